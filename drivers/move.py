"""Moves, limits and the permission to move; synchronised trapezoidal profiles. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import MotionRefused

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """Limits of one motor in its drive's counts:
    range of its targets, largest velocity and acceleration.
    """

    position_min_counts: int
    position_max_counts: int
    velocity_counts_s: float
    acceleration_counts_s2: float


@dataclass(frozen=True, slots=True)
class Move:
    """One synchronised point-to-point move in profile position mode;
    an axis that does not move gets no profile.
    """

    target_counts: tuple[int, ...]  #: absolute, of each axis
    velocity_counts_s: tuple[int, ...]  #: profile of each axis (6081h)
    acceleration_counts_s2: tuple[int, ...]  #: profile of each axis (6083h and 6084h)
    dwell_cycles: int = 0  #: samples to wait at the target

    def duration_s(self, start_counts: Sequence[int]) -> tuple[float, ...]:
        """Return the time that each axis needs from these positions."""
        return tuple(
            self.path(axis, start).duration_s if self.target_counts[axis] != start else 0.0
            for axis, start in enumerate(start_counts)
        )

    def path(self, axis: int, start_counts: int) -> Trapezoid:
        """Return the way of one axis from a position, with the profile's whole numbers [counts]."""
        start, end, velocity, acceleration = (
            np.array([float(number)])
            for number in (
                start_counts,
                self.target_counts[axis],
                self.velocity_counts_s[axis],
                self.acceleration_counts_s2[axis],
            )
        )
        return synchronised(start, end, velocity, acceleration)


@dataclass(frozen=True, slots=True)
class MotionPermission:
    """Permission to move these axes now, within limits; without it nothing moves."""

    granted_by: str  #: operator or policy that takes the responsibility; it is logged
    limits: tuple[AxisLimits, ...]  #: one for each axis


def synchronised_move(
    start_counts: Sequence[int],
    target_counts: Sequence[int],
    limits: Sequence[AxisLimits],
    dwell_cycles: int = 0,
) -> Move:
    """Return the fastest move within the limits in which all axes start and end together.

    Drives accept whole numbers only. The velocity is rounded up and the acceleration then chosen
    for the common duration, so that the end times differ only by its rounding, on the ramp alone.

    Raises:
        ValueError: a limit is not above 2 counts/s or counts/s².
    """
    start = np.asarray(start_counts, dtype=np.float64)
    target = np.asarray(target_counts, dtype=np.float64)
    # One count less than allowed leaves room for rounding up.
    path = synchronised(
        start,
        target,
        np.array([limit.velocity_counts_s - 1.0 for limit in limits]),
        np.array([limit.acceleration_counts_s2 - 1.0 for limit in limits]),
    )
    velocities = []
    accelerations = []
    for distance, speed in zip(np.abs(target - start), np.abs(path.velocity), strict=True):
        velocity = max(1, math.ceil(speed))
        ramp_s = path.duration_s - distance / velocity
        velocities.append(velocity)
        accelerations.append(max(1, round(velocity / ramp_s)) if distance > 0 else 1)
    return Move(
        tuple(map(int, target_counts)), tuple(velocities), tuple(accelerations), dwell_cycles
    )


def check_moves(
    start_counts: Sequence[int],
    moves: Sequence[Move],
    permission: MotionPermission,
    names: Sequence[str],
) -> None:
    """Check all moves against the permission before anything moves.

    Raises:
        MotionRefused: names the axis, the requested value and the allowed one.
    """
    if not permission.granted_by.strip():
        raise MotionRefused("the permission names no operator: set granted_by")
    if len(permission.limits) != len(names):
        raise MotionRefused(
            f"the permission has limits for {len(permission.limits)} axes, the cell has "
            f"{len(names)}"
        )

    def check_positions(event: str, positions: Sequence[int]) -> None:
        for name, position, limit in zip(names, positions, permission.limits, strict=True):
            if not limit.position_min_counts <= position <= limit.position_max_counts:
                allowed = f"{limit.position_min_counts} to {limit.position_max_counts} counts"
                raise MotionRefused(f"{name}: {event} {position} counts, allowed is {allowed}")

    check_positions("starts at", start_counts)
    here = tuple(start_counts)
    for number, move in enumerate(moves):
        where = f"move {number}"
        profiles = (move.target_counts, move.velocity_counts_s, move.acceleration_counts_s2)
        if any(len(column) != len(names) for column in profiles):
            raise MotionRefused(
                f"{where}: has {tuple(map(len, profiles))} values, the cell has {len(names)} axes"
            )
        if move.dwell_cycles < 0:
            raise MotionRefused(f"{where}: dwells for {move.dwell_cycles} cycles")
        check_positions(f"{where} goes to", move.target_counts)
        for axis, limit in enumerate(permission.limits):
            if move.target_counts[axis] == here[axis]:
                continue
            for quantity, value, allowed in (
                ("velocity", move.velocity_counts_s[axis], limit.velocity_counts_s),
                ("acceleration", move.acceleration_counts_s2[axis], limit.acceleration_counts_s2),
            ):
                if not 0 < value <= allowed:
                    raise MotionRefused(
                        f"{where}: {names[axis]}: {quantity} {value}, allowed is above 0 up to "
                        f"{allowed:g}"
                    )
        here = move.target_counts


@dataclass(frozen=True, slots=True)
class Trapezoid:
    """One move of n axes with a trapezoidal velocity profile.

    Every axis accelerates for ``ramp_s``, cruises, and decelerates for ``ramp_s``; because the
    ramps are shared, any linear combination of axes (a coupled motor) moves on a trapezoid of the
    same times.
    """

    start: FloatArray  #: first position [any unit], shape (n,)
    end: FloatArray  #: last position [any unit], shape (n,)
    duration_s: float  #: from start to end [s]
    ramp_s: float  #: of acceleration, and of deceleration [s]

    @property
    def velocity(self) -> FloatArray:
        """Signed cruise velocity of each axis [unit/s], shape (n,)."""
        cruise_s = self.duration_s - self.ramp_s
        if cruise_s > 0:
            return (self.end - self.start) / cruise_s
        return np.zeros_like(self.start)

    @property
    def acceleration(self) -> FloatArray:
        """Signed acceleration of the first ramp of each axis [unit/s²], shape (n,)."""
        if self.ramp_s > 0:
            return self.velocity / self.ramp_s
        return np.zeros_like(self.start)

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position, velocity and acceleration at the given times, each of shape (len(time_s),
        n).
        """
        t = np.clip(np.asarray(time_s, dtype=np.float64), 0.0, self.duration_s)[:, None]
        rising = np.minimum(t, self.ramp_s)
        falling = np.maximum(t - (self.duration_s - self.ramp_s), 0.0)
        acceleration = self.acceleration
        velocity = self.velocity
        distance = (
            0.5 * acceleration * rising**2
            + velocity * (t - rising)
            - 0.5 * acceleration * falling**2
        )
        speed = acceleration * (rising - falling)
        inside = (np.asarray(time_s)[:, None] >= 0.0) & (
            np.asarray(time_s)[:, None] < self.duration_s
        )
        phase = np.where(t < self.ramp_s, 1.0, 0.0) - np.where(
            t > self.duration_s - self.ramp_s, 1.0, 0.0
        )
        return (
            self.start + distance,
            np.where(inside, speed, 0.0),
            np.where(inside, acceleration * phase, 0.0),
        )


def synchronised(
    start: FloatArray, end: FloatArray, velocity_limit: FloatArray, acceleration_limit: FloatArray
) -> Trapezoid:
    """Return the fastest trapezoid within the limits of every axis in which all axes end together.

    Args:
        start, end: positions, shape (n,).
        velocity_limit, acceleration_limit: positive limits in the same unit per s and s², shape
            (n,).

    Raises:
        ValueError: a limit is not positive.
    """
    limits = np.array([velocity_limit, acceleration_limit], dtype=np.float64)
    if np.any(limits <= 0):
        raise ValueError(
            f"limits must be positive, found {velocity_limit!r} and {acceleration_limit!r}"
        )
    start = np.asarray(start, dtype=np.float64)
    end = np.asarray(end, dtype=np.float64)
    distance = np.abs(end - start)
    moving = distance > 0
    if not moving.any():
        return Trapezoid(start, end, 0.0, 0.0)
    # Normalised to the path 0..1, the slowest axis in velocity and in acceleration decides for all.
    rate, ramp_rate = np.min(limits[:, moving] / distance[moving], axis=1).tolist()
    ramp_s = min(rate / ramp_rate, ramp_rate**-0.5)
    cruise_s = 1.0 / (ramp_rate * ramp_s)
    return Trapezoid(start, end, cruise_s + ramp_s, ramp_s)
