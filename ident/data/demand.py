"""The motion that was asked for, rebuilt from a recording of point-to-point moves.

A torque disturbance inside the position loop moves the arm, and comes back in the current: the
recorded motion and the equation's error then share a cause, and least squares are biased
(Söderström & Stoica, System Identification, §10). The set-point of the loop knows nothing of the
disturbance. Its motion gives the *instruments* of `ident.estimators.maximum_likelihood.iv`.

A drive in profile position mode makes a trapezoid of velocity from each set-point (CiA 402-2). So
every motion of a motor between two rests is fitted by one, with three unknowns: when it starts, how
long it accelerates, how long it lasts. Three numbers out of some hundred samples carry next to
nothing of the disturbance. The lag of the loop goes into the start; a smoother profile differs
little from its trapezoid, and an instrument need only resemble the motion. Instruments from the
recorded demand 6062h give the same gains (docs/decisions/0010).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.data.conditioning import Conditioning, low_pass
from ident.data.dataset import Dataset
from ident.model.model import DriveTrain
from ident.model.robot import Motion

SLOW = (0.01, 0.03, 0.1)
"""Share of a motor's speed (95 % quantile) below which it rests.

The first one that finds its moves will do: a lower one overlooks rests of a disturbed motor, a
higher one slow moves.
"""
REST_S = 0.05  #: Time over which that speed is a mean, and of the shortest rest
#: Share of a motor's range: a shorter way between two rests is a settling or disturbed motor
SMALLEST_WAY = 0.01
POINTS = 64  #: Samples of each move that the fit sees: twenty for each of its unknowns
ITERATIONS = 25
#: Moves to each move that was found at first: continuous motion is not cut up for ever
MAX_SPLITS = 4
FOUND = 0.98  #: Share of a motor's squared velocity that is followed when every move was found
EXPLAINED = 0.9
"""Least share of each motor's squared velocity that the trapezoids must follow; point-to-point
moves reach 0.98 and more. A sine between two turning points may pass too: its trapezoid resembles
it, which is all that is asked.
"""


class Demands:
    """Set-points of runs, each rebuilt when it is first asked for:
    a search asks for those of the same runs often.
    """

    def __init__(self) -> None:
        self._found: dict[int, tuple[Dataset, FloatArray | None]] = {}

    def of(self, data: Dataset, drive_train: DriveTrain) -> FloatArray | None:
        """Return `demanded_positions` of a run; the run is told by its identity, and kept."""
        if id(data) not in self._found:
            self._found[id(data)] = (data, demanded_positions(data, drive_train))
        return self._found[id(data)][1]


def with_demand(
    data: Dataset,
    drive_train: DriveTrain,
    conditioning: Conditioning,
    demands: Demands | None = None,
) -> Dataset:
    """Add the motion that the drives were asked for, filtered as the recorded one;
    unchanged where it is unknown.

    Args:
        data: a run of n joints.
        drive_train: R, for the trapezoids of coupled motors.
        conditioning: its low-pass.
        demands: of the runs that were asked for before.
    """
    if demands is None:
        position = demanded_positions(data, drive_train)
    else:
        position = demands.of(data, drive_train)
    if position is None:
        return data
    smooth = low_pass(
        position.T, data.rate_hz, conditioning.position_cutoff_hz, conditioning.position_order
    )
    velocity = np.gradient(smooth, axis=1) * data.rate_hz
    acceleration = np.gradient(velocity, axis=1) * data.rate_hz
    return replace(data, demanded=Motion(smooth.T, velocity.T, acceleration.T))


def as_demanded(data: Dataset) -> Dataset:
    """The run as it would have been if it had followed its set-points;
    the run itself where they are unknown.
    """
    asked = data.demanded
    if asked is None:
        return data
    return replace(
        data,
        position_rad=asked.position_rad,
        velocity_rad_s=asked.velocity_rad_s,
        acceleration_rad_s2=asked.acceleration_rad_s2,
    )


def demanded_positions(data: Dataset, drive_train: DriveTrain) -> FloatArray | None:
    """Rebuild the set-points of a recording of point-to-point moves.

    Args:
        data: a run of n joints.
        drive_train: R: coupled motors make the trapezoids, not their joints.

    Returns:
        demanded positions of the joints [rad; m for a prismatic joint], shape (k, n), delayed like
        the recorded ones; None where the motion of a motor is not made of trapezoids between rests.
    """
    recorded = drive_train.direction @ data.position_rad.T
    demanded = recorded.copy()
    for motor, position in enumerate(recorded):
        left = np.inf
        for slow in SLOW:
            trial = _trapezoids(position, data.rate_hz, slow)
            misfit = _misfit(position, trial)
            if misfit < left:
                demanded[motor], left = trial, misfit
            if left <= 1.0 - FOUND:
                break
        if data.motor_moving[:, motor].any() and left > 1.0 - EXPLAINED:
            return None
    return np.asarray(np.linalg.solve(drive_train.direction, demanded).T)


def _trapezoids(position: FloatArray, rate_hz: float, slow: float) -> FloatArray:
    """Positions of one motor with each motion between two rests replaced by its trapezoid,
    shape (k,).
    """
    # A disturbed motor is never quite still: its speed is a mean over REST_S.
    half = max(1, round(0.5 * REST_S * rate_hz))
    ahead, behind = (
        np.clip(np.arange(len(position)) + step, 0, len(position) - 1) for step in (half, -half)
    )
    speed = np.abs(position[ahead] - position[behind]) / (ahead - behind)
    rests = _rests(position, speed <= slow * float(np.quantile(speed, 0.95)), 2 * half)
    stops = [((first + last) // 2, level) for first, last, level in rests]
    share = np.linspace(0.0, 1.0, POINTS)
    while True:
        out = np.repeat(stops[0][1], len(position))
        if len(stops) < 2:
            return out
        times = []
        ways = []
        for (first, start), (last, end) in pairwise(stops):
            at = np.rint(share * (last - 1 - first)).astype(np.int64)
            times.append(at / rate_hz)
            ways.append((position[first + at] - start) / (end - start))
        fitted = _fitted(np.stack(times), np.stack(ways))
        added = []
        for ((first, start), (last, end)), parameters in zip(pairwise(stops), fitted, strict=True):
            time_s = np.arange(last - first) / rate_hz
            out[first:last] = start + (end - start) * _way(time_s[None], parameters[None])[0]
            out[last:] = out[last - 1]
            # Two moves with a rest between them that the disturbance has hidden: they part where it
            # is slowest.
            margin = (last - first) // 10
            if margin > half and _misfit(position[first:last], out[first:last]) > 1.0 - EXPLAINED:
                middle = first + margin + int(np.argmin(speed[first + margin : last - margin]))
                level = float(position[middle])
                if level not in (start, end):
                    added.append((middle, level))
        if not added or len(stops) > MAX_SPLITS * len(rests):
            return out
        stops = sorted(stops + added)


def _misfit(position: FloatArray, demanded: FloatArray) -> float:
    """Share of the squared velocity that a demanded motion does not follow."""
    velocity = np.diff(position)
    return float(
        np.sum((velocity - np.diff(demanded)) ** 2) / max(float(velocity @ velocity), 1e-300)
    )


def _rests(position: FloatArray, slow: BoolArray, shortest: int) -> list[tuple[int, int, float]]:
    """First sample, end and position of each rest;
    a recording that begins or ends in motion rests there for one.
    """
    edges = np.flatnonzero(np.diff(np.concatenate(([False], slow, [False])).astype(np.int8)))
    found = [
        (int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= shortest
    ]
    if not found or found[0][0] > 0:
        found.insert(0, (0, 1))
    if found[-1][1] < len(slow):
        found.append((len(slow) - 1, len(slow)))
    rests = list[tuple[int, int, float]]()
    smallest = SMALLEST_WAY * float(np.ptp(position))
    for first, last in found:
        level = float(np.median(position[first:last]))
        if rests and abs(level - rests[-1][2]) <= smallest:
            begun, _, level = rests.pop()
            rests.append((begun, last, level))
        else:
            rests.append((first, last, level))
    return rests


def _fitted(time_s: FloatArray, way: FloatArray) -> FloatArray:
    """Start, ramp and duration [s] of each move by damped Gauss-Newton, all moves at once,
    shape (m, 3).

    Args:
        time_s: of the points of each move, shape (m, POINTS).
        way: share of the way that is done there, same shape.
    """
    step = time_s[:, -1] / (POINTS - 1)
    begun, done = (np.argmax(way > limit, axis=1) * step for limit in (0.02, 0.98))
    # A trapezoid with ramps of a third has made 2 % of its way after 9 % of its time.
    duration = np.maximum((done - begun) / 0.82, 2.0 * step)
    parameters = np.stack((begun - 0.09 * duration, duration / 3.0, duration), axis=1)
    residual = way - _way(time_s, parameters)
    cost = np.sum(residual**2, axis=1)
    damping = np.full(len(way), 1e-3)
    nudges = 1e-4 * np.eye(3)
    for _ in range(ITERATIONS):
        size = parameters[:, 2]
        changed = [_way(time_s, parameters + nudge * size[:, None]) for nudge in nudges]
        jacobian = (np.stack(changed, axis=2) - (way - residual)[:, :, None]) / (1e-4 * size)[
            :, None, None
        ]
        gram = np.swapaxes(jacobian, 1, 2) @ jacobian
        gram += (damping[:, None] * np.trace(gram, axis1=1, axis2=2)[:, None] + 1e-12)[
            :, :, None
        ] * np.eye(3)
        move = np.linalg.solve(gram, np.swapaxes(jacobian, 1, 2) @ residual[:, :, None])[:, :, 0]
        trial = parameters + move
        trial[:, 1] = np.maximum(trial[:, 1], 0.1 * step)
        trial[:, 2] = np.maximum(trial[:, 2], 2.0 * trial[:, 1])
        left = way - _way(time_s, trial)
        better = np.sum(left**2, axis=1) < cost
        parameters[better], residual[better] = trial[better], left[better]
        cost = np.sum(residual**2, axis=1)
        damping = np.where(better, damping / 5.0, damping * 5.0)
    return parameters


def _way(time_s: FloatArray, parameters: FloatArray) -> FloatArray:
    """Share of the way done under a trapezoid of velocity, shapes (m, k) and (m, 3) → (m, k)."""
    start, ramp, duration = (column[:, None] for column in parameters.T)
    speed = 1.0 / (duration - ramp)
    since = np.clip(time_s - start, 0.0, duration)
    rising = np.minimum(since, ramp)
    falling = np.maximum(since - (duration - ramp), 0.0)
    cruising = np.clip(since - ramp, 0.0, duration - 2.0 * ramp)
    return np.asarray(
        speed * (0.5 * rising**2 / ramp + cruising + falling - 0.5 * falling**2 / ramp)
    )
