"""`drivegain validate`: what a calibration predicts of logs that it may never have seen, alone or beside others."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from daq.cli.fit import CellOption
from daq.cli.terminal import check_output, say_written, status
from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.config.cell_file import load_cell
from daq.errors import CalibrationMissing, OutputFailed
from daq.files import replace_file
from daq.report.fit import plot_torques
from daq.report.paper_tables import PaperTable, condition_table, mass_tables, page
from daq.report.paper_tables import error_table as paper_error_table
from daq.workflow.calibration_file import load
from daq.workflow.cross_validation import CheckedRun, CrossValidation, Failure, WeighedRun, cross_validate
from daq.workflow.fit import DOUBTFUL_PERCENT
from daq.workflow.validate import DataUse, Validation, conditioning_of, together
from ident.calibration import Calibration
from ident.estimators.estimate import RelativeError

TABLES = "drivegain-validation-tables"
"""What a page of tables says it is."""


def validate_verb(
    calibration: Annotated[Path, typer.Argument(help="calibration.yaml of `drivegain fit`.")],
    logs: Annotated[list[Path], typer.Argument(help="Logs of the same cell.")],
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for a picture of each log: measured and predicted torque.")
    ] = None,
    beside: Annotated[
        list[Path] | None,
        typer.Option(help="Another calibration, or a folder of them (`fit --cases`), to compare with; repeatable."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the paper's Tables 5 to 8 (tables.md).")] = None,
    cell: CellOption = None,
    json: JsonOption = False,
) -> None:
    """Predict the torque of runs with a calibration and weigh their payload with its gains.

    Prints the relative error of each axis, the condition number of each run (paper, Table 5) and the payload mass that
    the gains give (Tables 7, 8), with --beside every calibration side by side (Table 6 too). Logs without load among
    the others make the weighing independent of the calibration's robot parameters.
    """
    page_file = None if out is None else out / "tables.md"
    check_output(page_file, (calibration, *logs), TABLES)
    with status("predicting"):
        calibrations = load_beside(calibration, beside or [])
        known = next(iter(calibrations.values()))
        found = cross_validate(calibrations, logs, None if cell is None else load_cell(cell))
        drawn = {} if pictures is None else draw(known, found.validations, pictures)
    if page_file is not None:
        write_tables(page_file, f"Validation of {known.cell}", tables_of(found, all_of_them=True))
    if json:
        print_json({**report(known, found.validations, drawn), **cross_report(found)})
    else:
        show(known, found, drawn, page_file, Console(soft_wrap=True, highlight=False))


def load_beside(calibration: Path, beside: list[Path]) -> dict[str, Calibration]:
    """Calibrations by label, the one to validate first; a file that is named twice counts once.

    Raises:
        CalibrationMissing: a folder holds none.
        CalibrationUnreadable, CalibrationRefused: a file is none, or was changed by hand.
    """
    files = [calibration]
    for place in beside:
        found = sorted(place.glob("*.yaml")) if place.is_dir() else [place]
        if not found:
            raise CalibrationMissing(
                str(place),
                found="no .yaml file in it",
                expected="calibrations, as `drivegain fit --cases` leaves them",
                remedy="name another folder",
            )
        files += [file for file in found if not any(_same(file, other) for other in files)]
    stems = Counter(file.stem for file in files)
    return {file.stem if stems[file.stem] == 1 else str(file): load(file) for file in files}


def _same(one: Path, other: Path) -> bool:
    return one.resolve() == other.resolve()


def tables_of(found: CrossValidation, *, all_of_them: bool) -> list[PaperTable]:
    """The paper's tables; Table 6 is left out where the table of errors says the same."""
    whole = all_of_them or len(found.calibrations) > 1
    return [condition_table(found), *([paper_error_table(found)] if whole else []), *mass_tables(found)]


def write_tables(path: Path, title: str, tables: list[PaperTable]) -> None:
    """A page of them.

    Raises:
        OutputFailed: the file system refuses.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, page(title, tables, marker=TABLES).encode())
    except OSError as error:
        raise OutputFailed.of(path, error) from error


def draw(calibration: Calibration, validations: tuple[Validation, ...], folder: Path) -> dict[Path, Path]:
    """A picture of each log, as the paper's Fig. 2; where each was put, by log.

    Raises:
        OutputFailed: the file system refuses.
    """
    axes = tuple(gain.axis for gain in calibration.gains)
    forces = tuple("N" if gain.unit.startswith("N/") else "Nm" for gain in calibration.gains)
    logs_of = Counter(validation.run for validation in validations)
    drawn = {}
    for validation in validations:
        # Folders of two days may hold runs of one name.
        stem = validation.run if logs_of[validation.run] == 1 else f"{validation.run}-{validation.digest[:8]}"
        path = folder / f"{stem}.png"
        measured_nm, predicted_nm = (
            np.where(validation.use, torque_nm, np.nan).T
            for torque_nm in (validation.measured_nm, validation.predicted_nm)
        )
        title = f"{validation.run}, {validation.data_use.value}: torque of {calibration.cell}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            plot_torques(path, validation.time_s, measured_nm, predicted_nm, axes, title=title, forces=forces)
        except OSError as error:
            raise OutputFailed.of(path, error) from error
        drawn[validation.log] = path
    return drawn


def report(calibration: Calibration, validations: tuple[Validation, ...], drawn: dict[Path, Path]) -> dict[str, Any]:
    """Everything for --json."""
    return {
        "cell": calibration.cell,
        "axes": [gain.axis for gain in calibration.gains],
        "filter": calibration.filter,
        "fit_relative_error_percent": _error(calibration.relative_error_percent),
        "logs": [
            {
                "log": str(validation.log),
                "sha256": validation.digest,
                "seen_by_fit": validation.data_use is DataUse.FIT,
                "partial": validation.partial,
                "held_out": validation.data_use is DataUse.HOLDOUT,
                "same_configuration": validation.same_configuration,
                "rows": validation.rows,
                "relative_error_percent": _error(validation.error),
                "picture": str(drawn[validation.log]) if validation.log in drawn else None,
            }
            for validation in validations
        ],
        "together": {"relative_error_percent": _error(together(validations))} if validations else None,
    }


def cross_report(found: CrossValidation) -> dict[str, Any]:
    """What Tables 5 to 8 hold, for --json."""
    return {
        "calibrations": list(found.calibrations),
        "runs": [_checked(run) for run in found.runs],
        "payloads": [_weighed(run, found) for run in found.weighed],
    }


def _checked(run: CheckedRun) -> dict[str, Any]:
    return {
        "log": str(run.log),
        "condition": run.condition,
        "relative_error_percent": {label: _error(error) for label, error in run.errors.items()},
        "left_out": run.left_out or None,
        "seen_by": list(run.seen_by),
    }


def _weighed(run: WeighedRun, found: CrossValidation) -> dict[str, Any]:
    return {
        "log": str(run.log),
        "payload": run.payload.name,
        "mounting": run.payload.mounting,
        "weighed_kg": run.weighed_kg,
        "with_bare_runs": found.with_bare_runs,
        "masses": {
            label: {"reason": mass.reason}
            if isinstance(mass, Failure)
            else {
                "mass_kg": mass.mass_kg,
                "std_percent": mass.std_percent,
                "std_with_gains_percent": mass.std_with_gains_percent,
                "error_percent": mass.error_percent,
            }
            for label, mass in run.masses.items()
        },
    }


def _error(error: RelativeError) -> dict[str, Any]:
    return {"axes": error.axes, "total": error.total}


def show(
    calibration: Calibration, found: CrossValidation, drawn: dict[Path, Path], page_file: Path | None, console: Console
) -> None:
    """The errors, what they rest on, the paper's tables and where the pictures are, for a person."""
    validations = found.validations
    console.print(error_table(calibration, validations))
    filter_ = conditioning_of(calibration)
    console.print(
        f"Position filter {filter_.position_cutoff_hz:g} Hz, decimation {filter_.decimation_cutoff_hz:g} Hz, as in the "
        "fit: a relative error means nothing without them."
    )
    for validation in validations:
        if not validation.same_configuration:
            console.print(
                f"{printable(str(validation.log))} carries another cell configuration than the logs of the fit: "
                "look at what has changed.",
                style="bold",
                markup=False,
            )
    for validation in validations:
        if validation.error.total > DOUBTFUL_PERCENT:
            console.print(
                printable(
                    f"{validation.run} contradicts the calibration: it leaves {validation.error.total:.3g} % of the "
                )
                + "torque. Was the payload mounted as the log says, and is it the same robot?",
                style="bold",
                markup=False,
            )
    for run in found.runs:
        if run.left_out:
            console.print(printable(f"{run.run}: {run.left_out}"), style="bold", markup=False)
    for table in tables_of(found, all_of_them=False):
        console.print()
        console.print(table.on_screen())
        for note in table.notes:
            console.print(printable(note), markup=False)
    say_written(console, *drawn.values(), page_file)


def error_table(calibration: Calibration, validations: tuple[Validation, ...]) -> Table:
    """Relative error of each log, axis by axis."""
    table = Table(
        title="Relative error ‖ρ‖/‖Y‖ [%]", title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False
    )
    table.add_column("log")
    for heading in (*(gain.axis for gain in calibration.gains), "total"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for validation in validations:
        table.add_row(Text(printable(validation.run)), *_cells(validation.error), validation.data_use.value)
    if len(validations) > 1:
        table.add_row("together", *_cells(together(validations)))
    table.add_row("fit", *_cells(calibration.relative_error_percent))
    return table


def _cells(error: RelativeError) -> list[str]:
    return [f"{value:.2f}" if np.isfinite(value) else "-" for value in (*error.axes, error.total)]


VALIDATE = Verb(
    "validate", validate_verb, "drivegain validate calibration.yaml runs/later.mcap --beside cases --out tables"
)
