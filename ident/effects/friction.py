"""Friction beyond the declared viscous and dry friction."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from ident.arrays import FloatArray
from ident.effects.effect import (
    AxisNumber,
    Effect,
    FadingEffect,
    GearSide,
    Property,
    Range,
    Reported,
    Sense,
    Switch,
    sense_fault,
)
from ident.effects.rotor import least_rotor_rest, loss_columns
from ident.effects.signals import REFERENCE_C, Abscissa, Signals, distance_since_reversal
from ident.model.model import Column
from ident.model.regressor import cos_sin


class SpeedFriction(Effect):
    """Friction that depends on the speed of its joint alone."""

    __slots__ = ()
    abscissa = Abscissa.VELOCITY

    @abstractmethod
    def at_speed(self, velocity_rad_s: FloatArray) -> FloatArray:
        """Torque per unit of each coefficient at velocities, shape (k,) → (p, k)."""

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (p, k)."""
        return self.at_speed(signals.velocity_rad_s[axis])


@dataclass(frozen=True, slots=True)
class Stribeck(SpeedFriction):
    """τ = c · sign(q̇) · exp(−|q̇|/η);  c > 0: more friction at low speed.

    Source: Armstrong-Hélouvry, Dupont & Canudas de Wit, Automatica 30 (1994), the exponential form
    of the Stribeck curve; boundary lubrication gives way to a film as the speed grows past η.
    Signature: low speed, odd in q̇.
    """

    name = "stribeck"
    declares = Property.ODD_IN_VELOCITY
    coefficients = (Column("amplitude", "Nm", least=0.0),)

    #: η, between standstill and a tenth of full speed
    speed_rad_s: Annotated[float, Range(1e-4, 1e2)]

    def at_speed(self, velocity_rad_s: FloatArray) -> FloatArray:
        """Torque per unit of the amplitude, shape (1, k)."""
        v = velocity_rad_s
        return np.asarray(np.sign(v) * np.exp(-np.abs(v) / self.speed_rad_s))[None]


@dataclass(frozen=True, slots=True)
class NonlinearViscous(SpeedFriction):
    """τ = c · sign(q̇) · |q̇|^η;  c > 0: drag against the motion.

    Source: shear-thinning grease (η < 1) and churning losses (η = 2, 3); Harris & Kotzalas, Rolling
    Bearing Analysis, where load-free bearing drag grows with speed to the power 2/3. Signature: all
    speeds, odd in q̇.
    """

    name = "nonlinear-viscous"
    declares = Property.ODD_IN_VELOCITY

    #: η; one would be the declared viscous friction itself
    exponent: Annotated[float, Range(0.05, 10.0)]

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """Linear parameter, with a unit that depends on the exponent."""
        return (Column("coefficient", f"Nm/(rad/s)^{self.exponent:.3g}", least=0.0),)

    @property
    def nearly_declared(self) -> Mapping[str, Range]:
        """With an exponent near one it is viscous friction."""
        return {"exponent": Range(0.8, 1.25)}

    def at_speed(self, velocity_rad_s: FloatArray) -> FloatArray:
        """Torque per unit of the coefficient, shape (1, k)."""
        v = velocity_rad_s
        return np.asarray(np.sign(v) * np.abs(v) ** self.exponent)[None]


@dataclass(frozen=True, slots=True)
class AsymmetricViscous(SpeedFriction):
    """τ = c · |q̇|;  c > 0: more viscous friction in the positive direction than in the negative
    one.

    Source: the even part of Fv⁺q̇ for q̇ > 0, Fv⁻q̇ for q̇ < 0 (Swevers et al., IEEE TRA 13
    (1997)); the odd part is the declared viscous friction. Signature: even in q̇.
    """

    name = "asymmetric-viscous"
    declares = Property.EVEN_IN_VELOCITY
    coefficients = (Column("coefficient", "Nm/(rad/s)"),)

    def at_speed(self, velocity_rad_s: FloatArray) -> FloatArray:
        """Torque per unit of the coefficient, shape (1, k)."""
        return np.asarray(np.abs(velocity_rad_s))[None]


@dataclass(frozen=True, slots=True)
class LoadFriction(Effect):
    """τ = c · |τ_L| · sign(q̇) · |q̇|^η, τ_L the torque for links and payload;  c > 0:
    friction grows with the load.

    Where the model's τ_L contains the rotor, J q̈ is taken off, and d · ∂τ/∂J / c is a second
    column (`with_rotor`): see `ident.effects.rotor`.

    Source: Amontons' law at the gear mesh; Hamon, Gautier & Garrec, IROS 2010, "Dynamic
    identification of robots with a dry friction model depending on load and velocity". Signature:
    sign × load; loaded and unloaded runs differ in it.
    """

    name = "load-friction"
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.LOAD
    has_rotor_form = True
    form_settings = ("rotor_inertia_kg_m2", "with_rotor")
    added_settings = ("rotor_inertia_kg_m2", "with_rotor")

    speed_exponent: Switch  #: η, 0 for dry and 1 for viscous friction
    #: J, of the rotor in the model's load torque
    rotor_inertia_kg_m2: Annotated[float, Range(0.0, 1e6)] = 0.0
    #: 1 where the rest of the rotor's inertia is fitted, d = c (Ia − J), else 0
    with_rotor: Switch = 0

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """C, and d with the rotor; units depend on the exponent."""
        least = least_rotor_rest(self.rotor_inertia_kg_m2)
        if self.speed_exponent:
            loss = Column("coefficient", "(rad/s)^-1", least=0.0)
            rest = Column("rotor rest", "kg m²/(rad/s)", least=least)
        else:
            loss = Column("coefficient", "Nm/Nm", least=0.0)
            rest = Column("rotor rest", "kg m²", least=least)
        return (loss, rest)[: 1 + self.with_rotor]

    @property
    def reported(self) -> Reported:
        """A share of the load of dry friction; of viscous friction its coefficient."""
        if self.speed_exponent:
            return Reported.COEFFICIENTS
        return Reported.SHARE_OF_LOAD

    @property
    def forms(self) -> tuple[LoadFriction, ...]:
        """With J as it is, then with the rest of it where that is fitted."""
        return tuple(replace(self, with_rotor=fitted) for fitted in range(1 + self.with_rotor))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1 or 2, k)."""
        v = signals.velocity_rad_s[axis]
        rubbing = np.sign(v) * np.abs(v) ** self.speed_exponent
        load_nm = signals.load_torque_nm[axis]
        with_rotor = bool(self.with_rotor)
        return loss_columns(
            signals, axis, load_nm, rubbing, self.rotor_inertia_kg_m2, with_rotor=with_rotor
        )


@dataclass(frozen=True, slots=True)
class PositionFriction(Effect):
    """τ = sign(q̇) · (a cos q + b sin q);  a > 0: more dry friction at q = 0.

    Source: first harmonic of a run-out of gear, seal or bearing over one joint revolution;
    Armstrong-Hélouvry (1991), "Control of Machines with Friction", ch. 4. Signature: sign ×
    position.
    """

    name = "position-friction"
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.POSITION
    coefficients = (Column("cosine", "Nm"), Column("sine", "Nm"))
    reported = Reported.AMPLITUDE
    needs_revolute = True

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        q = signals.position_rad[axis]
        s = np.sign(signals.velocity_rad_s[axis])
        return np.asarray(np.stack(cos_sin(q)) * s)


@dataclass(frozen=True, slots=True)
class Presliding(Effect):
    """τ = c · (z − sign(q̇)),  dz/dq = (1 − z · sign(q̇))/η;  c > 0:
    friction builds up after a reversal.

    Instead of the declared sign(q̇), a part c of the dry friction follows z. Source: Dahl (1968),
    "A solid friction model". Signature: distance since the last reversal.
    """

    name = "presliding"
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.DISTANCE
    coefficients = (Column("amplitude", "Nm", least=0.0),)

    distance_rad: Annotated[float, Range(1e-6, 1e2)]  #: η, over which 63 % of a change of z happens

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        direction, distance = distance_since_reversal(signals.velocity_rad_s[axis], signals.rate_hz)
        # z − direction: after a reversal it starts where the last one ended, and dies out over the
        # distance.
        faded = np.exp(-distance / self.distance_rad)
        starts = np.flatnonzero(np.diff(direction, prepend=np.nan) != 0)
        lag = np.empty_like(direction)
        bristle = 0.0
        for first, last in zip(starts, np.append(starts[1:], len(direction)), strict=True):
            lag[first:last] = (bristle - direction[first]) * faded[first:last]
            bristle = direction[first] + lag[last - 1]
        return lag[None]


@dataclass(frozen=True, slots=True)
class PassiveFriction(Effect):
    """τ = a sign(q̇) + b q̇ on a joint without a motor;  a, b > 0:
    bearings of a closed chain brake.

    Source: Coulomb's law and a film of oil; in the equations of the motors it appears through the
    leverage of the joint (Briot & Gautier, Multibody System Dynamics 2015, friction of passive
    joints). Signature: odd in the speed of the passive joint, on all motors of its loop.
    """

    name = "passive-friction"
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.VELOCITY
    with_motor = False
    coefficients = (Column("dry", "Nm", least=0.0), Column("viscous", "Nm/(rad/s)", least=0.0))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        v = signals.velocity_rad_s[axis]
        return np.stack((np.sign(v), v))


@dataclass(frozen=True, slots=True)
class WarmUp(FadingEffect):
    """τ = e^(−t/η) · (c_s · sign(q̇) + c_v · q̇);  c_s, c_v > 0: more friction while cold.

    Source: grease is stiff when cold, and the heat of the losses fills the joint's capacity with
    one time constant; Bittencourt & Axelsson, "Modeling and experiment design for identification of
    wear in a robot joint under load and temperature uncertainties based on friction data",
    IEEE/ASME Trans. Mechatronics 19 (2014). Signature: time.
    """

    name = "warm-up"
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.TIME
    coefficients = (Column("dry", "Nm", least=0.0), Column("viscous", "Nm/(rad/s)", least=0.0))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        cold = self.left(signals)
        v = signals.velocity_rad_s[axis]
        return np.stack((cold * np.sign(v), cold * v))


SMALLEST_WARMING_K = 1.0  #: Range of a temperature that some sensors of drives round away


@dataclass(frozen=True, slots=True)
class TemperatureFriction(Effect):
    """τ = (T − T₀) · (c_s · sign(q̇) + c_v · q̇), T the recorded temperature, T₀ = 40 °C;  c_v < 0:
    less while warm.

    The declared friction is then that at T₀, for which see `ident.effects.signals.REFERENCE_C`. A
    lubricant's viscosity falls with temperature, so c_v is not positive; dry friction may go either
    way, by preload and by film. Source: Bittencourt & Gunnarsson, "Static friction in a robot
    joint: modeling and identification of load and temperature effects", ASME J. Dynamic Systems,
    Measurement, and Control 134 (2012), to first order. Signature: temperature.
    """

    name = "temperature-friction"
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.TEMPERATURE
    coefficients = (Column("dry", "Nm/K"), Column("viscous", "Nm/(rad/s)/K", largest=0.0))

    def fits_in(self, runs: Sequence[Signals], axis: int) -> bool:
        """Whether every run has the temperature of the axis, and it changes over them."""
        if any(
            run.temperature_c is None or np.isnan(run.temperature_c[axis]).any() for run in runs
        ):
            return False
        values = [run.temperature(axis) for run in runs]
        return bool(max(map(np.max, values)) - min(map(np.min, values)) >= SMALLEST_WARMING_K)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k); zero where the temperature was not recorded."""
        above_k = signals.temperature(axis) - REFERENCE_C
        v = signals.velocity_rad_s[axis]
        return np.stack((above_k * np.sign(v), above_k * v))


@dataclass(frozen=True, slots=True)
class Coupling(Effect):
    """τ_i = c_s · sign(q̇_i ± q̇_j) + c_v · (q̇_i ± q̇_j), and ± the same on joint j;  c > 0:
    against the relative motion.

    Source: a shaft, belt or hose of one joint that runs through another (paper eq. 25). Signature:
    another axis' speed.
    """

    name = "coupling"
    side = GearSide.TWO_JOINTS
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.OTHER_VELOCITY
    coefficients = (Column("dry", "Nm", least=0.0), Column("viscous", "Nm/(rad/s)", least=0.0))

    other_axis: AxisNumber  #: number of joint j, from 1; joint i is the one with the lower number
    sense: Sense  #: 1 for the sum of the speeds, −1 for their difference

    @property
    def settings_fault(self) -> str:
        """A sense of 0 is none."""
        return sense_fault(self.sense)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, 2, k)."""
        shared = (
            signals.velocity_rad_s[axis] + self.sense * signals.velocity_rad_s[self.other_axis - 1]
        )
        friction = np.stack((np.sign(shared), shared))
        return np.stack((friction, self.sense * friction))
