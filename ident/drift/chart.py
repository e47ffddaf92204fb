"""A slow drift of one gain over many calibrations: the two-sided tabular CUSUM, with a limit for single points and one
for the line through all of them.

With zᵢ the deviation of calibration i from the baseline over its σ (Page 1954; Montgomery, Introduction to Statistical
Quality Control, ch. 9)::

    C⁺ᵢ = max(0, C⁺ᵢ₋₁ + zᵢ − k),   C⁻ᵢ = max(0, C⁻ᵢ₋₁ − zᵢ − k),   alarm where either exceeds h

The baseline is the weighted mean of the first calibrations, up to `Chart.baseline` of them; while there are fewer, of
all that came before (Hawkins 1987), so that the zᵢ are independent and the chart watches from the second one on. The
baseline's own uncertainty is part of the σ of zᵢ. A drift during the first calibrations becomes part of the baseline in
part; `ident.drift.chart`, which needs none, is what sees more of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ident.drift.change import DISPERSION

# A gain that changes steadily: the slope of the straight line through its calibrations, over the σ of that slope.
#
# With gᵢ the gain of calibration i = 1 … n and wᵢ = 1/σᵢ² (weighted least squares; Draper & Smith, Applied Regression
# Analysis, ch. 9)::
#
#     t = Σ wᵢ (i − ī) gᵢ / √(Σ wᵢ (i − ī)²),    ī = Σ wᵢ i / Σ wᵢ
#
# Without drift t is standard normal for every n. A chart of deviations from a baseline is blind to what happens while
# the
# baseline is made. The line needs none: of all tests that do not know the level, |t| is the most powerful against a
# drift
# that goes on from the first calibration to the last. It is worse than the CUSUM at what comes late, because all the
# calibrations before it pull at the line too; so neither replaces the other.


FEWEST = 4
"""Calibrations of the first line that is looked at; through fewer it is hardly more than one difference."""


@dataclass(frozen=True, slots=True)
class Line:
    """The line through all calibrations of one gain.

    Attributes:
        start, start_std: its value at the first calibration, in the unit of the gain.
        slope, slope_std: in that unit a calibration.
    """

    start: float
    start_std: float
    slope: float
    slope_std: float


def line(values: FloatArray, stds: FloatArray) -> Line:
    """Weighted least squares.

    Args:
        values, stds: shape (n,), n ≥ 2, oldest first, σ > 0.
    """
    weights = 1.0 / stds**2
    total = float(weights.sum())
    places = np.arange(len(values))
    middle, mean = float(weights @ places) / total, float(weights @ values) / total
    spread = float(weights @ (places - middle) ** 2)
    slope = float(weights @ ((places - middle) * (values - mean))) / spread
    start_std = math.sqrt(1.0 / total + middle**2 / spread)
    return Line(mean - slope * middle, start_std, slope, 1.0 / math.sqrt(spread))


def trend(values: FloatArray, stds: FloatArray, dispersion: FloatArray | float) -> FloatArray:
    """t of the line through the first n calibrations, for every n and any number of gains at once.

    Args:
        values, stds: magnitudes, shape (..., n), oldest first, σ > 0.
        dispersion: scatter of repeated calibrations over their σ, shape (...) or a number.

    Returns:
        shape (..., n), positive where the magnitude rises; 0 for the first FEWEST − 1.
    """
    found = np.zeros(values.shape)
    total, middle, mean, spread, product = (np.zeros(values.shape[:-1]) for _ in range(5))
    # About running means (West 1979): differences of large sums lose their digits where one σ is far below the others.
    for i in range(values.shape[-1]):
        weight = 1.0 / stds[..., i] ** 2
        total = total + weight
        away = i - middle
        middle = middle + weight / total * away
        mean = mean + weight / total * (values[..., i] - mean)
        spread = spread + weight * away * (i - middle)
        product = product + weight * away * (values[..., i] - mean)
        if i + 1 >= FEWEST:
            found[..., i] = product / np.sqrt(spread) / dispersion
    return found


FloatArray = NDArray[np.float64]

_RECENT = 3
"""Calibrations that the size of a change is averaged over: enough to tame noise, few enough to be of now."""
_FINEST = 2.0**-52
"""σ of the largest gain over itself: no number is written finer."""
_APART = 1e3
"""How far σ may lie from the middle one, as a factor: beyond, a weight is all or nothing as it is."""


@dataclass(frozen=True, slots=True)
class Chart:
    """What raises an alarm; the defaults come from `make drift-study`, docs/evidence/drift.md has its table.

    Attributes:
        reference: k [σ]: half the shift that is to be found soonest.
        threshold: h [σ]: how much has to add up.
        single: deviation of one calibration that is an alarm by itself [σ].
        trend: slope of the line through all calibrations that is an alarm [its σ].
        baseline: number of calibrations that make it.
    """

    reference: float = 1.25
    threshold: float = 4.6
    single: float = 5.2
    trend: float = 4.3
    baseline: int = 12


CHART = Chart()


class AlarmKind(Enum):
    """What has raised an alarm."""

    DRIFT = "drift"
    """Small deviations to one side have added up (CUSUM)."""
    JUMP = "jump"
    """One calibration is far off by itself (Shewhart)."""
    TREND = "trend"
    """All calibrations lie about a line that rises or falls."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """One calibration with an alarm.

    Attributes:
        index: of the calibration, from 0.
        kind: the first that holds, in the order of `AlarmKind`.
        rose: whether the gain's magnitude rose.
    """

    index: int
    kind: AlarmKind
    rose: bool


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """What became of one gain since its baseline began.

    Attributes:
        baseline, baseline_std: what the newest calibrations are compared with, in the unit of the gains: the chart's
            baseline, up to the onset while there is an alarm; while that is a trend, the beginning of the line.
        deviations: z of each calibration, shape (n,), positive where the magnitude is larger; 0 for the first.
        upper, lower: C⁺ and C⁻, shape (n,).
        trend: t of the line through each calibration and all before it, shape (n,), positive where the magnitude rises.
        alarms: in the order of the calibrations, also those that have passed; nothing else here hangs on these.
        onset: index of the last calibration before the change that `alarm` tells of, the first calibration for a trend;
            None where the newest calibration raises no alarm.
        change_percent: since the baseline: mean of the newest calibrations (three, or those since the onset, without
            alarm those behind the baseline, if fewer); while there is a trend, along the line [% of the baseline's
            magnitude].
        change_sigmas: the same over its σ.
    """

    baseline: float
    baseline_std: float
    deviations: FloatArray
    upper: FloatArray
    lower: FloatArray
    trend: FloatArray
    alarms: tuple[Alarm, ...]
    onset: int | None
    change_percent: float
    change_sigmas: float

    @property
    def alarm(self) -> Alarm | None:
        """Of the newest calibration; None where it raises none, whatever earlier ones did."""
        return _present(self.alarms, len(self.deviations))

    @property
    def alarmed(self) -> bool:
        """Whether the newest calibration raises an alarm."""
        return self.alarm is not None

    @property
    def steady(self) -> bool:
        """Whether the change is told along the line."""
        return self.alarm is not None and self.alarm.kind is AlarmKind.TREND


def cusum(values: ArrayLike, stds: ArrayLike, *, dispersion: float = DISPERSION, chart: Chart = CHART) -> Drift:
    """Watch one gain.

    Args:
        values, stds: of its calibrations since the last change that somebody acknowledged, oldest first, shape (n,),
            n ≥ 1, in one unit; σ > 0.
        dispersion: scatter of repeated calibrations over their σ, as `ident.drift.change.dispersions` finds it.
        chart: limits.

    Raises:
        ValueError: shapes do not fit, a number is not finite, a σ is not positive, or the baseline is zero.
    """
    values, stds = np.asarray(values, float), np.asarray(stds, float)
    if values.ndim != 1 or values.shape != stds.shape or not len(values):
        raise ValueError(f"expected as many values as σ, at least one, found shapes {values.shape} and {stds.shape}")
    if not (np.isfinite(values).all() and np.isfinite(stds).all() and (stds > 0).all()):
        raise ValueError("expected finite gains with σ > 0")
    scale = float(np.abs(values).max())
    if scale == 0:
        raise ValueError("expected gains other than zero")
    values, stds = values / scale, _in_reach(stds, scale)
    sign = 1.0 if values.sum() > 0 else -1.0
    deviations, upper, lower = path(sign * values, stds, dispersion, chart)
    slopes = trend(sign * values, stds, dispersion)
    found = [_alarm(*one, chart) for one in enumerate(zip(deviations, upper, lower, slopes, strict=True))]
    alarms = tuple(alarm for alarm in found if alarm is not None)
    # An alarm that has passed tells of a change that is none any more: its onset bounds no baseline.
    present = _present(alarms, len(values))
    onset = None if present is None else _onset(present, upper, lower)
    if present is not None and present.kind is AlarmKind.TREND:
        change = _along_line(values, stds)
    else:
        change = _newest(values, stds, onset, chart)
    if change.baseline == 0:
        raise ValueError("expected gains other than zero")
    return Drift(
        baseline=scale * change.baseline,
        baseline_std=dispersion * scale * change.baseline_std,
        deviations=deviations,
        upper=upper,
        lower=lower,
        trend=slopes,
        alarms=alarms,
        onset=onset,
        change_percent=100.0 * sign * change.change / abs(change.baseline),
        change_sigmas=sign * change.change / (dispersion * change.change_std),
    )


def path(
    values: FloatArray, stds: FloatArray, dispersion: FloatArray | float, chart: Chart
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The chart's three lines, for any number of gains at once.

    Args:
        values, stds: magnitudes, shape (..., n), oldest first.
        dispersion: shape (...) or a number.
        chart: limits.

    Returns:
        z, C⁺ and C⁻, shape (..., n) each.
    """
    weights = np.cumsum(1.0 / stds**2, axis=-1)
    means = np.cumsum(values / stds**2, axis=-1) / weights
    shape, n = values.shape, values.shape[-1]
    deviations, upper, lower = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for i in range(1, n):
        last = min(i, chart.baseline) - 1
        std = dispersion * np.sqrt(stds[..., i] ** 2 + 1.0 / weights[..., last])
        deviations[..., i] = z = (values[..., i] - means[..., last]) / std
        upper[..., i] = np.maximum(0.0, upper[..., i - 1] + z - chart.reference)
        lower[..., i] = np.maximum(0.0, lower[..., i - 1] - z - chart.reference)
    return deviations, upper, lower


def _in_reach(stds: FloatArray, scale: float) -> FloatArray:
    """σ over the scale of the gains, such that no weight 1/σ² overflows, vanishes, or leaves nothing of the others."""
    with np.errstate(over="ignore"):
        relative = np.clip(stds / scale, _FINEST, 1.0 / _FINEST)
    middle = float(np.median(relative))
    return np.asarray(np.clip(relative, middle / _APART, middle * _APART))


@dataclass(frozen=True, slots=True)
class _Comparison:
    """Then and now, over the scale of the gains, with σ of the fits."""

    baseline: float
    baseline_std: float
    change: float
    change_std: float


def _newest(values: FloatArray, stds: FloatArray, onset: int | None, chart: Chart) -> _Comparison:
    """The newest calibrations against the baseline."""
    last = len(values) - 1
    # What came after the onset is no part of what it is compared with.
    first = max(1, min(last if onset is None else onset + 1, chart.baseline))
    # Nor is what came between baseline and onset part of what is new.
    since = first if onset is None else max(first, onset + 1)
    newest = max(1, min(_RECENT, len(values) - since))
    baseline, baseline_std = _mean(values[:first], stds[:first])
    recent, recent_std = _mean(values[-newest:], stds[-newest:])
    change = recent - baseline if last else 0.0
    return _Comparison(baseline, baseline_std, change, math.hypot(recent_std, baseline_std))


def _along_line(values: FloatArray, stds: FloatArray) -> _Comparison:
    """The end of the line against its beginning."""
    found, steps = line(values, stds), len(values) - 1
    return _Comparison(found.start, found.start_std, steps * found.slope, steps * found.slope_std)


def _mean(values: FloatArray, stds: FloatArray) -> tuple[float, float]:
    """Weighted by 1/σ², and its σ."""
    weights = 1.0 / stds**2
    total = float(weights.sum())
    return float(weights @ values) / total, math.sqrt(1.0 / total)


def _alarm(index: int, found: tuple[float, float, float, float], chart: Chart) -> Alarm | None:
    z, upper, lower, slope = found
    if max(upper, lower) > chart.threshold:
        return Alarm(index, AlarmKind.DRIFT, bool(upper > lower))
    if abs(z) > chart.single:
        return Alarm(index, AlarmKind.JUMP, bool(z > 0))
    if abs(slope) > chart.trend:
        return Alarm(index, AlarmKind.TREND, bool(slope > 0))
    return None


def _present(alarms: tuple[Alarm, ...], count: int) -> Alarm | None:
    """The alarm of the newest of `count` calibrations."""
    return alarms[-1] if alarms and alarms[-1].index == count - 1 else None


def _onset(alarm: Alarm, upper: FloatArray, lower: FloatArray) -> int:
    """The last calibration where the sum that has the alarm was zero (Page's estimate of the change point)."""
    if alarm.kind is AlarmKind.TREND:
        return 0
    line = (upper if alarm.rose else lower)[: alarm.index + 1]
    return int(np.flatnonzero(line == 0.0)[-1])
