"""A torque constant that drops at large current."""

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
