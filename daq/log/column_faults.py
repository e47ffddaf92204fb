"""Readings that are none in the columns of a foreign recording, by the judgement of a log (`ident.data.channel_faults`).

It is made where the numbers are as the file has them: a spline to a uniform clock would spread a glitch. Where the rows
stay as they are, the log keeps them, and a fit fills in what it finds there; else the import does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from daq.config.cell import Cell
from daq.config.import_description import Column, ImportDescription, PositionUnit
from daq.errors import TableUnfit
from daq.log.conversion import unwrapped
from daq.log.table import Table
from ident.arrays import FloatArray, IntArray
from ident.data.channel_faults import ChannelFault, Quantity, find_faults, mended, refused_fault
from ident.data.fault_text import expected, found, remedy


@dataclass(frozen=True, slots=True, eq=False)
class SoundColumns:
    """Positions and currents of a file without their glitches."""

    position: FloatArray  #: as the file has them, shape (rows, n)
    current: FloatArray  #: likewise
    faults: tuple[ChannelFault, ...]

    @property
    def is_mended(self) -> bool:
        """Whether some number is another than in the file."""
        return bool(self.faults)


def sound_columns(
    position: FloatArray,
    current: FloatArray,
    wanted: ImportDescription,
    files: dict[str, Table],
    row: IntArray,
    rate_hz: float,
) -> SoundColumns:
    """Judge the columns of a recording, and fill in their glitches.

    Args:
        position, current: as the file has them, shape (rows, n).
        wanted: with their columns and units.
        files: that they are in.
        row: rows that are used, shape (k,).
        rate_hz: rate of the rows.

    Raises:
        TableUnfit: readings are none, and nothing mends them. Positions that go on displaced are left to
            `require_mendable`, after the limits of the robot.
    """
    is_counter = wanted.position.unit is PositionUnit.COUNTS
    used = position[row]
    if is_counter:
        used = unwrapped(used.astype(np.int64).astype(np.int32)).astype(np.float64)
    faults = find_faults(used, current[row], rate_hz, unit=wanted.position.unit.value)
    require_mendable(faults, wanted, files, row, displaced=False)
    filled_position = position.copy()
    filled_position[row] = mended(used, faults, rate_hz)
    if is_counter:
        # A counter of 32 bits goes on at its other end.
        whole = np.rint(filled_position).astype(np.int64)
        filled_position = np.where(filled_position == position, position, whole.astype(np.int32))
    filled_current = current.copy()
    filled_current[row] = mended(current[row], faults, rate_hz, quantity=Quantity.CURRENT)
    return SoundColumns(filled_position, filled_current, faults)


def require_mendable(
    faults: Sequence[ChannelFault],
    wanted: ImportDescription,
    files: dict[str, Table],
    row: IntArray,
    *,
    displaced: bool,
) -> None:
    """Refuse readings that are none, and that nothing mends.

    Args:
        faults: of the columns.
        wanted, files, row: as of `sound_columns`.
        displaced: as of `ident.data.channel_faults.refused_fault`.

    Raises:
        TableUnfit: for the first of them.
    """
    refused = refused_fault(faults, displaced=displaced)
    if refused is not None:
        place = place_of(refused, int(row[refused.first]), wanted, files)
        raise TableUnfit(place, found=found(refused), expected=expected(refused), remedy=remedy(refused))


def fault_remarks(
    sound: SoundColumns, wanted: ImportDescription, files: dict[str, Table], row: IntArray, cell: Cell
) -> Iterator[str]:
    """Say what was found, and what is done with it, a line each.

    Args:
        sound: of `sound_columns`.
        wanted, files, row: likewise.
        cell: with the names of the axes.
    """
    for one in sound.faults:
        place = place_of(one, int(row[one.first]), wanted, files)
        name = cell.axes[one.axis].name
        done = "these samples are filled in" if one.is_filled else "a fit leaves these samples out"
        yield f"{place}, axis {name}: {found(one)}; {done}"


def place_of(fault: ChannelFault, row: int, wanted: ImportDescription, files: dict[str, Table]) -> str:
    """Name the number at which a fault begins."""
    section = wanted.position if fault.quantity is Quantity.POSITION else wanted.current
    columns: Sequence[Column] = section.columns
    return files[section.file].place(row, columns[fault.axis])
