"""A current that is seen later than the position: a filter in the drive, or a time skew of the record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.discovery.signals import Signals
from ident.effects.effect import Abscissa, Property, Side
from ident.model.model import Column

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Lag:
    """τ = −c · d(g v)/dt

    v(t − c) ≈ v(t) − c v̇(t) with the current that the model predicts. Source: first-order expansion of a delay, and of
    a first-order lag of time constant c alike: the two cannot be told apart here. Signature: rate of torque.
    """

    name: ClassVar[str] = "lag"
    side: ClassVar[Side] = Side.MOTOR
    holds: ClassVar[Property] = Property.RATE_OF_TORQUE
    abscissa: ClassVar[Abscissa] = Abscissa.TORQUE_RATE

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("time", "s"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        return np.asarray(-np.gradient(signals.motor_torque_nm[axis]) * signals.rate_hz)[None]


# Positions and currents that were not sampled at the same time, on all axes alike.


@dataclass(frozen=True, slots=True)
class TimeSkew:
    """τ_i = −c · d(g_i v_i)/dt of every motor i

    The current that belongs to a position was seen c later: v(t − c) ≈ v(t) − c v̇(t), with the current that the model
    predicts. On one axis it is a lag (lag.py); on all of them alike it is a fault of the recording. Source: first-order
    expansion of a delay. Signature: rate of torque, the same time everywhere.
    """

    name: ClassVar[str] = "time-skew"
    side: ClassVar[Side] = Side.ALL_MOTORS
    holds: ClassVar[Property] = Property.RATE_OF_TORQUE
    abscissa: ClassVar[Abscissa] = Abscissa.TORQUE_RATE

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("time", "s"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (n, 1, k); the axis does not matter."""
        return np.asarray(-np.gradient(signals.motor_torque_nm, axis=1) * signals.rate_hz)[:, None]
