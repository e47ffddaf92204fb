"""Triangles instead of rows: the same equations, whatever the pieces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from ident.data.run import Run
from ident.discovery.evidence import Evidence, gather
from ident.equations import reduction as reduction_module
from ident.equations.observation import OBSERVATION_ROWS
from ident.equations.reduction import motor_support, reduce_runs, regrouped
from ident.equations.system import System
from ident.equations.triangles import triangle
from ident.estimators.estimate import Estimate
from ident.estimators.identify import identify
from ident.estimators.maximum_likelihood import ml
from ident.model.model import DriveTrain, Model
from ident.model.robot import Motion
from tests.ident.recordings import CONDITIONING, Truth

SMALL = replace(CONDITIONING, standstill_rad_s=CONDITIONING.standstill_rad_s[:3])
"""For the arm of three axes."""


@pytest.fixture(scope="module")
def whole(truth: Truth, noisy_runs: tuple[Run, ...]) -> System:
    """In pieces of the usual length."""
    standard = reduce_runs(truth.model, noisy_runs, CONDITIONING)
    return regrouped(standard)


@pytest.mark.slow
def test_the_triangles_are_those_of_the_rows(noisy: Evidence, whole: System) -> None:
    rows = noisy.training.system()
    for one, other in ((whole.joints, rows.joints), (whole.motors, rows.motors)):
        assert one.rows.tolist() == other.rows.tolist()
        for a, b in zip(one.factors, other.factors, strict=True):
            expected = b.T @ b
            assert_allclose(a.T @ a, expected, rtol=1e-9, atol=1e-9 * np.max(np.abs(b)) ** 2)
    assert len(whole.clusters) == len(rows.clusters)
    assert ml(whole).gains_std == pytest.approx(ml(rows).gains_std, rel=1e-6)


def test_the_clusters_of_kept_rows_are_the_rows_of_their_motors(noisy: Evidence) -> None:
    observation = noisy.training
    system = observation.system()
    columns_of_motors = observation.motor_columns()
    for motor, columns in enumerate(columns_of_motors):
        used = observation.motor_use[motor]
        clusters = [cluster[motor] for cluster in system.clusters]
        found = np.concatenate(clusters)
        assert_allclose(found, columns[:, used].T, rtol=1e-12, atol=1e-12)
    moves = np.unique(observation.move[observation.motor_use.any(axis=0)])
    for move, cluster in zip(moves, system.clusters, strict=True):
        of_move = observation.motor_use[:, observation.move == move]
        counts = [len(rows) for rows in cluster]
        expected = of_move.sum(axis=1).tolist()
        assert counts == expected


@pytest.fixture(scope="module")
def small_estimate(small_truth: Truth, small_runs: tuple[Run, ...]) -> Estimate:
    """Estimate from a run of the three-axis arm without load and one with it,
    in pieces of the usual length.
    """
    standard = reduce_runs(small_truth.model, small_runs[:2], SMALL)
    return ml(regrouped(standard))


@pytest.mark.slow
@given(st.integers(min_value=1, max_value=400))
@settings(max_examples=6, deadline=None)
def test_results_do_not_depend_on_the_chunk(
    small_truth: Truth, small_runs: tuple[Run, ...], small_estimate: Estimate, chunk: int
) -> None:
    standard = reduce_runs(small_truth.model, small_runs[:2], SMALL, chunk_rows=chunk)
    other = ml(regrouped(standard))
    assert other.gains == pytest.approx(small_estimate.gains, rel=1e-9)
    assert other.gains_std == pytest.approx(small_estimate.gains_std, rel=1e-6)


@pytest.mark.slow
def test_many_moves_are_joined_and_say_the_same(
    truth: Truth, noisy_runs: tuple[Run, ...], whole: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reduction_module, "MAX_CLUSTERS", 20)
    standard = reduce_runs(truth.model, noisy_runs, CONDITIONING)
    joined = regrouped(standard)
    assert len(joined.clusters) < len(whole.clusters)
    assert ml(joined).gains == pytest.approx(ml(whole).gains, rel=1e-9)
    assert ml(joined).gains_std == pytest.approx(ml(whole).gains_std, rel=0.5)


def test_runs_are_read_one_after_the_other(small_truth: Truth, small_runs: tuple[Run, ...]) -> None:
    held: list[int] = []
    read: list[Run] = []

    def reading() -> Run:
        read.append(small_runs[len(held)])
        held.append(len(held))
        return read.pop()

    found = reduce_runs(small_truth.model, (reading() for _ in small_runs), SMALL)
    expected = tuple(run.name for run in small_runs)
    assert found.runs == expected


def test_rows_kept_by_a_fit_are_those_built_of_its_runs(
    small_truth: Truth, small_runs: tuple[Run, ...]
) -> None:
    given = small_runs[:2]
    unseen = small_runs[2:3]
    found = identify(small_truth.model, given, SMALL, holdout=unseen, keep_rows=True)
    kept = gather(found)
    built = gather(replace(found, gathered=None), given, unseen)
    expected = tuple(run.name for run in (*given, *unseen))
    assert kept.rows_without_effects.runs == expected
    for one, other in ((kept.training, built.training), (kept.holdout, built.holdout)):
        assert one is not None
        assert other is not None
        assert all(
            np.array_equal(getattr(one, name), getattr(other, name)) for name in OBSERVATION_ROWS
        )


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4, 5), (5, 4, 3, 2, 1, 0)])
def test_the_support_leaves_nothing_out(truth: Truth, order: tuple[int, ...]) -> None:
    """Columns that a joint or a motor does not have are zero for any motion."""
    ratio = truth.model.drive_train.ratio[list(order)]
    model = Model(truth.model.robot, DriveTrain(ratio))
    rng = np.random.default_rng(0)
    motion = Motion(*rng.normal(size=(3, 50, 6)))
    columns = model.regressor(motion)
    assert not columns[~model.support].any()
    mixed = np.einsum("ij,jck->ick", model.drive_train.to_motor, columns)
    for motor, held in enumerate(motor_support(model.drive_train, model.support)):
        absolute_mixed = np.abs(mixed[motor][~held])
        assert np.max(absolute_mixed, initial=0.0) < 1e-9


@given(st.integers(0, 40), st.integers(1, 12), st.integers(0, 2**32 - 1))
@settings(deadline=None)
def test_a_triangle_of_pieces_has_the_norms_of_the_whole(
    rows: int, columns: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(rows, columns))
    cut = int(rng.integers(0, rows + 1))
    parts = (matrix[:cut],)
    found = triangle((triangle(parts, columns), matrix[cut:]), columns)
    x = rng.normal(size=columns)
    assert np.linalg.norm(found @ x) == pytest.approx(
        np.linalg.norm(matrix @ x), rel=1e-12, abs=1e-12
    )
    assert len(found) <= max(columns, rows)
