"""A cable or hose that pulls from some position on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.effects.abscissa import Abscissa
from ident.effects.effect import Property, Side
from ident.model import Column
from ident.signals import Signals

FloatArray = NDArray[np.float64]


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
