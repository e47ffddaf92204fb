"""Friction that is higher at low speed."""

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
class Stribeck:
    """τ = c · sign(q̇) · exp(−|q̇|/η)

    Source: Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994), the exponential form of the Stribeck
    curve; boundary lubrication gives way to a film as the speed grows past η. Signature: low speed, odd in q̇.

    Attributes:
        speed_rad_s: η, between standstill and a tenth of full speed.
    """

    name: ClassVar[str] = "stribeck"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.VELOCITY

    speed_rad_s: float

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"speed_rad_s": self.speed_rad_s}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("amplitude", "Nm"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        v = signals.velocity_rad_s[axis]
        return np.asarray(np.sign(v) * np.exp(-np.abs(v) / self.speed_rad_s))[None]
