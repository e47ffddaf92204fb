"""The history of a cell, folded from its audit log:
calibrations, writes to controllers, acknowledged changes.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from enum import Enum
from typing import Any

from pydantic import TypeAdapter

from daq.config.cell import Cell
from daq.config.same_cell import (
    RobotDifference,
    calibrated_robot,
    expected_text,
    found_text,
    robot_differences,
)
from daq.documents.calibration_file import decode_calibration
from daq.errors import DaqError
from daq.files import sha256
from daq.ledger.audit import (
    AuditAction,
    AuditEntry,
    OpenWrite,
    begun_by,
    made_writes,
    witnessed_writes,
)
from daq.ledger.dates import corrected, times_by_order
from daq.ledger.names import (
    RenamedCell,
    drives_of,
    names_in,
    rename_of,
    renamed_to,
    with_present_names,
)
from ident.calibration import CalibratedRobot, Calibration, Gain, Source


class WriteAction(Enum):
    """Kinds of writes to a controller."""

    APPLIED = "applied"
    ROLLED_BACK = "rolled back"


@dataclass(frozen=True, slots=True)
class Event:
    """A write to a controller."""

    #: Of the calibration whose gains the controller had afterwards; None for a rollback to gains of
    #: no calibration.
    digest: str | None
    action: WriteAction  #: its kind
    at: datetime  #: when, UTC
    who: str  #: the person or the job
    target: str  #: the controller's file, or the drives
    audit: str | None = None  #: SHA-256 of its entry in the audit log, None where none was given
    #: of the target's content afterwards, None where none was given
    sha256_after: str | None = None


@dataclass(frozen=True, slots=True)
class Entry:
    """One calibration."""

    digest: str  #: SHA-256 of its file
    #: when it was fitted, UTC; when it was entered where its own time cannot be read
    created: datetime
    #: when the newest log of its fit was recorded, UTC; as `created` where no log has a time
    recorded: datetime
    #: digest of the logs of its fit, as a set; calibrations with the same one rest on the same
    #: recordings
    logs: str
    entered: datetime  #: when it was entered, UTC
    cell: str  #: name of the cell
    configuration_sha256: str  #: of the cell configuration that its logs carry
    method: str  #: of the fit
    software: str  #: that made it
    error_percent: float  #: relative error of the fit [%]
    holdout_percent: float | None  #: relative error on held-out data [%], None without any
    rows: int  #: of the observation
    gains: tuple[Gain, ...]  #: one an axis, in the order of the axes
    events: tuple[Event, ...]  #: writes after which a controller had its gains, oldest first
    #: result of the last new moves with its gains; None without any
    acceptance: RecordedAcceptance | None = None
    #: `created` by the clock of that day, where the order of the audit log shows that it was wrong;
    #: else None. Then `created` and `recorded` are what that order allows.
    created_by_clock: datetime | None = None
    #: that it is of; None where it was entered by an earlier version
    robot: CalibratedRobot | None = None

    def gain_of(self, axis: str) -> Gain | None:
        """Return the gain of an axis, None for an axis that it does not have."""
        return next((gain for gain in self.gains if gain.axis == axis), None)

    @property
    def applied(self) -> bool:
        """Whether a controller ever had its gains."""
        return bool(self.events)


@dataclass(frozen=True, slots=True)
class ForeignEntry:
    """A calibration under a cell's name that is of another robot, and is compared with nothing."""

    entry: Entry  #: itself
    differences: tuple[RobotDifference, ...]  #: found of its robot, expected of the cell's

    def __str__(self) -> str:
        return (
            f"calibration {self.entry.digest[:12]}… of {self.entry.recorded:%Y-%m-%d} is of "
            f"another robot with the cell name {self.entry.cell!r}: found "
            f"{found_text(self.differences)}; expected {expected_text(self.differences)}, as in "
            "the cell file"
        )


@dataclass(frozen=True, slots=True)
class IncomparableEntry:
    """A calibration of this cell with other axes or units than the newest one.

    Earlier versions entered such ones into one history.
    """

    entry: Entry  #: itself
    expected: Mapping[str, str]  #: unit of each axis in the newest calibration

    def __str__(self) -> str:
        found = _units(self.entry)
        if found.keys() != self.expected.keys():
            found_text = f"gains of {', '.join(found)}"
            expected_text = f"of {', '.join(self.expected)}"
        else:
            differing = [axis for axis, unit in found.items() if unit != self.expected[axis]]
            found_text = _units_text(differing, found)
            expected_text = _units_text(differing, self.expected)
        return (
            f"calibration {self.entry.digest[:12]}… of {self.entry.recorded:%Y-%m-%d} is not "
            f"compared: found {found_text}; expected {expected_text}, as in the newest one"
        )


def _units_text(axes: Sequence[str], units: Mapping[str, str]) -> str:
    return ", ".join(f"{axis} in {units[axis]}" for axis in axes)


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """A change that a person has explained; a new baseline begins."""

    axis: str  #: whose gain changed
    since: datetime  #: calibrations from this time on make the new baseline, UTC
    at: datetime  #: when it was acknowledged, UTC
    who: str  #: the person
    why: str  #: what had happened
    audit: str  #: SHA-256 of its entry in the audit log


@dataclass(frozen=True, slots=True)
class RecordedAcceptance:
    """Result of new moves that a cell made with written gains."""

    digest: str  #: SHA-256 of the calibration's file
    accepted: bool  #: whether the torques of these moves agree with the gains
    at: datetime  #: when, UTC
    who: str  #: the person or the session
    log_sha256: str | None  #: of the log of these moves; None where the audit log does not say
    remark: str  #: what was found, in words; may be empty
    undo: str  #: command that undoes the write; empty where they were accepted


def recorded_at(calibration: Calibration, otherwise: datetime) -> datetime:
    """Return when the newest log of a fit was recorded, UTC;
    `otherwise` where no log has a time.
    """
    times_s = [
        one.recording.recorded_s for one in _fitted(calibration) if one.recording is not None
    ]
    try:
        return datetime.fromtimestamp(
            max(seconds for seconds in times_s if seconds is not None), UTC
        )
    except (ValueError, OverflowError, OSError):
        return otherwise.astimezone(UTC)


def logs_of(calibration: Calibration, digest: str) -> str:
    """Return the digest of the set of logs of a fit;
    that of the calibration itself without logs.
    """
    logs = sorted({one.sha256 for one in _fitted(calibration)})
    return sha256("\n".join(logs).encode()) if logs else digest


def _fitted(calibration: Calibration) -> list[Source]:
    return [one for one in calibration.sources if one.role == "fit"]


def utc(text: str, otherwise: datetime) -> datetime:
    """Parse an ISO 8601 time as UTC, one without a zone as UTC;
    `otherwise` where the text is no time.
    """
    try:
        read = datetime.fromisoformat(text)
        return (read.replace(tzinfo=UTC) if read.tzinfo is None else read).astimezone(UTC)
    except (ValueError, OverflowError):
        return otherwise.astimezone(UTC)


def iso(at: datetime) -> str:
    """Format a time: UTC, of one length, so that times sort as text.

    Raises:
        ValueError: a time without its zone.
    """
    if at.tzinfo is None:
        raise ValueError(f"expected a time with its zone, found {at}")
    return at.astimezone(UTC).isoformat(timespec="microseconds")


def zoned(text: str) -> datetime:
    """Parse a time with its zone.

    Raises:
        ValueError: no time, or without a zone.
    """
    found = datetime.fromisoformat(text)
    if found.tzinfo is None:
        raise ValueError(f"{text!r} is a time without its zone")
    return found


def figures_of(calibration: Calibration, digest: str, entered: datetime) -> dict[str, object]:
    """Return what a history shows of a calibration, as plain JSON:
    parsing its document takes a hundred times as long.

    Args:
        calibration: of the document.
        digest: SHA-256 of its file.
        entered: when it was entered.
    """
    created = utc(calibration.created, entered)
    holdout = calibration.holdout_error_percent
    return {
        "created": iso(created),
        "recorded": iso(recorded_at(calibration, created)),
        "logs": logs_of(calibration, digest),
        "configuration_sha256": calibration.configuration_sha256,
        "method": calibration.method,
        "software": calibration.software,
        "error_percent": calibration.relative_error_percent.total,
        "holdout_percent": None if holdout is None else holdout.total,
        "rows": calibration.rows,
        "gains": [asdict(gain) for gain in calibration.gains],
    }


def entry_of(
    digest: str, cell: str, entered: datetime, figures: Mapping[str, Any], events: Sequence[Event]
) -> Entry:
    """Return a calibration by its `figures_of`; `events` are the writes of its gains, oldest first.

    Raises:
        KeyError, TypeError, ValueError: the figures are others than those of `figures_of`.
    """
    others = dict(figures)
    gains = tuple(Gain(**gain) for gain in others.pop("gains"))
    created = zoned(others.pop("created"))
    recorded = zoned(others.pop("recorded"))
    return Entry(
        digest=digest,
        cell=cell,
        entered=entered,
        created=created,
        recorded=recorded,
        gains=gains,
        events=tuple(events),
        **others,
    )


_ENDS = {AuditAction.APPLIED: WriteAction.APPLIED, AuditAction.ROLLED_BACK: WriteAction.ROLLED_BACK}
_BEGINS = {
    AuditAction.APPLY_BEGUN: WriteAction.APPLIED,
    AuditAction.ROLLBACK_BEGUN: WriteAction.ROLLED_BACK,
}
NEVER = datetime.min.replace(tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class History:
    """All that an audit log says of the gains of a cell."""

    entries: tuple[Entry, ...]  #: calibrations in the order in which they were fitted
    events: tuple[Event, ...]  #: writes to controllers, oldest first
    acknowledgements: tuple[Acknowledgement, ...]  #: explained changes, oldest first
    #: runs of new moves after a write, oldest first
    acceptances: tuple[RecordedAcceptance, ...] = ()
    #: calibrations of the audit log that cannot be read, as sentences
    unreadable: tuple[str, ...] = ()
    #: whether the audit log is not what was written, so that something may be missing here
    may_lack: bool = False
    #: Calibrations of another robot with the cell's name, oldest first. No change of a gain is
    #: computed with them.
    other_robots: tuple[ForeignEntry, ...] = ()
    #: Calibrations with other axes or units than the newest one, oldest first. No change of a gain
    #: is computed with them.
    not_compared: tuple[IncomparableEntry, ...] = ()
    renamed: RenamedCell | None = None  #: the rename by which this same robot has another name now
    #: Names in the same audit log whose calibrations are all of a robot like this one, where the
    #: cell has none.
    possible_names: tuple[str, ...] = ()

    @property
    def digests(self) -> frozenset[str]:
        """SHA-256 of every calibration, also of those that no change of a gain is computed with."""
        digests = {entry.digest for entry in self.entries}
        for other in self.other_robots:
            digests.add(other.entry.digest)
        for incomparable in self.not_compared:
            digests.add(incomparable.entry.digest)
        return frozenset(digests)

    def in_force(self, target: str | None = None) -> str | None:
        """Return the digest of the calibration in a target, or in the last written one;
        None for other numbers.
        """
        events = [event for event in self.events if target in {None, event.target}]
        return events[-1].digest if events else None


@dataclass(frozen=True, slots=True)
class AuditedWrite:
    """A successful write, as the audit log reports it."""

    #: The entry before the write, with its details; None where the audit log has none. Of a write
    #: that was found later, the entry of the finding.
    begun: AuditEntry | None
    #: the entry after it; the one before it, where the writer was killed in between
    ended: AuditEntry

    @property
    def action(self) -> WriteAction:
        """Applied or rolled back."""
        return {**_ENDS, **_BEGINS}.get(self.ended.action) or WriteAction(
            text_field(self.ended, "action")
        )

    @property
    def calibration(self) -> str | None:
        """SHA-256 of the calibration, None where the audit log has none."""
        if self.begun is None:
            return None
        return calibration_field(self.begun, "sha256")

    @property
    def sha256_after(self) -> str | None:
        """SHA-256 of the target's content after the write, None where the audit log has none."""
        if self.begun is None:
            return None
        return text_field(self.begun, "sha256_after")

    def __str__(self) -> str:
        one = self.ended
        if self.calibration:
            written = f", calibration {self.calibration[:12]}…"
        else:
            written = ""
        return (
            f"entry {one.number} of the audit, {one.action.value} by {one.who} at {one.at} to "
            f"{one.subject}{written}"
        )


@dataclass(frozen=True, slots=True)
class EnteredCalibration:
    """A calibration of the audit log."""

    number: int  #: of the entry
    digest: str  #: SHA-256 of its file
    #: time of the entry itself; later than the next where a history of an earlier version was taken
    #: in
    at: datetime
    entered: datetime  #: when it was entered, UTC
    document: str | None  #: the whole calibration; None where an earlier entry has it
    figures: dict[str, Any] | None  #: as of `figures_of`; None in an entry of an earlier version
    #: as of `ident.calibration.CalibratedRobot`; None in an entry of an earlier version
    robot: object = None


def fold(entries: Sequence[AuditEntry], cell: Cell) -> History:
    """Fold the entries of an audit log, oldest first, into the history of a cell;
    other cells may share the log.

    A write without an end counts where a later entry shows that it was made: the next write found
    its content, or a process did (`write found`). What the controller's file is by now is not
    asked: a history does not change by itself.
    """
    events = _events(writes_to(cell, entries, witnessed_writes(entries), everywhere=True))
    by_digest: dict[str | None, list[Event]] = {}
    for event in events:
        by_digest.setdefault(event.digest, []).append(event)
    acceptances = tuple(acceptances_of(entries, cell.name))
    accepted = {one.digest: one for one in acceptances}  # the last one of each calibration
    found: list[Entry] = []
    unreadable: list[str] = []
    calibrations = entered_calibrations(entries, cell.name)
    by_order = times_by_order([one.at for one in calibrations])
    # Two calibrations alone do not show which clock was wrong: the other entries must agree.
    corrected = _corrected_times(_stamped_times(entries))
    # Of logs, by calibrations that were entered while the clock was right
    recorded: dict[str, datetime] = {}
    for one, by_calibrations in zip(calibrations, by_order, strict=True):
        time = by_calibrations if one.number in corrected else None
        try:
            figures = one.figures or figures_of_document(one)
            entry = entry_of(
                one.digest, cell.name, one.entered, figures, by_digest.get(one.digest, ())
            )
            entry = replace(entry, robot=_robot_of(one.robot))
            if time is None:
                recorded.setdefault(entry.logs, entry.recorded)
            entry = _dated(entry, one.at, time, recorded)
            found.append(replace(entry, acceptance=accepted.get(one.digest)))
        except DaqError as error:
            unreadable.append(
                f"{_named(one)}: its document is {error.found}, expected {error.expected}"
            )
        except (KeyError, TypeError, ValueError) as error:
            unreadable.append(
                f"{_named(one)}: its figures are not those that drivegain writes: {error}"
            )
    robot = calibrated_robot(cell)
    own = []
    foreign = []
    for entry in found:
        differences = robot_differences(entry.robot, robot)
        if differences:
            foreign.append(ForeignEntry(entry, differences))
        else:
            own.append(entry)
    last = _units(own[-1]) if own else {}
    comparable = []
    incomparable = []
    for entry in own:
        if _units(entry) == last:
            comparable.append(entry)
        else:
            incomparable.append(IncomparableEntry(entry, last))
    return History(
        entries=tuple(sorted(comparable, key=lambda one: (one.created, one.entered, one.digest))),
        events=tuple(events),
        acknowledgements=tuple(acknowledgements_of(entries, cell.name)),
        acceptances=acceptances,
        unreadable=tuple(unreadable),
        other_robots=tuple(foreign),
        not_compared=tuple(incomparable),
        renamed=_rename_of_robot(entries, cell.name, robot),
        possible_names=() if calibrations else _names_of_robot(entries, robot),
    )


_ROBOT: TypeAdapter[CalibratedRobot | None] = TypeAdapter(CalibratedRobot | None)


def _robot_of(tree: object) -> CalibratedRobot | None:
    """Return the robot of an entry; None where it has none.

    Raises:
        ValueError: it is not as drivegain writes it.
    """
    return _ROBOT.validate_python(tree)


def _rename_of_robot(
    entries: Iterable[AuditEntry], name: str, robot: CalibratedRobot
) -> RenamedCell | None:
    """Return the rename of a robot that is described under its old name;
    None for another robot of that name.
    """
    rename = renamed_to(entries, name)
    if rename is None:
        return None
    try:
        renamed = _robot_of(rename.robot)
    except ValueError:
        return rename
    return None if robot_differences(renamed, robot) else rename


def _names_of_robot(entries: Sequence[AuditEntry], robot: CalibratedRobot) -> tuple[str, ...]:
    """Return the names in an audit log under which every calibration is of a robot that looks the
    same.
    """
    names = []
    for name in names_in(with_present_names(entries)):
        robots = []
        for one in entered_calibrations(entries, name):
            try:
                robots.append(_robot_of(one.robot))
            except ValueError:
                continue
        if robots and all(
            other is not None and not robot_differences(other, robot) for other in robots
        ):
            names.append(name)
    return tuple(names)


def _dated(
    entry: Entry, at: datetime, by_order: datetime | None, known: Mapping[str, datetime]
) -> Entry:
    """Return a calibration with the dates that the order of the audit log allows.

    Args:
        entry: as it was entered.
        at: time of its entry in the log, by the clock.
        by_order: the same by the order of the log; None where the clock agrees with it.
        known: when logs were recorded that an earlier calibration rests on, too.
    """
    if by_order is None:
        return entry
    created = corrected(entry.created, at, by_order)
    recorded = known.get(entry.logs) or corrected(entry.recorded, at, by_order)
    return replace(entry, created=created, recorded=recorded, created_by_clock=entry.created)


def figures_of_document(one: EnteredCalibration) -> dict[str, object]:
    """Return the figures of a calibration that an earlier version entered;
    parsing its document takes 7 ms.

    Raises:
        DaqError: the document cannot be read.
    """
    calibration = decode_calibration((one.document or "").encode(), f"entry {one.number}")
    return figures_of(calibration, one.digest, one.entered)


def _named(one: EnteredCalibration) -> str:
    return f"calibration {one.digest[:12]}… of entry {one.number}"


def _units(entry: Entry) -> dict[str, str]:
    """Return the axes with their units."""
    return {gain.axis: gain.unit for gain in entry.gains}


def _events(writes: Iterable[AuditedWrite]) -> list[Event]:
    events: list[Event] = []
    for write in writes:
        one = write.ended
        at = at_of(one)
        if at is None:
            continue
        digest = write.calibration
        if write.action is WriteAction.ROLLED_BACK:
            # Not the calibration before the last one: the content shows which gains are back, if
            # any calibration's.
            like = (one.subject, write.sha256_after)
            digest = next(
                (e.digest for e in reversed(events) if (e.target, e.sha256_after) == like), digest
            )
        events.append(
            Event(digest, write.action, at, one.who, one.subject, one.sha256, write.sha256_after)
        )
    return events


def entered_calibrations(entries: Iterable[AuditEntry], cell: str) -> list[EnteredCalibration]:
    """Return the calibrations of a cell that an audit log has, once each,
    in the order in which they were entered.
    """
    found: dict[str, EnteredCalibration] = {}
    for entry in with_present_names(tuple(entries)):
        one = _entered_calibration(entry, cell)
        if one is None:
            continue
        first = found.setdefault(one.digest, one)
        # A later entry gives the figures of one that an earlier version has entered.
        document = first.document or one.document
        found[one.digest] = replace(
            first,
            document=document,
            figures=first.figures or one.figures,
            robot=first.robot or one.robot,
        )
    return list(found.values())


def _entered_calibration(entry: AuditEntry, cell: str) -> EnteredCalibration | None:
    if entry.action is not AuditAction.CALIBRATION_ENTERED or text_field(entry, "cell") != cell:
        return None
    digest = text_field(entry, "sha256")
    entered = utc(text_field(entry, "entered") or "", NEVER)
    document = text_field(entry, "document")
    figures = entry.details.get("figures")
    known = figures if isinstance(figures, dict) else None
    if digest is None or entered == NEVER or (document is None and known is None):
        return None
    at = at_of(entry) or entered
    return EnteredCalibration(
        entry.number, digest, at, entered, document, known, entry.details.get("robot")
    )


def acknowledgements_of(entries: Iterable[AuditEntry], cell: str) -> Iterator[Acknowledgement]:
    """Yield the changes that were explained in a cell, oldest first."""
    for entry in with_present_names(tuple(entries)):
        found = _acknowledgement_of(entry)
        if found is not None and text_field(entry, "cell") == cell:
            yield found


def _acknowledgement_of(entry: AuditEntry) -> Acknowledgement | None:
    """Return the acknowledgement of an entry, None where it lacks a part or would silence an axis
    beforehand.
    """
    axis = text_field(entry, "axis")
    why = text_field(entry, "why")
    at = at_of(entry)
    since = utc(text_field(entry, "since") or "", NEVER)
    if entry.action is not AuditAction.ACKNOWLEDGED or axis is None or why is None or at is None:
        return None
    if not NEVER < since <= at:
        return None
    return Acknowledgement(axis, since, at, entry.who, why, entry.sha256)


def acceptances_of(entries: Iterable[AuditEntry], cell: str) -> Iterator[RecordedAcceptance]:
    """Yield the results of new moves with written gains in a cell, oldest first."""
    for entry in with_present_names(tuple(entries)):
        found = _acceptance_of(entry)
        if found is not None and text_field(entry, "cell") == cell:
            yield found


def _acceptance_of(entry: AuditEntry) -> RecordedAcceptance | None:
    """Return the acceptance of an entry; None where it is another entry, or lacks a part."""
    if entry.action not in {AuditAction.ACCEPTED, AuditAction.NOT_ACCEPTED}:
        return None
    at = at_of(entry)
    digest = text_field(entry, "calibration_sha256")
    if at is None or digest is None:
        return None
    return RecordedAcceptance(
        digest=digest,
        accepted=entry.action is AuditAction.ACCEPTED,
        at=at,
        who=entry.who,
        log_sha256=text_field(entry, "log_sha256"),
        remark=text_field(entry, "remark") or "",
        undo=text_field(entry, "undo") or "",
    )


def is_end(entry: AuditEntry) -> bool:
    """Whether an entry says that a controller has other gains now."""
    return entry.action in _ENDS or (
        entry.action is AuditAction.WRITE_FOUND
        and text_field(entry, "action") in {one.value for one in WriteAction}
    )


def writes_to(
    cell: Cell,
    entries: Sequence[AuditEntry],
    made: Iterable[OpenWrite],
    *,
    everywhere: bool = False,
) -> list[AuditedWrite]:
    """Return the writes of this cell's calibrations, and the rollbacks of them, in their order.

    Another cell may have the same audit log, and even the same controller file: what was written
    with its calibrations, and rolled back from there, is in its own history.

    Args:
        cell: whose writes are wanted.
        entries: of the audit log, oldest first.
        made: writes without an end that were made all the same; `write found` reports some of them.
        everywhere: include files that are not the cell's controller (`apply --to`).
    """
    entries = with_present_names(entries)
    targets = _targets(cell)
    begun = {one.number: one for one in entries if one.action in _BEGINS}
    unended = {one.begun.number for one in made} - {begun_by(one) for one in entries if is_end(one)}
    found: list[AuditedWrite] = []
    known: set[object] = set()
    owners = dict.fromkeys(targets, cell.name)
    times = _times_by_number(entries)
    for one in entries:
        if not (is_end(one) or one.number in unended) or not (everywhere or one.subject in targets):
            continue
        same = _identity(one)
        # Two processes found it at once, or one found it before its writer ended it
        if same in known:
            continue
        known.add(same)
        itself = one.number in unended or one.action is AuditAction.WRITE_FOUND
        write = AuditedWrite(one if itself else begun.get(begun_by(one)), one)
        if write.action is WriteAction.APPLIED:
            if write.begun is None:
                owner = None
            else:
                owner = calibration_field(write.begun, "cell")
            owners[one.subject] = owner or (cell.name if one.subject in targets else "")
        if owners.get(one.subject) == cell.name:
            found.insert(_place(found, one, times), write)
    return found


def _targets(cell: Cell) -> set[str]:
    """Return the cell's own targets as an audit log names them."""
    targets = {drives_of(cell.name)}
    if cell.controller_path is not None:
        # Not `resolve_links`: a link that it refuses today was followed on the day of the write.
        targets.add(os.path.realpath(cell.controller_path))
    return targets


def _identity(one: AuditEntry) -> object:
    """Return what two entries about one write have in common."""
    number = begun_by(one)
    if number:
        return number
    if one.action is AuditAction.WRITE_FOUND:
        return one.subject, one.at, one.who, text_field(one, "sha256_after")
    return one.number


def _times_by_number(entries: Sequence[AuditEntry]) -> dict[int, datetime]:
    """Return when entries were written, by their numbers, corrected where the clock was wrong."""
    stamped = _stamped_times(entries)
    return stamped | _corrected_times(stamped)


def _corrected_times(stamped: Mapping[int, datetime]) -> dict[int, datetime]:
    """Return when the entries with a wrong clock were written, by their numbers.

    Args:
        stamped: of `_stamped_times`.
    """
    by_order = times_by_order(list(stamped.values()))
    by_number = zip(stamped, by_order, strict=True)
    return {number: time for number, time in by_number if time is not None}


def _stamped_times(entries: Sequence[AuditEntry]) -> dict[int, datetime]:
    """Return the times of entries by their clock, by their numbers.

    A write that was found has the time of the write, which is out of the order of the log by
    intent.
    """
    stamped = {}
    for one in entries:
        at = at_of(one)
        if at is not None and one.action is not AuditAction.WRITE_FOUND:
            stamped[one.number] = at
    return stamped


def _place(found: Sequence[AuditedWrite], one: AuditEntry, times: Mapping[int, datetime]) -> int:
    """Return where a write belongs among the ones before;
    the entry of a found one may be younger than the write.
    """
    at = at_of(one)
    if one.action is AuditAction.WRITE_FOUND and at is not None:
        for place, other in enumerate(found):
            other_at = times.get(other.ended.number) or at_of(other.ended)
            if other_at is not None and other_at > at:
                return place
    return len(found)


def unknown_writes(
    cell: Cell,
    entries: Sequence[AuditEntry],
    opened: Sequence[OpenWrite],
    calibrations: Collection[str],
) -> tuple[AuditedWrite, ...]:
    """Return the writes to this cell's controller that its history lacks.

    Args:
        cell: whose writes are wanted.
        entries: of the audit log, oldest first.
        opened: writes that were begun and never ended.
        calibrations: SHA-256 of those in the history.

    Returns:
        writes whose content the controller has now, though no later entry shows it; writes of
        calibrations that were never entered.
    """
    shown = shown_writes(cell, entries, opened)
    return tuple(
        write
        for write in writes_to(cell, entries, made_writes(opened))
        if write in shown
        or (write.action is WriteAction.APPLIED and write.calibration not in calibrations)
    )


def shown_writes(
    cell: Cell, entries: Sequence[AuditEntry], opened: Sequence[OpenWrite]
) -> list[AuditedWrite]:
    """Return the writes without an end that only the content of their target shows,
    not a later entry.
    """
    witnessed = {one.begun.number for one in witnessed_writes(entries)}
    made = made_writes(opened)
    shown = {one.begun.number for one in made} - witnessed
    return [
        one for one in writes_to(cell, entries, made, everywhere=True) if one.ended.number in shown
    ]


def name_after_renames(entries: Sequence[AuditEntry], name: str, since: datetime) -> str:
    """Return the name that a cell has after the renames that were entered since a time.

    Args:
        entries: of the audit log, oldest first.
        name: of the cell at that time.
        since: the time, with zone.
    """
    times = _times_by_number(entries)
    found = name
    for one in entries:
        rename = rename_of(one)
        if rename is None or rename.old != found:
            continue
        renamed_at = times.get(one.number)
        if renamed_at is not None and renamed_at >= since:
            found = rename.new
    return found


def at_of(entry: AuditEntry) -> datetime | None:
    """Return when an entry was written, UTC; None where its time is none."""
    found = utc(entry.at, NEVER)
    return None if found == NEVER else found


def text_field(entry: AuditEntry, key: str) -> str | None:
    """Return a text of an entry's details, None where there is none."""
    found = entry.details.get(key)
    return found if isinstance(found, str) else None


def calibration_field(begun: AuditEntry, key: str) -> str | None:
    """Return what an entry says of its calibration, None without it."""
    recorded = begun.details.get("calibration")
    found = recorded.get(key) if isinstance(recorded, dict) else None
    return found if isinstance(found, str) else None
