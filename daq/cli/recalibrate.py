"""`drivegain recalibrate` and `schedule`:
the job, which moves the robot, and the timer that runs it.
"""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.advice import for_command_line
from daq.cli.output import say_losses_as
from daq.cli.terminal import interruptible, say
from daq.cli.verb import JsonOption, output_option, print_json, read_cell
from daq.environment import login
from daq.errors import DaqError, ExitCode, UsageError, exit_code, writing
from daq.files import replace_file
from daq.report.text import printable
from drivers.errors import DriverError, all_notes, stop_notes
from ident.errors import IdentificationError

if TYPE_CHECKING:
    from daq.jobs.journal import Journal


def recalibrate_verb(
    cell: Annotated[
        Path, typer.Argument(help="Cell file; `recalibration` and `policy` configure the job.")
    ],
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show the next steps; move and write nothing.")
    ] = False,
    now: Annotated[
        bool, typer.Option("--now", help="Run even if the last good calibration is recent.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Record, fit, decide, and propose or apply, unattended, for a timer.

    Events go to stderr, a line each.

    Nothing moves unless the cell file has `policy: {motion: allowed}` and its interlock releases
    the robot, which is checked before every motion. An interrupted job is resumed by the next one.
    Exit codes: 0 applied, unchanged or not due; 10 a change waits for approval; 11 the interlock
    does not release the robot; 12 the bus is taken; 13 out of time; 14 held for another reason;
    others as for every verb.
    """

    from daq.jobs.journal import Form, Journal, Level, form_of

    journal = Journal(sys.stderr, form_of(sys.stderr, os.environ), lambda: datetime.now(UTC))
    say_losses_as(
        lambda lines: journal.line(
            Level.WARNING, "lines left out: nothing read the output", lines=lines
        )
    )
    try:
        _run(cell, dry_run, now, json, journal)
    except KeyboardInterrupt as interrupt:
        journal.say(Level.ERROR, "interrupted", axes="; ".join(stop_notes(interrupt)) or "stopped")
        raise typer.Exit(ExitCode.INTERRUPTED) from interrupt
    except (DaqError, DriverError, IdentificationError) as error:
        if journal.form is Form.TEXT:
            raise  # a terminal gets the message once, with its parts
        journal.say(
            Level.ERROR,
            "failed",
            error=type(error).__name__,
            text=for_command_line(str(error)),
            notes=list(all_notes(error)),
        )
        # A program reads stderr, and the message for the terminal is no line of JSON.
        raise typer.Exit(exit_code(type(error)) or ExitCode.UNEXPECTED) from error


def _run(cell: Path, dry_run: bool, now: bool, json: bool, journal: Journal) -> None:

    from daq.jobs.certificate import save_certificate
    from daq.jobs.context import Tools
    from daq.jobs.job import preview, recalibrate
    from daq.jobs.reporting import conclusion_report, text
    from daq.log.feed import Feed
    from daq.report.job_schemas import DryRunReport
    from daq.workflow.record import record

    declared = read_cell(cell)
    if now and declared.recalibration is not None:
        declared = replace(declared, recalibration=replace(declared.recalibration, every_h=0.0))
    who = f"drivegain recalibrate, {login()}"
    with interruptible(moves_again=True) as block_signals, Feed(cell) as feed:
        tools = Tools(
            save_report=partial(save_certificate, cell, declared), record=partial(record, feed=feed)
        )
        if dry_run:
            seen = preview(cell, declared, tools, journal, who=who)
            if json:
                print_json(DryRunReport(dry_run=True, remark=seen.remark, steps=list(seen.steps)))
            else:
                say("\n".join((f"Dry run: {seen.remark}", *(f"  {step}" for step in seen.steps))))
            return
        ended = recalibrate(cell, declared, tools, journal, who=who, block_signals=block_signals)
    if json:
        print_json(conclusion_report(ended, cell))
    else:
        say(printable(text(ended, cell)).removesuffix("\n"))
    if ended.exit_code:
        raise typer.Exit(ended.exit_code)


_SYSTEM = Path("/etc/systemd/system")
_OF_USER = Path(".config/systemd/user")


def schedule_verb(
    cell: Annotated[Path, typer.Argument(help="Cell file with `recalibration`.")],
    to: Annotated[
        Path | None,
        output_option("--to", "Folder of the units, by default that of systemd."),
    ] = None,
    user: Annotated[
        bool, typer.Option("--user", help="Install units of this user, not of the system.")
    ] = False,
    schedule: Annotated[
        str, typer.Option(help="weekly, daily, or as 'Sun 03:00' (systemd.time).")
    ] = "weekly",
    cron: Annotated[bool, typer.Option("--cron", help="Print a line for crontab instead.")] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Write the units; without it they are only shown.")
    ] = False,
) -> None:
    """Create a service and a timer for `drivegain recalibrate`;
    the last lines printed show how to enable them.

    The timer does not catch up on a missed date, and the job checks the interlock before every
    motion. The earlier name of this verb, `install-units`, goes on working.
    """
    from daq.jobs.context import section_of
    from daq.jobs.gain_target import file_of
    from daq.jobs.units import Installation, cron_line, next_commands, units_of

    declared = read_cell(cell)
    section = section_of(declared)
    file_of(declared)  # refuses a cell without a controller file
    place = cell.resolve()
    try:
        owner = place.owner()
    except KeyError:  # a user without a name
        owner = str(place.stat().st_uid)
    wanted = Installation(place, program(), schedule, user, owner)
    if cron:
        typer.echo(cron_line(wanted))
        if yes:
            say("Not installed: add this line to the table that `crontab -e` opens.", err=True)
        return
    check_schedule(schedule)
    folder = to or (Path.home() / _OF_USER if user else _SYSTEM)
    units = units_of(declared, section, wanted)
    for unit in units:
        require_own_unit(folder / unit.name, place)
    if yes:
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            for unit in units:
                replace_file(folder / unit.name, unit.text.encode())
    for unit in units:
        path = folder / unit.name
        typer.echo(f"Written: {path}" if yes else f"# {path}\n{unit.text}")
    if yes:
        typer.echo("Then:")
    else:
        typer.echo(
            "Dry run, nothing was written. To write this, repeat the command with --yes; then:"
        )
    for command in next_commands(wanted, units[1], folder):
        typer.echo(f"  {command}")


def program() -> Path:
    """Return the path of the command that the timer calls."""

    beside = Path(sys.executable).parent / "drivegain"
    found = beside if beside.exists() else shutil.which("drivegain")
    if found is None:
        raise UsageError(
            "drivegain",
            found=f"no such command next to {sys.executable} or on PATH",
            expected="an installed command, for the timer to call",
            remedy="install it (`pip install .`), then repeat this",
        )
    return Path(found).absolute()


def check_schedule(schedule: str) -> None:
    """Check a calendar expression with systemd, where this computer has it."""
    import subprocess

    if schedule.strip() and schedule.isprintable():
        found = ""
    else:
        found = "an empty or unprintable text"
    analyze = shutil.which("systemd-analyze")
    if not found and analyze is not None:
        done = subprocess.run(
            [analyze, "calendar", "--", schedule],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode == 0:
            found = ""
        else:
            found = " ".join(done.stderr.split()) or "no calendar expression"
    if found:
        raise UsageError(
            f"--schedule {schedule!r}",
            found=found,
            expected="a calendar expression of systemd.time(7): weekly, 'Sun 03:00', "
            "'Mon..Fri 22:30'",
            remedy="correct it; `systemd-analyze calendar EXPRESSION` shows its next date",
        )


def require_own_unit(path: Path, cell_file: Path) -> None:
    """Refuse to replace a file that this verb did not write, or a service of another cell file."""
    from daq.jobs.units import MARKS, is_service_of

    with writing(path):
        # Reading a pipe would block; only a regular file can be a unit of ours.
        if path.is_file():
            text = path.read_text(encoding="utf-8", errors="replace")
        else:
            text = None
    if text is None and not path.exists():
        return
    found = ""
    expected = ""
    if text is None or not text.startswith(MARKS):
        found = "a unit that drivegain did not write"
        expected = "one of an earlier `schedule`"
    elif path.suffix == ".service" and not is_service_of(text, cell_file):
        found = "the unit of another cell file"
        expected = f"one of {cell_file}"
    if found:
        remedy = (
            "name another folder with --to, or move it away; remove it if the cell file has moved"
        )
        raise UsageError(
            str(path), found=found, expected=f"no such file, or {expected}", remedy=remedy
        )
