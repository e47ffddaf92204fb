"""The search: it names what was planted by other formulas than its own,
and stays silent on clean data.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.run import Run
from ident.discovery.evidence import Evidence
from ident.discovery.loop import find_effects
from tests.ident.recordings import GAINS, Truth, gathered

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]


def _with_torque(run: Run, axis: int, torque_nm: FloatArray) -> Run:
    current = run.current_a.copy()
    current[:, axis] += torque_nm / GAINS[axis]
    return replace(run, current_a=current)


def _speed(run: Run, axis: int) -> FloatArray:
    position_rad_gradient = np.gradient(run.position_rad[:, axis])
    return np.asarray(position_rad_gradient * run.rate_hz)


def _identified(truth: Truth, runs: tuple[Run, ...]) -> Evidence:
    return gathered(truth, runs[:-1], runs[-1:])


def test_clean_data_get_no_effect(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    steps = find_effects(_identified(truth, noisy_runs), np.random.default_rng(0))
    assert len(steps) == 1
    assert steps[0].accepted is None
    assert steps[0].after.effects == ()


# Made by other formulas than the dictionary's: a Gaussian Stribeck bump, friction of the measured
# load.
def test_low_speed_friction_is_named_and_the_holdout_run_gets_better(
    truth: Truth, noisy_runs: tuple[Run, ...]
) -> None:
    runs = []
    for run in noisy_runs:
        v = _speed(run, 1)
        torque_nm = 5.0 * np.sign(v) * np.exp(-((v / 0.35) ** 2))
        runs.append(_with_torque(run, 1, torque_nm))
    start = _identified(truth, tuple(runs))
    rng = np.random.default_rng(0)
    steps = find_effects(start, rng)
    assert [(step.accepted.effect.name, step.accepted.axis) for step in steps if step.accepted] == [
        ("stribeck", 1)
    ]
    before = start.holdout_error
    after = steps[-1].after.holdout_error
    assert before is not None
    assert after is not None
    assert after.axes[1] < 0.95 * before.axes[1]
    gains = steps[-1].after.estimate.gains
    assert np.max(np.abs(gains / GAINS - 1.0)) < 0.02


def test_a_spring_is_distinguished_from_gravity(
    small_truth: Truth, small_runs: tuple[Run, ...]
) -> None:
    """And from a hinge that begins where the joint hardly comes:
    that says the same with two settings more.
    """
    torque = [4.0 * run.position_rad[:, 2] / small_truth.gains[2] for run in small_runs]
    runs = tuple(
        replace(run, current_a=run.current_a + np.outer(added, (0.0, 0.0, 1.0)))
        for run, added in zip(small_runs, torque, strict=True)
    )
    steps = find_effects(_identified(small_truth, runs), np.random.default_rng(0))
    accepted = [step.accepted for step in steps if step.accepted]
    assert [(finding.effect.name, finding.axis) for finding in accepted] == [("spring", 2)]
    columns = steps[-1].after.training.columns
    index = [column.name for column in columns].index("spring stiffness 3")
    parameters = steps[-1].after.estimate.parameters
    assert parameters[index] == pytest.approx(4.0, rel=0.1)
