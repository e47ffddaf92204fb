"""One judgement of the channels of a recording:
what is wrong with single numbers, and whether it can be mended.

Arrays, native logs and imports are judged alike, each where it is read. A glitch is filled in. A
stretch in which a channel froze, or stood at the limit of its range, is left out. Of a counter that
wraps, a signed number that is read as an unsigned one, and an encoder that lost its place, nothing
says what is right: such a recording is refused, and so is one of which too much is wrong. Held
readings are in `ident.data.held`, currents at a limit in `ident.data.clipping`, and currents of
which only the size was recorded in `ident.data.unsigned_current`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.frozen import (
    clipped_position,
    frozen_current,
    frozen_position,
    frozen_to_the_end,
    usual_step,
)
from ident.data.glitches import Jumps, Readings, find_jumps, smallest_change, upper_part, wrap_size
from ident.data.held import fill_damaged, longest_cubic_fill, samples_to_fill

LARGEST_GLITCHED_SHARE = 0.01  #: Largest share of the samples of a channel that is filled in
LARGEST_FROZEN_SHARE = 0.1  #: Largest share of the samples that is left out
LOST_PLACE_RATIO = 3.0
"""Least step by which an encoder loses its place, as a multiple of the largest usual step of the
position.
"""
MOTOR_UNIT = "rad of the motor"
JOINT_UNIT = "rad or m of the joint"
MOTOR_ANGLE_DIGITS = 12
"""Decimals of a motor angle of several joints, in units of the largest Σ |R| |q|."""


class ChannelKind(Enum):
    """What a channel holds."""

    POSITION = "position"
    CURRENT = "current"


class FaultKind(Enum):
    """What is wrong with a channel."""

    GLITCH = "glitch"
    FROZEN = "frozen"
    CLIPPED = "clipped"
    WRAPPING = "wrapping"
    UNSIGNED = "unsigned"
    DISPLACED = "displaced"


@dataclass(frozen=True, slots=True, eq=False)
class ChannelFault:
    """Something wrong with one channel of a recording."""

    kind: FaultKind
    quantity: ChannelKind
    axis: int  #: index of the motor, or of the joint where the unit is JOINT_UNIT
    stretches: IntArray  #: first sample and end of each, shape (s, 2)
    #: In the unit of the channel: largest distance of a glitch from the values around it, range of
    #: a counter that wraps, usual step of an unsigned one, largest step of one that is displaced; 0
    #: of one that is frozen or clipped
    size: float
    samples: int  #: of the recording
    rate_hz: float  #: of the recording
    count: float = 0.0  #: smallest change that the channel can show
    unit: str = ""  #: of the channel, for messages

    @property
    def share(self) -> float:
        """Share of the samples of the recording."""
        return float(np.sum(self.stretches[:, 1] - self.stretches[:, 0])) / self.samples

    @property
    def first(self) -> int:
        """First sample that is wrong."""
        return int(self.stretches[0, 0])

    @property
    def is_refused(self) -> bool:
        """Whether the recording cannot be used."""
        if self.kind is FaultKind.GLITCH:
            return self.share > LARGEST_GLITCHED_SHARE
        if self.kind is FaultKind.FROZEN:
            return self.share > LARGEST_FROZEN_SHARE
        # A clipped position may be right: a simple device may have stopped the joint at the end of
        # its range. The other kinds cannot be mended.
        return self.kind is not FaultKind.CLIPPED

    @property
    def is_filled(self) -> bool:
        """Whether its samples are filled in."""
        return self.kind is FaultKind.GLITCH

    @property
    def is_left_out(self) -> bool:
        """Whether its samples are left out."""
        return self.kind in {FaultKind.FROZEN, FaultKind.CLIPPED}


def find_faults(
    position: FloatArray,
    current: FloatArray,
    rate_hz: float,
    ratio: FloatArray | None = None,
    usable: BoolArray | None = None,
    unit: str = MOTOR_UNIT,
) -> tuple[ChannelFault, ...]:
    """Judge the channels of a recording.

    Args:
        position: of the joints, or of whatever was recorded, shape (k, n).
        current: of the motors, shape (k, n).
        rate_hz: sampling rate.
        ratio: R of the drive train, motor angles are R q (paper eq. 24), shape (n, n); None where
            each column was recorded as it is.
        usable: samples that count, shape (k, n); faults elsewhere are known, and not returned.
            None where every sample counts.
        unit: of the columns of positions, for messages.

    Returns:
        what is wrong, positions first, by axis.
    """
    if len(position) < 2:
        return ()
    samples = len(position)
    recorded = position
    if ratio is not None:
        recorded = motor_positions(position, ratio)
    found: list[ChannelFault] = []
    for axis, readings in enumerate(_readings(recorded, rate_hz)):
        others = np.delete(recorded, axis, axis=1)
        place = ChannelPlace(ChannelKind.POSITION, axis, samples, unit)
        found += _position_faults(readings, others, place)
    if ratio is not None:
        found = _with_coupled_joints(found, position, ratio, rate_hz)
    for axis, readings in enumerate(_readings(current, rate_hz)):
        place = ChannelPlace(ChannelKind.CURRENT, axis, samples)
        found += _current_faults(readings, recorded[:, axis], place)
    if usable is None:
        return tuple(found)
    return faults_in_use(found, usable)


@dataclass(frozen=True, slots=True, eq=False)
class JudgedChannels:
    """All that is wrong with the channels of a recording, whether a sample is used or not.

    The reader of a log judges it once, and stores the result in the run. `differentiate` takes it
    from there.
    """

    position: FloatArray  #: of the joints, as of `find_faults`
    current: FloatArray  #: of the motors
    ratio: FloatArray  #: R of the drive train
    faults: tuple[ChannelFault, ...]

    def answers_for(self, position: object, current: object, ratio: FloatArray) -> bool:
        """Whether these are the arrays that were judged, not copies of them, and R is the same."""
        are_same_arrays = position is self.position and current is self.current
        return are_same_arrays and np.array_equal(ratio, self.ratio)


def faults_in_use(faults: Sequence[ChannelFault], usable: BoolArray) -> tuple[ChannelFault, ...]:
    """Return the faults in samples that count.

    A stretch stays where each of its samples counts, and the sample before it.

    Args:
        faults: of all samples.
        usable: samples that count, shape (k, n).
    """
    found: list[ChannelFault] = []
    for one in faults:
        is_unused = ~usable[:, one.axis]
        unused_before = np.concatenate(([0], np.cumsum(is_unused)))
        # A fault is seen by the step that leads to it, from the sample before.
        first = np.maximum(one.stretches[:, 0] - 1, 0)
        end = one.stretches[:, 1]
        is_in_use = unused_before[end] == unused_before[first]
        if np.any(is_in_use):
            found.append(replace(one, stretches=one.stretches[is_in_use]))
    return tuple(found)


def motor_positions(position: FloatArray, ratio: FloatArray) -> FloatArray:
    """Return what the encoders of the motors have read, shape (k, n).

    A reading that repeats does so exactly, also where it is computed of several joints.

    Args:
        position: of the joints, shape (k, n).
        ratio: R of the drive train, shape (n, n).
    """
    motor_rad = np.empty_like(position)
    for motor, row in enumerate(ratio):
        joints = np.flatnonzero(row)
        of_joints = position[:, joints]
        ratios = row[joints]
        turned = of_joints @ ratios
        largest = float(np.max(np.abs(of_joints) @ np.abs(ratios)))
        if len(joints) > 1 and largest > 0.0:
            # The sum over joints has rounding errors, with which nothing would repeat.
            turned = np.round(turned / largest, MOTOR_ANGLE_DIGITS) * largest
        motor_rad[:, motor] = turned
    return motor_rad


def _turned_by(ratio: FloatArray) -> BoolArray:
    """Whether a joint (row) is turned by a motor (column), shape (n, n): q_joint = R⁻¹ q_motor."""
    share_of_motor = np.abs(np.linalg.inv(ratio))
    rounding = 1e-12 * share_of_motor.max()
    return np.asarray(share_of_motor > rounding, dtype=np.bool_)


def _with_coupled_joints(
    motors: Sequence[ChannelFault], position: FloatArray, ratio: FloatArray, rate_hz: float
) -> list[ChannelFault]:
    """Add the faults of joints that several motors turn: their encoders may be at the joints.

    A joint is judged where its motors have no fault, or are only displaced. Where the encoder of a
    joint freezes and later goes on, the position jumps at the end, and so do those of its motors.
    Where the joint is found frozen or clipped, its fault takes the place of the motors' steps.
    Other faults of the joint are added only where its motors have none.

    Args:
        motors: faults of the positions of the motors.
        position: of the joints, shape (k, n).
        ratio: R of the drive train, shape (n, n).
        rate_hz: sampling rate.
    """
    found = list(motors)
    turned_by = _turned_by(ratio)
    coupled = np.flatnonzero(np.count_nonzero(turned_by, axis=1) > 1).tolist()
    for joint, readings in zip(coupled, _readings(position[:, coupled], rate_hz), strict=True):
        of_motors = [one for one in motors if turned_by[joint, one.axis]]
        if any(one.kind is not FaultKind.DISPLACED for one in of_motors):
            continue
        others = np.delete(position, joint, axis=1)
        place = ChannelPlace(ChannelKind.POSITION, joint, len(position), JOINT_UNIT)
        faults = list(_position_faults(readings, others, place))
        has_left_out = any(one.is_left_out for one in faults)
        if has_left_out:
            found = [one for one in found if one not in of_motors]
        if has_left_out or not of_motors:
            found += faults
    return found


def refused_fault(faults: Sequence[ChannelFault], *, displaced: bool) -> ChannelFault | None:
    """Return the first fault that nothing mends, None without one.

    Args:
        faults: of the recording.
        displaced: whether to look for positions that go on displaced, or for every other fault.
            The limits of the robot may explain a displaced position better, so a caller looks for
            the other faults first, then at the limits, then for these.
    """
    for one in faults:
        if one.is_refused and (one.kind is FaultKind.DISPLACED) is displaced:
            return one
    return None


def replaced_samples(
    faults: Sequence[ChannelFault],
    quantity: ChannelKind,
    shape: tuple[int, ...],
    ratio: FloatArray | None = None,
) -> BoolArray:
    """Samples of each column that are to be replaced by those around them, shape (k, n).

    Currents that are left out stay as they are: nothing depends on them. Positions do not, because
    filters would spread their steps.

    Args:
        faults: of the recording.
        quantity: of the columns.
        shape: of the columns.
        ratio: R of the drive train, where the columns are joints, shape (n, n).
    """
    turned_by = None
    if ratio is not None:
        turned_by = _turned_by(ratio)
    marked = np.zeros(shape, dtype=np.bool_)
    for one in faults:
        is_replaced = one.is_filled
        if one.quantity is ChannelKind.POSITION and one.is_left_out:
            is_replaced = True
        if one.quantity is not quantity or not is_replaced:
            continue
        columns = np.array([one.axis])
        # A joint whose own encoder was read is a column itself; a motor turns one or several.
        if turned_by is not None and one.unit != JOINT_UNIT:
            columns = np.flatnonzero(turned_by[:, one.axis])
        for first, end in one.stretches.tolist():
            marked[first:end, columns] = True
    return marked


def mended(
    values: FloatArray,
    faults: Sequence[ChannelFault],
    rate_hz: float,
    ratio: FloatArray | None = None,
    quantity: ChannelKind = ChannelKind.POSITION,
    time: FloatArray | None = None,
) -> FloatArray:
    """Return channels, shape (k, n), in which samples that are no readings are replaced by those
    around them; the same array where every sample is a reading.

    Args:
        values: positions or currents, as of `find_faults`.
        faults: of the recording.
        rate_hz: sampling rate.
        ratio: as of `find_faults`, for positions.
        quantity: of the values.
        time: of each sample, in any unit, shape (k,); None for a constant rate.
    """
    replaced = replaced_samples(faults, quantity, values.shape, ratio)
    if not np.any(replaced):
        return values
    longest_cubic = 0
    if quantity is ChannelKind.POSITION:
        longest_cubic = longest_cubic_fill(rate_hz)
    columns: list[FloatArray] = []
    for channel, is_replaced in zip(values.T, replaced.T, strict=True):
        filled = fill_damaged(channel, is_replaced, longest_cubic, time)
        columns.append(filled)
    return np.stack(columns, axis=1)


def left_out_samples(
    faults: Sequence[ChannelFault], shape: tuple[int, ...], margin: int
) -> BoolArray:
    """Samples of each axis that are to be left out, shape (k, n).

    Every torque depends on every position. Around a position that is not known, filters spread what
    is assumed of it.

    Args:
        faults: of the recording.
        shape: of its positions.
        margin: samples that are left out before and after the fault of a position.
    """
    out = np.zeros(shape, dtype=np.bool_)
    for one in faults:
        if not one.is_left_out:
            continue
        for first, end in one.stretches.tolist():
            if one.quantity is ChannelKind.POSITION:
                begin = max(first - margin, 0)
                out[begin : end + margin] = True
            else:
                out[first:end, one.axis] = True
    return out


@dataclass(frozen=True, slots=True)
class ChannelPlace:
    """Which channel of a recording is judged."""

    quantity: ChannelKind
    axis: int  #: index
    samples: int  #: of the recording
    unit: str = ""  #: of the channel, for messages

    def fault(
        self, kind: FaultKind, readings: Readings, stretches: IntArray, size: float = 0.0
    ) -> ChannelFault:
        """Make a fault of this channel."""
        return ChannelFault(
            kind=kind,
            quantity=self.quantity,
            axis=self.axis,
            stretches=stretches,
            size=size,
            samples=self.samples,
            rate_hz=readings.rate_hz,
            count=readings.count,
            unit=self.unit,
        )


def _readings(channels: FloatArray, rate_hz: float) -> Iterator[Readings]:
    """Yield the readings of each channel, shape (k, c), without samples that repeat a reading.

    Where a channel changes too seldom to show its count, the coarsest count of the others is taken.
    """
    counts = [smallest_change(values) for values in channels.T]
    coarsest = 0.0
    for count in counts:
        if count is not None:
            coarsest = max(coarsest, count)
    for values, count in zip(channels.T, counts, strict=True):
        held = samples_to_fill(values, rate_hz)
        if held is None:
            sample = np.arange(len(values))
        else:
            sample = np.flatnonzero(~held)
        own_count = coarsest
        if count is not None:
            own_count = count
        yield Readings(values[sample], sample, rate_hz, own_count)


def _position_faults(
    readings: Readings, others: FloatArray, place: ChannelPlace
) -> Iterator[ChannelFault]:
    """Judge a position.

    Args:
        readings: of the position.
        others: positions of the other columns, shape (k, n − 1). Where none of them moves any more,
            a position that stays to the end is at rest, not frozen.
        place: which channel it is.
    """
    jumps = find_jumps(readings, is_position=True)
    counter_range = wrap_size(readings, jumps, is_position=True)
    if counter_range is not None:
        stretches = _steps(readings, jumps.step)
        yield place.fault(FaultKind.WRAPPING, readings, stretches, counter_range)
        return
    if jumps.glitches:
        stretches = _glitched(readings, jumps)
        yield place.fault(FaultKind.GLITCH, readings, stretches, _largest_glitch(jumps))
    without_glitches = _without(readings, jumps)
    frozen_within = frozen_position(without_glitches)
    frozen_at_end = frozen_to_the_end(without_glitches, others)
    frozen = np.concatenate((frozen_within, frozen_at_end))
    if len(frozen):
        yield place.fault(FaultKind.FROZEN, readings, frozen)
    else:
        clipped = clipped_position(without_glitches)
        if len(clipped):
            yield place.fault(FaultKind.CLIPPED, readings, clipped)
    lost = _lost_place(readings, jumps, frozen)
    if np.any(lost):
        size = float(np.max(np.abs(jumps.step_size[lost])))
        stretches = _steps(readings, jumps.step[lost])
        yield place.fault(FaultKind.DISPLACED, readings, stretches, size)


def _lost_place(readings: Readings, jumps: Jumps, frozen: IntArray) -> BoolArray:
    """Steps after which a position goes on displaced, shape (s,),
    without those at the ends of frozen stretches.
    """
    is_large = np.abs(jumps.step_size) > LOST_PLACE_RATIO * usual_step(readings)
    # A step leaves a stretch where the sample after the one before the step is the stretch's end,
    # and enters it where the sample after the step is the stretch's first.
    leaves_frozen = np.isin(readings.sample[jumps.step] + 1, frozen)
    enters_frozen = np.isin(readings.sample[jumps.step + 1], frozen)
    is_end_of_frozen = leaves_frozen | enters_frozen
    return np.asarray(is_large & ~is_end_of_frozen)


def _current_faults(
    readings: Readings, motor_rad: FloatArray, place: ChannelPlace
) -> Iterator[ChannelFault]:
    """Judge the current of a motor.

    Args:
        readings: of the current.
        motor_rad: positions of the motor at every sample, shape (k,).
        place: which channel it is.
    """
    upper = upper_part(readings.values)
    if upper is not None:
        # Over the empty middle, most steps are about as long as the counter's range.
        step = np.flatnonzero(np.diff(upper))
        changes = np.diff(readings.values)
        size = float(np.median(np.abs(changes[step])))
        stretches = _steps(readings, step)
        yield place.fault(FaultKind.UNSIGNED, readings, stretches, size)
        return
    jumps = find_jumps(readings, is_position=False)
    counter_range = wrap_size(readings, jumps, is_position=False)
    if counter_range is not None:
        stretches = _steps(readings, jumps.step)
        yield place.fault(FaultKind.WRAPPING, readings, stretches, counter_range)
        return
    if jumps.glitches:
        stretches = _glitched(readings, jumps)
        yield place.fault(FaultKind.GLITCH, readings, stretches, _largest_glitch(jumps))
    without_glitches = _without(readings, jumps)
    frozen = frozen_current(without_glitches, motor_rad)
    if len(frozen):
        yield place.fault(FaultKind.FROZEN, readings, frozen)


def _glitched(readings: Readings, jumps: Jumps) -> IntArray:
    """First sample and end of each glitch, shape (g, 2)."""
    samples = np.append(readings.sample, readings.sample[-1] + 1)
    first = [one.first for one in jumps.glitches]
    end = [one.end for one in jumps.glitches]
    return np.column_stack((samples[first], samples[end]))


def _largest_glitch(jumps: Jumps) -> float:
    """Largest distance of a glitch from the values around it."""
    return max(one.size for one in jumps.glitches)


def _steps(readings: Readings, step: IntArray) -> IntArray:
    """The sample after each step, as a stretch, shape (s, 2).

    Args:
        readings: of the channel.
        step: number of the reading before each step, shape (s,).
    """
    after = readings.sample[step + 1]
    return np.column_stack((after, after + 1))


def _without(readings: Readings, jumps: Jumps) -> Readings:
    """Readings without those that are glitches."""
    is_right = np.ones(len(readings.values), dtype=np.bool_)
    for one in jumps.glitches:
        is_right[one.first : one.end] = False
    return replace(readings, values=readings.values[is_right], sample=readings.sample[is_right])
