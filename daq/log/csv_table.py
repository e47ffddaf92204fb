"""Read CSV files as tables."""

from __future__ import annotations

import csv
import math
import re
from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import numpy as np

from daq.config.import_description import Column, CsvLayout, ImportDescription, TimeColumn, TimeUnit
from daq.errors import TableUnfit
from daq.files import read_regular, sha256
from daq.log.table import Stamps, Table, check_reach, repeated, stamps_of_ns, stamps_of_numbers, unreadable
from ident.arrays import FloatArray

ABSOLUTE_S = 1e8  #: Stamps above this are since 1970, and floats are too coarse for them: 0.2 µs
LARGEST_BYTES = 2**30  #: Largest file; an hour of six axes at 1 kHz has half of it
LARGEST_JUMP = 3.0  #: Largest step to a last number that may be cut off, in multiples of the largest step before it
_ISO = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:[.,](\d{1,9})\d*)?(Z|[+-]\d\d:?\d\d)")


def read_csv(path: Path, wanted: ImportDescription, columns: tuple[Column, ...], time: TimeColumn | None) -> Table:
    """Read columns of a CSV file in UTF-8, UTF-16 with a byte order mark, or Windows-1252.

    Raises:
        TableUnfit: the file cannot be read, has no rows, ends early, a line has another number of fields, a column is
            missing, or a field is not a finite number or time.
    """
    lines, remarks = _read_lines(path, wanted.table)
    dated = time is not None and time.unit is TimeUnit.ISO_8601
    values = _numbers(lines, columns if time is None or dated else (*columns, time.column))
    stamps = None
    if time is not None:
        stamps = _dates(lines, time) if dated else _stamps(lines, time, values[:, -1])
    digest = sha256("\n".join(lines.rows).encode())
    return Table(path, columns, values[:, : len(columns)], digest, stamps, lines.first_line, remarks)


@dataclass(frozen=True, slots=True)
class _Lines:
    """A CSV file as lines."""

    path: Path  #: path of the file
    table: CsvLayout  #: its layout
    names: tuple[str, ...]  #: column names from the header; empty without one
    rows: tuple[str, ...]  #: lines of numbers
    first_line: int  #: line number of the first row, from 1

    def fields(self, row: str) -> list[str]:
        """Split a line into fields without quotes and white space; a delimiter between quotes belongs to its field.

        Raises:
            csv.Error: a quote is not closed.
        """
        delimiter = self.table.delimiter
        if '"' not in row:
            return row.split() if delimiter == " " else [part.strip() for part in row.split(delimiter)]
        text = " ".join(row.split()) if delimiter == " " else row.strip(" ")
        reader = csv.reader([text], delimiter=delimiter, skipinitialspace=True, strict=True)
        return [part.strip() for part in next(reader)]

    def place(self, row: int, index: int) -> str:
        """Name a field in a message: `run.csv:42, column i3`."""
        return f"{self.path}:{self.first_line + row}, column {self.names[index] if self.names else index + 1}"

    def number(self, text: str) -> float:
        """Read a field; NaN if it is no number."""
        if "_" in text:  # Python reads 1_000, no other program does
            return math.nan
        try:
            return float(text.replace(",", ".") if self.table.decimal == "," else text)
        except ValueError:
            return math.nan


def _read_lines(path: Path, table: CsvLayout) -> tuple[_Lines, tuple[str, ...]]:
    """Read a file as lines, all of the same number of fields, and remark on what is odd about it.

    Raises:
        TableUnfit: the file cannot be read, has no rows, ends early, or a line has another number of fields.
    """
    try:
        data = read_regular(path, LARGEST_BYTES)
    except OSError as error:
        raise unreadable(path, error, "a CSV file") from error
    text, *remarks = _decoded(path, data)
    lines = text.splitlines()
    whole = text.endswith(("\n", "\r"))
    while lines and not lines[-1].strip():
        lines.pop()
    start = table.skip_rows + (1 if table.header else 0)
    rows = tuple(lines[start:])
    if not rows:
        raise TableUnfit(
            str(path),
            found=f"{len(lines)} lines, of which {min(start, len(lines))} before the numbers",
            expected="a line of numbers for each sample",
            remedy="was the export interrupted?",
        )
    bare = _Lines(path, table, (), rows, start + 1)
    _check_quotes(bare, lines)
    names = tuple(bare.fields(lines[table.skip_rows])) if table.header else ()
    _check_header(bare, names)
    _check_shape(bare, len(names))
    if not whole and len(rows) > 1:
        _check_last(bare)
        remarks.append("the last line has no end of line; its numbers are complete and were taken")
    return _Lines(path, table, names, rows, start + 1), tuple(f"{path.name}: {remark}" for remark in remarks)


def _decoded(path: Path, data: bytes) -> tuple[str, ...]:
    """Return the text, and a remark if it is not UTF-8."""
    bom = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    try:
        decoded = (data.decode("utf-16"), "read as UTF-16") if bom else (data.decode("utf-8-sig"),)
        place, kind = decoded[0].find("\0"), "NUL"
    except UnicodeDecodeError as error:
        decoded, place, kind = (data.decode("cp1252", "replace"), "no UTF-8; read as Windows-1252"), -1, "no UTF-8"
        if bom or "\0" in decoded[0] or "\ufffd" in decoded[0]:
            place, kind = error.start, "no UTF-16" if bom else "no UTF-8"
    if place >= 0:
        raise TableUnfit(
            str(path),
            found=f"byte {place} is {kind}",
            expected="text in UTF-8, UTF-16 with a byte order mark, or Windows-1252",
            remedy="is this a CSV file? if so, save it as UTF-8",
        )
    return decoded


def _check_quotes(file: _Lines, lines: Sequence[str]) -> None:
    """Refuse a quote that is not closed: where the fields of such a line end is a guess."""
    for number, line in enumerate(lines[file.table.skip_rows :], start=file.table.skip_rows + 1):
        if '"' not in line:
            continue
        try:
            file.fields(line)
        except csv.Error as error:
            raise TableUnfit(
                f"{file.path}:{number}",
                found=f"a quote that does not enclose a whole field, in {line[:40]!r}",
                expected="quotes around whole fields, closed on the same line",
                remedy="export the table without quotes, or without that column",
            ) from error


def _check_header(file: _Lines, names: tuple[str, ...]) -> None:
    """Refuse a header of numbers, the first row of a file without one; columns may be called 0, 1, 2 and so on."""
    values = [file.number(name) for name in names]
    counted = len(values) > 1 and values[0] in (0.0, 1.0) and all(b - a == 1.0 for a, b in pairwise(values))
    if values and np.isfinite(values).all() and not counted:
        raise TableUnfit(
            f"{file.path}:{file.first_line - 1}",
            found=f"a header of numbers, {', '.join(names[:3])}" + (" ..." if len(names) > 3 else ""),
            expected="names of columns",
            remedy="if the file has no header, write `header: false` under `table` and columns as numbers from 1",
        )


def _check_last(file: _Lines) -> None:
    """Refuse a last number that may lack digits: one with fewer decimals than all others, or one that jumps."""
    ends = [file.fields(row)[-1] for row in file.rows]
    values = np.array([file.number(end) for end in ends])
    decimals = [len(end.partition(file.table.decimal)[2]) for end in ends]
    steps = np.abs(np.diff(values))
    jumps = len(steps) > 1 and steps[-1] > LARGEST_JUMP * steps[:-1].max()
    if np.isfinite(values[:-1]).all() and (decimals[-1] < min(decimals[:-1]) or jumps or not math.isfinite(values[-1])):
        raise TableUnfit(
            f"{file.path}:{file.first_line + len(file.rows) - 1}",
            found=f"a last number {ends[-1]!r} without an end of line, after {ends[-2]!r}",
            expected="a number with all its digits",
            remedy="the file ends early: export or copy it again, or delete its last line",
        )


def _stamps(file: _Lines, time: TimeColumn, values: FloatArray) -> Stamps:
    """Return the stamps of a column of numbers; those since 1970 are read again, digit by digit."""
    check_reach(values * time.unit.seconds, lambda row: f"{file.path}:{file.first_line + row}, column {time.column}")
    if abs(values[0]) * time.unit.seconds < ABSOLUTE_S:
        return stamps_of_numbers(values, time.unit)
    to_ns, index = Decimal(10) ** (9 - time.unit.digits), _index(file, time.column)
    texts = (file.fields(row)[index].replace(",", ".") for row in file.rows)
    return stamps_of_ns([round(Decimal(text) * to_ns) for text in texts])


def _dates(file: _Lines, time: TimeColumn) -> Stamps:
    """Return the stamps of a column of dates and times with a zone (ISO 8601)."""
    index, stamp_ns = _index(file, time.column), []
    for number, row in enumerate(file.rows):
        text = file.fields(row)[index]
        date_ns = _date_ns(text)
        if date_ns is None:
            raise TableUnfit(
                f"{file.path}:{file.first_line + number}, column {time.column}",
                found=repr(text),
                expected="a date and time with its zone, as 2026-03-01T08:00:00.004+01:00 or ...Z",
                remedy="correct `unit` of `time` in the import description, or add the zone to the file",
            )
        stamp_ns.append(date_ns)
    seconds = np.array([1e-9 * date_ns for date_ns in stamp_ns])
    check_reach(seconds, lambda row: f"{file.path}:{file.first_line + row}, column {time.column}")
    return stamps_of_ns(stamp_ns)


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
    return second * 10**9 + int(fraction.ljust(9, "0"))


def _numbers(file: _Lines, columns: Sequence[str | int]) -> FloatArray:
    """Read columns as numbers, shape (k, len(columns)).

    Raises:
        TableUnfit: a column is missing, or a field is not a finite number.
    """
    indices = [_index(file, column) for column in columns]
    if twice := [column for number, column in enumerate(columns) if indices[number] in indices[:number]]:
        raise repeated(file.path, twice[0], "once by name and once by number")
    numbers = array("d")
    for row in file.rows:
        fields = file.fields(row)
        numbers.extend([file.number(fields[index]) for index in indices])
    values = np.asarray(numbers).reshape(len(file.rows), len(indices))
    wrong = np.argwhere(~np.isfinite(values))
    if wrong.size:
        number, column = wrong[0].tolist()
        index = indices[column]
        text = file.fields(file.rows[number])[index]
        remedy = _remedy(file, number, text)
        raise TableUnfit(file.place(number, index), found=repr(text), expected="a finite number", remedy=remedy)
    _check_points(file, indices)
    for index, own in zip(indices, values.T, strict=True):
        _check_thousands(file, index, own)
    return values


def _check_points(file: _Lines, indices: list[int]) -> None:
    """Refuse a point in a number under a decimal comma: it may group thousands, or be decimal after all."""
    if file.table.decimal != ",":
        return
    for number, row in enumerate(file.rows):
        if "." not in row:
            continue
        fields = file.fields(row)
        for index in indices:
            if "." in fields[index]:
                raise TableUnfit(
                    file.place(number, index),
                    found=f"{fields[index]!r}, with a point",
                    expected="a number with a decimal comma alone, as `table` of the import description has it",
                    remedy="if points group thousands, export the numbers without them; if they are decimal, write "
                    '`decimal: "."`',
                )


def _check_thousands(file: _Lines, index: int, values: FloatArray) -> None:
    """Refuse a column in which the decimal sign must group thousands: 987 beside 1.234, and never 1.2 or 0.987."""
    if np.abs(values).max() >= 1000.0 or not (values % 1.0).any():
        return
    thousands = 1000.0 * values
    if (np.abs(thousands - np.rint(thousands)) > 1e-6).any():  # more than three digits: most columns end here
        return
    texts = [file.fields(row)[index] for row in file.rows]
    sign = re.escape(file.table.decimal)
    grouped, plain = re.compile(rf"[-+]?[1-9]\d{{0,2}}{sign}\d{{3}}"), re.compile(r"[-+]?\d{1,3}")
    first = next((number for number, text in enumerate(texts) if grouped.fullmatch(text)), None)
    beside = next((text for text in texts if plain.fullmatch(text) and text.strip("+-0")), None)
    if first is None or beside is None or not all(grouped.fullmatch(text) or plain.fullmatch(text) for text in texts):
        return
    raise TableUnfit(
        file.place(first, index),
        found=f"{texts[first]!r} beside {beside!r}: three digits behind every {file.table.decimal!r} of the column",
        expected="numbers whose thousands are not grouped",
        remedy="export them without grouping; if these are decimals, export all numbers with the same three",
    )


def _check_shape(file: _Lines, named: int) -> None:
    counts = np.array([len(file.fields(row)) for row in file.rows])
    usual = named or Counter(counts.tolist()).most_common(1)[0][0]
    wrong = np.flatnonzero(counts != usual)
    last = len(file.rows) - 1
    if wrong.size and (wrong[0] != last or counts[last] > usual or last == 0):
        first = int(wrong[0])
        raise TableUnfit(
            f"{file.path}:{file.first_line + first}",
            found=f"{counts[first]} columns",
            expected=f"{usual}, as in {'the header' if named else 'most lines'}",
            remedy="check the delimiter in the import description, and the export",
        )
    if wrong.size or (not file.fields(file.rows[last])[-1] and file.fields(file.rows[0])[-1]):
        raise TableUnfit(
            f"{file.path}:{file.first_line + last}",
            found=f"a last line {file.rows[last][-40:]!r} of {counts[last]} fields",
            expected=f"{usual} complete fields",
            remedy="the file ends early; export or copy it again",
        )


def _index(file: _Lines, column: str | int) -> int:
    width = len(file.fields(file.rows[0]))
    if isinstance(column, int):
        if column <= width:
            return column - 1
        raise TableUnfit(
            str(file.path), found=f"{width} columns", expected=f"a column {column}", remedy="columns count from 1"
        )
    if file.names.count(column) == 1:
        return file.names.index(column)
    raise TableUnfit(
        str(file.path),
        found=f"columns {', '.join(file.names)}",
        expected=f"one column {column!r}",
        remedy="correct `columns` in the import description",
    )


def _remedy(file: _Lines, row: int, text: str) -> str:
    """Advice for a field that is not a finite number."""
    if file.table.decimal == "." and re.fullmatch(r"[-+]?\d+,\d+", text):
        grouped = "; if commas group thousands, export the numbers without them" if text[-4:-3] == "," else ""
        return 'write `decimal: ","` under `table` in the import description' + grouped
    if row == 0 and not file.table.header:
        return "if this line is a header, write `header: true` under `table` in the import description"
    return "samples are never invented: cut the recording there, or export it again"
