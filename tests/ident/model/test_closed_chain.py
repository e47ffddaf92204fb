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


def _turn(rng: np.random.Generator) -> FloatArray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    determinant_sign = np.sign(np.linalg.det(q))
    return np.asarray(q * determinant_sign)


def _axes_motion(mechanism: Mechanism, samples: int = 400, size: float = 1.0) -> Motion:
    """A smooth motion of the motors that the closures allow, with its exact derivatives."""
    t = np.arange(samples) * STEP_S
    phase = np.arange(3)[:, None]
    wave = 2.0 * np.pi * (0.6 + 0.35 * phase)
    phase_sine = np.sin(wave * t + phase)
    x = size * phase_sine
    phase_cosine = np.cos(wave * t + phase)
    v = size * wave * phase_cosine
    a = -size * wave**2 * np.sin(wave * t + phase)
    robot = mechanism.robot
    assembly = assemble(robot)
    home = assembly.position_rad[list(robot.axis_joints)]
    if mechanism is not PLANAR:
        reach = 0.4 if mechanism is FIVE_BAR else 0.06
        part = slice(len(home))
        return Motion(
            *(
                np.asarray(start + reach * one[part].T)
                for start, one in ((home, x), (0.0, v), (0.0, a))
            )
        )
    pose, rate, change = (
        np.asarray((np.array([[0.05], [0.05], [0.3]]) * part).T) for part in (x, v, a)
    )
    h = 1e-4
    steps = [pose + k * h * rate + 0.5 * (k * h) ** 2 * change for k in (-2, -1, 0, 1, 2)]
    at = []
    for one in steps:
        at.append(np.stack([leg_angles(one, leg)[0] for leg in range(4)], axis=1))
    home_difference = home - at[2][0]
    turns = 2.0 * np.pi * np.round(home_difference / (2.0 * np.pi))
    velocity = (at[0] - 8.0 * at[1] + 8.0 * at[3] - at[4]) / (12.0 * h)
    acceleration = (-at[0] + 16.0 * at[1] - 30.0 * at[2] + 16.0 * at[3] - at[4]) / (12.0 * h**2)
    position_rad = at[2] + turns
    return Motion(position_rad, velocity, acceleration)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    directions=st.lists(st.sampled_from(DIRECTIONS), min_size=1, max_size=6, unique=True),
)
def test_derivatives_of_any_closure(seed: int, directions: list[str]) -> None:
    rng = np.random.default_rng(seed)
    tree = robot_from_urdf(SEVEN_AXES.urdf)
    joints = tuple(replace(joint, parent=index // 2 - 1) for index, joint in enumerate(tree.joints))
    ends = [Place(joint, _turn(rng), rng.uniform(-0.3, 0.3, 3)) for joint in (6, 5)]
    closure = Closure("any", ends[0], ends[1], tuple(directions))
    closures = (closure,)
    robot = Robot(joints, tree.gravity_m_s2, closures, (0,))
    q, v = rng.uniform(-1, 1, (2, 1, 7))
    h = 1e-6
    here = loops(robot, q, velocity=v)
    ahead, behind = (loops(robot, q + sign * h * v) for sign in (1, -1))
    residual_difference = ahead.residual - behind.residual
    assert here.jacobian[0] @ v[0] == pytest.approx(residual_difference[0] / (2 * h), abs=1e-7)
    jacobian_difference = ahead.jacobian - behind.jacobian
    assert here.bias[0] == pytest.approx(jacobian_difference[0] @ v[0] / (2 * h), abs=1e-6)


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_joints_follow_with_their_derivatives(mechanism: Mechanism) -> None:
    robot = mechanism.robot
    motion = _axes_motion(mechanism)
    assembly = assemble(robot, mechanism.mobility)
    found = follow(robot, assembly, motion)
    q = found.joints.position_rad
    v = found.joints.velocity_rad_s
    a = found.joints.acceleration_rad_s2
    absolute_residual = np.abs(loops(robot, q).residual)
    assert np.max(absolute_residual) < 1e-11
    motors = list(robot.axis_joints)
    difference = q[:, motors] - motion.position_rad
    largest_absolute_difference = np.max(np.abs(difference))
    assert largest_absolute_difference < 1e-11
    closing = loops(robot, q, velocity=v)
    jacobian = closing.jacobian
    bias = closing.bias
    assert np.max(np.abs(np.einsum("kcn,kn->kc", jacobian, v))) < 1e-10
    absolute_bias = np.abs(np.einsum("kcn,kn->kc", jacobian, a) + bias)
    assert np.max(absolute_bias) < 1e-9
    differences = (q[2:] - q[:-2]) / (2 * STEP_S)
    difference_difference = np.abs(differences - v[1:-1])
    assert np.max(difference_difference) < 2e-5 * np.max(np.abs(a)) + 1e-4
    assert np.max(np.abs(np.einsum("kcn,knd->kcd", jacobian, found.to_joints))) < 1e-12
    assert found.to_motors == pytest.approx(found.to_joints[:, motors])


def test_a_pose_does_not_depend_on_what_was_asked_before() -> None:
    motion = _axes_motion(FIVE_BAR, 300)
    robot = FIVE_BAR.robot
    assembly = assemble(robot)
    whole = follow(robot, assembly, motion).joints.position_rad
    part = Motion(
        *(
            array[77:201]
            for array in (motion.position_rad, motion.velocity_rad_s, motion.acceleration_rad_s2)
        )
    )
    position_rad = follow(robot, assembly, part).joints.position_rad
    position_difference_rad = position_rad - whole[77:201]
    assert np.max(np.abs(position_difference_rad)) < 1e-11


def test_a_model_keeps_a_motion_as_long_as_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    model = FIVE_BAR.model
    motion = _axes_motion(FIVE_BAR, 50)
    first = model.follow(motion)
    assert model.follow(replace(motion)) is first
    velocity_rad_s = 2.0 * motion.velocity_rad_s
    faster = Motion(motion.position_rad, velocity_rad_s, motion.acceleration_rad_s2)
    assert model.follow(faster).joints.velocity_rad_s == pytest.approx(
        2.0 * first.joints.velocity_rad_s
    )
    assert model.follow(motion) is first
    with pytest.raises(ValueError, match="read-only"):
        first.to_joints[0] = 0.0
    motion.position_rad[7] += 1e-9  # what was followed is not what the array holds now
    moved = model.follow(motion).joints.position_rad
    assert moved == pytest.approx(first.joints.position_rad, abs=1e-8)
    assert not np.array_equal(moved[7], first.joints.position_rad[7])
    monkeypatch.setattr("ident.model.model.REMEMBERED_BYTES", 1000)
    assert model.follow(faster) is not model.follow(faster)


def test_five_bar_against_the_circles_that_its_rods_describe() -> None:
    assembly = assemble(FIVE_BAR.robot)
    joints = follow(FIVE_BAR.robot, assembly, _axes_motion(FIVE_BAR)).joints
    found = joints.position_rad
    index = {joint.name: number for number, joint in enumerate(FIVE_BAR.robot.joints)}
    left = found[:, index["left-crank"]]
    right = found[:, index["right-crank"]]
    ends = [
        np.stack([side * 0.5 * BASE_M + CRANK_M * np.cos(q), CRANK_M * np.sin(q)], axis=1)
        for side, q in ((-1, left), (1, right))
    ]
    middle = 0.5 * (ends[0] + ends[1])
    apart = ends[1] - ends[0]
    apart_norm = np.linalg.norm(apart, axis=1)
    half = 0.5 * apart_norm
    across = np.stack([-apart[:, 1], apart[:, 0]], axis=1) / (2.0 * half)[:, None]
    tip = middle + np.sqrt(ROD_M**2 - half**2)[:, None] * across
    angle = found[:, index["left-rod"]] + left
    stacked_angle_cosine = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert ends[0] + ROD_M * stacked_angle_cosine == pytest.approx(tip, abs=1e-12)


def test_three_legs_carry_a_platform_that_only_translates() -> None:
    robot = THREE_LEGS.robot
    motion = _axes_motion(THREE_LEGS)
    joints = follow(robot, assemble(robot), motion).joints
    position_rad = joints.position_rad
    placed = poses(robot, position_rad)
    matching_number = next(
        number for number, joint in enumerate(robot.joints) if joint.name == "hand-0"
    )
    hand = matching_number + 1
    assert placed.rotation[hand] == pytest.approx(
        np.broadcast_to(placed.rotation[hand, 0], (400, 3, 3)), abs=1e-11
    )
    # Each rod keeps its length: from its slide to the platform.
    for leg in range(3):
        at = motion.position_rad[:, leg, None] * np.eye(3)[leg] - SLIDE_M * np.eye(3)[leg]
        origin_difference_m = placed.origin_m[hand] - at
        origin_difference_norm_m = np.linalg.norm(origin_difference_m, axis=1)
        assert origin_difference_norm_m == pytest.approx(SLIDE_M, abs=1e-11)


def _torque_of_tree(mechanism: Mechanism, joints: Motion) -> FloatArray:
    """Pinocchio's inverse dynamics of the tree without closures, shape (k, n)."""
    model = pin.buildModelFromXML(mechanism.urdf)
    model.gravity.linear = np.array(mechanism.gravity_m_s2)
    data = model.createData()
    states = zip(
        joints.position_rad, joints.velocity_rad_s, joints.acceleration_rad_s2, strict=True
    )
    return np.stack([pin.rnea(model, data, q, v, a) for q, v, a in states])


def _standard(mechanism: Mechanism, model: Model) -> FloatArray:
    """The URDF's inertias as standard parameters, without friction."""
    standard = np.zeros(len(model.columns))
    bodies = read_urdf(mechanism.urdf).bodies
    for columns, body in zip(model.link_columns, bodies, strict=True):
        standard[columns] = body.parameters
    return standard


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_virtual_power_of_the_motors_is_that_of_all_joints(mechanism: Mechanism) -> None:
    model = mechanism.model
    motion = _axes_motion(mechanism, 60)
    torque = np.einsum("mck,c->mk", model.regressor(motion), _standard(mechanism, model))
    followed = model.follow(motion)
    tree = _torque_of_tree(mechanism, followed.joints)
    motors = np.einsum("kmd,mk->kd", followed.to_motors, torque)
    joints = np.einsum("knd,kn->kd", followed.to_joints, tree)
    motor_difference = np.abs(motors - joints)
    largest_motor_difference = np.max(motor_difference)
    largest_absolute_joint = np.max(np.abs(joints))
    assert largest_motor_difference < 1e-9 * largest_absolute_joint


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_constrained_forward_dynamics_returns_the_acceleration(mechanism: Mechanism) -> None:
    """The torques of the regressor, put into Pinocchio's forward dynamics with constraints of its
    own.
    """
    model = mechanism.model
    motion = _axes_motion(mechanism, 40)
    torque = np.einsum("mck,c->km", model.regressor(motion), _standard(mechanism, model))
    joints = model.follow(motion).joints
    tree = pin.buildModelFromXML(mechanism.urdf)
    tree.gravity.linear = np.array(mechanism.gravity_m_s2)
    data = tree.createData()
    constraints = pin.StdVec_RigidConstraintModel()
    datas = pin.StdVec_RigidConstraintData()
    for closure in mechanism.closures:
        # In a plane, the third translation holds by itself.
        if len(closure.directions) == 6:
            kind = pin.ContactType.CONTACT_6D
        else:
            kind = pin.ContactType.CONTACT_3D
        ends = [
            tree.frames[tree.getFrameId(link, pin.FrameType.BODY)]
            for link in (closure.first, closure.second)
        ]
        places: list[Any] = []
        for end in ends:
            places.extend((end.parentJoint, end.placement))
        rigid_constraint_model = pin.RigidConstraintModel(
            kind, tree, *places, pin.ReferenceFrame.LOCAL
        )
        constraints.append(rigid_constraint_model)
    for constraint in constraints:
        datas.append(constraint.createData())
    pin.initConstraintDynamics(tree, data, constraints, datas)
    settings = pin.ProximalSettings(1e-13, 1e-10, 200)
    names = [joint.name for joint in model.robot.axes]
    for k in range(40):
        q = joints.position_rad[k]
        v = joints.velocity_rad_s[k]
        applied = np.zeros(tree.nv)
        for name, one in zip(names, torque[k], strict=True):
            applied[tree.joints[tree.getJointId(name)].idx_v] = one
        found = pin.constraintDynamics(tree, data, q, v, applied, constraints, datas, settings)
        expected = joints.acceleration_rad_s2[k]
        difference = np.abs(found - expected)
        largest_difference = np.max(difference)
        largest_absolute_expected = np.max(np.abs(expected))
        assert largest_difference < TOLERANCE * largest_absolute_expected


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_short_cuts_agree_with_the_regressor(mechanism: Mechanism) -> None:
    model = mechanism.model
    motion = _axes_motion(mechanism, 30)
    standard = _standard(mechanism, model)
    load, _, whole = model.torques(motion, standard)
    torque = np.einsum("mck,c->mk", model.regressor(motion), standard)
    assert load == pytest.approx(torque, rel=1e-9, abs=1e-9)
    assert whole == pytest.approx(torque, rel=1e-9, abs=1e-9)
    # Of a redundant drive not all motors at will, which would tear the platform apart, but as its
    # coordinates move.
    to_motors = model.follow(motion).to_motors
    per_x = to_motors.sum(axis=2)
    acceleration_rad_s2 = motion.acceleration_rad_s2 + per_x
    faster = Motion(motion.position_rad, motion.velocity_rad_s, acceleration_rad_s2)
    change = np.einsum("mck,c->mk", model.regressor(faster), standard) - torque
    found = np.einsum("mjk,kj->mk", model.inertia(motion.position_rad, standard), per_x)
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
    low = float(np.arccos((2.0 * ROD_M - BASE_M) / (2.0 * CRANK_M)))
    high = np.pi - low
    stretched = {"left-crank": high, "left-rod": -high, "right-crank": low, "right-rod": high}
    with pytest.raises(ModelError, match="the robot is singular at the assembly pose"):
        assemble(_wrong(FIVE_BAR, assembly_rad=stretched))
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
    with pytest.raises(ModelError, match=r"left-crank at 3.6e\+09°; expected -360° to 360°"):
        assemble(
            _wrong(FIVE_BAR, assembly_rad={"left-crank": np.radians(3.6e9), "right-crank": 0.0})
        )
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
        match=r"motors do not fit each other at .*: .* away from where "
        r"the others hold it",
    ):
        follow(robot, assembly, axes)
    # What an encoder or a bent arm makes is no wrong zero.
    rng = np.random.default_rng(0)
    shaken = motion.position_rad + rng.normal(0.0, 1e-3, turned.shape)
    changed_motion = replace(motion, position_rad=shaken)
    to_motors = follow(robot, assembly, changed_motion).to_motors
    assert to_motors.shape == (
        30,
        4,
        3,
    )


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_the_assembly_pose_has_the_condition_of_a_motion_there(mechanism: Mechanism) -> None:
    robot = mechanism.robot
    assembly = assemble(mechanism.robot)
    home = assembly.position_rad[None, list(robot.axis_joints)]
    velocity_rad_s = 0.0 * home
    acceleration_rad_s2 = 0.0 * home
    axes = Motion(home, velocity_rad_s, acceleration_rad_s2)
    found = follow(robot, assembly, axes)
    assert found.condition == pytest.approx(assembly.condition)
    assert reach(robot, assembly, home).condition == pytest.approx(assembly.condition)


def test_a_redundant_drive_train_is_diagonal() -> None:
    ratio = 5.0 * np.eye(4)[[1, 0, 2, 3]]
    with pytest.raises(ModelError, match="expected a diagonal drive train"):
        Model(PLANAR.robot, DriveTrain(ratio))


def test_a_position_out_of_reach_is_named() -> None:
    motion = Motion(*(np.array([[3.1, 0.0]]) for _ in range(3)))
    assembly = assemble(FIVE_BAR.robot)
    with pytest.raises(
        ModelError,
        match=r"the loops cannot be closed at left-crank .*, "
        r"right-crank ",
    ):
        follow(FIVE_BAR.robot, assembly, motion)


def test_a_motion_through_a_singularity_is_refused_with_the_pose() -> None:
    low = float(np.arccos((2.0 * ROD_M - BASE_M) / (2.0 * CRANK_M))) + 1e-7
    position_rad = assemble(FIVE_BAR.robot).position_rad
    home = position_rad[list(FIVE_BAR.robot.axis_joints)]
    grid = np.linspace(0.0, 1.0, 200)
    way = grid[:, None]
    difference = np.array([np.pi - low, low]) - home
    motion = home + way * difference
    velocity_rad_s = 0.0 * motion
    acceleration_rad_s2 = 0.0 * motion
    axes = Motion(motion, velocity_rad_s, acceleration_rad_s2)
    assembly = assemble(FIVE_BAR.robot)
    with pytest.raises(
        ModelError,
        match=r"close to a singularity at left-crank 2.73, "
        r"right-crank 0.41",
    ):
        follow(FIVE_BAR.robot, assembly, axes)


def test_the_planar_platform_is_where_its_legs_hold_it() -> None:
    pose = np.array([[0.03, -0.02, 0.2]])
    motors = np.stack([leg_angles(pose, leg)[0] for leg in range(4)], axis=1)
    position_rad = assemble(PLANAR.robot).position_rad
    home = position_rad[list(PLANAR.robot.axis_joints)]
    motors += 2.0 * np.pi * np.round((home - motors) / (2.0 * np.pi))
    velocity_rad_s = 0 * motors
    acceleration_rad_s2 = 0 * motors
    axes = Motion(motors, velocity_rad_s, acceleration_rad_s2)
    assembly = assemble(PLANAR.robot)
    found = follow(PLANAR.robot, assembly, axes).joints.position_rad
    turned = {joint.name: value for joint, value in zip(PLANAR.robot.joints, found[0], strict=True)}
    assert turned["motor-0"] + turned["elbow-0"] + turned["platform"] == pytest.approx(0.2)


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
    assert np.max(np.abs(position_difference_rad)) < 1e-8


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


def test_a_follower_is_described_by_one_closure_of_a_direction() -> None:
    """What the refusal of <mimic> proposes: the forearm keeps its direction,
    so its joint turns back as J2 turns.
    """
    keeps = LinkPair("parallelogram", "column", "forearm", ("ry",))
    motors = ("J1", "J2", "J4")
    robot = robot_from_urdf(PARALLELOGRAM, closures=(keeps,), motors=motors)
    rng = np.random.default_rng(5)
    axes = Motion(*(rng.uniform(-0.8, 0.8, (20, 3)) for _ in range(3)))
    assembly = assemble(robot, 3)
    joints = follow(robot, assembly, axes).joints
    for found, wanted in (
        (joints.position_rad, axes.position_rad),
        (joints.velocity_rad_s, axes.velocity_rad_s),
        (joints.acceleration_rad_s2, axes.acceleration_rad_s2),
    ):
        np.testing.assert_allclose(found[:, [0, 1, 3]], wanted, atol=TOLERANCE)
        expected = -wanted[:, 1]
        np.testing.assert_allclose(found[:, 2], expected, atol=1e-8)
