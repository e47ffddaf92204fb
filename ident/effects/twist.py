"""How far a joint stands behind its motor where the gear between them is not rigid,
and what the gear then passes.

Joint j lags its motor by the twist δ, so that τ(q − δ, q̇ − δ̇, q̈ − δ̈) moves links and payload.
To first order in δ that is −M_ij δ̈ on each joint i, M the mass matrix, and D_i(δ), what the twist
changes without any acceleration of its own: gravity and the other torques of posture and speed
(`torque_of_twist`).

The link follows M_jj δ̈ = τ_L + F − y. τ_L is the torque that moves it as fast as its motor, y what
a spring with a gap passes, and F the link's friction. Where F is that of the motor's speed, as if
it were rigid, τ_L + F is known beforehand. Where it is that of the link's own speed q̇ − δ̇,
friction holds the link while the motor winds up the spring, or crosses the gap: until then the
motor has neither its weight nor its friction to carry.

Sources: Nordin & Gutman (2002), "Controlling mechanical systems with backlash", Automatica 38, the
dead-zone model; Spong (1987), "Modeling and control of elastic joint robots", with the encoder on
the motor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.effects.signals import STICKING_RAD_S, Signals, curvature

RESOLVED = 0.9  #: Largest resonance in parts of half the sampling rate
LEAST_SHARE = 0.02  #: Of the mean, below which an inertia is not one of a link
#: Time before a turn of the torque from which the twist is computed: a flank may be left early
LEAD_S = 0.03
SETTLED_S = 0.3  #: Time after the last turn until a flank is in touch again
#: Time at rest after which a link is taken to stand where its weight pushes it
LONGEST_HOLD_S = 2.0
#: Time between two postures in which the derivatives to position and velocity are computed
POSTURE_S = 0.01
STEP_RAD = 0.25  #: Largest step of the resonance of flank and link
MOST_STEPS = 16  #: Of a sample


@dataclass(frozen=True, slots=True, eq=False)
class DrivenLink:
    """What moves a link behind a gear; arrays have the shape (k,)."""

    rate_hz: float  #: sampling rate
    inertia_kg_m2: FloatArray  #: M_jj of link and payload in each posture
    #: that moves it as its motor moves; with its friction, unless that is `dry_nm`
    torque_nm: FloatArray
    speed_rad_s: FloatArray  #: of its motor, as a joint
    #: friction that the link's own speed decides on; zero where the torque has it
    dry_nm: FloatArray

    @property
    def pushed_nm(self) -> FloatArray:
        """Torque that a rigid gear passes, shape (k,); zero where friction holds the link."""
        held = np.clip(self.torque_nm, -self.dry_nm, self.dry_nm)
        direction = np.sign(self.speed_rad_s)
        is_moving = np.abs(self.speed_rad_s) > STICKING_RAD_S
        return np.asarray(
            np.where(is_moving, self.torque_nm + self.dry_nm * direction, self.torque_nm - held)
        )


def link_of(signals: Signals, axis: int, *, held: bool) -> DrivenLink:
    """Return the link of a joint.

    Args:
        signals: of the run.
        axis: the joint.
        held: its friction is that of its own speed; else that of its motor's speed.
    """
    inertia = signals.inertia(axis, axis)
    speed = signals.velocity_rad_s[axis]
    geared = signals.gear_torque(axis)
    if not held:
        return DrivenLink(signals.rate_hz, inertia, geared, speed, np.zeros_like(geared))
    load = signals.link_torque(axis)
    friction = np.abs(geared - load)
    is_moving = np.abs(speed) > STICKING_RAD_S
    if not np.any(is_moving):
        return DrivenLink(signals.rate_hz, inertia, load, speed, np.zeros_like(load))
    # At rest there is no friction in the prediction; in slow motion there is hardly any but the dry
    # one.
    at_rest = float(np.min(friction[is_moving]))
    return DrivenLink(signals.rate_hz, inertia, load, speed, np.where(is_moving, friction, at_rest))


@dataclass(frozen=True, slots=True, eq=False)
class Gears:
    """Gears that are not rigid, one or several to be tried."""

    half_gap_rad: FloatArray  #: shape (g,)
    compliance_rad_nm: FloatArray  #: shape (g,)
    damping_ratio: float  #: ζ of link and spring, the same for all


@dataclass(frozen=True, slots=True, eq=False)
class Twists:
    """How far a link lags its motor behind each of several gears, shape (g, k) each."""

    twist_rad: FloatArray  #: δ
    acceleration_rad_s2: FloatArray  #: δ̈
    passed_nm: FloatArray  #: y


def twists(link: DrivenLink, gears: Gears) -> Twists:
    """Follow a link behind each of several gears.

    Where the torque turns, and where friction holds the link, M δ̈ = τ_L + F − y is integrated by
    small steps, y zero in the gap and never pulling on a flank, in all windows and for all gears at
    once. Elsewhere a flank is in touch, and the gear is a spring (`spring_torque`). A link without
    inertia does not lag.

    Args:
        link: what moves it.
        gears: to be tried.
    """
    pushed = link.pushed_nm
    mean = float(np.mean(link.inertia_kg_m2))
    if not mean > 0.0:
        none = np.zeros((len(gears.half_gap_rad), len(pushed)))
        return Twists(none, none, np.broadcast_to(pushed, none.shape))
    inertia = np.maximum(link.inertia_kg_m2, LEAST_SHARE * mean)
    twist = _bent_springs(pushed, inertia, link.rate_hz, gears)
    bend = np.empty_like(twist)
    for one, of_spring in zip(bend, twist, strict=True):
        one[:] = curvature(of_spring, link.rate_hz)
    side = np.sign(np.where(pushed == 0.0, link.torque_nm, pushed))
    twist += gears.half_gap_rad[:, None] * side
    around = Twists(twist, bend, pushed - inertia * bend)
    windows = _windows(link, pushed, has_gap=bool(np.any(gears.half_gap_rad > 0.0)))
    if windows is not None:
        _follow(link, inertia, gears, around, windows)
    return around


def _bent_springs(
    pushed_nm: FloatArray, inertia_kg_m2: FloatArray, rate_hz: float, gears: Gears
) -> FloatArray:
    """Twist of each gear's spring alone, shape (g, k)."""
    found: dict[float, FloatArray] = {}
    for compliance in gears.compliance_rad_nm.tolist():
        if compliance not in found:
            passed = spring_torque(
                pushed_nm, inertia_kg_m2, rate_hz, compliance, gears.damping_ratio
            )
            found[compliance] = compliance * passed
    return np.stack([found[compliance] for compliance in gears.compliance_rad_nm.tolist()])


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Stretches of a run, the longest first, so that those still running come first."""

    begin: IntArray  #: first sample of each, shape (w,)
    length: IntArray  #: samples of each, shape (w,)


def _windows(link: DrivenLink, pushed_nm: FloatArray, *, has_gap: bool) -> Windows | None:
    """Stretches in which the gear is more than a spring; None without any."""
    settle = round(SETTLED_S * link.rate_hz)
    lead = round(LEAD_S * link.rate_hz)
    side = np.sign(pushed_nm)
    turns = np.diff(side) != 0
    if not has_gap:
        # Without a gap only friction does more than a spring: where the motor turns, and where the
        # link is held.
        moving = np.where(np.abs(link.speed_rad_s) > STICKING_RAD_S, np.sign(link.speed_rad_s), 0.0)
        turns = (np.diff(moving) != 0) & (link.dry_nm[:-1] > 0.0)
    events = np.flatnonzero(turns | _short_holds(link, round(LONGEST_HOLD_S * link.rate_hz))[:-1])
    events = events[(events > lead) & (events < len(pushed_nm) - 2)]
    if not len(events):
        return None
    apart = np.flatnonzero(np.diff(events) > settle + lead) + 1
    begin = events[np.concatenate(([0], apart))] - lead
    last = events[np.concatenate((apart - 1, [len(events) - 1]))]
    end = np.minimum(last + settle, len(pushed_nm) - 2)
    order = np.argsort(begin - end)
    return Windows(begin[order], (end - begin)[order])


def _short_holds(link: DrivenLink, longest: int) -> BoolArray:
    """Samples of the times at rest in which friction holds the link and that last at most so long,
    shape (k,).
    """
    is_held = (np.abs(link.speed_rad_s) <= STICKING_RAD_S) & (link.dry_nm > 0.0)
    edges = np.flatnonzero(np.diff(is_held, prepend=False, append=False))
    for first, end in edges.reshape(-1, 2).tolist():
        if end - first > longest:
            is_held[first:end] = False
    return np.asarray(is_held)


def _follow(
    link: DrivenLink, inertia_kg_m2: FloatArray, gears: Gears, around: Twists, windows: Windows
) -> None:
    """Integrate the link in the windows, and write it over what was known around them:
    these are the largest arrays of a search, and there is no second copy of them.
    """
    rate_hz = link.rate_hz
    # A flank too stiff for the steps is as good as one that they resolve.
    stiffest = 1.0 / (np.min(inertia_kg_m2) * (2.0 * STEP_RAD * MOST_STEPS * rate_hz) ** 2)
    gap = gears.half_gap_rad[:, None]
    compliance = np.maximum(gears.compliance_rad_nm, stiffest)[:, None]
    fastest_rad_s = 1.0 / float(np.sqrt(np.min(inertia_kg_m2) * np.min(compliance)))
    steps = min(MOST_STEPS, int(np.ceil(fastest_rad_s / rate_hz / STEP_RAD)))
    step_s = 1.0 / (steps * rate_hz)
    has_friction = bool(np.any(link.dry_nm > 0.0))
    begin = windows.begin
    twist = around.twist_rad[:, begin]
    rate = (around.twist_rad[:, begin + 1] - around.twist_rad[:, begin - 1]) * (0.5 * rate_hz)
    twisted = around.twist_rad
    bent = around.acceleration_rad_s2
    passed = around.passed_nm
    # Means from one sample to the next lie half a sample late: each sample gets that of the means
    # on its two sides.
    bend_before = np.zeros_like(rate)
    flank_before = np.zeros_like(rate)
    for sample in range(int(windows.length[0])):
        running = int(np.searchsorted(-windows.length, -sample))
        at = begin[:running] + sample
        mass = inertia_kg_m2[at]
        before = link.torque_nm[at]
        rise = link.torque_nm[at + 1] - before
        motor = link.speed_rad_s[at]
        motor_rise = link.speed_rad_s[at + 1] - motor
        holding = link.dry_nm[at] * step_s / mass
        damping = 2.0 * gears.damping_ratio * np.sqrt(mass / compliance)
        delta = twist[:, :running]
        speed = rate[:, :running]
        twisted[:, at] = delta
        speed_before = speed.copy()
        flanks = np.zeros_like(delta)
        for part in range(steps):
            share = part / steps
            flank = _flank(delta, speed, gap, compliance, damping)
            flanks += flank
            speed += step_s * (before + rise * share - flank) / mass
            if has_friction:
                # Dry friction takes from the link's speed what it can, and never turns it round.
                sliding = motor + motor_rise * share - speed
                speed += np.clip(sliding, -holding, holding)
            delta += step_s * speed
        mean_bend = (speed - speed_before) * rate_hz
        mean_flank = flanks / steps
        bent[:, at] = mean_bend if sample == 0 else 0.5 * (bend_before[:, :running] + mean_bend)
        passed[:, at] = (
            mean_flank if sample == 0 else 0.5 * (flank_before[:, :running] + mean_flank)
        )
        bend_before = mean_bend
        flank_before = mean_flank


def _flank(
    twist_rad: FloatArray,
    rate_rad_s: FloatArray,
    half_gap_rad: FloatArray,
    compliance_rad_nm: FloatArray,
    damping_nm_s_rad: FloatArray,
) -> FloatArray:
    """What a spring passes; of a gear with a gap, what a flank does:
    nothing in the gap, and it never pulls.
    """
    pressed = twist_rad - np.clip(twist_rad, -half_gap_rad, half_gap_rad)
    spring = pressed / compliance_rad_nm + damping_nm_s_rad * rate_rad_s
    pushing = np.where(pressed > 0.0, np.maximum(spring, 0.0), np.minimum(spring, 0.0))
    in_touch = np.where(pressed == 0.0, 0.0, pushing)
    return np.asarray(np.where(half_gap_rad > 0.0, in_touch, spring))


def torque_of_twist(signals: Signals, axis: int, twist_rad: FloatArray) -> FloatArray:
    """D(δ) = −δ ∂τ/∂q_j − δ̇ ∂τ/∂q̇_j, torque of links and payload on every joint, shape (n, k).

    Args:
        signals: of the run; without the arm behind them it is zero.
        axis: joint j.
        twist_rad: δ, by which the joint lags its motor, shape (k,).
    """
    if signals.arm is None:
        return np.zeros_like(signals.load_torque_nm)
    count = len(twist_rad)
    every = max(1, round(POSTURE_S * signals.rate_hz))
    postures = np.unique(np.append(np.arange(0, count, every), count - 1))
    by_position, by_velocity = signals.arm.load_derivatives(axis, postures)
    rate_rad_s = np.gradient(twist_rad) * signals.rate_hz
    samples = np.arange(count)
    added = np.empty_like(signals.load_torque_nm)
    for joint in range(len(added)):
        stiffness = np.interp(samples, postures, by_position[joint])
        damping = np.interp(samples, postures, by_velocity[joint])
        added[joint] = -stiffness * twist_rad - damping * rate_rad_s
    return added


def spring_torque(
    torque_nm: FloatArray,
    inertia_kg_m2: FloatArray,
    rate_hz: float,
    compliance_rad_nm: float,
    damping_ratio: float,
) -> FloatArray:
    """Torque y that a spring passes to a link, (ÿ + 2ζω ẏ)/ω² + y = τ with ω² = 1/(c M),
    shape (k,).

    By the trapezoidal rule, which is stable at any rate, with its steps stretched to keep the mean
    resonance. It starts at rest. A compliance of 0 or a link without inertia passes τ.

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
