"""The command `drivegain`: its verbs, and how an error becomes a message and an exit code."""

from __future__ import annotations

import codecs
import errno
import gc
import io
import json
import re
import signal
import sys
import traceback
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from daq.cli.failure import ErrorParts, show_failure
from daq.cli.output import QueuedOutput
from daq.cli.terminal import (
    CHANGED,
    STARTED,
    WRITTEN,
    interruptible,
    remove_empty_folders,
    say_last,
)
from daq.cli.verb import HELP_NAMES, Job, Verb
from daq.environment import software
from daq.errors import DaqError, ExitCode, OutputFailed, UsageError, reason_of
from daq.report.text import printable
from drivers.errors import DriverError, all_notes
from ident.errors import IdentificationError

CLICK_ERROR: type[Exception] = next(
    kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException"
)
"""What typer raises of a command line that cannot be parsed:
it brings a click of its own, without public names.
"""
MISSING = "MissingParameter"  #: What its error is called where an argument or option is not given
BY_JOB = {
    Job.COMMISSION: (
        Verb(
            "demo",
            "daq.cli.simulate:demo",
            "drivegain demo --out out/demo",
            "Run the whole calibration on a simulated six-axis cell.",
        ),
        Verb(
            "init",
            "daq.cli.init:init",
            "drivegain init press-4 --simulated",
            "Create a folder for a new cell, with templates to fill in.",
        ),
        Verb(
            "calibrate",
            "daq.cli.calibrate:calibrate_verb",
            "drivegain calibrate press-4/cells/press-4.yaml --enable-motion",
            "One session: check, record, identify, write, accept.",
        ),
        Verb(
            "scan",
            "daq.cli.scan:scan_verb",
            "drivegain scan CELL",
            "Compare the nodes on the bus with the cell file.",
        ),
        Verb(
            "plan",
            "daq.cli.plan:plan_verb",
            "drivegain plan CELL --out plan.yaml --seed 1 --duration 40",
            "Choose moves that show the worst gain best.",
        ),
        Verb(
            "record",
            "daq.cli.record:record_verb",
            "drivegain record CELL plan.yaml --out loaded.mcap --payload disc --mass 4.59 "
            "--enable-motion",
            "Execute a plan and log it; this moves the robot.",
        ),
        Verb(
            "fit",
            "daq.cli.fit:fit_verb",
            "drivegain fit unloaded.mcap loaded.mcap --holdout held-out.mcap --out "
            "calibration.yaml",
            "Identify all drive gains and dynamic parameters.",
        ),
        Verb(
            "residual",
            "daq.cli.fit:residual_verb",
            "drivegain residual unloaded.mcap loaded.mcap --holdout held-out.mcap --out "
            "calibration.yaml --report report",
            "Fit, then detect and add missing effects.",
        ),
        Verb(
            "validate",
            "daq.cli.validate:validate_verb",
            "drivegain validate calibration.yaml held-out.mcap --pictures pictures",
            "Predict the torque of other logs with a calibration.",
        ),
        Verb(
            "certificate",
            "daq.cli.certificate:certificate_verb",
            "drivegain certificate calibration.yaml --cell CELL",
            "Judge a calibration on one page, to print and sign.",
        ),
        Verb(
            "apply",
            "daq.cli.apply:apply_verb",
            "drivegain apply CELL calibration.yaml",
            "Write gains to the controller; a dry run without --yes.",
        ),
        Verb(
            "rollback",
            "daq.cli.apply:rollback_verb",
            "drivegain rollback press-4/cells/press-4.yaml",
            "Undo the last write.",
        ),
    ),
    Job.LOOK: (
        Verb(
            "monitor",
            "daq.cli.monitor:monitor_verb",
            "drivegain monitor CELL --calibration calibration.yaml",
            "Show the state of the axes; nothing is changed.",
        ),
        Verb(
            "console",
            "daq.cli.monitor:console_verb",
            "drivegain console CELL --calibration calibration.yaml",
            "Show the cell live on a page, with a stop button.",
        ),
        Verb("info", "daq.cli.logs:info", "drivegain info loaded.mcap", "Show what is in a log."),
        Verb(
            "history",
            "daq.cli.history:history_verb",
            "drivegain history press-4/cells/press-4.yaml --axis J4 --plot history.png",
            "Show the calibrations of a cell and any drift.",
        ),
        Verb(
            "explain-emcy",
            "daq.cli.scan:explain_emcy_verb",
            "drivegain explain-emcy 8611h",
            "Explain an error code of an amplifier.",
        ),
    ),
    Job.MAINTAIN: (
        Verb(
            "recalibrate",
            "daq.cli.recalibrate:recalibrate_verb",
            "drivegain recalibrate press-4/cells/press-4.yaml --dry-run",
            "Scheduled job: record, fit, propose or apply.",
        ),
        Verb(
            "schedule",
            "daq.cli.recalibrate:schedule_verb",
            "drivegain schedule press-4/cells/press-4.yaml --schedule weekly",
            "Run the job on a schedule, by systemd or cron.",
        ),
        Verb(
            "sign",
            "daq.cli.sign:sign_verb",
            "drivegain sign calibration calibration.yaml --key keys/anna.key --name anna",
            "Sign a calibration as its second approver.",
            (
                Verb(
                    "key",
                    "daq.cli.sign:sign_key_verb",
                    "drivegain sign key --name anna --folder keys",
                ),
                Verb(
                    "calibration",
                    "daq.cli.sign:sign_calibration_verb",
                    "drivegain sign calibration calibration.yaml --key keys/anna.key --name anna",
                ),
                Verb(
                    "check",
                    "daq.cli.sign:sign_check_verb",
                    "drivegain sign check CELL calibration.yaml",
                ),
            ),
        ),
        Verb(
            "fleet",
            "daq.cli.fleet:fleet_verb",
            "drivegain fleet logs --scheduler processes --out calibrations --csv fleet.csv",
            "Fit the logs of many cells.",
        ),
        Verb(
            "salvage",
            "daq.cli.logs:salvage_verb",
            "drivegain salvage loaded.mcap.part --out loaded-partial.mcap",
            "Save the readable part of an unfinished or damaged log.",
        ),
    ),
    Job.EXPERT: (
        Verb(
            "import",
            "daq.cli.logs:import_files",
            "drivegain import press-4/imports/press-4.yaml --data csv-files --out imported.mcap",
            "Convert CSV, MATLAB or ROS 2 files to a log.",
        ),
        Verb(
            "export",
            "daq.cli.logs:export_verb",
            "drivegain export urdf CELL calibration.yaml --out robot.urdf",
            "Write a calibration or a log for other programs.",
            (
                Verb(
                    "urdf",
                    "daq.cli.models:export_urdf_verb",
                    "drivegain export urdf CELL calibration.yaml --out robot.urdf",
                ),
                Verb(
                    "mjcf",
                    "daq.cli.models:export_mjcf_verb",
                    "drivegain export mjcf CELL calibration.yaml --out robot.xml",
                ),
                Verb(
                    "log",
                    "daq.cli.logs:export_log_verb",
                    "drivegain export log loaded.mcap --csv --out loaded.csv",
                ),
                Verb(
                    "csv",
                    "daq.cli.logs:export_csv_verb",
                    "drivegain export csv calibration.yaml held-out.mcap --out residual.csv",
                ),
                Verb(
                    "bag",
                    "daq.cli.logs:export_bag_verb",
                    "drivegain export bag loaded.mcap --out loaded-bag",
                ),
            ),
        ),
        Verb(
            "weigh",
            "daq.cli.validate:weigh_verb",
            "drivegain weigh calibration.yaml held-out.mcap --bare unloaded.mcap",
            "Weigh the body on the flange with a calibration.",
        ),
        Verb(
            "contact",
            "daq.cli.validate:contact_verb",
            "drivegain contact calibration.yaml loaded.mcap --quiet held-out.mcap",
            "Find external torques, with a threshold for alarms.",
        ),
        Verb(
            "simulate",
            "daq.cli.simulate:simulate",
            "drivegain simulate demo --payload disc --faults faults-example",
            "Run a simulated cell on a bus, to try the other verbs.",
        ),
    ),
}
"""Verbs by job, in the order of the help; each is imported when it is called."""
VERBS = tuple(chain.from_iterable(BY_JOB.values()))
VERB_NAMES = frozenset(verb.name for verb in VERBS)
ALIASES = {"report": "certificate", "install-units": "schedule"}
"""Names of earlier versions, which go on working; the help and the completion do not list them."""


class _Verbs(TyperGroup):
    """Group that lists the verbs by job without importing them,
    and imports the one that is called.
    """

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Return name, command and remaining arguments,
        with the verb itself in place of its placeholder.
        """
        first, *others = args
        named = ALIASES.get(first, first)
        name, command, rest = super().resolve_command(ctx, [named, *others])
        verb = next((verb for verb in VERBS if verb.name == name), None)
        return name, command if verb is None else verb.command(), rest

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List the verbs of each job with their whole summaries."""
        width = max(len(verb.name) for verb in VERBS)
        for job, verbs in BY_JOB.items():
            with formatter.section(job.value):
                formatter.write_dl([(f"{verb.name:{width}}", verb.summary) for verb in verbs])

    def invoke(self, ctx: Any) -> Any:
        """Run the verb; an interrupt, SIGTERM or SIGHUP is one line that says what was written."""
        try:
            with interruptible(signals=_ending_signals()):
                return super().invoke(ctx)
        except KeyboardInterrupt as interrupt:
            writes = ctx.invoked_subcommand in {"apply", "rollback"}
            if writes:
                nothing = "nothing was changed"
            else:
                nothing = "no file was written"
            said = _kept() or "; ".join(all_notes(interrupt)) or nothing
            if ctx.invoked_subcommand == "demo" and any(path.exists() for path in STARTED):
                said += "; the next `drivegain demo` into this folder starts anew and replaces it"
            say_last(printable(f"interrupted: {said}"))
            raise typer.Exit(ExitCode.INTERRUPTED) from interrupt


def _ending_signals() -> tuple[signal.Signals, ...]:
    """Signals that end this process at once; those that are ignored stay so: nohup."""
    return tuple(
        one for one in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(one) is signal.SIG_DFL
    )


def build_app() -> typer.Typer:
    """Build the command with its verbs."""
    app = typer.Typer(
        cls=_Verbs,
        name="drivegain",
        help="Record a robot over CANopen, identify its joint drive gains and dynamics, write the "
        "calibration back.",
        epilog="Exit codes: 0 ok, 1 unexpected, or the output could not be written, 2 usage, 3 "
        "calibration refused, 4 data unfit, 5 device fault, 6 configuration, 10 to 14 see "
        "recalibrate (11: the interlock refuses, 12: the bus is taken), 15 new moves contradict "
        "the gains that were written, see calibrate; 130 interrupted.",
        no_args_is_help=True,
        context_settings={"help_option_names": HELP_NAMES},
        pretty_exceptions_enable=False,
        # Rich would read the units in brackets, [s], as markup and drop them
        rich_markup_mode=None,
    )
    app.callback()(_options)
    for verb in VERBS:
        app.command(verb.name, help=verb.summary)(lambda: None)  # never called
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line, by default that of this process, and return its exit code."""
    if arguments is None:
        # A process of one command: almost all that it makes at its start stays, and searching it
        # for garbage again and again is a sixth of the time of `info`. A recording sets limits of
        # its own (daq/workflow/on_time.py).
        gc.set_threshold(20_000, 50, 100)
    WRITTEN.clear()
    CHANGED.clear()
    STARTED.clear()
    words = sys.argv[1:] if arguments is None else list(arguments)
    json_wanted = "--json" in words[: words.index("--") if "--" in words else None]
    with QueuedOutput() as output:
        if isinstance(sys.stdout, io.TextIOWrapper):
            codecs.register_error("drivegain", _spelled)
            sys.stdout.reconfigure(errors="drivegain")
        try:
            code = _run(words, json_wanted)
        except Exception:
            if arguments is not None:
                raise
            # The interpreter would print it where nothing waits for a reader in its stead.
            traceback.print_exc()
            code = ExitCode.UNEXPECTED
        finally:
            remove_empty_folders()
        return _handed_over(output, code, json_wanted)


def _handed_over(output: QueuedOutput, code: int, json_wanted: bool) -> int:
    """Wait for the reader of what was printed, unless an interrupt ends that;
    return the exit code.
    """
    if code == ExitCode.INTERRUPTED:
        return code
    try:
        with interruptible(signals=(signal.SIGINT, *_ending_signals())):
            output.wait_for_results()
    except OSError as error:
        return code or _output_failed(error, json_wanted)
    except KeyboardInterrupt:
        kept = _kept()
        say_last(
            printable(
                "interrupted: the output was not read to its end" + (f"; {kept}" if kept else "")
            )
        )
        return ExitCode.INTERRUPTED
    return code


def _spelled(error: Any) -> tuple[str, int]:
    """Spell characters that the output's encoding lacks as \\u00b1,
    which is right in a JSON document too.
    """
    return json.dumps(error.object[error.start : error.end])[1:-1], error.end


def _run(words: list[str], json_wanted: bool) -> int:
    try:
        ended = typer.main.get_command(build_app()).main(
            words, prog_name="drivegain", standalone_mode=False
        )
    except (DaqError, DriverError, IdentificationError) as error:
        kept = ""
        if CHANGED or isinstance(error, OutputFailed):
            kept = _kept()
        if kept:
            error.add_note(f"kept: {kept}")
        failure = ErrorParts.of(error, _verb_of(words))
        show_failure(failure, json_wanted=json_wanted)
        return failure.exit_code
    except OSError as error:
        return _output_failed(error, json_wanted)
    # Typer ends so after an option such as --show-completion, rich at a closed pipe.
    except SystemExit as stop:
        if isinstance(stop.__context__, BrokenPipeError):
            return _output_failed(stop.__context__, json_wanted)
        ended = stop.code
    except typer.Abort:
        # Ctrl-C or Ctrl-D at a prompt
        said = _kept() or "no file was written"
        say_last(printable(f"interrupted: {said}"))
        ended = ExitCode.INTERRUPTED
    except CLICK_ERROR as error:
        ended = _usage_failed(error, words, json_wanted)
    return ended if isinstance(ended, int) else ExitCode.OK


def _verb_of(words: list[str]) -> str:
    """Return the verb of a command line; empty where it has none."""
    return next((word for word in words if word in VERB_NAMES), "")


def _wanted(shown: str, param: Any) -> str:
    """Return what a missing argument or option is, as the help of its verb says it."""
    if not param.help:
        return shown
    return f"{shown} ({param.help.rstrip('.')})"


def _usage_failed(error: Any, words: list[str], json_wanted: bool) -> int:
    """Report a command line that cannot be parsed."""
    if "Usage:" in error.message:
        error.show()  # a verb without arguments shows its help
        return ExitCode.USAGE
    command = "drivegain"
    expected = "a value for this option"
    if error.ctx is not None:
        command = error.ctx.command_path
        expected = error.ctx.get_usage()
    elif verb := _verb_of(words):
        # The parser knows no verb where an option ends the line without its value.
        command = f"drivegain {verb}"
    found = str(error.format_message())
    param = getattr(error, "param", None)
    if param is not None:
        if param.param_type_name == "argument":
            shown = param.name.upper()
        else:
            shown = max(param.opts, key=len)
        found = found.replace(f"'{param.display_name_raw}'", f"'{shown}'", 1)
        if type(error).__name__ == MISSING:
            expected = _wanted(shown, param)
    remedy = f"`{command} --help` explains it"
    # A value of the wrong type: the message of typer's validation does not repeat it.
    given = [one["input"] for one in getattr(error.__cause__, "errors", list)()]
    if len(given) == 1 and isinstance(given[0], str):
        found = f"{given[0]!r}: {found}"
        if re.fullmatch(r"[+-]?\d*,\d+", given[0]):
            remedy = f"write a decimal point: {given[0].replace(',', '.')}"
    failure = ErrorParts("UsageError", command, found, expected, remedy, ExitCode.USAGE)
    show_failure(failure, json_wanted=json_wanted)
    return ExitCode.USAGE


def _output_failed(error: OSError, json_wanted: bool) -> int:
    if error.errno == errno.ENAMETOOLONG and error.filename:
        # Names to write were judged with the command line: this one is of a file to read.
        unusable = UsageError(
            str(error.filename),
            found=reason_of(error),
            expected="a name that the file system takes",
            remedy="check the name",
        )
        failure = ErrorParts.of(unusable)
        show_failure(failure, json_wanted=json_wanted)
        return failure.exit_code
    # A reader that closed the pipe needs no message where nothing was written; a full disk does.
    has_changed = bool(WRITTEN or CHANGED)
    if has_changed or not isinstance(error, BrokenPipeError):
        failed = OutputFailed.of(Path(str(error.filename or "standard output")), error)
        failed.__cause__ = error
        if not error.filename:
            failed.expected = "an output that takes what is printed"
            if has_changed:
                failed.remedy = f"only the printed output is lost: {_kept()}"
            else:
                failed.remedy = "send it elsewhere"
        show_failure(ErrorParts.of(failed), json_wanted=json_wanted)
    return ExitCode.UNEXPECTED


def _kept() -> str:
    """Say what this command has written: files that are complete, folders that it was still
    filling, and changes of other files.
    """
    unfinished = [str(path) for path in STARTED if path.exists()]
    if WRITTEN:
        parts = [f"{', '.join(map(str, WRITTEN))} was written before that, completely"]
    else:
        parts = []
    if unfinished:
        parts += [f"{', '.join(unfinished)} has what was finished until then"]
    parts += CHANGED
    return "; ".join(parts)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(software())
        raise typer.Exit


def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Options before the verb."""
