"""A validation: relative errors of other logs, weighed payloads, pictures, and the paper's Tables 5 to 8."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import RenderableType

from daq.files import replace_file
from daq.report import paper_tables
from daq.report.fit import errors_of
from daq.report.fit_schemas import (
    CheckedLog,
    CheckedPayload,
    DiagnosisEntry,
    FoundMass,
    Together,
    ValidatedLog,
    ValidateReport,
)
from daq.report.gains import diagnosis_texts
from daq.report.plots import plot_torques
from daq.report.svg import sheet
from daq.report.text import Sentence, percent_text, plain_table, terminal_text
from daq.workflow.fit import DOUBTFUL_PERCENT
from daq.workflow.validate import (
    CheckedRun,
    CrossValidation,
    DataUse,
    Mass,
    Validation,
    WeighedRun,
    conditioning_of,
    together,
)
from ident.calibration import Calibration
from ident.errors import Diagnosis


def validation_view(calibration: Calibration, found: CrossValidation) -> Iterator[RenderableType]:
    """Relative errors, doubts about the logs, condition numbers and weighed payloads."""
    validations = found.validations
    headings = ("log", *(gain.axis for gain in calibration.gains), "total", "")
    table = plain_table(headings, title="Relative error ‖ρ‖/‖Y‖ [%]", left=(0, len(headings) - 1), wrap=(0,))
    errors = [(validation.run, validation.error, validation.data_use.value) for validation in validations]
    errors += [("together", together(validations), "")] if len(validations) > 1 else []
    for name, error, use in (*errors, ("fit", calibration.relative_error_percent, "")):
        table.add_row(terminal_text(name), *map(percent_text, (*error.axes, error.total)), use)
    yield table
    filter_ = conditioning_of(calibration)
    yield Sentence(
        f"Position filter {filter_.position_cutoff_hz:g} Hz, decimation {filter_.decimation_cutoff_hz:g} Hz, as in the "
        "fit. Compare relative errors only under the same filters."
    )
    doubts: list[str] = []
    names = {validation.run for validation in validations}
    for diagnosis, text in zip(found.diagnoses, diagnosis_texts(found.diagnoses), strict=True):
        # What these runs show again is theirs.
        is_of_fit = diagnosis in calibration.diagnoses and names.isdisjoint(diagnosis.runs)
        doubts.append(f"The fit of this calibration found: {text}" if is_of_fit else text)
    doubts += [
        f"{validation.log} carries another cell configuration than the logs of the fit; check the difference."
        for validation in validations
        if not validation.same_configuration
    ]
    doubts += [
        f"{validation.run} contradicts the calibration: it leaves {validation.error.total:.3g} % of the torque. "
        "Was the payload mounted as the log says, and is it the same robot?"
        for validation in validations
        if validation.error.total > DOUBTFUL_PERCENT
    ]
    doubts += [f"{run.run}: {run.left_out}" for run in found.runs if run.left_out]
    yield from (Sentence(doubt, "bold") for doubt in doubts)
    for paper_table in validation_tables(found, complete=False):
        yield ""
        yield from paper_table.view(numbered=False)


def validation_tables(found: CrossValidation, *, complete: bool) -> list[paper_tables.PaperTable]:
    """Tables 5 to 8 of the paper; unless complete, Table 6 is left out where the table of errors shows the same."""
    return [
        paper_tables.condition_table(found),
        *([paper_tables.paper_error_table(found)] if complete or len(found.calibrations) > 1 else []),
        *paper_tables.mass_tables(found),
    ]


def draw_validations(calibration: Calibration, validations: tuple[Validation, ...], folder: Path) -> dict[Path, Path]:
    """Draw each log as the paper's Fig. 2; return the pictures by log.

    Raises:
        OSError: from the file system.
    """
    axes = tuple(gain.axis for gain in calibration.gains)
    forces = tuple("N" if gain.unit.startswith("N/") else "Nm" for gain in calibration.gains)
    logs_of = Counter(validation.run for validation in validations)
    pictures = {}
    for validation in validations:
        # Logs in different folders may have the same name.
        stem = validation.run if logs_of[validation.run] == 1 else f"{validation.run}-{validation.digest[:8]}"
        path = folder / f"{stem}.svg"
        measured_nm, predicted_nm = (
            np.where(validation.use, torque_nm, np.nan).T
            for torque_nm in (validation.measured_nm, validation.predicted_nm)
        )
        title = f"{validation.run}, {validation.data_use.value}: torque of {calibration.cell}"
        folder.mkdir(parents=True, exist_ok=True)
        drawn = plot_torques(validation.time_s, measured_nm, predicted_nm, axes, forces=forces)
        replace_file(path, sheet(drawn, title))
        pictures[validation.log] = path
    return pictures


def validate_report(calibration: Calibration, found: CrossValidation, drawn: dict[Path, Path]) -> ValidateReport:
    """Return the relative errors of a calibration, and what Tables 5 to 8 show of all calibrations.

    Args:
        calibration: the one to validate.
        found: by it, and by those beside it.
        drawn: pictures by log.
    """
    validations = found.validations
    return ValidateReport(
        cell=calibration.cell,
        axes=[gain.axis for gain in calibration.gains],
        filter=calibration.filter,
        fit_relative_error_percent=errors_of(calibration.relative_error_percent),
        payload_mass=list(calibration.payload_mass),
        logs=[_validated_log(validation, drawn.get(validation.log)) for validation in validations],
        together=Together(relative_error_percent=errors_of(together(validations))) if validations else None,
        calibrations=list(found.calibrations),
        diagnoses=[_diagnosis(one) for one in found.diagnoses],
        runs=[_checked_log(run) for run in found.runs],
        payloads=[_checked_payload(run, with_bare_runs=found.with_bare_runs) for run in found.weighed],
    )


def _validated_log(validation: Validation, picture: Path | None) -> ValidatedLog:
    return ValidatedLog(
        log=str(validation.log),
        sha256=validation.digest,
        seen_by_fit=validation.data_use is DataUse.FIT,
        partial=validation.partial,
        held_out=validation.data_use is DataUse.HOLDOUT,
        same_configuration=validation.same_configuration,
        rows=validation.rows,
        relative_error_percent=errors_of(validation.error),
        picture=None if picture is None else str(picture),
    )


def _diagnosis(one: Diagnosis) -> DiagnosisEntry:
    return DiagnosisEntry(
        name=one.name,
        runs=list(one.runs),
        axes=list(one.axes),
        found=one.found,
        expected=one.expected,
        remedy=one.remedy,
    )


def _checked_log(run: CheckedRun) -> CheckedLog:
    return CheckedLog(
        log=str(run.log),
        condition=run.condition,
        relative_error_percent={label: errors_of(error) for label, error in run.errors.items()},
        left_out=run.left_out or None,
        seen_by=list(run.seen_by),
    )


def _checked_payload(run: WeighedRun, *, with_bare_runs: bool) -> CheckedPayload:
    return CheckedPayload(
        log=str(run.log),
        payload=run.payload.name,
        mounting=run.payload.mounting,
        weighed_kg=run.weighed_kg,
        with_bare_runs=with_bare_runs,
        masses={label: _found_mass(mass) for label, mass in run.masses.items()},
    )


def _found_mass(mass: Mass | str) -> FoundMass:
    if isinstance(mass, str):
        return FoundMass(reason=mass)
    return FoundMass(
        mass_kg=mass.mass_kg,
        std_percent=mass.std_percent,
        std_with_gains_percent=mass.std_with_gains_percent,
        error_percent=mass.error_percent,
    )
