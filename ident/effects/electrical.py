"""The motor and its current: less torque at large current, torque ripple, offsets that drift,
and late currents.
"""

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

EARLIEST_S = 0.01
"""By how much a current may be early on one axis: its reference precedes the torque by the current
loop, and a position is read a few cycles late; both are milliseconds. More is no cause of what was
recorded before it.
"""


@dataclass(frozen=True, slots=True)
class Saturation(Effect):
    """τ = c · g v³ + d · g v⁵: at large torque the motor needs more current v than its gain g says.

    v is the current that the model predicts. Where half the torque constant is left at a current h,
    i/(1 + (i/h)²) = v, c is about 1/h² and d about 2/h⁴ (the series converges below v = h/2). With
    the first term alone the gain takes up what is left of the others. Source: saturation of the
    stator iron, the first even terms of the current per torque; Hendershot & Miller, Design of
    Brushless Permanent-Magnet Motors. Signature: large current, odd in it.
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
        """That of one term, then that of two if it has them."""
        return tuple(Saturation(two_terms) for two_terms in range(1 + self.two_terms))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1 or 2, k)."""
        square = signals.current_a[axis] ** 2
        return np.asarray(
            signals.motor_torque_nm[axis] * np.stack((square, square**2)[: 1 + self.two_terms])
        )


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
        return np.stack(cos_sin(self.order * signals.motor_position_rad[axis]))


@dataclass(frozen=True, slots=True)
class OffsetDrift(FadingEffect):
    """τ = c · e^(−t/η), at the motor;  c > 0:
    the reference is too high by c/g at first, beside the declared offset.

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
    backwards: Switch = 0  #: 1 where the filter runs backwards in time, else 0

    def rate(self, torque_nm: FloatArray, rate_hz: float) -> FloatArray:
        """ẏ of a torque [Nm/s], of its shape."""
        return filtered_rate(torque_nm, rate_hz, self.filter_s, backwards=bool(self.backwards))


@dataclass(frozen=True, slots=True)
class Lag(LateCurrent):
    """τ = −c · ẏ,  T ẏ + y = g v;  c > 0: the current is late by c; c < 0:
    it is early, by 10 ms at most.

    v is the current that the model predicts, other effects left out. A first-order lag of time
    constant c is this with T = c; a delay is v(t − c) ≈ v − c v̇ + c²/2 · v̈, this with T = c/2 to
    second order. For an early current the filter runs backwards in time. With T = 0 it is the first
    order alone, which is wrong where the torque jumps, and bends the gain. Source: Taylor and Padé
    expansions of a delay. Signature: rate of torque.
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

    On one axis a delay is a `Lag` (see there for T); the same delay on all axes is a fault of the
    recording. Source: Padé expansion of a delay. Signature: rate of torque, the same time
    everywhere.
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
    """ẏ of T ẏ + y = τ [Nm/s], exact for torques that are linear between samples;
    of the shape of ``torque_nm``.

    It starts as if the first torque had been there for ever. With T = 0, ẏ is the central
    difference of τ.

    Args:
        torque_nm: τ, shape (k,) or (n, k).
        rate_hz: sampling rate.
        filter_s: T.
        backwards: the filter runs from the last sample to the first.
    """
    if backwards:
        return -filtered_rate(torque_nm[..., ::-1], rate_hz, filter_s, backwards=False)[..., ::-1]
    if not filter_s > 0.0:
        return np.asarray(np.gradient(torque_nm, axis=-1) * rate_hz)
    steps = filter_s * rate_hz
    kept = np.exp(-1.0 / steps)
    new = 1.0 - (1.0 - kept) * steps
    old = (1.0 - kept) * steps - kept
    # y_k − kept · y_k−1 = new · τ_k + old · τ_k−1 is a triangular system with two bands.
    band = np.full((2, torque_nm.shape[-1]), -kept, order="F")
    driven = new * torque_nm
    driven[..., 1:] += old * torque_nm[..., :-1]
    driven[..., 0] = torque_nm[..., 0]
    passed = lapack.dtbtrs(band, np.atleast_2d(driven).T, uplo="L", diag="U")[0].T.reshape(
        torque_nm.shape
    )
    return np.asarray((torque_nm - passed) / filter_s)
