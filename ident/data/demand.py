"""The demanded motion of the drives, rebuilt from a recording of point-to-point moves.

A torque disturbance moves the arm, and the position loop answers it with current. The recorded
motion is then correlated with the error of the motors' equations, and least squares is biased
(Söderström & Stoica, System Identification, §10). The demanded motion, which the drive computes
from its set-points, is not correlated with the disturbance. It gives the *instruments* of
`ident.estimators.maximum_likelihood.iv`.

A drive in profile position mode reaches each set-point with a trapezoidal velocity (CiA 402-2). So
every motion of a motor between two rests is replaced by the trapezoid that fits it best, with three
unknowns: start, ramp time and duration. Three numbers fitted to some hundred samples follow almost
nothing of the disturbance. The lag of the position loop becomes part of the start. Other smooth
profiles differ little from a trapezoid, and an instrument need only be correlated with the motion.
Instruments from the recorded demand 6062h give the same gains (docs/decisions/0010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ident.arrays import BoolArray, FloatArray, true_stretches
from ident.data.conditioning import Conditioning, low_pass
from ident.data.dataset import Dataset
from ident.model.model import DriveTrain
from ident.model.robot import Motion

REST_SPEEDS = (0.01, 0.03, 0.1)
"""Speeds below which a motor rests, as shares of the 95 % quantile of its speed.

Each is tried, until WELL_FOLLOWED is reached; the trapezoids that follow the motion best are used.
A low limit misses rests of a disturbed motor, a high one takes slow moves for rests.
"""
SHORTEST_REST_S = 0.05  #: Shortest rest, and the window over which the speed is a mean
#: Shortest distance between two rests, as a share of the motor's range. Rests that are closer are
#: one: between them the motor settles, or the disturbance moves it.
SHORTEST_MOVE_SHARE = 0.01
#: Samples of each move that its fit uses: about twenty for each unknown
FIT_SAMPLES = 64
FIT_ITERATIONS = 25
#: Moves are split no further once there are more stops than this number times the rests: a
#: continuous motion would be split without end
MAX_STOPS_PER_REST = 4
#: Share of a motor's squared velocity that its trapezoids follow where every rest was found
WELL_FOLLOWED = 0.98
LEAST_FOLLOWED = 0.9
"""Least share of a motor's squared velocity that its trapezoids must follow.

Point-to-point moves reach WELL_FOLLOWED. A sine between two turning points may pass too: its
trapezoid is correlated with it, and an instrument needs no more.
"""
#: Smallest sum of squared velocities that a misfit is divided by
SMALLEST_SQUARE = 1e-300
#: Step of the numerical derivatives of a trapezoid, as a share of its duration
DERIVATIVE_STEP = 1e-4
#: Share of its distance at which a move has visibly begun
BEGIN_SHARE = 0.02
#: Share of its distance at which a move is almost done
END_SHARE = 0.98


class DemandCache:
    """Demanded positions of runs, computed when they are first needed.

    A search for effects needs those of the same runs many times.
    """

    def __init__(self) -> None:
        # A stored Dataset stays alive, so that no other object gets its id.
        self._by_id: dict[int, tuple[Dataset, FloatArray | None]] = {}

    def positions(self, data: Dataset, drive_train: DriveTrain) -> FloatArray | None:
        """Return `demanded_positions` of a run, shape (k, n), computed once for each `Dataset`
        object.
        """
        key = id(data)
        if key not in self._by_id:
            self._by_id[key] = (data, demanded_positions(data, drive_train))
        _, position = self._by_id[key]
        return position


def with_demand(
    data: Dataset,
    drive_train: DriveTrain,
    conditioning: Conditioning,
    cache: DemandCache | None = None,
) -> Dataset:
    """Add the demanded motion to a run, filtered like the recorded one.

    The run is returned unchanged where its demanded motion is unknown.

    Args:
        data: a run of n joints.
        drive_train: R, for the trapezoids of coupled motors.
        conditioning: its low-pass.
        cache: demanded positions that were computed before.
    """
    if cache is None:
        position = demanded_positions(data, drive_train)
    else:
        position = cache.positions(data, drive_train)
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
    """Replace the recorded motion of a run by its demanded one (`with_demand`).

    The run is returned unchanged where its demanded motion is unknown.
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
    """Rebuild the demanded positions of a recording of point-to-point moves.

    Args:
        data: a run of n joints.
        drive_train: R. The trapezoids are those of the motors, not of the joints that they turn
            together.

    Returns:
        demanded positions of the joints [rad; m for a prismatic joint], shape (k, n), delayed like
        the recorded ones; None where the motion of a motor is not made of trapezoids between rests.
    """
    # q_motor = R q_joint, each row divided by the motor's reduction N
    recorded = drive_train.direction @ data.position_rad.T
    demanded = recorded.copy()
    for motor, position in enumerate(recorded):
        misfit = np.inf
        for rest_speed in REST_SPEEDS:
            trial = _trapezoids(position, data.rate_hz, rest_speed)
            trial_misfit = _misfit(position, trial)
            if trial_misfit < misfit:
                demanded[motor] = trial
                misfit = trial_misfit
            if misfit <= 1.0 - WELL_FOLLOWED:
                break
        is_moved = data.motor_moving[:, motor].any()
        if is_moved and misfit > 1.0 - LEAST_FOLLOWED:
            return None
    joint_positions = np.linalg.solve(drive_train.direction, demanded)
    return np.asarray(joint_positions.T)


@dataclass(frozen=True, slots=True, order=True)
class _Stop:
    """A sample at which a motor rests, and its position there.

    A move goes from one stop to the next.
    """

    sample: int
    position: float


@dataclass(frozen=True, slots=True)
class _Rest:
    """Samples during which a motor rests."""

    first: int  #: sample
    end: int  #: the first sample after it
    position: float  #: median

    @property
    def middle(self) -> _Stop:
        """The sample in its middle."""
        return _Stop((self.first + self.end) // 2, self.position)


def _trapezoids(position: FloatArray, rate_hz: float, rest_speed: float) -> FloatArray:
    """Positions of one motor with each motion between two rests replaced by its trapezoid.

    Args:
        position: of the motor, shape (k,).
        rate_hz: sampling rate.
        rest_speed: speed below which it rests, one of REST_SPEEDS.

    Returns:
        shape (k,).
    """
    # A disturbed motor never stands still: its speed is a mean over SHORTEST_REST_S.
    half_window = max(1, round(0.5 * SHORTEST_REST_S * rate_hz))
    shortest_rest = 2 * half_window
    speed = _mean_speed(position, half_window)
    rest_limit = rest_speed * float(np.quantile(speed, 0.95))
    is_slow = speed <= rest_limit
    rests = _rests(position, is_slow, shortest_rest)
    stops = [rest.middle for rest in rests]
    while True:
        demanded = _motion_between(position, stops, rate_hz)
        missed: list[_Stop] = []
        for start, end in pairwise(stops):
            stop = _missed_stop(position, demanded, speed, start, end, half_window)
            if stop is not None:
                missed.append(stop)
        if not missed or len(stops) > MAX_STOPS_PER_REST * len(rests):
            return demanded
        stops = sorted(stops + missed)


def _motion_between(position: FloatArray, stops: Sequence[_Stop], rate_hz: float) -> FloatArray:
    """Positions of a motor that moves from stop to stop by fitted trapezoids, shape (k,)."""
    demanded = np.repeat(stops[0].position, len(position))
    if len(stops) < 2:
        return demanded
    fitted = _fit_moves(position, stops, rate_hz)
    for (start, end), parameters in zip(pairwise(stops), fitted, strict=True):
        time_s = np.arange(end.sample - start.sample) / rate_hz
        share = _distance_share(time_s[None], parameters[None])[0]
        distance = end.position - start.position
        demanded[start.sample : end.sample] = start.position + distance * share
        # At rest there, until another move begins.
        demanded[end.sample :] = demanded[end.sample - 1]
    return demanded


def _missed_stop(
    position: FloatArray,
    demanded: FloatArray,
    speed: FloatArray,
    start: _Stop,
    end: _Stop,
    half_window: int,
) -> _Stop | None:
    """A stop within a move that its trapezoid does not follow; None where there is none.

    Such a move is two moves, and the disturbance hides the rest between them. The stop is where the
    motor is slowest, apart from the first and the last tenth of the move.

    Args:
        position: of the motor, shape (k,).
        demanded: by trapezoids between the stops that are known, shape (k,).
        speed: of the motor, a mean over half_window samples on either side, shape (k,).
        start, end: stops between which the move is.
        half_window: in samples; a move is not divided where its tenth is no longer than that.
    """
    move = slice(start.sample, end.sample)
    tenth = (end.sample - start.sample) // 10
    if tenth <= half_window:
        return None
    misfit = _misfit(position[move], demanded[move])
    if misfit <= 1.0 - LEAST_FOLLOWED:
        return None
    first = start.sample + tenth
    last = end.sample - tenth
    slowest = first + int(np.argmin(speed[first:last]))
    stop = _Stop(slowest, float(position[slowest]))
    # A fit divides by the distance between two stops.
    if stop.position in (start.position, end.position):
        return None
    return stop


def _mean_speed(position: FloatArray, half_window: int) -> FloatArray:
    """Speed of a motor in a window around each sample, in units of position per sample.

    Args:
        position: of the motor, shape (k,).
        half_window: samples on either side.

    Returns:
        shape (k,).
    """
    samples = np.arange(len(position))
    last = len(position) - 1
    ahead = np.clip(samples + half_window, 0, last)
    behind = np.clip(samples - half_window, 0, last)
    distance = np.abs(position[ahead] - position[behind])
    return np.asarray(distance / (ahead - behind))


def _misfit(position: FloatArray, demanded: FloatArray) -> float:
    """Share of the squared velocity that a demanded motion does not follow.

    Args:
        position: of the motor, shape (k,).
        demanded: by trapezoids, shape (k,).
    """
    velocity = np.diff(position)
    error = velocity - np.diff(demanded)
    squared_velocity = max(float(velocity @ velocity), SMALLEST_SQUARE)
    return float(np.sum(error**2) / squared_velocity)


def _rests(position: FloatArray, is_slow: BoolArray, shortest: int) -> list[_Rest]:
    """Rests of a motor.

    A recording that begins or ends in motion has a rest of one sample there.

    Args:
        position: of the motor, shape (k,).
        is_slow: whether it is slower than the limit of a rest, shape (k,).
        shortest: length of the shortest rest, in samples.
    """
    stretches: list[tuple[int, int]] = []
    for first, end in true_stretches(is_slow):
        if end - first >= shortest:
            stretches.append((first, end))
    count = len(is_slow)
    if not stretches or stretches[0][0] > 0:
        stretches.insert(0, (0, 1))
    if stretches[-1][1] < count:
        stretches.append((count - 1, count))
    shortest_move = SHORTEST_MOVE_SHARE * float(np.ptp(position))
    rests: list[_Rest] = []
    for first, end in stretches:
        rest = _Rest(first, end, float(np.median(position[first:end])))
        if rests and abs(rest.position - rests[-1].position) <= shortest_move:
            before = rests.pop()
            rest = replace(before, end=end)
        rests.append(rest)
    return rests


def _fit_moves(position: FloatArray, stops: Sequence[_Stop], rate_hz: float) -> FloatArray:
    """Fit a trapezoid to the move after each stop but the last.

    Returns:
        start, ramp and duration [s] of each move, shape (m, 3).
    """
    share_of_time = np.linspace(0.0, 1.0, FIT_SAMPLES)
    times_s: list[FloatArray] = []
    shares: list[FloatArray] = []
    for start, end in pairwise(stops):
        # The last move of a slow recording may have one sample; its fit takes the one after, too.
        last = max(end.sample - 1 - start.sample, 1)
        samples = np.rint(share_of_time * last).astype(np.int64)
        travelled = position[start.sample + samples] - start.position
        times_s.append(samples / rate_hz)
        shares.append(travelled / (end.position - start.position))
    return _fit_trapezoids(np.stack(times_s), np.stack(shares))


def _fit_trapezoids(time_s: FloatArray, share: FloatArray) -> FloatArray:
    """Fit trapezoids to all moves at once, by Levenberg-Marquardt.

    Args:
        time_s: of the samples of each move, shape (m, FIT_SAMPLES).
        share: of its distance that is travelled there, same shape.

    Returns:
        start, ramp and duration [s] of each move, shape (m, 3).
    """
    step = time_s[:, -1] / (FIT_SAMPLES - 1)
    begin = np.argmax(share > BEGIN_SHARE, axis=1) * step
    end = np.argmax(share > END_SHARE, axis=1) * step
    # A trapezoid with ramps of a third of its duration has travelled 9/4 · 0.09² = 2 % of its
    # distance after 9 % of its duration, and 98 % after 91 %.
    duration = np.maximum((end - begin) / 0.82, 2.0 * step)
    parameters = np.stack((begin - 0.09 * duration, duration / 3.0, duration), axis=1)
    residual = share - _distance_share(time_s, parameters)
    cost = np.sum(residual**2, axis=1)
    damping = np.full(len(share), 1e-3)
    for _ in range(FIT_ITERATIONS):
        fitted_share = share - residual
        jacobian = _share_jacobian(time_s, parameters, fitted_share)
        transposed = np.swapaxes(jacobian, 1, 2)
        # (JᵀJ + (λ tr JᵀJ + ε) 1) Δ = Jᵀ r of each move
        gram = transposed @ jacobian
        trace = np.trace(gram, axis1=1, axis2=2)
        added = damping[:, None] * trace[:, None] + 1e-12
        gram += added[:, :, None] * np.eye(3)
        change = np.linalg.solve(gram, transposed @ residual[:, :, None])
        trial = parameters + change[:, :, 0]
        # A ramp is not zero, and two ramps fit in the duration.
        trial[:, 1] = np.maximum(trial[:, 1], 0.1 * step)
        trial[:, 2] = np.maximum(trial[:, 2], 2.0 * trial[:, 1])
        trial_residual = share - _distance_share(time_s, trial)
        is_better = np.sum(trial_residual**2, axis=1) < cost
        parameters[is_better] = trial[is_better]
        residual[is_better] = trial_residual[is_better]
        cost = np.sum(residual**2, axis=1)
        damping = np.where(is_better, damping / 5.0, damping * 5.0)
    return parameters


def _share_jacobian(time_s: FloatArray, parameters: FloatArray, share: FloatArray) -> FloatArray:
    """Derivative of `_distance_share` to start, ramp and duration by forward differences.

    Args:
        time_s, parameters: of `_distance_share`.
        share: its result there, shape (m, k).

    Returns:
        shape (m, k, 3).
    """
    duration = parameters[:, 2]
    changed_shares: list[FloatArray] = []
    for one_parameter in np.eye(3):
        change = DERIVATIVE_STEP * duration[:, None] * one_parameter
        changed = parameters + change
        changed_shares.append(_distance_share(time_s, changed))
    step = DERIVATIVE_STEP * duration
    difference = np.stack(changed_shares, axis=2) - share[:, :, None]
    return np.asarray(difference / step[:, None, None])


def _distance_share(time_s: FloatArray, parameters: FloatArray) -> FloatArray:
    """Share of its distance that a move with a trapezoidal velocity has travelled.

    With start s, ramp a and duration T, and u = t − s limited to [0, T], it is

        (min(u, a)²/2a + clip(u − a, 0, T − 2a) + w − w²/2a) / (T − a),   w = max(u − T + a, 0).

    Args:
        time_s: t, shape (m, k).
        parameters: s, a and T of each move [s], shape (m, 3).

    Returns:
        shape (m, k).
    """
    start = parameters[:, 0, None]
    ramp = parameters[:, 1, None]
    duration = parameters[:, 2, None]
    speed = 1.0 / (duration - ramp)
    elapsed = np.clip(time_s - start, 0.0, duration)
    accelerating = np.minimum(elapsed, ramp)
    cruising = np.clip(elapsed - ramp, 0.0, duration - 2.0 * ramp)
    braking = np.maximum(elapsed - (duration - ramp), 0.0)
    gained = 0.5 * accelerating**2 / ramp
    lost = 0.5 * braking**2 / ramp
    return np.asarray(speed * (gained + cruising + braking - lost))
