"""What an effect is: columns of torque that the declared model lacks."""

from __future__ import annotations

from enum import Enum
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from ident.model import Column
from ident.signals import Signals

FloatArray = NDArray[np.float64]


class Side(Enum):
    """Where the torque acts: on the joint, or on the motor of that number (and through R on all joints it turns)."""

    JOINT = "joint"
    MOTOR = "motor"


class Abscissa(Enum):
    """What a person plots a residual against to see an effect: label with unit."""

    VELOCITY = "joint velocity [rad/s]"
    POSITION = "joint position [rad]"
    LOAD = "load torque [Nm]"
    MOTOR_ANGLE = "motor angle, one revolution [rad]"
    CURRENT = "predicted current [A]"
    TORQUE_RATE = "rate of the motor torque [Nm/s]"


class Property(Enum):
    """What an effect claims about its columns; one test tries to refute the claim of every entry of EFFECTS."""

    ODD_IN_VELOCITY = "turns its sign when the motion is reversed in place"
    EVEN_IN_VELOCITY = "keeps its value when the motion is reversed in place"
    INDEPENDENT_OF_VELOCITY = "does not change when the velocity does"
    PERIODIC_IN_MOTOR_ANGLE = "repeats after one motor revolution"
    ODD_IN_CURRENT = "turns its sign with the current"
    RATE_OF_TORQUE = "is zero where the torque does not change"


class Effect(Protocol):
    """An entry of the dictionary: a frozen dataclass whose fields are its searched (non-linear) parameters.

    Attributes:
        name: what a technician calls it.
        side: where it acts.
        holds: what it claims about its columns.
        abscissa: what shows it in a picture.
    """

    name: ClassVar[str]
    side: ClassVar[Side]
    holds: ClassVar[Property]
    abscissa: ClassVar[Abscissa]

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters by name, units in the names."""
        ...

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Name and unit of each linear parameter."""
        ...

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque at the axis per unit of each coefficient [Nm], shape (coefficients, k)."""
        ...
