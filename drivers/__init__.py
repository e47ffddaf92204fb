"""Drive CiA 402 amplifiers over CANopen: find them, stream their samples, move them.

Everything that a program needs is here; importing `drivers` loads no module before a name is used::

    axes = [drivers.Axis("J1", node_id=1), drivers.Axis("J2", node_id=2)]
    with drivers.open_cell("socketcan:can0", axes) as cell:
        stream = drivers.SyncStream(cell, drivers.TimedSync(period_ns=1_000_000))
        for sample in itertools.islice(stream, 1000):
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

Nothing moves without a `MotionPermission`. A simulated cell for trials runs on the same buses
(`drivers.simulation`).
"""  # noqa: E501

from __future__ import annotations

from typing import TYPE_CHECKING

from lazy_names import lazy_names

if TYPE_CHECKING:  # the names of a module stand together
    # ruff: noqa: I001
    from drivers.canopen.bus import BusAddress as BusAddress
    from drivers.canopen.network import (
        CanopenNetwork as CanopenNetwork,
        open_cell as open_cell,
    )
    from drivers.canopen.node_scan import (
        FoundNode as FoundNode,
        scan as scan,
    )
    from drivers.canopen.split_bus import (
        BusPart as BusPart,
        SplitAddress as SplitAddress,
    )
    from drivers.errors import (
        BusBusy as BusBusy,
        BusError as BusError,
        DriveFault as DriveFault,
        DriverError as DriverError,
        MotionRefused as MotionRefused,
        MotionTimeout as MotionTimeout,
        NodeError as NodeError,
        NodeMisplaced as NodeMisplaced,
        NodeMissing as NodeMissing,
        ObjectAccessError as ObjectAccessError,
        ParameterRefused as ParameterRefused,
        ParametersMixed as ParametersMixed,
        SampleLost as SampleLost,
        SetupRefused as SetupRefused,
        StateRefused as StateRefused,
    )
    from drivers.messages import (
        CellEvent as CellEvent,
        EventKind as EventKind,
        Sample as Sample,
    )
    from drivers.motion.execute import execute as execute
    from drivers.move import (
        AxisLimits as AxisLimits,
        MotionPermission as MotionPermission,
        Move as Move,
        synchronised_move as synchronised_move,
    )
    from drivers.profiles.cia402 import (
        State as State,
        decode as decode,
    )
    from drivers.profiles.profile import (
        CIA402 as CIA402,
        Amplitude as Amplitude,
        Axis as Axis,
        CurrentScale as CurrentScale,
        DriveProfile as DriveProfile,
        Identity as Identity,
        ObjectEntry as ObjectEntry,
        TapPoint as TapPoint,
    )
    from drivers.stream.answers import StreamStatistics as StreamStatistics
    from drivers.stream.stream import SyncStream as SyncStream
    from drivers.stream.sync import (
        FollowedSync as FollowedSync,
        LockstepSync as LockstepSync,
        TimedSync as TimedSync,
    )

    __all__: list[str]
else:
    __getattr__, __dir__ = lazy_names(__name__)
