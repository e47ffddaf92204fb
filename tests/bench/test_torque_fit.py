"""The job that is timed is done right; its speed is not asserted."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pytest

from ident.model.model import DriveTrain, Model
from ident.model.robot import Motion
from ident.model.urdf import robot_from_urdf
from tests.bench import compiled_inputs, pinocchio_fit, synthetic
from tests.bench.compiled import NotCompiled, compiled
from tests.bench.motion import RATE_HZ, sinusoids
from tests.bench.synthetic import NOISE_NM, measurements
from tests.bench.torque_fit import fill_rows, fit_torques, names, standard_rows
from tests.ident.arms import ARMS, TX40, Arm

TX40_URDF = Path("configs/robots/tx40.urdf")


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_its_rows_are_those_of_the_model(arm: Arm) -> None:
    robot = robot_from_urdf(arm.urdf)
    motion = sinusoids(robot.joint_count, 1).motion(np.linspace(0.0, 10.0, 50))
    rows = standard_rows(robot, 50)
    fill_rows(robot, motion, rows)
    model = Model(robot, DriveTrain(np.eye(robot.joint_count)))
    assert tuple(column.name for column in model.columns) == names(robot.joint_count)
    assert np.array_equal(rows, model.regressor(motion))


def test_velocity_and_acceleration_are_derivatives() -> None:
    step_s = 1e-5
    time_s = np.linspace(0.0, 20.0, 30)
    course = sinusoids(3, 2)
    before, here, after = (course.motion(time_s + shift * step_s) for shift in (-1, 0, 1))
    slope = (after.position_rad - before.position_rad) / (2.0 * step_s)
    assert np.max(np.abs(slope - here.velocity_rad_s)) < 1e-7
    slope = (after.velocity_rad_s - before.velocity_rad_s) / (2.0 * step_s)
    assert np.max(np.abs(slope - here.acceleration_rad_s2)) < 1e-6


def test_a_course_does_not_depend_on_its_pieces() -> None:
    course = sinusoids(2, 3)
    pieces = list(course.pieces(1000, 300))
    assert [len(piece.position_rad) for piece in pieces] == [300, 300, 300, 100]
    joined = np.concatenate([piece.acceleration_rad_s2 for piece in pieces])
    assert np.array_equal(joined, course.motion(np.arange(1000) / RATE_HZ).acceleration_rad_s2)


def written(folder: Path) -> Path:
    """Measurements of the TX-40 as a file."""
    path = folder / "measurements.npz"
    synthetic.main(str(TX40_URDF), "6000", str(path))
    return path


def of_program(command: list[str]) -> dict[str, Any]:
    """What one of the timed programs prints."""
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout))


def test_the_loop_over_pinocchio_finds_the_same(tmp_path: Path) -> None:
    robot = robot_from_urdf(TX40_URDF.read_text())
    fit = fit_torques(robot, measurements(robot, 6000))
    data = dict(np.load(written(tmp_path)))
    parameters, residual_norm_nm = pinocchio_fit.fit(
        pinocchio.buildModelFromUrdf(str(TX40_URDF)), data
    )
    assert parameters == len(fit.values)
    assert residual_norm_nm == pytest.approx(fit.residual_norm, rel=1e-9)


@pytest.mark.processes
def test_the_compiled_program_finds_the_same(tmp_path: Path) -> None:
    robot = robot_from_urdf(TX40_URDF.read_text())
    fit = fit_torques(robot, measurements(robot, 6000))
    data = written(tmp_path)
    inputs = tmp_path / "measurements.bin", tmp_path / "joints.txt"
    compiled_inputs.main(str(data), str(TX40_URDF), str(inputs[0]), str(inputs[1]))
    folder = Path("out/bench/compiled")
    folder.mkdir(parents=True, exist_ok=True)
    try:
        program = compiled(folder)
    except NotCompiled as error:
        pytest.skip(str(error))
    found = of_program([str(program), str(inputs[0]), str(inputs[1]), "1"])
    assert found["base_parameters"] == len(fit.values)
    assert found["residual_norm_nm"] == pytest.approx(fit.residual_norm, rel=1e-9)


def test_agrees_with_dense_least_squares() -> None:
    robot = robot_from_urdf(TX40.urdf)
    pieces = list(measurements(robot, 6000))
    fit = fit_torques(robot, pieces)
    assert len(fit.values) == 58
    torque = np.concatenate([measured for _, measured in pieces], axis=1)
    motions = [motion for motion, _ in pieces]
    position_rad = np.concatenate([motion.position_rad for motion in motions])
    velocity_rad_s = np.concatenate([motion.velocity_rad_s for motion in motions])
    acceleration_rad_s2 = np.concatenate([motion.acceleration_rad_s2 for motion in motions])
    whole = Motion(position_rad, velocity_rad_s, acceleration_rad_s2)
    rows = standard_rows(robot, 6000)
    fill_rows(robot, whole, rows)
    dense = np.moveaxis(rows, 1, 2).reshape(-1, rows.shape[1])
    best = dense @ np.linalg.lstsq(dense, torque.ravel())[0]
    assert np.max(np.abs(fit.predict(rows).ravel() - best)) < 1e-8 * np.max(np.abs(best))
    assert fit.residual_norm == pytest.approx(
        float(np.linalg.norm(torque.ravel() - best)), rel=1e-10
    )
    assert fit.residual_norm / np.sqrt(torque.size) == pytest.approx(NOISE_NM, rel=0.03)
