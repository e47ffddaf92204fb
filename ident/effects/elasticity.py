"""A gear that gives, seen through an encoder on the motor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.effects.abscissa import Abscissa, curvature
from ident.effects.effect import Property, Side
from ident.model import Column
from ident.signals import Signals

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Elasticity:
    """τ_i = −c · M_ij · τ̈_j,  c = 1/k

    Joint j stands behind its motor by τ_j/k, so its acceleration is less than the motor's by τ̈_j/k, and every joint i
    takes M_ij times as much torque less; M is the mass matrix in that posture and τ_j what goes through the gear, its
    friction left out, which only jumps. To first order in c: good well below the resonance √(k/M_jj). Source: Spong
    (1987), "Modeling and control of elastic joint robots", with the encoder on the motor. Signature: second derivative
    of the load.
    """

    name: ClassVar[str] = "elasticity"
    side: ClassVar[Side] = Side.ALL_JOINTS
    holds: ClassVar[Property] = Property.RATE_OF_LOAD
    abscissa: ClassVar[Abscissa] = Abscissa.LOAD_CURVATURE

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("compliance", "rad/Nm"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (n, 1, k)."""
        bend = curvature(signals.load_torque_nm[axis], signals.rate_hz)
        return np.asarray(-signals.inertia_kg_m2[:, axis] * bend)[:, None]
