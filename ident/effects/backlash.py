"""Free play between the flanks of a gear, seen through an encoder on the motor."""

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
class Backlash:
    """τ_i = −c · M_ij · d²/dt² tanh(τ_j/w),  c = half the gap

    The joint lags its motor by half the gap on the side to which it is pushed, so where the torque turns it is pushed
    across; τ_j is what goes through the gear, M the mass matrix. Source: Nordin & Gutman (2002), "Controlling
    mechanical systems with backlash", Automatica 38, the dead-zone model with stiff flanks. Signature: sign changes of
    the load.

    Attributes:
        share: w, over which the side changes, in parts of the load's root mean square.
    """

    name: ClassVar[str] = "backlash"
    side: ClassVar[Side] = Side.ALL_JOINTS
    holds: ClassVar[Property] = Property.ODD_IN_LOAD
    abscissa: ClassVar[Abscissa] = Abscissa.LOAD

    share: float

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"share": self.share}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("half gap", "rad"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (n, 1, k)."""
        torque = signals.geared_torque_nm[axis]
        width = self.share * float(np.sqrt(np.mean(torque**2))) or 1.0
        crossing = curvature(np.tanh(torque / width), signals.rate_hz)
        return np.asarray(-signals.inertia_kg_m2[:, axis] * crossing)[:, None]
