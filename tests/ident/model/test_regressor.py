"""The regressor against Pinocchio's inverse dynamics, for arms of all kinds."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from ident.arrays import FloatArray
from ident.model import regressor
from ident.model.regressor import fill_rigid, mass_matrix
from ident.model.robot import Robot
from ident.model.urdf import robot_from_urdf
from tests.bench.torque_fit import moved_links
from tests.ident.arms import ARMS, GRAVITIES, Arm


def _pinocchio_parameters(model: pin.Model) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    parameters: list[float] = []
    for inertia in list(model.inertias)[1:]:
        mass, mx, my, mz, ixx, ixy, iyy, ixz, iyz, izz = inertia.toDynamicParameters()
        parameters.extend((ixx, ixy, ixz, iyy, iyz, izz, mx, my, mz, mass))
    return np.array(parameters)


def rigid_regressor(
    robot: Robot, position: FloatArray, velocity: FloatArray, acceleration: FloatArray
) -> FloatArray:
    """Columns of the rigid links, shape (n, 10 n, k)."""
    count, samples = position.shape
    out = np.zeros((count, count, 10, samples))
    fill_rigid(robot, position, velocity, acceleration, out)
    return out.reshape(count, 10 * count, samples)


def inverse_dynamics(
    model: pin.Model, position: FloatArray, velocity: FloatArray, acceleration: FloatArray
) -> FloatArray:
    """Torques by Pinocchio's recursive Newton-Euler algorithm, shape (n, k)."""
    data = model.createData()
    torques = [
        pin.rnea(model, data, q, v, a)
        for q, v, a in zip(position.T, velocity.T, acceleration.T, strict=True)
    ]
    return np.stack(torques, axis=1)


def largest_error(found: FloatArray, expected: FloatArray) -> float:
    return float(np.max(np.abs(found - expected)))


def largest_size(values: FloatArray) -> float:
    return float(np.max(np.abs(values)))


@pytest.mark.parametrize("gravity", GRAVITIES)
@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_agrees_with_inverse_dynamics_to_1e9(arm: Arm, gravity: tuple[float, float, float]) -> None:
    model = pin.buildModelFromXML(arm.urdf)
    model.gravity.linear = np.array(gravity)
    robot = robot_from_urdf(arm.urdf, gravity)
    rng = np.random.default_rng(7)
    q, v, a = rng.uniform(-3, 3, (3, model.nv, 40))
    parameters = _pinocchio_parameters(model)
    torque = np.einsum("jck,c->jk", rigid_regressor(robot, q, v, a), parameters)
    expected = inverse_dynamics(model, q, v, a)
    assert largest_error(torque, expected) < 1e-9 * max(1.0, largest_size(expected))


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_blocks_do_not_show(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = robot_from_urdf(arm.urdf)
    rng = np.random.default_rng(8)
    q, v, a = rng.uniform(-2, 2, (3, robot.joint_count, 25))
    whole = rigid_regressor(robot, q, v, a)
    monkeypatch.setattr(regressor, "BLOCK_SAMPLES", 10)
    in_blocks = rigid_regressor(robot, q, v, a)
    assert largest_error(in_blocks, whole) < 1e-12 * largest_size(whole)


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_writes_what_a_joint_moves_and_nothing_else(arm: Arm) -> None:
    robot = robot_from_urdf(arm.urdf)
    count = robot.joint_count
    rng = np.random.default_rng(9)
    q, v, a = rng.uniform(-2, 2, (3, count, 5))
    wide = np.full((count, count, 12, 5), np.nan)  # a column beside the ten, on either side
    fill_rigid(robot, q, v, a, wide[:, :, 1:11])
    moved = np.zeros((count, count), dtype=np.bool_)
    for joint, links in enumerate(moved_links(robot)):
        moved[joint, list(links)] = True
    expected = rigid_regressor(robot, q, v, a).reshape(count, count, 10, 5)
    assert np.array_equal(wide[moved][:, 1:11], expected[moved])
    assert np.isnan(wide[~moved]).all()
    assert np.isnan(wide[:, :, [0, 11]]).all()
    assert not expected[~moved].any()


TREE_JOINTS = (
    # name, type, parent, y, axis
    ("torso", "revolute", "base", "0", "0 0 1"),
    ("a1", "revolute", "torso", "0.2", "0 1 0"),
    ("a2", "prismatic", "a1", "0.1", "0.6 0 0.8"),
    ("b1", "revolute", "torso", "-0.2", "1 0 0"),
    ("b2", "revolute", "b1", "-0.1", "0 0 1"),
)


def _tree_joint(name: str, kind: str, parent: str, y: str, axis: str) -> str:
    """A joint and the link behind it."""
    return f'''
        <joint name="q{name}" type="{kind}">
          <origin xyz="0.1 {y} 0.3" rpy="0.3 0.1 {y}"/>
          <parent link="{parent}"/>
          <child link="{name}"/>
          <axis xyz="{axis}"/>
          <limit lower="-3" upper="3" velocity="3" effort="9"/>
        </joint>
        <link name="{name}">
          <inertial>
            <origin xyz="0.01 0.02 0.03"/>
            <mass value="2"/>
            <inertia ixx="0.03" ixy="0.001" ixz="-0.002" iyy="0.04" iyz="0.003" izz="0.02"/>
          </inertial>
        </link>'''


def test_in_a_tree_a_joint_moves_its_own_branch_alone() -> None:
    """Two arms on one torso: against Pinocchio, and what one arm does not move of the other."""
    joints = "".join(_tree_joint(*joint) for joint in TREE_JOINTS)
    urdf = f'<robot name="two"><link name="base"/>{joints}</robot>'
    robot = robot_from_urdf(urdf)
    assert moved_links(robot) == ((0, 1, 2, 3, 4), (1, 2), (2,), (3, 4), (4,))
    model = pin.buildModelFromXML(urdf)
    rng = np.random.default_rng(10)
    q, v, a = rng.uniform(-2, 2, (3, 5, 20))
    parameters = _pinocchio_parameters(model)
    torque = np.einsum("jck,c->jk", rigid_regressor(robot, q, v, a), parameters)
    expected = inverse_dynamics(model, q, v, a)
    assert largest_error(torque, expected) < 1e-9 * largest_size(expected)


def test_no_samples_are_no_rows() -> None:
    robot = robot_from_urdf(ARMS[0].urdf)
    nothing = np.zeros((robot.joint_count, 0))
    rows = rigid_regressor(robot, nothing, nothing, nothing)
    assert rows.shape == (6, 60, 0)


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_the_mass_matrix_is_that_of_the_composite_bodies(arm: Arm) -> None:
    model = pin.buildModelFromXML(arm.urdf)
    data = model.createData()
    rng = np.random.default_rng(9)
    q = rng.uniform(-3, 3, (model.nv, 12))
    parameters = _pinocchio_parameters(model).reshape(-1, 10)
    robot = robot_from_urdf(arm.urdf)
    found = mass_matrix(robot, q, parameters)
    for k in range(12):
        # Pinocchio fills the upper triangle alone.
        upper = np.triu(pin.crba(model, data, q[:, k]))
        symmetric = upper + np.triu(upper, 1).T
        assert found[:, :, k] == pytest.approx(symmetric, rel=1e-10, abs=1e-10)


def test_writes_the_wanted_parameters_alone() -> None:
    robot = robot_from_urdf(ARMS[0].urdf)
    count = robot.joint_count
    rng = np.random.default_rng(10)
    q, v, a = rng.uniform(-2, 2, (3, count, 5))
    whole = np.full((count, count, 10, 5), np.nan)
    part = np.full((count, count, 10, 5), np.nan)
    wanted = rng.random((count, 10)) < 0.5
    fill_rigid(robot, q, v, a, whole)
    fill_rigid(robot, q, v, a, part, wanted)
    assert np.array_equal(part[:, wanted], whole[:, wanted], equal_nan=True)
    assert np.isnan(part[:, ~wanted]).all()
