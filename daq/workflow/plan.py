"""A plan: point-to-point moves that show every gain, chosen for the experiment that they are made in (paper §2.3)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import Cell, JointUnit
from daq.errors import UsageError
from daq.workflow.choices import EXCHANGES, LARGEST_CONDITION, LARGEST_STD_PERCENT
from daq.workflow.experiment import Experiment, PlannedMove, duration_of, experiment_of
from daq.workflow.plan_search import Search
from drivers.motion.move import Trapezoid, synchronised
from ident.model.robot import JointKind, poses
from ident.planning.excitation import ExtraMoves


@dataclass(frozen=True, slots=True)
class Plan:
    """A run's moves."""

    cell: str  #: name of the cell it was made for
    seed: int  #: it was made from
    condition: float  #: of the weighted observation matrix that these moves give
    #: Standard deviation of each gain [% of it] when the moves are made once without load and once with the cell's
    #: payload, as predicted from nominal parameters; empty in plans of earlier versions.
    predicted_std_percent: tuple[float, ...]
    #: From the first target to the end of the last dwell [s]; how long the way to the first target takes depends on the
    #: robot's position.
    duration_s: float
    moves: tuple[PlannedMove, ...]  #: in order
    units: tuple[JointUnit, ...]  #: in which people read the targets, one a joint


def units_of(cell: Cell) -> tuple[JointUnit, ...]:
    """Units of its joints."""
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
        progress: receives the number of tries and the deviation predicted for the worst gain so far [%].

    Raises:
        UsageError: no plan of this length shows every gain, or there is no clear way.
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
        raise UsageError(
            subject,
            found=f"condition {found:.0f} of the weighted observation matrix after {exchanges} exchanges",
            expected=f"at most {largest_condition:.0f}",
            remedy=remedy,
        )
    if predicted[worst] > largest_std_percent:
        raise UsageError(
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


FloatArray = NDArray[np.float64]

SECONDS = 5.0  #: Duration of the extra moves of each kind, so that the kinds can be compared
POSTURES = 300
POSITION_MARGIN = 0.03
SLOW = 0.2  #: Share of the speed limit at which gravity excites more than inertia
STROKES = (1.0, 0.7, 0.4)  #: Shares of the range that are tried until the way is clear


def extra_moves(experiment: Experiment) -> tuple[ExtraMoves, ...]:
    """Some five seconds of each kind, within limits and clear of everything; the same every time.

    For every axis: fast with the arm stretched, fast with it folded (as the last link is seen from that axis), slow
    with it stretched, and fast together with a neighbour; and of all axes together.
    """
    lower, upper = np.array([axis.limits.position for axis in experiment.cell.axes]).T
    margin = POSITION_MARGIN * (upper - lower)
    low, high = lower + margin, upper - margin
    sampled = np.random.default_rng(0).uniform(low, high, (POSTURES, len(low)))
    postures = sampled[experiment.scene.checker.margins(sampled) > 0.0]
    names = experiment.cell.axis_names
    found = []
    for axis, name in enumerate(names):
        lever = _levers(experiment, postures, axis)
        stretched, folded = postures[np.argsort(-lever, kind="stable")], postures[np.argsort(lever, kind="stable")]
        other = axis + 1 if axis + 1 < len(names) else axis - 1
        kinds: list[tuple[str, FloatArray, tuple[int, ...], float]] = [
            (f"fast moves of {name} with the arm stretched", stretched, (axis,), 1.0),
            (f"fast moves of {name} with the arm folded", folded, (axis,), 1.0),
            (f"slow moves of {name} with the arm stretched", stretched, (axis,), SLOW),
        ]
        if other >= 0:
            kinds.append((f"fast moves of {name} and {names[other]} together", postures, (axis, other), 1.0))
        found += [_swings(experiment, words, at, axes, speed, (low, high)) for words, at, axes, speed in kinds]
    found.append(_swings(experiment, "fast moves of all axes", postures, tuple(range(len(names))), 1.0, (low, high)))
    return tuple(extra for extra in found if extra is not None)


def _levers(experiment: Experiment, postures: FloatArray, axis: int) -> FloatArray:
    """Distance of the last link's frame from the axis; of a prismatic one, from the axis' own frame [m]."""
    robot = experiment.design.expectation.model.robot
    at = poses(robot, postures)
    way = at.origin_m[-1] - at.origin_m[axis + 1]
    if robot.joints[axis].kind is JointKind.PRISMATIC:
        return np.asarray(np.linalg.norm(way, axis=1))
    return np.asarray(np.linalg.norm(np.cross(at.rotation[axis + 1] @ robot.joints[axis].axis, way), axis=1))


def _swings(
    experiment: Experiment,
    words: str,
    postures: FloatArray,
    axes: Sequence[int],
    speed: float,
    ends: tuple[FloatArray, FloatArray],
) -> ExtraMoves | None:
    """There and back in the first few postures in which that is clear; None when there are none."""
    velocity = np.array([axis.limits.velocity for axis in experiment.cell.axes]) * speed
    acceleration = np.array([axis.limits.acceleration for axis in experiment.cell.axes])
    paths: list[Trapezoid] = []
    for start, end in _clear_strokes(experiment, postures, axes, ends):
        there = synchronised(start, end, velocity, acceleration)
        paths += [there, Trapezoid(end, start, there.duration_s, there.ramp_s)]
        if len(paths) >= 6:
            break
    chosen: list[Trapezoid] = []
    seconds = 0.0
    for path in cycle(paths):
        chosen.append(path)
        seconds += path.duration_s
        if seconds >= SECONDS:
            break
    return ExtraMoves(words, seconds, experiment.excitation(chosen)[0]) if chosen else None


def _clear_strokes(
    experiment: Experiment, postures: FloatArray, axes: Sequence[int], ends: tuple[FloatArray, FloatArray]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    low, high = ends
    moved = list(axes)
    for posture in postures:
        for stroke in STROKES:
            inwards = 0.5 * (1.0 - stroke) * (high - low)
            start, end = posture.copy(), posture.copy()
            start[moved], end[moved] = (low + inwards)[moved], (high - inwards)[moved]
            if experiment.scene.checker.obstruction(start, end) is None:
                yield start, end
                break
