"""Glitches and steps of a channel, each rule at its limit: how large, how long, how they return.

A sample is a millisecond. Positions are a slow sine, so that a step of it is known, and a glitch
must be larger than 20 counts.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.data.glitches import (
    Glitch,
    Jumps,
    Readings,
    find_jumps,
    smallest_change,
    upper_part,
    wrap_size,
)

FloatArray = NDArray[np.float64]
RATE_HZ = 1000.0
COUNT = 0.001
SAMPLES = 1000


def _readings(values: FloatArray, every: int = 1) -> Readings:
    """Readings of every so many samples."""
    sample = every * np.arange(len(values))
    return Readings(values=values, sample=sample, rate_hz=RATE_HZ, count=COUNT)


def _sine() -> FloatArray:
    return np.asarray(np.sin(2.0 * np.pi * np.arange(SAMPLES) / SAMPLES))


def _position_jumps(values: FloatArray, every: int = 1) -> Jumps:
    return find_jumps(_readings(values, every), is_position=True)


@given(
    first=st.integers(20, 970),
    length=st.integers(1, 8),
    size=st.floats(0.1, 100.0),
    up=st.booleans(),
)
@settings(max_examples=8)
def test_readings_beside_the_course_are_one_glitch_of_their_size(
    first: int, length: int, size: float, up: bool
) -> None:
    values = _sine()
    values[first : first + length] += size if up else -size
    found = _position_jumps(values)
    (glitch,) = found.glitches
    assert (glitch.first, glitch.end) == (first, first + length)
    assert glitch.size == pytest.approx(size, abs=0.01)
    assert found.step.tolist() == []


@given(after=st.integers(20, 970), size=st.floats(0.1, 100.0), up=st.booleans())
@settings(max_examples=8)
def test_a_channel_that_goes_on_elsewhere_has_a_step_of_its_signed_size(
    after: int, size: float, up: bool
) -> None:
    signed = size if up else -size
    values = _sine()
    values[after + 1 :] += signed
    found = _position_jumps(values)
    assert found.glitches == ()
    assert found.step.tolist() == [after]
    assert found.step_size.tolist() == pytest.approx([signed], abs=0.001)


@pytest.mark.parametrize(("counts", "is_found"), [(19.0, False), (21.0, True)])
def test_an_encoder_at_rest_may_flicker_by_twenty_counts(counts: float, is_found: bool) -> None:
    values = np.zeros(SAMPLES)
    values[500] = counts * COUNT
    assert bool(_position_jumps(values).glitches) is is_found


def test_a_jump_is_ten_times_the_spread_of_the_steps_around_it() -> None:
    # One before and three after it: the median is two, and each of them is one from it.
    steps = np.where(np.arange(SAMPLES) < 500, 1.0, 3.0)
    for added, is_found in ((9.9, False), (10.1, True), (-9.9, False), (-10.1, True)):
        changed = steps.copy()
        changed[500] = 2.0 + added
        values = np.cumsum(changed)
        assert bool(len(_position_jumps(values).step)) is is_found


@pytest.mark.parametrize(("length", "is_glitch"), [(49, True), (51, False)])
def test_a_position_returns_from_a_glitch_within_50_ms(length: int, is_glitch: bool) -> None:
    values = _sine()
    values[300 : 300 + length] += 5.0
    found = _position_jumps(values)
    assert bool(found.glitches) is is_glitch
    assert found.step.tolist() == ([] if is_glitch else [299, 299 + length])


def test_the_time_of_a_glitch_is_that_of_its_samples_where_readings_are_held() -> None:
    values = _sine()
    values[300:320] += 5.0
    assert _position_jumps(values, every=2).glitches[0].end == 320
    assert _position_jumps(values, every=3).glitches == ()


@pytest.mark.parametrize(("share", "is_glitch"), [(0.2, True), (0.3, False)])
def test_a_glitch_returns_to_its_course_within_a_quarter_of_its_size(
    share: float, is_glitch: bool
) -> None:
    values = np.zeros(SAMPLES)
    values[300:303] = 4.0
    values[303:] = 4.0 * share
    assert bool(_position_jumps(values).glitches) is is_glitch


def test_two_readings_after_a_glitch_are_on_the_course() -> None:
    values = np.zeros(SAMPLES)
    values[300:303] = 4.0
    values[304] = -4.0
    glitches = _position_jumps(values).glitches
    assert [(one.first, one.end) for one in glitches] == [(300, 305)]


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        (slice(0, 1), Glitch(0, 1, 4.0)),
        (slice(0, 3), Glitch(0, 3, 4.0)),
        (slice(SAMPLES - 1, SAMPLES), Glitch(SAMPLES - 1, SAMPLES, 4.0)),
        (slice(SAMPLES - 3, SAMPLES), Glitch(SAMPLES - 3, SAMPLES, 4.0)),
    ],
)
def test_up_to_three_readings_at_an_end_of_a_position_are_a_glitch(
    place: slice, expected: Glitch
) -> None:
    values = np.zeros(SAMPLES)
    values[place] = 4.0
    found = _position_jumps(values)
    assert found.glitches == (expected,)
    assert found.step.tolist() == []


def test_a_glitch_at_the_beginning_is_alone_where_the_next_is_more_than_50_ms_away() -> None:
    values = np.zeros(SAMPLES)
    values[:2] = 4.0
    values[30] = 4.0
    glitches = _position_jumps(values, every=10).glitches
    assert [(one.first, one.end) for one in glitches] == [(0, 2), (30, 31)]


@pytest.mark.parametrize("place", [slice(0, 4), slice(SAMPLES - 4, SAMPLES)])
def test_four_readings_at_an_end_are_another_place(place: slice) -> None:
    values = np.zeros(SAMPLES)
    values[place] = 4.0
    found = _position_jumps(values)
    assert found.glitches == ()
    assert len(found.step) == 1


# Currents


def _current() -> FloatArray:
    return np.asarray(_sine() + np.random.default_rng(1).normal(scale=0.01, size=SAMPLES))


def _current_glitches(values: FloatArray, every: int = 1) -> list[tuple[int, int]]:
    found = find_jumps(_readings(values, every), is_position=False)
    return [(one.first, one.end) for one in found.glitches]


@pytest.mark.parametrize(("size", "is_glitch"), [(1.5, False), (2.5, True)])
def test_a_short_glitch_of_a_current_is_larger_than_its_usual_range(
    size: float, is_glitch: bool
) -> None:
    # The usual range of this current is 2.
    values = _current()
    values[500:502] += size
    assert _current_glitches(values) == ([(500, 502)] if is_glitch else [])


def test_a_longer_glitch_of_a_current_repeats_one_number() -> None:
    values = _current()
    values[500:510] = 7.0
    assert _current_glitches(values) == [(500, 510)]
    values[505] = 7.1
    assert _current_glitches(values) == []


@pytest.mark.parametrize("place", [slice(0, 2), slice(SAMPLES - 2, SAMPLES)])
def test_a_current_need_not_return_at_an_end(place: slice) -> None:
    values = _current()
    values[place] += 9.0
    assert _current_glitches(values) == []


@pytest.mark.parametrize("every", [1, 4, 20])
@pytest.mark.parametrize(
    ("added", "is_glitch"),
    [([1.5], False), ([1.5, 1.6], False), ([2.5], True), ([2.5, 2.7, 2.6], True)],
)
def test_a_short_glitch_is_of_three_readings_however_long_each_of_them_stays(
    added: list[float], is_glitch: bool, every: int
) -> None:
    # The usual range of this current is 2.
    values = _current()
    end = 500 + len(added)
    values[500:end] += added
    expected = [(500, end)] if is_glitch else []
    assert _current_glitches(values, every) == expected


@pytest.mark.parametrize(("stays", "is_glitch"), [(12, False), (13, True), (50, True)])
def test_a_number_that_stays_as_long_as_several_readings_is_a_dropout(
    stays: int, is_glitch: bool
) -> None:
    # Every reading stays for 4 samples, and the one of zero for longer.
    values = _current()
    values[250] = 0.0
    sample = 4 * np.arange(SAMPLES)
    sample[251:] += stays - 4
    readings = Readings(values=values, sample=sample, rate_hz=RATE_HZ, count=COUNT)
    glitches = find_jumps(readings, is_position=False).glitches
    assert bool(glitches) is is_glitch


# Counters that wrap


def _wrapped(speed: float = 0.01) -> FloatArray:
    """A position that a counter shows from 0 to 1."""
    return np.asarray(np.mod(speed * np.arange(SAMPLES), 1.0))


def _range(values: FloatArray, *, is_position: bool = True) -> float | None:
    readings = _readings(values)
    jumps = find_jumps(readings, is_position=is_position)
    return wrap_size(readings, jumps, is_position=is_position)


@pytest.mark.parametrize("size", [1.0, 360.0, 65536.0])
def test_a_counter_that_wraps_has_the_size_of_its_range(size: float) -> None:
    assert _range(size * _wrapped()) == pytest.approx(size, rel=1e-9)
    assert _range(-size * _wrapped()) == pytest.approx(size, rel=1e-9)


def _with_steps_back(sizes: list[float]) -> FloatArray:
    """A position that goes up by one in a hundred samples, and back by these sizes in turn."""
    values = 0.01 * np.arange(100.0 * (len(sizes) + 1.0))
    for number, size in enumerate(sizes, start=1):
        values[100 * number :] -= size
    return np.asarray(values)


@pytest.mark.parametrize("unit", [1.0, 360.0])
@pytest.mark.parametrize(
    ("sizes", "is_counter"),
    [
        ([0.97, 1.0, 1.03], True),
        ([0.9, 1.0, 1.04, 1.1], False),  # two of four are near their median
    ],
)
def test_a_counter_goes_on_by_its_range_within_a_twentieth_more_often_than_not(
    sizes: list[float], is_counter: bool, unit: float
) -> None:
    found = _range(unit * _with_steps_back(sizes))
    assert (found is not None) is is_counter


def test_one_step_is_no_counter_that_wraps() -> None:
    values = 0.0005 * np.arange(SAMPLES, dtype=np.float64)
    values[500:] -= 0.5
    assert _range(values) is None


def test_equal_steps_that_lead_away_are_no_counter() -> None:
    sample = np.arange(SAMPLES, dtype=np.float64)
    values = 0.001 * sample + 0.3 * np.floor(sample / 100.0)
    assert len(find_jumps(_readings(values), is_position=True).step) == 9
    assert _range(values) is None


def test_a_channel_without_steps_has_no_range() -> None:
    assert _range(_sine()) is None


def test_a_current_that_friction_turns_between_two_values_is_no_counter() -> None:
    square = np.where(np.arange(SAMPLES) // 100 % 2 == 0, 1.0, -1.0)
    assert _range(square, is_position=False) is None


@pytest.mark.parametrize("samples", [102, 202])
def test_a_current_that_wraps_at_its_first_and_its_last_step_is_a_counter(samples: int) -> None:
    # From 0.995 to 0.005 at the first step, and after each hundred to the last one
    values = np.mod(0.995 + 0.01 * np.arange(samples), 1.0)
    assert _range(values, is_position=False) == pytest.approx(1.0)


# Signs that were lost


def test_negative_numbers_without_their_sign_are_in_the_upper_part() -> None:
    values = np.tile([1.0, 2.0, 99.0, 98.0], 5)
    upper = upper_part(values)
    assert upper is not None
    assert upper.tolist() == [False, False, True, True] * 5
    mirrored = upper_part(-values)
    assert mirrored is not None
    assert mirrored.tolist() == [True, True, False, False] * 5


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ([-1.0, 1.0] * 20, "both signs"),
        ([1.0, 50.0, 99.0] * 20, "something in the middle"),
        ([1.0] * 20 + [99.0] * 20, "one crossing"),
        ([5.0] * 20, "one number"),
        ([1.0, 99.0] + [1.0] * 200, "too few values in the upper part"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_other_values_are_not_split(values: list[float], reason: str) -> None:
    assert upper_part(np.array(values)) is None, reason


@pytest.mark.parametrize(("place", "is_empty"), [(26.0, False), (24.0, True), (76.0, True)])
def test_the_middle_is_between_a_quarter_and_three_quarters_of_the_range(
    place: float, is_empty: bool
) -> None:
    values = np.array([0.0, 100.0] * 30 + [place, 0.0])
    assert (upper_part(values) is not None) is is_empty


# Counts


@pytest.mark.parametrize(("changes", "expected"), [(19, None), (20, 0.5)])
def test_twenty_changes_show_the_smallest(changes: int, expected: float | None) -> None:
    values = np.zeros(100)
    values[: changes + 1] = np.cumsum([0.5] + [1.5] * changes)
    values[2 : changes + 1] -= 1.0
    values[changes + 1 :] = values[changes]
    assert smallest_change(values) == expected


def test_rounding_is_no_change() -> None:
    values = np.tile([0.0, 1.0, 1.0 + 1e-12], 30)
    assert smallest_change(values) == pytest.approx(1.0)
