"""A CSV file as lines: its header, its line of units, its rows of numbers,
and what is none of these.

Lines that are empty, or begin with the sign of a comment, are left out before and after the rows.
Among the rows they may part two recordings, so there they are refused, unless the import
description says what they are.
"""

from __future__ import annotations

import codecs
import csv
import io
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from daq.config.foreign_files import foreign_kind
from daq.config.import_description import Column, CsvLayout, ImportDescription, TimeColumn
from daq.errors import TableUnfit, counted
from daq.files import read_regular
from daq.log.column_units import check_units, column_unit_of, expected_units
from daq.log.table import unreadable

LARGEST_BYTES = 2**30  #: Largest file; an hour of six axes at 1 kHz has half of it
#: Largest step to a last number that may be cut off, in multiples of the largest step before it
LARGEST_JUMP = 3.0
COMMENT_SIGNS = ("#", "%", "//")  #: Of lines before and after the rows
EXCERPT_CHARACTERS = 40  #: Characters of a line in a message
#: Usual delimiters, and how YAML has them
DELIMITERS = {",": '","', ";": '";"', "\t": r'"\t"', "|": '"|"', " ": '" "'}
MINUS = "\u2212"  #: The minus sign of typography, which spreadsheets write
MISSING = frozenset(("", "nan", "+nan", "-nan", "inf", "+inf", "-inf", "na", "n/a", "null", "none"))
"""Words for a number that is not there, in lower case: a line with them is a row."""


@dataclass(frozen=True, slots=True)
class CsvLines:
    """A CSV file as lines."""

    path: Path  #: path of the file
    layout: CsvLayout  #: delimiter, decimal sign and header
    names: tuple[str, ...]  #: column names from the header; empty without one
    rows: tuple[str, ...]  #: lines of numbers
    line_numbers: Sequence[int]  #: of each row, from 1
    first_row: int  #: rows that were cut off before the first one

    def fields(self, row: str) -> list[str]:
        """Split a line into fields without quotes and white space;
        a delimiter between quotes belongs to its field.

        Raises:
            csv.Error: a quote is not closed.
        """
        return split_fields(row, self.layout.delimiter)

    def field_place(self, row: int, index: int) -> str:
        """Name a field in a message: `run.csv:42, column i3`."""
        column = self.names[index] if self.names else index + 1
        return f"{self.row_place(row)}, column {column}"

    def row_place(self, row: int) -> str:
        """Name the line of a row in a message: `run.csv:42`."""
        return f"{self.path}:{self.line_numbers[row]}"

    def to_number(self, text: str) -> float:
        """Read a field; NaN if it is no number."""
        return read_number(text, self.layout.decimal)

    def index(self, column: Column) -> int:
        """Return the place of a column.

        Raises:
            TableUnfit: it is not there, or twice.
        """
        width = len(self.fields(self.rows[0]))
        if isinstance(column, int):
            if column <= width:
                return column - 1
            raise TableUnfit(
                str(self.path),
                found=counted(width, "column"),
                expected=f"a column {column}",
                remedy="columns count from 1",
            )
        if self.names.count(column) == 1:
            return self.names.index(column)
        remedy = "correct `columns` in the import description"
        other = self._other_delimiter(column)
        if other:
            remedy = f"write `delimiter: {other}` under `table` of the import description"
        raise TableUnfit(
            str(self.path),
            found=f"columns {', '.join(self.names)}",
            expected=f"one column {column!r}",
            remedy=remedy,
        )

    def _other_delimiter(self, column: str) -> str:
        """Return the delimiter, as YAML has it, that a header of one field is split by;
        empty where none gives the column.
        """
        if len(self.names) != 1:
            return ""
        for delimiter, as_yaml in DELIMITERS.items():
            if column in split_fields(self.names[0], delimiter):
                return as_yaml
        return ""

    def select_rows(self, rows: slice) -> CsvLines:
        """Return some of the rows."""
        first, _, _ = rows.indices(len(self.rows))
        return CsvLines(
            path=self.path,
            layout=self.layout,
            names=self.names,
            rows=self.rows[rows],
            line_numbers=self.line_numbers[rows],
            first_row=self.first_row + first,
        )


def split_fields(row: str, delimiter: str) -> list[str]:
    """Split a line into fields; see `CsvLines.fields`."""
    if '"' not in row:
        if delimiter == " ":
            return row.split()
        return [part.strip() for part in row.split(delimiter)]
    if delimiter == " ":
        text = " ".join(row.split())
    else:
        text = row.strip(" ")
    reader = csv.reader([text], delimiter=delimiter, skipinitialspace=True, strict=True)
    return [part.strip() for part in next(reader)]


def read_number(text: str, decimal: str) -> float:
    """Read a field; NaN if it is no number."""
    if "_" in text:  # Python reads 1_000, no other program does
        return math.nan
    if decimal == ",":
        text = text.replace(",", ".")
    try:
        return float(text)
    except ValueError:
        return math.nan


def read_lines(
    path: Path, wanted: ImportDescription, columns: Sequence[Column], time: TimeColumn | None
) -> tuple[CsvLines, tuple[str, ...]]:
    """Read a file as lines, all of the same number of fields, and remark on what is odd about it.

    Args:
        path: of the file.
        wanted: its layout, and the rows that are kept.
        columns: that are read, without that of the time.
        time: the time column, if it is in this file.

    Raises:
        TableUnfit: the file cannot be read, has no rows, ends early, a line is no row, or has
            another number of fields; its line of units contradicts the import description.
    """
    try:
        data = read_regular(path, LARGEST_BYTES)
    except OSError as error:
        raise unreadable(path, error, "a CSV file") from error
    text, *remarks = _decode(path, data)
    has_last_end = text.endswith(("\n", "\r"))
    # The line ends of editors; `splitlines` also parts a line at a form feed and at ends of
    # Unicode's.
    all_lines = [line.removesuffix("\n") for line in io.StringIO(text, newline=None)]
    file = _RawLines(path, wanted.table, all_lines)
    sought = list(columns)
    if time is not None:
        sought.append(time.column)
    named = [column for column in sought if isinstance(column, str)]
    start, names = file.find_header(named)
    header_number = start
    units_line = file.units_line(start, names, columns, time)
    expected = tuple(expected_units(path, wanted, time))
    if units_line is None:
        check_units(f"{path}:{header_number}", None, names, expected)
    else:
        check_units(f"{path}:{units_line + 1}", file.fields(units_line), names, expected)
        start = units_line + 1
        remarks.append(
            f"line {start} was taken for the units of the columns: {file.excerpt(units_line)}"
        )
    end = file.end_of_rows(start)
    footer = [number for number in range(end, len(file.lines)) if not file.is_blank(number)]
    if footer:
        lines_left_out = counted(len(footer), "line")
        excerpt = file.excerpt(footer[0])
        remarks.append(f"left out after the rows: {lines_left_out}, {excerpt}")
    numbers, skipped = file.row_numbers(start, end, has_time=wanted.time is not None)
    remarks += skipped
    rows = slice(None) if wanted.keep is None else wanted.keep.rows
    first, _, _ = rows.indices(len(numbers))
    kept = numbers[rows]
    if not kept:
        raise _without_rows(file, start, len(numbers), wanted)
    file.check_quotes(kept)
    rows_as_read = [file.lines[number] for number in kept]
    rows_kept = tuple(row.replace(MINUS, "-") for row in rows_as_read)
    if any(MINUS in row for row in rows_as_read):
        remarks.append("the minus sign U+2212 was read as -")
    line_numbers = [number + 1 for number in kept]
    lines = CsvLines(path, wanted.table, names, rows_kept, line_numbers, first)
    _check_header(lines, header_number)
    _check_shape(lines, len(names))
    is_last = not footer and kept[-1] == end - 1
    if is_last and not has_last_end and len(kept) > 1:
        _check_last_number(lines)
        remarks.append("the last line has no end of line; its numbers are complete and were taken")
    return lines, tuple(f"{path.name}: {remark}" for remark in remarks)


def _without_rows(file: _RawLines, start: int, rows: int, wanted: ImportDescription) -> TableUnfit:
    """Make the error for a file without rows, or without those that are kept."""
    lines = len(file.lines)
    before = min(start, lines)
    found = f"{counted(lines, 'line')}, {before} of them before the numbers"
    if before:
        found += f": {file.excerpt(before - 1)}"
    remedy = "is this the file with the rows, and was its export finished?"
    if rows and wanted.keep is not None:
        found = f"{counted(rows, 'row')} of numbers, none of them in `keep`"
        remedy = "correct `keep` in the import description"
    return TableUnfit(
        str(file.path), found=found, expected="a line of numbers for each sample", remedy=remedy
    )


@dataclass(frozen=True, slots=True)
class _RawLines:
    """All lines of a file, and which of them are header, units, rows and footer."""

    path: Path
    layout: CsvLayout
    lines: list[str]

    def fields(self, number: int) -> list[str]:
        """Split a line; one field where a quote is not closed."""
        try:
            return split_fields(self.lines[number], self.layout.delimiter)
        except csv.Error:
            return [self.lines[number]]

    def excerpt(self, number: int) -> str:
        """Return a line for a message."""
        return repr(self.lines[number][:EXCERPT_CHARACTERS])

    def is_comment(self, number: int) -> bool:
        """Whether a line begins with the sign of a comment."""
        signs: tuple[str, ...] = COMMENT_SIGNS
        if self.layout.comment is not None:
            signs = (*signs, self.layout.comment)
        return self.lines[number].lstrip().startswith(signs)

    def is_blank(self, number: int) -> bool:
        """Whether a line is empty, or has blanks only."""
        return not self.lines[number].strip()

    def is_skipped(self, number: int) -> bool:
        """Whether a line is empty or a comment."""
        return self.is_blank(number) or self.is_comment(number)

    def is_row(self, number: int) -> bool:
        """Whether a line has a number."""
        numbers = (read_number(field, self.layout.decimal) for field in self.fields(number))
        return any(map(math.isfinite, numbers))

    def find_header(self, named: Iterable[str]) -> tuple[int, tuple[str, ...]]:
        """Return the first line after the header, and its names.

        A header may begin with the sign of a comment: it is the line that has the names that are
        looked for, or the last one before the rows.
        """
        start = self._skip_delimiter_line(self.layout.skip_rows)
        wanted = set(named)
        first = start
        while first < len(self.lines):
            if not self.is_skipped(first):
                break
            if self.layout.header and self._is_header(first, wanted):
                break
            first += 1
        if not self.layout.header:
            return first, ()
        if first >= len(self.lines):
            return first, ()
        names = self.fields(first)
        if not wanted <= set(names):
            bare = self._without_sign(first)
            if wanted <= set(bare):
                names = bare
        return first + 1, tuple(names)

    def _is_header(self, number: int, wanted: set[str]) -> bool:
        if self.is_blank(number):
            return False
        if wanted:
            has_names = wanted <= set(self.fields(number))
            if has_names or wanted <= set(self._without_sign(number)):
                return True
        following = number + 1
        if following >= len(self.lines):
            return False
        return self.is_row(following) and not self.is_comment(following)

    def _without_sign(self, number: int) -> list[str]:
        text = self.lines[number].lstrip()
        for sign in COMMENT_SIGNS:
            text = text.removeprefix(sign)
        if '"' not in text:
            return split_fields(text.strip(), self.layout.delimiter)
        return []

    def _skip_delimiter_line(self, number: int) -> int:
        """Return the line after `sep=;`, by which a spreadsheet names the delimiter."""
        if number >= len(self.lines):
            return number
        text = self.lines[number].strip().strip('"')
        is_delimiter_line = text.lower().startswith("sep=")
        if not is_delimiter_line or len(text) > len("sep=x"):
            return number
        bare = self.lines[number].strip(' "\r\n')
        stated = bare[len("sep=") :]
        if stated and stated != self.layout.delimiter:
            raise TableUnfit(
                f"{self.path}:{number + 1}",
                found=f"`sep={stated}`, which names the delimiter of the file",
                expected=f"{self.layout.delimiter!r}, the `delimiter` under `table` of the import "
                "description",
                remedy=f"write `delimiter: {stated!r}` there",
            )
        return number + 1

    def units_line(
        self, start: int, names: tuple[str, ...], columns: Sequence[Column], time: TimeColumn | None
    ) -> int | None:
        """Return the line of units below the header, None without one.

        Its fields are no numbers, and at least one of those that are read, that of the time among
        them, is a unit.
        """
        number = start
        while number < len(self.lines) and self.is_skipped(number):
            number += 1
        if not names or number >= len(self.lines):
            return None
        fields = self.fields(number)
        if len(fields) != len(names) or self.is_row(number):
            return None
        read = [fields[index] for index in _present_indices(columns, names)]
        if any(field.lower() in MISSING for field in read):
            return None
        if time is not None:
            read += [fields[index] for index in _present_indices([time.column], names)]
        if any(column_unit_of(field) is not None for field in read):
            return number
        return None

    def end_of_rows(self, start: int) -> int:
        """Return the line after the last row: empty lines and comments there are no rows."""
        end = len(self.lines)
        while end > start and self.is_skipped(end - 1):
            end -= 1
        return end

    def row_numbers(self, start: int, end: int, *, has_time: bool) -> tuple[list[int], list[str]]:
        """Return the numbers of the lines that are rows or ought to be, from 0,
        and remarks on those that are not.

        Args:
            start, end: first line after the head, and after the last row.
            has_time: stamps show where a recording goes on, so that an empty line says nothing.
        """
        while start < end and self.is_skipped(start):
            start += 1
        candidates = range(start, end)
        comments = self._declared_comments(candidates)
        empty = [number for number in candidates if self.is_blank(number)]
        remarks = []
        left_out = set(comments)
        if not has_time:
            self._require_no_commented_row(comments)
        if comments:
            lines = counted(len(comments), "line")
            remarks.append(f"left out, as `comment` says: {lines} among the rows")
        if empty and (has_time or _is_every_other(empty, len(candidates))):
            left_out |= set(empty)
            lines = counted(len(empty), "empty line")
            remarks.append(f"left out: {lines} among the rows")
        return [number for number in candidates if number not in left_out], remarks

    def _declared_comments(self, candidates: range) -> list[int]:
        """Return the numbers of the lines that begin with the sign of the layout."""
        sign = self.layout.comment
        if not sign:
            return []
        return [number for number in candidates if self.lines[number].lstrip().startswith(sign)]

    def _require_no_commented_row(self, comments: Sequence[int]) -> None:
        """Refuse a row that is commented out:
        at a stated rate, all that follow would move by a sample.
        """
        sign = self.layout.comment or ""
        for number in comments:
            text = self.lines[number].lstrip().removeprefix(sign).strip()
            if '"' in text or not text:
                continue
            fields = split_fields(text, self.layout.delimiter)
            values = [read_number(field, self.layout.decimal) for field in fields]
            if len(values) > 1 and all(map(math.isfinite, values)):
                excerpt = self.excerpt(number)
                raise TableUnfit(
                    f"{self.path}:{number + 1}",
                    found=f"{excerpt}, a row of numbers that is commented out, at a rate without "
                    "stamps",
                    expected="every sample, as `rate_hz` gives each row its time",
                    remedy="take the sign of the comment away, name a column of stamps by `time`, "
                    "or import what is before it and what is after it by `keep`",
                )

    def check_quotes(self, numbers: Sequence[int]) -> None:
        """Refuse a quote that is not closed: where the fields of such a line end is a guess."""
        for number in numbers:
            if '"' not in self.lines[number]:
                continue
            try:
                split_fields(self.lines[number], self.layout.delimiter)
            except csv.Error as error:
                raise TableUnfit(
                    f"{self.path}:{number + 1}",
                    found=f"a quote that does not enclose a whole field, in {self.excerpt(number)}",
                    expected="quotes around whole fields, closed on the same line",
                    remedy="export the table without quotes, or without that column",
                ) from error


def _is_every_other(numbers: Sequence[int], count: int) -> bool:
    """Whether every other of so many lines is one of these."""
    if len(numbers) < 2:
        return False
    distances = {later - number for number, later in pairwise(numbers)}
    return distances == {2} and 2 * len(numbers) + 1 >= count


def _present_indices(columns: Sequence[Column], names: tuple[str, ...]) -> list[int]:
    """Return the places of the columns that are there."""
    found = []
    for column in columns:
        if isinstance(column, int):
            if column <= len(names):
                found.append(column - 1)
        elif column in names:
            found.append(names.index(column))
    return found


def _decode(path: Path, data: bytes) -> tuple[str, ...]:
    """Return the text, and a remark if it is not UTF-8.

    Raises:
        TableUnfit: it is no text, with the place of the first byte that shows it, or the name of
            its kind.
    """
    other = foreign_kind(data)
    if other is not None:
        raise TableUnfit(str(path), found=other.value, expected="a CSV file", remedy=other.remedy)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return _decode_utf16(path, data)
    mark = codecs.BOM_UTF8 if data.startswith(codecs.BOM_UTF8) else b""
    try:
        text = data[len(mark) :].decode("utf-8")
    except UnicodeDecodeError as error:
        text = data.decode("cp1252", "replace")
        if mark or "\0" in text or "\ufffd" in text:
            raise _no_text(path, len(mark) + error.start, "no UTF-8") from error
        return text, "no UTF-8; read as Windows-1252"
    nul = data.find(b"\0")
    if nul >= 0 and not data[nul:].strip(b"\0"):
        raise TableUnfit(
            str(path),
            found=f"nothing but NUL from byte {nul} to the end",
            expected="rows of numbers to the last line",
            remedy="the computer that wrote it lost power, or the disk was full: copy or export "
            f"it again, or cut the file there (`head -c {nul}`)",
        )
    if nul >= 0:
        raise _no_text(path, nul, "NUL")
    return (text,)


def _decode_utf16(path: Path, data: bytes) -> tuple[str, ...]:
    """Return the text of a file with the byte order mark of UTF-16, and a remark."""
    mark = data[: len(codecs.BOM_UTF16_LE)]
    if mark == codecs.BOM_UTF16_LE:
        encoding = "utf-16-le"
    else:
        encoding = "utf-16-be"
    try:
        text = data[len(mark) :].decode(encoding)
    except UnicodeDecodeError as error:
        raise _no_text(path, len(mark) + error.start, "no UTF-16") from error
    nul = text.find("\0")
    if nul >= 0:
        before = text[:nul].encode(encoding)
        raise _no_text(path, len(mark) + len(before), "NUL")
    return text, "read as UTF-16"


def _no_text(path: Path, place: int, kind: str) -> TableUnfit:
    """Make the error for a file with a byte, counted from 0, that no text has."""
    return TableUnfit(
        str(path),
        found=f"byte {place} is {kind}",
        expected="text in UTF-8, UTF-16 with a byte order mark, or Windows-1252",
        remedy="is this a CSV file? if so, save it as UTF-8",
    )


def _check_header(file: CsvLines, line_number: int) -> None:
    """Refuse a header of numbers, the first row of a file without one;
    columns may be called 0, 1, 2 and so on.
    """
    names = file.names
    values = [file.to_number(name) for name in names]
    if values and np.isfinite(values).all() and not _are_counted(values):
        first_names = ", ".join(names[:3])
        more = " ..." if len(names) > 3 else ""
        raise TableUnfit(
            f"{file.path}:{line_number}",
            found=f"a header of numbers, {first_names}{more}",
            expected="names of columns",
            remedy="if the file has no header, write `header: false` under `table` and columns as "
            "numbers from 1",
        )


def _are_counted(values: Sequence[float]) -> bool:
    """Whether numbers count columns, from 0 or from 1."""
    if len(values) < 2 or values[0] not in (0.0, 1.0):
        return False
    return all(later - earlier == 1.0 for earlier, later in pairwise(values))


def _check_shape(file: CsvLines, named: int) -> None:
    """Refuse lines that are no rows, rows of another number of fields,
    and a last row that was cut off.
    """
    counts = np.array([len(file.fields(row)) for row in file.rows])
    if named:
        usual = named
        source = "the header"
    else:
        [(usual, _)] = Counter(counts.tolist()).most_common(1)
        source = "most lines"
    wrong = np.flatnonzero(counts != usual)
    for row in wrong.tolist():
        _require_row(file, row)
    last = len(file.rows) - 1
    if wrong.size and (wrong[0] != last or counts[last] > usual or last == 0):
        first = int(wrong[0])
        raise TableUnfit(
            file.row_place(first),
            found=counted(int(counts[first]), "column"),
            expected=f"{usual}, as in {source}",
            remedy="check the delimiter in the import description, and the export",
        )
    first_end = file.fields(file.rows[0])[-1]
    last_end = file.fields(file.rows[last])[-1]
    lacks_last_field = first_end and not last_end
    if lacks_last_field:
        _require_row(file, last)
    if wrong.size or lacks_last_field:
        excerpt = file.rows[last][-EXCERPT_CHARACTERS:]
        keep = _keep_to(file, last)
        fields = counted(int(counts[last]), "field")
        raise TableUnfit(
            file.row_place(last),
            found=f"a last line {excerpt!r} of {fields}",
            expected=f"{usual} complete fields",
            remedy="the file ends early; export or copy it again, or leave that line out by "
            f"{keep}",
        )


def _require_row(file: CsvLines, row: int) -> None:
    """Refuse a line without any number, or with a word where rows begin with a number:
    an empty one, a comment, a remark of the program that wrote it.
    """
    text = file.rows[row]
    numbers = (file.to_number(field) for field in file.fields(text))
    has_number = any(map(math.isfinite, numbers))
    is_row = has_number and not begins_with_word(file, row)
    is_comment = text.lstrip().startswith(COMMENT_SIGNS)
    has_letters = any(character.isalpha() for character in text)
    # A last line of one torn field may be the begin of a number.
    is_torn = row == len(file.rows) - 1 and not has_letters
    if (is_row and not is_comment) or is_torn:
        return
    raise no_row(file, row)


def begins_with_word(file: CsvLines, row: int) -> bool:
    """Whether a line begins with a word where the first row begins with a number:
    `Samples,1000` of the program that wrote the file.
    """
    first, *_ = file.fields(file.rows[row])
    usual, *_ = file.fields(file.rows[0])
    if not math.isfinite(file.to_number(usual)) or first.lower() in MISSING:
        return False
    has_letters = any(character.isalpha() for character in first)
    return has_letters and not math.isfinite(file.to_number(first))


def no_row(file: CsvLines, row: int) -> TableUnfit:
    """Make the error for a line among the rows that is none."""
    text = file.rows[row]
    sign = _first_sign(text)
    found = f"{text[:EXCERPT_CHARACTERS]!r}, a line that is no row of numbers"
    leave_out = ""
    if sign:
        leave_out = f", or write `comment: {sign!r}` under `table` of the import description"
    else:
        found = f"an empty line, {found}"
    parts = _keep_to(file, row) if row else "`keep`"
    return TableUnfit(
        file.row_place(row),
        found=found,
        expected="rows of numbers alone, after the header",
        remedy=f"if no sample is missing there, delete the line{leave_out}; if it parts two "
        f"recordings, import what is before it by {parts}, and what is after it by `from_row`",
    )


def _first_sign(text: str) -> str:
    """Return the sign of a comment that a line begins with, else its first characters."""
    word, *_ = text.split() or [""]
    for sign in COMMENT_SIGNS:
        if word.startswith(sign):
            return sign
    return word[:4]


def _keep_to(file: CsvLines, row: int) -> str:
    """Return the setting that keeps the rows before one."""
    return f"`keep: {{to_row: {file.first_row + row}}}`"


def _check_last_number(file: CsvLines) -> None:
    """Refuse a last number that may lack digits:
    one with fewer decimals than all others, or one that jumps.
    """
    ends = [file.fields(row)[-1] for row in file.rows]
    values = np.array([file.to_number(end) for end in ends])
    decimals = [len(end.partition(file.layout.decimal)[2]) for end in ends]
    steps = np.abs(np.diff(values))
    if not np.isfinite(values[:-1]).all():
        return
    jumps = len(steps) > 1 and steps[-1] > LARGEST_JUMP * steps[:-1].max()
    lacks_decimals = decimals[-1] < min(decimals[:-1])
    if lacks_decimals or jumps or not math.isfinite(values[-1]):
        last = len(file.rows) - 1
        keep = _keep_to(file, last)
        raise TableUnfit(
            file.row_place(last),
            found=f"a last number {ends[-1]!r} without an end of line, after {ends[-2]!r}",
            expected="a number with all its digits",
            remedy="the file ends early: export or copy it again, or leave that line out by "
            f"{keep}",
        )
