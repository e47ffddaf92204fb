"""Drives that give less current than their reference asks for, and do not report it.

A limit behind the reference shows nothing in the current itself: the reference goes on to grow. But
the torque does not: the current that the motion needs goes no further than the limit, whenever the
reference is beyond it. What is recorded there is no torque, and bends the gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.data.dataset import Dataset
from ident.data.run_channels import RunChannels
from ident.equations.observation import Observation
from ident.estimators.estimate import Estimate

LEAST_ROWS = 6  #: Rows in which the reference is beyond the limit
#: By how much a reference exceeds the predicted current there, in σ of a motor's noise
BEYOND_SIGMAS = 6.0
PLATEAU = 0.1  #: Of a limit, by which predicted currents differ where it acts
#: Share of the rows beyond the limit whose predicted current is on the plateau
LEAST_ON_PLATEAU = 0.8
LARGEST_SLOPE = 0.25
"""Slope of the predicted current over the reference beyond the limit.

Where a motor weakens, its torque grows on.
"""
#: Share of the rows with a reference well beyond the limit whose torque lacks it
LEAST_MISSING = 0.9
SAFE = 0.95  #: Of a limit, from which on samples are left out: it is known to some percent


@dataclass(frozen=True, slots=True)
class LimitedCurrent:
    """A drive that gives no more current than a limit."""

    motor: int  #: index
    limit_a: float  #: that the torque shows, in the unit of the currents


def limited_currents(observation: Observation, estimate: Estimate) -> tuple[LimitedCurrent, ...]:
    """Find motors whose predicted current goes no further than a limit while its reference does.

    Args:
        observation: rows of all runs; of a redundantly driven robot nothing is found.
        estimate: of the fit.
    """
    if observation.preload.size:
        return ()
    found: list[LimitedCurrent] = []
    motor_torque_nm = observation.drive_train.to_motor @ estimate.predicted_torque(observation)
    for motor, torque_nm in enumerate(motor_torque_nm):
        use = observation.motor_use[motor]
        reference_a = observation.current[motor, use]
        predicted_a = torque_nm[use] / estimate.gains[motor]
        limit_a = _limit(reference_a, predicted_a)
        if limit_a is not None:
            found.append(LimitedCurrent(motor, limit_a))
    return tuple(found)


def without_limited(data: Dataset, limits: Sequence[LimitedCurrent]) -> Dataset:
    """Leave out the samples of a run whose reference is near a limit, or beyond it."""
    limited = limited_samples(data, limits)
    return replace(data, valid=data.valid & ~limited)


def limited_samples(data: Dataset, limits: Sequence[LimitedCurrent]) -> BoolArray:
    """Samples of a run whose reference is near a limit, or beyond it, shape (k, m)."""
    limited = np.zeros_like(data.valid)
    for one in limits:
        reference_a = data.current_a[:, one.motor]
        limited[:, one.motor] = np.abs(reference_a) > SAFE * one.limit_a
    return limited


def noting_limits(
    channels: RunChannels, data: Dataset, limits: Sequence[LimitedCurrent]
) -> RunChannels:
    """Return the channels of a run with what its drives did not give.

    Args:
        channels: of the run.
        data: the run, with all its samples.
        limits: of the fit.
    """
    moving = data.motor_moving & data.valid
    limited = limited_samples(data, limits) & moving
    limited_counts = np.count_nonzero(limited, axis=0)
    moving_counts = np.count_nonzero(moving, axis=0)
    percent = 100.0 * limited_counts / np.maximum(moving_counts, 1)
    torque_limits = np.full(len(percent), np.nan)
    for one in limits:
        torque_limits[one.motor] = one.limit_a
    return replace(channels, limited_percent=percent, torque_limits=torque_limits)


def _limit(reference_a: FloatArray, predicted_a: FloatArray) -> float | None:
    """Limit of one motor's current, None where none shows, from its rows, shape (r,) each."""
    if len(reference_a) < LEAST_ROWS:
        return None
    size_a = np.abs(reference_a)
    along_a = predicted_a * np.sign(reference_a)
    missing_a = size_a - along_a
    # σ of normal noise by its median absolute deviation
    deviation_a = np.abs(missing_a - np.median(missing_a))
    noise_a = float(np.median(deviation_a)) / 0.6745
    is_missing = missing_a > BEYOND_SIGMAS * noise_a
    if np.count_nonzero(is_missing) < LEAST_ROWS:
        return None
    given_a = along_a[is_missing]
    limit_a = float(np.median(given_a))
    plateau_end_a = (1.0 + 2.0 * PLATEAU) * limit_a
    is_well_beyond = size_a > plateau_end_a
    if limit_a <= 0.0 or np.count_nonzero(is_well_beyond) < LEAST_ROWS:
        return None
    is_on_plateau = np.abs(given_a - limit_a) <= PLATEAU * limit_a
    slope, _ = np.polyfit(size_a[is_missing], given_a, 1)
    is_flat = slope <= LARGEST_SLOPE and np.mean(is_on_plateau) >= LEAST_ON_PLATEAU
    # Nothing is given beyond the plateau, and nearly every reference there misses something.
    nothing_beyond = np.max(along_a) <= plateau_end_a
    misses_beyond = np.mean(is_missing[is_well_beyond]) >= LEAST_MISSING
    if is_flat and nothing_beyond and misses_beyond:
        return limit_a
    return None
