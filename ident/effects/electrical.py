"""A torque constant that drops at large current."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.discovery.signals import Signals
from ident.effects.effect import Abscissa, Property, Side
from ident.model.model import Column

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Saturation:
    """g v (1 − c v²): seen as a torque c · g v³ more than the current tells

    v is the current that the model predicts. Source: saturation of the stator iron, the first even term of K_t(v);
    Hendershot & Miller, Design of Brushless Permanent-Magnet Motors. Signature: large current, odd in it.
    """

    name: ClassVar[str] = "saturation"
    side: ClassVar[Side] = Side.MOTOR
    holds: ClassVar[Property] = Property.ODD_IN_CURRENT
    abscissa: ClassVar[Abscissa] = Abscissa.CURRENT

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("coefficient", "1/A²"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        return np.asarray(signals.motor_torque_nm[axis] * signals.current_a[axis] ** 2)[None]


# Torque ripple that repeats with the motor's turn.


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
