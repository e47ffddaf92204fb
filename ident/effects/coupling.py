"""Friction between two joints that the drive train does not know of."""

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
class Coupling:
    """τ_i = c_s · sign(q̇_i ± q̇_j) + c_v · (q̇_i ± q̇_j), and ± the same on joint j

    Source: a shaft, belt or hose of one joint that runs through another (paper eq. 25). Signature: another axis' speed.

    Attributes:
        other_axis: number of joint j, from 1; joint i is the one with the lower number.
        sense: 1 for the sum of the speeds, −1 for their difference.
    """

    name: ClassVar[str] = "coupling"
    side: ClassVar[Side] = Side.TWO_JOINTS
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.OTHER_VELOCITY

    other_axis: int
    sense: int

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"other_axis": self.other_axis, "sense": self.sense}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("dry", "Nm"), Column("viscous", "Nm/(rad/s)"))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (2, 2, k)."""
        shared = signals.velocity_rad_s[axis] + self.sense * signals.velocity_rad_s[self.other_axis - 1]
        friction = np.stack((np.sign(shared), shared))
        return np.stack((friction, self.sense * friction))
