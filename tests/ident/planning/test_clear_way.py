"""A way around what is in the way: every leg of it is clear,
and none is found where there is none.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.arrays import FloatArray
from ident.model.urdf import robot_from_urdf
from ident.planning.clear_way import clear_way, farthest_towards
from ident.planning.clearance import Box, Capsule, Checker, Scene
from tests.ident.arms import TX40
from tests.ident.mechanisms import PLANAR

pytestmark = pytest.mark.slow

LIMIT = np.array([2.5, 1.5, 1.5, 1.0, 1.0, 1.0])
STRETCHED = np.array([0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
"""The wrist is 0.45 m in front of the arm and 0.34 m high;
the first joint turns it to the left or right.
"""
NOTHING = Scene((), (), (), None, (), 0.0)


@pytest.fixture(scope="module")
def behind_a_wall() -> Checker:
    """An arm that reaches over a wall in front of it, but not through it."""
    start_m = (0.0, 0.0, 0.0)
    end_m = (0.0, 0.0, 0.0)
    wrist = Capsule("wrist", 3, start_m, end_m, 0.05)
    lower_m = (0.2, -0.02, 0.0)
    upper_m = (0.8, 0.02, 0.45)
    wall = Box("wall", lower_m, upper_m)
    scene = Scene((wrist,), (), (wall,), None, (), 0.01)
    return Checker(robot_from_urdf(TX40.urdf), scene)


def _legs(
    start: FloatArray, way: tuple[FloatArray, ...], end: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    return list(pairwise((start, *way, end)))


@given(st.integers(0, 1000))
@settings(max_examples=10, deadline=None, derandomize=True)
def test_the_way_around_a_wall_is_clear_and_stays_within_the_limits(
    behind_a_wall: Checker, seed: int
) -> None:
    start, end = (STRETCHED + np.array([side, 0.0, 0.0, 0.0, 0.0, 0.0]) for side in (-0.8, 0.8))
    assert behind_a_wall.obstruction(start, end) is not None
    rng = np.random.default_rng(seed)
    way = clear_way(behind_a_wall, start, end, -LIMIT, LIMIT, rng)
    assert way
    for one, other in _legs(start, way, end):
        assert behind_a_wall.obstruction(one, other) is None
    assert np.all(np.abs(way) <= LIMIT)


def test_a_clear_straight_way_has_no_turns(behind_a_wall: Checker) -> None:
    start = STRETCHED - 0.8 * np.eye(6)[0]
    end = STRETCHED - 1.2 * np.eye(6)[0]
    rng = np.random.default_rng(0)
    assert clear_way(behind_a_wall, start, end, -LIMIT, LIMIT, rng) == ()


def test_no_way_is_found_where_the_room_has_none(behind_a_wall: Checker) -> None:
    """Only the first joint may move: it cannot lift the arm over the wall."""
    start = STRETCHED - 0.8 * np.eye(6)[0]
    end = STRETCHED + 0.8 * np.eye(6)[0]
    lower = np.minimum(start, end)
    upper = np.maximum(start, end)
    rng = np.random.default_rng(0)
    assert clear_way(behind_a_wall, start, end, lower, upper, rng) is None


@given(st.integers(0, 1000))
@settings(max_examples=6, deadline=None, derandomize=True)
def test_motors_of_a_redundant_drive_fit_each_other_on_the_whole_way(seed: int) -> None:
    checker = Checker(PLANAR.robot, NOTHING)
    rng = np.random.default_rng(seed)
    limit = np.full(4, 0.5)
    start, end = (_walked(checker, limit, rng) for _ in range(2))
    lower = checker.home - limit
    upper = checker.home + limit
    way = clear_way(checker, start, end, lower, upper, rng)
    assert way is not None
    for one, other in _legs(start, way, end):
        assert checker.obstruction(one, other) is None


def _walked(checker: Checker, limit: FloatArray, rng: np.random.Generator) -> FloatArray:
    """A position that some clear straight ways lead to."""
    here = checker.home
    for _ in range(4):
        target = checker.home + rng.uniform(-limit, limit)
        lower = checker.home - limit
        upper = checker.home + limit
        reached = farthest_towards(checker, here, target, lower, upper)
        here = here if reached is None else reached
    return here
