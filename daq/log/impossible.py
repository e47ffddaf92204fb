"""Numbers that no robot moves by, in a recording of our own as in an import:
one judgement for both.

Readings that are none are found by `ident.data.channel_faults`, without a description of the robot.
With its limits, a step between two samples may be one that no motor makes, and a wrong scale makes
every speed impossible; an outlier of the currents is none. Each function returns what it found,
with the axis and the sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from daq.config.cell import Cell, CellAxis
from daq.errors import CurrentImplausible, DataError, PositionImplausible
from ident.arrays import BoolArray, FloatArray
from ident.data.channel_faults import ChannelFault, ChannelKind, refused_fault
from ident.data.fault_text import expected, found, remedy

LARGEST_OUTLIER = 1000.0
"""Largest current, in multiples of the 99th percentile of its column;
a real peak is some ten times that.
"""
SPEED_MARGIN = 3.0
"""Largest speed, in multiples of the joint's velocity limit, which is often a guess;
a wrong rate is off by more.
"""
SPEED_PERCENTILE = 99.9
"""Percentile of a run's speeds that is compared with the limit:
a few outliers do not mean a wrong rate.
"""
STEP_NOISE = 10.0
STEP_PERCENTILE = 95.0
STEP_OUTLIER = 5.0
"""A step between two samples is refused beyond SPEED_MARGIN, by this multiple of the typical change
of a step (noise, coarse encoders), if it is this multiple of that percentile of all steps: a wrong
rate makes all of them larger.
"""
NOISE_SHARE = 0.01
NOISE_CHANGES = 20
SPARSE_NOISE = 0.005
"""Where fewer samples than this share, or than this number, change their step at all, as of an axis
at rest, the changes may be the glitch itself: as noise they then count up to this share of the
joint's range.
"""
GLITCH_SAMPLES = 10
ABSURD = 1e6
"""An outlier has at most so many samples above a tenth of it, where a short motion has more;
or it is so many times the 99th percentile, which no current is.
"""


@dataclass(frozen=True, slots=True)
class Impossible:
    """A number among the samples that no robot moves by."""

    axis: int  #: index of the axis
    row: int  #: index of the sample
    found: str
    expected: str

    def error(self, kind: type[DataError], subject: str, remedy: str) -> DataError:
        """Make the error for it."""
        return kind(subject, found=self.found, expected=self.expected, remedy=remedy)


def impossible_current(current: FloatArray) -> Impossible | None:
    """Return the first current that is an outlier, None without one.

    Args:
        current: of the motors, in any unit, shape (k, n).
    """
    size = np.abs(current)
    usual = np.percentile(size, 99.0, axis=0)
    others = usual[usual > 0.0]
    # An axis whose current is almost always zero is compared with the other one of the smallest
    # current.
    least = float(others.min()) if others.size else 0.0
    for axis, own in enumerate(usual.tolist()):
        column = size[:, axis]
        row = int(np.argmax(column))
        peak = float(column[row])
        compared = own if own > 0.0 else least
        is_rare = np.count_nonzero(column > 0.1 * peak) <= GLITCH_SAMPLES
        times = LARGEST_OUTLIER if is_rare else ABSURD
        if peak > times * max(compared, 1e-200):
            found = f"{current[row, axis]:.6g}, while 99 % of the column are within {own:.3g}"
            return Impossible(axis, row, found, "a current")
    return None


def impossible_speed(joint_rad: FloatArray, rate_hz: float, cell: Cell) -> Impossible | None:
    """Return the first axis that is too fast over many samples, far above the noise;
    None without one.

    Args:
        joint_rad: positions of the joints [rad; m of a prismatic joint], shape (k, n).
        rate_hz: rate of the samples.
        cell: with the velocity limits.
    """
    step = _speed_samples(joint_rad, rate_hz)
    fastest = fastest_speeds(joint_rad, rate_hz)
    for index, axis in enumerate(cell.axes):
        limit = axis.limits.velocity
        if fastest[index] > SPEED_MARGIN * limit:
            found = (
                f"{axis.unit.spell(float(fastest[index]))}/s over {step} samples at {rate_hz:g} Hz"
            )
            return Impossible(index, 0, found, _speed_limit(axis))
    return None


def impossible_step(joint_rad: FloatArray, rate_hz: float, cell: Cell) -> Impossible | None:
    """Return the first step between two samples that no motor makes, None without one.

    Args:
        joint_rad: positions of the joints [rad; m of a prismatic joint], shape (k, n).
        rate_hz: rate of the samples.
        cell: with the velocity limits.
    """
    steps = np.diff(joint_rad, axis=0)
    if not len(steps):
        return None
    changes = np.abs(np.diff(steps, axis=0))
    for index, axis in enumerate(cell.axes):
        sizes = np.abs(steps[:, index])
        step = int(np.argmax(sizes))
        size = float(sizes[step])
        usual = float(np.percentile(sizes, STEP_PERCENTILE))
        lower, upper = axis.limits.position
        noise = _step_noise(changes[:, index], upper - lower)
        largest = SPEED_MARGIN * axis.limits.velocity / rate_hz + noise
        if size > max(largest, STEP_OUTLIER * usual):
            found = (
                f"a step of {axis.unit.spell(size)} in one sample, "
                f"{axis.unit.spell(size * rate_hz)}/s"
            )
            return Impossible(index, step + 1, found, _speed_limit(axis))
    return None


def _step_noise(changes: FloatArray, range_rad: float) -> float:
    """Largest step that noise or a coarse encoder makes [rad or m],
    from the changes of an axis's steps, shape (k,).
    """
    typical = changes[changes > 0.0]
    if not typical.size:
        return 0.0
    noise = STEP_NOISE * float(np.median(typical))
    if typical.size < max(NOISE_SHARE * len(changes), NOISE_CHANGES):
        return min(noise, SPARSE_NOISE * range_rad)
    return noise


def _speed_limit(axis: CellAxis) -> str:
    limit = axis.unit.spell(axis.limits.velocity)
    largest = axis.unit.spell(SPEED_MARGIN * axis.limits.velocity)
    return (
        f"at most {largest}/s, {SPEED_MARGIN:g} times {limit}/s, the limit in the cell "
        "configuration"
    )


def _speed_samples(joint_rad: FloatArray, rate_hz: float) -> int:
    """Samples over which a speed is measured:
    a tenth of a second, and at most a tenth of the run.
    """
    return max(1, min(round(0.1 * rate_hz), len(joint_rad) // 10))


def fastest_speeds(joint_rad: FloatArray, rate_hz: float) -> FloatArray:
    """Speed of each axis that a few outliers do not raise [rad/s or m/s], shape (n,)."""
    step = _speed_samples(joint_rad, rate_hz)
    speeds = np.abs(joint_rad[step:] - joint_rad[:-step]) * rate_hz / step
    if not len(speeds):
        return np.zeros(joint_rad.shape[1])
    return np.percentile(speeds, SPEED_PERCENTILE, axis=0)


def between_answers(joint_rad: FloatArray, answered: BoolArray) -> FloatArray:
    """Return positions with straight lines in the place of samples without an answer, shape (k, n).

    An unanswered sample says nothing of the position, and must not count as a step.

    Args:
        joint_rad: positions of the joints [rad; m of a prismatic joint], shape (k, n).
        answered: whether every motor that moves the joint answered, shape (k, n).
    """
    if answered.all():
        return joint_rad
    filled = joint_rad.copy()
    every = np.arange(len(joint_rad))
    for axis in np.flatnonzero(~answered.all(axis=0) & answered.any(axis=0)).tolist():
        known = answered[:, axis]
        filled[:, axis] = np.interp(every, every[known], joint_rad[known, axis])
    filled[:, ~answered.any(axis=0)] = 0.0
    return filled


_GLITCH = (
    "record again, and check the encoder, its cable and the object that the drive sends; a counter "
    "of fewer than 32 bits that wraps is read as a step"
)


def motion_fault(
    name: str,
    cell: Cell,
    rate_hz: float,
    position_rad: FloatArray,
    current: FloatArray,
    answered: BoolArray,
    faults: Sequence[ChannelFault],
) -> DataError | None:
    """Return the error for a recording of our own that no robot moves by, None for a plausible one.

    Args:
        name: of the recording in the message.
        cell: with the limits.
        rate_hz: rate of the samples.
        position_rad: joint positions [rad; m of a prismatic joint], shape (k, n).
        current: of the motors, shape (k, n).
        answered: whether every motor that moves the joint answered, shape (k, n).
        faults: of its channels (`ident.data.channel_faults.find_faults`).
    """
    damaged = refused_fault(faults, displaced=False)
    if damaged is not None:
        return fault_error(damaged, name, cell)
    known_rad = between_answers(position_rad, answered)
    step = impossible_step(known_rad, rate_hz, cell)
    if step is not None:
        timed = replace(step, found=f"{step.found}, at {step.row / rate_hz:.6g} s")
        return timed.error(PositionImplausible, _axis_of(step, name, cell), _GLITCH)
    speed = impossible_speed(known_rad, rate_hz, cell)
    if speed is not None:
        check = (
            "check `drive_train.ratio`, `counts_per_revolution` and the velocity limit in the "
            "cell file"
        )
        return speed.error(PositionImplausible, _axis_of(speed, name, cell), check)
    displaced = refused_fault(faults, displaced=True)
    if displaced is not None:
        return fault_error(displaced, name, cell)
    outlier = impossible_current(current)
    if outlier is not None:
        timed = replace(
            outlier, found=f"a current of {outlier.found}, at {outlier.row / rate_hz:.6g} s"
        )
        check = "record again, and check the object that the drive sends as its current"
        return timed.error(CurrentImplausible, _axis_of(outlier, name, cell), check)
    return None


def fault_error(fault: ChannelFault, name: str, cell: Cell) -> DataError:
    """Return the error for readings that are none.

    Args:
        fault: of a channel, that nothing mends.
        name: of the recording in the message.
        cell: with the names of the axes.
    """
    kind = PositionImplausible if fault.quantity is ChannelKind.POSITION else CurrentImplausible
    subject = f"{name}, axis {cell.axes[fault.axis].name}"
    return kind(subject, found=found(fault), expected=expected(fault), remedy=remedy(fault))


def _axis_of(found: Impossible, name: str, cell: Cell) -> str:
    return f"{name}, axis {cell.axes[found.axis].name}"
