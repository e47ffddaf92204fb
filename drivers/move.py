"""What an axis is asked to do, and what it may do: moves, limits, permission. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.errors import MotionRefused
from drivers.trapezoid import synchronised


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """What one motor may do, in its drive's counts.

    Attributes:
        position_min_counts, position_max_counts: where its targets may be.
        velocity_counts_s, acceleration_counts_s2: not to be exceeded.
    """

    position_min_counts: int
    position_max_counts: int
    velocity_counts_s: float
    acceleration_counts_s2: float


@dataclass(frozen=True, slots=True)
class Move:
    """One synchronised point-to-point move in profile position mode.

    Attributes:
        target_counts: absolute, of each axis.
        velocity_counts_s, acceleration_counts_s2: profile of each axis (6081h; 6083h and 6084h); of an axis that stays
            where it is they are not sent.
        dwell_cycles: samples to wait at the target.
    """

    target_counts: tuple[int, ...]
    velocity_counts_s: tuple[int, ...]
    acceleration_counts_s2: tuple[int, ...]
    dwell_cycles: int = 0

    def duration_s(self, start_counts: Sequence[int]) -> tuple[float, ...]:
        """How long each axis moves from these positions, with the profile's whole numbers."""
        return tuple(
            trapezoid_duration_s(abs(target - start), velocity, acceleration) if target != start else 0.0
            for start, target, velocity, acceleration in zip(
                start_counts, self.target_counts, self.velocity_counts_s, self.acceleration_counts_s2, strict=True
            )
        )


@dataclass(frozen=True, slots=True)
class MotionPermission:
    """Somebody's word that these axes may move now, and how far; without it nothing moves.

    Attributes:
        granted_by: the person or the policy that takes the responsibility; it is logged.
        limits: one for each axis.
    """

    granted_by: str
    limits: tuple[AxisLimits, ...]


def trapezoid_duration_s(distance_counts: float, velocity_counts_s: float, acceleration_counts_s2: float) -> float:
    """Duration of a trapezoid, or of the triangle that it is when the velocity is not reached [s]."""
    if distance_counts * acceleration_counts_s2 < velocity_counts_s**2:
        return 2.0 * math.sqrt(distance_counts / acceleration_counts_s2)
    return distance_counts / velocity_counts_s + velocity_counts_s / acceleration_counts_s2


def synchronised_move(
    start_counts: Sequence[int], target_counts: Sequence[int], limits: Sequence[AxisLimits], dwell_cycles: int = 0
) -> Move:
    """The fastest move within the limits in which all axes start and end together.

    The drives take whole numbers. The velocity is rounded up and the acceleration then chosen for the common duration,
    so only its rounding, on the ramp alone, is left as a difference of the end times.

    Raises:
        ValueError: a limit is not above 2 counts/s or counts/s².
    """
    start, target = np.asarray(start_counts, dtype=np.float64), np.asarray(target_counts, dtype=np.float64)
    # One count less than allowed leaves room for rounding up.
    path = synchronised(
        start,
        target,
        np.array([limit.velocity_counts_s - 1.0 for limit in limits]),
        np.array([limit.acceleration_counts_s2 - 1.0 for limit in limits]),
    )
    velocities, accelerations = [], []
    for distance, speed in zip(np.abs(target - start), np.abs(path.velocity), strict=True):
        velocity = max(1, math.ceil(speed))
        ramp_s = path.duration_s - distance / velocity
        velocities.append(velocity)
        accelerations.append(max(1, round(velocity / ramp_s)) if distance > 0 else 1)
    return Move(tuple(map(int, target_counts)), tuple(velocities), tuple(accelerations), dwell_cycles)


def check_moves(
    start_counts: Sequence[int], moves: Sequence[Move], permission: MotionPermission, names: Sequence[str]
) -> None:
    """Refuse everything outside of the permission before anything moves.

    Raises:
        MotionRefused: names the axis, what was asked for and what is allowed.
    """
    if not permission.granted_by.strip():
        raise MotionRefused("the permission does not say who granted it")
    if len(permission.limits) != len(names):
        raise MotionRefused(f"the permission has limits for {len(permission.limits)} axes, the cell has {len(names)}")
    _check_positions("starts at", start_counts, permission, names)
    here = tuple(start_counts)
    for number, move in enumerate(moves):
        where = f"move {number}"
        profiles = (move.target_counts, move.velocity_counts_s, move.acceleration_counts_s2)
        if any(len(column) != len(names) for column in profiles):
            raise MotionRefused(f"{where}: has {tuple(map(len, profiles))} values, the cell has {len(names)} axes")
        if move.dwell_cycles < 0:
            raise MotionRefused(f"{where}: dwells for {move.dwell_cycles} cycles")
        _check_positions(f"{where} goes to", move.target_counts, permission, names)
        for axis, limit in enumerate(permission.limits):
            if move.target_counts[axis] == here[axis]:
                continue
            for what, value, allowed in (
                ("velocity", move.velocity_counts_s[axis], limit.velocity_counts_s),
                ("acceleration", move.acceleration_counts_s2[axis], limit.acceleration_counts_s2),
            ):
                if not 0 < value <= allowed:
                    raise MotionRefused(f"{where}: {names[axis]}: {what} {value}, allowed is above 0 up to {allowed:g}")
        here = move.target_counts


def _check_positions(what: str, positions: Sequence[int], permission: MotionPermission, names: Sequence[str]) -> None:
    for name, position, limit in zip(names, positions, permission.limits, strict=True):
        if not limit.position_min_counts <= position <= limit.position_max_counts:
            allowed = f"{limit.position_min_counts} to {limit.position_max_counts} counts"
            raise MotionRefused(f"{name}: {what} {position} counts, allowed is {allowed}")
