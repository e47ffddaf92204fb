"""A table of samples as numbers: what every reader of a foreign file hands to the import.

A reader is a function of the file, the import description, and the columns and the time column that the description
names in that file. It returns a `Table`, or raises `TableUnfit`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from daq.config.import_description import Column, ImportDescription, TimeColumn, TimeUnit
from daq.errors import TableUnfit, reason_of
from ident.arrays import FloatArray

LATEST_NS = 9 * 10**18  #: The latest stamp that a log holds, roughly


@dataclass(frozen=True, slots=True, eq=False)
class Stamps:
    """Time stamps of k rows."""

    time_s: FloatArray  #: since the first stamp [s], shape (k,)
    first_ns: int  #: the first stamp by its own clock [ns]; the Unix time where that is the clock


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns of one file, with what a message about them needs."""

    path: Path  #: the file
    columns: tuple[Column, ...]  #: names or numbers of the columns, as the description has them
    values: FloatArray  #: finite numbers, shape (k, len(columns))
    digest: str  #: of the rows (sha256, hex)
    stamps: Stamps | None = None  #: of the time column; None if it is not in this file
    first_line: int | None = None  #: line of the first row, from 1; None where rows have no lines
    remarks: tuple[str, ...] = ()  #: oddities of the file that were mended, for the person who imports it

    def take(self, columns: Sequence[Column]) -> FloatArray:
        """Return some of the columns, shape (k, len(columns))."""
        return self.values[:, [self.columns.index(column) for column in columns]]

    def place(self, row: int, column: Column) -> str:
        """Name a number in a message: `run.csv:42, column i3`."""
        at = f", row {row + 1}" if self.first_line is None else f":{self.first_line + row}"
        return f"{self.path}{at}, column {column}"


Reader = Callable[[Path, ImportDescription, tuple[Column, ...], TimeColumn | None], Table]


def check_reach(time_s: FloatArray, place: Callable[[int], str]) -> None:
    """Refuse stamps that no log can hold, before they are converted.

    Args:
        time_s: finite stamps as the file has them [s], shape (k,).
        place: name of a row's stamp in a message.

    Raises:
        TableUnfit: a stamp is beyond ±LATEST_NS.
    """
    wrong = np.flatnonzero(~(np.abs(time_s) < LATEST_NS * 1e-9))
    if wrong.size:
        row = int(wrong[0])
        raise TableUnfit(
            place(row),
            found=f"a stamp of {time_s[row]:.4g} s",
            expected="seconds since 1970, or since some start",
            remedy="correct `unit` of `time` in the import description: is it ms, us or ns?",
        )


def stamps_of_numbers(values: FloatArray, unit: TimeUnit) -> Stamps:
    """Make stamps of numbers, as exact as floats are: 0.2 µs for seconds since 1970."""
    time_s = values * unit.seconds
    return Stamps(time_s - time_s[0], round(float(time_s[0]) * 1e9))


def stamps_of_ns(stamp_ns: Sequence[int]) -> Stamps:
    """Make stamps of whole nanoseconds, exactly."""
    first = stamp_ns[0]
    return Stamps(np.array([stamp - first for stamp in stamp_ns], dtype=np.float64) * 1e-9, first)


def unreadable(path: Path, error: OSError, expected: str) -> TableUnfit:
    """Make the error for a file that the file system refuses."""
    return TableUnfit(
        str(path),
        found=reason_of(error),
        expected=expected,
        remedy="check --data and the file name in the import description",
    )


def repeated(path: Path, column: Column, names: str) -> TableUnfit:
    """Make the error for a column that is named twice."""
    return TableUnfit(
        str(path),
        found=f"column {column} a second time, {names}",
        expected="a column of its own for each quantity of each axis",
        remedy="correct `columns` in the import description",
    )


def require_finite(table: Table) -> Table:
    """Return the table.

    Raises:
        TableUnfit: a number is not finite.
    """
    wrong = np.argwhere(~np.isfinite(table.values))
    if wrong.size:
        row, column = wrong[0].tolist()
        raise TableUnfit(
            table.place(row, table.columns[column]),
            found=str(table.values[row, column]),
            expected="a finite number",
            remedy="samples are never invented: cut the recording there, or export it again",
        )
    return table


def digest_of(values: FloatArray, stamps: Stamps | None) -> str:
    """Return the sha256 of rows that are no text, hex."""
    rows = hashlib.sha256(values.tobytes())
    if stamps is not None:
        rows.update(f"{stamps.first_ns}".encode() + stamps.time_s.tobytes())
    return rows.hexdigest()
