"""Pinocchio reads the exported URDF and MJCF:
torques with its own dynamics are those that the calibration predicts.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from daq.cli.app import main
from ident.model.robot import Motion
from tests.daq.robot_calibrations import CalibratedRobot, apart, robot_of

FloatArray = NDArray[np.float64]
SAME = 1e-6  #: ‖Δτ‖/‖τ‖


def _export(
    kind: str, robot: CalibratedRobot, folder: Path, capsys: pytest.CaptureFixture[str]
) -> tuple[Path, dict[str, Any]]:
    out = folder / f"robot.{kind}"
    file = robot.saved(folder)
    assert main(["export", kind, str(robot.cell_file), str(file), "--out", str(out), "--json"]) == 0
    return out, json.loads(capsys.readouterr().out)


def _rigid_nm(model: Any, robot: CalibratedRobot, tree: Motion) -> FloatArray:
    """Torque of the links at each joint of the tree, by Pinocchio's recursive Newton-Euler
    algorithm, shape (n, k).
    """
    model.gravity.linear = robot.model.robot.gravity_m_s2
    model.armature = np.zeros(model.nv)
    data = model.createData()
    joints = robot.model.robot.joints
    ids = [model.getJointId(joint.name) for joint in joints]
    places = [model.joints[number].idx_v for number in ids]
    torques = []
    for position, velocity, acceleration in zip(
        tree.position_rad, tree.velocity_rad_s, tree.acceleration_rad_s2, strict=True
    ):
        q = pin.neutral(model)
        v = np.zeros(model.nv)
        a = np.zeros(model.nv)
        for number, angle in zip(ids, position, strict=True):
            joint = model.joints[number]
            # A joint without limits has cosine and sine of its angle.
            if joint.nq == 1:
                own = [angle]
            else:
                own = [np.cos(angle), np.sin(angle)]
            q[joint.idx_q : joint.idx_q + joint.nq] = own
        v[places] = velocity
        a[places] = acceleration
        torques.append(np.array(pin.rnea(model, data, q, v, a))[places])
    return np.array(torques).T


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["kr270", "seven-axis", "gantry", "ur10", "five-bar", "orthoglide", "dualv"]
)
def test_the_urdf_has_the_predicted_torque_without_what_is_listed(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Damping and friction are those of the file;
    rotors, offsets and couplings those of the list.
    """
    robot = robot_of(name)
    out, report = _export("urdf", robot, tmp_path, capsys)
    assert report["exact"]
    closures = robot.model.robot.closures
    expected = [closure.name for closure in closures]
    assert report["closures_left_out"] == expected
    value_of = {entry["name"]: entry["value"] for entry in report["not_in_urdf"]}
    for number, joint in enumerate(report["joints"], start=1):
        value_of[f"fv{number}"] = joint["damping"]
        value_of[f"fs{number}"] = joint["friction"]
    drive = np.array([value_of.get(column.name, 0.0) for column in robot.model.columns])
    of_drives = np.einsum("jck,c->jk", robot.model.regressor(robot.states), drive)
    followed = robot.model.follow(robot.states)
    model = pin.buildModelFromUrdf(str(out))
    rigid = _rigid_nm(model, robot, followed.joints)
    found = robot.model.at_axes(followed, rigid) + of_drives
    difference = apart(found, robot.predicted_nm())
    with capsys.disabled():
        sys.stdout.write(
            f"\n  {name}: torque of Pinocchio apart from predict_torque by {difference:.1e}\n"
        )
    assert difference <= SAME


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tx40", "kr270", "seven-axis", "ur10"])
def test_the_mjcf_of_a_serial_robot_has_the_same_bodies_and_joints(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pinocchio knows no tendons: what is along them is added by the list of actuators."""
    robot = robot_of(name)
    out, report = _export("mjcf", robot, tmp_path, capsys)
    model = pin.buildModelFromMJCF(str(out))
    places = [
        model.joints[model.getJointId(joint.name)].idx_v for joint in robot.model.robot.joints
    ]
    armature = np.array(model.armature)[places, None]
    damping = np.array(model.damping)[places, None]
    upperDryFrictionLimit = np.array(model.upperDryFrictionLimit)
    friction = upperDryFrictionLimit[places, None]
    velocity = robot.states.velocity_rad_s.T
    acceleration = robot.states.acceleration_rad_s2.T
    found = _rigid_nm(model, robot, robot.states)
    found += armature * acceleration + damping * velocity + friction * np.sign(velocity)
    direction = robot.model.drive_train.direction
    for r, actuator in zip(direction, report["actuators"], strict=True):
        along = actuator["armature"] * (r @ acceleration) + actuator["damping"] * (r @ velocity)
        found += np.outer(r, along + actuator["friction"] * np.sign(r @ velocity))
    missing = {entry["name"]: entry["value"] for entry in report["not_in_mjcf"]}
    left = np.array([missing.get(column.name, 0.0) for column in robot.model.columns])
    found += np.einsum("jck,c->jk", robot.model.regressor(robot.states), left)
    assert apart(found, robot.predicted_nm()) <= SAME
