"""The control loops of a set of amplifiers: set-point, position and velocity loop, limits, monitoring."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.simulated.compiled import compiled
from drivers.simulated.effects.lag import Lag
from drivers.simulated.profile_position import SEGMENTS, ProfileMove, ramp_down
from drivers.simulated.spec import CellSpec
from drivers.simulated.tuning import LoopTuning

FloatArray = NDArray[np.float64]

LOOP = np.dtype(
    [
        # settings
        ("inertia_a_s2", "f8"),
        ("position_1_s", "f8"),
        ("velocity_1_s", "f8"),
        ("integral_1_s", "f8"),
        ("filter", "f8"),
        ("limit_a", "f8"),
        ("error_window", "f8"),
        ("error_time_s", "f8"),
        ("target_window", "f8"),
        ("target_time_s", "f8"),
        # state
        ("enabled", "i8"),
        ("demand", "f8"),
        ("demand_velocity", "f8"),
        ("demand_acceleration", "f8"),
        ("target", "f8"),
        ("piece", "i8"),
        ("piece_time_s", "f8"),
        ("counts", "i8"),
        ("velocity", "f8"),
        ("integral_a", "f8"),
        ("current_a", "f8"),
        ("error_for_s", "f8"),
        ("inside_for_s", "f8"),
        # what the drive tells; limited is kept for a whole sample period
        ("reached", "i8"),
        ("limited", "i8"),
        ("following_error", "i8"),
    ],
    align=True,
)
"""One record an axis; positions in motor counts, velocities in counts/s, accelerations in counts/s²."""


@compiled
def control(
    loops: NDArray[np.void],
    piece_s: FloatArray,
    piece_acceleration: FloatArray,
    motor_rad: FloatArray,
    counts_per_rad: FloatArray,
    step_s: float,
) -> None:
    """One substep of every axis: read the encoder, move the set-point on, compute the current for the next substep.

    Args:
        loops: LOOP records, changed in place, shape (n,).
        piece_s, piece_acceleration: pieces of constant acceleration of each set-point, shape (n, SEGMENTS).
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
def _move_demand(axis: np.void, piece_s: FloatArray, piece_acceleration: FloatArray, step_s: float) -> None:
    """The set-point is piecewise quadratic and followed exactly, also where a piece ends inside the substep."""
    left = step_s
    while left > 0.0 and axis["piece"] < len(piece_s):
        k = axis["piece"]
        rest = piece_s[k] - axis["piece_time_s"]
        used = min(left, rest)
        acceleration = piece_acceleration[k]
        axis["demand"] += axis["demand_velocity"] * used + 0.5 * acceleration * used * used
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
    """Position P over velocity PI, with velocity and acceleration feed-forward; the error in counts."""
    wanted = axis["demand_velocity"] + axis["position_1_s"] * error
    velocity_error = wanted - axis["velocity"]
    wanted_acceleration = axis["velocity_1_s"] * velocity_error + axis["demand_acceleration"]
    current = axis["inertia_a_s2"] * wanted_acceleration + axis["integral_a"]
    limit = axis["limit_a"]
    push = axis["inertia_a_s2"] * axis["velocity_1_s"] * axis["integral_1_s"] * velocity_error * step_s
    limited = abs(current) >= limit
    if limited:
        axis["limited"] = 1
        current = limit if current > 0.0 else -limit
    # No wind-up: at the limit the integral may only come back.
    if not limited or push * current < 0.0:
        axis["integral_a"] += push
    axis["current_a"] = current


@compiled
def _watch(axis: np.void, error: float, arrived: bool, step_s: float) -> None:
    """Following error window (6065h, 6066h) and target window (6067h, 6068h); the error in counts."""
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


class AmplifierSet:
    """The loops of the n amplifiers of one cell, and what they measure of themselves.

    Attributes:
        loops: LOOP records, shape (n,).
        reported_a: current reference that 6074h tells, with its noise [A], shape (n,); renewed once a SYNC.
        actual_a: current of the motor at the same moment [A], shape (n,).
    """

    def __init__(self, spec: CellSpec, tuning: LoopTuning, lags: tuple[Lag, ...]) -> None:
        n = len(spec.axes)
        period_s = spec.sync_period_us * 1e-6
        self.step_s = period_s / spec.substeps
        self.loops: NDArray[np.void] = np.zeros(n, dtype=LOOP)
        self.loops["inertia_a_s2"] = tuning.inertia_a_s2
        self.loops["position_1_s"] = tuning.position_1_s
        self.loops["velocity_1_s"] = tuning.velocity_1_s
        self.loops["integral_1_s"] = tuning.integral_1_s
        self.loops["filter"] = -np.expm1(-self.step_s / tuning.filter_s)
        self.loops["limit_a"] = [axis.peak_current_a for axis in spec.axes]
        self.loops["piece"] = SEGMENTS
        self.reported_a = np.zeros(n)
        self.actual_a = np.zeros(n)
        self._counts_per_rad = tuning.counts_per_rad
        self._piece_s, self._piece_acceleration = np.zeros((n, SEGMENTS)), np.zeros((n, SEGMENTS))
        self._lags = lags
        self._lagged_a = np.zeros(n)
        # Every axis has a random stream of its own: another axis' noise level or presence does not change it.
        self._random = [np.random.default_rng(np.random.SeedSequence(spec.seed, spawn_key=(i,))) for i in range(n)]
        sigma = np.array([axis.current_noise_a for axis in spec.axes])
        tau = np.array([axis.noise_correlation_s for axis in spec.axes])
        with np.errstate(divide="ignore"):
            self._memory = np.where(tau > 0.0, np.exp(-period_s / np.where(tau > 0.0, tau, 1.0)), 0.0)
        self._drive_a = sigma * np.sqrt(1.0 - self._memory**2)
        self._noise_a = sigma * [stream.standard_normal() for stream in self._random]
        self._block = np.zeros((0, n))
        self._used = 0

    def prime(self, motor_rad: FloatArray) -> None:
        """Take the encoders' first reading at power-on, so that the position of a resting axis is no jump."""
        self.loops["counts"] = np.rint(motor_rad * self._counts_per_rad)
        self.loops["demand"] = self.loops["counts"]
        self.loops["target"] = self.loops["counts"]

    def control(self, motor_rad: FloatArray) -> None:
        """One substep; the currents for the next one are then in ``loops["current_a"]``."""
        control(self.loops, self._piece_s, self._piece_acceleration, motor_rad, self._counts_per_rad, self.step_s)
        if self._lags:
            self._lagged_a[:] = self.loops["current_a"]
            for lag in self._lags:
                lag.report(self._lagged_a, self.step_s)

    def report(self) -> None:
        """Renew the reported currents; once a SYNC."""
        self.actual_a[:] = self.loops["current_a"]
        if self._used == len(self._block):
            self._block = np.stack([stream.standard_normal(1024) for stream in self._random], axis=1)
            self._used = 0
        # First-order autoregression of stationary variance σ².
        self._noise_a = self._memory * self._noise_a + self._drive_a * self._block[self._used]
        self._used += 1
        np.add(self._lagged_a if self._lags else self.loops["current_a"], self._noise_a, out=self.reported_a)

    def enable(self, index: int, on: bool) -> None:
        """Switch the power stage; the set-point then holds where the axis is."""
        axis = self.loops[index]
        axis["enabled"] = int(on)
        axis["reached"] = 0
        axis["inside_for_s"] = 0.0
        axis["following_error"] = 0
        axis["current_a"] = 0.0
        axis["demand"] = axis["target"] = axis["counts"]
        axis["demand_velocity"] = axis["demand_acceleration"] = 0.0
        axis["piece"] = SEGMENTS
        axis["integral_a"] = 0.0

    def move(self, index: int, move: ProfileMove) -> None:
        """Begin a move from the present set-point."""
        self._piece_s[index], self._piece_acceleration[index] = move.duration_s, move.acceleration
        axis = self.loops[index]
        axis["target"] = move.target
        axis["piece"] = 0
        axis["piece_time_s"] = 0.0
        axis["reached"] = 0
        axis["inside_for_s"] = 0.0

    def stop(self, index: int, deceleration: float) -> None:
        """Slow down to a stop [counts/s²]."""
        axis = self.loops[index]
        self.move(index, ramp_down(float(axis["demand"]), float(axis["demand_velocity"]), deceleration))

    def moving(self, index: int) -> bool:
        """Whether the set-point still moves."""
        return bool(self.loops[index]["piece"] < SEGMENTS)
