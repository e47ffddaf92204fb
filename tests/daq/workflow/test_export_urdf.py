"""`drivegain export urdf`: the user's file with other inertias, and nothing else of it touched."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

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
LOAD_FRICTION = Parameter("load-friction coefficient 3 (speed_exponent 0)", 0.1, 0.01, "1")
FS5 = 14 * 4 + 12


def _standard_slice(joint: int) -> slice:
    """Place of a joint's standard parameters: its link, its rotor and its friction."""
    first = 14 * joint
    return slice(first, first + 14)


def _calibration(
    cell: str, model: Model, limits: FloatArray, standard: FloatArray, digest: str = "c" * 64
) -> Calibration:
    motion = random_motion(limits, 200, 9)
    by_row = model.regressor(motion).transpose(0, 2, 1)
    columns = by_row.reshape(-1, len(standard))
    triangle = np.asarray(np.linalg.qr(columns, mode="r"))
    names = tuple(column.name for column in model.columns)
    base = base_parameters(triangle, names)
    values = base.grouping @ standard
    parameters = []
    for name, value in zip(base.names, values, strict=True):
        parameters.append(Parameter(name, float(value), 0.01, "kg m²"))
    parameters.append(Parameter("mx:flange-a", 0.3, 0.01, "kg m"))
    parameters.append(LOAD_FRICTION)
    count = model.robot.joint_count
    gains = []
    for number in range(1, count + 1):
        gains.append(Gain(f"J{number}", 30.0, 0.1, "Nm/A", 30.0))
    accepted_effect = AcceptedEffect(
        "load-friction", "J3", {"speed_exponent": 0}, (LOAD_FRICTION,), 6.1, 3.4
    )
    axes = (3.0,) * count
    relative_error_percent = RelativeError(axes, 3.0)
    return Calibration(
        cell=cell,
        method="ml",
        gains=tuple(gains),
        parameters=tuple(parameters),
        effects=(accepted_effect,),
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
        body = link + more.parameters
        standard[_standard_slice(joint)] = (*body, 0.3, 1.2, 2.0, 0.1)
    standard[-3:] = (0.1, 0.3, 0.8)
    file = tmp_path_factory.mktemp("calibration") / "calibration.yaml"
    calibration = _calibration("tx40", model, cell_limits(cell), standard, cell.digest)
    save_calibration(calibration, file)
    return path, file, standard


def _export(*arguments: str | Path) -> int:
    return main(["export", "urdf", *map(str, arguments)])


def _exported_report(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> dict[str, Any]:
    """What an export reports with --json."""
    assert _export(*arguments, "--json") == 0
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return report


def _one_line(text: str) -> str:
    """A printed text without its line breaks."""
    return " ".join(text.split())


def _values_of_drives(report: dict[str, Any], model: Model) -> FloatArray:
    """Standard parameters of a report that are no part of a link."""
    values = {entry["name"]: entry["value"] for entry in report["not_in_urdf"]}
    for number, joint in enumerate(report["joints"], start=1):
        values[f"fv{number}"] = joint["damping"]
        values[f"fs{number}"] = joint["friction"]
    drive = [values.get(column.name, 0.0) for column in model.columns]
    return np.array(drive)


@pytest.mark.slow
def test_pinocchio_with_the_exported_urdf_gives_the_identified_torque(
    tx40: tuple[Path, Path, FloatArray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell, calibration, standard = tx40
    out = tmp_path / "robot.urdf"
    report = _exported_report(capsys, calibration, "--cell", cell, "--out", out)
    assert report["exact"]
    assert report["same_configuration"]
    assert report["shifts"] == []
    assert report["effects_left_out"] == ["load-friction on J3"]
    model = model_of(load_cell(cell))
    drive = _values_of_drives(report, model)
    _compare(model, out.read_text(), drive, standard)


@pytest.mark.slow
def test_a_corrected_description_is_said_beside_the_bodies(
    tx40: tuple[Path, Path, FloatArray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The joints of the file are as they were described, and its bodies are not."""
    cell, file, _ = tx40
    calibration = load_calibration(file)
    offset = Parameter("zero-offset offset 2", 1e-4, 1e-5, "rad")
    second_axis = calibration.gains[1].axis
    zero = AcceptedEffect("zero-offset", second_axis, {}, (offset,), 6.0, 3.0)
    effects = (*calibration.effects, zero)
    corrected_file = tmp_path / "zero.yaml"
    save_calibration(replace(calibration, effects=effects), corrected_file)
    out = tmp_path / "out.urdf"
    for known, corrected in ((file, False), (corrected_file, True)):
        assert _export(cell, known, "--out", out) == 0
        printed = _one_line(capsys.readouterr().out)
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
        body = 1.3 * link
        standard[_standard_slice(joint)] = (*body, 0.5, 3.0, 4.0, 0.2)
    limits = np.repeat([[0.0], [1.0], [2.0], [5.0]], 5, axis=1)
    calibration = _calibration("any", model, limits, standard)
    # An effect of a package that is not installed is left out, as every effect is.
    cosine = Parameter("ring-friction cosine 2", 0.1, 0.01, "Nm")
    second_axis = calibration.gains[1].axis
    missing = AcceptedEffect(
        "ring-friction", second_axis, {}, (cosine,), 6.1, 3.4, package="rings 1.2.0"
    )
    effects = (*calibration.effects, missing)
    save_calibration(replace(calibration, effects=effects), file)
    report = _exported_report(capsys, file, "--urdf", source, "--out", out)
    assert report["same_configuration"] is None
    drive = _values_of_drives(report, model)
    _compare(model, out.read_text(), drive, standard)


def _compare(model: Model, urdf: str, drive: FloatArray, standard: FloatArray) -> None:
    count = model.robot.joint_count
    limits = np.repeat([[0.2], [1.0], [2.0], [5.0]], count, axis=1)
    motion = random_motion(limits, 30, 17)
    columns = model.regressor(motion)
    torque = np.einsum("jck,c->jk", columns, standard)
    friction = np.einsum("jck,c->jk", columns, drive)
    robot = pin.buildModelFromXML(urdf)
    data = robot.createData()
    rigid = np.empty_like(torque)
    for k in range(30):
        q = motion.position_rad[k]
        v = motion.velocity_rad_s[k]
        a = motion.acceleration_rad_s2[k]
        rigid[:, k] = pin.rnea(robot, data, q, v, a)
    difference_norm = np.linalg.norm(rigid + friction - torque)
    torque_norm = np.linalg.norm(torque)
    assert difference_norm <= 2e-6 * torque_norm


@pytest.mark.slow
def test_an_impossible_calibration_is_projected_and_reported(
    tx40: tuple[Path, Path, FloatArray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell, _, standard = tx40
    declared = load_cell(cell)
    broken = standard.copy()
    broken[FS5] = -0.3
    file = tmp_path / "c.yaml"
    out = tmp_path / "r.urdf"
    model = model_of(declared)
    calibration = _calibration("tx40", model, cell_limits(declared), broken)
    save_calibration(calibration, file)
    report = _exported_report(capsys, file, "--cell", cell, "--out", out)
    assert not report["exact"]
    assert not report["same_configuration"]
    total = report["torque_change_percent"]["total"]
    assert 0.0 < total < 10.0
    largest_shifts = [shift["name"] for shift in report["shifts"][:3]]
    assert "fs5" in largest_shifts
    for joint in report["joints"]:
        assert joint["friction"] >= 0.0
        assert joint["mass_kg"] > 0.0
    assert _export(file, "--cell", cell, "--out", out) == 0
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
    missing = tmp_path / "none.urdf"
    assert _export(calibration, "--urdf", missing, "--out", out) == 6
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
    calibration = robot.saved(tmp_path)
    assert _export(robot.cell_file, calibration, "--out", out) == 0
    printed = _one_line(capsys.readouterr().out)
    assert "exactly the identified one" in printed
    assert "closure tip" in printed
    joint_count = robot.model.robot.joint_count
    links = urdf_links(out.read_text())
    assert len(links) == joint_count


@pytest.mark.slow
def test_no_input_and_no_foreign_file_is_overwritten(
    tx40: tuple[Path, Path, FloatArray], tmp_path: Path, checkout: Path
) -> None:
    cell, calibration, _ = tx40
    copy = tmp_path / "configs"
    for folder in ("cells", "robots"):
        (copy / folder).mkdir(parents=True)
    own = copy / "cells/tx40.yaml"
    own.write_text(cell.read_text())
    source = copy / "robots/tx40.urdf"
    # An earlier export may be replaced, but not while it is the URDF of the cell.
    original = (checkout / "configs/robots/tx40.urdf").read_text()
    text = original.replace("<robot", "<!-- format: drivegain-urdf -->\n<robot")
    source.write_text(text)
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
    out = tmp_path / "robot.urdf"

    def without_solver(name: str) -> object:
        if name == "cvxpy":
            return None
        return object()

    monkeypatch.setattr(daq.environment, "find_spec", without_solver)
    assert _export(calibration, "--cell", cell, "--out", out) == 6
    assert "pip install 'drivegain[physical]'" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_nothing_brings_the_solver_along_at_start_up() -> None:
    code = (
        "import sys, daq.cli.app, daq.cli.logs, ident.physical.physical;print({'cvxpy', "
        "'clarabel'} & set(sys.modules))"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
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


CHANGED_COMMENT = r"(?s)<!-- (format: drivegain-urdf|drivegain:).*?-->"
CHANGED_ELEMENT = (
    r"(?s)<inertial>(?=\s*<(origin|mass)).*?</inertial>|<dynamics "
    r"(?!damping=\"3\").*?/>"
)


def _unchanged_part(document: str) -> str:
    """A file without the parts that the export may change, and the space around them."""
    rest = re.sub(CHANGED_COMMENT, "", document)
    rest = re.sub(CHANGED_ELEMENT, "", rest)
    rest = rest.replace("<link name='arm'>\r\n\t</link>", "<link name='arm'/>")
    return re.sub(r"\s+", "", rest)


def test_everything_else_of_the_file_stays_byte_for_byte() -> None:
    updated = update_urdf(ODD.encode(), "odd.urdf", UPDATES, "by -- me -")
    assert updated.links == {"a": "arm", "b": "slide"}
    assert updated.merged == ("tool",)
    text = updated.content.decode()
    bodies = np.array([BODY.parameters, BODY.parameters])
    assert urdf_links(text) == pytest.approx(bodies, abs=1e-12)
    assert '<dynamics damping="1.5" friction="0.25" spring="2"/>' in text
    assert '<dynamics damping="2.5" friction="0.5"/>' in text
    first_comment = text.index("<!-- mine")
    format_comment = text.index("format: drivegain-urdf")
    assert first_comment < format_comment < text.index("<robot")
    assert text.count("\n") == text.count("\r\n")
    base = '<mass value="9"/>'
    assert base in text
    without_arm = re.sub("<linkname=.arm.>.*?</link>", "<linkname='arm'/>", _unchanged_part(text))
    assert without_arm == _unchanged_part(ODD)
    again = update_urdf(updated.content, "odd.urdf", UPDATES, "by -- me -")
    assert again.content == updated.content


@settings(deadline=None, max_examples=60)
@given(
    cut=st.integers(0, len(ODD)),
    rubbish=st.sampled_from(["", "<", "\x00", "<a>", "&x;", "]]>", '"']),
)
def test_a_damaged_file_is_refused_or_gives_the_bodies(cut: int, rubbish: str) -> None:
    damaged_text = ODD[:cut] + rubbish + ODD[cut:]
    damaged = damaged_text.encode()
    try:
        updated = update_urdf(damaged, "odd.urdf", UPDATES, "me")
    except SchemaMismatch:
        return
    assert b'<mass value="2.5"/>' in updated.content


def _changed_odd(old: str, new: str) -> bytes:
    """The odd file with one other text."""
    return ODD.replace(old, new).encode()


DEEP = b"<robot>" + b"<a>" * 100_000 + b"</a>" * 100_000 + b"</robot>"
LARGE = b"<robot>" + b" " * 17_000_000 + b"</robot>"
TWO_INERTIALS = _changed_odd(
    "</inertial></link>\r\n\t<trans", "</inertial><inertial/></link><trans"
)
DOCUMENT_TYPE = _changed_odd("<robot", '<!DOCTYPE robot SYSTEM "/etc/hostname"><robot')


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "well-formed"),
        (b"<html/>", "robot"),
        (ODD.encode("utf-16"), "UTF-8"),
        (_changed_odd("utf-8", "latin-1"), "UTF-8"),
        (DEEP, "in each other"),
        (LARGE, "bytes"),
        (_changed_odd('name="b"', 'name="c"'), "no joint 'b'"),
        (_changed_odd('name="slide"', 'name="slid"'), "no link 'slide'"),
        (_changed_odd('name="slide"', 'name="base"'), "two of <link name='base'>"),
        (_changed_odd('<child link="slide"/>', ""), "without one <child"),
        (TWO_INERTIALS, "2 <inertial>"),
        (DOCUMENT_TYPE, "document type"),
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
        'link="f"/><limit effort="1" velocity="1"/></joint>'
    )
    declared = load_cell(cell)
    urdf = declared.urdf.replace("</robot>", f"{finger}</robot>")
    (tmp_path / "robot.urdf").write_text(urdf)
    own_urdf = cell.read_text().replace("../robots/tx40.urdf", "robot.urdf")
    text = own_urdf.replace("axes:", "hold: {finger: 20}\naxes:", 1)
    own_cell = tmp_path / "cell.yaml"
    own_cell.write_text(text)
    out = tmp_path / "out.urdf"
    assert _export(calibration, "--cell", own_cell, "--out", out) == 0
    exported = pin.buildModelFromXML(out.read_text())
    names = list(exported.names)
    assert names[1:] == ["J1", "J2", "J3", "J4", "J5", "J6"]
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
    report = _exported_report(capsys, robot.cell_file, file, "--out", out)
    assert report["chosen_by"] == "full_parameters of the calibration"
    reported_values = [one["value"] for one in report["parameters"]]
    assert reported_values == [one.value for one in full.parameters]
    by_prior = [one["name"] for one in report["parameters"] if one["basis"] == "prior"]
    assert by_prior == ["m1"]
    total = report["torque_change_percent"]["total"]
    assert total == pytest.approx(1.0, abs=1e-6)
    shifts = report["shifts"]
    largest = max(shifts, key=lambda shift: shift["standard_deviations"])
    assert shifts[0] == largest
    for shift in shifts:
        physical = 1.01 * shift["identified"]
        assert shift["physical"] == pytest.approx(physical)
    text = out.read_text()
    links = standard[robot.model.link_columns]
    np.testing.assert_allclose(urdf_links(text), links, rtol=1e-9, atol=1e-9)
    assert "full_parameters of the calibration" in text
    assert "By the prior, not measured: m1" in text

    model = tmp_path / "robot.xml"
    files = [str(path) for path in (robot.cell_file, file)]
    assert main(["export", "mjcf", *files, "--out", str(model), "--json"]) == 0
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
    axes = [gain.axis for gain in calibration.gains]
    number = 1 + axes.index(axis)
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
    negative[FS5] = -0.3
    plain = _calibration("tx40", model, limits, negative, cell.digest)
    known = _with_friction_of_a_package(plain, "J5")

    def choose(calibration: Calibration) -> FullChoice:
        installed, missing = split_installed(calibration)
        gone = [effect.accepted for effect in missing]
        return full_choice(installed, model, limits, cell.urdf, gone)

    installed = replace(known, own_effects=(_SlidingFriction(),))
    with_package = choose(installed)
    without = choose(known)
    assert with_package.exact
    np.testing.assert_array_equal(without.standard, with_package.standard)
    assert not choose(plain).exact
    file = tmp_path / "calibration.yaml"
    save_calibration(known, file)
    out = tmp_path / "out.urdf"
    report = _exported_report(capsys, path, file, "--out", out)
    assert report["exact"]
    assert report["effects_left_out"] == [
        "load-friction on J3",
        "sliding-friction on J5 (of slides 1.2.0, not installed)",
    ]
