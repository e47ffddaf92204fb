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
from ident.equations.linearisation import Linearisation, cut_into_folds
from tests.ident.discovery.random_problem import MOTORS, MOVES, WIDTH, fitted_to, random_problem
from tests.ident.recordings import whole

FloatArray = NDArray[np.float64]


def _written_out(problem: Linearisation, columns: FloatArray, count: int = 8) -> CandidateTrial:
    """The same by projection and by one whole refit a fold."""
    j = whole(problem.jacobian)
    e = problem.residual
    left = columns - j @ fitted_to(j, columns)
    coefficients = fitted_to(left, e)
    after = e - left @ coefficients

    def by_motor(residual: FloatArray, rows: NDArray[np.bool_]) -> list[float]:
        return [float(np.sum(residual[rows & (problem.motor == i)] ** 2)) for i in range(MOTORS)]

    everything = np.ones(len(e), dtype=np.bool_)
    both = np.concatenate((j, columns), axis=1)
    training = []
    held = []
    for fold in range(count):
        out = problem.cluster % count == fold
        target = e[~out]
        without = e[~out] - j[~out] @ fitted_to(j[~out], target)
        fitted = fitted_to(both[~out], e[~out])
        difference = np.sum(without**2) - np.sum((e[~out] - both[~out] @ fitted) ** 2)
        training.append(float(difference))
        held.append(by_motor(e - both @ fitted, out))
    moves = [problem.cluster == move for move in range(MOVES)]
    fall_by_motor = np.array(by_motor(e, everything)) - np.array(by_motor(after, everything))
    scatter = np.stack([left[rows].T @ after[rows] for rows in moves])
    gram = np.stack([left[rows].T @ left[rows] for rows in moves])
    score = left.T @ e
    training_fall = np.array(training)
    left_out = np.array(held)
    return CandidateTrial(
        coefficients=coefficients,
        fall_by_motor=fall_by_motor,
        training_fall=training_fall,
        left_out=left_out,
        score=score,
        scatter=scatter,
        gram=gram,
    )


def _agree(found: CandidateTrial | None, expected: CandidateTrial) -> None:
    assert found is not None
    for name in set(CandidateTrial.__slots__) - {"without_leverage"}:
        wanted = getattr(expected, name)
        scale = float(np.max(np.abs(wanted)))
        assert getattr(found, name) == pytest.approx(wanted, rel=1e-8, abs=1e-8 * scale), name


@given(seed=st.integers(0, 2**32 - 1), widths=st.lists(st.integers(1, 4), min_size=1, max_size=3))
@settings(max_examples=15, deadline=None)
def test_blocks_say_what_whole_rows_say(seed: int, widths: list[int]) -> None:
    """Candidates of one and of several columns side by side, on all motors or on one alone."""
    rng = np.random.default_rng(seed)
    folds = cut_into_folds(random_problem(rng))
    problem = folds.linearisation
    columns = rng.normal(size=(len(problem.motor), sum(widths)))
    columns[:, 0] *= problem.motor == 1
    columns += 0.4 * whole(problem.jacobian)[:, :1] + 0.2 * problem.residual[:, None]
    ends = np.cumsum(widths)
    slices = [slice(int(end) - width, int(end)) for end, width in zip(ends, widths, strict=True)]
    for trial, chosen in zip(score_candidates(folds, columns, slices), slices, strict=True):
        _agree(trial, _written_out(problem, columns[:, chosen]))


def test_what_the_model_says_already_is_no_candidate() -> None:
    rng = np.random.default_rng(1)
    folds = cut_into_folds(random_problem(rng))
    j = whole(folds.linearisation.jacobian)
    own = rng.normal(size=len(j))
    said = j @ rng.normal(size=WIDTH)
    columns = np.stack((said, own, said + own, own, 2.0 * own, said + 1e-2 * own), axis=1)
    slices = [slice(0, 1), slice(1, 2), slice(1, 3), slice(3, 5), slice(5, 6)]
    absorbed, good, twin, double, nearly = score_candidates(folds, columns, slices)
    assert absorbed is None
    assert twin is None
    assert double is None
    _agree(good, _written_out(folds.linearisation, columns[:, 1:2]))
    assert nearly is not None


def test_a_column_that_one_fold_alone_sees_predicts_nothing_there() -> None:
    rng = np.random.default_rng(2)
    folds = cut_into_folds(random_problem(rng))
    problem = folds.linearisation
    seen = rng.normal(size=(len(problem.motor), 1)) * (problem.cluster % 8 == 3)[:, None]
    candidates = [slice(0, 1)]
    (trial,) = score_candidates(folds, seen, candidates)
    assert trial is not None
    expected = _written_out(problem, seen)  # of the least size, where the others do not say: zero
    assert trial.training_fall[3] == pytest.approx(0.0, abs=1e-9)
    assert trial.left_out == pytest.approx(expected.left_out, rel=1e-6)
    assert trial.left_out[3] == pytest.approx(folds.square_sum(folds.residual)[3])


def test_pairs_of_which_one_fold_alone_sees_a_part_predict_with_the_other() -> None:
    rng = np.random.default_rng(3)
    folds = cut_into_folds(random_problem(rng))
    problem = folds.linearisation
    whole = rng.normal(size=len(problem.motor)) + 0.5 * problem.residual
    seen = rng.normal(size=len(problem.motor)) * (problem.cluster % 8 == 3)
    pair = np.stack((whole, seen), axis=1)
    candidates = [slice(0, 2)]
    (trial,) = score_candidates(folds, pair, candidates)
    assert trial is not None
    assert trial.left_out == pytest.approx(_written_out(problem, pair).left_out, rel=1e-6)


def test_the_unit_of_a_candidate_does_not_matter() -> None:
    rng = np.random.default_rng(4)
    folds = cut_into_folds(random_problem(rng))
    columns = rng.normal(size=(len(folds.linearisation.motor), 2))
    candidates = [slice(0, 2)]
    (one,) = score_candidates(folds, columns, candidates)
    (other,) = score_candidates(folds, columns * np.array([1e5, 1e-4]), [slice(0, 2)])
    assert one is not None
    assert other is not None
    coefficients = other.coefficients * np.array([1e5, 1e-4])
    _agree(replace(other, score=one.score, scatter=one.scatter, gram=one.gram,
                   coefficients=coefficients), one)  # fmt: skip


@pytest.mark.parametrize("width", [1, 2, 3])
def test_a_draws_statistic_is_that_of_its_moves_one_by_one(width: int) -> None:
    rng = np.random.default_rng(5)
    folds = cut_into_folds(random_problem(rng))
    columns = rng.normal(size=(len(folds.linearisation.motor), width))
    candidates = [slice(0, width)]
    (trial,) = score_candidates(folds, columns, candidates)
    assert trial is not None
    signs = rng.choice((-1.0, 1.0), size=(5, MOVES))
    expected = []
    for drawn in signs:
        total = drawn @ trial.scatter
        fitted = np.linalg.solve(trial.gram.sum(axis=0), total)
        left = drawn[:, None] * trial.scatter - trial.gram @ fitted
        expected.append(total @ np.linalg.solve(left.T @ left, total))
    if width > 1:
        found = _drawn_wald(trial, signs)
    else:
        found = _drawn_numbers(trial.scatter, trial.gram[:, :, 0], signs)
    assert found == pytest.approx(np.array(expected), rel=1e-9)
