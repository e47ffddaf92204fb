"""Zeros and lengths of a description, and what they do to torques,
against the simulator's mechanics.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.simulation.closures import Mechanism as SimulatedMechanism
from drivers.simulation.plant import link_model
from drivers.simulation.spec import CellSpec
from ident.errors import ModelError
from ident.model.closed_chain import assemble
from ident.model.geometry import (
    GeometryChange,
    GeometryKind,
    GeometryParameter,
    described_length,
    geometry_parameters,
    model_with_geometry,
    unit_of,
    with_geometry,
)
from ident.model.model import DriveTrain, Model
from ident.model.robot import Motion, poses
from ident.model.urdf import LinkPair, robot_from_urdf
from tests.ident.mechanisms import FIVE_BAR, PLANAR, THREE_LEGS, Mechanism

FloatArray = NDArray[np.float64]
STEP_S = 1e-3
STEP = 1e-4  #: of the central differences [rad, or of the robot's size]


def _torque_slope(
    model: Model, motion: Motion, standard: FloatArray, parameter: GeometryParameter
) -> FloatArray:
    """Change of the axes' torques per unit of a zero or a length, shape (m, k)."""
    step = STEP * unit_of(model, parameter)
    ahead = _torque(_changed(model, parameter, step), motion, standard)
    behind = _torque(_changed(model, parameter, -step), motion, standard)
    difference = ahead - behind
    return difference / (2.0 * step)


def _changed(model: Model, parameter: GeometryParameter, change: float) -> Model:
    return model_with_geometry(model, (GeometryChange(parameter, change),))


def _torque(model: Model, motion: Motion, standard: FloatArray) -> FloatArray:
    """Torques of the axes, shape (m, k)."""
    torques = model.torques(motion, standard)
    return np.asarray(torques[2])


def _home_rad(model: Model) -> FloatArray:
    """Positions of the axes in which the robot is assembled."""
    axis_joints = list(model.robot.axis_joints)
    return np.asarray(model.assembly.position_rad[axis_joints])


def test_parameters_are_the_zeros_of_motors_and_the_lengths_of_moving_links() -> None:
    names = [one.name for one in geometry_parameters(FIVE_BAR.robot)]
    expected = [
        "zero of left-crank",
        "zero of right-crank",
        "length from left-crank to left-rod",
        "length from right-crank to right-rod",
        "length from left-rod to tip",
        "length from right-rod to tip",
    ]
    assert names == expected


@pytest.mark.parametrize("mechanism", [FIVE_BAR, THREE_LEGS], ids=lambda one: one.name)
def test_a_zero_is_added_to_the_recorded_positions(mechanism: Mechanism) -> None:
    robot = mechanism.robot
    home = assemble(robot).position_rad
    for axis, joint in enumerate(robot.axis_joints):
        change = GeometryChange(geometry_parameters(robot)[axis], 0.01)
        shifted = home.copy()
        shifted[joint] += 0.01
        changed = with_geometry(robot, (change,))
        found = poses(changed, home[None])
        expected = poses(robot, shifted[None])
        behind = joint + 2
        found_origins_m = found.origin_m[behind:]
        expected_origins_m = expected.origin_m[behind:]
        assert_allclose(found_origins_m, expected_origins_m, atol=1e-12)
        assert_allclose(found.rotation, expected.rotation, atol=1e-12)


@pytest.mark.slow
def test_a_length_moves_the_other_end_of_its_link_along_itself() -> None:
    robot = PLANAR.robot
    parameters = geometry_parameters(robot)
    lengths = [one for one in parameters if one.kind is GeometryKind.LENGTH]
    before_m = {length: described_length(robot, length) for length in lengths}
    for length in lengths:
        change = GeometryChange(length, 3e-4)
        longer = with_geometry(robot, (change,))
        for one in lengths:
            found_m = described_length(longer, one)
            if one == length:
                longer_m = before_m[one] + 3e-4
                assert found_m == pytest.approx(longer_m)
            else:
                assert found_m == before_m[one]


def test_an_unknown_length_is_refused_with_those_that_there_are() -> None:
    unknown = GeometryParameter(GeometryKind.LENGTH, "left-crank", "right-rod")
    change = GeometryChange(unknown, 1e-3)
    with pytest.raises(ModelError, match="length from left-crank to left-rod"):
        with_geometry(FIVE_BAR.robot, (change,))
    with pytest.raises(ModelError, match="no length from left-crank to right-rod"):
        described_length(FIVE_BAR.robot, unknown)


# The derivative of the torques, against the simulator's closures and Pinocchio's tree


def _model(spec: CellSpec) -> Model:
    pairs = []
    for closure in spec.closures:
        pair = LinkPair(
            closure.name,
            closure.first,
            closure.second,
            closure.directions,
        )
        pairs.append(pair)
    assembly_rad = dict(spec.assembly_rad)
    robot = robot_from_urdf(
        spec.urdf,
        spec.gravity_m_s2,
        closures=pairs,
        motors=spec.motors,
        assembly_rad=assembly_rad,
        platform=spec.platform,
    )
    return Model(robot, DriveTrain(spec.ratio))


def _standard(model: Model, spec: CellSpec) -> FloatArray:
    """Parameters of the links as Pinocchio reads them:
    m, m c and the inertia about the joint's origin.
    """
    changed_spec = replace(spec, payload=None)
    tree = link_model(changed_spec)
    standard = np.zeros(len(model.columns))
    for joint, columns in zip(model.robot.joints, model.link_columns, strict=True):
        joint_id = tree.getJointId(joint.name)
        inertia = tree.inertias[joint_id]
        m, mx, my, mz, xx, xy, yy, xz, yz, zz = inertia.toDynamicParameters()
        standard[columns] = xx, xy, xz, yy, yz, zz, mx, my, mz, m
    return standard


def _axes_motion(model: Model, samples: int) -> Motion:
    time_s = np.linspace(0.0, 1.0, samples)
    frequency_hz = np.array([0.7, 1.1])
    wave = 2.0 * np.pi * frequency_hz
    phase = wave * time_s[:, None] + [0.0, 1.0]
    swing_rad = 0.25 * np.sin(phase)
    position_rad = _home_rad(model) + swing_rad
    velocity_rad_s = 0.25 * wave * np.cos(phase)
    acceleration_rad_s2 = -(wave**2) * swing_rad
    return Motion(
        position_rad,
        velocity_rad_s,
        acceleration_rad_s2,
    )


def _simulated_torque(spec: CellSpec, motion: Motion, zero_rad: FloatArray) -> FloatArray:
    """Torque of the motors, shape (m, k): the simulator's closures, differences in time,
    and Pinocchio's RNEA.
    """
    changed_spec = replace(spec, payload=None)
    tree = link_model(changed_spec)
    mechanism = SimulatedMechanism(tree, spec)
    data = tree.createData()
    motors = len(spec.motors)
    torques = []
    position = mechanism.start_rad
    order = mechanism.order
    for sample in range(len(motion.position_rad)):
        start_rad = motion.position_rad[sample] + zero_rad
        speed_rad_s = motion.velocity_rad_s[sample]
        acceleration_rad_s2 = motion.acceleration_rad_s2[sample]
        states = []
        for step in (-STEP_S, 0.0, STEP_S):
            by_speed = step * speed_rad_s
            by_acceleration = 0.5 * step**2 * acceleration_rad_s2
            rough = position.copy()
            rough[:motors] = start_rad + by_speed + by_acceleration
            closed = mechanism.closed(rough, (motors,))
            states.append(closed)
        before, position, after = states
        velocity = (after - before) / (2.0 * STEP_S)
        second_difference = after - 2.0 * position + before
        acceleration = second_difference / STEP_S**2
        q = np.empty(tree.nv)
        v = np.empty(tree.nv)
        a = np.empty(tree.nv)
        q[order] = position
        v[order] = velocity
        a[order] = acceleration
        of_tree = pin.rnea(tree, data, q, v, a)[order]
        jacobian = mechanism.at(position)[1]
        of_motors = jacobian[:, :motors]
        of_passive = jacobian[:, motors:]
        passive = -np.linalg.solve(of_passive, of_motors)
        torque = of_tree[:motors] + passive.T @ of_tree[motors:]
        torques.append(torque)
    return np.array(torques).T


def _with_length(spec: CellSpec, joint: str, before_m: float, after_m: float) -> CellSpec:
    """The cell with another place of a joint on its link."""
    described = f'xyz="{before_m:g} 0 0"'
    changed = f'xyz="{after_m!r} 0 0"'
    head, name, tail = spec.urdf.partition(f'name="{joint}"')
    assert described in tail
    changed_tail = tail.replace(described, changed, 1)
    urdf = head + name + changed_tail
    return replace(spec, urdf=urdf)


def test_the_derivative_of_the_torques_is_that_of_the_simulated_five_bar() -> None:
    spec = load_simulation(shipped_simulation("five-bar"))
    model = _model(spec)
    standard = _standard(model, spec)
    motion = _axes_motion(model, 12)
    no_zero = np.zeros(2)
    torque = _torque(model, motion, standard)
    simulated = _simulated_torque(spec, motion, no_zero)
    largest = np.abs(torque).max()
    assert_allclose(torque, simulated, atol=1e-4 * largest)

    step = 1e-3
    joints = model.robot.joints
    (crank, *_) = [joint for joint in joints if joint.parent >= 0]
    driven = joints[crank.parent].name
    length_m = float(np.linalg.norm(crank.translation_m))
    longer = _with_length(spec, crank.name, length_m, length_m + step)
    shorter = _with_length(spec, crank.name, length_m, length_m - step)
    torque_longer = _simulated_torque(longer, motion, no_zero)
    torque_shorter = _simulated_torque(shorter, motion, no_zero)
    length = GeometryParameter(GeometryKind.LENGTH, driven, crank.name)

    turned = np.array([step, 0.0])
    torque_ahead = _simulated_torque(spec, motion, turned)
    torque_behind = _simulated_torque(spec, motion, -turned)
    zero = GeometryParameter(GeometryKind.ZERO, model.robot.axes[0].name)

    changes = {length: torque_longer - torque_shorter, zero: torque_ahead - torque_behind}
    for parameter, change in changes.items():
        expected = change / (2.0 * step)
        found = _torque_slope(model, motion, standard, parameter)
        largest = np.abs(expected).max()
        assert_allclose(found, expected, atol=2e-3 * largest)


@pytest.mark.slow
def test_the_torque_beside_a_redundant_robot_is_the_derivative_times_the_change() -> None:
    """To first order: halving the change quarters what the derivative leaves."""
    model = PLANAR.model
    rng = np.random.default_rng(3)
    standard = rng.uniform(0.1, 1.0, len(model.columns))
    home = _home_rad(model)
    still = np.zeros((1, 4))
    acceleration_rad_s2 = still + 1.0
    motion = Motion(home[None], still, acceleration_rad_s2)
    described = _torque(model, motion, standard)
    for parameter in geometry_parameters(model.robot)[1::4]:
        slope = _torque_slope(model, motion, standard, parameter)
        left = []
        for change in (2e-3, 1e-3):
            changed = _torque(_changed(model, parameter, change), motion, standard)
            by_derivative = change * slope
            rest = changed - described - by_derivative
            left.append(np.linalg.norm(rest))
        of_change, of_half = left
        ratio = of_change / of_half
        assert 3.5 < ratio < 4.5
