"""Whether splits of the data give one residual the same name.

An effect is chosen by its errors on all folds of moves together. With one fold left out of that
comparison, each in turn, they show whether the name depends on a few moves: then the residual is a
torque that depends on some variable, and its names are candidates. Nothing is fitted again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.discovery.loop import Step
from ident.discovery.search import Finding, is_better
from ident.effects.effect import PlacedEffect, effect_key


@dataclass(frozen=True, slots=True)
class SplitName:
    """A name of a residual, and how many splits of the data choose it."""

    placed: PlacedEffect  #: the effect
    splits: int  #: that choose it
    of: int  #: number of splits


def names_by_split(step: Step) -> tuple[SplitName, ...]:
    """Names that splits of the data choose for what a turn added, the most frequent first.

    A split is all folds of moves but one. It keeps the name that was added, unless another one has
    less ‖e‖² on its left-out moves, and clearly so by a paired comparison over its folds
    (`is_better`). Other names are those that all data together cannot distinguish from what was
    added (`Finding.ambiguity`).

    Args:
        step: of the search.

    Returns:
        one name where all splits agree; none where the turn added nothing.
    """
    added = step.accepted
    if added is None:
        return ()
    rivals = {effect_key(rival.effect, rival.axis) for rival in added.ambiguity}
    own = effect_key(added.effect, added.axis)
    candidates: list[Finding] = [added]
    for finding in (*step.findings, *step.structures):
        key = effect_key(finding.effect, finding.axis)
        if finding.passed and key in rivals and key != own:
            candidates.append(finding)
    squares = np.stack([finding.fold_errors for finding in candidates])
    folds = squares.shape[1]
    count = np.zeros(len(candidates), dtype=np.intp)
    for left_out in range(folds):
        split = np.delete(squares, left_out, axis=1)
        total = np.where(is_better(split, split[0]), split.sum(axis=1), np.inf)
        # Where none is clearly better, all are alike, and the first is what was added.
        count[np.argmin(total)] += 1
    # Of equals, what was added comes first.
    order = np.argsort(-count, kind="stable")
    return tuple(
        SplitName(candidates[number].placed, int(count[number]), folds)
        for number in order
        if count[number] > 0
    )
