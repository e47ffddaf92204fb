"""Migration of the history that earlier versions stored in an SQLite file:
entries that only the file has are added to the audit log, once.

Those versions recorded each calibration and each write to a controller twice, in the file and in
the audit log. Where the two disagree, the audit log is right. From a broken file nothing is
migrated (docs/decisions/0036).
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

BUSY_S = 5.0  #: Longest time to wait for the transaction of another process
APPLICATION_ID = 0x64726776  #: In the header of every history of earlier versions
VERSION = 1  #: Version of its tables; there was no other


@dataclass(frozen=True, slots=True)
class StoredHistory:
    """Content of the file."""

    #: oldest first; without figures, and with 0 as the number of their entry in the audit log
    calibrations: tuple[EnteredCalibration, ...]
    events: tuple[Event, ...]  #: writes to controllers, oldest first
    acknowledgements: tuple[Acknowledgement, ...]  #: oldest first
    flaws: tuple[str, ...]  #: damage of the file, as sentences

    @property
    def audit_digests(self) -> frozenset[str]:
        """SHA-256 of the entries that the audit log must have."""
        of_acknowledgements = {acknowledgement.audit for acknowledgement in self.acknowledgements}
        of_events = {event.audit for event in self.events if event.audit is not None}
        return frozenset(of_acknowledgements | of_events)


EMPTY = StoredHistory(calibrations=(), events=(), acknowledgements=(), flaws=())


@dataclass(frozen=True, slots=True)
class EntryDraft:
    """An entry to be added to the audit log."""

    action: AuditAction  #: its kind
    at: datetime  #: its time, with zone
    who: str  #: the person or the job
    subject: str  #: as in `AuditEntry`
    details: Mapping[str, object]  #: plain JSON


def read_stored(path: Path) -> StoredHistory:
    """Read a history of an earlier version, and check its consistency.

    Nothing is changed, but SQLite undoes the unfinished transaction of a killed writer: the file is
    then as before that transaction, and its journal is gone.

    Raises:
        HistoryInaccessible: it is locked for long, or its rights do not let it be read.
        HistoryUnreadable: it is none, of a later version, or broken.
    """
    # With "ro" SQLite could not undo such a transaction, and would refuse the file. With "rw" it
    # opens a file without the right to write for reading.
    quoted = quote(os.fsencode(path.absolute()))
    address = f"file:{quoted}?mode=rw"
    with (
        _translate_errors(path),
        contextlib.closing(sqlite3.connect(address, uri=True, timeout=BUSY_S)) as connection,
    ):
        (table_count,) = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()
        (application_id,) = connection.execute("PRAGMA application_id").fetchone()
        if not table_count and not application_id:
            return EMPTY  # its first writer was killed before it made the tables
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if application_id != APPLICATION_ID:
            raise _unreadable(path, "a file of another program")
        if version != VERSION:
            raise _unreadable(path, f"a history of version {version}")
        results = connection.execute("PRAGMA integrity_check")
        damage = tuple(str(row[0]) for row in results if row[0] != "ok")
        if damage:  # rows of a broken file prove nothing
            return replace(EMPTY, flaws=damage)
        return _read_rows(connection)


_INACCESSIBLE = (
    "SQLITE_BUSY",
    "SQLITE_LOCKED",
    "SQLITE_CANTOPEN",
    "SQLITE_PERM",
    "SQLITE_READONLY",
    "SQLITE_IOERR",
)
"""Prefixes of the names of SQLite's errors after which the content of the file is unknown."""


@contextlib.contextmanager
def _translate_errors(path: Path) -> Iterator[None]:
    """Turn errors of SQLite, and of foreign rows, into those that `read_stored` documents."""
    try:
        yield
    except ValueError as error:
        raise _unreadable(path, f"a row that drivegain did not write: {error}") from error
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", "") or type(error).__name__
        # SQLite appends the bytes of a damaged row; they are left out.
        message, _, _ = str(error).partition(" with text ")
        found = f"{message} ({name})"
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


def _unreadable(path: Path, found: str) -> HistoryUnreadable:
    """Return the error for a file that cannot be read."""
    return HistoryUnreadable(
        str(path),
        found=found,
        expected="the history that earlier versions of drivegain kept of a cell",
        remedy="restore the last good one from a backup, or go on without it: `drivegain history "
        "CELL --migrate` keeps it under another name",
    )


def _read_rows(connection: sqlite3.Connection) -> StoredHistory:
    """Read all tables.

    Raises:
        ValueError: drivegain did not write a row.
    """
    calibrations = tuple(_read_calibrations(connection))
    events = tuple(_read_events(connection))
    acknowledgements = tuple(_read_acknowledgements(connection))
    flaws = tuple(_unreadable_documents(calibrations))
    return StoredHistory(calibrations, events, acknowledgements, flaws)


def _read_calibrations(connection: sqlite3.Connection) -> Iterator[EnteredCalibration]:
    """Yield the calibrations of the file, oldest first."""
    query = "SELECT digest, entered, document FROM calibration ORDER BY created, digest"
    for digest, entered_text, document in connection.execute(query):
        entered = zoned(_text(entered_text))
        yield EnteredCalibration(
            number=0,
            digest=_text(digest),
            at=entered,  # no entry of the audit log has a time of its own for it
            entered=entered,
            document=_text(document),
            figures=None,
        )


def _read_events(connection: sqlite3.Connection) -> Iterator[Event]:
    """Yield the writes to controllers of the file, oldest first."""
    query = "SELECT digest, deed, at, who, target, audit, sha256_after FROM event ORDER BY number"
    for digest, deed, at, who, target, audit, sha256_after in connection.execute(query):
        yield Event(
            digest=_text_or_none(digest),
            action=WriteAction(_text(deed)),
            at=zoned(_text(at)),
            who=_with_surrogates(_text(who)),
            target=_with_surrogates(_text(target)),
            audit=_text_or_none(audit),
            sha256_after=_text_or_none(sha256_after),
        )


def _read_acknowledgements(connection: sqlite3.Connection) -> Iterator[Acknowledgement]:
    """Yield the acknowledged changes of the file, oldest first."""
    query = "SELECT axis, since, at, who, why, audit FROM acknowledgement ORDER BY number"
    for axis, since, at, who, why, audit in connection.execute(query):
        yield Acknowledgement(
            axis=_text(axis),
            since=zoned(_text(since)),
            at=zoned(_text(at)),
            who=_with_surrogates(_text(who)),
            why=_with_surrogates(_text(why)),
            audit=_text(audit),
        )


def _text(value: object) -> str:
    """Return the text of a column. Tables of drivegain are STRICT and have nothing else there.

    Raises:
        ValueError: the value is no text.
    """
    if isinstance(value, str):
        return value
    raise ValueError(f"{value!r:.40} where text belongs")


def _text_or_none(value: object) -> str | None:
    """Return the text of a column that may be empty; see `_text`."""
    if value is None:
        return None
    return _text(value)


def _with_surrogates(text: str) -> str:
    r"""Replace escapes such as `\udcff` by lone surrogates.

    A name may have bytes that are not UTF-8. In the audit log they are lone surrogates; SQLite
    refuses those, so the file has them as escapes.
    """
    return re.sub(r"\\u(d[89a-f][0-9a-f]{2})", _surrogate, text)


def _surrogate(escape: re.Match[str]) -> str:
    """Return the character of an escape."""
    hexadecimal = escape[1]
    return chr(int(hexadecimal, 16))


def _unreadable_documents(calibrations: Iterable[EnteredCalibration]) -> Iterator[str]:
    """Yield a sentence for each calibration with a document that cannot be read."""
    for calibration in calibrations:
        try:
            figures_of_document(calibration)
        except DaqError as error:
            yield (
                f"calibration {calibration.digest[:12]}…: its document is {error.found}, expected "
                f"{error.expected}"
            )


def drafts_of(
    stored: StoredHistory, entries: Sequence[AuditEntry], cell: str, who: str, at: datetime
) -> list[EntryDraft]:
    """Return the entries of a stored history that the audit log lacks;
    none where the history was migrated before.

    Args:
        stored: history without flaws.
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
    """Yield entries for two kinds of calibrations: those of the audit log without figures, which an
    earlier version entered, and those that only the file has.
    """
    known_digests = set()
    without_figures = []
    for calibration in entered_calibrations(entries, cell):
        known_digests.add(calibration.digest)
        if calibration.figures is None and calibration.document is not None:
            without_figures.append(calibration)
    only_stored = [one for one in stored if one.digest not in known_digests]
    for calibration in (*without_figures, *only_stored):
        try:
            figures = figures_of_document(calibration)
        except DaqError:
            continue  # every verb that reads the history reports it
        details: dict[str, object] = {
            "sha256": calibration.digest,
            "cell": cell,
            "entered": iso(calibration.entered),
            "figures": figures,
        }
        # An earlier entry of the audit log has the document of the others.
        if calibration.digest not in known_digests:
            details["document"] = calibration.document
        subject = history_subject(cell)
        yield EntryDraft(AuditAction.CALIBRATION_ENTERED, at, who, subject, details)


def history_subject(cell: str) -> str:
    """Return the subject of entries about the calibrations of a cell."""
    return f"history of {cell}"


def _event_drafts(
    stored: Iterable[Event], entries: Sequence[AuditEntry], cell: str
) -> Iterator[EntryDraft]:
    """Yield entries for the writes that the audit log does not have to the end; without those that
    an earlier migration has entered.
    """
    entry_by_digest = {entry.sha256: entry for entry in entries}
    known_writes = set()
    for entry in entries:
        if entry.action is AuditAction.WRITE_FOUND:
            known_writes.add((entry.subject, entry.at, entry.who))
    for event in stored:
        # The entry that the file names: the end of the write, or its begin if no end was written.
        named = entry_by_digest.get(event.audit or "")
        if named is not None and is_end(named):
            continue
        key = (event.target, event.at.isoformat(), event.who)
        if key in known_writes:
            continue
        begun = None
        if named is not None:
            begun = named.number
        details = {
            "action": event.action.value,
            "begun": begun,
            "calibration": {"sha256": event.digest, "cell": cell},
            "sha256_after": event.sha256_after,
            "migrated": True,
        }
        yield EntryDraft(AuditAction.WRITE_FOUND, event.at, event.who, event.target, details)


def _acknowledgement_drafts(
    stored: Iterable[Acknowledgement], entries: Sequence[AuditEntry], cell: str
) -> Iterator[EntryDraft]:
    """Yield entries for acknowledgements that the audit log does not have for this cell.

    The first versions entered them without the name of the cell: such an entry counts for no cell,
    and the acknowledgement is entered again.
    """
    entered = list(acknowledgements_of(entries, cell))
    known_digests = {acknowledgement.audit for acknowledgement in entered}
    # One that was migrated before has the digest of another entry, and is otherwise the same.
    known_content = {replace(acknowledgement, audit="") for acknowledgement in entered}
    for acknowledgement in stored:
        is_entered = acknowledgement.audit in known_digests
        is_migrated = replace(acknowledgement, audit="") in known_content
        if is_entered or is_migrated:
            continue
        details = {
            "axis": acknowledgement.axis,
            "cell": cell,
            "since": acknowledgement.since.isoformat(),
            "why": acknowledgement.why,
            "migrated": True,
        }
        yield EntryDraft(
            action=AuditAction.ACKNOWLEDGED,
            at=acknowledgement.at,
            who=acknowledgement.who,
            subject=f"gain of {acknowledgement.axis}",
            details=details,
        )


def set_aside(path: Path, at: datetime) -> Path:
    """Rename the file, with the journal of a killed writer; return its new name.

    Args:
        path: of the file.
        at: time in UTC, which becomes part of the name.

    Raises:
        OSError: from the file system.
    """
    name = f"{path.name}.{at:%Y%m%dT%H%M%SZ}"
    renamed = path.with_name(f"{name}.bak")
    count = 0
    while renamed.exists():
        count += 1
        renamed = path.with_name(f"{name}-{count}.bak")
    journal = path.with_name(f"{path.name}-journal")
    with contextlib.suppress(FileNotFoundError):
        journal.rename(renamed.with_name(f"{renamed.name}-journal"))
    path.rename(renamed)
    return renamed
