"""The Jacobian against finite differences of the residual."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import signal

from ident.arrays import FloatArray
from ident.data.run import Run
from ident.discovery.evidence import Evidence, gather
from ident.equations.linearisation import (
    MIN_MOVES_TO_LEAVE_OUT,
    Jacobian,
    Linearisation,
    independent_blocks,
    jackknife_covariance,
    left_out_shifts,
    linearise,
    motor_jacobian,
    sums_of_motors,
)
from ident.errors import TooFewMoves
from ident.estimators.estimate import Identification
from tests.ident.recordings import Truth


def test_jacobian_is_the_slope_of_the_residual(
    clean_found: Identification, clean_runs: tuple[Run, ...]
) -> None:
    start = gather(clean_found, clean_runs)
    gains = start.estimate.gains
    parameters = start.estimate.parameters
    noise = np.full(6, 0.1)

    def residual_after(step: FloatArray) -> FloatArray:
        changed_gains = gains + step[:6]
        changed_parameters = parameters + step[6:]
        changed = linearise(
            start.training, changed_gains, changed_parameters, noise, gains_fixed=False
        )
        return changed.residual

    around = linearise(start.training, gains, parameters, noise, gains_fixed=False)
    rng = np.random.default_rng(0)
    for _ in range(3):
        scaled = 1e-6 * rng.normal(size=len(around.free))
        step = np.zeros(6 + len(parameters))
        step[around.free] = scaled * around.scale
        slope = (residual_after(step) - residual_after(-step)) / 2.0
        expected = around.jacobian @ scaled
        tolerance = 1e-4 * np.max(np.abs(slope))
        assert_allclose(-slope, expected, rtol=0.0, atol=tolerance)


def test_a_jacobian_in_parts_is_the_whole_one() -> None:
    """Products, some of its columns, and all of them; each motor holds unknowns of its own."""
    rng = np.random.default_rng(7)
    first_seen = np.array([0, 2, 3, 4])
    second_seen = np.array([1, 4])
    third_seen = np.array([], dtype=np.int64)
    first_part = rng.normal(size=(4, 6))
    second_part = rng.normal(size=(2, 9))
    third_part = rng.normal(size=(0, 3))
    parts = (first_part, second_part, third_part)
    seen = (first_seen, second_seen, third_seen)
    jacobian = Jacobian(parts, seen, 5)
    whole = np.zeros((18, 5))
    whole[:6, first_seen] = first_part.T
    whole[6:15, second_seen] = second_part.T
    step = rng.normal(size=5)
    columns = rng.normal(size=(18, 2))
    assert jacobian @ step == pytest.approx(whole @ step)
    assert jacobian.on_columns(columns) == pytest.approx(whole.T @ columns)
    one_column = columns[:, 0]
    assert jacobian.on_columns(one_column) == pytest.approx(whole.T @ one_column)
    chosen = np.array([1, 3, 4])
    chosen_columns = whole[:, chosen]
    chosen_step = step[chosen]
    assert np.array_equal(jacobian.columns(chosen), chosen_columns)
    assert jacobian.only(chosen) @ chosen_step == pytest.approx(chosen_columns @ chosen_step)


def _lines(motor: list[int], cluster: list[int], source: list[int]) -> Linearisation:
    """Rows of two motors without any unknown."""
    rows = len(motor)
    part = np.zeros((0, rows))
    no_unknown = np.zeros(0, dtype=np.int64)
    gamma = np.array([0.5, 0.2])
    noise = np.array([0.1, 0.3])
    return Linearisation(
        jacobian=Jacobian((part,), (no_unknown,), 0),
        residual=np.zeros(rows),
        current=np.ones(rows),
        motor=np.array(motor),
        cluster=np.array(cluster),
        source=np.array(source),
        gamma=gamma,
        noise=noise,
        free=no_unknown,
        scale=np.zeros(0),
    )


def test_clusters_and_rows_of_a_motor_are_counted_over_all_motors() -> None:
    # Motor 1 has no row in cluster 2, and motor 2 none in cluster 0.
    lines = _lines(motor=[0, 0, 0, 1, 1], cluster=[0, 0, 1, 1, 2], source=[0, 2, 4, 5, 7])
    assert lines.cluster_count == 3
    run_of_row = np.array([3, 3, 3, 3, 8, 8, 8, 9])
    run_of_cluster = lines.of_clusters(run_of_row)
    assert run_of_cluster.tolist() == [3, 8, 9]
    assert lines.rows_of(0) == slice(0, 3)
    assert lines.rows_of(1) == slice(3, 5)
    assert lines.effective_rows(0) == 3.0
    assert lines.effective_rows(1) == 2.0


def test_what_internal_preload_hides_is_not_shown() -> None:
    # T_D = P D⁻¹ with D the diagonal of σ/γ: P_ii is 1/2 for both motors of one joint.
    lines = _lines(motor=[0, 0, 1], cluster=[0, 0, 0], source=[0, 1, 1])
    projection = np.full((2, 2), 0.5)
    per_row = projection / (lines.noise / lines.gamma)
    lines = replace(lines, transform=np.stack((per_row, per_row)))
    assert lines.effective_rows(0) == pytest.approx(1.0)
    assert lines.effective_rows(1) == pytest.approx(0.5)


def test_a_shift_is_that_of_the_fit_without_the_cluster() -> None:
    """By least squares on the rows that are left, in units that differ by a million."""
    rng = np.random.default_rng(3)
    jacobian = rng.normal(size=(10, 12, 4)) * np.array([1e-3, 1.0, 30.0, 1e3])
    residual = rng.normal(size=(10, 12))
    rows = jacobian.reshape(-1, 4)
    whole = residual.ravel()
    estimate = np.linalg.lstsq(rows, whole, rcond=None)[0]
    around = residual - jacobian @ estimate
    grams = np.einsum("mri,mrj->mij", jacobian, jacobian)
    scores = np.einsum("mri,mr->mi", jacobian, around)
    shifts = left_out_shifts(grams, scores)
    tolerance = 1e-9 * np.abs(estimate).max()
    for cluster, shift in enumerate(shifts):
        others = np.arange(10) != cluster
        other_rows = jacobian[others].reshape(-1, 4)
        other_residual = residual[others].ravel()
        without = np.linalg.lstsq(other_rows, other_residual, rcond=None)[0]
        assert shift == pytest.approx(without - estimate, rel=1e-6, abs=tolerance)


def test_a_direction_that_one_cluster_alone_has_seen_stays() -> None:
    both = np.diag([1.0, 1.0])
    first_only = np.diag([1.0, 0.0])
    grams = np.stack([both, first_only, first_only, first_only])
    scores = np.array([[0.3, 0.0], [-0.1, 0.0], [-0.1, 0.0], [-0.1, 0.0]])
    assert left_out_shifts(grams, scores) == pytest.approx(-scores / 3.0)


def test_the_triangle_of_rows_has_their_jacobian(truth: Truth) -> None:
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(40, 7))
    parameters = rng.normal(size=5)
    noise = rng.uniform(0.1, 1.0, 6)
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))

    def normal_equations(part: FloatArray) -> FloatArray:
        jacobian, residual = motor_jacobian(part, 2, truth.gains, parameters, noise)
        gram = jacobian.T @ jacobian
        score = jacobian.T @ residual
        return np.column_stack((gram, score))

    of_rows = normal_equations(rows)
    of_triangle = normal_equations(triangle)
    tolerance = 1e-10 * np.abs(of_rows).max()
    assert of_rows == pytest.approx(of_triangle, abs=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("has_instruments", [False, True])
def test_sums_of_clusters_are_those_of_each_clusters_own_rows(
    noisy: Evidence, has_instruments: bool
) -> None:
    recorded = noisy.training.system()
    system = recorded
    if has_instruments:  # other rows for J than for e
        tilted = []
        for cluster in recorded.clusters:
            tilted.append(tuple(rows * 1.01 for rows in cluster))
        system = replace(recorded, clusters=tuple(tilted))
    estimate = noisy.estimate
    around = (estimate.gains, estimate.parameters, estimate.axis_noise)
    grams, scores, left = sums_of_motors(system, recorded, *around)
    size = grams.shape[-1]
    squares = 0.0
    for index, cluster in enumerate(system.clusters):
        gram = np.zeros((size, size))
        score = np.zeros(size)
        for motor, rows in enumerate(cluster):
            jacobian, _ = motor_jacobian(rows, motor, *around)
            own_rows = recorded.clusters[index][motor]
            _, residual = motor_jacobian(own_rows, motor, *around)
            gram += jacobian.T @ jacobian
            score += jacobian.T @ residual
            squares += float(residual @ residual)
        largest_product = np.abs(gram).max()
        largest_score = np.abs(score).max()
        assert grams[index] == pytest.approx(gram, rel=1e-9, abs=1e-9 * largest_product)
        assert scores[index] == pytest.approx(score, rel=1e-9, abs=1e-9 * largest_score)
    assert left == pytest.approx(squares, rel=1e-9)


def _slow_line(
    rng: np.random.Generator, correlation_rows: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Six slow columns fitted to noise alone:
    the estimate, and G and s of 120 clusters of 50 rows.
    """
    rows = np.arange(6000)
    turns = rng.uniform(1e-3, 2.5e-2, 5)
    phase = rng.uniform(0.0, 6.0, 5)
    angles = np.outer(rows, turns) + phase
    jacobian = np.column_stack((np.ones(len(rows)), np.sin(angles)))
    keep = np.exp(-1.0 / correlation_rows) if correlation_rows else 0.0
    settling_rows = 1000
    white = rng.standard_normal(len(rows) + settling_rows)
    new_share = np.sqrt(1.0 - keep**2)
    correlated = signal.lfilter([new_share], [1.0, -keep], white)
    noise = correlated[settling_rows:]
    estimate = np.linalg.lstsq(jacobian, noise, rcond=None)[0]
    residual = noise - jacobian @ estimate
    parts = jacobian.reshape(-1, 50, 6)
    left = residual.reshape(-1, 50)
    grams = np.einsum("mri,mrj->mij", parts, parts)
    scores = np.einsum("mri,mr->mi", parts, left)
    return estimate, grams, scores


def _std(grams: FloatArray, scores: FloatArray) -> FloatArray:
    shifts = left_out_shifts(grams, scores)
    blocks = len(grams)
    deviations = shifts - shifts.mean(axis=0)
    squares = np.sum(deviations**2, axis=0)
    return np.asarray(np.sqrt((blocks - 1) / blocks * squares))


def test_clusters_with_independent_noise_stay_as_they_are() -> None:
    runs = np.repeat([0, 1, 2], 40)
    unjoined = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        _, grams, scores = _slow_line(rng, 0.0)
        blocks = independent_blocks(grams, scores, runs)
        unjoined += len(blocks) == len(grams)
    assert unjoined >= 19


def test_clusters_within_one_correlation_time_are_joined_until_sigma_is_true() -> None:
    """A misfit that outlives three clusters:
    plain clusters claim half of the scatter, blocks nearly all of it.
    """
    runs = np.repeat([0, 1], 60)
    plain = []
    joined = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        estimate, grams, scores = _slow_line(rng, 150.0)
        starts = independent_blocks(grams, scores, runs)
        assert len(starts) >= MIN_MOVES_TO_LEAVE_OUT
        assert {0, 60} <= set(starts)
        plain.append(estimate / _std(grams, scores))
        joined_grams = np.add.reduceat(grams, starts)
        joined_scores = np.add.reduceat(scores, starts)
        joined.append(estimate / _std(joined_grams, joined_scores))
    rms_of_plain = np.sqrt(np.mean(np.square(plain)))
    rms_of_joined = np.sqrt(np.mean(np.square(joined)))
    assert rms_of_plain > 1.6
    assert rms_of_joined < 1.3


def test_clusters_of_different_runs_are_never_joined() -> None:
    rng = np.random.default_rng(1)
    _, grams, scores = _slow_line(rng, 150.0)
    run_of_cluster = np.arange(len(grams))
    blocks = independent_blocks(grams, scores, run_of_cluster)
    assert len(blocks) == len(grams)


def test_one_move_fewer_than_can_be_left_out_is_refused_with_their_number(noisy: Evidence) -> None:
    system = noisy.training.system()
    count = MIN_MOVES_TO_LEAVE_OUT - 1
    few = replace(system, clusters=system.clusters[:count])
    estimate = noisy.estimate
    around = (estimate.gains, estimate.parameters, estimate.axis_noise)
    with pytest.raises(TooFewMoves, match=f"{count}"):
        jackknife_covariance(few, *around, gains_fixed=False)
