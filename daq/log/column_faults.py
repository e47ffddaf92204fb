"""Readings that are none in the columns of a foreign recording,
judged as in a log (`ident.data.channel_faults`).

It is made where the numbers are as the file has them: a spline to a uniform clock would spread a
glitch. Where the rows stay as they are, the log keeps them, and a fit fills in what it finds there;
else the import does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import Cell
from daq.config.import_description import ImportDescription, PositionUnit, Section
from daq.errors import TableUnfit
from daq.log.conversion import unwrapped
from daq.log.table import Table, section_place
from ident.arrays import FloatArray, IntArray
from ident.data.channel_faults import ChannelFault, ChannelKind, find_faults, mended, refused_fault
from ident.data.fault_text import expected, found, remedy, what_is_done


@dataclass(frozen=True, slots=True, eq=False)
class UsedRows:
    """Rows of a recording that an import uses, and how its files are read."""

    row: IntArray  #: number of each, shape (k,)
    time_s: FloatArray | None  #: stamp of each [s], shape (k,); None without stamps
    rate_hz: float  #: of the rows
    wanted: ImportDescription
    files: Mapping[str, Table]
    cell: Cell

    def place_of(self, fault: ChannelFault) -> str:
        """Name the number at which a fault begins, and its axis."""
        section: Section = self.wanted.current
        if fault.quantity is ChannelKind.POSITION:
            section = self.wanted.position
        row = int(self.row[fault.first])
        place = section_place(section, self.files, row, fault.axis)
        return f"{place}, axis {self.cell.axes[fault.axis].name}"


@dataclass(frozen=True, slots=True, eq=False)
class SoundColumns:
    """Positions and currents of a file with the numbers replaced that are no readings."""

    position: FloatArray  #: as the file has them, shape (rows, n)
    current: FloatArray  #: likewise
    faults: tuple[ChannelFault, ...]


def sound_columns(position: FloatArray, current: FloatArray, used: UsedRows) -> SoundColumns:
    """Judge the columns of a recording, and replace what is no reading.

    Args:
        position, current: as the file has them, shape (rows, n).
        used: the rows that are used.

    Raises:
        TableUnfit: readings are none, and nothing mends them. Positions that go on displaced are
            left to `require_mendable`, after the limits of the robot.
    """
    is_counter = used.wanted.position.unit is PositionUnit.COUNTS
    read = position[used.row]
    if is_counter:
        read = unwrapped(_as_counter(read)).astype(np.float64)
    own_current = current[used.row]
    unit = used.wanted.position.unit.value
    faults = find_faults(read, own_current, used.rate_hz, unit=unit)
    require_mendable(faults, used, displaced=False)
    mended_position = position.copy()
    mended_position[used.row] = mended(read, faults, used.rate_hz, time=used.time_s)
    if is_counter:
        # The counter of 32 bits goes on at its other end.
        mended_position = _as_counter(np.rint(mended_position)).astype(np.float64)
    mended_current = current.copy()
    mended_current[used.row] = mended(
        own_current,
        faults,
        used.rate_hz,
        quantity=ChannelKind.CURRENT,
        time=used.time_s,
    )
    return SoundColumns(mended_position, mended_current, faults)


def _as_counter(counts: FloatArray) -> NDArray[np.int32]:
    """Return whole numbers as a counter of 32 bits has them."""
    return counts.astype(np.int64).astype(np.int32)


def require_mendable(faults: Sequence[ChannelFault], used: UsedRows, *, displaced: bool) -> None:
    """Refuse readings that are none, and that nothing mends.

    Args:
        faults: of the columns.
        used: the rows that are used.
        displaced: as of `ident.data.channel_faults.refused_fault`.

    Raises:
        TableUnfit: for the first of them.
    """
    refused = refused_fault(faults, displaced=displaced)
    if refused is not None:
        place = used.place_of(refused)
        raise TableUnfit(
            place,
            found=found(refused),
            expected=expected(refused),
            remedy=remedy(refused),
        )


def fault_remarks(faults: Sequence[ChannelFault], used: UsedRows) -> Iterator[str]:
    """Say what was found, and what is done with it, a line each.

    Args:
        faults: of the columns, all of them mended.
        used: the rows that are used.
    """
    for fault in faults:
        place = used.place_of(fault)
        yield f"{place}: {found(fault)}; {what_is_done(fault)}"
