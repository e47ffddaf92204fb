"""`drivegain validate`: what a calibration predicts of logs that it may never have seen."""

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

from daq.calibration_file import load
from daq.cli.fit import CellOption
from daq.cli.progress import status
from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.configuration.cell_file import load_cell
from daq.errors import OutputFailed
from daq.report.torque import plot_torques
from daq.validate import Acquaintance, Validation, conditioning_of, together, validate
from ident.calibration import Calibration
from ident.relative_error import RelativeError


def validate_verb(
    calibration: Annotated[Path, typer.Argument(help="calibration.yaml of `drivegain fit`.")],
    logs: Annotated[list[Path], typer.Argument(help="Logs of the same cell.")],
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for a picture of each log: measured and predicted torque.")
    ] = None,
    cell: CellOption = None,
    json: JsonOption = False,
) -> None:
    """Predict the torque of runs with a calibration and say how far the measured one is from it."""
    with status("predicting"):
        known = load(calibration)
        validations = validate(known, logs, None if cell is None else load_cell(cell))
        drawn = {} if pictures is None else draw(known, validations, pictures)
    if json:
        print_json(report(known, validations, drawn))
    else:
        show(known, validations, drawn, Console(soft_wrap=True, highlight=False))


def draw(calibration: Calibration, validations: tuple[Validation, ...], folder: Path) -> dict[Path, Path]:
    """A picture of each log, as the paper's Fig. 2; where each was put, by log.

    Raises:
        OutputFailed: the file system refuses.
    """
    axes = tuple(gain.axis for gain in calibration.gains)
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
        title = f"{validation.run}, {validation.acquaintance.value}: torque of {calibration.cell}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            plot_torques(path, validation.time_s, measured_nm, predicted_nm, axes, title=title)
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
                "seen_by_fit": validation.acquaintance is Acquaintance.FIT,
                "held_out": validation.acquaintance is Acquaintance.HOLDOUT,
                "same_configuration": validation.same_configuration,
                "rows": validation.rows,
                "relative_error_percent": _error(validation.error),
                "picture": str(drawn[validation.log]) if validation.log in drawn else None,
            }
            for validation in validations
        ],
        "together": {"relative_error_percent": _error(together(validations))},
    }


def _error(error: RelativeError) -> dict[str, Any]:
    return {"axes": error.axes, "total": error.total}


def show(
    calibration: Calibration, validations: tuple[Validation, ...], drawn: dict[Path, Path], console: Console
) -> None:
    """The errors, what they rest on and where the pictures are, for a person."""
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
    for path in drawn.values():
        console.print(f"Picture: {path}", markup=False)


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
        table.add_row(Text(printable(validation.run)), *_cells(validation.error), validation.acquaintance.value)
    if len(validations) > 1:
        table.add_row("together", *_cells(together(validations)))
    table.add_row("fit", *_cells(calibration.relative_error_percent))
    return table


def _cells(error: RelativeError) -> list[str]:
    return [f"{value:.2f}" if np.isfinite(value) else "-" for value in (*error.axes, error.total)]


VALIDATE = Verb("validate", validate_verb, "drivegain validate calibration.yaml runs/later.mcap --pictures pictures")
