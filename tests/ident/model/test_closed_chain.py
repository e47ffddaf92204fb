"""Closed chains: how passive joints follow, against differences, Pinocchio,
and equations derived by hand.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.errors import ModelError
from ident.model.closed_chain import assemble, follow, reach
from ident.model.closures import loops
from ident.model.model import DriveTrain, Model
from ident.model.robot import DIRECTIONS, Closure, Motion, Place, Robot, poses
from ident.model.urdf import LinkPair, read_urdf, robot_from_urdf
from tests.ident.arms import SEVEN_AXES
from tests.ident.closed_recordings import axis_positions
from tests.ident.mechanisms import (
    BASE_M,
    CRANK_M,
    FIVE_BAR,
    MECHANISMS,
    PLANAR,
    ROD_M,
    SLIDE_M,
    THREE_LEGS,
    Mechanism,
    leg_angles,
)

FloatArray = NDArray[np.float64]
STEP_S = 1e-3
TOLERANCE = 1e-9


def _largest(values: FloatArray) -> float:
    """Largest absolute value."""
    return float(np.max(np.abs(values)))


def _turn(rng: np.random.Generator) -> FloatArray:
    """A random rotation."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    determinant = np.linalg.det(q)
    return np.asarray(q * np.sign(determinant))


def _place(rng: np.random.Generator, joint: int) -> Place:
    """A random place behind a joint."""
    rotation = _turn(rng)
    offset_m = rng.uniform(-0.3, 0.3, 3)
    return Place(joint, rotation, offset_m)


def _home(robot: Robot) -> FloatArray:
    """Positions of the motors at the assembly pose, shape (m,)."""
    position_rad = assemble(robot).position_rad
    motors = list(robot.axis_joints)
    return position_rad[motors]


def _standing(position_rad: FloatArray) -> Motion:
    """Axes that stand still at positions."""
    zero = np.zeros_like(position_rad)
    return Motion(position_rad, zero, zero)


def _full_turns(angle_rad: FloatArray) -> FloatArray:
    """The full turns in an angle [rad]."""
    turns = np.round(angle_rad / (2.0 * np.pi))
    return np.asarray(2.0 * np.pi * turns)


def _motor_angles(pose: FloatArray) -> FloatArray:
    """Motors of the planar platform at poses (x, y, angle), shape (k, 4)."""
    cranks = []
    for leg in range(4):
        crank, _ = leg_angles(pose, leg)
        cranks.append(crank)
    return np.stack(cranks, axis=1)


def _waves(samples: int) -> Motion:
    """Three sine waves, each with another frequency and phase, and their exact derivatives."""
    t = np.arange(samples) * STEP_S
    phase = np.arange(3)[:, None]
    frequency = 2.0 * np.pi * (0.6 + 0.35 * phase)
    angle = frequency * t + phase
    x = np.sin(angle)
    v = frequency * np.cos(angle)
    a = -(frequency**2) * np.sin(angle)
    return Motion(x.T, v.T, a.T)


def _axes_motion(mechanism: Mechanism, samples: int = 400) -> Motion:
    """A smooth motion of the motors that the closures allow, with its exact derivatives."""
    home = _home(mechanism.robot)
    waves = _waves(samples)
    if mechanism is PLANAR:
        return _platform_motion(waves, home)
    amplitude = 0.06
    if mechanism is FIVE_BAR:
        amplitude = 0.4
    count = len(home)
    position_rad = home + amplitude * waves.position_rad[:, :count]
    velocity_rad_s = amplitude * waves.velocity_rad_s[:, :count]
    acceleration_rad_s2 = amplitude * waves.acceleration_rad_s2[:, :count]
    return Motion(position_rad, velocity_rad_s, acceleration_rad_s2)


def _platform_motion(waves: Motion, home: FloatArray) -> Motion:
    """Motion of the motors while the planar platform follows waves.

    Derivatives are differences of fourth order.
    """
    amplitude = np.array([0.05, 0.05, 0.3])
    pose = amplitude * waves.position_rad
    rate = amplitude * waves.velocity_rad_s
    change = amplitude * waves.acceleration_rad_s2
    h = 1e-4
    angles = []
    for k in (-2, -1, 0, 1, 2):
        step_s = k * h
        moved = pose + step_s * rate + 0.5 * step_s**2 * change
        angles.append(_motor_angles(moved))
    at_minus_2h, at_minus_h, at_0, at_plus_h, at_plus_2h = angles
    near_difference = at_plus_h - at_minus_h
    far_difference = at_plus_2h - at_minus_2h
    velocity = (8.0 * near_difference - far_difference) / (12.0 * h)
    near_sum = at_minus_h + at_plus_h
    far_sum = at_minus_2h + at_plus_2h
    acceleration = (16.0 * near_sum - 30.0 * at_0 - far_sum) / (12.0 * h**2)
    position_rad = at_0 + _full_turns(home - at_0[0])
    return Motion(position_rad, velocity, acceleration)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    directions=st.lists(st.sampled_from(DIRECTIONS), min_size=1, max_size=6, unique=True),
)
def test_derivatives_of_any_closure(seed: int, directions: list[str]) -> None:
    rng = np.random.default_rng(seed)
    tree = robot_from_urdf(SEVEN_AXES.urdf)
    joints = []
    for index, joint in enumerate(tree.joints):
        branched = replace(joint, parent=index // 2 - 1)
        joints.append(branched)
    first = _place(rng, 6)
    second = _place(rng, 5)
    closure = Closure("any", first, second, tuple(directions))
    robot = Robot(tuple(joints), tree.gravity_m_s2, (closure,), (0,))
    q, v = rng.uniform(-1, 1, (2, 1, 7))
    h = 1e-6

    here = loops(robot, q, velocity=v)
    ahead = loops(robot, q + h * v)
    behind = loops(robot, q - h * v)

    rate = here.jacobian[0] @ v[0]
    residual_difference = ahead.residual - behind.residual
    rate_by_difference = residual_difference[0] / (2 * h)
    assert rate == pytest.approx(rate_by_difference, abs=1e-7)
    jacobian_difference = ahead.jacobian - behind.jacobian
    bias_by_difference = jacobian_difference[0] @ v[0] / (2 * h)
    assert here.bias[0] == pytest.approx(bias_by_difference, abs=1e-6)


def _velocities(jacobian: FloatArray, joints: FloatArray) -> FloatArray:
    """Jᵢ q̇ᵢ of each sample, shape (k, c)."""
    return np.asarray(np.einsum("kcn,kn->kc", jacobian, joints))


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_joints_follow_with_their_derivatives(mechanism: Mechanism) -> None:
    robot = mechanism.robot
    motion = _axes_motion(mechanism)
    assembly = assemble(robot, mechanism.mobility)
    found = follow(robot, assembly, motion)
    q = found.joints.position_rad
    v = found.joints.velocity_rad_s
    a = found.joints.acceleration_rad_s2
    residual = loops(robot, q).residual
    assert _largest(residual) < 1e-11
    motors = list(robot.axis_joints)
    motor_difference = q[:, motors] - motion.position_rad
    assert _largest(motor_difference) < 1e-11

    closing = loops(robot, q, velocity=v)
    jacobian = closing.jacobian
    closing_velocity = _velocities(jacobian, v)
    assert _largest(closing_velocity) < 1e-10
    closing_acceleration = _velocities(jacobian, a) + closing.bias
    assert _largest(closing_acceleration) < 1e-9
    v_by_difference = (q[2:] - q[:-2]) / (2 * STEP_S)
    velocity_error = v_by_difference - v[1:-1]
    tolerance = 2e-5 * _largest(a) + 1e-4
    assert _largest(velocity_error) < tolerance

    per_coordinate = np.einsum("kcn,knd->kcd", jacobian, found.to_joints)
    assert _largest(per_coordinate) < 1e-12
    motors_per_coordinate = found.to_joints[:, motors]
    assert found.to_motors == pytest.approx(motors_per_coordinate)


def test_a_pose_does_not_depend_on_what_was_asked_before() -> None:
    motion = _axes_motion(FIVE_BAR, 300)
    robot = FIVE_BAR.robot
    assembly = assemble(robot)
    all_rad = follow(robot, assembly, motion).joints.position_rad
    part = slice(77, 201)
    part_of_motion = Motion(
        motion.position_rad[part],
        motion.velocity_rad_s[part],
        motion.acceleration_rad_s2[part],
    )
    part_rad = follow(robot, assembly, part_of_motion).joints.position_rad
    position_difference_rad = part_rad - all_rad[part]
    assert _largest(position_difference_rad) < 1e-11


def test_a_model_keeps_a_motion_as_long_as_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    model = FIVE_BAR.model
    motion = _axes_motion(FIVE_BAR, 50)
    first = model.follow(motion)
    assert model.follow(replace(motion)) is first
    velocity_rad_s = 2.0 * motion.velocity_rad_s
    faster = Motion(motion.position_rad, velocity_rad_s, motion.acceleration_rad_s2)
    faster_rad_s = model.follow(faster).joints.velocity_rad_s
    first_rad_s = first.joints.velocity_rad_s
    assert faster_rad_s == pytest.approx(2.0 * first_rad_s)
    assert model.follow(motion) is first
    with pytest.raises(ValueError, match="read-only"):
        first.to_joints[0] = 0.0
    motion.position_rad[7] += 1e-9  # what was followed is not what the array holds now
    moved = model.follow(motion).joints.position_rad
    unmoved = first.joints.position_rad
    assert moved == pytest.approx(unmoved, abs=1e-8)
    assert not np.array_equal(moved[7], unmoved[7])
    monkeypatch.setattr("ident.model.model.REMEMBERED_BYTES", 1000)
    assert model.follow(faster) is not model.follow(faster)


def _vector(length_m: float, angle_rad: FloatArray) -> FloatArray:
    """Vectors of a length in the plane, at angles from its x axis, shape (k, 2)."""
    cosine = np.cos(angle_rad)
    sine = np.sin(angle_rad)
    return length_m * np.stack([cosine, sine], axis=1)


def test_five_bar_against_the_circles_that_its_rods_describe() -> None:
    assembly = assemble(FIVE_BAR.robot)
    joints = follow(FIVE_BAR.robot, assembly, _axes_motion(FIVE_BAR)).joints
    found = joints.position_rad
    names = [joint.name for joint in FIVE_BAR.robot.joints]
    left = found[:, names.index("left-crank")]
    right = found[:, names.index("right-crank")]
    left_rod = found[:, names.index("left-rod")]

    base = np.array([0.5 * BASE_M, 0.0])
    left_end = -base + _vector(CRANK_M, left)
    right_end = base + _vector(CRANK_M, right)
    middle = 0.5 * (left_end + right_end)
    apart = right_end - left_end
    distance = np.linalg.norm(apart, axis=1)
    half = 0.5 * distance
    across = np.stack([-apart[:, 1], apart[:, 0]], axis=1)
    unit_across = across / distance[:, None]
    height = np.sqrt(ROD_M**2 - half**2)
    tip = middle + height[:, None] * unit_across
    rod = _vector(ROD_M, left_rod + left)
    assert left_end + rod == pytest.approx(tip, abs=1e-12)


def test_three_legs_carry_a_platform_that_only_translates() -> None:
    robot = THREE_LEGS.robot
    motion = _axes_motion(THREE_LEGS)
    joints = follow(robot, assemble(robot), motion).joints
    position_rad = joints.position_rad
    placed = poses(robot, position_rad)
    names = [joint.name for joint in robot.joints]
    hand = names.index("hand-0") + 1
    rotation = placed.rotation[hand]
    first_rotation = np.broadcast_to(rotation[0], (400, 3, 3))
    assert rotation == pytest.approx(first_rotation, abs=1e-11)
    # Each rod keeps its length: from its slide to the platform.
    for leg in range(3):
        direction = np.eye(3)[leg]
        slide_m = motion.position_rad[:, leg] - SLIDE_M
        rod_m = placed.origin_m[hand] - np.outer(slide_m, direction)
        length_m = np.linalg.norm(rod_m, axis=1)
        assert length_m == pytest.approx(SLIDE_M, abs=1e-11)


def _pinocchio_model(mechanism: Mechanism) -> Any:
    """The tree without closures."""
    tree = pin.buildModelFromXML(mechanism.urdf)
    tree.gravity.linear = np.array(mechanism.gravity_m_s2)
    return tree


def _torque_of_tree(mechanism: Mechanism, joints: Motion) -> FloatArray:
    """Pinocchio's inverse dynamics of the tree without closures, shape (k, n)."""
    model = _pinocchio_model(mechanism)
    data = model.createData()
    states = zip(
        joints.position_rad, joints.velocity_rad_s, joints.acceleration_rad_s2, strict=True
    )
    torques = [pin.rnea(model, data, q, v, a) for q, v, a in states]
    return np.stack(torques)


def _standard(mechanism: Mechanism, model: Model) -> FloatArray:
    """The URDF's inertias as standard parameters, without friction."""
    standard = np.zeros(len(model.columns))
    bodies = read_urdf(mechanism.urdf).bodies
    for columns, body in zip(model.link_columns, bodies, strict=True):
        standard[columns] = body.parameters
    return standard


def _motor_torque(model: Model, motion: Motion, standard: FloatArray) -> FloatArray:
    """Torque of the motors by the regressor, shape (m, k)."""
    regressor = model.regressor(motion)
    return np.asarray(np.einsum("mck,c->mk", regressor, standard))


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_virtual_power_of_the_motors_is_that_of_all_joints(mechanism: Mechanism) -> None:
    model = mechanism.model
    motion = _axes_motion(mechanism, 60)
    torque = _motor_torque(model, motion, _standard(mechanism, model))
    followed = model.follow(motion)
    tree = _torque_of_tree(mechanism, followed.joints)
    motors = np.einsum("kmd,mk->kd", followed.to_motors, torque)
    joints = np.einsum("knd,kn->kd", followed.to_joints, tree)
    difference = motors - joints
    assert _largest(difference) < 1e-9 * _largest(joints)


def _end_of(tree: Any, link: str) -> tuple[Any, Any]:
    """Parent joint and placement of a link, in Pinocchio."""
    number = tree.getFrameId(link, pin.FrameType.BODY)
    frame = tree.frames[number]
    return frame.parentJoint, frame.placement


def _pinocchio_constraints(tree: Any, mechanism: Mechanism) -> Any:
    """The closures of a mechanism as constraints of Pinocchio."""
    constraints = pin.StdVec_RigidConstraintModel()
    for closure in mechanism.closures:
        # In a plane, the third translation holds by itself.
        if len(closure.directions) == 6:
            kind = pin.ContactType.CONTACT_6D
        else:
            kind = pin.ContactType.CONTACT_3D
        first = _end_of(tree, closure.first)
        second = _end_of(tree, closure.second)
        local = pin.ReferenceFrame.LOCAL
        constraint = pin.RigidConstraintModel(kind, tree, *first, *second, local)
        constraints.append(constraint)
    return constraints


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_constrained_forward_dynamics_returns_the_acceleration(mechanism: Mechanism) -> None:
    """The torques of the regressor, put into Pinocchio's forward dynamics with constraints of its
    own.
    """
    model = mechanism.model
    motion = _axes_motion(mechanism, 40)
    standard = _standard(mechanism, model)
    torque = _motor_torque(model, motion, standard).T
    joints = model.follow(motion).joints
    tree = _pinocchio_model(mechanism)
    data = tree.createData()
    constraints = _pinocchio_constraints(tree, mechanism)
    datas = pin.StdVec_RigidConstraintData()
    for constraint in constraints:
        constraint_data = constraint.createData()
        datas.append(constraint_data)
    pin.initConstraintDynamics(tree, data, constraints, datas)
    proximal = pin.ProximalSettings(1e-13, 1e-10, 200)
    joint_numbers = [tree.getJointId(joint.name) for joint in model.robot.axes]
    motor_dofs = [tree.joints[number].idx_v for number in joint_numbers]
    for k in range(40):
        q = joints.position_rad[k]
        v = joints.velocity_rad_s[k]
        applied = np.zeros(tree.nv)
        applied[motor_dofs] = torque[k]
        found = pin.constraintDynamics(tree, data, q, v, applied, constraints, datas, proximal)
        expected = joints.acceleration_rad_s2[k]
        difference = found - expected
        assert _largest(difference) < TOLERANCE * _largest(expected)


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_short_cuts_agree_with_the_regressor(mechanism: Mechanism) -> None:
    model = mechanism.model
    motion = _axes_motion(mechanism, 30)
    standard = _standard(mechanism, model)
    load, _, total = model.torques(motion, standard)
    torque = _motor_torque(model, motion, standard)
    assert load == pytest.approx(torque, rel=1e-9, abs=1e-9)
    assert total == pytest.approx(torque, rel=1e-9, abs=1e-9)
    # Of a redundant drive not all motors at will, which would tear the platform apart, but as its
    # coordinates move.
    to_motors = model.follow(motion).to_motors
    per_x = to_motors.sum(axis=2)
    acceleration_rad_s2 = motion.acceleration_rad_s2 + per_x
    faster = Motion(motion.position_rad, motion.velocity_rad_s, acceleration_rad_s2)
    change = _motor_torque(model, faster, standard) - torque
    inertia = model.inertia(motion.position_rad, standard)
    found = np.einsum("mjk,kj->mk", inertia, per_x)
    assert found == pytest.approx(change, rel=1e-8, abs=1e-9)


def test_a_robot_without_closures_is_the_special_case() -> None:
    robot = robot_from_urdf(SEVEN_AXES.urdf)
    assembly = assemble(robot)
    rng = np.random.default_rng(0)
    q = rng.uniform(-1, 1, (5, 7))
    axes = Motion(q, q, q)
    found = follow(robot, assembly, axes)
    assert assembly.mobility == 7
    assert (found.to_joints == np.eye(7)).all()
    assert (found.to_motors == np.eye(7)).all()
    drive_train = DriveTrain(np.eye(7))
    assert Model(robot, drive_train).is_redundant is False


def _wrong(mechanism: Mechanism, **changes: Any) -> Robot:
    return replace(mechanism, **changes).robot


def _stretched_rad() -> float:
    """Angle of the right crank of the five-bar where both rods are in one line."""
    cosine = (2.0 * ROD_M - BASE_M) / (2.0 * CRANK_M)
    return float(np.arccos(cosine))


def test_bad_descriptions_are_refused_by_name() -> None:
    assembly_rad = {"left-crank": 3.1, "right-crank": 0.0}
    with pytest.raises(
        ModelError,
        match=r"closure 'tip' cannot close at the assembly "
        r"pose: x .* mm",
    ):
        assemble(_wrong(FIVE_BAR, assembly_rad=assembly_rad))
    with pytest.raises(
        ModelError, match="leave 2 degrees of freedom at the assembly pose; expected 3"
    ):
        assemble(FIVE_BAR.robot, 3)
    robot = _wrong(FIVE_BAR, motors=("left-crank",))
    with pytest.raises(ModelError, match="left-crank do not move all 2 degrees of freedom"):
        assemble(robot)
    # Both rods in one line: the tip can move across it while the cranks stay.
    low = _stretched_rad()
    high = np.pi - low
    stretched = {"left-crank": high, "left-rod": -high, "right-crank": low, "right-rod": high}
    singular = _wrong(FIVE_BAR, assembly_rad=stretched)
    with pytest.raises(ModelError, match="the robot is singular at the assembly pose"):
        assemble(singular)
    closures = (LinkPair("tip", "nowhere", "right-tip", ("x",)),)
    with pytest.raises(ModelError, match="names link 'nowhere'"):
        _wrong(FIVE_BAR, closures=closures)
    with pytest.raises(ModelError, match="the list of motors names joint 'left'"):
        _wrong(FIVE_BAR, motors=("left", "right-crank"))
    motors = ("left-crank", "right-crank", "left-crank")
    with pytest.raises(
        ModelError, match="two motors drive left-crank; expected a joint of its own for each"
    ):
        assemble(_wrong(FIVE_BAR, motors=motors))
    far_rad = {"left-crank": np.radians(3.6e9), "right-crank": 0.0}
    far = _wrong(FIVE_BAR, assembly_rad=far_rad)
    with pytest.raises(ModelError, match=r"left-crank at 3.6e\+09°; expected -360° to 360°"):
        assemble(far)
    link_pair = LinkPair("tip", "left-tip", "right-tip", ("q",))
    with pytest.raises(ModelError, match="directions q; expected some of x, y, z, rx, ry, rz"):
        _wrong(FIVE_BAR, closures=(link_pair,))


def test_motors_of_a_redundant_drive_that_do_not_fit_each_other_are_named() -> None:
    motion = _axes_motion(PLANAR, 30)
    robot = PLANAR.robot
    assembly = assemble(PLANAR.robot)
    turned = motion.position_rad.copy()
    turned[:, 1] += 0.15  # a wrong zero
    axes = replace(motion, position_rad=turned)
    with pytest.raises(
        ModelError,
        match=r"motors do not fit each other at .*: .* away from where the others hold it",
    ):
        follow(robot, assembly, axes)
    # What an encoder or a bent arm makes is no wrong zero.
    rng = np.random.default_rng(0)
    shaken = motion.position_rad + rng.normal(0.0, 1e-3, turned.shape)
    changed_motion = replace(motion, position_rad=shaken)
    to_motors = follow(robot, assembly, changed_motion).to_motors
    assert to_motors.shape == (30, 4, 3)


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_the_assembly_pose_has_the_condition_of_a_motion_there(mechanism: Mechanism) -> None:
    robot = mechanism.robot
    assembly = assemble(mechanism.robot)
    home = _home(robot)[None]
    axes = _standing(home)
    found = follow(robot, assembly, axes)
    reached = reach(robot, assembly, home)
    assert found.condition == pytest.approx(assembly.condition)
    assert reached.condition == pytest.approx(assembly.condition)


def test_a_redundant_drive_train_is_diagonal() -> None:
    order = [1, 0, 2, 3]
    ratio = 5.0 * np.eye(4)[order]
    drive_train = DriveTrain(ratio)
    with pytest.raises(ModelError, match="expected a diagonal drive train"):
        Model(PLANAR.robot, drive_train)


def test_a_position_out_of_reach_is_named() -> None:
    out_of_reach = np.array([[3.1, 0.0]])
    motion = Motion(out_of_reach, out_of_reach, out_of_reach)
    assembly = assemble(FIVE_BAR.robot)
    with pytest.raises(
        ModelError, match=r"the loops cannot be closed at left-crank .*, right-crank "
    ):
        follow(FIVE_BAR.robot, assembly, motion)


def test_a_motion_through_a_singularity_is_refused_with_the_pose() -> None:
    low = _stretched_rad() + 1e-7
    home = _home(FIVE_BAR.robot)
    singular = np.array([np.pi - low, low])
    way = np.linspace(0.0, 1.0, 200)
    motion = home + np.outer(way, singular - home)
    axes = _standing(motion)
    assembly = assemble(FIVE_BAR.robot)
    with pytest.raises(
        ModelError, match=r"close to a singularity at left-crank 2.73, right-crank 0.41"
    ):
        follow(FIVE_BAR.robot, assembly, axes)


def test_the_planar_platform_is_where_its_legs_hold_it() -> None:
    pose = np.array([[0.03, -0.02, 0.2]])
    motors = _motor_angles(pose)
    home = _home(PLANAR.robot)
    motors += _full_turns(home - motors)
    axes = _standing(motors)
    assembly = assemble(PLANAR.robot)
    found = follow(PLANAR.robot, assembly, axes).joints.position_rad
    names = [joint.name for joint in PLANAR.robot.joints]
    turned = dict(zip(names, found[0], strict=True))
    platform_rad = turned["motor-0"] + turned["elbow-0"] + turned["platform"]
    assert platform_rad == pytest.approx(0.2)


@pytest.mark.slow
@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_every_pose_of_a_recording_is_reached_from_the_assembly_pose(mechanism: Mechanism) -> None:
    """Also when they are asked one by one, far from each other, as a planner does."""
    robot = mechanism.robot
    assembly = assemble(mechanism.robot)
    rng = np.random.default_rng(7)
    motion = axis_positions(mechanism, rng, 40.0)
    smooth = reach(robot, assembly, motion)
    apart = reach(robot, assembly, motion[::97])
    assert smooth.closed.all()
    assert apart.closed.all()
    position_difference_rad = apart.position_rad - smooth.position_rad[::97]
    assert _largest(position_difference_rad) < 1e-8


PARALLELOGRAM = """<robot name="lifter">
  <link name="base"/><link name="column"/><link name="upper arm"/><link name="forearm"/><link name="hand"/>
  <joint name="J1" type="revolute"><parent link="base"/><child link="column"/><axis xyz="0 0 1"/>
    <limit velocity="1" effort="1"/></joint>
  <joint name="J2" type="revolute"><parent link="column"/><child link="upper arm"/><origin xyz="0.05 0 0.2"/>
    <axis xyz="0 1 0"/><limit velocity="1" effort="1"/></joint>
  <joint name="rod" type="revolute"><parent link="upper arm"/><child link="forearm"/><origin xyz="0 0 0.35"/>
    <axis xyz="0 1 0"/><limit velocity="1" effort="1"/></joint>
  <joint name="J4" type="revolute"><parent link="forearm"/><child link="hand"/><origin xyz="0 0 0.3"/>
    <axis xyz="1 0 0"/><limit velocity="1" effort="1"/></joint>
</robot>"""  # noqa: E501


def _check_follower(joints: FloatArray, axes: FloatArray) -> None:
    """Check that the axes are where they were put, and the rod turns back as J2 turns."""
    driven = joints[:, [0, 1, 3]]
    rod = joints[:, 2]
    np.testing.assert_allclose(driven, axes, atol=TOLERANCE)
    np.testing.assert_allclose(rod, -axes[:, 1], atol=1e-8)


def test_a_follower_is_described_by_one_closure_of_a_direction() -> None:
    """What the refusal of <mimic> proposes: the forearm keeps its direction,
    so its joint turns back as J2 turns.
    """
    keeps = LinkPair("parallelogram", "column", "forearm", ("ry",))
    motors = ("J1", "J2", "J4")
    robot = robot_from_urdf(PARALLELOGRAM, closures=(keeps,), motors=motors)
    rng = np.random.default_rng(5)
    position_rad = rng.uniform(-0.8, 0.8, (20, 3))
    velocity_rad_s = rng.uniform(-0.8, 0.8, (20, 3))
    acceleration_rad_s2 = rng.uniform(-0.8, 0.8, (20, 3))
    axes = Motion(position_rad, velocity_rad_s, acceleration_rad_s2)
    assembly = assemble(robot, 3)
    joints = follow(robot, assembly, axes).joints
    _check_follower(joints.position_rad, axes.position_rad)
    _check_follower(joints.velocity_rad_s, axes.velocity_rad_s)
    _check_follower(joints.acceleration_rad_s2, axes.acceleration_rad_s2)
