"""Joints that follow an axis (`<mimic>` of a URDF):
motion and torque against Pinocchio, and the gains of an arm.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.discovery.evidence import gather
from ident.discovery.loop import find_effects
from ident.errors import ModelError, PayloadUnseen
from ident.estimators.identify import identify
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.closed_chain import assemble, follow
from ident.model.model import DriveTrain, Model
from ident.model.robot import Motion, Robot
from ident.model.urdf import LinkPair, robot_from_urdf
from tests.ident.recordings import PAYLOAD_TRUTH, positions

FloatArray = NDArray[np.float64]
MULTIPLIER = -1.5
OFFSET_RAD = 0.2
GAINS = np.array([33.9, 32.4, -24.2])
FRICTION = ((7.0, 5.5), (4.4, 7.7), (1.6, 6.3))
RATE_HZ = 250.0


def _link(name: str, mass: float, centre: str) -> str:
    inertia = '<inertia ixx="0.06" ixy="0.002" ixz="-0.003" iyy="0.08" iyz="0.004" izz="0.05"/>'
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre}"/><mass '
        f'value="{mass}"/>{inertia}</inertial></link>'
    )


def _joint(
    name: str,
    parent: str,
    child: str,
    place: str,
    axis: str,
    more: str = "",
    kind: str = "revolute",
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{place}"/><parent '
        f'link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/><limit lower="-3" upper="3" '
        f'velocity="3" effort="99"/>{more}</joint>'
    )


#: A turntable, a shoulder, a link that a belt turns with the shoulder, and a wrist at its end
LINKS = (
    _link("table", 10.0, "0.02 -0.03 0.1"),
    _link("upper", 5.0, "0.05 0.02 0.15"),
    _link("belted", 3.0, "-0.04 0.03 0.12"),
    _link("hand", 2.0, "0.06 -0.05 0.08"),
)
TURN = _joint("turn", "base", "table", "0 0 0.2", "0 0 1")
SHOULDER = _joint("shoulder", "table", "upper", "0.05 0 0.2", "0 1 0")
WRIST = _joint("wrist", "belted", "hand", "0.1 0 0.3", "0 1 0")


def _robot_xml(name: str, *parts: str) -> str:
    """A URDF with a base and these links and joints."""
    content = "".join(parts)
    return f'<robot name="{name}"><link name="base"/>{content}</robot>'


def _arm(multiplier: float = MULTIPLIER, kind: str = "revolute") -> str:
    """The arm of `LINKS`."""
    mimic = f'<mimic joint="shoulder" multiplier="{multiplier}" offset="{OFFSET_RAD}"/>'
    rod = _joint("rod", "upper", "belted", "0 0 0.35", "0 1 0", mimic, kind)
    return _robot_xml("belted", *LINKS, TURN, SHOULDER, rod, WRIST)


def _random_motion(rng: np.random.Generator, samples: int, largest: float) -> Motion:
    """Random positions, velocities and accelerations of the axes."""
    shape = (samples, 3)
    position_rad = rng.uniform(-largest, largest, shape)
    velocity_rad_s = rng.uniform(-largest, largest, shape)
    acceleration_rad_s2 = rng.uniform(-largest, largest, shape)
    return Motion(position_rad, velocity_rad_s, acceleration_rad_s2)


def _pinocchio_torque(
    urdf: str, multiplier: float, motion: Motion, hand: FloatArray | None = None
) -> FloatArray:
    """Torques of the three axes, τ = Gᵀ rnea(q, q̇, q̈) with q of all four joints and G =
    ∂q/∂(axes), shape (k, 3).
    """
    model = pin.buildModelFromXML(urdf)
    if hand is not None:
        model.inertias[4] += pin.Inertia.FromDynamicParameters(hand)
    data = model.createData()
    to_joints = np.zeros((4, 3))
    to_joints[0, 0] = 1.0
    to_joints[1, 1] = 1.0
    to_joints[2, 1] = multiplier
    to_joints[3, 2] = 1.0
    offset = np.array([0.0, 0.0, OFFSET_RAD, 0.0])
    position_rad = np.asarray(motion.position_rad)
    position = position_rad @ to_joints.T + offset
    velocity_rad_s = np.asarray(motion.velocity_rad_s)
    velocity = velocity_rad_s @ to_joints.T
    acceleration_rad_s2 = np.asarray(motion.acceleration_rad_s2)
    acceleration = acceleration_rad_s2 @ to_joints.T
    torques = []
    for q, v, a in zip(position, velocity, acceleration, strict=True):
        of_joints = pin.rnea(model, data, q, v, a)
        torques.append(of_joints)
    return np.asarray(np.array(torques) @ to_joints)


PINOCCHIO_ORDER = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")


def _standard(model: Model, urdf: str) -> FloatArray:
    """Standard parameters of the URDF's links, without drives."""
    standard = np.zeros(len(model.columns))
    _, *inertias = pin.buildModelFromXML(urdf).inertias
    for joint, inertia in enumerate(inertias):
        values = inertia.toDynamicParameters()
        by_name = dict(zip(PINOCCHIO_ORDER, values, strict=True))
        first = 14 * joint
        end = first + len(LINK_PARAMETERS)
        standard[first:end] = [by_name[name] for name in LINK_PARAMETERS]
    return standard


def _model(robot: Robot) -> Model:
    ratio = np.diag([40.0, 50.0, -45.0])
    drive_train = DriveTrain(ratio)
    return Model(robot, drive_train)


def _arm_model() -> Model:
    """Model of the arm."""
    robot = robot_from_urdf(_arm())
    return _model(robot)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_the_torque_is_that_of_pinocchios_tree_projected_to_the_axes(kind: str) -> None:
    urdf = _arm(kind=kind)
    model = _model(robot_from_urdf(urdf))
    rng = np.random.default_rng(1)
    motion = _random_motion(rng, 40, 1.5)
    expected = _pinocchio_torque(urdf, MULTIPLIER, motion)
    standard = _standard(model, urdf)
    regressor = model.regressor(motion)
    by_columns = np.einsum("jck,c->kj", regressor, standard)
    np.testing.assert_allclose(by_columns, expected, atol=1e-9)
    load, _, _ = model.torques(motion, standard)
    np.testing.assert_allclose(load.T, expected, atol=1e-9)

    # The mass matrix: the torque of an acceleration of one axis, less that at rest.
    position_rad = np.asarray(motion.position_rad)
    mass = model.inertia(position_rad, standard)
    still = np.zeros((40, 3))
    standing = Motion(position_rad, still, still)
    at_rest = _pinocchio_torque(urdf, MULTIPLIER, standing)
    for axis in range(3):
        acceleration_rad_s2 = still.copy()
        acceleration_rad_s2[:, axis] = 1.0
        accelerated = Motion(position_rad, still, acceleration_rad_s2)
        moved = _pinocchio_torque(urdf, MULTIPLIER, accelerated)
        of_axis = mass[:, axis].T
        np.testing.assert_allclose(of_axis, moved - at_rest, atol=1e-9)


def test_a_rack_with_many_radians_to_the_metre_is_followed() -> None:
    """No step on the way to a position is too long for a joint that turns 200 rad in a metre of its
    leader.
    """
    mimic = '<mimic joint="slide" multiplier="200" offset="-8"/>'
    carriage = _link("carriage", 3.0, "0 0 0")
    pinion = _link("pinion", 0.5, "0.01 0 0")
    slide = _joint("slide", "base", "carriage", "0 0 0", "1 0 0", kind="prismatic")
    turning = _joint("pinion turns", "carriage", "pinion", "0 0 0.1", "0 0 1", mimic)
    urdf = _robot_xml("rack", carriage, pinion, slide, turning)
    robot = robot_from_urdf(urdf)
    grid = np.linspace(-0.6, 0.9, 50)
    position_m = grid[:, None]
    rate = np.ones_like(position_m)
    acceleration_rad_s2 = 3.0 * rate
    axes = Motion(position_m, rate, acceleration_rad_s2)
    found = follow(robot, assemble(robot), axes).joints
    expected_rad = 200.0 * position_m[:, 0] - 8.0
    turned_rad = found.position_rad[:, 1]
    np.testing.assert_allclose(turned_rad, expected_rad, atol=1e-9)
    rate_rad_s = found.velocity_rad_s[:, 1]
    np.testing.assert_allclose(rate_rad_s, 200.0, atol=1e-9)
    change_rad_s2 = found.acceleration_rad_s2[:, 1]
    np.testing.assert_allclose(change_rad_s2, 600.0, atol=1e-9)


def _friction_nm(velocity_rad_s: FloatArray) -> FloatArray:
    """Friction of the axes, shape (k, 3)."""
    viscous, dry = np.array(FRICTION).T
    of_speed = viscous * velocity_rad_s
    of_direction = dry * np.sign(velocity_rad_s)
    return np.asarray(of_speed + of_direction)


def _recordings() -> tuple[Run, ...]:
    """Runs of the arm without and with a payload on the hand, their currents by Pinocchio,
    friction and the gains.
    """
    urdf = _arm()
    train = _arm_model().drive_train
    disc = np.array([PAYLOAD_TRUTH[name] for name in PINOCCHIO_ORDER])
    known = {"m": PAYLOAD_TRUTH["m"]}
    payload = Payload("disc", "a", known)
    conditioning = Conditioning(position_cutoff_hz=0.3 * RATE_HZ)
    limits = np.array([2.5, 1.2, 2.0])
    rng = np.random.default_rng(7)
    runs = []
    for name, carried, body in (("bare", None, None), ("loaded", payload, disc)):
        q = positions(rng, 24.0, RATE_HZ, limits)
        time_s = np.arange(len(q)) / RATE_HZ
        run = Run(name, time_s, q, np.zeros_like(q), carried)
        motion = differentiate(run, train, conditioning).motion()
        rigid_nm = _pinocchio_torque(urdf, MULTIPLIER, motion, body)
        velocity_rad_s = np.asarray(motion.velocity_rad_s)
        torque_nm = rigid_nm + _friction_nm(velocity_rad_s)
        current = np.zeros_like(q)
        current[1:-1] = torque_nm / GAINS
        noise = 0.02 * rng.standard_normal(current.shape)
        recorded = replace(run, current_a=current + noise)
        runs.append(recorded)
    return tuple(runs)


@pytest.fixture(scope="module")
def recordings() -> tuple[Run, ...]:
    return _recordings()


def _gains(recordings: tuple[Run, ...], multiplier: float) -> FloatArray:
    robot = robot_from_urdf(_arm(multiplier))
    model = _model(robot)
    estimate = identify(model, recordings, Conditioning()).estimate
    return np.asarray(estimate.gains)


@pytest.mark.slow
def test_the_gains_of_an_arm_with_a_follower_are_found(recordings: tuple[Run, ...]) -> None:
    found = _gains(recordings, MULTIPLIER)
    np.testing.assert_allclose(found, GAINS, rtol=5e-3)


@pytest.mark.slow
def test_a_wrong_multiplier_bends_the_gains_or_is_refused(recordings: tuple[Run, ...]) -> None:
    """Without it, the gains above could be right whatever is done with the ratio."""
    gain_ratio = _gains(recordings, -1.4) / GAINS
    error = np.abs(gain_ratio - 1.0)
    assert error.min() > 0.02
    assert error.max() > 0.04
    with pytest.raises(PayloadUnseen, match="do not differ by the weight of the payload"):
        _gains(recordings, 1.0)


def test_a_follower_is_no_place_of_an_effect() -> None:
    """Its friction is friction of its axis: the two columns would be the same."""
    robot = robot_from_urdf(_arm())
    places = [joint.name for joint in robot.places]
    assert places == ["turn", "shoulder", "wrist"]
    assert robot.passive_names == ("rod",)
    assert robot.undriven_names == ()
    model = _model(robot)
    constant = np.full((4, 3), 0.1)
    motion = Motion(constant, constant, constant)
    followed = model.follow(motion)
    leverage = model.leverage(followed)
    assert leverage.shape == (0, 3, 4)
    at_places = model.at_places(followed)
    position_rad = np.asarray(at_places.position_rad)
    assert position_rad.shape == (4, 3)


@pytest.mark.slow
def test_a_spring_on_a_follower_is_found_as_one_of_its_axis(recordings: tuple[Run, ...]) -> None:
    """The search works on the motion of the axes, in which the follower has no place."""
    stiffness_nm_rad = 30.0
    sprung = []
    for run in recordings:
        position_rad = np.asarray(run.position_rad)
        angle_rad = MULTIPLIER * position_rad[:, 1] + OFFSET_RAD
        torque_nm = MULTIPLIER * stiffness_nm_rad * angle_rad
        current = np.asarray(run.current_a).copy()
        current[:, 1] += torque_nm / GAINS[1]
        with_spring = replace(run, current_a=current)
        sprung.append(with_spring)
    found = identify(_arm_model(), sprung, Conditioning())
    rng = np.random.default_rng(0)
    steps = find_effects(gather(found, sprung), rng)
    findings = steps[0].findings
    # The best of its axes
    spring = next(one for one in findings if one.effect.name == "spring")
    assert spring.axis == 1
    # Before the refit, a little of it is in the gravity of the links.
    at_axis_nm_rad = MULTIPLIER**2 * stiffness_nm_rad
    assert spring.coefficients[0] == pytest.approx(at_axis_nm_rad, rel=0.06)


def test_columns_of_a_follower_are_its_links_alone() -> None:
    model = _arm_model()
    rng = np.random.default_rng(4)
    motion = _random_motion(rng, 30, 1.0)
    columns = model.regressor(motion)
    first = 14 * 2
    end_of_link = first + len(LINK_PARAMETERS)
    of_link = np.abs(columns[1, first:end_of_link])
    assert of_link.max() > 1e-3
    of_drive = columns[:, end_of_link : first + 14]
    assert not of_drive.any()


def test_a_motor_on_a_follower_and_a_follower_in_a_closed_chain_are_refused() -> None:
    robot = robot_from_urdf(_arm(), motors=("turn", "rod", "wrist"))
    with pytest.raises(
        ModelError,
        match=r"joint 'rod' follows 'shoulder' and has a motor; expected one or the other",
    ):
        _model(robot)
    loop = LinkPair("loop", "table", "hand", ("ry",))
    with pytest.raises(
        ModelError,
        match=r"joint 'rod' has <mimic>, and the robot has closures; .* delete <mimic>",
    ):
        robot_from_urdf(_arm(), closures=(loop,), motors=("turn", "shoulder"))


@pytest.mark.parametrize(
    ("multiplier", "offset", "found"),
    [
        ("1e300", "0", "the multiplier 1e\\+300"),
        ("1e29", "0", "the multiplier 1e\\+29"),
        ("1e-300", "0", "the multiplier 1e-300"),
        ("1", "1e300", "the offset 1e\\+300"),
        ("1", "-1e29", "the offset -1e\\+29"),
    ],
)
def test_a_follower_that_no_mechanism_moves_so_is_refused(
    multiplier: str, offset: str, found: str
) -> None:
    """Torques overflowed, and the logs were blamed."""
    usual = f'multiplier="{MULTIPLIER}" offset="{OFFSET_RAD}"'
    arm = _arm()
    assert usual in arm
    urdf = arm.replace(usual, f'multiplier="{multiplier}" offset="{offset}"')
    with pytest.raises(ModelError, match=f"joint 'rod' mimics joint 'shoulder' with {found}"):
        robot_from_urdf(urdf)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("axis", ["0 0 1e200", "1e308 1e308 0"])
def test_an_axis_whose_length_overflows_is_refused_with_its_numbers(axis: str) -> None:
    urdf = _arm().replace('<axis xyz="0 0 1"/>', f'<axis xyz="{axis}"/>')
    with pytest.raises(ModelError, match=rf"<axis> of 'turn' .* xyz='{re.escape(axis)}'; expected"):
        robot_from_urdf(urdf)
