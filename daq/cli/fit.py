"""`drivegain fit` and `residual`: all gains and all parameters from logs,
and the effects that the model lacks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.next_step import free_name, say_after_calibration, say_after_fit, say_next
from daq.cli.terminal import (
    at_most_one,
    check_folder,
    check_output,
    check_replaceable,
    make_folder,
    print_view,
    replace_output,
    require_different,
    require_folder_name,
    status,
)
from daq.cli.verb import (
    CellOption,
    JsonOption,
    corrected_cell,
    output_option,
    print_json,
    taking,
)
from daq.environment import require_packages
from daq.errors import OutputFailed, UsageError, writing
from daq.files import replace_file
from daq.workflow.choices import Known
from ident.estimators.method import Method
from ident.physical.full_set import LARGEST_TOLERANCE, LEAST_TOLERANCE

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.log.reader import LossyLogs
    from daq.workflow.cases import CaseFit
    from daq.workflow.fit import Fit
    from ident.calibration import Calibration
    from ident.physical.full_set import FullSet

CALIBRATION = "drivegain-calibration"  #: Format of the calibrations that `fit` writes
TABLES = "drivegain-fit-tables"  #: Format of its page of tables


class Gains(Enum):
    """Whether the gains are identified or held."""

    FREE = "free"
    FIXED = "fixed"


@dataclass(frozen=True, slots=True, kw_only=True)
class LogsRequest:
    """Logs to fit and places for the result, as the command line asks for them."""

    logs: Annotated[
        list[Path], typer.Argument(help="Logs: without load, and with a weighed payload.")
    ]
    gains: Annotated[
        Gains, typer.Option(help="fixed: hold the gains at the nameplate (classical IDIM).")
    ] = Gains.FREE
    holdout: Annotated[
        list[Path] | None,
        typer.Option("--holdout", help="Held-out log, for the final error; repeatable."),
    ] = None
    out: Annotated[
        Path | None, output_option("--out", "Calibration file to write (calibration.yaml).")
    ] = None
    pictures: Annotated[
        Path | None, output_option("--pictures", "Folder for pictures; it is created.")
    ] = None
    cell: CellOption = None
    accept_losses: Annotated[
        bool,
        typer.Option(
            "--accept-losses",
            help="Use logs with lost frames, less those samples; `apply` refuses the result.",
        ),
    ] = False
    channels_as_wired: Annotated[
        bool,
        typer.Option(
            "--channels-as-wired",
            help="Do not look for exchanged currents: they are each axis' own.",
        ),
    ] = False
    json: JsonOption = False

    @property
    def gains_fixed(self) -> bool:
        """Whether the nameplate gains are held."""
        return self.gains is Gains.FIXED

    @property
    def lossy(self) -> LossyLogs:
        """Whether logs with lost frames are used."""
        from daq.log.reader import LossyLogs

        if self.accept_losses:
            return LossyLogs.ACCEPTED
        return LossyLogs.REFUSED

    def options(self) -> list[object]:
        """Return the options of the same logs as words of another command."""
        words: list[object] = []
        for log in self.holdout or ():
            words += ("--holdout", log)
        if self.cell is not None:
            words += ("--cell", self.cell)
        if self.gains_fixed:
            words += ("--gains", self.gains.value)
        if self.channels_as_wired:
            words.append("--channels-as-wired")
        return words

    def check_places(self, report: Path | None) -> None:
        """Refuse places of the output that cannot be written, before any long work."""
        check_folder(self.out)
        check_output(self.out, (*self.logs, *(self.holdout or ()), self.cell), CALIBRATION)
        require_different(self.out, report=report, pictures=self.pictures)
        require_folder_name(self.pictures)
        check_report(report, self.out)


@dataclass(frozen=True, slots=True, kw_only=True)
class FitRequest(LogsRequest):
    """A fit of logs, as the command line asks for it."""

    method: Annotated[
        Method | None,
        typer.Option(
            help="ls, wls, tls of the paper; ml (default; wls with fixed gains); iv: instruments "
            "of the demand."
        ),
    ] = None
    known: Annotated[
        Known, typer.Option(help="What is known of the payload; cad: its drawing too.")
    ] = Known.MASS
    essential: Annotated[
        float | None,
        typer.Option(
            min=1.5,
            help="Keep only essential parameters, whose relative σ are within this factor "
            "(10 to 30).",
        ),
    ] = None
    cases: Annotated[
        Path | None,
        output_option(
            "--cases", "Folder for the paper's cases 1 to 4, the nameplate gains and ml."
        ),
    ] = None
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="Also run every estimator, at the cell's cut-offs, their half and their double.",
        ),
    ] = False
    report: Annotated[
        Path | None, output_option("--report", "Folder for report.html, the certificate.")
    ] = None
    prior: Annotated[
        Path | None,
        typer.Option(
            "--prior",
            help="URDF with the inertias of the CAD model: also find every single parameter.",
        ),
    ] = None
    prior_tolerance: Annotated[
        float | None,
        typer.Option(
            "--prior-tolerance",
            min=LEAST_TOLERANCE,
            max=LARGEST_TOLERANCE,
            help="How far its masses and inertias may be off, one relative σ (0.1); alone: of the "
            "cell's URDF.",
        ),
    ] = None

    @property
    def wants_full(self) -> bool:
        """Whether all standard parameters are to be found."""
        return self.prior is not None or self.prior_tolerance is not None


@taking(FitRequest)
def fit_verb(request: FitRequest) -> None:
    """Identify all drive gains and dynamic parameters from runs without load and with a weighed
    payload.
    """

    from daq.report.fit import fit_report, fit_view
    from daq.workflow.cases import calibration_of_case
    from daq.workflow.diagnoses import geometry_refusal
    from daq.workflow.fit import compare_estimators

    if request.cases is not None:
        _fit_cases(request, request.cases)
        return
    at_most_one(essential=request.essential, prior=request.prior or request.prior_tolerance)
    request.check_places(request.report)
    if request.wants_full:
        require_packages(
            "full parameters", "the semidefinite solver", "physical", "cvxpy", "clarabel"
        )
    prior = _read_prior(request)
    with status("identifying"):
        if request.wants_full:
            _require_prior(request, prior)
        found = _fit(request)
        calibration = calibration_of_case(found, datetime.now(UTC))
        if request.wants_full:
            full_parameters = _full_set(request, found.fitted, prior)
            calibration = replace(calibration, full_parameters=full_parameters)
    refused = geometry_refusal(calibration.diagnoses)
    if refused is not None:  # nothing is written, and no gains are shown that mean nothing
        if request.json:
            print_json(fit_report(found, calibration, None))
        raise refused
    _save(found.fitted, calibration, request.out, request.pictures)
    if request.report is not None:
        _save_certificate(found.fitted, calibration, request.report)
    comparison = None
    if request.compare:
        with status("comparing estimators") as report_step:
            comparison = compare_estimators(found.fitted, report_step)
    if request.json:
        print_json(fit_report(found, calibration, comparison))
        return
    print_view(
        fit_view(found, calibration, comparison), request.out, request.report, request.pictures
    )
    say_after_fit(calibration, [*request.logs, *request.options()], request.out)


def _fit(request: FitRequest) -> CaseFit:
    """Fit the logs with what is known of the payload, and keep the essential parameters alone if
    that is wanted.
    """

    from daq.workflow.cases import CaseFit, essential_fit, fit_case, reduce_logs
    from daq.workflow.fit import fit
    from ident.estimators.refusals import require_plausible

    holdout = request.holdout or ()
    cell = corrected_cell(request.cell)
    if request.known is Known.MASS:
        fitted = fit(
            request.logs,
            holdout=holdout,
            method=request.method,
            gains_fixed=request.gains_fixed,
            cell=cell,
            lossy=request.lossy,
            channels_as_wired=request.channels_as_wired,
        )
        found = CaseFit(fitted, (), None)
    else:
        method = request.method or (Method.WLS if request.gains_fixed else Method.ML)
        reduced = reduce_logs(request.logs, holdout, cell, instruments=method is Method.IV)
        found = fit_case(reduced, method, request.known, gains_fixed=request.gains_fixed)
        one = found.fitted.identification
        require_plausible(one.estimate, one.training_error, found.fitted.cell.axis_names)
    if request.essential is None:
        return found
    return replace(essential_fit(found.fitted, request.essential), payloads=found.payloads)


def _read_prior(request: FitRequest) -> tuple[str, str] | None:
    """Name and text of the URDF of --prior; None without the option.

    It is read before the fit, which would be lost where it cannot be read.
    """

    from daq.config.urdf_text import urdf_text
    from daq.config.yaml_file import read_yaml_bytes

    if request.prior is None:
        return None
    text = urdf_text(read_yaml_bytes(request.prior), str(request.prior))
    return request.prior.name, text


def _require_prior(request: FitRequest, prior: tuple[str, str] | None) -> None:
    """Refuse a prior of another robot before the fit, which would be lost.

    The cell is that of --cell, else that of the first log.
    """

    from daq.log.reader import read_cell_of
    from daq.workflow.full_parameters import OF_CELL, require_prior, require_std_by_moves

    require_std_by_moves(request.method, gains_fixed=request.gains_fixed)
    cell = corrected_cell(request.cell) or read_cell_of(request.logs[0])
    name, urdf = prior or (OF_CELL, cell.urdf)
    require_prior(cell, urdf, name)


def _full_set(request: FitRequest, fitted: Fit, prior: tuple[str, str] | None) -> FullSet:
    """Find all standard parameters under a prior, name and URDF; None for that of the cell."""

    from daq.workflow.full_parameters import DEFAULT_TOLERANCE, OF_CELL, full_set

    name, urdf = prior or (OF_CELL, fitted.cell.urdf)
    return full_set(fitted, urdf, name, request.prior_tolerance or DEFAULT_TOLERANCE)


def _fit_cases(request: FitRequest, folder: Path) -> None:
    """Fit the paper's cases and ours, write a calibration of each,
    and tabulate them as Tables 1 to 4.
    """

    from daq.documents.calibration_file import save_calibration
    from daq.report.fit import cases_report, cases_view
    from daq.report.paper_tables import case_tables, paper_page
    from daq.workflow.cases import CASES, calibration_of_case, fit_case, reduce_logs

    at_most_one(
        cases=folder,
        method=request.method,
        known=request.known is not Known.MASS,  # every case has its own
        gains=request.gains_fixed,  # likewise
        prior=request.wants_full,
        out=request.out,
        report=request.report,
        pictures=request.pictures,
    )
    cell = corrected_cell(request.cell)
    holdout = request.holdout or ()
    inputs = (*request.logs, *holdout)
    created = datetime.now(UTC)
    files = {case.name: folder / f"{case.name}.yaml" for case in CASES}
    page_file = folder / "tables.md"
    check_output(page_file, inputs, TABLES)
    for file in files.values():
        check_output(file, inputs, CALIBRATION)
    with status("identifying") as report_step:
        reduced = reduce_logs(request.logs, holdout, cell)
        fits: dict[str, CaseFit] = {}
        for case in CASES:
            report_step(case.title)
            fits[case.name] = fit_case(
                reduced,
                case.method,
                case.known,
                gains_fixed=case.gains_fixed,
                ratio=request.essential,
            )
        calibrations = {name: calibration_of_case(found, created) for name, found in fits.items()}
    tables = case_tables(calibrations)
    with replace_output(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, file in files.items():
            save_calibration(calibrations[name], file)
        replace_file(
            page_file,
            paper_page(f"Identification of {reduced.cell.name}", tables, marker=TABLES).encode(),
        )
    if request.json:
        print_json(cases_report(fits, calibrations))
    else:
        print_view(cases_view(fits, tables), *files.values(), page_file)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualRequest(LogsRequest):
    """A search for what the model lacks, as the command line asks for it."""

    seed: Annotated[
        int, typer.Option(help="Seed of the significance test, which fixes its verdict.", min=0)
    ] = 0
    report: Annotated[
        Path | None, output_option("--report", "Folder for report.html and residual.json.")
    ] = None
    leave_out_runs: Annotated[
        bool,
        typer.Option(
            "--leave-out-runs", help="Also predict each run from a fit of the others: slow."
        ),
    ] = False
    accept_worse_holdout: Annotated[
        bool,
        typer.Option(
            "--accept-worse-holdout",
            help="Write every effect that was found, whatever held-out logs say.",
        ),
    ] = False
    write_undecided: Annotated[
        bool,
        typer.Option(
            "--write-undecided",
            help="Write effects that held-out logs neither confirm nor refute, too.",
        ),
    ] = False
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose", help="Also print the search, all errors and what these data cannot show."
        ),
    ] = False


@taking(ResidualRequest)
def residual_verb(request: ResidualRequest) -> None:
    """Fit, then detect the effect that explains the residual, add it, refit everything,
    and repeat.
    """

    from daq.report.fit import start_of
    from daq.report.residual import residual_view
    from daq.report.residual_document import residual_report
    from daq.report.residual_page import save_report
    from daq.workflow.diagnoses import geometry_refusal
    from daq.workflow.fit import calibration_of, check_holdout
    from daq.workflow.verdicts import needed_verdicts
    from ident.discovery.before_after import account

    request.check_places(request.report)
    with status("identifying") as report_step:
        closed = _search(request, report_step)
        closed = replace(closed, uncertain=needed_verdicts(closed))
        calibration = calibration_of(closed, datetime.now(UTC))
        report_step("computing the errors before and after")
        changed = account(
            start_of(closed),
            closed.steps,
            leave_out_runs=request.leave_out_runs,
            progress=report_step,
        )

    def show(*written: Path | None) -> None:
        if request.json:
            print_json(residual_report(closed, changed, calibration))
        else:
            print_view(
                residual_view(closed, changed, calibration, verbose=request.verbose), *written
            )

    try:
        if request.report is not None:
            with status("drawing the report"), replace_output(request.report):
                save_report(closed, changed, calibration, request.report)
        check_holdout(closed)
        refused = geometry_refusal(calibration.diagnoses)
        if refused is not None:
            show(request.report)  # what was found may say why
            raise refused
        _save(closed, calibration, request.out, request.pictures)
    except OutputFailed:
        show()  # what took minutes to find is not lost with the disk
        raise
    show(request.out, request.report, request.pictures)
    if not request.json:
        _say_after_search(request, calibration, closed.cell)


def _search(request: ResidualRequest, report_step: Callable[[str], None]) -> Fit:
    """Fit the logs, and add the effects that the model lacks."""

    from daq.workflow.fit import Undecided, close_loop, fit

    fitted = fit(
        request.logs,
        holdout=request.holdout or (),
        method=Method.ML,
        gains_fixed=request.gains_fixed,
        cell=corrected_cell(request.cell),
        lossy=request.lossy,
        keep_rows=True,
        channels_as_wired=request.channels_as_wired,
        judge_holdout=False,
    )
    undecided = Undecided.of(
        write=request.write_undecided, ignore_holdout=request.accept_worse_holdout
    )
    found = close_loop(fitted, request.seed, report_step, undecided)
    return replace(found, accept_worse_holdout=request.accept_worse_holdout)


def _say_after_search(request: ResidualRequest, calibration: Calibration, described: Cell) -> None:
    """Print the next step: what would be written to the controller,
    or the same search with a calibration to write.

    Args:
        request: what the search was asked for.
        calibration: that it has found.
        described: the cell as its logs describe it.
    """
    named = say_after_calibration(
        calibration, request.out, request.logs, request.cell, described=described
    )
    if named or request.out is not None:
        return
    same = request.options()
    if request.seed:
        same += ["--seed", request.seed]
    switches = {
        "--accept-losses": request.accept_losses,
        "--accept-worse-holdout": request.accept_worse_holdout,
        "--write-undecided": request.write_undecided,
    }
    same += [name for name, given in switches.items() if given]
    out = free_name(Path("calibration.yaml"))
    report = request.report or "report"
    say_next("drivegain", "residual", *request.logs, *same, "--out", out, "--report", report)


def check_report(folder: Path | None, out: Path | None = None) -> None:
    """Create the folder of a report before any long work,
    and refuse one with other files of the same names.

    A folder in which nothing is written in the end is removed again.
    """

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
        with tempfile.TemporaryFile(dir=folder):
            pass
    for name, mark in MARKS.items():
        check_replaceable(folder / name, mark, "report of `drivegain residual`")


def _save_certificate(fitted: Fit, calibration: Calibration, folder: Path) -> None:
    """Write the certificate of a fit as the page of its report."""
    from daq.report.certificate import certify
    from daq.report.certificate_page import certificate_page
    from daq.report.residual_page import PAGE, beside_nameplate

    page = certificate_page(certify(calibration, beside_nameplate(fitted, calibration)))
    with replace_output(folder):
        replace_file(folder / PAGE, page.encode())


def _save(fitted: Fit, calibration: Calibration, out: Path | None, pictures: Path | None) -> None:
    from daq.documents.calibration_file import save_calibration
    from daq.report.plots import draw_fit

    if out is not None:
        with replace_output(out):
            save_calibration(calibration, out)
    if pictures is not None:
        with replace_output(pictures):
            pictures.mkdir(parents=True, exist_ok=True)
            draw_fit(fitted, calibration, None, pictures)
