"""Fit the settings of an effect that are refined together, beside everything else in the model.

The fall of the squared residual is a smooth function of them, and each value costs products of
columns, no refit. It is maximised by the simplex of Nelder and Mead (1965), which needs no
derivatives and no scale.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import scipy  # loads scipy.optimize when it is first used

from ident.arrays import FloatArray
from ident.discovery.candidate_fits import CandidateFit
from ident.discovery.candidates import CandidateTrial, FitAtRows, SearchProblem
from ident.effects.effect import Effect, Range, is_shipped, setting_range

MOST_TRIALS = 80  #: Of settings, in one refinement
FIRST_STEP = 0.15  #: Of the simplex, in the unit of each setting
CLOSE_ENOUGH = 1e-3  #: Change of a setting at which the simplex stops, in its unit
DIGITS = 4  #: Of a setting, as a calibration shows it


def is_strictly_possible(effect: Effect, fit: CandidateTrial | CandidateFit) -> bool:
    """Whether every coefficient is inside its possible values, without tolerance."""
    fitted = zip(effect.coefficients, fit.coefficients, strict=True)
    return all(column.least <= value <= column.largest for column, value in fitted)


def best_of_each(fits: Iterable[FitAtRows], setting: str, most: int) -> tuple[Effect, ...]:
    """The possible effects that explain most, the best first, one for each value of a setting.

    The simplex does not find the way from one value to another.

    Args:
        fits: of the effects.
        setting: in which no two of them are alike.
        most: number of effects.
    """
    possible = [one for one in fits if is_strictly_possible(one.effect, one.fit)]
    best: dict[float, Effect] = {}
    for one in sorted(possible, key=lambda one: -one.share):
        best.setdefault(one.effect.settings[setting], one.effect)
    return tuple(best.values())[:most]


def refine_together(search_problem: SearchProblem, effect: Effect, axis: int) -> Effect:
    """Refine the settings in `Effect.refined_once_chosen`; the same effect where none is better.

    Args:
        search_problem: around the model without the effect.
        effect: where to begin.
        axis: index of its joint.
    """
    names = effect.refined_once_chosen
    ranges = [setting_range(effect, name) for name in names]

    def changed(values: FloatArray) -> Effect:
        settings: dict[str, float] = {}
        for name, value in zip(names, values.tolist(), strict=True):
            settings[name] = float(f"{value:.{DIGITS}g}")
        return effect.with_settings(settings)

    def cost(values: FloatArray) -> float:
        in_ranges = zip(ranges, values.tolist(), strict=True)
        if not all(one.least <= value <= one.largest for one, value in in_ranges):
            return 0.0  # it explains nothing
        torque_nm = search_problem.torque_at_rows(changed(values), axis)
        (fit,) = search_problem.fits([torque_nm])
        if fit is not None and is_strictly_possible(effect, fit):
            return -float(fit.fall_by_motor.sum())
        return 0.0

    start = np.array([effect.settings[name] for name in names])
    unit = _units(effect, start)
    simplex = _first_simplex(start, unit, ranges)

    def cost_in_units(values: FloatArray) -> float:
        return cost(values * unit)

    found = scipy.optimize.minimize(
        cost_in_units,
        start / unit,
        method="Nelder-Mead",
        options={
            "initial_simplex": simplex / unit,
            "maxfev": MOST_TRIALS,
            "xatol": CLOSE_ENOUGH,
            "fatol": 0.1,
        },
    )
    if found.fun >= cost(start):
        return effect
    return changed(found.x * unit)


def _first_simplex(start: FloatArray, unit: FloatArray, ranges: Sequence[Range]) -> FloatArray:
    """Corners of the simplex, shape (p + 1, p): the start, and a step of each setting from it.

    A step beyond the range goes the other way: cut off at its end, the simplex would be flat, and
    never leave the end.
    """
    corners = [start]
    for place, allowed in enumerate(ranges):
        half_range = 0.5 * (allowed.largest - allowed.least)
        step = min(FIRST_STEP * unit[place], half_range)
        if start[place] + step > allowed.largest:
            step = -step
        corner = start.copy()
        corner[place] += step
        corners.append(corner)
    return np.array(corners)


def _units(effect: Effect, start: FloatArray) -> FloatArray:
    """Unit in which each setting is changed.

    In the dictionary it is 1 rad or a ratio of 1, else the size of the value.
    """
    if is_shipped(effect):
        return np.ones(len(start))
    size = np.abs(start)
    return np.where(size == 0.0, 1.0, size)
