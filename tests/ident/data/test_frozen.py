"""Stretches in which a channel keeps one number, each rule at its limit: how long, how far it
jumps, what else moves.

A sample is a millisecond, and a position moves by two hundred counts in it.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.frozen import (
    at_limit,
    clipped_position,
    frozen_current,
    frozen_position,
    frozen_to_the_end,
)
from ident.data.glitches import Readings

FloatArray = NDArray[np.float64]
RATE_HZ = 1000.0
COUNT = 0.01
STEP = 2.0  #: of a position in a sample
SAMPLES = 2000
BEGIN = 700  #: first sample of a stretch

Stretches = list[list[int]]
NONE: Stretches = []


def _readings(values: FloatArray, every: int = 1, count: float = COUNT) -> Readings:
    """Readings of every so many samples."""
    sample = every * np.arange(len(values))
    return Readings(values=values, sample=sample, rate_hz=RATE_HZ, count=count)


def _listed(stretches: NDArray[np.intp]) -> Stretches:
    assert stretches.shape == (len(stretches), 2)
    listed: Stretches = stretches.tolist()
    return listed


def _found_in_position(values: FloatArray, every: int = 1) -> Stretches:
    return _listed(frozen_position(_readings(values, every)))


def _way() -> FloatArray:
    """A position at one speed."""
    return STEP * np.arange(SAMPLES, dtype=np.float64)


def _frozen_way(samples: int, jump: float) -> FloatArray:
    """A way at one speed that stands for so many samples, and goes on with a jump."""
    values = _way()
    values[BEGIN : BEGIN + samples] = values[BEGIN]
    end = BEGIN + samples
    values[end:] += values[BEGIN] + jump - values[end]
    return values


@pytest.mark.parametrize(("samples", "found"), [(50, NONE), (51, [[BEGIN, BEGIN + 51]])])
def test_a_position_is_frozen_beyond_50_ms(samples: int, found: list[list[int]]) -> None:
    values = _frozen_way(samples, jump=float(samples))
    assert _found_in_position(values) == found


@pytest.mark.parametrize(("jump", "is_frozen"), [(6.0, False), (6.09, False), (6.11, True)])
def test_a_frozen_position_jumps_by_three_usual_steps_and_ten_counts(
    jump: float, is_frozen: bool
) -> None:
    expected = [[BEGIN, BEGIN + 80]] if is_frozen else NONE
    assert _found_in_position(_frozen_way(80, jump)) == expected


def test_a_frozen_position_may_jump_back() -> None:
    values = _frozen_way(80, jump=-6.2)
    assert _found_in_position(values) == [[BEGIN, BEGIN + 80]]


def test_a_position_that_is_frozen_from_the_start_is_found() -> None:
    values = _way()
    values[:80] = values[79]
    values[80:] += 20.0
    assert _found_in_position(values) == [[0, 80]]


def test_a_position_that_does_not_go_on_has_no_jump() -> None:
    values = _way()
    values[BEGIN:] = values[BEGIN]
    assert _found_in_position(values) == NONE


def test_a_frozen_position_may_differ_by_rounding() -> None:
    values = _frozen_way(80, jump=80.0)
    values[BEGIN + 1 : BEGIN + 80 : 2] += 1e-9
    assert _found_in_position(values) == [[BEGIN, BEGIN + 80]]


def test_a_stretch_is_given_in_samples_where_readings_are_held() -> None:
    stretches = _found_in_position(_frozen_way(80, jump=80.0), every=3)
    # The last reading of the stretch is not known to have been there any longer than itself.
    assert stretches == [[3 * BEGIN, 3 * (BEGIN + 79) + 1]]


@pytest.mark.parametrize("values", [np.zeros(0), np.zeros(1), np.full(500, 0.3)])
def test_a_position_that_never_moves_is_not_frozen(values: FloatArray) -> None:
    assert _found_in_position(values) == NONE


# A position that is frozen until the end


def _swinging(period_s: float = 1.0) -> FloatArray:
    """A motor that goes to and fro by a thousand counts."""
    time_s = np.arange(SAMPLES) / RATE_HZ
    return np.asarray(10.0 * np.sin(2.0 * np.pi * time_s / period_s))


#: Where the motor is at its fastest
STOP = 1000


def _stopped(values: FloatArray) -> FloatArray:
    values[STOP:] = values[STOP]
    return values


def _others() -> FloatArray:
    """Another motor that goes on, shape (k, 1)."""
    return _swinging(0.7)[:, None]


def _found_at_the_end(
    values: FloatArray, others: FloatArray, every: int = 1, count: float = COUNT
) -> Stretches:
    return _listed(frozen_to_the_end(_readings(values, every, count), others))


def test_a_position_that_stops_at_full_speed_while_others_move_is_frozen() -> None:
    values = _stopped(_swinging())
    assert _found_at_the_end(values, _others()) == [[STOP, SAMPLES]]


def test_a_position_that_stops_at_its_turn_is_not_frozen() -> None:
    values = _swinging()
    values[1250:] = values[1250]
    assert _found_at_the_end(values, _others()) == NONE


def test_a_position_that_goes_on_once_more_is_not_frozen_to_the_end() -> None:
    values = _stopped(_swinging())
    values[-1] += 5.0
    assert _found_at_the_end(values, _others()) == NONE


@pytest.mark.parametrize(("until", "is_frozen"), [(STOP + 480, False), (STOP + 560, True)])
def test_others_must_move_later_than_half_a_second_after_the_stop(
    until: int, is_frozen: bool
) -> None:
    others = _others()
    others[until:] = others[until]
    stretches = _found_at_the_end(_stopped(_swinging()), others)
    assert bool(stretches) is is_frozen


@pytest.mark.parametrize(("share", "is_frozen"), [(0.019, False), (0.021, True)])
def test_others_must_move_by_a_fiftieth_of_their_range(share: float, is_frozen: bool) -> None:
    others = _others()
    others[STOP:] = others[STOP]
    others[-100:] = others[STOP] + share * np.ptp(others)
    stretches = _found_at_the_end(_stopped(_swinging()), others)
    assert bool(stretches) is is_frozen


@pytest.mark.parametrize(("height", "is_frozen"), [(0.985, True), (0.99, False)])
def test_a_frozen_motor_stops_three_times_as_abruptly_as_it_turns(
    height: float, is_frozen: bool
) -> None:
    # In the 10 ms before a height of A sin φ it goes A (sin φ − sin(φ − 0.02 π)): 0.0128 A before
    # 0.985 A, and 0.0109 A before 0.99 A. At its turns that way changes by 0.0039 A in 10 ms.
    values = _swinging()
    phase = np.arcsin(height)
    stop = STOP + round(RATE_HZ * phase / (2.0 * np.pi))
    values[stop:] = values[stop]
    stretches = _found_at_the_end(values, _others(), count=1e-4)
    assert bool(stretches) is is_frozen


@pytest.mark.parametrize(("count", "is_frozen"), [(0.04, True), (0.06, False)])
def test_a_motor_of_a_coarse_encoder_stops_by_more_than_ten_counts(
    count: float, is_frozen: bool
) -> None:
    # It stops from 0.63 in 10 ms; three times its largest other change is 0.12.
    stretches = _found_at_the_end(_stopped(_swinging()), _others(), count=count)
    assert bool(stretches) is is_frozen


def test_a_frozen_end_is_given_in_samples_where_readings_are_held() -> None:
    others = np.repeat(_others(), 2, axis=0)
    stretches = _found_at_the_end(_stopped(_swinging()), others, every=2)
    assert stretches == [[2 * STOP, 2 * SAMPLES - 1]]


def test_without_another_motor_nothing_shows_that_the_robot_goes_on() -> None:
    alone = np.zeros((SAMPLES, 0))
    assert _found_at_the_end(_stopped(_swinging()), alone) == NONE


def test_any_of_the_others_is_enough() -> None:
    still = np.zeros(SAMPLES)
    others = np.column_stack((still, _others()))
    stretches = _found_at_the_end(_stopped(_swinging()), others)
    assert len(stretches) == 1


@pytest.mark.parametrize(("period_s", "is_frozen"), [(1.0, True), (1.6, False)])
def test_a_motor_that_has_turned_but_once_shows_not_how_gently_it_stops(
    period_s: float, is_frozen: bool
) -> None:
    # In the second before the stop: two turns with a period of 1 s, one with 1.6 s.
    stretches = _found_at_the_end(_stopped(_swinging(period_s)), _others())
    assert bool(stretches) is is_frozen


def test_a_motor_that_stops_so_abruptly_at_other_times_is_not_frozen() -> None:
    # It goes to and fro at one speed, and turns from one sample to the next.
    time_s = np.arange(SAMPLES) / RATE_HZ
    values = 10.0 * np.abs(np.mod(time_s, 0.8) / 0.4 - 1.0)
    assert _found_at_the_end(_stopped(values), _others()) == NONE


# A position at the end of its range


def _clipped(lowest: float, highest: float) -> FloatArray:
    return np.clip(_swinging(), lowest, highest)


def _found_at_a_limit(values: FloatArray, count: float = COUNT) -> Stretches:
    return _listed(clipped_position(_readings(values, count=count)))


def test_a_position_beyond_the_end_of_its_range_is_found() -> None:
    # sin⁻¹ 0.5 is a twelfth of the period, 84 samples: it is cut until five twelfths.
    assert _found_at_a_limit(_clipped(-99.0, 5.0)) == [[84, 417], [1084, 1417]]
    assert _found_at_a_limit(_clipped(-5.0, 99.0)) == [[584, 917], [1584, 1917]]


@pytest.mark.parametrize(("count", "is_clipped"), [(0.038, True), (0.042, False)])
def test_a_clipped_position_stops_more_abruptly_than_it_turns_and_by_ten_counts(
    count: float, is_clipped: bool
) -> None:
    # 0.516 in 10 ms before and after; three times its largest usual change is 0.118.
    stretches = _found_at_a_limit(_clipped(-99.0, 5.0), count)
    assert bool(stretches) is is_clipped


@pytest.mark.parametrize("is_reversed", [False, True])
def test_a_clipped_position_is_abrupt_at_one_end_at_least(is_reversed: bool) -> None:
    # At 10 units/s to its limit, 0.3 s there, and off with 20 units/s².
    limit = 3.0
    time_s = np.arange(1000) / RATE_HZ
    there = 10.0 * time_s[:301]
    rest = np.full(299, limit)
    back = limit - 10.0 * time_s**2
    end = np.full(100, back[-1])
    # Where it stands at its other end, it stops as abruptly: that is cut off.
    values = np.concatenate((there, rest, back, end))[:-140]
    expected = [[300, 601]]
    if is_reversed:
        values = values[::-1].copy()
        expected = [[len(values) - 601, len(values) - 300]]
    assert _found_at_a_limit(values, count=1e-4) == expected


def test_a_recording_may_begin_and_end_beyond_the_range() -> None:
    # A cosine begins at its largest value, and ends there after two periods.
    time_s = np.arange(SAMPLES) / RATE_HZ
    values = np.clip(10.0 * np.cos(2.0 * np.pi * time_s), -99.0, 5.0)
    # cos⁻¹ 0.5 is a sixth of the period.
    assert _found_at_a_limit(values) == [[0, 167], [834, 1167], [1834, 2000]]


@pytest.mark.parametrize("is_reversed", [False, True])
def test_a_motor_that_rests_at_an_end_of_the_recording_is_not_clipped(is_reversed: bool) -> None:
    # 0.3 s of rest, and off with 20 units/s².
    time_s = np.arange(1000) / RATE_HZ
    values = np.concatenate((np.zeros(300), 10.0 * time_s**2))
    if is_reversed:
        values = values[::-1].copy()
    assert _found_at_a_limit(values) == NONE


def test_stops_at_two_places_are_no_end_of_a_range() -> None:
    assert _found_at_a_limit(_clipped(-5.0, 5.0)) == NONE


def test_a_motor_that_rests_at_the_end_of_its_way_is_not_clipped() -> None:
    up = _swinging()[:250]  # a quarter of a period
    rest = np.full(300, 10.0)
    down = up[::-1]
    values = np.concatenate((up, rest, down, -up, -down, up))
    assert _found_at_a_limit(values) == NONE


@pytest.mark.parametrize(
    ("places", "expected"),
    [([], False), ([2], True), ([0], True), ([2, 5], True), ([0, 2], False), ([1], False)],
)
def test_stretches_are_at_a_limit_where_all_are_at_one(places: list[int], expected: bool) -> None:
    readings = _readings(np.array([-1.0, 0.0, 1.0, 0.0, 0.5, 1.0]), every=4)
    first = 4 * np.array(places, dtype=np.int64)
    stretches = np.column_stack((first, first + 1))
    assert at_limit(readings, stretches) is expected


# A current that is frozen


def _noisy_current() -> FloatArray:
    return np.random.default_rng(3).normal(size=SAMPLES)


def _frozen_for(samples: int, value: float = 0.25) -> FloatArray:
    """A noisy current that has one value for so many samples."""
    current = _noisy_current()
    current[BEGIN : BEGIN + samples] = value
    return current


def _found_in_current(current: FloatArray, motor: FloatArray) -> Stretches:
    return _listed(frozen_current(_readings(current), motor))


@pytest.mark.parametrize(("samples", "found"), [(100, NONE), (101, [[BEGIN, BEGIN + 101]])])
def test_a_current_is_frozen_beyond_100_ms(samples: int, found: list[list[int]]) -> None:
    assert _found_in_current(_frozen_for(samples), _way()) == found


@pytest.mark.parametrize(("share", "is_frozen"), [(0.019, False), (0.021, True)])
def test_a_current_is_frozen_where_its_motor_moves_by_a_fiftieth_of_its_range(
    share: float, is_frozen: bool
) -> None:
    motor = np.zeros(SAMPLES)
    motor[1500:] = 1.0
    motor[BEGIN + 100 : 1500] = share
    expected = [[BEGIN, BEGIN + 200]] if is_frozen else NONE
    assert _found_in_current(_frozen_for(200), motor) == expected


@pytest.mark.parametrize(("moves_at", "is_frozen"), [(BEGIN + 199, True), (BEGIN + 200, False)])
def test_a_motor_may_move_at_the_last_frozen_sample_alone(moves_at: int, is_frozen: bool) -> None:
    motor = np.zeros(SAMPLES)
    motor[moves_at:] = 1.0
    stretches = _found_in_current(_frozen_for(200), motor)
    assert bool(stretches) is is_frozen


@pytest.mark.parametrize(("run", "is_frozen"), [(3, True), (5, False)])
def test_a_current_is_noisy_where_a_quarter_of_its_changes_turn_back(
    run: int, is_frozen: bool
) -> None:
    # It goes up by so many steps, and down by as many.
    place = np.mod(np.arange(SAMPLES), 2 * run)
    current = np.minimum(place, 2 * run - place).astype(np.float64)
    current[BEGIN : BEGIN + 200] = 1.5
    stretches = _found_in_current(current, _way())
    assert bool(stretches) is is_frozen


def test_without_any_motion_no_current_is_frozen() -> None:
    still = np.zeros(SAMPLES)
    assert _found_in_current(_frozen_for(200), still) == NONE


def test_a_current_at_its_largest_value_is_not_frozen_but_limited() -> None:
    for value in (9.0, -9.0):
        assert _found_in_current(_frozen_for(200, value), _way()) == NONE


@pytest.mark.parametrize(("samples", "is_frozen"), [(149, False), (150, True)])
def test_a_current_that_is_often_constant_is_frozen_beyond_ten_such_times(
    samples: int, is_frozen: bool
) -> None:
    every = 15  # samples that each number stays
    current = np.repeat(_noisy_current(), every)[:SAMPLES]
    begin = 47 * every
    current[begin : begin + samples] = 0.25
    stretches = _found_in_current(current, _way())
    assert bool(stretches) is is_frozen


def test_a_current_without_noise_may_be_constant() -> None:
    current = np.asarray(np.sin(_way() / 300.0))
    current[BEGIN : BEGIN + 200] = current[BEGIN]
    assert _found_in_current(current, _way()) == NONE
