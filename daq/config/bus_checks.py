"""Find contradictions in the buses of a cell file: wiring, sampling, load, and the producer of SYNC."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

from daq.config.cell import KERNEL, RECORDER, Bus, PacingMode
from daq.config.cell_buses import LARGEST_MEAN, bus_load, shortest_period_us, split_answers
from daq.config.cell_schema import CellModel
from daq.config.yaml_file import Fault, Location
from drivers.profiles.profile import DriveProfile

SIMULATED_INTERFACES = ("virtual", "socketcand")  #: Interfaces of simulated cells; any other may have a machine on it


def bus_faults(model: CellModel, profiles: Mapping[str, DriveProfile]) -> Iterator[Fault]:
    """Find faults of the wiring, the sampling and the load of the buses."""
    yield from _wiring_faults(model)
    if not model.buses:
        return
    if model.sync is None:
        yield Fault(("sync",), "nothing", "a sampling period, because the cell has a bus")
        return
    if len(model.buses) > 1 and model.sync.producer != RECORDER:
        expected = f"{RECORDER}: one SYNC must go out on all of the buses at once"
        yield Fault(("sync", "producer"), f"{model.sync.producer}, with {len(model.buses)} buses", expected)
    for drive in model.drives:
        refresh_us = profiles[drive].update_period_us
        if refresh_us > model.sync.period_us:
            yield Fault(
                ("sync", "period_us"),
                f"{model.sync.period_us}, while drive {drive} refreshes its objects every {refresh_us} µs",
                f"{refresh_us} or more: faster than that, samples repeat old values and motion becomes a staircase",
            )
    for index, bus in enumerate(model.buses):
        if model.sync.pacing is PacingMode.TIMED:
            yield from _load_faults(model, model.sync.period_us, bus, profiles)
        elif bus.interface not in SIMULATED_INTERFACES:
            yield Fault(
                ("sync", "pacing"),
                f"lockstep on a bus of interface {bus.interface}",
                f"timed: in lockstep the time of the samples is simulated, so only a simulated cell "
                f"({' or '.join(SIMULATED_INTERFACES)}) may use it",
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
            yield Fault(("bus", index, "name"), f"{name}, used {names.count(name)} times", "each name once")
        if names.index(name) == index and not any(model.bus_of(axis) == name for axis in model.axes):
            yield Fault(_path(model, index), f"bus {name} without an axis", "an axis with this `bus`, or no such bus")
    used = Counter(axis.node_id for axis in model.axes if axis.node_id is not None)
    for index, axis in enumerate(model.axes):
        if model.buses:
            for key in ("node_id", "drive", "identity", "counts_per_revolution"):
                if getattr(axis, key) is None:
                    yield Fault(("axes", index, key), "nothing", "a value, because the cell has a bus")
        where, known = ("axes", index, "bus"), ", ".join(names)
        if model.bus_of(axis) is None and len(names) > 1:
            yield Fault(where, "nothing", f"the bus of its amplifier, because the cell has several: {known}")
        elif axis.bus is not None and axis.bus not in names:
            yield Fault(where, f"{axis.bus}, which is no bus of this cell", f"one of {known}" if names else "no `bus`")
        if axis.node_id is None:
            continue
        if not 1 <= axis.node_id <= 127:
            yield Fault(("axes", index, "node_id"), str(axis.node_id), "1 to 127 (CiA 301)")
        if used[axis.node_id] > 1:
            several = ", on all buses together: a frame is known by its node id alone" if len(names) > 1 else ""
            found = f"{axis.node_id}, used {used[axis.node_id]} times"
            yield Fault(("axes", index, "node_id"), found, f"each node once{several}")


def _load_faults(model: CellModel, period_us: int, bus: Bus, profiles: Mapping[str, DriveProfile]) -> Iterator[Fault]:
    """Find buses that cannot carry a recording. In lockstep any can: the next SYNC waits for the answers."""
    used = [profiles[axis.drive] for axis in model.axes if axis.drive is not None and model.bus_of(axis) == bus.name]
    load = bus_load(used, bus.bitrate_bit_s, period_us)
    if load.allowed:
        return
    shortest = shortest_period_us(used, bus.bitrate_bit_s)
    ways = ["a faster bus" if shortest is None else f"{shortest} or more"]
    if len(used) > 1:
        ways.append("the axes on more buses (`bus` as a list)")
    wide = sorted({profile.name for profile in used if split_answers(profile)})
    if wide:
        ways.append(f"position, current and statusword in one frame (drive {', '.join(wide)} needs two)")
    yield Fault(
        ("sync", "period_us"),
        f"{period_us}, with which SYNC, the answers of {len(used)} axes, heartbeats and moves load bus {bus.name} "
        f"by {load} at {bus.bitrate_bit_s} bit/s",
        f"at most {100 * LARGEST_MEAN:.0f} % on average and answers that fit between two SYNCs at worst: "
        + ", or ".join(ways),
    )


def _where(bus: Bus) -> tuple[str | int, ...]:
    hub = (bus.host, bus.port) if bus.interface == "socketcand" else ()
    return (bus.interface, bus.channel, *hub)


def _path(model: CellModel, index: int) -> Location:
    return ("bus", index) if isinstance(model.bus, tuple) else ("bus",)


KERNEL_INTERFACE = "socketcan"  #: Only SocketCAN's broadcast manager sends SYNC from the kernel


def producer_faults(model: CellModel) -> Iterator[Fault]:
    """Find a SYNC producer that does not exist, or cannot pace this bus."""
    if model.sync is None or model.sync.producer == RECORDER:
        return
    path, producer = ("sync", "producer"), model.sync.producer
    interfaces = [bus.interface for bus in model.buses]
    if len(interfaces) > 1:
        expected = f"{RECORDER}: no other producer sends SYNC on several buses at once"
        yield Fault(path, f"{producer} with {len(interfaces)} buses", expected)
    if model.sync.pacing is PacingMode.LOCKSTEP:
        expected = f"{RECORDER}, or pacing timed: in lockstep the next SYNC waits for the answers"
        yield Fault(path, f"{producer} with pacing lockstep", expected)
    if producer == KERNEL:
        if set(interfaces) != {KERNEL_INTERFACE}:
            expected = f"a bus of interface {KERNEL_INTERFACE}, whose broadcast manager sends it"
            yield Fault(path, f"{KERNEL} on {' + '.join(interfaces) or 'no bus'}", expected)
    elif producer not in (names := [axis.name for axis in model.axes]):
        yield Fault(path, producer, f"{RECORDER}, {KERNEL}, or an axis ({', '.join(names)})")
