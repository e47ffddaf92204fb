"""`drivegain calibrate`: one session with a person, from a wired cell to an accepted calibration."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.terminal import interruptible, output_console, progress_bar, say_last
from daq.cli.verb import CellArgument, JsonOption, Verb, output_option, print_json, taking
from daq.environment import login
from daq.errors import ExitCode, JobHeld, UsageError
from daq.report.text import printable
from drivers.errors import MotionRefused, stop_notes

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.config.recalibration import PlannedRun
    from daq.jobs.calibrate import CheckLine
    from daq.workflow.fit import Fit
    from daq.writeback.file_target import FileEdit
    from daq.writeback.target import Proposal
    from ident.calibration import Calibration
    from ident.discovery.before_after import Account

YES = "yes"  #: What the operator types to write


@dataclass(frozen=True, slots=True)
class CalibrateOptions:
    """A guided session, as the command line asks for it."""

    cell: CellArgument
    enable_motion: Annotated[
        bool, typer.Option("--enable-motion", help="Allow motion; each block still asks before power comes on.")
    ] = False
    check: Annotated[bool, typer.Option("--check", help="Only check what a session needs; nothing moves.")] = False
    payload: Annotated[str | None, typer.Option(help="Body for the loaded blocks, if the cell has several.")] = None
    target: Annotated[
        float | None, typer.Option(help="σ of every gain at which the recording ends [%].", min=0.05, max=10.0)
    ] = None
    block: Annotated[float, typer.Option(help="Duration of a block [s].", min=5.0, max=600.0)] = 20.0
    time_limit: Annotated[float, typer.Option(help="Motion after which the recording ends [min].", min=1.0)] = 30.0
    sessions: Annotated[
        Path | None, output_option("--sessions", "Folder of the sessions, by default beside the cell file.")
    ] = None
    by: Annotated[str | None, typer.Option("--by", help="Operator, for logs and audit; you, by default.")] = None
    yes_move: Annotated[
        bool, typer.Option("--yes-move", help="Do not ask before each block: on simulated cells alone.")
    ] = False
    json: JsonOption = False


@dataclass(frozen=True, slots=True)
class Person:
    """An operator at the terminal, who mounts, weighs, permits each motion and types `yes` to write."""

    cell: Cell
    who: str
    may_move: bool  #: --enable-motion
    asks_before_motion: bool  #: not with --yes-move

    @property
    def unguarded(self) -> bool:
        """No: a person at the terminal uses `record --unguarded` for such drives."""
        return False

    def mount(self, run: PlannedRun) -> None:
        """Ask for what the next block carries."""
        if run.payload is None:
            wanted = "NOTHING on the flange"
        else:
            wanted = f"{run.payload.upper()} ({run.mass_kg:g} kg) on the flange"
        say("")
        say(f"{run.name}: {wanted}")
        if self.asks_before_motion:
            ask("Mount it if it is not, leave the cell, then press Enter")

    def weigh(self, payload: str) -> float:
        """Ask for the mass from the scale, twice."""
        from daq.workflow.safeguards import check_entered_mass

        declared = next(one for one in self.cell.payloads if one.name == payload)
        while True:
            first = _number(ask(f"Mass of {payload} read from the scale [kg]"))
            second = _number(ask("The same once more"))
            if first is not None and first == second:
                check_entered_mass(self.cell, declared.payload, first)
                return first
            say("Found two different numbers, or none; type the mass in kg, such as 4.59, twice.")

    def permit_motion(self, run: PlannedRun) -> str:
        """Ask once more before power comes on."""
        if not self.may_move:
            raise MotionRefused("motion is disabled", expected="permission", remedy="pass --enable-motion")
        if self.asks_before_motion:
            ask(f"The robot moves now. Press Enter to start {run.name}, Ctrl-C to stop here")
        return self.who

    def approve(self, proposal: Proposal[FileEdit], *, touched: bool) -> bool:
        """Show the change, and ask for `yes`."""
        from daq.report.proposal import show_proposal

        show_proposal(proposal, output_console())
        if touched:
            say("The controller's file was written or rolled back since the session began.")
        return ask(f"Type {YES} to write these gains to {proposal.edit.subject}, anything else to leave them") == YES


def say(text: str) -> None:
    """Print a line for the operator."""
    typer.echo(printable(text), err=True)


def ask(question: str) -> str:
    """Ask the operator; return the answer without spaces.

    Raises:
        JobHeld: nobody answers.
    """
    typer.echo(printable(f"{question}: "), err=True, nl=False)
    answer = sys.stdin.readline()
    if not answer:
        typer.echo("", err=True)
        raise JobHeld(
            question,
            found="no answer: the input has ended",
            expected="an operator at the terminal",
            remedy="start the same command in a terminal; the session goes on where it is",
        )
    return answer.strip()


def _number(text: str) -> float | None:
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return None


def _check_yes_move(cell: Cell, given: bool) -> None:
    """Refuse --yes-move where a machine may be on the bus."""
    from daq.config.cell_buses import SIMULATED_INTERFACES

    real = [bus.interface for bus in cell.buses if bus.interface not in SIMULATED_INTERFACES]
    if given and real:
        raise UsageError(
            "--yes-move",
            found=f"a bus on which a robot may be ({', '.join(real)})",
            expected="a simulated cell",
            remedy="leave it out: each block asks before power comes on",
        )


def _show_check(lines: Sequence[CheckLine]) -> None:
    """Print the table of what a session needs; end with an exit code where something is missing."""
    for line in lines:
        mark = "✓" if line.passed else "✗"
        typer.echo(printable(f"{mark} {line.name}: {line.text}"))
    if not all(line.passed for line in lines):
        raise typer.Exit(ExitCode.CONFIGURATION)


@taking(CalibrateOptions)
def calibrate_verb(options: CalibrateOptions) -> None:
    """Calibrate a cell in one session: check, record until every gain is precise, identify, write, accept.

    Nothing moves without --enable-motion, and each block asks before power comes on. Ctrl-C stops the axes; the same
    command goes on where the session is. Nothing is written to the controller before you have typed `yes`.
    """
    from daq.config.cell_file import load_cell
    from daq.jobs.calibrate import calibrate, check, context_of, payload_of
    from daq.jobs.context import Tools
    from daq.jobs.guided import TARGET_PERCENT, GuidedSettings
    from daq.jobs.journal import Form, Journal
    from daq.jobs.reporting import conclusion_report, text
    from daq.jobs.session import CALIBRATION
    from daq.log.feed import Feed
    from daq.report.certificate import compare
    from daq.report.residual_page import save_report
    from daq.workflow.record import record
    from daq.writeback.request import Request

    declared = load_cell(options.cell)
    _check_yes_move(declared, options.yes_move)
    payload = payload_of(declared, options.payload)
    settings = GuidedSettings(
        options.sessions or options.cell.with_suffix(".sessions"),
        payload.name,
        target_percent=options.target or TARGET_PERCENT,
        block_s=options.block,
        time_limit_min=options.time_limit,
    )
    person = Person(declared, options.by or login(), options.enable_motion, not options.yes_move)
    journal = Journal(sys.stderr, Form.TEXT, lambda: datetime.now(UTC))

    def certify(fitted: Fit, changed: Account, calibration: Calibration, folder: Path) -> None:
        request = Request(calibration, datetime.now(UTC))
        command = f"drivegain apply {shlex.quote(str(options.cell))} {shlex.quote(str(folder.parent / CALIBRATION))}"
        save_report(fitted, changed, calibration, folder, compare(declared, request, command))

    try:
        with (
            interruptible() as block_signals,
            Feed(options.cell) as feed,
            progress_bar("recording") as report_progress,
        ):
            recorder = partial(record, feed=feed, progress=lambda done, total: report_progress(done, total, "moves"))
            tools = Tools(save_report=certify, record=recorder)
            if options.check:
                context = context_of(options.cell, declared, settings, person, tools, journal)
                _show_check(check(context, options.payload, options.block))
                return
            if not options.enable_motion:
                raise MotionRefused("motion is disabled", expected="permission", remedy="pass --enable-motion")
            ended = calibrate(options.cell, declared, settings, person, tools, journal, block_signals=block_signals)
    except KeyboardInterrupt as interrupt:
        axes = "; ".join(stop_notes(interrupt)) or "axes stopped"
        say_last(f"interrupted: {axes}; the same command goes on where the session is")
        raise typer.Exit(ExitCode.INTERRUPTED) from interrupt
    if options.json:
        print_json(conclusion_report(ended, options.cell))
    else:
        typer.echo(printable(text(ended, options.cell)), nl=False)
    if ended.exit_code:
        raise typer.Exit(ended.exit_code)


CALIBRATE = Verb("calibrate", calibrate_verb, "drivegain calibrate press-4/cells/press-4.yaml --enable-motion")
