"""Stretches in which a channel keeps one number, each rule at its limit: how long, how far it
jumps, what else moves.

A sample is a millisecond, and a position moves by a hundred counts in it.
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
STEP = 1.0
SAMPLES = 2000
BEGIN = 700


def _readings(values: FloatArray, every: int = 1) -> Readings:
    """Readings of every so many samples."""
    sample = every * np.arange(len(values))
    return Readings(values=values, sample=sample, rate_hz=RATE_HZ, count=COUNT)


def _way(seconds: float = SAMPLES / RATE_HZ) -> FloatArray:
    return STEP * np.arange(round(seconds * RATE_HZ), dtype=np.float64)


def _frozen_way(samples: int, jump: float) -> FloatArray:
    """A way at one speed that stands for so many samples, and goes on with a jump."""
    values = _way()
    values[BEGIN : BEGIN + samples] = values[BEGIN]
    values[BEGIN + samples :] += values[BEGIN] + jump - values[BEGIN + samples]
    return values


@pytest.mark.parametrize(("samples", "found"), [(50, []), (51, [[BEGIN, BEGIN + 51]])])
def test_a_position_is_frozen_beyond_50_ms(samples: int, found: list[list[int]]) -> None:
    stretches = frozen_position(_readings(_frozen_way(samples, float(samples))))
    assert stretches.tolist() == found


@pytest.mark.parametrize(("jump", "is_frozen"), [(3.0, False), (3.09, False), (3.11, True)])
def test_a_frozen_position_jumps_by_three_usual_steps_and_ten_counts(
    jump: float, is_frozen: bool
) -> None:
    stretches = frozen_position(_readings(_frozen_way(80, jump)))
    assert stretches.tolist() == ([[BEGIN, BEGIN + 80]] if is_frozen else [])


def test_a_frozen_position_may_jump_back() -> None:
    stretches = frozen_position(_readings(_frozen_way(80, -3.2)))
    assert stretches.tolist() == [[BEGIN, BEGIN + 80]]


def test_a_stretch_is_given_in_samples_where_readings_are_held() -> None:
    stretches = frozen_position(_readings(_frozen_way(80, 80.0), every=3))
    # The last reading of the stretch is not known to have been there any longer than itself.
    assert stretches.tolist() == [[3 * BEGIN, 3 * (BEGIN + 79) + 1]]


@pytest.mark.parametrize("values", [np.zeros(0), np.zeros(1), np.full(500, 0.3)])
def test_a_position_that_never_moves_is_not_frozen(values: FloatArray) -> None:
    assert frozen_position(_readings(values)).shape == (0, 2)


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
    return _swinging(0.7)[:, None]


def test_a_position_that_stops_at_full_speed_while_others_move_is_frozen() -> None:
    stretches = frozen_to_the_end(_readings(_stopped(_swinging())), _others())
    assert stretches.tolist() == [[STOP, SAMPLES]]


def test_a_position_that_stops_at_its_turn_is_not_frozen() -> None:
    values = _swinging()
    values[1250:] = values[1250]
    assert frozen_to_the_end(_readings(values), _others()).shape == (0, 2)


def test_a_position_that_goes_on_once_more_is_not_frozen_to_the_end() -> None:
    values = _stopped(_swinging())
    values[-1] += 5.0
    assert frozen_to_the_end(_readings(values), _others()).shape == (0, 2)


@pytest.mark.parametrize(("until", "is_frozen"), [(STOP + 480, False), (STOP + 560, True)])
def test_others_must_move_later_than_half_a_second_after_the_stop(
    until: int, is_frozen: bool
) -> None:
    others = _others()
    others[until:] = others[until]
    stretches = frozen_to_the_end(_readings(_stopped(_swinging())), others)
    assert bool(len(stretches)) is is_frozen


@pytest.mark.parametrize(("share", "is_frozen"), [(0.019, False), (0.021, True)])
def test_others_must_move_by_a_fiftieth_of_their_range(share: float, is_frozen: bool) -> None:
    others = _others()
    others[STOP:] = others[STOP]
    others[-100:] = others[STOP] + share * np.ptp(others)
    stretches = frozen_to_the_end(_readings(_stopped(_swinging())), others)
    assert bool(len(stretches)) is is_frozen


def test_any_of_the_others_is_enough() -> None:
    others = np.column_stack((np.zeros(SAMPLES), _others()))
    stretches = frozen_to_the_end(_readings(_stopped(_swinging())), others)
    assert len(stretches) == 1


@pytest.mark.parametrize(("period_s", "is_frozen"), [(1.0, True), (1.6, False)])
def test_a_motor_that_has_turned_but_once_shows_not_how_gently_it_stops(
    period_s: float, is_frozen: bool
) -> None:
    # In the second before the stop: two turns with a period of 1 s, one with 1.6 s.
    readings = _readings(_stopped(_swinging(period_s)))
    assert bool(len(frozen_to_the_end(readings, _others()))) is is_frozen


def test_a_motor_that_stops_so_abruptly_at_other_times_is_not_frozen() -> None:
    # It goes to and fro at one speed, and turns from one sample to the next.
    time_s = np.arange(SAMPLES) / RATE_HZ
    values = 10.0 * np.abs(np.mod(time_s, 0.8) / 0.4 - 1.0)
    readings = _readings(_stopped(values))
    assert frozen_to_the_end(readings, _others()).shape == (0, 2)


# A position at the end of its range


def _clipped(lowest: float, highest: float) -> Readings:
    return _readings(np.clip(_swinging(), lowest, highest))


def test_a_position_beyond_the_end_of_its_range_is_found() -> None:
    # sin⁻¹ 0.5 is a twelfth of the period, 84 samples: it is cut until five twelfths.
    found = clipped_position(_clipped(-99.0, 5.0))
    assert found.tolist() == [[84, 417], [1084, 1417]]
    below = clipped_position(_clipped(-5.0, 99.0))
    assert below.tolist() == [[584, 917], [1584, 1917]]


def test_stops_at_two_places_are_no_end_of_a_range() -> None:
    assert clipped_position(_clipped(-5.0, 5.0)).shape == (0, 2)


def test_a_motor_that_rests_at_the_end_of_its_way_is_not_clipped() -> None:
    half = _swinging()[:250]
    values = np.concatenate((half, np.full(300, 10.0), half[::-1], -half, -half[::-1], half))
    assert clipped_position(_readings(values)).shape == (0, 2)


@pytest.mark.parametrize(
    ("places", "expected"),
    [([], False), ([2], True), ([0], True), ([2, 5], True), ([0, 2], False), ([1], False)],
)
def test_stretches_are_at_a_limit_where_all_are_at_one(places: list[int], expected: bool) -> None:
    readings = _readings(np.array([-1.0, 0.0, 1.0, 0.0, 0.5, 1.0]), every=4)
    stretches = np.array([[4 * place, 4 * place + 1] for place in places]).reshape(-1, 2)
    assert at_limit(readings, stretches) is expected


# A current that is frozen


def _noisy_current() -> FloatArray:
    return np.random.default_rng(3).normal(size=SAMPLES)


def _frozen_current(samples: int, value: float = 0.25) -> Readings:
    current = _noisy_current()
    current[BEGIN : BEGIN + samples] = value
    return _readings(current)


@pytest.mark.parametrize(("samples", "found"), [(100, []), (101, [[BEGIN, BEGIN + 101]])])
def test_a_current_is_frozen_beyond_100_ms(samples: int, found: list[list[int]]) -> None:
    stretches = frozen_current(_frozen_current(samples), _way())
    assert stretches.tolist() == found


@pytest.mark.parametrize(("share", "is_frozen"), [(0.019, False), (0.021, True)])
def test_a_current_is_frozen_where_its_motor_moves_by_a_fiftieth_of_its_range(
    share: float, is_frozen: bool
) -> None:
    motor = np.zeros(SAMPLES)
    motor[1500:] = 1.0
    motor[BEGIN + 100 : 1500] = share
    stretches = frozen_current(_frozen_current(200), motor)
    assert stretches.tolist() == ([[BEGIN, BEGIN + 200]] if is_frozen else [])


def test_without_any_motion_no_current_is_frozen() -> None:
    assert frozen_current(_frozen_current(200), np.zeros(SAMPLES)).shape == (0, 2)


def test_a_current_at_its_largest_value_is_not_frozen_but_limited() -> None:
    for value in (9.0, -9.0):
        assert frozen_current(_frozen_current(200, value), _way()).shape == (0, 2)


def test_a_current_that_is_often_constant_is_frozen_beyond_ten_such_times() -> None:
    # Each number stays for 15 samples.
    current = np.repeat(_noisy_current(), 15)[:SAMPLES]
    for samples, is_frozen in ((135, False), (165, True)):
        changed = current.copy()
        changed[705 : 705 + samples] = 0.25
        stretches = frozen_current(_readings(changed), _way())
        assert bool(len(stretches)) is is_frozen


def test_a_current_without_noise_may_be_constant() -> None:
    current = np.asarray(np.sin(_way() / 300.0))
    current[BEGIN : BEGIN + 200] = current[BEGIN]
    assert frozen_current(_readings(current), _way()).shape == (0, 2)
