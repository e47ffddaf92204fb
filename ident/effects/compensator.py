"""A gravity compensator, or whatever repeats with the joint."""

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
