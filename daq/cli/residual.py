"""`drivegain residual`: what the model lacks, named, added, and what that changes."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from daq.cli.fit import (
    CALIBRATION,
    AcceptLossesOption,
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
from daq.cli.residual_report import check_report, save_report
from daq.cli.verb import JsonOption, Verb, print_json
from daq.configuration.cell_file import load_cell
from daq.effect_words import placed_name
from daq.fit import Fit, calibration_of, close_loop, fit
from daq.log.losses import LossyLogs
from daq.report.fit import start_of
from daq.report.gain_table import gain_table, partial_note, with_deviation
from daq.report.residual_document import residual_document
from daq.report.residual_summary import error_rows, spelt, summary
from ident.before_after import Account, account
from ident.calibration import Calibration
from ident.effects.placed import PlacedEffect
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
    report: Annotated[
        Path | None,
        typer.Option("--report", help="Folder for report.html and residual.json; an earlier report is replaced."),
    ] = None,
    pictures: PicturesOption = None,
    leave_out_runs: Annotated[
        bool,
        typer.Option("--leave-out-runs", help="Also refit without each run in turn, and predict that run: slow."),
    ] = False,
    cell: CellOption = None,
    accept_losses: AcceptLossesOption = False,
    json: JsonOption = False,
) -> None:
    """Find the effect that the residual asks for, add it to the model, refit everything, and look again."""
    check_output(out, (*logs, *(holdout or ()), *(() if cell is None else (cell,))), CALIBRATION)
    check_report(report)
    with status("identifying") as told:
        fitted = fit(
            logs,
            holdout=holdout or (),
            method=Method.ML,
            gains_fixed=gains is Gains.FIXED,
            cell=None if cell is None else load_cell(cell),
            lossy=LossyLogs.ACCEPTED if accept_losses else LossyLogs.REFUSED,
        )
        closed = close_loop(fitted, seed, told)
        calibration = calibration_of(closed, datetime.now(UTC))
        told("counting the errors before and after")
        changed = account(start_of(closed), closed.steps, leave_out_runs=leave_out_runs, progress=told)
    if out is not None:
        save_calibration(calibration, out)
    if report is not None:
        with status("drawing the report"):
            save_report(closed, changed, calibration, report)
    if pictures is not None:
        save_pictures(closed, calibration, pictures)
    if json:
        print_json(residual_document(closed, changed, calibration))
    else:
        console = Console(soft_wrap=True, highlight=False)
        show(closed, changed, calibration, console)
        say_written(console, out, report, pictures)


def show(fitted: Fit, changed: Account, calibration: Calibration, console: Console) -> None:
    """The turns of the loop and their outcome, for a person."""
    axes = fitted.cell.axis_names
    for number, step in enumerate(fitted.steps, start=1):
        console.print(ranking_table(fitted, step.findings, f"Turn {number}: best candidates on left-out moves"))
        if step.accepted is None:
            console.print("No candidate passes every gate: nothing is added.\n")
        else:
            added = placed_name(PlacedEffect(step.accepted.effect, step.accepted.axis), axes)
            console.print(f"Added: {added}.\n", markup=False)
    for effect in calibration.effects:
        sizes = ", ".join(f"{c.name} {with_deviation(c.value, c.std)} {c.unit}" for c in effect.coefficients)
        more = len(effect.ambiguity) - SHOWN_RIVALS
        rivals = ", ".join(effect.ambiguity[:SHOWN_RIVALS]) + (f" and {more} more" if more > 0 else "")
        rivals = f"; not told from {rivals}" if rivals else ""
        console.print(f"{effect.axis}: {effect.name}: {sizes}{rivals}", markup=False)
    for sentence in summary(fitted, changed):
        console.print(sentence, markup=False)
    console.print()
    console.print(error_table(changed, axes))
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
    return error_table(account(start_of(fitted), fitted.steps), fitted.cell.axis_names)


def error_table(changed: Account, axes: tuple[str, ...]) -> Table:
    """Relative error of each axis before and after, and what noise alone would leave."""
    table = Table(
        title="Relative error ‖e‖/‖v‖ of the motor currents by ml [%]",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
    )
    table.add_column("", no_wrap=True)
    for heading in (*axes, "total"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, error in error_rows(changed):
        table.add_row(name, *map(spelt, (*error.axes, error.total)))
    return table


RESIDUAL = Verb(
    "residual",
    residual_verb,
    "drivegain residual bare.mcap loaded.mcap --holdout unused.mcap --out calibration.yaml --report report",
)
