"""Properties of synchronised trapezoids, and of their whole-number form for the drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
distances = st.tuples(
    *[st.floats(-1e3, 1e3).filter(lambda d: d == 0 or abs(d) > 1e-3)] * AXES
).filter(any)
limits = st.tuples(*[st.floats(1e-2, 1e3)] * AXES)


def made(
    distance: Sequence[float], velocity: Sequence[float], acceleration: Sequence[float]
) -> Trapezoid:
    velocity_limit = np.array(velocity)
    acceleration_limit = np.array(acceleration)
    return synchronised(np.zeros(AXES), np.array(distance), velocity_limit, acceleration_limit)


@given(distances, limits, limits)
def test_limits_are_kept_and_one_is_used(
    distance: tuple[float, ...], velocity: tuple[float, ...], acceleration: tuple[float, ...]
) -> None:
    path = made(distance, velocity, acceleration)
    absolute_velocity = np.abs(path.velocity)
    speed_share = absolute_velocity / np.array(velocity)
    absolute_acceleration = np.abs(path.acceleration)
    ramp_share = absolute_acceleration / np.array(acceleration)
    assert np.all(speed_share <= 1 + 1e-9)
    assert np.all(ramp_share <= 1 + 1e-9)
    assert np.max(ramp_share) == pytest.approx(1.0)
    if path.duration_s > 2 * path.ramp_s * (1 + 1e-9):
        assert np.max(speed_share) == pytest.approx(1.0)


@given(distances, limits, limits)
def test_all_axes_run_from_start_to_end_together(
    distance: tuple[float, ...], velocity: tuple[float, ...], acceleration: tuple[float, ...]
) -> None:
    path = made(distance, velocity, acceleration)
    time_s = np.linspace(0.0, path.duration_s, 4001)
    position, speed, _ = path.at(time_s)
    np.testing.assert_allclose(position[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(position[-1], distance, rtol=1e-9)
    # The path parameter is the same for all axes, so a coupled motor moves on a trapezoid too.
    share = position[:, np.array(distance) != 0] / np.array(distance)[np.array(distance) != 0]
    expected = np.repeat(share[:, :1], share.shape[1], axis=1)
    np.testing.assert_allclose(share, expected, atol=1e-9)
    travelled = np.sum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time_s)[:, None], axis=0)
    np.testing.assert_allclose(travelled, distance, rtol=1e-3, atol=1e-6)


def test_no_distance_takes_no_time() -> None:
    distance = (0.0,) * AXES
    velocity = (1.0,) * AXES
    acceleration = (1.0,) * AXES
    assert made(distance, velocity, acceleration).duration_s == 0.0


def test_a_limit_must_be_positive() -> None:
    distance = (1.0,) * AXES
    acceleration = (1.0,) * AXES
    velocity = (1.0, 0.0, 1.0)
    with pytest.raises(ValueError, match="positive"):
        made(distance, velocity, acceleration)


counts = st.tuples(*[st.integers(-2_000_000, 2_000_000)] * AXES)
ROOM = (AxisLimits(-3_000_000, 3_000_000, 900_000.0, 4_000_000.0),) * AXES


@given(counts, counts)
def test_whole_numbers_keep_limits_and_end_times(
    start: tuple[int, ...], target: tuple[int, ...]
) -> None:
    move = synchronised_move(start, target, ROOM)
    permission = MotionPermission("test", ROOM)
    names = ("a", "b", "c")
    check_moves(start, (move,), permission, names)
    going = [
        (seconds, abs(b - a))
        for seconds, a, b in zip(move.duration_s(start), start, target, strict=True)
        if abs(b - a) > 2000
    ]
    # For a few counts no whole speed is near enough, so their time is left out.
    longest = max((seconds for seconds, _ in going), default=0.0)
    for seconds, _ in going:
        assert abs(seconds - longest) < 2e-3  # two periods of a 1 kHz SYNC


@given(
    st.tuples(*[st.integers(-500, 500)] * AXES),
    st.tuples(*[st.floats(3, 500)] * AXES),
    st.tuples(*[st.floats(3, 500)] * AXES),
)
def test_rounding_never_leaves_tight_limits(
    target: tuple[int, ...], velocity: tuple[float, ...], acceleration: tuple[float, ...]
) -> None:
    room = tuple(AxisLimits(-500, 500, v, a) for v, a in zip(velocity, acceleration, strict=True))
    start_counts = (0,) * AXES
    move = synchronised_move(start_counts, target, room)
    permission = MotionPermission("test", room)
    names = ("a", "b", "c")
    check_moves((0,) * AXES, (move,), permission, names)


def test_refusals_name_axis_found_and_allowed() -> None:
    axis_limits = AxisLimits(-10, 10, 100.0, 1000.0)
    room = (axis_limits,)
    granted = MotionPermission("test", room)
    for start, move, words in (
        (0, Move((11,), (50,), (500,)), ("J1", "11", "-10 to 10")),
        (0, Move((5,), (101,), (500,)), ("J1", "velocity 101", "100")),
        (0, Move((5,), (50,), (1001,)), ("J1", "acceleration 1001", "1000")),
        (0, Move((5,), (0,), (500,)), ("J1", "velocity 0")),
        (-11, Move((5,), (50,), (500,)), ("J1", "starts at -11", "-10 to 10")),
        (0, Move((5, 6), (50, 50), (500, 500)), ("1 axes",)),
    ):
        with pytest.raises(MotionRefused) as refusal:
            check_moves((start,), (move,), granted, ("J1",))
        assert all(word in str(refusal.value) for word in words)
    permission = MotionPermission(" ", room)
    with pytest.raises(MotionRefused, match="names no operator"):
        check_moves((0,), (), permission, ("J1",))
