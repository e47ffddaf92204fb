"""The setting of an accepted effect, found between those that the dictionary tries."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields, is_dataclass, replace

import numpy as np

from ident.effects.effect import Effect
from ident.inquiry import Inquiry

STEPS = 6
"""Of the golden section: the bracket between two neighbours becomes an eighteenth."""
DECLARED = {"exponent": (0.8, 1.25)}
"""Settings between which an effect is nearly one that is declared: friction with exponent one is viscous."""
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


def refined(inquiry: Inquiry, effect: Effect, axis: int, families: Iterable[Sequence[Effect]]) -> Effect:
    """Golden section on the squared residual, over the logarithm of a setting, between its neighbours in the family.

    An effect without a positive real setting, or at the end of its family, is returned as it is.

    Args:
        inquiry: the residual.
        effect, axis: accepted.
        families: the dictionary that it came from.
    """
    family = next((members for members in families if effect in members), None)
    if family is None:
        return effect
    for name, value in effect.settings.items():
        if not isinstance(value, float) or not is_dataclass(effect):
            continue
        others = {key: setting for key, setting in effect.settings.items() if key != name}
        grid = sorted(
            member.settings[name]
            for member in family
            if {key: setting for key, setting in member.settings.items() if key != name} == others
        )
        place = grid.index(value)
        if grid[0] > 0 and 0 < place < len(grid) - 1:
            lower, upper = _one_side(name, value, grid[place - 1], grid[place + 1])
            return _golden(inquiry, effect, axis, name, lower, upper)
    return effect


def _one_side(name: str, value: float, lower: float, upper: float) -> tuple[float, float]:
    """The part of a bracket on whose side of DECLARED the value lies."""
    if name not in DECLARED:
        return lower, upper
    below, above = DECLARED[name]
    return (lower, min(upper, below)) if value < below else (max(lower, above), upper)


def _golden(inquiry: Inquiry, effect: Effect, axis: int, name: str, lower: float, upper: float) -> Effect:
    a, b = float(np.log(lower)), float(np.log(upper))

    def fall(x: float) -> float:
        (trial,) = inquiry.trials([inquiry.torque(_with(effect, name, float(np.exp(x))), axis)])
        return -np.inf if trial is None else float(trial.fallen.sum())

    inner, outer = b - GOLDEN * (b - a), a + GOLDEN * (b - a)
    at_inner, at_outer = fall(inner), fall(outer)
    for _ in range(STEPS):
        if at_inner > at_outer:
            b, outer, at_outer = outer, inner, at_inner
            inner = b - GOLDEN * (b - a)
            at_inner = fall(inner)
        else:
            a, inner, at_inner = inner, outer, at_outer
            outer = a + GOLDEN * (b - a)
            at_outer = fall(outer)
    best = float(f"{np.exp((a + b) / 2.0):.4g}")
    return _with(effect, name, best) if fall(np.log(best)) > fall(np.log(effect.settings[name])) else effect


def _with(effect: Effect, name: str, value: float) -> Effect:
    if not is_dataclass(effect) or name not in {part.name for part in fields(effect)}:
        return effect
    changed: Effect = replace(effect, **{name: value})
    return changed
