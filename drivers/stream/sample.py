"""One SYNC cycle of a cell, as the amplifiers sent it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum


@dataclass(frozen=True, slots=True)
class Sample:
    """What all axes reported for one SYNC.

    Raw counts, converted late: the gain is what is being identified, so no assumed gain is baked into data.

    Attributes:
        cycle: number of the sampling period since the stream began; a period that had no SYNC leaves a gap.
        time_ns: time of the SYNC, not of the frames that answered it: wall time at the stream's first SYNC plus the
            monotonic time since [ns since 1970].
        position_counts: motor-side position of each axis [encoder counts].
        current_raw: signal of the current loop of each axis [unit of the drive profile's current object].
        statusword: CiA 402 object 6041h of each axis.
        missing: bit i is set when axis i did not answer this SYNC; its values then repeat the last known ones.
    """

    cycle: int
    time_ns: int
    position_counts: tuple[int, ...]
    current_raw: tuple[int, ...]
    statusword: tuple[int, ...]
    missing: int = 0


# What happens in a cell besides samples.


class EventKind(Enum):
    """What a CellEvent tells; its code says more."""

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
    ENDED = "ended"
    """Early, before the moves were made; the text says by what."""


@dataclass(frozen=True, slots=True)
class CellEvent:
    """One event of the cell.

    Attributes:
        time_ns: in the time of the samples [ns since 1970]: that of the SYNC it came after.
        axis: index of the axis from 0, or None when it concerns the whole cell.
        kind: what happened.
        code: EMCY error code, NMT state, statusword, identifier of a frame, number of the move or of the cycle, bits of
            the controller's state, number of frames, by kind.
        text: for a person.
    """

    time_ns: int
    axis: int | None
    kind: EventKind
    code: int
    text: str


EventSink = Callable[[CellEvent], None]
"""Receives events in the order in which they happen, before the sample of their cycle is handed out."""


def ignore_event(event: CellEvent) -> None:
    """An EventSink for those who want samples alone."""
