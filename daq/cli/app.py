"""The command `drivegain`: its verbs, and how an error becomes a message and an exit code."""

from __future__ import annotations

import codecs
import gc
import io
import json
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text
from typer.core import TyperGroup

from daq.cli.terminal import WRITTEN
from daq.cli.verb import Listed
from daq.environment import software
from daq.errors import DaqError, ExitCode, OutputFailed, exit_code
from daq.report.text import printable
from drivers.errors import DriverError
from ident.errors import IdentificationError

VERBS = (
    Listed("demo", "daq.cli.simulate:DEMO", "Run the whole calibration on a simulated six-axis cell."),
    Listed("init", "daq.cli.init:INIT", "Create a folder for a new cell, with templates to fill in."),
    Listed("scan", "daq.cli.scan:SCAN", "Compare the nodes on the bus with the cell file."),
    Listed("monitor", "daq.cli.scan:MONITOR", "Show the state of the axes; nothing is changed."),
    Listed("console", "daq.cli.console:CONSOLE", "Show the cell live on a page, with a stop button."),
    Listed("explain-emcy", "daq.cli.scan:EXPLAIN_EMCY", "Explain an error code of an amplifier."),
    Listed("plan", "daq.cli.record:PLAN", "Choose moves that excite every parameter."),
    Listed("record", "daq.cli.record:RECORD", "Execute a plan and log it; this moves the robot."),
    Listed("info", "daq.cli.logs:INFO", "Show what is in a log."),
    Listed("salvage", "daq.cli.logs:SALVAGE", "Save the readable part of an unfinished or damaged log."),
    Listed("import", "daq.cli.logs:IMPORT", "Convert CSV, MATLAB or ROS 2 files to a log."),
    Listed("fit", "daq.cli.fit:FIT", "Identify all drive gains and dynamic parameters."),
    Listed("residual", "daq.cli.fit:RESIDUAL", "Fit, then detect and add missing effects."),
    Listed("fleet", "daq.cli.fleet:FLEET", "Fit the logs of many cells."),
    Listed("validate", "daq.cli.validate:VALIDATE", "Predict the torque of other logs with a calibration."),
    Listed("weigh", "daq.cli.weigh:WEIGH", "Weigh the body on the flange with a calibration."),
    Listed("contact", "daq.cli.weigh:CONTACT", "Find external torques, with a threshold for alarms."),
    Listed("export", "daq.cli.export:EXPORT", "Write a calibration or a log for other programs."),
    Listed("sign", "daq.cli.sign:SIGN", "Sign a calibration as its second approver."),
    Listed("apply", "daq.cli.apply:APPLY", "Write gains to the controller; a dry run without --yes."),
    Listed("rollback", "daq.cli.apply:ROLLBACK", "Undo the last write."),
    Listed("history", "daq.cli.history:HISTORY", "Show the calibrations of a cell and any drift."),
    Listed("recalibrate", "daq.cli.recalibrate:RECALIBRATE", "Scheduled job: record, fit, propose or apply."),
    Listed("install-units", "daq.cli.recalibrate:INSTALL_UNITS", "Schedule the job with systemd or cron."),
    Listed("simulate", "daq.cli.simulate:SIMULATE", "Run a simulated cell on a bus, to try the other verbs."),
)
"""Verbs in the order of the help; each is imported when it is called."""

NOTES = ("kept", "hint")
"""Labels of the notes that `show_error` prints; a verb adds them to an error with ``error.add_note("hint: …")``."""


class _Verbs(TyperGroup):
    """Group that lists the verbs without importing them, and imports the one that is called."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Return name, command and remaining arguments, with the verb itself in place of its placeholder."""
        name, _, rest = super().resolve_command(ctx, args)
        return name, next(listed.load().command() for listed in VERBS if listed.name == name), rest

    def invoke(self, ctx: Any) -> Any:
        """Run the verb; an interrupt is one line that says what was written."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as interrupt:
            unchanged = ": nothing was changed" if ctx.invoked_subcommand in {"apply", "rollback"} else ""
            typer.echo(printable(f"interrupted: {_kept()}" if WRITTEN else f"interrupted{unchanged}"), err=True)
            raise typer.Exit(ExitCode.INTERRUPTED) from interrupt


def build_app() -> typer.Typer:
    """Build the command with its verbs."""
    app = typer.Typer(
        cls=_Verbs,
        name="drivegain",
        help="Record a robot over CANopen, identify its joint drive gains and dynamics, write the calibration back.",
        epilog="Exit codes: 0 ok, 1 unexpected, or the output could not be written, 2 usage, 3 calibration refused, "
        "4 data unfit, 5 device fault, 6 configuration, 10 to 14 see recalibrate (12: the bus is taken), "
        "130 interrupted.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,  # rich would read the units in brackets, [s], as markup and drop them
    )
    app.callback()(_options)
    for listed in VERBS:
        app.command(listed.name, help=listed.summary)(lambda: None)  # never called
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line, by default that of this process, and return its exit code."""
    if arguments is None:
        # A process of one command: almost all that it makes at its start stays, and searching it for garbage again and
        # again is a sixth of the time of `info`. A recording sets limits of its own (daq/workflow/safeguards.py).
        gc.set_threshold(20_000, 50, 100)
    WRITTEN.clear()
    if isinstance(sys.stdout, io.TextIOWrapper):
        codecs.register_error("drivegain", _spelled)
        sys.stdout.reconfigure(errors="drivegain")
    code = _run(arguments)
    try:
        # Flush here: at the end of the interpreter a failure could not be reported.
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        return code or _output_failed(error)
    return code


def _spelled(error: Any) -> tuple[str, int]:
    """Spell characters that the output's encoding lacks as \\u00b1, which is right in a JSON document too."""
    return json.dumps(error.object[error.start : error.end])[1:-1], error.end


def _run(arguments: Sequence[str] | None) -> int:
    try:
        build_app()(args=None if arguments is None else list(arguments), prog_name="drivegain")
    except (DaqError, DriverError, IdentificationError) as error:
        if isinstance(error, OutputFailed) and WRITTEN:
            error.add_note(f"kept: {_kept()}")
        show_error(error, Console(stderr=True, soft_wrap=True))
        return exit_code(type(error)) or ExitCode.UNEXPECTED
    except OSError as error:
        return _output_failed(error)
    except SystemExit as stop:  # typer ends so, after success too
        if isinstance(stop.__context__, BrokenPipeError):  # rich and click end so
            return _output_failed(stop.__context__)
        return stop.code if isinstance(stop.code, int) else ExitCode.OK
    return ExitCode.OK


def _output_failed(error: OSError) -> int:
    # A reader that closed the pipe needs no message where nothing was written; a full disk does.
    if WRITTEN or not isinstance(error, BrokenPipeError):
        failed = OutputFailed.of(Path(str(error.filename or "standard output")), error)
        if not error.filename:
            failed.expected = "an output that takes what is printed"
            failed.remedy = f"only the printed output is lost: {_kept()}" if WRITTEN else "send it elsewhere"
        show_error(failed, Console(stderr=True, soft_wrap=True))
    try:
        sys.stdout.flush()
    except OSError:
        # The interpreter flushes stdout again at its end, and would complain.
        with suppress(OSError):
            null, wanted = os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
            os.dup2(null, wanted)
            os.close(null)
    return ExitCode.UNEXPECTED


def _kept() -> str:
    return f"{', '.join(map(str, WRITTEN))} was written before that, completely"


def show_error(error: Exception, console: Console) -> None:
    """Print subject, found, expected and remedy of an error, a line each, and its notes."""
    lines = [("error", error.subject if isinstance(error, DaqError) else str(error), "bold red")]
    if isinstance(error, DaqError):
        parts = (("found", error.found), ("expected", error.expected), ("do", error.remedy))
        lines += [(label, text, "bold") for label, text in parts]
    notes = getattr(error, "__notes__", ())
    lines += [(label, text, "bold") for label, _, text in (note.partition(": ") for note in notes) if label in NOTES]
    # A stop of the axes that could not be confirmed is a note on the error.
    unconfirmed = [note for note in notes if note.startswith(("while stopping", "while closing"))]
    lines += [("note", text, "bold") for text in unconfirmed]
    if unconfirmed:
        lines.append(("AXES", "NOT ALL ARE CONFIRMED STOPPED: use the emergency stop", "bold red"))
    for label, text, style in lines:
        # Indented, a line end in the name of a file cannot make another line of an error.
        console.print(Text(f"{label + ':':<10}", style=style) + Text(printable(text).replace("\n", "\n" + 10 * " ")))


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(software())
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Options before the verb."""
