"""Dry friction that changes with the joint's position."""

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
class PositionFriction:
    """τ = sign(q̇) · (a cos q + b sin q)

    Source: first harmonic of a run-out of gear, seal or bearing over one joint revolution; Armstrong-Hélouvry (1991),
    "Control of Machines with Friction", ch. 4. Signature: sign × position.
    """

    name: ClassVar[str] = "position-friction"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.POSITION

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("cosine", "Nm"), Column("sine", "Nm"))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (2, k)."""
        q, s = signals.position_rad[axis], np.sign(signals.velocity_rad_s[axis])
        return np.stack((s * np.cos(q), s * np.sin(q)))
