"""Friction of a joint that is cold when the session begins."""

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
class WarmUp:
    """τ = e^(−t/η) · (c_s · sign(q̇) + c_v · q̇)

    Source: grease is stiff when cold, and the heat of the losses fills the joint's capacity with one time constant;
    Bittencourt & Axelsson, "Modeling and experiment design for identification of wear in a robot joint under load and
    temperature uncertainties based on friction data", IEEE/ASME Trans. Mechatronics 19 (2014). Signature: time.

    Attributes:
        time_constant_s: η, from half a run to many.
        whole_session: 1 where t counts from the first run of the session, 0 where from the beginning of each run, as
            after a power-on.
    """

    name: ClassVar[str] = "warm-up"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.TIME

    time_constant_s: float
    whole_session: int

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"time_constant_s": self.time_constant_s, "whole_session": self.whole_session}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("dry", "Nm"), Column("viscous", "Nm/(rad/s)"))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (2, k)."""
        time_s = signals.session_s if self.whole_session else signals.time_s
        cold, v = np.exp(-time_s / self.time_constant_s), signals.velocity_rad_s[axis]
        return np.stack((cold * np.sign(v), cold * v))
