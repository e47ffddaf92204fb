"""The Jacobian against finite differences of the residual."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy import signal

from ident.data.run import Run
from ident.discovery.evidence import Evidence, gather
from ident.equations.linearisation import (
    MIN_MOVES_TO_LEAVE_OUT,
    Jacobian,
    Linearisation,
    _sums_of_motors,
    independent_blocks,
    jackknife_covariance,
    left_out_shifts,
    linearise,
    motor_jacobian,
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

    def problem(
        step: np.ndarray[tuple[int], np.dtype[np.float64]],
    ) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return linearise(
            start.training, gains + step[:6], parameters + step[6:], noise, gains_fixed=False
        ).residual

    around = linearise(start.training, gains, parameters, noise, gains_fixed=False)
    rng = np.random.default_rng(0)
    for _ in range(3):
        scaled = 1e-6 * rng.normal(size=len(around.free))
        step = np.zeros(6 + len(parameters))
        step[around.free] = scaled * around.scale
        slope = (problem(step) - problem(-step)) / 2.0
        assert_allclose(
            -slope, around.jacobian @ scaled, rtol=0.0, atol=1e-4 * np.max(np.abs(slope))
        )


def test_a_jacobian_in_parts_is_the_whole_one() -> None:
    """Products, some of its columns, and all of them; each motor holds unknowns of its own."""
    rng = np.random.default_rng(7)
    seen = (np.array([0, 2, 3, 4]), np.array([1, 4]), np.array([], dtype=np.int64))
    parts = tuple(
        rng.normal(size=(len(held), rows)) for held, rows in zip(seen, (6, 9, 3), strict=True)
    )
    jacobian = Jacobian(parts, seen, 5)
    whole = np.zeros((18, 5))
    whole[:6, seen[0]], whole[6:15, seen[1]] = parts[0].T, parts[1].T
    step = rng.normal(size=5)
    columns = rng.normal(size=(18, 2))
    assert jacobian @ step == pytest.approx(whole @ step)
    assert jacobian.on_columns(columns) == pytest.approx(whole.T @ columns)
    assert jacobian.on_columns(columns[:, 0]) == pytest.approx(whole.T @ columns[:, 0])
    chosen = np.array([1, 3, 4])
    assert np.array_equal(jacobian.columns(chosen), whole[:, chosen])
    assert jacobian.only(chosen) @ step[chosen] == pytest.approx(whole[:, chosen] @ step[chosen])


def _lines(motor: list[int], cluster: list[int], source: list[int]) -> Linearisation:
    """Rows of two motors without any unknown."""
    rows = len(motor)
    nothing = np.zeros((0, rows))
    return Linearisation(
        jacobian=Jacobian((nothing,), (np.zeros(0, dtype=np.int64),), 0),
        residual=np.zeros(rows),
        current=np.ones(rows),
        motor=np.array(motor),
        cluster=np.array(cluster),
        source=np.array(source),
        gamma=np.array([0.5, 0.2]),
        noise=np.array([0.1, 0.3]),
        free=np.zeros(0, dtype=np.int64),
        scale=np.zeros(0),
    )


def test_clusters_and_rows_of_a_motor_are_counted_over_all_motors() -> None:
    # Motor 1 has no row in cluster 2, and motor 2 none in cluster 0.
    lines = _lines(motor=[0, 0, 0, 1, 1], cluster=[0, 0, 1, 1, 2], source=[0, 2, 4, 5, 7])
    assert lines.cluster_count == 3
    run_of_row = np.array([3, 3, 3, 3, 8, 8, 8, 9])
    assert lines.of_clusters(run_of_row).tolist() == [3, 8, 9]
    assert [lines.rows_of(motor) for motor in (0, 1)] == [slice(0, 3), slice(3, 5)]
    assert [lines.shown(motor) for motor in (0, 1)] == [3.0, 2.0]


def test_what_internal_preload_hides_is_not_shown() -> None:
    # T_D = P D⁻¹ with D the diagonal of σ/γ: P_ii is 1/2 for both motors of one joint.
    lines = _lines(motor=[0, 0, 1], cluster=[0, 0, 0], source=[0, 1, 1])
    projection = np.full((2, 2), 0.5)
    per_row = projection / (lines.noise / lines.gamma)
    lines = replace(lines, transform=np.stack((per_row, per_row)))
    assert lines.shown(0) == pytest.approx(1.0)
    assert lines.shown(1) == pytest.approx(0.5)


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
    shifts = left_out_shifts(grams, np.einsum("mri,mr->mi", jacobian, around))
    for cluster, shift in enumerate(shifts):
        kept = np.arange(10) != cluster
        without = np.linalg.lstsq(
            jacobian[kept].reshape(-1, 4), residual[kept].ravel(), rcond=None
        )[0]
        assert shift == pytest.approx(
            without - estimate, rel=1e-6, abs=1e-9 * np.abs(estimate).max()
        )


def test_a_direction_that_one_cluster_alone_has_seen_stays() -> None:
    grams = np.stack([np.diag([1.0, 1.0]), *(np.diag([1.0, 0.0]) for _ in range(3))])
    scores = np.array([[0.3, 0.0], [-0.1, 0.0], [-0.1, 0.0], [-0.1, 0.0]])
    assert left_out_shifts(grams, scores) == pytest.approx(-scores / 3.0)


def test_the_triangle_of_rows_has_their_jacobian(truth: Truth) -> None:
    rng = np.random.default_rng(5)
    rows = rng.normal(size=(40, 7))
    parameters = rng.normal(size=5)
    noise = rng.uniform(0.1, 1.0, 6)
    products = []
    for part in (rows, np.asarray(np.linalg.qr(rows, mode="r"))):
        jacobian, residual = motor_jacobian(part, 2, truth.gains, parameters, noise)
        products.append(np.column_stack((jacobian.T @ jacobian, jacobian.T @ residual)))
    assert products[0] == pytest.approx(products[1], abs=1e-10 * np.abs(products[0]).max())


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
    grams, scores = _sums_of_motors(system, recorded, *around)
    size = grams.shape[-1]
    for index, cluster in enumerate(system.clusters):
        gram = np.zeros((size, size))
        score = np.zeros(size)
        for motor, rows in enumerate(cluster):
            jacobian, _ = motor_jacobian(rows, motor, *around)
            own_rows = recorded.clusters[index][motor]
            _, residual = motor_jacobian(own_rows, motor, *around)
            gram += jacobian.T @ jacobian
            score += jacobian.T @ residual
        assert grams[index] == pytest.approx(gram, rel=1e-9, abs=1e-9 * np.abs(gram).max())
        assert scores[index] == pytest.approx(score, rel=1e-9, abs=1e-9 * np.abs(score).max())


FloatArray = NDArray[np.float64]


def _slow_line(
    rng: np.random.Generator, correlation_rows: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Six slow columns fitted to noise alone:
    the estimate, and G and s of 120 clusters of 50 rows.
    """
    rows = np.arange(6000)
    turns = rng.uniform(1e-3, 2.5e-2, 5)
    phase = rng.uniform(0.0, 6.0, 5)
    jacobian = np.column_stack((np.ones(len(rows)), np.sin(np.outer(rows, turns) + phase)))
    keep = np.exp(-1.0 / correlation_rows) if correlation_rows else 0.0
    noise = signal.lfilter(
        [np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(len(rows) + 1000)
    )[1000:]
    estimate = np.linalg.lstsq(jacobian, noise, rcond=None)[0]
    parts = jacobian.reshape(-1, 50, 6)
    left = (noise - jacobian @ estimate).reshape(-1, 50)
    return estimate, np.einsum("mri,mrj->mij", parts, parts), np.einsum("mri,mr->mi", parts, left)


def _std(grams: FloatArray, scores: FloatArray) -> FloatArray:
    shifts = left_out_shifts(grams, scores)
    blocks = len(grams)
    return np.asarray(
        np.sqrt((blocks - 1) / blocks * np.sum((shifts - shifts.mean(axis=0)) ** 2, axis=0))
    )


def test_clusters_with_independent_noise_stay_as_they_are() -> None:
    runs = np.repeat([0, 1, 2], 40)
    kept = 0
    for seed in range(20):
        _, grams, scores = _slow_line(np.random.default_rng(seed), 0.0)
        kept += len(independent_blocks(grams, scores, runs)) == len(grams)
    assert kept >= 19


def test_clusters_within_one_correlation_time_are_joined_until_sigma_is_true() -> None:
    """A misfit that outlives three clusters:
    plain clusters claim half of the scatter, blocks nearly all of it.
    """
    runs = np.repeat([0, 1], 60)
    plain = []
    joined = []
    for seed in range(60):
        estimate, grams, scores = _slow_line(np.random.default_rng(seed), 150.0)
        starts = independent_blocks(grams, scores, runs)
        assert len(starts) >= MIN_MOVES_TO_LEAVE_OUT
        assert {0, 60} <= set(starts)
        plain.append(estimate / _std(grams, scores))
        joined.append(
            estimate / _std(np.add.reduceat(grams, starts), np.add.reduceat(scores, starts))
        )
    assert np.sqrt(np.mean(np.square(plain))) > 1.6
    assert np.sqrt(np.mean(np.square(joined))) < 1.3


def test_clusters_of_different_runs_are_never_joined() -> None:
    _, grams, scores = _slow_line(np.random.default_rng(1), 150.0)
    assert len(independent_blocks(grams, scores, np.arange(len(grams)))) == len(grams)


def test_one_move_fewer_than_can_be_left_out_is_refused_with_their_number(noisy: Evidence) -> None:
    system = noisy.training.system()
    few = replace(system, clusters=system.clusters[: MIN_MOVES_TO_LEAVE_OUT - 1])
    estimate = noisy.estimate
    with pytest.raises(TooFewMoves, match=f"{MIN_MOVES_TO_LEAVE_OUT - 1}"):
        jackknife_covariance(
            few, estimate.gains, estimate.parameters, estimate.axis_noise, gains_fixed=False
        )
