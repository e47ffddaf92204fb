"""What the audit tells of the writes to a controller, held against what the history knows of them."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from daq.config.cell import Cell
from daq.config.policy import HistoryPlace
from daq.ledger.audit import AuditAction, AuditEntry, verify
from daq.ledger.entry import Acknowledgement, Event, WriteAction, iso, utc
from daq.ledger.store import HistoryStore
from daq.writeback.drive_record import drives_of

_ENDS = {AuditAction.APPLIED: WriteAction.APPLIED, AuditAction.ROLLED_BACK: WriteAction.ROLLED_BACK}
_BEGINS = (AuditAction.APPLY_BEGUN, AuditAction.ROLLBACK_BEGUN)
_NEVER = datetime.min.replace(tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class AuditedWrite:
    """A write that went well, as the audit tells of it.

    Attributes:
        begun: the entry before it, None where the audit has none.
        ended: the entry after it.
    """

    begun: AuditEntry | None
    ended: AuditEntry

    @property
    def action(self) -> WriteAction:
        """What was done."""
        return _ENDS[self.ended.action]

    @property
    def calibration(self) -> str | None:
        """SHA-256 of the calibration that was written, None where the audit does not tell."""
        return None if self.begun is None else _calibration(self.begun)

    @property
    def cell(self) -> str | None:
        """Name of the cell whose calibration was written, None where the audit does not tell."""
        recorded = None if self.begun is None else self.begun.details.get("calibration")
        found = recorded.get("cell") if isinstance(recorded, dict) else None
        return found if isinstance(found, str) else None

    @property
    def sha256_after(self) -> str | None:
        """Of what the target held afterwards, None where the audit does not tell."""
        return None if self.begun is None else _text(self.begun, "sha256_after")

    @property
    def digests(self) -> frozenset[str]:
        """Of its entries; an event of the history names one of them."""
        return frozenset(one.sha256 for one in (self.begun, self.ended) if one is not None)

    @property
    def changed_nothing(self) -> bool:
        """Whether the target held the same before it: drives are written again to let them save."""
        return self.begun is not None and self.sha256_after == _text(self.begun, "sha256_before") is not None

    def __str__(self) -> str:
        one = self.ended
        written = f", calibration {self.calibration[:12]}…" if self.calibration else ""
        return f"entry {one.number} of the audit, {one.action.value} by {one.who} at {one.at} to {one.subject}{written}"


def writes_to(cell: Cell, entries: Sequence[AuditEntry]) -> list[AuditedWrite]:
    """To this cell's controller.

    Another cell may have the same audit, and even the same file: what was written with its calibrations, and the way
    back from there, is told to its own history.
    """
    file = cell.controller_path
    # Not `followed`: a link that it refuses today was followed on the day of the write.
    targets = {drives_of(cell.name), *(() if file is None else (os.path.realpath(file),))}
    begun = {one.number: one for one in entries if one.action in _BEGINS}
    found, owners = [], dict[str, str]()
    for one in entries:
        if one.action not in _ENDS or one.subject not in targets:
            continue
        write = AuditedWrite(begun.get(_number(one)), one)
        if write.action is WriteAction.APPLIED:
            owners[one.subject] = write.cell or cell.name
        if owners.get(one.subject, cell.name) == cell.name:
            found.append(write)
    return found


def unknown_writes(
    writes: Sequence[AuditedWrite], named: Collection[str]
) -> tuple[list[AuditedWrite], list[AuditedWrite]]:
    """Writes that no event names, and those of them behind which there is none of the same target that one names."""
    unknown, new = [], []
    following: dict[str, tuple[AuditedWrite, bool]] = {}
    some_known: set[str] = set()
    for write in reversed(writes):
        target = write.ended.subject
        after, after_known = following.get(target, (None, False))
        known = not write.digests.isdisjoint(named)
        # Drives that were written once more with the same: whoever knows of that knows what they hold since.
        again = after is not None and after.changed_nothing and after.sha256_after == write.sha256_after
        known = known or (after_known and again and after is not None and after.calibration == write.calibration)
        following[target] = write, known
        if known:
            some_known.add(target)
            continue
        unknown.append(write)
        if target not in some_known:
            new.append(write)
    return unknown[::-1], new[::-1]


def catch_up(cell: Cell, place: HistoryPlace, store: HistoryStore) -> tuple[AuditedWrite, ...]:
    """Enter writes of which the audit tells and the history does not know, in their order.

    Only those behind the last one of their target that it knows, and of those with calibrations that it has: an event
    is never entered behind a later one. Of an audit that is not what was written nothing is entered.

    Returns:
        what was entered.

    Raises:
        AuditUnusable, HistoryUnreadable, OutputFailed: see `daq.ledger.audit.verify` and the store.
    """
    verdict = verify(place.audit, store.audited())
    if not verdict.holds:
        return ()
    _, new = unknown_writes(writes_to(cell, verdict.entries), store.audited())
    known, stopped, entered = {entry.digest for entry in store.entries()}, set[str](), []
    for write in new:
        one, after = write.ended, write.sha256_after
        at, can = (
            at_of(one),
            after is not None and (write.action is WriteAction.ROLLED_BACK or write.calibration in known),
        )
        if one.subject in stopped or at is None or after is None or not can:
            stopped.add(one.subject)
            continue
        if write.action is WriteAction.ROLLED_BACK:
            store.rolled_back(at=at, who=one.who, target=one.subject, sha256_after=after, audit=one.sha256)
        else:
            digest = write.calibration or ""
            store.applied(digest, at=at, who=one.who, target=one.subject, audit=one.sha256, sha256_after=after)
        entered.append(write)
    return tuple(entered)


def enter_applied(cell: Cell, store: HistoryStore, event: Event) -> None:
    """Enter that a calibration was written, and before it what others wrote and could not tell (`catch_up`).

    Args:
        cell: whose controller it was.
        store: of its history, which has the calibration.
        event: the write; where the audit tells of it, it is entered as the audit has it.

    Raises:
        ValueError: the event names no calibration, or one that the history does not have.
        AuditUnusable, HistoryUnreadable, OutputFailed: see `catch_up`.
    """
    if event.digest is None:
        raise ValueError("an event without its calibration")
    caught_up = () if cell.history is None else catch_up(cell, cell.history, store)
    if not any(event.audit in write.digests for write in caught_up):
        store.applied(
            event.digest,
            at=event.at,
            who=event.who,
            target=event.target,
            audit=event.audit,
            sha256_after=event.sha256_after,
        )


def event_flaws(event: Event, entry: AuditEntry, entries: Sequence[AuditEntry]) -> Iterator[str]:
    """Where an event is not what the entry of the audit says that it names."""
    named = f"as entry {entry.number} of the audit, which it names"
    begun = next((one for one in entries if one.number == _number(entry)), entry) if entry.action in _ENDS else entry
    after = _text(begun, "sha256_after")
    if entry.action in _ENDS and _ENDS[entry.action] is not event.action:
        yield f"found {event.action.value}, expected {entry.action.value} {named}"
    if event.target != entry.subject:
        yield f"found target {event.target}, expected {entry.subject} {named}"
    if after is not None and event.sha256_after is not None and event.sha256_after != after:
        yield f"found sha256_after {event.sha256_after[:12]}…, expected {after[:12]}… {named}"
    if entry.action is AuditAction.APPLIED and event.digest != (_calibration(begun) or event.digest):
        yield f"found calibration {event.digest}, expected {_calibration(begun)} {named}"
    if (event.who, event.at) != (entry.who, at_of(entry)) and not _finished(event, entry, entries):
        if event.who != entry.who:
            yield f"found who {event.who!r}, expected {entry.who!r} {named}"
        if event.at != at_of(entry):
            yield f"found time {iso(event.at)}, expected {entry.at} {named}"


def _finished(event: Event, entry: AuditEntry, entries: Sequence[AuditEntry]) -> bool:
    """Whether somebody else may have entered the write later: its writer was killed, or it is a job's.

    Such an event names the entry of the begin, and another entry of the audit tells of whoever entered it: `nothing to
    do` of the same time, or the job around it.
    """
    if entry.action in _ENDS or event.action is not WriteAction.APPLIED:
        return False
    begun_at: datetime | None = None
    for one in entries:
        if one.who != event.who or (at := at_of(one)) is None:
            continue
        if one.action is AuditAction.NOTHING_TO_DO and (one.subject, at) == (event.target, event.at):
            return True
        if one.action is AuditAction.RECALIBRATION_BEGUN:
            begun_at = begun_at or at  # a job that was killed has no end
        elif one.action is AuditAction.RECALIBRATION_ENDED and begun_at is not None:
            if begun_at <= event.at <= at:
                return True
            begun_at = None
    return begun_at is not None and begun_at <= event.at


def acknowledgement_flaws(noted: Acknowledgement, entry: AuditEntry) -> Iterator[str]:
    named = f"as entry {entry.number} of the audit, which it names"
    if entry.action is not AuditAction.ACKNOWLEDGED:
        yield f"found an entry of the audit ({entry.number}) that tells of {entry.action.value}, expected acknowledged"
        return
    since = utc(_text(entry, "since") or "", _NEVER)
    pairs: tuple[tuple[str, object, object], ...] = (
        ("who", noted.who, entry.who),
        ("axis", noted.axis, _text(entry, "axis")),
        ("why", noted.why, _text(entry, "why")),
        ("since", iso(noted.since), iso(since)),
        ("time", iso(noted.at), iso(utc(entry.at, _NEVER))),
    )
    for name, found, expected in pairs:
        if found != expected:
            yield f"found {name} {found!r}, expected {expected!r} {named}"


def at_of(entry: AuditEntry) -> datetime | None:
    """When an entry was written, UTC; None where what stands there is no time."""
    found = utc(entry.at, _NEVER)
    return None if found == _NEVER else found


def _text(entry: AuditEntry, key: str) -> str | None:
    """Anybody can write a chain that holds: what is no text says nothing."""
    found = entry.details.get(key)
    return found if isinstance(found, str) else None


def _number(entry: AuditEntry) -> int:
    found = entry.details.get("begun")
    return found if isinstance(found, int) else 0


def _calibration(begun: AuditEntry) -> str | None:
    recorded = begun.details.get("calibration")
    found = recorded.get("sha256") if isinstance(recorded, dict) else None
    return found if isinstance(found, str) else None
