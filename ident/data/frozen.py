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
"""Way within BESIDE_S beside a stretch, in multiples of the largest usual change of it from one
such time to the next: what a motor has on its way to a standstill is half of that.
"""
USUAL_PERCENTILE = 98.0  #: Of these changes, away from every stretch
ABRUPT_COUNTS = 10.0  #: And in counts
JUMP = 3.0  #: Jump at the end of a frozen stretch, in multiples of the largest usual step
STEP_PERCENTILE = 99.0  #: Of the steps of a position: the largest usual one
BESIDE_S, LEAST_BESIDE = 0.01, 3  #: Time, and samples, over which that way is measured
LONGER = 10.0  #: Frozen current, in multiples of what else is constant in it
#: Least share of the changes of a current that turn back: without noise, constant shows nothing
NOISY = 0.25
MOVED = 0.02  #: Least way of a motor that moves in a stretch, as a share of its range
LEAST_TURNS = 2  #: Changes of direction that show how gently a motor slows down
LATER_S = 0.5  #: Time after a stop in which other motors may still come to rest with it


def frozen_position(readings: Readings) -> IntArray:
    """Stretches in which a position is frozen, as first sample and end, shape (s, 2).

    Args:
        readings: of a motor's position.
    """
    steps = np.abs(np.diff(readings.values))
    if len(steps):
        usual = float(np.percentile(steps, STEP_PERCENTILE))
    else:
        usual = 0.0
    if not usual > 0.0:
        return _no_stretch()  # nothing says how fast it moves
    least = JUMP * usual + ABRUPT_COUNTS * readings.count
    tiny = ROUNDING * float(np.ptp(readings.values))
    found: list[tuple[int, int]] = []
    for first, last in _constant(readings, tiny, LEAST_S):
        if last < len(steps) and steps[last] > least:
            found.append((first, last))
    return _samples(readings, found)


def frozen_to_the_end(readings: Readings, others: FloatArray) -> IntArray:
    """The stretch in which a position is frozen until the end of a recording, shape (0 or 1, 2).

    Args:
        readings: of a motor's position.
        others: positions of the other motors at every sample, shape (k, n − 1).
    """
    tiny = ROUNDING * float(np.ptp(readings.values))
    stretches = _constant(readings, tiny, LEAST_S)
    if not stretches or stretches[-1][1] != len(readings.values) - 1:
        return _no_stretch()
    first, last = stretches[-1]
    begin = int(readings.sample[first])
    if not _go_on(others, begin + round(LATER_S * readings.rate_hz)):
        return _no_stretch()
    beside = _samples_beside(readings)
    course = _course(readings)[: begin + 1]
    if len(course) <= 4 * beside:
        return _no_stretch()
    way = course[beside:] - course[:-beside]
    speed_changes = np.abs(way[beside:] - way[:-beside])[: -2 * beside]
    least_way = ABRUPT_COUNTS * readings.count
    directions = np.sign(way[np.abs(way) > least_way])
    if np.count_nonzero(np.diff(directions)) < LEAST_TURNS:
        return _no_stretch()
    usual = float(np.max(speed_changes))
    stopped_from = abs(float(way[-1]))
    if stopped_from <= ABRUPT * usual + least_way:
        return _no_stretch()
    return _samples(readings, [(first, last)])


def _go_on(others: FloatArray, sample: int) -> bool:
    """Whether any of the other motors moves after a sample."""
    later = others[sample:]
    if not later.size:
        return False
    way = np.ptp(later, axis=0)
    whole_range = np.ptp(others, axis=0)
    return bool(np.any((way > 0.0) & (way >= MOVED * whole_range)))


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
    tiny = ROUNDING * float(np.ptp(readings.values))
    stretches = _constant(readings, tiny, LEAST_S)
    beside = _samples_beside(readings)
    course = _course(readings)
    if not stretches or len(course) <= 4 * beside:
        return _no_stretch()
    way = np.abs(course[beside:] - course[:-beside])
    changes = np.abs(course[2 * beside :] - 2.0 * course[beside:-beside] + course[: -2 * beside])
    counts = way[beside:] > tiny
    for first, last in stretches:
        begin = int(readings.sample[first])
        end = int(readings.sample[last])
        counts[max(begin - 3 * beside, 0) : end + beside] = False
    if not np.any(counts):
        return _no_stretch()
    usual = float(np.percentile(changes[counts], USUAL_PERCENTILE))
    least = ABRUPT * usual + ABRUPT_COUNTS * readings.count
    found: list[tuple[int, int]] = []
    for first, last in stretches:
        begin = int(readings.sample[first])
        end = int(readings.sample[last])
        before = way[begin - beside] if begin >= beside else 0.0
        after = way[end] if end < len(way) else 0.0
        if max(before, after) > least:
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
    changed = steps[steps != 0.0]
    range_rad = float(np.ptp(motor_rad))
    if len(changed) < 2 or not range_rad > 0.0:
        return _no_stretch()
    turns_back = float(np.mean(changed[1:] * changed[:-1] < 0.0))
    if turns_back < NOISY:
        return _no_stretch()
    starts = np.concatenate(([0], np.flatnonzero(steps) + 1))
    usual = float(np.percentile(np.diff(starts, append=len(values)), 99.0))
    limits = (float(values.min()), float(values.max()))
    found: list[tuple[int, int]] = []
    for first, last in _constant(readings, 0.0, LEAST_CURRENT_S):
        part = motor_rad[readings.sample[first] : readings.sample[last] + 1]
        is_moved = float(np.ptp(part)) >= MOVED * range_rad
        if is_moved and last + 1 - first >= LONGER * usual and values[first] not in limits:
            found.append((first, last))
    return _samples(readings, found)


def _samples_beside(readings: Readings) -> int:
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


def _constant(readings: Readings, tiny: float, least_s: float) -> list[tuple[int, int]]:
    """First and last reading of every stretch that is constant for so long."""
    changed = np.abs(np.diff(readings.values)) > tiny
    first = np.concatenate(([0], np.flatnonzero(changed) + 1))
    last = np.append(first[1:], len(readings.values)) - 1
    long = readings.sample[last] + 1 - readings.sample[first] > least_s * readings.rate_hz
    return list(zip(first[long].tolist(), last[long].tolist(), strict=True))


def _samples(readings: Readings, found: list[tuple[int, int]]) -> IntArray:
    if not found:
        return _no_stretch()
    return np.array(
        [(readings.sample[first], readings.sample[last] + 1) for first, last in found],
        dtype=np.int64,
    )


def _no_stretch() -> IntArray:
    return np.zeros((0, 2), dtype=np.int64)
