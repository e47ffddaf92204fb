"""Moves from limits alone: within the limits, better than random ones, and good for the σ that they predict."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ident
from ident.arrays import FloatArray
from ident.planning.effort import EFFORT_MARGIN, effort_shares
from ident.planning.moves import _search_of

EXAMPLE = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[3] / "examples" / "gains_from_arrays.py")))
LIMITS = ident.JointLimits([-2.9, -2.0, -2.2], [2.9, 2.0, 2.2], [3.0, 2.5, 3.0], [12.0, 10.0, 12.0])
RATE_HZ = 500.0
lax: Any = ident  #: As a notebook sees it


@pytest.fixture(scope="module")
def model() -> ident.Model:
    return ident.Model(ident.robot_from_urdf(EXAMPLE.URDF), ident.DriveTrain(np.diag(EXAMPLE.GEAR_RATIOS)))


@pytest.fixture(scope="module")
def plan(model: ident.Model) -> ident.PlannedMoves:
    return ident.plan_moves(model, LIMITS, EXAMPLE.DISC, EXAMPLE.NAMEPLATE_NM_A, exchanges=400)


def test_moves_keep_the_limits_and_begin_and_end_at_rest(plan: ident.PlannedMoves) -> None:
    time_s, motion = plan.motion(RATE_HZ)
    assert plan.duration_s <= 40.0
    assert time_s[-1] == pytest.approx(plan.duration_s, abs=2.0 / RATE_HZ)
    lower, upper = LIMITS.targets()
    assert np.all(motion.position_rad >= lower - 1e-9)
    assert np.all(motion.position_rad <= upper + 1e-9)
    speed = np.abs(motion.velocity_rad_s).max(axis=0) / LIMITS.velocity
    acceleration = np.abs(motion.acceleration_rad_s2).max(axis=0) / LIMITS.acceleration
    assert np.all(np.maximum(speed, acceleration) <= 1.0 + 1e-9)
    assert max(speed.max(), acceleration.max()) > 0.9  # the fastest moves use a limit
    ends = np.cumsum(plan.move_s + plan.dwell_s)
    at_rest = np.searchsorted(time_s, ends - 0.5 * plan.dwell_s)
    assert np.all(motion.velocity_rad_s[at_rest] == 0.0)
    assert np.allclose(motion.position_rad[at_rest], plan.target_rad[1:])


def test_velocity_and_acceleration_are_derivatives_of_the_position(plan: ident.PlannedMoves) -> None:
    time_s, motion = plan.motion(5000.0)
    inner = slice(2, -2)
    velocity = np.gradient(motion.position_rad, time_s, axis=0)
    assert np.abs(velocity - motion.velocity_rad_s)[inner].max() < 1e-3
    acceleration = np.gradient(motion.velocity_rad_s, time_s, axis=0)
    assert np.abs(acceleration - motion.acceleration_rad_s2)[inner].max() < 0.05


def _recorded(model: ident.Model, plan: ident.PlannedMoves, payload: ident.Payload | None, seed: int) -> ident.Run:
    """The run that a robot makes of a plan, with the example's truth and a noise of 0.3 A."""
    rng = np.random.default_rng(seed)
    time_s, motion = plan.motion(RATE_HZ)
    parameters = _parameters(model, payload)
    torque_nm = np.einsum("jck,c->kj", model.regressor(motion), parameters)
    current_a = torque_nm / EXAMPLE.TRUE_GAINS_NM_A + 0.3 * rng.standard_normal(torque_nm.shape)
    return ident.Run("loaded" if payload else "bare", time_s, motion.position_rad, current_a, payload)


def _parameters(model: ident.Model, payload: ident.Payload | None) -> FloatArray:
    """Standard parameters of an arm with links of 10, 5 and 3 kg."""
    truth: list[float] = []
    for mass in (10.0, 5.0, 3.0):
        link = [0.02 * mass, 0.0, 0.0, 0.02 * mass, 0.0, 0.01 * mass, 0.05 * mass, 0.0, 0.12 * mass, mass]
        truth += [*link, 0.03, 5.0, 6.0, 0.1]
    parameters = np.array(truth)
    if payload is not None:
        parameters[model.flange] += [0.08, 0.0, 0.02, 0.08, 0.03, 0.05, -0.24, -0.25, 0.39, 4.59]
    return parameters


def test_a_fit_of_planned_moves_has_smaller_deviations_than_of_random_ones(
    model: ident.Model, plan: ident.PlannedMoves
) -> None:
    random = ident.plan_moves(model, LIMITS, EXAMPLE.DISC, EXAMPLE.NAMEPLATE_NM_A, exchanges=0)
    assert plan.predicted_std_percent.max() < 0.8 * random.predicted_std_percent.max()
    worst: list[float] = []
    for moves in (plan, random):
        runs = [_recorded(model, moves, load, seed) for load, seed in ((None, 1), (EXAMPLE.DISC, 2))]
        found = ident.identify(model, runs)
        assert np.all(np.abs(found.estimate.gains - EXAMPLE.TRUE_GAINS_NM_A) < 4.0 * found.estimate.gains_std)
        worst.append(float(np.max(found.estimate.gains_std / np.abs(found.estimate.gains))))
    assert worst[0] < worst[1]


def test_the_same_seed_gives_the_same_moves(model: ident.Model, plan: ident.PlannedMoves) -> None:
    again = ident.plan_moves(model, LIMITS, EXAMPLE.DISC, list(EXAMPLE.NAMEPLATE_NM_A), exchanges=400)
    assert np.array_equal(again.target_rad, plan.target_rad)
    other = ident.plan_moves(model, LIMITS, EXAMPLE.DISC, EXAMPLE.NAMEPLATE_NM_A, seed=1, exchanges=0)
    assert not np.array_equal(other.target_rad[0], plan.target_rad[0])


def test_torques_keep_the_efforts_of_the_urdf(model: ident.Model, plan: ident.PlannedMoves) -> None:
    """With weak motors the planner makes other moves: those of strong ones ask for more torque."""
    weak = EXAMPLE.URDF.replace('effort="99"', 'effort="60"')
    moves = ident.plan_moves(model, LIMITS, EXAMPLE.DISC, EXAMPLE.NAMEPLATE_NM_A, urdf=weak, exchanges=20)
    gains = np.array(EXAMPLE.NAMEPLATE_NM_A)
    search = _search_of(model, LIMITS, EXAMPLE.DISC, gains, weak, ident.Conditioning(), 40.0)
    assert np.isfinite(search.effort).all()

    def largest(planned: ident.PlannedMoves) -> float:
        _, motion = planned.motion(RATE_HZ)
        return float(effort_shares(search.design.expectation, search.effort, motion, (None, 0)).max())

    assert largest(moves) <= 1.02 / EFFORT_MARGIN  # looked at 50 times a second
    assert largest(plan) > 1.0 / EFFORT_MARGIN


Call = Callable[[ident.Model], Any]
WRONG: list[tuple[str, Call, str]] = [
    ("dict", lambda m: lax.plan_moves(m, {}, EXAMPLE.DISC, [1, 1, 1]), "limits is of type dict; expected JointLimits"),
    ("mass", lambda m: lax.plan_moves(m, LIMITS, 4.59, [1, 1, 1]), "payload is of type float; expected Payload"),
    (
        "gains",
        lambda m: lax.plan_moves(m, LIMITS, EXAMPLE.DISC, [1, 1]),
        r"nameplate has shape \(2,\); expected \(3,\)",
    ),
    ("zero", lambda m: lax.plan_moves(m, LIMITS, EXAMPLE.DISC, [1, 0, 1]), r"nameplate is \[1.0, 0.0, 1.0\]"),
    (
        "two limits",
        lambda m: lax.plan_moves(m, lax.JointLimits([-1, -1], [1, 1], [1, 1], [1, 1]), EXAMPLE.DISC, [1, 1, 1]),
        r"limits.lower has shape \(2,\); expected \(3,\), one per joint",
    ),
    (
        "exchanged limits",
        lambda m: lax.plan_moves(
            m,
            lax.JointLimits(LIMITS.upper, LIMITS.lower, LIMITS.velocity, LIMITS.acceleration),
            EXAMPLE.DISC,
            [1, 1, 1],
        ),
        "limits: found positions from .* expected each `lower` below its `upper`",
    ),
    (
        "no velocity",
        lambda m: lax.plan_moves(
            m, lax.JointLimits(LIMITS.lower, LIMITS.upper, [1, 0, 1], LIMITS.acceleration), EXAMPLE.DISC, [1, 1, 1]
        ),
        r"limits.velocity: found \[1.0, 0.0, 1.0\]; expected numbers above zero",
    ),
    (
        "short",
        lambda m: lax.plan_moves(m, LIMITS, EXAMPLE.DISC, [1, 1, 1], duration_s=5.0),
        r"found room for \d moves in 5 s; expected at least 10, and better 30; give a longer `duration_s`",
    ),
    (
        "endless",
        lambda m: lax.plan_moves(m, LIMITS, EXAMPLE.DISC, [1, 1, 1], duration_s=float("inf")),
        "duration_s is inf; expected a number from 0 to 3600; give the duration of one run in seconds",
    ),
    (
        "no number",
        lambda m: lax.plan_moves(m, LIMITS, EXAMPLE.DISC, [1, 1, 1], duration_s=float("nan")),
        "duration_s is nan; expected a number",
    ),
    (
        "text",
        lambda m: lax.plan_moves(m, LIMITS, EXAMPLE.DISC, [1, 1, 1], exchanges="many"),
        "exchanges is 'many'; expected a number from 0",
    ),
    (
        "slow as a glacier",
        lambda m: lax.plan_moves(
            m, lax.JointLimits(LIMITS.lower, LIMITS.upper, [1e-9] * 3, LIMITS.acceleration), EXAMPLE.DISC, [1, 1, 1]
        ),
        "found room for 0 moves in 40 s",
    ),
    (
        "limits of words",
        lambda m: lax.JointLimits(["low"], ["high"], [1], [1]),
        "limits.lower is no array of numbers",
    ),
    (
        "no mass",
        lambda m: lax.plan_moves(m, LIMITS, lax.Payload("disc", "flange", {}), [1, 1, 1], exchanges=0),
        r"found gains that \d+ moves do not show: J1, J2, J3; .* a payload with a mass",
    ),
]


@pytest.mark.parametrize(("call", "words"), [case[1:] for case in WRONG], ids=[case[0] for case in WRONG])
def test_what_no_plan_can_be_made_of_is_refused(model: ident.Model, call: Call, words: str) -> None:
    with pytest.raises(ident.IdentificationError, match=words):
        call(model)


@pytest.mark.parametrize("rate_hz", [0.0, -5.0, float("nan"), 1e9])
def test_set_points_at_no_rate_are_refused(plan: ident.PlannedMoves, rate_hz: float) -> None:
    with pytest.raises(ident.IdentificationError, match=r"rate_hz is .*; expected a number from 1 to 100000"):
        plan.motion(rate_hz)
