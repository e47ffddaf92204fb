"""Closed chains in a cell file: bad descriptions are refused by name,
and joints without a motor have names.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from daq.config.cell import DEGREE, Cell, DeclaredEffect, model_of, robot_of
from daq.config.cell_file import load_cell
from daq.config.same_cell import differing_sections
from daq.errors import ConfigurationInconsistent, SchemaMismatch
from daq.report.weighing_views import carrier_text
from daq.workflow.fit import declared_effects
from ident.model.bodies import LINK_PARAMETERS
from ident.model.urdf import read_urdf
from tests.conftest import CHECKOUT

MOTORS = "motors: [crank-1, crank-2]"
JOINTS = "crank-1, elbow-1, crank-2, elbow-2"
ASSEMBLY = "crank-1: 0, elbow-1: 0, crank-2: 0, elbow-2: 0"
CLOSURE = "  - {name: tip, first: rod-1-tip, second: rod-2-tip, directions: [x, y]}\n"
AGAIN = "  - {name: too, first: rod-2-tip, second: rod-1-tip, directions: [x, y]}\n"
#: The cranks meet each other, and the rods lie on each other: they turn about the elbows freely.
SINGULAR = "crank-1: 81.87, elbow-1: -128.436, crank-2: -81.87, elbow-2: 128.436"


def _cell(folder: Path, *changes: tuple[str, str], name: str = "five-bar") -> Cell:
    text = (CHECKOUT / f"configs/cells/{name}.yaml").read_text(encoding="utf-8")
    text = text.replace("../", f"{CHECKOUT}/configs/")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "cell.yaml").write_text(text, encoding="utf-8")
    return load_cell(folder / "cell.yaml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        pytest.param(
            ASSEMBLY,
            "crank-1: 90, elbow-1: 90, crank-2: 0, elbow-2: 0",
            "11: closures: found closure 'tip' cannot close at the assembly pose: x 643 mm, y 243 "
            "mm apart where it is declared; expected a pose of all joints at which the frames of "
            "every closure nearly coincide (assembly_deg, assembly_mm)",
            id="cannot close",
        ),
        pytest.param(
            "mobility: 2",
            "mobility: 3",
            "11: closures: found the closures leave 2 degrees of freedom at the assembly pose; "
            "expected 3 as declared: is a closure missing, or does one hold a direction that must "
            "be free (`directions`)?",
            id="mobility",
        ),
        pytest.param(
            MOTORS,
            "motors: [crank-1]",
            "11: closures: found the motors crank-1 do not move all 2 degrees of freedom that the "
            "closures leave; name a joint that each motor drives, one for each degree of freedom "
            "at least (`motors`); expected a mechanism that closes, and that its motors move",
            id="too few motors",
        ),
        pytest.param(
            MOTORS,
            "motors: [crank-1, crank-1]",
            "11: closures: found two motors drive crank-1; expected a joint of its own for each "
            "(`motors`)",
            id="one joint twice",
        ),
        pytest.param(
            MOTORS,
            "motors: [crank-1, crank-9]",
            "6: robot.motors[1]: found 'crank-9'; expected a joint of the URDF that "
            f"moves: {JOINTS}",
            id="unknown motor",
        ),
        pytest.param(
            "second: rod-2-tip",
            "second: rod-2-tap",
            "12: closures[0].second: found 'rod-2-tap'; expected a link of the URDF: base, "
            "crank-link-1, rod-1, plate, rod-1-tip, crank-link-2, rod-2, rod-2-tip",
            id="unknown link",
        ),
        pytest.param(
            "platform: plate",
            "platform: base",
            "11: closures: found the platform 'base' does not move; expected the link that carries "
            "the payload",
            id="fixed platform",
        ),
        pytest.param(
            "elbow-2: 0}",
            "elbow-3: 0}",
            "10: robot.assembly_deg.elbow-3: found no such joint; expected a joint of the URDF "
            f"that moves: {JOINTS}",
            id="unknown joint of the assembly pose",
        ),
        pytest.param(
            f"  {MOTORS}\n",
            "",
            "3: robot.motors: found missing; expected the joint of each axis",
            id="closures without motors",
        ),
        pytest.param(
            "  mobility: 2\n",
            "",
            "3: robot.mobility: found missing; expected the maker's degrees of freedom",
            id="closures without mobility",
        ),
        pytest.param(
            "- name: crank-2\n",
            "- name: elbow-1\n",
            "6: robot.motors[1]: found crank-2 as the joint of axis elbow-1, and joint elbow-1 "
            "without a motor; expected elbow-1, or another name of that axis (`axes[1].name`)",
            id="axis named as a joint without a motor",
        ),
        pytest.param(
            CLOSURE,
            CLOSURE + AGAIN,
            "13: closures[1]: found too, which closes rod-2-tip and rod-1-tip as tip does; "
            "expected each closure once",
            id="a closure twice",
        ),
        pytest.param(
            MOTORS,
            "motors: [crank-1, elbow-2]",
            "6: robot.motors[1]: found elbow-2 as the joint of axis crank-2, and joint crank-2 "
            "without a motor; expected crank-2, or another name of that axis (`axes[1].name`)",
            id="a joint without a motor among the motors",
        ),
        pytest.param(
            MOTORS,
            "motors: [crank-1, crank-2, elbow-1]",
            "6: robot.motors: found 3 joints for 2 axes; expected the joint of each axis, in their "
            "order (crank-1, crank-2)",
            id="more motors than axes",
        ),
        pytest.param(
            "mass_tolerance_kg: 0.005\n",
            "mass_tolerance_kg: 0.005\n    known: {mx: 0.1}\n",
            "45: payloads[0].known: found single parameters, and the link plate is not at the "
            "origin of its joint; expected `centre_m` and `inertia_kg_m2`, in the frame of that "
            "link",
            id="single parameters in the frame of a platform",
        ),
    ],
)
def test_a_bad_description_is_refused_by_name(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(ConfigurationInconsistent) as refusal:
        _cell(tmp_path, (old, new))
    expected = f"{tmp_path}/cell.yaml:{message}; correct the cell file"
    assert str(refusal.value) == expected


def test_a_coupled_drive_train_of_a_redundant_robot_is_refused(tmp_path: Path) -> None:
    """Such a model cannot be fitted; the refusal comes before a plan or a recording."""
    with pytest.raises(ConfigurationInconsistent) as refusal:
        _cell(tmp_path, ("- [0, 0, -5, 0]", "- [0, 1, -5, 0]"), name="dualv")
    assert str(refusal.value) == (
        f"{tmp_path}/cell.yaml:20: drive_train.ratio[2]: found the motor of crank-3 also turns "
        "with crank-2; expected zeros off the diagonal: 4 motors for 3 degrees of freedom; correct "
        "the cell file"
    )
    # Two motors, two degrees of freedom
    ratio = _cell(tmp_path, ("- [0, -50]", "- [10, -50]")).ratio
    assert ratio[1, 0] == 10.0


def test_motors_in_another_order_than_their_axes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"motors\[0\]: found crank-2 as the joint "
        r"of axis crank-1",
    ):
        _cell(tmp_path, (MOTORS, "motors: [crank-2, crank-1]"))


def test_a_joint_that_mimics_another_is_refused(tmp_path: Path) -> None:
    text = (CHECKOUT / "configs/robots/five-bar.urdf").read_text(encoding="utf-8")
    head = '<joint name="elbow-1" type="revolute">'
    assert head in text
    text = text.replace(head, f'{head}<mimic joint="crank-1"/>')
    (tmp_path / "mimic.urdf").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationInconsistent, match="joint elbow-1 mimics crank-1 in the URDF"):
        _cell(tmp_path, (f"{CHECKOUT}/configs/robots/five-bar.urdf", "mimic.urdf"))


def test_a_list_that_is_too_short_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(
        SchemaMismatch,
        match=r"directions: found list \[\]; expected at "
        r"least 1 item; ",
    ):
        _cell(tmp_path, ("directions: [x, y]", "directions: []"))


def test_a_singular_start_is_refused(tmp_path: Path) -> None:
    message = (
        r"11: closures: found the assembly pose is close to a singularity: condition "
        r"\d[\d.e+]+ of the closures; "
    )
    with pytest.raises(
        ConfigurationInconsistent,
        match=message + "expected below 500: give a pose inside the workspace",
    ):
        _cell(tmp_path, (ASSEMBLY, SINGULAR))


def test_degrees_of_a_prismatic_joint_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationInconsistent) as refusal:
        _cell(
            tmp_path,
            ("  assembly_mm: {slide-x: 0, slide-y: 0, slide-z: 0}\n", ""),
            ("assembly_deg: {\n", "assembly_deg: {\n    slide-x: 0,\n"),
            name="orthoglide",
        )
    assert (
        "robot.assembly_deg.slide-x: found joint slide-x, which is prismatic; expected a "
        "revolute joint"
    ) in str(refusal.value)


def test_a_serial_robot_has_no_key_of_a_closed_chain(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigurationInconsistent,
        match=r"6: robot\.motors: found given without "
        r"`closures`",
    ) as refusal:
        _cell(tmp_path, (CLOSURE, ""), ("closures:", "closures: []"))
    assert "found 3 faults" in str(refusal.value)
    assert "robot.platform" not in str(refusal.value)


def test_the_payload_of_a_serial_robot_may_hang_on_any_link_that_moves(tmp_path: Path) -> None:
    """Its drawing is in the frame of that link."""
    shutil.copytree(CHECKOUT / "configs", tmp_path / "configs")
    path = tmp_path / "configs/cells/rx90.yaml"
    text = path.read_text(encoding="utf-8")
    last = load_cell(path)
    assert model_of(last).robot.carrier == 5
    changed_text = text.replace("robot:\n", "robot:\n  platform: link3\n", 1)
    path.write_text(changed_text, encoding="utf-8")
    cell = load_cell(path)
    model = model_of(cell)
    assert model.robot.carrier == 2
    assert model.flange.start < model_of(last).flange.start
    assert carrier_text(cell).startswith("the joint J3, in which the link link3 is at (0, 0, 0) mm")
    assert differing_sections(cell, last) == ("robot.platform",)
    for name, found in (("base", "'base', which does not move"), ("hand", "'hand'")):
        path.write_text(
            text.replace("robot:\n", f"robot:\n  platform: {name}\n", 1), encoding="utf-8"
        )
        pattern = (
            rf"robot\.platform: found {found}; expected a "
            r"link that mov"
        )
        with pytest.raises(
            ConfigurationInconsistent,
            match=pattern,
        ):
            load_cell(path)


@pytest.mark.slow
def test_places_of_a_cell_are_those_of_its_robot() -> None:
    for name in ("five-bar", "dualv", "orthoglide", "demo"):
        path = CHECKOUT / f"configs/cells/{name}.yaml"
        cell = load_cell(path)
        robot = robot_of(cell)
        assert cell.place_names[len(cell.axes) :] == robot.undriven_names
        assert len(cell.place_units) == len(robot.places)
    five_bar_path = CHECKOUT / "configs/cells/five-bar.yaml"
    assert load_cell(five_bar_path).place_units[3] is DEGREE


def test_an_effect_is_declared_on_the_pivot_that_a_loop_is_cut_at(tmp_path: Path) -> None:
    declared = "effects:\n  - {name: passive-friction, axis: pivot tip}\nconditioning:"
    cell = _cell(tmp_path, ("conditioning:", declared))
    expected = (DeclaredEffect("passive-friction", 4, {}),)
    assert cell.effects == expected
    (placed,) = declared_effects(cell)
    assert placed.name_among(cell.place_names) == "passive-friction on pivot tip"
    assert cell.place_units[placed.axis] is DEGREE


def test_an_effect_is_declared_on_a_joint_without_a_motor(tmp_path: Path) -> None:
    declared = "effects:\n  - {name: passive-friction, axis: elbow-2}\nconditioning:"
    cell = _cell(tmp_path, ("conditioning:", declared))
    expected = (DeclaredEffect("passive-friction", 3, {}),)
    assert cell.effects == expected
    (placed,) = declared_effects(cell)
    assert placed.name_among(cell.place_names) == "passive-friction on elbow-2"
    wrong = declared.replace("elbow-2", "elbow-3")
    with pytest.raises(
        ConfigurationInconsistent,
        match="'elbow-3'; expected one of crank-1, crank-2, elbow-1, elbow-2",
    ):
        _cell(tmp_path, ("conditioning:", wrong))
    message = (
        r"effects\[0\]\.axis: found a place that this effect cannot have; expected a joint "
        r".* without a motor"
    )
    changed_declared = declared.replace("elbow-2", "crank-2")
    with pytest.raises(ConfigurationInconsistent, match=message):
        _cell(tmp_path, ("conditioning:", changed_declared))


def test_a_payload_is_drawn_in_the_frame_of_the_platform(tmp_path: Path) -> None:
    # The URDF's own joining of a body on a fixed joint must give the same as the cell file's
    # conversion.
    centre = (-0.02, 0.03, 0.05)
    inertia = (0.012, 0.001, -0.002, 0.014, 0.003, 0.017)
    turned = '<origin xyz="0.45 0 0" rpy="0.3 -0.2 0.5"/>'
    urdf = (CHECKOUT / "configs/robots/five-bar.urdf").read_text(encoding="utf-8")
    head, tail = urdf.split('<joint name="plate-mount" type="fixed">')
    tail = tail.replace('<origin xyz="0.45 0 0" rpy="0 0 0"/>', turned, 1)
    head_of_link, rest = tail.split('<link name="plate">')
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    drawn = " ".join(f'{name}="{value}"' for name, value in zip(names, inertia, strict=True))
    body = (
        f'<inertial><origin xyz="{centre[0]} {centre[1]} {centre[2]}"/><mass value="5.1"/>'
        f"<inertia {drawn}/></inertial></link>"
    )
    start = f'{head}<joint name="plate-mount" type="fixed">{head_of_link}<link name="plate">'
    rest = rest.partition("</link>")[2]
    bodies = read_urdf(f"{start}</link>{rest}").bodies
    bare = bodies[1]
    loaded = read_urdf(f"{start}{body}{rest}").bodies[1]
    text = f"{start}</link>{rest}"
    (tmp_path / "robot.urdf").write_text(text, encoding="utf-8")
    listed = f"    centre_m: {list(centre)}\n    inertia_kg_m2: {list(inertia)}\n"
    cell = _cell(
        tmp_path,
        (f"{CHECKOUT}/configs/robots/five-bar.urdf", "robot.urdf"),
        ("    mass_tolerance_kg: 0.005\n", f"    mass_tolerance_kg: 0.005\n{listed}"),
    )
    known = cell.payloads[0].drawn.known
    expected = loaded.parameters - bare.parameters
    actual = [known[name] for name in LINK_PARAMETERS]
    assert_allclose(actual, expected, rtol=1e-9, atol=1e-12)
    assert not np.allclose([known["mx"], known["my"], known["mz"]], 5.1 * np.array(centre))


def test_a_capsule_hangs_on_the_joint_that_its_axis_drives(tmp_path: Path) -> None:
    """The second crank of the five-bar is its third joint;
    a rod has no axis, and its joint's name.
    """
    capsules = "".join(
        f"    - {{name: {name}, link: {link}, from_m: [0, 0, 0], to_m: [0.1, 0, 0], "
        f"radius_m: 0.02}}\n"
        for name, link in (("crank", "crank-2"), ("rod", "elbow-1"))
    )
    cell = _cell(tmp_path, ("drive_train:\n", f"clearance:\n  capsules:\n{capsules}drive_train:\n"))
    assert cell.clearance is not None
    joints = [joint.name for joint in robot_of(cell).joints]
    assert [joints[capsule.link] for capsule in cell.clearance.capsules] == ["crank-2", "elbow-1"]
