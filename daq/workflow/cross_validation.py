"""Calibrations beside each other on runs that they may never have seen (paper §4.3, Tables 5 to 8)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import Cell, model_of
from daq.errors import LogsDiffer
from daq.log.conversion import load_run
from daq.workflow.validate import DataUse, Validation, check_cell, conditioning_of, predicted, unpredictable
from ident.calibration import Calibration
from ident.data.conditioning import Conditioning
from ident.data.run import Run
from ident.equations.reduction import Reduction, reduce_runs
from ident.errors import IdentificationError
from ident.estimators.estimate import RelativeError
from ident.estimators.least_squares import wls
from ident.estimators.payload_estimate import as_one_body, joined, payload_beside_bare_runs, payload_on_known_robot
from ident.model.bodies import Payload
from ident.model.model import Model
from ident.prediction import standard_parameters

FloatArray = NDArray[np.float64]

MANUFACTURER = "manufacturer"  #: Label of the nameplate gains


@dataclass(frozen=True, slots=True)
class Mass:
    """A payload's mass found with one set of gains."""

    mass_kg: float  #: found [kg]
    std_percent: float  #: σ from the scatter of the moves, the gains taken as exact [% of the mass]
    std_with_gains_percent: float  #: the same with the σ of the gains
    error_percent: float | None  #: |found − weighed|/weighed [%], None where it was not weighed


@dataclass(frozen=True, slots=True)
class Failure:
    """Why there is no number."""

    reason: str


@dataclass(frozen=True, slots=True)
class CheckedRun:
    """One run under every calibration."""

    log: Path  #: where it was read
    run: str  #: its name
    #: Of its weighted observation matrix, None where the run alone does not show the base parameters.
    condition: float | None
    #: ‖ρ‖/‖Y‖ by label of the calibration; calibrations that cannot predict the run are not in it.
    errors: dict[str, RelativeError]
    left_out: str  #: why some of them cannot, empty where all can
    seen_by: tuple[str, ...]  #: labels of calibrations whose fit has seen it


@dataclass(frozen=True, slots=True)
class WeighedRun:
    """One loaded run, and the mass of its payload by label of the gains."""

    log: Path
    run: str
    payload: Payload
    weighed_kg: float | None
    masses: dict[str, Mass | Failure]


@dataclass(frozen=True, slots=True)
class CrossValidation:
    """All figures of the tables of §4.3."""

    axes: tuple[str, ...]  #: their names
    calibrations: dict[str, Calibration]  #: by label
    runs: tuple[CheckedRun, ...]  #: in the order of the logs
    weighed: tuple[WeighedRun, ...]  #: those with a payload
    with_bare_runs: bool  #: the payloads were found together with the robot, from runs without load
    validations: tuple[Validation, ...]  #: of the first calibration, for the runs that it can predict


def cross_validate(
    calibrations: Mapping[str, Calibration], logs: Sequence[Path], cell: Cell | None = None
) -> CrossValidation:
    """Test calibrations on logs; each log is read once.

    Args:
        calibrations: by label, made under one filter; the first one is what is being validated.
        logs: of their cell, without load or with any payload.
        cell: another description of the cell than the one that the logs carry.

    Raises:
        DataError, ConfigurationError: a log cannot be used.
        LogsDiffer: a log is of another cell, or a calibration was made under another filter.
        IdentificationError: a calibration contradicts the cell or a run.
    """
    first = next(iter(calibrations))
    conditioning = conditioning_of(calibrations[first])
    _check_filters(calibrations)
    runs, bare, loaded, validations = [], [], [], []
    for log in logs:
        run, described = load_run(log, cell)
        model = model_of(described)
        found: dict[str, Validation] = {}
        reasons: dict[str, list[str]] = {}
        for label, calibration in calibrations.items():
            check_cell(calibration, log, described)
            reason = unpredictable(calibration, run.payload)
            if reason:
                reasons.setdefault(reason, []).append(label)
            else:
                found[label] = predicted(calibration, conditioning, model, log, run, described.digest)
        if first in found:
            validations.append(found[first])
        reduction = _reduced(model, run, conditioning)
        if run.payload is not None:
            loaded.append((log, run.payload, _weighed_kg(run.payload, described), reduction))
        elif isinstance(reduction, Reduction):
            bare.append(reduction)
        runs.append(
            CheckedRun(
                log=log,
                run=run.name,
                condition=_condition(reduction, calibrations[first]),
                errors={label: validation.error for label, validation in found.items()},
                left_out="; ".join(
                    reason if len(labels) == len(calibrations) else f"{reason} ({', '.join(labels)})"
                    for reason, labels in reasons.items()
                ),
                seen_by=tuple(label for label, v in found.items() if v.data_use is DataUse.FIT),
            )
        )
    together = joined(bare) if bare else None
    weighed = [
        WeighedRun(log, log.stem, payload, kg, _masses(calibrations, together, reduction, kg))
        for log, payload, kg, reduction in loaded
    ]
    axes = tuple(gain.axis for gain in calibrations[first].gains)
    return CrossValidation(axes, dict(calibrations), tuple(runs), tuple(weighed), bool(bare), tuple(validations))


def _check_filters(calibrations: Mapping[str, Calibration]) -> None:
    (first, reference), *others = calibrations.items()
    for label, calibration in others:
        if conditioning_of(calibration) != conditioning_of(reference):
            raise LogsDiffer(
                f"calibration {label}",
                found=f"the filter {calibration.filter}",
                expected=f"that of {first}: {reference.filter}",
                remedy="a relative error can be compared under one filter only: fit both with one cell file",
            )


def _reduced(model: Model, run: Run, conditioning: Conditioning) -> Reduction | Failure:
    try:
        return reduce_runs(model, (run,), conditioning)
    except IdentificationError as error:
        return Failure(str(error))


def _condition(reduction: Reduction | Failure, calibration: Calibration) -> float | None:
    if isinstance(reduction, Failure):
        return None
    whole = as_one_body(reduction)
    try:
        return wls(whole.system(whole.base(), ()), _gains(calibration)).condition
    except IdentificationError:
        return None


def _weighed_kg(payload: Payload, cell: Cell) -> float | None:
    """Weighed mass from the log, else from the cell, since a body weighs the same anywhere."""
    of_cell = (candidate.mass_kg for candidate in cell.payloads if candidate.name == payload.name)
    return payload.known.get("m", next(of_cell, None))


def _masses(
    calibrations: Mapping[str, Calibration], bare: Reduction | None, loaded: Reduction | Failure, kg: float | None
) -> dict[str, Mass | Failure]:
    nameplate = np.array([gain.nameplate for gain in next(iter(calibrations.values())).gains])
    sets = {label: (_gains(c), np.array([gain.std for gain in c.gains])) for label, c in calibrations.items()}
    if bare is not None and not any(np.array_equal(gains, nameplate) for gains, _ in sets.values()):
        sets = {MANUFACTURER: (nameplate, np.zeros(len(nameplate))), **sets}
    masses: dict[str, Mass | Failure] = {}
    for label, (gains, std) in sets.items():
        if isinstance(loaded, Failure):
            masses[label] = loaded
            continue
        try:
            if bare is not None:
                found = payload_beside_bare_runs(bare, loaded, gains)
            else:
                robot = standard_parameters(calibrations[label], loaded.model)
                found = payload_on_known_robot(robot, loaded, gains)
        except IdentificationError as error:
            masses[label] = Failure(str(error))
            continue
        mass = found.mass_kg
        masses[label] = Mass(
            mass_kg=mass,
            std_percent=100.0 * found.mass_std_kg / abs(mass),
            std_with_gains_percent=100.0 * found.mass_std_with_gains_kg(std) / abs(mass),
            error_percent=None if kg is None else 100.0 * abs(mass - kg) / kg,
        )
    return masses


def _gains(calibration: Calibration) -> FloatArray:
    return np.array([gain.value for gain in calibration.gains])
