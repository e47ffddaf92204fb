"""`drivegain recalibrate`: the scheduled job. It moves the robot, by the cell's policy and its interlock."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.interrupt import interruptible
from daq.cli.residual_report import save_report
from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.configuration.cell_file import load_cell
from daq.errors import DaqError, ExitCode, exit_code
from daq.login import login
from daq.recalibration.job import preview, recalibrate
from daq.recalibration.journal import Form, Journal, Level, form_of
from daq.recalibration.report import document, text
from daq.recalibration.tools import Tools
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
    with interruptible() as undisturbed:
        if dry_run:
            seen = preview(cell, declared, tools, journal, who=who)
            if json:
                print_json({"dry_run": True, "remark": seen.remark, "steps": seen.steps})
            else:
                typer.echo("\n".join((f"Dry run: {seen.remark}", *(f"  {step}" for step in seen.steps))))
            return
        ended = recalibrate(cell, declared, tools, journal, who=who, undisturbed=undisturbed)
    if json:
        print_json(document(ended, cell))
    else:
        typer.echo(printable(text(ended, cell)), nl=False)
    if ended.exit_code:
        raise typer.Exit(ended.exit_code)


RECALIBRATE = Verb("recalibrate", recalibrate_verb, "drivegain recalibrate --cell cells/demo.yaml --dry-run")
