"""Estimators side by side: the same answer without noise, and only `ml` keeps it under other filters with noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.run import Run
from ident.estimators.comparison import CUTOFF_FACTORS, ESTIMATORS, Comparison, compare
from tests.ident.recordings import CONDITIONING, GAINS, Truth

FloatArray = NDArray[np.float64]


@pytest.fixture(scope="module")
def noisy(truth: Truth, noisy_runs: tuple[Run, ...]) -> Comparison:
    return compare(truth.model, lambda: noisy_runs, CONDITIONING)


def _of(comparison: Comparison, estimator: str) -> FloatArray:
    spread = comparison.spread_percent(estimator)
    assert spread is not None
    return spread


def test_every_estimator_is_tried_under_every_filter_the_declared_ones_first(noisy: Comparison) -> None:
    assert len(noisy.trials) == len(ESTIMATORS) * len(CUTOFF_FACTORS)
    assert {trial.position_cutoff_hz for trial in noisy.declared} == {CONDITIONING.position_cutoff_hz}
    assert [trial.estimator for trial in noisy.declared] == list(ESTIMATORS)


def test_ml_hangs_on_the_filters_less_than_the_papers_tls_and_tls_on_its_scaling(noisy: Comparison) -> None:
    assert np.mean(_of(noisy, "ml")) < 0.5 * np.mean(_of(noisy, "tls, rows (paper)"))
    gains = {trial.estimator: trial.gains for trial in noisy.declared}
    unscaled, rows = gains["tls, unscaled"], gains["tls, rows (paper)"]
    assert unscaled is not None
    assert rows is not None
    assert np.max(np.abs(unscaled / rows - 1.0)) > 0.002


def test_without_noise_all_agree(truth: Truth, clean_runs: tuple[Run, ...]) -> None:
    for trial in compare(truth.model, lambda: clean_runs, CONDITIONING).declared:
        assert trial.gains == pytest.approx(GAINS, rel=2e-4)


def test_a_filter_that_the_rate_does_not_allow_fails_alone(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    slow = [
        Run(run.name, run.time_s[::6], run.position_rad[::6], run.current_a[::6], run.payload) for run in noisy_runs
    ]
    found = compare(truth.model, lambda: slow, CONDITIONING)
    assert all(trial.gains is not None for trial in found.declared)
    assert "needs more than 200 Hz" in found.trials[-1].reason
    assert found.spread_percent("ml") is None
