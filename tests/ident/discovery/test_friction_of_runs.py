"""Friction that differs from run to run is no law within the runs:
it is given no name, and hides none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.discovery.evidence import Evidence
from ident.discovery.gates import gain_shifts, whitened_columns
from ident.discovery.loop import find_effects
from ident.effects.position import Spring
from ident.equations import run_scatter
from ident.equations.linearisation import cut_into_folds, linearise
from ident.equations.run_scatter import RunScatter
from tests.ident.recordings import (
    MOUNTED,
    PAYLOAD_TRUTH,
    Truth,
    acting_on,
    bent,
    gathered,
    record,
    search_problem_of,
)

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]

SPREAD = 0.02  #: Standard deviation of each axis' friction from run to run
LOAD_FRICTION = 0.08


def _session(truth: Truth, seed: int) -> Evidence:
    """Four runs, every other one loaded, at an error of about two per cent;
    the friction of each has its own size.
    """
    rng = np.random.default_rng(seed)
    names = [column.name for column in truth.model.columns]
    runs = []
    for index in range(4):
        parameters = truth.parameters.copy()
        factors = 1.0 + SPREAD * rng.standard_normal(3)
        for place, name in enumerate(names):
            if name[:2] in {"fv", "fs"}:
                parameters[place] *= factors[int(name[2:]) - 1]
        rubbing = replace(truth, parameters=parameters)
        payload = MOUNTED if index % 2 else None
        run = record(rubbing, f"run{index}", rng, payload, noise_a=0.1, seconds=22.0)
        started_s = 40.0 * index
        runs.append(replace(run, started_s=started_s))
    return gathered(truth, tuple(runs))


def _load(truth: Truth, data: Dataset) -> FloatArray:
    """True load of the second joint, shape (k,)."""
    names = [column.name for column in truth.model.columns]
    parameters = truth.parameters * np.array(
        [name[:2] not in {"Ia", "fv", "fs", "of"} for name in names]
    )
    if data.payload is not None:
        parameters[truth.model.flange] += list(PAYLOAD_TRUTH.values())
    return np.asarray(np.einsum("ck,c->k", truth.model.regressor(data.motion())[1], parameters))


# A search that takes moves of all runs as exchangeable adds a warm-up to both of these, and in the
# second a warm-up and a lag to the load friction.
@pytest.mark.parametrize("seed", [3, 4])
def test_friction_that_differs_from_run_to_run_adds_no_effect(
    small_truth: Truth, seed: int
) -> None:
    (step,) = find_effects(_session(small_truth, seed), np.random.default_rng(0))
    assert step.accepted is None
    assert not step.set_aside


def test_load_friction_is_named_alone_where_friction_differs_from_run_to_run(
    small_truth: Truth,
) -> None:
    clean = _session(small_truth, 1)
    start = bent(
        clean,
        small_truth,
        lambda data: acting_on(
            1,
            3,
            LOAD_FRICTION * np.abs(_load(small_truth, data)) * np.sign(data.velocity_rad_s[:, 1]),
        ),
    )
    rng = np.random.default_rng(0)
    last_effect = find_effects(start, rng)[-1]
    end = last_effect.after
    assert [(placed.effect.name, placed.axis) for placed in end.effects] == [("load-friction", 1)]
    assert end.estimate.parameters[len(end.rows_without_effects.columns)] == pytest.approx(
        LOAD_FRICTION, rel=0.2
    )


def test_shifts_of_gains_are_those_of_the_estimate(small: Evidence) -> None:
    """The search alone takes friction as different from run to run;
    a refit with the torque would not.
    """
    problem = search_problem_of(small)
    spring = whitened_columns(problem, Spring(), 1)[:, 0]
    estimate = small.estimate
    plain = linearise(
        small.training, estimate.gains, estimate.parameters, estimate.axis_noise, gains_fixed=False
    )
    torque = plain.whitened(problem.torque(Spring(), 1), small.model.drive_train.to_motor)[:, 0]
    folds = cut_into_folds(replace(plain))
    order = np.lexsort((plain.cluster, plain.cluster % folds.count, plain.motor))
    assert gain_shifts(problem.folds, spring) == pytest.approx(
        gain_shifts(folds, torque[order]), rel=1e-6
    )


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_decorrelated_rows_have_the_identity_as_covariance(seed: int) -> None:
    """V written out; S V S = 1, and V − 1 between columns."""
    rng = np.random.default_rng(seed)
    run = np.sort(rng.integers(0, 3, 30))
    shared = rng.normal(size=(2, 30)) * rng.uniform(0.1, 3.0, size=(2, 1))
    scatter = RunScatter.of([shared], [run])
    order = rng.permutation(30)
    moved = scatter.sorted([order])
    same_run = run[:, None] == run[None]
    covariance = np.eye(30) + shared.T @ shared * same_run
    columns = rng.normal(size=(4, 30))
    identity = np.eye(30)
    halved = scatter.decorrelate(0, identity)
    np.testing.assert_allclose(halved @ covariance @ halved, np.eye(30), atol=1e-9)
    np.testing.assert_allclose(scatter.correlate(0, columns), columns @ covariance, atol=1e-9)
    np.testing.assert_allclose(
        scatter.shared(0, columns), columns @ (covariance - np.eye(30)) @ columns.T, atol=1e-9
    )
    np.testing.assert_allclose(
        moved.decorrelate(0, columns[:, order]),
        scatter.decorrelate(0, columns)[:, order],
        atol=1e-9,
    )


def test_directions_with_and_without_their_zeros_decorrelate_alike(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(3)
    run = np.sort(rng.integers(0, 4, 200))
    shared = rng.normal(size=(3, 200))
    columns = rng.normal(size=(5, 200))
    dense = RunScatter.of([shared], [run])
    monkeypatch.setattr(run_scatter, "MOST_DENSE", 0)
    sparse = RunScatter.of([shared], [run])
    assert isinstance(dense.directions[0], np.ndarray)
    assert not isinstance(sparse.directions[0], np.ndarray)
    for one, other in (
        (dense.decorrelate(0, columns), sparse.decorrelate(0, columns)),
        (dense.correlate(0, columns), sparse.correlate(0, columns)),
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
