"""Changes and drifts: what is noise is called noise as often as is said,
and what is none is found.
"""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest, norm

from ident.drift import change as change_module
from ident.drift.change import (
    CHART,
    DISPERSION,
    Alarm,
    AlarmKind,
    Chart,
    Pattern,
    change_significance,
    cusum,
    cusum_paths,
    decide,
    dispersions,
    pattern,
)
from tests.studies.drift_study import (
    AXES,
    RECALIBRATIONS,
    delays,
    draw,
    false_alarms,
    most_percent,
    share_percent,
)

NAMES = tuple(f"J{number}" for number in range(1, AXES + 1))
GAINS = np.array([33.9, 32.4, 24.2, -9.21, 16.3, 6.79])
_gains = st.floats(0.1, 1e3) | st.floats(-1e3, -0.1)


def test_constants_of_the_normal_distribution_are_those_of_scipy() -> None:
    cut = change_module._CUT
    expected = norm.expect(lambda z: np.minimum(z**2, cut**2))
    assert pytest.approx(expected, rel=1e-9) == change_module._MEAN_OF_CUT
    assert pytest.approx(norm.ppf(0.75), rel=1e-15) == change_module._MEDIAN_OF_NORMAL
    sigmas = [change_significance(0.0, 0.6, x, 0.8, dispersion=1.0) for x in (0.1, 2.0, 30.0)]
    expected_p = 2.0 * norm.sf([0.1, 2.0, 30.0])
    probabilities = [change.probability for change in sigmas]
    assert probabilities == pytest.approx(expected_p, rel=1e-12)


def test_a_history_is_judged_without_importing_scipy() -> None:
    code = (
        "import sys, ident.drift.change, ident.drift.change; sys.exit(any(m.startswith('scipy') "
        "for m in sys.modules))"
    )
    completed = subprocess.run([sys.executable, "-c", code], check=False)
    assert completed.returncode == 0


def test_a_probability_far_in_the_tail_has_no_digits() -> None:
    certain, likely = (
        decide(("J1",), [10.0], [0.01], [new], [0.01]).words for new in (12.0, 10.05)
    )
    assert "p < 1e-6 among 1" in certain
    assert "p = 0.0" in likely


def test_one_change_is_the_two_sided_normal_test() -> None:
    change = change_significance(-10.0, 0.03, -9.4, 0.04, dispersion=1.2)
    assert change.percent == pytest.approx(-6.0)
    assert change.sigmas == pytest.approx(-0.6 / (1.2 * 0.05))
    assert change.probability == pytest.approx(2.0 * norm.cdf(-10.0))


@settings(max_examples=100, deadline=None)
@given(_gains, _gains, st.floats(1e-3, 10.0), st.floats(1e-3, 10.0), st.floats(0.5, 2.0))
def test_a_change_does_not_depend_on_unit_nor_sign(
    old: float, new: float, a: float, b: float, factor: float
) -> None:
    one = change_significance(old, a, new, b)
    old_std = factor * a
    new_std = factor * b
    other = change_significance(-factor * old, old_std, -factor * new, new_std)
    assert other.percent == pytest.approx(one.percent, rel=1e-9, abs=1e-9)
    assert other.sigmas == pytest.approx(one.sigmas, rel=1e-9, abs=1e-9)
    back = change_significance(new, b, old, a)
    assert abs(back.sigmas) == pytest.approx(abs(one.sigmas))


def test_what_is_known_exactly_changes_surely_or_not_at_all() -> None:
    probability = change_significance(2.0, 0.0, 2.0, 0.0).probability
    assert probability == 1.0
    assert change_significance(2.0, 0.0, 2.1, 0.0).probability == 0.0
    percent = change_significance(0.0, 0.0, 1.0, 0.1).percent
    assert percent == math.inf
    for wrong in ((math.nan, 0.1, 1.0, 0.1), (1.0, -0.1, 1.0, 0.1), (1.0, 0.1, math.inf, 0.1)):
        with pytest.raises(ValueError, match="expected finite"):
            change_significance(*wrong)


@pytest.mark.parametrize("wrong", [-0.5, math.nan, math.inf])
def test_a_dispersion_that_is_none_is_shown(wrong: float) -> None:
    with pytest.raises(ValueError, match=rf"dispersion ≥ 0, found .* dispersion {wrong}$"):
        change_significance(1.0, 0.1, 1.0, 0.1, dispersion=wrong)


def test_probabilities_of_no_change_are_uniform() -> None:
    rng = np.random.default_rng(1)
    found = [
        change_significance(
            10.0 + 0.04 * a, 0.04, 10.0 + 0.03 * b, 0.03, dispersion=1.0
        ).probability
        for a, b in rng.standard_normal((2000, 2))
    ]
    assert kstest(found, "uniform").pvalue > 0.01


@pytest.mark.parametrize("common", [0.0, 0.9])
def test_a_recalibration_without_change_is_seldom_taken_for_one(common: float) -> None:
    """However the errors of the axes depend on each other."""
    rng = np.random.default_rng(2)
    correlation = np.full((AXES, AXES), common) + (1.0 - common) * np.eye(AXES)
    root = np.linalg.cholesky(correlation)
    std = 0.004 * np.abs(GAINS)
    found = []
    for _ in range(1500):
        old, new = (GAINS + DISPERSION * std * (root @ rng.standard_normal(AXES)) for _ in range(2))
        differs = decide(NAMES, old, std, new, std).differs
        found.append(differs)
    # 1 % asked for; 1500 draws know it to 0.26 %.
    assert np.mean(found) < 0.02


def test_a_recalibration_with_a_change_says_which_and_how_much() -> None:
    std = 0.004 * np.abs(GAINS)
    new = GAINS.copy()
    new[3] *= 0.94
    found = decide(NAMES, GAINS, std, new, std)
    assert found.differs
    percent = found.changes[3].percent
    assert percent == pytest.approx(-6.0)
    assert found.adjusted[3] == min(found.adjusted) < 1e-6
    assert found.words.startswith("changed by more than noise: J4 -6 % (10.")
    assert "J3" not in found.words
    same = decide(NAMES, GAINS, std, GAINS, std)
    assert not same.differs
    assert same.words.startswith("no gain has changed by more than noise")


def test_nothing_to_compare_changes_nothing() -> None:
    differs = decide((), [], [], [], []).differs
    assert not differs


@settings(max_examples=50, deadline=None)
@given(st.floats(0.1, 10.0), st.integers(0, 30), st.booleans())
def test_scatter_is_measured_in_any_unit_and_never_below_one(
    unit: float, count: int, mirrored: bool
) -> None:
    rng = np.random.default_rng(count)
    values, stds = draw(rng, (AXES, count + 1), 1.0)
    found = dispersions(values, stds)
    sign = -1.0 if mirrored else 1.0
    assert found.shape == (AXES,)
    assert (found >= 1.0).all()
    np.testing.assert_allclose(
        dispersions(sign * unit * values + 7.0, unit * stds), found, rtol=1e-6
    )


@pytest.mark.parametrize("true", [1.0, 1.5, 3.0])
def test_scatter_is_found_from_history(true: float) -> None:
    rng = np.random.default_rng(3)
    values, stds = draw(rng, (400, AXES, 60), true)
    found = dispersions(values, stds)
    assert float(np.median(found)) == pytest.approx(true, rel=0.08)


def test_neither_a_step_nor_a_slow_drift_is_scatter() -> None:
    rng = np.random.default_rng(4)
    values, stds = draw(rng, (400, AXES, 30), 1.0)
    plain = float(np.median(dispersions(values, stds)[:, 0]))
    step = values.copy()
    slope = values.copy()
    step[:, 0, 15:] += 20.0
    slope[:, 0] += 0.3 * np.arange(30)
    for changed in (step, slope):
        assert float(np.median(dispersions(changed, stds)[:, 0])) < plain + 0.05


def test_a_quarter_of_the_differences_may_be_of_any_size() -> None:
    rng = np.random.default_rng(10)
    values, stds = draw(rng, (400, AXES, 25), 1.0)
    plain = float(np.median(dispersions(values, stds)))
    found = []
    for size in (1e3, 1e9):
        far = values.copy()
        far[..., 4:19:6] += size  # three calibrations off, six differences of 24
        found.append(float(np.median(dispersions(far, stds))))
    assert found[0] < 2.2 * plain
    assert found[1] == pytest.approx(found[0], rel=1e-3)


def test_scatter_is_known_better_than_by_the_median() -> None:
    """A thousand differences outweigh the prior;
    the median is worth little more than a third of them.
    """
    rng = np.random.default_rng(11)
    values, stds = draw(rng, (300, 1, 1001), 1.5)
    away = np.abs(np.diff(values)) / np.hypot(stds[..., 1:], stds[..., :-1])
    median_away = np.median(away, axis=-1)
    by_median = median_away / norm.ppf(0.75)
    assert np.std(dispersions(values, stds)) < 0.85 * np.std(by_median)


def test_few_calibrations_say_nothing_of_scatter() -> None:
    stds = np.ones((2, 3))
    expected = [DISPERSION] * 2
    np.testing.assert_array_equal(dispersions(np.ones((2, 3)), stds), expected)


def test_the_sums_are_pages() -> None:
    """By hand: baseline exact, k = 0.5, deviations of 2, 2, -3 σ."""
    values = np.array([0.0, 2.0, 2.0, -3.0]) + 100.0
    stds = np.ones(4)
    stds[0] = 1e-9
    chart = Chart(reference=0.5, baseline=1)
    found = cusum_paths(values, stds, 1.0, chart)
    expected = [0.0, 2.0, 2.0, -3.0]
    np.testing.assert_allclose(found[0], expected)
    np.testing.assert_allclose(found[1], [0.0, 1.5, 3.0, 0.0])
    np.testing.assert_allclose(found[2], [0.0, 0.0, 0.0, 2.5])


def test_deviations_within_the_baseline_are_independent_and_normal() -> None:
    """Hawkins' recursive residuals: exactly standard normal,
    with the baseline's uncertainty counted.
    """
    rng = np.random.default_rng(5)
    values = rng.standard_normal((20_000, CHART.baseline))
    stds = np.ones_like(values)
    deviations = cusum_paths(values, stds, 1.0, CHART)[0][:, 1:]
    pvalue = kstest(deviations.ravel(), "norm").pvalue
    assert pvalue > 0.01
    correlation = np.corrcoef(deviations.T)
    identity = np.eye(CHART.baseline - 1)
    correlation_difference = correlation - identity
    assert np.abs(correlation_difference).max() < 0.03


def test_a_step_is_reported_with_its_size_its_time_and_its_side() -> None:
    values = np.r_[np.full(14, -10.0), np.full(6, -9.4)]
    stds = np.full(20, 0.04)
    found = cusum(values, stds)
    assert found.alarmed
    assert found.onset == 13
    assert not found.alarms[-1].rose
    assert found.change_percent == pytest.approx(-6.0)
    assert found.change_sigmas == pytest.approx(
        -0.6 / (DISPERSION * 0.04 * math.sqrt(1 / 3 + 1 / 12))
    )
    assert found.baseline == pytest.approx(-10.0)
    assert found.alarms[0].index == 14
    assert found.alarms[0].kind is AlarmKind.DRIFT  # 14 σ at once are beyond both limits


@pytest.mark.parametrize(("count", "newest"), [(15, 1), (16, 2), (17, 3), (18, 3)])
def test_a_step_has_its_whole_size_from_the_first_day_on(count: int, newest: int) -> None:
    """Calibrations before the onset are no part of the change after it."""
    values = np.r_[np.full(14, 10.0), np.full(count - 14, 9.4)]
    stds = np.full(count, 0.04)
    found = cusum(values, stds)
    assert found.alarmed
    assert found.onset == 13
    assert found.change_percent == pytest.approx(-6.0)
    assert found.change_sigmas == pytest.approx(
        -0.6 / (DISPERSION * 0.04 * math.sqrt(1 / newest + 1 / 12))
    )


def test_a_change_within_the_baseline_is_compared_with_what_was_before() -> None:
    values = np.r_[np.full(5, 10.0), np.full(4, 10.6)]
    stds = np.full(9, 0.04)
    found = cusum(values, stds)
    assert found.onset == 4
    assert found.change_percent == pytest.approx(6.0)
    assert found.alarms[-1].rose


def test_one_calibration_far_off_is_a_jump() -> None:
    values = np.full(15, 10.0)
    values[14] = 10.0 + 0.04 * DISPERSION * 5.8
    stds = np.full(15, 0.04)
    found = cusum(values, stds)
    assert [alarm.kind for alarm in found.alarms] == [AlarmKind.JUMP]
    calm = cusum(np.r_[values, 10.0, 10.0], np.full(17, 0.04))
    assert calm.alarms == found.alarms
    assert not calm.alarmed
    expected = (found.alarms[0], None)
    assert (found.alarm, calm.alarm) == expected


def test_an_alarm_that_has_passed_changes_nothing_of_what_is_reported() -> None:
    """After a jump on the fourth day: twelve calibrations are the baseline again,
    that one among them.
    """
    values = np.full(20, 10.0)
    values[3] = 10.0 + 0.04 * DISPERSION * 6.5
    stds = np.full(4, 0.04)
    onset = cusum(values[:4], stds).onset
    assert onset == 2
    found = cusum(values, np.full(20, 0.04))
    assert [alarm.index for alarm in found.alarms] == [3]
    expected = (False, None, None, False)
    assert (found.alarmed, found.alarm, found.onset, found.steady) == expected
    assert found.baseline == pytest.approx(values[:12].mean())
    assert found.baseline_std == pytest.approx(DISPERSION * 0.04 / math.sqrt(12))
    assert found.change_percent == pytest.approx(100.0 * (10.0 / values[:12].mean() - 1.0))


def test_a_slope_that_has_ended_is_not_reported_along_its_line() -> None:
    """It rises by 0.7 σ a calibration for eight of them, and is back where it was."""
    values = 10.0 * (1.0 + 0.0028 * np.r_[np.arange(8), np.zeros(8)])
    stds = np.full(8, 0.04)
    assert cusum(values[:8], stds).steady
    found = cusum(values, np.full(16, 0.04))
    last_alarm = found.alarms[-1]
    assert last_alarm.kind is AlarmKind.TREND
    expected = (False, None, None, False)
    assert (found.alarmed, found.alarm, found.onset, found.steady) == expected
    assert found.baseline == pytest.approx(values[:12].mean())
    assert found.change_percent == pytest.approx(100.0 * (10.0 / values[:12].mean() - 1.0))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.sampled_from([10.0, 10.0, 10.05, 9.95, 10.6, 9.4]), min_size=2, max_size=30))
def test_an_onset_is_reported_in_alarm_only(values: list[float]) -> None:
    stds = np.full(len(values), 0.04)
    found = cusum(values, stds)
    assert found.alarmed == (found.onset is not None) == (found.alarm is not None)
    if not found.alarmed:
        assert not found.steady
        smallest = min(len(values) - 1, CHART.baseline)
        assert found.baseline == pytest.approx(np.mean(values[:smallest]))


def test_one_calibration_is_its_own_baseline() -> None:
    found = cusum([5.0], [0.1])
    expected = (5.0, (), None, 0.0)
    assert (found.baseline, found.alarms, found.onset, found.change_percent) == expected


@pytest.mark.parametrize(
    ("values", "stds"),
    [([], []), ([1.0], [1.0, 2.0]), ([1.0], [0.0]), ([math.nan], [1.0]), ([0.0, 0.0], [1.0, 1.0])],
)
def test_what_cannot_be_watched_is_refused(values: list[float], stds: list[float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        cusum(values, stds)


@pytest.mark.parametrize(
    ("values", "stds"),
    [
        ([1e300] * 6, [1e-300] * 6),
        ([1e300, 1.1e300] * 3, [1e-300] * 6),
        ([1e-300] * 6, [1e300] * 6),
        ([5e-324] * 6, [1.0] * 6),
        ([1.0] * 6, [5e-324] * 6),
        ([1e300, 1.0, 1.0, 1.0, 1.0, 1.0], [1e-3] * 6),
        ([1.0] * 6, [1e300, 0.01, 0.01, 0.01, 0.01, 0.01]),
        ([1.0] * 6, [1e-15, 1e-10, 1e-5, 1.0, 1e5, 1e10]),
        ([1.0] * 6, [1e10, 1e5, 1.0, 1e-5, 1e-10, 1e-15]),
    ],
)
def test_numbers_of_any_size_are_watched(values: list[float], stds: list[float]) -> None:
    """As a file that was made by hand may have them; a warning of numpy would be an error here."""
    (factor,) = dispersions([values], [stds])
    found = cusum(values, stds, dispersion=float(factor))
    numbers = [found.baseline, found.change_percent, found.change_sigmas]
    assert all(
        map(math.isfinite, [*numbers, *found.deviations, *found.upper, *found.lower, *found.trend])
    )
    words = decide(("J1",), values[:1], stds[:1], values[1:2], stds[1:2]).words
    assert len(words) < 120


def test_one_sigma_of_any_size_leaves_the_others_their_say() -> None:
    values = np.r_[np.full(14, 10.0), np.full(6, 9.4)]
    plain = cusum(values, np.full(20, 0.04))
    for far in (1e-300, 1e300):
        stds = np.full(20, 0.04)
        stds[3] = far
        assert cusum(values, stds).onset == plain.onset


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(st.floats(5.0, 15.0), st.floats(0.01, 1.0)), min_size=1, max_size=30),
    st.floats(0.01, 100.0),
    st.booleans(),
)
def test_a_drift_does_not_depend_on_unit_nor_sign(
    points: list[tuple[float, float]], unit: float, mirrored: bool
) -> None:
    values, stds = np.array(points).T
    one = cusum(values, stds)
    other = cusum((-unit if mirrored else unit) * values, unit * stds)
    np.testing.assert_allclose(other.upper, one.upper, atol=1e-6)
    np.testing.assert_allclose(other.lower, one.lower, atol=1e-6)
    np.testing.assert_allclose(other.trend, one.trend, atol=1e-6)
    expected = [alarm.kind for alarm in one.alarms]
    assert [alarm.kind for alarm in other.alarms] == expected
    assert other.change_percent == pytest.approx(one.change_percent, abs=1e-6)


def test_a_slope_is_reported_along_its_line() -> None:
    """0.7 σ a calibration from the first one on:
    the CUSUM's baseline goes with it, the line does not.
    """
    values = -10.0 * (1.0 - 0.0028 * np.arange(8))
    stds = np.full(8, 0.04)
    found = cusum(values, stds)
    assert found.steady
    assert found.alarmed
    expected = Alarm(7, AlarmKind.TREND, rose=False)
    assert found.alarms[-1] == expected
    assert found.onset == 0
    assert found.baseline == pytest.approx(-10.0)
    assert found.change_percent == pytest.approx(-1.96)
    assert found.change_sigmas == pytest.approx(found.trend[-1])
    middle, spread = 3.5, 42.0  # of 0 … 7: mean, and sum of squares about it
    assert found.trend[-1] == pytest.approx(-0.7 * math.sqrt(spread) / DISPERSION)
    assert found.baseline_std == pytest.approx(
        DISPERSION * 0.04 * math.sqrt(1 / 8 + middle**2 / spread)
    )


@pytest.mark.slow
def test_no_alarm_in_24_recalibrations_without_drift() -> None:
    """1.1 % of the histories of six axes at most; 3000 draws know that to 0.2 %.

    One draw by itself has none.
    """
    rng = np.random.default_rng(6)
    shares = false_alarms(rng, 3000, dispersion=1.05)
    assert shares.any <= 1.5
    assert max(shares.cusum, shares.trend) <= 1.1
    assert shares.single <= 0.3
    assert false_alarms(np.random.default_rng(7), 1, dispersion=1.05).any == 0.0
    assert RECALIBRATIONS == 24


@pytest.mark.slow
@pytest.mark.parametrize(
    ("std_percent", "within_two", "within_four"),
    [(0.2, 98, 99), (0.3, 93, 99), (0.5, 85, 98), (0.8, 91, 97), (1, 86, 94)],
)
def test_three_per_cent_over_twelve_recalibrations_is_found_by_the_sums(
    std_percent: float, within_two: float, within_four: float
) -> None:
    """Shares of histories in which it is found at most two, and four,
    recalibrations after it has reached 3 σ [%].
    """
    rng = np.random.default_rng(8)
    found = delays(rng, 800, std_percent=std_percent, before=12)
    assert share_percent(found.cusum, 2) >= within_two
    assert share_percent(found.cusum, 4) >= within_four
    assert (found.any <= found.cusum).all()


@pytest.mark.parametrize(
    ("std_percent", "within_two"), [(0.2, 57), (0.3, 36), (0.5, 23), (0.8, 35), (1, 28)]
)
def test_a_drift_from_the_first_day_is_found_by_the_line_sooner_than_by_the_sums(
    std_percent: float, within_two: float
) -> None:
    """No test can find them all: what the best one finds that knows the day is no more than
    `most_percent`.
    """
    rng = np.random.default_rng(9)
    found = delays(rng, 800, std_percent=std_percent, before=1)
    share = share_percent(found.any, 2)
    assert share >= within_two
    assert share > share_percent(found.cusum, 2) + 10
    assert share < most_percent(std_percent=std_percent, before=1, false_percent=1.1) < 98


def test_patterns() -> None:
    std = np.full(6, 0.4)
    one = np.array([0.1, -0.2, 0.3, -6.0, 0.2, 0.0])
    alarmed = [False] * 6
    change_percent = np.zeros(6)
    assert pattern(change_percent, std, alarmed) is Pattern.NONE
    assert pattern(one, std, [False, False, False, True, False, False]) is Pattern.ONE
    several = np.array([0.1, -5.0, 0.3, -6.0, 0.2, 0.0])
    assert pattern(several, std, np.abs(several) > 4) is Pattern.SEVERAL
    common = -3.0 + np.array([0.1, -0.2, 0.3, -0.4, 0.2, 0.0])
    assert pattern(common, std, [True, True, False, True, True, False]) is Pattern.COMMON
    assert pattern(common, std, [False] * 6) is Pattern.NONE
