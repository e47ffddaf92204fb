"""Everything that can go wrong between a file and a screen, and the exit code of every error of the three packages.

DaqError
├── UsageError                  the command asks for what cannot be done                      exit 2
│   ├── OutputExists            a file would be overwritten
│   ├── SecretKeyUnfit          no secret key, another password, or a key that others may read
│   └── PlanUnfit               no moves within these limits excite every parameter
├── CalibrationRefused          a gate of the write-back is closed                            exit 3
│   ├── CalibrationEdited       calibration.yaml was changed by hand
│   ├── ControllerUnfit         the controller file cannot be read, or lacks a gain's key
│   ├── ControllerChanged       the controller file is not the one that the diff was shown for
│   ├── ControllerBusy          somebody else is writing the controller file
│   ├── SignatureInvalid        a trusted person's signature does not fit the calibration
│   ├── BackupMissing           there is nothing to roll back to
│   └── AuditUnusable           what is done could not be written down
├── DataError                   a recording cannot be used                                    exit 4
│   ├── CalibrationMissing      there is no such calibration file
│   ├── CalibrationUnreadable   it is none, of another version, or broken
│   ├── LogUnreadable
│   │   ├── LogMissing          there is no such log
│   │   ├── LogForeign          not MCAP, or not a log of a cell
│   │   ├── LogTruncated        the end is missing: power loss, a killed recorder, a broken copy
│   │   ├── LogCorrupt          a checksum or a length does not fit
│   │   └── LogIncomplete       cell configuration, readback or run metadata are not in the log
│   ├── TableUnfit              a CSV file of another controller
│   │   ├── TableMissing        there is no such file
│   │   ├── TableEmpty          it has no rows
│   │   ├── TableTruncated      its last row is incomplete
│   │   ├── TableColumns        it has other columns than the description says
│   │   ├── TableNotNumeric     a field is not a finite number
│   │   └── TimeNotUniform      its time column has gaps or jumps
│   ├── HistoryUnreadable       the history is no SQLite file of ours, broken, of another version, or cannot be written
│   ├── HistoryMixed            a calibration of another cell, other axes, or gains in other units
│   ├── AuditBroken             the audit is not what was written: entries were changed, moved or taken away
│   ├── LogsDiffer              logs of different cells, or of different configurations of one
│   ├── LogRepeated             one recording twice
│   ├── RolesExchanged          loaded and unloaded runs are mistaken for each other
│   ├── ModelContradicted       the declared model explains less of the data than it leaves
│   └── RunUnfit
│       ├── RunInvalid          the recorder itself marked it invalid
│       ├── CyclesLost          SYNC cycles are missing
│       ├── ClockImplausible    the time stamps show another rate than was asked for, or uneven steps
│       ├── CurrentSaturated    a limit acted in too large a part of the run
│       ├── CurrentImplausible  a dead channel, or a number that is no current
│       ├── SpeedImplausible    faster than the joint can be: a wrong rate
│       └── PositionImplausible far outside the joint limits: deg for rad, or a wrong drive train
├── ConfigurationError          a configuration file is wrong                                 exit 6
│   ├── ConfigurationMissing    there is no such file
│   ├── YamlInvalid             not YAML, a duplicate key, an alias
│   ├── SchemaMismatch          unknown key, missing key, wrong type
│   └── ConfigurationInconsistent  each value is well-formed, together they describe no cell
├── JobHeld                     a job may not go on now; the next one takes it up             exit 14
│   ├── NotReleased             the interlock does not let the robot move                     exit 11
│   ├── BusTaken                another recording or job of drivegain has the bus             exit 12
│   ├── TimeBoundReached        the job took longer than it may; the axes were stopped        exit 13
│   ├── MountFailed             the command that mounts a payload failed
│   └── ClockWentBack           the wall clock is behind what was written down before
└── OutputFailed                the disk is full, the folder is read-only                     exit 1
    └── DiskSpaceShort          too little room for a recording, before it or during it

`drivegain recalibrate` ends with 10 where it found a change that waits for a person.
drivers.errors.DriverError is exit 5, ident.errors.IdentificationError is exit 4.
"""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path

from drivers.errors import DriverError, MotionRefused
from ident.errors import IdentificationError


class ExitCode(IntEnum):
    """What the shell, a scheduled job or a PLC sees of the outcome."""

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
    INTERRUPTED = 130


class DaqError(Exception):
    """Root of the tree: what it is about, what was found, what was expected, and what to do."""

    def __init__(self, subject: str, *, found: str, expected: str, remedy: str) -> None:
        super().__init__(f"{subject}: found {found}; expected {expected}; {remedy}")
        self.subject = subject
        self.found = found
        self.expected = expected
        self.remedy = remedy

    def __reduce__(self) -> tuple[object, ...]:
        # The arguments of `__init__` are not the message that `args` holds: without this, no process can hand one of
        # these to another.
        return type(self).__new__, (type(self), *self.args), self.__dict__


class UsageError(DaqError):
    """The command asks for what cannot be done."""


class OutputExists(UsageError):
    """A file would be overwritten."""


class SecretKeyUnfit(UsageError):
    """No secret key, another password, or a key that others may read."""


class PlanUnfit(UsageError):
    """No moves within these limits and this time excite every parameter."""


class CalibrationRefused(DaqError):
    """A gate of the write-back is closed; nothing was written."""


class CalibrationEdited(CalibrationRefused):
    """A calibration file is not what was fitted."""


class ControllerUnfit(CalibrationRefused):
    """The controller file cannot be read, or lacks a gain's key."""


class ControllerChanged(CalibrationRefused):
    """The controller file is not the one that the diff was shown for."""


class ControllerBusy(CalibrationRefused):
    """Somebody else is writing the controller file."""


class SignatureInvalid(CalibrationRefused):
    """A trusted person's signature stands beside the calibration and does not fit it."""


class BackupMissing(CalibrationRefused):
    """There is nothing to roll back to."""


class AuditUnusable(CalibrationRefused):
    """The audit is no regular file, is locked for long, or its last line is not what was written."""


class DataError(DaqError):
    """A recording cannot be used."""


class CalibrationMissing(DataError):
    """There is no such calibration file, or it cannot be read."""


class CalibrationUnreadable(DataError):
    """Not a calibration file, of another version, or broken."""


class LogUnreadable(DataError):
    """A log cannot be read."""


class LogMissing(LogUnreadable):
    """There is no such log."""


class LogForeign(LogUnreadable):
    """Not MCAP, or not a log of a cell."""


class LogTruncated(LogUnreadable):
    """The end is missing."""


class LogCorrupt(LogUnreadable):
    """A checksum or a length does not fit."""


class LogIncomplete(LogUnreadable):
    """Something that a log must carry is not in it."""


class TableUnfit(DataError):
    """A CSV file of another controller cannot be imported."""


class TableMissing(TableUnfit):
    """There is no such file."""


class TableEmpty(TableUnfit):
    """The file has no rows."""


class TableTruncated(TableUnfit):
    """The last row is incomplete."""


class TableColumns(TableUnfit):
    """The file has other columns than the description says."""


class TableNotNumeric(TableUnfit):
    """A field is not a finite number."""


class TimeNotUniform(TableUnfit):
    """The time column has gaps or jumps."""


class HistoryUnreadable(DataError):
    """The history is no SQLite file of ours, broken, of another version, or cannot be written."""


class HistoryMixed(DataError):
    """A calibration of another cell, of other axes, or with gains in other units than the history's."""


class AuditBroken(DataError):
    """The audit is not what was written: entries were changed, moved or taken away."""


class LogsDiffer(DataError):
    """Logs of different cells, or of different configurations of one."""


class LogRepeated(DataError):
    """One recording twice, in the fit or in fit and hold-out."""


class RolesExchanged(DataError):
    """Loaded and unloaded runs are mistaken for each other."""


class ModelContradicted(DataError):
    """The declared model explains less of the data than it leaves."""


class RunUnfit(DataError):
    """A log can be read, and its samples cannot be used."""


class RunInvalid(RunUnfit):
    """The recorder itself marked the run invalid."""


class CyclesLost(RunUnfit):
    """SYNC cycles are missing; they are never interpolated."""


class ClockImplausible(RunUnfit):
    """The time stamps show another rate than was asked for, or uneven steps."""


class CurrentSaturated(RunUnfit):
    """A limit acted in too large a part of the run."""


class CurrentImplausible(RunUnfit):
    """A dead channel, or a number that is no current."""


class SpeedImplausible(RunUnfit):
    """Faster than the joint can be: a wrong rate."""


class PositionImplausible(RunUnfit):
    """Positions far outside the joint limits."""


class ConfigurationError(DaqError):
    """A configuration file is wrong."""


class ConfigurationMissing(ConfigurationError):
    """There is no such file."""


class YamlInvalid(ConfigurationError):
    """Not YAML, a duplicate key, or an alias."""


class SchemaMismatch(ConfigurationError):
    """Unknown key, missing key, or wrong type."""


class ConfigurationInconsistent(ConfigurationError):
    """Each value is well-formed; together they describe no cell."""


class JobHeld(DaqError):
    """A job may not go on now; nothing was written to a controller, and the next one takes it up."""


class NotReleased(JobHeld):
    """The interlock does not let the robot move."""


class BusTaken(JobHeld):
    """Another recording or job of drivegain has the bus."""


class TimeBoundReached(JobHeld):
    """The job took longer than it may; the axes were stopped."""


class MountFailed(JobHeld):
    """The command that mounts a payload failed, or took too long."""


class ClockWentBack(JobHeld):
    """The wall clock is behind what was written down before."""


class OutputFailed(DaqError):
    """The disk is full, or the folder is read-only."""

    @classmethod
    def of(cls, path: Path, error: OSError) -> OutputFailed:
        """What the file system said when a file was written whole or not at all."""
        return cls(
            str(path),
            found=(error.strerror or type(error).__name__).lower(),
            expected="a folder that can be written, with room",
            remedy="nothing was changed; free space or rights, or choose another folder",
        )


class DiskSpaceShort(OutputFailed):
    """Too little room on the disk for a recording: it does not begin, or the axes were stopped and the log finished."""


EXIT_CODES: tuple[tuple[type[Exception], ExitCode], ...] = (
    (UsageError, ExitCode.USAGE),
    (CalibrationRefused, ExitCode.CALIBRATION_REFUSED),
    (DataError, ExitCode.DATA_UNFIT),
    (ConfigurationError, ExitCode.CONFIGURATION),
    (NotReleased, ExitCode.NOT_RELEASED),
    (BusTaken, ExitCode.BUS_TAKEN),
    (TimeBoundReached, ExitCode.TIME_BOUND),
    (JobHeld, ExitCode.JOB_HELD),
    (OutputFailed, ExitCode.UNEXPECTED),
    (IdentificationError, ExitCode.DATA_UNFIT),
    (MotionRefused, ExitCode.USAGE),
    (DriverError, ExitCode.DEVICE_FAULT),
)
"""Exit code of every error class with a cause that a user can act on; the first that fits wins."""


def exit_code(kind: type[BaseException]) -> ExitCode | None:
    """Exit code of an exception class, None when it is none of ours."""
    for root, code in EXIT_CODES:
        if issubclass(kind, root):
            return code
    return None
