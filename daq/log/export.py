"""Export a log as a table for other programs:
one row for each SYNC, with SI and raw columns, in bounded memory.
"""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from enum import Enum
from importlib.util import find_spec
from itertools import chain, pairwise
from math import inf, isnan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import Cell, CellAxis
from daq.errors import ConfigurationMissing, OutputFailed
from daq.files import require_new
from daq.log.conversion import answers, moves, readings_by_axis, scaling, unwrapped
from daq.log.message import RawArray
from daq.log.motion import judge_log
from daq.log.reader import LogReader, SampleBlock
from drivers.messages import CellEvent, Quantity, SlowReading
from ident.arrays import FloatArray, IntArray

Columns = dict[str, NDArray[Any]]  #: Columns of equal length by name, in order
Write = Callable[[Columns], None]


class TableFormat(Enum):
    """Format of the table."""

    CSV = "csv"
    PARQUET = "parquet"


@dataclass(frozen=True, slots=True)
class Exported:
    """Result of an export."""

    columns: tuple[str, ...]  #: names of the columns
    rows: int  #: number of rows
    partial: bool  #: the log was never finished
    #: whether the recorder marked the run valid, and its cycles and time steps are even
    valid: bool
    reason: str  #: why not


def export_log(log: Path, out: Path, kind: TableFormat) -> Exported:
    """Write all samples of a log to a table; the file appears when it is whole.

    Args:
        log: log to read.
        out: file to write; must not exist.
        kind: format of the file.

    Raises:
        UsageError: a file, folder or link of that name exists.
        OutputFailed: the file system refuses.
        ConfigurationMissing: the package for the format is missing; the message names the extra to
            install.
        LogUnreadable: the log is damaged or contradicts itself; nothing is written.
    """
    require_new_table(out, kind)
    # The first pass finds all damage and all moves; the second writes, a block at a time.
    reader, cell, verdict = judge_log(log)
    events = tuple(reader.events)
    readings = tuple(reader.readings)
    blocks = tables(LogReader(log), cell, events, readings)
    names, rows = write_table(out, kind, blocks)
    return Exported(names, rows, reader.partial, *verdict)


def require_new_table(out: Path, kind: TableFormat) -> None:
    """Refuse, before any work is done, a table that cannot be written.

    Raises:
        UsageError: a file, folder or link of that name exists.
        ConfigurationMissing: the package for the format is missing; the message names the extra to
            install.
    """
    needs_pyarrow = kind is TableFormat.PARQUET
    if needs_pyarrow and find_spec("pyarrow") is None:
        raise ConfigurationMissing(
            "Parquet",
            found="no package pyarrow",
            expected="that of the optional extra `parquet`",
            remedy="pip install 'drivegain[parquet]', or export --csv",
        )
    require_new(out, "choose another --out, or move it away")


def write_table(
    out: Path, kind: TableFormat, blocks: Iterable[Columns]
) -> tuple[tuple[str, ...], int]:
    """Write a table block by block; the file appears when it is whole.

    Args:
        out: file to write; must not exist (`require_new_table`).
        kind: format of the file.
        blocks: with the same columns each.

    Returns:
        names of the columns, and the number of rows.

    Raises:
        OutputFailed: the file system refuses.
    """
    names: tuple[str, ...] = ()
    rows = 0
    unfinished = out.with_name(out.name + ".part")
    try:
        with ExitStack() as stack:
            # The rest of an earlier export, or a link that would be followed: the writers make a
            # new file ("x").
            unfinished.unlink(missing_ok=True)
            stack.callback(unfinished.unlink, missing_ok=True)
            with _WRITERS[kind](unfinished) as write:
                for columns in blocks:
                    names = tuple(columns)
                    rows += len(next(iter(columns.values())))
                    write(columns)
            with unfinished.open("rb") as stream:
                os.fsync(stream.fileno())
            unfinished.replace(out)
    except OSError as error:
        raise OutputFailed.of(out, error) from error
    return names, rows


def tables(
    reader: LogReader,
    cell: Cell,
    events: tuple[CellEvent, ...],
    readings: tuple[SlowReading, ...] = (),
) -> Iterator[Columns]:
    """Convert the samples to columns, a block at a time.

    Args:
        reader: reader of the log, not yet iterated over.
        cell: cell of the log.
        events: events of the whole log, for the numbers of the moves.
        readings: torques and temperatures of the whole log; each is in the row of the last SYNC
            before it.

    Raises:
        LogUnreadable: the log is damaged, or cell and log do not belong together.
    """
    last: tuple[RawArray, IntArray] | None = None
    first_ns = 0
    end_ns = -inf
    names = column_names(cell)
    by_quantity = {quantity: readings_by_axis(readings, quantity) for quantity in Quantity}
    slow = {}
    for axis, name in enumerate(names):
        for quantity, by_axis in by_quantity.items():
            if axis in by_axis:
                column = f"{name}.{_SLOW_COLUMNS[quantity]}"
                slow[column] = by_axis[axis]
    for block, following in pairwise(chain(reader, (None,))):
        assert block is not None  # None follows the last one
        begin_ns = end_ns
        if following is None:
            end_ns = inf
        else:
            end_ns = int(following.time_ns[0])
        readback = reader.head.readback
        scale = scaling(cell, readback)
        is_counter = [axis.position_rad_per_count is None for axis in readback.axes]
        if last is None:
            first_ns = int(block.time_ns[0])
        counted = unwrapped(block.position_counts, last)
        last = block.position_counts[-1], counted[-1]
        counts = np.where(is_counter, counted, block.position_counts)
        joints = scale.joint_position(counts)
        columns = _columns(
            cell,
            block,
            counts,
            joints,
            scale.current_per_unit,
            moves(events, block.time_ns),
            first_ns,
        )
        for name, (reading_ns, values) in slow.items():
            columns[name] = _in_rows(block.time_ns, reading_ns, values, begin_ns, end_ns)
        yield columns


def _columns(
    cell: Cell,
    block: SampleBlock,
    counts: IntArray,
    joints: FloatArray,
    per_unit: FloatArray,
    move: IntArray | None,
    first_ns: int,
) -> Columns:
    if move is None:
        move = np.full(len(block.cycle), -1, dtype=np.int64)
    columns: Columns = {
        "cycle": block.cycle,
        "time_ns": block.time_ns,
        "time_s": (block.time_ns - first_ns) * 1e-9,
        "move": move,
    }
    answered = answers(block.missing, len(cell.axes)).astype(np.uint8)
    names = column_names(cell)
    for index, axis in enumerate(cell.axes):
        name = names[index]
        current_raw = block.current_raw[:, index]
        columns[f"{name}.position_{axis.unit.si_name}"] = joints[:, index]
        columns[f"{name}.current_{current_unit(axis)}"] = current_raw * per_unit[index]
        columns[f"{name}.motor_counts"] = counts[:, index]
        columns[f"{name}.current_raw"] = current_raw
        columns[f"{name}.statusword"] = block.statusword[:, index]
        columns[f"{name}.answered"] = answered[:, index]
    return columns


def current_unit(axis: CellAxis) -> str:
    """Unit of an axis' current reference, as the name of a column has it."""
    _, _, denominator = axis.gain_unit.partition("/")
    unit = denominator.strip() or "A"
    return re.sub(r"[^0-9A-Za-z%]+", "_", unit)


def column_names(cell: Cell) -> list[str]:
    """Name of each axis in the columns; names that become equal get the axis's number:
    `A+` and `A-` are `A_1`, `A_2`.

    Where that is an axis of the cell too, all names begin with their number.
    """
    plain = [re.sub(r"\W+", "_", name) for name in cell.axis_names]
    names = []
    for number, name in enumerate(plain, start=1):
        is_unique = plain.count(name) == 1
        names.append(name if is_unique else f"{name}{number}")
    if len(set(names)) == len(names):
        return names
    return [f"{number}_{name}" for number, name in enumerate(plain, start=1)]


_SLOW_COLUMNS = {Quantity.TORQUE: "motor_torque_Nm", Quantity.TEMPERATURE: "temperature_degC"}


def _in_rows(
    time_ns: IntArray, reading_ns: IntArray, readings: FloatArray, begin_ns: float, end_ns: float
) -> FloatArray:
    """Put the readings from one time to another into the rows of a block, shape (k,);
    rows without one are NaN.

    Args:
        time_ns: of the rows, shape (k,).
        reading_ns: increasing times of all readings of the log, shape (r,).
        readings: their values, shape (r,).
        begin_ns: time of the first row; before all readings if it is the first of the log.
        end_ns: time of the row after the last; infinite after the last of the log.
    """
    values = np.full(len(time_ns), np.nan)
    inside = (reading_ns >= begin_ns) & (reading_ns < end_ns)
    following = np.searchsorted(time_ns, reading_ns[inside], side="right")
    row = np.maximum(following - 1, 0)
    values[row] = readings[inside]
    return values


@contextmanager
def _csv(path: Path) -> Iterator[Write]:
    """Write a CSV file with decimal points (RFC 4180, but lines end with LF)."""
    with path.open("x", encoding="utf-8", newline="\n") as stream:
        begun = False

        def write(columns: Columns) -> None:
            nonlocal begun
            if not begun:
                stream.write(",".join(columns) + "\n")
                begun = True
            texts = [_csv_fields(column) for column in columns.values()]
            rows = zip(*texts, strict=True)
            stream.writelines(",".join(row) + "\n" for row in rows)

        yield write


def _csv_fields(column: NDArray[Any]) -> list[str]:
    """Return the numbers of a column as texts, empty for NaN.

    repr of a float is the shortest text that reads back as the same number.
    """
    return ["" if isnan(value) else repr(value) for value in column.tolist()]


@contextmanager
def _parquet(path: Path) -> Iterator[Write]:
    """Write a row group for each block, compressed by zstandard."""
    arrow: Any = importlib.import_module("pyarrow")
    parquet: Any = importlib.import_module("pyarrow.parquet")
    with ExitStack() as stack:
        stream = stack.enter_context(path.open("xb"))
        writer: Any = None

        def write(columns: Columns) -> None:
            nonlocal writer
            contiguous = {name: np.ascontiguousarray(column) for name, column in columns.items()}
            table = arrow.table(contiguous)
            if writer is None:
                writer = stack.enter_context(
                    parquet.ParquetWriter(stream, table.schema, compression="zstd")
                )
            writer.write_table(table)

        yield write


_WRITERS: dict[TableFormat, Callable[[Path], AbstractContextManager[Write]]] = {
    TableFormat.CSV: _csv,
    TableFormat.PARQUET: _parquet,
}
