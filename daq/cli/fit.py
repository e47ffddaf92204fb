"""`drivegain fit` and `residual`: all gains and all parameters from logs, and the effects that the model lacks."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.verb import CellOption, JsonOption, Verb, judged_output, print_json, say_correct_first, say_next
from daq.workflow.choices import Known
from ident.estimators.method import Method

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.workflow.fit import Fit
    from ident.calibration import Calibration

CALIBRATION, TABLES = "drivegain-calibration", "drivegain-fit-tables"  #: Formats of the files that `fit` writes


class Gains(Enum):
    """Whether the gains are identified or held."""

    FREE = "free"
    FIXED = "fixed"


LogsArgument = Annotated[list[Path], typer.Argument(help="Logs: without load, and with a weighed payload.")]
HoldoutOption = Annotated[
    list[Path] | None, typer.Option("--holdout", help="Held-out log, for the final error; repeatable.")
]
OutOption = Annotated[
    Path | None, typer.Option("--out", help="Calibration file to write (calibration.yaml).", callback=judged_output)
]
PicturesOption = Annotated[
    Path | None, typer.Option("--pictures", help="Folder for pictures; it is created.", callback=judged_output)
]
AcceptLossesOption = Annotated[
    bool,
    typer.Option("--accept-losses", help="Use logs with lost frames, less those samples; `apply` refuses the result."),
]
AsWiredOption = Annotated[
    bool, typer.Option("--channels-as-wired", help="Do not look for exchanged currents: they are each axis' own.")
]
GainsOption = Annotated[Gains, typer.Option(help="fixed: hold the nameplate gains (classical IDIM).")]
KnownOption = Annotated[Known, typer.Option(help="What is known of the payload; cad: its drawing too.")]
EssentialOption = Annotated[
    float | None,
    typer.Option(min=1.5, help="Keep only essential parameters, whose relative σ are within this factor (10 to 30)."),
]
CasesOption = Annotated[
    Path | None,
    typer.Option(
        "--cases", help="Folder for the paper's cases 1 to 4, the nameplate gains and ml.", callback=judged_output
    ),
]
CompareOption = Annotated[
    bool,
    typer.Option("--compare", help="Also run every estimator, at the cell's cut-offs, their half and their double."),
]


def fit_verb(
    logs: LogsArgument,
    method: Annotated[
        Method | None,
        typer.Option(
            help="ls, wls, tls of the paper; ml (default; wls with fixed gains); iv: instruments of the demand."
        ),
    ] = None,
    gains: GainsOption = Gains.FREE,
    known: KnownOption = Known.MASS,
    essential: EssentialOption = None,
    cases: CasesOption = None,
    compare: CompareOption = False,
    holdout: HoldoutOption = None,
    out: OutOption = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Folder for report.html, the certificate.", callback=judged_output)
    ] = None,
    pictures: PicturesOption = None,
    cell: CellOption = None,
    accept_losses: AcceptLossesOption = False,
    channels_as_wired: AsWiredOption = False,
    json: JsonOption = False,
) -> None:
    """Identify all drive gains and dynamic parameters from runs without load and with a weighed payload."""
    from dataclasses import replace
    from datetime import UTC, datetime

    from daq.cli.terminal import at_most_one, check_folder, check_output, print_view, require_different, status
    from daq.config.cell_file import load_cell
    from daq.log.reader import LossyLogs
    from daq.report.fit import fit_document, fit_view
    from daq.workflow.cases import CaseFit, calibration_of_case, essential_fit, fit_case, reduce_logs
    from daq.workflow.fit import compare_estimators, fit
    from ident.estimators.refusals import require_plausible

    if cases is not None:
        other = {"known": known is not Known.MASS, "gains": gains is not Gains.FREE}  # every case has its own
        at_most_one(cases=cases, method=method, **other, out=out, report=report, pictures=pictures)
        _fit_cases(logs, holdout or (), None if cell is None else load_cell(cell), essential, cases, json=json)
        return
    check_folder(out)
    check_output(out, (*logs, *(holdout or ()), cell), CALIBRATION)
    require_different(out, report=report, pictures=pictures)
    check_report(report, out)
    with status("identifying"):
        described = None if cell is None else load_cell(cell)
        fixed = gains is Gains.FIXED
        if known is Known.MASS:
            lossy = LossyLogs.ACCEPTED if accept_losses else LossyLogs.REFUSED
            fitted = fit(
                logs,
                holdout=holdout or (),
                method=method,
                gains_fixed=fixed,
                cell=described,
                lossy=lossy,
                channels_as_wired=channels_as_wired,
            )
            found = CaseFit(fitted, (), None)
        else:
            chosen = method or (Method.WLS if fixed else Method.ML)
            reduced = reduce_logs(logs, holdout or (), described, instruments=chosen is Method.IV)
            found = fit_case(reduced, chosen, known, gains_fixed=fixed)
            one = found.fitted.identification
            require_plausible(one.estimate, one.training_error, found.fitted.cell.axis_names)
        if essential is not None:
            found = replace(essential_fit(found.fitted, essential), payloads=found.payloads)
        calibration = calibration_of_case(found, datetime.now(UTC))
    _save(found.fitted, calibration, out, pictures)
    if report is not None:
        _save_certificate(found.fitted, calibration, report)
    comparison = None
    if compare:
        with status("comparing estimators") as report_step:
            comparison = compare_estimators(found.fitted, report_step)
    if json:
        print_json(fit_document(found, calibration, comparison))
    else:
        print_view(fit_view(found, calibration, comparison), out, report, pictures)
        same = [word for log in holdout or () for word in ("--holdout", log)]
        same += [] if cell is None else ["--cell", cell]
        same += ["--gains", gains.value] if fixed else []
        same += ["--channels-as-wired"] if channels_as_wired else []
        say_after_fit(calibration, [*logs, *same], out or Path("calibration.yaml"))


def say_after_fit(calibration: Calibration, arguments: Sequence[object], out: Path) -> None:
    """Print the next step: the search for what the model lacks, unless the robot is described wrongly."""
    from daq.writeback.gates.fit import uncorrected_description

    if uncorrected_description(calibration):
        say_correct_first()
    else:
        say_next("drivegain", "residual", *arguments, "--out", out, "--report", "report")


def _fit_cases(
    logs: Sequence[Path], holdout: Sequence[Path], cell: Cell | None, ratio: float | None, folder: Path, *, json: bool
) -> None:
    """Fit the paper's cases and ours, write a calibration of each, and tabulate them as Tables 1 to 4."""
    from datetime import UTC, datetime

    from daq.cli.terminal import check_output, print_view, status, write_output
    from daq.documents.calibration_file import save_calibration
    from daq.files import replace_file
    from daq.report.fit import cases_document, cases_view
    from daq.report.paper_tables import case_tables, paper_page
    from daq.workflow.cases import CASES, CaseFit, calibration_of_case, fit_case, reduce_logs

    created = datetime.now(UTC)
    files = {case.name: folder / f"{case.name}.yaml" for case in CASES}
    page_file = folder / "tables.md"
    check_output(page_file, (*logs, *holdout), TABLES)
    for file in files.values():
        check_output(file, (*logs, *holdout), CALIBRATION)
    with status("identifying") as report_step:
        reduced = reduce_logs(logs, holdout, cell)
        fits: dict[str, CaseFit] = {}
        for case in CASES:
            report_step(case.title)
            fits[case.name] = fit_case(reduced, case.method, case.known, gains_fixed=case.gains_fixed, ratio=ratio)
        calibrations = {name: calibration_of_case(found, created) for name, found in fits.items()}
    tables = case_tables(calibrations)
    with write_output(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, file in files.items():
            save_calibration(calibrations[name], file)
        replace_file(page_file, paper_page(f"Identification of {reduced.cell.name}", tables, marker=TABLES).encode())
    if json:
        print_json(cases_document(fits, calibrations))
    else:
        print_view(cases_view(fits, tables), *files.values(), page_file)


FIT = Verb("fit", fit_verb, "drivegain fit unloaded.mcap loaded.mcap --holdout held-out.mcap --out calibration.yaml")


def residual_verb(
    logs: LogsArgument,
    gains: GainsOption = Gains.FREE,
    holdout: HoldoutOption = None,
    seed: Annotated[int, typer.Option(help="Seed of the significance test, which fixes its verdict.", min=0)] = 0,
    out: OutOption = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Folder for report.html and residual.json.", callback=judged_output)
    ] = None,
    pictures: PicturesOption = None,
    leave_out_runs: Annotated[
        bool, typer.Option("--leave-out-runs", help="Also predict each run from a fit of the others: slow.")
    ] = False,
    cell: CellOption = None,
    accept_losses: AcceptLossesOption = False,
    channels_as_wired: AsWiredOption = False,
    accept_worse_holdout: Annotated[
        bool,
        typer.Option(
            "--accept-worse-holdout",
            help="Write every effect that was found, whatever held-out logs say.",
        ),
    ] = False,
    write_undecided: Annotated[
        bool,
        typer.Option(
            "--write-undecided",
            help="Write effects that held-out logs neither confirm nor refute, too.",
        ),
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", help="Also print the search, all errors and what these data cannot show."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Fit, then detect the effect that explains the residual, add it, refit everything, and repeat."""
    from dataclasses import replace
    from datetime import UTC, datetime

    from daq.cli.terminal import check_folder, check_output, print_view, require_different, status, write_output
    from daq.config.cell_file import load_cell
    from daq.errors import OutputFailed
    from daq.log.reader import LossyLogs
    from daq.report.fit import start_of
    from daq.report.residual import residual_document, residual_view
    from daq.report.residual_page import save_report
    from daq.workflow.fit import Undecided, calibration_of, check_holdout, close_loop, fit
    from ident.discovery.before_after import account
    from ident.estimators.method import Method

    check_folder(out)
    check_output(out, (*logs, *(holdout or ()), cell), CALIBRATION)
    require_different(out, report=report, pictures=pictures)
    check_report(report, out)
    with status("identifying") as report_step:
        fitted = fit(
            logs,
            holdout=holdout or (),
            method=Method.ML,
            gains_fixed=gains is Gains.FIXED,
            cell=None if cell is None else load_cell(cell),
            lossy=LossyLogs.ACCEPTED if accept_losses else LossyLogs.REFUSED,
            keep_rows=True,
            channels_as_wired=channels_as_wired,
        )
        undecided = Undecided.of(write=write_undecided, ignore_holdout=accept_worse_holdout)
        found = close_loop(fitted, seed, report_step, undecided)
        closed = replace(found, accept_worse_holdout=accept_worse_holdout)
        calibration = calibration_of(closed, datetime.now(UTC))
        report_step("computing the errors before and after")
        changed = account(start_of(closed), closed.steps, leave_out_runs=leave_out_runs, progress=report_step)

    def show(*written: Path | None) -> None:
        if json:
            print_json(residual_document(closed, changed, calibration))
        else:
            print_view(residual_view(closed, changed, calibration, verbose=verbose), *written)

    try:
        if report is not None:
            with status("drawing the report"), write_output(report):
                save_report(closed, changed, calibration, report)
        check_holdout(closed)
        _save(closed, calibration, out, pictures)
    except OutputFailed:
        show()  # what took minutes to find is not lost with the disk
        raise
    show(out, report, pictures)
    if json:
        return
    same: list[object] = [] if cell is None else ["--cell", cell]
    if out is not None:
        say_next("drivegain", "validate", out, *(holdout or logs), *same)
        return
    same += [word for log in holdout or () for word in ("--holdout", log)]
    same += ["--gains", gains.value] if gains is Gains.FIXED else []
    same += ["--seed", str(seed)] if seed else []
    switches = {
        "--accept-losses": accept_losses,
        "--channels-as-wired": channels_as_wired,
        "--accept-worse-holdout": accept_worse_holdout,
        "--write-undecided": write_undecided,
    }
    same += [name for name, given in switches.items() if given]
    say_next("drivegain", "residual", *logs, *same, "--out", "calibration.yaml", "--report", report or "report")


def check_report(folder: Path | None, out: Path | None = None) -> None:
    """Create the folder of a report before any long work, and refuse one with other files of the same names.

    A folder in which nothing is written in the end is removed again.
    """
    from tempfile import TemporaryFile

    from daq.cli.terminal import check_replaceable, make_folder
    from daq.errors import UsageError, writing
    from daq.report.residual_page import MARKS

    if folder is None:
        return
    if out is not None and out.resolve() in {folder.resolve() / name for name in MARKS}:
        raise UsageError(
            str(out),
            found="a file of the report as --out",
            expected="another name than " + " and ".join(MARKS),
            remedy=f"choose another name for --out, as {folder / 'calibration.yaml'}",
        )
    with writing(folder):
        make_folder(folder)
        with TemporaryFile(dir=folder):
            pass
    for name, mark in MARKS.items():
        check_replaceable(folder / name, mark, "report of `drivegain residual`")


RESIDUAL = Verb(
    "residual",
    residual_verb,
    "drivegain residual unloaded.mcap loaded.mcap --holdout held-out.mcap --out calibration.yaml --report report",
)


def _save_certificate(fitted: Fit, calibration: Calibration, folder: Path) -> None:
    """Write the certificate of a fit as the page of its report."""
    from daq.cli.terminal import write_output
    from daq.files import replace_file
    from daq.report.certificate import certify
    from daq.report.certificate_page import certificate_page
    from daq.report.residual_page import PAGE, beside_nameplate

    page = certificate_page(certify(calibration, beside_nameplate(fitted, calibration)))
    with write_output(folder):
        replace_file(folder / PAGE, page.encode())


def _save(fitted: Fit, calibration: Calibration, out: Path | None, pictures: Path | None) -> None:
    from daq.cli.terminal import write_output
    from daq.documents.calibration_file import save_calibration
    from daq.report.plots import draw_fit

    if out is not None:
        with write_output(out):
            save_calibration(calibration, out)
    if pictures is not None:
        with write_output(pictures):
            pictures.mkdir(parents=True, exist_ok=True)
            draw_fit(fitted, calibration, None, pictures)
