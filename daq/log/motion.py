"""Judge the motion in a log wherever a log is called valid:
at the end of its recording, by `info`, by the exports.

A fit refuses a log that no robot moves by (`daq.log.impossible.motion_fault`); what is said of a
log before agrees.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import Cell
from daq.log.conversion import answers, continuous_counts, scaling
from daq.log.impossible import LARGEST_OUTLIER, SPEED_MARGIN, motion_fault
from daq.log.message import RawArray
from daq.log.metadata import Readback, RunStatistics
from daq.log.reader import LogHead, LogReader, SampleBlock, SampleChecks, joined
from drivers.messages import Sample
from ident.data.channel_faults import find_faults


def motion_reason(
    cell: Cell,
    readback: Readback,
    rate_hz: float,
    position_counts: RawArray,
    current_raw: RawArray,
    missing: NDArray[np.uint32],
) -> str:
    """Return why no robot moves by the samples of a log, with the axis; empty where one may.

    Args:
        cell: with the limits.
        readback: answers of the amplifiers.
        rate_hz: rate of the samples.
        position_counts: positions of the motors, shape (k, n).
        current_raw: currents of the motors, shape (k, n).
        missing: bit i for axis i without an answer, shape (k,).

    Raises:
        LogIncomplete: cell and readback do not belong together.
    """
    scale = scaling(cell, readback)
    position_rad = scale.joint_position(continuous_counts(position_counts, readback))
    known = scale.joints_known(answers(missing, len(cell.axes)))
    current = current_raw * scale.current_per_unit
    faults = find_faults(position_rad, current, rate_hz, cell.ratio, known)
    fault = motion_fault("", cell, rate_hz, position_rad, current, known, faults)
    if fault is None:
        return ""
    axis = fault.subject.removeprefix(", ")
    return f"{axis}: {fault.found}"


#: Samples of a block that are judged with the next one, too: more than what a fault is compared
#: with
OVERLAP = 200


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """What is judged of some samples."""

    position_counts: RawArray  #: shape (k, n)
    current_raw: RawArray  #: shape (k, n)
    missing: NDArray[np.uint32]  #: bit i for axis i without an answer, shape (k,)

    def after(self, before: _Samples) -> _Samples:
        """Return these samples after others."""
        position_counts = np.concatenate((before.position_counts, self.position_counts))
        current_raw = np.concatenate((before.current_raw, self.current_raw))
        missing = np.concatenate((before.missing, self.missing))
        return _Samples(position_counts, current_raw, missing)

    def last(self, count: int) -> _Samples:
        """Return so many of the last samples."""
        return _Samples(
            position_counts=self.position_counts[-count:],
            current_raw=self.current_raw[-count:],
            missing=self.missing[-count:],
        )


class MotionWatch:
    """Finds block by block, in bounded memory, the logs of which all samples have to be judged:
    few have a fault.

    What it does not suspect, `motion_fault` does not refuse: a speed over many samples has a step
    as fast among them, the 99th percentile of a current is at least the smallest one of the blocks,
    a fault of a channel begins or ends in one of them, and a current that lost its sign goes
    through most of its range in a step.
    """

    def __init__(self, cell: Cell, head: LogHead) -> None:
        """Store the cell of a log, and what is before its samples."""
        self._cell = cell
        self._rate_hz = head.run.rate_hz
        self._readback = head.readback
        self._scale = scaling(cell, head.readback)
        self._limits = np.array([axis.limits.velocity for axis in cell.axes])
        self._tail: _Samples | None = None
        self._is_faulty = False
        self._fastest = 0.0  # in multiples of the velocity limit
        self._peak = np.zeros(len(cell.axes))
        self._usual = np.full(len(cell.axes), np.inf)
        self._lowest = np.full(len(cell.axes), np.inf)
        self._highest = np.full(len(cell.axes), -np.inf)
        self._current_step = np.zeros(len(cell.axes))

    def take(self, block: SampleBlock) -> None:
        """Take the next samples."""
        if block.position_counts.shape[1] != len(self._limits):
            return  # the reader refuses the log at its end
        samples = _Samples(block.position_counts, block.current_raw, block.missing)
        if self._tail is not None:
            samples = samples.after(self._tail)
        self._tail = samples.last(OVERLAP)
        motor_counts = continuous_counts(samples.position_counts, self._readback)
        position_rad = self._scale.joint_position(motor_counts)
        step_rad = np.abs(np.diff(position_rad, axis=0))
        speeds = step_rad * self._rate_hz / self._limits
        if speeds.size:
            self._fastest = max(self._fastest, float(speeds.max()))
        size = np.abs(block.current_raw.astype(np.float64))
        usual = np.percentile(size, 99.0, axis=0)
        self._peak = np.maximum(self._peak, size.max(axis=0))
        self._usual = np.minimum(self._usual, usual)
        current = samples.current_raw.astype(np.float64)
        self._lowest = np.minimum(self._lowest, current.min(axis=0))
        self._highest = np.maximum(self._highest, current.max(axis=0))
        steps = np.abs(np.diff(current, axis=0))
        largest_step = steps.max(axis=0, initial=0.0)
        self._current_step = np.maximum(self._current_step, largest_step)
        if not self._is_faulty:
            answered = answers(samples.missing, len(self._limits))
            known = self._scale.joints_known(answered)
            faults = find_faults(position_rad, current, self._rate_hz, self._cell.ratio, known)
            self._is_faulty = bool(faults)

    def verdict(
        self,
        checks: SampleChecks,
        statistics: RunStatistics,
        again: Callable[[], Iterable[SampleBlock]],
    ) -> tuple[bool, str]:
        """Return whether the log is valid by its recorder, its cycles and its motion, and why not.

        Args:
            checks: that took every block.
            statistics: of its recorder.
            again: reads the blocks once more, where all samples have to be judged together.
        """
        valid, reason = checks.verdict(self._rate_hz, statistics)
        outlier = self._peak > LARGEST_OUTLIER * self._usual
        current_range = self._highest - self._lowest
        lost_sign = self._current_step > 0.5 * current_range
        is_fast = self._fastest > SPEED_MARGIN
        is_suspected = self._is_faulty or is_fast or np.any(outlier | lost_sign)
        if not valid or not is_suspected:
            return valid, reason
        samples = joined(again())
        found = motion_reason(
            self._cell,
            self._readback,
            self._rate_hz,
            samples.position_counts,
            samples.current_raw,
            samples.missing,
        )
        return not found, found or reason


def judge_log(path: Path) -> tuple[LogReader, Cell, tuple[bool, str]]:
    """Read a whole log in bounded memory.

    Returns:
        its reader, which has read all; the cell in it; whether it is valid, and why not.

    Raises:
        LogUnreadable: the log cannot be read, or its parts contradict each other.
        ConfigurationError: the cell in it is inconsistent.
    """
    reader = LogReader(path)
    watch: MotionWatch | None = None
    for block in reader:
        if watch is None:
            cell = reader.head.cell(path)
            watch = MotionWatch(cell, reader.head)
        watch.take(block)
    assert watch is not None  # the reader refuses a log without samples
    verdict = watch.verdict(reader.checks, reader.statistics, lambda: LogReader(path))
    return reader, cell, verdict


class RecordedMotion:
    """Positions and currents of a recording, by which it is judged at its end:
    8 bytes for each sample of an axis.
    """

    def __init__(self, axes: int) -> None:
        """Store the number of axes."""
        self._axes = axes
        self._position_counts = array("i")
        self._current_raw = array("i")
        self._missing = array("I")

    def take(self, sample: Sample) -> None:
        """Take the next sample."""
        self._position_counts.extend(sample.position_counts)
        self._current_raw.extend(sample.current_raw)
        self._missing.append(sample.missing)

    def reason(self, cell: Cell, readback: Readback, rate_hz: float) -> str:
        """Return why no robot moves by the recording; empty where one may."""
        if not self._missing:
            return ""
        shape = len(self._missing), self._axes
        position_counts = np.frombuffer(self._position_counts, dtype=np.int32).reshape(shape)
        current_raw = np.frombuffer(self._current_raw, dtype=np.int32).reshape(shape)
        missing = np.frombuffer(self._missing, dtype=np.uint32)
        return motion_reason(cell, readback, rate_hz, position_counts, current_raw, missing)
