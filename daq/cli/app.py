"""The command `drivegain`: its verbs, and how an error becomes a message and an exit code."""

from __future__ import annotations

import codecs
import gc
import io
import json
import os
import re
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from daq.cli.failure import ErrorParts, show_failure
from daq.cli.terminal import STARTED, WRITTEN, interruptible, remove_empty_folders, say_last
from daq.cli.verb import HELP_NAMES, Job, Listed
from daq.environment import software
from daq.errors import DaqError, ExitCode, OutputFailed
from daq.report.text import printable
from drivers.errors import DriverError, all_notes
from ident.errors import IdentificationError

CLICK_ERROR: type[Exception] = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")
"""What typer raises of a command line that cannot be parsed: it brings a click of its own, without public names."""
BY_JOB = {
    Job.COMMISSION: (
        Listed("demo", "daq.cli.simulate:DEMO", "Run the whole calibration on a simulated six-axis cell."),
        Listed("init", "daq.cli.init:INIT", "Create a folder for a new cell, with templates to fill in."),
        Listed("calibrate", "daq.cli.calibrate:CALIBRATE", "One session: check, record, identify, write, accept."),
        Listed("scan", "daq.cli.scan:SCAN", "Compare the nodes on the bus with the cell file."),
        Listed("plan", "daq.cli.plan:PLAN", "Choose moves that show the worst gain best."),
        Listed("record", "daq.cli.record:RECORD", "Execute a plan and log it; this moves the robot."),
        Listed("fit", "daq.cli.fit:FIT", "Identify all drive gains and dynamic parameters."),
        Listed("residual", "daq.cli.fit:RESIDUAL", "Fit, then detect and add missing effects."),
        Listed("validate", "daq.cli.validate:VALIDATE", "Predict the torque of other logs with a calibration."),
        Listed("report", "daq.cli.report:REPORT", "Write the certificate of a calibration as one page."),
        Listed("apply", "daq.cli.apply:APPLY", "Write gains to the controller; a dry run without --yes."),
        Listed("rollback", "daq.cli.apply:ROLLBACK", "Undo the last write."),
    ),
    Job.LOOK: (
        Listed("monitor", "daq.cli.monitor:MONITOR", "Show the state of the axes; nothing is changed."),
        Listed("console", "daq.cli.monitor:CONSOLE", "Show the cell live on a page, with a stop button."),
        Listed("info", "daq.cli.logs:INFO", "Show what is in a log."),
        Listed("history", "daq.cli.history:HISTORY", "Show the calibrations of a cell and any drift."),
        Listed("explain-emcy", "daq.cli.scan:EXPLAIN_EMCY", "Explain an error code of an amplifier."),
    ),
    Job.MAINTAIN: (
        Listed("recalibrate", "daq.cli.recalibrate:RECALIBRATE", "Scheduled job: record, fit, propose or apply."),
        Listed("install-units", "daq.cli.recalibrate:INSTALL_UNITS", "Schedule the job with systemd or cron."),
        Listed("sign", "daq.cli.sign:SIGN", "Sign a calibration as its second approver."),
        Listed("fleet", "daq.cli.fleet:FLEET", "Fit the logs of many cells."),
        Listed("salvage", "daq.cli.logs:SALVAGE", "Save the readable part of an unfinished or damaged log."),
    ),
    Job.EXPERT: (
        Listed("import", "daq.cli.logs:IMPORT", "Convert CSV, MATLAB or ROS 2 files to a log."),
        Listed("export", "daq.cli.logs:EXPORT", "Write a calibration or a log for other programs."),
        Listed("weigh", "daq.cli.validate:WEIGH", "Weigh the body on the flange with a calibration."),
        Listed("contact", "daq.cli.validate:CONTACT", "Find external torques, with a threshold for alarms."),
        Listed("simulate", "daq.cli.simulate:SIMULATE", "Run a simulated cell on a bus, to try the other verbs."),
    ),
}
"""Verbs by job, in the order of the help; each is imported when it is called."""
VERBS = tuple(listed for verbs in BY_JOB.values() for listed in verbs)


class _Verbs(TyperGroup):
    """Group that lists the verbs by job without importing them, and imports the one that is called."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Return name, command and remaining arguments, with the verb itself in place of its placeholder."""
        name, command, rest = super().resolve_command(ctx, args)
        listed = next((listed for listed in VERBS if listed.name == name), None)
        return name, command if listed is None else listed.load().command(), rest

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List the verbs of each job with their whole summaries."""
        width = max(len(listed.name) for listed in VERBS)
        for job, verbs in BY_JOB.items():
            with formatter.section(job.value):
                formatter.write_dl([(f"{listed.name:{width}}", listed.summary) for listed in verbs])

    def invoke(self, ctx: Any) -> Any:
        """Run the verb; an interrupt, SIGTERM or SIGHUP is one line that says what was written."""
        # Signals that are ignored stay so: nohup.
        ending = tuple(one for one in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(one) is signal.SIG_DFL)
        try:
            with interruptible(signals=ending):
                return super().invoke(ctx)
        except KeyboardInterrupt as interrupt:
            writes = ctx.invoked_subcommand in {"apply", "rollback"}
            nothing = "nothing was changed" if writes else "no file was written"
            said = _kept() or "; ".join(all_notes(interrupt)) or nothing
            say_last(printable(f"interrupted: {said}"))
            raise typer.Exit(ExitCode.INTERRUPTED) from interrupt


def build_app() -> typer.Typer:
    """Build the command with its verbs."""
    app = typer.Typer(
        cls=_Verbs,
        name="drivegain",
        help="Record a robot over CANopen, identify its joint drive gains and dynamics, write the calibration back.",
        epilog="Exit codes: 0 ok, 1 unexpected, or the output could not be written, 2 usage, 3 calibration refused, "
        "4 data unfit, 5 device fault, 6 configuration, 10 to 14 see recalibrate "
        "(11: the interlock refuses, 12: the bus is taken), "
        "130 interrupted.",
        no_args_is_help=True,
        context_settings={"help_option_names": HELP_NAMES},
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
    STARTED.clear()
    if isinstance(sys.stdout, io.TextIOWrapper):
        codecs.register_error("drivegain", _spelled)
        sys.stdout.reconfigure(errors="drivegain")
    words = sys.argv[1:] if arguments is None else list(arguments)
    json_wanted = "--json" in words[: words.index("--") if "--" in words else None]
    try:
        code = _run(words, json_wanted)
    finally:
        remove_empty_folders()
    try:
        # Flush here: at the end of the interpreter a failure could not be reported.
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        return code or _output_failed(error, json_wanted)
    return code


def _spelled(error: Any) -> tuple[str, int]:
    """Spell characters that the output's encoding lacks as \\u00b1, which is right in a JSON document too."""
    return json.dumps(error.object[error.start : error.end])[1:-1], error.end


def _run(words: list[str], json_wanted: bool) -> int:
    try:
        ended = typer.main.get_command(build_app()).main(words, prog_name="drivegain", standalone_mode=False)
    except (DaqError, DriverError, IdentificationError) as error:
        if isinstance(error, OutputFailed) and _kept():
            error.add_note(f"kept: {_kept()}")
        failure = ErrorParts.of(error)
        show_failure(failure, json_wanted=json_wanted)
        return failure.exit_code
    except OSError as error:
        return _output_failed(error, json_wanted)
    except SystemExit as stop:  # typer ends so after an option such as --show-completion, rich at a closed pipe
        if isinstance(stop.__context__, BrokenPipeError):
            return _output_failed(stop.__context__, json_wanted)
        ended = stop.code
    except typer.Abort:
        say_last("interrupted: no file was written")  # Ctrl-C or Ctrl-D at a prompt
        ended = ExitCode.INTERRUPTED
    except CLICK_ERROR as error:
        ended = _usage_failed(error, json_wanted)
    return ended if isinstance(ended, int) else ExitCode.OK


def _usage_failed(error: Any, json_wanted: bool) -> int:
    """Report a command line that cannot be parsed."""
    if error.ctx is None or "Usage:" in error.message:
        error.show()  # a verb without arguments shows its help
        return ExitCode.USAGE
    found = str(error.format_message())
    param = getattr(error, "param", None)
    if param is not None:
        shown = param.name.upper() if param.param_type_name == "argument" else max(param.opts, key=len)
        found = found.replace(f"'{param.display_name_raw}'", f"'{shown}'", 1)
    remedy = f"`{error.ctx.command_path} --help` explains it"
    usage = error.ctx.get_usage()
    # A value of the wrong type: the message of typer's validation does not repeat it.
    given = [one["input"] for one in getattr(error.__cause__, "errors", list)()]
    if len(given) == 1 and isinstance(given[0], str):
        found = f"{given[0]!r}: {found}"
        if re.fullmatch(r"[+-]?\d*,\d+", given[0]):
            remedy = f"write a decimal point: {given[0].replace(',', '.')}"
    failure = ErrorParts("UsageError", error.ctx.command_path, found, usage, remedy, ExitCode.USAGE)
    show_failure(failure, json_wanted=json_wanted)
    return ExitCode.USAGE


def _output_failed(error: OSError, json_wanted: bool) -> int:
    # A reader that closed the pipe needs no message where nothing was written; a full disk does.
    if WRITTEN or not isinstance(error, BrokenPipeError):
        failed = OutputFailed.of(Path(str(error.filename or "standard output")), error)
        if not error.filename:
            failed.expected = "an output that takes what is printed"
            failed.remedy = f"only the printed output is lost: {_kept()}" if WRITTEN else "send it elsewhere"
        show_failure(ErrorParts.of(failed), json_wanted=json_wanted)
    try:
        sys.stdout.flush()
    except OSError:
        # The interpreter flushes stdout again at its end, and would complain.
        with suppress(OSError):
            null = os.open(os.devnull, os.O_WRONLY)
            wanted = sys.stdout.fileno()
            os.dup2(null, wanted)
            os.close(null)
    return ExitCode.UNEXPECTED


def _kept() -> str:
    """Say what this command has written: files that are complete, and folders that it was still filling."""
    unfinished = [str(path) for path in STARTED if path.exists()]
    parts = [f"{', '.join(map(str, WRITTEN))} was written before that, completely"] if WRITTEN else []
    parts += [f"{', '.join(unfinished)} has what was finished until then"] if unfinished else []
    return "; ".join(parts)


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
