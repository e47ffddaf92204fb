"""A cell as drivers takes it: the address of its bus, or of its buses, and its amplifiers."""

from __future__ import annotations

from daq.configuration.bus_load import BusLoad, bus_load
from daq.configuration.cell import Bus, Cell, Pacing
from daq.errors import ConfigurationInconsistent
from drivers.axis import Axis
from drivers.bus import BusAddress
from drivers.split_bus import BusPart, CellAddress, SplitAddress


def cell_address(cell: Cell) -> CellAddress:
    """Where the bus, or the buses, of a cell are.

    Raises:
        ConfigurationInconsistent: the cell has no bus, it only imports recordings.
    """
    parts = bus_parts(cell)
    return parts[0].address if len(parts) == 1 else SplitAddress(parts)


def bus_parts(cell: Cell) -> tuple[BusPart, ...]:
    """Each bus of a cell with the nodes that should be on it.

    Raises:
        ConfigurationInconsistent: as `cell_address`.
    """
    if not cell.buses:
        raise _no_bus(cell, "no bus")
    return tuple(
        BusPart(bus.name, _address(bus), frozenset(axis.node_id for axis in axes if axis.node_id is not None))
        for bus, axes in cell.wiring
    )


def bus_loads(cell: Cell) -> tuple[tuple[Bus, BusLoad], ...]:
    """What a recording takes of each bus; in lockstep, what it would take of a real one."""
    if cell.sync is None:
        return ()
    profiles = [[axis.profile for axis in axes if axis.profile is not None] for _, axes in cell.wiring]
    return tuple(
        (bus, bus_load(used, bus.bitrate_bit_s, cell.sync.period_us))
        for bus, used in zip(cell.buses, profiles, strict=True)
    )


def load_warnings(cell: Cell) -> tuple[str, ...]:
    """Buses on which the start of a move does not fit between two SYNCs."""
    if cell.sync is None or cell.sync.pacing is Pacing.LOCKSTEP:
        return ()
    return tuple(
        f"{bus.name}: when all its axes are told to start, set-points and answers take {100 * load.start:.0f} % of a "
        "period, and a late answer makes the run invalid; a longer sync.period_us or a second bus has room for them"
        for bus, load in bus_loads(cell)
        if load.start > 1.0
    )


def bus_address(cell: Cell) -> BusAddress:
    """Where the bus of a cell that has one is.

    Raises:
        ConfigurationInconsistent: the cell has none, or several.
    """
    if not cell.buses:
        raise _no_bus(cell, "no bus")
    if len(cell.buses) > 1:
        raise ConfigurationInconsistent(
            f"cell {cell.name!r}",
            found=f"{len(cell.buses)} buses",
            expected="one",
            remedy="use a cell file with a single bus here",
        )
    return _address(cell.buses[0])


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


def _address(bus: Bus) -> BusAddress:
    return BusAddress(bus.interface, bus.channel, bus.bitrate_bit_s, bus.host, bus.port)


def _no_bus(cell: Cell, found: str) -> ConfigurationInconsistent:
    return ConfigurationInconsistent(
        f"cell {cell.name!r}",
        found=found,
        expected="a cell with bus, sync, and node_id and drive of each axis",
        remedy="this cell only imports recordings; add what is missing, as in configs/cells/demo.yaml",
    )
