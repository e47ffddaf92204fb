"""Frozen data: an axis that is told to move while neither its position nor its current changes by one count, and, where
an amplifier has a toggle bit, an amplifier that sends its last values again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from drivers.axis import Axis
from drivers.errors import DataStale
from drivers.move import Move
from drivers.sample import Sample

FROZEN_S = 0.05
"""Exactly equal values for so long, in the time of the samples. A loop that fights friction changes its current at
once, and a current that is measured has noise."""
FROZEN_COUNTS = 64
"""Way that the set-point must have gone meanwhile: one that creeps or has just begun proves nothing."""


def way_counts(distance_counts: float, velocity_counts_s: float, acceleration_counts_s2: float, time_s: float) -> float:
    """Way of a symmetric trapezoid from rest after a time, or of the triangle that it is [counts]."""
    velocity = min(velocity_counts_s, math.sqrt(distance_counts * acceleration_counts_s2))
    ramp_s = velocity / acceleration_counts_s2
    duration_s = distance_counts / velocity + ramp_s
    time_s = min(max(time_s, 0.0), duration_s)
    rising, falling = min(time_s, ramp_s), max(time_s - (duration_s - ramp_s), 0.0)
    return (
        velocity * time_s
        - 0.5 * velocity * ramp_s
        + 0.5 * acceleration_counts_s2 * ((ramp_s - rising) ** 2 - falling**2)
    )


class FrozenData:
    """Looks at the samples of one move; made when the set-points go out.

    Args:
        move: that the axes make.
        start_counts: from where.
        axes: that have a way to go.
        period_ns: of the samples.
    """

    def __init__(self, move: Move, start_counts: Sequence[int], axes: Sequence[int], period_ns: int) -> None:
        self._profiles = {
            axis: (
                float(abs(move.target_counts[axis] - start_counts[axis])),
                float(move.velocity_counts_s[axis]),
                float(move.acceleration_counts_s2[axis]),
            )
            for axis in axes
        }
        self._period_s = period_ns * 1e-9
        self._begin: int | None = None
        self._last: dict[int, tuple[int, int, int]] = {}

    def frozen(self, sample: Sample) -> tuple[int, ...]:
        """Axes whose values have been equal for longer than any that moves can be; give it every sample once."""
        if self._begin is None:
            self._begin = sample.cycle
        found = []
        for axis, profile in self._profiles.items():
            values = (sample.position_counts[axis], sample.current_raw[axis])
            last = self._last.get(axis)
            if last is None or last[:2] != values or sample.missing >> axis & 1:
                self._last[axis] = (*values, sample.cycle)
                continue
            since_s, now_s = ((cycle - self._begin) * self._period_s for cycle in (last[2], sample.cycle))
            if now_s - since_s >= FROZEN_S and way_counts(*profile, now_s) - way_counts(*profile, since_s) >= (
                FROZEN_COUNTS
            ):
                found.append(axis)
        return tuple(found)


STALE_PERIODS = 2
"""Of the amplifier's own, and SYNCs, in which its toggle bit stands: less may be its timer against ours."""


class ToggleBits:
    """Looks at the toggle bits of all axes that have one, in every cycle.

    Args:
        axes: of the cell.
    """

    def __init__(self, axes: Sequence[Axis]) -> None:
        self._bits = tuple(
            (number, axis.node_id, axis.profile.toggle_bit, STALE_PERIODS * 1000 * axis.profile.update_period_us)
            for number, axis in enumerate(axes)
            if axis.profile.toggle_bit is not None
        )
        # Of each axis: the bit, when it was first seen so, cycles since, whether that was told.
        self._last: dict[int, tuple[int, int, int, bool]] = {}

    def __bool__(self) -> bool:
        return bool(self._bits)

    def stale(self, time_ns: int, statuswords: Sequence[int], missing: int) -> Iterator[tuple[int, DataStale]]:
        """Axes whose bit has stood for too long, each once until it changes again; to be asked in every cycle.

        Args:
            time_ns: of the samples.
            statuswords: of all axes.
            missing: bit i is set when axis i did not answer; what it sent meanwhile is not known, so it begins anew.
        """
        for axis, node_id, bit, allowed_ns in self._bits:
            if missing >> axis & 1:
                self._last.pop(axis, None)
                continue
            value = statuswords[axis] >> bit & 1
            before, since_ns, cycles, told = self._last.get(axis, (-1, 0, 0, False))
            if value != before:
                self._last[axis] = (value, time_ns, 0, False)
                continue
            stale = cycles + 1 >= STALE_PERIODS and time_ns - since_ns >= allowed_ns
            self._last[axis] = (value, since_ns, cycles + 1, told or stale)
            if stale and not told:
                yield axis, DataStale(node_id, bit, (time_ns - since_ns) * 1e-9, cycles + 1)
