"""An error for the user: subject, found, expected and remedy, a line each, or a line of JSON.

The errors of `daq` have all four parts. Those of `drivers` and `ident` have the first two; `ADVICE`
adds expected and remedy for the command line, and `daq.advice` replaces functions by verbs. Errors
of the operating system on a bus are explained by their number.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from daq.advice import for_command_line
from daq.errors import DaqError, ExitCode, exit_code
from daq.report.text import break_lines, printable, spelled_bytes
from drivers import errors as driver
from drivers.profiles.cia402 import STATUS_FAULT, STATUS_FOLLOWING_ERROR
from ident import errors as identification

if TYPE_CHECKING:
    from daq.report.document import ErrorReport

#: Errors of the identification that have found, expected and remedy.
WITH_EVIDENCE = (
    identification.ModelContradicted | identification.PayloadMissing | identification.ChannelUnfit
)
NOTES = ("kept", "hint")
"""Labels of the notes that are shown. A verb adds one by ``error.add_note("hint: …")``."""
NOT_STOPPED = "{} NOT CONFIRMED WITHOUT POWER: use the emergency stop"

_VCAN = "`sudo modprobe vcan`, `sudo ip link add dev vcan0 type vcan`, `sudo ip link set vcan0 up`"
_SIMULATE = "at a desk `drivegain simulate demo` in a second terminal is a cell"

ADVICE: dict[type[Exception], tuple[str, str]] = {
    driver.BusError: (
        "a bus that is up, with the amplifiers on it",
        "check `bus` in the cell file, the adapter (`ip -details link show`) and the power "
        "of the cell",
    ),
    driver.BusBusy: (
        "no other master on the bus",
        "end the other program; `drivegain monitor CELL` only listens",
    ),
    driver.NodeMissing: (
        "an answer from every axis of the cell file",
        "`drivegain scan CELL` lists the nodes that answer",
    ),
    driver.NodeMisplaced: (
        "every axis on the bus that the cell file names",
        "correct the wiring or the cell file; `drivegain scan CELL` lists the nodes of each bus",
    ),
    driver.ObjectAccessError: (
        "an object that this drive has and answers for",
        "check that the drive profile (`drive` in the cell file) is that of this drive, then "
        "its wiring",
    ),
    driver.SetupRefused: (
        "the drive that the cell file describes",
        "compare the drive with `drivegain scan CELL`, and correct `identity` or `drive` in the "
        "cell file",
    ),
    driver.StateRefused: (
        "a drive that follows the commands of CiA 301 and CiA 402",
        "check the power stage and the safety chain; `drivegain scan CELL --reset-faults` names "
        "and resets a fault",
    ),
    driver.ParameterRefused: (
        "a parameter that reads back as written",
        "nothing else was changed; check write protection and the drive's manual",
    ),
    driver.DriveFault: (
        "axes without a fault from the first SYNC to the last",
        "remove the cause (`drivegain explain-emcy CODE` explains a code), then `drivegain scan "
        "CELL --reset-faults`",
    ),
    driver.NodeError: (
        "an amplifier as the cell file describes it",
        "compare it with `drivegain scan CELL`",
    ),
    driver.ParametersMixed: (
        "all drives with their previous values, or all with the new ones",
        "`drivegain rollback CELL --drives --yes` before an axis is enabled",
    ),
    driver.SampleLost: (
        "an answer from every axis to every SYNC",
        "check the power of the cell and the load of bus and computer: `drivegain monitor CELL`",
    ),
    driver.MotionRefused: (
        "a person who permits motion, and moves within the limits",
        "pass --enable-motion when the cell is clear; plan again where a limit is named",
    ),
    driver.MotionTimeout: (
        "every move within its time",
        "check brakes and limits, or record with --speed 0.5",
    ),
    driver.DriverError: (
        "an undisturbed bus",
        "read the message above; `drivegain monitor CELL` shows the bus",
    ),
    identification.DataUnfit: ("runs that can be used", "leave the run out, or record it again"),
    identification.TooFewMoves: (
        "enough moves to judge the scatter",
        "record a plan with more moves (`plan --duration`), or give more logs",
    ),
    identification.RankDeficient: (
        "moves that identify every unknown",
        "record runs without load and with the payload, with a plan of `drivegain plan`",
    ),
    identification.PayloadUnseen: (
        "the payload in every run that declares it, in no other, and heavy enough for the moves "
        "to show it",
        "check what was mounted in each run (`drivegain info LOG` shows what it declares) and "
        "record the wrong one again; if all are right, use a heavier payload or a plan of "
        "`drivegain plan`",
    ),
    identification.NotConverged: (
        "a fit that settles",
        "check the cell file, or try `fit --method wls`",
    ),
    identification.EffectImpossible: (
        "coefficients that physics allows",
        "check this effect, `zero_offset_deg` and `gravity_m_s2` in the cell file",
    ),
    identification.EffectRefused: (
        "effects as `drivegain residual` and the cell file's reference have them",
        "correct `effects` of the calibration or of the cell file, or fit the logs again",
    ),
    identification.IdentificationError: (
        "a model and runs that belong together",
        "check the cell file and the logs (`drivegain info LOG`)",
    ),
}
"""Expected and remedy by class of error, for errors that have neither.

The nearest base class of an error counts.
"""

_NO_POWER = (
    "axes that keep their supply and their power from the first SYNC to the last",
    "check the drive's supply and the safety chain (STO, doors, enable), then repeat the command",
)
"""Expected and remedy where an axis booted again, stopped answering or lost its power, without the
report of an error or a fault.
"""
_FAULT_WITHOUT_CODE = (
    "axes without a fault from the first SYNC to the last",
    "remove the cause; `drivegain scan CELL --reset-faults` names and resets the fault",
)
_ERROR_REPORTED = (
    "axes that report no error",
    "remove the cause of the error that it reported (`drivegain explain-emcy CODE` explains its "
    "code), then repeat the command",
)

_CHECK_NODE = (
    "check the drive's supply, its wiring, and `node_id` and `drive` of the axis in the cell file"
)
ADVICE_WITHIN: dict[str, dict[type[Exception], tuple[str, str]]] = {
    "scan": {
        driver.NodeMissing: (
            "an answer from every axis of the cell file",
            "check, in this order, the supply of the drives, wiring and termination (60 Ω between "
            "CAN_H and CAN_L without power), the bit rate, and the node ids; `--wait 2` waits "
            "longer",
        ),
        driver.NodeMisplaced: (
            "every axis on the bus that the cell file names",
            "correct the wiring or the cell file",
        ),
        driver.StateRefused: (
            "a drive that follows the commands of CiA 301 and CiA 402",
            "check the power stage and the safety chain, and the fault on the drive's display",
        ),
        driver.DriveFault: (
            "a fault that can be reset",
            "remove its cause (`drivegain explain-emcy CODE` explains a code), then reset it again",
        ),
        driver.NodeError: ("an amplifier as the cell file describes it", _CHECK_NODE),
        driver.SetupRefused: ("the drive that the cell file describes", _CHECK_NODE),
    },
    "monitor": {
        driver.SampleLost: (
            "an answer from every axis to every SYNC",
            "check the power of the cell and the load of bus and computer",
        ),
        driver.DriverError: (
            "an undisturbed bus",
            "read the message above; `drivegain scan CELL` lists the nodes",
        ),
        driver.BusBusy: ("no other master on the bus", "end the other program"),
    },
    # Its cell is simulated and has no file: no other verb can look at it.
    "demo": {
        driver.DriverError: (
            "a simulated cell that answers in time",
            "close other programs, because a busy computer answers late, and run `drivegain demo` "
            "again; with the same error on an idle one, choose another --seed",
        ),
        identification.IdentificationError: (
            "five runs that identify every gain",
            "run `drivegain demo` again with a longer --duration or another --seed",
        ),
    },
}
"""Expected and remedy within a verb, by class of error, instead of those of `ADVICE`.

`ADVICE` would propose the verb that the user has just run.
"""

#: End of a message about a fault, for users of the library
RESET = "; then reset the fault with `CanopenNetwork.reset_faults`"

_BUS_ADVICE: dict[int, tuple[str, str, str]] = {
    errno.ECONNREFUSED: (
        "nothing that listens there (connection refused)",
        "a CAN server, or a simulated cell",
        f"start the CAN server of the cell; {_SIMULATE}",
    ),
    errno.EAFNOSUPPORT: (
        "no CAN in this kernel",
        "a Linux kernel with SocketCAN",
        "load it (`sudo modprobe can can_raw`) or use a kernel that has it; for a virtual bus also "
        f"{_VCAN}; without SocketCAN, {_SIMULATE}",
    ),
    errno.ENODEV: (
        "no such CAN interface",
        "an interface of that name (`ip link` lists them)",
        "connect the adapter, or correct `bus.channel` in the cell file; for a virtual "
        f"bus {_VCAN}",
    ),
    errno.ENETDOWN: (
        "an interface that is down",
        "one that is up",
        "bring it up: `sudo ip link set can0 up type can bitrate 1000000`, with the cell's channel "
        "and bit rate",
    ),
    errno.EPERM: (
        "no permission to use it",
        "a user who may open CAN sockets",
        "run it as such a user; in a container, share the host's network and the "
        "capability NET_RAW",
    ),
    errno.ENOSPC: ("no space left", "room for frames and files", "free space on the disk"),
    errno.ETIMEDOUT: (
        "no answer from its host",
        "a host that can be reached",
        "check `bus.host` in the cell file, the network cable and the firewall",
    ),
}
"""Found, expected and remedy of an error on a bus, by the operating system's number."""
_BUS_ADVICE[errno.EPROTONOSUPPORT] = _BUS_ADVICE[errno.EAFNOSUPPORT]
_BUS_ADVICE[errno.EACCES] = _BUS_ADVICE[errno.EPERM]
_BUS_ADVICE[errno.EHOSTUNREACH] = _BUS_ADVICE[errno.ETIMEDOUT]
_BUS_ADVICE[errno.ENETUNREACH] = _BUS_ADVICE[errno.ETIMEDOUT]


@dataclass(frozen=True, slots=True)
class ErrorParts:
    """An error in its parts."""

    kind: str  #: class of the error
    error: str  #: subject, or the complete message if the message says what was found
    found: str
    expected: str
    do: str  #: remedy
    exit_code: int
    notes: dict[str, str] = field(default_factory=dict)  #: by label, see `NOTES`
    #: parts of the stop, and of the restoring of settings, that could not be confirmed
    unconfirmed: tuple[str, ...] = ()
    #: axes that had power and are not confirmed without it; empty where there are none
    powered: str = ""

    @classmethod
    def of(cls, error: Exception, verb: str = "") -> ErrorParts:
        """Split an error of `daq`, `drivers` or `ident`; `verb` is the one that raised it."""
        subject, found, expected, remedy = map(for_command_line, _parts(error, verb))
        kind = type(error)
        code = exit_code(kind) or ExitCode.UNEXPECTED
        notes: dict[str, str] = {}
        for note in getattr(error, "__notes__", ()):
            label, _, text = note.partition(": ")
            if label in NOTES:
                notes[label] = text
        stop_notes = driver.stop_notes(error)
        unconfirmed = tuple(note for note in stop_notes if note.startswith(driver.WHILE))
        return cls(
            kind=kind.__name__,
            error=subject,
            found=found,
            expected=expected,
            do=remedy,
            exit_code=int(code),
            notes=notes,
            unconfirmed=unconfirmed,
            powered=may_have_power(error),
        )

    def document(self) -> ErrorReport:
        """Return the object of `--json`.

        Its types are not checked: an error with any content is reported, and bytes of file names
        that are not UTF-8 stay.
        """
        from daq.report.document import ErrorReport

        optional_parts: dict[str, Any] = dict(self.notes)
        if self.powered:
            optional_parts["axes"] = NOT_STOPPED.format(self.powered)
        if self.unconfirmed:
            optional_parts["unconfirmed"] = list(self.unconfirmed)
        return ErrorReport.model_construct(
            error=self.error,
            found=self.found,
            expected=self.expected,
            do=self.do,
            exit_code=self.exit_code,
            kind=self.kind,
            **optional_parts,
        )

    def lines(self) -> Iterator[tuple[str, str, str]]:
        """Yield label, text and style of each line for a terminal."""
        yield "error", self.error, "bold red"
        evidence = {"found": self.found, "expected": self.expected, "do": self.do}
        for label, text in evidence.items():
            # The first line may be the complete message: it is not repeated.
            if text != self.error:
                yield label, text, "bold"
        for label, text in self.notes.items():
            yield label, text, "bold"
        for text in self.unconfirmed:
            yield "note", text, "bold"
        if self.powered:
            yield "AXES", NOT_STOPPED.format(self.powered), "bold red"


def may_have_power(error: BaseException | None) -> str:
    """Name the axes that had power and are not confirmed without it; empty where there are none."""
    axes = []
    for note in driver.stop_notes(error):
        if note.startswith(driver.POWERED):
            axes.append(note.removeprefix(driver.POWERED))
    return ", ".join(axes)


def _parts(error: Exception, verb: str) -> tuple[str, str, str, str]:
    """Return subject, found, expected and remedy."""
    of_process = _advice_for_process(error)
    if of_process is not None:
        return of_process
    if isinstance(error, DaqError | WITH_EVIDENCE):
        return error.subject, error.found, error.expected, error.remedy
    if isinstance(error, driver.BusError):
        number = _system_error_number(error)
        if number in _BUS_ADVICE:
            found, expected, remedy = _BUS_ADVICE[number]
            return f"bus {error.address}", found, expected, remedy
    # The simulated cell of `demo` has no file, wiring or drives that these remedies are about.
    if verb != "demo":
        if isinstance(error, driver.MotionRefused) and error.remedy:
            return "motion is refused", error.found, error.expected, error.remedy
        if isinstance(error, driver.SetupRefused) and error.remedy:
            # The answer of the drive says more than the class of the error.
            return error.found, error.found, error.expected, error.remedy
    expected, remedy = _advice_for_evidence(error, verb) or _advice(type(error), verb)
    message = str(error)
    if isinstance(error, driver.DriveFault):
        # The message of the library ends with the remedy, which has a line of its own here.
        message = message.removesuffix(f"; {remedy}")
    if verb == "demo":
        message = message.replace(RESET, "")
    return message, message, expected, remedy


def _advice_for_process(error: Exception) -> tuple[str, str, str, str] | None:
    """Return the parts of an error whose cause is this process, not the file or bus that it names;
    None for any other.
    """
    number = _system_error_number(error)
    subject = getattr(error, "subject", str(error))
    if number in (errno.EMFILE, errno.ENFILE):
        return (
            subject,
            "too many open files",
            "room for another open file",
            "close other programs, or raise the limit (`ulimit -n`), then repeat the command",
        )
    if number == errno.ENOENT and _is_current_folder_gone():
        return (
            subject,
            "no current folder: the one that this shell is in was removed",
            "a current folder that is there",
            "change to another folder (`cd`), then repeat the command",
        )
    return None


def _is_current_folder_gone() -> bool:
    """Whether the folder that relative names begin in was removed."""
    try:
        Path.cwd()
    except FileNotFoundError:
        return True
    return False


def _advice_for_evidence(error: Exception, verb: str) -> tuple[str, str] | None:
    """Return expected and remedy by what is known of an error of a drive;
    None where its class says enough.
    """
    if verb == "demo":
        return None
    if isinstance(error, driver.SampleLost | driver.StateRefused):
        if any(error.reported):
            return _ERROR_REPORTED
    elif isinstance(error, driver.DriveFault):
        return _advice_for_fault(error, verb)
    return None


def _advice_for_fault(error: driver.DriveFault, verb: str) -> tuple[str, str] | None:
    """Return expected and remedy of a fault that has no code of an EMCY; None for one with it."""
    if error.emcy_code is not None:
        return None
    if error.remedy:
        expected, _ = _advice(type(error), verb)
        return expected, error.remedy
    fault_bits = STATUS_FAULT | STATUS_FOLLOWING_ERROR
    if error.statusword is not None and error.statusword & fault_bits:
        return _FAULT_WITHOUT_CODE
    return _NO_POWER


def _advice(kind: type[Exception], verb: str) -> tuple[str, str]:
    """Return expected and remedy for a class of errors, empty where there is no advice."""
    if verb == "demo":
        known_advice = ADVICE_WITHIN["demo"]
    else:
        known_advice = ADVICE | ADVICE_WITHIN.get(verb, {})
    for base in kind.__mro__:  # the nearest class first
        if base in known_advice:
            return known_advice[base]
    return "", ""


def _system_error_number(error: BaseException | None) -> int | None:
    """Return the number of the operating system's error that caused an error, None without one."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, OSError) and error.errno is not None:
            return error.errno
        error = error.__cause__
    return None


INDENT = 10  #: Width of the labels of an error [columns]


def show_failure(failure: ErrorParts, *, json_wanted: bool) -> None:
    """Print an error on stderr; if stderr cannot be written, the exit code alone reports it."""
    console = Console(stderr=True, soft_wrap=True)
    with suppress(OSError, ValueError):  # a full disk, a reader that has gone, a closed stream
        if json_wanted:
            # Imported only here: an error as text does not need the types of documents.
            from daq.report.document import json_tree

            tree = json_tree(failure.document())
            line = json.dumps(tree, ensure_ascii=False)
            console.file.write(spelled_bytes(line) + "\n")
            return
        line_start = "\n" + INDENT * " "
        for label, text, style in failure.lines():
            shown = printable(text)
            if console.is_terminal:
                width = max(console.width - INDENT, 1)
                shown = break_lines(shown, width)
            # A line end in the name of a file must not look like another line of the error.
            indented = shown.replace("\n", line_start)
            padded_label = f"{label}:".ljust(INDENT)
            console.print(Text(padded_label, style=style) + Text(indented))
