"""Significance of changed gains: one change against its noise, all changes of a recalibration,
and the pattern of many.

Recordings of different days are independent, so σ of a difference is the root of the sum of
squares. But σ of a single fit covers one session: repeated sessions scatter more (friction warms
up, magnets too). Every function here therefore takes a *dispersion*, the ratio of the scatter of
repeated calibrations to their σ; `dispersions` estimates it from a history.

Control chart of one gain over many calibrations: CUSUM, single points, and the line through all of
them.

With zᵢ the deviation of calibration i from the baseline over its σ (Page 1954; Montgomery,
Introduction to Statistical Quality Control, ch. 9)::

    C⁺ᵢ = max(0, C⁺ᵢ₋₁ + zᵢ − k),   C⁻ᵢ = max(0, C⁻ᵢ₋₁ − zᵢ − k),   alarm where either exceeds h

The baseline is the weighted mean of the first calibrations, up to `Chart.baseline` of them; while
there are fewer, of all that came before (Hawkins 1987), so that the zᵢ are independent and the
chart watches from the second one on. The baseline's own uncertainty is part of the σ of zᵢ.

A drift during the first calibrations becomes part of the baseline. The slope of the straight line
through all calibrations needs no baseline: with gᵢ the gain of calibration i = 1 … n and wᵢ = 1/σᵢ²
(weighted least squares; Draper & Smith, Applied Regression Analysis, ch. 9)::

    t = Σ wᵢ (i − ī) gᵢ / √(Σ wᵢ (i − ī)²),    ī = Σ wᵢ i / Σ wᵢ

is standard normal without drift for every n. Of all tests that do not know the level, |t| is the
most powerful against a drift from the first calibration to the last. It is worse than the CUSUM at
a late change, because all the calibrations before it pull at the line too; so neither replaces the
other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import compress

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import FloatArray

#: That is written with its digits: further out no distribution of errors is known
LEAST_PROBABILITY = 1e-6

#: Default without a history: repeated fits of simulated cells scatter 5 % more than their σ
DISPERSION = 1.05
FALSE_ALARM = 0.01
"""Share of comparisons without any change in which a gain is said to change by more than noise,
over all axes.
"""

#: Weight of the prior in the pooled estimate, in numbers of successive differences
_POOLED_WEIGHT = 10.0
_AXIS_WEIGHT = 30.0  #: Weight of the pooled estimate in that of an axis, likewise
_MIN_DIFFERENCES = 4
#: Differences count up to so many of their σ (Huber); somewhat less than a third of them may be of
#: any size
_CUT = 1.5
_FARTHEST = 1e100  #: Limit of a difference over its σ, so that its square is still a number
_MEAN_OF_CUT = (
    1.0
    + (_CUT**2 - 1.0) * math.erfc(_CUT / math.sqrt(2.0))
    - _CUT * math.sqrt(2.0 / math.pi) * math.exp(-(_CUT**2) / 2.0)
)
"""E min(Z², c²) of a standard normal Z."""
_MEDIAN_OF_NORMAL = 0.6744897501960817  #: Median of |Z|, the upper quartile of a standard normal Z
_STEPS = 20
"""Each brings the scale nearer to its end by a factor of two and more,
unless more than a tenth are outliers.
"""
#: Changes are not one common factor if noise makes them so different in fewer cases than this
_UNLIKE = 0.01
_COMMON_SIGMAS = 4.0


@dataclass(frozen=True, slots=True)
class Change:
    """Change of one gain."""

    #: of the compared gain's magnitude [%], inf from zero; negative where the gain has decreased
    percent: float
    sigmas: float  #: the change over its σ, signed as `percent`
    probability: float  #: of so large a change by noise alone, two-sided


@dataclass(frozen=True, slots=True)
class ChangeDecision:
    """Whether a recalibration differs from the current gains."""

    differs: bool  #: at least one gain has changed by more than noise
    axes: tuple[str, ...]  #: names, as they were given
    changes: tuple[Change, ...]  #: one an axis
    #: Probability of each axis' change among all of them (Holm 1979, valid however their errors
    #: depend).
    adjusted: tuple[float, ...]
    significant: tuple[bool, ...]  #: whether each axis' change is more than noise
    words: str  #: the same in one sentence


class Pattern(Enum):
    """Pattern of the changes of all gains."""

    NONE = "none"
    ONE = "one axis"
    COMMON = "all axes by the same factor"
    SEVERAL = "several axes"


def change_significance(
    old: float, old_std: float, new: float, new_std: float, *, dispersion: float = DISPERSION
) -> Change:
    """Compute the significance of one change between independent recordings with normal errors.

    Args:
        old, old_std, new, new_std: gains and their σ in one unit; σ is 0 for a value known exactly.
        dispersion: scatter of repeated calibrations over their σ.

    Raises:
        ValueError: a number is not finite, or a σ or the dispersion negative.
    """
    numbers = np.array([old, old_std, new, new_std, dispersion])
    are_finite = np.isfinite(numbers).all()
    has_negative = np.min([old_std, new_std, dispersion]) < 0
    if has_negative or not are_finite:
        raise ValueError(
            f"expected finite gains, σ ≥ 0 and dispersion ≥ 0, found {old} ± {old_std}, {new} ± "
            f"{new_std} and dispersion {dispersion}"
        )
    sign = 1.0
    if old < 0.0:
        sign = -1.0
    change = float((new - old) * sign)
    change_std = dispersion * math.hypot(old_std, new_std)
    sigmas = _ratio(change, change_std)
    return Change(
        percent=100.0 * _ratio(change, abs(old)),
        sigmas=sigmas,
        probability=math.erfc(abs(sigmas) / math.sqrt(2.0)),
    )


def decide(
    axes: tuple[str, ...],
    old: ArrayLike,
    old_std: ArrayLike,
    new: ArrayLike,
    new_std: ArrayLike,
    *,
    dispersion: ArrayLike = DISPERSION,
) -> ChangeDecision:
    """Decide whether a recalibration changes anything, over all axes together.

    Of recalibrations without change, one is found in a share of FALSE_ALARM at most.

    Each axis is tested by itself against its own σ, and the probabilities are corrected for the
    number of axes, however their errors depend on each other. There is no fixed threshold in per
    cent.

    Args:
        axes: n names.
        old, old_std, new, new_std: gains in force and found, with their σ, shape (n,) each, in one
            unit an axis.
        dispersion: scatter of repeated calibrations over their σ, a number or shape (n,).

    Raises:
        ValueError: shapes do not fit, a number is not finite, or a σ or a dispersion is negative.
    """
    count = len(axes)
    olds = _one_an_axis(old, count)
    old_stds = _one_an_axis(old_std, count)
    news = _one_an_axis(new, count)
    new_stds = _one_an_axis(new_std, count)
    factors = _one_an_axis(dispersion, count)
    changes: list[Change] = []
    for axis in range(count):
        change = change_significance(
            olds[axis], old_stds[axis], news[axis], new_stds[axis], dispersion=factors[axis]
        )
        changes.append(change)
    adjusted = _adjusted([change.probability for change in changes])
    significant = tuple(probability <= FALSE_ALARM for probability in adjusted)
    return ChangeDecision(
        differs=any(significant),
        axes=axes,
        changes=tuple(changes),
        adjusted=adjusted,
        significant=significant,
        words=_decision_words(axes, changes, adjusted, significant),
    )


def _one_an_axis(values: ArrayLike, count: int) -> list[float]:
    """Numbers of so many axes, of which one may be given for all."""
    numbers = np.broadcast_to(np.asarray(values, float), (count,))
    return [float(number) for number in numbers]


def _adjusted(probabilities: Sequence[float]) -> tuple[float, ...]:
    """Holm: the smallest probability counts times their number, the next times one less,
    never falling.
    """
    given = np.array(probabilities)
    count = len(given)
    order = np.argsort(given)
    multiplied = given[order] * np.arange(count, 0, -1)
    bounded = np.minimum(1.0, multiplied)
    adjusted = np.empty(count)
    adjusted[order] = np.maximum.accumulate(bounded)
    return tuple(float(probability) for probability in adjusted)


def _decision_words(
    axes: Sequence[str],
    changes: Sequence[Change],
    adjusted: Sequence[float],
    significant: Sequence[bool],
) -> str:
    """Describe a decision in one sentence."""
    if not axes:
        return "no gain to compare"
    count = len(axes)
    parts: list[str] = []
    for axis, change, probability in zip(axes, changes, adjusted, strict=True):
        sigmas = _short(abs(change.sigmas))
        parts.append(
            f"{axis} {change.percent:+.2g} % ({sigmas} σ, {_probability(probability)} "
            f"among {count})"
        )
    if any(significant):
        changed = ", ".join(compress(parts, significant))
        return f"changed by more than noise: {changed}"
    sizes = [abs(change.sigmas) for change in changes]
    largest = parts[int(np.argmax(sizes))]
    return f"no gain has changed by more than noise: the largest change is {largest}"


def dispersions(values: ArrayLike, stds: ArrayLike) -> FloatArray:
    """Estimate how much more repeated calibrations scatter than their σ, for each axis;
    never less than 1.

    From differences of successive calibrations, so that a slow drift adds little; each counts up to
    1.5 of their σ (Huber 1964, proposal 2), so that a sudden change adds little too. The estimate
    of an axis is drawn towards that of all axes, and that towards DISPERSION, by weights in numbers
    of differences (as a scaled inverse-χ² prior).

    Args:
        values, stds: shape (..., axes, n), oldest first; leading dimensions are separate histories.

    Returns:
        shape (..., axes).
    """
    values = np.asarray(values, float)
    stds = np.asarray(stds, float)
    count = values.shape[-1] - 1
    if count < _MIN_DIFFERENCES:
        return np.full(values.shape[:-1], DISPERSION)
    # Differences not about their own centre: the centre of few differences is too near to them.
    half_differences = np.abs(np.diff(values / 2.0))
    with np.errstate(over="ignore"):
        difference_stds = np.hypot(stds[..., 1:], stds[..., :-1])
        in_sigmas = 2.0 * (half_differences / difference_stds)
    squares = np.minimum(in_sigmas, _FARTHEST) ** 2
    of_axis = _robust_variance(squares)
    of_all_axes = _robust_variance(squares.reshape(*squares.shape[:-2], -1))
    total = count * values.shape[-2]
    pooled = _weighted_mean(DISPERSION**2, _POOLED_WEIGHT, of_all_axes, total)
    variance = _weighted_mean(pooled[..., None], _AXIS_WEIGHT, of_axis, count)
    return np.asarray(np.sqrt(np.maximum(variance, 1.0)))


def _weighted_mean(
    prior: FloatArray | float, prior_weight: float, found: FloatArray, weight: int
) -> FloatArray:
    """Mean of a prior and of what was found."""
    total = prior_weight * prior + weight * found
    return np.asarray(total / (prior_weight + weight))


def pattern(change_percent: ArrayLike, std_percent: ArrayLike, alarmed: ArrayLike) -> Pattern:
    """Classify the changes of all gains together.

    They have one common factor where at least two raise an alarm, the weighted mean c̄ of all
    changes is significant, and Σ ((c − c̄)/σ)² is no larger than χ² with n − 1 degrees of freedom
    makes plausible.

    Args:
        change_percent, std_percent: of each axis since its baseline, with σ > 0 [%], shape (n,).
        alarmed: which of them raise an alarm, shape (n,).
    """
    changes = np.asarray(change_percent, float)
    stds = np.asarray(std_percent, float)
    alarm_count = int(np.count_nonzero(alarmed))
    if alarm_count == 0:
        return Pattern.NONE
    if alarm_count == 1:
        return Pattern.ONE
    from scipy.special import chdtrc  # noqa: PLC0415 - half of the start-up of `history`, which seldom needs it

    weights = 1.0 / stds**2
    total = weights.sum()
    mean = float(weights @ changes / total)
    square_sum = float(weights @ (changes - mean) ** 2)
    probability = chdtrc(len(changes) - 1, square_sum)
    mean_sigmas = abs(mean) * total**0.5
    if probability > _UNLIKE and mean_sigmas > _COMMON_SIGMAS:
        return Pattern.COMMON
    return Pattern.SEVERAL


def _robust_variance(squares: FloatArray) -> FloatArray:
    """Solve mean(min(x², c² s)) = s E min(Z², c²) for s along the last axis,
    starting from the median.
    """
    variance = np.median(squares, axis=-1) / _MEDIAN_OF_NORMAL**2
    for _ in range(_STEPS):
        largest = _CUT**2 * variance[..., None]
        variance = np.minimum(squares, largest).mean(axis=-1) / _MEAN_OF_CUT
    return np.asarray(variance)


def _ratio(change: float, size: float) -> float:
    """Quotient; infinite for a change of a value known exactly, 0 without a change."""
    if size:
        return change / size
    if change:
        return math.copysign(math.inf, change)
    return 0.0


def _probability(p: float) -> str:
    """A probability in words; far in the tail of a distribution its digits mean nothing."""
    if p < LEAST_PROBABILITY:
        return f"p < {LEAST_PROBABILITY:.0e}".replace("e-0", "e-")
    return f"p = {p:.2g}"


def _short(sigmas: float) -> str:
    """Format a number in a few digits, however large."""
    if sigmas < 1e4:
        return f"{sigmas:.1f}"
    return f"{sigmas:.1e}"


#: Calibrations of the first line that is tested; through fewer it is hardly more than one
#: difference
FEWEST = 4
#: Calibrations that the size of a change is averaged over: enough to reduce noise, few enough to be
#: recent
_RECENT = 3
_FINEST = 2.0**-52  #: Smallest σ of the largest gain over itself: no number is written finer
_LARGEST_FACTOR = 1e3  #: Between a σ and the median one: beyond, a weight is all or nothing anyway


@dataclass(frozen=True, slots=True)
class Chart:
    """Limits of the chart; the defaults come from `make drift-study`,
    docs/evidence/drift.md has its table.
    """

    reference: float = 1.25  #: k [σ]: half the shift that is to be found soonest
    threshold: float = 4.6  #: h [σ]: sum that raises an alarm
    single: float = 5.2  #: deviation of one calibration that is an alarm by itself [σ]
    trend: float = 4.3  #: slope of the line through all calibrations that is an alarm [its σ]
    baseline: int = 12  #: number of calibrations that make it


CHART = Chart()


class AlarmKind(Enum):
    """Rule that raised an alarm."""

    DRIFT = "drift"  #: Small deviations to one side have added up (CUSUM)
    JUMP = "jump"  #: One calibration is far off by itself (Shewhart)
    TREND = "trend"  #: All calibrations lie about a line that rises or falls


@dataclass(frozen=True, slots=True)
class Alarm:
    """One calibration with an alarm."""

    index: int  #: of the calibration, from 0
    kind: AlarmKind  #: the first rule that applies, in the order of `AlarmKind`
    rose: bool  #: whether the gain's magnitude rose


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """Change of one gain since its baseline began."""

    #: Reference of the newest calibrations, in the unit of the gains: the chart's baseline, up to
    #: the onset while there is an alarm; while that is a trend, the beginning of the line.
    baseline: float
    baseline_std: float  #: its σ
    #: Z of each calibration, shape (n,), positive where the magnitude is larger; 0 for the first.
    deviations: FloatArray
    upper: FloatArray  #: C⁺, shape (n,)
    lower: FloatArray  #: C⁻, shape (n,)
    #: T of the line through each calibration and all before it, shape (n,), positive where the
    #: magnitude rises.
    trend: FloatArray
    #: In the order of the calibrations, also those that have passed; nothing else here depends on
    #: these.
    alarms: tuple[Alarm, ...]
    #: Index of the last calibration before the change that `alarm` reports, the first calibration
    #: for a trend; None where the newest calibration raises no alarm.
    onset: int | None
    #: Since the baseline: mean of the newest calibrations (three, or those since the onset, without
    #: alarm those after the baseline, if fewer); while there is a trend, along the line [% of the
    #: baseline's magnitude].
    change_percent: float
    change_sigmas: float  #: the same over its σ

    @property
    def alarm(self) -> Alarm | None:
        """Alarm of the newest calibration; None where it raises none, whatever earlier ones did."""
        return _present(self.alarms, len(self.deviations))

    @property
    def alarmed(self) -> bool:
        """Whether the newest calibration raises an alarm."""
        return self.alarm is not None

    @property
    def steady(self) -> bool:
        """Whether the change is given along the line."""
        return self.alarm is not None and self.alarm.kind is AlarmKind.TREND


def cusum(values: ArrayLike, stds: ArrayLike, *, dispersion: float = DISPERSION) -> Drift:
    """Watch one gain.

    Args:
        values, stds: of its calibrations since the last acknowledged change, oldest first, shape
            (n,), n ≥ 1, in one unit; σ > 0.
        dispersion: scatter of repeated calibrations over their σ, as
            `ident.drift.change.dispersions` finds it.

    Raises:
        ValueError: shapes do not fit, a number is not finite, a σ is not positive, or the baseline
            is zero.
    """
    values = np.asarray(values, float)
    stds = np.asarray(stds, float)
    if values.ndim != 1 or values.shape != stds.shape or not len(values):
        raise ValueError(
            f"expected as many values as σ, at least one, found shapes {values.shape} "
            f"and {stds.shape}"
        )
    are_finite = np.isfinite(values).all() and np.isfinite(stds).all()
    if not (are_finite and (stds > 0).all()):
        raise ValueError("expected finite gains with σ > 0")
    scale = float(np.abs(values).max())
    if scale == 0:
        raise ValueError("expected gains other than zero")
    values = values / scale
    stds = _bounded(stds, scale)
    sign = -1.0
    if values.sum() > 0:
        sign = 1.0
    magnitudes = sign * values
    deviations, upper, lower = cusum_paths(magnitudes, stds, dispersion, CHART)
    slopes = trend_statistic(magnitudes, stds, dispersion)
    alarms = _alarms(deviations, upper, lower, slopes)
    # The onset of an alarm that has passed bounds no baseline: that change is over.
    present = _present(alarms, len(values))
    onset = None
    if present is None:
        since = _change_since_baseline(values, stds, onset)
    elif present.kind is AlarmKind.TREND:
        onset = 0
        since = _change_along_line(values, stds)
    else:
        path = lower
        if present.rose:
            path = upper
        # Where the sum that has the alarm was zero for the last time (Page's estimate of the change
        # point).
        zeros = np.flatnonzero(path[: present.index + 1] == 0.0)
        onset = int(zeros[-1])
        since = _change_since_baseline(values, stds, onset)
    if since.baseline == 0:
        raise ValueError("expected gains other than zero")
    return Drift(
        baseline=scale * since.baseline,
        baseline_std=dispersion * scale * since.baseline_std,
        deviations=deviations,
        upper=upper,
        lower=lower,
        trend=slopes,
        alarms=alarms,
        onset=onset,
        change_percent=100.0 * sign * since.change / abs(since.baseline),
        change_sigmas=sign * since.change / (dispersion * since.change_std),
    )


def _alarms(
    deviations: FloatArray, upper: FloatArray, lower: FloatArray, slopes: FloatArray
) -> tuple[Alarm, ...]:
    """Alarms of all calibrations, in their order; each by the first rule that applies."""
    alarms: list[Alarm] = []
    for index, (z, above, below, slope) in enumerate(
        zip(deviations, upper, lower, slopes, strict=True)
    ):
        if max(above, below) > CHART.threshold:
            alarms.append(Alarm(index, AlarmKind.DRIFT, bool(above > below)))
        elif abs(z) > CHART.single:
            alarms.append(Alarm(index, AlarmKind.JUMP, bool(z > 0)))
        elif abs(slope) > CHART.trend:
            alarms.append(Alarm(index, AlarmKind.TREND, bool(slope > 0)))
    return tuple(alarms)


@dataclass(frozen=True, slots=True)
class _ChangeSinceBaseline:
    """Baseline of a gain and its change since, with their σ, in one unit."""

    baseline: float
    baseline_std: float
    change: float
    change_std: float


def _change_along_line(values: FloatArray, stds: FloatArray) -> _ChangeSinceBaseline:
    """Change along the line through all calibrations."""
    line = fit_line(values, stds)
    steps = len(values) - 1
    return _ChangeSinceBaseline(
        baseline=line.start,
        baseline_std=line.start_std,
        change=steps * line.slope,
        change_std=steps * line.slope_std,
    )


def _change_since_baseline(
    values: FloatArray, stds: FloatArray, onset: int | None
) -> _ChangeSinceBaseline:
    """Change of the newest calibrations; the baseline ends at the onset,
    and the newest begin after both.
    """
    count = len(values)
    most = count - 1
    if onset is not None:
        most = onset + 1
    baseline_count = max(1, min(most, CHART.baseline))
    behind = baseline_count
    if onset is not None:
        behind = max(baseline_count, onset + 1)
    newest = max(1, min(_RECENT, count - behind))
    baseline, baseline_std = _mean(values[:baseline_count], stds[:baseline_count])
    recent, recent_std = _mean(values[-newest:], stds[-newest:])
    change = 0.0
    if count > 1:
        change = recent - baseline
    return _ChangeSinceBaseline(
        baseline, baseline_std, change, math.hypot(recent_std, baseline_std)
    )


def cusum_paths(
    values: FloatArray, stds: FloatArray, dispersion: FloatArray | float, chart: Chart
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute the chart's z, C⁺ and C⁻, shape (..., n) each, for any number of gains at once.

    Args:
        values, stds: magnitudes, shape (..., n), oldest first.
        dispersion: shape (...) or a number.
        chart: limits.
    """
    weights = np.cumsum(1.0 / stds**2, axis=-1)
    means = np.cumsum(values / stds**2, axis=-1) / weights
    deviations = np.zeros(values.shape)
    upper = np.zeros(values.shape)
    lower = np.zeros(values.shape)
    for i in range(1, values.shape[-1]):
        last = min(i, chart.baseline) - 1
        baseline_variance = 1.0 / weights[..., last]
        variance = stds[..., i] ** 2 + baseline_variance
        std = dispersion * np.sqrt(variance)
        z = (values[..., i] - means[..., last]) / std
        # C⁺ + z − k and C⁻ − z − k, never below zero
        above = upper[..., i - 1] + z - chart.reference
        below = lower[..., i - 1] - z - chart.reference
        deviations[..., i] = z
        upper[..., i] = np.maximum(0.0, above)
        lower[..., i] = np.maximum(0.0, below)
    return deviations, upper, lower


def trend_statistic(
    values: FloatArray, stds: FloatArray, dispersion: FloatArray | float
) -> FloatArray:
    """Compute t of the line through the first n calibrations,
    for every n and any number of gains at once.

    Args:
        values, stds: magnitudes, shape (..., n), oldest first, σ > 0.
        dispersion: scatter of repeated calibrations over their σ, shape (...) or a number.

    Returns:
        shape (..., n), positive where the magnitude rises; 0 for the first FEWEST − 1.
    """
    statistic = np.zeros(values.shape)
    zeros = np.zeros(values.shape[:-1])
    total = zeros  # Σ w
    mean_index = zeros  # ī
    mean = zeros  # ḡ
    index_square = zeros  # Σ w (i − ī)²
    product = zeros  # Σ w (i − ī) (g − ḡ)
    # About running means (West 1979): differences of large sums lose their digits where one σ is
    # far below the others.
    for i in range(values.shape[-1]):
        value = values[..., i]
        weight = 1.0 / stds[..., i] ** 2
        total = total + weight
        distance = i - mean_index
        mean_index = mean_index + weight / total * distance
        mean = mean + weight / total * (value - mean)
        index_square = index_square + weight * distance * (i - mean_index)
        product = product + weight * distance * (value - mean)
        if i + 1 >= FEWEST:
            statistic[..., i] = product / np.sqrt(index_square) / dispersion
    return statistic


@dataclass(frozen=True, slots=True)
class GainTrend:
    """Line through all calibrations of one gain."""

    start: float  #: value at the first calibration [unit of the gain]
    start_std: float  #: its σ
    slope: float  #: slope in that unit a calibration
    slope_std: float  #: its σ


def fit_line(values: FloatArray, stds: FloatArray) -> GainTrend:
    """Fit a line by weighted least squares to values of shape (n,), n ≥ 2, oldest first, σ > 0."""
    weights = 1.0 / stds**2
    total = float(weights.sum())
    indices = np.arange(len(values))
    mean_index = float(weights @ indices) / total
    mean = float(weights @ values) / total
    distances = indices - mean_index
    square_sum = float(weights @ distances**2)
    product = float(weights @ (distances * (values - mean)))
    slope = product / square_sum
    start_variance = 1.0 / total + mean_index**2 / square_sum
    return GainTrend(
        start=mean - slope * mean_index,
        start_std=math.sqrt(start_variance),
        slope=slope,
        slope_std=1.0 / math.sqrt(square_sum),
    )


def _bounded(stds: FloatArray, scale: float) -> FloatArray:
    """σ over the scale of the gains, such that no weight 1/σ² overflows, vanishes,
    or leaves nothing of the others.
    """
    with np.errstate(over="ignore"):
        relative = np.clip(stds / scale, _FINEST, 1.0 / _FINEST)
    middle = float(np.median(relative))
    smallest = middle / _LARGEST_FACTOR
    largest = middle * _LARGEST_FACTOR
    return np.asarray(np.clip(relative, smallest, largest))


def _mean(values: FloatArray, stds: FloatArray) -> tuple[float, float]:
    """Mean weighted by 1/σ², and its σ."""
    weights = 1.0 / stds**2
    total = float(weights.sum())
    mean = float(weights @ values) / total
    return mean, math.sqrt(1.0 / total)


def _present(alarms: tuple[Alarm, ...], count: int) -> Alarm | None:
    """Alarm of the newest of `count` calibrations."""
    if not alarms:
        return None
    last = alarms[-1]
    if last.index == count - 1:
        return last
    return None
