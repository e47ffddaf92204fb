"""`drivegain residual`: what the model lacks, named, added, and what that changes."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from daq.calibration_file import as_document
from daq.cli.fit import (
    CALIBRATION,
    CellOption,
    Gains,
    GainsOption,
    HoldoutOption,
    LogsArgument,
    OutOption,
    PicturesOption,
    save_calibration,
    save_pictures,
)
from daq.cli.output import check_output, say_written
from daq.cli.progress import status
from daq.cli.verb import JsonOption, Verb, print_json
from daq.configuration.cell_file import load_cell
from daq.fit import Fit, calibration_of, close_loop, fit
from daq.report.gain_table import gain_table, partial_note, with_deviation
from ident.calibration import Calibration
from ident.estimate import Method
from ident.search import Finding

SHOWN = 6
"""Findings listed for each turn; the JSON has them all."""
SHOWN_RIVALS = 3


def residual_verb(
    logs: LogsArgument,
    gains: GainsOption = Gains.FREE,
    holdout: HoldoutOption = None,
    seed: Annotated[
        int, typer.Option(help="Of the significance test; the same seed gives the same verdict.", min=0)
    ] = 0,
    out: OutOption = None,
    pictures: PicturesOption = None,
    cell: CellOption = None,
    json: JsonOption = False,
) -> None:
    """Find the effect that the residual asks for, add it to the model, refit everything, and look again."""
    check_output(out, (*logs, *(holdout or ()), *(() if cell is None else (cell,))), CALIBRATION)
    with status("identifying") as told:
        fitted = fit(
            logs,
            holdout=holdout or (),
            method=Method.ML,
            gains_fixed=gains is Gains.FIXED,
            cell=None if cell is None else load_cell(cell),
        )
        closed = close_loop(fitted, seed, told)
        calibration = calibration_of(closed, datetime.now(UTC))
    if out is not None:
        save_calibration(calibration, out)
    if pictures is not None:
        save_pictures(closed, calibration, pictures)
    if json:
        print_json({**as_document(calibration), **report(closed)})
    else:
        console = Console(soft_wrap=True, highlight=False)
        show(closed, calibration, console)
        say_written(console, out, pictures)


def report(fitted: Fit) -> dict[str, Any]:
    """Errors before and after, and every finding of every turn, for --json."""
    before, after = fitted.identification, fitted.final
    return {
        "before": {
            "relative_error_percent": _error(before.training_error),
            "holdout_error_percent": _error(before.holdout_error),
            "gains": [float(gain) for gain in before.estimate.gains],
        },
        "after": {
            "relative_error_percent": _error(after.training_error),
            "holdout_error_percent": _error(after.holdout_error),
            "gains": [float(gain) for gain in after.estimate.gains],
        },
        "turns": [
            {
                "accepted": None if step.accepted is None else _finding(fitted, step.accepted),
                "findings": [_finding(fitted, finding) for finding in step.findings],
            }
            for step in fitted.steps
        ],
    }


def _error(error: Any) -> dict[str, Any] | None:
    return None if error is None else {"axes": error.axes, "total": error.total}


def _finding(fitted: Fit, finding: Finding) -> dict[str, Any]:
    return {
        "effect": finding.effect.name,
        "axis": fitted.cell.axes[finding.axis].name,
        "settings": finding.effect.settings,
        "coefficients": {
            column.name: float(value)
            for column, value in zip(finding.effect.coefficients, finding.coefficients, strict=True)
        },
        "probability": finding.probability,
        "folds_better": finding.folds_better,
        "explained": finding.explained,
        "error_before_percent": finding.error_before_percent,
        "error_after_percent": finding.error_after_percent,
        "passed": finding.passed,
        "ambiguity": finding.ambiguity,
    }


def show(fitted: Fit, calibration: Calibration, console: Console) -> None:
    """The turns of the loop and their outcome, for a person."""
    for number, step in enumerate(fitted.steps, start=1):
        console.print(ranking_table(fitted, step.findings, f"Turn {number}: best candidates on left-out moves"))
        if step.accepted is None:
            console.print("No candidate passes every gate: nothing is added.\n")
        else:
            console.print(f"Added: {step.accepted.effect.name} on {fitted.cell.axes[step.accepted.axis].name}.\n")
    for effect in calibration.effects:
        sizes = ", ".join(f"{c.name} {with_deviation(c.value, c.std)} {c.unit}" for c in effect.coefficients)
        more = len(effect.ambiguity) - SHOWN_RIVALS
        rivals = ", ".join(effect.ambiguity[:SHOWN_RIVALS]) + (f" and {more} more" if more > 0 else "")
        rivals = f"; not told from {rivals}" if rivals else ""
        console.print(f"{effect.axis}: {effect.name}: {sizes}{rivals}", markup=False)
    console.print(before_after_table(fitted))
    console.print()
    console.print(gain_table(calibration.gains, title="Drive gains with the effects in the model"))
    if (note := partial_note(calibration)) is not None:
        console.print(note, style="bold", markup=False)


def ranking_table(fitted: Fit, findings: tuple[Finding, ...], title: str) -> Table:
    """The best findings and the gates that they passed."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    table.add_column("effect", no_wrap=True)
    for heading in ("axis", "p", "folds", "explains", "error left out", "gates"):
        table.add_column(heading, justify="right", no_wrap=True)
    for finding in findings[:SHOWN]:
        table.add_row(
            finding.effect.name,
            fitted.cell.axes[finding.axis].name,
            f"{finding.probability:.3f}",
            f"{100 * finding.folds_better:.0f} %",
            f"{100 * finding.explained:.1f} %",
            f"{finding.error_before_percent:.2f} → {finding.error_after_percent:.2f} %",
            "pass" if finding.passed else "no",
        )
    return table


def before_after_table(fitted: Fit) -> Table:
    """Relative error of each axis without and with the effects."""
    table = Table(
        title="Relative error ‖ρ‖/‖Y‖ by ml [%]",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
    )
    for heading in ("", *(axis.name for axis in fitted.cell.axes), "total"):
        table.add_column(heading, justify="right", no_wrap=True)
    before, after = fitted.identification, fitted.final
    rows = (
        ("fit, before", before.training_error),
        ("fit, after", after.training_error),
        ("unused, before", before.holdout_error),
        ("unused, after", after.holdout_error),
    )
    for name, error in rows:
        if error is not None:
            values = (f"{value:.2f}" if np.isfinite(value) else "-" for value in error.axes)
            table.add_row(name, *values, f"{error.total:.2f}")
    return table


RESIDUAL = Verb(
    "residual", residual_verb, "drivegain residual bare.mcap loaded.mcap --holdout unused.mcap --out calibration.yaml"
)
