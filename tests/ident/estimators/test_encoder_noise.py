"""Correlation of encoders' noise: found from a residual, and in σ of what is fitted."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.estimators.encoder_noise import RunDirections, estimate_noise

FloatArray = NDArray[np.float64]
SAMPLES = 150
TIME_S: FloatArray = np.asarray(0.04 * np.arange(SAMPLES), dtype=np.float64)
DRAWS = 30


def _directions() -> RunDirections:
    """Two motors that hold each other, so that the misfit has one direction, which turns slowly."""
    angle = 0.3 * np.sin(TIME_S)
    cosine_and_sine = np.stack((np.cos(angle), -np.sin(angle)), axis=1)
    basis = cosine_and_sine[:, :, None]
    return RunDirections(TIME_S, basis)


def _noise(rng: np.random.Generator, correlation_s: float) -> FloatArray:
    """Noise of both motors with σ = 1 in that direction, half of its variance white, shape (k,)."""
    time_difference_s = TIME_S[:, None] - TIME_S[None, :]
    decay = np.exp(-np.abs(time_difference_s) / correlation_s)
    root = np.linalg.cholesky(decay + 1e-12 * np.eye(SAMPLES))
    slow = root @ rng.standard_normal((SAMPLES, 2))
    white = rng.standard_normal((SAMPLES, 2))
    both = np.sqrt(0.5) * (slow + white)
    return np.asarray(np.einsum("km,km->k", _directions().basis[:, :, 0], both))


@pytest.mark.slow
@pytest.mark.parametrize("correlation_s", [1e-6, 0.1, 0.5])
def test_an_estimate_with_white_rows_has_its_own_deviation(correlation_s: float) -> None:
    slow_columns = np.stack(
        [np.sin(0.7 * TIME_S), np.cos(0.7 * TIME_S), np.sin(2.0 * TIME_S)], axis=1
    )
    jacobian = np.concatenate((slow_columns, slow_columns))
    rng = np.random.default_rng(3)
    scaled: list[FloatArray] = []
    for _ in range(DRAWS):
        right = np.concatenate((_noise(rng, correlation_s), _noise(rng, correlation_s)))
        directions = [_directions(), _directions()]
        noise = estimate_noise(directions, jacobian, right)
        rows = np.column_stack((jacobian, right))
        white = noise.white(rows)
        change, square, _, _ = np.linalg.lstsq(white[:, :3], white[:, 3], rcond=None)
        variance = square[0] / (2 * SAMPLES - 3)
        inverse = np.linalg.inv(white[:, :3].T @ white[:, :3])
        covariance = variance * inverse
        covariance_diagonal_root = np.sqrt(np.diag(covariance))
        scaled.append(change / covariance_diagonal_root)
    mean_squared_scaled = np.mean(np.square(scaled))
    assert 0.8 < np.sqrt(mean_squared_scaled) < 1.2


def test_slow_noise_counts_as_fewer_numbers() -> None:
    rng = np.random.default_rng(1)
    jacobian = np.ones((SAMPLES, 1))
    white = estimate_noise([_directions()], jacobian, rng.standard_normal(SAMPLES))
    slow = estimate_noise([_directions()], jacobian, _noise(rng, 0.5))
    assert white.effective > 0.9 * SAMPLES
    assert slow.effective < 0.6 * SAMPLES
