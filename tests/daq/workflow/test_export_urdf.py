"""`drivegain export urdf`: the user's file with other inertias, and nothing else of it touched."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import daq.environment
from daq.cli.app import main
from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import load_calibration, save_calibration
from daq.errors import SchemaMismatch
from daq.workflow.full_choice import FullChoice, full_choice
from daq.workflow.mjcf_effects import split_installed
from daq.workflow.urdf_export import JointUpdate, cell_limits, update_urdf
from ident.calibration import AcceptedEffect, Calibration, Gain, Parameter
from ident.effects.effect import Effect, Property
from ident.effects.signals import Abscissa, Signals
from ident.estimators.estimate import RelativeError
from ident.model.base import base_parameters
from ident.model.bodies import Body
from ident.model.model import Column, DriveTrain, Model
from ident.model.urdf import robot_from_urdf
from ident.physical.full_set import FullParameter, FullSet
from ident.physical.physical import random_motion, urdf_links
from tests.daq.robot_calibrations import robot_of
from tests.ident.arms import GANTRY

FloatArray = NDArray[np.float64]
BODY = Body(
    2.5,
    np.array([0.01, -0.02, 0.1]),
    np.array([[0.03, 1e-3, -2e-3], [1e-3, 0.04, 3e-3], [-2e-3, 3e-3, 0.02]]),
)


def _calibration(
    cell: str, model: Model, limits: FloatArray, standard: FloatArray, digest: str = "c" * 64
) -> Calibration:
    motion = random_motion(limits, 200, 9)
    columns = model.regressor(motion).transpose(0, 2, 1).reshape(-1, len(standard))
    triangle = np.asarray(np.linalg.qr(columns, mode="r"))
    names = tuple(column.name for column in model.columns)
    base = base_parameters(triangle, names)
    count = model.robot.joint_count
    parameter = Parameter("mx:flange-a", 0.3, 0.01, "kg m")
    parameters = (
        *(
            Parameter(name, float(value), 0.01, "kg m²")
            for name, value in zip(base.names, base.grouping @ standard, strict=True)
        ),
        parameter,
        Parameter("load-friction coefficient 3 (speed_exponent 0)", 0.1, 0.01, "1"),
    )
    gains = tuple(Gain(f"J{number}", 30.0, 0.1, "Nm/A", 30.0) for number in range(1, count + 1))
    coefficients = (Parameter("load-friction coefficient 3 (speed_exponent 0)", 0.1, 0.01, "1"),)
    accepted_effect = AcceptedEffect(
        "load-friction", "J3", {"speed_exponent": 0}, coefficients, 6.1, 3.4
    )
    effects = (accepted_effect,)
    axes = (3.0,) * count
    relative_error_percent = RelativeError(axes, 3.0)
    return Calibration(
        cell=cell,
        method="ml",
        gains=gains,
        parameters=parameters,
        effects=effects,
        relative_error_percent=relative_error_percent,
        holdout_error_percent=None,
        condition=800.0,
        rows=1000,
        filter={"position_cutoff_hz": 40.0},
        sources=(),
        configuration_sha256=digest,
        created="2025-01-02T03:04:05+00:00",
        software="drivegain 0.1.0",
    )


@pytest.fixture(scope="module")
def tx40(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, FloatArray]:
    """Cell file, a calibration of it, and the standard parameters behind that."""
    path = checkout / "configs/cells/tx40.yaml"
    cell = load_cell(path)
    model = model_of(cell)
    standard = np.zeros(len(model.columns))
    rng = np.random.default_rng(4)
    for joint, link in enumerate(urdf_links(cell.urdf)):
        # Other bodies than those of the URDF: each has a further kilogram somewhere.
        centre_m = rng.uniform(-0.1, 0.1, 3)
        inertia_kg_m2 = 0.01 * np.eye(3)
        more = Body(1.0, centre_m, inertia_kg_m2)
        standard[14 * joint : 14 * joint + 14] = (*(link + more.parameters), 0.3, 1.2, 2.0, 0.1)
    standard[-3:] = (0.1, 0.3, 0.8)
    file = tmp_path_factory.mktemp("calibration") / "calibration.yaml"
    calibration = _calibration("tx40", model, cell_limits(cell), standard, cell.digest)
    save_calibration(calibration, file)
    return path, file, standard


def _export(*arguments: str | Path) -> int:
    return main(["export", "urdf", *map(str, arguments)])


@pytest.mark.slow
def test_pinocchio_with_the_exported_urdf_gives_the_identified_torque(
    tx40: tuple[Path, Path, FloatArray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell, calibration, standard = tx40
    out = tmp_path / "robot.urdf"
    assert _export(calibration, "--cell", cell, "--out", out, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["exact"]
    assert report["same_configuration"]
    assert report["shifts"] == []
    assert report["effects_left_out"] == ["load-friction on J3"]
    model = model_of(load_cell(cell))
    rest = {entry["name"]: entry["value"] for entry in report["not_in_urdf"]}
    for number, joint in enumerate(report["joints"], start=1):
        rest |= {f"fv{number}": joint["damping"], f"fs{number}": joint["friction"]}
    drive = np.array([rest.get(column.name, 0.0) for column in model.columns])
    _compare(model, out.read_text(), drive, standard)


@pytest.mark.slow
def test_a_corrected_description_is_said_beside_the_bodies(
    tx40: tuple[Path, Path, FloatArray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The joints of the file are as they were described, and its bodies are not."""
    cell, file, _ = tx40
    calibration = load_calibration(file)
    offset = Parameter("zero-offset offset 2", 1e-4, 1e-5, "rad")
    zero = AcceptedEffect("zero-offset", calibration.gains[1].axis, {}, (offset,), 6.0, 3.0)
    effects = (*calibration.effects, zero)
    changed_calibration = replace(calibration, effects=effects)
    save_calibration(changed_calibration, tmp_path / "zero.yaml")
    for known, corrected in ((file, False), (tmp_path / "zero.yaml", True)):
        assert _export(cell, known, "--out", tmp_path / "out.urdf") == 0
        printed = " ".join(capsys.readouterr().out.split())
        assert ("CHECK the description: the bodies are those" in printed) == corrected
        assert ("corrected by zero-offset on J2" in printed) == corrected
        assert "load-friction on J3 (see --json)" in printed


def test_a_gantry_without_a_cell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "gantry.urdf"
    file = tmp_path / "c.yaml"
    out = tmp_path / "out.urdf"
    source.write_text(GANTRY.urdf)
    drive_train = DriveTrain(np.eye(5))
    robot = robot_from_urdf(GANTRY.urdf)
    model = Model(robot, drive_train)
    standard = np.zeros(len(model.columns))
    for joint, link in enumerate(urdf_links(GANTRY.urdf)):
        standard[14 * joint : 14 * joint + 14] = (*(1.3 * link), 0.5, 3.0, 4.0, 0.2)
    limits = np.repeat([[0.0], [1.0], [2.0], [5.0]], 5, axis=1)
    calibration = _calibration("any", model, limits, standard)
    # An effect of a package that is not installed is left out, as every effect is.
    cosine = Parameter("ring-friction cosine 2", 0.1, 0.01, "Nm")
    missing = AcceptedEffect(
        "ring-friction", calibration.gains[1].axis, {}, (cosine,), 6.1, 3.4, package="rings 1.2.0"
    )
    effects = (*calibration.effects, missing)
    changed_calibration = replace(calibration, effects=effects)
    save_calibration(changed_calibration, file)
    assert _export(file, "--urdf", source, "--out", out, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["same_configuration"] is None
    rest = {entry["name"]: entry["value"] for entry in report["not_in_urdf"]}
    for number, joint in enumerate(report["joints"], start=1):
        rest |= {f"fv{number}": joint["damping"], f"fs{number}": joint["friction"]}
    drive = np.array([rest.get(column.name, 0.0) for column in model.columns])
    _compare(
        model,
        out.read_text(),
        drive,
        standard,
    )


def _compare(model: Model, urdf: str, drive: FloatArray, standard: FloatArray) -> None:
    count = model.robot.joint_count
    limits = np.repeat([[0.2], [1.0], [2.0], [5.0]], count, axis=1)
    motion = random_motion(limits, 30, 17)
    columns = model.regressor(motion)
    expected = np.einsum("jck,c->jk", columns, standard)
    friction = np.einsum("jck,c->jk", columns, drive)
    robot = pin.buildModelFromXML(urdf)
    data = robot.createData()
    rigid = np.array(
        [
            pin.rnea(robot, data, *state)
            for state in zip(
                motion.position_rad, motion.velocity_rad_s, motion.acceleration_rad_s2, strict=True
            )
        ]
    ).T
    rigid_norm = np.linalg.norm(rigid + friction - expected)
    expected_norm = np.linalg.norm(expected)
    assert rigid_norm <= 2e-6 * expected_norm


@pytest.mark.slow
def test_an_impossible_calibration_is_projected_and_reported(
    tx40: tuple[Path, Path, FloatArray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell, _, standard = tx40
    declared = load_cell(cell)
    broken = standard.copy()
    broken[14 * 4 + 12] = -0.3  # fs5
    file = tmp_path / "c.yaml"
    calibration = _calibration("tx40", model_of(declared), cell_limits(declared), broken)
    save_calibration(calibration, file)
    assert _export(file, "--cell", cell, "--out", tmp_path / "r.urdf", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert not report["exact"]
    assert not report["same_configuration"]
    total = report["torque_change_percent"]["total"]
    assert 0.0 < total < 10.0
    assert "fs5" in {shift["name"] for shift in report["shifts"][:3]}
    assert all(joint["friction"] >= 0.0 and joint["mass_kg"] > 0.0 for joint in report["joints"])
    assert _export(file, "--cell", cell, "--out", tmp_path / "r.urdf") == 0
    text = capsys.readouterr().out
    assert "No physical robot has exactly the identified parameters" in text
    assert "fs5 by" in text


def test_what_is_refused_and_with_which_code(
    tx40: tuple[Path, Path, FloatArray],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    checkout: Path,
) -> None:
    cell, calibration, _ = tx40
    out = tmp_path / "robot.urdf"
    demo = checkout / "configs/cells/demo.yaml"
    source = checkout / "configs/robots/tx40.urdf"
    assert _export(calibration, "--out", out) == 2
    assert _export(calibration, "--cell", cell, "--urdf", source, "--out", out) == 2
    assert _export(calibration, "--cell", demo, "--out", out) == 6
    assert "cell 'demo'" in capsys.readouterr().err
    # Motor 6 turns with two joints, which no URDF says.
    assert _export(calibration, "--urdf", source, "--out", out) == 4
    assert "Iam6" in capsys.readouterr().err
    assert _export(calibration, "--urdf", tmp_path / "none.urdf", "--out", out) == 6
    bomb = tmp_path / "bomb.urdf"
    bomb.write_text('<!DOCTYPE robot [<!ENTITY a "aaaa">]><robot name="&a;"/>')
    assert _export(calibration, "--urdf", bomb, "--out", out) == 6
    assert "document type" in capsys.readouterr().err
    assert not out.exists()


def test_of_a_closed_chain_the_tree_is_written_and_its_closures_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of("five-bar")
    out = tmp_path / "out.urdf"
    assert _export(robot.cell_file, robot.saved(tmp_path), "--out", out) == 0
    printed = capsys.readouterr().out
    said = " ".join(printed.split())
    assert "exactly the identified one" in said
    assert "closure tip" in said
    joint_count = robot.model.robot.joint_count
    assert len(urdf_links(out.read_text())) == joint_count


@pytest.mark.slow
def test_no_input_and_no_foreign_file_is_overwritten(
    tx40: tuple[Path, Path, FloatArray], tmp_path: Path, checkout: Path
) -> None:
    cell, calibration, _ = tx40
    copy = tmp_path / "configs"
    for folder in ("cells", "robots"):
        (copy / folder).mkdir(parents=True)
    (copy / "cells/tx40.yaml").write_text(cell.read_text())
    source = copy / "robots/tx40.urdf"
    # An earlier export may be replaced, but not while it is the URDF of the cell.
    text = (
        (checkout / "configs/robots/tx40.urdf")
        .read_text()
        .replace("<robot", "<!-- format: drivegain-urdf -->\n<robot")
    )
    source.write_text(text)
    own = copy / "cells/tx40.yaml"
    assert _export(calibration, "--cell", own, "--out", source) == 2
    assert source.read_text() == text
    assert _export(calibration, "--cell", own, "--out", own) == 2
    notes = tmp_path / "notes.txt"
    notes.write_text("mine")
    assert _export(calibration, "--cell", own, "--out", notes) == 2
    assert notes.read_text() == "mine"
    out = tmp_path / "out.urdf"
    assert _export(calibration, "--cell", own, "--out", out) == 0
    first = out.read_bytes()
    assert first.count(b"format: drivegain-urdf") == 1
    assert _export(calibration, "--cell", own, "--out", out) == 0
    assert out.read_bytes() == first


def test_without_the_solver_the_extra_is_named(
    tx40: tuple[Path, Path, FloatArray],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cell, calibration, _ = tx40
    monkeypatch.setattr(
        daq.environment, "find_spec", lambda name: None if name == "cvxpy" else object()
    )
    assert _export(calibration, "--cell", cell, "--out", tmp_path / "robot.urdf") == 6
    assert "pip install 'drivegain[physical]'" in capsys.readouterr().err
    assert not (tmp_path / "robot.urdf").exists()


@pytest.mark.slow
def test_nothing_brings_the_solver_along_at_start_up() -> None:
    code = (
        "import sys, daq.cli.app, daq.cli.logs, ident.physical.physical;print({'cvxpy', "
        "'clarabel'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


ODD = """<?xml version="1.0" encoding='utf-8'?>\r
<!-- mine: do not touch -->\r
<robot name='x'>\r
\t<material name="grey > dark"/>\r
\t<link name="base"><inertial><mass value="9"/>\r
\t\t<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>\r
\t<joint type="revolute" name="a"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>\r
\t\t<limit lower="-1" upper="1" effort="1" velocity="1"/><dynamics friction = '7' spring="2"/></joint>\r
\t<link name='arm'/>\r
\t<joint name="hold" type="fixed"><origin xyz="0 0 1"/><parent link="arm"/><child link="tool"/></joint>\r
\t<link name="tool"><visual><geometry><mesh filename="a>b.stl"/></geometry></visual><!-- <inertial/> -->\r
\t\t<inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>\r
\t<joint name="b" type="prismatic"><parent link="tool"/><child link="slide"/><axis xyz="1 0 0"/>\r
\t\t<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>\r
\t<link name="slide"><inertial><origin xyz="0 0 0"/><mass value="1"/>\r
\t\t<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>\r
\t<transmission name="t"><joint name="a"><dynamics damping="3"/></joint></transmission>\r
</robot>\r
"""  # noqa: E501
UPDATES = {"a": JointUpdate(BODY, 1.5, 0.25), "b": JointUpdate(BODY, 2.5, 0.5)}


def test_everything_else_of_the_file_stays_byte_for_byte() -> None:
    updated = update_urdf(ODD.encode(), "odd.urdf", UPDATES, "by -- me -")
    expected = {"a": "arm", "b": "slide"}
    assert updated.links == expected
    assert updated.merged == ("tool",)
    urdf = updated.content.decode()
    assert urdf_links(urdf) == pytest.approx(np.array([BODY.parameters] * 2), abs=1e-12)
    text = updated.content.decode()
    assert '<dynamics damping="1.5" friction="0.25" spring="2"/>' in text
    assert '<dynamics damping="2.5" friction="0.5"/>' in text
    assert text.index("<!-- mine") < text.index("format: drivegain-urdf") < text.index("<robot")
    assert text.count("\n") == text.count("\r\n")

    def without(document: str) -> str:
        """Remove the parts that the export may change, and the space around them."""
        kept = re.sub(r"(?s)<!-- (format: drivegain-urdf|drivegain:).*?-->", "", document)
        kept = re.sub(
            r"(?s)<inertial>(?=\s*<(origin|mass)).*?</inertial>|<dynamics "
            r"(?!damping=\"3\").*?/>",
            "",
            kept,
        )
        return re.sub(
            r"\s+", "", kept.replace("<link name='arm'>\r\n\t</link>", "<link name='arm'/>")
        )

    base = '<mass value="9"/>'
    assert base in text
    assert re.sub("<linkname=.arm.>.*?</link>", "<linkname='arm'/>", without(text)) == without(ODD)
    again = update_urdf(updated.content, "odd.urdf", UPDATES, "by -- me -")
    assert again.content == updated.content


@settings(deadline=None, max_examples=60)
@given(
    cut=st.integers(0, len(ODD)),
    rubbish=st.sampled_from(["", "<", "\x00", "<a>", "&x;", "]]>", '"']),
)
def test_a_damaged_file_is_refused_or_gives_the_bodies(cut: int, rubbish: str) -> None:
    damaged = (ODD[:cut] + rubbish + ODD[cut:]).encode()
    try:
        updated = update_urdf(damaged, "odd.urdf", UPDATES, "me")
    except SchemaMismatch:
        return
    assert b'<mass value="2.5"/>' in updated.content


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "well-formed"),
        (b"<html/>", "robot"),
        (ODD.encode("utf-16"), "UTF-8"),
        (ODD.replace("utf-8", "latin-1").encode(), "UTF-8"),
        (b"<robot>" + b"<a>" * 100_000 + b"</a>" * 100_000 + b"</robot>", "in each other"),
        (b"<robot>" + b" " * 17_000_000 + b"</robot>", "bytes"),
        (ODD.replace('name="b"', 'name="c"').encode(), "no joint 'b'"),
        (ODD.replace('name="slide"', 'name="slid"').encode(), "no link 'slide'"),
        (ODD.replace('name="slide"', 'name="base"').encode(), "two of <link name='base'>"),
        (ODD.replace('<child link="slide"/>', "").encode(), "without one <child"),
        (
            ODD.replace(
                "</inertial></link>\r\n\t<trans", "</inertial><inertial/></link><trans"
            ).encode(),
            "2 <inertial>",
        ),
        (
            ODD.replace("<robot", '<!DOCTYPE robot SYSTEM "/etc/hostname"><robot').encode(),
            "document type",
        ),
    ],
)
def test_hostile_and_foreign_files_are_refused(content: bytes, says: str) -> None:
    with pytest.raises(SchemaMismatch, match=re.escape(says)):
        update_urdf(content, "x.urdf", UPDATES, "me")


def test_held_joints_are_fixed_in_the_exported_urdf(
    tx40: tuple[Path, Path, FloatArray], tmp_path: Path
) -> None:
    cell, calibration, _ = tx40
    finger = (
        '<link name="f"/><joint name="finger" type="revolute"><parent link="link6"/><child '
        'link="f"/><limit '
    )
    urdf = load_cell(cell).urdf.replace(
        "</robot>", finger + 'effort="1" velocity="1"/></joint></robot>'
    )
    (tmp_path / "robot.urdf").write_text(urdf)
    changed_text = cell.read_text().replace("../robots/tx40.urdf", "robot.urdf")
    text = changed_text.replace("axes:", "hold: {finger: 20}\naxes:", 1)
    (tmp_path / "cell.yaml").write_text(text)
    out = tmp_path / "out.urdf"
    assert _export(calibration, "--cell", tmp_path / "cell.yaml", "--out", out) == 0
    exported = pin.buildModelFromXML(out.read_text())
    expected = [f"J{number}" for number in range(1, 7)]
    assert list(exported.names)[1:] == expected
    assert exported.existFrame("finger")


def _full_set(model: Model, standard: FloatArray) -> FullSet:
    """Full parameters of a fit, the mass of the base by the prior."""
    parameters: list[FullParameter] = []
    for column, value in zip(model.columns, standard.tolist(), strict=True):
        basis = "data"
        share = 0.1
        if column.name == "m1":
            basis = "prior"
            share = 0.9
        parameter = FullParameter(column.name, value, 0.1, column.unit, basis, share, None, None)
        parameters.append(parameter)
    urdf_sha256 = "a" * 64
    return FullSet(
        "arm.urdf", urdf_sha256, 0.1, tuple(parameters), (), False, 1.0, 1.0, None, None, ()
    )


def test_full_parameters_of_the_fit_are_written_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other bodies than the nearest ones, with the same numbers as `export mjcf`, and without a
    solver.
    """
    monkeypatch.setattr(daq.environment, "find_spec", lambda _: None)
    robot = robot_of("kr270")
    standard = 1.01 * robot.standard
    full = _full_set(robot.model, standard)
    calibration = replace(robot.calibration, full_parameters=full)
    file = robot.saved(tmp_path, calibration)
    out = tmp_path / "robot.urdf"
    assert _export(robot.cell_file, file, "--out", out, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["chosen_by"] == "full_parameters of the calibration"
    assert [one["value"] for one in report["parameters"]] == [one.value for one in full.parameters]
    assert [one["name"] for one in report["parameters"] if one["basis"] == "prior"] == ["m1"]
    total = report["torque_change_percent"]["total"]
    assert total == pytest.approx(1.0, abs=1e-6)
    largest = max(report["shifts"], key=lambda shift: shift["standard_deviations"])
    assert report["shifts"][0] == largest
    for shift in report["shifts"]:
        assert shift["physical"] == pytest.approx(1.01 * shift["identified"])
    links = urdf_links(out.read_text())
    expected = 1.01 * robot.standard[robot.model.link_columns]
    np.testing.assert_allclose(links, expected, rtol=1e-9, atol=1e-9)
    assert "full_parameters of the calibration" in out.read_text()
    assert "By the prior, not measured: m1" in out.read_text()
    model = tmp_path / "robot.xml"
    words = [str(word) for word in (robot.cell_file, file, "--out", model, "--json")]
    assert main(["export", "mjcf", *words]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["parameters"] == report["parameters"]
    assert _export(robot.cell_file, file, "--out", out) == 0
    assert "The torque of these bodies differs by 1 %" in capsys.readouterr().out


class _SlidingFriction(Effect):
    """τ = c sign(q̇): what fs has, too."""

    name = "sliding-friction"
    phrase = "sliding friction"
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.VELOCITY
    coefficients = (Column("coefficient", "Nm"),)

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Return one column."""
        velocity_sign = np.sign(signals.velocity_rad_s[axis])
        return np.asarray(velocity_sign[None])


def _with_friction_of_a_package(calibration: Calibration, axis: str) -> Calibration:
    number = 1 + [gain.axis for gain in calibration.gains].index(axis)
    coefficient = Parameter(f"sliding-friction coefficient {number}", 1.0, 0.01, "Nm")
    effect = AcceptedEffect(
        "sliding-friction", axis, {}, (coefficient,), 6.1, 3.4, package="slides 1.2.0"
    )
    parameters = (*calibration.parameters, coefficient)
    effects = (*calibration.effects, effect)
    return replace(calibration, parameters=parameters, effects=effects)


@pytest.mark.slow
def test_bodies_are_the_same_where_the_package_of_an_effect_is_not_installed(
    tx40: tuple[Path, Path, FloatArray],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Beside an effect of friction fs may be negative, whether the effect can be computed or
    not.
    """
    path, _, standard = tx40
    cell = load_cell(path)
    model = model_of(cell)
    limits = cell_limits(cell)
    negative = standard.copy()
    negative[14 * 4 + 12] = -0.3  # fs5
    plain = _calibration("tx40", model, limits, negative, cell.digest)
    known = _with_friction_of_a_package(plain, "J5")

    def choose(calibration: Calibration) -> FullChoice:
        installed, missing = split_installed(calibration)
        gone = [effect.accepted for effect in missing]
        return full_choice(installed, model, limits, cell.urdf, gone)

    changed_known = replace(known, own_effects=(_SlidingFriction(),))
    with_package = choose(changed_known)
    without = choose(known)
    assert with_package.exact
    np.testing.assert_array_equal(without.standard, with_package.standard)
    assert not choose(plain).exact
    file = tmp_path / "calibration.yaml"
    save_calibration(known, file)
    assert _export(path, file, "--out", tmp_path / "out.urdf", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["exact"]
    assert report["effects_left_out"] == [
        "load-friction on J3",
        "sliding-friction on J5 (of slides 1.2.0, not installed)",
    ]
