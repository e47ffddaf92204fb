"""Comparison of the audit log with the history: the writes, calibrations and acknowledgements of one in the other."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime

from daq.config.cell import Cell
from daq.config.policy import HistoryPlace
from daq.documents.calibration_file import decode_calibration
from daq.errors import DataError
from daq.ledger.audit import AuditAction, AuditEntry, AuditVerdict, Content, verify
from daq.ledger.entry import Acknowledgement, Event, WriteAction, differences, drives_of, iso, utc
from daq.ledger.store import HistoryStore

_ENDS = {AuditAction.APPLIED: WriteAction.APPLIED, AuditAction.ROLLED_BACK: WriteAction.ROLLED_BACK}
_BEGINS = {AuditAction.APPLY_BEGUN: WriteAction.APPLIED, AuditAction.ROLLBACK_BEGUN: WriteAction.ROLLED_BACK}
_NEVER = datetime.min.replace(tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class AuditedWrite:
    """A successful write, as the audit log reports it."""

    #: The entry before the write, with its details; None where the audit log has none. Of a write that was found later,
    #: the entry of the finding.
    begun: AuditEntry | None
    ended: AuditEntry  #: the entry after it; the one before it, where the writer was killed in between

    @property
    def action(self) -> WriteAction:
        """Applied or rolled back."""
        return {**_ENDS, **_BEGINS}.get(self.ended.action) or WriteAction(_text(self.ended, "action"))

    @property
    def calibration(self) -> str | None:
        """SHA-256 of the calibration, None where the audit log has none."""
        return None if self.begun is None else _calibration(self.begun, "sha256")

    @property
    def sha256_after(self) -> str | None:
        """SHA-256 of the target's content after the write, None where the audit log has none."""
        return None if self.begun is None else _text(self.begun, "sha256_after")

    @property
    def digests(self) -> frozenset[str]:
        """SHA-256 of its entries; an event of the history names one of them."""
        return frozenset(one.sha256 for one in (self.begun, self.ended) if one is not None)

    def __str__(self) -> str:
        one = self.ended
        written = f", calibration {self.calibration[:12]}…" if self.calibration else ""
        return f"entry {one.number} of the audit, {one.action.value} by {one.who} at {one.at} to {one.subject}{written}"


def is_end(entry: AuditEntry) -> bool:
    """Whether an entry says that a controller has other gains now."""
    return entry.action in _ENDS or (
        entry.action is AuditAction.WRITE_FOUND and _text(entry, "action") in {one.value for one in WriteAction}
    )


def writes_to(cell: Cell, verdict: AuditVerdict, *, everywhere: bool = False) -> list[AuditedWrite]:
    """Return the writes of this cell's calibrations, and the rollbacks of them, in their order.

    A write that was begun and never ended is one where the controller has its content, unless it was found later.

    Another cell may have the same audit log, and even the same controller file: what was written with its calibrations,
    and rolled back from there, is in its own history.

    `everywhere` includes files that are not the cell's controller (`apply --to`).
    """
    file = cell.controller_path
    # Not `resolve_links`: a link that it refuses today was followed on the day of the write.
    targets = {drives_of(cell.name), *(() if file is None else (os.path.realpath(file),))}
    entries = verdict.entries
    begun = {one.number: one for one in entries if one.action in _BEGINS}
    left = {write.begun.number for write in verdict.open_writes if write.content is Content.AFTER}
    left -= {_number(one) for one in entries if one.action is AuditAction.WRITE_FOUND}
    found: list[AuditedWrite] = []
    owners = dict.fromkeys(targets, cell.name)
    for one in entries:
        unended = one.number in left
        if not (is_end(one) or unended) or not (everywhere or one.subject in targets):
            continue
        known = unended or one.action is AuditAction.WRITE_FOUND
        write = AuditedWrite(one if known else begun.get(_number(one)), one)
        if write.action is WriteAction.APPLIED:
            owner = None if write.begun is None else _calibration(write.begun, "cell")
            owners[one.subject] = owner or (cell.name if one.subject in targets else "")
        if owners.get(one.subject) == cell.name:
            later = len(found)
            at = at_of(one)
            if one.action is AuditAction.WRITE_FOUND and at is not None:  # its entry may be younger than the write
                times = [at_of(other.ended) for other in found]
                later = next((i for i, other in enumerate(times) if other is not None and other > at), later)
            found.insert(later, write)
    return found


def unknown_writes(
    writes: Sequence[AuditedWrite], named: Collection[str]
) -> tuple[list[AuditedWrite], list[AuditedWrite]]:
    """Return the writes that no event names, and those of them without a later named one of the same target."""
    unknown, new = [], []
    following: dict[str, tuple[AuditedWrite, bool]] = {}
    some_known: set[str] = set()
    for write in reversed(writes):
        target = write.ended.subject
        after, after_known = following.get(target, (None, False))
        known = not write.digests.isdisjoint(named)
        if after_known and after is not None and after.begun is not None:
            # Drives that were written once more with the same, to let them save: that event has their content too.
            contents = {after.sha256_after, _text(after.begun, "sha256_before"), write.sha256_after}
            again = len(contents) == 1 and None not in contents
            known = known or (again and after.calibration == write.calibration)
        following[target] = write, known
        if known:
            some_known.add(target)
            continue
        unknown.append(write)
        if target not in some_known:
            new.append(write)
    return unknown[::-1], new[::-1]


def catch_up(
    cell: Cell, place: HistoryPlace, store: HistoryStore, own: Collection[str] = ()
) -> tuple[AuditedWrite, ...]:
    """Enter in the history what the audit log reports and the history lacks, in the order of the audit log.

    Calibrations and acknowledgements, and of each target the writes behind the last one that the history has: an event
    is never entered behind a later one. A write whose calibration is not known stops its target. Nothing is entered
    from an audit log that was changed.

    `own` are the SHA-256 of acknowledgements without the name of a cell that are this cell's.

    Returns:
        the writes that were entered.

    Raises:
        AuditUnusable, HistoryUnreadable, OutputFailed: see `daq.ledger.audit.verify` and the store.
    """
    audited = store.audited()
    verdict = verify(place.audit, audited)
    if not verdict.holds:
        return ()
    known = {entry.digest for entry in store.entries()}
    for one in verdict.entries:
        noted = None if one.sha256 in audited else acknowledgement_of(one)
        if noted is not None and (one.sha256 in own or _text(one, "cell") == cell.name):
            store.acknowledge(noted)
        for digest, entered_at, document in entered_calibration(one, cell.name):
            if digest not in known:
                with contextlib.suppress(DataError):  # not comparable: of a history that was begun earlier
                    store.add(decode_calibration(document, f"entry {one.number}"), digest=digest, at=entered_at)
                    known.add(digest)
    _, new = unknown_writes(writes_to(cell, verdict, everywhere=True), audited)
    stopped, entered = set[str](), []
    for write in new:
        one, at, after = write.ended, at_of(write.ended), write.sha256_after
        can = write.action is WriteAction.ROLLED_BACK or write.calibration in known
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


def entered_calibration(entry: AuditEntry, cell: str) -> list[tuple[str, datetime, bytes]]:
    """Return the calibration of this cell that an entry has: SHA-256 of its file, time of entry, file; [] without."""
    digest, document, at = _text(entry, "sha256"), _text(entry, "document"), utc(_text(entry, "entered") or "", _NEVER)
    if entry.action is not AuditAction.CALIBRATION_ENTERED or _text(entry, "cell") != cell:
        return []
    return [] if digest is None or document is None or at == _NEVER else [(digest, at, document.encode())]


def acknowledgement_of(entry: AuditEntry) -> Acknowledgement | None:
    """Return the acknowledgement of an entry, None where it lacks a part or would silence an axis beforehand."""
    axis, why, at = _text(entry, "axis"), _text(entry, "why"), at_of(entry)
    since = utc(_text(entry, "since") or "", _NEVER)
    if entry.action is not AuditAction.ACKNOWLEDGED or axis is None or why is None or at is None:
        return None
    if not _NEVER < since <= at:
        return None
    return Acknowledgement(axis, since, at, entry.who, why, entry.sha256)


def contradictions(entries: Sequence[AuditEntry], cell: str, store: HistoryStore) -> Iterator[str]:
    """Report rows of the history that are not what the audit log says, as sentences."""
    by_digest = {one.sha256: one for one in entries}
    for number, event in enumerate(store.events(), start=1):
        if (entry := by_digest.get(event.audit or "")) is not None:
            yield from _event_flaws(f"event {number}", event, entry, entries)
    for noted in store.acknowledgements():
        if (entry := by_digest.get(noted.audit)) is None:
            continue
        name, expected = f"acknowledgement of {noted.axis} at {iso(noted.at)}", acknowledgement_of(entry)
        if expected is None:
            yield f"{name}: found entry {entry.number} of the audit, {entry.action.value}, expected an acknowledgement"
        else:
            yield from differences(name, asdict(noted), asdict(expected), _named(entry))
    rows = {entry.digest: (entry.entered, store.document(entry.digest)) for entry in store.entries()}
    for one in entries:
        for digest, entered_at, document in entered_calibration(one, cell):
            name, said = f"calibration {digest[:12]}…", f"as entry {one.number} of the audit says"
            if digest not in rows:
                yield f"{name}: found no such row, expected one {said}"
                continue
            if rows[digest][1] != document:
                yield f"document of {name}: found another one, expected it {said}"
            yield from differences(name, {"entered": rows[digest][0]}, {"entered": entered_at}, said)


def _event_flaws(name: str, event: Event, entry: AuditEntry, entries: Sequence[AuditEntry]) -> Iterator[str]:
    begun = next((one for one in entries if one.number == _number(entry)), entry) if entry.action in _ENDS else entry
    expected: dict[str, object] = {"target": entry.subject, "who": entry.who, "at": at_of(entry)}
    if is_end(entry):
        expected["action"] = AuditedWrite(begun, entry).action.value
    if (after := _text(begun, "sha256_after")) is not None:
        expected["sha256_after"] = after
    if entry.action in (AuditAction.APPLIED, AuditAction.WRITE_FOUND) and (digest := _calibration(begun, "sha256")):
        expected["digest"] = digest
    found = {**asdict(event), "action": event.action.value}
    may_differ = ("who", "at") if _finished(event, entry, entries) else ()
    yield from differences(name, found, expected, _named(entry), may_differ)


def _named(entry: AuditEntry) -> str:
    return f"as entry {entry.number} of the audit, which it names"


def _finished(event: Event, entry: AuditEntry, entries: Sequence[AuditEntry]) -> bool:
    """Whether an earlier version may have entered the write later, in another name: the writer was killed.

    Such an event names the entry of the begin, and another entry has the name and time of the process that entered it:
    `nothing to do` of the same time, or the job around it. This version appends `write found` instead.
    """
    if is_end(entry) or event.action is not WriteAction.APPLIED:
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


def at_of(entry: AuditEntry) -> datetime | None:
    """Return when an entry was written, UTC; None where its time is none."""
    found = utc(entry.at, _NEVER)
    return None if found == _NEVER else found


def _text(entry: AuditEntry, key: str) -> str | None:
    """Return a text; None for anything else, as a forged chain can hold."""
    found = entry.details.get(key)
    return found if isinstance(found, str) else None


def _number(entry: AuditEntry) -> int:
    found = entry.details.get("begun")
    return found if isinstance(found, int) else 0


def _calibration(begun: AuditEntry, key: str) -> str | None:
    """Return what an entry says of its calibration, None without it."""
    recorded = begun.details.get("calibration")
    found = recorded.get(key) if isinstance(recorded, dict) else None
    return found if isinstance(found, str) else None
