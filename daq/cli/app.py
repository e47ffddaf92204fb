"""The command `drivegain`: its verbs, and how an error becomes a message and an exit code."""

from __future__ import annotations

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

from daq.cli.verb import Listed, VerbGroup, printable
from daq.environment import software
from daq.errors import DaqError, ExitCode, OutputFailed, exit_code
from drivers.errors import DriverError
from ident.errors import IdentificationError

VERBS = (
    Listed("demo", "daq.cli.demo:DEMO", "Do the whole job on a simulated six-axis cell."),
    Listed("init", "daq.cli.init:INIT", "Make a folder for a new cell, with templates to fill in."),
    Listed("scan", "daq.cli.scan:SCAN", "List the nodes on the bus beside those that are configured."),
    Listed("monitor", "daq.cli.monitor:MONITOR", "Show what the axes do now; it changes nothing."),
    Listed("explain-emcy", "daq.cli.scan:EXPLAIN_EMCY", "Say what an error code of an amplifier means."),
    Listed("plan", "daq.cli.plan:PLAN", "Choose moves within the limits that excite every parameter."),
    Listed("record", "daq.cli.record:RECORD", "Make a plan's moves and log them; this moves the robot."),
    Listed("info", "daq.cli.logs:INFO", "Show what is in a log."),
    Listed("salvage", "daq.cli.logs:SALVAGE", "Save what a killed recording left behind."),
    Listed("import", "daq.cli.logs:IMPORT", "Make a log of CSV files of another controller."),
    Listed("fit", "daq.cli.fit:FIT", "Identify all drive gains and dynamic parameters."),
    Listed("residual", "daq.cli.residual:RESIDUAL", "As fit; then find what the model lacks, and add it."),
    Listed("fleet", "daq.cli.fleet:FLEET", "Fit the logs of many cells, one task a cell."),
    Listed("validate", "daq.cli.validate:VALIDATE", "Measure a calibration on any log."),
    Listed("export", "daq.cli.export:EXPORT", "Write a calibration or a log for other programs."),
    Listed("sign", "daq.cli.sign:SIGN", "Sign a calibration, as the second person."),
    Listed("apply", "daq.cli.apply:APPLY", "Write gains into the controller's file; first a dry run."),
    Listed("rollback", "daq.cli.rollback:ROLLBACK", "Take the last write to a controller's file back."),
    Listed("history", "daq.cli.history:HISTORY", "Show the calibrations of a cell, and any drift."),
    Listed("recalibrate", "daq.cli.recalibrate:RECALIBRATE", "The scheduled job: record, fit, propose or apply."),
    Listed("install-units", "daq.cli.recalibrate:INSTALL_UNITS", "Let systemd or cron run the scheduled job."),
    Listed("simulate", "daq.cli.simulate:SIMULATE", "Run a simulated cell on a bus, for trying the other verbs."),
)
"""In the order of the help. A verb is imported when it is called: most of them bring a second of mathematics along."""

NOTES = ("kept", "hint")
"""Labels of what a verb notes on an error on its way up, ``error.add_note("hint: …")``: what it left, what may help."""


class _Verbs(TyperGroup):
    """Lists the verbs without importing them, and imports the one that is called."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Name, command and the arguments left; the placeholder gives way to the verb itself."""
        name, _, rest = super().resolve_command(ctx, args)
        return name, next(_command(listed) for listed in VERBS if listed.name == name), rest


def build_app() -> typer.Typer:
    """The command with its verbs."""
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
        rich_markup_mode=None,  # it would take the units in brackets, [s], for markup and swallow them
    )
    app.callback()(_options)
    for listed in VERBS:
        app.command(listed.name, help=listed.summary)(_placeholder)
    return app


def _placeholder() -> None:
    """Stands in the list of verbs; it is never called."""


def _command(listed: Listed) -> Any:
    verb = listed.load()
    if isinstance(verb, VerbGroup):
        return verb.command()
    alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    # \b keeps the example on one line: it is there to be copied.
    alone.command(verb.name, epilog=f"\b\nExample:\n  {verb.example}")(verb.function)
    return typer.main.get_command(alone)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line; the exit code.

    Args:
        arguments: without the command's name; None for those of this process.
    """
    code = _run(arguments)
    try:
        # What is still buffered fails here, where it can be told, and not at the end of the interpreter.
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        return code or _output_failed(error)
    return code


def _run(arguments: Sequence[str] | None) -> int:
    try:
        build_app()(args=None if arguments is None else list(arguments), prog_name="drivegain")
    except (DaqError, DriverError, IdentificationError) as error:
        show_error(error, Console(stderr=True, soft_wrap=True))
        return exit_code(type(error)) or ExitCode.UNEXPECTED
    except OSError as error:
        return _output_failed(error)
    except SystemExit as stop:  # typer ends so, after success too
        return stop.code if isinstance(stop.code, int) else ExitCode.OK
    return ExitCode.OK


def _output_failed(error: OSError) -> int:
    # Whoever closed the pipe has seen enough; a full disk is news.
    if not isinstance(error, BrokenPipeError):
        failed = OutputFailed.of(Path(str(error.filename or "standard output")), error)
        show_error(failed, Console(stderr=True, soft_wrap=True))
    try:
        sys.stdout.flush()
    except OSError:
        # The interpreter flushes it once more at its end, and would complain.
        with suppress(OSError):
            null, wanted = os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
            os.dup2(null, wanted)
            os.close(null)
    return ExitCode.UNEXPECTED


def show_error(error: Exception, console: Console) -> None:
    """What it is about, what was found, what was expected and what to do, a line each."""
    lines = [("error", str(error), "bold red")]
    if isinstance(error, DaqError):
        lines = [
            ("error", error.subject, "bold red"),
            ("found", error.found, "bold"),
            ("expected", error.expected, "bold"),
            ("do", error.remedy, "bold"),
        ]
    notes = getattr(error, "__notes__", ())
    lines += [(label, text, "bold") for label, _, text in (note.partition(": ") for note in notes) if label in NOTES]
    # What a stop or a give-back could not confirm is noted on the error on its way up.
    unconfirmed = [note for note in notes if note.startswith(("while stopping", "while closing"))]
    lines += [("note", text, "bold") for text in unconfirmed]
    if unconfirmed:
        lines.append(("AXES", "NOT ALL OF THEM ARE KNOWN TO STAND: use the emergency stop", "bold red"))
    for label, text, style in lines:
        console.print(Text(f"{label + ':':<10}", style=style) + Text(printable(text)))


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
