"""A torque proportional to position: gas spring, cable or hose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.discovery.signals import Signals
from ident.effects.effect import Abscissa, Property, Side
from ident.model.model import Column

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Spring:
    """τ = c · q, with c · q₀ in the declared offset

    Source: Hooke's law. Signature: position, at any speed; a gravity term differs from it over a large range only.
    """

    name: ClassVar[str] = "spring"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.INDEPENDENT_OF_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.POSITION

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("stiffness", "Nm/rad"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        return np.asarray(signals.position_rad[axis])[None]


# A gravity compensator, or whatever repeats with the joint.


@dataclass(frozen=True, slots=True)
class Compensator:
    """τ = a cos kq + b sin kq

    Source: a compensating spring between two points of the arm, to its first harmonics; Ulrich & Kumar (1991),
    "Passive mechanical gravity compensation for robot manipulators". Signature: position, at any speed.

    Attributes:
        order: k, in the joint's revolutions.
    """

    name: ClassVar[str] = "gravity-compensator"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.INDEPENDENT_OF_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.POSITION

    order: int

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"order": self.order}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("cosine", "Nm"), Column("sine", "Nm"))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (2, k)."""
        angle = self.order * signals.position_rad[axis]
        return np.stack((np.cos(angle), np.sin(angle)))


# A cable or hose that pulls from some position on.


@dataclass(frozen=True, slots=True)
class Hinge:
    """τ = c · max(0, σ (q − q₀))

    Source: Hooke's law of a slack cable. Signature: position, on one side of q₀.

    Attributes:
        start_rad: q₀.
        sense: σ, 1 where it pulls above q₀, −1 below.
    """

    name: ClassVar[str] = "hinge"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.INDEPENDENT_OF_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.POSITION

    start_rad: float
    sense: int

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"start_rad": self.start_rad, "sense": self.sense}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("stiffness", "Nm/rad"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        return np.asarray(np.maximum(0.0, self.sense * (signals.position_rad[axis] - self.start_rad)))[None]
