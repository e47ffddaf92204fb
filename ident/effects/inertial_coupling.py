"""Inertia between two joints that the drive train does not know of."""

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
class InertialCoupling:
    """τ_i = c · q̈_j and τ_j = c · q̈_i

    Source: a rotor or shaft that both joints turn (paper eq. 25: Ia_m6 beside the diagonal). Signature: another axis'
    acceleration.

    Attributes:
        other_axis: number of joint j, from 1; joint i is the one with the lower number.
    """

    name: ClassVar[str] = "inertial-coupling"
    side: ClassVar[Side] = Side.TWO_JOINTS
    holds: ClassVar[Property] = Property.INDEPENDENT_OF_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.OTHER_VELOCITY

    other_axis: int

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"other_axis": self.other_axis}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("inertia", "kg m²"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (2, 1, k)."""
        return signals.acceleration_rad_s2[[self.other_axis - 1, axis]][:, None]
