"""Errors of the service, and the exit code of every error of the three packages.

DaqError
├── UsageError            exit 2    PlanTooShort
├── CalibrationRefused    exit 3    ControllerUnfit, ControllerChanged, SignatureInvalid, AuditUnusable
├── DataError             exit 4    CalibrationMissing, CalibrationUnreadable, TableUnfit, HistoryUnreadable,
│   │                               LogsDiffer, LogRepeated, RunInvalid, CyclesLost, ClockImplausible,
│   │                               CurrentSaturated, CurrentImplausible, PositionImplausible, EffectsRefuted
│   └── LogUnreadable               LogMissing, LogForeign, LogTruncated, LogCorrupt, LogIncomplete
├── ConfigurationError    exit 6    ConfigurationMissing, YamlInvalid, SchemaMismatch, ConfigurationInconsistent
├── VirtualBusEmpty       exit 5
├── WorkersLost           exit 2
├── JobHeld               exit 14   NotReleased (exit 11), BusTaken (exit 12), TimeBoundReached (exit 13)
└── OutputFailed          exit 1    DiskSpaceShort

A kind of failure has a class of its own where a caller catches it, where it has its own exit code,
or where its name is data: `drivegain fleet` reports the class of every failed cell. Everything else
raises the parent, with a message that says what was found.

`drivegain recalibrate` exits with 10 when it found a change that an operator has to approve.
drivers.errors.DriverError is exit 5, ident.errors.IdentificationError is exit 4.
"""  # noqa: E501

from __future__ import annotations

import errno
import shlex
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path

from drivers.errors import DriverError, MotionRefused
from ident.errors import IdentificationError


class ExitCode(IntEnum):
    """Outcome of a command for the shell, a scheduled job or a PLC."""

    OK = 0
    UNEXPECTED = 1
    USAGE = 2
    CALIBRATION_REFUSED = 3
    DATA_UNFIT = 4
    DEVICE_FAULT = 5
    CONFIGURATION = 6
    PROPOSED = 10
    NOT_RELEASED = 11
    BUS_TAKEN = 12
    TIME_BOUND = 13
    JOB_HELD = 14
    NOT_ACCEPTED = 15
    INTERRUPTED = 130


#: Characters of one part of a message; what was found may be a field of a damaged file, of any size
LONGEST = 4000


def _cut(text: str) -> str:
    if len(text) <= LONGEST:
        return text
    return f"{text[:LONGEST]}... ({len(text) - LONGEST} more characters)"


class DaqError(Exception):
    """Root of the tree; its message names subject, what was found, what was expected,
    and what to do.
    """

    def __init__(self, subject: str, *, found: str, expected: str, remedy: str) -> None:
        subject = _cut(subject)
        found = _cut(found)
        expected = _cut(expected)
        super().__init__(f"{subject}: found {found}; expected {expected}; {remedy}")
        self.subject = subject
        self.found = found
        self.expected = expected
        self.remedy = remedy

    def __reduce__(self) -> tuple[object, ...]:
        # `args` holds the message, not the arguments of `__init__`: without this the error could
        # not be pickled.
        return type(self).__new__, (type(self), *self.args), self.__dict__


def counted(count: int, noun: str) -> str:
    """Write a number of things: ``1 entry``, ``2 entries``."""
    if count == 1:
        return f"{count} {noun}"
    if noun.endswith("y"):
        return f"{count} {noun[:-1]}ies"
    return f"{count} {noun}s"


def on_one_line(text: str) -> str:
    """Return a text of a file for one line of a message: with its control characters and line ends
    escaped.
    """
    if text.isprintable():
        return text
    return ascii(text)


def first_few(texts: Sequence[str], count: int, *, separator: str = "; ", note: str = "") -> str:
    """Join the first of some texts, and say how many more there are: ``a; b; and 3 more``.

    Args:
        texts: all of them.
        count: of those that are shown.
        separator: between two texts, and before the number of the others.
        note: after the number of the others, such as where all are.
    """
    parts = list(texts[:count])
    more = len(texts) - count
    if more > 0:
        parts.append(f"and {more} more{note}")
    return separator.join(parts)


def evidence(error: Exception) -> str:
    """Return where and what an error found, without its remedy:
    for a warning about work that is done all the same.
    """
    if isinstance(error, DaqError):
        return f"{error.subject}: {error.found}"
    return str(error)


class UsageError(DaqError):
    """The command asks for something that cannot be done."""


class PlanTooShort(UsageError):
    """The duration of a plan has no room for moves that are enough; a longer one has."""


class CalibrationRefused(DaqError):
    """A check of the write-back failed; nothing was written."""


class ControllerUnfit(CalibrationRefused):
    """The controller file cannot be read, or lacks a gain's key."""


class ControllerChanged(CalibrationRefused):
    """The controller file changed after its diff was shown."""


class SignatureInvalid(CalibrationRefused):
    """A signature of a trusted signer does not match the calibration."""


class AuditUnusable(CalibrationRefused):
    """The audit log is not a regular file, stays locked, or its last line was altered."""


class DataError(DaqError):
    """Recorded or derived data cannot be used."""


class CalibrationMissing(DataError):
    """The calibration file does not exist, or cannot be read."""


class CalibrationUnreadable(DataError):
    """Not a calibration file, of another version, or broken."""


class LogUnreadable(DataError):
    """The log cannot be read."""


class LogMissing(LogUnreadable):
    """The log does not exist."""


class LogForeign(LogUnreadable):
    """Not MCAP, or not a log of a cell."""


class LogTruncated(LogUnreadable):
    """The end of the log is missing: power loss, a killed recorder, an incomplete copy."""


class LogCorrupt(LogUnreadable):
    """A checksum or a length does not match."""


class LogIncomplete(LogUnreadable):
    """Cell configuration, readback or run metadata are missing from the log."""


class TableUnfit(DataError):
    """A file of another controller cannot be imported."""


class HistoryUnreadable(DataError):
    """Not a history of drivegain, broken, of another version, or not writable."""


class HistoryInaccessible(HistoryUnreadable):
    """A history that may be sound: another program keeps it locked,
    or its rights do not let it be read.
    """


class LogsDiffer(DataError):
    """Logs of different cells, or of different configurations of one."""


class LogRepeated(DataError):
    """One recording twice, in the fit or in fit and hold-out."""


class RunInvalid(DataError):
    """The recorder itself marked the run invalid."""


class CyclesLost(DataError):
    """SYNC cycles are missing; they are never interpolated."""


class ClockImplausible(DataError):
    """The time stamps show another rate than declared, or uneven steps."""


class CurrentSaturated(DataError):
    """A limit was active in too large a part of the run."""


class CurrentImplausible(DataError):
    """A current is an outlier that no amplifier sets."""


class PositionImplausible(DataError):
    """Positions far outside the joint limits (degrees for radians, a wrong drive train),
    or a step no motor makes.
    """


class EffectsRefuted(DataError):
    """The effects found raise the error of held-out runs by more than its noise."""


class ConfigurationError(DaqError):
    """A configuration file is wrong."""


class ConfigurationMissing(ConfigurationError):
    """A configuration file does not exist."""


class YamlInvalid(ConfigurationError):
    """Not YAML, a duplicate key, or an alias."""


class SchemaMismatch(ConfigurationError):
    """Unknown key, missing key, or wrong type."""


class ConfigurationInconsistent(ConfigurationError):
    """Each value is valid; together they contradict each other."""


class VirtualBusEmpty(DaqError):
    """No node answers on a virtual bus, which ends at the program that opened it."""


class WorkersLost(DaqError):
    """The workers of a fleet, or their scheduler, ended before the work was done."""


class JobHeld(DaqError):
    """A job may not go on now; nothing was written to a controller, and the next job resumes it."""


class NotReleased(JobHeld):
    """The interlock does not release the robot."""


class BusTaken(JobHeld):
    """Another program of drivegain uses the bus, such as a recording or a job."""


class TimeBoundReached(JobHeld):
    """The job exceeded its time limit; the axes were stopped."""


class OwnerNotKept(PermissionError):
    """A new file cannot have the owner and group of the one that it would replace:
    nothing is written.
    """

    def __init__(self, path: Path, differing: str) -> None:
        """Store what differs.

        Args:
            path: file that would be replaced.
            differing: its owner and group where a new file of this user has others, in words.
        """
        super().__init__(
            errno.EPERM, f"this user may not make a file of its {differing}", str(path)
        )


class FileImmutable(PermissionError):
    """A file or folder has a mark of its file system (``chattr +i``, ``+a``),
    because of which even root cannot replace the file: nothing is written.
    """

    def __init__(self, path: Path, marked: Path) -> None:
        """Store what has the mark.

        Args:
            path: file that would be replaced.
            marked: the file, or its folder.
        """
        self.marked = marked
        self.reason = f"{marked} is marked as immutable or append-only (`chattr`)"
        super().__init__(errno.EPERM, self.reason, str(path))


class WriteUnconfirmed(OSError):
    """The system took the new content, or a part of an entry, and failed after that:
    whether the disk has it is not known.
    """

    @classmethod
    def of(cls, path: Path, error: OSError) -> WriteUnconfirmed:
        """Make the error for a file that may have its new content."""
        return cls(error.errno, error.strerror, str(path))


class OutputFailed(DaqError):
    """The disk is full, or the folder is read-only."""

    @classmethod
    def of(cls, path: Path, error: OSError, *, state: str = "") -> OutputFailed:
        """Make the error for a file that was replaced whole or not at all.

        Args:
            path: of the file.
            error: of the system.
            state: what the file is now, in words; by default whether it is as it was.
        """
        state = state or _state_after(path)
        if isinstance(error, WriteUnconfirmed):
            return cls(
                str(path),
                found=reason_of(error),
                expected="a file system that completes what it began",
                remedy="it may have the new content: check the disk, then repeat the command",
            )
        if isinstance(error, OwnerNotKept):
            return cls(
                str(path),
                found=reason_of(error),
                expected="a user who may keep owner and group of the file, so that who reads it "
                "now can read it then",
                remedy=f"{state}; run the command as its owner and in its group (`sudo -u`, "
                "or `usermod -aG` and a new login), or give the file to this user (`chown`, "
                "`chgrp`) if the controller can read it then",
            )
        if isinstance(error, FileImmutable):
            return cls(
                str(path),
                found=error.reason,
                expected="a file that may be replaced",
                remedy=f"{state}; ask who set the mark and why, take it off "
                f"(`chattr -i -a {shlex.quote(str(error.marked))}`), then repeat the command",
            )
        missing = cls.of_missing_folder(path, error)
        if missing is not None:
            return missing
        if error.errno == errno.ENAMETOOLONG:
            return cls(
                str(path),
                found=reason_of(error),
                expected="a name that the file system takes, with the endings of its temporary "
                "files",
                remedy=f"{state}; choose a shorter name",
            )
        return cls(
            str(path),
            found=reason_of(error),
            expected="a folder that can be written, with room",
            remedy=f"{state}; free space or rights, or choose another folder",
        )

    @classmethod
    def of_missing_folder(cls, path: Path, error: OSError) -> OutputFailed | None:
        """Make the error for a file whose folder is not there, or is a file; None for another
        reason.
        """
        # Only of these errors: another may say that the folders above cannot be looked at.
        is_missing = error.errno in {errno.ENOENT, errno.ENOTDIR, errno.EEXIST}
        if not is_missing or path.parent.is_dir():
            return None
        above = next(folder for folder in path.absolute().parents if folder.exists())
        if not above.is_dir():
            return cls(
                str(path),
                found=f"{above} is a file",
                expected="a folder above the output",
                remedy="nothing was written; choose another folder",
            )
        return cls(
            str(path),
            found=f"no folder {path.parent}",
            expected="a folder that is there",
            remedy="nothing was written; make it (`mkdir -p`), or choose another folder",
        )


def _state_after(path: Path) -> str:
    """Say what a file is that was not written: one that never existed is not as it was."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return "it was not made"
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            return "it was not made"
        return "it is as it was"
    if stat.S_ISREG(found.st_mode) and found.st_size == 0:
        return "it is empty"
    return "it is as it was"


def reason_of(error: OSError) -> str:
    """Return what the system says of a refusal, in small letters."""
    return (error.strerror or type(error).__name__).lower()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Report a refusal of the file system within the block as an output that failed.

    Raises:
        OutputFailed: the file system refuses.
    """
    try:
        yield
    except OSError as error:
        raise OutputFailed.of(path, error) from error


class DiskSpaceShort(OutputFailed):
    """Too little room for a recording: it does not begin,
    or the axes were stopped and the log was finished.
    """


EXIT_CODES: tuple[tuple[type[Exception], ExitCode], ...] = (
    (UsageError, ExitCode.USAGE),
    (CalibrationRefused, ExitCode.CALIBRATION_REFUSED),
    (DataError, ExitCode.DATA_UNFIT),
    (ConfigurationError, ExitCode.CONFIGURATION),
    (VirtualBusEmpty, ExitCode.DEVICE_FAULT),
    (WorkersLost, ExitCode.USAGE),
    (NotReleased, ExitCode.NOT_RELEASED),
    (BusTaken, ExitCode.BUS_TAKEN),
    (TimeBoundReached, ExitCode.TIME_BOUND),
    (JobHeld, ExitCode.JOB_HELD),
    (OutputFailed, ExitCode.UNEXPECTED),
    (IdentificationError, ExitCode.DATA_UNFIT),
    (MotionRefused, ExitCode.USAGE),
    (DriverError, ExitCode.DEVICE_FAULT),
)
"""Exit code of every error class with a cause that a user can act on; the first match wins."""


def exit_code(kind: type[BaseException]) -> ExitCode | None:
    """Exit code of an exception class, or None for a foreign one."""
    return next((code for root, code in EXIT_CODES if issubclass(kind, root)), None)
