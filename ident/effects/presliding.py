"""Dry friction that builds up over a distance after each reversal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.effects.abscissa import Abscissa, way_since_reversal
from ident.effects.effect import Property, Side
from ident.model import Column
from ident.signals import Signals

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Presliding:
    """τ = c · (z − sign(q̇)),  dz/dq = (1 − z · sign(q̇))/η

    Instead of the declared sign(q̇), a part c of the dry friction follows z. Source: Dahl (1968), "A solid friction
    model". Signature: distance since the last reversal.

    Attributes:
        distance_rad: η, over which 63 % of a change of z happens.
    """

    name: ClassVar[str] = "presliding"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.DISTANCE

    distance_rad: float

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"distance_rad": self.distance_rad}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("amplitude", "Nm"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        direction, distance = way_since_reversal(signals.velocity_rad_s[axis], signals.rate_hz)
        return np.asarray(_lag_of_bristle(direction, distance, self.distance_rad))[None]


def _lag_of_bristle(direction: FloatArray, way_rad: FloatArray, distance_rad: float) -> FloatArray:
    """z − direction: after a reversal it starts where the last one had come to, and dies out over the distance."""
    faded = np.exp(-way_rad / distance_rad)
    starts = np.flatnonzero(np.diff(direction, prepend=np.nan) != 0)
    lag = np.empty_like(direction)
    bristle = 0.0
    for first, last in zip(starts, np.append(starts[1:], len(direction)), strict=True):
        part = slice(first, last)
        lag[part] = (bristle - direction[first]) * faded[part]
        bristle = direction[first] + lag[last - 1]
    return lag
