"""Moves that could be added to an experiment, of every kind that is known to help some gain: the planner's advice."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from daq.experiment import Experiment
from drivers.trapezoid import Trapezoid, synchronised
from ident.kinematics import poses
from ident.robot import JointKind
from ident.verdict import ExtraMoves

FloatArray = NDArray[np.float64]

SECONDS = 5.0
"""Of each kind of extra moves, so that they can be compared."""
POSTURES = 300
POSITION_MARGIN = 0.03
SLOW = 0.2
"""Share of the speed limit at which gravity tells more than inertia."""
STROKES = (1.0, 0.7, 0.4)
"""Shares of the range that are tried until the way is clear."""


def extra_moves(experiment: Experiment) -> tuple[ExtraMoves, ...]:
    """Some five seconds of each kind, within limits and clear of everything; the same every time.

    For every axis: fast with the arm stretched, fast with it folded (as the last link is seen from that axis), slow
    with it stretched, and fast together with a neighbour; and of all axes together.
    """
    lower, upper = np.array([axis.limits.position for axis in experiment.cell.axes]).T
    margin = POSITION_MARGIN * (upper - lower)
    low, high = lower + margin, upper - margin
    sampled = np.random.default_rng(0).uniform(low, high, (POSTURES, len(low)))
    postures = sampled[experiment.scene.checker.margins(sampled.T) > 0.0]
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
    at = poses(robot, postures.T)
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
