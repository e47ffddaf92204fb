"""Torques that depend on the joint's position alone: springs, gravity compensators, cables and hoses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ident.arrays import FloatArray
from ident.effects.effect import Effect, Property, Range, Sense, Switch
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
class PassiveSpring(Effect):
    """τ = c q + a on a joint without a motor;  c > 0: pulls towards −a/c.

    Source: Hooke's law. Signature: position of the passive joint, on all motors of its loop. The torque a at position
    zero is no declared offset there, so it is a parameter of its own.
    """

    name = "passive-spring"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.POSITION
    with_motor = False
    coefficients = (Column("stiffness", "Nm/rad"), Column("preload", "Nm"))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        q = signals.position_rad[axis]
        return np.stack((q, np.ones_like(q)))


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
class Counterbalance(Effect):
    """τ = c₀ sin x / w + c₁ sin x (1 − (1 − ρ)/w),  w = √(1 + ρ² − 2ρ cos x),  x = q − α;  c₀, c₁ > 0: it pulls.

    A balancer pulls a lever of length L on the moving link towards its foot, at a from the axis on the link before;
    ρ = l/b with l = min(a, L) and b = max(a, L), and α is the position where the lever points at the foot. Its length
    is s = b w, shortest at s₁ = b (1 − ρ), and its force F = F₁ + k (s − s₁) gives the torque F ds/dq: c₀ = F₁ l is the
    preload's share and c₁ = k a L the spring's. The motor must push away from q = α. Source: Klimchik, Wu, Caro, Dumas,
    Furet & Pashkevich (2013), "Modelling of the gravity compensators in robotic manufacturing cells".

    sin x is gravity's torque, too. Where nothing else shows the first moments of the links, it belongs to them, and
    only c sin x / w is new, with c = (F₁ − k s₁) l of either sign: `with_spring` = 0. Signature: position, at any
    speed, with harmonics.
    """

    name = "counterbalance"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.POSITION
    needs_revolute = True
    refined = ("ratio", "phase_rad")

    #: ρ; with a shorter lever the torque is that of gravity and its second harmonic, and ρ and α do not show.
    ratio: Annotated[float, Range(0.05, 0.95)]
    phase_rad: Annotated[float, Range(-10.0, 10.0)]  #: α
    with_spring: Switch = 1  #: 1 where sin x is identified beside gravity, else 0

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """c₀ and c₁, or c alone."""
        if not self.with_spring:
            return (Column("harmonics", "Nm"),)
        return (Column("preload", "Nm", least=0.0), Column("stiffness", "Nm", least=0.0))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k) or (1, k)."""
        cosine, sine = cos_sin(signals.position_rad[axis] - self.phase_rad)
        bent = sine / np.sqrt(1.0 + self.ratio**2 - 2.0 * self.ratio * cosine)
        return np.stack((bent, sine - (1.0 - self.ratio) * bent)) if self.with_spring else np.asarray(bent)[None]


@dataclass(frozen=True, slots=True)
class Hinge(Effect):
    """τ = c · max(0, σ (q − q₀));  c > 0: the motor pushes in the positive direction beyond q₀.

    A cable or hose only pulls: what it stores beyond q₀ grows, ½ σ c (q − q₀)², and so σ c ≥ 0. One that lets go beyond
    q₀ is the hinge of the other σ. Source: Hooke's law of a slack cable or hose. Signature: position, on one side.
    """

    name = "hinge"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.POSITION

    start_rad: Annotated[float, Range(-1e3, 1e3)]  #: q₀
    sense: Sense  #: σ, 1 where it pulls above q₀, −1 below

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameter, of the sign of σ."""
        if self.sense > 0:
            return (Column("stiffness", "Nm/rad", least=0.0),)
        return (Column("stiffness", "Nm/rad", largest=0.0),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        return np.asarray(np.maximum(0.0, self.sense * (signals.position_rad[axis] - self.start_rad)))[None]
