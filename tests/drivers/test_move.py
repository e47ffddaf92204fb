"""Properties of synchronised trapezoids, and of their whole-number form for the drives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from drivers.errors import MotionRefused
from drivers.move import (
    AxisLimits,
    MotionPermission,
    Move,
    Trapezoid,
    check_moves,
    synchronised,
    synchronised_move,
)

AXES = 3
NAMES = ("a", "b", "c")
Values = tuple[float, ...]
Counts = tuple[int, ...]


def on_each_axis(values: st.SearchStrategy[Any]) -> st.SearchStrategy[tuple[Any, ...]]:
    return st.tuples(*[values] * AXES)


def is_zero_or_not_tiny(distance: float) -> bool:
    return distance == 0 or abs(distance) > 1e-3


distances = on_each_axis(st.floats(-1e3, 1e3).filter(is_zero_or_not_tiny)).filter(any)
limits = on_each_axis(st.floats(1e-2, 1e3))


def trapezoid_from_zero(
    distance: Sequence[float], velocity_limit: Sequence[float], acceleration_limit: Sequence[float]
) -> Trapezoid:
    return synchronised(
        np.zeros(AXES),
        np.array(distance),
        np.array(velocity_limit),
        np.array(acceleration_limit),
    )


@given(distances, limits, limits)
def test_limits_are_kept_and_one_is_used(
    distance: Values, velocity_limit: Values, acceleration_limit: Values
) -> None:
    path = trapezoid_from_zero(distance, velocity_limit, acceleration_limit)
    speed_share = np.abs(path.velocity) / np.array(velocity_limit)
    ramp_share = np.abs(path.acceleration) / np.array(acceleration_limit)
    assert np.all(speed_share <= 1 + 1e-9)
    assert np.all(ramp_share <= 1 + 1e-9)
    assert np.max(ramp_share) == pytest.approx(1.0)
    has_cruise = path.duration_s > 2 * path.ramp_s * (1 + 1e-9)
    if has_cruise:
        assert np.max(speed_share) == pytest.approx(1.0)


@pytest.mark.slow
@given(distances, limits, limits)
def test_all_axes_run_from_start_to_end_together(
    distance: Values, velocity_limit: Values, acceleration_limit: Values
) -> None:
    path = trapezoid_from_zero(distance, velocity_limit, acceleration_limit)
    time_s = np.linspace(0.0, path.duration_s, 4001)
    position, velocity, _ = path.at(time_s)
    assert_allclose(position[0], 0.0, atol=1e-9)
    assert_allclose(position[-1], distance, rtol=1e-9)
    # The path parameter is the same for all axes, so a coupled motor moves on a trapezoid too.
    way = np.array(distance)
    moves = way != 0
    path_parameter = position[:, moves] / way[moves]
    of_first_axis = path_parameter[:, :1]
    expected = np.repeat(of_first_axis, path_parameter.shape[1], axis=1)
    assert_allclose(path_parameter, expected, atol=1e-9)
    travelled = np.trapezoid(velocity, time_s, axis=0)
    assert_allclose(travelled, distance, rtol=1e-3, atol=1e-6)


def test_no_distance_takes_no_time() -> None:
    ones = (1.0,) * AXES
    path = trapezoid_from_zero((0.0,) * AXES, ones, ones)
    assert path.duration_s == 0.0


def test_a_limit_must_be_positive() -> None:
    ones = (1.0,) * AXES
    with pytest.raises(ValueError, match="positive"):
        trapezoid_from_zero(ones, (1.0, 0.0, 1.0), ones)


counts = on_each_axis(st.integers(-2_000_000, 2_000_000))
WIDE_LIMITS = (AxisLimits(-3_000_000, 3_000_000, 900_000.0, 4_000_000.0),) * AXES
FEW_COUNTS = 2000
"""Up to here no whole speed need be near enough for a common end time."""
TWO_SYNC_PERIODS_S = 2e-3


@given(counts, counts)
def test_whole_numbers_keep_limits_and_end_times(start: Counts, target: Counts) -> None:
    move = synchronised_move(start, target, WIDE_LIMITS)
    permission = MotionPermission("test", WIDE_LIMITS)
    check_moves(start, (move,), permission, NAMES)
    way = np.abs(np.subtract(target, start))
    durations_s = np.array(move.duration_s(start))[way > FEW_COUNTS]
    longest_s = np.max(durations_s, initial=0.0)
    assert np.all(longest_s - durations_s < TWO_SYNC_PERIODS_S)


tight_limits = on_each_axis(st.floats(3, 500))


@given(on_each_axis(st.integers(-500, 500)), tight_limits, tight_limits)
def test_rounding_never_leaves_tight_limits(
    target: Counts, velocity_limit: Values, acceleration_limit: Values
) -> None:
    axis_limits = tuple(
        AxisLimits(-500, 500, velocity, acceleration)
        for velocity, acceleration in zip(velocity_limit, acceleration_limit, strict=True)
    )
    start = (0,) * AXES
    move = synchronised_move(start, target, axis_limits)
    permission = MotionPermission("test", axis_limits)
    check_moves(start, (move,), permission, NAMES)


ONE = (AxisLimits(-10, 10, 100.0, 1000.0),)
ONE_GRANTED = MotionPermission("test", ONE)


@pytest.mark.parametrize(
    ("start", "move", "words"),
    [
        (0, Move((11,), (50,), (500,)), ("J1", "11", "-10 to 10")),
        (0, Move((5,), (101,), (500,)), ("J1", "velocity 101", "100")),
        (0, Move((5,), (50,), (1001,)), ("J1", "acceleration 1001", "1000")),
        (0, Move((5,), (0,), (500,)), ("J1", "velocity 0")),
        (-11, Move((5,), (50,), (500,)), ("J1", "starts at -11", "-10 to 10")),
        (0, Move((5, 6), (50, 50), (500, 500)), ("1 axes",)),
    ],
    ids=["target", "velocity", "acceleration", "no velocity", "start", "axes"],
)
def test_refusals_name_axis_found_and_allowed(
    start: int, move: Move, words: tuple[str, ...]
) -> None:
    with pytest.raises(MotionRefused) as refusal:
        check_moves((start,), (move,), ONE_GRANTED, ("J1",))
    for word in words:
        assert word in str(refusal.value)


def test_a_permission_without_an_operator_is_refused() -> None:
    nameless = MotionPermission(" ", ONE)
    with pytest.raises(MotionRefused, match="names no operator"):
        check_moves((0,), (), nameless, ("J1",))


# One axis from 10 to 34 units, at most 4 unit/s and 2 unit/s²: 2 s of ramp, 4 s of cruise, 2 s of
# ramp, 8 s in all. By hand: 4 + 16 + 4 units.
LONG_WAY = synchronised(np.array([10.0]), np.array([34.0]), np.array([4.0]), np.array([2.0]))


def test_a_long_way_has_ramps_and_a_cruise_as_by_hand() -> None:
    assert LONG_WAY.ramp_s == pytest.approx(2.0)
    assert LONG_WAY.duration_s == pytest.approx(8.0)
    assert LONG_WAY.velocity == pytest.approx([4.0])
    assert LONG_WAY.acceleration == pytest.approx([2.0])


@pytest.mark.parametrize(
    ("time_s", "position", "velocity", "acceleration"),
    [
        (-1.0, 10.0, 0.0, 0.0),
        (1.0, 11.0, 2.0, 2.0),
        (2.0, 14.0, 4.0, 0.0),
        (4.0, 22.0, 4.0, 0.0),
        (6.0, 30.0, 4.0, 0.0),
        (7.0, 33.0, 2.0, -2.0),
        (8.0, 34.0, 0.0, 0.0),
        (9.0, 34.0, 0.0, 0.0),
    ],
)
def test_a_way_at_a_time_is_where_the_formulas_of_a_ramp_put_it(
    time_s: float, position: float, velocity: float, acceleration: float
) -> None:
    found = np.ravel(LONG_WAY.at(np.array([time_s])))
    assert found == pytest.approx([position, velocity, acceleration], abs=1e-9)


def test_a_way_accelerates_from_its_first_instant() -> None:
    _, velocity, acceleration = LONG_WAY.at(np.array([0.0]))
    assert velocity[0, 0] == 0.0
    assert acceleration[0, 0] == pytest.approx(2.0)


def test_a_short_way_has_no_cruise() -> None:
    # 2 units at 2 unit/s²: 1 s up to 2 unit/s, below the limit of 4, and 1 s down.
    short = synchronised(np.array([0.0]), np.array([-2.0]), np.array([4.0]), np.array([2.0]))
    assert short.duration_s == pytest.approx(2.0)
    assert short.ramp_s == pytest.approx(1.0)
    assert short.velocity == pytest.approx([-2.0])


def test_a_way_without_distance_has_no_speed_and_no_acceleration() -> None:
    still = Trapezoid(np.array([3.0, 4.0]), np.array([3.0, 4.0]), 0.0, 0.0)
    assert still.velocity.tolist() == [0.0, 0.0]
    assert still.acceleration.tolist() == [0.0, 0.0]


def test_one_limit_of_zero_among_others_is_refused_with_all_of_them() -> None:
    words = r"positive, found \(1.0, 1.0, 1.0\) and \(2.0, 0.0, 2.0\)"
    with pytest.raises(ValueError, match=words):
        synchronised(np.zeros(3), np.ones(3), (1.0, 1.0, 1.0), (2.0, 0.0, 2.0))  # type: ignore[arg-type]


def test_an_axis_that_stays_needs_no_time_and_gets_the_least_profile() -> None:
    start = (7, 0)
    target = (7, 4000)
    axis_limits = AxisLimits(-9999, 9999, 1001.0, 2001.0)
    move = synchronised_move(start, target, (axis_limits, axis_limits))
    assert move.velocity_counts_s == (1, 1000)
    assert move.acceleration_counts_s2 == (1, 2000)
    # 0.5 s up to 1000 counts/s over 250 counts, 3.5 s of cruise, 0.5 s down.
    assert list(move.duration_s(start)) == pytest.approx([0.0, 4.5])
    assert move.dwell_cycles == 0


def test_a_move_keeps_the_cycles_that_it_dwells() -> None:
    axis_limits = AxisLimits(-10, 10, 100.0, 100.0)
    move = synchronised_move((0,), (5,), (axis_limits,), 12)
    assert move.dwell_cycles == 12


TWO = (AxisLimits(-10, 10, 100.0, 1000.0), AxisLimits(-20, 20, 50.0, 500.0))
TWO_GRANTED = MotionPermission("test", TWO)


def _refusal(start: tuple[int, ...], *moves: Move) -> str:
    with pytest.raises(MotionRefused) as refusal:
        check_moves(start, moves, TWO_GRANTED, ("J1", "J2"))
    return str(refusal.value)


def test_an_axis_behind_one_that_stays_is_checked() -> None:
    text = _refusal((0, 0), Move((0, 5), (0, 51), (0, 500)))
    assert text == "move 0: J2: velocity 51, allowed is above 0 up to 50"


def test_limits_themselves_are_allowed() -> None:
    move = Move((10, -20), (100, 50), (1000, 500))
    check_moves((-10, 20), (move,), TWO_GRANTED, ("J1", "J2"))


def test_a_later_move_starts_where_the_one_before_ends() -> None:
    there = Move((5, 0), (100, 0), (1000, 0))
    # J1 stays at 5 in the second move, so its profile of zeros is none.
    second = Move((5, 1), (0, 50), (0, 500))
    check_moves((0, 0), (there, second), TWO_GRANTED, ("J1", "J2"))
    back = Move((0, 1), (0, 50), (0, 500))
    text = _refusal((0, 0), there, back)
    assert text == "move 1: J1: velocity 0, allowed is above 0 up to 100"


def test_a_move_of_too_many_values_in_one_profile_is_refused_with_its_lengths() -> None:
    text = _refusal((0, 0), Move((5, 5), (50, 50), (500, 500, 500)))
    assert text == "move 0: has (2, 2, 3) values, the cell has 2 axes"


def test_a_dwell_before_the_target_is_refused_and_none_is_not() -> None:
    before_target = Move((5, 5), (50, 50), (500, 500), dwell_cycles=-1)
    text = _refusal((0, 0), before_target)
    assert text == "move 0: dwells for -1 cycles"
    without_dwell = Move((5, 5), (50, 50), (500, 500), dwell_cycles=0)
    check_moves((0, 0), (without_dwell,), TWO_GRANTED, ("J1", "J2"))


def test_a_permission_for_fewer_axes_than_the_cell_is_refused_with_both_numbers() -> None:
    with pytest.raises(MotionRefused, match="limits for 2 axes, the cell has 3"):
        check_moves((0, 0, 0), (), TWO_GRANTED, ("J1", "J2", "J3"))
