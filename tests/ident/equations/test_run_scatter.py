"""Errors that the rows of a run share, against the dense covariance that they stand for."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from numpy.testing import assert_allclose

from ident.arrays import FloatArray, IntArray
from ident.equations import run_scatter
from ident.equations.run_scatter import RunScatter

RUNS = (np.array([0, 0, 1, 1, 1, 0, 2]), np.array([1, 1, 1, 2, 2]))


@pytest.fixture
def columns() -> tuple[FloatArray, ...]:
    """Two deviations on the rows of each of two motors; the first motor has but one of them."""
    rng = np.random.default_rng(8)
    made = [rng.normal(size=(2, len(run))) for run in RUNS]
    made[0][1] = 0.0
    return tuple(made)


def covariance(columns: FloatArray, run: IntArray) -> FloatArray:
    """1 + N Nᵀ, where N has a column for each deviation and run."""
    out = np.eye(len(run))
    for number in np.unique(run):
        own = columns * (run == number)
        out += own.T @ own
    return out


def inverse_root(matrix: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors / np.sqrt(values)) @ vectors.T)


@pytest.mark.parametrize("motor", [0, 1])
def test_columns_are_multiplied_by_the_covariance_and_by_its_inverse_root(
    columns: tuple[FloatArray, ...], motor: int
) -> None:
    scatter = RunScatter.of(columns, RUNS)
    dense = covariance(columns[motor], RUNS[motor])
    given = np.random.default_rng(9).normal(size=(3, len(RUNS[motor])))
    assert_allclose(scatter.correlate(motor, given), given @ dense, rtol=1e-12, atol=1e-12)
    expected = given @ inverse_root(dense)
    assert_allclose(scatter.decorrelate(motor, given), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("motor", [0, 1])
def test_the_shared_part_of_a_product_is_that_beyond_independent_rows(
    columns: tuple[FloatArray, ...], motor: int
) -> None:
    scatter = RunScatter.of(columns, RUNS)
    beyond = covariance(columns[motor], RUNS[motor]) - np.eye(len(RUNS[motor]))
    given = np.random.default_rng(9).normal(size=(3, len(RUNS[motor])))
    assert_allclose(scatter.shared(motor, given), given @ beyond @ given.T, atol=1e-12)


def test_rows_in_another_order_have_the_same_errors(columns: tuple[FloatArray, ...]) -> None:
    orders = (np.array([6, 2, 0, 1, 5, 4, 3]), np.array([4, 0, 3, 1, 2]))
    scatter = RunScatter.of(columns, RUNS)
    moved = scatter.sorted(orders)
    for motor, order in enumerate(orders):
        given = np.random.default_rng(9).normal(size=(3, len(order)))
        expected = scatter.decorrelate(motor, given)[:, order]
        assert_allclose(moved.decorrelate(motor, given[:, order]), expected, atol=1e-12)


def test_many_directions_are_sparse_and_say_the_same(
    columns: tuple[FloatArray, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    dense = RunScatter.of(columns, RUNS)
    # The first motor has one deviation in three runs.
    assert [len(own) for own in dense.variances] == [3, 4]
    assert not scipy.sparse.issparse(dense.directions[0])
    monkeypatch.setattr(run_scatter, "MOST_DENSE", 3)
    sparse = RunScatter.of(columns, RUNS)
    assert [scipy.sparse.issparse(own) for own in sparse.directions] == [False, True]
    given = np.random.default_rng(9).normal(size=(3, 5))
    assert_allclose(sparse.correlate(1, given), dense.correlate(1, given), atol=1e-12)


def test_a_motor_without_deviations_keeps_its_rows() -> None:
    scatter = RunScatter.of((np.zeros((2, 4)),), (np.array([0, 0, 1, 1]),))
    given = np.arange(8.0).reshape(2, 4)
    assert_allclose(scatter.decorrelate(0, given), given)
    assert_allclose(scatter.shared(0, given), np.zeros((2, 2)))
