"""Stretches in which a channel keeps one number although its motor moves:
an encoder that froze, a limit of a range.

A frozen position goes on with a jump, by the way that its motor has gone meanwhile. One that only
stops from one sample to the next is none: a robot may run into something, and a simple device may
know no acceleration. One that never goes on is frozen where every other stop and turn of its motor
was far gentler, and the other motors still move. A position at the end of its range does not jump;
it stops, and goes on, without any acceleration. A frozen current lacks its noise while its motor
moves.
"""

from __future__ import annotations

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.data.glitches import Readings
from ident.data.held import ROUNDING

LEAST_S = 0.05  #: Shortest stretch; shorter ones are held readings
LEAST_CURRENT_S = 0.1  #: Likewise of a current
ABRUPT = 3.0
"""Way within BESIDE_S next to a stretch, in multiples of the largest usual change of it from one
such time to the next: what a motor has on its way to a standstill is half of that.
"""
USUAL_PERCENTILE = 98.0  #: Of these changes, away from every stretch
ABRUPT_COUNTS = 10.0  #: And in counts
JUMP = 3.0  #: Jump at the end of a frozen stretch, in multiples of the largest usual step
STEP_PERCENTILE = 99.0  #: Of the steps of a position: the largest usual one
BESIDE_S = 0.01  #: Time over which that way is measured
LEAST_BESIDE = 3  #: Least samples of that time
LONGER = 10.0  #: Frozen current, in multiples of what else is constant in it
LENGTH_PERCENTILE = 99.0  #: Of the lengths of what else is constant
#: Least share of the changes of a current that turn back: without noise, constant shows nothing
NOISY = 0.25
MOVED = 0.02  #: Least way of a motor that moves in a stretch, as a share of its range
LEAST_TURNS = 2  #: Changes of direction that show how gently a motor slows down
LATER_S = 0.5  #: Time after a stop in which other motors may still come to rest with it


def usual_step(readings: Readings) -> float:
    """The largest usual step of a position; zero without any."""
    steps = np.abs(np.diff(readings.values))
    if not len(steps):
        return 0.0
    return float(np.percentile(steps, STEP_PERCENTILE))


def frozen_position(readings: Readings) -> IntArray:
    """Stretches in which a position is frozen, as first sample and end, shape (s, 2).

    Args:
        readings: of a motor's position.
    """
    steps = np.abs(np.diff(readings.values))
    usual = usual_step(readings)
    if not usual > 0.0:
        return _no_stretch()  # nothing says how fast it moves
    smallest_jump = JUMP * usual + ABRUPT_COUNTS * readings.count
    found: list[tuple[int, int]] = []
    for first, last in _constant(readings, _rounding(readings), LEAST_S):
        if last < len(steps) and steps[last] > smallest_jump:
            found.append((first, last))
    return _samples(readings, found)


def frozen_to_the_end(readings: Readings, others: FloatArray) -> IntArray:
    """The stretch in which a position is frozen until the end of a recording, shape (0 or 1, 2).

    Args:
        readings: of a motor's position.
        others: positions of the other motors at every sample, shape (k, n − 1).
    """
    stretches = _constant(readings, _rounding(readings), LEAST_S)
    if not stretches:
        return _no_stretch()
    first, last = stretches[-1]
    is_at_end = last == len(readings.values) - 1
    begin = int(readings.sample[first])
    later = begin + round(LATER_S * readings.rate_hz)
    if not (is_at_end and _go_on(others, later)):
        return _no_stretch()
    until_stop = _course(readings)[: begin + 1]
    if not _stops_abruptly(until_stop, _samples_of_span(readings), readings.count):
        return _no_stretch()
    return _samples(readings, [(first, last)])


def _stops_abruptly(course: FloatArray, span: int, count: float) -> bool:
    """Whether a position stops at its last sample, and every other stop and turn before was far
    gentler.

    Args:
        course: position at every sample, shape (k,).
        span: samples over which its way is measured.
        count: of the channel.
    """
    if len(course) <= 4 * span:
        return False
    way = course[span:] - course[:-span]
    smallest_way = ABRUPT_COUNTS * count
    directions = np.sign(way[np.abs(way) > smallest_way])
    turns = np.count_nonzero(np.diff(directions))
    if turns < LEAST_TURNS:
        return False
    speed_changes = np.abs(way[span:] - way[:-span])
    before_stop = speed_changes[: -2 * span]
    usual = float(np.max(before_stop))
    last_way = abs(float(way[-1]))
    return last_way > ABRUPT * usual + smallest_way


def _go_on(others: FloatArray, sample: int) -> bool:
    """Whether any of the other motors moves after a sample."""
    later = others[sample:]
    if not later.size:
        return False
    way = np.ptp(later, axis=0)
    smallest_way = MOVED * np.ptp(others, axis=0)
    return bool(np.any((way > 0.0) & (way >= smallest_way)))


def clipped_position(readings: Readings) -> IntArray:
    """Stretches in which a position stands at the largest, or the smallest, value of its range,
    shape (s, 2).

    Args:
        readings: of a motor's position.
    """
    stretches = _abrupt(readings)
    if at_limit(readings, stretches):
        return stretches
    return _no_stretch()


def _abrupt(readings: Readings) -> IntArray:
    """Stretches in which a position is constant and that begin or end without any acceleration,
    shape (s, 2).
    """
    rounding = _rounding(readings)
    stretches = _constant(readings, rounding, LEAST_S)
    span = _samples_of_span(readings)
    course = _course(readings)
    if not stretches or len(course) <= 4 * span:
        return _no_stretch()
    way = np.abs(course[span:] - course[:-span])
    changes = np.abs(course[2 * span :] - 2.0 * course[span:-span] + course[: -2 * span])
    counts = way[span:] > rounding
    for first, last in stretches:
        begin = int(readings.sample[first])
        end = int(readings.sample[last])
        counts[max(begin - 3 * span, 0) : end + span] = False
    if not np.any(counts):
        return _no_stretch()
    usual = float(np.percentile(changes[counts], USUAL_PERCENTILE))
    smallest_way = ABRUPT * usual + ABRUPT_COUNTS * readings.count
    found: list[tuple[int, int]] = []
    for first, last in stretches:
        begin = int(readings.sample[first])
        end = int(readings.sample[last])
        before = 0.0
        if begin >= span:
            before = way[begin - span]
        after = 0.0
        if end < len(way):
            after = way[end]
        if max(before, after) > smallest_way:
            found.append((first, last))
    return _samples(readings, found)


def frozen_current(readings: Readings, motor_rad: FloatArray) -> IntArray:
    """Stretches in which a current is frozen, as first sample and end, shape (s, 2).

    Its largest and its smallest value are left to `ident.data.clipping`.

    Args:
        readings: of the current.
        motor_rad: position of its motor at every sample, shape (k,).
    """
    values = readings.values
    steps = np.diff(values)
    changes = steps[steps != 0.0]
    range_rad = float(np.ptp(motor_rad))
    if len(changes) < 2 or not range_rad > 0.0:
        return _no_stretch()
    is_turn = changes[1:] * changes[:-1] < 0.0
    if float(np.mean(is_turn)) < NOISY:
        return _no_stretch()
    starts = np.concatenate(([0], np.flatnonzero(steps) + 1))
    lengths = np.diff(starts, append=len(values))
    usual = float(np.percentile(lengths, LENGTH_PERCENTILE))
    limits = (float(values.min()), float(values.max()))
    found: list[tuple[int, int]] = []
    for first, last in _constant(readings, 0.0, LEAST_CURRENT_S):
        begin = readings.sample[first]
        end = readings.sample[last] + 1
        is_moved = float(np.ptp(motor_rad[begin:end])) >= MOVED * range_rad
        is_long = last + 1 - first >= LONGER * usual
        if is_moved and is_long and values[first] not in limits:
            found.append((first, last))
    return _samples(readings, found)


def _rounding(readings: Readings) -> float:
    """Largest change of a channel that is rounding."""
    return ROUNDING * float(np.ptp(readings.values))


def _samples_of_span(readings: Readings) -> int:
    """Samples in BESIDE_S."""
    return max(LEAST_BESIDE, round(BESIDE_S * readings.rate_hz))


def _course(readings: Readings) -> FloatArray:
    """A channel at every sample, from the first to the last reading;
    a held reading is on the way to the next one.
    """
    samples = np.arange(int(readings.sample[-1]) + 1)
    return np.asarray(np.interp(samples, readings.sample, readings.values))


def at_limit(readings: Readings, stretches: IntArray) -> bool:
    """Whether every stretch is at the largest, or at the smallest, value of a channel."""
    if not len(stretches):
        return False
    where = np.searchsorted(readings.sample, stretches[:, 0])
    values = readings.values[where]
    is_largest = bool(np.all(values == readings.values.max()))
    is_smallest = bool(np.all(values == readings.values.min()))
    return is_largest or is_smallest


def _constant(readings: Readings, rounding: float, least_s: float) -> list[tuple[int, int]]:
    """First and last reading of every stretch that is constant for so long."""
    is_changed = np.abs(np.diff(readings.values)) > rounding
    first = np.concatenate(([0], np.flatnonzero(is_changed) + 1))
    last = np.append(first[1:], len(readings.values)) - 1
    samples = readings.sample[last] + 1 - readings.sample[first]
    is_long = samples > least_s * readings.rate_hz
    return list(zip(first[is_long].tolist(), last[is_long].tolist(), strict=True))


def _samples(readings: Readings, found: list[tuple[int, int]]) -> IntArray:
    """First sample and end of stretches, given by their first and last reading, shape (s, 2)."""
    if not found:
        return _no_stretch()
    first, last = np.array(found).T
    return np.column_stack((readings.sample[first], readings.sample[last] + 1))


def _no_stretch() -> IntArray:
    """No stretch at all, shape (0, 2)."""
    return np.zeros((0, 2), dtype=np.int64)
