"""Pivots that a closed chain is cut at:
their motion, and what friction in them asks of the motors.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose

from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from ident.model.model import Model
from ident.model.robot import Motion
from tests.ident.mechanisms import pin_on_a_parallel_link

STEP_S = 1e-4


def _model(name: str) -> Model:
    cells_folder = Path(shipped_configurations()) / "cells"
    path = cells_folder / f"{name}.yaml"
    return model_of(load_cell(path))


def _five_bar_motion(model: Model) -> Motion:
    """Motion of the two cranks by formulas, so that speeds and accelerations are exact."""
    time_s = np.arange(200) * STEP_S
    phase = np.array([0.3, 1.1])
    rate = np.array([7.0, 5.0])
    angle = np.outer(time_s, rate) + phase
    assert model.robot.axis_count == 2
    acceleration_rad_s2 = -0.3 * rate**2 * np.sin(angle)
    velocity_rad_s = 0.3 * rate * np.cos(angle)
    position_rad = 0.3 * np.sin(angle)
    return Motion(position_rad, velocity_rad_s, acceleration_rad_s2)


def test_a_pivot_turns_by_the_angle_between_its_two_rods() -> None:
    model = _model("five-bar")
    followed = model.follow(_five_bar_motion(model))
    placed = model.at_places(followed)
    names = [joint.name for joint in model.robot.joints]
    expected = ["crank-1", "crank-2", "elbow-1", "elbow-2", "pivot tip"]
    assert [joint.name for joint in model.robot.places] == expected
    sign = np.array([{"1": -1.0, "2": 1.0}[name[-1]] for name in names])
    for ours, of_joints in (
        (placed.velocity_rad_s, followed.joints.velocity_rad_s),
        (placed.acceleration_rad_s2, followed.joints.acceleration_rad_s2),
    ):
        assert_allclose(ours[:, -1], of_joints @ sign, atol=1e-9)
    turned = np.diff(placed.position_rad[:, -1])
    assert_allclose(turned, np.diff(followed.joints.position_rad @ sign), atol=1e-9)


def test_motion_of_every_pivot_is_the_derivative_of_its_angle() -> None:
    model = _model("five-bar")
    followed = model.follow(_five_bar_motion(model))
    placed = model.at_places(followed)
    for value, rate in (
        (placed.position_rad, placed.velocity_rad_s),
        (placed.velocity_rad_s, placed.acceleration_rad_s2),
    ):
        assert_allclose(np.gradient(value, STEP_S, axis=0)[2:-2], rate[2:-2], rtol=1e-4, atol=1e-3)


def test_motors_supply_the_power_that_a_pivot_loses() -> None:
    model = _model("dualv")
    # Motors of a redundant drive must fit each other: their positions and speeds are those of the
    # followed joints.
    still = np.zeros((1, 4))
    axis_joints = list(model.robot.axis_joints)
    home = Motion(model.assembly.position_rad[None, axis_joints], still, still)
    at_home = model.follow(home)
    speed = at_home.to_motors @ np.array([0.3, -0.4, 0.9])
    followed = model.follow(replace(home, velocity_rad_s=speed))
    placed = model.at_places(followed)
    leverage = model.leverage(followed)
    undriven = placed.velocity_rad_s[0, 4:]
    assert len(undriven) == len(model.robot.undriven_names) == 8
    assert np.abs(undriven).min() > 0.01
    assert_allclose(np.einsum("umk,km->u", leverage, speed), undriven, atol=1e-9)


def test_pivots_of_a_parallelogram_turn_as_joints_of_the_tree_and_are_no_places_of_their_own() -> (
    None
):
    assert _model("orthoglide").robot.pivots == ()


def test_a_pivot_that_does_not_turn_is_no_place() -> None:
    assert pin_on_a_parallel_link().robot.pivots == ()
