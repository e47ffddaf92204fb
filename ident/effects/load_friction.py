"""Dry friction that grows with the load on the teeth."""

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
class LoadFriction:
    """τ = c · |τ_L| · sign(q̇) · |q̇|^η

    τ_L is the torque that links and payload ask of the joint. Source: Amontons' law at the gear mesh; Hamon, Gautier &
    Garrec, IROS 2010, "Dynamic identification of robots with a dry friction model depending on load and velocity".
    Signature: sign × load; loaded and unloaded runs differ in it.

    Attributes:
        speed_exponent: η, 0 for dry and 1 for viscous friction.
    """

    name: ClassVar[str] = "load-friction"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.LOAD

    speed_exponent: int

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"speed_exponent": self.speed_exponent}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("coefficient", "(rad/s)^-1" if self.speed_exponent else "Nm/Nm"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        v = signals.velocity_rad_s[axis]
        rubbing = np.sign(v) * np.abs(v) ** self.speed_exponent
        return np.asarray(np.abs(signals.load_torque_nm[axis]) * rubbing)[None]
