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
        value_of = {entry["name"]: entry["value"] for entry in self.report["not_in_mjcf"]}
        columns = self.robot.model.columns
        values = np.array([value_of.get(column.name, 0.0) for column in columns])
        return np.asarray(
            np.einsum("jck,c->jk", self.robot.model.regressor(self.robot.states), values)
        )


def export(
    robot: CalibratedRobot,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    calibration: Calibration | None = None,
) -> Exported:
    """Run the command."""
    file = robot.saved(folder, calibration)
    out = folder / "robot.xml"
    assert (
        main(["export", "mjcf", str(robot.cell_file), str(file), "--out", str(out), "--json"]) == 0
    )
    report = json.loads(capsys.readouterr().out)
    return Exported(robot, out.read_text(), report)


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
    for position, velocity, acceleration in zip(
        tree.position_rad, tree.velocity_rad_s, tree.acceleration_rad_s2, strict=True
    ):
        data.qpos[dofs] = position
        data.qvel[dofs] = velocity
        data.qacc[dofs] = acceleration
        mujoco.mj_inverse(simulated, data)
        torques.append(data.qfrc_inverse[dofs].copy())
    assert not any(warning.number for warning in data.warning)
    return robot.model.at_axes(followed, np.array(torques).T)


def is_moving(robot: CalibratedRobot) -> NDArray[np.bool_]:
    """Mask of the states in which every joint and every motor is fast enough, shape (k,)."""
    velocity = robot.states.velocity_rad_s
    motors = velocity @ robot.model.drive_train.direction.T
    joints = robot.model.follow(robot.states).joints.velocity_rad_s
    moving = [np.abs(speeds) > SLOWEST for speeds in (velocity, motors, joints)]
    stacked_moving = np.concatenate(moving, axis=1)
    return np.asarray(stacked_moving.all(axis=1))


def dry_nm(robot: CalibratedRobot) -> FloatArray:
    """True dry friction at each axis, shape (m, k)."""
    names = [column.name for column in robot.model.columns]
    is_dry = np.array([name.startswith("fs") for name in names])
    columns = robot.model.regressor(robot.states)
    return np.asarray(np.einsum("jck,c->jk", columns, np.where(is_dry, robot.standard, 0.0)))


@pytest.mark.parametrize("name", [*SERIAL, "ur10", *CLOSED])
def test_inverse_dynamics_are_the_predicted_torque_without_what_is_listed(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Offsets are all that these models lack: couplings of wrist and belt motors are tendons."""
    robot = robot_of(name)
    exported = export(robot, tmp_path, capsys)
    assert exported.report["exact"]
    assert exported.report["same_configuration"]
    assert exported.report["closures_left_out"] == []
    axis_joints = robot.model.robot.axis_joints
    axes = [joint + 1 for joint in axis_joints]
    assert [entry["name"] for entry in exported.report["not_in_mjcf"]] == [
        f"off{number}" for number in axes
    ]
    expected = robot.predicted_nm()
    smooth = apart(
        inverse_nm(exported.text, robot, friction=False) + dry_nm(robot) + exported.missing_nm,
        expected,
    )
    moving = is_moving(robot)
    assert moving.sum() >= 100
    whole = inverse_nm(exported.text, robot) + exported.missing_nm
    with_friction = apart(whole[:, moving], expected[:, moving])
    without_list = apart(inverse_nm(exported.text, robot)[:, moving], expected[:, moving])
    with capsys.disabled():
        figures = (
            f"{smooth:.1e}, with dry friction {with_friction:.1e}, without the listed "
            f"offsets {without_list:.1e}"
        )
        sys.stdout.write(f"\n  {name}: torque of MuJoCo apart from predict_torque by {figures}\n")
    assert smooth <= SAME
    assert with_friction <= SAME
    assert without_list > 1e-3


def _turn_axis(root: Element) -> None:
    joint = _found(root, ".//joint[@name='J2']")
    joint.set("axis", " ".join(repr(-float(word)) for word in joint.get("axis", "").split()))


def _swap_inertia(root: Element) -> None:
    inertial = _found(root, ".//body[@name='link5']/inertial")
    words = inertial.get("fullinertia", "").split()
    inertial.set("fullinertia", " ".join((*words[:3], words[5], words[4], words[3])))


def _shift_mass(root: Element) -> None:
    inertial = _found(root, ".//body[@name='link6']/inertial")
    inertial.set("pos", " ".join(repr(-float(word)) for word in inertial.get("pos", "").split()))


def _turn_gravity(root: Element) -> None:
    _found(root, "option").set("gravity", "0 0 9.81")


def _turn_frame(root: Element) -> None:
    """Conjugate a quaternion: the frame of the child in the parent's is taken for its inverse."""
    body = next(
        one for one in root.iter("body") if one.get("quat", "").split()[1:] != ["0.0", "0.0", "0.0"]
    )
    first, *others = body.get("quat", "").split()
    body.set("quat", " ".join((first, *(repr(-float(word)) for word in others))))


def _drop(name: str, attribute: str) -> Any:
    def change(root: Element) -> None:
        path = f".//*[@name='{name}'][@{attribute}]"
        _found(root, path).set(attribute, "0")

    return change


def _turn_tendon(root: Element) -> None:
    joint = _found(root, ".//fixed/joint")
    joint.set("coef", repr(-float(joint.get("coef", "0"))))


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
    moving = is_moving(robot)
    text = tostring(root, encoding="unicode")
    found = inverse_nm(text, robot) + exported.missing_nm
    assert apart(found[:, moving], robot.predicted_nm()[:, moving]) > 100 * SAME


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
        data.actuator(axis).ctrl = value
    mujoco.mj_forward(simulated, data)
    axes = robot.model.robot.axes
    dofs = [simulated.joint(joint.name).dofadr[0] for joint in axes]
    expected = measured_torque(robot.calibration, robot.model, current_a)[0]
    assert data.qfrc_actuator[dofs] == pytest.approx(expected, rel=1e-9)
    for entry, gain in zip(exported.report["actuators"], robot.calibration.gains, strict=True):
        assert (entry["axis"], entry["gear"], entry["unit"]) == (gain.axis, gain.value, gain.unit)


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
    largest = np.abs(robot.states.acceleration_rad_s2).max()
    moving = np.flatnonzero(is_moving(robot))
    for sample in moving[:40]:
        data.qpos[:] = robot.states.position_rad[sample]
        data.qvel[:] = robot.states.velocity_rad_s[sample]
        data.ctrl[:] = current_a[sample]
        mujoco.mj_forward(simulated, data)
        # The friction constraint is solved by iteration.
        assert data.qacc == pytest.approx(
            robot.states.acceleration_rad_s2[sample], abs=1e-4 * largest
        )


def _simulated_gap_m(simulated: Any, robot: CalibratedRobot) -> tuple[float, float]:
    """Push a closed chain by its first motor;
    return how far it moved, and how far its loops are open [m].
    """
    data = mujoco.MjData(simulated)
    mujoco.mj_resetDataKeyframe(simulated, data, 0)
    start = data.qpos.copy()
    push_nm = 0.06 * float(np.abs(robot.predicted_nm()).max())
    gain = robot.calibration.gains[0].value
    data.ctrl[0] = push_nm / gain
    for _ in range(300):
        mujoco.mj_step(simulated, data)
    assert not any(warning.number for warning in data.warning)
    joints = [simulated.joint(joint.name).qposadr[0] for joint in robot.model.robot.joints]
    position_rad = data.qpos[joints][None]
    placed = poses(robot.model.robot, position_rad)
    closures = robot.model.robot.closures
    gaps = [origin(placed, closure.first) - origin(placed, closure.second) for closure in closures]
    moved_by = data.qpos - start
    largest_motion = np.abs(moved_by).max()
    largest_absolute_gap = np.abs(gaps).max()
    return float(largest_motion), float(largest_absolute_gap)


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


def test_a_joint_that_follows_an_axis_follows_it_in_mujoco(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = CHECKOUT / "configs"
    (tmp_path / "cells").mkdir()
    (tmp_path / "robots").mkdir()
    rod = """<link name="behind"><inertial><origin xyz="0.05 0.02 0.1"/><mass value="1.5"/>
      <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/></inertial></link>
      <joint name="rod" type="revolute"><origin xyz="0 0 0.1"/>
      <parent link="link5"/><child link="behind"/>
      <axis xyz="0 1 0"/><limit lower="-9" upper="9" velocity="1" effort="1"/>
      <mimic joint="J5" multiplier="-0.5" offset="0.1"/></joint></robot>"""
    urdf = (source / "robots/tx40.urdf").read_text()
    changed_urdf = urdf.replace("</robot>", rod)
    (tmp_path / "robots/tx40.urdf").write_text(changed_urdf)
    cell = tmp_path / "cells/tx40.yaml"
    cell.write_text((source / "cells/tx40.yaml").read_text())
    robot = calibrated_robot(cell)
    exported = export(robot, tmp_path, capsys)
    moving = is_moving(robot)
    expected = robot.predicted_nm() - exported.missing_nm
    assert apart(inverse_nm(exported.text, robot)[:, moving], expected[:, moving]) < SAME
    simulated = loaded(exported.text)
    data = mujoco.MjData(simulated)
    mujoco.mj_resetDataKeyframe(simulated, data, 0)
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
    assert data.qpos[follower] == pytest.approx(0.1 - 0.5 * data.qpos[leader], abs=2e-3)


def test_a_planar_loop_closes_beside_its_plane(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rods of a five-bar pass each other: their tips are apart along the axis of the pivot."""
    source = CHECKOUT / "configs"
    (tmp_path / "cells").mkdir()
    (tmp_path / "robots").mkdir()
    urdf = (source / "robots/five-bar.urdf").read_text()
    tip = re.search(r'<joint name="tip-2" type="fixed">\s*<origin xyz="(\S+) (\S+) (\S+)"', urdf)
    assert tip is not None
    raised = tip[0].replace(f'{tip[2]} {tip[3]}"', f'{tip[2]} {float(tip[3]) + 0.03:g}"')
    changed_urdf = urdf.replace(tip[0], raised)
    (tmp_path / "robots/five-bar.urdf").write_text(changed_urdf)
    cell = tmp_path / "cells/five-bar.yaml"
    cell.write_text((source / "cells/five-bar.yaml").read_text())
    exported = export(calibrated_robot(cell), tmp_path, capsys)
    assert exported.report["closures_left_out"] == []
    simulated = loaded(exported.text)
    data = mujoco.MjData(simulated)
    mujoco.mj_resetDataKeyframe(simulated, data, 0)
    mujoco.mj_forward(simulated, data)
    absolute_efc_pos = np.abs(data.efc_pos[: data.ne])
    assert absolute_efc_pos.max() < 1e-9
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
    calibration = replace(
        calibration,
        parameters=parameters,
    )
    exported = export(robot, tmp_path, capsys, calibration)
    assert exported.report["effects_left_out"] == ["load-friction on J3"]
    assert exported.report["mountings_left_out"] == ["flange-a"]
    (listed,) = exported.report["effects_not_in_mjcf"]
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
    for entry in exported.report["not_in_mjcf"]:
        assert f"{entry['name']} = {entry['value']:.6g}" in exported.text
    moving = is_moving(robot)
    of_effect = robot.predicted_nm(calibration) - robot.predicted_nm()
    assert np.abs(of_effect).max() > 1.0
    whole = inverse_nm(exported.text, robot) + exported.missing_nm + of_effect
    assert apart(whole[:, moving], robot.predicted_nm(calibration)[:, moving]) <= SAME


def test_an_effect_that_is_not_installed_is_listed_with_its_package(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of("seven-axis")
    coefficient = Parameter("ring-friction coefficient 1", 0.1, 0.01, "Nm")
    effect = AcceptedEffect(
        "ring-friction", "J3", {}, (coefficient,), 6.1, 3.4, package="ring-effect 1.2.0"
    )
    calibration = robot.with_effect(effect)
    exported = export(robot, tmp_path, capsys, calibration)
    assert exported.report["effects_left_out"] == [
        "ring-friction on J3 (of ring-effect 1.2.0, not installed)"
    ]
    assert "Effects NOT in this model: ring-friction on J3 (of ring-effect 1.2.0" in exported.text
    (listed,) = exported.report["effects_not_in_mjcf"]
    first_coefficient = listed["coefficients"][0]
    assert (listed["package"], first_coefficient["value"]) == ("ring-effect 1.2.0", 0.1)
    assert "ring-friction on J3: ring-friction coefficient 1 = 0.1 Nm" in exported.text


def test_the_covariance_without_a_missing_effect_is_that_of_the_others() -> None:
    robot = robot_of("seven-axis")
    coefficient = Parameter("ring-friction coefficient 1", 0.1, 0.01, "Nm")
    effect = AcceptedEffect(
        "ring-friction", "J3", {}, (coefficient,), 6.1, 3.4, package="ring-effect 1.2.0"
    )
    known = robot.with_effect(effect)
    last_parameter = known.parameters[-1]
    parameters = (last_parameter, *known.parameters[:-1])
    known = replace(known, parameters=parameters)
    size = len(known.gains) + len(known.parameters)
    rng = np.random.default_rng(1)
    factor = np.tril(rng.normal(size=(size, size)))
    rows = tuple(tuple(row[: number + 1].tolist()) for number, row in enumerate(factor))
    calibration = replace(known, covariance_factor=rows)
    without, _ = split_installed(calibration)
    left = np.delete(np.arange(size), len(known.gains))
    assert without.parameters == known.parameters[1:]
    assert without.covariance is not None
    expected = (factor @ factor.T)[np.ix_(left, left)]
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


def test_springs_and_friction_of_passive_joints_are_at_their_joints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm = robot_of("seven-axis")
    coefficients = (Parameter("spring stiffness 2", 30.0, 0.1, "Nm/rad"),)
    spring = AcceptedEffect("spring", "J2", {}, coefficients, 6.0, 3.0)
    changed_coefficient = replace(spring.coefficients[0], value=-30.0)
    pushing = replace(spring, coefficients=(changed_coefficient,))
    chain = robot_of("five-bar")
    places = [joint.name for joint in chain.model.robot.places]
    elbow, other = (places.index(name) + 1 for name in ("elbow-1", "elbow-2"))
    parameter = Parameter(f"passive-friction dry {elbow}", 0.4, 0.01, "Nm")
    friction = AcceptedEffect(
        "passive-friction",
        "elbow-1",
        {},
        (
            parameter,
            Parameter(f"passive-friction viscous {elbow}", 0.2, 0.01, "Nm/(rad/s)"),
        ),
        6.0,
        3.0,
    )
    passive_spring = AcceptedEffect(
        "passive-spring",
        "elbow-2",
        {},
        (
            Parameter(f"passive-spring stiffness {other}", 5.0, 0.01, "Nm/rad"),
            Parameter(f"passive-spring preload {other}", -2.0, 0.01, "Nm"),
        ),
        6.0,
        3.0,
    )
    pivot = replace(friction, axis="pivot tip")
    number = places.index("pivot tip") + 1
    pivot = replace(
        pivot,
        coefficients=tuple(
            replace(one, name=one.name.rpartition(" ")[0] + f" {number}")
            for one in friction.coefficients
        ),
    )
    for robot, effect, is_held in (
        (arm, spring, True),
        (arm, pushing, False),
        (chain, friction, True),
        (chain, passive_spring, True),
        (chain, pivot, False),
    ):
        calibration = robot.with_effect(effect)
        exported = export(robot, tmp_path, capsys, calibration)
        name = [f"{effect.name} on {effect.axis}"]
        assert exported.report["effects_at_joints"] == (name if is_held else [])
        assert exported.report["effects_left_out"] == ([] if is_held else name)
        expected = robot.predicted_nm(calibration)
        assert apart(expected, robot.predicted_nm()) > 1e-3
        if not is_held:
            expected = robot.predicted_nm()
        moving = is_moving(robot)
        assert moving.sum() >= 100
        found = inverse_nm(exported.text, robot) + exported.missing_nm
        assert apart(found[:, moving], expected[:, moving]) <= SAME


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
    moving = is_moving(robot)
    expected = robot.predicted_nm(corrected)
    assert apart(expected, robot.predicted_nm()) > 1e-3
    found = inverse_nm(exported.text, robot) + exported.missing_nm
    assert apart(found[:, moving], expected[:, moving]) <= SAME
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
    listed = [
        entry["name"]
        for entry in exported.report["not_in_mjcf"]
        if not entry["name"].startswith("off")
    ]
    assert listed == ["Iam5", "fvm5", "Iam6", "fvm6"]
    root = fromstring(exported.text)
    amounts = [
        float(element.get("armature", "0")) for element in root.iter() if element.get("armature")
    ]
    assert min(amounts) >= 0.0
    found = inverse_nm(exported.text, robot, friction=False) + exported.missing_nm + dry_nm(robot)
    assert apart(found, robot.predicted_nm()) <= SAME


def test_full_parameters_of_the_fit_are_written_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(daq.environment, "find_spec", lambda _: None)  # they need no solver
    robot = robot_of("kr270")
    parameters = []
    for column, value in zip(robot.model.columns, robot.standard, strict=True):
        if column.name == "m1":
            basis = "prior"
            share = 0.9
        else:
            basis = "data"
            share = 0.1
        full_parameter = FullParameter(
            column.name, 1.01 * float(value), 0.1, column.unit, basis, share, None, None
        )
        parameters.append(full_parameter)
    urdf_sha256 = "a" * 64
    full = FullSet(
        "arm.urdf", urdf_sha256, 0.1, tuple(parameters), (), False, 1.0, 1.0, None, None, ()
    )
    calibration = replace(robot.calibration, full_parameters=full)
    exported = export(robot, tmp_path, capsys, calibration)
    report = exported.report
    assert report["chosen_by"] == "full_parameters of the calibration"
    assert not report["exact"]
    total = report["torque_change_percent"]["total"]
    assert total == pytest.approx(1.0, abs=1e-6)
    expected = [one.value for one in parameters]
    assert [one["value"] for one in report["parameters"]] == expected
    assert [one["name"] for one in report["parameters"] if one["basis"] == "prior"] == ["m1"]
    prior_shares = [one["prior_share"] for one in report["parameters"]]
    prior_shares_expected = [one.prior_share for one in parameters]
    assert prior_shares == prior_shares_expected
    assert "By the prior, not measured: m1\n" in exported.text
    moving = is_moving(robot)
    found = inverse_nm(exported.text, robot) + exported.missing_nm
    assert apart(found[:, moving], 1.01 * robot.predicted_nm()[:, moving]) <= SAME
    # Of another robot they are refused.
    shorter = replace(full, parameters=full.parameters[1:])
    changed_calibration = replace(robot.calibration, full_parameters=shorter)
    file = robot.saved(tmp_path, changed_calibration)
    assert (
        main(
            [
                "export",
                "mjcf",
                str(robot.cell_file),
                str(file),
                "--out",
                str(tmp_path / "other.xml"),
            ]
        )
        == 4
    )
    assert "Ixx1" in capsys.readouterr().err


def test_numbers_that_rest_on_the_prior_are_marked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of("tx40")
    exported = export(robot, tmp_path, capsys)
    basis = {one["name"]: one["basis"] for one in exported.report["parameters"]}
    value = {one["name"]: one["value"] for one in exported.report["parameters"]}
    # The base does not move: of its mass and most of its inertia the torque says nothing, and the
    # prior all.
    first_link = inertia_prior(robot.cell.urdf).links[0]
    prior = dict(zip(("Ixx1", "m1"), first_link[[0, 9]], strict=True))
    for name, expected in prior.items():
        assert basis[name] == "prior"
        assert value[name] == pytest.approx(expected, rel=1e-4)
    share = {one["name"]: one["prior_share"] for one in exported.report["parameters"]}
    assert share["Ixx1"] == pytest.approx(1.0)
    assert share["fs2"] == pytest.approx(0.0, abs=1e-9)
    assert basis["off2"] == "data"
    assert basis["fs2"] == "data"
    listed = re.search(r"By the prior, not measured: (.*)\n", exported.text)
    assert listed is not None
    assert listed[1].split(", ") == [name for name, one in basis.items() if one == "prior"]


def test_what_a_payload_adds_to_friction_is_no_part_of_the_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = CHECKOUT / "configs"
    (tmp_path / "cells").mkdir()
    (tmp_path / "robots").mkdir()
    content = (source / "robots/tx40.urdf").read_bytes()
    (tmp_path / "robots/tx40.urdf").write_bytes(content)
    cell = tmp_path / "cells/tx40.yaml"
    text = (source / "cells/tx40.yaml").read_text()
    cell.write_text(text + "friction_by_payload: true\n")
    robot = calibrated_robot(cell)
    assert "fs2_loaded" in [column.name for column in robot.model.columns]
    more = Parameter("fs2_loaded", 0.7, 0.01, "Nm")
    parameters = (*robot.calibration.parameters, more)
    calibration = replace(robot.calibration, parameters=parameters)
    exported = export(robot, tmp_path, capsys, calibration)
    assert exported.report["exact"]
    assert "_loaded" not in json.dumps(exported.report)
    assert "_loaded" not in exported.text
    moving = is_moving(robot)
    found = inverse_nm(exported.text, robot) + exported.missing_nm
    assert apart(found[:, moving], robot.predicted_nm()[:, moving]) <= SAME


def _tx40_of(folder: Path, urdf: str) -> CalibratedRobot:
    """The TX-40's cell beside another description of the robot."""
    (folder / "cells").mkdir()
    (folder / "robots").mkdir()
    (folder / "robots/tx40.urdf").write_text(urdf)
    cell = folder / "cells/tx40.yaml"
    cell.write_text((CHECKOUT / "configs/cells/tx40.yaml").read_text())
    return calibrated_robot(cell)


def test_a_moving_link_called_world_has_another_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The world is MuJoCo's own body; it refuses a second one."""
    text = (CHECKOUT / "configs/robots/tx40.urdf").read_text()
    urdf = text.replace('"link3"', '"world"')
    robot = _tx40_of(tmp_path, urdf)
    simulated = loaded(export(robot, tmp_path, capsys).text)
    data = mujoco.MjData(simulated)
    mujoco.mj_kinematics(simulated, data)
    assert data.site("world").xpos == pytest.approx(data.body("world link").xpos)


def test_frames_of_fixed_links_are_sites(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names are those of the URDF: a program that knows the tool frame finds it."""
    urdf = (CHECKOUT / "configs/robots/tx40.urdf").read_text()
    tool = (
        '<link name="tool"/><joint name="mount" type="fixed"><origin xyz="0.1 0.02 0.3" rpy="0.4 '
        '-0.2 1.1"/>'
        '<parent link="link6"/><child link="tool"/></joint>'
        '<link name="flange"/><joint name="at flange" type="fixed"><parent link="link6"/><child '
        'link="flange"/></joint>'
        "</robot>"
    )
    changed_urdf = urdf.replace("</robot>", tool)
    robot = _tx40_of(tmp_path, changed_urdf)
    text = export(robot, tmp_path, capsys).text
    simulated = loaded(text)
    data = mujoco.MjData(simulated)
    data.qpos[:] = robot.states.position_rad[3]
    mujoco.mj_kinematics(simulated, data)
    placed = poses(robot.model.robot, robot.states.position_rad[3:4])
    at_link = placed.rotation[6, 0]
    xpos = data.body("link6").xpos
    assert xpos == pytest.approx(placed.origin_m[6, 0], abs=1e-12)
    assert data.site("flange").xpos == pytest.approx(placed.origin_m[6, 0], abs=1e-12)
    assert data.site("tool").xpos == pytest.approx(
        placed.origin_m[6, 0] + at_link @ (0.1, 0.02, 0.3), abs=1e-12
    )


def test_what_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = robot_of("kr270")
    file = robot.saved(tmp_path)
    out = tmp_path / "robot.xml"
    command = ["export", "mjcf", str(robot.cell_file), str(file), "--out", str(out)]
    assert main(["export", "mjcf", str(CHECKOUT / "configs/cells/demo.yaml"), *command[3:]]) == 6
    assert "cell 'demo'" in capsys.readouterr().err
    out.write_text("<mujoco/>")
    assert main(command) == 2
    assert out.read_text() == "<mujoco/>"
    out.unlink()
    relative_error_percent = replace(robot.calibration.relative_error_percent, total=90.0)
    poor = replace(
        robot.calibration,
        relative_error_percent=relative_error_percent,
    )
    robot.saved(tmp_path, poor)
    assert main(command) == 4
    assert "a relative error of 90 %" in capsys.readouterr().err
    robot.saved(tmp_path)
    monkeypatch.setattr(
        daq.environment, "find_spec", lambda name: None if name == "cvxpy" else object()
    )
    assert main(command) == 6
    assert "pip install 'drivegain[physical]'" in capsys.readouterr().err
    assert not out.exists()


def test_the_terminal_says_what_the_model_holds_and_an_own_file_is_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = robot_of("seven-axis")
    file = robot.saved(tmp_path)
    out = tmp_path / "robot.xml"
    command = ["export", "mjcf", str(robot.cell_file), str(file), "--out", str(out)]
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
    assert float(torques.split("[")[1].split()[0]) == pytest.approx(1.5 * gain, rel=1e-3)
    assert len(accelerations.split("[")[1].split()) == 6


@dataclass(frozen=True, slots=True)
class StiffeningSpring(Spring):
    """τ = c q³, of a package of one's own."""

    name = "stiffening-spring"

    def columns(self, signals: Signals, axis: int) -> NDArray[np.float64]:
        return np.asarray(signals.position_rad[axis] ** 3)[None]


def test_an_own_class_that_derives_from_a_spring_is_no_spring_of_the_model() -> None:
    stiffness = np.array([12.0])
    numbers = numbers_of(Spring(), stiffness)
    assert numbers is not None
    expected = [12.0, 0.0, 0.0, 0.0]
    assert numbers.tolist() == expected
    assert numbers_of(StiffeningSpring(), stiffness) is None
