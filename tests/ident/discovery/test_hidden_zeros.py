"""Why a zero is not seen: a symmetry of the arm, the last link, or the moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.discovery.alike_corrections import axes_before
from ident.discovery.hidden_zeros import ZeroHiddenBy, zero_hidden_by
from ident.model.robot import Robot
from tests.ident.recordings import gantry_truth, three_axes_truth


@pytest.fixture
def arm() -> Robot:
    return three_axes_truth().model.robot


def causes(robot: Robot) -> list[str]:
    return [zero_hidden_by(robot, axis).value for axis in range(robot.axis_count)]


def leaning(robot: Robot, angle_deg: float) -> Robot:
    angle = np.deg2rad(angle_deg)
    gravity_m_s2 = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    return replace(robot, gravity_m_s2=gravity_m_s2)


def test_an_upright_arm_hides_the_first_zero_by_symmetry_and_the_last_one_by_its_link(
    arm: Robot,
) -> None:
    assert causes(arm) == ["symmetry", "moves", "last link"]


def test_a_base_that_leans_by_two_degrees_is_upright_still(arm: Robot) -> None:
    robot = leaning(arm, 2.0)
    assert zero_hidden_by(robot, 0) is ZeroHiddenBy.SYMMETRY


@pytest.mark.parametrize("angle_deg", [20.0, 90.0])
def test_on_a_wall_the_first_zero_is_hidden_by_the_moves_alone(
    arm: Robot, angle_deg: float
) -> None:
    robot = leaning(arm, angle_deg)
    assert zero_hidden_by(robot, 0) is ZeroHiddenBy.MOVES


def test_slides_before_any_turning_joint_shift_the_whole_arm() -> None:
    """A turn about the vertical behind horizontal slides is none of the whole arm:
    their torques show it.
    """
    robot = gantry_truth().model.robot
    assert causes(robot) == [
        "symmetry",
        "symmetry",
        "symmetry",
        "moves",
        "last link",
    ]


def test_axes_before_are_those_of_the_chain(arm: Robot) -> None:
    assert axes_before(0, arm) == ()
    assert axes_before(2, arm) == (1, 0)
