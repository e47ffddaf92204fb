"""`drivegain record`: make the moves of a plan, and log them."""

from __future__ import annotations

import shlex
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.next_step import say_after_record
from daq.cli.terminal import interruptible, progress_bar, say, say_last
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
from daq.errors import DiskSpaceShort, ExitCode, OutputFailed, UsageError, counted
from daq.files import is_taken, require_new
from drivers.errors import POWERED, DriverError, SampleLost, all_notes, error_chain

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from ident.model.bodies import Payload


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """A recording, as the command line asks for it."""

    cell: CellArgument
    plan: Annotated[Path, typer.Argument(help="Plan written by `drivegain plan`.")]
    out: Annotated[Path, output_option("--out", "Log to write (.mcap); must not exist.")]
    enable_motion: Annotated[
        bool,
        typer.Option(
            "--enable-motion",
            help="Allow motion. Without it nothing moves, whatever the cell file says.",
        ),
    ] = False
    payload: Annotated[
        str | None, typer.Option(help="Mounted payload, by its name in the cell file.")
    ] = None
    mass: Annotated[
        float | None, typer.Option(help="Mass of the payload read off the scale [kg].", min=0.0)
    ] = None
    operator: Annotated[
        str | None, typer.Option(help="Operator of this recording; you, by default.")
    ] = None
    speed: Annotated[
        float, typer.Option(help="Share of the plan's speed, for a first run.", min=0.05, max=1.0)
    ] = 1.0
    unguarded: Annotated[
        bool,
        typer.Option(
            "--unguarded",
            help="Move axes that do not stop by themselves when this program is killed.",
        ),
    ] = False
    json: JsonOption = False


@taking(RecordOptions)
def record_verb(options: RecordOptions) -> None:
    """Execute the moves of a plan and log every sample; Ctrl-C, Ctrl-Z and SIGTERM stop the axes.

    Where the cell file has an interlock (`recalibration`), it must release the robot: exit code
    11 where it does not.
    A run with losses is kept, marked invalid, and ends with exit code 4; `fit` refuses it.
    """
    from daq.log.feed import Feed
    from daq.report.log import record_report
    from daq.workflow.bus_lock import bus_lock
    from daq.workflow.plan import load_plan, slowed
    from daq.workflow.record import RecordingRequest, record
    from daq.workflow.safeguards import check_entered_mass

    require_printable("--operator", options.operator)
    declared = read_cell(options.cell)
    moves = slowed(declared, load_plan(options.plan, declared), options.speed)
    who = options.operator or login()
    carried = mounted(declared, options.payload)
    check_entered_mass(declared, carried, options.mass)
    out = options.out
    part = _free(out)
    not_weighed = carried is not None and options.mass is None
    before_motion = list(_before_motion(declared, options.plan, not_weighed))
    for line in before_motion:
        say(line, err=True)
    request = RecordingRequest(
        options.cell,
        declared,
        moves,
        out,
        payload=carried,
        operator=who,
        granted_by=who if options.enable_motion else None,
        run_id=str(uuid.uuid4()),
        speed=options.speed,
        entered_kg=options.mass,
        unguarded=options.unguarded,
    )
    try:
        with (
            bus_lock(declared),
            interruptible() as block_signals,
            Feed(options.cell) as feed,
            progress_bar("recording") as report_progress,
        ):
            if feed.remark:
                say(feed.remark, err=True)
            done = record(
                request,
                block_signals=block_signals,
                progress=lambda count, total: report_progress(count, total, "moves"),
                feed=feed,
            )
    except KeyboardInterrupt as interrupt:
        made = next((path for path in (out, part) if path.exists()), None)
        say_last(_interrupted(interrupt, made, out))
        raise typer.Exit(ExitCode.INTERRUPTED) from interrupt
    except DriverError as error:
        _add_what_is_kept(error, declared, part)
        raise
    for warning in done.warnings:
        if warning not in before_motion:  # that of a bus without room comes at both times
            say(warning, err=True)
    if options.json:
        print_json(record_report(out, done, declared))
    else:
        if done.log.valid:
            verdict = "complete"
        else:
            verdict = f"INVALID: {done.log.reason}; a fit will refuse it"
        say(
            f"{out}: {done.log.samples} samples, {counted(done.log.lost_cycles, 'cycle')} lost, "
            f"{verdict}"
        )
    if not done.log.valid:
        # The log is kept; the exit code keeps a script from using it.
        raise typer.Exit(ExitCode.DATA_UNFIT)
    if not options.json:
        say_after_record(options.cell, declared, options.plan, out, loaded=carried is not None)


def _add_what_is_kept(error: DriverError, cell: Cell, part: Path) -> None:
    """Say in notes of an error what became of the samples,
    and what helps a cell that is too slow for its clock.
    """
    from daq.config.cell import PacingMode

    if part.exists():
        error.add_note(
            f"kept: the samples recorded until then are in {part}, which `fit` does not read; "
            f"{_next_command(part)}"
        )
    if (
        isinstance(error, SampleLost)
        and cell.sync is not None
        and cell.sync.pacing is PacingMode.TIMED
    ):
        real = not all(bus.kind.is_simulated for bus in cell.buses)
        if real:
            hint = "check the load of bus and computer, or use a longer `sync.period_us`"
        else:
            hint = (
                "a cell of `drivegain simulate` answers as fast as its computer can and needs "
                "`sync.pacing: lockstep` in the cell file"
            )
        error.add_note(f"hint: {hint}")


def _before_motion(cell: Cell, plan: Path, not_weighed: bool) -> Iterator[str]:
    """Remarks for a person before the axes move."""
    from daq.config.cell_buses import load_warnings
    from daq.report.bus_views import load_lines
    from daq.report.plan_preview import find_preview

    if not_weighed:
        yield (
            "the payload's mass was not entered from the scale (--mass KG); `drivegain apply` "
            "will ask for it"
        )
    if (page := find_preview(plan)) is not None:
        yield f"preview of these moves: {page}"
    yield from load_lines(cell)
    yield from load_warnings(cell)


def _free(out: Path) -> Path:
    """Return the file in which the log grows until it is finished, before the bus is used;
    neither may exist.
    """
    part = out.with_name(out.name + ".part")
    unfinished = (
        "the rest of a recording of that name that failed, was interrupted, or is still running"
    )
    require_new(out, "choose another --out, or move it away")
    if is_taken(part):
        raise UsageError(
            str(part),
            found=unfinished,
            expected="none",
            remedy=f"`fit` does not read it; {_next_command(part)}",
        )
    return part


def _next_command(part: Path) -> str:
    aside = part.with_name(part.name + ".kept")
    one = shlex.quote(str(part))
    other = shlex.quote(str(aside))
    saved = shlex.quote(str(part.with_name(part.name.replace(".mcap.part", "") + "-partial.mcap")))
    return (
        f"`drivegain salvage {one} --out {saved}` saves what is in it; to record under this name, "
        f"remove it (`rm {one}`) or keep it (`mv {one} {other}`), or choose another --out"
    )


def _interrupted(interrupt: KeyboardInterrupt, made: Path | None, out: Path) -> str:
    """Describe in one line what became of the axes and of the recording."""
    # A stop that could not be confirmed is noted on the interrupt; an interrupt during a stop for
    # another reason cut that stop short.
    behind = error_chain(interrupt)[1:]
    causes = (DriverError, OutputFailed, DiskSpaceShort, KeyboardInterrupt)
    first = next((error for error in behind if isinstance(error, causes)), None)
    if first is None:
        notes = []
    else:
        notes = [f"it came while they were stopped after {type(first).__name__}: {first}"]
    notes += all_notes(interrupt)
    problems = "; ".join(note for note in notes if not note.startswith(POWERED))
    powered = ", ".join(note.removeprefix(POWERED) for note in notes if note.startswith(POWERED))
    if powered:
        axes = f"{powered} NOT CONFIRMED WITHOUT POWER, use the emergency stop"
    else:
        axes = "axes stopped"
    axes += f" ({problems})" if problems else ""
    if made is None:
        return f"interrupted: {axes}; nothing was recorded"
    if made == out:
        return f"interrupted: {axes}; all moves were finished, and {out} is complete"
    kept = f"the samples recorded so far are in {made}, which `fit` does not read"
    return f"interrupted: {axes}; {kept}; {_next_command(made)}"


def mounted(cell: Cell, name: str | None) -> Payload | None:
    """Return the payload of that name."""
    known = {payload.name: payload.payload for payload in cell.payloads}
    if name is None or name in known:
        return None if name is None else known[name]
    alike = [one for one in known if one.casefold() == name.casefold()]
    remedy = "weigh it and add it to `payloads` of the cell file"
    if alike:
        remedy = f"write `--payload {alike[0]}`"
    raise UsageError(
        f"payload {name!r}",
        found="no such payload in the cell file",
        expected=", ".join(known) or "none: the cell declares no payloads",
        remedy=remedy,
    )
