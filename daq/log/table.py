"""A table of samples as numbers: what every reader of a foreign file hands to the import.

A reader is a function of the file, the import description, and the columns and the time column that
the description names in that file. It returns a `Table`, or raises `TableUnfit`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, floor, inf
from pathlib import Path

import numpy as np

from daq.config.foreign_files import foreign_kind
from daq.config.import_description import (
    Column,
    ImportDescription,
    KeptPart,
    Section,
    TimeColumn,
    TimeUnit,
)
from daq.errors import TableUnfit, counted, reason_of
from ident.arrays import FloatArray

ABSOLUTE_S = 1e8  #: Stamps above this are since 1970, and floats are too coarse for them: 0.2 µs
TIME_MARGIN_S = 1e-9  #: Stamps so near to an end of the part that is kept are in it
ROW_MARGIN = 1e-6  #: Likewise, in rows
COUNTER_BITS = (16, 32)  #: Of counters of time
LONGEST_WRAP_STEP = 3.0  #: Longest step over the end of a counter, in usual steps
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
    #: line of each row, from 1; None where rows have no lines
    line_numbers: Sequence[int] | None = None
    first_row: int = 0  #: rows of the file that were cut off before the first one
    #: oddities of the file that were mended, for the person who imports it
    remarks: tuple[str, ...] = ()
    #: Of a column that is called as the time column of another file; None without one.
    stamps_beside: Stamps | None = None

    def take(self, columns: Sequence[Column]) -> FloatArray:
        """Return some of the columns, shape (k, len(columns))."""
        indices = [self.columns.index(column) for column in columns]
        return self.values[:, indices]

    def place(self, row: int, column: Column) -> str:
        """Name a number in a message: `run.csv:42, column i3`."""
        if self.line_numbers is None:
            row_of_file = self.first_row + row + 1
            return f"{self.path}, row {row_of_file}, column {column}"
        return f"{self.path}:{self.line_numbers[row]}, column {column}"


def compare_stamps(timed: Table, other: Table) -> tuple[str, ...]:
    """Compare the rows of two files that both have stamps:
    a row of one belongs to the same row of the other.

    Args:
        timed: with the stamps that are used.
        other: with `stamps_beside`, or without.

    Returns:
        a remark where one of them begins later, by a clock of its own.

    Raises:
        TableUnfit: the steps differ, so that a row is missing in one of them, or dates say that
            they are of other times.
    """
    mine = timed.stamps
    others = other.stamps_beside
    if mine is None or others is None:
        return ()
    count = len(mine.time_s)
    if count != len(others.time_s) or count < 2:
        return ()
    usual_step_s = float(np.median(np.diff(mine.time_s)))
    half_step_s = 0.5 * usual_step_s
    distance_s = np.abs(mine.time_s - others.time_s)
    apart = np.flatnonzero(distance_s > half_step_s)
    if apart.size:
        row = int(apart[0])
        other_s = others.time_s[row]
        timed_s = mine.time_s[row]
        raise TableUnfit(
            other.place(row, "time"),
            found=f"{other_s:.6g} s since its first row, and {timed_s:.6g} s in {timed.path.name}",
            expected="rows of the same instants in both files",
            remedy="a row is missing in one of them, or they are of different runs; export "
            "them again",
        )
    later_s = 1e-9 * (others.first_ns - mine.first_ns)
    if abs(later_s) <= half_step_s:
        return ()
    name = other.path.name
    if 1e-9 * min(mine.first_ns, others.first_ns) > ABSOLUTE_S:
        raise TableUnfit(
            str(other.path),
            found=f"stamps that begin {later_s:.6g} s after those of {timed.path.name}, by the "
            "same clock",
            expected="rows of the same instants in both files",
            remedy="the files are of different times: export the same part of each, or keep it "
            "by `keep`",
        )
    return (
        f"{name}: its stamps begin {later_s:.6g} s after those of {timed.path.name}: rows "
        "count as simultaneous",
    )


def section_values(section: Section, files: Mapping[str, Table]) -> FloatArray:
    """Return the columns of a section, shape (k, number of axes)."""
    columns = [files[file].take((column,)) for file, column in section.places]
    return np.hstack(columns)


def section_place(section: Section, files: Mapping[str, Table], row: int, axis: int) -> str:
    """Name a number of a section in a message."""
    file, column = section.places[axis]
    return files[file].place(row, column)


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


def kind_of_content(head: bytes) -> tuple[str, str]:
    """Return the kind of a file that is not the expected one, and what to do, in words.

    Args:
        head: its first bytes, at least HEAD_BYTES of `foreign_files` where it has as many.
    """
    foreign = foreign_kind(head)
    if foreign is not None:
        return foreign.value, foreign.remedy
    if not head:
        return "an empty file", "export or copy it again"
    wrong_file = "correct `file` in the import description, or export the file again"
    is_text = all(byte in b"\t\n\r" or byte >= 0x20 for byte in head)
    if is_text:
        first_line = head.decode("utf-8", errors="replace").splitlines()[0]
        return (
            f"a text file that begins with {first_line!r}",
            f"if it is a CSV file, give it a name that ends in .csv; else {wrong_file}",
        )
    return "a file of an unknown kind", wrong_file


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
            remedy=cut_advice(table.values, table.first_row),
        )
    return table


def cut_advice(values: FloatArray, first_row: int) -> str:
    """Say which rows to keep of a table in which numbers are not finite.

    Args:
        values: shape (k, n).
        first_row: rows of the file that were cut off before the first one.
    """
    sound = np.asarray(np.isfinite(values).all(axis=1))
    first = int(np.argmax(sound)) if sound.any() else 0
    unsound_at_end = int(np.argmax(sound[::-1]))
    last = len(sound) - unsound_at_end
    if not sound[first:last].all():
        last = first + int(np.argmin(sound[first:last]))
    ends = []
    if first > 0:
        from_row = first_row + first + 1
        ends.append(f"from_row: {from_row}")
    if last < len(sound):
        ends.append(f"to_row: {first_row + last}")
    setting = "`keep`"
    if ends and sound.any():
        both = ", ".join(ends)
        setting = f"`keep: {{{both}}}`"
    cut = f"cut the recording there, by {setting} of the import description"
    return f"samples are never invented: {cut}, or export it again"


def rows_in_time(stamps: Stamps, part: KeptPart) -> slice:
    """Return the rows of the times that are kept."""
    from_s = part.from_s or 0.0
    to_s = inf if part.to_s is None else part.to_s
    is_begun = stamps.time_s >= from_s - TIME_MARGIN_S
    is_before_end = stamps.time_s <= to_s + TIME_MARGIN_S
    inside = np.flatnonzero(is_begun & is_before_end)
    if not inside.size:
        return slice(0, 0)
    return slice(int(inside[0]), int(inside[-1]) + 1)


def require_kept(path: Path, count: int, rows: slice) -> None:
    """Refuse a part of a recording in which there is nothing.

    Args:
        path: of the file.
        count: rows that it has.
        rows: that are kept.

    Raises:
        TableUnfit: there are none of them.
    """
    if not range(count)[rows]:
        raise TableUnfit(
            str(path),
            found=f"{counted(count, 'row')}, none of them in `keep`",
            expected="a row for each sample of a motion",
            remedy="correct `keep` in the import description",
        )


def rows_at_rate(rate_hz: float, part: KeptPart) -> slice:
    """Return the rows of the times that are kept, where a rate is stated in the place of stamps."""
    from_s = part.from_s or 0.0
    first = ceil(from_s * rate_hz - ROW_MARGIN)
    if part.to_s is None:
        return slice(first, None)
    last = floor(part.to_s * rate_hz + ROW_MARGIN)
    return slice(first, last + 1)


def cut_stamps(stamps: Stamps, rows: slice) -> Stamps:
    """Return the stamps of some rows."""
    time_s = stamps.time_s[rows]
    if not time_s.size:
        return Stamps(time_s, stamps.first_ns)
    later_ns = round(float(time_s[0]) * 1e9)
    return Stamps(time_s - time_s[0], stamps.first_ns + later_ns)


@dataclass(frozen=True, slots=True)
class Wrap:
    """A way in which stamps begin anew."""

    period_s: float
    name: str  #: for a remark


def counter_wraps() -> tuple[Wrap, ...]:
    """Return how counters of 16 and 32 bits wrap, of any unit of time."""
    found: list[Wrap] = []
    for unit in (TimeUnit.SECOND, TimeUnit.MILLISECOND, TimeUnit.MICROSECOND, TimeUnit.NANOSECOND):
        for bits in COUNTER_BITS:
            name = f"a counter of {bits} bits in {unit.value} that wraps"
            found.append(Wrap(2.0**bits * unit.seconds, name))
    return tuple(found)


#: A time of day of a controller (IEC 61131-3: ms since midnight) is a number that does so too
MIDNIGHT = Wrap(86400.0, "times of day that pass midnight")


def without_wraps(time_s: FloatArray, wraps: Sequence[Wrap]) -> tuple[FloatArray, tuple[str, ...]]:
    """Make stamps continuous that begin anew, as a counter of 32 bits does;
    others stay as they are.

    Each step back must be nearly a whole period: with it, the step is as long as the others.

    Args:
        time_s: stamps [s], shape (k,).
        wraps: what may have happened; the first one that explains every step back is taken.

    Returns:
        stamps, shape (k,), and a remark if they were changed.
    """
    step_s = np.diff(time_s)
    is_back = step_s < 0.0
    forward_s = step_s[step_s > 0.0]
    if not is_back.any() or not forward_s.size:
        return time_s, ()
    longest_s = LONGEST_WRAP_STEP * float(np.median(forward_s))
    for wrap in wraps:
        mended_s = step_s[is_back] + wrap.period_s
        is_explained = np.all((mended_s > 0.0) & (mended_s <= longest_s))
        if is_explained and np.ptp(time_s) <= wrap.period_s:
            whole_s = np.where(is_back, step_s + wrap.period_s, step_s)
            times = counted(int(np.count_nonzero(is_back)), "time")
            remark = f"stamps begin anew {times}: taken as {wrap.name}, and made continuous"
            later_s = time_s[0] + np.cumsum(whole_s)
            return np.concatenate((time_s[:1], later_s)), (remark,)
    return time_s, ()


def digest_of(values: FloatArray, stamps: Stamps | None) -> str:
    """Return the sha256 of rows that are no text, hex."""
    rows = hashlib.sha256(values.tobytes())
    if stamps is not None:
        rows.update(f"{stamps.first_ns}".encode())
        rows.update(stamps.time_s.tobytes())
    return rows.hexdigest()
