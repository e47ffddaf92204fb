"""Predicted, measured and residual of a log, row by row, as a table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from daq.config.cell import Cell
from daq.log.conversion import load_run
from daq.log.export import Columns, column_names, current_unit
from daq.workflow.validate import (
    Corrections,
    Validation,
    check_cell,
    conditioning_of,
    predicted,
    warn_without_temperature,
)
from ident.calibration import Calibration
from ident.model.model import DriveTrain


@dataclass(frozen=True, slots=True, eq=False)
class ResidualTable:
    """One log under a calibration."""

    validation: Validation
    #: By name. Of each axis: torque of its joint [Nm; N], current reference of its motor, whether
    #: the row counts.
    columns: Columns


def residual_table(calibration: Calibration, log: Path, cell: Cell | None = None) -> ResidualTable:
    """Predict a log with a calibration, in the rows of its fit: filtered and decimated.

    A current is that of the torques of all joints through the drive train, v = (T τ)/g. Internal
    preload of a redundant drive is in none of them.

    Args:
        calibration: with the filter of its fit.
        log: of the calibration's cell.
        cell: corrected description of the same cell, which replaces the one in the log.

    Raises:
        DataError, ConfigurationError: the log cannot be used.
        LogsDiffer: it is of another cell.
        CalibrationUnreadable: the calibration does not say its filter.
        IdentificationError: the calibration cannot speak of this run.
    """
    conditioning_of(calibration)  # refuses a calibration without a filter before the log is read
    run, described = load_run(log, cell)
    Corrections().note(log, run)
    check_cell(calibration, log, described)
    warn_without_temperature(calibration, run.name, run.temperature_c)
    found = predicted(calibration, described, log, run)
    gains = np.array([gain.value for gain in calibration.gains])
    to_current = DriveTrain(described.ratio).to_motor / gains[:, None]
    measured_a = to_current @ found.measured_nm
    predicted_a = to_current @ found.predicted_nm
    columns: Columns = {"time_s": found.time_s}
    residual_nm = found.measured_nm - found.predicted_nm
    residual_a = measured_a - predicted_a
    names = column_names(described)
    for index, axis in enumerate(described.axes):
        name = names[index]
        force = axis.unit.force
        torque = "torque" if force == "Nm" else "force"
        current = current_unit(axis)
        columns[f"{name}.{torque}_predicted_{force}"] = found.predicted_nm[index]
        columns[f"{name}.{torque}_measured_{force}"] = found.measured_nm[index]
        columns[f"{name}.{torque}_residual_{force}"] = residual_nm[index]
        columns[f"{name}.current_predicted_{current}"] = predicted_a[index]
        columns[f"{name}.current_measured_{current}"] = measured_a[index]
        columns[f"{name}.current_residual_{current}"] = residual_a[index]
        columns[f"{name}.counts"] = found.use[index].astype(np.uint8)
    return ResidualTable(found, columns)
