"""One plant on several buses: which SYNCs belong to one cycle."""

from __future__ import annotations

PATIENCE = 3
"""SYNCs that may wait for another bus's: a busy machine hands on some of one bus before those of the other."""

Cycles = tuple[frozenset[int], ...]
"""Cycles to run now, each by the buses whose nodes take part in it."""


class SyncGate:
    """Pairs the SYNCs of the buses in their order: a cycle begins when every bus has brought one.

    A bus that brings none is left out, when too many of another bus wait for it, or when the cell's own patience ends
    (``close``). Its next SYNC comes too late for a cycle of its own: its nodes answer it, time does not move, and the
    bus is waited for again.

    Args:
        buses: their number.
    """

    def __init__(self, buses: int) -> None:
        self._waiting = [0] * buses
        self._absent: frozenset[int] = frozenset()

    @property
    def open(self) -> bool:
        """Whether a cycle waits for SYNCs."""
        return any(self._waiting)

    def late(self, bus: int) -> bool:
        """Whether a SYNC on this bus belongs to a cycle that was run without it."""
        if bus not in self._absent:
            return False
        self._absent -= {bus}
        return True

    def arrive(self, bus: int) -> Cycles:
        """A SYNC that is not late."""
        self._waiting[bus] += 1
        return self.close() if self._waiting[bus] > PATIENCE else self._complete()

    def close(self) -> Cycles:
        """Wait no longer for the buses that bring no SYNC."""
        self._absent |= {bus for bus, count in enumerate(self._waiting) if not count}
        return self._complete()

    def _complete(self) -> Cycles:
        present = frozenset(range(len(self._waiting))) - self._absent
        cycles = min((self._waiting[bus] for bus in present), default=0)
        for bus in present:
            self._waiting[bus] -= cycles
        return (present,) * cycles
