"""Free play between the flanks of a gear, seen through an encoder on the motor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.discovery.signals import Signals
from ident.effects.effect import Abscissa, Property, Side, curvature
from ident.model.model import Column

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


# A gear that gives, seen through an encoder on the motor.


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


# Inertia between two joints that the drive train does not know of.


@dataclass(frozen=True, slots=True)
class InertialCoupling:
    """τ_i = c · q̈_j and τ_j = c · q̈_i

    Source: a rotor or shaft that both joints turn (paper eq. 25: Ia_m6 beside the diagonal). Signature: another axis'
    acceleration.

    Attributes:
        other_axis: number of joint j, from 1; joint i is the one with the lower number.
    """

    name: ClassVar[str] = "inertial-coupling"
    side: ClassVar[Side] = Side.TWO_JOINTS
    holds: ClassVar[Property] = Property.INDEPENDENT_OF_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.OTHER_VELOCITY

    other_axis: int

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"other_axis": self.other_axis}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("inertia", "kg m²"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (2, 1, k)."""
        return signals.acceleration_rad_s2[[self.other_axis - 1, axis]][:, None]
