"""CSV files of other controllers, fast when they are well, and precise about line and column when they are not."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.configuration.importing import Columns, Table
from daq.errors import TableColumns, TableEmpty, TableMissing, TableNotNumeric, TableTruncated

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TableFile:
    """One file as lines.

    Attributes:
        path: of the file.
        table: its layout.
        names: from its header; () where it has none.
        rows: its lines of numbers.
        first_line: line number of the first of them, from 1.
    """

    path: Path
    table: Table
    names: tuple[str, ...]
    rows: tuple[str, ...]
    first_line: int

    def fields(self, row: str) -> list[str]:
        """The fields of a line, quotes and white space removed."""
        parts = row.split() if self.table.delimiter == " " else row.split(self.table.delimiter)
        return [part.strip().strip('"').strip() for part in parts]


def read_table(path: Path, table: Table) -> TableFile:
    """Read a file as lines, all of the same number of fields.

    Raises:
        TableMissing: there is no such file, or it cannot be read.
        TableEmpty: no line of numbers.
        TableTruncated: the last line is shorter than the others, or has no end.
        TableColumns: another line is shorter or longer than the others.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise TableMissing(
            str(path),
            found=(error.strerror or type(error).__name__).lower(),
            expected="a CSV file",
            remedy="check --data and the file name in the import description",
        ) from error
    except UnicodeDecodeError as error:
        raise TableNotNumeric(
            str(path), found=f"byte {error.start} is no UTF-8", expected="text", remedy="is this a CSV file?"
        ) from error
    lines = text.splitlines()
    if len(lines) > 1 and not text.endswith(("\n", "\r")):
        # The last number may lack digits, and nobody would see it.
        raise TableTruncated(
            f"{path}:{len(lines)}",
            found=f"a last line {lines[-1][-40:]!r} without an end of line",
            expected="an end of line, as after all others",
            remedy="the file ends early: export or copy it again; if the exporter never writes the last one, add it",
        )
    while lines and not lines[-1].strip():
        lines.pop()
    start = table.skip_rows + (1 if table.header else 0)
    rows = tuple(lines[start:])
    if not rows:
        raise TableEmpty(
            str(path),
            found=f"{len(lines)} lines, of which {min(start, len(lines))} before the numbers",
            expected="a line of numbers for each sample",
            remedy="was the export interrupted?",
        )
    bare = TableFile(path, table, (), rows, start + 1)
    names = tuple(bare.fields(lines[table.skip_rows])) if table.header else ()
    _check_shape(bare, len(names))
    return TableFile(path, table, names, rows, start + 1)


def columns(file: TableFile, wanted: Columns) -> FloatArray:
    """Some columns as numbers, shape (k, len(wanted.columns)).

    Raises:
        TableColumns: a column is not in the file.
        TableNotNumeric: a field is not a finite number.
    """
    indices = [_index(file, column) for column in wanted.columns]
    table = file.table
    rows = [row.replace(",", ".") for row in file.rows] if table.decimal == "," else file.rows
    try:
        values = np.loadtxt(
            rows,
            delimiter=None if table.delimiter == " " else table.delimiter,
            usecols=indices,
            ndmin=2,
            comments=None,
            quotechar='"',
        )
    except ValueError as error:
        raise _not_numeric(file, indices) from error
    if not np.isfinite(values).all():
        raise _not_numeric(file, indices)
    return np.asarray(values, dtype=np.float64)


def _check_shape(file: TableFile, named: int) -> None:
    counts = np.array([len(file.fields(row)) for row in file.rows])
    usual = named or Counter(counts.tolist()).most_common(1)[0][0]
    wrong = np.flatnonzero(counts != usual)
    last = len(file.rows) - 1
    if wrong.size and (wrong[0] != last or counts[last] > usual or last == 0):
        first = int(wrong[0])
        raise TableColumns(
            f"{file.path}:{file.first_line + first}",
            found=f"{counts[first]} columns",
            expected=f"{usual}, as in {'the header' if named else 'most lines'}",
            remedy="check the delimiter in the import description, and the export",
        )
    if wrong.size or not file.fields(file.rows[last])[-1]:
        raise TableTruncated(
            f"{file.path}:{file.first_line + last}",
            found=f"a last line {file.rows[last][-40:]!r} of {counts[last]} fields",
            expected=f"{usual} complete fields",
            remedy="the file ends early; export or copy it again",
        )


def _index(file: TableFile, column: str | int) -> int:
    width = len(file.fields(file.rows[0]))
    if isinstance(column, int):
        if column <= width:
            return column - 1
        raise TableColumns(
            str(file.path), found=f"{width} columns", expected=f"a column {column}", remedy="columns count from 1"
        )
    if file.names.count(column) == 1:
        return file.names.index(column)
    raise TableColumns(
        str(file.path),
        found=f"columns {', '.join(file.names)}",
        expected=f"one column {column!r}",
        remedy="correct `columns` in the import description",
    )


def _not_numeric(file: TableFile, indices: list[int]) -> TableNotNumeric:
    """The error for the first field that is no finite number."""
    for number, row in enumerate(file.rows):
        fields = file.fields(row)
        for index in indices:
            text = fields[index].replace(",", ".") if file.table.decimal == "," else fields[index]
            if not _finite(text):
                label = file.names[index] if file.names else str(index + 1)
                return TableNotNumeric(
                    f"{file.path}:{file.first_line + number}, column {label}",
                    found=repr(fields[index]),
                    expected="a finite number",
                    remedy="samples are never invented: cut the recording there, or export it again",
                )
    return TableNotNumeric(
        str(file.path), found="fields that are no numbers", expected="numbers", remedy="check the decimal sign"
    )


def _finite(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
