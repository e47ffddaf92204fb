"""Torques that depend on the joint's position alone: springs, gravity compensators, cables and hoses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ident.arrays import FloatArray
from ident.effects.effect import Effect, Property, Range, Sense
from ident.effects.signals import Abscissa, Signals
from ident.model.model import Column
from ident.model.regressor import cos_sin


@dataclass(frozen=True, slots=True)
class Spring(Effect):
    """τ = c · q, with c · q₀ in the declared offset;  c > 0: pulls towards q₀.

    Source: Hooke's law. Signature: position, at any speed; a gravity term differs from it over a large range only.
    """

    name = "spring"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.POSITION
    coefficients = (Column("stiffness", "Nm/rad"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        return np.asarray(signals.position_rad[axis])[None]


@dataclass(frozen=True, slots=True)
class Compensator(Effect):
    """τ = a cos kq + b sin kq;  a > 0: the motor pushes in the positive direction at q = 0.

    Source: a compensating spring between two points of the arm, to its first harmonics; Ulrich & Kumar (1991),
    "Passive mechanical gravity compensation for robot manipulators". Signature: position, at any speed.
    """

    name = "gravity-compensator"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.POSITION
    coefficients = (Column("cosine", "Nm"), Column("sine", "Nm"))
    needs_revolute = True

    order: Annotated[int, Range(1, 1000)]  #: k, in the joint's revolutions

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        return np.stack(cos_sin(self.order * signals.position_rad[axis]))


@dataclass(frozen=True, slots=True)
class Hinge(Effect):
    """τ = c · max(0, σ (q − q₀));  c > 0: the motor pushes in the positive direction beyond q₀.

    Source: Hooke's law of a slack cable or hose. Signature: position, on one side of q₀.
    """

    name = "hinge"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.POSITION
    coefficients = (Column("stiffness", "Nm/rad"),)

    start_rad: Annotated[float, Range(-1e3, 1e3)]  #: q₀
    sense: Sense  #: σ, 1 where it pulls above q₀, −1 below

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        return np.asarray(np.maximum(0.0, self.sense * (signals.position_rad[axis] - self.start_rad)))[None]
