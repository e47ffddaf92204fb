"""Gears that lose power, gears and shafts that are not rigid behind the motors' encoders, and inertia shared by two."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy.linalg import lapack

from ident.arrays import FloatArray
from ident.effects.effect import AxisNumber, Effect, GearSide, Property, Range, Switch
from ident.effects.rotor import least_rotor_rest, loss_columns
from ident.effects.signals import Abscissa, Signals, curvature
from ident.model.model import Column
from ident.model.regressor import cos_sin

RESOLVED = 0.9  #: Largest resonance in parts of half the sampling rate
LEAST_SHARE = 0.02  #: Of the mean, below which an inertia is not one of a link
LEAD_S = 0.03  #: Time before a turn of the torque from which the twist is computed: it may be left early
SETTLED_S = 0.3  #: Time after the last turn until a flank is in touch again
STEP_RAD = 0.25  #: Largest step of the resonance of flank and link
MOST_STEPS = 16  #: Of a sample


@dataclass(frozen=True, slots=True)
class Backlash(Effect):
    """τ_i = −c · M_ij · δ̈/b,  M_jj δ̈ = τ_j − y,  y = (δ ± b)/c₀ + 2ζ√(M_jj/c₀) δ̇ on a flank, 0 in the gap;  c > 0.

    c is half the gap. The joint lags its motor by δ: half the gap on the side to which it is pushed and the bend of the
    flank; where the torque turns, it crosses. τ_j is the torque that a rigid gear would pass, friction included, M the
    mass matrix. With b = 0 the crossing follows the torque at once, δ = c tanh(τ_j/w): for light links and stiff flanks
    only. Source: Nordin & Gutman (2002), "Controlling mechanical systems with backlash", Automatica 38, the dead-zone
    model. Signature: sign changes of the load, each with a blow at its end.
    """

    name = "backlash"
    side = GearSide.ALL_JOINTS
    declares = Property.ODD_IN_LOAD
    abscissa = Abscissa.LOAD
    coefficients = (Column("half gap", "rad", least=0.0),)

    #: W, over which the side changes, in parts of the load's root mean square; 0 where the crossing is computed.
    share: Annotated[float, Range(0.0, 1.0)]
    half_gap_rad: Annotated[float, Range(0.0, 1.0)] = 0.0  #: b, with which the crossing is computed
    resonant_rad_nm: Annotated[float, Range(0.0, 10.0)] = 0.0  #: c₀, compliance of the flanks
    damping_ratio: Annotated[float, Range(0.0, 10.0)] = 0.0  #: ζ

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 1, k)."""
        torque = signals.gear_torque(axis)
        inertia = signals.inertia(slice(None), axis)
        if self.half_gap_rad > 0.0 and self.resonant_rad_nm > 0.0:
            gap = (np.array([self.half_gap_rad]), np.array([self.resonant_rad_nm]), self.damping_ratio)
            crossing = twist_acceleration(torque, inertia[axis], signals.rate_hz, *gap)[0] / self.half_gap_rad
        else:
            width = self.share * float(np.sqrt(np.mean(torque**2))) or 1.0
            crossing = curvature(np.tanh(torque / width), signals.rate_hz)
        return np.asarray(-inertia * crossing)[:, None]


def twist_acceleration(
    torque_nm: FloatArray,
    inertia_kg_m2: FloatArray,
    rate_hz: float,
    half_gap_rad: FloatArray,
    compliance_rad_nm: FloatArray,
    damping_ratio: float,
) -> FloatArray:
    """Second derivative of the twist δ of gears with a gap [rad/s²], shape (m, k).

    Where the torque turns, M δ̈ = τ − y is integrated by small steps, y zero in the gap and never pulling on a flank,
    in all windows and for all gaps at once. Elsewhere a flank is in touch, and δ̈ is that of a spring. It is zero for a
    link without inertia.

    Args:
        torque_nm: τ, shape (k,).
        inertia_kg_m2: M of the link in each posture, shape (k,).
        rate_hz: sampling rate.
        half_gap_rad, compliance_rad_nm: of each gear, shape (m,).
        damping_ratio: of link and flank, the same for all.
    """
    mean = float(np.mean(inertia_kg_m2))
    if not mean > 0.0:
        return np.zeros((len(half_gap_rad), len(torque_nm)))
    inertia = np.maximum(inertia_kg_m2, LEAST_SHARE * mean)
    passed = {c: spring_torque(torque_nm, inertia, rate_hz, c, damping_ratio) for c in set(compliance_rad_nm.tolist())}
    bent = np.stack([c * passed[c] for c in compliance_rad_nm.tolist()])
    out = np.stack([curvature(one, rate_hz) for one in bent])
    turns = np.flatnonzero(np.diff(np.sign(torque_nm)) != 0)
    settle, lead = round(SETTLED_S * rate_hz), round(LEAD_S * rate_hz)
    turns = turns[(turns > lead) & (turns < len(torque_nm) - 2)]
    if not len(turns):
        return out
    apart = np.flatnonzero(np.diff(turns) > settle + lead) + 1
    begin = turns[np.concatenate(([0], apart))] - lead
    end = np.minimum(turns[np.concatenate((apart - 1, [len(turns) - 1]))] + settle, len(torque_nm) - 2)
    order = np.argsort(begin - end)  # the longest first, so that those still running come first
    begin, length = begin[order], (end - begin)[order]
    # A flank too stiff for the steps is as good as one that they resolve.
    stiffest = 1.0 / (np.min(inertia) * (2.0 * STEP_RAD * MOST_STEPS * rate_hz) ** 2)
    gap, compliance = half_gap_rad[:, None], np.maximum(compliance_rad_nm, stiffest)[:, None]
    twist = gap * np.sign(torque_nm[begin]) + bent[:, begin]
    rate = (bent[:, begin + 1] - bent[:, begin - 1]) * (0.5 * rate_hz)
    fastest_rad_s = 1.0 / float(np.sqrt(np.min(inertia) * np.min(compliance)))
    steps = min(MOST_STEPS, int(np.ceil(fastest_rad_s / rate_hz / STEP_RAD)))
    step_s = 1.0 / (steps * rate_hz)
    for sample in range(int(length[0])):
        running = int(np.searchsorted(-length, -sample))
        at = begin[:running] + sample
        mass, before, rise = inertia[at], torque_nm[at], torque_nm[at + 1] - torque_nm[at]
        damping = 2.0 * damping_ratio * np.sqrt(mass / compliance)
        delta, speed = twist[:, :running], rate[:, :running]
        for part in range(steps):
            pressed = delta - np.clip(delta, -gap, gap)
            flank = pressed / compliance + damping * speed
            flank = np.where(
                pressed > 0.0, np.maximum(flank, 0.0), np.where(pressed < 0.0, np.minimum(flank, 0.0), 0.0)
            )
            bend = (before + rise * (part / steps) - flank) / mass
            if part == 0:
                out[:, at] = bend
            speed += step_s * bend
            delta += step_s * speed
    return out


@dataclass(frozen=True, slots=True)
class Elasticity(Effect):
    """τ_i = −c · M_ij · ÿ_j,  c₀ M_jj (ÿ + 2ζω ẏ) + y = τ_j,  ω² = 1/(c₀ M_jj);  c = 1/k > 0: compliance of the gear.

    Joint j lags its motor by y/k, so its acceleration is less than the motor's by ÿ/k, and every joint i takes M_ij
    times as much torque less; M is the mass matrix in that posture, τ_j the torque that a rigid gear would pass,
    without its friction, and y what the spring passes: τ_j through the resonance of spring and link. With c₀ = 0, y is
    τ_j, the first order in c: good well below the resonance. Source: Spong (1987), "Modeling and control of elastic
    joint robots", with the encoder on the motor. Signature: second derivative of the load, larger near the resonance.
    """

    name = "elasticity"
    side = GearSide.ALL_JOINTS
    declares = Property.RATE_OF_LOAD
    abscissa = Abscissa.LOAD_CURVATURE
    coefficients = (Column("compliance", "rad/Nm", least=0.0),)

    resonant_rad_nm: Annotated[float, Range(0.0, 10.0)] = 0.0  #: c₀, the compliance that sets the resonance
    damping_ratio: Annotated[float, Range(0.0, 10.0)] = 0.0  #: ζ

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 1, k)."""
        inertia = signals.inertia(slice(None), axis)
        torque = signals.link_torque(axis)
        passed = spring_torque(torque, inertia[axis], signals.rate_hz, self.resonant_rad_nm, self.damping_ratio)
        return np.asarray(-inertia * curvature(passed, signals.rate_hz))[:, None]


def spring_torque(
    torque_nm: FloatArray, inertia_kg_m2: FloatArray, rate_hz: float, compliance_rad_nm: float, damping_ratio: float
) -> FloatArray:
    """Torque y that a spring passes to a link, (ÿ + 2ζω ẏ)/ω² + y = τ with ω² = 1/(c M), shape (k,).

    By the trapezoidal rule, which is stable at any rate, with its steps stretched to keep the mean resonance. It starts
    at rest. A compliance of 0 or a link without inertia passes τ.

    Args:
        torque_nm: τ, the torque that a rigid gear would pass, shape (k,).
        inertia_kg_m2: M of the link in each posture, shape (k,).
        rate_hz: sampling rate.
        compliance_rad_nm: c.
        damping_ratio: ζ.
    """
    mean = float(np.mean(inertia_kg_m2))
    if not mean * compliance_rad_nm > 0.0:
        return torque_nm
    mean_rad_s = min(1.0 / float(np.sqrt(mean * compliance_rad_nm)), RESOLVED * np.pi * rate_hz)
    steps_hz = mean_rad_s / (2.0 * np.tan(mean_rad_s / (2.0 * rate_hz)))
    square = mean_rad_s**2 * mean / np.maximum(inertia_kg_m2[1:-1], LEAST_SHARE * mean)
    damping, quarter = damping_ratio * np.sqrt(square) * steps_hz, square / 4.0
    last = steps_hz**2 + damping + quarter
    # y_k, y_k−1 and y_k−2 in each row: a triangular system with two bands.
    band = np.ones((3, len(torque_nm)), order="F")
    band[1, 0] = 0.0
    band[1, 1:-1] = (2.0 * quarter - 2.0 * steps_hz**2) / last
    band[2, :-2] = (steps_hz**2 - damping + quarter) / last
    driven = torque_nm.copy()
    driven[2:] = quarter / last * (torque_nm[2:] + 2.0 * torque_nm[1:-1] + torque_nm[:-2])
    return np.asarray(lapack.dtbtrs(band, driven[:, None], uplo="L", diag="U")[0][:, 0])


@dataclass(frozen=True, slots=True)
class Efficiency(Effect):
    """τ = c · |τ_g| · sign(q̇),  τ_g = τ_L + σ (Fs sign(q̇) + Fv q̇);  c = (1 − η²)/(1 + η²) > 0, η the efficiency.

    The motor gives τ_g/η where it drives the load and η τ_g where the load drives it. The mean of the two is c |τ_g|
    from the plain torque; their difference is τ_g itself and belongs to the gain: `ident.discovery.gear_loss`. A loss
    on τ_L alone is `load-friction`; here the share σ of the joint's own friction passes the mesh too. Source: Hamon,
    Gautier, Garrec & Janot, AIM 2010, "Dynamic identification of robot with a load-dependent joint friction model".
    Signature: sign × torque through the gear, with a step where the load turns.

    Where the model's τ_L contains the rotor, J q̈ is taken off, and d · ∂τ/∂J / c is a second column (`with_rotor`): see
    `ident.effects.rotor`.
    """

    name = "efficiency"
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.LOAD

    friction_share: Annotated[float, Range(1e-3, 1.0)]  #: σ, of the joint's friction that lies behind the gear
    rotor_inertia_kg_m2: Annotated[float, Range(0.0, 1e6)] = 0.0  #: J, of the rotor in the model's load torque
    with_rotor: Switch = 0  #: 1 where the rest of the rotor's inertia is fitted, d = c (Ia − J), else 0

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
        return loss_columns(signals, axis, through_nm, direction, self.rotor_inertia_kg_m2, with_rotor=with_rotor)


@dataclass(frozen=True, slots=True)
class InertialCoupling(Effect):
    """τ_i = c · q̈_j and τ_j = c · q̈_i;  c > 0: both joints accelerate the shared body in the same sense.

    A rotor that turns with n_i q̇_i + n_j q̇_j has the energy ½ J (n_i q̇_i + n_j q̇_j)²: c = J n_i n_j has the sign of the
    two ratios, so that c < 0 is no negative inertia, but a body that the joints turn against each other. Source:
    a rotor or shaft that both joints turn (paper eq. 25: Ia_m6 beside the diagonal). Signature: another axis'
    acceleration.
    """

    name = "inertial-coupling"
    side = GearSide.TWO_JOINTS
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.OTHER_VELOCITY
    coefficients = (Column("inertia", "kg m²"),)

    other_axis: AxisNumber  #: number of joint j, from 1; joint i is the one with the lower number

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, 1, k)."""
        return signals.acceleration_rad_s2[[self.other_axis - 1, axis]][:, None]


@dataclass(frozen=True, slots=True)
class Ripple(Effect):
    """τ = a cos(k θ) + b sin(k θ), θ = q_m, at the motor, or θ = q;  k need not be whole.

    A belt's tooth, the wave generator and the flexspline of a strain-wave gear, a cam or a ball in a bearing turn at
    other rates than the motor. The search proposes k by a periodogram of the residual
    (`ident.discovery.ripple`). Source: Tuttle & Seering, "A nonlinear model of a harmonic drive gear transmission",
    IEEE TRA 12 (1996). Signature: a line at order k.
    """

    name = "ripple"
    declares = Property.INDEPENDENT_OF_VELOCITY
    abscissa = Abscissa.MOTOR_ANGLE
    coefficients = (Column("cosine", "Nm"), Column("sine", "Nm"))

    order: Annotated[float, Range(1e-4, 1e4)]  #: k, periods a revolution of θ
    of_joint: Switch = 0  #: 1 where θ is the joint's angle, which differs where a motor turns with several joints

    @property
    def side(self) -> GearSide:
        """Motor, or joint where the angle is the joint's."""
        return GearSide.JOINT if self.of_joint else GearSide.MOTOR

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        angle = (signals.position_rad if self.of_joint else signals.motor_position_rad)[axis]
        return np.stack(cos_sin(self.order * angle))
