"""What an effect is: columns of torque that the declared model lacks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from ident.discovery.signals import Signals
from ident.model.model import Column

# The variables that a residual is held against: what a person plots, and what the search for structure tries.


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
        Abscissa.DISTANCE: lambda: distance_since_reversal(signals.velocity_rad_s[axis], signals.rate_hz)[1],
        Abscissa.OTHER_VELOCITY: lambda: signals.velocity_rad_s[axis if other is None else other],
    }
    return np.asarray(given[abscissa](), dtype=np.float64)


def curvature(value: FloatArray, rate_hz: float) -> FloatArray:
    """Second derivative in time by central differences, shape (k,)."""
    return np.asarray(np.gradient(np.gradient(value)) * rate_hz**2)


def distance_since_reversal(velocity_rad_s: FloatArray, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Direction of the last motion (−1, 0 before any, 1) and the way made in it [rad], both of shape (k,)."""
    moving = np.abs(velocity_rad_s) > STICKING_RAD_S
    way = np.cumsum(np.abs(velocity_rad_s) * moving) / rate_hz
    last = np.maximum.accumulate(np.where(moving, np.arange(len(moving)), -1))
    direction = np.where(last >= 0, np.sign(velocity_rad_s[last]), 0.0)
    turned = np.diff(direction, prepend=direction[:1]) != 0
    start = np.maximum.accumulate(np.where(turned, np.arange(len(moving)), 0))
    return direction, way - way[start]


FloatArray = NDArray[np.float64]


class Side(Enum):
    """Where the torque acts.

    JOINT: on the joint. MOTOR: on the motor of that number, and through R on all joints that it turns. TWO_JOINTS: on
    the joint and on another one, whose number is the setting `other_axis`. ALL_JOINTS: on every joint, through the
    links. ALL_MOTORS: on every motor alike; it has no axis of its own and is placed on the first.
    """

    JOINT = "joint"
    MOTOR = "motor"
    TWO_JOINTS = "two joints"
    ALL_JOINTS = "all joints"
    ALL_MOTORS = "all motors"


class Property(Enum):
    """What an effect claims about its columns; one test tries to refute the claim of every entry of EFFECTS."""

    ODD_IN_VELOCITY = "turns its sign when the motion is reversed in place"
    EVEN_IN_VELOCITY = "keeps its value when the motion is reversed in place"
    INDEPENDENT_OF_VELOCITY = "does not change when the velocity does"
    PERIODIC_IN_MOTOR_ANGLE = "repeats after one motor revolution"
    ODD_IN_CURRENT = "turns its sign with the current"
    ODD_IN_LOAD = "turns its sign with the load"
    RATE_OF_TORQUE = "is zero where the torque does not change"
    SMOOTH = "changes little where its variable does"
    RATE_OF_LOAD = "is zero where the load does not change"


class Effect(Protocol):
    """An entry of the dictionary: a frozen dataclass whose fields are its searched (non-linear) parameters.

    Attributes:
        holds: what it claims about its columns.
    """

    holds: ClassVar[Property]

    @property
    def side(self) -> Side:
        """Where it acts."""
        ...

    @property
    def name(self) -> str:
        """What a technician calls it."""
        ...

    @property
    def abscissa(self) -> Abscissa:
        """What shows it in a picture."""
        ...

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters by name, units in the names."""
        ...

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Name and unit of each linear parameter."""
        ...

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient [Nm], shape (p, k), where several joints feel it (joints, p, k)."""
        ...


# An effect and the axis that it acts on.


@dataclass(frozen=True, slots=True)
class PlacedEffect:
    """An effect on an axis (index from 0)."""

    effect: Effect
    axis: int

    @property
    def columns(self) -> tuple[Column, ...]:
        """Its linear parameters, named after effect, axis and settings: an axis may have cogging of two orders."""
        name, number = self.effect.name, self.axis + 1
        settings = ", ".join(f"{key} {value:.6g}" for key, value in self.effect.settings.items())
        suffix = f" ({settings})" if settings else ""
        return tuple(
            Column(f"{name} {column.name} {number}{suffix}", column.unit) for column in self.effect.coefficients
        )
