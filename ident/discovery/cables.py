"""Propose where a cable along two joints begins to pull, and how much of its way each joint makes.

Both are settings on which the torque depends strongly, and a grid of them on every pair of joints
would be most of all candidates. So they are tried on the pair alone whose residual a cable of the
dictionary explains most of, and the best of them are fitted beside the model. They compete together
with all that were tried, which represent the search.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.candidates import FitAtRows, SearchProblem
from ident.discovery.gates import Gates
from ident.discovery.refinement import best_of_each, refine_together
from ident.effects.effect import Effect, is_placeable
from ident.effects.position import AlongTwoJoints, SlackCable

DIRECTIONS = 12  #: Of the way of a cable, tried on a pair of joints
#: Of the rows in which a cable is still slack, where it begins to pull
SHARES_OF_WAY = (0.1, 0.3, 0.5, 0.7)
STARTS = 3  #: From which direction and start are fitted
#: Share of the rows in which a slack cable hangs slack: one that never does is a `Cable`
LEAST_SLACK = 0.05
#: Of a direction from a joint's own, below which a cable is a `Hinge` of that joint
ONE_JOINT_RAD = 0.15


def propose_cables(
    search_problem: SearchProblem, gates: Gates, families: tuple[tuple[Effect, ...], ...]
) -> Mapping[int, tuple[tuple[Effect, ...], ...]]:
    """Return a family of slack cables for the pair of joints that a cable explains most of.

    It is listed by the lower axis of the pair.

    Args:
        search_problem: around the model.
        gates: what a cable explains of a motor's squared residual must reach their least share.
        families: the dictionary; without cables in it nothing is proposed.
    """
    cables = tuple(family for family in families if isinstance(family[0], AlongTwoJoints))
    grid = next((family for family in cables if isinstance(family[0], SlackCable)), ())
    if not grid or search_problem.folds.moves < grid[0].least_moves:
        return {}
    found: list[tuple[int, FitAtRows]] = []
    for axis in range(search_problem.axes):
        for one in search_problem.fits_at_rows(chain.from_iterable(cables), axis):
            found.append((axis, one))
    if not found:
        return {}
    axis, best = max(found, key=lambda one: one[1].share)
    if best.share < gates.smallest_share:
        return {}
    other_axis = int(best.effect.settings["other_axis"])
    tried = _tried(search_problem, axis, other_axis)
    refined: list[Effect] = []
    for effect in best_of_each(tried, "direction_rad", STARTS):
        fitted = refine_together(search_problem, effect, axis)
        if isinstance(fitted, SlackCable) and _is_slack_cable(search_problem, fitted, axis):
            refined.append(fitted)
    robot = search_problem.model.robot
    shared = [effect for effect in grid if is_placeable(effect, axis, robot)]
    tried_effects = [one.effect for one in tried]
    family = (*shared, *tried_effects, *refined)
    return {axis: (family,)}


def _tried(search_problem: SearchProblem, axis: int, other_axis: int) -> list[FitAtRows]:
    """Slack cables on a pair of joints that the model does not contain, with their fits."""
    effects: list[SlackCable] = []
    step_rad = 2.0 * np.pi / DIRECTIONS
    # None along one joint alone
    directions_rad = step_rad * (np.arange(DIRECTIONS) + 0.5) - np.pi
    for direction_rad in directions_rad.tolist():
        cable = SlackCable(other_axis, direction_rad)
        starts_rad = np.quantile(_way(search_problem, cable, axis), SHARES_OF_WAY)
        for start_rad in starts_rad:
            rounded_rad = float(f"{start_rad:.4g}")
            effects.append(SlackCable(other_axis, direction_rad, rounded_rad))
    return search_problem.fits_at_rows(effects, axis)


def _way(search_problem: SearchProblem, cable: SlackCable, axis: int) -> FloatArray:
    """Way of a cable on the rows of the fit [rad], shape (r,)."""
    return np.concatenate([cable.way(run, axis) for run in search_problem.rows])


def _is_slack_cable(search_problem: SearchProblem, cable: SlackCable, axis: int) -> bool:
    """Whether a cable hangs slack in a part of the rows, and both joints make a part of its way."""
    is_slack = _way(search_problem, cable, axis) < cable.start_rad
    if np.mean(is_slack) < LEAST_SLACK:
        return False
    # A quarter turn leads from one joint's own direction to that of the other.
    quarter_turns = cable.direction_rad / (np.pi / 2.0)
    from_one_joint_rad = abs(quarter_turns - round(quarter_turns)) * np.pi / 2.0
    return from_one_joint_rad >= ONE_JOINT_RAD
