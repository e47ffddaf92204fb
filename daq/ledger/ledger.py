"""The ledger of a cell: its audit log, and the history that is folded from it.

Everything is written once, into the audit log. `record_write` is for `apply` and `rollback` of
`daq.writeback.target` alone: whoever writes gains calls these. A history of an earlier version, in
SQLite, is taken into the audit log by the first command that enters or shows the history
(`migrate`).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path

from daq.config.cell import Cell
from daq.config.same_cell import calibrated_robot, mismatch_of_robot
from daq.documents.calibration_file import encode_calibration
from daq.errors import (
    DataError,
    HistoryInaccessible,
    HistoryUnreadable,
    OutputFailed,
    evidence,
    first_few,
    reason_of,
    writing,
)
from daq.files import fsync_folder
from daq.ledger.audit import (
    CONVERT_BACK,
    AuditAction,
    AuditEntry,
    AuditVerdict,
    append,
    begun_by,
    entry_after,
    head_file,
    note_obstacle,
    noted_heads,
    verify,
)
from daq.ledger.fold import (
    AuditedWrite,
    Event,
    History,
    RecordedAcceptance,
    at_of,
    entered_calibrations,
    figures_of,
    fold,
    iso,
    name_after_renames,
    shown_writes,
    unknown_writes,
)
from daq.ledger.migration import (
    EMPTY,
    EntryDraft,
    StoredHistory,
    drafts_of,
    history_subject,
    read_stored,
    set_aside,
)
from daq.ledger.names import cell_names, former_names, rename_of, renames_to, with_present_names
from ident.calibration import Calibration

_LOG = logging.getLogger("drivegain")
_SHOWN = 5  #: Sentences in an error; `history --verify --json` has all

WRITES = frozenset(
    {
        AuditAction.REFUSED,
        AuditAction.NOTHING_TO_DO,
        AuditAction.APPLY_BEGUN,
        AuditAction.APPLIED,
        AuditAction.ROLLBACK_BEGUN,
        AuditAction.ROLLED_BACK,
        AuditAction.FAILED,
        AuditAction.WRITE_FOUND,
    }
)
"""What `record_write` enters."""
SESSIONS = frozenset(
    {
        AuditAction.PROPOSED,
        AuditAction.RECALIBRATION_BEGUN,
        AuditAction.RECALIBRATION_ENDED,
        AuditAction.ACCEPTED,
        AuditAction.NOT_ACCEPTED,
    }
)
"""What `record_session` enters."""


@dataclass(frozen=True, slots=True)
class Ledger:
    """The ledger of a cell."""

    cell: Cell  #: as it is now
    audit: Path  #: the audit log
    #: history of an earlier version; None where the cell cannot have one
    stored: Path | None = None

    @classmethod
    def of(cls, cell: Cell, audit: Path | None = None) -> Ledger | None:
        """The ledger of a cell, or that of another audit log;
        None for a cell from a log without either.
        """
        place = cell.history
        if place is not None and audit in {None, place.audit}:
            return cls(cell, place.audit, place.store)
        return None if audit is None else cls(cell, audit)

    @property
    def outdated(self) -> bool:
        """Whether there is a history of an earlier version that was not migrated yet."""
        return self.stored is not None and self.stored.exists()


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of checking a ledger."""

    audit: Path  #: the audit log
    verdict: AuditVerdict  #: on it
    history: History  #: as far as it can be read
    #: what the history cannot show, and what a history of an earlier version says otherwise
    broken: tuple[str, ...]
    unknown: tuple[AuditedWrite, ...] = ()  #: writes that the history lacks
    #: whether the last entry of the audit log is noted, without which a missing end does not show
    noted: bool = True
    note_obstacle: str = ""  #: why the next entry cannot be noted either; empty where it can

    @property
    def complete(self) -> bool:
        """Whether the audit log holds and the history has every write."""
        return self.verdict.holds and not self.unknown


@dataclass(frozen=True, slots=True)
class Migrated:
    """What was taken over from a history of an earlier version."""

    entries: int  #: number of entries that the audit log got
    aside: Path | None  #: new name of the file; None where there was none
    #: why nothing was taken over from it, as sentences; empty where it is sound
    flaws: tuple[str, ...] = ()


MAY_LACK = (
    "the audit log is not what was written, so the history may lack something: `drivegain history "
    "CELL --verify` says what"
)
"""What a reader of a history with `may_lack` must know."""


def read_history(ledger: Ledger) -> History:
    """Read the history of a cell, as far as the audit log is what was written (`may_lack`).

    Nothing is entered. In a history of an earlier version the unfinished transaction of a killed
    writer is undone (`read_stored`).

    Raises:
        AuditUnusable: the audit log is no regular file, or it cannot be read.
        HistoryUnreadable: there is a history of an earlier version that cannot be read.
    """
    stored = _read_stored(ledger)
    verdict = verify(ledger.audit, stored.audit_digests.union(noted_heads(ledger.audit)))
    if stored.flaws:
        raise stored_error(ledger, stored.flaws)
    history = fold(_with_stored(verdict.intact, stored, ledger.cell), ledger.cell)
    return replace(history, may_lack=not verdict.holds)


def present_name(cell: Cell, name: str, at: datetime) -> str:
    """Return the name that a cell has now by an audit log, which had another name at a time.

    A name that a rename has freed may be another cell's: what was made under it before the rename
    is of the renamed cell, and what was made later is not.

    Args:
        cell: whose audit log is read.
        name: of any cell in that log, at the time.
        at: time, with zone.

    Raises:
        AuditUnusable: the audit log is no regular file, or it cannot be read.
    """
    ledger = Ledger.of(cell)
    if ledger is None:
        return name
    return name_after_renames(verify(ledger.audit).intact, name, at)


def is_damaged(audit: Path) -> bool:
    """Whether an audit log is not what was written.

    Raises:
        AuditUnusable: it is no regular file, or it cannot be read.
    """
    return not verify(audit, noted_heads(audit)).holds


def verify_ledger(ledger: Ledger, heads: Collection[str] = ()) -> Verification:
    """Check the audit log, and that the history has what it reports.

    Args:
        ledger: to check.
        heads: SHA-256 of entries of the audit log that were noted elsewhere, besides the note
            next to it.

    Raises:
        AuditUnusable, HistoryUnreadable: see `read_history`.
    """
    stored = _read_stored(ledger)
    noted = noted_heads(ledger.audit)
    verdict = verify(ledger.audit, stored.audit_digests.union(heads, noted))
    entries = _with_stored(verdict.intact, EMPTY if stored.flaws else stored, ledger.cell)
    history = fold(entries, ledger.cell)
    broken = stored.flaws + history.unreadable
    if not verdict.holds:  # its entries do not prove that anything is missing
        return Verification(ledger.audit, verdict, replace(history, may_lack=True), broken)
    known = history.digests
    unknown = unknown_writes(ledger.cell, entries, verdict.open_writes, known)
    is_noted = not verdict.entries or verdict.entries[-1].sha256 in noted
    # Whoever may only read the log cannot write the note either: that is no finding.
    obstacle = ""
    if not is_noted:
        obstacle = note_obstacle(ledger.audit)
    return Verification(
        ledger.audit,
        verdict,
        history,
        broken,
        unknown,
        noted=is_noted,
        note_obstacle=obstacle,
    )


def record_write(
    audit: Path,
    action: AuditAction,
    *,
    at: datetime,
    who: str,
    subject: str,
    details: Mapping[str, object],
) -> AuditEntry:
    """Enter one step of a write to a controller;
    only `apply` and `rollback` of `daq.writeback.target` do.

    Raises:
        ValueError: the action is none of `WRITES`.
        AuditUnusable, OSError: see `daq.ledger.audit.append`.
    """
    if action not in WRITES:
        raise ValueError(f"{action.value!r} is no step of a write")
    return append(audit, action, at=at, who=who, subject=subject, details=details)


def record_session(
    audit: Path,
    action: AuditAction,
    *,
    at: datetime,
    who: str,
    subject: str,
    details: Mapping[str, object],
) -> AuditEntry:
    """Enter a step of a session, which writes to no controller.

    Raises:
        ValueError: the action is none of `SESSIONS`.
        AuditUnusable, OutputFailed: it could not be recorded.
    """
    if action not in SESSIONS:
        raise ValueError(f"{action.value!r} is no step of a session")
    with writing(audit):
        return append(audit, action, at=at, who=who, subject=subject, details=details)


def enter_calibration(
    ledger: Ledger, calibration: Calibration, *, digest: str, who: str, at: datetime
) -> bool:
    """Enter a calibration, with the SHA-256 of its file,
    and writes whose writer was killed before it ended them.

    A history of an earlier version is migrated first, but not into an audit log that was changed.

    Returns:
        whether the calibration is new: a file is entered once.

    Raises:
        DataError: another cell, other axes, or a gain in another unit than the history's.
        AuditUnusable, HistoryUnreadable, OutputFailed: it could not be entered; see `migrate`.
    """
    try:
        _take_over(ledger, who=who, at=at)
        _put_aside(ledger, at)
    except HistoryUnreadable:
        raise
    except DataError as error:  # the next line goes after the changed ones all the same
        _LOG.warning("the history of an earlier version stays where it is: %s", evidence(error))
    except _NotPutAside as error:  # the audit log has all of it, and takes the calibration too
        _LOG.warning("the history of an earlier version keeps its name: %s", evidence(error))
    entries = verify(ledger.audit).intact
    known = {one.digest for one in entered_calibrations(entries, ledger.cell.name)}
    new = digest not in known
    if new:
        _check_like(ledger, calibration, fold(entries, ledger.cell))
        details = {
            "sha256": digest,
            "cell": ledger.cell.name,
            "entered": iso(at),
            "document": encode_calibration(calibration).decode(),
            "figures": figures_of(calibration, digest, at),
        }
        if calibration.robot is not None:
            details["robot"] = asdict(calibration.robot)
        _append(
            ledger,
            EntryDraft(
                AuditAction.CALIBRATION_ENTERED, at, who, history_subject(ledger.cell.name), details
            ),
        )
    _end_found_writes(ledger)
    return new


def acknowledge(
    ledger: Ledger, axis: str, *, since: datetime, at: datetime, who: str, why: str
) -> None:
    """Enter that a change of a gain is explained.

    Args:
        ledger: of the cell.
        axis: whose gain changed.
        since: calibrations from then on make the new baseline.
        at: time, with zone.
        who: explains it.
        why: what happened.

    Raises:
        AuditUnusable, OutputFailed: it could not be recorded.
    """
    details = {"axis": axis, "cell": ledger.cell.name, "since": since.isoformat(), "why": why}
    _append(ledger, EntryDraft(AuditAction.ACKNOWLEDGED, at, who, f"gain of {axis}", details))


@dataclass(frozen=True, slots=True)
class PlannedRename:
    """What a rename takes over in a ledger."""

    old: str  #: name of the cell
    new: str  #: that of its cell file
    calibrations: int  #: under the old name
    writes: int  #: of their gains, and rollbacks
    acknowledgements: int  #: explained changes
    undescribed: int  #: calibrations of earlier versions, which do not say their robot
    entered_at: datetime | None  #: when the audit log got the rename; None where it has none yet


def plan_rename(ledger: Ledger, old: str) -> PlannedRename:
    """Check that the history of an old name is of this cell's robot; nothing is written.

    Args:
        ledger: of the cell, whose file has the new name.
        old: the name before.

    Raises:
        DataError: the audit log is not what was written, has nothing under the old name, or has
            calibrations of another robot under one of the two names.
        AuditUnusable: the audit log is no regular file, or it cannot be read.
    """
    new = ledger.cell.name
    verdict = verify(ledger.audit, noted_heads(ledger.audit))
    if not verdict.holds:
        raise audit_error(ledger.audit, verdict)
    entries = verdict.entries
    under_old = fold(entries, replace(ledger.cell, name=old))
    for history in (under_old, fold(entries, ledger.cell)):
        _require_own_robot(ledger, history)
    is_known = old in cell_names(with_present_names(entries))
    is_entered = not is_known and old in former_names(entries, new)
    if not is_known and not is_entered:
        known = ", ".join(map(repr, sorted(cell_names(entries)))) or "none"
        raise DataError(
            str(ledger.audit),
            found=f"nothing of a cell {old!r}; cells in it: {known}",
            expected=f"the history of the cell that is called {new!r} now",
            remedy="give its earlier name as the audit log has it, or correct `history.audit` of "
            "the cell file",
        )
    incomparable = [one.entry for one in under_old.not_compared]
    calibrations = [*under_old.entries, *incomparable]
    return PlannedRename(
        old=old,
        new=new,
        calibrations=len(calibrations),
        writes=len(under_old.events),
        acknowledgements=len(under_old.acknowledgements),
        undescribed=sum(entry.robot is None for entry in calibrations),
        entered_at=_entered_rename_at(entries, old, new) if is_entered else None,
    )


def rename_cell(ledger: Ledger, planned: PlannedRename, *, who: str, at: datetime) -> None:
    """Enter that a cell has another name:
    one entry, which counts for all that was entered before it.

    Raises:
        AuditUnusable, OutputFailed: it could not be recorded.
    """
    if planned.entered_at is not None:
        return
    details = {
        "cell": planned.new,
        "old_name": planned.old,
        "robot": asdict(calibrated_robot(ledger.cell)),
    }
    _append(ledger, EntryDraft(AuditAction.RENAMED, at, who, f"cell {planned.new}", details))


def _entered_rename_at(entries: Sequence[AuditEntry], old: str, new: str) -> datetime | None:
    """Return when a cell gave up a name that it had before its present one;
    None where the entry has no time.
    """
    own = [rename for rename in renames_to(entries, new) if rename.old == old]
    found = None
    for one in entries:
        if rename_of(one) in own:
            found = at_of(one) or found
    return found


def _require_own_robot(ledger: Ledger, history: History) -> None:
    """Refuse to join the history of another robot.

    Raises:
        DataError: it is one.
    """
    axes = ledger.cell.axis_names
    found = ""
    expected = "calibrations of the robot that the cell file describes"
    if history.other_robots:
        found = str(history.other_robots[0])
    elif history.entries and tuple(gain.axis for gain in history.entries[-1].gains) != axes:
        entry = history.entries[-1]
        named = ", ".join(gain.axis for gain in entry.gains)
        found = f"calibrations of cell {entry.cell!r} with the axes {named}"
        expected = f"the axes {', '.join(axes)}, as in the cell file"
    if found:
        raise DataError(
            str(ledger.audit),
            found=found,
            expected=expected,
            remedy="two robots have no common history: give the earlier name of this robot; "
            "nothing was renamed",
        )


def migrate(ledger: Ledger, *, who: str, at: datetime, forced: bool = False) -> Migrated:
    """Take what only a history of an earlier version has into the audit log, and rename its file.

    A process that is killed in between leaves the file; the next one enters what is still missing.
    Calibrations that an earlier version has entered get their figures.

    Args:
        ledger: of the cell.
        who: the person or the job.
        at: time, with zone.
        forced: also rename a file that is broken, from which nothing is taken over; and
            add figures where there is no such file.

    Raises:
        HistoryInaccessible: the file is locked, or its rights do not let it be read; nothing was
            changed.
        HistoryUnreadable: the file is broken, without `forced`; nothing was changed.
        DataError: the audit log is not what was written; nothing was changed.
        AuditUnusable, OutputFailed: a file cannot be written; the next call goes on.
    """
    taken = _take_over(ledger, who=who, at=at, forced=forced)
    return replace(taken, aside=_put_aside(ledger, at))


def _take_over(ledger: Ledger, *, who: str, at: datetime, forced: bool = False) -> Migrated:
    """Enter what only a history of an earlier version has; its file keeps its name."""
    if not ledger.outdated and not forced:
        return Migrated(0, None)
    stored = EMPTY
    flaws: tuple[str, ...] = ()
    try:
        stored = _read_stored(ledger)
    except HistoryUnreadable as error:
        may_be_sound = isinstance(error, HistoryInaccessible)
        if may_be_sound or not forced:
            raise
        flaws = (error.found,)
    verdict = verify(ledger.audit, stored.audit_digests.union(noted_heads(ledger.audit)))
    if not verdict.holds:
        raise audit_error(ledger.audit, verdict)
    flaws += stored.flaws
    if flaws and not forced:
        raise stored_error(ledger, flaws)
    drafts = drafts_of(EMPTY if flaws else stored, verdict.entries, ledger.cell.name, who, at)
    for draft in drafts:
        _append(ledger, draft)
    return Migrated(len(drafts), None, flaws)


class _NotPutAside(OutputFailed):
    """All of it is in the audit log, and the file could not be renamed."""


def _put_aside(ledger: Ledger, at: datetime) -> Path | None:
    """Rename a history that was taken over; return its new name, None where there was none."""
    if ledger.stored is None or not ledger.outdated:
        return None
    try:
        aside = set_aside(ledger.stored, at)
        fsync_folder(aside.parent)
    except FileNotFoundError:  # another process was faster
        return None
    except OSError as error:
        raise _NotPutAside(
            str(ledger.stored),
            found=reason_of(error),
            expected="a new name for it, now that the audit log has its content",
            remedy="check the rights of its folder, and repeat the command; nothing is lost",
        ) from error
    return aside


def audit_error(audit: Path, verdict: AuditVerdict) -> DataError:
    """Return the error for an audit log that is not what was written."""
    first = verdict.flaws[0]
    if not audit.exists():
        return DataError(
            str(audit),
            found=f"no file; {first.says}",
            expected="the audit log with these entries",
            remedy="restore it from a backup; if there is none, begin a new log (another name in "
            "`history.audit`)",
        )
    note = ""
    if verdict.lacks_noted:
        note = f" (if the entries that are missing are of another log, remove {head_file(audit)})"
    if len(verdict.flaws) == 1:
        places = "1 place that is"
    else:
        places = f"{len(verdict.flaws)} places that are"
    more = "".join(
        f"\n  line {flaw.line}: {flaw.flaw.value}: {flaw.says}" for flaw in verdict.flaws
    )
    return DataError(
        f"{audit}, line {first.line}",
        found=f"{places} not what was written{more}\n ",
        expected="entries that were never changed, moved or removed",
        remedy=_remedy(verdict, note),
    )


def _remedy(verdict: AuditVerdict, note: str) -> str:
    """Return what to do about an audit log that is not what was written.

    Args:
        verdict: on it.
        note: on the digests that were noted next to it, in brackets.
    """
    if verdict.is_only_converted:
        return f"the entries are what was written: {CONVERT_BACK}"
    if verdict.is_torn_end:
        return (
            "keep a copy; restore the log and its `.head` from a backup, or without one begin "
            "another log under a new name (`history.audit`). A power failure, a failing disk or an "
            "unfinished copy leaves such an end: check the disk. If none of them happened, ask who "
            f"can write to the file{note}"
        )
    return (
        f"keep this file as it is, compare it with a backup{note}, ask who can write to it; "
        "until that is known trust the controller's file by its backups only, and begin another "
        "log under a new name (`history.audit`)"
    )


def stored_error(ledger: Ledger, flaws: Collection[str]) -> HistoryUnreadable:
    """Return the error for a history of an earlier version that is broken."""
    return HistoryUnreadable(
        str(ledger.stored),
        found=first_few(tuple(flaws), _SHOWN),
        expected="a sound SQLite file whose calibrations can be read",
        remedy="ask who can write to it, and restore the last good one from a backup, or go on "
        "without it: `drivegain history CELL --migrate` keeps it under another name, and takes "
        "nothing over from it",
    )


def _read_stored(ledger: Ledger) -> StoredHistory:
    if ledger.stored is None or not ledger.outdated:
        return EMPTY
    return read_stored(ledger.stored)


def _with_stored(
    entries: Sequence[AuditEntry], stored: StoredHistory, cell: Cell
) -> tuple[AuditEntry, ...]:
    """Return the entries as they will be once a history of an earlier version is migrated."""
    chain = list(entries)
    never = datetime.min.replace(tzinfo=UTC)  # these entries are only folded
    for draft in drafts_of(stored, entries, cell.name, "", never):
        last = chain[-1] if chain else None
        at = draft.at.isoformat()
        chain.append(entry_after(last, at, draft.who, draft.action, draft.subject, draft.details))
    return tuple(chain)


def _append(ledger: Ledger, draft: EntryDraft) -> AuditEntry:
    with writing(ledger.audit):
        return append(
            ledger.audit,
            draft.action,
            at=draft.at,
            who=draft.who,
            subject=draft.subject,
            details=draft.details,
        )


def _end_found_writes(ledger: Ledger) -> None:
    """Enter the writes without an end whose content the controller has now,
    in the name of their writers.

    Nothing is concluded from an audit log that was changed.
    """
    verdict = verify(ledger.audit)
    if not verdict.holds:
        return
    for write in shown_writes(ledger.cell, verdict.entries, verdict.open_writes):
        begun = write.ended
        at = at_of(begun)
        if at is None:
            continue
        details = {
            "action": write.action.value,
            "begun": begun.number,
            "calibration": {"sha256": write.calibration, "cell": ledger.cell.name},
            "sha256_after": write.sha256_after,
        }
        _append(ledger, EntryDraft(AuditAction.WRITE_FOUND, at, begun.who, begun.subject, details))


def _check_like(ledger: Ledger, calibration: Calibration, history: History) -> None:
    """Refuse a calibration that cannot be compared with those of the history."""
    remedy = (
        "gains are compared over time only where they mean the same: begin another audit log "
        "(`history.audit` of the cell file); it was not entered"
    )
    units = {gain.axis: gain.unit for gain in calibration.gains}
    known: dict[str, str] = {}
    for one in history.entries:
        known |= {gain.axis: gain.unit for gain in one.gains}
    robot = mismatch_of_robot(calibration, ledger.cell)
    other = [axis for axis in units if axis in known and units[axis] != known[axis]]
    if calibration.cell != ledger.cell.name:
        found = f"a calibration of cell {calibration.cell!r}"
        expected = f"of {ledger.cell.name!r}, as all in this history"
    elif robot is not None:
        found = robot.found
        expected = robot.expected
        remedy = "give the cell file of the robot that was calibrated; it was not entered"
    elif history.renamed is not None:
        found = (
            f"the cell name {ledger.cell.name!r}, which this robot had until {history.renamed.at}"
        )
        expected = f"{history.renamed.new!r}, its name since"
        remedy = f"{history.renamed.remedy}; it was not entered"
    elif history.other_robots:
        found = str(history.other_robots[0])
        expected = "calibrations of one robot in a history"
    elif not known and units.keys() != set(ledger.cell.axis_names):
        found = f"gains of {', '.join(units)}"
        expected = f"of {', '.join(ledger.cell.axis_names)}, the axes of the cell file"
        remedy = "give the cell file of the robot that was calibrated; it was not entered"
    elif known and units.keys() != known.keys():
        found = f"gains of {', '.join(units)}"
        expected = f"of {', '.join(known)}"
    elif other:
        axis = other[0]
        found = f"the gain of {axis} in {units[axis]}"
        expected = f"{known[axis]}, as in the calibrations before"
    else:
        return
    raise DataError(
        str(ledger.audit),
        found=found,
        expected=expected,
        remedy=remedy,
    )


class StandingState(Enum):
    """States of a calibration."""

    NOT_KNOWN = "not known"  #: no ledger was read
    NOT_WRITTEN = "not written"
    WRITTEN = "written"  #: a controller has its gains
    ACCEPTED = "accepted"  #: it was tried in the cell, and accepted
    NOT_ACCEPTED = "not accepted"  #: it was tried in the cell, and new moves contradict it
    REPLACED = "replaced"  #: its gains were written, and were replaced or rolled back since


@dataclass(frozen=True, slots=True)
class Standing:
    """State of one calibration at one time."""

    as_of: datetime | None  #: when the ledger was read, with zone; None where it was not
    unknown: str = ""  #: why it was not, in words; empty where it was
    #: last write of its gains, one that is in force if there is any; None if never written
    write: Event | None = None
    #: Next write or rollback at the same place; None while the gains are in force.
    ended: Event | None = None
    #: Previous gains, at that place before the write, by axis; empty where the ledger does not have
    #: them.
    before: Mapping[str, float] = field(default_factory=dict)
    acceptance: RecordedAcceptance | None = None  #: result of the last new moves with these gains
    history: History = field(default_factory=lambda: History((), (), ()))  #: that it was read from

    @property
    def state(self) -> StandingState:
        """State in one word."""
        if self.as_of is None:
            return StandingState.NOT_KNOWN
        if self.ended is not None:
            return StandingState.REPLACED
        if self.acceptance is not None and not self.acceptance.accepted:
            return StandingState.NOT_ACCEPTED
        if self.acceptance is not None:
            return StandingState.ACCEPTED
        if self.write is not None:
            return StandingState.WRITTEN
        return StandingState.NOT_WRITTEN


def read_standing(
    ledger: Ledger, digest: str, as_of: datetime, place: str | None = None
) -> Standing:
    """Read the state of a calibration from the ledger of its cell.

    Args:
        ledger: of the cell.
        digest: SHA-256 of the calibration's file.
        as_of: time now, with zone.
        place: controller's file, whose write counts before others where it is in force; None for
            any place.

    Raises:
        AuditUnusable: the audit log is no regular file, or it cannot be read.
        HistoryUnreadable: there is a history of an earlier version that cannot be read.
    """
    history = read_history(ledger)
    # Entries that were edited prove nothing.
    entries = verify(ledger.audit, noted_heads(ledger.audit)).intact
    write = _last_write(history, digest, place)
    acceptances = [one for one in history.acceptances if one.digest == digest]
    before: dict[str, float] = {}
    ended: Event | None = None
    if write is not None:
        before = _gains_before(write, entries)
        ended = _next_at_its_place(history, write)
    return Standing(
        as_of=as_of,
        write=write,
        ended=ended,
        before=before,
        acceptance=acceptances[-1] if acceptances else None,
        history=history,
    )


def _last_write(history: History, digest: str, place: str | None) -> Event | None:
    """Return the last write of a calibration's gains, one that is in force if there is any,
    and `place` first.
    """
    newest = {event.target: event for event in history.events}
    in_force = [event for event in newest.values() if event.digest == digest]
    here = [event for event in in_force if event.target == place]
    writes = here or in_force or [event for event in history.events if event.digest == digest]
    # In the order of the log: their times are by a clock that may have been wrong.
    return max(writes, key=history.events.index, default=None)


def _next_at_its_place(history: History, write: Event) -> Event | None:
    """Return the write or rollback that followed a write at the same place;
    None where there was none.
    """
    later = history.events[history.events.index(write) + 1 :]
    return next((event for event in later if event.target == write.target), None)


def _gains_before(write: Event, entries: Sequence[AuditEntry]) -> dict[str, float]:
    """Return the previous gains, those before a write, by axis;
    none where the audit log lacks them.
    """
    by_digest = {entry.sha256: entry for entry in entries}
    by_number = {entry.number: entry for entry in entries}
    ended = by_digest.get(write.audit or "")
    if ended is None:
        return {}
    # The end names the begin, which has the numbers; a write that its killed writer did not end is
    # the begin itself.
    begun = by_number.get(begun_by(ended), ended)
    changes = begun.details.get("changes")
    if not isinstance(changes, list):
        return {}
    before = {}
    for change in changes:
        if not isinstance(change, dict):
            continue
        axis = change.get("axis")
        old = change.get("old")
        if isinstance(axis, str) and isinstance(old, float | int) and math.isfinite(old):
            before[axis] = float(old)
    return before
