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
        durations_s = []
        for axis, start in enumerate(start_counts):
            if self.target_counts[axis] == start:
                durations_s.append(0.0)
            else:
                durations_s.append(self.path(axis, start).duration_s)
        return tuple(durations_s)

    def path(self, axis: int, start_counts: int) -> Trapezoid:
        """Return the way of one axis from a position, with the profile's whole numbers [counts]."""
        start = np.array([float(start_counts)])
        end = np.array([float(self.target_counts[axis])])
        velocity = np.array([float(self.velocity_counts_s[axis])])
        acceleration = np.array([float(self.acceleration_counts_s2[axis])])
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
        ValueError: a limit is not above 1 count/s or count/s²; it shows the limits less 1.
    """
    start = np.asarray(start_counts, dtype=np.float64)
    target = np.asarray(target_counts, dtype=np.float64)
    # One count less than allowed leaves room for rounding up.
    velocity_limit = [limit.velocity_counts_s - 1.0 for limit in limits]
    acceleration_limit = [limit.acceleration_counts_s2 - 1.0 for limit in limits]
    path = synchronised(start, target, np.array(velocity_limit), np.array(acceleration_limit))
    distances = np.abs(target - start)
    speeds = np.abs(path.velocity)
    velocities = []
    accelerations = []
    for distance, speed in zip(distances, speeds, strict=True):
        velocity = max(1, math.ceil(speed))
        acceleration = 1
        if distance > 0:
            ramp_s = path.duration_s - distance / velocity
            acceleration = max(1, round(velocity / ramp_s))
        velocities.append(velocity)
        accelerations.append(acceleration)
    return Move(
        target_counts=tuple(map(int, target_counts)),
        velocity_counts_s=tuple(velocities),
        acceleration_counts_s2=tuple(accelerations),
        dwell_cycles=dwell_cycles,
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
            lengths = tuple(map(len, profiles))
            raise MotionRefused(f"{where}: has {lengths} values, the cell has {len(names)} axes")
        if move.dwell_cycles < 0:
            raise MotionRefused(f"{where}: dwells for {move.dwell_cycles} cycles")
        check_positions(f"{where} goes to", move.target_counts)
        for axis, limit in enumerate(permission.limits):
            if move.target_counts[axis] == here[axis]:
                continue
            subject = f"{where}: {names[axis]}"
            velocity = move.velocity_counts_s[axis]
            acceleration = move.acceleration_counts_s2[axis]
            _require_allowed(f"{subject}: velocity", velocity, limit.velocity_counts_s)
            _require_allowed(f"{subject}: acceleration", acceleration, limit.acceleration_counts_s2)
        here = move.target_counts


def _require_allowed(quantity: str, value: int, allowed: float) -> None:
    """Refuse a velocity or an acceleration beyond its limit.

    Raises:
        MotionRefused: it is, or it is not above zero.
    """
    if not 0 < value <= allowed:
        raise MotionRefused(f"{quantity} {value}, allowed is above 0 up to {allowed:g}")


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
        """Return position, velocity and acceleration at the given times, shape (k, n) each."""
        asked_s = np.asarray(time_s, dtype=np.float64)[:, None]
        t = np.clip(asked_s, 0.0, self.duration_s)
        fall_s = self.duration_s - self.ramp_s
        rising = np.minimum(t, self.ramp_s)
        falling = np.maximum(t - fall_s, 0.0)
        acceleration = self.acceleration
        velocity = self.velocity
        # q − q₀ = ½ a t_r² + v (t − t_r) − ½ a t_f²
        rise = 0.5 * acceleration * rising**2
        fall = 0.5 * acceleration * falling**2
        distance = rise + velocity * (t - rising) - fall
        speed = acceleration * (rising - falling)
        is_moving = (asked_s >= 0.0) & (asked_s < self.duration_s)
        is_rising = np.where(t < self.ramp_s, 1.0, 0.0)
        is_falling = np.where(t > fall_s, 1.0, 0.0)
        phase = is_rising - is_falling
        position = self.start + distance
        velocity_now = np.where(is_moving, speed, 0.0)
        acceleration_now = np.where(is_moving, acceleration * phase, 0.0)
        return position, velocity_now, acceleration_now


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
    rates = limits[:, moving] / distance[moving]
    rate, ramp_rate = np.min(rates, axis=1).tolist()
    ramp_s = min(rate / ramp_rate, ramp_rate**-0.5)
    cruise_s = 1.0 / (ramp_rate * ramp_s)
    return Trapezoid(start, end, cruise_s + ramp_s, ramp_s)
