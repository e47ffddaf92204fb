"""Candidates fitted in-sample by sums over motors, against trials and against least squares."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.discovery.candidate_fits import CandidateFit, WhitenedColumns, fit_candidates
from ident.discovery.candidates import score_candidates
from ident.equations.linearisation import Folds, cut_into_folds
from tests.ident.discovery.random_problem import WIDTH, fitted_to, random_problem
from tests.ident.recordings import whole

FloatArray = NDArray[np.float64]


def _whitened(folds: Folds, columns: FloatArray) -> WhitenedColumns:
    """Columns by motor; a motor whose rows are zero is not loaded."""
    by_motor: dict[int, FloatArray] = {}
    for own in folds.motors:
        part = columns[own.rows].T
        if part.any():
            by_motor[own.motor] = part
    return by_motor


def _fits(folds: Folds, candidates: list[FloatArray]) -> tuple[CandidateFit | None, ...]:
    widths_and_columns = ((one.shape[1], _whitened(folds, one)) for one in candidates)
    return fit_candidates(folds, widths_and_columns)


def _candidates(rng: np.random.Generator, folds: Folds, widths: list[int]) -> list[FloatArray]:
    """Columns that resemble the model and the residual; every other candidate is of one motor."""
    problem = folds.linearisation
    jacobian = whole(problem.jacobian)
    found: list[FloatArray] = []
    for number, width in enumerate(widths):
        columns = rng.normal(size=(len(problem.motor), width))
        columns += 0.4 * jacobian[:, :1] + 0.2 * problem.residual[:, None]
        if number % 2:
            columns *= (problem.motor == 1)[:, None]
        found.append(columns)
    return found


@given(seed=st.integers(0, 2**32 - 1), widths=st.lists(st.integers(1, 4), min_size=1, max_size=5))
@settings(max_examples=15, deadline=None)
def test_a_fit_has_the_numbers_of_a_trial_and_of_least_squares(
    seed: int, widths: list[int]
) -> None:
    rng = np.random.default_rng(seed)
    folds = cut_into_folds(random_problem(rng))
    problem = folds.linearisation
    jacobian = whole(problem.jacobian)
    candidates = _candidates(rng, folds, widths)
    fits = _fits(folds, candidates)
    for fit, columns in zip(fits, candidates, strict=True):
        (trial,) = score_candidates(folds, columns, [slice(0, columns.shape[1])])
        assert fit is not None
        assert trial is not None
        assert fit.coefficients == pytest.approx(trial.coefficients, rel=1e-9, abs=1e-12)
        assert fit.fall_by_motor == pytest.approx(trial.fall_by_motor, rel=1e-9, abs=1e-9)
        both = np.concatenate((jacobian, columns), axis=1)
        after = problem.residual - both @ fitted_to(both, problem.residual)
        change = problem.residual**2 - after**2
        by_motor = np.bincount(problem.motor, change)
        assert fit.fall_by_motor == pytest.approx(by_motor, rel=1e-7, abs=1e-7)


def test_candidates_that_the_model_contains_leave_the_others_of_their_batch_as_they_are() -> None:
    rng = np.random.default_rng(1)
    folds = cut_into_folds(random_problem(rng))
    jacobian = whole(folds.linearisation.jacobian)
    contained = jacobian @ rng.normal(size=(WIDTH, 2))
    first, second = _candidates(rng, folds, [2, 2])
    alone = _fits(folds, [first, second])
    assert _fits(folds, [contained]) == (None,)
    candidates = [contained, first, contained, second]
    together = _fits(folds, candidates)
    assert together[0] is None
    assert together[2] is None
    for own, beside in zip(alone, (together[1], together[3]), strict=True):
        assert own is not None
        assert beside is not None
        assert beside.coefficients == pytest.approx(own.coefficients, rel=1e-9)
        assert beside.fall_by_motor == pytest.approx(own.fall_by_motor, rel=1e-9, abs=1e-12)
    slices = [slice(0, 2), slice(2, 4), slice(4, 6), slice(6, 8)]
    columns = np.concatenate((contained, first, contained, second), axis=1)
    trials = score_candidates(folds, columns, slices)
    assert trials[0] is None
    assert trials[2] is None
    for own, trial in zip(alone, (trials[1], trials[3]), strict=True):
        assert own is not None
        assert trial is not None
        assert trial.fall_by_motor == pytest.approx(own.fall_by_motor, rel=1e-9, abs=1e-12)


@given(seed=st.integers(0, 2**32 - 1), width=st.integers(1, 4))
@settings(max_examples=10, deadline=None)
def test_products_of_a_candidate_with_itself_are_those_of_matrix_products(
    seed: int, width: int
) -> None:
    rng = np.random.default_rng(seed)
    folds = cut_into_folds(random_problem(rng))
    for own in folds.motors:
        columns = rng.normal(size=(3, width, own.equations.shape[1]))
        expected = own.sums(columns, columns)
        assert own.grams(columns) == pytest.approx(expected, rel=1e-12, abs=1e-12)
