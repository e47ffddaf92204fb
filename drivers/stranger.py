"""Whether more SYNCs come than the one producer sends that we know of."""

from __future__ import annotations

SURPLUS = 3.0
"""SYNCs ahead of the period: what a late producer catches up with is one or two."""
DECAY = 0.99
"""Of what a SYNC was ahead, after the next: clocks differ by some tens of ppm for ever, which adds up to nothing so."""


class SyncRate:
    """Followed SYNCs against their period.

    A SYNC of somebody else looks like the producer's own; but then too many come. Jitter cancels out: who comes late
    once comes early after it.

    Args:
        period_ns: of the producer [ns].
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ahead = 0.0

    def too_fast(self, since_last_ns: int) -> bool:
        """Whether this SYNC, so long after the one before, is one too many."""
        self._ahead = max(-1.0, DECAY * self._ahead + 1.0 - since_last_ns / self._period_ns)
        return self._ahead > SURPLUS
