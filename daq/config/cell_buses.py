"""The buses of a cell: their contradictions, their load in a recording,
and their addresses for `drivers`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING

import drivers
from daq.config.cell import KERNEL, RECORDER, Bus, Cell, PacingMode, Sync, Wired
from daq.config.cell_schema import CellModel
from daq.config.yaml_file import Fault, Location
from daq.errors import ConfigurationInconsistent
from drivers.canopen.interfaces import INTERFACES, SOCKETCAN
from drivers.canopen.pdo import HEARTBEAT_MS, SETPOINT_PDOS, STATUSWORD, pack
from drivers.profiles.profile import Axis, DriveProfile, ObjectEntry

if TYPE_CHECKING:
    from drivers.canopen.split_bus import CellAddress
    from drivers.stream.monitor import CellReading

# Addresses are made through the lazy front door: reading a cell file checks the load of its buses,
# and that needs no CAN library.

LARGEST_MEAN = 0.80
"""Largest mean load, as a share of the bus.

The rest is for repeated frames, SDO, EMCY and other nodes; above it frames wait for each other so
often that answers come after the next SYNC.
"""
LARGEST_WORST = 1.0
"""Largest share of a period for SYNC and its answers at maximal bit stuffing:
an answer after the next SYNC is late and makes a run invalid.
"""
STUFFING = 13
"""Number of bits for each stuff bit on average: positions and currents have longer runs of equal
bits than random data, where it is 30. tests/daq/config/test_bus_load.py compares it with real
frames.
"""
MOVES_PER_S = 1.0
SETPOINTS = 4
"""Controlwords of an axis in a move: new set-point until acknowledged, cleared until confirmed;
usually twice each.
"""


@dataclass(frozen=True, slots=True)
class BusLoad:
    """Load of a recording on one bus, as shares of its capacity."""

    #: SYNC, answers, heartbeats, and the set-points of one move per second, with usual stuffing
    mean: float
    worst: float  #: SYNC and answers alone, with maximal stuffing
    #: The cycle in which all axes start, with usual stuffing. Above 1 it takes longer than a
    #: period, and answers may be late.
    start: float

    @property
    def allowed(self) -> bool:
        """Whether a recording may have this load."""
        return self.mean <= LARGEST_MEAN and self.worst <= LARGEST_WORST

    def __str__(self) -> str:
        mean_percent = 100 * self.mean
        worst_percent = 100 * self.worst
        return f"{mean_percent:.0f} % on average, {worst_percent:.0f} % at worst"


def frame_bits(data_bytes: int) -> int:
    """Return the bits of the longest data frame with an 11-bit identifier,
    with stuff bits and interframe space.

    Source: ISO 11898-1; 34 + 8·d bits are stuffed, with at most one stuff bit for four of them (for
    the first, five).
    """
    stuffed = 34 + 8 * data_bytes
    return stuffed + 13 + (stuffed - 1) // 4


def usual_bits(data_bytes: int) -> float:
    """Return the bits of such a frame with the average number of stuff bits of a recording."""
    stuffed = 34 + 8 * data_bytes
    return stuffed + 13 + stuffed / STUFFING


def answer_us(profiles: Sequence[DriveProfile], bitrate_bit_s: int) -> float:
    """Return the longest time for SYNC and one answer of each axis [µs]."""
    answer_bits = sum(map(frame_bits, _answers(profiles)))
    return 1e6 * (frame_bits(0) + answer_bits) / bitrate_bit_s


def bus_load(profiles: Sequence[DriveProfile], bitrate_bit_s: int, period_us: int) -> BusLoad:
    """Compute the load of a recording on a bus.

    Args:
        profiles: drive profiles of the axes on it, one each.
        bitrate_bit_s: bit rate of the bus.
        period_us: period of SYNC.
    """
    period_bits = bitrate_bit_s * period_us * 1e-6
    cycle = _cycle_bits(profiles)
    setpoints = len(profiles) * usual_bits(_SETPOINT_BYTES[0])
    steady = _steady_bits_s(profiles) / bitrate_bit_s
    return BusLoad(
        mean=cycle / period_bits + steady,
        worst=answer_us(profiles, bitrate_bit_s) / period_us,
        start=(cycle + setpoints) / period_bits,
    )


def shortest_period_us(profiles: Sequence[DriveProfile], bitrate_bit_s: int) -> int | None:
    """Return the shortest allowed period;
    None if heartbeats and moves alone are too much for the bus.
    """
    left_bits_s = LARGEST_MEAN * bitrate_bit_s - _steady_bits_s(profiles)
    if left_bits_s <= 0:
        return None
    mean_us = 1e6 * _cycle_bits(profiles) / left_bits_s
    worst_us = answer_us(profiles, bitrate_bit_s) / LARGEST_WORST
    # Rounding must not refuse a period that is exactly long enough.
    return ceil(max(mean_us, worst_us) - 1e-6)


def split_answers(profile: DriveProfile) -> bool:
    """Return whether an axis's answer takes two PDOs."""
    return len(pack(_feedback(profile))) > 1


def _feedback(profile: DriveProfile) -> tuple[ObjectEntry, ...]:
    return (profile.position, profile.current, STATUSWORD)


def _bytes(pdo: Sequence[ObjectEntry]) -> int:
    return sum(entry.bits for entry in pdo) // 8


_SETPOINT_BYTES = tuple(map(_bytes, SETPOINT_PDOS))


def _answers(profiles: Sequence[DriveProfile]) -> tuple[int, ...]:
    """Return the data bytes of every frame that answers one SYNC."""
    data_bytes: list[int] = []
    for profile in profiles:
        data_bytes += map(_bytes, pack(_feedback(profile)))
    return tuple(data_bytes)


def _cycle_bits(profiles: Sequence[DriveProfile]) -> float:
    return usual_bits(0) + sum(map(usual_bits, _answers(profiles)))


def _steady_bits_s(profiles: Sequence[DriveProfile]) -> float:
    """Return the load of heartbeats (also the recorder's) and set-points,
    independent of the period [bit/s].
    """
    nodes = len(profiles) + 1
    heartbeats = nodes * usual_bits(1) * 1000.0 / HEARTBEAT_MS
    first, *others = map(usual_bits, _SETPOINT_BYTES)
    move_bits = SETPOINTS * first + sum(others)
    return heartbeats + MOVES_PER_S * len(profiles) * move_bits


SIMULATED = " or ".join(one.name for one in INTERFACES.values() if one.is_simulated)


def bus_faults(model: CellModel, profiles: Mapping[str, DriveProfile]) -> Iterator[Fault]:
    """Find faults of the wiring, the sampling and the load of the buses."""
    yield from _wiring_faults(model)
    if not model.buses:
        return
    if model.sync is None:
        yield Fault(("sync",), "nothing", "a sampling period, because the cell has a bus")
        return
    for drive in model.drives:
        refresh_us = profiles[drive].update_period_us
        if refresh_us > model.sync.period_us:
            period_us = model.sync.period_us
            found = f"{period_us}, while drive {drive} refreshes its objects every {refresh_us} µs"
            expected = (
                f"{refresh_us} or more: faster than that, samples repeat old values and motion "
                "becomes a staircase"
            )
            yield Fault(("sync", "period_us"), found, expected)
    for index, bus in enumerate(model.buses):
        if model.sync.pacing is PacingMode.TIMED:
            yield from _load_faults(model, model.sync.period_us, bus, profiles)
        elif not bus.kind.is_simulated:
            yield Fault(
                ("sync", "pacing"),
                f"lockstep on a bus of interface {bus.interface}",
                "timed: in lockstep the time of the samples is simulated, so only a simulated cell "
                f"({SIMULATED}) may use it",
            )
        for other in model.buses[:index]:
            if _where(bus) == _where(other):
                yield Fault(
                    _path(model, index),
                    f"{bus.interface} {bus.channel}, which bus {other.name} is too",
                    "another channel: each bus has its own interface",
                )


def _wiring_faults(model: CellModel) -> Iterator[Fault]:
    names = [bus.name for bus in model.buses]
    for index, name in enumerate(names):
        if names.count(name) > 1:
            found = f"{name}, used {names.count(name)} times"
            yield Fault(("bus", index, "name"), found, "each name once")
        has_axis = any(model.bus_of(axis) == name for axis in model.axes)
        if names.index(name) == index and not has_axis:
            yield Fault(
                _path(model, index),
                f"bus {name} without an axis",
                "an axis with this `bus`, or no such bus",
            )
    yield from _node_faults(model, names)


def _node_faults(model: CellModel, names: Sequence[str]) -> Iterator[Fault]:
    """Find axes without a node or a bus of the cell, and nodes that are there twice."""
    used = Counter(axis.node_id for axis in model.axes if axis.node_id is not None)
    for index, axis in enumerate(model.axes):
        if model.buses:
            for key in ("node_id", "drive", "counts_per_revolution"):
                if getattr(axis, key) is None:
                    yield Fault(
                        ("axes", index, key), "nothing", "a value, because the cell has a bus"
                    )
        where = ("axes", index, "bus")
        known = ", ".join(names)
        if model.bus_of(axis) is None and len(names) > 1:
            expected = f"the bus of its amplifier, because the cell has several: {known}"
            yield Fault(where, "nothing", expected)
        elif axis.bus is not None and axis.bus not in names:
            expected = f"one of {known}" if names else "no `bus`"
            yield Fault(where, f"{axis.bus}, which is no bus of this cell", expected)
        if axis.node_id is None:
            continue
        if not 1 <= axis.node_id <= 127:
            yield Fault(("axes", index, "node_id"), str(axis.node_id), "1 to 127 (CiA 301)")
        if used[axis.node_id] > 1:
            expected = "each node once"
            if len(names) > 1:
                expected += ", on all buses together: a frame is known by its node id alone"
            found = f"{axis.node_id}, used {used[axis.node_id]} times"
            yield Fault(("axes", index, "node_id"), found, expected)


def _load_faults(
    model: CellModel, period_us: int, bus: Bus, profiles: Mapping[str, DriveProfile]
) -> Iterator[Fault]:
    """Find buses that cannot carry a recording.

    In lockstep any can: the next SYNC waits for the answers.
    """
    used = []
    for axis in model.axes:
        if axis.drive is not None and model.bus_of(axis) == bus.name:
            used.append(profiles[axis.drive])
    load = bus_load(used, bus.bitrate_bit_s, period_us)
    if load.allowed:
        return
    shortest = shortest_period_us(used, bus.bitrate_bit_s)
    ways = ["a faster bus" if shortest is None else f"{shortest} or more"]
    if len(used) > 1:
        ways.append("the axes on more buses (`bus` as a list)")
    wide = sorted({profile.name for profile in used if split_answers(profile)})
    if wide:
        drives = ", ".join(wide)
        ways.append(f"position, current and statusword in one frame (drive {drives} needs two)")
    found = (
        f"{period_us}, with which SYNC, the answers of {len(used)} axes, heartbeats and moves load "
        f"bus {bus.name} by {load} at {bus.bitrate_bit_s} bit/s"
    )
    largest_percent = 100 * LARGEST_MEAN
    expected = (
        f"at most {largest_percent:.0f} % on average and answers that fit between two SYNCs "
        "at worst: "
    )
    yield Fault(("sync", "period_us"), found, expected + ", or ".join(ways))


def _where(bus: Bus) -> tuple[str | int, ...]:
    hub = (bus.host, bus.port) if bus.kind.has_server else ()
    return (bus.interface, bus.channel, *hub)


def _path(model: CellModel, index: int) -> Location:
    return ("bus", index) if isinstance(model.bus, tuple) else ("bus",)


def producer_faults(model: CellModel) -> Iterator[Fault]:
    """Find a SYNC producer that does not exist, or cannot pace this bus."""
    if model.sync is None or model.sync.producer == RECORDER:
        return
    path = ("sync", "producer")
    producer = model.sync.producer
    interfaces = [bus.interface for bus in model.buses]
    if len(interfaces) > 1:
        expected = f"{RECORDER}: no other producer sends SYNC on several buses at once"
        yield Fault(path, f"{producer} with {len(interfaces)} buses", expected)
    if model.sync.pacing is PacingMode.LOCKSTEP:
        expected = f"{RECORDER}, or pacing timed: in lockstep the next SYNC waits for the answers"
        yield Fault(path, f"{producer} with pacing lockstep", expected)
    if producer == KERNEL:
        if set(interfaces) != {SOCKETCAN.name}:
            expected = f"a bus of interface {SOCKETCAN.name}, whose broadcast manager sends it"
            listed = " + ".join(interfaces) or "no bus"
            yield Fault(path, f"{KERNEL} on {listed}", expected)
    elif producer not in model.axis_names:
        listed = ", ".join(model.axis_names)
        yield Fault(path, producer, f"{RECORDER}, {KERNEL}, or an axis ({listed})")


def cell_address(cell: Wired) -> CellAddress:
    """Return the address of a cell's bus, or of its buses.

    Raises:
        ConfigurationInconsistent: the cell only imports recordings.
    """
    parts = bus_parts(cell)
    if len(parts) == 1:
        return parts[0].address
    return drivers.SplitAddress(parts)


def bus_parts(cell: Wired) -> tuple[drivers.BusPart, ...]:
    """Return each bus of a cell with the nodes that should be on it.

    Raises:
        ConfigurationInconsistent: as `cell_address`.
    """

    if not cell.buses:
        raise _no_bus(cell, "no bus")
    parts = []
    for bus in cell.buses:
        axes = [axis for axis in cell.axes if axis.bus == bus.name]
        names = {axis.node_id: axis.name for axis in axes if axis.node_id is not None}
        parts.append(drivers.BusPart(bus.name, _address(bus), frozenset(names), names))
    return tuple(parts)


def bus_loads(cell: Cell) -> tuple[tuple[Bus, BusLoad], ...]:
    """Compute the load of a recording on each bus; in lockstep, the load of a real bus."""
    if cell.sync is None:
        return ()
    loads = []
    for bus, axes in cell.wiring:
        used = [axis.profile for axis in axes if axis.profile is not None]
        loads.append((bus, bus_load(used, bus.bitrate_bit_s, cell.sync.period_us)))
    return tuple(loads)


def load_warnings(cell: Cell) -> tuple[str, ...]:
    """Warn of buses on which the start of a move does not fit between two SYNCs."""
    if cell.sync is None or cell.sync.pacing is PacingMode.LOCKSTEP:
        return ()
    warnings = []
    for bus, load in bus_loads(cell):
        if load.start > 1.0:
            start_percent = 100 * load.start
            warnings.append(
                f"{bus.name}: when all its axes start, set-points and answers take "
                f"{start_percent:.0f} % of a period, and a late answer makes the run invalid; a "
                "longer sync.period_us or a second bus has room for them"
            )
    return tuple(warnings)


def polling_fits(cell: Cell) -> bool:
    """Return whether every period has room for an SDO request and its answer besides all answers to
    the SYNC.

    Both frames may fall into one period, and an answer after the next SYNC makes a run invalid. In
    lockstep there is always room.
    """
    if cell.sync is None or cell.sync.pacing is PacingMode.LOCKSTEP:
        return True
    loads = [load.worst + _sdo_share(cell.sync, bus) for bus, load in bus_loads(cell)]
    return all(load <= LARGEST_WORST for load in loads)


def polling_warnings(cell: Cell) -> tuple[str, ...]:
    """Warn of a cell in which torque and temperature are not logged alongside the samples:
    see `polling_fits`.
    """
    if cell.sync is None or polling_fits(cell):
        return ()
    loads = [load.worst + _sdo_share(cell.sync, bus) for bus, load in bus_loads(cell)]
    most_us = max(load * cell.sync.period_us for load in loads)
    period_us = 100 * ceil(most_us / 100)
    return (
        "no room for SDO between two SYNCs: the drives' torque is not logged, and their "
        f"temperature only before and after the run; a sync.period_us of {period_us} has room",
    )


def _sdo_share(sync: Sync, bus: Bus) -> float:
    """Share of a period of an SDO request and its answer, with maximal stuffing."""
    return 2 * frame_bits(8) * 1e6 / (bus.bitrate_bit_s * sync.period_us)


def bus_address(cell: Cell) -> drivers.BusAddress:
    """Return the address of the only bus of a cell.

    Raises:
        ConfigurationInconsistent: the cell has no bus, or several.
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
    """Return the amplifiers of a cell.

    Raises:
        ConfigurationInconsistent: the cell only imports recordings.
    """
    axes = []
    for axis in cell.axes:
        if axis.node_id is None or axis.profile is None:
            raise _no_bus(cell, f"axis {axis.name} without node_id or drive")
        axes.append(Axis(axis.name, axis.node_id, axis.profile, axis.identity))
    return tuple(axes)


def _address(bus: Bus) -> drivers.BusAddress:
    return drivers.BusAddress(bus.interface, bus.channel, bus.bitrate_bit_s, bus.host, bus.port)


def _no_bus(cell: Wired, found: str) -> ConfigurationInconsistent:
    return ConfigurationInconsistent(
        f"cell {cell.name!r}",
        found=found,
        expected="a cell with bus, sync, and node_id and drive of each axis",
        remedy="this cell only imports recordings; add what is missing, as in "
        "configs/cells/demo.yaml",
    )


def bus_loads_percent(cell: Cell, reading: CellReading) -> tuple[float, ...]:
    """Load of each bus, with every frame as long as bit stuffing can make it [%]."""
    loads = []
    for bus, frames in zip(cell.buses, reading.frames, strict=True):
        bits = sum(count * frame_bits(length) for length, count in enumerate(frames))
        loads.append(100.0 * bits / (bus.bitrate_bit_s * reading.seconds))
    return tuple(loads)
