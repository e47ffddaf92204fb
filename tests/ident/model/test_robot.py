"""Requirements on a URDF for its joints to be a robot's,
and that it is read as Pinocchio reads it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.errors import ModelError
from ident.model.robot import (
    JointCoupling,
    JointKind,
    Pivot,
    Robot,
    require_described,
)
from ident.model.urdf import UrdfRobot, hold_joints, read_urdf, robot_from_urdf
from tests.ident.arms import CONFIGS, GANTRY, SEVEN_AXES, THREE_AXES
from tests.ident.mechanisms import FIVE_BAR

FloatArray = NDArray[np.float64]

ROBOT_FILES = CONFIGS.glob("robots/*.urdf")
SIMULATED_FILES = CONFIGS.glob("simulation/*.urdf")
SHIPPED = sorted((*ROBOT_FILES, *SIMULATED_FILES))
LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
BODY = '<mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
TWO_LINKS = (
    '<robot name="r"><link name="a"/><link '
    f'name="b"><inertial>{BODY}</inertial></link><joint name="j" '
    'type="revolute"><origin xyz="0 0 1"/><parent link="a"/><child link="b"/><axis '
    f'xyz="0 0 1"/>{LIMIT}</joint></robot>'
)


def _assert_read_as_pinocchio_reads(urdf: str) -> None:
    model = pin.buildModelFromXML(urdf)
    _assert_same(read_urdf(urdf), model)


def _assert_same(found: UrdfRobot, model: pin.Model) -> None:
    _, *names = model.names
    assert _names_of(found) == names
    assert len(found.bodies) == len(names)
    assert found.effort_limit.tolist() == list(model.upperEffortLimit)
    for index, joint in enumerate(found.joints):
        number = index + 1
        placement = model.jointPlacements[number]
        assert joint.parent == model.parents[number] - 1
        assert _far(joint.rotation, placement.rotation) < 1e-14
        assert _far(joint.translation_m, placement.translation) < 1e-14
        assert _far(joint.axis, _axis_of(model, number, joint.kind)) < 1e-14
    for index, body in enumerate(found.bodies):
        inertia = model.inertias[index + 1]
        assert body.mass_kg == pytest.approx(inertia.mass, rel=1e-14)
        if body.mass_kg > 0.0:
            assert _far(body.centre_m, inertia.lever) < 1e-14
        largest = float(np.abs(inertia.inertia).max())
        tolerance = 1e-14 * max(1.0, largest)
        assert _far(body.inertia_kg_m2, inertia.inertia) < tolerance


def _names_of(robot: UrdfRobot) -> list[str]:
    """Names of the joints that move."""
    return [joint.name for joint in robot.joints]


def _axis_of(model: pin.Model, number: int, kind: JointKind) -> FloatArray:
    """The axis of a joint of Pinocchio: the first half of its screw is a velocity."""
    screw = _screw(model, number)
    if kind is JointKind.PRISMATIC:
        return screw[:3]
    return screw[3:]


def _screw(model: pin.Model, number: int) -> FloatArray:
    joint = model.joints[number]
    motion = joint.createData()
    neutral = pin.neutral(model)
    end = joint.idx_q + joint.nq
    joint.calc(motion, neutral[joint.idx_q : end])
    return np.asarray(motion.S, dtype=np.float64).reshape(6)


def _far(found: FloatArray, expected: FloatArray) -> float:
    difference = found - np.asarray(expected)
    return float(np.abs(difference).max())


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_the_shipped_robots_are_read_as_pinocchio_reads_them(path: Path) -> None:
    assert len(SHIPPED) >= 6
    _assert_read_as_pinocchio_reads(path.read_text())


@pytest.mark.parametrize("name", ["tx40/tx40_mdh_modified.urdf", "kr300/kr300.urdf"])
def test_robots_of_others_are_read_as_pinocchio_reads_them(name: str, shared_data: Path) -> None:
    urdf = (shared_data / name).read_text()
    _assert_read_as_pinocchio_reads(urdf)


@pytest.mark.slow
@settings(deadline=None, max_examples=150, derandomize=True)
@given(seed=st.integers(0, 1_000_000), count=st.integers(2, 14))
def test_any_tree_is_read_as_pinocchio_reads_it(seed: int, count: int) -> None:
    _assert_read_as_pinocchio_reads(_any_tree(seed, count))


@settings(deadline=None, max_examples=60, derandomize=True)
@given(seed=st.integers(0, 1_000_000), count=st.integers(3, 10))
def test_held_joints_are_those_that_pinocchio_locks(seed: int, count: int) -> None:
    """Any joints but one, at any position;
    the bodies behind them are carried by the joint before them.
    """
    urdf = _any_tree(seed, count)
    model = pin.buildModelFromXML(urdf)
    rng = np.random.default_rng(seed)
    angles = [0.0, np.pi / 2, -0.7, 2.5]
    position = rng.choice(angles, model.nv)
    numbers = np.arange(1, model.njoints)
    shuffled = rng.permutation(numbers)
    count_held = rng.integers(0, model.nv)
    held = shuffled[:count_held].tolist()
    configuration = pin.integrate(model, pin.neutral(model), position)
    locked = pin.buildReducedModel(model, held, configuration)
    position_rad = {}
    for number in held:
        place = model.joints[number].idx_v
        position_rad[model.names[number]] = position[place]
    found = hold_joints(urdf, position_rad)
    _assert_same(read_urdf(found), locked)


def _with_gripper(finger: str, thumb: str) -> str:
    """The two links with a gripper on the second;
    the arguments are type and content of its joints.
    """
    gripper = (
        f'<link name="f"><inertial>{BODY}</inertial></link><link '
        f'name="t"><inertial>{BODY}</inertial></link><joint name="finger" {finger}<parent '
        f'link="b"/><child link="f"/></joint><joint name="thumb" {thumb}<parent link="b"/><child '
        'link="t"/></joint>'
    )
    return _with_more(TWO_LINKS, gripper)


def _with_more(urdf: str, elements: str) -> str:
    """A URDF with further elements at its end."""
    return urdf.replace("</robot>", f"{elements}</robot>")


TURNING = 'type="revolute"><origin xyz="0.1 0 0"/><axis xyz="0 0 2"/>' + LIMIT
SLIDING = 'type="prismatic"><origin xyz="0.1 0 0"/><axis xyz="0 0 2"/>' + LIMIT
FOLLOWING = '<mimic joint="finger" multiplier="-2" offset="0.1"/>'


@settings(deadline=None, max_examples=25, derandomize=True)
@given(angle=st.floats(-7.0, 7.0))
def test_a_held_gripper_is_the_one_whose_joints_are_fixed_by_hand(angle: float) -> None:
    sliding_thumb = SLIDING + FOLLOWING
    urdf = _with_gripper(TURNING, sliding_thumb)
    held = hold_joints(urdf, {"finger": angle})
    slid_m = 0.1 - 2.0 * angle
    thumb = f'type="fixed"><origin xyz="0.1 0 {slid_m}"/>'
    finger = f'type="fixed"><origin xyz="0.1 0 0" rpy="0 0 {angle}"/>'
    by_hand = _with_gripper(finger, thumb)
    _assert_same_robot(held, by_hand)
    free_thumb = _with_gripper(TURNING, SLIDING)
    both_held = hold_joints(free_thumb, {"finger": angle, "thumb": slid_m})
    _assert_same_robot(held, both_held)


def _assert_same_robot(urdf: str, other: str) -> None:
    (found,) = read_urdf(urdf).bodies
    (expected,) = read_urdf(other).bodies
    assert found.mass_kg == 6.0
    assert expected.mass_kg == 6.0
    assert _far(found.centre_m, expected.centre_m) < 1e-13
    assert _far(found.inertia_kg_m2, expected.inertia_kg_m2) < 1e-11


@pytest.mark.parametrize(
    ("urdf", "held", "message"),
    [
        (
            _with_gripper(TURNING, SLIDING),
            {"wrist": 0.0},
            "no movable joint 'wrist'.*one of j, finger, thumb",
        ),
        (
            _with_gripper(TURNING, 'type="fixed">'),
            {"thumb": 0.0},
            "no movable joint 'thumb'.*one of j, finger",
        ),
        (
            _with_gripper('type="floating">', SLIDING),
            {"finger": 0.1},
            "'finger' is of type 'floating' and held at 0.1",
        ),
        (
            _with_gripper(TURNING, SLIDING + FOLLOWING.replace("-2", "x")),
            {"finger": 0.1},
            "'thumb'.*no number",
        ),
    ],
)
def test_what_cannot_be_held_is_refused(urdf: str, held: dict[str, float], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        hold_joints(urdf, held)


FOLLOWING_THUMB = _with_gripper(TURNING, TURNING + '<mimic joint="finger" multiplier="2"/>')
TIP = (
    '<link name="u"/><joint name="tip" type="revolute"><parent link="t"/><child link="u"/><axis '
    f'xyz="0 0 1"/>{LIMIT}<mimic joint="thumb" multiplier="-3" offset="0.5"/></joint>'
)
CHAINED = _with_more(FOLLOWING_THUMB, TIP)
"""A finger, a thumb that follows it, and a tip that follows the thumb."""


def test_a_follower_of_a_follower_is_where_the_chain_puts_it() -> None:
    held = hold_joints(CHAINED, {"finger": 0.1})
    position_rad = {"finger": 0.1, "thumb": 0.2, "tip": -0.1}
    by_hand = hold_joints(CHAINED, position_rad)
    assert _names_of(read_urdf(held)) == ["j"]
    _assert_same_robot(held, by_hand)


@pytest.mark.parametrize(
    ("mimic", "held", "message"),
    [
        (
            '<mimic joint="j" multiplier="-1"/>',
            {"finger": 0.0},
            "joint 'finger' mimics joint 'j' .* which moves",
        ),
        (
            '<mimic joint="thumb"/>',
            {"finger": 0.0},
            "'finger' mimics joint 'thumb' .multiplier 1., which moves",
        ),
        (
            '<mimic joint="thumb"/>',
            {"finger": 0.2, "thumb": 0.1},
            "held at 0.2 and mimics joint 'thumb', by which",
        ),
        (
            '<mimic joint="j" multiplier="0" offset="0.3"/>',
            {"finger": 0.0},
            "held at 0 .*by which it is at 0.3",
        ),
    ],
)
def test_a_follower_is_held_only_where_it_is(
    mimic: str, held: dict[str, float], message: str
) -> None:
    finger = TURNING + mimic
    with pytest.raises(ModelError, match=message):
        hold_joints(_with_gripper(finger, TURNING), held)


def test_a_follower_is_held_where_its_leader_puts_it() -> None:
    urdf = _with_gripper(TURNING + '<mimic joint="thumb"/>', TURNING)
    same = hold_joints(urdf, {"finger": 0.1, "thumb": 0.1})
    assert _names_of(read_urdf(same)) == ["j"]
    position_rad = {"finger": 0.3, "thumb": 0.0}
    finger = TURNING + '<mimic joint="j" multiplier="0" offset="0.3"/>'
    still = hold_joints(_with_gripper(finger, TURNING), position_rad)
    assert len(read_urdf(still).joints) == 1
    # Nothing of this URDF moves a follower of a joint that it does not have.
    turning_finger = TURNING + '<mimic joint="elsewhere"/>'
    of_another = hold_joints(_with_gripper(turning_finger, TURNING), position_rad)
    assert len(read_urdf(of_another).joints) == 1


@pytest.mark.parametrize(
    ("mimic", "message"),
    [
        (
            '<mimic joint="elsewhere"/>',
            "'finger' mimics 'elsewhere', which is no joint .* that moves; expected one of j",
        ),
        (
            '<mimic joint="finger"/>',
            "'finger' mimics 'finger', which follows it in turn; expected a joint at the head",
        ),
    ],
    ids=["of nothing", "of itself"],
)
def test_a_joint_that_follows_no_joint_is_refused(mimic: str, message: str) -> None:
    finger = TURNING + mimic
    with pytest.raises(ModelError, match=message):
        robot_from_urdf(_with_gripper(finger, TURNING))


def test_a_follower_of_a_follower_follows_the_first_joint() -> None:
    robot = robot_from_urdf(CHAINED)
    names = [joint.name for joint in robot.joints]
    assert [joint.name for joint in robot.axes] == ["j", "finger"]
    couplings = {names[one.follower]: one for one in robot.couplings}
    assert couplings.keys() == {"thumb", "tip"}
    thumb = couplings["thumb"]
    assert names[thumb.leader] == "finger"
    assert thumb.multiplier == 2.0
    assert round(thumb.offset, 12) == 0.0
    tip = couplings["tip"]
    assert names[tip.leader] == "finger"
    assert tip.multiplier == -6.0
    assert round(tip.offset, 12) == 0.5


def test_a_floating_base_is_held_where_it_is() -> None:
    base = _with_gripper('type="floating"><origin xyz="1 2 3"/>', 'type="planar">')
    position_rad = {"finger": 0.0, "thumb": 0.0}
    held = hold_joints(base, position_rad)
    fixed = _with_gripper('type="fixed"><origin xyz="1 2 3"/>', 'type="fixed">')
    _assert_same_robot(held, fixed)


def _any_tree(seed: int, count: int) -> str:
    """Random trees: branches, fixed joints, all kinds of joint, bodies anywhere or nowhere,
    names in any order.
    """
    rng = np.random.default_rng(seed)
    letters = rng.choice(list("zyABé_"), count)
    kinds = rng.choice(["revolute", "continuous", "prismatic", "fixed"], count)
    kinds[0] = "revolute"
    elements = [f'<link name="base">{_inertial(rng)}</link>']
    for number in range(count):
        name = f"{letters[number]}{number}"
        elements += _any_joint(rng, number, name, kinds[number])
    rng.shuffle(elements)
    tree = "".join(elements)
    return f'<?xml version="1.0"?><!-- a tree --><robot name="r">{tree}</robot>'


AXIS_COMPONENTS = np.array([-1.0, 0.3, 1.0, 2.0])
TURNS_RAD = np.array([0.0, np.pi / 2, np.pi, -1.2, 0.3])


def _any_joint(rng: np.random.Generator, number: int, name: str, kind: str) -> list[str]:
    """A joint behind one of the three links before it, or on the base; and its link."""
    parent = "base"
    if number > 0 and rng.random() >= 0.1:
        first = max(0, number - 3)
        parent = f"l{rng.integers(first, number)}"
    axis = ""
    if rng.random() >= 0.2:
        components = rng.choice(AXIS_COMPONENTS, 3)
        axis = f'<axis xyz="{_three(components)}"/>'
    limit = f'<limit velocity="1" effort="{number}"/>'
    may_be_unlimited = kind in ("continuous", "fixed")
    if may_be_unlimited and rng.random() < 0.5:
        limit = ""
    origin = _origin(rng)
    ends = f'<parent link="{parent}"/><child link="l{number}"/>'
    joint = f'<joint name="{name}" type="{kind}">{origin}{ends}{axis}{limit}</joint>'
    link = f'<link name="l{number}"><visual/>{_inertial(rng)}</link>'
    return [joint, link]


def _three(numbers: FloatArray) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _origin(rng: np.random.Generator) -> str:
    xyz = ""
    if rng.random() < 0.8:
        place_m = rng.uniform(-2, 2, 3)
        xyz = f'xyz="{_three(place_m)}"'
    turned = rng.choice(TURNS_RAD, 3)
    rpy = ""
    if rng.random() < 0.8:
        rpy = f'rpy="{_three(turned)}"'
    if rng.random() < 0.9:
        return f"<origin {xyz} {rpy}/>"
    return ""


def _inertial(rng: np.random.Generator) -> str:
    if rng.random() < 0.2:
        return ""
    components = rng.uniform(0.0, 1.0, 6)
    mass = rng.choice([0.0, 0.7, 12.5])
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    attributes = [f'{name}="{value}"' for name, value in zip(names, components, strict=True)]
    origin = _origin(rng)
    inertia = ""
    if rng.random() < 0.9:
        inertia = f"<inertia {' '.join(attributes)}/>"
    return f'<inertial>{origin}<mass value="{mass}"/>{inertia}</inertial>'


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>'), "direction of length one"),
        (('xyz="0 0.01 0.2"', 'xyz="0 10 200"'), "in mm"),
        (('xyz="0 0.01 0.2"', 'xyz="0 1e200 0.2"'), "expected at most"),
    ],
)
def test_no_geometry_that_cannot_be(wrong: tuple[str, str], message: str) -> None:
    urdf = SEVEN_AXES.urdf.replace(*wrong, 1)
    with pytest.raises(ModelError, match=message):
        robot_from_urdf(urdf)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (('name="j"', ""), "has no name"),
        (('<child link="b"/>', ""), "'j' in the URDF has no <child>"),
        (
            ('<child link="b"/>', '<child link="c"/>'),
            "connects link 'c', which the URDF does not have",
        ),
        (
            ('<parent link="a"/>', '<parent link="c"/>'),
            "connects link 'c', which the URDF does not have",
        ),
        (
            ('<parent link="a"/>', '<parent link="b"/>'),
            "no moving joint",
        ),
        (
            ('<link name="a"/>', '<link name="a"/><link name="c"/>'),
            r"2 links without a parent \(a, c\)",
        ),
        (
            ('<link name="a"/>', '<link name="a"/><link name="a"/>'),
            "two links of the URDF have the same name",
        ),
        (('type="revolute"', 'type="floating"'), "type 'floating'; expected revolute"),
        (('type="revolute"', ""), "type None; expected revolute"),
        (('type="revolute"', 'type="fixed"'), "no moving joint"),
        ((LIMIT, ""), "has no <limit>; expected one with effort and velocity"),
        (('effort="1"', ""), "effort=''; expected a number"),
        (('xyz="0 0 1"/><parent', 'xyz="0 0"/><parent'), "expected three numbers"),
        (('xyz="0 0 1"/><parent', 'xyz="0 0 nan"/><parent'), "expected three numbers"),
        (('xyz="0 0 1"/><parent', 'xyz="0 0 1_0"/><parent'), "expected three numbers"),
        (('xyz="0 0 1"/><parent', 'quat_xyzw="0 0 0 1"/><parent'), "expected rpy"),
        (('<robot name="r">', '<robot name="r" version="2.0">'), "version 2.0; expected 1.0"),
        (("</robot>", ""), "cannot be read.*expected XML"),
        (("robot", "myrobot"), "cannot be read"),
        (('<link name="a"/>', '<xacro:arm name="a"/>'), "unbound prefix.*expected xmlns:PREFIX"),
        (("<link", "<body"), "connects link 'a', which the URDF does not have"),
    ],
)
def test_what_is_no_urdf_of_an_arm_is_refused(wrong: tuple[str, str], message: str) -> None:
    urdf = TWO_LINKS.replace(*wrong, 1)
    with pytest.raises(ModelError, match=message):
        read_urdf(urdf)


@pytest.mark.parametrize("space", ["http://www.ros.org/wiki/xacro", "http://ros.org/wiki/xacro"])
def test_xacro_that_is_not_expanded_is_named(space: str) -> None:
    """An expanded file may still declare the namespace."""
    declared = TWO_LINKS.replace('name="r"', f'name="r" xmlns:xacro="{space}"', 1)
    assert _names_of(read_urdf(declared)) == ["j"]
    macro = declared.replace("</robot>", '<xacro:arm prefix=""/></robot>')
    with pytest.raises(
        ModelError,
        match=r"xacro that is not expanded \(it has <xacro:arm>\); "
        r".*`xacro robot",
    ):
        read_urdf(macro)
    expression = declared.replace('name="j"', 'name="${prefix}j"', 1)
    with pytest.raises(
        ModelError,
        match=r"xacro that is not expanded \(it has \$\{\.\.\.\} in "
        r"<joint>\)",
    ):
        read_urdf(expression)


BACK = '<joint name="back" type="fixed"><parent link="b"/><child link="a"/></joint>'


@pytest.mark.parametrize(
    ("urdf", "message"),
    [
        ('<robot name="r"/>', "has no <link>; expected the links of an arm"),
        (
            _with_more(TWO_LINKS, BACK),
            "every link of the URDF is behind a joint; expected a tree",
        ),
    ],
)
def test_a_urdf_without_a_base_is_named(urdf: str, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        read_urdf(urdf)


@pytest.mark.parametrize(
    "twin",
    [
        TWO_LINKS.replace('name="r"', 'name="r" xmlns="http://example.com/urdf"'),
        TWO_LINKS.replace('name="r"', 'name="r" xmlns:xacro="http://example.com/xacro"').replace(
            '<link name="a"/>', '<link name="a"/><xacro:link name="a"/>'
        ),
        TWO_LINKS.replace('<mass value="2"/>', ""),
        TWO_LINKS.replace('<mass value="2"/>', '<mass value="two"/>'),
        TWO_LINKS.replace("<mass", '<origin xyz="here"/><mass'),
        TWO_LINKS.replace('ixx="1"', ""),
        TWO_LINKS.replace(LIMIT, f'{LIMIT}<mimic joint="j"/>'),
    ],
)
def test_what_pinocchio_lets_pass_is_let_pass(twin: str) -> None:
    assert twin != TWO_LINKS
    _assert_read_as_pinocchio_reads(twin)


def test_a_link_with_two_parents_is_refused() -> None:
    begin = TWO_LINKS.index("<joint")
    end = TWO_LINKS.index("</robot>")
    joint = TWO_LINKS[begin:end]
    other_name = joint.replace('name="j"', 'name="k"')
    twice = _with_more(TWO_LINKS, other_name)
    with pytest.raises(ModelError, match="'b' is the child of two joints; expected a tree"):
        read_urdf(twice)
    same_name = _with_more(TWO_LINKS, joint)
    with pytest.raises(ModelError, match="two joints of the URDF have the same name"):
        read_urdf(same_name)


def test_the_arms_of_the_tests_can_be() -> None:
    assert robot_from_urdf(SEVEN_AXES.urdf).joint_count == 7
    for arm in (SEVEN_AXES, GANTRY, THREE_AXES):
        _assert_read_as_pinocchio_reads(arm.urdf)


# Robots made by hand


def _with_closure(**changed: Any) -> Robot:
    robot = FIVE_BAR.robot
    (closure,) = robot.closures
    return replace(robot, closures=(replace(closure, **changed),))


def _with_couplings(*pairs: tuple[int, int]) -> Robot:
    """Followers and their leaders."""
    couplings = [JointCoupling(follower, leader, 1.0, 0.0) for follower, leader in pairs]
    return replace(FIVE_BAR.robot, couplings=tuple(couplings))


def _with_pivot(closure: int, axis: int) -> Robot:
    return replace(FIVE_BAR.robot, pivots=(Pivot(closure, axis),))


def _with_first_parent(parent: int) -> Robot:
    robot = FIVE_BAR.robot
    first, *others = robot.joints
    return replace(robot, joints=(replace(first, parent=parent), *others))


DIRECTIONS_WANTED = "expected some of x, y, z, rx, ry, rz, each once"
INDESCRIBABLE: dict[str, tuple[Robot, str]] = {
    "unknown direction": (
        _with_closure(directions=("x", "up")),
        f"closure 'tip' has the directions x, up; {DIRECTIONS_WANTED}",
    ),
    "direction twice": (
        _with_closure(directions=("x", "x")),
        f"closure 'tip' has the directions x, x; {DIRECTIONS_WANTED}",
    ),
    "no direction": (
        _with_closure(directions=()),
        f"closure 'tip' has the directions none; {DIRECTIONS_WANTED}",
    ),
    "directions in one text": (
        _with_closure(directions="xy"),
        "directions of closure 'tip' is the text 'xy'; expected a list of names",
    ),
    "a closure without a name": (
        _with_closure(name=3),
        "name of a closure is of type int; expected str",
    ),
    "the pivot of another closure": (
        _with_pivot(1, 2),
        "closure of a pivot is 1; expected 0; give the index of a closure",
    ),
    "a pivot of no closure": (
        replace(_with_pivot(0, 2), closures=()),
        "the robot has a pivot and no closure; expected none; a pivot is where a loop is cut",
    ),
    "the fourth axis": (
        _with_pivot(0, 3),
        "axis of a pivot is 3; expected a whole number from 0 to 2; give the index of an axis",
    ),
    "a leader that follows": (
        _with_couplings((1, 0), (2, 1)),
        "joint 'right-crank' follows 'left-rod', a follower itself; expected a leader",
    ),
    "a joint that follows itself": (
        _with_couplings((1, 1)),
        "joint 'left-rod' follows 'left-rod', a follower itself; expected a leader",
    ),
    "a first joint behind another": (
        _with_first_parent(0),
        "parent of joint 'left-crank' is 0; expected -1; give the index of a joint",
    ),
}


@pytest.mark.parametrize(("robot", "words"), INDESCRIBABLE.values(), ids=INDESCRIBABLE)
def test_a_robot_made_by_hand_is_refused_in_words(robot: Robot, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        require_described(robot)


def test_a_robot_with_pivots_and_followers_is_described() -> None:
    require_described(FIVE_BAR.robot)
    require_described(_with_couplings((1, 0), (3, 2)))
