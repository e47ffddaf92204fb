"""How far a joint stands behind its motor where their gear is not rigid, and what that passes.

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

from ident.arrays import BoolArray, FloatArray, IntArray, true_stretches
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
        held_nm = np.clip(self.torque_nm, -self.dry_nm, self.dry_nm)
        at_rest_nm = self.torque_nm - held_nm
        moving_nm = self.torque_nm + self.dry_nm * np.sign(self.speed_rad_s)
        is_moving = np.abs(self.speed_rad_s) > STICKING_RAD_S
        return np.asarray(np.where(is_moving, moving_nm, at_rest_nm))


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
    dry = np.where(is_moving, friction, at_rest)
    return DrivenLink(signals.rate_hz, inertia, load, speed, dry)


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
    pressing = np.where(pushed == 0.0, link.torque_nm, pushed)
    twist += gears.half_gap_rad[:, None] * np.sign(pressing)
    passed = pushed - inertia * bend
    around = Twists(twist, bend, passed)
    has_gap = bool(np.any(gears.half_gap_rad > 0.0))
    windows = _windows(link, pushed, has_gap=has_gap)
    if windows is not None:
        _follow(link, inertia, gears, around, windows)
    return around


def _bent_springs(
    pushed_nm: FloatArray, inertia_kg_m2: FloatArray, rate_hz: float, gears: Gears
) -> FloatArray:
    """Twist of each gear's spring alone, shape (g, k)."""
    compliances = gears.compliance_rad_nm.tolist()
    damping = gears.damping_ratio
    twists_rad: dict[float, FloatArray] = {}
    for compliance in compliances:
        if compliance not in twists_rad:
            passed_nm = spring_torque(pushed_nm, inertia_kg_m2, rate_hz, compliance, damping)
            twists_rad[compliance] = compliance * passed_nm
    return np.stack([twists_rad[compliance] for compliance in compliances])


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Stretches of a run, the longest first, so that those still running come first."""

    begin: IntArray  #: first sample of each, shape (w,)
    length: IntArray  #: samples of each, shape (w,)


def _windows(link: DrivenLink, pushed_nm: FloatArray, *, has_gap: bool) -> Windows | None:
    """Stretches in which the gear is more than a spring; None without any."""
    settle = round(SETTLED_S * link.rate_hz)
    lead = round(LEAD_S * link.rate_hz)
    longest_hold = round(LONGEST_HOLD_S * link.rate_hz)
    if has_gap:
        side = np.sign(pushed_nm)
        is_turn = np.diff(side) != 0
    else:
        # Without a gap only friction does more than a spring: where the motor turns, and where the
        # link is held.
        is_moving = np.abs(link.speed_rad_s) > STICKING_RAD_S
        direction = np.where(is_moving, np.sign(link.speed_rad_s), 0.0)
        has_friction = link.dry_nm > 0.0
        is_turn = (np.diff(direction) != 0) & has_friction[:-1]
    is_held = _short_holds(link, longest_hold)
    events = np.flatnonzero(is_turn | is_held[:-1])
    last_sample = len(pushed_nm) - 2
    events = events[(events > lead) & (events < last_sample)]
    if not len(events):
        return None
    # Events whose windows overlap are in one.
    gaps = np.flatnonzero(np.diff(events) > settle + lead)
    first_events = np.concatenate(([0], gaps + 1))
    last_events = np.concatenate((gaps, [len(events) - 1]))
    begin = events[first_events] - lead
    end = np.minimum(events[last_events] + settle, last_sample)
    length = end - begin
    order = np.argsort(-length)
    return Windows(begin[order], length[order])


def _short_holds(link: DrivenLink, longest: int) -> BoolArray:
    """Whether friction holds the link at rest, for at most so many samples, shape (k,)."""
    is_at_rest = np.abs(link.speed_rad_s) <= STICKING_RAD_S
    is_held = is_at_rest & (link.dry_nm > 0.0)
    for first, end in true_stretches(is_held):
        if end - first > longest:
            is_held[first:end] = False
    return np.asarray(is_held)


def _follow(
    link: DrivenLink, inertia_kg_m2: FloatArray, gears: Gears, around: Twists, windows: Windows
) -> None:
    """Integrate the link in the windows, and write it over what was known around them.

    These are the largest arrays of a search, and there is no second copy of them.
    """
    rate_hz = link.rate_hz
    twisted = around.twist_rad
    bent = around.acceleration_rad_s2
    passed = around.passed_nm
    gap = gears.half_gap_rad[:, None]
    resolved, steps = _resolved(gears.compliance_rad_nm, float(np.min(inertia_kg_m2)), rate_hz)
    compliance = resolved[:, None]
    step_s = 1.0 / (steps * rate_hz)
    has_friction = bool(np.any(link.dry_nm > 0.0))
    begin = windows.begin
    twist = twisted[:, begin]
    around_begin = twisted[:, begin + 1] - twisted[:, begin - 1]
    rate = around_begin * (0.5 * rate_hz)
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
        if sample == 0:
            bent[:, at] = mean_bend
            passed[:, at] = mean_flank
        else:
            bent[:, at] = 0.5 * (bend_before[:, :running] + mean_bend)
            passed[:, at] = 0.5 * (flank_before[:, :running] + mean_flank)
        bend_before = mean_bend
        flank_before = mean_flank


def _resolved(
    compliance_rad_nm: FloatArray, least_inertia_kg_m2: float, rate_hz: float
) -> tuple[FloatArray, int]:
    """Compliances that the steps resolve, and how many steps of a sample they take.

    A flank too stiff for the steps is as good as one that they resolve: ω² = 1/(c M).
    """
    largest_rad_s = 2.0 * STEP_RAD * MOST_STEPS * rate_hz
    stiffest = 1.0 / (least_inertia_kg_m2 * largest_rad_s**2)
    compliance = np.maximum(compliance_rad_nm, stiffest)
    fastest_rad_s = 1.0 / float(np.sqrt(least_inertia_kg_m2 * np.min(compliance)))
    needed = int(np.ceil(fastest_rad_s / rate_hz / STEP_RAD))
    return compliance, min(MOST_STEPS, needed)


def _flank(
    twist_rad: FloatArray,
    rate_rad_s: FloatArray,
    half_gap_rad: FloatArray,
    compliance_rad_nm: FloatArray,
    damping_nm_s_rad: FloatArray,
) -> FloatArray:
    """What a spring passes; with a gap, what a flank does: nothing in it, and it never pulls."""
    within_gap_rad = np.clip(twist_rad, -half_gap_rad, half_gap_rad)
    pressed_rad = twist_rad - within_gap_rad
    spring_nm = pressed_rad / compliance_rad_nm + damping_nm_s_rad * rate_rad_s
    forward_nm = np.maximum(spring_nm, 0.0)
    backward_nm = np.minimum(spring_nm, 0.0)
    pushing_nm = np.where(pressed_rad > 0.0, forward_nm, backward_nm)
    flank_nm = np.where(pressed_rad == 0.0, 0.0, pushing_nm)
    return np.asarray(np.where(half_gap_rad > 0.0, flank_nm, spring_nm))


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
    samples = np.arange(count)
    every = max(1, round(POSTURE_S * signals.rate_hz))
    postures = np.unique(np.append(samples[::every], count - 1))
    by_position, by_velocity = signals.arm.load_derivatives(axis, postures)
    rate_rad_s = np.gradient(twist_rad) * signals.rate_hz
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
    """Torque y that a spring passes: (ÿ + 2ζω ẏ)/ω² + y = τ with ω² = 1/(c M), shape (k,).

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
    resonance_rad_s = 1.0 / float(np.sqrt(mean * compliance_rad_nm))
    fastest_rad_s = RESOLVED * np.pi * rate_hz
    mean_rad_s = min(resonance_rad_s, fastest_rad_s)
    # Steps of 1/h with tan(ω/(2 rate)) = ω/(2 h)
    half_step = mean_rad_s / (2.0 * rate_hz)
    steps_hz = mean_rad_s / (2.0 * np.tan(half_step))
    inertia = np.maximum(inertia_kg_m2[1:-1], LEAST_SHARE * mean)
    square = mean_rad_s**2 * mean / inertia
    # (h² + ζωh + ω²/4) y_k + (ω²/2 − 2 h²) y_k−1 + (h² − ζωh + ω²/4) y_k−2
    #     = ω²/4 (τ_k + 2 τ_k−1 + τ_k−2)
    damping = damping_ratio * np.sqrt(square) * steps_hz
    quarter = square / 4.0
    last = steps_hz**2 + damping + quarter
    # y_k, y_k−1 and y_k−2 in each row: a triangular system with two bands.
    band = np.ones((3, len(torque_nm)), order="F")
    before = 2.0 * quarter - 2.0 * steps_hz**2
    two_before = steps_hz**2 - damping + quarter
    band[1, 0] = 0.0
    band[1, 1:-1] = before / last
    band[2, :-2] = two_before / last
    smoothed_nm = torque_nm[2:] + 2.0 * torque_nm[1:-1] + torque_nm[:-2]
    driven = torque_nm.copy()
    driven[2:] = quarter / last * smoothed_nm
    solution, _ = lapack.dtbtrs(band, driven[:, None], uplo="L", diag="U")
    return np.asarray(solution[:, 0])
