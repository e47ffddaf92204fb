"""A trial's block formulas against projections and refits written out, row by row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.discovery.candidates import CandidateTrial, score_candidates
from ident.discovery.search import _drawn_numbers, _drawn_wald
from ident.equations.linearisation import Folds, Linearisation, cut_into_folds
from tests.ident.discovery.random_problem import MOTORS, MOVES, WIDTH, fitted_to, random_problem
from tests.ident.recordings import whole

FloatArray = NDArray[np.float64]


def _unexplained(j: FloatArray, values: FloatArray) -> FloatArray:
    """What a fit with the columns of j leaves of values."""
    fitted = j @ fitted_to(j, values)
    return np.asarray(values - fitted)


def _squares_by_motor(
    problem: Linearisation, residual: FloatArray, rows: NDArray[np.bool_]
) -> FloatArray:
    """Sum of squares on the rows of each motor, shape (m,)."""
    squares = residual**2
    sums = []
    for motor in range(MOTORS):
        of_motor = rows & (problem.motor == motor)
        sums.append(np.sum(squares[of_motor]))
    return np.array(sums)


def _written_out(problem: Linearisation, columns: FloatArray, count: int = 8) -> CandidateTrial:
    """The same by projection and by one refit on all rows a fold."""
    j = whole(problem.jacobian)
    e = problem.residual
    left = _unexplained(j, columns)
    coefficients = fitted_to(left, e)
    after = e - left @ coefficients

    both = np.concatenate((j, columns), axis=1)
    training = []
    held_out = []
    for fold in range(count):
        out = problem.cluster % count == fold
        fitted_rows = ~out
        e_fitted = e[fitted_rows]
        without = _unexplained(j[fitted_rows], e_fitted)
        with_columns = _unexplained(both[fitted_rows], e_fitted)
        difference = np.sum(without**2) - np.sum(with_columns**2)
        training.append(difference)
        refit = fitted_to(both[fitted_rows], e_fitted)
        residual = e - both @ refit
        of_fold = _squares_by_motor(problem, residual, out)
        held_out.append(of_fold)

    everything = np.ones(len(e), dtype=np.bool_)
    before_by_motor = _squares_by_motor(problem, e, everything)
    after_by_motor = _squares_by_motor(problem, after, everything)
    scatter = []
    gram = []
    for move in range(MOVES):
        rows = problem.cluster == move
        left_of_move = left[rows]
        scatter.append(left_of_move.T @ after[rows])
        gram.append(left_of_move.T @ left_of_move)
    return CandidateTrial(
        coefficients=coefficients,
        fall_by_motor=before_by_motor - after_by_motor,
        training_fall=np.array(training),
        left_out=np.array(held_out),
        score=left.T @ e,
        scatter=np.stack(scatter),
        gram=np.stack(gram),
    )


def _agree(found: CandidateTrial | None, expected: CandidateTrial) -> None:
    assert found is not None
    for name in set(CandidateTrial.__slots__) - {"without_leverage"}:
        value = getattr(found, name)
        wanted = getattr(expected, name)
        scale = float(np.max(np.abs(wanted)))
        assert value == pytest.approx(wanted, rel=1e-8, abs=1e-8 * scale), name


def _random_folds(rng: np.random.Generator) -> Folds:
    """A random problem, cut into folds."""
    problem = random_problem(rng)
    return cut_into_folds(problem)


@given(seed=st.integers(0, 2**32 - 1), widths=st.lists(st.integers(1, 4), min_size=1, max_size=3))
@settings(max_examples=15, deadline=None)
def test_blocks_say_what_whole_rows_say(seed: int, widths: list[int]) -> None:
    """Candidates of one and of several columns side by side, on all motors or on one alone."""
    rng = np.random.default_rng(seed)
    folds = _random_folds(rng)
    problem = folds.linearisation
    rows = len(problem.motor)
    columns = rng.normal(size=(rows, sum(widths)))
    columns[:, 0] *= problem.motor == 1
    first_of_model = whole(problem.jacobian)[:, :1]
    columns += 0.4 * first_of_model
    columns += 0.2 * problem.residual[:, None]
    slices = []
    begin = 0
    for width in widths:
        end = begin + width
        slices.append(slice(begin, end))
        begin = end

    trials = score_candidates(folds, columns, slices)

    for trial, chosen in zip(trials, slices, strict=True):
        expected = _written_out(problem, columns[:, chosen])
        _agree(trial, expected)


def test_what_the_model_says_already_is_no_candidate() -> None:
    rng = np.random.default_rng(1)
    folds = _random_folds(rng)
    j = whole(folds.linearisation.jacobian)
    own = rng.normal(size=len(j))
    said = j @ rng.normal(size=WIDTH)
    nearly_said = said + 1e-2 * own
    columns = np.stack((said, own, said + own, own, 2.0 * own, nearly_said), axis=1)
    slices = [
        slice(0, 1),
        slice(1, 2),
        slice(1, 3),
        slice(3, 5),
        slice(5, 6),
    ]
    absorbed, good, twin, double, nearly = score_candidates(folds, columns, slices)
    assert absorbed is None
    assert twin is None
    assert double is None
    expected = _written_out(folds.linearisation, own[:, None])
    _agree(good, expected)
    assert nearly is not None


def test_a_column_that_one_fold_alone_sees_predicts_nothing_there() -> None:
    rng = np.random.default_rng(2)
    folds = _random_folds(rng)
    problem = folds.linearisation
    rows = len(problem.motor)
    is_fold_3 = problem.cluster % 8 == 3
    seen = rng.normal(size=(rows, 1)) * is_fold_3[:, None]
    candidates = [slice(0, 1)]
    (trial,) = score_candidates(folds, seen, candidates)
    assert trial is not None
    expected = _written_out(problem, seen)  # of the least size, where the others do not say: zero
    assert trial.training_fall[3] == pytest.approx(0.0, abs=1e-9)
    assert trial.left_out == pytest.approx(expected.left_out, rel=1e-6)
    before = folds.square_sum(folds.residual)
    assert trial.left_out[3] == pytest.approx(before[3])


def test_pairs_of_which_one_fold_alone_sees_a_part_predict_with_the_other() -> None:
    rng = np.random.default_rng(3)
    folds = _random_folds(rng)
    problem = folds.linearisation
    rows = len(problem.motor)
    of_all_folds = rng.normal(size=rows) + 0.5 * problem.residual
    is_fold_3 = problem.cluster % 8 == 3
    seen = rng.normal(size=rows) * is_fold_3
    pair = np.stack((of_all_folds, seen), axis=1)
    candidates = [slice(0, 2)]
    (trial,) = score_candidates(folds, pair, candidates)
    assert trial is not None
    expected = _written_out(problem, pair)
    assert trial.left_out == pytest.approx(expected.left_out, rel=1e-6)


def test_the_unit_of_a_candidate_does_not_matter() -> None:
    rng = np.random.default_rng(4)
    folds = _random_folds(rng)
    rows = len(folds.linearisation.motor)
    columns = rng.normal(size=(rows, 2))
    units = np.array([1e5, 1e-4])
    candidates = [slice(0, 2)]
    (one,) = score_candidates(folds, columns, candidates)
    (other,) = score_candidates(folds, columns * units, candidates)
    assert one is not None
    assert other is not None
    in_units_of_one = replace(
        other,
        score=one.score,
        scatter=one.scatter,
        gram=one.gram,
        coefficients=other.coefficients * units,
    )
    _agree(in_units_of_one, one)


@pytest.mark.parametrize("width", [1, 2, 3])
def test_a_draws_statistic_is_that_of_its_moves_one_by_one(width: int) -> None:
    rng = np.random.default_rng(5)
    folds = _random_folds(rng)
    rows = len(folds.linearisation.motor)
    columns = rng.normal(size=(rows, width))
    candidates = [slice(0, width)]
    (trial,) = score_candidates(folds, columns, candidates)
    assert trial is not None
    signs = rng.choice((-1.0, 1.0), size=(5, MOVES))
    all_moves = trial.gram.sum(axis=0)
    expected = []
    for drawn in signs:
        total = drawn @ trial.scatter
        fitted = np.linalg.solve(all_moves, total)
        drawn_scatter = drawn[:, None] * trial.scatter
        left = drawn_scatter - trial.gram @ fitted
        covariance = left.T @ left
        statistic = total @ np.linalg.solve(covariance, total)
        expected.append(statistic)
    if width > 1:
        found = _drawn_wald(trial, signs)
    else:
        gram = trial.gram[:, :, 0]
        found = _drawn_numbers(trial.scatter, gram, signs)
    assert found == pytest.approx(np.array(expected), rel=1e-9)
