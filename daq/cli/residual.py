"""`drivegain residual`: fit, then detect and add missing effects."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from daq.cli.fit import (
    CALIBRATION,
    AcceptLossesOption,
    Gains,
    GainsOption,
    HoldoutOption,
    LogsArgument,
    OutOption,
    PicturesOption,
    save_calibration,
    save_pictures,
)
from daq.cli.verb import CellOption, JsonOption, Verb, print_json


def residual_verb(
    logs: LogsArgument,
    gains: GainsOption = Gains.FREE,
    holdout: HoldoutOption = None,
    seed: Annotated[int, typer.Option(help="Seed of the significance test, which fixes its verdict.", min=0)] = 0,
    out: OutOption = None,
    report: Annotated[Path | None, typer.Option("--report", help="Folder for report.html and residual.json.")] = None,
    pictures: PicturesOption = None,
    leave_out_runs: Annotated[
        bool, typer.Option("--leave-out-runs", help="Also predict each run from a fit of the others: slow.")
    ] = False,
    cell: CellOption = None,
    accept_losses: AcceptLossesOption = False,
    json: JsonOption = False,
) -> None:
    """Fit, then detect the effect that explains the residual, add it, refit everything, and repeat."""
    from datetime import UTC, datetime

    from daq.cli.terminal import check_output, print_view, status
    from daq.config.cell_file import load_cell
    from daq.log.reader import LossyLogs
    from daq.report.fit import start_of
    from daq.report.residual import residual_document, residual_view
    from daq.report.residual_page import save_report
    from daq.workflow.fit import calibration_of, close_loop, fit
    from ident.discovery.before_after import account
    from ident.estimators.method import Method

    check_output(out, (*logs, *(holdout or ()), cell), CALIBRATION)
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
        report_step("computing the errors before and after")
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
        print_view(residual_view(closed, changed, calibration), out, report, pictures)


def check_report(folder: Path | None) -> None:
    """Create the folder of a report before any long work, and refuse one with other files of the same names."""
    from tempfile import TemporaryFile

    from daq.cli.terminal import check_replaceable, writing
    from daq.report.residual_page import MARKS

    if folder is None:
        return
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    for name, mark in MARKS.items():
        check_replaceable(folder / name, mark, "report of `drivegain residual`")


RESIDUAL = Verb(
    "residual",
    residual_verb,
    "drivegain residual bare.mcap loaded.mcap --holdout held-out.mcap --out calibration.yaml --report report",
)
