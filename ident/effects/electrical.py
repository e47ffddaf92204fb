"""The motor and its current: a torque constant that drops at large current, torque ripple, and late currents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ident.arrays import FloatArray
from ident.effects.effect import Effect, Property, Range, Side
from ident.effects.signals import Abscissa, Signals
from ident.model.model import Column
from ident.model.regressor import cos_sin


@dataclass(frozen=True, slots=True)
class Saturation(Effect):
    """τ = c · g v³;  c > 0: the motor gives g v (1 − c v²), so that it needs more current at large torque.

    v is the current that the model predicts. Source: saturation of the stator iron, the first even term of K_t(v);
    Hendershot & Miller, Design of Brushless Permanent-Magnet Motors. Signature: large current, odd in it.
    """

    name = "saturation"
    side = Side.MOTOR
    declares = Property.ODD_IN_CURRENT
    abscissa = Abscissa.CURRENT
    coefficients = (Column("coefficient", "1/A²", least=0.0),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        return np.asarray(signals.motor_torque_nm[axis] * signals.current_a[axis] ** 2)[None]


@dataclass(frozen=True, slots=True)
class Cogging(Effect):
    """τ = a cos(k q_m) + b sin(k q_m), at the motor;  a > 0: the motor pushes in the positive direction at q_m = 0.

    Source: magnetic cogging (k poles and slots), current-offset ripple (k = pole pairs) and the wave generator of a
    strain-wave gear (k = 2); Gandhi et al., IEEE/ASME ToM 7 (2002). Signature: a line at motor order k.
    """

    name = "cogging"
    side = Side.MOTOR
    declares = Property.PERIODIC_IN_MOTOR_ANGLE
    abscissa = Abscissa.MOTOR_ANGLE
    coefficients = (Column("cosine", "Nm"), Column("sine", "Nm"))

    order: Annotated[int, Range(1, 1000)]  #: k, per motor revolution

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        return np.stack(cos_sin(self.order * signals.motor_position_rad[axis]))


@dataclass(frozen=True, slots=True)
class Lag(Effect):
    """τ = −c · d(g v)/dt;  c > 0: the current is late by c.

    v(t − c) ≈ v(t) − c v̇(t) with the current that the model predicts. Source: first-order expansion of a delay, and of
    a first-order lag of time constant c: the two cannot be distinguished here. Signature: rate of torque.
    """

    name = "lag"
    side = Side.MOTOR
    declares = Property.RATE_OF_TORQUE
    abscissa = Abscissa.TORQUE_RATE
    coefficients = (Column("time", "s"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        return np.asarray(-np.gradient(signals.motor_torque_nm[axis]) * signals.rate_hz)[None]


@dataclass(frozen=True, slots=True)
class TimeSkew(Effect):
    """τ_i = −c · d(g_i v_i)/dt of every motor i;  c > 0: all currents are late by c.

    On one axis a delay is a `Lag`; the same delay on all axes is a fault of the recording. Source: first-order
    expansion of a delay, with the current that the model predicts. Signature: rate of torque, the same time everywhere.
    """

    name = "time-skew"
    side = Side.ALL_MOTORS
    declares = Property.RATE_OF_TORQUE
    abscissa = Abscissa.TORQUE_RATE
    coefficients = (Column("time", "s"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 1, k); the axis does not matter."""
        return np.asarray(-np.gradient(signals.motor_torque_nm, axis=1) * signals.rate_hz)[:, None]
