"""Propose refined settings of effects of one's own before effects are compared.

Whoever writes an effect gives a few values of its settings. Where the torque depends strongly on
one of them, as that of lobes on their number, a spline explains more than any of these values, and
the effect gets no name. So the values are refined before effects are compared. Families of the
dictionary have grids that are fine enough, or proposals of their own.
"""

from __future__ import annotations

from collections.abc import Mapping

from ident.discovery.candidates import CandidateTrial, SearchProblem, shares_explained
from ident.discovery.gates import Gates
from ident.discovery.search import refine_setting
from ident.effects.effect import Effect, fits_data, is_placeable, is_shipped


def propose_own_settings(
    search_problem: SearchProblem, gates: Gates, families: tuple[tuple[Effect, ...], ...]
) -> Mapping[int, tuple[tuple[Effect, ...], ...]]:
    """Return families of one's own with refined members, too, by axis.

    Args:
        search_problem: around the model.
        gates: what the best member explains of a motor's squared residual must reach their least
            share.
        families: that are tried; those that drivegain ships are left as they are.
    """
    own = [family for family in families if not is_shipped(family[0])]
    proposed: dict[int, tuple[tuple[Effect, ...], ...]] = {}
    for axis in range(search_problem.axes):
        refined: list[tuple[Effect, ...]] = []
        for family in own:
            # A value at the end of the grid has no neighbour to be refined to: each one is tried.
            found = dict.fromkeys(family)
            for effect in _members_that_explain(search_problem, gates, family, axis):
                found[refine_setting(search_problem, effect, axis, (family,))] = None
            if len(found) > len(family):
                refined.append(tuple(found))
        if refined:
            proposed[axis] = tuple(refined)
    return proposed


def _members_that_explain(
    search_problem: SearchProblem, gates: Gates, family: tuple[Effect, ...], axis: int
) -> tuple[Effect, ...]:
    """The members that data can show on an axis; none where no member explains enough there."""
    tried: list[Effect] = []
    for effect in family:
        can_be_there = is_placeable(effect, axis, search_problem.model.robot)
        has_moves = effect.least_moves <= search_problem.folds.moves
        if can_be_there and has_moves and fits_data(effect, search_problem.runs, axis):
            tried.append(effect)
    if not tried:
        return ()
    trials: list[CandidateTrial] = []
    for tested in search_problem.test((tuple(tried),), axis, at_rows=True):
        trials += [trial for _, trial in tested.members]
    shares = shares_explained(search_problem, trials)
    if max(shares, default=0.0) < gates.smallest_share:
        return ()
    return tuple(tried)
