"""Samples that leave the course of a channel and return to it,
and steps after which it does not return.

A motor does not turn back within a few samples, and its position goes on from where it was. A
reading that does neither is none: a flipped bit, a lost frame, a sign that is wrong for a sample, a
reading of zero where nothing was read. Where the channel does not return, the encoder has lost its
place, or its counter has wrapped: it goes on, a fixed step away.

A step is judged by the steps around it, so speed, noise and counts are those of the moment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.held import ROUNDING

SUSPECT = 10.0
"""A step is looked at whose change is so many times a percentile of the changes of a channel."""
POSITION_PERCENTILE = 90.0  #: That percentile of a position, which is smooth at any time
CURRENT_PERCENTILE = 98.0
"""That percentile of a current.

A controller may ask for one that lasts a sample: where a joint breaks loose, those of a real robot
have up to 12 times the percentile, and ring on.
"""
JUMP = 10.0
"""A jump differs from the steps around it by so many times their spread.

Noise that is normal reaches 5 times.
"""
SPREAD_PERCENTILE = 80.0
"""Percentile of the distances of the steps around from their median: a current that goes up and
down with friction has many small ones among its large ones; two other glitches may be near.
"""
JUMP_COUNTS = 20.0  #: And by so many counts: an encoder at rest may flicker
#: Of a channel that shows its counts: those of an axis at rest may be glitches alone
LEAST_CHANGES = 20
NEAR = 5  #: Nearest step around a jump that is compared with it, on either side
FAR = 14  #: Farthest one
SHORT = 3  #: Readings that a glitch of any shape may have
#: Of a glitch whose readings follow the channel, or repeat one number: a position, or a dropout
LONGEST_S = 0.05
USUAL_PERCENTILES = 1.0, 99.0
"""Their distance is the usual range of a current.

A short glitch of a current is larger: what a controller asks for where a joint breaks loose may
last one reading, and nothing tells it from a smaller glitch, which bends no gain.
"""
RETURN = 0.25  #: Largest distance from its course after a glitch, as a share of the glitch
RETURNED = 2  #: Readings after it that are on the course; what rings on is a blow to the robot
SAME_SIZE = 0.05  #: Largest relative difference of the steps of a counter that wraps
#: Beginning of the part of a range that is empty where negative numbers lost their sign
EMPTY_FROM = 0.25
EMPTY_TO = 0.75  #: End of that part
LEAST_SPLIT = 0.01  #: Least share of the values at either end of it
WRAP_SHARE = 0.75  #: Least share of the range of a counter that was seen where it wraps


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
class Glitch:
    """Readings that are none."""

    first: int  #: number of the first reading
    end: int  #: of the next one that is right
    size: float  #: distance from the course


@dataclass(frozen=True, slots=True, eq=False)
class Jumps:
    """What a channel does that no motor does."""

    glitches: tuple[Glitch, ...]
    step: IntArray  #: readings before the steps after which the channel does not return, shape (s,)
    step_size: FloatArray  #: of each of them, less the motion, shape (s,)


def find_jumps(readings: Readings, *, is_position: bool) -> Jumps:
    """Find glitches, and steps after which a channel does not return.

    Args:
        readings: of the channel.
        is_position: a position is continuous. A current may go up and down within some samples, so
            a longer glitch of a current repeats one number.
    """
    if is_position:
        percentile = POSITION_PERCENTILE
        smallest = 0.0
    else:
        percentile = CURRENT_PERCENTILE
        lowest, highest = np.percentile(readings.values, USUAL_PERCENTILES)
        smallest = float(highest - lowest)
    step, size = _jumps(readings, percentile)
    longest = max(SHORT, round(LONGEST_S * readings.rate_hz))
    glitches: list[Glitch] = []
    others: list[int] = []
    number = 0
    while number < len(step):
        found = _glitch_from(
            readings, step[number:], size[number:], longest, smallest, is_position=is_position
        )
        if found is None:
            others.append(number)
            number += 1
            continue
        glitch, used = found
        glitches.append(glitch)
        number += used
    return Jumps(tuple(glitches), step[others], size[others])


def wrap_size(readings: Readings, jumps: Jumps, *, is_position: bool) -> float | None:
    """Range of a counter that wraps, in the unit of the channel; None where none does.

    It goes on one range away, again and again, and never leaves that range.
    """
    if not len(jumps.step):
        return None
    sizes = _sizes_of_wraps(readings, jumps.step)
    counter_range = float(np.median(sizes))
    seen_range = float(np.ptp(readings.values))
    if not WRAP_SHARE * counter_range <= seen_range <= (1.0 + SAME_SIZE) * counter_range:
        return None
    # A counter goes through its range; a current that friction turns between two values does not.
    if not is_position and _share_in_middle(readings.values) < LEAST_SPLIT:
        return None
    is_same = np.abs(sizes - counter_range) <= SAME_SIZE * counter_range
    # A single step may be that of an encoder that has lost its place.
    if np.count_nonzero(is_same) < 2 or np.mean(is_same) <= 0.5:
        return None
    return counter_range


def _share_in_middle(values: FloatArray) -> float:
    """Share of the values in the middle of their range."""
    lowest = values.min()
    range_ = float(np.ptp(values))
    if not range_ > 0.0:
        return 0.0
    place = (values - lowest) / range_
    is_in_middle = (place > EMPTY_FROM) & (place < EMPTY_TO)
    return float(np.mean(is_in_middle))


def _sizes_of_wraps(readings: Readings, step: IntArray) -> FloatArray:
    """Size of each step less the motion, by the two steps on either side of it, shape (s,)."""
    steps = np.diff(readings.values)
    around = np.clip(step[:, None] + np.array([-2, -1, 1, 2]), 0, len(steps) - 1)
    motion = np.median(steps[around], axis=1)
    return np.asarray(np.abs(steps[step] - motion))


def _jumps(readings: Readings, percentile: float) -> tuple[IntArray, FloatArray]:
    """Steps unlike those around them, by the number of the reading before,
    and their sizes less the motion.
    """
    no_jumps = (np.zeros(0, dtype=np.int64), np.zeros(0))
    steps = np.diff(readings.values)
    count = len(steps)
    if count < 2 * FAR:
        return no_jumps
    suspects = _suspect_steps(steps, float(np.ptp(readings.values)), percentile)
    if not len(suspects):
        return no_jumps
    before = np.arange(-FAR, -NEAR + 1)
    after = np.arange(NEAR, FAR + 1)
    indices = suspects[:, None] + np.concatenate((before, after))
    is_outside = (indices < 0) | (indices >= count)
    around = np.where(is_outside, np.nan, steps[np.clip(indices, 0, count - 1)])
    motion = np.nanmedian(around, axis=1)
    distances = np.abs(around - motion[:, None])
    spread = np.nanpercentile(distances, SPREAD_PERCENTILE, axis=1)
    size = steps[suspects] - motion
    smallest = JUMP * spread + JUMP_COUNTS * readings.count
    is_jump = np.abs(size) > smallest
    return suspects[is_jump], size[is_jump]


def _suspect_steps(steps: FloatArray, range_: float, percentile: float) -> IntArray:
    """Indices of steps whose change is large, and of those of half the range of the channel."""
    changes = np.abs(np.diff(steps))
    smallest = SUSPECT * float(np.percentile(changes, percentile))
    is_large = changes > max(smallest, ROUNDING * range_)
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
    longest: int,
    smallest: float,
    *,
    is_position: bool,
) -> tuple[Glitch, int] | None:
    """Return the glitch that begins with the first of the jumps,
    and how many of the jumps belong to it.

    Args:
        readings: of the channel.
        step, size: of the jumps that are left, as of `_jumps`.
        longest: glitch, in samples.
        smallest: size of a glitch of SHORT readings or fewer.
        is_position: as of `find_jumps`.
    """
    values = readings.values
    count = len(values)
    begin = int(step[0])
    first = begin + 1
    signed_size = float(size[0])
    glitch_size = abs(signed_size)
    motion = float(values[first] - values[begin]) - signed_size
    # A current steps where friction turns; one that does so near an end of the recording need not
    # return.
    is_alone = len(step) == 1 or step[1] - begin > longest
    if is_position and begin < SHORT and is_alone:
        return Glitch(0, first, glitch_size), 1
    for number in range(1, len(step)):
        last = int(step[number])
        samples = int(readings.sample[last] - readings.sample[begin])
        if samples > longest:
            break
        after = np.arange(last + 1, min(last + 1 + RETURNED, count))
        off_course = values[after] - values[begin] - motion * (after - begin)
        if np.max(np.abs(off_course)) > RETURN * glitch_size:
            continue
        inside = values[first : last + 1]
        is_short = samples <= SHORT and glitch_size > smallest
        is_dropout = samples > SHORT and np.ptp(inside) == 0.0
        if is_position or is_short or is_dropout:
            return Glitch(first, last + 1, glitch_size), number + 1
    if is_position and count - 1 - begin <= SHORT:
        return Glitch(first, count, glitch_size), len(step)
    return None


def is_split(values: FloatArray) -> BoolArray | None:
    """Whether each value is in the upper part of a range whose middle is empty, shape (k,);
    None where it is not.

    A signed number that is read without its sign has its negative values at the other end of the
    counter's range, and all have one sign: a current that friction alone turns between two values
    has both.
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
    is_both = min(share, 1.0 - share) >= LEAST_SPLIT
    if is_empty and is_both and crossings >= 2:
        return upper
    return None
