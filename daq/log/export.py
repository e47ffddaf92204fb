"""A log as a table for other programs: a row a SYNC, columns in SI beside the raw numbers; in bounded memory."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import Cell
from daq.config.cell_file import cell_from_bundle
from daq.errors import ConfigurationMissing, OutputFailed, UsageError
from daq.log.conversion import moves, scaling
from daq.log.reader import LogReader, SampleBlock
from drivers.stream.sample import CellEvent

Columns = dict[str, NDArray[Any]]
"""Columns of the same length by name, in their order."""
Write = Callable[[Columns], None]


class TableFormat(Enum):
    """Kind of file; the value is what people call it."""

    CSV = "csv"
    PARQUET = "parquet"


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written.

    Attributes:
        columns: their names.
        rows: how many.
        partial: the log was never finished.
        valid: its recorder found no loss; what it found else is in `reason`.
        reason: why not.
    """

    columns: tuple[str, ...]
    rows: int
    partial: bool
    valid: bool
    reason: str


def require_format(kind: TableFormat) -> None:
    """Say at once that the package for a format is missing.

    Raises:
        ConfigurationMissing: with the extra to install.
    """
    if kind is TableFormat.PARQUET and find_spec("pyarrow") is None:
        raise ConfigurationMissing(
            "Parquet",
            found="no package pyarrow",
            expected="that of the optional extra `parquet`",
            remedy="pip install 'drivegain[parquet]', or export --csv",
        )


def export_log(log: Path, out: Path, kind: TableFormat) -> Exported:
    """Write all samples of a log into a table; the file appears when it is whole.

    Args:
        log: to read.
        out: to write; must not exist.
        kind: of file.

    Raises:
        UsageError: there is a file of that name.
        OutputFailed: the file system refuses.
        ConfigurationMissing: the package for the format is missing.
        LogUnreadable: the log is damaged or lacks what makes it one; nothing is written then.
    """
    require_format(kind)
    if out.exists():
        raise UsageError(
            str(out), found="a file of that name", expected="none", remedy="choose another --out, or move it away"
        )
    reader = LogReader(log)
    # The first pass finds all damage and all moves; the second writes, a block at a time.
    for _ in reader:
        pass
    cell = cell_from_bundle(reader.head.files, names={"cell.yaml": f"{log}, cell.yaml"})
    names: tuple[str, ...] = ()
    rows = 0
    unfinished = out.with_name(out.name + ".part")
    try:
        with ExitStack() as stack:
            stack.callback(unfinished.unlink, missing_ok=True)
            with _WRITERS[kind](unfinished) as write:
                for columns in tables(LogReader(log), cell, tuple(reader.events)):
                    names = tuple(columns)
                    rows += len(next(iter(columns.values())))
                    write(columns)
            with unfinished.open("rb") as stream:
                os.fsync(stream.fileno())
            unfinished.replace(out)
    except OSError as error:
        raise OutputFailed.of(out, error) from error
    said = reader.statistics
    partial = said.partial or log.name.endswith(".part")
    return Exported(names, rows, partial, said.valid, said.reason)


def tables(reader: LogReader, cell: Cell, events: tuple[CellEvent, ...]) -> Iterator[Columns]:
    """The samples as columns, a block at a time.

    Args:
        reader: of the log, not yet iterated over.
        cell: of the log.
        events: of the whole log, for the numbers of the moves.

    Raises:
        LogUnreadable: the log is damaged, or cell and log do not belong together.
    """
    last: tuple[NDArray[np.int32], NDArray[np.int64]] | None = None
    first_ns = 0
    for block in reader:
        scale = scaling(cell, reader.head.readback)
        counter = np.array([axis.position_rad_per_count is None for axis in reader.head.readback.axes])
        if last is None:
            first_ns = int(block.time_ns[0])
            last = block.position_counts[0], block.position_counts[0].astype(np.int64)
        unwrapped = _continued(last, block.position_counts)
        last = block.position_counts[-1], unwrapped[-1]
        counts = np.where(counter, unwrapped, block.position_counts)
        joints = scale.joint_position(counts)
        yield _columns(cell, block, counts, joints, scale.current_per_unit, moves(events, block.time_ns), first_ns)


def _continued(last: tuple[NDArray[np.int32], NDArray[np.int64]], counts: NDArray[np.int32]) -> NDArray[np.int64]:
    """As daq.conversion.unwrapped, from where the block before ended: counter and unwrapped count, shape (n,)."""
    all_counts = np.concatenate((last[0][None, :], counts)).astype(np.int32)
    steps = np.diff(all_counts.view(np.uint32), axis=0).view(np.int32)
    return np.asarray(last[1] + steps.cumsum(axis=0, dtype=np.int64), dtype=np.int64)


def _columns(
    cell: Cell,
    block: SampleBlock,
    counts: NDArray[np.int64],
    joints: NDArray[np.float64],
    per_unit: NDArray[np.float64],
    move: NDArray[np.int64] | None,
    first_ns: int,
) -> Columns:
    columns: Columns = {
        "cycle": block.cycle,
        "time_ns": block.time_ns,
        "time_s": (block.time_ns - first_ns) * 1e-9,
        "move": np.full(len(block.cycle), -1, dtype=np.int64) if move is None else move,
    }
    for index, axis in enumerate(cell.axes):
        name = re.sub(r"\W+", "_", axis.name)
        current = axis.gain_unit.partition("/")[2].strip() or "A"
        columns |= {
            f"{name}.position_{axis.unit.si_name}": joints[:, index],
            f"{name}.current_{re.sub(r'[^0-9A-Za-z%]+', '_', current)}": block.current_raw[:, index] * per_unit[index],
            f"{name}.motor_counts": counts[:, index],
            f"{name}.current_raw": block.current_raw[:, index],
            f"{name}.statusword": block.statusword[:, index],
            f"{name}.answered": ((block.missing >> np.uint32(index)) & 1 == 0).astype(np.uint8),
        }
    return columns


class _Csv(AbstractContextManager[Write]):
    """Comma, point, a header, lines that end with LF (RFC 4180 but for the end of line)."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stack = ExitStack()

    def __enter__(self) -> Write:
        stream = self._stack.enter_context(self._path.open("w", encoding="utf-8", newline="\n"))
        begun = False

        def write(columns: Columns) -> None:
            nonlocal begun
            if not begun:
                stream.write(",".join(columns) + "\n")
                begun = True
            # repr of a float is the shortest text that reads back as the same number.
            texts = [map(repr, column.tolist()) for column in columns.values()]
            stream.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))

        return write

    def __exit__(self, *error: object) -> None:
        self._stack.close()


class _Parquet(AbstractContextManager[Write]):
    """A row group a block, compressed by zstandard."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stack = ExitStack()

    def __enter__(self) -> Write:
        arrow: Any = importlib.import_module("pyarrow")
        parquet: Any = importlib.import_module("pyarrow.parquet")
        stream = self._stack.enter_context(self._path.open("wb"))
        writer: Any = None

        def write(columns: Columns) -> None:
            nonlocal writer
            table = arrow.table({name: np.ascontiguousarray(column) for name, column in columns.items()})
            if writer is None:
                writer = self._stack.enter_context(parquet.ParquetWriter(stream, table.schema, compression="zstd"))
            writer.write_table(table)

        return write

    def __exit__(self, *error: object) -> None:
        self._stack.close()


_WRITERS: dict[TableFormat, Callable[[Path], AbstractContextManager[Write]]] = {
    TableFormat.CSV: _Csv,
    TableFormat.PARQUET: _Parquet,
}
