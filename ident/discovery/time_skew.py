"""Delay of the currents after the positions, the same for every motor, by instruments.

Least squares are biased here: where a torque disturbs the arm inside its position loop, recorded
motion and current share a cause, and the coefficient of `TimeSkew` is −3 ± 0.6 ms in recordings
without any delay. Instruments from the demanded motion (`ident.discovery.evidence.by_instruments`)
know nothing of the disturbance. Their value counts, and only where it cannot be zero; where no
instruments exist, the delay is not known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ident.discovery.evidence import Evidence, by_instruments, refitted_around
from ident.discovery.gates import own_unknowns
from ident.discovery.joining import FIT_ERRORS
from ident.effects.effect import PlacedEffect
from ident.effects.electrical import TimeSkew
from ident.estimators.estimate import Estimate

CERTAIN_SIGMAS = 4.0
"""σ by which a skew must differ from zero: with 3.3, one in 200 clean recordings had a skew,
with a disturbance in the loop, where σ is up to a fifth too small (`tests/studies/skew_study.py`).
"""
REFITS = 4  #: Refits with the filter of the delay found; a delay of 8 ms settles in three
SETTLED = 0.1  #: Share of σ below which another refit is not worth its time


@dataclass(frozen=True, slots=True)
class CurrentDelay:
    """Delay of current samples after position samples, common to all motors;
    negative where currents are early.
    """

    seconds: float  #: by instruments [s]
    std: float  #: its σ [s]
    #: by the estimator of the fit, which a disturbance in the position loop bends [s]
    fit_seconds: float
    fit_std: float  #: its σ [s]
    confirmed: bool  #: whether it cannot be zero by instruments: beyond CERTAIN_SIGMAS
    is_in_model: bool  #: whether the search accepted it, or the cell declares it


def time_skew(evidence: Evidence) -> CurrentDelay | None:
    """Estimate the time skew beside everything else in a model, without a search.

    Args:
        evidence: a fit, with its effects.

    Returns:
        None where the demanded motion is not known, the drive is redundant, or these data cannot
        show it.
    """
    own = [placed for placed in evidence.effects if isinstance(placed.effect, TimeSkew)]
    if own:
        return _judged(evidence, own[0], is_in_model=True)
    placed = PlacedEffect(TimeSkew(), 0)
    found = _beside(evidence, placed)
    for _ in range(REFITS):
        if found is None or not found.confirmed:
            break
        # A delay c is a filter of T = c/2 to second order; without it, jumps of the torque shorten
        # the delay.
        setting = TimeSkew(filter_s=0.5 * abs(found.seconds), backwards=int(found.seconds < 0.0))
        placed = replace(placed, effect=setting)
        before = found
        found = _beside(evidence, placed)
        if found is None or abs(found.seconds - before.seconds) < SETTLED * found.std:
            break
    return found


def _beside(evidence: Evidence, placed: PlacedEffect) -> CurrentDelay | None:
    """Refit with the skew in the model, and judge it; None where it cannot be fitted.

    One refit is enough: the torque whose rate is its column is that of a fit with everything else
    in the model.
    """
    try:
        refitted = refitted_around(evidence, (*evidence.effects, placed))
    except FIT_ERRORS:
        return None
    return _judged(refitted, placed, is_in_model=False)


def _judged(evidence: Evidence, placed: PlacedEffect, *, is_in_model: bool) -> CurrentDelay | None:
    """Judge the skew of a model by instruments;
    None without any, or where nothing can be fitted by them.
    """
    try:
        estimate = by_instruments(evidence)
    except FIT_ERRORS:
        return None
    if estimate is None:
        return None
    seconds, std = _of(estimate, placed)
    fit_seconds, fit_std = _of(evidence.estimate, placed)
    return CurrentDelay(
        seconds=seconds,
        std=std,
        fit_seconds=fit_seconds,
        fit_std=fit_std,
        confirmed=abs(seconds) > CERTAIN_SIGMAS * std,
        is_in_model=is_in_model,
    )


def _of(estimate: Estimate, placed: PlacedEffect) -> tuple[float, float]:
    """The one coefficient of a skew, and its σ [s]."""
    (own,) = own_unknowns(estimate, (placed,))
    return float(estimate.parameters[own]), float(estimate.parameters_std[own])
