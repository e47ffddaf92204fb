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
    torques = []
    for change in (step, -step):
        changed = model_with_geometry(model, (GeometryChange(parameter, change),))
        torques.append(changed.torques(motion, standard)[2])
    ahead, behind = torques
    return np.asarray((ahead - behind) / (2.0 * step))


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
        found = poses(with_geometry(robot, (change,)), home[None])
        expected = poses(robot, shifted[None])
        assert_allclose(found.origin_m[joint + 2 :], expected.origin_m[joint + 2 :], atol=1e-12)
        assert_allclose(found.rotation, expected.rotation, atol=1e-12)


@pytest.mark.slow
def test_a_length_moves_the_other_end_of_its_link_along_itself() -> None:
    for parameter in geometry_parameters(PLANAR.robot):
        if parameter.kind is GeometryKind.LENGTH:
            before = described_length(PLANAR.robot, parameter)
            longer = with_geometry(PLANAR.robot, (GeometryChange(parameter, 3e-4),))
            assert described_length(longer, parameter) == pytest.approx(before + 3e-4)
            others = [
                one
                for one in geometry_parameters(PLANAR.robot)
                if one.kind is parameter.kind and one != parameter
            ]
            assert all(
                described_length(longer, one) == described_length(PLANAR.robot, one)
                for one in others
            )


def test_an_unknown_length_is_refused_with_those_that_there_are() -> None:
    unknown = GeometryParameter(GeometryKind.LENGTH, "left-crank", "right-rod")
    with pytest.raises(ModelError, match="length from left-crank to left-rod"):
        with_geometry(FIVE_BAR.robot, (GeometryChange(unknown, 1e-3),))
    with pytest.raises(ModelError, match="no length from left-crank to right-rod"):
        described_length(FIVE_BAR.robot, unknown)


# The derivative of the torques, against the simulator's closures and Pinocchio's tree


def _model(spec: CellSpec) -> Model:
    pairs = [LinkPair(one.name, one.first, one.second, one.directions) for one in spec.closures]
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
        m, mx, my, mz, xx, xy, yy, xz, yz, zz = tree.inertias[
            tree.getJointId(joint.name)
        ].toDynamicParameters()
        standard[columns] = xx, xy, xz, yy, yz, zz, mx, my, mz, m
    return standard


def _axes_motion(model: Model, samples: int) -> Motion:
    grid = np.linspace(0.0, 1.0, samples)
    t = grid[:, None]
    axis_joints = list(model.robot.axis_joints)
    home = model.assembly.position_rad[axis_joints]
    wave = 2.0 * np.pi * np.array([0.7, 1.1])
    position = home + 0.25 * np.sin(wave * t + [0.0, 1.0])
    acceleration_rad_s2 = -0.25 * wave**2 * np.sin(wave * t + [0.0, 1.0])
    velocity_rad_s = 0.25 * wave * np.cos(wave * t + [0.0, 1.0])
    return Motion(
        position,
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
    for sample in range(len(motion.position_rad)):
        states = []
        for step in (-STEP_S, 0.0, STEP_S):
            rough = position.copy()
            rough[:motors] = (
                motion.position_rad[sample]
                + zero_rad
                + step * motion.velocity_rad_s[sample]
                + 0.5 * step**2 * motion.acceleration_rad_s2[sample]
            )
            states.append(mechanism.closed(rough, (motors,)))
        before, position, after = states
        velocity = (after - before) / (2.0 * STEP_S)
        acceleration = (after - 2.0 * position + before) / STEP_S**2
        q, v, a = (np.empty(tree.nv) for _ in range(3))
        for target, source in ((q, position), (v, velocity), (a, acceleration)):
            target[mechanism.order] = source
        of_tree = pin.rnea(tree, data, q, v, a)[mechanism.order]
        jacobian = mechanism.at(position)[1]
        passive = -np.linalg.solve(jacobian[:, motors:], jacobian[:, :motors])
        torques.append(of_tree[:motors] + passive.T @ of_tree[motors:])
    return np.array(torques).T


def test_the_derivative_of_the_torques_is_that_of_the_simulated_five_bar() -> None:
    spec = load_simulation(shipped_simulation("five-bar"))
    model = _model(spec)
    standard = _standard(model, spec)
    motion = _axes_motion(model, 12)
    no_zero = np.zeros(2)
    whole = model.torques(motion, standard)[2]
    assert_allclose(
        whole, _simulated_torque(spec, motion, no_zero), atol=1e-4 * np.abs(whole).max()
    )
    step = 1e-3
    crank = next(joint for joint in model.robot.joints if joint.parent >= 0)
    driven = model.robot.joints[crank.parent].name
    length_m = float(np.linalg.norm(crank.translation_m))
    described = f'xyz="{length_m:g} 0 0"'
    before, _, after = spec.urdf.partition(f'name="{crank.name}"')
    assert described in after
    changed_after = after.replace(described, f'xyz="{length_m + step!r} 0 0"', 1)
    changed_after_urdf = f'{before}name="{crank.name}"' + changed_after
    longer = replace(
        spec,
        urdf=changed_after_urdf,
    )
    urdf = f'{before}name="{crank.name}"' + after.replace(
        described, f'xyz="{length_m - step!r} 0 0"', 1
    )
    shorter = replace(
        spec,
        urdf=urdf,
    )
    by_length = _simulated_torque(longer, motion, no_zero) - _simulated_torque(
        shorter, motion, no_zero
    )
    turned = np.array([step, 0.0])
    by_zero = _simulated_torque(spec, motion, turned) - _simulated_torque(spec, motion, -turned)
    geometry_parameter = GeometryParameter(GeometryKind.ZERO, model.robot.axes[0].name)
    for parameter, change in (
        (GeometryParameter(GeometryKind.LENGTH, driven, crank.name), by_length),
        (geometry_parameter, by_zero),
    ):
        expected = change / (2.0 * step)
        found = _torque_slope(model, motion, standard, parameter)
        largest_absolute_expected = np.abs(expected).max()
        assert_allclose(found, expected, atol=2e-3 * largest_absolute_expected)


@pytest.mark.slow
def test_the_torque_beside_a_redundant_robot_is_the_derivative_times_the_change() -> None:
    """To first order: halving the change quarters what the derivative leaves."""
    model = PLANAR.model
    rng = np.random.default_rng(3)
    standard = rng.uniform(0.1, 1.0, len(model.columns))
    axis_joints = list(model.robot.axis_joints)
    home = model.assembly.position_rad[axis_joints]
    still = np.zeros((1, 4))
    acceleration_rad_s2 = still + 1.0
    motion = Motion(home[None], still, acceleration_rad_s2)
    described = model.torques(motion, standard)[2]
    for parameter in geometry_parameters(model.robot)[1::4]:
        slope = _torque_slope(model, motion, standard, parameter)
        left = []
        for change in (2e-3, 1e-3):
            beside = model_with_geometry(model, (GeometryChange(parameter, change),))
            difference = beside.torques(motion, standard)[2] - described
            difference_norm = np.linalg.norm(difference - change * slope)
            left.append(difference_norm)
        assert 3.5 < left[0] / left[1] < 4.5
