"""`drivegain fit`: all gains and all parameters from logs, in one step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from daq.cli.terminal import check_output, say_written, status
from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.errors import OutputFailed, UsageError
from daq.files import replace_file
from daq.log.reader import LossyLogs
from daq.report.fit import (
    actual_current_note,
    advice,
    comparison_document,
    comparison_tables,
    draw,
    identifiability_notes,
    verdict_document,
)
from daq.report.gains import gain_table, partial_note
from daq.report.paper_tables import PaperTable, page, parameter_table
from daq.report.paper_tables import gain_table as paper_gain_table
from daq.report.residual_document import percent_text
from daq.workflow.calibration_file import as_document, save
from daq.workflow.cases import CASES, Case, CaseFit, Known, calibration_of_case, essential_fit, fit_case, reduce_logs
from daq.workflow.fit import DOUBTFUL_PERCENT, Fit, check_explained, compare_estimators, fit, needed_verdicts
from ident.calibration import Calibration
from ident.estimators.comparison import Comparison
from ident.estimators.estimate import Method

# `drivegain fit --cases`: the paper's cases and ours from the same logs, a calibration file each.


TABLES = "drivegain-fit-tables"
"""What a page of tables says it is."""


def fit_cases(
    logs: Sequence[Path],
    holdout: Sequence[Path],
    cell: Cell | None,
    ratio: float | None,
    folder: Path,
    format_: str,
    created: datetime,
    *,
    json: bool,
) -> None:
    """Fit every case, write its calibration, and tabulate them as Tables 1 to 4.

    Args:
        logs, holdout, cell, ratio: as of daq.cases.
        folder: for the calibrations, and tables.md.
        format_: what a calibration file says it is.
        created: when.
        json: print one JSON object.

    Raises:
        UsageError, OutputFailed: a file of another kind is in the way, or the file system refuses.
        DaqError, IdentificationError: a case cannot be fitted.
    """
    files = {case.name: folder / f"{case.name}.yaml" for case in CASES}
    page_file = folder / "tables.md"
    check_output(page_file, (*logs, *holdout), TABLES)
    for file in files.values():
        check_output(file, (*logs, *holdout), format_)
    with status("identifying") as report_step:
        reduced = reduce_logs(logs, holdout, cell)
        fits: dict[str, CaseFit] = {}
        for case in CASES:
            report_step(case.title)
            fits[case.name] = fit_case(reduced, case.method, case.known, gains_fixed=case.gains_fixed, ratio=ratio)
        calibrations = {name: calibration_of_case(found, created) for name, found in fits.items()}
    tables = case_tables(calibrations)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, file in files.items():
            save(calibrations[name], file)
        title = f"Identification of {reduced.cell.name}"
        replace_file(page_file, page(title, tables, marker=TABLES).encode())
    except OSError as error:
        raise OutputFailed.of(folder, error) from error
    if json:
        print_json({"cases": {case.name: _document(case, fits, calibrations) for case in CASES}})
        return
    console = Console(soft_wrap=True, highlight=False)
    for name, found in fits.items():
        left = found.fitted.identification.training_error.total
        if left > DOUBTFUL_PERCENT:
            console.print(f"{name} did not succeed: its relative error is {left:.3g} %.", style="bold", markup=False)
    for table in tables:
        console.print(table.on_screen())
        for note in table.notes:
            console.print(printable(note), markup=False)
        console.print()
    say_written(console, *files.values(), page_file)


def case_tables(calibrations: dict[str, Calibration]) -> tuple[PaperTable, ...]:
    """Tables 1 to 4."""
    wls, tls = ((calibrations[f"case-{drawn}"], calibrations[f"case-{mass}"]) for drawn, mass in ((1, 2), (3, 4)))
    return (
        parameter_table(1, *wls, "IDIM-WLS"),
        paper_gain_table(2, *wls, "IDIM-WLS"),
        parameter_table(3, *tls, "IDIM-TLS"),
        paper_gain_table(4, *tls, "IDIM-TLS"),
    )


def _document(case: Case, fits: dict[str, CaseFit], calibrations: dict[str, Calibration]) -> dict[str, Any]:
    return {
        "title": case.title,
        "known": case.known.value,
        **as_document(calibrations[case.name]),
        "removed": removed(fits[case.name]),
    }


def removed(found: CaseFit) -> list[dict[str, Any]]:
    """Base parameters that were taken out, in the order in which they went, for --json."""
    steps = () if found.essential is None else found.essential.removed
    return [{"name": step.name, "std_percent": step.std_percent} for step in steps]


CALIBRATION = "drivegain-calibration"
"""What a calibration file says it is."""


class Gains(Enum):
    """Whether the gains are unknown."""

    FREE = "free"
    FIXED = "fixed"


LogsArgument = Annotated[list[Path], typer.Argument(help="Logs: without load, and with a weighed payload.")]
HoldoutOption = Annotated[
    list[Path] | None,
    typer.Option("--holdout", help="Log that the fit must not see, for the final figure; repeatable."),
]
OutOption = Annotated[Path | None, typer.Option("--out", help="Calibration file to write (calibration.yaml).")]
PicturesOption = Annotated[Path | None, typer.Option("--pictures", help="Folder for pictures (PNG); it is made.")]
CellOption = Annotated[Path | None, typer.Option("--cell", help="Another cell file than the one in the logs.")]
AcceptLossesOption = Annotated[
    bool,
    typer.Option(
        "--accept-losses",
        help="Use logs that are invalid for lost frames, without those samples; `apply` refuses the result.",
    ),
]
GainsOption = Annotated[Gains, typer.Option(help="fixed: hold the nameplate gains (classical IDIM).")]
KnownOption = Annotated[
    Known,
    typer.Option(help="Of the payload: its weighed mass, or cad: also what the cell file says of centre and inertia."),
]
EssentialOption = Annotated[
    float | None,
    typer.Option(
        min=1.5,
        help="Keep essential parameters alone: the largest relative σ below this many times the least (10 to 30).",
    ),
]
CasesOption = Annotated[
    Path | None,
    typer.Option("--cases", help="Folder for the paper's cases 1 to 4, the nameplate gains and ml, a file each."),
]
CompareOption = Annotated[
    bool,
    typer.Option("--compare", help="Also run every estimator, under the cell's filters and half and twice of them."),
]


def fit_verb(
    logs: LogsArgument,
    method: Annotated[
        Method | None,
        typer.Option(help="ls, wls and tls of the paper, or ml; by default ml, and wls when the gains are fixed."),
    ] = None,
    gains: GainsOption = Gains.FREE,
    known: KnownOption = Known.MASS,
    essential: EssentialOption = None,
    cases: CasesOption = None,
    compare: CompareOption = False,
    holdout: HoldoutOption = None,
    out: OutOption = None,
    pictures: PicturesOption = None,
    cell: CellOption = None,
    accept_losses: AcceptLossesOption = False,
    json: JsonOption = False,
) -> None:
    """Identify all drive gains and dynamic parameters from runs without load and with a weighed payload."""
    if cases is not None:
        require_cases_alone(method is not None or known is not Known.MASS or gains is not Gains.FREE, out, pictures)
        described = None if cell is None else load_cell(cell)
        fit_cases(logs, holdout or (), described, essential, cases, CALIBRATION, datetime.now(UTC), json=json)
        return
    check_output(out, (*logs, *(holdout or ()), *(() if cell is None else (cell,))), CALIBRATION)
    with status("identifying"):
        described = None if cell is None else load_cell(cell)
        fixed = gains is Gains.FIXED
        if known is Known.MASS:
            lossy = LossyLogs.ACCEPTED if accept_losses else LossyLogs.REFUSED
            fitted = fit(logs, holdout=holdout or (), method=method, gains_fixed=fixed, cell=described, lossy=lossy)
            found = CaseFit(fitted, (), None)
        else:
            chosen = method or (Method.WLS if fixed else Method.ML)
            found = fit_case(reduce_logs(logs, holdout or (), described), chosen, known, gains_fixed=fixed)
            check_explained(found.fitted.identification.training_error, found.fitted.cell.axis_names)
        if essential is not None:
            found = replace(essential_fit(found.fitted, essential), payloads=found.payloads)
        fitted, calibration = found.fitted, calibration_of_case(found, datetime.now(UTC))
    if out is not None:
        save_calibration(calibration, out)
    if pictures is not None:
        save_pictures(fitted, calibration, pictures)
    side_by_side = None
    if compare:
        with status("comparing estimators") as report_step:
            side_by_side = compare_estimators(fitted, report_step)
    if json:
        print_json({**as_document(calibration), **report(found, side_by_side)})
    else:
        console = Console(soft_wrap=True, highlight=False)
        show(fitted, calibration, console)
        show_notes(found, side_by_side, console)
        say_written(console, out, pictures)


def report(found: CaseFit, comparison: Comparison | None) -> dict[str, Any]:
    """What --json says beside the calibration."""
    fitted = found.fitted
    axes = fitted.cell.axis_names
    document = {**compared(fitted), "removed": removed(found)}
    document["verdicts"] = [verdict_document(gain, axes) for gain in needed_verdicts(fitted)]
    if comparison is not None:
        document["comparison"] = comparison_document(comparison, axes)
    return document


def show_notes(found: CaseFit, comparison: Comparison | None, console: Console) -> None:
    """What the fit rests on and what it cannot tell, for a person."""
    fitted = found.fitted
    for line in (*identifiability_notes(fitted), *advice(fitted, needed_verdicts(fitted))):
        console.print(line, markup=False)
    if comparison is not None:
        for table in comparison_tables(comparison, fitted.cell.axis_names):
            console.print()
            console.print(table)
    if found.essential is not None:
        kept, names = len(found.essential.system.columns), [step.name for step in found.essential.removed]
        console.print(f"{kept} essential parameters; taken out: {', '.join(names) or 'none'}", markup=False)


def require_cases_alone(chosen: bool, out: Path | None, pictures: Path | None) -> None:
    """--cases chooses by itself, and writes into its own folder.

    Raises:
        UsageError: something else was chosen beside it.
    """
    if chosen or out is not None or pictures is not None:
        raise UsageError(
            "--cases",
            found="--method, --gains, --known, --out or --pictures beside it",
            expected="none of them: every case has its own, and a file in the folder",
            remedy="leave them out, or fit one case without --cases",
        )


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write it whole or not at all.

    Raises:
        OutputFailed: the file system refuses.
    """
    try:
        save(calibration, path)
    except OSError as error:
        raise OutputFailed.of(path, error) from error


def save_pictures(fitted: Fit, calibration: Calibration, folder: Path) -> None:
    """Torques, gains, and the residual before and after each effect.

    Raises:
        OutputFailed: the file system refuses.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        draw(fitted, calibration, None, folder)
    except OSError as error:
        raise OutputFailed.of(folder, error) from error


def compared(fitted: Fit) -> dict[str, Any]:
    """The paper's estimate beside ours, for --json."""
    if fitted.paper is None:
        return {"compared": {}}
    paper = fitted.paper
    gains = [
        {"axis": axis.name, "value": float(value), "std_percent": 100.0 * float(std / abs(value))}
        for axis, value, std in zip(fitted.cell.axes, paper.gains, paper.gains_std, strict=True)
    ]
    return {"compared": {"tls": {"gains": gains, "condition": paper.condition}}}


def show(fitted: Fit, calibration: Calibration, console: Console) -> None:
    """Gains, errors and what they rest on, for a person."""
    estimate = fitted.estimate
    console.print(gain_table(calibration.gains, title=f"Drive gains of {calibration.cell} by {calibration.method}"))
    if (note := partial_note(calibration)) is not None:
        console.print(note, style="bold", markup=False)
    note = actual_current_note(fitted.cell)
    if note is not None:
        console.print(note)
    if fitted.paper is not None:
        values = ", ".join(f"{value:.4g}" for value in fitted.paper.gains)
        console.print(f"For comparison, the paper's total least squares on the same rows: {values}")
    console.print()
    console.print(error_table(fitted, calibration))
    filter_ = fitted.identification.conditioning
    console.print(
        f"{estimate.rows} rows, {len(fitted.final.columns)} base parameters and effects, condition "
        f"{estimate.condition:.0f}; position filter {filter_.position_cutoff_hz:g} Hz, decimation "
        f"{filter_.decimation_cutoff_hz:g} Hz: a relative error means nothing without them."
    )


def error_table(fitted: Fit, calibration: Calibration) -> Table:
    """Relative error of each axis, on the rows of the fit and on those it has not seen."""
    table = Table(
        title="Relative error ‖ρ‖/‖Y‖ [%]", title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False
    )
    for heading in ("", *(axis.name for axis in fitted.cell.axes), "total"):
        table.add_column(heading, justify="right", no_wrap=True)
    rows = [("fit", calibration.relative_error_percent), ("unused", calibration.holdout_error_percent)]
    for name, error in rows:
        if error is not None:
            table.add_row(name, *map(percent_text, (*error.axes, error.total)))
    return table


FIT = Verb("fit", fit_verb, "drivegain fit bare.mcap loaded.mcap --holdout unused.mcap --out calibration.yaml")
