"""Torques that depend on positions alone, of one joint or of two:
springs, gravity compensators, cables and hoses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ident.arrays import FloatArray
from ident.effects.effect import (
    AxisNumber,
    Effect,
    GearSide,
    Property,
    Range,
    Reported,
    Sense,
    Switch,
    sense_fault,
)
from ident.effects.signals import Abscissa, Signals
from ident.model.model import Column
from ident.model.regressor import cos_sin

CABLE_REACH = 2
"""Largest distance of the two joints that a cable or hose is led along, in joints:
between joints farther apart, others would stretch it as well.
"""

LEAST_CABLE_MOVES = 35
"""Fewest moves of the data with which a search tries a cable.

A term without a name needs as many: a cable's settings are chosen from as many shapes. In ten moves
of a real arm, a cable was accepted that raised the error where the arm had not been.
"""


@dataclass(frozen=True, slots=True)
class Spring(Effect):
    """τ = c · q, with c · q₀ in the declared offset;  c > 0: pulls towards q₀.

    Source: Hooke's law. Signature: position, at any speed; a gravity term differs from it over a
    large range only.
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

    Source: Hooke's law. Signature: position of the passive joint, on all motors of its loop. The
    torque a at position zero is no declared offset there, so it is a parameter of its own.
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

    Source: a compensating spring between two points of the arm, to its first harmonics; Ulrich &
    Kumar (1991), "Passive mechanical gravity compensation for robot manipulators". Signature:
    position, at any speed.
    """

    name = "gravity-compensator"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.POSITION
    coefficients = (Column("cosine", "Nm"), Column("sine", "Nm"))
    reported = Reported.AMPLITUDE
    needs_revolute = True

    order: Annotated[int, Range(1, 1000)]  #: k, periods in one revolution of the joint

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        return np.stack(cos_sin(self.order * signals.position_rad[axis]))


@dataclass(frozen=True, slots=True)
class Counterbalance(Effect):
    """τ = c₀ sin x / w + c₁ sin x (1 − (1 − ρ)/w),  w = √(1 + ρ² − 2ρ cos x),  x = q − α;
    c₀, c₁ > 0: it pulls.

    A balancer pulls a lever of length L on the moving link towards its foot, at a from the axis on
    the link before; ρ = l/b with l = min(a, L) and b = max(a, L), and α is the position where the
    lever points at the foot. Its length is s = b w, shortest at s₁ = b (1 − ρ), and its force
    F = F₁ + k (s − s₁) gives the torque F ds/dq: c₀ = F₁ l is the preload's share and c₁ = k a L
    the spring's. The motor must push away from q = α. Source: Klimchik, Wu, Caro, Dumas, Furet &
    Pashkevich (2013), "Modelling of the gravity compensators in robotic manufacturing cells".

    sin x is gravity's torque, too. Where nothing else shows the first moments of the links, it
    belongs to them, and only c sin x / w is new, with c = (F₁ − k s₁) l of either sign:
    `with_spring` = 0. Signature: position, at any speed, with harmonics.
    """

    name = "counterbalance"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.POSITION
    needs_revolute = True
    refined = ("ratio", "phase_rad")

    #: ρ; below this range the torque is that of gravity with a second harmonic, which does not
    #: determine ρ and α.
    ratio: Annotated[float, Range(0.05, 0.95)]
    phase_rad: Annotated[float, Range(-10.0, 10.0)]  #: α
    with_spring: Switch = 1  #: 1 where sin x can be told from gravity, else 0

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """c₀ and c₁, or c alone."""
        if not self.with_spring:
            return (Column("harmonics", "Nm"),)
        return (Column("preload", "Nm", least=0.0), Column("stiffness", "Nm", least=0.0))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k) or (1, k)."""
        cosine, sine = cos_sin(signals.position_rad[axis] - self.phase_rad)
        relative_length = np.sqrt(1.0 + self.ratio**2 - 2.0 * self.ratio * cosine)  # w
        sine_over_length = sine / relative_length
        if self.with_spring:
            of_spring = sine - (1.0 - self.ratio) * sine_over_length
            return np.stack((sine_over_length, of_spring))
        return np.asarray(sine_over_length)[None]


@dataclass(frozen=True, slots=True)
class Hinge(Effect):
    """τ = c · max(0, σ (q − q₀));  c > 0: the motor pushes in the positive direction beyond q₀.

    A cable or hose only pulls: what it stores beyond q₀ grows, ½ σ c (q − q₀)², and so σ c ≥ 0. One
    that lets go beyond q₀ is the hinge of the other σ. Source: Hooke's law of a slack cable or
    hose. Signature: position, on one side.
    """

    name = "hinge"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.POSITION
    refined_once_chosen = ("start_rad",)

    start_rad: Annotated[float, Range(-1e3, 1e3)]  #: q₀
    sense: Sense  #: σ, 1 where it pulls above q₀, −1 below

    @property
    def settings_fault(self) -> str:
        """A sense of 0 is none."""
        return sense_fault(self.sense)

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameter, of the sign of σ."""
        if self.sense > 0:
            return (Column("stiffness", "Nm/rad", least=0.0),)
        return (Column("stiffness", "Nm/rad", largest=0.0),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        beyond_start = self.sense * (signals.position_rad[axis] - self.start_rad)
        stretch = np.maximum(0.0, beyond_start)
        return np.asarray(stretch)[None]


@dataclass(frozen=True, slots=True)
class AlongTwoJoints(Effect):
    """A cable or hose that is led along two joints."""

    side = GearSide.TWO_JOINTS
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.POSITION
    reach = CABLE_REACH
    least_moves = LEAST_CABLE_MOVES

    other_axis: AxisNumber  #: number of joint j, from 1; joint i is the one with the lower number


@dataclass(frozen=True, slots=True)
class Cable(AlongTwoJoints):
    """τ_i = a q_i + b q_j and τ_j = b q_i + c q_j, with the torques at zero in the declared
    offsets;  a, c > 0.

    Source: Hooke's law of a cable or hose that both joints stretch. One potential gives both
    torques, V = ½ a q_i² + b q_i q_j + ½ c q_j², so b is the same in both. Led around the joints at
    radii r_i and r_j, it has a = k r_i², b = k r_i r_j and c = k r_j². Signature: positions of two
    joints, at any speed.
    """

    name = "cable"
    coefficients = (
        Column("stiffness", "Nm/rad", least=0.0),
        Column("shared stiffness", "Nm/rad"),
        Column("other stiffness", "Nm/rad", least=0.0),
    )

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, 3, k): of a, b and c on joint i, then on joint j."""
        own = signals.position_rad[axis]
        other = signals.position_rad[self.other_axis - 1]
        zero = np.zeros_like(own)
        on_own = np.stack((own, other, zero))
        on_other = np.stack((zero, own, other))
        return np.stack((on_own, on_other))


@dataclass(frozen=True, slots=True)
class SlackCable(AlongTwoJoints):
    """τ_i = c h cos φ and τ_j = c h sin φ,  h = max(0, q_i cos φ + q_j sin φ − s₀);  c > 0:
    it pulls beyond s₀.

    A cable along two joints that hangs slack before s₀: its potential is ½ c h². φ says how much of
    its way each joint makes, tan φ = r_j/r_i with the radii at which it is led around them. Source:
    Hooke's law of a slack cable or hose. Signature: positions of two joints, on one side.
    """

    name = "slack-cable"
    coefficients = (Column("stiffness", "Nm/rad", least=0.0),)
    refined = ("direction_rad", "start_rad")

    direction_rad: Annotated[float, Range(-10.0, 10.0)]  #: φ
    start_rad: Annotated[float, Range(-1e3, 1e3)] = 0.0  #: s₀

    def way(self, signals: Signals, axis: int) -> FloatArray:
        """q_i cos φ + q_j sin φ: way of the cable, divided by √(r_i² + r_j²) [rad], shape (k,)."""
        on_own = np.cos(self.direction_rad) * signals.position_rad[axis]
        on_other = np.sin(self.direction_rad) * signals.position_rad[self.other_axis - 1]
        return np.asarray(on_own + on_other)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, 1, k): of c on joint i, then on joint j."""
        stretch = np.maximum(0.0, self.way(signals, axis) - self.start_rad)
        on_own = np.cos(self.direction_rad) * stretch
        on_other = np.sin(self.direction_rad) * stretch
        return np.stack((on_own, on_other))[:, None]
