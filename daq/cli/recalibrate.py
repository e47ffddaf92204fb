"""`drivegain recalibrate`: the scheduled job. It moves the robot, by the cell's policy and its interlock."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.residual import save_report
from daq.cli.terminal import interruptible
from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.config.cell_file import load_cell
from daq.environment import login
from daq.errors import DaqError, ExitCode, OutputFailed, UsageError, exit_code
from daq.files import replace_file
from daq.jobs.conclusion import document, text
from daq.jobs.job import preview, recalibrate
from daq.jobs.journal import Form, Journal, Level, form_of
from daq.jobs.preflight import section_of, target_of
from daq.jobs.tools import Tools
from daq.jobs.units import MARK, Installation, Unit, cell_option, cron_line, next_commands, units_of
from drivers.errors import WHILE, DriverError
from ident.errors import IdentificationError


def recalibrate_verb(
    cell: Annotated[Path, typer.Option(help="Cell file; its `recalibration` and `policy` say what is done.")],
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Ask interlock and drives, say what would be done, move and write nothing."),
    ] = False,
    now: Annotated[
        bool, typer.Option("--now", help="Also where the last good calibration is young: a motor was replaced.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Record, fit, decide, and propose or apply, without anybody: for a timer. Events go to stderr, a line each.

    Nothing moves unless the cell file says `policy: {motion: allowed}` and its interlock lets the robot move, which is
    asked before every motion. A job that was ended is taken up by the next one. Exit codes: 0 applied, unchanged or not
    due; 10 a change waits for a person; 11 the interlock does not let the robot move; 12 the bus is taken; 13 out of
    time; 14 held for another reason; else as every verb.
    """
    journal = Journal(sys.stderr, form_of(sys.stderr, os.environ), lambda: datetime.now(UTC))
    try:
        _run(cell, dry_run, now, json, journal)
    except KeyboardInterrupt as interrupt:
        notes = [note for note in getattr(interrupt, "__notes__", ()) if note.startswith(WHILE)]
        journal.say(Level.ERROR, "interrupted", axes="; ".join(notes) or "stopped")
        raise typer.Exit(ExitCode.INTERRUPTED) from interrupt
    except (DaqError, DriverError, IdentificationError) as error:
        journal.say(Level.ERROR, "failed", error=type(error).__name__, text=str(error), notes=error_notes(error))
        if journal.form is Form.TEXT:
            raise
        # A program reads stderr: the message for a person would be no line of JSON.
        raise typer.Exit(exit_code(type(error)) or ExitCode.UNEXPECTED) from error


def error_notes(error: BaseException) -> list[str]:
    """What was noted on an error on its way up."""
    return list(getattr(error, "__notes__", ()))


def _run(cell: Path, dry_run: bool, now: bool, json: bool, journal: Journal) -> None:
    declared = load_cell(cell)
    if now and declared.recalibration is not None:
        declared = replace(declared, recalibration=replace(declared.recalibration, every_h=0.0))
    who = f"drivegain recalibrate, {login()}"
    tools = Tools(save_report=save_report)
    with interruptible() as block_signals:
        if dry_run:
            seen = preview(cell, declared, tools, journal, who=who)
            if json:
                print_json({"dry_run": True, "remark": seen.remark, "steps": seen.steps})
            else:
                typer.echo("\n".join((f"Dry run: {seen.remark}", *(f"  {step}" for step in seen.steps))))
            return
        ended = recalibrate(cell, declared, tools, journal, who=who, block_signals=block_signals)
    if json:
        print_json(document(ended, cell))
    else:
        typer.echo(printable(text(ended, cell)), nl=False)
    if ended.exit_code:
        raise typer.Exit(ended.exit_code)


RECALIBRATE = Verb("recalibrate", recalibrate_verb, "drivegain recalibrate --cell cells/demo.yaml --dry-run")


# `drivegain install-units`: let systemd or cron run the cell's scheduled recalibration. A dry run at first.


SYSTEM, OF_USER = Path("/etc/systemd/system"), Path(".config/systemd/user")


def install_units(
    cell: Annotated[Path, typer.Option(help="Cell file with `recalibration`.")],
    to: Annotated[
        Path | None,
        typer.Option("--to", help="Folder of the units; /etc/systemd/system, or the user's, where it is not given."),
    ] = None,
    user: Annotated[bool, typer.Option("--user", help="Units of this user, not of the system.")] = False,
    schedule: Annotated[
        str, typer.Option(help="When: weekly, daily, or a calendar expression of systemd such as 'Sun 03:00'.")
    ] = "weekly",
    cron: Annotated[bool, typer.Option("--cron", help="Print a line for crontab instead.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Write the units; without it they are only shown.")] = False,
) -> None:
    """Make a service and a timer for `drivegain recalibrate`; nothing is enabled, the last lines say how to.

    The timer never makes up for a date that it missed, and the job's interlock is asked before every motion.
    """
    declared = load_cell(cell)
    section, _ = section_of(declared), target_of(declared)
    wanted = Installation(cell.resolve(), program(), schedule, user, owner_of(cell.resolve()))
    if cron:
        typer.echo(cron_line(wanted))
        if yes:
            typer.echo("Not installed: put this line into the table that `crontab -e` opens.", err=True)
        return
    check_schedule(schedule)
    folder = to or (Path.home() / OF_USER if user else SYSTEM)
    units = units_of(declared, section, wanted)
    for unit in units:
        require_own_unit(folder / unit.name, cell_option(wanted) if unit.name.endswith(".service") else "")
    if yes:
        _write(folder, units)
    for unit in units:
        typer.echo(f"Written: {folder / unit.name}" if yes else f"# {folder / unit.name}\n{unit.text}")
    typer.echo("Then:" if yes else "Dry run, nothing was written. To write this, repeat the command with --yes; then:")
    for command in next_commands(wanted, units[1], folder):
        typer.echo(f"  {command}")


def program() -> Path:
    """The command that a timer must call, where it is.

    Raises:
        UsageError: drivegain is not installed as a command.
    """
    beside = Path(sys.executable).parent / "drivegain"
    found = beside if beside.exists() else shutil.which("drivegain")
    if found is None:
        raise UsageError(
            "drivegain",
            found=f"no such command beside {sys.executable} and none on the path",
            expected="an installed drivegain: a timer must find it",
            remedy="install it (`pip install .`), then repeat this",
        )
    return Path(found).absolute()


def owner_of(path: Path) -> str:
    """Name of a file's owner, or the number of one without a name."""
    try:
        return path.owner()
    except KeyError:
        return str(path.stat().st_uid)


def check_schedule(schedule: str) -> None:
    """Have systemd read the calendar expression, where this computer has it.

    Raises:
        UsageError: it is none.
    """
    found = "" if schedule.strip() and schedule.isprintable() else "nothing that can stand in a line"
    analyze = shutil.which("systemd-analyze")
    if not found and analyze is not None:
        done = subprocess.run(
            [analyze, "calendar", "--", schedule], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
        )
        found = "" if done.returncode == 0 else " ".join(done.stderr.split()) or "no calendar expression"
    if found:
        raise UsageError(
            f"--schedule {schedule!r}",
            found=found,
            expected="a calendar expression of systemd.time(7): weekly, 'Sun 03:00', 'Mon..Fri 22:30'",
            remedy="correct it; `systemd-analyze calendar EXPRESSION` tells when it strikes",
        )


def require_own_unit(path: Path, saying: str = "") -> None:
    """Refuse to replace a file that this verb has not made, or that it made for another cell.

    Args:
        path: of the unit.
        saying: what a unit of this cell says.

    Raises:
        UsageError: it is somebody else's.
    """
    try:
        # What is no regular file is nobody's unit, and a pipe would be waited for.
        text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else None
    except OSError as error:
        raise OutputFailed.of(path, error) from error
    if text is not None and text.startswith(MARK) and saying not in text:
        raise UsageError(
            str(path),
            found="the unit of another cell file",
            expected=f"no such file, or one that says {saying}",
            remedy="name another folder with --to, or remove it where the cell file has moved",
        )
    if (text is None and path.exists()) or (text is not None and not text.startswith(MARK)):
        raise UsageError(
            str(path),
            found="a unit that drivegain did not make",
            expected="no such file, or one of an earlier `install-units`",
            remedy="name another folder with --to, or move it away",
        )


def _write(folder: Path, units: tuple[Unit, ...]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for unit in units:
            replace_file(folder / unit.name, unit.text.encode())
    except OSError as error:
        raise OutputFailed.of(folder, error) from error


INSTALL_UNITS = Verb("install-units", install_units, "drivegain install-units --cell cells/demo.yaml --schedule weekly")
