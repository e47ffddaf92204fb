"""`drivegain export mjcf`: MuJoCo's inverse dynamics of the model are the torques that the
calibration predicts.
"""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, fromstring, tostring

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

import daq.environment
from daq.cli.app import main
from daq.workflow.mjcf_effects import numbers_of, split_installed
from ident.calibration import AcceptedEffect, Calibration, Parameter
from ident.effects.position import Spring
from ident.effects.signals import Signals
from ident.model.closures import origin
from ident.model.robot import poses
from ident.physical.full_set import FullParameter, FullSet
from ident.physical.physical import inertia_prior
from ident.prediction import measured_torque
from tests.conftest import CHECKOUT
from tests.daq.robot_calibrations import CalibratedRobot, apart, calibrated_robot, robot_of

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
SERIAL = ("kr270", "seven-axis", "gantry", "tx40")
CLOSED = ("five-bar", "orthoglide", "dualv")
SLOWEST = (
    #: Speed of joints and motors above which MuJoCo's friction constraint has its whole force
    #: [rad/s or m/s]
    0.05
)
SAME = 1e-6  #: ‖Δτ‖/‖τ‖


@dataclass(frozen=True)
class Exported:
    """A model that was written, and the JSON document."""

    robot: CalibratedRobot
    text: str
    report: dict[str, Any]

    @property
    def missing_nm(self) -> FloatArray:
        """Torque that the document says the model lacks, shape (m, k)."""
        entries = self.report["not_in_mjcf"]
        value_of = {entry["name"]: entry["value"] for entry in entries}
        columns = self.robot.model.columns
        values = [value_of.get(column.name, 0.0) for column in columns]
        regressor = self.robot.model.regressor(self.robot.states)
        missing_nm = np.einsum("jck,c->jk", regressor, np.array(values))
        return np.asarray(missing_nm)

    def completed_nm(self, *, friction: bool = True) -> FloatArray:
        """MuJoCo's torque and the torque that the document says the model lacks, shape (m, k)."""
        simulated_nm = inverse_nm(self.text, self.robot, friction=friction)
        return simulated_nm + self.missing_nm


def export_command(cell_file: Path, calibration_file: Path, out: Path) -> list[str]:
    """Arguments of `drivegain export mjcf`."""
    return ["export", "mjcf", str(cell_file), str(calibration_file), "--out", str(out)]


def export(
    robot: CalibratedRobot,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    calibration: Calibration | None = None,
) -> Exported:
    """Run the command."""
    calibration_file = robot.saved(folder, calibration)
    out = folder / "robot.xml"
    command = export_command(robot.cell_file, calibration_file, out)
    status = main([*command, "--json"])
    assert status == 0
    printed = capsys.readouterr().out
    report = json.loads(printed)
    return Exported(robot, out.read_text(), report)


def names_of(entries: list[dict[str, Any]]) -> list[str]:
    """Names in a list of the JSON document."""
    return [entry["name"] for entry in entries]


def by_name(entries: list[dict[str, Any]], key: str) -> dict[str, Any]:
    """Values of a key in a list of the JSON document, by the names of the entries."""
    return {entry["name"]: entry[key] for entry in entries}


def loaded(text: str) -> Any:
    """Load a model; MuJoCo warns of what it changes in it."""
    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)
    try:
        model = mujoco.MjModel.from_xml_string(text)
    finally:
        mujoco.set_mju_user_warning(None)
    assert warnings == []
    return model


def at_keyframe(simulated: Any) -> Any:
    """Data of a simulated robot at its keyframe."""
    data = mujoco.MjData(simulated)
    mujoco.mj_resetDataKeyframe(simulated, data, 0)
    return data


def inverse_nm(text: str, robot: CalibratedRobot, *, friction: bool = True) -> FloatArray:
    """Torque of each axis by MuJoCo's inverse dynamics, of a closed chain projected to its motors,
    shape (m, k).
    """
    simulated = loaded(text)
    if not friction:
        simulated.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    data = mujoco.MjData(simulated)
    followed = robot.model.follow(robot.states)
    joints = robot.model.robot.joints
    dofs = [simulated.joint(joint.name).dofadr[0] for joint in joints]
    torques = []
    tree = followed.joints
    states = zip(tree.position_rad, tree.velocity_rad_s, tree.acceleration_rad_s2, strict=True)
    for position, velocity, acceleration in states:
        data.qpos[dofs] = position
        data.qvel[dofs] = velocity
        data.qacc[dofs] = acceleration
        mujoco.mj_inverse(simulated, data)
        joint_torque = data.qfrc_inverse[dofs]
        torques.append(joint_torque.copy())
    warning_counts = [warning.number for warning in data.warning]
    assert not any(warning_counts)
    joint_torques = np.array(torques).T
    return robot.model.at_axes(followed, joint_torques)


def is_moving(robot: CalibratedRobot) -> NDArray[np.bool_]:
    """Mask of the states in which every joint and every motor is fast enough, shape (k,)."""
    velocity = robot.states.velocity_rad_s
    motors = velocity @ robot.model.drive_train.direction.T
    joints = robot.model.follow(robot.states).joints.velocity_rad_s
    speeds = np.concatenate((velocity, motors, joints), axis=1)
    is_fast = np.abs(speeds) > SLOWEST
    return np.asarray(is_fast.all(axis=1))


def moving_error(robot: CalibratedRobot, found: FloatArray, expected: FloatArray) -> float:
    """‖found − expected‖/‖expected‖ of the worst axis, of the states in which all is moving."""
    moving = is_moving(robot)
    found_moving = found[:, moving]
    expected_moving = expected[:, moving]
    return apart(found_moving, expected_moving)


def dry_nm(robot: CalibratedRobot) -> FloatArray:
    """True dry friction at each axis, shape (m, k)."""
    names = [column.name for column in robot.model.columns]
    is_dry = [name.startswith("fs") for name in names]
    dry = np.where(is_dry, robot.standard, 0.0)
    columns = robot.model.regressor(robot.states)
    dry_nm = np.einsum("jck,c->jk", columns, dry)
    return np.asarray(dry_nm)


@pytest.mark.parametrize("name", [*SERIAL, "ur10", *CLOSED])
def test_inverse_dynamics_are_the_predicted_torque_without_what_is_listed(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Offsets are all that these models lack: couplings of wrist and belt motors are tendons."""
    robot = robot_of(name)
    exported = export(robot, tmp_path, capsys)
    report = exported.report
    assert report["exact"]
    assert report["same_configuration"]
    assert report["closures_left_out"] == []
    axis_joints = robot.model.robot.axis_joints
    offsets = [f"off{joint + 1}" for joint in axis_joints]
    assert names_of(report["not_in_mjcf"]) == offsets

    expected = robot.predicted_nm()
    without_friction = exported.completed_nm(friction=False)
    smooth = apart(without_friction + dry_nm(robot), expected)
    moving = is_moving(robot)
    assert moving.sum() >= 100
    with_friction = moving_error(robot, exported.completed_nm(), expected)
    simulated_nm = inverse_nm(exported.text, robot)
    without_list = moving_error(robot, simulated_nm, expected)
    with capsys.disabled():
        figures = (
            f"{smooth:.1e}, with dry friction {with_friction:.1e}, without the listed "
            f"offsets {without_list:.1e}"
        )
        sys.stdout.write(f"\n  {name}: torque of MuJoCo apart from predict_torque by {figures}\n")
    assert smooth <= SAME
    assert with_friction <= SAME
    assert without_list > 1e-3


def _negative(words: str) -> str:
    """Numbers of an attribute, with the other sign."""
    negative = [repr(-float(word)) for word in words.split()]
    return " ".join(negative)


def _turn_axis(root: Element) -> None:
    joint = _found(root, ".//joint[@name='J2']")
    axis = joint.get("axis", "")
    joint.set("axis", _negative(axis))


def _swap_inertia(root: Element) -> None:
    inertial = _found(root, ".//body[@name='link5']/inertial")
    words = inertial.get("fullinertia", "").split()
    swapped = (*words[:3], words[5], words[4], words[3])
    inertial.set("fullinertia", " ".join(swapped))


def _shift_mass(root: Element) -> None:
    inertial = _found(root, ".//body[@name='link6']/inertial")
    centre = inertial.get("pos", "")
    inertial.set("pos", _negative(centre))


def _turn_gravity(root: Element) -> None:
    _found(root, "option").set("gravity", "0 0 9.81")


def _turn_frame(root: Element) -> None:
    """Conjugate a quaternion: the frame of the child in the parent's is taken for its inverse."""
    bodies = root.findall(".//body[@quat]")
    body = next(one for one in bodies if _is_turned(one))
    first, others = body.get("quat", "").split(maxsplit=1)
    body.set("quat", f"{first} {_negative(others)}")


def _is_turned(body: Element) -> bool:
    """Whether the frame of a body is turned in its parent's."""
    words = body.get("quat", "").split()
    return words[1:] != ["0.0", "0.0", "0.0"]


def _drop(name: str, attribute: str) -> Any:
    def change(root: Element) -> None:
        path = f".//*[@name='{name}'][@{attribute}]"
        _found(root, path).set(attribute, "0")

    return change


def _turn_tendon(root: Element) -> None:
    joint = _found(root, ".//fixed/joint")
    coefficient = joint.get("coef", "0")
    joint.set("coef", _negative(coefficient))


def _found(root: Element, path: str) -> Element:
    element = root.find(path)
    assert element is not None
    return element


@pytest.mark.parametrize(
    ("name", "change"),
    [
        pytest.param("tx40", _turn_frame, id="frame"),
        pytest.param("kr270", _turn_axis, id="axis"),
        pytest.param("kr270", _swap_inertia, id="order of the inertia"),
        pytest.param("kr270", _shift_mass, id="centre of mass"),
        pytest.param("kr270", _turn_gravity, id="gravity"),
        pytest.param("kr270", _drop("J6", "armature"), id="armature"),
        pytest.param("kr270", _drop("J1", "damping"), id="damping"),
        pytest.param("kr270", _drop("J1", "frictionloss"), id="friction"),
        pytest.param("kr270", _turn_tendon, id="tendon"),
    ],
)
def test_one_wrong_number_is_another_torque(
    name: str, change: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The round trip notices each of them: none is too small to count."""
    robot = robot_of(name)
    exported = export(robot, tmp_path, capsys)
    root = fromstring(exported.text)
    change(root)
    text = tostring(root, encoding="unicode")
    changed = replace(exported, text=text)
    error = moving_error(robot, changed.completed_nm(), robot.predicted_nm())
    assert error > 100 * SAME


@pytest.mark.parametrize("name", ["kr270", "gantry", "five-bar", "dualv"])
def test_the_actuators_turn_currents_into_torques_by_the_identified_gains(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of(name)
    exported = export(robot, tmp_path, capsys)
    simulated = loaded(exported.text)
    data = mujoco.MjData(simulated)
    rng = np.random.default_rng(8)
    axis_count = robot.model.robot.axis_count
    current_a = rng.uniform(-5.0, 5.0, (1, axis_count))
    for axis, value in zip(robot.cell.axis_names, current_a[0], strict=True):
        actuator = data.actuator(axis)
        actuator.ctrl = value
    mujoco.mj_forward(simulated, data)
    axes = robot.model.robot.axes
    dofs = [simulated.joint(joint.name).dofadr[0] for joint in axes]
    torque_nm = data.qfrc_actuator[dofs]
    expected_nm = measured_torque(robot.calibration, robot.model, current_a)[0]
    assert torque_nm == pytest.approx(expected_nm, rel=1e-9)
    actuators = exported.report["actuators"]
    for entry, gain in zip(actuators, robot.calibration.gains, strict=True):
        assert entry["axis"] == gain.axis
        assert entry["gear"] == gain.value
        assert entry["unit"] == gain.unit


@pytest.mark.parametrize("name", ["seven-axis", "gantry"])
def test_predicted_currents_accelerate_the_simulated_robot_as_predicted(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of(name)
    exported = export(robot, tmp_path, capsys)
    simulated = loaded(exported.text)
    data = mujoco.MjData(simulated)
    torque_nm = robot.predicted_nm() - exported.missing_nm
    gains = np.array([gain.value for gain in robot.calibration.gains])
    to_motor = robot.model.drive_train.to_motor
    current_a = (to_motor @ torque_nm).T / gains
    acceleration = robot.states.acceleration_rad_s2
    largest = np.abs(acceleration).max()
    moving = np.flatnonzero(is_moving(robot))
    for sample in moving[:40]:
        data.qpos[:] = robot.states.position_rad[sample]
        data.qvel[:] = robot.states.velocity_rad_s[sample]
        data.ctrl[:] = current_a[sample]
        mujoco.mj_forward(simulated, data)
        # The friction constraint is solved by iteration.
        expected = pytest.approx(acceleration[sample], abs=1e-4 * largest)
        assert data.qacc == expected


def _simulated_gap_m(simulated: Any, robot: CalibratedRobot) -> tuple[float, float]:
    """Push a closed chain by its first motor;
    return how far it moved, and how far its loops are open [m].
    """
    data = at_keyframe(simulated)
    start = data.qpos.copy()
    largest_nm = np.abs(robot.predicted_nm()).max()
    push_nm = 0.06 * float(largest_nm)
    gain = robot.calibration.gains[0].value
    data.ctrl[0] = push_nm / gain
    for _ in range(300):
        mujoco.mj_step(simulated, data)
    warning_counts = [warning.number for warning in data.warning]
    assert not any(warning_counts)

    joints = robot.model.robot.joints
    addresses = [simulated.joint(joint.name).qposadr[0] for joint in joints]
    position_rad = data.qpos[addresses][None]
    placed = poses(robot.model.robot, position_rad)
    gaps = []
    for closure in robot.model.robot.closures:
        first = origin(placed, closure.first)
        second = origin(placed, closure.second)
        gaps.append(first - second)
    moved_by = data.qpos - start
    largest_motion = np.abs(moved_by).max()
    largest_gap = np.abs(gaps).max()
    return float(largest_motion), float(largest_gap)


@pytest.mark.parametrize("name", CLOSED)
def test_a_simulated_closed_chain_stays_closed(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of(name)
    text = export(robot, tmp_path, capsys).text
    simulated = loaded(text)
    moved, gap_m = _simulated_gap_m(simulated, robot)
    assert moved > 0.01
    size_m = robot.model.assembly.size_m
    assert gap_m < 1e-3 * size_m
    simulated.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EQUALITY
    _, apart_m = _simulated_gap_m(simulated, robot)
    assert apart_m > 10.0 * gap_m


def _cell_with_description(folder: Path, name: str, urdf: str, more: str = "") -> Path:
    """Write the cell of a shipped robot with another description, and return its file.

    Args:
        folder: gets the folders of cells and robots.
        name: of the robot.
        urdf: its other description.
        more: lines that are added to the shipped cell.
    """
    cells = folder / "cells"
    robots = folder / "robots"
    cells.mkdir()
    robots.mkdir()
    (robots / f"{name}.urdf").write_text(urdf)
    shipped = CHECKOUT / f"configs/cells/{name}.yaml"
    cell = cells / f"{name}.yaml"
    cell.write_text(shipped.read_text() + more)
    return cell


def _urdf_of(name: str) -> str:
    """Description of a shipped robot."""
    return (CHECKOUT / f"configs/robots/{name}.urdf").read_text()


def test_a_joint_that_follows_an_axis_follows_it_in_mujoco(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rod = """<link name="behind"><inertial><origin xyz="0.05 0.02 0.1"/><mass value="1.5"/>
      <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/></inertial></link>
      <joint name="rod" type="revolute"><origin xyz="0 0 0.1"/>
      <parent link="link5"/><child link="behind"/>
      <axis xyz="0 1 0"/><limit lower="-9" upper="9" velocity="1" effort="1"/>
      <mimic joint="J5" multiplier="-0.5" offset="0.1"/></joint></robot>"""
    urdf = _urdf_of("tx40").replace("</robot>", rod)
    cell = _cell_with_description(tmp_path, "tx40", urdf)
    robot = calibrated_robot(cell)
    exported = export(robot, tmp_path, capsys)
    expected = robot.predicted_nm() - exported.missing_nm
    simulated_nm = inverse_nm(exported.text, robot)
    assert moving_error(robot, simulated_nm, expected) < SAME

    simulated = loaded(exported.text)
    data = at_keyframe(simulated)
    leader = simulated.joint("J5").qposadr[0]
    follower = simulated.joint("rod").qposadr[0]
    start = data.qpos[leader]
    gain = robot.calibration.gains[4].value
    gain_sign = np.sign(gain)
    data.ctrl[4] = 3.0 * gain_sign  # that of J5, in A
    for _ in range(200):
        mujoco.mj_step(simulated, data)
    moved_by = data.qpos[leader] - start
    assert abs(moved_by) > 0.02
    follower_rad = data.qpos[follower]
    expected_rad = 0.1 - 0.5 * data.qpos[leader]
    assert follower_rad == pytest.approx(expected_rad, abs=2e-3)


def test_a_planar_loop_closes_beside_its_plane(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rods of a five-bar pass each other: their tips are apart along the axis of the pivot."""
    urdf = _urdf_of("five-bar")
    tip = re.search(r'<joint name="tip-2" type="fixed">\s*<origin xyz="(\S+) (\S+) (\S+)"', urdf)
    assert tip is not None
    raised_m = float(tip[3]) + 0.03
    coordinates = f'{tip[2]} {tip[3]}"'
    raised_coordinates = f'{tip[2]} {raised_m:g}"'
    raised = tip[0].replace(coordinates, raised_coordinates)
    raised_urdf = urdf.replace(tip[0], raised)
    cell = _cell_with_description(tmp_path, "five-bar", raised_urdf)
    exported = export(calibrated_robot(cell), tmp_path, capsys)
    assert exported.report["closures_left_out"] == []
    simulated = loaded(exported.text)
    data = at_keyframe(simulated)
    mujoco.mj_forward(simulated, data)
    equality_gaps = np.abs(data.efc_pos[: data.ne])
    assert equality_gaps.max() < 1e-9
    assert data.ne == 3


def test_effects_are_listed_and_exactly_they_are_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of("seven-axis")
    coefficient = Parameter("load-friction coefficient 3 (speed_exponent 0)", 0.1, 0.01, "1")
    effect = AcceptedEffect("load-friction", "J3", {"speed_exponent": 0}, (coefficient,), 6.1, 3.4)
    calibration = robot.with_effect(effect)
    parameter = Parameter("mx:flange-a", 0.3, 0.01, "kg m")
    parameters = (*calibration.parameters, parameter)
    calibration = replace(calibration, parameters=parameters)
    exported = export(robot, tmp_path, capsys, calibration)
    report = exported.report
    assert report["effects_left_out"] == ["load-friction on J3"]
    assert report["mountings_left_out"] == ["flange-a"]
    (listed,) = report["effects_not_in_mjcf"]
    assert listed["name"] == "load-friction"
    assert listed["axis"] == "J3"
    assert listed["package"] is None
    assert listed["settings"] == {"speed_exponent": 0}
    expected = [{"name": coefficient.name, "value": 0.1, "unit": "1"}]
    assert listed["coefficients"] == expected
    assert f"load-friction on J3: speed_exponent = 0, {coefficient.name} = 0.1 1" in exported.text
    assert "goes to qfrc_applied" in exported.text
    assert "Effects NOT in this model: load-friction on J3" in exported.text
    assert "Payloads NOT in this model: flange-a" in exported.text
    for entry in report["not_in_mjcf"]:
        assert f"{entry['name']} = {entry['value']:.6g}" in exported.text

    predicted_nm = robot.predicted_nm(calibration)
    of_effect = predicted_nm - robot.predicted_nm()
    assert np.abs(of_effect).max() > 1.0
    found = exported.completed_nm() + of_effect
    assert moving_error(robot, found, predicted_nm) <= SAME


def _effect_of_a_package() -> AcceptedEffect:
    """An effect of a package that is not installed."""
    coefficient = Parameter("ring-friction coefficient 1", 0.1, 0.01, "Nm")
    return AcceptedEffect(
        name="ring-friction",
        axis="J3",
        settings={},
        coefficients=(coefficient,),
        error_before_percent=6.1,
        error_after_percent=3.4,
        package="ring-effect 1.2.0",
    )


def test_an_effect_that_is_not_installed_is_listed_with_its_package(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of("seven-axis")
    effect = _effect_of_a_package()
    calibration = robot.with_effect(effect)
    exported = export(robot, tmp_path, capsys, calibration)
    left_out = exported.report["effects_left_out"]
    assert left_out == ["ring-friction on J3 (of ring-effect 1.2.0, not installed)"]
    assert "Effects NOT in this model: ring-friction on J3 (of ring-effect 1.2.0" in exported.text
    (listed,) = exported.report["effects_not_in_mjcf"]
    assert listed["package"] == "ring-effect 1.2.0"
    assert listed["coefficients"][0]["value"] == 0.1
    assert "ring-friction on J3: ring-friction coefficient 1 = 0.1 Nm" in exported.text


def test_the_covariance_without_a_missing_effect_is_that_of_the_others() -> None:
    robot = robot_of("seven-axis")
    effect = _effect_of_a_package()
    known = robot.with_effect(effect)
    *others, last = known.parameters
    known = replace(known, parameters=(last, *others))
    size = len(known.gains) + len(known.parameters)
    rng = np.random.default_rng(1)
    factor = np.tril(rng.normal(size=(size, size)))
    rows = []
    for number, row in enumerate(factor):
        up_to_diagonal = row[: number + 1]
        rows.append(tuple(up_to_diagonal.tolist()))
    calibration = replace(known, covariance_factor=tuple(rows))

    without, _ = split_installed(calibration)

    left = np.delete(np.arange(size), len(known.gains))
    assert without.parameters == known.parameters[1:]
    assert without.covariance is not None
    covariance = factor @ factor.T
    expected = covariance[np.ix_(left, left)]
    np.testing.assert_allclose(without.covariance, expected, atol=1e-12)


def test_a_calibration_of_a_library_has_neither_date_nor_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of("seven-axis")
    calibration = replace(robot.calibration, created="", software="", configuration_sha256="")
    exported = export(robot, tmp_path, capsys, calibration)
    assert f"from the calibration of {calibration.cell}, without a date. " in exported.text
    assert exported.report["same_configuration"] is None
    configuration_sha256 = "0" * 64
    changed_calibration = replace(calibration, configuration_sha256=configuration_sha256)
    other = export(robot, tmp_path, capsys, changed_calibration)
    assert other.report["same_configuration"] is False


def _passive_effect(kind: str, joint: str, *coefficients: Parameter) -> AcceptedEffect:
    """An effect of a passive joint that was accepted, without settings."""
    return AcceptedEffect(
        name=kind,
        axis=joint,
        settings={},
        coefficients=coefficients,
        error_before_percent=6.0,
        error_after_percent=3.0,
    )


def _passive_friction(joint: str, number: int) -> AcceptedEffect:
    """Dry and viscous friction of a passive joint."""
    dry = Parameter(f"passive-friction dry {number}", 0.4, 0.01, "Nm")
    viscous = Parameter(f"passive-friction viscous {number}", 0.2, 0.01, "Nm/(rad/s)")
    return _passive_effect("passive-friction", joint, dry, viscous)


@dataclass(frozen=True)
class JointEffect:
    """An effect, and whether MuJoCo has it at a joint."""

    robot: CalibratedRobot
    effect: AcceptedEffect
    is_at_joint: bool


def _joint_effects() -> list[JointEffect]:
    """Springs and friction of joints, some of them of no kind that MuJoCo has at a joint."""
    arm = robot_of("seven-axis")
    coefficients = (Parameter("spring stiffness 2", 30.0, 0.1, "Nm/rad"),)
    spring = AcceptedEffect("spring", "J2", {}, coefficients, 6.0, 3.0)
    pushing_coefficient = replace(spring.coefficients[0], value=-30.0)
    pushing = replace(spring, coefficients=(pushing_coefficient,))

    chain = robot_of("five-bar")
    places = [joint.name for joint in chain.model.robot.places]
    elbow = places.index("elbow-1") + 1
    friction = _passive_friction("elbow-1", elbow)
    other = places.index("elbow-2") + 1
    stiffness = Parameter(f"passive-spring stiffness {other}", 5.0, 0.01, "Nm/rad")
    preload = Parameter(f"passive-spring preload {other}", -2.0, 0.01, "Nm")
    passive_spring = _passive_effect("passive-spring", "elbow-2", stiffness, preload)
    tip = places.index("pivot tip") + 1
    pivot = _passive_friction("pivot tip", tip)
    return [
        JointEffect(arm, spring, is_at_joint=True),
        JointEffect(arm, pushing, is_at_joint=False),
        JointEffect(chain, friction, is_at_joint=True),
        JointEffect(chain, passive_spring, is_at_joint=True),
        JointEffect(chain, pivot, is_at_joint=False),
    ]


def test_springs_and_friction_of_passive_joints_are_at_their_joints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for case in _joint_effects():
        robot = case.robot
        effect = case.effect
        calibration = robot.with_effect(effect)

        exported = export(robot, tmp_path, capsys, calibration)

        name = f"{effect.name} on {effect.axis}"
        at_joints = exported.report["effects_at_joints"]
        left_out = exported.report["effects_left_out"]
        without_effect = robot.predicted_nm()
        with_effect = robot.predicted_nm(calibration)
        assert apart(with_effect, without_effect) > 1e-3
        if case.is_at_joint:
            assert at_joints == [name]
            assert left_out == []
            expected = with_effect
        else:
            assert at_joints == []
            assert left_out == [name]
            expected = without_effect
        moving = is_moving(robot)
        assert moving.sum() >= 100
        error = moving_error(robot, exported.completed_nm(), expected)
        assert error <= SAME


def test_a_corrected_zero_is_in_the_frames_of_the_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where the calibration corrects the description, recorded positions still mean the same."""
    robot = robot_of("kr270")
    offset = Parameter("zero-offset offset 3", 0.02, 1e-5, "rad")
    effect = AcceptedEffect("zero-offset", "J3", {}, (offset,), 6.0, 3.0, described=(0.0,))
    corrected = robot.with_effect(effect)
    late = Parameter("late-position time 2", 0.001, 1e-5, "s")
    accepted_effect = AcceptedEffect("late-position", "J2", {}, (late,), 6.0, 3.0)
    delayed = robot.with_effect(accepted_effect)
    exported = export(robot, tmp_path, capsys, corrected)
    assert exported.report["corrections_applied"] == ["zero-offset on J3"]
    assert exported.report["effects_left_out"] == []
    expected = robot.predicted_nm(corrected)
    assert apart(expected, robot.predicted_nm()) > 1e-3
    error = moving_error(robot, exported.completed_nm(), expected)
    assert error <= SAME
    # A late position is corrected in recordings, and no model holds that.
    report = export(robot, tmp_path, capsys, delayed).report
    assert report["corrections_applied"] == []
    assert report["effects_left_out"] == ["late-position on J2"]


def test_a_coupling_that_no_rotor_has_is_listed_and_exactly_it_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Identified Ia may be less than the diagonal of its motors' r rᵀ;
    MuJoCo knows no negative armature.
    """
    cell_file = CHECKOUT / "configs/cells/kr270.yaml"
    robot = calibrated_robot(cell_file, coupling=1.5)
    exported = export(robot, tmp_path, capsys)
    listed = names_of(exported.report["not_in_mjcf"])
    couplings = [name for name in listed if not name.startswith("off")]
    assert couplings == ["Iam5", "fvm5", "Iam6", "fvm6"]
    joints = fromstring(exported.text).findall(".//*[@armature]")
    armatures = [float(joint.get("armature", "")) for joint in joints]
    assert min(armatures) >= 0.0
    found = exported.completed_nm(friction=False) + dry_nm(robot)
    assert apart(found, robot.predicted_nm()) <= SAME


def _full_parameters(robot: CalibratedRobot) -> tuple[FullParameter, ...]:
    """The true parameters and one percent more; the mass of the first link is the prior's."""
    parameters = []
    for column, value in zip(robot.model.columns, robot.standard, strict=True):
        if column.name == "m1":
            basis = "prior"
            share = 0.9
        else:
            basis = "data"
            share = 0.1
        more = 1.01 * float(value)
        parameter = FullParameter(
            name=column.name,
            value=more,
            std=0.1,
            unit=column.unit,
            basis=basis,
            prior_share=share,
            prior=None,
            prior_std=None,
        )
        parameters.append(parameter)
    return tuple(parameters)


def test_full_parameters_of_the_fit_are_written_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(daq.environment, "find_spec", lambda _: None)  # they need no solver
    robot = robot_of("kr270")
    parameters = _full_parameters(robot)
    urdf_sha256 = "a" * 64
    full = FullSet(
        urdf="arm.urdf",
        urdf_sha256=urdf_sha256,
        tolerance=0.1,
        parameters=parameters,
        gains=(),
        bounded=False,
        chi_square=1.0,
        degrees_of_freedom=1.0,
        mass_ratio=None,
        mass_ratio_std=None,
        contradictions=(),
    )
    calibration = replace(robot.calibration, full_parameters=full)
    exported = export(robot, tmp_path, capsys, calibration)
    report = exported.report
    assert report["chosen_by"] == "full_parameters of the calibration"
    assert not report["exact"]
    total = report["torque_change_percent"]["total"]
    assert total == pytest.approx(1.0, abs=1e-6)
    written = report["parameters"]
    values = [one["value"] for one in written]
    assert values == [one.value for one in parameters]
    by_prior = [one["name"] for one in written if one["basis"] == "prior"]
    assert by_prior == ["m1"]
    prior_shares = [one["prior_share"] for one in written]
    assert prior_shares == [one.prior_share for one in parameters]
    assert "By the prior, not measured: m1\n" in exported.text
    expected = 1.01 * robot.predicted_nm()
    error = moving_error(robot, exported.completed_nm(), expected)
    assert error <= SAME

    # Of another robot they are refused.
    shorter = replace(full, parameters=full.parameters[1:])
    of_another = replace(robot.calibration, full_parameters=shorter)
    calibration_file = robot.saved(tmp_path, of_another)
    out = tmp_path / "other.xml"
    command = export_command(robot.cell_file, calibration_file, out)
    assert main(command) == 4
    assert "Ixx1" in capsys.readouterr().err


def test_numbers_that_rest_on_the_prior_are_marked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of("tx40")
    exported = export(robot, tmp_path, capsys)
    parameters = exported.report["parameters"]
    basis = by_name(parameters, "basis")
    value = by_name(parameters, "value")
    # The base does not move: of its mass and most of its inertia the torque says nothing, and the
    # prior all.
    first_link = inertia_prior(robot.cell.urdf).links[0]
    prior = {"Ixx1": first_link[0], "m1": first_link[9]}
    for name, expected in prior.items():
        assert basis[name] == "prior"
        assert value[name] == pytest.approx(expected, rel=1e-4)
    share = by_name(parameters, "prior_share")
    assert share["Ixx1"] == pytest.approx(1.0)
    assert share["fs2"] == pytest.approx(0.0, abs=1e-9)
    assert basis["off2"] == "data"
    assert basis["fs2"] == "data"
    listed = re.search(r"By the prior, not measured: (.*)\n", exported.text)
    assert listed is not None
    by_prior = [name for name, one in basis.items() if one == "prior"]
    assert listed[1].split(", ") == by_prior


def test_what_a_payload_adds_to_friction_is_no_part_of_the_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf = _urdf_of("tx40")
    cell = _cell_with_description(tmp_path, "tx40", urdf, "friction_by_payload: true\n")
    robot = calibrated_robot(cell)
    columns = [column.name for column in robot.model.columns]
    assert "fs2_loaded" in columns
    more = Parameter("fs2_loaded", 0.7, 0.01, "Nm")
    parameters = (*robot.calibration.parameters, more)
    calibration = replace(robot.calibration, parameters=parameters)
    exported = export(robot, tmp_path, capsys, calibration)
    assert exported.report["exact"]
    assert "_loaded" not in json.dumps(exported.report)
    assert "_loaded" not in exported.text
    error = moving_error(robot, exported.completed_nm(), robot.predicted_nm())
    assert error <= SAME


def test_a_moving_link_called_world_has_another_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The world is MuJoCo's own body; it refuses a second one."""
    urdf = _urdf_of("tx40").replace('"link3"', '"world"')
    cell = _cell_with_description(tmp_path, "tx40", urdf)
    robot = calibrated_robot(cell)
    text = export(robot, tmp_path, capsys).text
    simulated = loaded(text)
    data = mujoco.MjData(simulated)
    mujoco.mj_kinematics(simulated, data)
    link = data.body("world link")
    assert data.site("world").xpos == pytest.approx(link.xpos)


def test_frames_of_fixed_links_are_sites(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names are those of the URDF: a program that knows the tool frame finds it."""
    tool = (
        '<link name="tool"/><joint name="mount" type="fixed"><origin xyz="0.1 0.02 0.3" rpy="0.4 '
        '-0.2 1.1"/>'
        '<parent link="link6"/><child link="tool"/></joint>'
        '<link name="flange"/><joint name="at flange" type="fixed"><parent link="link6"/><child '
        'link="flange"/></joint>'
        "</robot>"
    )
    urdf = _urdf_of("tx40").replace("</robot>", tool)
    cell = _cell_with_description(tmp_path, "tx40", urdf)
    robot = calibrated_robot(cell)
    text = export(robot, tmp_path, capsys).text
    simulated = loaded(text)
    data = mujoco.MjData(simulated)
    data.qpos[:] = robot.states.position_rad[3]
    mujoco.mj_kinematics(simulated, data)
    placed = poses(robot.model.robot, robot.states.position_rad[3:4])
    link_m = placed.origin_m[6, 0]
    tool_m = link_m + placed.rotation[6, 0] @ (0.1, 0.02, 0.3)
    link = data.body("link6")
    flange = data.site("flange")
    tool_site = data.site("tool")
    assert link.xpos == pytest.approx(link_m, abs=1e-12)
    assert flange.xpos == pytest.approx(link_m, abs=1e-12)
    assert tool_site.xpos == pytest.approx(tool_m, abs=1e-12)


def test_what_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = robot_of("kr270")
    calibration_file = robot.saved(tmp_path)
    out = tmp_path / "robot.xml"
    command = export_command(robot.cell_file, calibration_file, out)
    other_cell = CHECKOUT / "configs/cells/demo.yaml"
    of_another_cell = export_command(other_cell, calibration_file, out)
    assert main(of_another_cell) == 6
    assert "cell 'demo'" in capsys.readouterr().err
    out.write_text("<mujoco/>")
    assert main(command) == 2
    assert out.read_text() == "<mujoco/>"
    out.unlink()
    high = replace(robot.calibration.relative_error_percent, total=90.0)
    poor = replace(robot.calibration, relative_error_percent=high)
    robot.saved(tmp_path, poor)
    assert main(command) == 4
    assert "a relative error of 90 %" in capsys.readouterr().err
    robot.saved(tmp_path)

    def without_cvxpy(name: str) -> object:
        if name == "cvxpy":
            return None
        return object()

    monkeypatch.setattr(daq.environment, "find_spec", without_cvxpy)
    assert main(command) == 6
    assert "pip install 'drivegain[physical]'" in capsys.readouterr().err
    assert not out.exists()


def test_the_terminal_says_what_the_model_holds_and_an_own_file_is_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of("seven-axis")
    calibration_file = robot.saved(tmp_path)
    out = tmp_path / "robot.xml"
    command = export_command(robot.cell_file, calibration_file, out)
    assert main(command) == 0
    printed = capsys.readouterr().out
    said = " ".join(printed.split())
    assert "exactly the identified one" in said
    assert "tendon J6" in said
    assert "Not in the model: off1" in said
    first = out.read_bytes()
    assert first.startswith(b"<!-- format: drivegain-mjcf\n")
    assert main(command) == 0
    assert out.read_bytes() == first


def test_the_example_of_the_page_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = robot_of("kr270")
    export(robot, tmp_path, capsys)
    page = (CHECKOUT / "docs/how-to/simulate-in-mujoco.md").read_text()
    example = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert example is not None
    monkeypatch.chdir(tmp_path)
    exec(example[1], {})  # noqa: S102 - of this repository
    printed = capsys.readouterr().out
    torques, accelerations = printed.split("]")[:2]
    gain = robot.calibration.gains[0].value
    first_torque = float(torques.split("[")[1].split()[0])
    assert first_torque == pytest.approx(1.5 * gain, rel=1e-3)
    acceleration_words = accelerations.split("[")[1].split()
    assert len(acceleration_words) == 6


@dataclass(frozen=True, slots=True)
class StiffeningSpring(Spring):
    """τ = c q³, of a package of one's own."""

    name = "stiffening-spring"

    def columns(self, signals: Signals, axis: int) -> NDArray[np.float64]:
        cube = signals.position_rad[axis] ** 3
        return np.asarray(cube)[None]


def test_an_own_class_that_derives_from_a_spring_is_no_spring_of_the_model() -> None:
    stiffness = np.array([12.0])
    numbers = numbers_of(Spring(), stiffness)
    assert numbers is not None
    expected = [12.0, 0.0, 0.0, 0.0]
    assert numbers.tolist() == expected
    assert numbers_of(StiffeningSpring(), stiffness) is None
