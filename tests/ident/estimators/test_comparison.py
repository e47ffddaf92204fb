"""Estimators side by side: the same answer without noise,
and only `ml` keeps it under other filters with noise.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.run import Run
from ident.estimators.comparison import (
    CUTOFF_FACTORS,
    ESTIMATORS,
    EstimatorComparison,
    try_estimators,
)
from tests.ident.recordings import CONDITIONING, GAINS, MOUNTED, Truth, record

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]


@pytest.fixture(scope="module")
def noisy(truth: Truth, noisy_runs: tuple[Run, ...]) -> EstimatorComparison:
    return try_estimators(truth.model, lambda: noisy_runs, CONDITIONING)


def _of(comparison: EstimatorComparison, estimator: str) -> FloatArray:
    spread = comparison.spread_percent(estimator)
    assert spread is not None
    return spread


def test_every_estimator_is_tried_under_every_filter_the_declared_ones_first(
    noisy: EstimatorComparison,
) -> None:
    expected = len(ESTIMATORS) * len(CUTOFF_FACTORS)
    assert len(noisy.trials) == expected
    position_cutoff_hz = {trial.position_cutoff_hz for trial in noisy.declared}
    assert position_cutoff_hz == {CONDITIONING.position_cutoff_hz}
    estimators = [trial.estimator for trial in noisy.declared]
    assert estimators == list(ESTIMATORS)


def test_gains_of_ml_depend_less_on_the_filters_than_those_of_tls(
    noisy: EstimatorComparison,
) -> None:
    assert np.mean(_of(noisy, "ml")) < 0.5 * np.mean(_of(noisy, "tls, rows (paper)"))
    assert np.mean(_of(noisy, "tls, rows (paper)")) < 0.2 * np.mean(_of(noisy, "tls, residuals"))


def test_gains_of_tls_depend_on_the_weights_of_the_rows(noisy: EstimatorComparison) -> None:
    errors = {
        trial.estimator: trial.gains / GAINS - 1.0
        for trial in noisy.declared
        if trial.gains is not None
    }
    paper_errors = np.abs(errors["tls, rows (paper)"])
    assert np.max(paper_errors) < 0.01
    residual_errors = np.abs(errors["tls, residuals"])
    assert np.max(residual_errors) > 0.05


def test_without_noise_all_agree(truth: Truth, clean_runs: tuple[Run, ...]) -> None:
    for trial in try_estimators(truth.model, lambda: clean_runs, CONDITIONING).declared:
        assert trial.gains == pytest.approx(GAINS, rel=2e-4)


def test_a_filter_that_the_rate_does_not_allow_fails_alone(truth: Truth) -> None:
    rng = np.random.default_rng(3)
    slow = [
        record(truth, name, rng, payload, noise_a=0.2, rate_hz=500.0, averaged=3)
        for name, payload in (("bare", None), ("loaded", MOUNTED))
    ]
    found = try_estimators(truth.model, lambda: slow, CONDITIONING)
    assert all(trial.gains is not None for trial in found.declared)
    last_trial = found.trials[-1]
    assert "needs more than 200 Hz" in last_trial.reason
    assert found.spread_percent("ml") is None
