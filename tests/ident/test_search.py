"""The search: it names what was planted, stays silent on clean data, and its folds do not leak."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.linearisation import linearise
from ident.loop import Evidence, close_the_loop
from ident.residual import cut
from ident.run import Run
from ident.search import find
from tests.ident.recordings import GAINS, Truth, gathered

FloatArray = NDArray[np.float64]


def _with_torque(run: Run, axis: int, torque_nm: FloatArray) -> Run:
    current = run.current_a.copy()
    current[:, axis] += torque_nm / GAINS[axis]
    return replace(run, current_a=current)


def _speed(run: Run, axis: int) -> FloatArray:
    return np.asarray(np.gradient(run.position_rad[:, axis]) * run.rate_hz)


def _identified(truth: Truth, runs: tuple[Run, ...]) -> Evidence:
    return gathered(truth, runs[:-1], runs[-1:])


def test_clean_data_get_no_effect(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    steps = close_the_loop(_identified(truth, noisy_runs), np.random.default_rng(0))
    assert len(steps) == 1
    assert steps[0].accepted is None
    assert steps[0].after.effects == ()


# Made by other formulas than the dictionary's: a Gaussian Stribeck bump, friction of the measured load.
def test_low_speed_friction_is_named_and_the_unused_run_gets_better(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    runs = []
    for run in noisy_runs:
        v = _speed(run, 1)
        runs.append(_with_torque(run, 1, 5.0 * np.sign(v) * np.exp(-((v / 0.35) ** 2))))
    start = _identified(truth, tuple(runs))
    steps = close_the_loop(start, np.random.default_rng(0))
    assert [(step.accepted.effect.name, step.accepted.axis) for step in steps if step.accepted] == [("stribeck", 1)]
    before, after = start.holdout_error, steps[-1].after.holdout_error
    assert before is not None
    assert after is not None
    assert after.axes[1] < 0.95 * before.axes[1]
    assert np.max(np.abs(steps[-1].after.estimate.gains / GAINS - 1.0)) < 0.02


def test_a_spring_is_told_from_gravity(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    runs = tuple(_with_torque(run, 2, 4.0 * run.position_rad[:, 2]) for run in noisy_runs)
    steps = close_the_loop(_identified(truth, runs), np.random.default_rng(0))
    accepted = [step.accepted for step in steps if step.accepted]
    assert [(finding.effect.name, finding.axis) for finding in accepted] == [("spring", 2)]
    index = [column.name for column in steps[-1].after.training.columns].index("spring stiffness 3")
    assert steps[-1].after.estimate.parameters[index] == pytest.approx(4.0, rel=0.1)


def test_the_same_seed_gives_the_same_verdict(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    start = _identified(truth, noisy_runs)
    trained = start.trained
    first, second = (
        find(start.model, trained, start.training, start.estimate, np.random.default_rng(4)) for _ in range(2)
    )
    assert [(f.effect, f.axis, f.probability) for f in first] == [(f.effect, f.axis, f.probability) for f in second]


def test_a_left_out_fold_has_no_say_in_its_own_prediction(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    start = _identified(truth, noisy_runs)
    estimate = start.estimate
    problem = linearise(start.training, estimate.gains, estimate.parameters, estimate.axis_noise, gains_fixed=False)
    folds = cut(problem)
    parts = [folds.problem.cluster[rows] for rows in folds.slices]
    assert sum(map(len, parts)) == len(problem.cluster)
    assert not any(set(one) & set(other) for one, other in combinations(parts, 2))
    # A change of what fold 0 measured must show in full: its prediction came from the others alone.
    rows = problem.cluster % folds.count == 0
    bent = cut(replace(problem, residual=problem.residual + 3.0 * rows))
    change = bent.residual - folds.residual
    assert change[folds.slices[0]] == pytest.approx(3.0)
    assert np.max(np.abs(change[folds.slices[1].start :])) > 1e-3
