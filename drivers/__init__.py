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

Nothing moves without a `MotionPermission`. A simulated cell for trials runs on the same buses (`drivers.simulation`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lazy_names import lazy_names

if TYPE_CHECKING:
    from drivers.canopen.bus import BusAddress as BusAddress
    from drivers.canopen.network import CanopenNetwork as CanopenNetwork
    from drivers.canopen.network import open_cell as open_cell
    from drivers.canopen.node_scan import FoundNode as FoundNode
    from drivers.canopen.node_scan import scan as scan
    from drivers.canopen.split_bus import BusPart as BusPart
    from drivers.canopen.split_bus import SplitAddress as SplitAddress
    from drivers.errors import BusBusy as BusBusy
    from drivers.errors import BusError as BusError
    from drivers.errors import DriveFault as DriveFault
    from drivers.errors import DriverError as DriverError
    from drivers.errors import MotionRefused as MotionRefused
    from drivers.errors import MotionTimeout as MotionTimeout
    from drivers.errors import NodeError as NodeError
    from drivers.errors import NodeMisplaced as NodeMisplaced
    from drivers.errors import NodeMissing as NodeMissing
    from drivers.errors import ObjectAccessError as ObjectAccessError
    from drivers.errors import ParameterRefused as ParameterRefused
    from drivers.errors import ParametersMixed as ParametersMixed
    from drivers.errors import SampleLost as SampleLost
    from drivers.errors import SetupRefused as SetupRefused
    from drivers.errors import StateRefused as StateRefused
    from drivers.messages import CellEvent as CellEvent
    from drivers.messages import EventKind as EventKind
    from drivers.messages import Sample as Sample
    from drivers.motion.execute import execute as execute
    from drivers.move import AxisLimits as AxisLimits
    from drivers.move import MotionPermission as MotionPermission
    from drivers.move import Move as Move
    from drivers.move import synchronised_move as synchronised_move
    from drivers.profiles.cia402 import State as State
    from drivers.profiles.cia402 import decode as decode
    from drivers.profiles.profile import CIA402 as CIA402
    from drivers.profiles.profile import Amplitude as Amplitude
    from drivers.profiles.profile import Axis as Axis
    from drivers.profiles.profile import CurrentScale as CurrentScale
    from drivers.profiles.profile import DriveProfile as DriveProfile
    from drivers.profiles.profile import Identity as Identity
    from drivers.profiles.profile import ObjectEntry as ObjectEntry
    from drivers.profiles.profile import TapPoint as TapPoint
    from drivers.stream.answers import StreamStatistics as StreamStatistics
    from drivers.stream.stream import SyncStream as SyncStream
    from drivers.stream.sync import FollowedSync as FollowedSync
    from drivers.stream.sync import LockstepSync as LockstepSync
    from drivers.stream.sync import TimedSync as TimedSync

    __all__: list[str]
else:
    __getattr__, __dir__ = lazy_names(__name__)
