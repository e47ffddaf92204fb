"""`drivegain calibrate`: one session with a person,
from a wired cell to an accepted calibration.
"""

from __future__ import annotations

import os
import sys
import termios
import time
import webbrowser
from array import array
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from fcntl import ioctl
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.cli.failure import ErrorParts
from daq.cli.output import output_error, wait_until_shown
from daq.cli.terminal import interruptible, output_console, progress_bar, say_last
from daq.cli.verb import (
    CellArgument,
    JsonOption,
    output_option,
    print_json,
    read_cell,
    require_printable,
    taking,
)
from daq.environment import login
from daq.errors import ExitCode, JobHeld, UsageError, reason_of
from daq.report.text import printable
from drivers.errors import MotionRefused, stop_notes

if TYPE_CHECKING:
    from daq.config.cell import Cell, WeighedPayload
    from daq.config.recalibration import PlannedRun
    from daq.jobs.calibrate import CheckLine
    from daq.jobs.context import Tools
    from daq.jobs.journal import Journal
    from daq.log.feed import Feed, QuickLook
    from daq.workflow.fit import Fit
    from daq.workflow.record import Recorded, RecordingRequest
    from daq.writeback.target import Proposal
    from ident.calibration import Calibration
    from ident.discovery.before_after import Account

YES = "yes"  #: What the operator types to write
KEEP = "keep"  #: What the operator types where a block shows a mistake and is right all the same
SHOWN_WITHIN_S = 0.5  #: A terminal that takes longer for a question was stopped
MOVES = "moves"  #: Unit of the progress of a block
LONGEST_ANSWER = 60  #: Characters of an answer that are shown; someone may paste a whole page


@dataclass(frozen=True, slots=True)
class CalibrateOptions:
    """A guided session, as the command line asks for it."""

    cell: CellArgument
    enable_motion: Annotated[
        bool,
        typer.Option(
            "--enable-motion", help="Allow motion; each block still asks before power comes on."
        ),
    ] = False
    check: Annotated[
        bool, typer.Option("--check", help="Only check what a session needs; nothing moves.")
    ] = False
    payload: Annotated[
        str | None, typer.Option(help="Body for the loaded blocks, if the cell has several.")
    ] = None
    target: Annotated[
        float | None,
        typer.Option(
            help="σ of every gain at which the recording ends [%]; target_sigma_percent of the "
            "cell file by default.",
            min=0.05,
            max=10.0,
        ),
    ] = None
    block: Annotated[float, typer.Option(help="Duration of a block [s].", min=5.0, max=600.0)] = (
        20.0
    )
    rehearse: Annotated[
        bool,
        typer.Option(
            "--rehearse", help="First make the moves of three blocks at 25 % of their speed."
        ),
    ] = False
    time_limit: Annotated[
        float, typer.Option(help="Motion after which the recording ends [min].", min=1.0)
    ] = 30.0
    sessions: Annotated[
        Path | None,
        output_option("--sessions", "Folder of the sessions, by default next to the cell file."),
    ] = None
    by: Annotated[
        str | None, typer.Option("--by", help="Operator, for logs and audit; you, by default.")
    ] = None
    yes_move: Annotated[
        bool,
        typer.Option("--yes-move", help="Do not ask before each block: on simulated cells alone."),
    ] = False
    json: JsonOption = False


@dataclass(frozen=True, slots=True)
class Person:
    """An operator at the terminal, who mounts, weighs,
    permits each motion and types `yes` to write.
    """

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
        from daq.jobs.position import on_flange

        tell("")
        tell(f"── {run.name}: {on_flange(run)} ──", bold=True)
        if self.asks_before_motion:
            ask_enter("Check the flange, leave the cell, press Enter")

    def weigh(self, payload: str) -> float:
        """Ask for the mass from the scale, twice, until both are the same and that of the cell
        file.
        """
        declared = next(one for one in self.cell.payloads if one.name == payload)
        while True:
            first_kg = _number(ask(f"Mass of {payload} read from the scale [kg]"))
            second_kg = _number(ask("The same once more"))
            if first_kg is None or first_kg != second_kg:
                tell(
                    "Found two different numbers, or none; type the mass in kg, such as "
                    "4.59, twice."
                )
                continue
            refusal = _refused_mass(declared, first_kg)
            if not refusal:
                return first_kg
            tell(refusal)

    def permit_motion(self, run: PlannedRun) -> str:
        """Ask once more before power comes on."""
        if not self.may_move:
            raise MotionRefused(
                "motion is disabled", expected="permission", remedy="pass --enable-motion"
            )
        if self.asks_before_motion:
            ask_enter("The robot moves now: Enter starts it, Ctrl-C stops")
        return self.who

    def record_again(self, run: PlannedRun, blocks: Sequence[str], mistake: str) -> bool:
        """Ask whether blocks with a mistake are recorded again; `keep` keeps them."""
        if len(blocks) == 1:
            them = "it"
        else:
            them = f"these {len(blocks)} blocks"
        is_kept = ask_word(
            f"Press Enter to record {them} again, or type {KEEP} to keep {run.name} as it is", KEEP
        )
        return not is_kept

    def approve(self, proposal: Proposal[Any], *, touched: bool) -> bool:
        """Show the change, and ask for `yes`."""
        from daq.report.proposal import show_proposal

        show_proposal(proposal, output_console())
        if touched:
            tell("! The controller's file was written or rolled back since the session began.")
        return ask_word(f"Type {YES} to write to {proposal.edit.subject}, else Enter", YES)


def _refused_mass(declared: WeighedPayload, mass_kg: float) -> str:
    """Return why a mass from the scale is not taken; empty where it is."""
    from daq.workflow.safeguards import agree

    tolerance_kg = declared.mass_tolerance_kg
    if agree(mass_kg, declared.mass_kg, tolerance_kg):
        return ""
    expected = f"the cell file has {declared.mass_kg:g} kg within {tolerance_kg:g} kg"
    if agree(mass_kg / 1000.0, declared.mass_kg, tolerance_kg):
        return f"Found {mass_kg:g}, which is the mass in grams; {expected}. Type it in kg."
    return (
        f"Found {mass_kg:g} kg; {expected}. Weigh it again. If the cell file is wrong, press "
        "Ctrl-C and correct it: all gains are in proportion to this mass."
    )


def tell(text: str, *, bold: bool = False) -> None:
    """Print a line for the operator."""
    typer.secho(printable(text), err=True, bold=bold)


def ask_enter(question: str) -> None:
    """Ask the operator for Enter alone.

    Any other line is no permission: it may be a *no*, or meant for another window.

    Raises:
        JobHeld: as `ask`.
    """
    while answer := ask(question):
        tell(
            f"Found {in_short(answer)}, expected Enter alone. Nothing moves: press Enter to go on, "
            "or Ctrl-C to stop."
        )


def in_short(answer: str) -> str:
    """Return what was typed in quotes, of a long line its start."""
    if len(answer) > LONGEST_ANSWER:
        answer = f"{answer[:LONGEST_ANSWER]}…"
    return repr(answer)


def ask_word(question: str, word: str) -> bool:
    """Ask the operator for one word; return whether it was typed, in letters of either case.

    Enter alone, or `no`, means that it was not. Any other answer may be the word with a slip, so
    the question is asked again.

    Raises:
        JobHeld: as `ask`.
    """
    while True:
        answer = ask(question)
        if answer.casefold() == word:
            return True
        if answer.casefold() in {"", "no"}:
            return False
        tell(f"Found {in_short(answer)}, expected {word}, or Enter alone.")


def ask(question: str) -> str:
    """Ask the operator; return the answer without spaces.

    Only what is typed at a terminal after the question answers it: a key that was pressed too
    often before must not start the robot.

    Raises:
        JobHeld: the input has ended, or the question cannot be shown.
    """
    _show_question(question)
    while not _shown_at_once():
        tell("")  # the person has not seen it before, and may have typed meanwhile
        _show_question(question)
    _require_shown(question)
    answer = ""
    if sys.stdin is not None:  # it is None where the input was closed
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


def _show_question(question: str) -> None:
    if _discard_typed_ahead():
        tell("What was typed before this question does not count.")
    typer.secho(printable(f">>> {question}: "), err=True, nl=False, bold=True)


def _shown_at_once() -> bool:
    """Wait until a question is on the screen; return whether nothing can have been typed before."""
    began_s = time.monotonic()
    wait_until_shown(sys.stdout, sys.stderr)
    return time.monotonic() - began_s < SHOWN_WITHIN_S


def _require_shown(question: str) -> None:
    """Refuse to take an answer to a question that went nowhere: it may start the robot.

    Raises:
        JobHeld: the error output is closed, or takes nothing.
    """
    found = ""
    if sys.stderr is None:
        found = "the error output is closed"
    else:
        error = output_error(sys.stderr)
        if error is not None:
            found = f"the error output takes nothing: {reason_of(error)}"
    if found:
        raise JobHeld(
            question,
            found=f"a question that cannot be shown; {found}",
            expected="an operator who sees it",
            remedy="start the same command in a terminal; the session goes on where it is",
        )


def _discard_typed_ahead() -> bool:
    """Discard what waits in the terminal's input; return whether a whole line did.

    The lines of a pipe stay: a script writes its answers before it is asked.
    """
    if sys.stdin is None or not sys.stdin.isatty():
        return False
    waiting_bytes = array("i", [0])
    ioctl(sys.stdin, termios.FIONREAD, waiting_bytes)
    termios.tcflush(sys.stdin, termios.TCIFLUSH)
    return waiting_bytes[0] > 0


def open_page(page: Path) -> None:
    """Show a page in the browser, where a person is at a terminal with a display."""
    has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if has_display and sys.stdin is not None and sys.stdin.isatty():
        webbrowser.open(page.resolve().as_uri())


def _number(text: str) -> float | None:
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return None


def _check_yes_move(cell: Cell, given: bool) -> None:
    """Refuse --yes-move where a machine may be on the bus."""
    real = [bus.interface for bus in cell.buses if not bus.kind.is_simulated]
    if given and real:
        raise UsageError(
            "--yes-move",
            found=f"a bus on which a robot may be ({', '.join(real)})",
            expected="a simulated cell",
            remedy="leave it out: each block asks before power comes on",
        )


def show_check(lines: Sequence[CheckLine]) -> None:
    """Print the table of what a session needs; end with an exit code where something is missing."""
    for line in lines:
        if line.error is None:
            typer.echo(printable(f"✓ {line.name}: {line.text}"))
            continue
        parts = ErrorParts.of(line.error, "calibrate")
        typer.echo(f"✗ {line.name}")
        for label, text, _ in parts.lines():
            typer.echo(printable(f"    {label}: {text}"))
    if not all(line.passed for line in lines):
        raise typer.Exit(ExitCode.CONFIGURATION)


@dataclass(slots=True)
class Looks:
    """Shows the gains after each move, while a block is recorded."""

    feed: Feed  #: for consoles
    journal: Journal  #: for the terminal
    block: str = ""  #: that is being recorded; empty between two blocks
    last: QuickLook | None = None  #: that was printed
    remark: str = MOVES  #: next to the progress bar of a block

    def show(self, look: QuickLook) -> None:
        """Publish a look, put its worst gain next to the bar, and print it if it is new;
        in the thread that receives it.

        One that comes after the end of its block is not printed: the operator types then.
        """
        from daq.jobs.journal import Level
        from daq.jobs.live_gains import tells_something_new

        self.feed.look(look)
        if look.gains:
            worst = look.gains[0]
            self.remark = (
                f"{MOVES}, {worst.axis} ± {worst.std_percent:.2f} % (target "
                f"{worst.target_percent:g} %)"
            )
        is_late = look.block not in ("", self.block)
        if is_late or not tells_something_new(look, self.last):
            return
        self.last = look
        # The present stream: while a progress bar is shown, it prints above the bar.
        journal = replace(self.journal, stream=sys.stderr)
        journal.say(Level.INFO, "quick estimate", **asdict(look))


def _tools(cell_file: Path, cell: Cell, looks: Looks) -> Tools:
    """Return the tools of a session, which show a person what they do."""
    from daq.jobs.certificate import save_certificate
    from daq.jobs.context import Tools
    from daq.report.residual_page import PAGE
    from daq.workflow.record import record

    def save_report(fitted: Fit, changed: Account, calibration: Calibration, folder: Path) -> None:
        certificate = save_certificate(cell_file, cell, fitted, changed, calibration, folder)
        tell("")
        tell(f"Verdict: {certificate.sentence}", bold=True)
        open_page(folder / PAGE)

    def record_with_bar(request: RecordingRequest, **further: Any) -> Recorded:
        # A bar of its own: between two blocks the operator types, and a bar would take the line.
        with progress_bar(f"recording {request.out.stem}") as report_progress:
            looks.block = request.out.stem
            looks.remark = MOVES
            try:
                return record(
                    request,
                    feed=looks.feed,
                    progress=lambda done, total: report_progress(done, total, looks.remark),
                    **further,
                )
            finally:
                looks.block = ""

    return Tools(save_report=save_report, record=record_with_bar)


@taking(CalibrateOptions)
def calibrate_verb(options: CalibrateOptions) -> None:
    """Calibrate a cell in one session: check, record until every gain is precise, identify, write,
    accept.

    Nothing moves without --enable-motion, and each block asks before power comes on. Ctrl-C stops
    the axes; the same command goes on where the session is. Nothing is written to the controller
    before you have typed `yes`.
    """
    from daq.jobs.calibrate import calibrate, check_readiness, context_of, payload_for_blocks
    from daq.jobs.guided import GuidedSettings
    from daq.jobs.journal import Form
    from daq.jobs.live_gains import LiveGains
    from daq.jobs.position import sessions_folder
    from daq.jobs.reporting import ending, session_report
    from daq.jobs.story import Story
    from daq.log.feed import Feed

    require_printable("--by", options.by)
    declared = read_cell(options.cell)
    _check_yes_move(declared, options.yes_move)
    payload_name = options.payload or ""
    if not options.check:  # whose table says what is wrong with it
        payload_name = payload_for_blocks(declared, options.payload).name
    settings = GuidedSettings(
        options.sessions or sessions_folder(options.cell),
        payload_name,
        target_percent=options.target or declared.target_sigma_percent,
        block_s=options.block,
        time_limit_min=options.time_limit,
        rehearse=options.rehearse,
    )
    person = Person(declared, options.by or login(), options.enable_motion, not options.yes_move)
    journal = Story(sys.stderr, Form.TEXT, lambda: datetime.now(UTC))

    try:
        with interruptible(moves_again=True) as block_signals, Feed(options.cell) as feed:
            looks = Looks(feed, journal)
            tools = _tools(options.cell, declared, looks)
            if options.check:
                context = context_of(options.cell, declared, settings, person, tools, journal)
                show_check(check_readiness(context, options.payload, options.block))
                return
            if not options.enable_motion:
                raise MotionRefused(
                    "motion is disabled", expected="permission", remedy="pass --enable-motion"
                )
            with LiveGains(options.cell, payload_name, settings.target_percent, looks.show):
                ended = calibrate(
                    options.cell,
                    declared,
                    settings,
                    person,
                    tools,
                    journal,
                    block_signals=block_signals,
                )
    except KeyboardInterrupt as interrupt:
        axes = "; ".join(stop_notes(interrupt)) or "no axis moves"
        say_last(f"interrupted: {axes}; the same command goes on where the session is")
        raise typer.Exit(ExitCode.INTERRUPTED) from interrupt
    if options.json:
        print_json(session_report(ended, options.cell))
    else:
        typer.echo(printable(ending(ended, options.cell)), nl=False)
    if ended.exit_code:
        raise typer.Exit(ended.exit_code)
