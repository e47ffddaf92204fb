"""One SYNC cycle of a cell as the amplifiers sent it, and the events and slow readings between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum


@dataclass(frozen=True, slots=True)
class Sample:
    """Reports of all axes for one SYNC.

    Values are raw counts, converted late: the gain is to be identified, so the data contain no
    assumed gain.
    """

    #: number of the sampling period since the stream began; a period that had no SYNC leaves a gap
    cycle: int
    #: Time of the SYNC, not of the frames that answered it: wall time at the stream's first SYNC
    #: plus the monotonic time since [ns since 1970].
    time_ns: int
    position_counts: tuple[int, ...]  #: motor-side position of each axis [encoder counts]
    #: Signal of the current loop of each axis [unit of the drive profile's current object].
    current_raw: tuple[int, ...]
    statusword: tuple[int, ...]  #: CiA 402 object 6041h of each axis
    #: bit i is set when axis i did not answer this SYNC; its values then repeat the last known ones
    missing: int = 0


class EventKind(Enum):
    """Kind of a CellEvent."""

    EMCY = "emcy"
    EMCY_RESET = "emcy reset"
    NMT = "nmt"
    STATE = "state"
    FOLLOWING_ERROR = "following error"
    LIMIT = "limit"
    HEARTBEAT_LOST = "heartbeat lost"
    SAMPLE_LOST = "sample lost"
    BUS_BUSY = "bus busy"
    BUS_LOST = "bus lost"
    BUS_PASSIVE = "error passive"
    CONTROLLER = "controller"
    FRAMES_DROPPED = "frames dropped"
    SYNC_LOST = "sync lost"
    CAPTURE = "capture"
    PDO_LENGTH = "pdo length"
    FROZEN = "frozen data"
    MOVE_START = "move start"
    MOVE_END = "move end"
    STOP = "stop"
    STOP_UNCONFIRMED = "stop unconfirmed"
    ENDED = "ended"  #: Before all moves were made; the text has the cause


@dataclass(frozen=True, slots=True)
class CellEvent:
    """One event of the cell."""

    time_ns: int  #: time of the SYNC before it [ns since 1970]
    axis: int | None  #: index of the axis from 0, or None for the whole cell
    kind: EventKind  #: of the event
    #: By kind: EMCY error code, NMT state, statusword, identifier of a frame, number of the move or
    #: of the cycle, bits of the controller's state, number of frames, index of an object that is
    #: not logged any more.
    code: int
    text: str  #: for the operator


EventSink = Callable[[CellEvent], None]
"""Receives events in the order in which they happen,
before the sample of their cycle is returned.
"""


class Quantity(Enum):
    """Quantity of a slow reading."""

    TORQUE = "torque"  #: the drive's own torque, at the motor [Nm]
    TEMPERATURE = "temperature"  #: of the motor or the drive [°C]


@dataclass(frozen=True, slots=True)
class SlowReading:
    """Value that is read a few times a second, alongside the samples."""

    time_ns: int  #: on the clock of the samples [ns since 1970]
    axis: int  #: index of the axis from 0
    quantity: Quantity
    value: float  #: in the unit of the quantity
