"""Currents that are recorded later than positions: a filter in one drive, or a time skew of the whole record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray
from ident.effects.effect import Effect, Property, Side
from ident.effects.signals import Abscissa, Signals
from ident.model.model import Column


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
