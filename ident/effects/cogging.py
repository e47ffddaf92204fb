"""Torque ripple that repeats with the motor's turn."""

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
class Cogging:
    """τ = a cos(k q_m) + b sin(k q_m), at the motor

    Source: magnetic cogging (k poles and slots), current-offset ripple (k = pole pairs) and the wave generator of a
    strain-wave gear (k = 2); Gandhi et al., IEEE/ASME ToM 7 (2002). Signature: a line at motor order k.

    Attributes:
        order: k, per motor revolution.
    """

    name: ClassVar[str] = "cogging"
    side: ClassVar[Side] = Side.MOTOR
    holds: ClassVar[Property] = Property.PERIODIC_IN_MOTOR_ANGLE
    abscissa: ClassVar[Abscissa] = Abscissa.MOTOR_ANGLE

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
        angle = self.order * signals.motor_position_rad[axis]
        return np.stack((np.cos(angle), np.sin(angle)))
