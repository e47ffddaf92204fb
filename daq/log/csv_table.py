"""Read CSV files as tables."""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Sequence
from datetime import datetime
from decimal import Decimal
from pathlib import Path

import numpy as np

from daq.config.import_description import Column, ImportDescription, TimeColumn, TimeUnit
from daq.errors import TableUnfit
from daq.files import sha256
from daq.log.csv_lines import MISSING, CsvLines, begins_with_word, no_row, read_lines
from daq.log.table import (
    ABSOLUTE_S,
    MIDNIGHT,
    Stamps,
    Table,
    check_reach,
    counter_wraps,
    cut_advice,
    cut_stamps,
    repeated,
    require_kept,
    rows_in_time,
    stamps_of_ns,
    stamps_of_numbers,
    without_wraps,
)
from ident.arrays import FloatArray

DAY_NS = 86_400 * 10**9
#: Steps back of a column that is no time; a restart of a clock or two is told by its row
FEWEST_BACK = 3
LARGEST_BACK_SHARE = 0.1  #: Likewise, as a share of the rows
_ISO = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:[.,](\d{1,9})\d*)?(Z|[+-]\d\d:?\d\d)")
_LIKE_CLOCK = re.compile(r"\d{1,2}:[0-5]\d(?!\d)")  #: A time in whatever spelling
_CLOCK = re.compile(r"(?:(\d{4}-\d\d-\d\d)[T ])?(\d{1,2}):([0-5]\d):([0-5]\d)(?:[.,](\d{1,9})\d*)?")


def read_csv(
    path: Path, wanted: ImportDescription, columns: tuple[Column, ...], time: TimeColumn | None
) -> Table:
    """Read columns of a CSV file in UTF-8, UTF-16 with a byte order mark, or Windows-1252.

    Raises:
        TableUnfit: the file cannot be read, has no rows, ends early, a line is no row or has
            another number of fields, a column is missing, or a field is not a finite number or
            time.
    """
    lines, remarks = read_lines(path, wanted, columns, time)
    stamps = None
    if time is not None:
        _require_once(lines, (*columns, time.column))
        stamps, of_stamps = _stamps_of(lines, time)
        _require_stamps(lines, time, stamps)
        remarks += tuple(f"{path.name}: {remark}" for remark in of_stamps)
        if wanted.keep is not None and wanted.keep.is_by_time:
            rows = rows_in_time(stamps, wanted.keep)
            require_kept(path, len(lines.rows), rows)
            lines = lines.select_rows(rows)
            stamps = cut_stamps(stamps, rows)
    stamps_beside = None
    if time is None and wanted.time is not None:
        occurrences = lines.names.count(str(wanted.time.column))
        if occurrences == 1:
            stamps_beside, _ = _stamps_of(lines, wanted.time)
    values = _numbers(lines, columns)
    digest = sha256("\n".join(lines.rows).encode())
    return Table(
        path=path,
        columns=columns,
        values=values,
        digest=digest,
        stamps=stamps,
        line_numbers=lines.line_numbers,
        first_row=lines.first_row,
        remarks=remarks,
        stamps_beside=stamps_beside,
    )


def _stamps_of(file: CsvLines, time: TimeColumn) -> tuple[Stamps, tuple[str, ...]]:
    """Return the stamps of a column, and remarks on them."""
    match time.unit:
        case TimeUnit.ISO_8601:
            return _dates(file, time), ()
        case TimeUnit.CLOCK:
            return _times_of_day(file, time)
        case _:
            values = _numbers(file, (time.column,))
            return _stamps(file, time, values[:, 0])


def _require_stamps(file: CsvLines, time: TimeColumn, stamps: Stamps) -> None:
    """Refuse a column of another quantity, which goes back again and again,
    and name those that go on as time does.
    """
    is_back = np.diff(stamps.time_s) < 0.0
    back = int(np.count_nonzero(is_back))
    if back < LARGEST_BACK_SHARE * len(file.rows) or back < FEWEST_BACK:
        return
    candidates = [str(column) for column in _increasing(file)]
    listed = ", ".join(candidates) or "none"
    if len(candidates) == 1:
        named = f"`time`: {{column: {candidates[0]}}}"
    else:
        named = "`column` of `time`"
    raise TableUnfit(
        f"{file.path}, column {time.column}",
        found=f"numbers that go back at {back} of {len(file.rows)} rows: this is no column "
        "of stamps",
        expected=f"a column that only grows; here: {listed}",
        remedy=f"correct {named} in the import description, or state `rate_hz` in its place",
    )


def _increasing(file: CsvLines) -> list[Column]:
    """Return the columns with numbers that grow from each row to the next."""
    fields = [file.fields(row) for row in file.rows]
    found: list[Column] = []
    for index in range(len(fields[0])):
        numbers = [file.to_number(row[index]) for row in fields]
        values = np.array(numbers)
        is_finite = np.isfinite(values).all()
        if is_finite and (np.diff(values) > 0.0).all():
            found.append(file.names[index] if file.names else index + 1)
    return found


def _check_reach(file: CsvLines, time: TimeColumn, seconds: FloatArray) -> None:
    """Refuse stamps that no clock has, naming the line."""
    check_reach(seconds, lambda row: f"{file.row_place(row)}, column {time.column}")


def _stamps(file: CsvLines, time: TimeColumn, values: FloatArray) -> tuple[Stamps, tuple[str, ...]]:
    """Return the stamps of a column of numbers; those since 1970 are read again, digit by digit."""
    seconds = values * time.unit.seconds
    _check_reach(file, time, seconds)
    if abs(seconds[0]) < ABSOLUTE_S:
        time_s, remarks = without_wraps(seconds, (*counter_wraps(), MIDNIGHT))
        if remarks:
            return stamps_of_numbers(time_s, TimeUnit.SECOND), remarks
        return stamps_of_numbers(values, time.unit), ()
    to_ns = Decimal(10) ** (9 - time.unit.digits)
    index = file.index(time.column)
    texts = (file.fields(row)[index].replace(",", ".") for row in file.rows)
    stamp_ns = [round(Decimal(text) * to_ns) for text in texts]
    return stamps_of_ns(stamp_ns), ()


def _dates(file: CsvLines, time: TimeColumn) -> Stamps:
    """Return the stamps of a column of dates and times with a zone (ISO 8601)."""
    expected = "a date and time with its zone, as 2026-03-01T08:00:00.004+01:00 or ...Z"
    remedy = (
        "correct `unit` of `time` in the import description, or add the zone to the file; `unit: "
        "clock` reads times without a zone"
    )
    stamp_ns = _texts_ns(file, time, _date_ns, expected, remedy)
    seconds = np.array([1e-9 * date_ns for date_ns in stamp_ns])
    _check_reach(file, time, seconds)
    return stamps_of_ns(stamp_ns)


def _times_of_day(file: CsvLines, time: TimeColumn) -> tuple[Stamps, tuple[str, ...]]:
    """Return the stamps of a column of times of day, since the midnight before the first one."""
    expected = (
        "a time of day of 24 hours, as 08:00:00.004, or a date before it, as 2026-03-01 "
        "08:00:00.004"
    )
    remedy = "correct `unit` of `time` in the import description, or export the times so"
    stamp_ns = _texts_ns(file, time, _clock_ns, expected, remedy)
    midnight_ns = stamp_ns[0] - stamp_ns[0] % DAY_NS
    since_ns = [one - midnight_ns for one in stamp_ns]
    has_date = max(stamp_ns) >= DAY_NS
    # A date that goes back is a wrong clock, or another run
    wraps = () if has_date else (MIDNIGHT,)
    since_s = np.array(since_ns) * 1e-9
    time_s, remarks = without_wraps(since_s, wraps)
    if remarks:
        return stamps_of_numbers(time_s, TimeUnit.SECOND), remarks
    return stamps_of_ns(since_ns), ()


def _texts_ns(
    file: CsvLines, time: TimeColumn, read: Callable[[str], int | None], expected: str, remedy: str
) -> list[int]:
    """Read a column of texts as stamps [ns].

    Raises:
        TableUnfit: a text is no stamp.
    """
    index = file.index(time.column)
    stamp_ns = []
    for number, row in enumerate(file.rows):
        text = file.fields(row)[index]
        one_ns = read(text)
        if one_ns is None:
            place = f"{file.row_place(number)}, column {time.column}"
            raise TableUnfit(place, found=f"{text!r:.60}", expected=expected, remedy=remedy)
        stamp_ns.append(one_ns)
    return stamp_ns


def _clock_ns(text: str) -> int | None:
    """Nanoseconds of a time of day since its midnight, or of a date and time since 1970;
    None for any other text.
    """
    match = _CLOCK.fullmatch(text)
    if match is None:
        return None
    date, hour, minute, second, fraction = match.groups(default="")
    if int(hour) >= 24:
        return None
    try:
        days = datetime.fromisoformat(date).toordinal() if date else 0
    except ValueError:  # the 30th of February
        return None
    minutes = int(hour) * 60 + int(minute)
    whole_s = minutes * 60 + int(second)
    return days * DAY_NS + whole_s * 10**9 + _fraction_ns(fraction)


def _date_ns(text: str) -> int | None:
    """Nanoseconds since 1970 of a date and time with its zone, None for any other text."""
    match = _ISO.fullmatch(text)
    if match is None:
        return None
    whole, fraction, zone = match.groups(default="")
    try:
        second = int(datetime.fromisoformat(whole + zone).timestamp())
    except ValueError:  # the 30th of February
        return None
    return second * 10**9 + _fraction_ns(fraction)


def _fraction_ns(digits: str) -> int:
    """Nanoseconds of the digits after the point of a second."""
    return int(digits.ljust(9, "0"))


def _require_once(file: CsvLines, columns: Sequence[Column]) -> list[int]:
    """Return the places of columns, each a column of its own.

    Raises:
        TableUnfit: a column is missing, or named twice.
    """
    indices = [file.index(column) for column in columns]
    for number, column in enumerate(columns):
        if indices[number] in indices[:number]:
            raise repeated(file.path, column, "once by name and once by number")
    return indices


def _numbers(file: CsvLines, columns: Sequence[Column]) -> FloatArray:
    """Read columns as numbers, shape (k, len(columns)).

    Raises:
        TableUnfit: a column is missing, or a field is not a finite number.
    """
    indices = _require_once(file, columns)
    numbers = array("d")
    for row in file.rows:
        fields = file.fields(row)
        numbers.extend([file.to_number(fields[index]) for index in indices])
    shape = (len(file.rows), len(indices))
    values = np.asarray(numbers).reshape(shape)
    wrong = np.argwhere(~np.isfinite(values))
    if wrong.size:
        number, column = wrong[0].tolist()
        index = indices[column]
        fields = file.fields(file.rows[number])
        text = fields[index]
        is_header = fields == list(file.names)
        if begins_with_word(file, number) and not is_header:
            raise no_row(file, number)
        remedy = _remedy(file, number, text, values)
        raise TableUnfit(
            file.field_place(number, index),
            found=f"{text!r:.60}",
            expected="a finite number",
            remedy=remedy,
        )
    _check_points(file, indices)
    for index, own in zip(indices, values.T, strict=True):
        _check_thousands(file, index, own)
    return values


def _check_points(file: CsvLines, indices: list[int]) -> None:
    """Refuse a point in a number under a decimal comma:
    it may group thousands, or be decimal after all.
    """
    if file.layout.decimal != ",":
        return
    for number, row in enumerate(file.rows):
        if "." not in row:
            continue
        fields = file.fields(row)
        for index in indices:
            if "." in fields[index]:
                place = file.field_place(number, index)
                raise TableUnfit(
                    place,
                    found=f"{fields[index]!r:.60}, with a point",
                    expected="a number with a decimal comma alone, as `table` of the import "
                    "description has it",
                    remedy="if points group thousands, export the numbers without them; if they "
                    "are decimal, write "
                    '`decimal: "."`',
                )


def _check_thousands(file: CsvLines, index: int, values: FloatArray) -> None:
    """Refuse a column in which the decimal sign must group thousands:
    987 among 1.234, and never 1.2 or 0.987.
    """
    has_decimals = (values % 1.0).any()
    if np.abs(values).max() >= 1000.0 or not has_decimals:
        return
    thousands = 1000.0 * values
    rest = np.abs(thousands - np.rint(thousands))
    if (rest > 1e-6).any():  # more than three digits: most columns end here
        return
    texts = [file.fields(row)[index] for row in file.rows]
    sign = re.escape(file.layout.decimal)
    grouped = re.compile(rf"[-+]?[1-9]\d{{0,2}}{sign}\d{{3}}")
    plain = re.compile(r"[-+]?\d{1,3}")
    first_grouped = None
    first_plain = None
    for number, text in enumerate(texts):
        if grouped.fullmatch(text):
            if first_grouped is None:
                first_grouped = number
        elif not plain.fullmatch(text):
            return
        elif first_plain is None and text.strip("+-0"):
            first_plain = text
    if first_grouped is None or first_plain is None:
        return
    raise TableUnfit(
        file.field_place(first_grouped, index),
        found=f"{texts[first_grouped]!r} and {first_plain!r}: three digits after every "
        f"{file.layout.decimal!r} of the column",
        expected="numbers whose thousands are not grouped",
        remedy="export them without grouping; if these are decimals, export all numbers with the "
        "same three",
    )


def _remedy(file: CsvLines, row: int, text: str, values: FloatArray) -> str:
    """Advice for a field that is not a finite number.

    Args:
        file: with the field.
        row: of the field.
        text: of the field.
        values: of the columns that are read, shape (k, n).
    """
    if file.layout.decimal == "." and re.fullmatch(r"[-+]?\d+,\d+", text):
        advice = 'write `decimal: ","` under `table` in the import description'
        if text[-4:-3] == ",":
            advice += "; if commas group thousands, export the numbers without them"
        return advice
    if row == 0 and not file.layout.header:
        return (
            "if this line is a header, write `header: true` under `table` in the import description"
        )
    if _ISO.fullmatch(text) or _CLOCK.fullmatch(text):
        return (
            "if this is the time, write `unit: clock` under `time` in the import description: a "
            "time of day, without a date and its zone, so that nothing is known of the order of "
            "runs; `unit: iso8601` reads both"
        )
    if _LIKE_CLOCK.search(text):
        return (
            "if this is the time, export it as 08:00:00.004, of 24 hours, or as 2026-03-01 "
            "08:00:00.004, and write `unit: clock` under `time` in the import description"
        )
    return _remedy_for_a_line(file, row, text, values)


def _remedy_for_a_line(file: CsvLines, row: int, text: str, values: FloatArray) -> str:
    """Advice for a row that has a field that is no finite number."""
    fields = file.fields(file.rows[row])
    if file.names and fields == list(file.names):
        before = file.first_row + row
        return (
            "the header is there once more: import what is before it by `keep: {to_row: "
            f"{before}}}`, and what is after it by `keep: {{from_row: {before + 2}}}`"
        )
    if row == 0 and set(file.names).intersection(fields):
        return (
            "this is a second header, with the names in another order or with other names: nothing "
            "says which of the two is right; delete the wrong one from the file"
        )
    has_number = any(np.isfinite(values[0]))
    if row == 0 and text.lower() not in MISSING and not has_number:
        following = file.first_row + 2
        return (
            "if this line is no row (units, a second header), leave it out: `keep: {from_row: "
            f"{following}}}` in the import description"
        )
    return cut_advice(values, file.first_row)
