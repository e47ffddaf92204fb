"""A periodic function of the motor's angle: what no single ripple order explains."""

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

ORDERS = (1, 2, 3, 4, 6)


@dataclass(frozen=True, slots=True)
class Periodic:
    """τ = Σ a_k cos kθ + b_k sin kθ, θ the motor's angle, k in ORDERS

    Source: Fourier series of whatever repeats with the motor. Where `signed`, times sign(q̇): friction that does.

    Attributes:
        signed: 1 where it turns with the direction of motion, else 0.
    """

    side: ClassVar[Side] = Side.MOTOR
    holds: ClassVar[Property] = Property.PERIODIC_IN_MOTOR_ANGLE
    name: ClassVar[str] = "periodic-motor-angle"
    abscissa: ClassVar[Abscissa] = Abscissa.MOTOR_ANGLE

    signed: int = 0

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"signed": self.signed}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return tuple(Column(f"{part} {order}", "Nm") for order in ORDERS for part in ("cosine", "sine"))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (2 · orders, k)."""
        angle = signals.motor_position_rad[axis]
        waves = np.stack([wave(order * angle) for order in ORDERS for wave in (np.cos, np.sin)])
        return np.asarray(waves * np.sign(signals.velocity_rad_s[axis]) if self.signed else waves)
