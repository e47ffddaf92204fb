"""Friction that is higher at low speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.discovery.signals import Signals
from ident.effects.effect import Abscissa, Property, Side, distance_since_reversal
from ident.model.model import Column

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Stribeck:
    """τ = c · sign(q̇) · exp(−|q̇|/η)

    Source: Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994), the exponential form of the Stribeck
    curve; boundary lubrication gives way to a film as the speed grows past η. Signature: low speed, odd in q̇.

    Attributes:
        speed_rad_s: η, between standstill and a tenth of full speed.
    """

    name: ClassVar[str] = "stribeck"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.VELOCITY

    speed_rad_s: float

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"speed_rad_s": self.speed_rad_s}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("amplitude", "Nm"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        v = signals.velocity_rad_s[axis]
        return np.asarray(np.sign(v) * np.exp(-np.abs(v) / self.speed_rad_s))[None]


# Viscous friction that is not proportional to speed.


@dataclass(frozen=True, slots=True)
class NonlinearViscous:
    """τ = c · sign(q̇) · |q̇|^η

    Source: shear-thinning grease (η < 1) and churning losses (η = 2, 3); Harris & Kotzalas, Rolling Bearing Analysis,
    where load-free bearing drag grows with speed to the power 2/3. Signature: all speeds, odd in q̇.

    Attributes:
        exponent: η; one would be the declared viscous friction itself.
    """

    name: ClassVar[str] = "nonlinear-viscous"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.VELOCITY

    exponent: float

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"exponent": self.exponent}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("coefficient", f"Nm/(rad/s)^{self.exponent:.3g}"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        v = signals.velocity_rad_s[axis]
        return np.asarray(np.sign(v) * np.abs(v) ** self.exponent)[None]


# Viscous friction that differs between the two directions.


@dataclass(frozen=True, slots=True)
class AsymmetricViscous:
    """τ = c · |q̇|

    Source: the even part of Fv⁺q̇ for q̇ > 0, Fv⁻q̇ for q̇ < 0 (Swevers et al., IEEE TRA 13 (1997)); the odd part is the
    declared viscous friction. Signature: even in q̇.
    """

    name: ClassVar[str] = "asymmetric-viscous"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.EVEN_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.VELOCITY

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("coefficient", "Nm/(rad/s)"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        return np.asarray(np.abs(signals.velocity_rad_s[axis]))[None]


# Dry friction that grows with the load on the teeth.


@dataclass(frozen=True, slots=True)
class LoadFriction:
    """τ = c · |τ_L| · sign(q̇) · |q̇|^η

    τ_L is the torque that links and payload ask of the joint. Source: Amontons' law at the gear mesh; Hamon, Gautier &
    Garrec, IROS 2010, "Dynamic identification of robots with a dry friction model depending on load and velocity".
    Signature: sign × load; loaded and unloaded runs differ in it.

    Attributes:
        speed_exponent: η, 0 for dry and 1 for viscous friction.
    """

    name: ClassVar[str] = "load-friction"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.LOAD

    speed_exponent: int

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"speed_exponent": self.speed_exponent}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("coefficient", "(rad/s)^-1" if self.speed_exponent else "Nm/Nm"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (1, k)."""
        v = signals.velocity_rad_s[axis]
        rubbing = np.sign(v) * np.abs(v) ** self.speed_exponent
        return np.asarray(np.abs(signals.load_torque_nm[axis]) * rubbing)[None]


# Dry friction that changes with the joint's position.


@dataclass(frozen=True, slots=True)
class PositionFriction:
    """τ = sign(q̇) · (a cos q + b sin q)

    Source: first harmonic of a run-out of gear, seal or bearing over one joint revolution; Armstrong-Hélouvry (1991),
    "Control of Machines with Friction", ch. 4. Signature: sign × position.
    """

    name: ClassVar[str] = "position-friction"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.POSITION

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("cosine", "Nm"), Column("sine", "Nm"))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (2, k)."""
        q, s = signals.position_rad[axis], np.sign(signals.velocity_rad_s[axis])
        return np.stack((s * np.cos(q), s * np.sin(q)))


# Dry friction that builds up over a distance after each reversal.


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
        direction, distance = distance_since_reversal(signals.velocity_rad_s[axis], signals.rate_hz)
        return np.asarray(_lag_of_bristle(direction, distance, self.distance_rad))[None]


def _lag_of_bristle(direction: FloatArray, travel_rad: FloatArray, distance_rad: float) -> FloatArray:
    """z − direction: after a reversal it starts where the last one had come to, and dies out over the distance."""
    faded = np.exp(-travel_rad / distance_rad)
    starts = np.flatnonzero(np.diff(direction, prepend=np.nan) != 0)
    lag = np.empty_like(direction)
    bristle = 0.0
    for first, last in zip(starts, np.append(starts[1:], len(direction)), strict=True):
        part = slice(first, last)
        lag[part] = (bristle - direction[first]) * faded[part]
        bristle = direction[first] + lag[last - 1]
    return lag


# Friction of a joint that is cold when the session begins.


@dataclass(frozen=True, slots=True)
class WarmUp:
    """τ = e^(−t/η) · (c_s · sign(q̇) + c_v · q̇)

    Source: grease is stiff when cold, and the heat of the losses fills the joint's capacity with one time constant;
    Bittencourt & Axelsson, "Modeling and experiment design for identification of wear in a robot joint under load and
    temperature uncertainties based on friction data", IEEE/ASME Trans. Mechatronics 19 (2014). Signature: time.

    Attributes:
        time_constant_s: η, from half a run to many.
        whole_session: 1 where t counts from the first run of the session, 0 where from the beginning of each run, as
            after a power-on.
    """

    name: ClassVar[str] = "warm-up"
    side: ClassVar[Side] = Side.JOINT
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.TIME

    time_constant_s: float
    whole_session: int

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"time_constant_s": self.time_constant_s, "whole_session": self.whole_session}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("dry", "Nm"), Column("viscous", "Nm/(rad/s)"))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (2, k)."""
        time_s = signals.session_s if self.whole_session else signals.time_s
        cold, v = np.exp(-time_s / self.time_constant_s), signals.velocity_rad_s[axis]
        return np.stack((cold * np.sign(v), cold * v))


# Friction between two joints that the drive train does not know of.


@dataclass(frozen=True, slots=True)
class Coupling:
    """τ_i = c_s · sign(q̇_i ± q̇_j) + c_v · (q̇_i ± q̇_j), and ± the same on joint j

    Source: a shaft, belt or hose of one joint that runs through another (paper eq. 25). Signature: another axis' speed.

    Attributes:
        other_axis: number of joint j, from 1; joint i is the one with the lower number.
        sense: 1 for the sum of the speeds, −1 for their difference.
    """

    name: ClassVar[str] = "coupling"
    side: ClassVar[Side] = Side.TWO_JOINTS
    holds: ClassVar[Property] = Property.ODD_IN_VELOCITY
    abscissa: ClassVar[Abscissa] = Abscissa.OTHER_VELOCITY

    other_axis: int
    sense: int

    @property
    def settings(self) -> dict[str, float]:
        """The searched parameters."""
        return {"other_axis": self.other_axis, "sense": self.sense}

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameters."""
        return (Column("dry", "Nm"), Column("viscous", "Nm/(rad/s)"))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Torque per unit of each coefficient, shape (2, 2, k)."""
        shared = signals.velocity_rad_s[axis] + self.sense * signals.velocity_rad_s[self.other_axis - 1]
        friction = np.stack((np.sign(shared), shared))
        return np.stack((friction, self.sense * friction))
