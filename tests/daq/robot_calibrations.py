"""Calibrations of robots with known bodies, rotors and friction,
for models that have to give the same torques.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import save_calibration
from daq.workflow.urdf_export import cell_limits, random_states
from ident.arrays import FloatArray
from ident.calibration import AcceptedEffect, Calibration, Gain, Parameter
from ident.data.dataset import planned
from ident.estimators.estimate import RelativeError
from ident.model.base import base_parameters
from ident.model.bodies import Body
from ident.model.model import JOINT_COLUMNS, Model
from ident.model.robot import Motion
from ident.physical.physical import inertia_prior
from ident.prediction import predict_torque
from tests.conftest import CHECKOUT

RATE_HZ = 250.0


@dataclass(frozen=True)
class CalibratedRobot:
    """A cell, a calibration of it, and what is behind it."""

    cell_file: Path
    cell: Cell
    model: Model
    standard: FloatArray  #: true standard parameters, shape (c,)
    calibration: Calibration
    states: Motion  #: random states of the axes within their limits, arrays of shape (k, m)

    def predicted_nm(self, calibration: Calibration | None = None) -> FloatArray:
        """Torque of each axis that a calibration predicts for the states, shape (m, k)."""
        data = planned(self.states, RATE_HZ)
        return predict_torque(calibration or self.calibration, self.model, data).T

    def saved(self, folder: Path, calibration: Calibration | None = None) -> Path:
        """Write a calibration of the robot, and return its file."""
        path = folder / "calibration.yaml"
        save_calibration(calibration or self.calibration, path)
        return path

    def with_effect(self, effect: AcceptedEffect) -> Calibration:
        """Return the calibration with an effect."""
        parameters = (*self.calibration.parameters, *effect.coefficients)
        return replace(self.calibration, parameters=parameters, effects=(effect,))


@cache
def robot_of(name: str) -> CalibratedRobot:
    """The robot of a shipped cell, or that of a recording beside the checkout."""
    path = CHECKOUT / "configs/cells" / f"{name}.yaml"
    if name == "ur10":
        data_folder = CHECKOUT.parent / "shared/data"
        data = Path(os.environ.get("DRIVEGAIN_DATA", data_folder))
        path = data / "ur10/ur10-cell.yaml"
        if not path.exists():
            pytest.skip(
                f"no description of the UR10 at {path}; DRIVEGAIN_DATA names the folder "
                "that holds ur10/"
            )
    return calibrated_robot(path)


def apart(found: FloatArray, expected: FloatArray) -> float:
    """‖found − expected‖/‖expected‖ of the worst axis."""
    difference_norm = np.linalg.norm(found - expected, axis=1)
    expected_norm = np.linalg.norm(expected, axis=1)
    return float((difference_norm / expected_norm).max())


def calibrated_robot(cell_file: Path, seed: int = 4, coupling: float = 0.2) -> CalibratedRobot:
    """Make a robot with other bodies than those of its URDF, and the calibration of a perfect fit.

    Args:
        cell_file: of the cell.
        seed: of bodies, rotors and friction.
        coupling: Iam and fvm of motors that turn with several joints, as a share of the least Ia
            and fv.
    """
    cell = load_cell(cell_file)
    model = model_of(cell)
    standard = _standard_of(cell, model, seed, coupling)
    states = random_states(model, cell_limits(cell))
    columns = model.regressor(states).transpose(0, 2, 1).reshape(-1, len(standard))
    names = tuple(column.name for column in model.columns)
    triangle = np.asarray(np.linalg.qr(columns, mode="r"))
    base = base_parameters(triangle, names)
    gains = tuple(
        Gain(axis.name, 1.03 * axis.nameplate_gain, 0.01, axis.gain_unit, axis.nameplate_gain)
        for axis in cell.axes
    )
    parameters = tuple(
        Parameter(name, float(value), 0.01 * abs(float(value)) + 1e-3, "kg m²")
        for name, value in zip(base.names, base.grouping @ standard, strict=True)
    )
    axes = (3.0,) * len(gains)
    relative_error_percent = RelativeError(axes, 3.0)
    calibration = Calibration(
        cell=cell.name,
        method="ml",
        gains=gains,
        parameters=parameters,
        effects=(),
        relative_error_percent=relative_error_percent,
        holdout_error_percent=None,
        condition=800.0,
        rows=1000,
        filter={"position_cutoff_hz": 40.0},
        sources=(),
        configuration_sha256=cell.digest,
        created="2025-01-02T03:04:05+00:00",
        software="drivegain 0.1.0",
        passive_joints=model.robot.undriven_names,
    )
    return CalibratedRobot(cell_file, cell, model, standard, calibration, states)


def _standard_of(cell: Cell, model: Model, seed: int, coupling: float) -> FloatArray:
    rng = np.random.default_rng(seed)
    standard = np.zeros(len(model.columns))
    links = inertia_prior(cell.urdf).links
    for columns, link in zip(model.link_columns, links, strict=True):
        # A tenth of the link's mass more, somewhere in it.
        more_kg = 0.1 * float(link[9])
        centre_m = rng.uniform(-0.1, 0.1, 3)
        inertia_kg_m2 = 0.01 * more_kg * np.eye(3)
        more = Body(more_kg, centre_m, inertia_kg_m2)
        standard[columns] = link + more.parameters
    # Inertias, dampers and dry friction that matter beside the links, each axis its own.
    motion = random_states(model, cell_limits(cell))
    least = np.abs(model.regressor(motion)).max(axis=2)
    largest_nm = (least @ np.abs(standard)).max()
    count = model.robot.axis_count
    speeds = cell_limits(cell)[2:]
    for column, size in (
        (model.rotor_columns, 0.1 * largest_nm / speeds[1]),
        (model.viscous_friction_columns, 0.1 * largest_nm / speeds[0]),
        (model.dry_friction_columns, np.full(count, 0.02 * largest_nm)),
    ):
        standard[column] = size * rng.uniform(0.5, 1.0, count)
    axis_joints = np.array(model.robot.axis_joints)
    offsets = JOINT_COLUMNS * axis_joints + JOINT_COLUMNS - 1
    standard[offsets] = 0.02 * largest_nm * rng.uniform(-1.0, 1.0, count)
    first = JOINT_COLUMNS * model.robot.joint_count
    for number, motor in enumerate(model.drive_train.coupled):
        turned = np.flatnonzero(model.drive_train.direction[motor])
        for place, columns in enumerate(
            (model.rotor_columns, model.viscous_friction_columns, model.dry_friction_columns)
        ):
            smallest_standard = float(standard[columns][turned].min())
            standard[first + 3 * number + place] = coupling * smallest_standard
    return standard
