"""The command `drivegain`: its verbs, and how an error becomes a message and an exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from daq.cli.apply import APPLY
from daq.cli.demo import DEMO
from daq.cli.fit import FIT
from daq.cli.import_ import IMPORT
from daq.cli.info import INFO
from daq.cli.init import INIT
from daq.cli.plan import PLAN
from daq.cli.record import RECORD
from daq.cli.residual import RESIDUAL
from daq.cli.rollback import ROLLBACK
from daq.cli.scan import SCAN
from daq.cli.simulate import SIMULATE
from daq.cli.validate import VALIDATE
from daq.cli.verb import Verb, printable
from daq.errors import DaqError, ExitCode, OutputFailed, exit_code
from daq.version import software
from drivers.errors import DriverError
from ident.errors import IdentificationError

VERBS: tuple[Verb, ...] = (
    DEMO,
    INIT,
    SCAN,
    PLAN,
    RECORD,
    INFO,
    IMPORT,
    FIT,
    RESIDUAL,
    VALIDATE,
    APPLY,
    ROLLBACK,
    SIMULATE,
)
"""In the order of the help."""


def build_app(verbs: tuple[Verb, ...] = VERBS) -> typer.Typer:
    """The command with its verbs."""
    app = typer.Typer(
        name="drivegain",
        help="Record a robot over CANopen, identify its joint drive gains and dynamics, write the calibration back.",
        epilog="Exit codes: 0 ok, 1 unexpected, 2 usage, 3 calibration refused, 4 data unfit, 5 device fault, "
        "6 configuration, 130 interrupted.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    app.callback()(_options)
    for verb in verbs:
        app.command(verb.name, epilog=f"Example: {verb.example}")(verb.function)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line; the exit code.

    Args:
        arguments: without the command's name; None for those of this process.
    """
    try:
        build_app()(args=None if arguments is None else list(arguments), prog_name="drivegain")
    except (DaqError, DriverError, IdentificationError) as error:
        show_error(error, Console(stderr=True, soft_wrap=True))
        return exit_code(type(error)) or ExitCode.UNEXPECTED
    except BrokenPipeError:  # whoever read the output has seen enough
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123 - the interpreter flushes it once more at its end
        return ExitCode.UNEXPECTED
    except OSError as error:
        show_error(OutputFailed.of(Path(str(error.filename or "standard output")), error), Console(stderr=True))
        return ExitCode.UNEXPECTED
    except SystemExit as stop:  # typer ends so, after success too
        return stop.code if isinstance(stop.code, int) else ExitCode.OK
    return ExitCode.OK


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
    # What a stop or a give-back could not confirm is noted on the error on its way up.
    notes = [note for note in getattr(error, "__notes__", ()) if note.startswith(("while stopping", "while closing"))]
    lines += [("note", note, "bold") for note in notes]
    if notes:
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
