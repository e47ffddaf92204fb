"""`drivegain residual`: what the model lacks, named, added, and what that changes."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryFile
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
from daq.cli.terminal import check_output, say_written, status
from daq.cli.verb import JsonOption, Verb, json_text, print_json
from daq.config.cell_file import load_cell
from daq.errors import OutputFailed, UsageError
from daq.files import replace_file
from daq.log.reader import LossyLogs
from daq.report.effect_names import placed_name
from daq.report.fit import start_of
from daq.report.gains import gain_table, partial_note, with_deviation
from daq.report.residual_document import FORMAT, VERSION, error_rows, percent_text, residual_document, summary
from daq.report.residual_page import GENERATOR, residual_page
from daq.workflow.fit import Fit, calibration_of, close_loop, fit
from ident.calibration import Calibration
from ident.discovery.before_after import Account, account
from ident.discovery.search import Finding
from ident.effects.effect import PlacedEffect
from ident.estimators.estimate import Method

# The folder that `drivegain residual --report` fills.


PAGE, DOCUMENT = "report.html", "residual.json"
_LOOK_BYTES = 4096
_OURS = ((PAGE, f'<meta name="generator" content="{GENERATOR}">'), (DOCUMENT, f'"format": "{FORMAT}"'))
"""What the beginning of either file says, so that an earlier report may be replaced and nothing else."""


def check_report(folder: Path | None) -> None:
    """Make the folder, before any long work, and refuse one in which something would be destroyed.

    Args:
        folder: None where no report is wanted.

    Raises:
        UsageError: it holds a file of one of these names that is no earlier report.
        OutputFailed: it cannot be made, or nothing can be written into it.
    """
    if folder is None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputFailed.of(folder, error) from error
    for name, mark in _OURS:
        path = folder / name
        if path.exists() and not (path.is_file() and mark.encode() in _head(path)):
            raise UsageError(
                str(path),
                found="something that is no report of `drivegain residual`",
                expected="no such file, or that of an earlier report",
                remedy="choose another folder, or move it away",
            )


def save_report(fitted: Fit, account: Account, calibration: Calibration, folder: Path) -> None:
    """Both files, each whole or not at all.

    Args:
        fitted: with the turns of the loop.
        account: of them.
        calibration: with the accepted effects.
        folder: checked.

    Raises:
        OutputFailed: the file system refuses.
    """
    body = residual_document(fitted, account, calibration)
    document = json_text({"format": FORMAT, "version": VERSION, **body})
    try:
        replace_file(folder / PAGE, residual_page(fitted, account, calibration).encode())
        replace_file(folder / DOCUMENT, document.encode())
    except OSError as error:
        raise OutputFailed.of(folder, error) from error


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(_LOOK_BYTES)


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
    with status("identifying") as report_step:
        fitted = fit(
            logs,
            holdout=holdout or (),
            method=Method.ML,
            gains_fixed=gains is Gains.FIXED,
            cell=None if cell is None else load_cell(cell),
            lossy=LossyLogs.ACCEPTED if accept_losses else LossyLogs.REFUSED,
        )
        closed = close_loop(fitted, seed, report_step)
        calibration = calibration_of(closed, datetime.now(UTC))
        report_step("counting the errors before and after")
        changed = account(start_of(closed), closed.steps, leave_out_runs=leave_out_runs, progress=report_step)
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
        table.add_row(name, *map(percent_text, (*error.axes, error.total)))
    return table


RESIDUAL = Verb(
    "residual",
    residual_verb,
    "drivegain residual bare.mcap loaded.mcap --holdout unused.mcap --out calibration.yaml --report report",
)
