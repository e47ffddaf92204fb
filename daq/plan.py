"""A plan: point-to-point moves that show every gain, chosen for the experiment that they are made in (paper §2.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from daq.configuration.cell import Cell
from daq.configuration.joint_unit import JointUnit
from daq.errors import PlanUnfit
from daq.experiment import Experiment, experiment_of
from daq.plan_search import Search
from daq.planned_move import PlannedMove, duration_of

LARGEST_CONDITION = 3500.0
"""Of the weighted observation matrix; the paper's trajectories have 1930 to 2817 (Table 5)."""
LARGEST_STD_PERCENT = 10.0
"""Predicted for the worst gain; a plan above it could as well not be made."""
EXCHANGES = 3000


@dataclass(frozen=True, slots=True)
class Plan:
    """A run's moves.

    Attributes:
        cell: name of the cell it was made for.
        seed: it was made from.
        condition: of the weighted observation matrix that these moves give.
        predicted_std_percent: standard deviation of each gain [% of it] when the moves are made once without load and
            once with the cell's payload, as predicted from nominal parameters; empty in plans of earlier versions.
        duration_s: from the first target to the end of the last dwell [s]; how long the way to the first target takes
            depends on where the robot stands.
        moves: in order.
        units: in which people read the targets, one a joint.
    """

    cell: str
    seed: int
    condition: float
    predicted_std_percent: tuple[float, ...]
    duration_s: float
    moves: tuple[PlannedMove, ...]
    units: tuple[JointUnit, ...]


def units_of(cell: Cell) -> tuple[JointUnit, ...]:
    """Of its joints."""
    return tuple(axis.unit for axis in cell.axes)


def plan(
    cell: Cell,
    *,
    seed: int,
    duration_s: float = 40.0,
    exchanges: int = EXCHANGES,
    speed: float = 1.0,
    largest_condition: float = LARGEST_CONDITION,
    largest_std_percent: float = LARGEST_STD_PERCENT,
    experiment: Experiment | None = None,
    progress: Callable[[int, float], None] = lambda _done, _worst: None,
) -> Plan:
    """Choose moves that let the worst gain be known as well as the time allows.

    Random moves fill the duration; then they are exchanged, shifted, stretched and sped up one at a time, and what
    lowers the predicted standard deviation of the worst gain stays. All moves keep position, velocity and acceleration
    limits, the workspace and clear of the arm itself, on their whole way.

    Args:
        cell: with robot, limits and a weighed payload.
        seed: the same seed gives the same plan.
        duration_s: of the run [s].
        exchanges: tries; every one of them is made. With 0 the random moves are the plan.
        speed: share of the limits that the fastest moves may use.
        largest_condition: a plan worse than this is refused.
        largest_std_percent: a plan that predicts more than this for a gain is refused.
        experiment: that the plan is for, None for the one with the cell's first payload.
        progress: told the number of tries and the deviation predicted for the worst gain so far [%].

    Raises:
        PlanUnfit: no plan of this length shows every gain, or there is no clear way.
        ConfigurationInconsistent: the cell declares no payload.
    """
    experiment = experiment or experiment_of(cell)
    search = Search(experiment, np.random.default_rng(seed), duration_s, speed, largest_condition)
    draft = search.improve(search.random_moves(), exchanges, lambda done, found: progress(done, float(np.max(found))))
    information = np.sum(experiment.informations(draft.paths), axis=0)
    predicted, found = experiment.design.std_percent(information), experiment.design.condition(information)
    worst = int(np.argmax(predicted))
    subject = f"plan of {duration_s:g} s for cell {cell.name!r}"
    remedy = "allow a longer run, more exchanges, wider joint limits or higher speed"
    if found > largest_condition:
        raise PlanUnfit(
            subject,
            found=f"condition {found:.0f} of the weighted observation matrix after {exchanges} exchanges",
            expected=f"at most {largest_condition:.0f}",
            remedy=remedy,
        )
    if predicted[worst] > largest_std_percent:
        raise PlanUnfit(
            subject,
            found=f"{predicted[worst]:.1f} % predicted for the gain of {cell.axes[worst].name}",
            expected=f"at most {largest_std_percent:g} %",
            remedy=remedy,
        )
    return Plan(
        cell=cell.name,
        seed=seed,
        condition=found,
        predicted_std_percent=tuple(predicted.tolist()),
        duration_s=duration_of(cell, draft.moves),
        moves=draft.moves,
        units=units_of(cell),
    )


def slowed(cell: Cell, plan_: Plan, override: float) -> Plan:
    """The same ways at a share of their speed, as for a first run; the predictions are those of the plan as made."""
    moves = tuple(
        replace(move, velocity=move.velocity * override, acceleration=move.acceleration * override**2)
        for move in plan_.moves
    )
    return replace(plan_, duration_s=duration_of(cell, moves), moves=moves)
