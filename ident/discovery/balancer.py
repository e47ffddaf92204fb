"""Propose the geometry of a balancer: where its lever points, and the ratio of its two lengths.

Both are settings on which the torque depends strongly, so no grid of a usual size comes close: a
spline would always explain more, and the effect would get no name. They are fitted beside the model
on each axis whose residual a member of the dictionary's grid explains a part of, and compete
together with the grid, which represents the search over them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from ident.discovery.candidates import SearchProblem
from ident.discovery.gates import Gates
from ident.discovery.refinement import best_of_each, refine_together
from ident.effects.effect import Effect
from ident.effects.position import Counterbalance

STARTS = 4  #: Directions from which the geometry is fitted


def propose_balancers(
    search_problem: SearchProblem,
    gates: Gates,
    families: tuple[tuple[Effect, ...], ...],
    taken: Collection[int] = (),
) -> Mapping[int, tuple[tuple[Effect, ...], ...]]:
    """Return a family of balancers for each axis whose residual could hold one.

    Args:
        search_problem: around the model.
        gates: what the grid explains of a motor's squared residual must reach their least share.
        families: the dictionary; without a balancer in it nothing is proposed.
        taken: axes that have one already.
    """
    grid = next((family for family in families if isinstance(family[0], Counterbalance)), ())
    proposed: dict[int, tuple[tuple[Effect, ...], ...]] = {}
    if not grid:
        return proposed
    for axis in range(search_problem.axes):
        if axis in taken:
            continue
        tried = search_problem.fits_at_rows(grid, axis)
        if not tried:  # gravity's parameters hold the spring's share
            bare = [effect.with_settings({"with_spring": 0}) for effect in grid]
            tried = search_problem.fits_at_rows(bare, axis)
        enough = [one for one in tried if one.share >= gates.smallest_share]
        starts = best_of_each(enough, "phase_rad", STARTS)
        refined = [refine_together(search_problem, start, axis) for start in starts]
        if refined:
            grid_effects = [one.effect for one in tried]
            proposed[axis] = ((*grid_effects, *refined),)
    return proposed
