"""The set-point of profile position mode: a trapezoid of velocity from wherever the axis is (CiA 402-2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

SEGMENTS = 4
"""A stop, an acceleration, a cruise and a deceleration are the most that one move needs."""


@dataclass(frozen=True, slots=True)
class ProfileMove:
    """Pieces of constant acceleration, in the drive's units.

    Attributes:
        duration_s: of each piece, SEGMENTS long; unused ones are zero.
        acceleration: in each piece [counts/s²], signed.
        target: where the move ends [counts].
    """

    duration_s: tuple[float, ...]
    acceleration: tuple[float, ...]
    target: float


def plan(
    start: float, velocity: float, target: float, speed: float, acceleration: float, deceleration: float
) -> ProfileMove:
    """The fastest trapezoid to a target.

    Args:
        start: position set-point [counts].
        velocity: of the set-point, signed [counts/s].
        target: [counts].
        speed, acceleration, deceleration: profile velocity 6081h, 6083h and 6084h, all positive.
    """
    pieces: list[tuple[float, float]] = []
    if velocity != 0.0:
        stop_s = abs(velocity) / deceleration
        stop = start + 0.5 * velocity * stop_s
        if velocity * (target - stop) < 0.0:
            # It cannot stop before the target, or runs the other way: stop, then go back from rest.
            pieces.append((stop_s, math.copysign(deceleration, -velocity)))
            start, velocity = stop, 0.0
    sign = math.copysign(1.0, target - start)
    distance, moving = abs(target - start), abs(velocity)
    if moving > speed:
        slow_s = (moving - speed) / deceleration
        pieces.append((slow_s, -sign * deceleration))
        distance -= 0.5 * (moving + speed) * slow_s
        moving = speed
    # Distance of accelerating from `moving` to the peak p and stopping: (p² − moving²) / 2a + p² / 2d.
    peak_squared = (2.0 * distance + moving**2 / acceleration) / (1.0 / acceleration + 1.0 / deceleration)
    peak = max(moving, min(speed, math.sqrt(max(peak_squared, 0.0))))
    pieces.append(((peak - moving) / acceleration, sign * acceleration))
    ramps = (peak**2 - moving**2) / (2.0 * acceleration) + peak**2 / (2.0 * deceleration)
    if peak > 0.0:
        pieces.append((max(distance - ramps, 0.0) / peak, 0.0))
        pieces.append((peak / deceleration, -sign * deceleration))
    return _padded(pieces, target)


def ramp_down(start: float, velocity: float, deceleration: float) -> ProfileMove:
    """Stop on a ramp.

    Args:
        start: position set-point [counts].
        velocity: of the set-point, signed [counts/s].
        deceleration: positive [counts/s²].
    """
    stop_s = abs(velocity) / deceleration
    return _padded([(stop_s, math.copysign(deceleration, -velocity))], start + 0.5 * velocity * stop_s)


def _padded(pieces: list[tuple[float, float]], target: float) -> ProfileMove:
    used = [piece for piece in pieces if piece[0] > 0.0]
    used += [(0.0, 0.0)] * (SEGMENTS - len(used))
    return ProfileMove(tuple(p[0] for p in used), tuple(p[1] for p in used), target)
