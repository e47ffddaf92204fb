"""A cell as drivers takes it: the address of its bus, and its amplifiers."""

from __future__ import annotations

from daq.configuration.cell import Cell
from daq.errors import ConfigurationInconsistent
from drivers.axis import Axis
from drivers.bus import BusAddress


def bus_address(cell: Cell) -> BusAddress:
    """Where the bus of a cell is.

    Raises:
        ConfigurationInconsistent: the cell has no bus, it only imports recordings.
    """
    if cell.bus is None:
        raise _no_bus(cell, "no bus")
    return BusAddress(cell.bus.interface, cell.bus.channel, cell.bus.bitrate_bit_s, cell.bus.host, cell.bus.port)


def drive_axes(cell: Cell) -> tuple[Axis, ...]:
    """The amplifiers of a cell.

    Raises:
        ConfigurationInconsistent: an axis has no node, the cell only imports recordings.
    """
    axes = []
    for axis in cell.axes:
        if axis.node_id is None or axis.profile is None:
            raise _no_bus(cell, f"axis {axis.name} without node_id or drive")
        axes.append(Axis(axis.name, axis.node_id, axis.profile, axis.identity))
    return tuple(axes)


def _no_bus(cell: Cell, found: str) -> ConfigurationInconsistent:
    return ConfigurationInconsistent(
        f"cell {cell.name!r}",
        found=found,
        expected="a cell with bus, sync, and node_id and drive of each axis",
        remedy="this cell only imports recordings; add what is missing, as in configs/cells/demo.yaml",
    )
