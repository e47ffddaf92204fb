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
J3 = 2
"""Axis of the small arm that a coupling or a cable joins to the axis of its case."""
EFFICIENCY = 0.85


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
    inertia_columns: Callable[[int], FloatArray]
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
    def speed(self) -> FloatArray:
        """Absolute velocity of the axis."""
        return np.abs(self.velocity)

    @property
    def direction(self) -> FloatArray:
        """Sign of the velocity of the axis."""
        return np.asarray(np.sign(self.velocity))

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

    @property
    def session_s(self) -> FloatArray:
        """Time since the session began."""
        return self.started_s + self.time_s

    def inertia_column(self) -> FloatArray:
        """Torque of every joint per unit of acceleration of the axis, at every sample."""
        return self.inertia_columns(self.axis)

    def second_derivative(self, of_time: FloatArray) -> FloatArray:
        """Second derivative by central differences; the ends repeat their neighbours."""
        step = 1.0 / self.rate_hz
        after = of_time[2:]
        here = of_time[1:-1]
        before = of_time[:-2]
        difference = after - 2.0 * here + before
        middle = difference / step**2
        first = middle[:1]
        last = middle[-1:]
        return np.concatenate((first, middle, last))

    def on_two_joints(self, own: FloatArray, other: FloatArray) -> FloatArray:
        """Torque of all joints, of which one acts on the axis and one on J3, shape (n, k)."""
        torque = np.zeros_like(self.positions)
        torque[self.axis] = own
        torque[J3] = other
        return torque


@dataclass(frozen=True)
class Planted:
    """An effect in a formula of the test's own, with the coefficients that must come back.

    The formula gives the torque of its axis, shape (k,), or of all joints or motors, shape (n, k).
    """

    family: str
    axis: int
    torque: Callable[[TrueSignals], FloatArray]
    expected: tuple[float, ...]


def _spring(t: TrueSignals) -> FloatArray:
    return 9.0 * t.position


def _cogging(t: TrueSignals) -> FloatArray:
    """Once a turn of the motor."""
    return _wave(t.motor_angle)


def _ripple(t: TrueSignals) -> FloatArray:
    """Once every second turn of the motor."""
    half_angle = 0.5 * t.motor_angle
    return _wave(half_angle)


def _wave(angle: FloatArray) -> FloatArray:
    cosine = 4.0 * np.cos(angle)
    sine = 3.0 * np.sin(angle)
    return np.asarray(cosine + sine)


def _saturation(t: TrueSignals) -> FloatArray:
    return _torque_lost_by_saturation(t, half_a=10.0)


def _torque_lost_by_saturation(t: TrueSignals, half_a: float) -> FloatArray:
    """Gain times the current that a torque needs where half the torque constant is left at half_a,
    i / (1 + (i/h)²), less that torque.
    """
    gain = GAINS[t.axis]
    least_a = t.motor_torque / gain
    share = least_a / half_a
    root = np.sqrt(1.0 - 4.0 * share**2)
    current_a = 2.0 * least_a / (1.0 + root)
    saturated = gain * current_a
    return np.asarray(saturated - t.motor_torque)


def _lag(t: TrueSignals) -> FloatArray:
    followed = _first_order_lag(t.motor_torque, 0.01, t.rate_hz)
    return followed - t.motor_torque


def _first_order_lag(torque: FloatArray, constant_s: float, rate_hz: float) -> FloatArray:
    """Torque behind a first-order lag, in ten Euler steps a sample,
    between which it goes straight.
    """
    out = np.empty_like(torque)
    state = float(torque[0])
    steps = 10
    constant_steps = constant_s * rate_hz * steps
    before = state
    for sample, value in enumerate(torque.tolist()):
        change = value - before
        for step in range(steps):
            middle = (step + 0.5) / steps
            target = before + change * middle
            state += (target - state) / constant_steps
        out[sample] = state
        before = value
    return out


def _time_skew(t: TrueSignals) -> FloatArray:
    """Current of every axis recorded 8 ms late."""
    _, count = t.motor_torques.shape
    time_s = np.arange(count) / t.rate_hz
    earlier_s = time_s - 0.008
    late = [np.interp(earlier_s, time_s, torque) for torque in t.motor_torques]
    return np.stack(late) - t.motor_torques


def _stribeck(t: TrueSignals) -> FloatArray:
    left = np.exp(-t.speed / 0.2)
    return np.asarray(6.0 * t.direction * left)


def _nonlinear_viscous(t: TrueSignals) -> FloatArray:
    return np.asarray(1.5 * t.velocity * t.speed)


def _asymmetric_viscous(t: TrueSignals) -> FloatArray:
    speed = np.maximum(t.velocity, -t.velocity)
    return np.asarray(0.9 * speed)


def _load_friction(t: TrueSignals) -> FloatArray:
    return _friction_by_load(t, 0.15)


def _friction_by_load(t: TrueSignals, share: float) -> FloatArray:
    dry = share * np.abs(t.load)
    return np.asarray(dry * t.direction)


def _position_friction(t: TrueSignals) -> FloatArray:
    dry = 1.5 * np.cos(t.position + 0.7)
    return np.asarray(dry * t.direction)


def _warm_up_of_a_run(t: TrueSignals) -> FloatArray:
    return _cold_friction(t, t.time_s, constant_s=20.0)


def _warm_up_of_a_session(t: TrueSignals) -> FloatArray:
    return _cold_friction(t, t.session_s, constant_s=80.0)


def _cold_friction(t: TrueSignals, clock_s: FloatArray, constant_s: float) -> FloatArray:
    """Friction that falls with time, as exp(-clock/constant)."""
    half_life_s = constant_s * np.log(2.0)
    left = np.exp2(-clock_s / half_life_s)
    dry = 5.0 * t.direction
    viscous = 2.0 * t.velocity
    warm = dry + viscous
    return np.asarray(left * warm)


def _temperature_friction(t: TrueSignals) -> FloatArray:
    """Dry friction that grows with temperature, and viscous friction that falls."""
    above_k = t.temperatures[t.axis] - 40.0
    dry = 0.15 * t.direction
    viscous = 0.1 * t.velocity
    per_k = dry - viscous
    return np.asarray(above_k * per_k)


def _presliding(t: TrueSignals) -> FloatArray:
    bristle = _bristle(t, 0.08)
    missing = bristle - t.direction
    return np.asarray(9.0 * missing)


def _bristle(t: TrueSignals, distance_rad: float) -> FloatArray:
    """z of Dahl's model, sample by sample:
    dz = (1 − z s) dq/η with the exact solution over one step.
    """
    z = 0.0
    out = np.empty_like(t.velocity)
    step_rad = t.velocity / t.rate_hz
    for k, step in enumerate(step_rad):
        way = np.sign(step)
        left = np.exp(-abs(step) / distance_rad)
        z = way - (way - z) * left
        out[k] = z
    return np.asarray(out)


def _backlash(t: TrueSignals) -> FloatArray:
    """Torque of all joints for the joint behind a gap of 2 × 4 mrad,
    which follows its motor from flank to flank.
    """
    half_gap_rad = 0.004
    through = _torque_through_the_gear(t)
    rms_through = np.sqrt(np.mean(through**2))
    width = 0.15 * rms_through
    growth = np.exp(2.0 * through / width)
    flank = 1.0 - 2.0 / (1.0 + growth)
    gap_rad = half_gap_rad * flank
    acceleration = t.second_derivative(gap_rad)
    return np.asarray(-t.inertia_column() * acceleration)


def _torque_through_the_gear(t: TrueSignals) -> FloatArray:
    return np.asarray(t.load + t.frictions[t.axis])


def _elasticity(t: TrueSignals) -> FloatArray:
    """A gear of 2000 Nm/rad."""
    wind_up_rad = 0.0005 * t.load
    acceleration = t.second_derivative(wind_up_rad)
    return np.asarray(-t.inertia_column() * acceleration)


def _efficiency(t: TrueSignals) -> FloatArray:
    """More torque where the motor drives the load, less where the load drives it:
    what a gear keeps of the power.
    """
    through = _torque_through_the_gear(t)
    power = through * t.velocity
    needed = through / EFFICIENCY
    left = through * EFFICIENCY
    motor_torque = np.where(power > 0.0, needed, left)
    return np.asarray(motor_torque - through)


def _coupling(t: TrueSignals) -> FloatArray:
    """The same friction on this joint and on J3, from the sum of their velocities."""
    velocity_sum = t.velocity + t.velocities[J3]
    dry = 2.0 * np.sign(velocity_sum)
    viscous = 0.8 * velocity_sum
    friction = dry + viscous
    return t.on_two_joints(friction, friction)


def _inertial_coupling(t: TrueSignals) -> FloatArray:
    own = 0.25 * t.accelerations[J3]
    other = 0.25 * t.accelerations[t.axis]
    return t.on_two_joints(own, other)


def _hinge(t: TrueSignals) -> FloatArray:
    """A spring that begins at 0.5 rad."""
    beyond_rad = np.maximum(t.position - 0.5, 0.0)
    return np.asarray(12.0 * beyond_rad)


def _hose(t: TrueSignals) -> FloatArray:
    """A hose of 30 Nm/rad whose way is 0.8 q_i − 0.6 q_j, which pulls and pushes."""
    own_way = 0.8 * t.position
    other_way = 0.6 * t.positions[J3]
    force = 30.0 * (own_way - other_way)
    return t.on_two_joints(0.8 * force, -0.6 * force)


def _slack_cable(t: TrueSignals) -> FloatArray:
    """A cable that pulls where the joint is before J3, around both at one radius;
    half of it on each.
    """
    difference_rad = t.position - t.positions[J3]
    stretch_rad = np.maximum(difference_rad, 0.0)
    pull = 15.0 * stretch_rad
    return t.on_two_joints(pull, -pull)


def _offset_drift(t: TrueSignals) -> FloatArray:
    left = np.exp(-t.session_s / 60.0)
    return np.asarray(4.0 * left)


def _gravity_compensator(t: TrueSignals) -> FloatArray:
    phase = np.arctan2(3.0, 4.0)
    angle = 2.0 * t.position - phase
    return np.asarray(5.0 * np.cos(angle))


def _counterbalance(t: TrueSignals) -> FloatArray:
    """A constant force along a balancer: its work F Δs between neighbouring angles,
    over their difference.
    """
    force_n = 16.0
    angle = t.position - np.pi / 3.0
    shorter = _balancer_length_m(angle - 1e-6)
    longer = _balancer_length_m(angle + 1e-6)
    work_nm = force_n * (longer - shorter)
    return np.asarray(work_nm / 2e-6)


def _balancer_length_m(angle: FloatArray) -> FloatArray:
    foot_m = 1.0
    lever_m = 0.5
    x_m = np.cos(angle) * lever_m
    y_m = np.sin(angle) * lever_m
    return np.hypot(foot_m - x_m, y_m)


CASES = (
    Planted("spring", 1, _spring, (9.0,)),
    Planted("cogging", 0, _cogging, (4.0, 3.0)),
    Planted("ripple", 0, _ripple, (4.0, 3.0)),
    Planted("saturation", 1, _saturation, (0.01, 2e-4)),
    Planted("lag", 0, _lag, (0.01,)),
    Planted("time-skew", 0, _time_skew, (0.008,)),
)
FRICTION_CASES = (
    Planted("stribeck", 1, _stribeck, (6.0,)),
    Planted("nonlinear-viscous", 2, _nonlinear_viscous, (1.5,)),
    Planted("asymmetric-viscous", 2, _asymmetric_viscous, (0.9,)),
    Planted("load-friction", 2, _load_friction, (0.15,)),
    Planted("position-friction", 2, _position_friction, (1.147, -0.966)),
    Planted("warm-up", 1, _warm_up_of_a_run, (5.0, 2.0)),
    Planted("warm-up", 2, _warm_up_of_a_session, (5.0, 2.0)),
    Planted("temperature-friction", 1, _temperature_friction, (0.15, -0.1)),
    Planted("presliding", 1, _presliding, (9.0,)),
)
#: Dry friction that has the same loss, as a share of the load: (1 − η²)/(1 + η²)
EFFICIENCY_SHARE = (1 - EFFICIENCY**2) / (1 + EFFICIENCY**2)
GEAR_CASES = (
    Planted("backlash", 1, _backlash, (0.004,)),
    Planted("elasticity", 1, _elasticity, (0.0005,)),
    Planted("efficiency", 1, _efficiency, (EFFICIENCY_SHARE,)),
    Planted("coupling", 1, _coupling, (2.0, 0.8)),
    Planted("inertial-coupling", 0, _inertial_coupling, (0.25,)),
)
OUTSIDE_CASES = (
    Planted("hinge", 1, _hinge, (12.0,)),
    Planted("cable", 1, _hose, (19.2, -14.4, 10.8)),
    Planted("slack-cable", 1, _slack_cable, (30.0,)),
    Planted("offset-drift", 1, _offset_drift, (4.0,)),
    Planted("gravity-compensator", 1, _gravity_compensator, (4.0, 3.0)),
    Planted("counterbalance", 1, _counterbalance, (8.0,)),
)
SMALL_CASES = (*FRICTION_CASES, *GEAR_CASES, *OUTSIDE_CASES)
"""On the arm of three axes, which needs a third of the time."""
ALL_CASES = (*CASES, *SMALL_CASES)


def _case(family: str) -> Planted:
    """The first case of a family."""
    of_family = [case for case in ALL_CASES if case.family == family]
    return of_family[0]


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
    session_s = started_s + run.time_s
    time_constant_s = np.array([31.0, 23.0, 41.0])
    start_phase = np.array([0.3, 2.0, 4.1])
    phase = session_s[:, None] / time_constant_s + start_phase
    wave = np.sin(phase)
    return np.asarray(40.0 + 10.0 * wave)


@pytest.fixture(scope="module")
def small_arm(small_truth: Truth, small_runs: tuple[Run, ...]) -> Arm:
    """In a session in which every run began a while after the one before,
    with drives that warm up and cool down.
    """
    runs = []
    for index, run in enumerate(small_runs):
        started_s = PAUSE_S * index
        temperature_c = warmth(run, started_s)
        timed = replace(run, started_s=started_s, temperature_c=temperature_c)
        runs.append(timed)
    clean = gathered(small_truth, tuple(runs))
    signals = {data.name: _true(small_truth, data) for data in clean.datasets}
    return Arm(small_truth, clean, {}, signals)


def _true(truth: Truth, data: Dataset) -> TrueSignals:
    names = [column.name for column in truth.model.columns]
    parameters = truth.parameters.copy()
    if data.payload is not None:
        payload = list(PAYLOAD_TRUTH.values())
        parameters[truth.model.flange] += payload
    rigid = [_is_rigid(name) for name in names]
    rubbing = [_is_joint_friction(name) for name in names]
    rigid_parameters = np.where(rigid, parameters, 0.0)
    rubbing_parameters = np.where(rubbing, parameters, 0.0)
    motion = data.motion()
    columns = truth.model.regressor(motion)

    def inertia_columns(axis: int) -> FloatArray:
        still = np.zeros_like(motion.position_rad)
        one = still.copy()
        one[:, axis] = 1.0
        accelerated = Motion(motion.position_rad, still, one)
        standing = Motion(motion.position_rad, still, still)
        moved = _torque(truth.model.regressor(accelerated), rigid_parameters)
        at_rest = _torque(truth.model.regressor(standing), rigid_parameters)
        return np.asarray(moved - at_rest)

    drive_train = truth.model.drive_train
    joint_torques = _torque(columns, parameters)
    motor_torques = drive_train.to_motor @ joint_torques
    motor_angles = drive_train.ratio @ motion.position_rad.T
    loads = _torque(columns, rigid_parameters)
    frictions = _torque(columns, rubbing_parameters)
    time_s = data.time_s - data.time_s[0]
    temperatures = np.zeros((0, 0))
    if data.temperature_c is not None:
        temperatures = data.temperature_c.T
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
        inertia_columns=inertia_columns,
        temperatures=temperatures,
    )


def _is_rigid(name: str) -> bool:
    """Whether a column of the regressor is of a link, neither of a rotor nor of friction."""
    return not name.startswith(("Ia", "fv", "fs", "of"))


def _is_joint_friction(name: str) -> bool:
    """Whether a column of the regressor is of friction on a joint, not on a motor."""
    is_friction = name.startswith(("fv", "fs"))
    return is_friction and name[2] != "m"


def _torque(columns: FloatArray, parameters: FloatArray) -> FloatArray:
    """Torque of every joint, shape (n, k), of a regressor of shape (n, c, k)."""
    torque = np.einsum("jck,c->jk", columns, parameters)
    return np.asarray(torque)


def _with(arm: Arm, planted: Planted) -> Evidence:
    def torque(data: Dataset) -> FloatArray:
        signals = arm.signals[data.name]
        of_axis = replace(signals, axis=planted.axis)
        made = planted.torque(of_axis)
        if made.ndim == 2:
            on_all = made
        else:
            axis_count = len(arm.truth.gains)
            on_all = acting_on(planted.axis, axis_count, made)
        simplest = _family(planted.family)[0]
        if simplest.side in {GearSide.MOTOR, GearSide.ALL_MOTORS}:
            direction = arm.truth.model.drive_train.direction
            return np.asarray(direction.T @ on_all)
        return on_all

    return bent(arm.clean, arm.truth, torque)


def _family(name: str) -> tuple[Effect, ...]:
    of_name = [family for family in EFFECTS if family[0].name == name]
    return of_name[0]


def test_every_family_is_planted() -> None:
    """Those of joints without a motor in test_closed_chains.py."""
    simplest = [family[0] for family in EFFECTS]
    on_axes = {effect.name for effect in simplest if effect.with_motor}
    planted = {case.family for case in ALL_CASES}
    assert planted == on_axes


@pytest.mark.parametrize("planted", CASES, ids=lambda planted: planted.family)
def test_planted_effect_is_named_with_its_size_and_sign(arm: Arm, planted: Planted) -> None:
    _is_named(arm, planted)


@pytest.mark.parametrize(
    "planted", SMALL_CASES, ids=lambda planted: f"{planted.family}-{planted.axis}"
)
def test_planted_effect_on_a_small_arm_is_named_with_its_size_and_sign(
    small_arm: Arm, planted: Planted
) -> None:
    _is_named(small_arm, planted)


def _is_named(arm: Arm, planted: Planted) -> None:
    start = _with(arm, planted)
    search_problem = search_problem_of(start, arm.cache)
    rng = np.random.default_rng(0)
    findings = rank_effects(search_problem, rng, GATES)
    best = findings[0]
    assert best.passed
    place = (planted.family, planted.axis)
    indistinguishable = (best.placed, *best.ambiguity)
    places = [(placed.effect.name, placed.axis) for placed in indistinguishable]
    assert place in places
    at_place = [finding for finding in findings if (finding.effect.name, finding.axis) == place]
    own = at_place[0]
    after = with_effects(start, (own.placed,))
    first = len(after.rows_without_effects.columns)
    coefficients = after.estimate.parameters[first:]
    count = len(planted.expected)
    expected = np.array(planted.expected)
    largest_expected = max(np.abs(expected))
    near_expected = pytest.approx(expected, rel=0.2, abs=0.1 * largest_expected)
    assert coefficients[:count] == near_expected
    error_before = training_error(start).axes[planted.axis]
    error_after = training_error(after).axes[planted.axis]
    assert error_after < error_before


@pytest.mark.parametrize("family", ["elasticity", "backlash", "presliding", "coupling"])
def test_a_fast_effect_is_no_delay_and_no_wrong_zero(small_arm: Arm, family: str) -> None:
    """Torques of these families change where a motion does, as what is late does.

    The check of the description called a spring in the gear of J1 a position that is early by
    3.5 ms.
    """
    evidence = _with(small_arm, _case(family))
    rng = np.random.default_rng(0)
    check = check_geometry(evidence, rng, GATES)
    assert check.mistakes == ()


@dataclass(frozen=True)
class GainErrors:
    """Effect that is found, and relative errors of the gain of its axis."""

    found: Effect
    by_first_order: float
    by_found: float


def _gain_errors(arm: Arm, planted: Planted, first_order: Effect) -> GainErrors:
    """Errors of a gain by a first-order form of an effect and by the form that is found."""
    start = _with(arm, planted)
    rng = np.random.default_rng(0)
    families = (_family(planted.family),)
    first, last = find_effects(start, rng, GATES, families, geometry=())
    assert first.accepted is not None
    assert first.accepted.axis == planted.axis
    assert last.accepted is None
    placed = PlacedEffect(first_order, planted.axis)
    with_first_order = with_effects(start, (placed,))
    by_first_order = _gain_error(arm, with_first_order)
    by_found = _gain_error(arm, first.after)
    return GainErrors(
        found=first.after.effects[0].effect,
        by_first_order=by_first_order[planted.axis],
        by_found=by_found[planted.axis],
    )


def _gain_error(arm: Arm, evidence: Evidence) -> FloatArray:
    """Relative error of every gain, shape (m,)."""
    gain_ratio = evidence.estimate.gains / arm.truth.gains
    return np.asarray(np.abs(gain_ratio - 1.0))


def test_the_filter_of_a_lag_keeps_its_gain(arm: Arm) -> None:
    """What a first-order expansion lacks goes into the gain."""
    errors = _gain_errors(arm, _case("lag"), Lag())
    filter_s = errors.found.settings["filter_s"]
    assert filter_s == pytest.approx(0.01, rel=0.1)
    assert errors.by_found < 0.5 * errors.by_first_order
    assert errors.by_found < 0.01


def test_a_second_term_keeps_the_gain_of_a_saturated_motor(arm: Arm) -> None:
    """It rests on few moves, whose random signs test nothing:
    the first one says whether the effect is there.
    """

    def torque(t: TrueSignals) -> FloatArray:
        return _torque_lost_by_saturation(t, half_a=12.0)

    planted = Planted("saturation", 2, torque, ())
    evidence = _with(arm, planted)
    families = (_family("saturation"),)
    (family,) = search_problem_of(evidence).test(families, 2)
    (_, first_trial), (_, trial_of_both) = family.members
    moves_of_first = moves_behind(first_trial.gram)
    moves_of_both = moves_behind(trial_of_both.gram)
    assert moves_of_both < FEWEST_MOVES < moves_of_first
    errors = _gain_errors(arm, planted, Saturation())
    assert errors.found == Saturation(two_terms=1)
    assert errors.by_found < 0.5 * errors.by_first_order
    assert errors.by_found < 0.01


def test_a_richer_form_needs_no_possible_simpler_one(small_arm: Arm) -> None:
    problem = search_problem_of(small_arm.clean)
    families = (_family("saturation"),)
    (family,) = problem.test(families, 1)
    (simple, simple_trial), (rich, rich_trial) = family.members
    negative = np.array([-1e9])
    positive = np.array([1.0, 1.0])
    impossible = replace(simple_trial, coefficients=negative)
    possible = replace(rich_trial, coefficients=positive)
    members = ((simple, impossible), (rich, possible))
    tested = (replace(family, members=members),)
    rng = np.random.default_rng(0)
    (finding,) = rank_families(problem, tested, rng, GATES)
    assert finding.effect == rich


def test_motors_in_another_order_change_no_verdict(arm: Arm) -> None:
    """A spring on joint 2 must pass its gates on whichever motor gives the torque."""
    order = np.array([2, 0, 1, 3, 5, 4])
    start = _with(arm, CASES[0])
    drive_train = DriveTrain(RATIO[order])
    robot = arm.truth.model.robot
    model = Model(robot, drive_train)
    current = start.training.current[order]
    motor_use = start.training.motor_use[order]
    training = replace(start.training, model=model, current=current, motor_use=motor_use)
    estimate = ml(training.system())
    turned = replace(start, model=model, training=training, estimate=estimate)
    families = (_family("spring"), _family("stribeck"), _family("load-friction"))
    rng = np.random.default_rng(0)
    search_problem = search_problem_of(turned)
    best = rank_effects(search_problem, rng, GATES, families)[0]
    assert best.effect.name == "spring"
    assert best.axis == 1
    assert best.passed
    search_problem = search_problem_of(start, arm.cache)
    rng = np.random.default_rng(0)
    best_in_order = rank_effects(search_problem, rng, GATES, families)[0]
    explained_in_order = pytest.approx(best_in_order.explained, rel=1e-3)
    assert best.explained == explained_in_order


def test_a_dead_current_channel_is_named(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    channels = np.array([1, 1, 1, 0, 1, 1])
    dead = []
    for run in noisy_runs:
        current_a = run.current_a * channels
        dead_run = replace(run, current_a=current_a)
        dead.append(dead_run)
    with pytest.raises(CurrentConstant, match="axis J4: found a current that is zero throughout"):
        identify(truth.model, tuple(dead), CONDITIONING)


def test_too_few_moves_are_refused_and_continuous_motion_counts_by_time(
    truth: Truth, clean_runs: tuple[Run, ...], noisy_runs: tuple[Run, ...]
) -> None:
    standstill_rad_s = (0.0,) * 6
    never_still = replace(CONDITIONING, standstill_rad_s=standstill_rad_s)
    identified = identify(truth.model, noisy_runs, never_still)
    assert len(identified.system.clusters) >= 4 * 11
    smallest_std = 1e-4 * np.abs(GAINS)
    assert np.all(identified.estimate.gains_std > smallest_std)
    rate_hz = clean_runs[0].rate_hz
    few = round(5.0 * rate_hz)
    short = [_first_samples(run, few) for run in clean_runs]
    with pytest.raises(TooFewMoves, match="record longer"):
        identify(truth.model, tuple(short), never_still)


def _first_samples(run: Run, count: int) -> Run:
    return replace(
        run,
        time_s=run.time_s[:count],
        position_rad=run.position_rad[:count],
        current_a=run.current_a[:count],
    )


def test_sigma_is_true_for_correlated_noise(small_arm: Arm) -> None:
    """Lag-one correlation 0.67 in every current:
    the spread over 24 draws against the σ that each of them claims.
    """
    rng = np.random.default_rng(5)
    clean = small_arm.clean
    bare = clean.rows_without_effects
    estimate = clean.estimate
    to_motor = small_arm.truth.model.drive_train.to_motor
    motor_torque = to_motor @ estimate.predicted_torque(bare)
    exact_a = motor_torque / estimate.gains[:, None]
    new_share = np.sqrt(1 - 0.67**2)
    gains = []
    claimed = []
    axis_count, row_count = exact_a.shape
    for _ in range(24):
        noise = np.empty_like(exact_a)
        noise[:, 0] = rng.normal(size=axis_count)
        drawn = new_share * rng.normal(size=exact_a.shape)
        for row in range(1, row_count):
            correlated = 0.67 * noise[:, row - 1]
            noise[:, row] = correlated + drawn[:, row]
        noisy_a = exact_a + 0.05 * noise
        found = with_current(clean, noisy_a - bare.current).estimate
        gains.append(found.gains)
        claimed.append(found.gains_std)
    gain_std = np.std(gains, axis=0, ddof=1)
    mean_claimed = np.mean(claimed, axis=0)
    ratio = mean_claimed / gain_std
    # 24 draws know a deviation to 15 % (1/√46); three of those on either side.
    assert np.all(ratio > 0.6)
    assert np.all(ratio < 1.6)


def test_the_loop_ends_where_nothing_is_left(small_arm: Arm) -> None:
    start = _with(small_arm, _case("load-friction"))
    rng = np.random.default_rng(1)
    first, last = find_effects(start, rng)
    assert first.accepted is not None
    assert last.accepted is None


def test_a_name_that_structure_refutes_bends_no_gain(arm: Arm) -> None:
    """Of what grows with the load, a dictionary without it can name only a saturation,
    which would bend the gain.

    Physics refuses that of two terms, because d < 0, but not that of one term.
    """

    def torque(t: TrueSignals) -> FloatArray:
        return _friction_by_load(t, 0.3)

    grown = Planted("load-friction", 1, torque, (0.3,))
    start = _with(arm, grown)
    families = _family("saturation"), _family("stribeck"), _family("spring")
    rng = np.random.default_rng(0)
    (step,) = find_effects(start, rng, GATES, families)
    assert step.accepted is None
    rejected = {candidate.finding.effect.name: candidate for candidate in step.set_aside}
    assert set(rejected) == {"smooth-load", "saturation"}
    saturation = rejected["saturation"]
    joint_names = ("J1", "J2", "J3", "J4", "J5", "J6")
    assert "the gain of J2 by" in saturation.reason(joint_names)
    smooth_load = rejected["smooth-load"].finding.effect
    assert saturation.rival == PlacedEffect(smooth_load, 1)
    # With it the gain would be off by more than three times as much.
    placed = PlacedEffect(saturation.finding.effect, 1)
    with_saturation = with_effects(start, (placed,))
    error_before = _gain_error(arm, start)[1]
    error_after = _gain_error(arm, with_saturation)[1]
    assert error_after > 3.0 * error_before


def test_friction_against_temperature_is_named_first_and_the_worst_gain_gets_better(
    small_arm: Arm,
) -> None:
    start = _with(small_arm, _case("temperature-friction"))
    rng = np.random.default_rng(1)
    steps = find_effects(start, rng)
    first = steps[0].accepted
    assert first is not None
    assert first.effect.name == "temperature-friction"
    assert first.axis == 1
    worst_before = _gain_error(small_arm, start).max()
    worst_after = _gain_error(small_arm, steps[-1].after).max()
    assert worst_after < worst_before


def test_drives_that_warm_up_without_an_effect_give_none(small_arm: Arm) -> None:
    rng = np.random.default_rng(1)
    (step,) = find_effects(small_arm.clean, rng)
    assert step.accepted is None
    candidates = {finding.effect.name for finding in step.findings}
    assert "temperature-friction" in candidates
