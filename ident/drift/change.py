"""Significance of changed gains: one change against its noise, a recalibration as a whole, and the pattern of many.

Recordings of different days are independent, so σ of a difference is the root of the sum of squares. But σ of a single
fit covers one session: repeated sessions scatter more (friction warms up, magnets too). Every function here therefore
takes a *dispersion*, the ratio of the scatter of repeated calibrations to their σ; `dispersions` estimates it from a
history.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import FloatArray

DISPERSION = 1.05  #: Default without a history: repeated fits of simulated cells scatter 5 % more than their σ
FALSE_ALARM = 0.01  #: Share of recalibrations without any change in which `decide` finds one

_POOLED_WEIGHT, _AXIS_WEIGHT = 10.0, 30.0
"""Weights of the prior and of the pooled estimate beside an axis' own, in numbers of successive differences."""
_MIN_DIFFERENCES = 4
_CUT = 1.5  #: Differences count up to so many of their σ (Huber); somewhat less than a third of them may be of any size
_FARTHEST = 1e100  #: Limit of a difference over its σ, so that its square is still a number
_MEAN_OF_CUT = (
    1.0
    + (_CUT**2 - 1.0) * math.erfc(_CUT / math.sqrt(2.0))
    - _CUT * math.sqrt(2.0 / math.pi) * math.exp(-(_CUT**2) / 2.0)
)
"""E min(Z², c²) of a standard normal Z."""
_MEDIAN_OF_NORMAL = 0.6744897501960817  #: Median of |Z|, the upper quartile of a standard normal Z
_STEPS = 20
"""Each brings the scale nearer to its end by a factor of two and more, unless more than a tenth are outliers."""
_UNLIKE = 0.01  #: Changes are not one common factor if noise makes them so different in fewer cases than this
_COMMON_SIGMAS = 4.0


@dataclass(frozen=True, slots=True)
class Change:
    """Change of one gain."""

    percent: float  #: of the old value's magnitude [%], inf from zero; negative where the gain has decreased
    sigmas: float  #: the change over its σ, signed as `percent`
    probability: float  #: of so large a change by noise alone, two-sided


@dataclass(frozen=True, slots=True)
class ChangeDecision:
    """Whether a recalibration differs from the gains in force."""

    differs: bool  #: at least one gain has changed by more than noise
    axes: tuple[str, ...]  #: names, as they were given
    changes: tuple[Change, ...]  #: one an axis
    #: Probability of each axis' change among all of them (Holm 1979, valid however their errors depend).
    adjusted: tuple[float, ...]
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
    if not np.isfinite(numbers).all() or (numbers[[1, 3, 4]] < 0).any():
        raise ValueError(
            f"expected finite gains, σ ≥ 0 and dispersion ≥ 0, found {old} ± {old_std}, {new} ± {new_std} "
            f"and dispersion {dispersion}"
        )
    change = (new - old) * (np.sign(old) or 1.0)
    sigmas = _ratio(float(change), dispersion * math.hypot(old_std, new_std))
    return Change(100.0 * _ratio(float(change), abs(old)), sigmas, math.erfc(abs(sigmas) / math.sqrt(2.0)))


def decide(
    axes: tuple[str, ...],
    old: ArrayLike,
    old_std: ArrayLike,
    new: ArrayLike,
    new_std: ArrayLike,
    *,
    dispersion: ArrayLike = DISPERSION,
    false_alarm: float = FALSE_ALARM,
) -> ChangeDecision:
    """Decide whether a recalibration changes anything, over all axes together.

    Each axis is tested by itself against its own σ, and the probabilities are corrected for the number of axes, however
    their errors depend on each other. There is no fixed threshold in per cent.

    Args:
        axes: n names.
        old, old_std, new, new_std: gains in force and found, with their σ, shape (n,) each, in one unit an axis.
        dispersion: scatter of repeated calibrations over their σ, a number or shape (n,).
        false_alarm: share of recalibrations without change in which one is found, at most.

    Raises:
        ValueError: shapes do not fit, a number is not finite, or a σ or a dispersion is negative.
    """
    n = len(axes)
    columns = [np.broadcast_to(np.asarray(c, float), (n,)) for c in (old, old_std, new, new_std, dispersion)]
    changes = tuple(
        change_significance(*map(float, four), dispersion=float(factor)) for *four, factor in zip(*columns, strict=True)
    )
    # Holm: the smallest probability counts times their number, the next times one less, never falling.
    probabilities = np.array([change.probability for change in changes])
    order = np.argsort(probabilities)
    adjusted = np.empty(n)
    adjusted[order] = np.maximum.accumulate(np.minimum(1.0, probabilities[order] * np.arange(n, 0, -1)))
    differs = bool(adjusted.min(initial=1.0) <= false_alarm)
    words = _words(axes, changes, adjusted, false_alarm)
    return ChangeDecision(differs, axes, changes, tuple(map(float, adjusted)), words)


def dispersions(values: ArrayLike, stds: ArrayLike) -> FloatArray:
    """Estimate how much more repeated calibrations scatter than their σ, for each axis; never less than 1.

    From differences of successive calibrations, so that a slow drift adds little; each counts up to 1.5 of their σ
    (Huber 1964, proposal 2), so that a sudden change adds little too. The estimate of an axis is drawn towards that of
    all axes, and that towards DISPERSION, by weights in numbers of differences (as a scaled inverse-χ² prior).

    Args:
        values, stds: shape (..., axes, n), oldest first; leading dimensions are separate histories.

    Returns:
        shape (..., axes).
    """
    values, stds = np.asarray(values, float), np.asarray(stds, float)
    count = values.shape[-1] - 1
    if count < _MIN_DIFFERENCES:
        return np.full(values.shape[:-1], DISPERSION)
    # Differences not about their own centre: the centre of few differences is too near to them.
    with np.errstate(over="ignore"):
        away = 2.0 * (np.abs(np.diff(values / 2.0)) / np.hypot(stds[..., 1:], stds[..., :-1]))
    squares = np.minimum(away, _FARTHEST) ** 2
    own = _robust_variance(squares)
    all_axes = _robust_variance(squares.reshape(*squares.shape[:-2], -1))
    total = count * values.shape[-2]
    pooled = (_POOLED_WEIGHT * DISPERSION**2 + total * all_axes) / (_POOLED_WEIGHT + total)
    drawn = (_AXIS_WEIGHT * pooled[..., None] + count * own) / (_AXIS_WEIGHT + count)
    return np.asarray(np.sqrt(np.maximum(drawn, 1.0)))


def pattern(change_percent: ArrayLike, std_percent: ArrayLike, alarmed: ArrayLike) -> Pattern:
    """Classify the changes of all gains together.

    They have one common factor where at least two raise an alarm, the weighted mean c̄ of all changes is significant,
    and Σ ((c − c̄)/σ)² is no larger than χ² with n − 1 degrees of freedom makes plausible.

    Args:
        change_percent, std_percent: of each axis since its baseline, with σ > 0 [%], shape (n,).
        alarmed: which of them raise an alarm, shape (n,).
    """
    changes, stds = np.asarray(change_percent, float), np.asarray(std_percent, float)
    count = int(np.count_nonzero(alarmed))
    if count < 2:
        return Pattern.ONE if count else Pattern.NONE
    from scipy.special import chdtrc  # noqa: PLC0415 - half of the start-up of `history`, which seldom needs it

    weights = 1.0 / stds**2
    common = float(weights @ changes / weights.sum())
    spread = float(weights @ (changes - common) ** 2)
    alike = chdtrc(len(changes) - 1, spread) > _UNLIKE
    return Pattern.COMMON if alike and abs(common) * weights.sum() ** 0.5 > _COMMON_SIGMAS else Pattern.SEVERAL


def _robust_variance(squares: FloatArray) -> FloatArray:
    """Solve mean(min(x², c² s)) = s E min(Z², c²) for s along the last axis, starting from the median."""
    found = np.median(squares, axis=-1) / _MEDIAN_OF_NORMAL**2
    for _ in range(_STEPS):
        found = np.minimum(squares, _CUT**2 * found[..., None]).mean(axis=-1) / _MEAN_OF_CUT
    return np.asarray(found)


def _ratio(part: float, whole: float) -> float:
    """Quotient; infinite for a change of a value known exactly, 0 without a change."""
    if whole:
        return part / whole
    return math.copysign(math.inf, part) if part else 0.0


def _words(axes: tuple[str, ...], changes: tuple[Change, ...], adjusted: FloatArray, level: float) -> str:
    if not axes:
        return "no gain to compare"
    parts = [
        f"{axis} {change.percent:+.2g} % ({_short(abs(change.sigmas))} σ, p = {p:.2g} among {len(axes)})"
        for axis, change, p in zip(axes, changes, adjusted, strict=True)
    ]
    changed = [text for text, p in zip(parts, adjusted, strict=True) if p <= level]
    if changed:
        return f"changed by more than noise: {', '.join(changed)}"
    largest = parts[int(np.argmax([abs(change.sigmas) for change in changes]))]
    return f"no gain has changed by more than noise: the largest change is {largest}"


def _short(sigmas: float) -> str:
    """Format a number in a few digits, however large."""
    return f"{sigmas:.1f}" if sigmas < 1e4 else f"{sigmas:.1e}"
