"""Gears and shafts that are not rigid, seen through encoders on the motors, and inertia shared by two joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ident.arrays import FloatArray
from ident.effects.effect import AxisNumber, Effect, Property, Range, Side
from ident.effects.signals import Abscissa, Signals, curvature
from ident.model.model import Column


@dataclass(frozen=True, slots=True)
class Backlash(Effect):
    """τ_i = −c · M_ij · d²/dt² tanh(τ_j/w);  c > 0: half the gap.

    The joint lags its motor by half the gap on the side to which it is pushed, so where the torque turns it is pushed
    across; τ_j is the torque through the gear, M the mass matrix. Source: Nordin & Gutman (2002), "Controlling
    mechanical systems with backlash", Automatica 38, the dead-zone model with stiff flanks. Signature: sign changes of
    the load.
    """

    name = "backlash"
    side = Side.ALL_JOINTS
    declares = Property.ODD_IN_LOAD
    abscissa = Abscissa.LOAD
    coefficients = (Column("half gap", "rad"),)

    #: W, over which the side changes, in parts of the load's root mean square.
    share: Annotated[float, Range(1e-6, 1.0)]

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 1, k)."""
        torque = signals.geared_torque_nm[axis]
        width = self.share * float(np.sqrt(np.mean(torque**2))) or 1.0
        crossing = curvature(np.tanh(torque / width), signals.rate_hz)
        return np.asarray(-signals.inertia_kg_m2[:, axis] * crossing)[:, None]


@dataclass(frozen=True, slots=True)
class Elasticity(Effect):
    """τ_i = −c · M_ij · τ̈_j;  c = 1/k > 0: compliance of the gear.

    Joint j lags its motor by τ_j/k, so its acceleration is less than the motor's by τ̈_j/k, and every joint i takes M_ij
    times as much torque less; M is the mass matrix in that posture and τ_j the torque through the gear, without its
    friction, which only jumps. To first order in c: good well below the resonance √(k/M_jj). Source: Spong (1987),
    "Modeling and control of elastic joint robots", with the encoder on the motor. Signature: second derivative of the
    load.
    """

    name = "elasticity"
    side = Side.ALL_JOINTS
    declares = Property.RATE_OF_LOAD
    abscissa = Abscissa.LOAD_CURVATURE
    coefficients = (Column("compliance", "rad/Nm"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 1, k)."""
        bend = curvature(signals.load_torque_nm[axis], signals.rate_hz)
        return np.asarray(-signals.inertia_kg_m2[:, axis] * bend)[:, None]


@dataclass(frozen=True, slots=True)
class InertialCoupling(Effect):
    """τ_i = c · q̈_j and τ_j = c · q̈_i;  c > 0: both joints accelerate the shared body in the same sense.

    Source: a rotor or shaft that both joints turn (paper eq. 25: Ia_m6 beside the diagonal). Signature: another axis'
    acceleration.
    """

    name = "inertial-coupling"
    side = Side.TWO_JOINTS
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.OTHER_VELOCITY
    coefficients = (Column("inertia", "kg m²"),)

    other_axis: AxisNumber  #: number of joint j, from 1; joint i is the one with the lower number

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, 1, k)."""
        return signals.acceleration_rad_s2[[self.other_axis - 1, axis]][:, None]
