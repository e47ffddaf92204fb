"""Synchronised trapezoidal point-to-point moves: all axes start and end together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Trapezoid:
    """One move of n axes with a trapezoidal velocity profile.

    Every axis accelerates for ``ramp_s``, cruises, and decelerates for ``ramp_s``; because the ramps are shared, any
    linear combination of axes (a coupled motor) moves on a trapezoid of the same times.

    Attributes:
        start, end: positions [any unit], shape (n,).
        duration_s: from start to end [s].
        ramp_s: of acceleration, and of deceleration [s].
    """

    start: FloatArray
    end: FloatArray
    duration_s: float
    ramp_s: float

    @property
    def velocity(self) -> FloatArray:
        """Signed cruise velocity of each axis [unit/s], shape (n,)."""
        cruise_s = self.duration_s - self.ramp_s
        return (self.end - self.start) / cruise_s if cruise_s > 0 else np.zeros_like(self.start)

    @property
    def acceleration(self) -> FloatArray:
        """Signed acceleration of the first ramp of each axis [unit/s²], shape (n,)."""
        return self.velocity / self.ramp_s if self.ramp_s > 0 else np.zeros_like(self.start)

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position, velocity and acceleration at the given times, each of shape (len(time_s), n)."""
        t = np.clip(np.asarray(time_s, dtype=np.float64), 0.0, self.duration_s)[:, None]
        rising = np.minimum(t, self.ramp_s)
        falling = np.maximum(t - (self.duration_s - self.ramp_s), 0.0)
        acceleration, velocity = self.acceleration, self.velocity
        distance = 0.5 * acceleration * rising**2 + velocity * (t - rising) - 0.5 * acceleration * falling**2
        speed = acceleration * (rising - falling)
        inside = (np.asarray(time_s)[:, None] >= 0.0) & (np.asarray(time_s)[:, None] < self.duration_s)
        phase = np.where(t < self.ramp_s, 1.0, 0.0) - np.where(t > self.duration_s - self.ramp_s, 1.0, 0.0)
        return self.start + distance, np.where(inside, speed, 0.0), np.where(inside, acceleration * phase, 0.0)


def synchronised(
    start: FloatArray,
    end: FloatArray,
    velocity_limit: FloatArray,
    acceleration_limit: FloatArray,
) -> Trapezoid:
    """The fastest trapezoid that keeps every axis within its limits and lets all axes end together.

    Args:
        start, end: positions, shape (n,).
        velocity_limit, acceleration_limit: positive limits in the same unit per s and s², shape (n,).

    Raises:
        ValueError: a limit is not positive.
    """
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    if np.any(np.asarray(velocity_limit) <= 0) or np.any(np.asarray(acceleration_limit) <= 0):
        raise ValueError(f"limits must be positive, found {velocity_limit!r} and {acceleration_limit!r}")
    distance = np.abs(end - start)
    if not distance.any():
        return Trapezoid(start, end, 0.0, 0.0)
    # Normalised to the path 0..1, the slowest axis in each of velocity and acceleration rules all.
    with np.errstate(divide="ignore"):
        rate = float(np.min(np.where(distance > 0, velocity_limit / np.maximum(distance, 1e-300), np.inf)))
        ramp_rate = float(np.min(np.where(distance > 0, acceleration_limit / np.maximum(distance, 1e-300), np.inf)))
    ramp_s = min(rate / ramp_rate, ramp_rate**-0.5)
    cruise_s = 1.0 / (ramp_rate * ramp_s)
    return Trapezoid(start, end, cruise_s + ramp_s, ramp_s)
