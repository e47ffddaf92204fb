"""The motor and its current: a torque constant that drops at large current, torque ripple, and late currents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.linalg import lapack

from ident.arrays import FloatArray
from ident.effects.effect import Effect, Property, Range, Side, Switch
from ident.effects.signals import Abscissa, Signals
from ident.model.model import Column
from ident.model.regressor import cos_sin


@dataclass(frozen=True, slots=True)
class Saturation(Effect):
    """τ = c · g v³ + d · g v⁵;  c, d > 0: the motor needs more current at large torque than without.

    v is the current that the model predicts. Source: saturation of the stator iron, the first two even terms of the
    current per torque; Hendershot & Miller, Design of Brushless Permanent-Magnet Motors. With the first alone, a motor
    that loses a tenth of its torque constant bends its gain by two per cent. Signature: large current, odd in it.
    """

    name = "saturation"
    side = Side.MOTOR
    declares = Property.ODD_IN_CURRENT
    abscissa = Abscissa.CURRENT

    two_terms: Switch = 0  #: 1 with the term of fifth order, else 0

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """One linear parameter a term."""
        terms = Column("coefficient", "1/A²", least=0.0), Column("second coefficient", "1/A⁴", least=0.0)
        return terms[: 1 + self.two_terms]

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1 or 2, k)."""
        square = signals.current_a[axis] ** 2
        return np.asarray(signals.motor_torque_nm[axis] * np.stack((square, square**2)[: 1 + self.two_terms]))


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
    """τ = −c · ẏ,  T ẏ + y = g v;  c > 0: the current is late by c.

    v is the current that the model predicts. A first-order lag of time constant c is this with T = c, exactly; a delay
    is v(t − c) ≈ v − c v̇ + c²/2 · v̈, this with T = c/2 to second order. With T = 0 it is the first order alone, which
    bends the gain where the torque jumps. Signature: rate of torque.
    """

    name = "lag"
    side = Side.MOTOR
    declares = Property.RATE_OF_TORQUE
    abscissa = Abscissa.TORQUE_RATE
    coefficients = (Column("time", "s"),)

    filter_s: Annotated[float, Range(0.0, 1.0)] = 0.0  #: T

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        return -filtered_rate(signals.motor_torque_nm[axis], signals.rate_hz, self.filter_s)[None]


@dataclass(frozen=True, slots=True)
class TimeSkew(Effect):
    """τ_i = −c · ẏ_i,  T ẏ_i + y_i = g_i v_i, of every motor i;  c > 0: all currents are late by c.

    On one axis a delay is a `Lag`, where T is explained; the same delay on all axes is a fault of the recording.
    Signature: rate of torque, the same time everywhere.
    """

    name = "time-skew"
    side = Side.ALL_MOTORS
    declares = Property.RATE_OF_TORQUE
    abscissa = Abscissa.TORQUE_RATE
    coefficients = (Column("time", "s"),)

    filter_s: Annotated[float, Range(0.0, 1.0)] = 0.0  #: T

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 1, k); the axis does not matter."""
        return -filtered_rate(signals.motor_torque_nm, signals.rate_hz, self.filter_s)[:, None]


def filtered_rate(torque_nm: FloatArray, rate_hz: float, filter_s: float) -> FloatArray:
    """Rate of what a first-order low pass leaves of torques [Nm/s], time last, of the shape of ``torque_nm``.

    It starts as if the first torque had been there for ever, and is exact for torques that are held from sample to
    sample.
    """
    if filter_s > 0.0:
        # y_k + (s − 1) y_k−1 = s τ_k is a triangular system with two bands.
        share = -np.expm1(-1.0 / (filter_s * rate_hz))
        band = np.full((2, torque_nm.shape[-1]), share - 1.0, order="F")
        driven = share * torque_nm
        driven[..., 0] = torque_nm[..., 0]
        torque_nm = lapack.dtbtrs(band, np.atleast_2d(driven).T, uplo="L", diag="U")[0].T.reshape(torque_nm.shape)
    return np.asarray(np.gradient(torque_nm, axis=-1) * rate_hz)
