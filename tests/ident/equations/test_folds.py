"""A small problem of three motors cut into folds, against sums over its dense rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ident.arrays import FloatArray, IntArray
from ident.equations.linearisation import (
    FOLDS,
    MIN_MOVES_TO_LEAVE_OUT,
    MOST_SUMMED,
    Folds,
    Jacobian,
    Linearisation,
    cut_into_folds,
    sum_of_squares,
)
from ident.errors import TooFewMoves

WIDTH = 5
SEEN = (np.array([0, 2, 3, 4]), np.array([1, 4]), np.array([2, 3]))
CLUSTERS = 2 * MIN_MOVES_TO_LEAVE_OUT
SAMPLES = 6 * CLUSTERS
TORQUE_COLUMNS = 2
TO_MOTOR = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -0.5], [0.0, 0.0, 2.0]])


def made_problem() -> Linearisation:
    """Motor 2 has no row in the first cluster; rows of clusters are mixed, as runs follow."""
    rng = np.random.default_rng(12)
    in_order = np.repeat(np.arange(CLUSTERS), 6)
    cluster = rng.permutation(in_order)
    sources = [np.flatnonzero(cluster >= least) for least in (0, 1, 0)]
    counts = [len(source) for source in sources]
    parts = []
    for seen, count in zip(SEEN, counts, strict=True):
        parts.append(rng.normal(size=(len(seen), count)))
    source = np.concatenate(sources)
    residual = rng.normal(size=len(source))
    current = rng.normal(size=len(source))
    motor = np.repeat(np.arange(3), counts)
    gamma = np.array([0.5, -0.2, 1.5])
    noise = np.array([0.1, 0.3, 0.2])
    return Linearisation(
        jacobian=Jacobian(tuple(parts), SEEN, WIDTH),
        residual=residual,
        current=current,
        motor=motor,
        cluster=cluster[source],
        source=source,
        gamma=gamma,
        noise=noise,
        free=np.arange(WIDTH),
        scale=np.ones(WIDTH),
    )


def dense(problem: Linearisation) -> FloatArray:
    return problem.jacobian.columns(np.arange(WIDTH))


@pytest.fixture(scope="module")
def problem() -> Linearisation:
    return made_problem()


@pytest.fixture(scope="module")
def folds(problem: Linearisation) -> Folds:
    return cut_into_folds(problem)


def rows_in(folds: Folds, fold: int) -> IntArray:
    """Rows of a fold, by the clusters that are dealt out in turn."""
    return np.flatnonzero(folds.linearisation.cluster % FOLDS == fold)


def test_the_normal_matrix_is_that_of_the_dense_rows(problem: Linearisation) -> None:
    rows = dense(problem)
    assert_allclose(sum_of_squares(problem.jacobian), rows.T @ rows, atol=1e-12)


def test_rows_are_sorted_by_motor_fold_and_cluster_and_none_is_lost(
    problem: Linearisation, folds: Folds
) -> None:
    found = folds.linearisation
    keys = list(zip(found.motor, found.cluster % FOLDS, found.cluster, strict=True))
    assert keys == sorted(keys)
    fold = problem.cluster % FOLDS
    order = np.lexsort((problem.cluster, fold, problem.motor))
    assert_allclose(dense(found), dense(problem)[order])
    assert_allclose(found.residual, problem.residual[order])
    assert_allclose(found.source, problem.source[order])
    assert_allclose(found.cluster, problem.cluster[order])
    assert folds.count == FOLDS
    assert folds.moves == CLUSTERS


def test_blocks_hold_one_motor_in_one_cluster_each(folds: Folds) -> None:
    found = folds.linearisation
    covered: list[int] = []
    for rows, fold, cluster, motor in folds.blocks:
        covered.extend(range(rows.start, rows.stop))
        assert set(found.cluster[rows]) == {cluster}
        assert set(found.motor[rows]) == {motor}
        assert fold == cluster % FOLDS
    assert covered == list(range(len(found.motor)))
    assert len(folds.blocks) == 3 * CLUSTERS - 1


def test_sums_of_clusters_and_motors_are_those_of_their_rows(folds: Folds) -> None:
    found = folds.linearisation
    rows = dense(found)
    for cluster in range(CLUSTERS):
        is_own = found.cluster == cluster
        own = rows[is_own]
        score = own.T @ found.residual[is_own]
        assert_allclose(folds.cluster_hessian[cluster], own.T @ own, atol=1e-12)
        assert_allclose(folds.cluster_score[cluster], score, atol=1e-12)
    for motor in range(3):
        is_own = found.motor == motor
        own = rows[is_own]
        score = own.T @ found.residual[is_own]
        assert_allclose(folds.motor_hessian[motor], own.T @ own, atol=1e-12)
        assert_allclose(folds.motor_score[motor], score, atol=1e-12)


def test_a_fold_is_predicted_by_a_fit_of_the_others(folds: Folds) -> None:
    found = folds.linearisation
    rows = dense(found)
    for fold in range(FOLDS):
        left_out = rows_in(folds, fold)
        others = np.setdiff1d(np.arange(len(rows)), left_out)
        other_rows = rows[others]
        other_residual = found.residual[others]
        step = np.linalg.lstsq(other_rows, other_residual, rcond=None)[0]
        predicted = rows[left_out] @ step
        expected = found.residual[left_out] - predicted
        assert_allclose(folds.residual[left_out], expected, atol=1e-6)
        assert_allclose(folds.scores[fold], other_rows.T @ other_residual, atol=1e-12)


def test_sums_of_each_fold_and_motor_are_of_predicted_rows(folds: Folds) -> None:
    found = folds.linearisation
    rows = dense(found)
    squares = folds.square_sum(folds.residual)
    for fold in range(FOLDS):
        in_fold = found.cluster % FOLDS == fold
        for motor in range(3):
            is_own = in_fold & (found.motor == motor)
            own = rows[is_own]
            residual = folds.residual[is_own]
            assert_allclose(folds.part_hessian[fold, motor], own.T @ own, atol=1e-12)
            assert_allclose(folds.part_score[fold, motor], own.T @ residual, atol=1e-12)
            assert squares[fold, motor] == pytest.approx(np.sum(residual**2))


def test_factors_are_of_all_rows_and_of_those_without_a_fold(folds: Folds) -> None:
    rows = dense(folds.linearisation)
    lower = np.tril(folds.full_factor[0])
    assert folds.full_factor[1] is True
    assert_allclose(lower @ lower.T, rows.T @ rows, rtol=1e-5)
    for fold, (factor, is_lower) in enumerate(folds.factors):
        assert is_lower
        others = np.setdiff1d(np.arange(len(rows)), rows_in(folds, fold))
        other_rows = rows[others]
        hessian = other_rows.T @ other_rows
        triangle = np.tril(factor)
        assert_allclose(triangle @ triangle.T, hessian, rtol=1e-5, atol=1e-4)
    assert folds.estimate_factor is folds.full_factor


def test_pieces_of_one_move_are_left_out_together(problem: Linearisation) -> None:
    pieces = np.arange(CLUSTERS) // 2 * 7
    folds = cut_into_folds(problem, pieces)
    assert folds.moves == CLUSTERS // 2
    for _, fold, cluster, _ in folds.blocks:
        assert fold == cluster // 2 % FOLDS


def test_too_few_moves_are_refused_with_their_number(problem: Linearisation) -> None:
    enough = np.minimum(np.arange(CLUSTERS), MIN_MOVES_TO_LEAVE_OUT - 1)
    folds = cut_into_folds(problem, enough)
    assert folds.moves == MIN_MOVES_TO_LEAVE_OUT
    few = np.minimum(np.arange(CLUSTERS), MIN_MOVES_TO_LEAVE_OUT - 2)
    number = str(MIN_MOVES_TO_LEAVE_OUT - 1)
    with pytest.raises(TooFewMoves, match=number):
        cut_into_folds(problem, few)


@pytest.mark.parametrize("count", [1, 2, MOST_SUMMED, MOST_SUMMED + 1])
def test_products_over_blocks_are_the_same_for_few_columns_and_many(
    folds: Folds, count: int
) -> None:
    own = folds.motors[1]
    rng = np.random.default_rng(2)
    columns = rng.normal(size=(2, count, own.equations.shape[1]))
    edges = [*own.starts.tolist(), columns.shape[-1]]
    found = own.grams(columns)
    assert found.shape == (len(own.starts), 2, count, count)
    for block, product in enumerate(found):
        part = columns[..., edges[block] : edges[block + 1]]
        expected = part @ np.swapaxes(part, -1, -2)
        assert_allclose(product, expected, atol=1e-12)


def test_a_best_fit_leaves_nothing_along_its_columns(problem: Linearisation) -> None:
    around, step = problem.fitted()
    rows = dense(problem)
    expected = np.linalg.lstsq(rows, problem.residual, rcond=None)[0]
    assert_allclose(step, expected, atol=1e-6)
    left = problem.residual - rows @ expected
    assert_allclose(around.residual, left, atol=1e-6)


def test_torque_columns_are_whitened_on_the_rows_of_every_motor_that_needs_them(
    problem: Linearisation,
) -> None:
    rng = np.random.default_rng(3)
    torque_nm = rng.normal(size=(3, TORQUE_COLUMNS, SAMPLES))
    found = problem.whitened(torque_nm, TO_MOTOR)
    for row, motor in enumerate(problem.motor):
        # γ (T τ)/σ of the row's motor.
        source = problem.source[row]
        torque = TO_MOTOR[motor] @ torque_nm[:, :, source]
        expected = torque * problem.gamma[motor] / problem.noise[motor]
        assert_allclose(found[row], expected)
    of_second_joint = np.zeros_like(torque_nm)
    of_second_joint[1] = torque_nm[1]
    motors = problem.columns_by_motor(of_second_joint, TO_MOTOR)
    assert set(motors) == {1}


def test_rows_of_a_motor_and_clusters_are_counted(problem: Linearisation) -> None:
    assert problem.cluster_count == CLUSTERS
    assert problem.rows_of(1) == slice(SAMPLES, 2 * SAMPLES - 6)
    assert problem.effective_rows(1) == SAMPLES - 6
    per_row = np.zeros(SAMPLES, dtype=np.int64)
    per_row[problem.source] = 10 * problem.cluster
    of_clusters = problem.of_clusters(per_row)
    assert of_clusters.tolist() == [10 * number for number in range(CLUSTERS)]


def test_errors_that_a_run_shares_are_taken_out_and_put_back(problem: Linearisation) -> None:
    rng = np.random.default_rng(5)
    deviations = rng.normal(size=(3, 1, SAMPLES))
    run = np.arange(SAMPLES) % 2
    beside = problem.decorrelated_from_runs(deviations, np.eye(3), run)
    rows = dense(problem)
    whitened = problem.whitened(deviations, np.eye(3))
    for motor in range(3):
        own = problem.rows_of(motor)
        of_run = run[problem.source[own]]
        deviation = whitened[own, 0]
        covariance = np.eye(len(deviation))
        for number in (0, 1):
            shared = deviation * (of_run == number)
            covariance += np.outer(shared, shared)
        values, vectors = np.linalg.eigh(covariance)
        root = (vectors / np.sqrt(values)) @ vectors.T
        assert_allclose(dense(beside)[own], root @ rows[own], atol=1e-9)
        assert_allclose(beside.residual[own], root @ problem.residual[own], atol=1e-9)
        given = rng.normal(size=len(problem.motor))
        decorrelated = beside.decorrelated(given)
        correlated = beside.correlated(given)
        assert_allclose(decorrelated[own], root @ given[own], atol=1e-9)
        assert_allclose(correlated[own], covariance @ given[own], atol=1e-9)
    assert problem.decorrelated(given) is given
    assert problem.correlated(given) is given


def test_candidates_are_decorrelated_together_as_each_alone(problem: Linearisation) -> None:
    rng = np.random.default_rng(6)
    deviations = rng.normal(size=(3, 1, SAMPLES))
    run = np.arange(SAMPLES) % 2
    beside = problem.decorrelated_from_runs(deviations, np.eye(3), run)
    scatter = beside.scatter
    assert scatter is not None
    rows_of_first = np.count_nonzero(problem.motor == 0)
    rows_of_last = np.count_nonzero(problem.motor == 2)
    on_one_motor = {0: rng.normal(size=(2, rows_of_first))}
    on_none = dict[int, FloatArray]()
    on_two_motors = {
        0: rng.normal(size=(1, rows_of_first)),
        2: rng.normal(size=(3, rows_of_last)),
    }
    each = [on_one_motor, on_none, on_two_motors]
    found = beside.decorrelated_by_motor(each)
    assert [set(one) for one in found] == [{0}, set(), {0, 2}]
    for one, by_motor in zip(found, each, strict=True):
        for motor, columns in by_motor.items():
            alone = scatter.decorrelate(motor, columns)
            assert_allclose(one[motor], alone, atol=1e-12)


def test_the_estimates_factor_is_of_rows_that_share_no_errors(problem: Linearisation) -> None:
    rng = np.random.default_rng(7)
    deviations = rng.normal(size=(3, 1, SAMPLES))
    run = np.arange(SAMPLES) % 2
    beside = problem.decorrelated_from_runs(deviations, np.eye(3), run)
    folds = cut_into_folds(beside)
    lower = np.tril(folds.estimate_factor[0])
    rows = dense(problem)
    assert_allclose(lower @ lower.T, rows.T @ rows, rtol=1e-4, atol=1e-3)


def test_preload_mixes_the_torques_of_all_joints_row_by_row(problem: Linearisation) -> None:
    rng = np.random.default_rng(8)
    transform = rng.normal(size=(SAMPLES, 3, 3))
    mixed = replace(problem, transform=transform)
    torque_nm = rng.normal(size=(3, TORQUE_COLUMNS, SAMPLES))
    found = mixed.whitened(torque_nm, TO_MOTOR)
    last_row = len(problem.motor) - 1
    for row in (0, SAMPLES + 3, last_row):
        source = problem.source[row]
        of_motor = transform[source, problem.motor[row]]
        expected = of_motor @ torque_nm[:, :, source]
        assert_allclose(found[row], expected)
    rows = mixed.rows_of(2)
    diagonal = transform[problem.source[rows], 2, 2]
    assert mixed.effective_rows(2) == pytest.approx(diagonal.sum() * 0.2 / 1.5)
