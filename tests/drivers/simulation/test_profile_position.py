"""The set-point of a move, against the limits it must keep and the point it must reach."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.simulation.amplifier import SEGMENTS, ProfileMove, plan, ramp_down

LIMIT = st.floats(10.0, 1e6)
PLACE = st.floats(-1e6, 1e6)


def end_of(move: ProfileMove, position: float, velocity: float) -> tuple[float, float, float]:
    """Where the pieces end, how fast, and the fastest on the way."""
    fastest = abs(velocity)
    for duration, acceleration in zip(move.duration_s, move.acceleration, strict=True):
        position += velocity * duration + 0.5 * acceleration * duration**2
        velocity += acceleration * duration
        fastest = max(fastest, abs(velocity))
    return position, velocity, fastest


@given(
    start=PLACE,
    target=PLACE,
    velocity=st.floats(-2e4, 2e4),
    speed=LIMIT,
    acceleration=LIMIT,
    deceleration=LIMIT,
)
def test_a_move_ends_at_rest_on_its_target_within_its_limits(
    start: float,
    target: float,
    velocity: float,
    speed: float,
    acceleration: float,
    deceleration: float,
) -> None:
    move = plan(start, velocity, target, speed, acceleration, deceleration)
    position, left, fastest = end_of(move, start, velocity)
    scale = 1.0 + abs(start) + abs(target) + velocity**2 / min(acceleration, deceleration)
    assert move.target == target
    assert position == pytest.approx(target, abs=1e-6 * scale)
    limit = 1e-6 * (1.0 + fastest)
    assert abs(left) <= limit
    largest_speed = max(speed, abs(velocity))
    assert fastest <= largest_speed * (1.0 + 1e-9)
    assert len(move.duration_s) == SEGMENTS
    assert min(move.duration_s) >= 0.0
    for a in move.acceleration:
        assert abs(a) in (0.0, acceleration, deceleration)


def test_a_textbook_trapezoid() -> None:
    move = plan(0.0, 0.0, 100.0, 10.0, 5.0, 10.0)
    assert move.duration_s[:3] == pytest.approx((2.0, 8.5, 1.0))
    expected = (5.0, 0.0, -10.0)
    assert move.acceleration[:3] == expected


@given(start=PLACE, velocity=st.floats(-1e5, 1e5), deceleration=LIMIT)
def test_a_stop_ends_at_rest_where_it_says(
    start: float, velocity: float, deceleration: float
) -> None:
    move = ramp_down(start, velocity, deceleration)
    position, left, _ = end_of(move, start, velocity)
    assert position == pytest.approx(
        move.target, abs=1e-6 * (1.0 + abs(start) + velocity**2 / deceleration)
    )
    limit = 1e-6 * (1.0 + abs(velocity))
    assert abs(left) <= limit
    travel = move.target - start
    assert travel * velocity >= 0.0
