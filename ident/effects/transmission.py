"""Gears that lose power, gears and shafts that are not rigid behind the motors' encoders,
and inertia shared by two.

What a twist between motor and joint does is computed in `ident.effects.twist`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from ident.arrays import FloatArray
from ident.effects.effect import AxisNumber, Effect, GearSide, Property, Range, Reported, Switch
from ident.effects.rotor import beside_rotor, least_rotor_rest, loss_columns
from ident.effects.signals import Abscissa, Signals, curvature
from ident.effects.twist import Gears, link_of, spring_torque, torque_of_twist, twists
from ident.model.model import Column
from ident.model.regressor import cos_sin


@dataclass(frozen=True, slots=True)
class Backlash(Effect):
    """τ_i = c (D_i(δ) − M_ij δ̈)/b,  M_jj δ̈ = τ_j − y,  y = (δ ± b)/c₀ + 2ζ√(M_jj/c₀)
    δ̇ on a flank, 0 in the gap.

    c > 0 is half the gap. The joint lags its motor by δ: half the gap on the side to which it is
    pushed and the bend of the flank; where the torque turns, it crosses. τ_j is the torque that a
    rigid gear would pass, with friction, and M the mass matrix. With b = 0 the crossing follows the
    torque at once, δ = c tanh(τ_j/w): for light links and stiff flanks only. Where its own friction
    holds the link, its motor crosses the gap, and τ_j = c (y − τ_j)/b on the joint itself. Source:
    Nordin & Gutman (2002), "Controlling mechanical systems with backlash", Automatica 38, the
    dead-zone model. Signature: sign changes of the load, each with a blow at its end; starts
    without a load.
    """

    name = "backlash"
    side = GearSide.ALL_JOINTS
    declares = Property.ODD_IN_LOAD
    abscissa = Abscissa.LOAD
    coefficients = (Column("half gap", "rad", least=0.0),)
    form_settings = ("held", "sags", "rotor_inertia_kg_m2")
    added_settings = ("half_gap_rad", "resonant_rad_nm", "damping_ratio", *form_settings)
    refined = ()  # by `ident.discovery.resonance`

    #: W, over which the side changes, in parts of the load's root mean square; 0 where the crossing
    #: is computed.
    share: Annotated[float, Range(0.0, 1.0)]
    half_gap_rad: Annotated[float, Range(0.0, 1.0)] = 0.0  #: b, with which the crossing is computed
    resonant_rad_nm: Annotated[float, Range(0.0, 10.0)] = 0.0  #: c₀, compliance of the flanks
    damping_ratio: Annotated[float, Range(0.0, 10.0)] = 0.0  #: ζ
    held: Switch = 0  #: 1 where the link's own friction holds it, else 0
    sags: Switch = 0  #: 1 where D_i is in the column: the arm stands elsewhere, by the twist
    #: J, of the rotor in the model's load torque
    rotor_inertia_kg_m2: Annotated[float, Range(0.0, 1e6)] = 0.0

    @property
    def known_rotor_kg_m2(self) -> float:
        """J, which it takes off the load."""
        return self.rotor_inertia_kg_m2

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 1, k)."""
        if self.half_gap_rad > 0.0 and self.resonant_rad_nm > 0.0:
            gear = Gears(
                np.array([self.half_gap_rad]), np.array([self.resonant_rad_nm]), self.damping_ratio
            )
            known = beside_rotor(signals, axis, self.rotor_inertia_kg_m2)
            return (
                _behind(gear, known, axis, held=bool(self.held), sags=bool(self.sags))
                / self.half_gap_rad
            )
        torque = signals.gear_torque(axis)
        width = self.share * float(np.sqrt(np.mean(torque**2))) or 1.0
        twist = np.tanh(torque / width)
        added = -signals.inertia(slice(None), axis) * curvature(twist, signals.rate_hz)
        if self.sags:
            added += torque_of_twist(signals, axis, twist)
        return np.asarray(added)[:, None]


@dataclass(frozen=True, slots=True)
class Elasticity(Effect):
    """τ_i = c (D_i(y) − M_ij ÿ),  c₀ M_jj (ÿ + 2ζω ẏ) + y = τ_j,  ω² = 1/(c₀ M_jj);  c > 0:
    compliance 1/k.

    Joint j lags its motor by y/k, so its acceleration is less than the motor's by ÿ/k, and every
    joint i takes M_ij times as much torque less, beside D_i, what the posture changes; M is the
    mass matrix in that posture, τ_j the torque that a rigid gear would pass, without its friction,
    and y what the spring passes: τ_j through the resonance of spring and link. With c₀ = 0, y is
    τ_j, the first order in c: good well below the resonance. D_i is left out until an elasticity is
    chosen: a sag alone is no sign of one, because gravity that is described wrongly looks alike.
    Where its own friction holds the link, the motor winds up the spring first
    (`ident.effects.twist`), and τ_j = c (y − τ_j)/c₀ on the joint itself: the spring passes neither
    weight nor friction of a link at rest. Source: Spong (1987), "Modeling and control of elastic
    joint robots", with the encoder on the motor. Signature: second derivative of the load, larger
    near the resonance.
    """

    name = "elasticity"
    side = GearSide.ALL_JOINTS
    declares = Property.RATE_OF_LOAD
    abscissa = Abscissa.LOAD_CURVATURE
    coefficients = (Column("compliance", "rad/Nm", least=0.0),)
    form_settings = ("held", "sags", "rotor_inertia_kg_m2")
    added_settings = ("resonant_rad_nm", "damping_ratio", *form_settings)
    refined = ()  # by `ident.discovery.resonance`

    #: c₀, the compliance that sets the resonance
    resonant_rad_nm: Annotated[float, Range(0.0, 10.0)] = 0.0
    damping_ratio: Annotated[float, Range(0.0, 10.0)] = 0.0  #: ζ
    held: Switch = 0  #: 1 where the link's own friction holds it, else 0
    sags: Switch = 0  #: 1 where D_i is in the column: the arm stands elsewhere, by the twist
    #: J, of the rotor in the model's load torque
    rotor_inertia_kg_m2: Annotated[float, Range(0.0, 1e6)] = 0.0

    @property
    def known_rotor_kg_m2(self) -> float:
        """J, which it takes off the load."""
        return self.rotor_inertia_kg_m2

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 1, k)."""
        if self.held and self.resonant_rad_nm > 0.0:
            gear = Gears(np.zeros(1), np.array([self.resonant_rad_nm]), self.damping_ratio)
            known = beside_rotor(signals, axis, self.rotor_inertia_kg_m2)
            return (
                _behind(gear, known, axis, held=True, sags=bool(self.sags)) / self.resonant_rad_nm
            )
        inertia = signals.inertia(slice(None), axis)
        torque = signals.link_torque(axis)
        passed = spring_torque(
            torque, inertia[axis], signals.rate_hz, self.resonant_rad_nm, self.damping_ratio
        )
        added = -inertia * curvature(passed, signals.rate_hz)
        if self.sags:
            added += torque_of_twist(signals, axis, passed)
        return np.asarray(added)[:, None]


def _behind(gear: Gears, signals: Signals, axis: int, *, held: bool, sags: bool) -> FloatArray:
    """Torque that a gear which is not rigid adds on every joint, shape (n, 1, k).

    Args:
        gear: one.
        signals: of the run.
        axis: joint behind it.
        held: the link's own friction holds it; the gear then passes neither its weight nor its
            friction.
        sags: with what the twist changes in the posture of the arm.
    """
    found = twists(link_of(signals, axis, held=held), gear)
    added = -signals.inertia(slice(None), axis) * found.acceleration_rad_s2[0]
    if sags:
        added += torque_of_twist(signals, axis, found.twist_rad[0])
    if held:
        added[axis] = found.passed_nm[0] - signals.gear_torque(axis)
    return np.asarray(added)[:, None]


@dataclass(frozen=True, slots=True)
class Efficiency(Effect):
    """τ = c · |τ_g| · sign(q̇),  τ_g = τ_L + σ (Fs sign(q̇) + Fv q̇);  c = (1 − η²)/(1 + η²) > 0,
    η the efficiency.

    The motor gives τ_g/η where it drives the load and η τ_g where the load drives it. The mean of
    the two is c |τ_g| from the plain torque; their difference is τ_g itself and belongs to the
    gain: `ident.discovery.gear_loss`. A loss on τ_L alone is `load-friction`; here the share σ of
    the joint's own friction passes the mesh too. Source: Hamon, Gautier, Garrec & Janot, AIM 2010,
    "Dynamic identification of robot with a load-dependent joint friction model". Signature: sign ×
    torque through the gear, with a step where the load turns.

    Where the model's τ_L contains the rotor, J q̈ is taken off, and d · ∂τ/∂J / c is a second
    column (`with_rotor`): see `ident.effects.rotor`.
    """

    name = "efficiency"
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.LOAD
    reported = Reported.SHARE_OF_LOAD
    has_rotor_form = True
    form_settings = ("rotor_inertia_kg_m2", "with_rotor")
    added_settings = ("rotor_inertia_kg_m2", "with_rotor")
    refined = ()

    #: σ, of the joint's friction that lies behind the gear
    friction_share: Annotated[float, Range(1e-3, 1.0)]
    #: J, of the rotor in the model's load torque
    rotor_inertia_kg_m2: Annotated[float, Range(0.0, 1e6)] = 0.0
    #: 1 where the rest of the rotor's inertia is fitted, d = c (Ia − J), else 0
    with_rotor: Switch = 0

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """C, and d with the rotor."""
        rest = Column("rotor rest", "kg m²", least=least_rotor_rest(self.rotor_inertia_kg_m2))
        columns = (Column("loss", "Nm/Nm", least=0.0), rest)
        return columns[: 1 + self.with_rotor]

    @property
    def forms(self) -> tuple[Efficiency, ...]:
        """With J as it is, then with the rest of it where that is fitted."""
        return tuple(replace(self, with_rotor=fitted) for fitted in range(1 + self.with_rotor))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1 or 2, k)."""
        load_nm = signals.load_torque_nm[axis]
        friction_nm = signals.geared_torque_nm[axis] - load_nm
        through_nm = load_nm + self.friction_share * friction_nm
        direction = np.sign(signals.velocity_rad_s[axis])
        with_rotor = bool(self.with_rotor)
        return loss_columns(
            signals, axis, through_nm, direction, self.rotor_inertia_kg_m2, with_rotor=with_rotor
        )


@dataclass(frozen=True, slots=True)
class InertialCoupling(Effect):
    """τ_i = c · q̈_j and τ_j = c · q̈_i;  c > 0:
    both joints accelerate the shared body in the same sense.

    A rotor that turns with n_i q̇_i + n_j q̇_j has the energy ½ J (n_i q̇_i + n_j q̇_j)²: c = J n_i
    n_j has the sign of the two ratios, so that c < 0 is no negative inertia, but a body that the
    joints turn against each other. Source: a rotor or shaft that both joints turn (paper eq. 25:
    Ia_m6 beside the diagonal). Signature: another axis' acceleration.
    """

    name = "inertial-coupling"
    side = GearSide.TWO_JOINTS
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.OTHER_ACCELERATION
    coefficients = (Column("inertia", "kg m²"),)

    other_axis: AxisNumber  #: number of joint j, from 1; joint i is the one with the lower number

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, 1, k)."""
        return signals.acceleration_rad_s2[[self.other_axis - 1, axis]][:, None]


@dataclass(frozen=True, slots=True)
class Ripple(Effect):
    """τ = a cos(k θ) + b sin(k θ), θ = q_m, at the motor, or θ = q;  k need not be whole.

    A belt's tooth, the wave generator and the flexspline of a strain-wave gear, a cam or a ball in
    a bearing turn at other rates than the motor. The search proposes k by a periodogram of the
    residual (`ident.discovery.ripple`). Source: Tuttle & Seering, "A nonlinear model of a harmonic
    drive gear transmission", IEEE TRA 12 (1996). Signature: a line at order k.
    """

    name = "ripple"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.MOTOR_ANGLE
    coefficients = (Column("cosine", "Nm"), Column("sine", "Nm"))
    reported = Reported.AMPLITUDE
    key_settings = ("order", "of_joint")

    order: Annotated[float, Range(1e-4, 1e4)]  #: k, periods a revolution of θ
    #: 1 where θ is the joint's angle, which differs where a motor turns with several joints
    of_joint: Switch = 0

    @property
    def side(self) -> GearSide:
        """Motor, or joint where the angle is the joint's."""
        return GearSide.JOINT if self.of_joint else GearSide.MOTOR

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        angle = (signals.position_rad if self.of_joint else signals.motor_position_rad)[axis]
        return np.stack(cos_sin(self.order * angle))
