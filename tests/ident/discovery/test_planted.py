"""Every family, planted with the true load and current:
named on its axis, with the right size and sign.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.data.run import Run
from ident.discovery.candidates import ColumnCache
from ident.discovery.evidence import Evidence, with_effects
from ident.discovery.few_moves import FEWEST_MOVES, moves_behind
from ident.discovery.gates import Gates
from ident.discovery.geometry_check import check_geometry
from ident.discovery.loop import find_effects
from ident.discovery.search import rank_effects, rank_families
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect, GearSide, PlacedEffect
from ident.effects.electrical import Lag, Saturation
from ident.errors import CurrentConstant, TooFewMoves
from ident.estimators.identify import identify
from ident.estimators.maximum_likelihood import ml
from ident.model.model import DriveTrain, Model
from ident.model.robot import Motion
from tests.ident.recordings import (
    CONDITIONING,
    GAINS,
    PAYLOAD_TRUTH,
    RATIO,
    Truth,
    acting_on,
    bent,
    gathered,
    search_problem_of,
    training_error,
    with_current,
)

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]

PAUSE_S = 40.0
"""From the start of one run to that of the next."""
GATES = Gates(draws=199)


@dataclass(frozen=True)
class TrueSignals:
    """True signals of a run; arrays of all axes, shape (n, k), and the axis in question."""

    axis: int
    positions: FloatArray
    velocities: FloatArray
    accelerations: FloatArray
    motor_angles: FloatArray
    loads: FloatArray
    frictions: FloatArray
    motor_torques: FloatArray
    time_s: FloatArray
    started_s: float
    rate_hz: float
    pulls: Callable[[int], FloatArray]
    temperatures: FloatArray

    @property
    def position(self) -> FloatArray:
        """Position of the axis."""
        return np.asarray(self.positions[self.axis])

    @property
    def velocity(self) -> FloatArray:
        """Velocity of the axis."""
        return np.asarray(self.velocities[self.axis])

    @property
    def load(self) -> FloatArray:
        """Load of the axis."""
        return np.asarray(self.loads[self.axis])

    @property
    def motor_torque(self) -> FloatArray:
        """Motor torque of the axis."""
        return np.asarray(self.motor_torques[self.axis])

    @property
    def motor_angle(self) -> FloatArray:
        """Motor angle of the axis."""
        return np.asarray(self.motor_angles[self.axis])

    def pull(self) -> FloatArray:
        """Torque of every joint per unit of acceleration of the axis, at every sample."""
        return self.pulls(self.axis)

    def accelerated(self, of_time: FloatArray) -> FloatArray:
        """Second derivative."""
        step = 1.0 / self.rate_hz
        middle = (of_time[2:] - 2.0 * of_time[1:-1] + of_time[:-2]) / step**2
        return np.concatenate((middle[:1], middle, middle[-1:]))


@dataclass(frozen=True)
class Planted:
    """An effect in a formula of the test's own, with the coefficients that must come back.

    The formula gives the torque of its axis, shape (k,), or of all joints or motors, shape (n, k).
    """

    family: str
    axis: int
    torque: Callable[[TrueSignals], FloatArray]
    expected: tuple[float, ...]


def _bristle(t: TrueSignals, distance_rad: float) -> FloatArray:
    """z of Dahl's model, sample by sample:
    dz = (1 − z s) dq/η with the exact solution over one step.
    """
    z = 0.0
    out = np.empty_like(t.velocity)
    for k, step in enumerate(t.velocity / t.rate_hz):
        way = np.sign(step)
        z = way - (way - z) * np.exp(-abs(step) / distance_rad)
        out[k] = z
    return np.asarray(out)


def _meshed(t: TrueSignals, efficiency: float) -> FloatArray:
    """More torque where the motor drives the load, less where the load drives it:
    what a gear keeps of the power.
    """
    through = t.load + t.frictions[t.axis]
    difference = (
        np.where(through * t.velocity > 0.0, through / efficiency, through * efficiency) - through
    )
    return np.asarray(difference)


def _pushed(t: TrueSignals, half_gap_rad: float) -> FloatArray:
    """Torque of all joints for the joint behind a gap,
    which follows its motor from flank to flank.
    """
    through = t.load + t.frictions[t.axis]
    rms_through = np.sqrt(np.mean(through**2))
    width = 0.15 * rms_through
    flank = 1.0 - 2.0 / (1.0 + np.exp(2.0 * through / width))
    return np.asarray(-half_gap_rad * t.pull() * t.accelerated(flank))


def _between(t: TrueSignals, other: int, along: FloatArray) -> FloatArray:
    """The same friction on two joints."""
    torque = np.zeros_like(t.positions)
    torque[[t.axis, other]] = along
    return torque


def _rubbing(t: TrueSignals, other: int) -> FloatArray:
    both = t.velocities[t.axis] + t.velocities[other]
    along = 2.0 * np.sign(both) + 0.8 * both
    return _between(t, other, along)


def _inertial(t: TrueSignals, other: int) -> FloatArray:
    torque = np.zeros_like(t.positions)
    torque[t.axis], torque[other] = 0.25 * t.accelerations[other], 0.25 * t.accelerations[t.axis]
    return torque


def _hose(t: TrueSignals, other: int) -> FloatArray:
    """A hose of 30 Nm/rad whose way is 0.8 q_i − 0.6 q_j, which pulls and pushes."""
    force = 30.0 * (0.8 * t.positions[t.axis] - 0.6 * t.positions[other])
    torque = np.zeros_like(t.positions)
    torque[t.axis], torque[other] = 0.8 * force, -0.6 * force
    return torque


def _slack_cable(t: TrueSignals, other: int) -> FloatArray:
    """A cable that pulls where the joint is before the other one, around both at one radius;
    half of it on each.
    """
    position_difference = t.positions[t.axis] - t.positions[other]
    force = np.where(t.positions[t.axis] > t.positions[other], position_difference, 0.0)
    torque = np.zeros_like(t.positions)
    torque[t.axis], torque[other] = 15.0 * force, -15.0 * force
    return torque


def _lengthening(angle: FloatArray, foot_m: float, lever_m: float, force_n: float) -> FloatArray:
    """A constant force along a balancer: its work F Δs between neighbouring angles,
    over their difference.
    """
    ends = [np.array([np.cos(angle + way), np.sin(angle + way)]) * lever_m for way in (-1e-6, 1e-6)]
    shorter, longer = (np.hypot(foot_m - x, y) for x, y in ends)
    return np.asarray(force_n * (longer - shorter) / 2e-6)


def _cold(t: TrueSignals, clock_s: FloatArray, constant_s: float) -> FloatArray:
    velocity_sign = np.sign(t.velocity)
    return np.asarray(
        np.exp2(-clock_s / (constant_s * np.log(2.0))) * (5.0 * velocity_sign + 2.0 * t.velocity)
    )


def _heated(t: TrueSignals) -> FloatArray:
    """Dry friction that grows with temperature, and viscous friction that falls."""
    above_k = t.temperatures[t.axis] - 40.0
    velocity_sign = np.sign(t.velocity)
    return np.asarray(above_k * (0.15 * velocity_sign - 0.1 * t.velocity))


def _saturated(torque: FloatArray, gain: float, half_a: float) -> FloatArray:
    """Gain times the current that a torque needs where half the torque constant is left at half_a:
    i / (1 + (i/h)²).
    """
    least_a = torque / gain
    return np.asarray(gain * 2.0 * least_a / (1.0 + np.sqrt(1.0 - 4.0 * (least_a / half_a) ** 2)))


def _followed(torque: FloatArray, constant_s: float, rate_hz: float) -> FloatArray:
    """What a first-order lag makes of it, in ten Euler steps a sample,
    between which it goes straight.
    """
    out = np.empty_like(torque)
    state = float(torque[0])
    steps = 10
    before = state
    for sample, value in enumerate(torque.tolist()):
        for step in range(steps):
            asked = before + (value - before) * (step + 0.5) / steps
            state += (asked - state) / (constant_s * rate_hz * steps)
        out[sample], before = state, value
    return out


def _late(torques: FloatArray, delay_s: float, rate_hz: float) -> FloatArray:
    time_s = np.arange(torques.shape[1]) / rate_hz
    return np.stack([np.interp(time_s - delay_s, time_s, torque) for torque in torques])


CASES = (
    Planted("spring", 1, lambda t: 9.0 * t.position, (9.0,)),
    Planted("cogging", 0, lambda t: 4.0 * np.cos(t.motor_angle) + 3.0 * np.sin(t.motor_angle), (4.0, 3.0)),  # noqa: E501
    Planted("ripple", 0, lambda t: 4.0 * np.cos(0.5 * t.motor_angle) + 3.0 * np.sin(0.5 * t.motor_angle), (4.0, 3.0)),  # noqa: E501
    Planted("saturation", 1, lambda t: _saturated(t.motor_torque, GAINS[1], 10.0) - t.motor_torque, (0.01, 2e-4)),  # noqa: E501
    Planted("lag", 0, lambda t: _followed(t.motor_torque, 0.01, t.rate_hz) - t.motor_torque, (0.01,)),  # noqa: E501
    Planted("time-skew", 0, lambda t: _late(t.motor_torques, 0.008, t.rate_hz) - t.motor_torques, (0.008,)),  # noqa: E501
)  # fmt: skip
SMALL_CASES = (
    Planted("stribeck", 1, lambda t: 6.0 * np.sign(t.velocity) / np.exp(np.abs(t.velocity) / 0.2), (6.0,)),  # noqa: E501
    Planted("nonlinear-viscous", 2, lambda t: 1.5 * t.velocity * np.abs(t.velocity), (1.5,)),
    Planted("asymmetric-viscous", 2, lambda t: 0.9 * np.maximum(t.velocity, -t.velocity), (0.9,)),
    Planted("load-friction", 2, lambda t: 0.15 * np.abs(t.load) * np.sign(t.velocity), (0.15,)),
    Planted("position-friction", 2, lambda t: np.sign(t.velocity) * 1.5 * np.cos(t.position + 0.7), (1.147, -0.966)),  # noqa: E501
    Planted("warm-up", 1, lambda t: _cold(t, t.time_s, 20.0), (5.0, 2.0)),
    Planted("warm-up", 2, lambda t: _cold(t, t.started_s + t.time_s, 80.0), (5.0, 2.0)),
    Planted("temperature-friction", 1, _heated, (0.15, -0.1)),
    Planted("presliding", 1, lambda t: 9.0 * (_bristle(t, 0.08) - np.sign(t.velocity)), (9.0,)),
    Planted("backlash", 1, lambda t: _pushed(t, 0.004), (0.004,)),
    Planted("elasticity", 1, lambda t: -0.0005 * t.pull() * t.accelerated(t.load), (0.0005,)),
    Planted("efficiency", 1, lambda t: _meshed(t, 0.85), ((1 - 0.85**2) / (1 + 0.85**2),)),
    Planted("coupling", 1, lambda t: _rubbing(t, 2), (2.0, 0.8)),
    Planted("inertial-coupling", 0, lambda t: _inertial(t, 2), (0.25,)),
    Planted("hinge", 1, lambda t: np.where(t.position > 0.5, 12.0 * (t.position - 0.5), 0.0), (12.0,)),  # noqa: E501
    Planted("cable", 1, lambda t: _hose(t, 2), (19.2, -14.4, 10.8)),
    Planted("slack-cable", 1, lambda t: _slack_cable(t, 2), (30.0,)),
    Planted("offset-drift", 1, lambda t: 4.0 * np.exp(-(t.started_s + t.time_s) / 60.0), (4.0,)),
    Planted("gravity-compensator", 1, lambda t: 5.0 * np.cos(2.0 * t.position - np.arctan2(3.0, 4.0)), (4.0, 3.0)),  # noqa: E501
    Planted("counterbalance", 1, lambda t: _lengthening(t.position - np.pi / 3.0, 1.0, 0.5, 16.0), (8.0,)),  # noqa: E501
)  # fmt: skip
"""On the arm of three axes, which needs a third of the time."""


@dataclass(frozen=True)
class Arm:
    """A robot with nothing undeclared, and what all cases of its one motion share."""

    truth: Truth
    clean: Evidence
    cache: ColumnCache
    signals: dict[str, TrueSignals]


@pytest.fixture(scope="module")
def arm(truth: Truth, noisy: Evidence) -> Arm:
    signals = {data.name: _true(truth, data) for data in noisy.datasets}
    return Arm(truth, noisy, {}, signals)


def warmth(run: Run, started_s: float) -> FloatArray:
    """Temperature of each of three drives [°C], shape (k, 3):
    slow waves between 30 and 50 °C, as loads change.
    """
    phase = (started_s + run.time_s[:, None]) / np.array([31.0, 23.0, 41.0]) + np.array(
        [0.3, 2.0, 4.1]
    )
    return np.asarray(40.0 + 10.0 * np.sin(phase))


@pytest.fixture(scope="module")
def small_arm(small_truth: Truth, small_runs: tuple[Run, ...]) -> Arm:
    """In a session in which every run began a while after the one before,
    with drives that warm up and cool down.
    """
    runs = tuple(
        replace(run, started_s=PAUSE_S * index, temperature_c=warmth(run, PAUSE_S * index))
        for index, run in enumerate(small_runs)
    )
    clean = gathered(small_truth, runs)
    signals = {data.name: _true(small_truth, data) for data in clean.datasets}
    return Arm(small_truth, clean, {}, signals)


def _true(truth: Truth, data: Dataset) -> TrueSignals:
    names = [column.name for column in truth.model.columns]
    parameters = truth.parameters.copy()
    if data.payload is not None:
        parameters[truth.model.flange] += list(PAYLOAD_TRUTH.values())
    rigid = np.array([name[:2] not in ("Ia", "fv", "fs", "of") for name in names])
    rubbing = np.array([name[:2] in ("fv", "fs") and name[2] != "m" for name in names])
    motion = data.motion()
    columns = truth.model.regressor(motion)

    def pulls(axis: int) -> FloatArray:
        still = np.zeros_like(motion.position_rad)
        one = still.copy()
        one[:, axis] = 1.0
        moved, at_rest = (
            np.einsum(
                "jck,c->jk",
                truth.model.regressor(Motion(motion.position_rad, still, a)),
                parameters * rigid,
            )
            for a in (one, still)
        )
        return np.asarray(moved - at_rest)

    to_motor = truth.model.drive_train.to_motor
    motor_torques = to_motor @ np.einsum("jck,c->jk", columns, parameters)
    ratio = truth.model.drive_train.ratio
    motor_angles = ratio @ motion.position_rad.T
    loads = np.einsum("jck,c->jk", columns, parameters * rigid)
    frictions = np.einsum("jck,c->jk", columns, parameters * rubbing)
    time_s = data.time_s - data.time_s[0]
    return TrueSignals(
        axis=0,
        positions=motion.position_rad.T,
        velocities=motion.velocity_rad_s.T,
        accelerations=motion.acceleration_rad_s2.T,
        motor_angles=motor_angles,
        loads=loads,
        frictions=frictions,
        motor_torques=motor_torques,
        time_s=time_s,
        started_s=data.started_s or 0.0,
        rate_hz=data.rate_hz,
        pulls=pulls,
        temperatures=np.zeros((0, 0)) if data.temperature_c is None else data.temperature_c.T,
    )


def _with(arm: Arm, planted: Planted) -> Evidence:
    def torque(data: Dataset) -> FloatArray:
        changed_signal = replace(arm.signals[data.name], axis=planted.axis)
        made = planted.torque(changed_signal)
        if made.ndim == 2:
            on_all = made
        else:
            on_all = acting_on(planted.axis, len(arm.truth.gains), made)
        side = _family(planted.family)[0].side
        if side in {GearSide.MOTOR, GearSide.ALL_MOTORS}:
            direction = arm.truth.model.drive_train.direction
            return np.asarray(direction.T @ on_all)
        return on_all

    return bent(arm.clean, arm.truth, torque)


def _family(name: str) -> tuple[Effect, ...]:
    return next(family for family in EFFECTS if family[0].name == name)


def test_every_family_is_planted() -> None:
    """Those of joints without a motor in test_closed_chains.py."""
    on_axes = {family[0].name for family in EFFECTS if family[0].with_motor}
    families = {case.family for case in (*CASES, *SMALL_CASES)}
    assert families == on_axes


@pytest.mark.parametrize("planted", CASES, ids=lambda planted: planted.family)
def test_it_is_named_with_its_size_and_sign(arm: Arm, planted: Planted) -> None:
    _is_named(arm, planted)


@pytest.mark.parametrize(
    "planted", SMALL_CASES, ids=lambda planted: f"{planted.family}-{planted.axis}"
)
def test_so_it_is_on_a_smaller_arm(small_arm: Arm, planted: Planted) -> None:
    _is_named(small_arm, planted)


def _is_named(arm: Arm, planted: Planted) -> None:
    start = _with(arm, planted)
    search_problem = search_problem_of(start, arm.cache)
    rng = np.random.default_rng(0)
    findings = rank_effects(search_problem, rng, GATES)
    best = findings[0]
    assert best.passed
    names = [(placed.effect.name, placed.axis) for placed in (best.placed, *best.ambiguity)]
    assert (planted.family, planted.axis) in names
    own = next(f for f in findings if (f.effect.name, f.axis) == (planted.family, planted.axis))
    after = with_effects(start, (own.placed,))
    count = len(planted.expected)
    found = after.estimate.parameters[len(after.rows_without_effects.columns) :][:count]
    largest_absolute_expected = max(np.abs(planted.expected))
    expected = np.array(planted.expected)
    assert found == pytest.approx(expected, rel=0.2, abs=0.1 * largest_absolute_expected)
    assert training_error(after).axes[planted.axis] < training_error(start).axes[planted.axis]


FAST = ("elasticity", "backlash", "presliding", "coupling")
"""Families of torques that change where a motion does, as what is late does."""


@pytest.mark.parametrize(
    "planted", [one for one in SMALL_CASES if one.family in FAST], ids=lambda one: one.family
)
def test_a_fast_effect_is_no_delay_and_no_wrong_zero(small_arm: Arm, planted: Planted) -> None:
    """The check of the description called a spring in the gear of J1 a position that is early by
    3.5 ms.
    """
    evidence = _with(small_arm, planted)
    rng = np.random.default_rng(0)
    check = check_geometry(evidence, rng, GATES)
    assert check.mistakes == ()


def _gain_errors(arm: Arm, planted: Planted, first_order: Effect) -> tuple[Effect, float, float]:
    """Effect that is found, and errors of its gain by a first-order form of it and by what was
    found.
    """
    start = _with(arm, planted)
    rng = np.random.default_rng(0)
    families = (_family(planted.family),)
    first, last = find_effects(start, rng, GATES, families, geometry=())
    assert first.accepted is not None
    assert first.accepted.axis == planted.axis
    assert last.accepted is None
    effects = (PlacedEffect(first_order, planted.axis),)
    before = with_effects(start, effects)
    plain, whole = (
        float(np.abs(one.estimate.gains / arm.truth.gains - 1.0)[planted.axis])
        for one in (before, first.after)
    )
    return first.after.effects[0].effect, plain, whole


def test_the_filter_of_a_lag_keeps_its_gain(arm: Arm) -> None:
    """What a first-order expansion lacks goes into the gain."""
    planted = next(case for case in CASES if case.family == "lag")
    found, plain, whole = _gain_errors(arm, planted, Lag())
    assert found.settings["filter_s"] == pytest.approx(0.01, rel=0.1)
    smallest = min(0.5 * plain, 0.01)
    assert whole < smallest


def test_a_second_term_keeps_the_gain_of_a_saturated_motor(arm: Arm) -> None:
    """It rests on few moves, whose random signs test nothing:
    the first one says whether the effect is there.
    """
    planted = Planted(
        "saturation", 2, lambda t: _saturated(t.motor_torque, GAINS[2], 12.0) - t.motor_torque, ()
    )
    evidence = _with(arm, planted)
    families = (_family("saturation"),)
    (family,) = search_problem_of(evidence).test(families, 2)
    first, both = (moves_behind(trial.gram) for _, trial in family.members)
    assert both < FEWEST_MOVES < first
    found, plain, whole = _gain_errors(arm, planted, Saturation())
    assert found == Saturation(two_terms=1)
    smallest = min(0.5 * plain, 0.01)
    assert whole < smallest


def test_a_richer_form_needs_no_possible_simpler_one(small_arm: Arm) -> None:
    problem = search_problem_of(small_arm.clean)
    families = (_family("saturation"),)
    (family,) = problem.test(families, 1)
    (plain, one), (whole, both) = family.members
    coefficients = np.array([-1e9])
    changed_both = replace(both, coefficients=np.array([1.0, 1.0]))
    trials = (
        replace(one, coefficients=coefficients),
        changed_both,
    )
    members = tuple(zip((plain, whole), trials, strict=True))
    tested = (replace(family, members=members),)
    rng = np.random.default_rng(0)
    (finding,) = rank_families(problem, tested, rng, GATES)
    assert finding.effect == whole


def test_motors_in_another_order_change_no_verdict(arm: Arm) -> None:
    """A spring on joint 2 must pass its gates on whichever motor gives the torque."""
    order = np.array([2, 0, 1, 3, 5, 4])
    start = _with(arm, CASES[0])
    drive_train = DriveTrain(RATIO[order])
    robot = arm.truth.model.robot
    model = Model(robot, drive_train)
    training = replace(
        start.training,
        model=model,
        current=start.training.current[order],
        motor_use=start.training.motor_use[order],
    )
    estimate = ml(training.system())
    turned = replace(start, model=model, training=training, estimate=estimate)
    families = (_family("spring"), _family("stribeck"), _family("load-friction"))
    rng = np.random.default_rng(0)
    findings = rank_effects(search_problem_of(turned), rng, GATES, families)
    effect = findings[0].effect
    passed = findings[0].passed
    assert (effect.name, findings[0].axis, passed) == ("spring", 1, True)
    search_problem = search_problem_of(start, arm.cache)
    same = rank_effects(search_problem, np.random.default_rng(0), GATES, families)
    assert findings[0].explained == pytest.approx(same[0].explained, rel=1e-3)


def test_a_dead_current_channel_is_named(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    dead = tuple(
        replace(run, current_a=run.current_a * np.array([1, 1, 1, 0, 1, 1])) for run in noisy_runs
    )
    with pytest.raises(CurrentConstant, match="axis J4: found a current that is zero throughout"):
        identify(truth.model, dead, CONDITIONING)


def test_too_few_moves_are_refused_and_continuous_motion_counts_by_time(
    truth: Truth, clean_runs: tuple[Run, ...], noisy_runs: tuple[Run, ...]
) -> None:
    standstill_rad_s = (0.0,) * 6
    never_still = replace(CONDITIONING, standstill_rad_s=standstill_rad_s)
    whole = identify(truth.model, noisy_runs, never_still)
    assert len(whole.system.clusters) >= 4 * 11
    assert np.all(whole.estimate.gains_std > 1e-4 * np.abs(GAINS))
    rate_hz = clean_runs[0].rate_hz
    few = round(5.0 * rate_hz)
    short = tuple(
        replace(
            run,
            time_s=run.time_s[:few],
            position_rad=run.position_rad[:few],
            current_a=run.current_a[:few],
        )
        for run in clean_runs
    )
    with pytest.raises(TooFewMoves, match="record longer"):
        identify(truth.model, short, never_still)


def test_sigma_is_true_for_correlated_noise(small_arm: Arm) -> None:
    """Lag-one correlation 0.67 in every current:
    the spread over 24 draws against the σ that each of them claims.
    """
    rng = np.random.default_rng(5)
    clean = small_arm.clean
    bare = clean.rows_without_effects
    estimate = clean.estimate
    to_motor = small_arm.truth.model.drive_train.to_motor
    exact = to_motor @ estimate.predicted_torque(bare) / estimate.gains[:, None]
    gains = []
    claimed = []
    for _ in range(24):
        noise = np.empty_like(exact)
        noise[:, 0] = rng.normal(size=len(exact))
        drawn = rng.normal(size=exact.shape)
        for row in range(1, exact.shape[1]):
            noise[:, row] = 0.67 * noise[:, row - 1] + np.sqrt(1 - 0.67**2) * drawn[:, row]
        added_a = exact + 0.05 * noise - bare.current
        found = with_current(clean, added_a).estimate
        gains.append(found.gains)
        claimed.append(found.gains_std)
    gain_std = np.std(gains, axis=0, ddof=1)
    mean_claimed = np.mean(claimed, axis=0)
    ratio = mean_claimed / gain_std
    # 24 draws know a deviation to 15 % (1/√46); three of those on either side.
    assert np.all(ratio > 0.6)
    assert np.all(ratio < 1.6)


def test_the_loop_ends_where_nothing_is_left(small_arm: Arm) -> None:
    planted = next(case for case in SMALL_CASES if case.family == "load-friction")
    start = _with(small_arm, planted)
    rng = np.random.default_rng(1)
    steps = find_effects(start, rng)
    assert [step.accepted is not None for step in steps] == [True, False]


def test_a_name_that_structure_refutes_bends_no_gain(arm: Arm) -> None:
    """Of what grows with the load, a dictionary without it can name only a saturation,
    which would bend the gain.

    Physics refuses that of two terms, because d < 0, but not that of one term.
    """
    grown = Planted(
        "load-friction", 1, lambda t: 0.3 * np.abs(t.load) * np.sign(t.velocity), (0.3,)
    )
    start = _with(arm, grown)
    families = _family("saturation"), _family("stribeck"), _family("spring")
    rng = np.random.default_rng(0)
    (step,) = find_effects(start, rng, GATES, families)
    assert step.accepted is None
    aside = {one.finding.effect.name: one for one in step.set_aside}
    assert set(aside) == {"smooth-load", "saturation"}
    assert "the gain of J2 by" in aside["saturation"].reason(("J1", "J2", "J3", "J4", "J5", "J6"))
    effect = aside["smooth-load"].finding.effect
    rival = aside["saturation"].rival
    assert rival == PlacedEffect(effect, 1)
    # With it the gain would be off by more than three times as much.
    finding = aside["saturation"].finding
    effects = (PlacedEffect(finding.effect, 1),)
    bent_by_name = with_effects(start, effects).estimate
    before, after = (
        np.abs(one.gains / arm.truth.gains - 1.0)[1] for one in (start.estimate, bent_by_name)
    )
    assert after > 3.0 * before


def test_friction_against_temperature_is_named_first_and_the_worst_gain_gets_better(
    small_arm: Arm,
) -> None:
    planted = next(case for case in SMALL_CASES if case.family == "temperature-friction")
    start = _with(small_arm, planted)
    rng = np.random.default_rng(1)
    steps = find_effects(start, rng)
    first = steps[0].accepted
    assert first is not None
    assert (first.effect.name, first.axis) == ("temperature-friction", 1)
    last_step = steps[-1]
    before, after = (
        np.abs(evidence.estimate.gains / small_arm.truth.gains - 1.0).max()
        for evidence in (start, last_step.after)
    )
    assert after < before


def test_drives_that_warm_up_without_an_effect_give_none(small_arm: Arm) -> None:
    rng = np.random.default_rng(1)
    (step,) = find_effects(small_arm.clean, rng)
    assert step.accepted is None
    assert "temperature-friction" in {finding.effect.name for finding in step.findings}
