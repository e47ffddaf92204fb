"""Drive CiA 402 amplifiers over CANopen: find them, stream their samples, move them.

Everything that a program needs is here; importing `drivers` loads no module before a name is used::

    axes = [drivers.Axis("J1", node_id=1), drivers.Axis("J2", node_id=2)]
    with drivers.open_cell("socketcan:can0", axes) as cell:
        for sample in itertools.islice(drivers.SyncStream(cell, drivers.TimedSync(period_ns=1_000_000)), 1000):
            print(sample.time_ns, sample.position_counts, sample.current_raw)

======================================  ==========================================================================
find a bus and its nodes                `BusAddress`, `SplitAddress` and `BusPart` (several buses), `scan`, `FoundNode`
describe an amplifier                   `Axis`, `Identity`, `DriveProfile`, `ObjectEntry`, `CurrentScale`, `CIA402`
set a cell up and restore it            `open_cell`, `CanopenNetwork`
stream samples                          `SyncStream`, `TimedSync`, `FollowedSync`, `LockstepSync`, `Sample`,
                                        `CellEvent`, `EventKind`, `StreamStatistics`
move axes                               `execute`, `Move`, `synchronised_move`, `MotionPermission`, `AxisLimits`
errors                                  `DriverError` and its subclasses (drivers/errors.py)
======================================  ==========================================================================

Nothing moves without a `MotionPermission`. A simulated cell for trials runs on the same buses: `drivegain simulate`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drivers.canopen.bus import BusAddress
    from drivers.canopen.network import CanopenNetwork, open_cell
    from drivers.canopen.scan import FoundNode
    from drivers.canopen.scan import scan_bus as scan
    from drivers.errors import (
        BusBusy,
        BusError,
        DriveFault,
        DriverError,
        MotionRefused,
        MotionTimeout,
        NodeError,
        NodeMisplaced,
        NodeMissing,
        ObjectAccessError,
        ParameterRefused,
        ParametersMixed,
        SampleLost,
        SetupRefused,
        StateRefused,
    )
    from drivers.motion.execute import execute
    from drivers.motion.move import AxisLimits, MotionPermission, Move, synchronised_move
    from drivers.profiles.cia402 import State, decode
    from drivers.profiles.profile import (
        CIA402,
        Amplitude,
        Axis,
        CurrentScale,
        DriveProfile,
        Identity,
        ObjectEntry,
        TapPoint,
    )
    from drivers.stream.answers import StreamStatistics
    from drivers.stream.sample import CellEvent, EventKind, Sample
    from drivers.stream.split_bus import BusPart, SplitAddress
    from drivers.stream.stream import SyncStream
    from drivers.stream.sync import FollowedSync, LockstepSync, TimedSync

__all__ = [
    "CIA402",
    "Amplitude",
    "Axis",
    "AxisLimits",
    "BusAddress",
    "BusBusy",
    "BusError",
    "BusPart",
    "CanopenNetwork",
    "CellEvent",
    "CurrentScale",
    "DriveFault",
    "DriveProfile",
    "DriverError",
    "EventKind",
    "FollowedSync",
    "FoundNode",
    "Identity",
    "LockstepSync",
    "MotionPermission",
    "MotionRefused",
    "MotionTimeout",
    "Move",
    "NodeError",
    "NodeMisplaced",
    "NodeMissing",
    "ObjectAccessError",
    "ObjectEntry",
    "ParameterRefused",
    "ParametersMixed",
    "Sample",
    "SampleLost",
    "SetupRefused",
    "SplitAddress",
    "State",
    "StateRefused",
    "StreamStatistics",
    "SyncStream",
    "TapPoint",
    "TimedSync",
    "decode",
    "execute",
    "open_cell",
    "scan",
    "synchronised_move",
]

_HOMES = {
    "canopen.bus": "BusAddress",
    "canopen.network": "CanopenNetwork open_cell",
    "canopen.scan": "FoundNode scan_bus",
    "motion.execute": "execute",
    "motion.move": "AxisLimits MotionPermission Move synchronised_move",
    "profiles.cia402": "State decode",
    "profiles.profile": "CIA402 Amplitude Axis CurrentScale DriveProfile Identity ObjectEntry TapPoint",
    "stream.answers": "StreamStatistics",
    "stream.sample": "CellEvent EventKind Sample",
    "stream.split_bus": "BusPart SplitAddress",
    "stream.stream": "SyncStream",
    "stream.sync": "FollowedSync LockstepSync TimedSync",
}
_MODULES = {name: home for home, names in _HOMES.items() for name in names.split()}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it exports {', '.join(__all__)}")
    name_there = "scan_bus" if name == "scan" else name
    module = import_module(f"{__name__}.{_MODULES.get(name_there, 'errors')}")
    value = globals()[name] = getattr(module, name_there)
    return value


def __dir__() -> list[str]:
    return __all__
