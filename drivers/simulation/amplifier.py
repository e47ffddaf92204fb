"""Control loops of a set of amplifiers:
tuning, set-point, position and velocity loop, limits, monitoring.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.simulation.dynamics import compiled
from drivers.simulation.effects import Lag, build_effect
from drivers.simulation.noise import ColouredNoise, random_streams
from drivers.simulation.plant import Plant, reduction
from drivers.simulation.spec import CellSpec, FloatArray, IntArray

VELOCITY_BANDWIDTH_RAD_S = 220.0
"""Bandwidth of the closed velocity loop at the tuned inertia;
an axis a few times lighter is still stable.
"""

POSITION_BANDWIDTH_RAD_S = VELOCITY_BANDWIDTH_RAD_S / 4.0
INTEGRAL_BANDWIDTH_RAD_S = VELOCITY_BANDWIDTH_RAD_S / 5.0

REDUNDANT_BANDWIDTH_RAD_S = 48.0
"""Bandwidth of the velocity loops of redundant drives.

Each drive follows a trapezoid of its own, and between two poses these agree only nearly: what they
disagree about becomes preload, in proportion to the stiffness of the loops. Such drives have no
integral part either, for their integrals would wind up against each other (Müller and Hufnagel
2012).
"""

#: Time constant of the velocity filter: one encoder count a substep is a coarse velocity
VELOCITY_FILTER_S = 0.0008

POSTURES = 3  #: Positions tried for each joint in tuning

SEGMENTS = 4  #: Largest number of pieces of one move: stop, acceleration, cruise, deceleration

SETTINGS = (
    "inertia_a_s2",
    "position_1_s",
    "velocity_1_s",
    "integral_1_s",
    "filter",
    "limit_a",
    "error_window",
    "error_time_s",
    "target_window",
    "target_time_s",
)
STATE = (
    "demand",
    "demand_velocity",
    "demand_acceleration",
    "target",
    "piece_time_s",
    "velocity",
    "integral_a",
    "current_a",
    "error_for_s",
    "inside_for_s",
)
COUNTERS = ("enabled", "piece", "counts")
#: `limited` stays set for the rest of a sample period
STATUS_BITS = ("reached", "limited", "following_error")
_FLOATS = [(name, "f8") for name in SETTINGS + STATE]
_INTEGERS = [(name, "i8") for name in COUNTERS + STATUS_BITS]
LOOP = np.dtype([*_FLOATS, *_INTEGERS], align=True)
"""One record an axis; positions in motor counts, velocities in counts/s,
accelerations in counts/s².
"""


def counts_per_rad(spec: CellSpec) -> FloatArray:
    """Return the encoder counts per radian of each rotor, shape (n,)."""
    return np.array([axis.counts_per_revolution for axis in spec.axes]) / (2.0 * np.pi)


def tuned_inertia_a_s2(spec: CellSpec, plant: Plant) -> FloatArray:
    """Return the current per motor acceleration [A per count/s²] to which the loops are tuned,
    shape (n,).

    It is the geometric mean of the smallest and largest inertia that each motor meets over the
    postures, and without and with `CellSpec.tuned_with`, signed as the axis is wired. A closed
    chain has only the posture of its start: in others its loops would have to be closed.
    """
    if spec.tuned_with is None:
        inertias = _inertias(spec, plant)
    else:
        bare = replace(spec, payload=None)
        loaded = replace(spec, payload=spec.tuned_with)
        inertias = _inertias(spec, Plant(bare)) + _inertias(spec, Plant(loaded))
    inertia = np.sqrt(np.min(inertias, axis=0) * np.max(inertias, axis=0))
    gain = np.array([axis.gain_nm_per_a for axis in spec.axes])
    # Joint-side rad/s² of a motor is its own over N; g/N keeps the sign of gear and wiring
    # together.
    return np.asarray(inertia / (gain * reduction(spec.ratio) * counts_per_rad(spec)))


def _inertias(spec: CellSpec, plant: Plant) -> list[FloatArray]:
    """Inertia that each motor meets in postures of the arm with what is mounted, shape (m,)
    each.
    """
    # The first joint's position changes no inertia; of long chains the joints behind the seventh
    # stay where they are.
    swept = range(1, 1 if spec.closures else min(len(spec.axes), 7))
    tried = plant.postures(spec.start_rad, POSTURES)
    inertias: list[FloatArray] = []
    for posture in itertools.product(*(tried[joint] for joint in swept)):
        position = spec.start_rad.copy()
        position[list(swept)] = posture
        inertias.append(plant.motor_inertia_at(position))
    return inertias


@dataclass(frozen=True, slots=True)
class ProfileMove:
    """Set-point of profile position mode: SEGMENTS pieces of constant acceleration."""

    duration_s: tuple[float, ...]  #: of each piece; zero for a piece that is not needed
    acceleration: tuple[float, ...]  #: in each piece [counts/s²], signed
    target: float  #: end of the move [counts]


def plan(
    start: float,
    velocity: float,
    target: float,
    speed: float,
    acceleration: float,
    deceleration: float,
) -> ProfileMove:
    """Return the fastest velocity trapezoid from a moving set-point to a target (CiA 402-2).

    Args:
        start, velocity: position [counts] and signed velocity [counts/s] of the set-point.
        target: [counts].
        speed, acceleration, deceleration: objects 6081h, 6083h and 6084h, all positive.
    """
    pieces: list[tuple[float, float]] = []
    if velocity != 0.0:
        stop_s = abs(velocity) / deceleration
        stop = start + 0.5 * velocity * stop_s
        if velocity * (target - stop) < 0.0:
            # It cannot stop before the target, or runs the other way: stop, then go back from rest.
            pieces.append((stop_s, math.copysign(deceleration, -velocity)))
            start = stop
            velocity = 0.0
    sign = math.copysign(1.0, target - start)
    distance = abs(target - start)
    moving = abs(velocity)
    if moving > speed:
        slow_s = (moving - speed) / deceleration
        pieces.append((slow_s, -sign * deceleration))
        distance -= 0.5 * (moving + speed) * slow_s
        moving = speed
    # Distance of accelerating from `moving` to the peak p and stopping: (p² − moving²) / 2a + p² /
    # 2d.
    squared_speeds = 2.0 * distance + moving**2 / acceleration
    peak_squared = squared_speeds / (1.0 / acceleration + 1.0 / deceleration)
    reachable = math.sqrt(max(peak_squared, 0.0))
    peak = max(moving, min(speed, reachable))
    accelerate_s = (peak - moving) / acceleration
    pieces.append((accelerate_s, sign * acceleration))
    ramp_up = (peak**2 - moving**2) / (2.0 * acceleration)
    ramps = ramp_up + peak**2 / (2.0 * deceleration)
    if peak > 0.0:
        cruise_s = max(distance - ramps, 0.0) / peak
        pieces.append((cruise_s, 0.0))
        pieces.append((peak / deceleration, -sign * deceleration))
    return _padded(pieces, target)


def ramp_down(start: float, velocity: float, deceleration: float) -> ProfileMove:
    """Return the move that stops a set-point on a ramp."""
    stop_s = abs(velocity) / deceleration
    acceleration = math.copysign(deceleration, -velocity)
    stop = start + 0.5 * velocity * stop_s
    return _padded([(stop_s, acceleration)], stop)


def _padded(pieces: list[tuple[float, float]], target: float) -> ProfileMove:
    used = [piece for piece in pieces if piece[0] > 0.0]
    used += [(0.0, 0.0)] * (SEGMENTS - len(used))
    durations_s = tuple(duration_s for duration_s, _ in used)
    accelerations = tuple(acceleration for _, acceleration in used)
    return ProfileMove(durations_s, accelerations, target)


@compiled
def control(
    loops: NDArray[np.void],
    piece_s: FloatArray,
    piece_acceleration: FloatArray,
    motor_rad: FloatArray,
    counts_per_rad: FloatArray,
    step_s: float,
) -> None:
    """Run one substep of every axis: read the encoder, move the set-point,
    compute the current for the next substep.

    Args:
        loops: LOOP records, changed in place, shape (n,).
        piece_s, piece_acceleration: pieces of constant acceleration of each set-point, shape (n,
            SEGMENTS).
        motor_rad: angle of each rotor, shape (n,).
        counts_per_rad: of the encoders, shape (n,).
        step_s: substep.
    """
    for i in range(len(loops)):
        axis = loops[i]
        counts = np.int64(np.rint(motor_rad[i] * counts_per_rad[i]))
        measured = (counts - axis["counts"]) / step_s
        axis["counts"] = counts
        axis["velocity"] += axis["filter"] * (measured - axis["velocity"])
        if axis["enabled"] == 0:
            axis["demand"] = axis["target"] = counts
            axis["demand_velocity"] = axis["demand_acceleration"] = 0.0
            axis["piece"] = piece_s.shape[1]
            axis["integral_a"] = axis["current_a"] = axis["error_for_s"] = 0.0
            continue
        _move_demand(axis, piece_s[i], piece_acceleration[i], step_s)
        _follow(axis, axis["demand"] - counts, step_s)
        _watch(axis, axis["demand"] - counts, axis["piece"] >= piece_s.shape[1], step_s)


@compiled
def _move_demand(
    axis: np.void, piece_s: FloatArray, piece_acceleration: FloatArray, step_s: float
) -> None:
    """Move the piecewise quadratic set-point, exactly also where a piece ends inside the
    substep.
    """
    left = step_s
    while left > 0.0 and axis["piece"] < len(piece_s):
        k = axis["piece"]
        rest = piece_s[k] - axis["piece_time_s"]
        used = min(left, rest)
        acceleration = piece_acceleration[k]
        travel = axis["demand_velocity"] * used + 0.5 * acceleration * used * used
        axis["demand"] += travel
        axis["demand_velocity"] += acceleration * used
        axis["demand_acceleration"] = acceleration
        axis["piece_time_s"] += used
        left -= used
        if used == rest:
            axis["piece"] = k + 1
            axis["piece_time_s"] = 0.0
    if axis["piece"] >= len(piece_s):
        axis["demand"] = axis["target"]
        axis["demand_velocity"] = axis["demand_acceleration"] = 0.0


@compiled
def _follow(axis: np.void, error: float, step_s: float) -> None:
    """Control the position (P over velocity PI, velocity and acceleration feed-forward);
    the error in counts.
    """
    wanted = axis["demand_velocity"] + axis["position_1_s"] * error
    velocity_error = wanted - axis["velocity"]
    wanted_acceleration = axis["velocity_1_s"] * velocity_error + axis["demand_acceleration"]
    current = axis["inertia_a_s2"] * wanted_acceleration + axis["integral_a"]
    limit = axis["limit_a"]
    push = (
        axis["inertia_a_s2"] * axis["velocity_1_s"] * axis["integral_1_s"] * velocity_error * step_s
    )
    limited = abs(current) >= limit
    if limited:
        axis["limited"] = 1
        current = math.copysign(limit, current)
    # No wind-up: at the limit the integral may only shrink.
    if not limited or push * current < 0.0:
        axis["integral_a"] += push
    axis["current_a"] = current


@compiled
def _watch(axis: np.void, error: float, arrived: bool, step_s: float) -> None:
    """Monitor the following error (6065h, 6066h) and target window (6067h, 6068h);
    the error in counts.
    """
    if abs(error) > axis["error_window"]:
        axis["error_for_s"] += step_s
        if axis["error_for_s"] >= axis["error_time_s"]:
            axis["following_error"] = 1
    else:
        axis["error_for_s"] = 0.0
    if arrived and abs(error) <= axis["target_window"]:
        axis["inside_for_s"] += step_s
        if axis["inside_for_s"] >= axis["target_time_s"]:
            axis["reached"] = 1
    else:
        axis["inside_for_s"] = 0.0
        axis["reached"] = 0


@dataclass(frozen=True, slots=True)
class Readings:
    """Values of all axes in the units of CiA 402, renewed once a SYNC; one integer an axis."""

    position: list[int]  #: 6064h [counts]
    demand: list[int]  #: 6062h [counts]
    velocity: list[int]  #: 606Ch [counts/s]
    current_demand: list[int]  #: 6074h [per mille of rated current]
    current: list[int]  #: 6077h and 6078h [per mille of rated current]
    reached: list[int]  #: target reached, bit 10 of 6041h
    limited: list[int]  #: internal limit active, bit 11
    following_error: list[int]  #: following error, bit 13


@compiled
def _fill(
    loops: NDArray[np.void], reported_a: FloatArray, rated_current_a: FloatArray, readings: IntArray
) -> None:
    """Fill one row for each field of Readings, in their order, shape (8, n)."""
    for i in range(len(loops)):
        axis = loops[i]
        # int32 as the bus carries it: an endless axis wraps around.
        readings[0, i] = (axis["counts"] + 2**31) % 2**32 - 2**31
        demand = np.int64(np.rint(axis["demand"]))
        readings[1, i] = (demand + 2**31) % 2**32 - 2**31
        velocity = np.rint(axis["velocity"])
        readings[2, i] = np.int64(min(max(velocity, -(2.0**31)), 2.0**31 - 1.0))
        per_mille = 1000.0 / rated_current_a[i]
        current_demand = np.rint(reported_a[i] * per_mille)
        readings[3, i] = np.int64(min(max(current_demand, -32768.0), 32767.0))
        current = np.rint(axis["current_a"] * per_mille)
        readings[4, i] = np.int64(min(max(current, -32768.0), 32767.0))
        readings[5, i] = axis["reached"]
        readings[6, i] = axis["limited"]
        readings[7, i] = axis["following_error"]


class AmplifierSet:
    """Loops of the n amplifiers of one cell, at rest where the plant is,
    and the currents that they report.
    """

    def __init__(self, spec: CellSpec, plant: Plant) -> None:
        n = len(spec.axes)
        period_s = spec.sync_period_us * 1e-6
        self.step_s = period_s / spec.substeps
        self.loops: NDArray[np.void] = np.zeros(n, dtype=LOOP)  #: shape (n,)
        self.loops["inertia_a_s2"] = tuned_inertia_a_s2(spec, plant)
        self.loops["position_1_s"] = POSITION_BANDWIDTH_RAD_S
        self.loops["velocity_1_s"] = VELOCITY_BANDWIDTH_RAD_S
        self.loops["integral_1_s"] = INTEGRAL_BANDWIDTH_RAD_S
        if plant.mechanism is not None and plant.mechanism.mobility < n:
            self.loops["velocity_1_s"] = REDUNDANT_BANDWIDTH_RAD_S
            self.loops["position_1_s"] = REDUNDANT_BANDWIDTH_RAD_S / 4.0
            self.loops["integral_1_s"] = 0.0
        self.loops["filter"] = -np.expm1(-self.step_s / VELOCITY_FILTER_S)
        self.loops["limit_a"] = [axis.peak_current_a for axis in spec.axes]
        self.loops["piece"] = SEGMENTS
        #: current reference with its noise, as in 6074h [A]; renewed once a SYNC
        self.reported_a = np.zeros(n)
        self.actual_a = np.zeros(n)  #: current of the motor at the same moment [A]
        self.temperature_c = plant.temperature_c  #: of the motors [°C]; the plant's own array
        self._counts_per_rad = counts_per_rad(spec)
        # Read the encoders at power-on, so that the position of a resting axis does not jump.
        for state in ("counts", "demand", "target"):
            self.loops[state] = np.rint(plant.motor_rad * self._counts_per_rad)
        self._piece_s = np.zeros((n, SEGMENTS))
        self._piece_acceleration = np.zeros((n, SEGMENTS))
        built = (build_effect(effect, n) for effect in spec.effects if effect.joint is None)
        self._lags = tuple(effect for effect in built if isinstance(effect, Lag))
        self._lagged_a = np.zeros(n)
        sigma_a = np.array([axis.current_noise_a for axis in spec.axes])
        correlation_s = np.array([axis.noise_correlation_s for axis in spec.axes])
        streams = random_streams(spec.seed, n)
        self._noise = ColouredNoise(streams, sigma_a, correlation_s, period_s)
        self._rated_a = np.array([axis.rated_current_a for axis in spec.axes])
        self.readings = self._read()  #: renewed once a SYNC

    def control(self, motor_rad: FloatArray) -> None:
        """Run one substep; ``loops["current_a"]`` then holds the currents for the next one."""
        control(
            self.loops,
            self._piece_s,
            self._piece_acceleration,
            motor_rad,
            self._counts_per_rad,
            self.step_s,
        )
        if self._lags:
            self._lagged_a[:] = self.loops["current_a"]
            for lag in self._lags:
                lag.report(self._lagged_a, self.step_s)

    def report(self) -> None:
        """Renew the reported currents and the readings, once a SYNC."""
        self.actual_a[:] = self.loops["current_a"]
        current_a = self.actual_a
        if self._lags:
            current_a = self._lagged_a
        np.add(current_a, self._noise.advance(), out=self.reported_a)
        self.readings = self._read()

    def _read(self) -> Readings:
        readings = np.empty((8, len(self.loops)), dtype=np.int64)
        _fill(self.loops, self.reported_a, self._rated_a, readings)
        return Readings(*readings.tolist())

    def move(self, index: int, move: ProfileMove) -> None:
        """Begin a move from the present set-point."""
        self._piece_s[index] = move.duration_s
        self._piece_acceleration[index] = move.acceleration
        axis = self.loops[index]
        axis["target"] = move.target
        axis["piece"] = 0
        axis["piece_time_s"] = 0.0
        axis["reached"] = 0
        axis["inside_for_s"] = 0.0
