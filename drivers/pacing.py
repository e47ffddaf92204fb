"""When the next SYNC goes out, and what time it stands for."""

from __future__ import annotations

import time
from dataclasses import dataclass

from drivers.sdo import Clock


@dataclass(frozen=True, slots=True)
class LockstepSync:
    """The next SYNC goes out when the last one is answered: for a cell whose time is the SYNC itself.

    Attributes:
        period_ns: what one cycle stands for [ns].
        timeout_s: how long one cycle waits for its answers [s of the clock].
        start_ns: time of cycle 0 [ns].
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
        clock: whose time the samples carry [ns].
    """

    period_ns: int
    clock: Clock = time.monotonic_ns


Pacing = LockstepSync | TimedSync
