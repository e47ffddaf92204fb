"""Moves from limits alone: within the limits, better than random ones,
and good for the σ that they predict.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ident
from ident.arrays import FloatArray
from ident.planning.effort import EFFORT_MARGIN, effort_shares
from ident.planning.limits import followers_beyond
from ident.planning.moves import DWELL_S, FEWEST_MOVES, MAX_TRIES, _random_moves, _search_of
from tests.ident.mechanisms import FIVE_BAR

EXAMPLE_FILE = Path(__file__).parents[3] / "examples" / "gains_from_arrays.py"
EXAMPLE = SimpleNamespace(**runpy.run_path(str(EXAMPLE_FILE)))
LOWER_RAD = [-2.9, -2.0, -2.2]
UPPER_RAD = [2.9, 2.0, 2.2]
VELOCITY_RAD_S = [3.0, 2.5, 3.0]
ACCELERATION_RAD_S2 = [12.0, 10.0, 12.0]
LIMITS = ident.JointLimits(LOWER_RAD, UPPER_RAD, VELOCITY_RAD_S, ACCELERATION_RAD_S2)
RATE_HZ = 500.0
lax: Any = ident  #: As a notebook sees it


@pytest.fixture(scope="module")
def model() -> ident.Model:
    robot = ident.robot_from_urdf(EXAMPLE.URDF)
    gear_matrix = np.diag(EXAMPLE.GEAR_RATIOS)
    return ident.Model(robot, ident.DriveTrain(gear_matrix))


@pytest.fixture(scope="module")
def plan(model: ident.Model) -> ident.PlannedMoves:
    return ident.plan_moves(model, LIMITS, EXAMPLE.DISC, EXAMPLE.NAMEPLATE_NM_A, exchanges=400)


@pytest.mark.slow
def test_moves_keep_the_limits_and_begin_and_end_at_rest(plan: ident.PlannedMoves) -> None:
    time_s, motion = plan.motion(RATE_HZ)
    assert plan.duration_s <= 40.0
    assert time_s[-1] == pytest.approx(plan.duration_s, abs=2.0 / RATE_HZ)
    lower, upper = LIMITS.targets()
    assert np.all(motion.position_rad >= lower - 1e-9)
    assert np.all(motion.position_rad <= upper + 1e-9)
    velocity_shares, acceleration_shares = _limit_shares(motion)
    assert np.all(velocity_shares <= 1.0 + 1e-9)
    assert np.all(acceleration_shares <= 1.0 + 1e-9)
    # The fastest moves use a limit.
    assert max(velocity_shares.max(), acceleration_shares.max()) > 0.9
    end_s = np.cumsum(plan.move_s + plan.dwell_s)
    rest_s = end_s - 0.5 * plan.dwell_s
    at_rest = np.searchsorted(time_s, rest_s)
    assert np.all(motion.velocity_rad_s[at_rest] == 0.0)
    assert np.allclose(motion.position_rad[at_rest], plan.target_rad[1:])


def _limit_shares(motion: Any) -> tuple[FloatArray, FloatArray]:
    """Largest velocity and acceleration of every joint, as shares of its limits, shape (n,)."""
    speed_rad_s = np.abs(motion.velocity_rad_s)
    acceleration_rad_s2 = np.abs(motion.acceleration_rad_s2)
    velocity_shares = speed_rad_s.max(axis=0) / LIMITS.velocity
    acceleration_shares = acceleration_rad_s2.max(axis=0) / LIMITS.acceleration
    return velocity_shares, acceleration_shares


def test_velocity_and_acceleration_are_derivatives_of_the_position(
    plan: ident.PlannedMoves,
) -> None:
    time_s, motion = plan.motion(5000.0)
    inner = slice(2, -2)
    velocity = np.gradient(motion.position_rad, time_s, axis=0)
    velocity_difference = np.abs(velocity - motion.velocity_rad_s)
    assert velocity_difference[inner].max() < 1e-3
    acceleration = np.gradient(motion.velocity_rad_s, time_s, axis=0)
    acceleration_difference = np.abs(acceleration - motion.acceleration_rad_s2)
    assert acceleration_difference[inner].max() < 0.05


def _recorded(
    model: ident.Model, plan: ident.PlannedMoves, payload: ident.Payload | None, seed: int
) -> ident.Run:
    """The run that a robot makes of a plan, with the example's truth and a noise of 0.3 A."""
    rng = np.random.default_rng(seed)
    time_s, motion = plan.motion(RATE_HZ)
    parameters = _parameters(model, payload)
    torque_nm = np.einsum("jck,c->kj", model.regressor(motion), parameters)
    noise_a = 0.3 * rng.standard_normal(torque_nm.shape)
    current_a = torque_nm / EXAMPLE.TRUE_GAINS_NM_A + noise_a
    return ident.Run(_run_name(payload), time_s, motion.position_rad, current_a, payload)


def _run_name(payload: ident.Payload | None) -> str:
    return "bare" if payload is None else "loaded"


def _parameters(model: ident.Model, payload: ident.Payload | None) -> FloatArray:
    """Standard parameters of an arm with links of 10, 5 and 3 kg."""
    truth: list[float] = []
    rotor_and_friction = [0.03, 5.0, 6.0, 0.1]
    for mass in (10.0, 5.0, 3.0):
        inertia = [0.02 * mass, 0.0, 0.0, 0.02 * mass, 0.0, 0.01 * mass]
        first_moment = [0.05 * mass, 0.0, 0.12 * mass]
        truth += [*inertia, *first_moment, mass, *rotor_and_friction]
    parameters = np.array(truth)
    if payload is not None:
        parameters[model.flange] += [0.08, 0.0, 0.02, 0.08, 0.03, 0.05, -0.24, -0.25, 0.39, 4.59]
    return parameters


@pytest.mark.slow
def test_a_fit_of_planned_moves_has_smaller_deviations_than_of_random_ones(
    model: ident.Model, plan: ident.PlannedMoves
) -> None:
    random = ident.plan_moves(model, LIMITS, EXAMPLE.DISC, EXAMPLE.NAMEPLATE_NM_A, exchanges=0)
    random_std_percent = random.predicted_std_percent.max()
    assert plan.predicted_std_percent.max() < 0.8 * random_std_percent
    worst: list[float] = []
    for moves in (plan, random):
        bare = _recorded(model, moves, None, seed=1)
        loaded = _recorded(model, moves, EXAMPLE.DISC, seed=2)
        found = ident.identify(model, [bare, loaded]).estimate
        gain_error = np.abs(found.gains - EXAMPLE.TRUE_GAINS_NM_A)
        assert np.all(gain_error < 4.0 * found.gains_std)
        relative_std = found.gains_std / np.abs(found.gains)
        worst.append(float(np.max(relative_std)))
    worst_of_plan, worst_of_random = worst
    assert worst_of_plan < worst_of_random


def _belted(payload: ident.Payload | None) -> tuple[ident.Model, FloatArray]:
    """The example's arm, whose forearm a belt turns with the second joint, and its parameters."""
    mimic = '<mimic joint="J2" multiplier="-0.8" offset="0.3"/></joint>'
    head, joint, tail = EXAMPLE.URDF.partition('<joint name="J3"')
    changed_tail = tail.replace("</joint>", mimic, 1)
    urdf = head + joint + changed_tail
    robot = ident.robot_from_urdf(urdf)
    drive_train = ident.DriveTrain(np.diag([100.0, 120.0]))
    model = ident.Model(robot, drive_train)
    parameters = _parameters(model, payload)
    # The third joint has neither a rotor nor friction: the last four of its fourteen.
    third_joint = 14 * 2
    parameters[third_joint + 10 : third_joint + 14] = 0.0
    return model, parameters


@pytest.mark.slow
def test_a_robot_with_a_joint_that_follows_an_axis_is_planned_for_with_what_it_carries() -> None:
    """The plan is good for a fit of that robot, and better than random moves."""
    model, _ = _belted(None)
    limits = ident.JointLimits([-2.9, -2.0], [2.9, 2.0], [3.0, 2.5], [12.0, 10.0])
    gains = EXAMPLE.TRUE_GAINS_NM_A[:2]
    nameplate = EXAMPLE.NAMEPLATE_NM_A[:2]
    random = ident.plan_moves(model, limits, EXAMPLE.DISC, nameplate, exchanges=0)
    plan = ident.plan_moves(model, limits, EXAMPLE.DISC, nameplate, exchanges=200)
    assert plan.target_rad.shape[1] == 2
    absolute_target_rad = np.abs(plan.target_rad)
    assert np.all(absolute_target_rad <= limits.upper)
    random_std_percent = random.predicted_std_percent.max()
    assert plan.predicted_std_percent.max() < 0.9 * random_std_percent
    runs: list[ident.Run] = []
    for payload, seed in ((None, 1), (EXAMPLE.DISC, 2)):
        time_s, motion = plan.motion(RATE_HZ)
        _, parameters = _belted(payload)
        torque_nm = np.einsum("jck,c->kj", model.regressor(motion), parameters)
        rng = np.random.default_rng(seed)
        noise_a = 0.05 * rng.standard_normal(torque_nm.shape)
        current_a = torque_nm / gains + noise_a
        name = _run_name(payload)
        run = ident.Run(name, time_s, motion.position_rad, current_a, payload)
        runs.append(run)
    found = ident.identify(model, runs).estimate
    gain_error = np.abs(found.gains - gains)
    assert np.all(gain_error < 4.0 * found.gains_std)
    absolute_gain = np.abs(found.gains)
    found_percent = 100.0 * found.gains_std / absolute_gain
    assert np.all(found_percent < plan.predicted_std_percent)


def test_limits_at_which_a_follower_goes_beyond_its_own_are_refused() -> None:
    model, _ = _belted(None)
    robot = model.robot
    follower = replace(robot.joints[2], lowest=-0.5, travel=1.0)
    narrow = replace(model, robot=replace(robot, joints=(*robot.joints[:2], follower)))
    limits = ident.JointLimits([-2.9, -2.0], [2.9, 2.0], [3.0, 2.5], [12.0, 10.0])
    nameplate = EXAMPLE.NAMEPLATE_NM_A[:2]
    # −0.8 q + 0.3: −1.3 to 1.9 rad for q within ±2, and ±0.5 rad for q from −0.25 to 1 rad
    words = (
        r"limits: joint J3, which follows J2, goes from -1.3 to 1.9 rad; expected -0.5 to 0.5 rad, "
        r"its limits in the URDF; give J2 limits within -0.25 to 1$"
    )
    with pytest.raises(ident.ModelError, match=words):
        ident.plan_moves(narrow, limits, EXAMPLE.DISC, nameplate, exchanges=0)
    inside = ident.JointLimits([-2.9, -0.25], [2.9, 1.0], [3.0, 2.5], [12.0, 10.0])
    plan = ident.plan_moves(narrow, inside, EXAMPLE.DISC, nameplate, exchanges=0)
    assert plan.target_rad[:, 1].min() >= -0.25


@pytest.mark.slow
def test_the_same_seed_gives_the_same_moves(model: ident.Model, plan: ident.PlannedMoves) -> None:
    nameplate = list(EXAMPLE.NAMEPLATE_NM_A)
    again = ident.plan_moves(model, LIMITS, EXAMPLE.DISC, nameplate, exchanges=400)
    assert np.array_equal(again.target_rad, plan.target_rad)
    other = ident.plan_moves(model, LIMITS, EXAMPLE.DISC, nameplate, seed=1, exchanges=0)
    assert not np.array_equal(other.target_rad[0], plan.target_rad[0])


def test_torques_keep_the_efforts_of_the_urdf(model: ident.Model, plan: ident.PlannedMoves) -> None:
    """With weak motors the planner makes other moves: those of strong ones ask for more torque."""
    weak = EXAMPLE.URDF.replace('effort="99"', 'effort="60"')
    nameplate = EXAMPLE.NAMEPLATE_NM_A
    moves = ident.plan_moves(model, LIMITS, EXAMPLE.DISC, nameplate, urdf=weak, exchanges=20)
    gains = np.array(nameplate)
    search = _search_of(model, LIMITS, EXAMPLE.DISC, gains, weak, ident.Conditioning())
    assert np.isfinite(search.effort).all()

    def largest(planned: ident.PlannedMoves) -> float:
        _, motion = planned.motion(RATE_HZ)
        expectation = search.design.expectation
        shares = effort_shares(expectation, search.effort, motion, (None, 0))
        return float(shares.max())

    assert largest(moves) <= 1.02 / EFFORT_MARGIN  # looked at 50 times a second
    assert largest(plan) > 1.0 / EFFORT_MARGIN


@pytest.mark.parametrize(
    ("changes", "rate_hz", "words"),
    [
        pytest.param(
            {},
            0.0,
            "rate_hz is 0; expected a finite number above 0; give the rate of the controller",
            id="no rate",
        ),
        pytest.param({}, -500.0, "rate_hz is -500", id="negative rate"),
        pytest.param({}, "500", "rate_hz is '500' of type str", id="rate of a text"),
        pytest.param(
            {}, 1e12, r"samples at 1e\+12 Hz; expected at most 1e\+07", id="too many samples"
        ),
        pytest.param(
            {"move_s": np.array([1.0, 0.0])},
            500.0,
            "move_s has 0 s; expected durations above 0 s",
            id="a move of 0 s",
        ),
        pytest.param(
            {"move_s": np.array([-5.0, 1.0])}, 500.0, "move_s has -5 s", id="a move of -5 s"
        ),
        pytest.param(
            {"move_s": np.array([1.0, np.nan])},
            500.0,
            "move_s holds 1 non-finite values",
            id="no duration",
        ),
        pytest.param(
            {"move_s": np.ones(3)},
            500.0,
            r"target_rad of shape \(3, 1\) and move_s of shape \(3,\)",
            id="a move too many",
        ),
        pytest.param({"dwell_s": np.inf}, 500.0, "dwell_s is inf", id="a dwell of inf"),
    ],
)
def test_moves_that_take_no_time_are_no_motion(
    changes: dict[str, Any], rate_hz: Any, words: str
) -> None:
    target_rad = np.array([[0.0], [1.0], [0.0]])
    move_s = np.array([1.0, 2.0])
    moves = ident.PlannedMoves(target_rad, move_s, 0.1, np.ones(1))
    changed = replace(moves, **changes)
    with pytest.raises(ident.ModelError, match=words):
        changed.motion(rate_hz)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        pytest.param({"limits": {}}, "limits is of type dict; expected JointLimits", id="dict"),
        pytest.param({"payload": 4.59}, "payload is of type float; expected Payload", id="mass"),
        pytest.param(
            {"nameplate": [1, 1]}, r"nameplate has shape \(2,\); expected \(3,\)", id="gains"
        ),
        pytest.param({"nameplate": [1, 0, 1]}, r"nameplate is \[1.0, 0.0, 1.0\]", id="zero"),
        pytest.param(
            {"limits": ident.JointLimits([-1, -1], [1, 1], [1, 1], [1, 1])},
            r"limits.lower has shape \(2,\); expected \(3,\), one per joint",
            id="two limits",
        ),
        pytest.param(
            {"limits": replace(LIMITS, lower=LIMITS.upper, upper=LIMITS.lower)},
            "limits: found positions from .* expected each `lower` below its `upper`",
            id="exchanged limits",
        ),
        pytest.param(
            {"limits": replace(LIMITS, velocity=np.array([1, 0, 1]))},
            r"limits.velocity: found \[1.0, 0.0, 1.0\]; expected numbers above zero",
            id="no velocity",
        ),
        pytest.param(
            {"limits": replace(LIMITS, velocity=np.full(3, 1e-9))},
            "found room for 0 moves in 40 s",
            id="slow",  # moves of days would have gigabytes of rows
        ),
        pytest.param(
            {"duration_s": 5.0},
            r"found room for \d moves in 5 s; expected at least 10, and better 30; give a longer "
            r"`duration_s`",
            id="short",
        ),
        pytest.param(
            {"duration_s": np.nan},
            "duration_s is .*nan; expected a finite number above 0; give the time of one run, "
            "such as 40",
            id="duration nan",
        ),
        pytest.param(
            {"duration_s": np.inf},
            "duration_s is .*inf; expected a finite number above 0",
            id="duration inf",
        ),
        pytest.param(
            {"duration_s": -5.0},
            "duration_s is .*-5; expected a finite number above 0",
            id="duration -5.0",
        ),
        pytest.param(
            {"duration_s": 1e9},
            r"duration_s is .*1e\+09 s; expected at most 3600 s for one run",
            id="duration 1e9",
        ),
        pytest.param(
            {"duration_s": "40"},
            "duration_s is .*'40' of type str; expected a finite number",
            id="duration 40 as a text",
        ),
        pytest.param({"seed": -1}, "seed is -1; expected a whole number, zero or above", id="seed"),
        pytest.param(
            {"exchanges": 1.5}, "exchanges is 1.5; expected a whole number", id="exchanges"
        ),
        pytest.param(
            {"urdf": b"robot"}, "urdf is of type bytes; expected str; give the text", id="a file"
        ),
        pytest.param(
            {"payload": ident.Payload("disc", "flange", {}), "exchanges": 0},
            r"found gains that \d+ moves do not show: J1, J2, J3; .* a payload with a mass",
            id="no mass",
        ),
        pytest.param(
            {"model": FIVE_BAR.model, "nameplate": [1, 1]},
            r"closed chain \(closures .*\): which positions its loops reach is not known here; "
            "expected a serial robot",
            id="a closed chain",
        ),
    ],
)
def test_what_no_plan_can_be_made_of_is_refused(
    model: ident.Model, changes: dict[str, Any], words: str
) -> None:
    possible = {
        "model": model,
        "limits": LIMITS,
        "payload": EXAMPLE.DISC,
        "nameplate": [1, 1, 1],
    }
    arguments = possible | changes
    with pytest.raises(ident.IdentificationError, match=words):
        lax.plan_moves(**arguments)


def test_limits_of_words_are_refused() -> None:
    with pytest.raises(ident.IdentificationError, match=r"limits.lower is no array of numbers"):
        lax.JointLimits("abc", [1], [1], [1])


class _Search:
    """What random moves ask: targets one after another, 2 s a move at full speed, and of every
    second move more torque than there is.
    """

    def __init__(self, refused: Callable[[int], bool]) -> None:
        self.asked = 0
        self.refused = refused
        self.durations_s: list[float] = []

    def random_target(
        self, rng: np.random.Generator, start_rad: FloatArray | None = None
    ) -> FloatArray:
        return rng.uniform(-1.0, 1.0, 2)

    def fastest_s(self, start_rad: FloatArray, end_rad: FloatArray) -> float:
        return 2.0

    def information(
        self, start_rad: FloatArray, end_rad: FloatArray, move_s: float
    ) -> FloatArray | None:
        self.asked += 1
        if self.refused(self.asked):
            return None
        self.durations_s.append(move_s)
        return np.eye(2)


def _filled(search: _Search, duration_s: float) -> Any:
    draw: Any = _random_moves
    rng = np.random.default_rng(5)
    return draw(search, rng, duration_s)


def test_moves_that_no_drive_can_make_are_drawn_again() -> None:
    duration_s = 200.0
    search = _Search(lambda asked: asked % 2 == 0)
    draft = _filled(search, duration_s)
    moves = len(draft.move_s)
    used_s = sum(draft.move_s) + DWELL_S * moves
    # The longest move takes 2 s / 0.3.
    longest_s = 2.0 / 0.3 + DWELL_S
    assert duration_s - longest_s < used_s <= duration_s
    assert list(draft.move_s) == search.durations_s[:moves]
    assert len(draft.target_rad) == moves + 1
    assert len(draft.information) == moves


@pytest.mark.parametrize(("in_turn", "is_enough"), [(MAX_TRIES - 1, True), (MAX_TRIES, False)])
def test_moves_are_drawn_so_often_from_one_place_and_no_more(in_turn: int, is_enough: bool) -> None:
    # After the third move, so many in turn are refused.
    search = _Search(lambda asked: 3 < asked <= 3 + in_turn)
    if is_enough:
        draft = _filled(search, 200.0)
        assert len(draft.move_s) >= FEWEST_MOVES
        return
    with pytest.raises(ident.PlanUnfit, match="found room for 3 moves in 200 s"):
        _filled(search, 200.0)


def test_a_move_takes_as_long_as_least_jerk_within_the_slowest_limit(model: ident.Model) -> None:
    gains = np.array(EXAMPLE.NAMEPLATE_NM_A)
    search = _search_of(model, LIMITS, EXAMPLE.DISC, gains, None, ident.Conditioning())
    start = np.array([-1.0, 0.5, 0.0])
    for way in ([2.0, 0.1, 0.1], [0.0, 0.05, 0.0], [0.1, -0.3, 2.2]):
        end = start + np.array(way)
        move_s = search.fastest_s(start, end)
        target_rad = np.array([start, end])
        planned = ident.PlannedMoves(target_rad, np.array([move_s]), 0.1, np.ones(3))
        _, motion = planned.motion(20_000.0)
        velocity_shares, acceleration_shares = _limit_shares(motion)
        largest_share = max(velocity_shares.max(), acceleration_shares.max())
        assert largest_share == pytest.approx(1.0, rel=1e-5)


def test_a_follower_of_a_joint_without_a_motor_is_not_judged_by_an_axis() -> None:
    model, _ = _belted(None)
    robot = model.robot
    follower = replace(robot.joints[2], lowest=-0.5, travel=1.0)
    by_a_loop = replace(robot, joints=(*robot.joints[:2], follower), motors=(0,))
    reach = np.array([2.0])
    assert followers_beyond(by_a_loop, -reach, reach) == ()
    driven = replace(by_a_loop, motors=(0, 1))
    both = np.array([2.0, 2.0])
    (beyond,) = followers_beyond(driven, -both, both)
    assert beyond.allowed == (-0.5, 0.5)
