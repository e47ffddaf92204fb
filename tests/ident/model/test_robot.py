"""Requirements on a URDF for its joints to be a robot's, and that it is read as Pinocchio reads it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.errors import ModelError
from ident.model.robot import JointKind, read_urdf, robot_from_urdf
from tests.ident.arms import CONFIGS, GANTRY, SEVEN_AXES, THREE_AXES

FloatArray = NDArray[np.float64]

SHIPPED = sorted((*CONFIGS.glob("robots/*.urdf"), *CONFIGS.glob("simulation/*.urdf")))
LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
BODY = '<mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
TWO_LINKS = (
    '<robot name="r"><link name="a"/><link name="b"><inertial>' + BODY + '</inertial></link><joint name="j" '
    'type="revolute"><origin xyz="0 0 1"/><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>' + LIMIT + "</joint>"
    "</robot>"
)


def _assert_read_as_pinocchio_reads(urdf: str) -> None:
    model = pin.buildModelFromXML(urdf)
    found = read_urdf(urdf)
    assert [joint.name for joint in found.joints] == list(model.names)[1:]
    assert found.effort_limit.tolist() == list(model.upperEffortLimit)
    for number, (joint, body) in enumerate(zip(found.joints, found.bodies, strict=True), start=1):
        placement, inertia = model.jointPlacements[number], model.inertias[number]
        prismatic = joint.kind is JointKind.PRISMATIC
        assert joint.parent == model.parents[number] - 1
        assert _far(joint.rotation, placement.rotation) < 1e-14
        assert _far(joint.translation_m, placement.translation) < 1e-14
        assert _far(joint.axis, _screw(model, number)[slice(0, 3) if prismatic else slice(3, 6)]) < 1e-14
        assert body.mass_kg == pytest.approx(inertia.mass, rel=1e-14)
        if body.mass_kg > 0.0:
            assert _far(body.centre_m, inertia.lever) < 1e-14
        assert _far(body.inertia_kg_m2, inertia.inertia) < 1e-14 * max(1.0, float(np.abs(inertia.inertia).max()))


def _screw(model: pin.Model, number: int) -> FloatArray:
    joint = model.joints[number]
    motion = joint.createData()
    joint.calc(motion, pin.neutral(model)[joint.idx_q : joint.idx_q + joint.nq])
    return np.asarray(motion.S, dtype=np.float64).reshape(6)


def _far(found: FloatArray, expected: FloatArray) -> float:
    return float(np.abs(found - np.asarray(expected)).max())


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_the_shipped_robots_are_read_as_pinocchio_reads_them(path: Path) -> None:
    assert len(SHIPPED) >= 6
    _assert_read_as_pinocchio_reads(path.read_text())


@pytest.mark.parametrize("name", ["tx40/tx40_mdh_modified.urdf", "kr300/kr300.urdf"])
def test_robots_of_others_are_read_as_pinocchio_reads_them(name: str, shared_data: Path) -> None:
    _assert_read_as_pinocchio_reads((shared_data / name).read_text())


@settings(deadline=None, max_examples=150, derandomize=True)
@given(seed=st.integers(0, 1_000_000), count=st.integers(2, 14))
def test_any_tree_is_read_as_pinocchio_reads_it(seed: int, count: int) -> None:
    """Random trees: branches, fixed joints, all kinds of joint, bodies anywhere or nowhere, names in any order."""
    rng = np.random.default_rng(seed)
    names = [f"{letter}{number}" for number, letter in enumerate(rng.choice(list("zyABé_"), count))]
    kinds = rng.choice(["revolute", "continuous", "prismatic", "fixed"], count)
    kinds[0] = "revolute"
    elements = [f'<link name="base">{_inertial(rng)}</link>']
    for number, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        parent = "base" if number == 0 or rng.random() < 0.1 else f"l{rng.integers(max(0, number - 3), number)}"
        axis = "" if rng.random() < 0.2 else f'<axis xyz="{_three(rng.choice([-1.0, 0.3, 1.0, 2.0], 3))}"/>'
        limit = (
            "" if kind in ("continuous", "fixed") and rng.random() < 0.5 else f'<limit velocity="1" effort="{number}"/>'
        )
        elements += [
            f'<joint name="{name}" type="{kind}">{_origin(rng)}<parent link="{parent}"/><child link="l{number}"/>'
            f"{axis}{limit}</joint>",
            f'<link name="l{number}"><visual/>{_inertial(rng)}</link>',
        ]
    rng.shuffle(elements)
    _assert_read_as_pinocchio_reads(f'<?xml version="1.0"?><!-- a tree --><robot name="r">{"".join(elements)}</robot>')


def _three(numbers: FloatArray) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _origin(rng: np.random.Generator) -> str:
    xyz = f'xyz="{_three(rng.uniform(-2, 2, 3))}"' if rng.random() < 0.8 else ""
    turned = rng.choice([0.0, np.pi / 2, np.pi, -1.2, 0.3], 3)
    rpy = f'rpy="{_three(turned)}"' if rng.random() < 0.8 else ""
    return f"<origin {xyz} {rpy}/>" if rng.random() < 0.9 else ""


def _inertial(rng: np.random.Generator) -> str:
    if rng.random() < 0.2:
        return ""
    xx, xy, xz, yy, yz, zz = rng.uniform(0.0, 1.0, 6)
    mass = rng.choice([0.0, 0.7, 12.5])
    inertia = f'<inertia ixx="{xx}" ixy="{xy}" ixz="{xz}" iyy="{yy}" iyz="{yz}" izz="{zz}"/>'
    return f'<inertial>{_origin(rng)}<mass value="{mass}"/>{inertia if rng.random() < 0.9 else ""}</inertial>'


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>'), "direction of length one"),
        (('xyz="0 0.01 0.2"', 'xyz="0 10 200"'), "in mm"),
        (('xyz="0 0.01 0.2"', 'xyz="0 1e200 0.2"'), "expected at most"),
    ],
)
def test_no_geometry_that_cannot_be(wrong: tuple[str, str], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        robot_from_urdf(SEVEN_AXES.urdf.replace(*wrong, 1))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (('name="j"', ""), "has no name"),
        (('<child link="b"/>', ""), "'j' in the URDF has no <child>"),
        (('<child link="b"/>', '<child link="c"/>'), "connects link 'c', which the URDF does not have"),
        (('<parent link="a"/>', '<parent link="c"/>'), "connects link 'c', which the URDF does not have"),
        (
            ('<parent link="a"/>', '<parent link="b"/>'),
            "no moving joint",
        ),
        (('<link name="a"/>', '<link name="a"/><link name="c"/>'), r"2 links without a parent \(a, c\)"),
        (('<link name="a"/>', '<link name="a"/><link name="a"/>'), "two links of the URDF have the same name"),
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
    ],
)
def test_what_is_no_urdf_of_an_arm_is_refused(wrong: tuple[str, str], message: str) -> None:
    urdf = TWO_LINKS.replace(*wrong, 1)
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
    joint = TWO_LINKS[TWO_LINKS.index("<joint") : TWO_LINKS.index("</robot>")]
    twice = TWO_LINKS.replace("</robot>", joint.replace('name="j"', 'name="k"') + "</robot>")
    with pytest.raises(ModelError, match="'b' is the child of two joints; expected a tree"):
        read_urdf(twice)
    with pytest.raises(ModelError, match="two joints of the URDF have the same name"):
        read_urdf(TWO_LINKS.replace("</robot>", joint + "</robot>"))


def test_the_arms_of_the_tests_can_be() -> None:
    assert robot_from_urdf(SEVEN_AXES.urdf).joint_count == 7
    for arm in (SEVEN_AXES, GANTRY, THREE_AXES):
        _assert_read_as_pinocchio_reads(arm.urdf)
