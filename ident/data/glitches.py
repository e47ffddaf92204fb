"""Samples that leave the course of a channel and return to it,
and steps after which it does not return.

A motor does not turn back within a few samples, and its position goes on from where it was. Values
that break one of these rules are no readings: a flipped bit, a lost frame, a sign that is wrong for
a sample, a zero where nothing was read. Where the channel does not return, the encoder has lost its
place, or its counter has wrapped: it goes on, a fixed step away.

A step is judged by the steps around it, so speed, noise and counts are those of the moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.held import ROUNDING

SUSPECT_RATIO = 10.0
"""Least change from one step to the next at a step that may be a jump,
as a multiple of a percentile of these changes.
"""
POSITION_PERCENTILE = 90.0  #: That percentile of a position, which is smooth at any time
CURRENT_PERCENTILE = 98.0
"""That percentile of a current.

A controller may ask for a current that lasts one sample: where a joint breaks loose, those of a
real robot have up to 12 times the percentile. They ring on, and so are no glitches.
"""
JUMP_RATIO = 10.0
"""Least difference of a jump from the steps around it, as a multiple of their spread.

Normal noise reaches 5 times.
"""
SPREAD_PERCENTILE = 80.0
"""Percentile of the distances of the steps around a jump from their median: their spread.

A current that goes up and down with friction has many small steps among its large ones, and two
other glitches may be near.
"""
#: Counts by which a jump differs from the steps around it beyond their spread: an encoder at rest
#: may flicker
JUMP_COUNTS = 20.0
#: Fewest changes that show the count of a channel: those of an axis at rest may all be glitches
LEAST_CHANGES = 20
NEAREST_STEP = 5  #: Steps from a jump to the nearest one that it is compared with, on either side
FARTHEST_STEP = 14  #: Steps to the farthest one
SHORT_READINGS = 3  #: Longest glitch of any shape and duration, in readings
LONGEST_GLITCH_S = 0.05
"""Longest glitch of more readings: of a position, which is continuous,
or a dropout of a current, which repeats one number.
"""
USUAL_PERCENTILES = 1.0, 99.0
"""Percentiles of a current between which its usual range is.

A short glitch of a current is larger than that range. A controller may ask for a smaller current
that lasts one reading, where a joint breaks loose. Nothing tells it from a glitch of that size, and
such a glitch bends no gain.
"""
RETURN_SHARE = 0.25  #: Largest distance from its course after a glitch, as a share of the glitch
#: Readings after a glitch that must be on the course; what rings on is a blow to the robot
RETURNED_READINGS = 2
SIZE_TOLERANCE = 0.05  #: Largest relative difference of the steps of a counter that wraps
MIDDLE_FROM = 0.25
"""Beginning of the middle of a range, as a share of it.

The middle is empty where negative numbers lost their sign; a counter that wraps goes through it.
"""
MIDDLE_TO = 0.75  #: End of that middle
LEAST_PART_SHARE = 0.01  #: Least share of the values in a part of a range that is not empty
WRAP_SHARE = 0.75  #: Least range of the readings of a counter that wraps, as a share of its range


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """The readings of a channel, without samples that repeat the one before because nothing was
    read.
    """

    values: FloatArray  #: shape (r,)
    sample: IntArray  #: number of the sample of each, increasing, shape (r,)
    rate_hz: float  #: of the samples
    count: float  #: smallest change that the channel can show


def smallest_change(values: FloatArray) -> float | None:
    """Return the smallest change of a channel, shape (k,);
    None where it changes too seldom to show one.
    """
    steps = np.abs(np.diff(values))
    rounding = ROUNDING * float(np.ptp(values))
    changes = steps[steps > rounding]
    if len(changes) < LEAST_CHANGES:
        return None
    return float(changes.min())


@dataclass(frozen=True, slots=True)
class GlitchLimits:
    """Limits of the glitches of a channel."""

    longest_samples: int  #: longest glitch of more than SHORT_READINGS
    #: A current that repeats one number for longer than SHORT_READINGS usually last has a dropout
    constant_samples: float
    #: size that a glitch of a current of SHORT_READINGS or fewer exceeds, in its unit
    short_size: float


@dataclass(frozen=True, slots=True)
class Glitch:
    """Successive readings that do not show what the channel measures."""

    first: int  #: number of the first reading
    end: int  #: number of the next reading that is right
    size: float  #: size of the jump that begins it, in the unit of the channel


@dataclass(frozen=True, slots=True, eq=False)
class Jumps:
    """What a channel does that no motor does."""

    glitches: tuple[Glitch, ...]
    #: number of the reading before each step after which the channel does not return, shape (s,)
    step: IntArray
    step_size: FloatArray  #: of each of them, less the motion, shape (s,)


def find_jumps(readings: Readings, *, is_position: bool) -> Jumps:
    """Find glitches, and steps after which a channel does not return.

    Args:
        readings: of the channel.
        is_position: a position is continuous. A current may go up and down within some samples, so
            a longer glitch of a current repeats one number.
    """
    percentile = CURRENT_PERCENTILE
    if is_position:
        percentile = POSITION_PERCENTILE
    step, size = _jumps(readings, percentile)
    limits = _glitch_limits(readings)
    glitches: list[Glitch] = []
    without_return: list[int] = []
    number = 0
    while number < len(step):
        found = _glitch_from(
            readings, step[number:], size[number:], limits, is_position=is_position
        )
        if found is None:
            without_return.append(number)
            number += 1
            continue
        glitch, used = found
        glitches.append(glitch)
        number += used
    return Jumps(tuple(glitches), step[without_return], size[without_return])


def _glitch_limits(readings: Readings) -> GlitchLimits:
    """Return the limits of the glitches of a channel."""
    lowest, highest = np.percentile(readings.values, USUAL_PERCENTILES)
    stays = np.diff(readings.sample)  # samples from each reading to the next
    held = stays[stays > 1]
    usual_stay = 1.0
    if len(held):
        usual_stay = float(np.median(held))
    return GlitchLimits(
        longest_samples=round(LONGEST_GLITCH_S * readings.rate_hz),
        constant_samples=SHORT_READINGS * usual_stay,
        short_size=float(highest - lowest),
    )


def wrap_size(readings: Readings, jumps: Jumps, *, is_position: bool) -> float | None:
    """Range of a counter that wraps, in the unit of the channel; None where none does.

    At a wrap the channel goes on one range away. It wraps again and again, and never leaves its
    range.
    """
    if not len(jumps.step):
        return None
    sizes = _sizes_of_wraps(readings, jumps.step)
    counter_range = float(np.median(sizes))
    seen_range = float(np.ptp(readings.values))
    if not WRAP_SHARE * counter_range <= seen_range <= (1.0 + SIZE_TOLERANCE) * counter_range:
        return None
    # A counter goes through its range; a current that friction turns between two values does not.
    if not is_position and _share_in_middle(readings.values) < LEAST_PART_SHARE:
        return None
    is_wrap = np.abs(sizes - counter_range) <= SIZE_TOLERANCE * counter_range
    # A single step may be that of an encoder that has lost its place.
    if np.count_nonzero(is_wrap) < 2 or np.mean(is_wrap) <= 0.5:
        return None
    return counter_range


def _share_in_middle(values: FloatArray) -> float:
    """Share of the values in the middle of their range."""
    lowest = values.min()
    range_ = float(np.ptp(values))
    if not range_ > 0.0:
        return 0.0
    share_of_range = (values - lowest) / range_
    is_in_middle = (share_of_range > MIDDLE_FROM) & (share_of_range < MIDDLE_TO)
    return float(np.mean(is_in_middle))


def _sizes_of_wraps(readings: Readings, step: IntArray) -> FloatArray:
    """Size of each step less the motion, shape (s,).

    The motion is that of the two steps on either side, as far as there are any: a counter may wrap
    so often that those farther away (`_jumps`) are wraps, too.
    """
    steps = np.diff(readings.values)
    neighbours = _steps_at(steps, step[:, None] + np.array([-2, -1, 1, 2]))
    motion = np.nanmedian(neighbours, axis=1)
    return np.asarray(np.abs(steps[step] - motion))


def _steps_at(steps: FloatArray, indices: IntArray) -> FloatArray:
    """Steps at indices of any shape; NaN before the first step and after the last one."""
    last = len(steps) - 1
    is_outside = (indices < 0) | (indices > last)
    inside = np.clip(indices, 0, last)
    return np.where(is_outside, np.nan, steps[inside])


def _jumps(readings: Readings, percentile: float) -> tuple[IntArray, FloatArray]:
    """Find steps unlike those around them.

    Args:
        readings: of the channel.
        percentile: of the changes from step to step; SUSPECT_RATIO is a multiple of it.

    Returns:
        number of the reading before each of them, and their sizes less the motion.
    """
    no_jumps = (np.zeros(0, dtype=np.int64), np.zeros(0))
    steps = np.diff(readings.values)
    if len(steps) < 2 * FARTHEST_STEP:
        return no_jumps
    suspects = _suspect_steps(steps, float(np.ptp(readings.values)), percentile)
    if not len(suspects):
        return no_jumps
    before = np.arange(-FARTHEST_STEP, -NEAREST_STEP + 1)
    after = np.arange(NEAREST_STEP, FARTHEST_STEP + 1)
    around = _steps_at(steps, suspects[:, None] + np.concatenate((before, after)))
    motion = np.nanmedian(around, axis=1)
    distances = np.abs(around - motion[:, None])
    spread = np.nanpercentile(distances, SPREAD_PERCENTILE, axis=1)
    size = steps[suspects] - motion
    smallest_jump = JUMP_RATIO * spread + JUMP_COUNTS * readings.count
    is_jump = np.abs(size) > smallest_jump
    return suspects[is_jump], size[is_jump]


def _suspect_steps(steps: FloatArray, range_: float, percentile: float) -> IntArray:
    """Indices of steps next to a large change of step, and of those above half the range of the
    channel.
    """
    changes = np.abs(np.diff(steps))
    smallest_change_of_step = SUSPECT_RATIO * float(np.percentile(changes, percentile))
    is_large = changes > max(smallest_change_of_step, ROUNDING * range_)
    is_suspect = np.zeros(len(steps), dtype=np.bool_)
    is_suspect[1:] |= is_large
    is_suspect[:-1] |= is_large
    # A counter may wrap so often that its steps are usual ones.
    is_suspect |= np.abs(steps) > 0.5 * range_
    return np.flatnonzero(is_suspect)


def _glitch_from(
    readings: Readings,
    step: IntArray,
    size: FloatArray,
    limits: GlitchLimits,
    *,
    is_position: bool,
) -> tuple[Glitch, int] | None:
    """Return the glitch that the first of the jumps begins,
    and how many of the jumps belong to it; None where it begins none.

    A position may begin with a glitch: then the first of the jumps ends it.

    Args:
        readings: of the channel.
        step, size: of the jumps that are left, as of `_jumps`.
        limits: of the glitches of the channel.
        is_position: as of `find_jumps`.
    """
    values = readings.values
    count = len(values)
    begin = int(step[0])
    first = begin + 1
    signed_size = float(size[0])
    glitch_size = abs(signed_size)
    motion = float(values[first] - values[begin]) - signed_size
    is_alone = len(step) == 1 or _is_too_long(readings, begin, int(step[1]), limits)
    # Near an end of the recording, a position need not return to its course. A current that steps
    # there may be friction that turns.
    if is_position and begin < SHORT_READINGS and is_alone:
        return Glitch(0, first, glitch_size), 1
    for number in range(1, len(step)):
        last = int(step[number])
        if _is_too_long(readings, begin, last, limits):
            break
        after = np.arange(last + 1, min(last + 1 + RETURNED_READINGS, count))
        # The course goes on from the reading before the glitch, with the motion around it.
        off_course = values[after] - values[begin] - motion * (after - begin)
        if np.max(np.abs(off_course)) > RETURN_SHARE * glitch_size:
            continue
        inside = values[first : last + 1]
        is_short = len(inside) <= SHORT_READINGS and glitch_size > limits.short_size
        # A number that stays for many samples may be one reading: those that repeat it are held.
        is_long = _samples_between(readings, begin, last) > limits.constant_samples
        is_dropout = is_long and np.ptp(inside) == 0.0
        if is_position or is_short or is_dropout:
            return Glitch(first, last + 1, glitch_size), number + 1
    if is_position and count - 1 - begin <= SHORT_READINGS:
        return Glitch(first, count, glitch_size), len(step)
    return None


def _is_too_long(readings: Readings, begin: int, last: int, limits: GlitchLimits) -> bool:
    """Whether what is between two jumps is too long for a glitch.

    Args:
        readings: of the channel.
        begin, last: number of the reading before each of the jumps.
        limits: of the glitches of the channel.
    """
    if last - begin <= SHORT_READINGS:
        return False
    return _samples_between(readings, begin, last) > limits.longest_samples


def _samples_between(readings: Readings, begin: int, last: int) -> int:
    """Samples from the first reading after a jump to the first one after another; their numbers as
    for `_is_too_long`.
    """
    return int(readings.sample[last + 1] - readings.sample[begin + 1])


def upper_part(values: FloatArray) -> BoolArray | None:
    """Whether each value is in the upper part of a range whose middle is empty, shape (k,);
    None where there is no such range.

    Where a signed number is read as an unsigned one, its negative values are at the other end of
    the counter's range, so all of its values have one sign. A current that friction alone turns
    between two values has both signs.
    """
    lowest = float(values.min())
    if lowest < 0.0 < float(values.max()):
        return None
    range_ = float(values.max()) - lowest
    if not range_ > 0.0:
        return None
    upper = (values - lowest) / range_ > 0.5
    is_empty = _share_in_middle(values) == 0.0
    crossings = int(np.count_nonzero(np.diff(upper)))
    share = float(np.mean(upper))
    are_both_used = min(share, 1.0 - share) >= LEAST_PART_SHARE
    if is_empty and are_both_used and crossings >= 2:
        return upper
    return None
