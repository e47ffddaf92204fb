"""A cell's ledger: the audit log, which is the truth, and the history, which is its index.

What is added goes to the audit log first and then to the index. A process that is killed in between leaves an index
that lacks an entry; the next one adds it (`catch_up`), and `rebuild` makes the whole index anew.
"""

from __future__ import annotations

import logging
import shutil
import sqlite3
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from daq.config.cell import Cell
from daq.config.policy import HistoryPlace
from daq.documents.calibration_file import decode_calibration, encode_calibration
from daq.errors import AuditUnusable, DataError, HistoryUnreadable, OutputFailed, evidence
from daq.files import fsync_folder
from daq.ledger.audit import AuditAction, AuditEntry, AuditVerdict, append, read, verify
from daq.ledger.entry import Acknowledgement, Event, iso
from daq.ledger.store import HistoryStore
from daq.ledger.verify import (
    AuditedWrite,
    catch_up,
    contradictions,
    entered_calibration,
    is_end,
    unknown_writes,
    writes_to,
)
from ident.calibration import Calibration

_LOG = logging.getLogger("drivegain")


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of checking audit log and history."""

    place: HistoryPlace  #: of both files
    verdict: AuditVerdict  #: on the audit log
    broken: tuple[str, ...]  #: what is broken in the history, and where its rows are not what the audit log says
    unknown: tuple[AuditedWrite, ...] = ()  #: writes that the history lacks
    late: bool = False  #: whether the history has a later write than one of these

    @property
    def complete(self) -> bool:
        """Whether the audit log holds and the history has every write."""
        return self.verdict.holds and not self.unknown


class Ledger(HistoryStore):
    """The history of a cell that writes through the audit log; use as a context manager.

    Where the audit log cannot be written, the history has what was added all the same, a warning says so, and `rebuild`
    enters it in the audit log later: a write that was made must not be called undone.
    """

    def __init__(self, cell: Cell, place: HistoryPlace, who: str) -> None:
        super().__init__(place.store)
        self.cell = cell
        self.place = place
        self.who = who

    def add(self, calibration: Calibration, *, digest: str, at: datetime) -> bool:
        """See `HistoryStore.add`."""
        if self.document(digest) is None:
            self._check_like(calibration)
            at = self._enter_calibration(calibration, digest, at, at)
        return super().add(calibration, digest=digest, at=at)

    def record_applied(
        self, digest: str, *, at: datetime, target: str, sha256_after: str, entry: str | None = None
    ) -> None:
        """Enter that a controller has the gains of a calibration; before it what other processes could not enter.

        `entry` is the SHA-256 of the audit log's entry of the write; None where an earlier process wrote, which may
        have been killed before it entered the write, or entered it.

        Raises:
            AuditUnusable, HistoryUnreadable, OutputFailed: see `HistoryStore.applied`.
        """
        if entry is None:
            if self.in_force(target) == digest:
                return
            for one in read(self.place.audit):
                if (one.subject, one.details.get("sha256_after")) == (target, sha256_after):
                    entry = one.sha256  # the newest one counts
        if not any(entry in write.digests for write in self.catch_up()):
            self.applied(digest, at=at, who=self.who, target=target, audit=entry, sha256_after=sha256_after)

    def record_rolled_back(self, *, at: datetime, target: str, sha256_after: str, entry: str | None) -> None:
        """Enter that the last write to a target was undone. Args and errors as in `record_applied`."""
        if not any(entry in write.digests for write in self.catch_up()):
            self.rolled_back(at=at, who=self.who, target=target, sha256_after=sha256_after, audit=entry)

    def acknowledge_change(self, axis: str, *, since: datetime, at: datetime, who: str, why: str) -> None:
        """Record that a change of a gain is explained.

        Raises:
            AuditUnusable, HistoryUnreadable, OutputFailed: it could not be recorded.
        """
        details = {"axis": axis, "cell": self.cell.name, "since": since.isoformat(), "why": why}
        try:
            entry = self._append(AuditAction.ACKNOWLEDGED, at, who, f"gain of {axis}", details)
        except OSError as error:
            raise OutputFailed.of(self.place.audit, error) from error
        self.acknowledge(Acknowledgement(axis, since, at, who, why, entry.sha256))

    def catch_up(self) -> tuple[AuditedWrite, ...]:
        """Add what the audit log has and the index lacks; see `daq.ledger.verify.catch_up`."""
        return catch_up(self.cell, self.place, self)

    def verify(self, heads: Collection[str] = ()) -> Verification:
        """Check audit log and history, each by itself and against the other.

        Args:
            heads: SHA-256 of entries of the audit log that were noted elsewhere, besides the history.

        Raises:
            AuditUnusable, HistoryUnreadable: see `daq.ledger.audit.verify` and the store.
        """
        verdict, broken = verify(self.place.audit, self.audited().union(heads)), self.integrity()
        if not verdict.holds:  # its entries prove nothing
            return Verification(self.place, verdict, broken)
        broken += tuple(contradictions(verdict.entries, self.cell.name, self))
        unknown, new = unknown_writes(writes_to(self.cell, verdict), self.audited())
        return Verification(self.place, verdict, broken, tuple(unknown), new != unknown)

    def warn_if_lost(self) -> bool:
        """Warn, and return true, if the index is empty though the audit log has entries of this cell."""
        if self.entries():
            return False
        verdict = verify(self.place.audit)
        entered = any(entered_calibration(one, self.cell.name) for one in verdict.entries)
        if lost := entered or bool(writes_to(self.cell, verdict, everywhere=True)):
            _LOG.warning("the history lacks what the audit has; to make it anew: drivegain history CELL --rebuild")
        return lost

    def enter_in_audit(self, at: datetime) -> None:
        """Enter in the audit log what only the history has: calibrations and found writes of an earlier version."""
        for one in self.entries():
            document = self.document(one.digest)
            if document is not None:
                self._enter_calibration(decode_calibration(document, one.digest), one.digest, one.entered, at)
        found = {
            (one.subject, one.at, one.who) for one in read(self.place.audit) if one.action is AuditAction.WRITE_FOUND
        }
        for event in self.events():
            if (event.target, event.at.isoformat(), event.who) not in found:
                self._with_entry(event, {"migrated": True})

    def _note(self, connection: sqlite3.Connection, event: Event) -> None:
        """Enter a write; one that no entry of the audit log ends is entered there as found."""
        super()._note(connection, self._with_entry(event, {}))

    def _with_entry(self, event: Event, more: dict[str, object]) -> Event:
        try:
            entries = {one.sha256: one for one in read(self.place.audit)}
            named = entries.get(event.audit or "")
            if named is not None and is_end(named):
                return event
            details: dict[str, object] = {
                "action": event.action.value,
                "begun": None if named is None else named.number,
                "calibration": {"sha256": event.digest, "cell": self.cell.name},
                "sha256_after": event.sha256_after,
                **more,
            }
            found = self._append(AuditAction.WRITE_FOUND, event.at, event.who, event.target, details)
            return replace(event, audit=found.sha256)
        except (AuditUnusable, OSError) as error:
            _LOG.warning("the audit log does not have this write: %s", evidence(error))
            return event

    def _enter_calibration(self, calibration: Calibration, digest: str, entered: datetime, at: datetime) -> datetime:
        """Enter a calibration in the audit log, once; return when it was entered: an earlier process may have done it.

        Its row has this time, too, so that `verify` can compare the two.
        """
        try:
            for one in read(self.place.audit):
                for known, earlier, _ in entered_calibration(one, self.cell.name):
                    if known == digest:
                        return earlier
            details = {
                "sha256": digest,
                "cell": self.cell.name,
                "entered": iso(entered),
                "document": encode_calibration(calibration).decode(),
            }
            subject = f"history of {self.cell.name}"
            self._append(AuditAction.CALIBRATION_ENTERED, at, self.who, subject, details)
        except (AuditUnusable, OSError) as error:
            _LOG.warning("the audit log does not have this calibration: %s", evidence(error))
        return entered

    def _append(
        self, action: AuditAction, at: datetime, who: str, subject: str, details: Mapping[str, object]
    ) -> AuditEntry:
        return append(self.place.audit, action, at=at, who=who, subject=subject, details=details)


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """Content of a history after `rebuild`."""

    calibrations: int  #: number of calibrations
    writes: int  #: number of writes
    acknowledgements: int  #: number of acknowledged changes
    kept: Path | None  #: the history that was replaced, None where there was none
    trusted: bool  #: whether what only the old history had was entered in the audit log: not where it was broken


def rebuild(cell: Cell, place: HistoryPlace, *, who: str, at: datetime, heads: Collection[str] = ()) -> Rebuilt:
    """Make the history anew from the audit log; the old file is kept under another name.

    Calibrations and writes that only the history has, which an earlier version wrote, are entered in the audit log
    first, unless the history contradicts itself or the audit log.

    `heads` are the SHA-256 of entries of the audit log that were noted elsewhere.

    Raises:
        DataError: the audit log is not what was written; nothing was changed.
        AuditUnusable, OutputFailed: a file cannot be written; the history is as it was.
    """
    entries = read(place.audit)
    own = frozenset(one.sha256 for one in entries if "cell" not in one.details)
    verdict, trusted = verify(place.audit, heads), False
    try:
        with Ledger(cell, place, who) as old:
            found = old.verify(heads)
            verdict, trusted = found.verdict, not found.broken
            if trusted and verdict.holds and place.store.exists():
                own = old.audited()
                old.enter_in_audit(at)
    except HistoryUnreadable as error:
        _LOG.warning("the old history cannot be read: %s", error)
    if not verdict.holds:
        raise audit_error(place, verdict)
    new = place.store.with_name(f"{place.store.name}.part")
    try:
        new.unlink(missing_ok=True)
        with HistoryStore(new) as index:
            catch_up(cell, place, index, own)
            counts = len(index.entries()), len(index.events()), len(index.acknowledgements())
        kept = None
        if place.store.exists():
            kept = place.store.with_name(f"{place.store.name}.{at:%Y%m%dT%H%M%SZ}.bak")
            shutil.copyfile(place.store, kept)
            journal = place.store.with_name(f"{place.store.name}-journal")
            if journal.exists():  # SQLite would apply it to the new history
                journal.rename(kept.with_name(f"{kept.name}-journal"))
        if new.exists():
            new.replace(place.store)
        else:
            place.store.unlink(missing_ok=True)
        fsync_folder(place.store.parent)
    except OSError as error:
        raise OutputFailed.of(place.store, error) from error
    return Rebuilt(*counts, kept, trusted)


def audit_error(place: HistoryPlace, verdict: AuditVerdict) -> DataError:
    """Return the error for an audit log that is not what was written."""
    first = verdict.flaws[0]
    if not place.audit.exists():
        return DataError(
            str(place.audit),
            found=f"no file; {first.says}",
            expected="the audit log with these entries",
            remedy="restore it from a backup; without one begin both anew (`history.audit`, `history.store`)",
        )
    more = "".join(f"\n  line {flaw.line}: {flaw.flaw.value}: {flaw.says}" for flaw in verdict.flaws)
    return DataError(
        f"{place.audit}, line {first.line}",
        found=f"{len(verdict.flaws)} places that are not what was written{more}\n ",
        expected="entries that were never changed, moved or removed",
        remedy="keep this file as it is, compare it with a backup, ask who can write to it; until that is known trust "
        "the controller's file by its backups only, and begin audit and history anew, both (`history.audit`, "
        "`history.store`): the old history would report the missing entries for ever",
    )
