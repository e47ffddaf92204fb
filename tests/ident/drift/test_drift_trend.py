"""The line through a history: its t is normal without drift, known by formula with one,
and the same in any unit.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import kstest

from ident.drift.change import FEWEST, fit_line, trend_statistic

_points = st.lists(
    st.tuples(st.floats(5.0, 15.0), st.floats(0.01, 1.0)), min_size=FEWEST, max_size=30
)


def _t(values: NDArray[np.float64], stds: NDArray[np.float64]) -> float:
    """By numpy's own weighted fit."""
    slope = np.polyfit(np.arange(len(values)), values, 1, w=1.0 / stds)[0]
    covariance = np.polyfit(np.arange(len(values)), values, 1, w=1.0 / stds, cov="unscaled")[1]
    covariance_root = np.sqrt(covariance[0, 0])
    return float(slope / covariance_root)


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(_points)
def test_each_line_is_that_of_numpy(points: list[tuple[float, float]]) -> None:
    values, stds = np.array(points).T
    found = trend_statistic(values, stds, 1.0)
    np.testing.assert_array_equal(found[: FEWEST - 1], 0.0)
    for count in range(FEWEST, len(values) + 1):
        assert found[count - 1] == pytest.approx(
            _t(values[:count], stds[:count]), rel=1e-6, abs=1e-6
        )
    whole = fit_line(values, stds)
    slope, start = np.polyfit(np.arange(len(values)), values, 1, w=1.0 / stds)
    assert whole.slope == pytest.approx(slope, abs=1e-6)
    assert whole.start == pytest.approx(start, abs=1e-6)
    assert whole.slope / whole.slope_std == pytest.approx(found[-1], abs=1e-6)


@settings(max_examples=100, deadline=None)
@given(_points, st.floats(0.01, 100.0), st.floats(-1e3, 1e3))
def test_it_depends_neither_on_unit_nor_level_and_turns_with_sign_and_time(
    points: list[tuple[float, float]], unit: float, level: float
) -> None:
    values, stds = np.array(points).T
    found = trend_statistic(values, stds, 1.3)
    np.testing.assert_allclose(
        trend_statistic(unit * values + level, unit * stds, 1.3), found, atol=1e-4
    )
    np.testing.assert_allclose(trend_statistic(-values, stds, 1.3), -found, atol=1e-9)
    np.testing.assert_allclose(trend_statistic(values, stds, 2.6), 0.5 * found, atol=1e-9)
    assert trend_statistic(values[::-1], stds[::-1], 1.3)[-1] == pytest.approx(-found[-1], abs=1e-6)


def test_without_drift_t_is_standard_normal_for_every_number_of_calibrations() -> None:
    """With σ that differ tenfold: weights must not make it narrower or wider."""
    rng = np.random.default_rng(1)
    stds = 10.0 ** rng.uniform(-1.0, 0.0, (20_000, 24))
    found = trend_statistic(7.0 + 1.2 * stds * rng.standard_normal(stds.shape), stds, 1.2)
    for count in (FEWEST, 6, 12, 24):
        pvalue = kstest(found[:, count - 1], "norm").pvalue
        assert pvalue > 0.01


def test_with_drift_t_is_normal_about_what_the_slope_says() -> None:
    """Mean slope √Σ(i − ī)² / σ = slope √(n(n² − 1)/12) / σ; power follows."""
    rng = np.random.default_rng(2)
    slope = 0.4
    dispersion = 1.05
    values = slope * np.arange(12) + dispersion * rng.standard_normal((20_000, 12))
    stds = np.ones_like(values)
    found = trend_statistic(values, stds, dispersion)
    for count in (FEWEST, 8, 12):
        expected = slope / dispersion * np.sqrt(count * (count**2 - 1) / 12.0)
        difference = found[:, count - 1] - expected
        assert kstest(difference, "norm").pvalue > 0.01


def test_one_sigma_far_below_the_others_costs_no_digits() -> None:
    """The first calibration exact: the line goes through it, as by hand Σ w i (g − g₁)
    / √(Σ w i²).
    """
    values = np.array([100.0, 101.0, 103.0, 102.0])
    stds = np.array([1e-9, 1.0, 1.0, 1.0])
    assert trend_statistic(values, stds, 1.0)[-1] == pytest.approx(
        (1.0 + 6.0 + 6.0) / np.sqrt(14.0), rel=1e-6
    )


def test_several_gains_at_once_are_each_by_itself() -> None:
    rng = np.random.default_rng(3)
    values = rng.standard_normal((2, 3, 9))
    stds = rng.uniform(0.5, 2.0, (2, 3, 9))
    factors = rng.uniform(1.0, 2.0, (2, 3))
    together = trend_statistic(values, stds, factors)
    for index in np.ndindex(2, 3):
        dispersion = float(factors[index])
        expected = trend_statistic(values[index], stds[index], dispersion)
        np.testing.assert_allclose(together[index], expected)
