"""A validation: relative errors of other logs, weighed payloads, pictures,
and the paper's Tables 5 to 8.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.console import RenderableType

from daq.files import replace_file
from daq.report import paper_tables
from daq.report.document import Figure, Report
from daq.report.fit import Errors
from daq.report.gains import diagnosis_texts
from daq.report.plots import plot_torques
from daq.report.svg import sheet
from daq.report.text import Sentence, percent_text, plain_table, terminal_text
from daq.workflow.fit import DOUBTFUL_PERCENT
from daq.workflow.residual_table import ResidualTable
from daq.workflow.validate import (
    CrossValidation,
    DataUse,
    Mass,
    Validation,
    WeighedRun,
    conditioning_of,
    together,
)
from ident.calibration import Calibration, PayloadMass


class ResidualTableReport(Report):
    """`export csv`."""

    calibration: str
    log: str
    table: str
    rows: int
    columns: list[str]
    relative_error_percent: Errors
    """of the rows that count, as `validate` has it"""
    partial: bool
    same_configuration: bool


def residual_table_report(
    found: ResidualTable, calibration: Path, log: Path, table: Path
) -> ResidualTableReport:
    """Return the table of predicted, measured and residual that was written."""
    validation = found.validation
    return ResidualTableReport.of(
        validation,
        calibration=calibration,
        log=log,
        table=table,
        rows=len(validation.time_s),
        columns=list(found.columns),
        relative_error_percent=validation.error,
    )


class ValidatedLog(Report):
    """Errors of one log."""

    log: str
    sha256: str
    seen_by_fit: bool
    partial: bool
    held_out: bool
    same_configuration: bool
    rows: int
    relative_error_percent: Errors
    picture: str | None


class Together(Report):
    """Errors of all logs together."""

    relative_error_percent: Errors


class CheckedLog(Report):
    """One log under every calibration."""

    log: str
    condition: Figure
    relative_error_percent: dict[str, Errors | None]
    left_out: str | None
    seen_by: list[str]


class FoundMass(Report):
    """Mass of a payload by one calibration, or why it was not found."""

    reason: str = ""
    mass_kg: Figure = None
    std_percent: Figure = None
    std_with_gains_percent: Figure = None
    error_percent: Figure = None


class CheckedPayload(Report):
    """A weighed payload."""

    log: str
    payload: str
    mounting: str
    weighed_kg: Figure
    with_bare_runs: bool
    masses: dict[str, FoundMass]


# Not the `Diagnosis` of `ident`: the name of a run is that of its file, which only a `Report` makes
# fit for JSON.
class DiagnosisEntry(Report):
    """Something wrong with a recording or a fit, and where to look."""

    name: str
    runs: list[str]
    axes: list[str]
    found: str
    expected: str
    remedy: str


class ValidateReport(Report):
    """`validate`."""

    cell: str
    axes: list[str]
    filter: dict[str, int | float | list[float]]
    fit_relative_error_percent: Errors
    payload_mass: list[PayloadMass]
    logs: list[ValidatedLog]
    together: Together | None
    calibrations: list[str]
    diagnoses: list[DiagnosisEntry]
    runs: list[CheckedLog]
    payloads: list[CheckedPayload]


def validation_view(calibration: Calibration, found: CrossValidation) -> Iterator[RenderableType]:
    """Relative errors, doubts about the logs, condition numbers and weighed payloads."""
    validations = found.validations
    headings = ("log", *(gain.axis for gain in calibration.gains), "total", "")
    table = plain_table(
        headings, title="Relative error of the torques [%]", left=(0, len(headings) - 1), wrap=(0,)
    )
    errors = [
        (validation.run, validation.error, validation.data_use.value) for validation in validations
    ]
    if len(validations) > 1:
        errors.append(("together", together(validations), ""))
    errors.append(("fit", calibration.relative_error_percent, ""))
    for name, error, use in errors:
        table.add_row(terminal_text(name), *map(percent_text, (*error.axes, error.total)), use)
    yield table
    filter_ = conditioning_of(calibration)
    yield Sentence(
        f"Position filter {filter_.position_cutoff_hz:g} Hz, decimation "
        f"{filter_.decimation_cutoff_hz:g} Hz, as in the fit. Compare relative errors only under "
        "the same filters."
    )
    yield from (Sentence(doubt, "bold") for doubt in _doubts(calibration, found))
    for paper_table in validation_tables(found, complete=False):
        yield ""
        yield from paper_table.view(numbered=False)


def _doubts(calibration: Calibration, found: CrossValidation) -> Iterator[str]:
    validations = found.validations
    names = {validation.run for validation in validations}
    for diagnosis, text in zip(found.diagnoses, diagnosis_texts(found.diagnoses), strict=True):
        # What these runs show again is theirs.
        is_of_fit = diagnosis in calibration.diagnoses and names.isdisjoint(diagnosis.runs)
        yield f"The fit of this calibration found: {text}" if is_of_fit else text
    for validation in validations:
        if not validation.same_configuration:
            yield (
                f"{validation.log} carries another cell configuration than the logs of the fit; "
                "check the difference."
            )
    for validation in validations:
        if validation.error.total > DOUBTFUL_PERCENT:
            yield (
                f"{validation.run} contradicts the calibration: it leaves "
                f"{validation.error.total:.3g} % of the torque. Was the payload mounted as the log "
                "says, and is it the same robot?"
            )
    yield from (f"{run.run}: {run.left_out}" for run in found.runs if run.left_out)


def validation_tables(found: CrossValidation, *, complete: bool) -> list[paper_tables.PaperTable]:
    """Tables 5 to 8 of the paper; unless complete, Table 6 is left out where the table of errors
    shows the same.
    """
    tables = [paper_tables.condition_table(found)]
    if complete or len(found.calibrations) > 1:
        tables.append(paper_tables.paper_error_table(found))
    return [*tables, *paper_tables.mass_tables(found)]


def draw_validations(
    calibration: Calibration, validations: tuple[Validation, ...], folder: Path
) -> dict[Path, Path]:
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
        if logs_of[validation.run] == 1:
            stem = validation.run
        else:
            stem = f"{validation.run}-{validation.digest[:8]}"
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


def validate_report(
    calibration: Calibration, found: CrossValidation, drawn: dict[Path, Path]
) -> ValidateReport:
    """Return the relative errors of a calibration, and what Tables 5 to 8 show of all calibrations.

    Args:
        calibration: the one to validate.
        found: by it, and by those compared with it.
        drawn: pictures by log.
    """
    validations = found.validations
    return ValidateReport.of(
        found,
        calibration,
        axes=[gain.axis for gain in calibration.gains],
        fit_relative_error_percent=calibration.relative_error_percent,
        logs=[
            ValidatedLog.of(
                validation,
                sha256=validation.digest,
                seen_by_fit=validation.data_use is DataUse.FIT,
                held_out=validation.data_use is DataUse.HOLDOUT,
                relative_error_percent=validation.error,
                picture=drawn.get(validation.log),
            )
            for validation in validations
        ],
        together={"relative_error_percent": together(validations)} if validations else None,
        calibrations=list(found.calibrations),
        runs=[
            CheckedLog.of(run, relative_error_percent=run.errors, left_out=run.left_out or None)
            for run in found.runs
        ],
        payloads=[
            _checked_payload(run, with_bare_runs=found.with_bare_runs) for run in found.weighed
        ],
    )


def _checked_payload(run: WeighedRun, *, with_bare_runs: bool) -> CheckedPayload:
    return CheckedPayload.of(
        run,
        run.payload,
        payload=run.payload.name,
        with_bare_runs=with_bare_runs,
        masses={label: _found_mass(mass) for label, mass in run.masses.items()},
    )


def _found_mass(mass: Mass | str) -> FoundMass:
    if isinstance(mass, str):
        return FoundMass(reason=mass)
    return FoundMass.of(mass)
