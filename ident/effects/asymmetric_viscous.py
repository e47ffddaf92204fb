"""Viscous friction that differs between the two directions."""

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
class AsymmetricViscous:
    """τ = c · |q̇|

    Source: the even part of Fv⁺q̇ for q̇ > 0, Fv⁻q̇ for q̇ < 0 (Swevers et al., IEEE TRA 13 (1997)); the odd part is the
    declared viscous friction. Signature: even in q̇.
    """

    name: ClassVar[str] = "asymmetric-viscous"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.EVEN_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.VELOCITY

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("coefficient", "Nm/(rad/s)"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        return np.asarray(np.abs(signals.velocity_rad_s[axis]))[None]
