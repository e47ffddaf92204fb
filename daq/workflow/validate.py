"""A calibration put to the test: what it predicts of a run, beside what was measured, under the filter of the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import Cell, model_of
from daq.errors import CalibrationUnreadable, LogsDiffer
from daq.log.conversion import load_run
from ident.calibration import Calibration, Parameter
from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.equations.rows import row_filter, row_masks
from ident.errors import DataUnfit
from ident.estimators.estimate import RelativeError, relative_error
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import Model
from ident.prediction import measured_torque, predict_torque

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class DataUse(Enum):
    """Whether a calibration has met a log, by the log's digest."""

    FIT = "seen by the fit"
    HOLDOUT = "held out"
    NEW = "not seen"


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """One run under a calibration; arrays are joint-first, decimated rows last.

    Attributes:
        log: where the run was read.
        run: its name.
        digest: of the log (sha256, hex).
        acquaintance: whether the fit has seen it.
        same_configuration: the log carries the cell configuration that the calibration was made with.
        partial: the log was salvaged from a recording that never finished.
        time_s: of each row, since the start of the run, shape (r,).
        measured_nm: V g with the calibration's gains, shape (n, r).
        predicted_nm: what the calibration says the joints need, shape (n, r).
        use: rows of each joint that count, shape (n, r).
    """

    log: Path
    run: str
    digest: str
    data_use: DataUse
    same_configuration: bool
    partial: bool
    time_s: FloatArray
    measured_nm: FloatArray
    predicted_nm: FloatArray
    use: BoolArray

    @property
    def error(self) -> RelativeError:
        """‖ρ‖/‖Y‖ of each axis and in total [%]."""
        return relative_error(self.measured_nm, self.predicted_nm, self.use)

    @property
    def rows(self) -> int:
        """Equations that count, of all joints."""
        return int(np.count_nonzero(self.use))


def validate(calibration: Calibration, logs: Sequence[Path], cell: Cell | None = None) -> tuple[Validation, ...]:
    """Predict every log with a calibration.

    Args:
        calibration: with the filter of its fit.
        logs: of the calibration's cell, at any date.
        cell: another description of the cell than the one that the logs carry.

    Raises:
        DataError, ConfigurationError: a log cannot be used.
        LogsDiffer: a log is of another cell.
        CalibrationUnreadable: the calibration does not say its filter.
        IdentificationError: the calibration cannot speak of this run: unknown mounting, effect or parameter.
    """
    conditioning = conditioning_of(calibration)
    validations: list[Validation] = []
    known: tuple[str, Model] | None = None
    for log in logs:
        run, described = load_run(log, cell)
        check_cell(calibration, log, described)
        if known is None or known[0] != described.digest:
            known = (described.digest, model_of(described))
        validations.append(predicted(calibration, conditioning, known[1], log, run, described.digest))
    return tuple(validations)


def together(validations: Sequence[Validation]) -> RelativeError:
    """‖ρ‖/‖Y‖ over the rows of several runs [%]; of the logs of the fit, it is the fit's own figure."""
    return relative_error(
        np.concatenate([validation.measured_nm for validation in validations], axis=1),
        np.concatenate([validation.predicted_nm for validation in validations], axis=1),
        np.concatenate([validation.use for validation in validations], axis=1),
    )


def conditioning_of(calibration: Calibration) -> Conditioning:
    """The filters of the fit: a relative error may be compared under the same ones only.

    Raises:
        CalibrationUnreadable: they are not all there.
    """
    expected = Conditioning().document()
    found = calibration.filter
    numbers = {name: value for name, value in found.items() if not isinstance(value, list)}
    speeds = found.get("standstill_rad_s")
    if not isinstance(speeds, list) or numbers.keys() | {"standstill_rad_s"} != expected.keys():
        raise CalibrationUnreadable(
            f"calibration of cell {calibration.cell!r}, filter",
            found=", ".join(f"{name}: {value}" for name, value in found.items()) or "nothing",
            expected=f"a list standstill_rad_s and numbers {', '.join(sorted(expected.keys() - {'standstill_rad_s'}))}",
            remedy="fit the logs again with this drivegain",
        )
    return Conditioning(
        position_cutoff_hz=numbers["position_cutoff_hz"],
        position_order=round(numbers["position_order"]),
        decimation_cutoff_hz=numbers["decimation_cutoff_hz"],
        standstill_rad_s=tuple(speeds),
        standstill_share=numbers["standstill_share"],
    )


def check_cell(calibration: Calibration, log: Path, cell: Cell) -> None:
    """Refuse a log of another cell.

    Raises:
        LogsDiffer: it is one.
    """
    axes = tuple(gain.axis for gain in calibration.gains)
    if (cell.name, cell.axis_names) != (calibration.cell, axes):
        raise LogsDiffer(
            str(log),
            found=f"cell {cell.name!r} with the axes {', '.join(cell.axis_names)}",
            expected=f"cell {calibration.cell!r} with the axes {', '.join(axes)}, as in the calibration",
            remedy="give logs of that cell, or the calibration of this one",
        )


def unpredictable(calibration: Calibration, payload: Payload | None) -> str:
    """Why a calibration says nothing of a run with this payload; empty where it does.

    Args:
        calibration: whose payload parameters are named by their mounting.
        payload: as the log has it, None without load.
    """
    if payload is None or set(payload.known) == set(LINK_PARAMETERS):
        return ""
    if "m" not in payload.known:
        return f"payload {payload.name!r} is not predicted: the log leaves its mass open"
    if not _of_mounting(calibration, payload):
        return f"payload {payload.name!r} is not predicted: nothing is known of mounting {payload.mounting!r}"
    return ""


def predicted(
    calibration: Calibration, conditioning: Conditioning, model: Model, log: Path, run: Run, configuration_sha256: str
) -> Validation:
    """One run under one calibration.

    Args:
        calibration: with gains and parameters.
        conditioning: `conditioning_of` the calibration.
        model: of the log's cell.
        log: where the run was read.
        run: of that log.
        configuration_sha256: of the cell that the log carries.

    Raises:
        IdentificationError: the calibration cannot speak of this run.
    """
    run = replace(run, payload=_left_to_the_log(calibration, run))
    data = differentiate(run, model.drive_train, conditioning)
    filter_ = row_filter(data, conditioning)
    use, _ = row_masks(model.drive_train, data, conditioning)
    if not use.any():
        raise DataUnfit(data.name, "no row is left after the standstill and validity masks; did the robot move?")
    return Validation(
        log=log,
        run=run.name,
        digest=run.digest,
        data_use=_data_use(calibration, run.digest),
        same_configuration=configuration_sha256 == calibration.configuration_sha256,
        partial=run.partial,
        time_s=data.time_s[filter_.centres(len(data.time_s))] - data.time_s[0],
        measured_nm=filter_(measured_torque(calibration, model, data.current_a).T),
        predicted_nm=filter_(predict_torque(calibration, model, data).T),
        use=use,
    )


def _left_to_the_log(calibration: Calibration, run: Run) -> Payload | None:
    """The run's payload without what the calibration itself says of it, given or identified."""
    if run.payload is None:
        return None
    own = _of_mounting(calibration, run.payload)
    mass, weighed = own.get("m"), run.payload.known.get("m")
    if mass is not None and mass.std == 0.0 and weighed is not None and weighed != mass.value:
        raise DataUnfit(
            run.name,
            f"carries {weighed:g} kg on mounting {run.payload.mounting!r}; the calibration has {mass.value:g} kg: "
            "give each way of mounting a name of its own",
        )
    return replace(run.payload, known={name: value for name, value in run.payload.known.items() if name not in own})


def _of_mounting(calibration: Calibration, payload: Payload) -> dict[str, Parameter]:
    split = ((*parameter.name.partition(":"), parameter) for parameter in calibration.parameters)
    return {name: parameter for name, _, mounting, parameter in split if mounting == payload.mounting}


def _data_use(calibration: Calibration, digest: str) -> DataUse:
    roles = {source.role for source in calibration.sources if source.sha256 == digest}
    if "fit" in roles:
        return DataUse.FIT
    return DataUse.HOLDOUT if "holdout" in roles else DataUse.NEW
