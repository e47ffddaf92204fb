"""The variables that a residual is held against: what a person plots, and what the search for structure tries."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ident.signals import Signals

FloatArray = NDArray[np.float64]

STICKING_RAD_S = 0.005
"""Slower than this the filtered encoder's noise decides on the sign of a speed."""


class Abscissa(Enum):
    """A variable of one axis: label with unit."""

    VELOCITY = "joint velocity [rad/s]"
    POSITION = "joint position [rad]"
    LOAD = "load torque [Nm]"
    TIME = "time in the run [s]"
    SESSION = "time in the session [s]"
    MOTOR_ANGLE = "motor angle, one revolution [rad]"
    CURRENT = "predicted current [A]"
    TORQUE_RATE = "rate of the motor torque [Nm/s]"
    LOAD_CURVATURE = "second derivative of the load torque [Nm/s²]"
    DISTANCE = "way since the last reversal [rad]"
    OTHER_VELOCITY = "velocity of the other joint [rad/s]"

    @property
    def is_kinematic(self) -> bool:
        """Whether it is known from the motion alone, whatever the model predicts."""
        return self not in {Abscissa.LOAD, Abscissa.CURRENT, Abscissa.TORQUE_RATE, Abscissa.LOAD_CURVATURE}


def values(abscissa: Abscissa, signals: Signals, axis: int, other: int | None = None) -> FloatArray:
    """A variable along a run, shape (k,).

    Args:
        abscissa: which.
        signals: of the run.
        axis: of it.
        other: the other axis, for what speaks of one.
    """
    given: dict[Abscissa, Callable[[], FloatArray]] = {
        Abscissa.VELOCITY: lambda: signals.velocity_rad_s[axis],
        Abscissa.POSITION: lambda: signals.position_rad[axis],
        Abscissa.LOAD: lambda: signals.load_torque_nm[axis],
        Abscissa.TIME: lambda: signals.time_s,
        Abscissa.SESSION: lambda: signals.session_s,
        Abscissa.MOTOR_ANGLE: lambda: np.mod(signals.motor_position_rad[axis], 2.0 * np.pi),
        Abscissa.CURRENT: lambda: signals.current_a[axis],
        Abscissa.TORQUE_RATE: lambda: np.gradient(signals.motor_torque_nm[axis]) * signals.rate_hz,
        Abscissa.LOAD_CURVATURE: lambda: curvature(signals.load_torque_nm[axis], signals.rate_hz),
        Abscissa.DISTANCE: lambda: way_since_reversal(signals.velocity_rad_s[axis], signals.rate_hz)[1],
        Abscissa.OTHER_VELOCITY: lambda: signals.velocity_rad_s[axis if other is None else other],
    }
    return np.asarray(given[abscissa](), dtype=np.float64)


def curvature(value: FloatArray, rate_hz: float) -> FloatArray:
    """Second derivative in time by central differences, shape (k,)."""
    return np.asarray(np.gradient(np.gradient(value)) * rate_hz**2)


def way_since_reversal(velocity_rad_s: FloatArray, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Direction of the last motion (−1, 0 before any, 1) and the way made in it [rad], both of shape (k,)."""
    moving = np.abs(velocity_rad_s) > STICKING_RAD_S
    way = np.cumsum(np.abs(velocity_rad_s) * moving) / rate_hz
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moving)), -1))
    direction = np.where(last >= 0, np.sign(velocity_rad_s[last]), 0.0)
    turned = np.diff(direction, prepend=direction[:1]) != 0
    start = np.maximum.accumulate(np.where(turned, np.arange(len(moving)), 0))
    return direction, way - way[start]
