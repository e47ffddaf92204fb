"""Moments at which the machine stood still during a test, by `tests.vcan.host_watch`.

A process of the highest priority sleeps for 2.5 ms again and again. Where it wakes late, nothing
else on that processor ran in time either, whatever the recorder does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tests.vcan.host_watch import Tick

STALL_S = 0.005
"""A quarter of the shortest period of these tests; longer delays make answers late in a guest."""
LONGEST_RECORDING_S = 20.0


@dataclass(frozen=True, slots=True)
class HostStalls:
    """Stalls of the machine during a test.

    Attributes:
        count: number of times that the machine stood still for `STALL_S` or longer.
        longest_s: the longest of these times; 0 without any.
        lasted_s: how long the test took.
    """

    count: int
    longest_s: float
    lasted_s: float

    @property
    def excuse_a_failure(self) -> bool:
        """Whether there was one for each recording: then none could be complete."""
        recordings = max(1.0, self.lasted_s / LONGEST_RECORDING_S)
        return self.count >= recordings

    def __str__(self) -> str:
        return (
            f"the machine stood still {self.count} times in {self.lasted_s:.0f} s, "
            f"for {1e3 * self.longest_s:.0f} ms at most"
        )


def stalls_between(ticks: Sequence[Tick], begin_s: float, end_s: float) -> HostStalls:
    """Return the stalls between two moments.

    Args:
        ticks: of the watch.
        begin_s, end_s: wall time [s since 1970].
    """
    late_s = []
    for tick in ticks:
        tick_s = 1e-9 * tick.time_ns
        tick_late_s = 1e-9 * tick.late_ns
        if begin_s <= tick_s <= end_s and tick_late_s >= STALL_S:
            late_s.append(tick_late_s)
    return HostStalls(len(late_s), max(late_s, default=0.0), end_s - begin_s)
