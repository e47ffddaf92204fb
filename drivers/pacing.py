"""When the next SYNC goes out, and what time it stands for.

Samples and events of all pacings have one epoch: wall time [ns since 1970] at the stream's first SYNC, plus the time
that has passed since, which no setting of the wall clock changes. On SocketCAN a SYNC's time is the kernel's, taken to
the monotonic clock (drivers/capture.py); the clock must then be that one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from drivers.sdo import Clock


@dataclass(frozen=True, slots=True)
class LockstepSync:
    """The next SYNC goes out when the last one is answered: for a cell whose time is the SYNC itself.

    The samples' time is made up, a period a cycle: that is true of a simulated cell alone.

    Attributes:
        period_ns: what one cycle stands for [ns].
        timeout_s: how long one cycle waits for its answers [s of the clock].
        start_ns: wall time of cycle 0 [ns since 1970].
        clock: for the time-out and the heartbeats [ns].
    """

    period_ns: int
    timeout_s: float = 1.0
    start_ns: int = 0
    clock: Clock = time.monotonic_ns


@dataclass(frozen=True, slots=True)
class TimedSync:
    """A SYNC every period by the clock, on an absolute schedule that starts with the first one.

    A schedule that slips by whole periods leaves them out, counted; it never sends a burst to catch up.

    Attributes:
        period_ns: of the schedule [ns].
        start_ns: wall time of the first SYNC [ns since 1970].
        clock: monotonic; what has passed by it since the first SYNC is added to start_ns [ns].
    """

    period_ns: int
    start_ns: int = 0
    clock: Clock = time.monotonic_ns


def ignore(monotonic_ns: int, periods: int) -> None:
    """For a producer that keeps its period by itself."""


@dataclass(frozen=True, slots=True)
class FollowedSync:
    """Somebody else sends SYNC, told so by us (drivers/producer.py): a cycle begins with each one that is seen.

    What belongs to which cycle is decided by the order of the frames on the bus: a reader that is late loses nothing.

    Attributes:
        period_ns: of the producer [ns].
        producer: its name, for messages.
        in_kernel: the producer is this machine's kernel; a SYNC from the wire is then somebody else's.
        timeout_s: without a SYNC, whatever else is on the bus, after which the producer is taken for dead; the stream
            then sends SYNC itself, because the axes are stopped by frames that act on SYNC.
        seen: told the monotonic time of each SYNC [ns], and how many periods after the one before it came.
        start_ns: wall time of the first SYNC [ns since 1970].
        clock: monotonic; what has passed by it since the first SYNC is added to start_ns [ns].
    """

    period_ns: int
    producer: str
    in_kernel: bool = False
    timeout_s: float = 0.1
    seen: Callable[[int, int], None] = ignore
    start_ns: int = 0
    clock: Clock = time.monotonic_ns


Pacing = LockstepSync | TimedSync | FollowedSync
