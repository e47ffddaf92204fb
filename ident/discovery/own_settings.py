"""Propose refined settings of effects of one's own before effects are compared.

Whoever writes an effect gives a few values of its settings. Where the torque depends strongly on
one of them, as that of lobes on their number, a spline explains more than any of these values, and
the effect gets no name. So the values are refined before effects are compared. Families of the
dictionary have grids that are fine enough, or proposals of their own.
"""

from __future__ import annotations

from collections.abc import Mapping

from ident.discovery.candidates import SearchProblem
from ident.discovery.gates import Gates
from ident.discovery.search import is_testable, refine_setting
from ident.effects.effect import Effect, is_shipped


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
    shown = [effect for effect in family if is_testable(search_problem, effect, axis)]
    shares = [one.share for one in search_problem.fits_at_rows(shown, axis)]
    if max(shares, default=0.0) < gates.smallest_share:
        return ()
    return tuple(shown)
