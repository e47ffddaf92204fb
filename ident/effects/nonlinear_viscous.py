"""Viscous friction that is not proportional to speed."""

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
class NonlinearViscous:
    """τ = c · sign(q̇) · |q̇|^η

    Source: shear-thinning grease (η < 1) and churning losses (η = 2, 3); Harris & Kotzalas, Rolling Bearing Analysis,
    where load-free bearing drag grows with speed to the power 2/3. Signature: all speeds, odd in q̇.

    Attributes:
        exponent: η; one would be the declared viscous friction itself.
    """

    name: ClassVar[str] = "nonlinear-viscous"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.VELOCITY

    exponent: float

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"exponent": self.exponent}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("coefficient", f"Nm/(rad/s)^{self.exponent:.3g}"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        v = signals.velocity_rad_s[axis]
        return np.asarray(np.sign(v) * np.abs(v) ** self.exponent)[None]
