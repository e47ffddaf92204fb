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

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
it, which is all that is needed.
"""
SMALLEST_SQUARE = 1e-300  #: Of a velocity that is divided by
NUDGE = 1e-4  #: Step of the differences of `_fitted`, as a share of a move's duration
SEEN_FROM = 0.02  #: Share of a way at which a move is seen to have begun
SEEN_TO = 0.98  #: Share at which it is seen to be done


class Demands:
    """Set-points of runs, each rebuilt when it is first needed:
    a search needs those of the same runs often.
    """

    def __init__(self) -> None:
        self._found: dict[int, tuple[Dataset, FloatArray | None]] = {}

    def of(self, data: Dataset, drive_train: DriveTrain) -> FloatArray | None:
        """Return `demanded_positions` of a run, shape (k, n), computed once for each `Dataset`
        object.
        """
        key = id(data)
        if key not in self._found:
            self._found[key] = (data, demanded_positions(data, drive_train))
        _, position = self._found[key]
        return position


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
        demands: of the runs that were needed before.
    """
    if demands is None:
        position = demanded_positions(data, drive_train)
    else:
        position = demands.of(data, drive_train)
    if position is None:
        return data
    rate_hz = data.rate_hz
    smooth = low_pass(
        position.T, rate_hz, conditioning.position_cutoff_hz, conditioning.position_order
    )
    velocity = np.gradient(smooth, axis=1) * rate_hz
    acceleration = np.gradient(velocity, axis=1) * rate_hz
    demanded = Motion(smooth.T, velocity.T, acceleration.T)
    return replace(data, demanded=demanded)


def as_demanded(data: Dataset) -> Dataset:
    """The run as it would have been if it had followed its set-points;
    the run itself where they are unknown.
    """
    demanded = data.demanded
    if demanded is None:
        return data
    return replace(
        data,
        position_rad=demanded.position_rad,
        velocity_rad_s=demanded.velocity_rad_s,
        acceleration_rad_s2=demanded.acceleration_rad_s2,
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
        misfit = np.inf
        for slow in SLOW:
            trial = _trapezoids(position, data.rate_hz, slow)
            own_misfit = _misfit(position, trial)
            if own_misfit < misfit:
                demanded[motor] = trial
                misfit = own_misfit
            if misfit <= 1.0 - FOUND:
                break
        moves = data.motor_moving[:, motor].any()
        if moves and misfit > 1.0 - EXPLAINED:
            return None
    of_joints = np.linalg.solve(drive_train.direction, demanded)
    return np.asarray(of_joints.T)


@dataclass(frozen=True, slots=True, order=True)
class _Stop:
    """A sample at which a motor rests, and its position there."""

    sample: int
    level: float


@dataclass(frozen=True, slots=True)
class _Rest:
    """Stretch in which a motor rests."""

    first: int  #: sample
    end: int  #: the first sample after it
    level: float  #: position

    @property
    def middle(self) -> _Stop:
        """The sample in its middle."""
        return _Stop((self.first + self.end) // 2, self.level)


def _trapezoids(position: FloatArray, rate_hz: float, slow: float) -> FloatArray:
    """Positions of one motor with each motion between two rests replaced by its trapezoid,
    shape (k,).
    """
    # A disturbed motor is never quite still: its speed is a mean over REST_S.
    half = max(1, round(0.5 * REST_S * rate_hz))
    speed = _mean_speed(position, half)
    slow_speed = slow * float(np.quantile(speed, 0.95))
    rests = _rests(position, speed <= slow_speed, 2 * half)
    stops = [rest.middle for rest in rests]
    while True:
        out = np.repeat(stops[0].level, len(position))
        if len(stops) < 2:
            return out
        fitted = _fitted_between(position, stops, rate_hz)
        added: list[_Stop] = []
        for (start, end), parameters in zip(pairwise(stops), fitted, strict=True):
            move = slice(start.sample, end.sample)
            samples = end.sample - start.sample
            time_s = np.arange(samples) / rate_hz
            share = _way(time_s[None], parameters[None])[0]
            out[move] = start.level + (end.level - start.level) * share
            out[end.sample :] = out[end.sample - 1]
            # Two moves with a rest between them that the disturbance has hidden: they part where it
            # is slowest.
            margin = samples // 10
            if margin > half and _misfit(position[move], out[move]) > 1.0 - EXPLAINED:
                inner = slice(start.sample + margin, end.sample - margin)
                slowest = inner.start + int(np.argmin(speed[inner]))
                level = float(position[slowest])
                if level not in (start.level, end.level):
                    added.append(_Stop(slowest, level))
        if not added or len(stops) > MAX_SPLITS * len(rests):
            return out
        stops = sorted(stops + added)


def _mean_speed(position: FloatArray, half: int) -> FloatArray:
    """Speed of a motor around each sample [a sample], over so many samples on either side,
    shape (k,).
    """
    samples = np.arange(len(position))
    last = len(position) - 1
    ahead = np.clip(samples + half, 0, last)
    behind = np.clip(samples - half, 0, last)
    way = np.abs(position[ahead] - position[behind])
    return np.asarray(way / (ahead - behind))


def _fitted_between(position: FloatArray, stops: Sequence[_Stop], rate_hz: float) -> FloatArray:
    """Start, ramp and duration [s] of the move after each stop but the last, shape (m, 3);
    see `_fitted`.
    """
    shares = np.linspace(0.0, 1.0, POINTS)
    times: list[FloatArray] = []
    ways: list[FloatArray] = []
    for start, end in pairwise(stops):
        last = end.sample - 1 - start.sample
        samples = np.rint(shares * last).astype(np.int64)
        way = position[start.sample + samples] - start.level
        times.append(samples / rate_hz)
        ways.append(way / (end.level - start.level))
    return _fitted(np.stack(times), np.stack(ways))


def _misfit(position: FloatArray, demanded: FloatArray) -> float:
    """Share of the squared velocity that a demanded motion does not follow."""
    velocity = np.diff(position)
    error = velocity - np.diff(demanded)
    square = max(float(velocity @ velocity), SMALLEST_SQUARE)
    return float(np.sum(error**2) / square)


def _rests(position: FloatArray, slow: BoolArray, shortest: int) -> list[_Rest]:
    """Rests of a motor; a recording that begins or ends in motion rests there for one sample."""
    padded = np.concatenate(([False], slow, [False])).astype(np.int8)
    edges = np.flatnonzero(np.diff(padded)).tolist()
    stretches: list[tuple[int, int]] = []
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        if end - first >= shortest:
            stretches.append((first, end))
    count = len(slow)
    if not stretches or stretches[0][0] > 0:
        stretches.insert(0, (0, 1))
    if stretches[-1][1] < count:
        stretches.append((count - 1, count))
    smallest_way = SMALLEST_WAY * float(np.ptp(position))
    rests: list[_Rest] = []
    for first, end in stretches:
        rest = _Rest(first, end, float(np.median(position[first:end])))
        if rests and abs(rest.level - rests[-1].level) <= smallest_way:
            before = rests.pop()
            rest = replace(before, end=end)
        rests.append(rest)
    return rests


def _fitted(time_s: FloatArray, way: FloatArray) -> FloatArray:
    """Start, ramp and duration [s] of each move by damped Gauss-Newton, all moves at once,
    shape (m, 3).

    Args:
        time_s: of the points of each move, shape (m, POINTS).
        way: share of the way that is done there, same shape.
    """
    step = time_s[:, -1] / (POINTS - 1)
    begun = np.argmax(way > SEEN_FROM, axis=1) * step
    done = np.argmax(way > SEEN_TO, axis=1) * step
    # A trapezoid with ramps of a third has made 2 % of its way after 9 % of its time.
    duration = np.maximum((done - begun) / 0.82, 2.0 * step)
    parameters = np.stack((begun - 0.09 * duration, duration / 3.0, duration), axis=1)
    residual = way - _way(time_s, parameters)
    cost = np.sum(residual**2, axis=1)
    damping = np.full(len(way), 1e-3)
    for _ in range(ITERATIONS):
        jacobian = _way_jacobian(time_s, parameters, way - residual)
        transposed = np.swapaxes(jacobian, 1, 2)
        gram = transposed @ jacobian
        trace = np.trace(gram, axis1=1, axis2=2)
        added = damping[:, None] * trace[:, None] + 1e-12
        gram += added[:, :, None] * np.eye(3)
        change = np.linalg.solve(gram, transposed @ residual[:, :, None])
        trial = parameters + change[:, :, 0]
        trial[:, 1] = np.maximum(trial[:, 1], 0.1 * step)
        trial[:, 2] = np.maximum(trial[:, 2], 2.0 * trial[:, 1])
        trial_residual = way - _way(time_s, trial)
        is_better = np.sum(trial_residual**2, axis=1) < cost
        parameters[is_better] = trial[is_better]
        residual[is_better] = trial_residual[is_better]
        cost = np.sum(residual**2, axis=1)
        damping = np.where(is_better, damping / 5.0, damping * 5.0)
    return parameters


def _way_jacobian(time_s: FloatArray, parameters: FloatArray, way: FloatArray) -> FloatArray:
    """Derivative of `_way` to start, ramp and duration by forward differences, shape (m, k, 3).

    Args:
        time_s, parameters: see `_way`.
        way: its result there.
    """
    duration = parameters[:, 2]
    changed: list[FloatArray] = []
    for direction in np.eye(3):
        nudge = NUDGE * direction
        nudged = parameters + nudge * duration[:, None]
        changed.append(_way(time_s, nudged))
    step = NUDGE * duration
    difference = np.stack(changed, axis=2) - way[:, :, None]
    return np.asarray(difference / step[:, None, None])


def _way(time_s: FloatArray, parameters: FloatArray) -> FloatArray:
    """Share of the way done under a trapezoid of velocity, shapes (m, k) and (m, 3) → (m, k)."""
    start = parameters[:, 0, None]
    ramp = parameters[:, 1, None]
    duration = parameters[:, 2, None]
    speed = 1.0 / (duration - ramp)
    since = np.clip(time_s - start, 0.0, duration)
    rising = np.minimum(since, ramp)
    cruising = np.clip(since - ramp, 0.0, duration - 2.0 * ramp)
    falling = np.maximum(since - (duration - ramp), 0.0)
    risen = 0.5 * rising**2 / ramp
    lost = 0.5 * falling**2 / ramp
    return np.asarray(speed * (risen + cruising + falling - lost))
