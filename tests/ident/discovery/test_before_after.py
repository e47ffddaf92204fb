"""Before and after: one metric for every error, and changes of gains that are distinguished from
noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.run import Run
from ident.discovery import before_after as before_after_module
from ident.discovery.before_after import (
    Account,
    CurrentError,
    account,
    assess,
    before_after,
    error_left_out,
    error_on,
    floor_on,
    holdout_change,
    left_on,
    left_out_runs,
)
from ident.discovery.evidence import Evidence, gather, with_effects, without_effects
from ident.discovery.loop import Step
from ident.discovery.noise_floor import FloorSource, MotorNoiseFloor
from ident.effects.effect import PlacedEffect
from ident.effects.electrical import Saturation
from ident.effects.position import Spring
from ident.equations.linearisation import cut_into_folds, linearise
from ident.estimators.identify import identify
from tests.ident.recordings import CONDITIONING, GAINS, Truth, gathered

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]

SPRING = PlacedEffect(Spring(), 2)
SPRING_NM_RAD = 4.0


@pytest.fixture(scope="module")
def sprung(noisy_runs: tuple[Run, ...]) -> tuple[Run, ...]:
    """The noisy runs with a spring on joint 3."""
    made = []
    for run in noisy_runs:
        current = run.current_a.copy()
        current[:, 2] += SPRING_NM_RAD * run.position_rad[:, 2] / GAINS[2]
        made.append(replace(run, current_a=current))
    return tuple(made)


@pytest.fixture(scope="module")
def start(truth: Truth, sprung: tuple[Run, ...]) -> Evidence:
    return gathered(truth, sprung[:3], sprung[3:])


@pytest.fixture(scope="module")
def after(start: Evidence) -> Evidence:
    return with_effects(start, (SPRING,))


@pytest.fixture(scope="module")
def compared(start: Evidence, after: Evidence) -> Account:
    limits = np.zeros(6)
    step = Step((), (), limits, None, after)
    steps = (step, Step((), (), limits, None, after))
    return account(start, steps)


def test_errors_are_those_of_the_residual_of_each_motor(start: Evidence, compared: Account) -> None:
    """From the definition: e_i = v_i − (T τ)_i/g_i over the motor's rows, motor by motor,
    and weighed by the gains.
    """
    estimate = start.estimate
    in_sample = compared.total.before.in_sample
    for rows, error in (
        (start.training, in_sample),
        (start.holdout, compared.total.before.holdout),
    ):
        assert rows is not None
        assert error is not None
        torque = np.linalg.solve(rows.drive_train.direction.T, estimate.predicted_torque(rows))
        left = []
        size = []
        for motor in range(6):
            used = rows.motor_use[motor]
            v = rows.current[motor, used]
            left.append(np.linalg.norm(v - torque[motor, used] / estimate.gains[motor]))
            size.append(np.linalg.norm(v))
        assert error.axes == pytest.approx(100.0 * np.array(left) / size)
        weighed = np.linalg.norm(estimate.gains * left) / np.linalg.norm(estimate.gains * size)
        assert error.total == pytest.approx(100.0 * weighed)


def test_an_uncoupled_axis_has_the_error_of_table_6(start: Evidence, compared: Account) -> None:
    """Motors 1 to 4 drive their joints alone: ‖e‖/‖v‖ is ‖ρ‖/‖Y‖ there."""
    in_sample = compared.total.before.in_sample
    assert in_sample.axes[:4] == pytest.approx(
        start.identification.training_error.axes[:4], rel=1e-6
    )


def test_parts_of_the_data_add_up(start: Evidence) -> None:
    rows = start.training
    weights = start.estimate.gains
    whole = error_on(rows, start.estimate)
    parts = CurrentError(np.zeros(6), np.zeros(6))
    for run in range(3):
        observation = rows.only(rows.run == run)
        parts = parts + error_on(observation, start.estimate)
    assert parts.relative(weights).total == pytest.approx(whole.relative(weights).total)
    assert parts.relative(weights).axes == pytest.approx(whole.relative(weights).axes)


def test_left_out_moves_are_predicted_worse_than_seen_ones(start: Evidence) -> None:
    estimate = start.estimate
    problem = linearise(
        start.training, estimate.gains, estimate.parameters, estimate.axis_noise, gains_fixed=False
    )
    folds = cut_into_folds(problem)
    seen = replace(folds, residual=folds.linearisation.residual)
    assert error_left_out(seen).left == pytest.approx(error_on(start.training, estimate).left)
    assert np.all(error_left_out(folds).left > error_left_out(seen).left)


def test_the_effect_helps_its_axis_alone_wherever_it_is_measured(compared: Account) -> None:
    before = compared.total.before
    after = compared.total.after
    pairs = (
        (before.in_sample, after.in_sample),
        (before.cross_validated, after.cross_validated),
        (before.holdout, after.holdout),
    )
    for first, second in pairs:
        assert first is not None
        assert second is not None
        assert second.axes[2] < 0.8 * first.axes[2]
        assert second.axes[0] == pytest.approx(first.axes[0], rel=0.02)
        assert second.total < first.total
    assert compared.total.added == (SPRING,)
    assert compared.total.removed == ()


def test_held_out_errors_are_compared_in_units_of_noise(start: Evidence, after: Evidence) -> None:
    change = holdout_change(start, after)
    assert change is not None
    assert start.holdout is not None
    assert after.holdout is not None
    variance = np.square(start.estimate.axis_noise)
    before = error_on(start.holdout, start.estimate).left / variance
    afterwards = error_on(after.holdout, after.estimate).left / variance
    assert change.before == pytest.approx(before)
    assert change.total.rise == pytest.approx(np.sum(afterwards - before))
    assert change.total.blocks <= len(np.unique(start.holdout.move))
    assert not change.is_harm
    without_the_spring = holdout_change(after, start)
    assert without_the_spring is not None
    assert without_the_spring.is_harm
    assert holdout_change(replace(start, holdout=None), after) is None


def test_a_turn_that_adds_nothing_has_no_before_and_after(compared: Account) -> None:
    first, last = compared.turns
    assert last is None
    assert first == compared.total


def test_what_is_taken_out_again_is_reported(start: Evidence, after: Evidence) -> None:
    weights = start.estimate.gains
    back = before_after(assess(after, weights), assess(start, weights))
    assert (back.added, back.removed) == ((), (SPRING,))


def test_the_declared_model_is_found_again_behind_its_effects(
    start: Evidence, after: Evidence
) -> None:
    again = without_effects(after, start.estimate)
    assert np.array_equal(again.training.regressor, start.training.regressor)
    assert again.holdout is not None
    assert start.holdout is not None
    assert np.array_equal(again.holdout.current, start.holdout.current)
    assert again.effects == ()


def test_gains_carry_their_own_sigma(start: Evidence, after: Evidence, compared: Account) -> None:
    for motor, gain in enumerate(compared.total.gains):
        expected = (start.estimate.gains[motor], start.estimate.gains_std[motor])
        assert (gain.before, gain.before_std) == expected
        assert (gain.after, gain.after_std) == (
            after.estimate.gains[motor],
            after.estimate.gains_std[motor],
        )
        after_difference = gain.after - gain.before
        assert gain.change_percent == pytest.approx(100.0 * after_difference / gain.before)


def test_the_jackknife_of_a_gain_is_that_of_its_estimate(start: Evidence) -> None:
    """The shifts behind σ_Δ are those behind σ."""
    moves = assess(start, start.estimate.gains).moves
    assert moves is not None
    shifts = moves.shifts(moves.blocks())[:, : len(start.estimate.gains)]
    blocks = len(shifts)
    shift_difference = shifts - shifts.mean(axis=0)
    std = np.sqrt((blocks - 1) / blocks * np.sum(shift_difference**2, axis=0))
    assert std == pytest.approx(start.estimate.gains_std, rel=0.02)


def test_an_effect_that_is_not_there_changes_no_gain_and_one_that_is_does(
    small: Evidence, small_truth: Truth, small_runs: tuple[Run, ...]
) -> None:
    saturation = PlacedEffect(Saturation(), 1)
    weights = small.estimate.gains
    evidence = with_effects(small, (saturation,))
    idle = before_after(assess(small, weights), assess(evidence, weights))
    assert not any(gain.significant for gain in idle.gains)
    # The change shares its noise with both estimates: it is known better than either where the
    # effect says little.
    change_std = idle.gains[0].change_std
    before_std = idle.gains[0].before_std
    assert change_std < 0.5 * before_std
    runs = []
    for run in small_runs:
        current = run.current_a.copy()
        current[:, 1] *= 1.0 + 0.004 * current[:, 1] ** 2
        runs.append(replace(run, current_a=current))
    bent = gathered(small_truth, tuple(runs))
    changed = before_after(
        assess(bent, weights), assess(with_effects(bent, (saturation,)), weights)
    )
    assert changed.gains[1].significant
    after_difference = abs(changed.gains[1].after - small_truth.gains[1])
    before = changed.gains[1].before
    before_difference = before - small_truth.gains[1]
    assert after_difference < abs(before_difference)


def test_a_left_out_run_is_predicted_by_the_others_alone(
    truth: Truth, sprung: tuple[Run, ...], after: Evidence
) -> None:
    weights = after.estimate.gains
    found = left_out_runs(after, weights)
    runs = [run.run for run in found.runs]
    assert runs == ["run0", "run1", "run2"]
    # By another way: run 0 given as a hold-out run.
    by_hand = with_effects(gathered(truth, sprung[1:3], sprung[:1]), (SPRING,))
    assert by_hand.holdout is not None
    expected = error_on(by_hand.holdout, by_hand.estimate).relative(weights)
    (first, loaded, _) = found.runs
    assert first.error is not None
    assert first.error.axes == pytest.approx(expected.axes, rel=1e-4)
    # Run 1 alone carries the payload: without it the gains have no scale.
    assert loaded.error is None
    assert "payload" in loaded.reason or "mounting" in loaded.reason
    assert found.together is not None


def test_the_noise_floor_is_relative_to_the_same_currents(start: Evidence) -> None:
    motor_noise_floor = MotorNoiseFloor(0.05, FloorSource.STANDSTILL, 20, 100.0)
    floors = (motor_noise_floor,) * 5 + (None,)
    error = floor_on(start.training, start.estimate, floors).relative(start.estimate.gains)
    used = start.training.motor_use[0]
    rms_a = np.sqrt(np.mean(start.training.current[0, used] ** 2))
    assert error.axes[0] == pytest.approx(100.0 * 0.05 / rms_a)
    assert np.isnan(error.axes[5])
    assert np.isnan(error.total)


def test_a_refuted_floor_bounds_no_error(
    start: Evidence, after: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    left_a = left_on(after.training, after.estimate)
    # Of what the model leaves; these floors are known to 9 %
    factors = np.array([0.9, 1.1, 2.0, 0.9, 1.1, 2.0])
    floors = tuple(
        MotorNoiseFloor(float(noise_a), FloorSource.STANDSTILL, 20, 100.0)
        for noise_a in factors * left_a
    )
    monkeypatch.setattr(before_after_module, "noise_floors", lambda *_: floors)
    limits_nm = np.zeros(6)
    steps = [Step((), (), limits_nm, None, after)]
    made = account(start, steps)
    assert made.floors == floors
    assert made.left_a == pytest.approx(left_a)
    expected = [False, False, True] * 2
    assert np.isnan(made.floor.axes).tolist() == expected
    axes = np.array(made.floor.axes)
    ratio = axes / made.total.after.in_sample.axes
    assert ratio[[0, 3]] == pytest.approx(factors[[0, 3]])
    assert made.holdout_floor is not None
    assert np.isnan(made.holdout_floor.axes).tolist() == [False, False, True] * 2


def test_no_floor_exceeds_the_error_on_the_same_rows(
    start: Evidence, after: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The floors are a tenth above what the model leaves, and known to 9 %:
    the model is at the floor.
    """
    left_a = left_on(after.training, after.estimate)
    floors = tuple(
        MotorNoiseFloor(1.1 * float(left), FloorSource.REPEATED_MOVES, 20, 100.0, is_bound=True)
        for left in left_a
    )
    monkeypatch.setattr(before_after_module, "noise_floors", lambda *_: floors)
    step = Step((), (), np.zeros(6), None, after)
    steps = [step]
    made = account(start, steps)
    before = made.total.before
    last = made.total.after
    pairs = (
        (made.floor, before.in_sample, last.in_sample),
        (made.holdout_floor, before.holdout, last.holdout),
    )
    for floor, *errors in pairs:
        for error in errors:
            assert floor is not None
            assert error is not None
            assert np.all(
                np.array((*floor.axes, floor.total))
                <= np.array((*error.axes, error.total)) * (1.0 + 1e-9)
            )
    assert made.floor.axes[2] == pytest.approx(last.in_sample.axes[2])
    assert made.floors == floors  # as measured
    # The lower limit of such a floor, a seventh below it, is below the error.
    least_a = [floor.least_a for floor in floors]
    expected = np.array(least_a) / left_a
    assert np.all(expected < 1.0)
    axes = np.array(made.least_floor.axes)
    ratio = axes / last.in_sample.axes
    assert ratio == pytest.approx(expected)
    # Standstill alone bounds nothing.
    at_rest = tuple(
        replace(floor, source=FloorSource.STANDSTILL, is_bound=False) for floor in floors
    )
    monkeypatch.setattr(before_after_module, "noise_floors", lambda *_: at_rest)
    limits_nm = np.zeros(6)
    unbound = account(start, [Step((), (), limits_nm, None, after)])
    assert np.isnan(unbound.least_floor.axes).all()
    assert unbound.floor == made.floor


def test_fixed_gains_do_not_change(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    runs = noisy_runs[:2]
    found = identify(truth.model, runs, CONDITIONING, fixed_gains=GAINS)
    start = gather(found, runs)
    evidence = with_effects(start, (SPRING,))
    changed = before_after(assess(start, GAINS), assess(evidence, GAINS))
    assert all(gain.change_std == 0.0 and not gain.significant for gain in changed.gains)


def test_a_change_and_its_estimates_leave_out_the_same_blocks(
    start: Evidence, after: Evidence
) -> None:
    """Where the moves of one model are correlated, the change is judged by its longer blocks."""
    weights = start.estimate.gains
    first = assess(start, weights)
    last = assess(after, weights)
    assert first.moves is not None
    assert last.moves is not None
    slow = (np.arange(len(first.moves.runs)) // 8 % 2)[:, None] * 2.0 - 1.0
    absolute_score = np.abs(first.moves.scores)
    scores = absolute_score * slow
    moves = replace(first.moves, scores=scores)
    correlated = replace(first, moves=moves)
    assert correlated.moves is not None
    starts = correlated.moves.blocks()
    assert len(starts) < len(last.moves.blocks())
    difference = last.moves.shifts(starts) - correlated.moves.shifts(starts)[:, :1]
    shifts = difference[:, 0]
    shift_difference = shifts - shifts.mean()
    expected = np.sqrt((len(starts) - 1) / len(starts) * np.sum(shift_difference**2))
    first_gain = before_after(correlated, last).gains[0]
    assert first_gain.change_std == pytest.approx(expected)
