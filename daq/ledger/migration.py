"""The SQLite file in which earlier versions kept the history:
what only it has goes into the audit log, once.

Those versions wrote each calibration and each write to a controller twice. What the audit log has
is right, whatever the file says of it; from a file that is broken nothing is taken over
(docs/decisions/0036).
"""

from __future__ import annotations

import contextlib
import os
import re
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from urllib.parse import quote

from daq.errors import DaqError, HistoryInaccessible, HistoryUnreadable
from daq.ledger.audit import AuditAction, AuditEntry
from daq.ledger.fold import (
    Acknowledgement,
    EnteredCalibration,
    Event,
    WriteAction,
    acknowledgements_of,
    entered_calibrations,
    figures_of_document,
    is_end,
    iso,
    zoned,
)

BUSY_S = 5.0  #: How long to wait for another process' transaction
APPLICATION_ID = 0x64726776  #: In the header of every history of earlier versions
VERSION = 1  #: Of its tables; there was no other


@dataclass(frozen=True, slots=True)
class StoredHistory:
    """Content of the file."""

    #: oldest first; of no entry (0), and without figures
    calibrations: tuple[EnteredCalibration, ...]
    events: tuple[Event, ...]  #: writes to controllers, oldest first
    acknowledgements: tuple[Acknowledgement, ...]  #: oldest first
    flaws: tuple[str, ...]  #: what is broken in it, as sentences

    @property
    def noted(self) -> frozenset[str]:
        """SHA-256 of the entries that the audit log must have."""
        digests = [event.audit for event in self.events] + [
            noted.audit for noted in self.acknowledgements
        ]
        return frozenset(digest for digest in digests if digest is not None)


EMPTY = StoredHistory((), (), (), ())


@dataclass(frozen=True, slots=True)
class EntryDraft:
    """An entry that the audit log is to get."""

    action: AuditAction  #: its kind
    at: datetime  #: its time, with zone
    who: str  #: the person or the job
    subject: str  #: as in `AuditEntry`
    details: Mapping[str, object]  #: plain JSON


def read_stored(path: Path) -> StoredHistory:
    """Read a history of an earlier version, and check it by itself; nothing is changed.

    Raises:
        HistoryInaccessible: it is locked for long, or its rights do not let it be read.
        HistoryUnreadable: it is none, of a later version, or broken.
    """
    # Not "ro", which could not undo the unfinished transaction of a killed writer; "rw" opens a
    # read-only file, too.
    address = f"file:{quote(os.fsencode(path.absolute()))}?mode=rw"
    with (
        _translate_errors(path),
        contextlib.closing(sqlite3.connect(address, uri=True, timeout=BUSY_S)) as connection,
    ):
        (tables,) = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()
        (application,) = connection.execute("PRAGMA application_id").fetchone()
        if not tables and not application:  # its first writer was killed before it was done
            return EMPTY
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if application != APPLICATION_ID or version != VERSION:
            known = application == APPLICATION_ID
            raise _unreadable(
                path, f"a history of version {version}" if known else "a file of another program"
            )
        damaged = [
            str(row[0]) for row in connection.execute("PRAGMA integrity_check") if row[0] != "ok"
        ]
        if damaged:  # rows of a broken file prove nothing
            return StoredHistory((), (), (), tuple(damaged))
        return _content(connection)


@contextlib.contextmanager
def _translate_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise _unreadable(path, f"a row that drivegain did not write: {error}") from error
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", "") or type(error).__name__
        # Without the bytes of a damaged row.
        found = f"{str(error).partition(' with text ')[0]} ({name})"
        if name.startswith(_INACCESSIBLE):
            raise HistoryInaccessible(
                str(path),
                found=found,
                expected="the history that earlier versions of drivegain kept of a cell, readable "
                "and not locked",
                remedy="check its rights, and who has it open (`fuser`), then try again; nothing "
                "was changed",
            ) from error
        raise _unreadable(path, found) from error


_INACCESSIBLE = (
    "SQLITE_BUSY",
    "SQLITE_LOCKED",
    "SQLITE_CANTOPEN",
    "SQLITE_PERM",
    "SQLITE_READONLY",
    "SQLITE_IOERR",
)
"""Errors of SQLite, by the begin of their names, that say nothing of what the file has."""


def _unreadable(path: Path, found: str) -> HistoryUnreadable:
    return HistoryUnreadable(
        str(path),
        found=found,
        expected="the history that earlier versions of drivegain kept of a cell",
        remedy="restore the last good one from a backup, or go on without it: `drivegain history "
        "CELL --migrate` keeps it under another name",
    )


def _content(connection: sqlite3.Connection) -> StoredHistory:
    """Read all rows; raises ValueError for one that drivegain did not write."""
    rows = connection.execute(
        "SELECT digest, entered, document FROM calibration ORDER BY created, digest"
    )
    calibrations = [
        EnteredCalibration(0, str(row[0]), zoned(row[1]), zoned(row[1]), str(row[2]), None)
        for row in rows
    ]
    events = []
    query = "SELECT digest, deed, at, who, target, audit, sha256_after FROM event ORDER BY number"
    for digest, deed, at, who, target, audit, after in connection.execute(query):
        events.append(
            Event(digest, WriteAction(deed), zoned(at), _raw(who), _raw(target), audit, after)
        )
    acknowledgements = []
    query = "SELECT axis, since, at, who, why, audit FROM acknowledgement ORDER BY number"
    for axis, since, at, who, why, audit in connection.execute(query):
        acknowledgements.append(
            Acknowledgement(axis, zoned(since), zoned(at), _raw(who), _raw(why), audit)
        )
    flaws = tuple(_unreadable_documents(calibrations))
    return StoredHistory(tuple(calibrations), tuple(events), tuple(acknowledgements), flaws)


def _raw(text: str) -> str:
    """Turn bytes of a name that are not UTF-8, which SQLite refuses,
    into what they are in the audit log.
    """
    return re.sub(r"\\u(d[89a-f][0-9a-f]{2})", lambda found: chr(int(found[1], 16)), text)


def _unreadable_documents(calibrations: Iterable[EnteredCalibration]) -> Iterator[str]:
    for one in calibrations:
        try:
            figures_of_document(one)
        except DaqError as error:
            yield (
                f"calibration {one.digest[:12]}…: its document is {error.found}, expected "
                f"{error.expected}"
            )


def drafts_of(
    stored: StoredHistory, entries: Sequence[AuditEntry], cell: str, who: str, at: datetime
) -> list[EntryDraft]:
    """Return what the audit log lacks of a stored history: nothing where it was migrated before.

    Args:
        stored: without flaws.
        entries: of the audit log.
        cell: name of the cell.
        who: the person or the job that migrates.
        at: time, with zone.
    """
    return [
        *_calibration_drafts(stored.calibrations, entries, cell, who, at),
        *_event_drafts(stored.events, entries, cell),
        *_acknowledgement_drafts(stored.acknowledgements, entries, cell),
    ]


def _calibration_drafts(
    stored: Iterable[EnteredCalibration],
    entries: Sequence[AuditEntry],
    cell: str,
    who: str,
    at: datetime,
) -> Iterator[EntryDraft]:
    """Enter calibrations that only the file has, and the figures of those that an earlier version
    entered.
    """
    known = {one.digest: one for one in entered_calibrations(entries, cell)}
    lacking = [one for one in stored if one.digest not in known]
    without_figures = [
        one for one in known.values() if one.figures is None and one.document is not None
    ]
    for one in (*without_figures, *lacking):
        try:
            figures = figures_of_document(one)
        except DaqError:
            continue  # reported wherever the history is read
        details: dict[str, object] = {
            "sha256": one.digest,
            "cell": cell,
            "entered": iso(one.entered),
            "figures": figures,
        }
        if one.digest not in known:
            details["document"] = one.document
        yield EntryDraft(AuditAction.CALIBRATION_ENTERED, at, who, history_subject(cell), details)


def history_subject(cell: str) -> str:
    """Return what the entries about calibrations have as their subject."""
    return f"history of {cell}"


def _event_drafts(
    stored: Iterable[Event], entries: Sequence[AuditEntry], cell: str
) -> Iterator[EntryDraft]:
    by_digest = {one.sha256: one for one in entries}
    found = {
        (one.subject, one.at, one.who) for one in entries if one.action is AuditAction.WRITE_FOUND
    }
    for event in stored:
        named = by_digest.get(event.audit or "")
        if named is not None and is_end(named):
            continue
        if (event.target, event.at.isoformat(), event.who) in found:
            continue
        details = {
            "action": event.action.value,
            "begun": None if named is None else named.number,
            "calibration": {"sha256": event.digest, "cell": cell},
            "sha256_after": event.sha256_after,
            "migrated": True,
        }
        yield EntryDraft(AuditAction.WRITE_FOUND, event.at, event.who, event.target, details)


def _acknowledgement_drafts(
    stored: Iterable[Acknowledgement], entries: Sequence[AuditEntry], cell: str
) -> Iterator[EntryDraft]:
    entered = list(acknowledgements_of(entries, cell))
    named = {one.audit for one in entered}
    # Migrated before, under an entry of its own
    known = {replace(one, audit="") for one in entered}
    for noted in stored:
        # The first versions did not enter the name of the cell.
        if noted.audit not in named and replace(noted, audit="") not in known:
            details = {
                "axis": noted.axis,
                "cell": cell,
                "since": noted.since.isoformat(),
                "why": noted.why,
                "migrated": True,
            }
            yield EntryDraft(
                AuditAction.ACKNOWLEDGED, noted.at, noted.who, f"gain of {noted.axis}", details
            )


def set_aside(path: Path, at: datetime) -> Path:
    """Rename the file, with the journal of a killed writer; return its new name.

    Raises:
        OSError: from the file system.
    """
    aside = path.with_name(f"{path.name}.{at:%Y%m%dT%H%M%SZ}.bak")
    count = 0
    while aside.exists():
        count += 1
        aside = path.with_name(f"{path.name}.{at:%Y%m%dT%H%M%SZ}-{count}.bak")
    journal = path.with_name(f"{path.name}-journal")
    with contextlib.suppress(FileNotFoundError):
        journal.rename(aside.with_name(f"{aside.name}-journal"))
    path.rename(aside)
    return aside
