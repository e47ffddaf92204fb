"""Effects of the motor and its current: saturation, cogging, drift of the offset, late currents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.linalg import lapack

from ident.arrays import FloatArray
from ident.effects.effect import Effect, FadingEffect, GearSide, Property, Range, Reported, Switch
from ident.effects.signals import Abscissa, Signals
from ident.model.model import Column
from ident.model.regressor import cos_sin

#: By how much a current may be early on one axis. The reference precedes the torque by the delay of
#: the current loop, and a position is read a few cycles late. Both are milliseconds: a current that
#: is earlier than this does not cause the torque.
EARLIEST_S = 0.01


@dataclass(frozen=True, slots=True)
class Saturation(Effect):
    """τ = c · g v³ + d · g v⁵: at large torque the motor needs more current v than its gain g says.

    v is the current that the model predicts, i the recorded one. With a torque constant that falls
    by 1/(1 + (i/h)²), to a half at i = h, v = i/(1 + (i/h)²). Its inverse is the series
    i = v + v³/h² + 2 v⁵/h⁴ + …, which converges below v = h/2: c is about 1/h², d about 2/h⁴. With
    the first term alone, the gain compensates the others in part. Source: saturation of the stator
    iron; Hendershot & Miller, Design of Brushless Permanent-Magnet Motors. Signature: large
    current, odd in it.
    """

    name = "saturation"
    side = GearSide.MOTOR
    declares = Property.ODD_IN_CURRENT
    abscissa = Abscissa.CURRENT
    form_settings = ("two_terms",)
    added_settings = ("two_terms",)

    two_terms: Switch = 0  #: 1 with the term of fifth order, else 0

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """One linear parameter a term."""
        terms = (
            Column("coefficient", "1/A²", least=0.0),
            Column("second coefficient", "1/A⁴", least=0.0),
        )
        return terms[: 1 + self.two_terms]

    @property
    def forms(self) -> tuple[Saturation, ...]:
        """The form with one term, then the form with two if this one has two."""
        if self.two_terms:
            return (Saturation(0), Saturation(1))
        return (Saturation(0),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns g v³ and g v⁵ as g v times even powers of v, shape (1 or 2, k)."""
        square = signals.current_a[axis] ** 2
        even_powers = [square]
        if self.two_terms:
            even_powers.append(square**2)
        torque_nm = signals.motor_torque_nm[axis]
        return np.asarray(torque_nm * np.stack(even_powers))


@dataclass(frozen=True, slots=True)
class Cogging(Effect):
    """τ = a cos(k q_m) + b sin(k q_m), at the motor;  a > 0:
    the motor pushes in the positive direction at q_m = 0.

    Source: magnetic cogging (k poles and slots), current-offset ripple (k = pole pairs) and the
    wave generator of a strain-wave gear (k = 2); Gandhi et al., IEEE/ASME ToM 7 (2002). Signature:
    a line at motor order k.
    """

    name = "cogging"
    side = GearSide.MOTOR
    declares = Property.PERIODIC_IN_MOTOR_ANGLE
    abscissa = Abscissa.MOTOR_ANGLE
    coefficients = (Column("cosine", "Nm"), Column("sine", "Nm"))
    reported = Reported.AMPLITUDE

    order: Annotated[int, Range(1, 1000)]  #: k, per motor revolution

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        motor_angle = signals.motor_position_rad[axis]
        return np.stack(cos_sin(self.order * motor_angle))


@dataclass(frozen=True, slots=True)
class OffsetDrift(FadingEffect):
    """τ = c · e^(−t/η), at the motor;  c > 0:
    at power-on the reference is higher by c/g than the declared offset says.

    Source: the offset of a current sensor drifts with its temperature, which settles with one time
    constant after power-on. Signature: time, at any speed.
    """

    name = "offset-drift"
    side = GearSide.MOTOR
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.TIME
    coefficients = (Column("offset", "Nm"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        del axis
        return self.left(signals)[None]


@dataclass(frozen=True, slots=True)
class LateCurrent(Effect):
    """A current that was recorded later than the torque, or earlier."""

    declares = Property.RATE_OF_TORQUE
    abscissa = Abscissa.TORQUE_RATE
    reported = Reported.DELAY
    form_settings = ("backwards",)
    added_settings = ("filter_s", "backwards")

    filter_s: Annotated[float, Range(0.0, 0.1)] = 0.0  #: T
    #: 1 where the filter runs backwards in time, else 0
    backwards: Switch = 0

    def rate(self, torque_nm: FloatArray, rate_hz: float) -> FloatArray:
        """Return `filtered_rate` of a torque [Nm/s], an array of the same shape."""
        backwards = bool(self.backwards)
        return filtered_rate(torque_nm, rate_hz, self.filter_s, backwards=backwards)


@dataclass(frozen=True, slots=True)
class Lag(LateCurrent):
    """τ = −c · ẏ,  T ẏ + y = g v;  c > 0: the current is late by c; c < 0:
    it is early, by 10 ms at most.

    v is the current that the model predicts, without other effects. c is fitted; T is a setting,
    which the search chooses. T = c is a first-order lag with the time constant c. T = c/2 is a
    delay to second order: v(t − c) ≈ v − c v̇ + c²/2 · v̈. T = 0 is the first order alone; it is
    wrong where the torque jumps, and biases the gain. For an early current the filter runs
    backwards in time. Source: Taylor and Padé expansions of a delay. Signature: rate of torque.
    """

    name = "lag"
    side = GearSide.MOTOR
    coefficients = (Column("time", "s", least=-EARLIEST_S),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        rate = self.rate(signals.motor_torque_nm[axis], signals.rate_hz)
        return -rate[None]


@dataclass(frozen=True, slots=True)
class TimeSkew(LateCurrent):
    """τ_i = −c · ẏ_i,  T ẏ_i + y_i = g_i v_i, of every motor i;  c > 0: all currents are late by c.

    A `Lag` (see there for T) with the same delay on every axis, which is a fault of the recording.
    Source: Padé expansion of a delay. Signature: rate of torque, the same time on every axis.
    """

    name = "time-skew"
    side = GearSide.ALL_MOTORS
    coefficients = (Column("time", "s"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 1, k); the axis does not matter."""
        rate = self.rate(signals.motor_torque_nm, signals.rate_hz)
        return -rate[:, None]


def filtered_rate(
    torque_nm: FloatArray, rate_hz: float, filter_s: float, *, backwards: bool
) -> FloatArray:
    """Return ẏ of the first-order filter T ẏ + y = τ [Nm/s], of the shape of ``torque_nm``.

    It is exact for torques that are linear between samples (first-order hold), and starts as if the
    first torque had acted for ever. With T = 0, ẏ is the central difference of τ.

    Args:
        torque_nm: τ, shape (k,) or (n, k).
        rate_hz: sampling rate.
        filter_s: T.
        backwards: whether the filter runs from the last sample to the first.
    """
    if backwards:
        # Reversed time turns the sign of the derivative.
        reverse_nm = torque_nm[..., ::-1]
        reverse_rate = filtered_rate(reverse_nm, rate_hz, filter_s, backwards=False)
        return -reverse_rate[..., ::-1]
    if not filter_s > 0.0:
        return np.asarray(np.gradient(torque_nm, axis=-1) * rate_hz)
    filtered_nm = _low_passed(torque_nm, filter_s * rate_hz)
    return np.asarray((torque_nm - filtered_nm) / filter_s)


def _low_passed(torque_nm: FloatArray, constant_samples: float) -> FloatArray:
    """y of T ẏ + y = τ for a τ that is linear between samples, of the shape of ``torque_nm``.

    With N = T in samples, p = e^(−1/N), a = 1 − (1 − p) N and b = (1 − p) N − p, it is

        y_0 = τ_0,   y_k − p y_k−1 = a τ_k + b τ_k−1,

    a triangular system with two bands.

    Args:
        torque_nm: τ, shape (k,) or (n, k).
        constant_samples: N.
    """
    pole = np.exp(-1.0 / constant_samples)
    present_weight = 1.0 - (1.0 - pole) * constant_samples
    previous_weight = (1.0 - pole) * constant_samples - pole
    # With diag="U" the first row, that of the diagonal, is taken for one.
    bands = np.full((2, torque_nm.shape[-1]), -pole, order="F")
    right_side = present_weight * torque_nm
    right_side[..., 1:] += previous_weight * torque_nm[..., :-1]
    right_side[..., 0] = torque_nm[..., 0]
    columns = np.atleast_2d(right_side).T
    filtered, _ = lapack.dtbtrs(bands, columns, uplo="L", diag="U")
    return np.asarray(filtered.T.reshape(torque_nm.shape))
