"""What an effect is: columns of torque that the declared model lacks."""

from __future__ import annotations

from enum import Enum
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from ident.effects.abscissa import Abscissa
from ident.model import Column
from ident.signals import Signals

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
