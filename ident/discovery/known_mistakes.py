"""Mistakes of the description and of the clock that a check has named,
and that join the model of a search.

`ident.discovery.geometry_check` compares each of them with everything else that could explain it,
and sees what a search does not look for: two zeros that hide each other, and a late current that is
a small part of its motor's residual. All join at once, because each of two may explain nothing
alone. What does not pass the gates of a joint fit leaves again.

Wrong zeros and gravity join before the search. A delay joins after it: what makes a torque that is
fast, a coupling or a spring in a gear, looks like a delay until it is in the model. The search has
late positions among its candidates, too, and may have found one by then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.discovery.evidence import Evidence, with_effects
from ident.discovery.gates import Gates
from ident.discovery.joining import (
    FIT_ERRORS,
    JointFit,
    SetAside,
    judge_beside_others,
    linearised_after,
    with_joint_settings,
)
from ident.discovery.search import Finding
from ident.effects.effect import PlacedEffect


@dataclass(frozen=True, slots=True)
class JoinedMistakes:
    """A model with what a check has named."""

    model: JointFit
    joined: tuple[Finding, ...]  #: that are in it
    models: tuple[Evidence, ...]  #: with the first of them, the first two, and so on
    set_aside: tuple[SetAside, ...]  #: what does not pass in the joint fit


def join_mistakes(
    model: JointFit, mistakes: Sequence[Finding], rng: np.random.Generator, gates: Gates
) -> JoinedMistakes:
    """Fit all mistakes together, and take out those that do not pass the gates of a joint fit,
    the worst first.

    An effect of the model that no longer passes beside them leaves, too: it was a part of a
    mistake.

    Args:
        model: before or behind a search.
        mistakes: that a check beside this model has named.
        rng: of the bootstrap.
        gates: limits of the search.
    """
    kept = model.evidence.effects
    left = list(mistakes)
    aside: list[SetAside] = []
    while left:
        try:
            evidence = _with_mistakes(model, kept, left)
            joined = linearised_after(evidence, model)
        except FIT_ERRORS as error:
            aside += [SetAside(one, f"it cannot be fitted: {error}") for one in left]
            break
        failing: list[tuple[float, Finding, str]] = []
        for one in left:
            fall, why = judge_beside_others(joined, one.placed, rng, gates)
            if why:
                failing.append((fall, one, why))
        if failing:
            _, worst, why = min(failing, key=lambda one: one[0])
            aside.append(SetAside(worst, f"in the joint fit it no longer passes: {why}"))
            left = [one for one in left if one is not worst]
            continue
        needless = _worst_of_model(joined, kept, rng, gates)
        if needless is not None:
            kept = tuple(placed for placed in kept if placed != needless)
            continue
        return JoinedMistakes(
            model=joined,
            joined=tuple(with_joint_settings(one, evidence) for one in left),
            models=_growing_models(model, kept, left, evidence),
            set_aside=tuple(aside),
        )
    return JoinedMistakes(model, (), (), tuple(aside))


def _growing_models(
    model: JointFit, kept: tuple[PlacedEffect, ...], mistakes: Sequence[Finding], last: Evidence
) -> tuple[Evidence, ...]:
    """Models with the first of some mistakes, the first two, and so on to the last one,
    which is given.

    Of two zeros that hide each other, one alone may not be fitted: then the model with both stands
    for it, too.
    """
    models = [last]
    for number in reversed(range(1, len(mistakes))):
        try:
            models.append(_with_mistakes(model, kept, mistakes[:number]))
        except FIT_ERRORS:
            models.append(models[-1])
    return tuple(reversed(models))


def _worst_of_model(
    joined: JointFit, kept: Sequence[PlacedEffect], rng: np.random.Generator, gates: Gates
) -> PlacedEffect | None:
    """The effect of a model that passes least beside mistakes;
    None where all that are not declared pass.
    """
    failing: list[tuple[float, PlacedEffect]] = []
    for placed in kept[joined.evidence.declared :]:
        fall, why = judge_beside_others(joined, placed, rng, gates)
        if why:
            failing.append((fall, placed))
    if not failing:
        return None
    _, worst = min(failing, key=lambda one: one[0])
    return worst


def _with_mistakes(
    model: JointFit, kept: tuple[PlacedEffect, ...], mistakes: Sequence[Finding]
) -> Evidence:
    """Refit with mistakes beside effects of a model.

    Raises:
        NotConverged, RankDeficient: see `ident.identify`.
    """
    placed = tuple(one.placed for one in mistakes)
    return with_effects(model.evidence, (*kept, *placed), model.search_problem.runs)
