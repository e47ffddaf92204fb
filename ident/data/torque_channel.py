"""The controller's own torque against the current: its slope is a second opinion on the drive gain.

A drive that reports a torque computes it, from its current and the torque constant that was entered
at commissioning. The slope of that torque over the recorded current shows this constant. No fit
uses it: an entered number must not look like a measured one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray, IntArray

BLOCK_S = 1.0  #: Residuals of one second are taken as correlated: loops and filters are far faster
FEWEST_BLOCKS = 5  #: With fewer, their scatter gives no σ
#: Least standard deviation of the current over its root mean square: else there is no slope
SMALLEST_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class TorqueChannel:
    """Readings of one axis in one run; arrays have the shape (m,)."""

    time_s: FloatArray  #: on the clock of the samples, increasing
    current_a: FloatArray  #: recorded current at that time
    nearby_a: FloatArray  #: recorded current shortly before and after, whose noise is independent
    #: torque of the motor by its drive, seen at its joint (× N) [Nm; N for a prismatic joint]
    torque_nm: FloatArray


@dataclass(frozen=True, slots=True)
class TorqueSlope:
    """Slope of an axis's own torque over its current."""

    value: float  #: [Nm/A at the joint, or the unit of the gain]
    std: float  #: its standard deviation by the scatter of the readings
    readings: int  #: number of readings


def torque_slope(channels: Sequence[TorqueChannel]) -> TorqueSlope | None:
    """Fit τ = s·v + o to the readings of an axis, with another offset o for each run.

    By least squares the noise of the current v would make the slope too small (errors in
    variables). The current nearby is the instrument z: it follows the same motion, and its noise is
    another. σ is that of a sandwich over blocks of BLOCK_S (Liang & Zeger, Biometrika 73 (1986)),
    because neighbouring readings share their errors e:

        s = Σ z τ / Σ z v,    σ² = B/(B − 1) · Σ_b (Σ_{k∈b} z_k e_k)² / (Σ z v)²,

    with B blocks, and z, v and τ counted from their means over the run.

    Args:
        channels: of one axis, one a run.

    Returns:
        the slope; None with readings of fewer than FEWEST_BLOCKS seconds, or where the current
        hardly changes or the torque not at all.
    """
    runs = [channel for channel in channels if len(channel.time_s) > 1]
    if not runs:
        return None
    nearby = _about_means([run.nearby_a for run in runs])
    current = _about_means([run.current_a for run in runs])
    torque = _about_means([run.torque_nm for run in runs])
    recorded = np.concatenate([run.current_a for run in runs])
    root_mean_square = np.sqrt(np.mean(recorded**2))
    current_changes = np.std(current) > SMALLEST_SHARE * root_mean_square
    blocks = _blocks(runs)
    count = len(np.unique(blocks))
    if count < FEWEST_BLOCKS or not current_changes or not torque.any():
        return None
    gram = float(nearby @ current)
    slope = float(nearby @ torque) / gram
    errors = torque - slope * current
    scores = np.bincount(blocks, weights=nearby * errors)
    variance = count / (count - 1) * float(scores @ scores)
    std = float(np.sqrt(variance)) / abs(gram)
    return TorqueSlope(slope, std, len(current))


def _about_means(runs: Sequence[FloatArray]) -> FloatArray:
    """Readings of all runs, counted from the mean of each."""
    return np.concatenate([values - values.mean() for values in runs])


def _blocks(runs: Sequence[TorqueChannel]) -> IntArray:
    """Number of the block of each reading, shape (m,); blocks end with their run."""
    first = 0
    parts: list[IntArray] = []
    for run in runs:
        since_start_s = run.time_s - run.time_s[0]
        part = (since_start_s / BLOCK_S).astype(np.int64) + first
        parts.append(part)
        first = int(part.max()) + 1
    return np.concatenate(parts)
