"""The history of a cell in one SQLite file: calibrations, writes to controllers, acknowledged changes.

It is the index of the audit log (docs/decisions/0031). SQLite's rollback journal, not its write-ahead log, makes it one
file that can be copied, and that opens on read-only media and network folders. A killed writer leaves a journal, and
the next process that opens the file undoes the unfinished transaction (docs/decisions/0024).
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Iterator
from datetime import datetime
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

from daq.errors import DataError, HistoryUnreadable, OutputFailed
from daq.ledger import schema
from daq.ledger.entry import (
    COLUMNS,
    GAIN_COLUMNS,
    Acknowledgement,
    Entry,
    Event,
    WriteAction,
    calibration_flaws,
    columns_of,
    early_flaws,
    gain_columns_of,
    gap_flaws,
    iso,
    zoned,
)
from daq.workflow.calibration_file import encode
from ident.calibration import Calibration, Gain

BUSY_S = 20.0  #: How long to wait for another process' transaction: each is a few rows

_NOT_WRITABLE = ("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_READONLY", "SQLITE_CANTOPEN")


class Access(Enum):
    """Access to the file; the value is SQLite's `mode` of a URI."""

    READ = "rw"
    """Opens an existing file, read-only where it cannot be written. Not "ro", which could not undo an unfinished
    transaction."""
    WRITE = "rwc"


def connect(path: Path, access: Access) -> sqlite3.Connection:
    """Open the file and check that it is a history.

    Raises:
        HistoryUnreadable: it is none, of another version, broken, or locked for long.
        OutputFailed: there is none, and none can be made.
    """
    with translate_sqlite_errors(path, access):
        address = f"file:{quote(os.fsencode(path.absolute()))}?mode={access.value}"
        connection = sqlite3.connect(address, uri=True, timeout=BUSY_S, isolation_level=None)
        try:
            connection.execute("PRAGMA foreign_keys = ON")
            connection.execute("PRAGMA trusted_schema = OFF")
            # EXTRA: a power cut behind the commit does not bring the journal, and the old content, back.
            connection.execute("PRAGMA synchronous = EXTRA")
            if not schema.is_empty(connection):
                schema.check(connection, path)
        except BaseException:
            connection.close()
            raise
    return connection


@contextlib.contextmanager
def transaction(connection: sqlite3.Connection, path: Path) -> Iterator[None]:
    """Write all or nothing; an empty file gets its tables.

    Raises:
        HistoryUnreadable, OutputFailed: see `connect`.
    """
    with translate_sqlite_errors(path, Access.WRITE):
        connection.execute("BEGIN IMMEDIATE")
        try:
            if schema.is_empty(connection):
                schema.create(connection)
            yield
            connection.execute("COMMIT")
        except BaseException:
            with contextlib.suppress(sqlite3.Error):
                connection.execute("ROLLBACK")
            raise


@contextlib.contextmanager
def translate_sqlite_errors(path: Path, access: Access) -> Iterator[None]:
    """Translate the errors of SQLite.

    Raises:
        HistoryUnreadable: broken, no SQLite file, locked for long, or not readable.
        OutputFailed: the disk is full, or the file or its folder cannot be written.
    """
    try:
        yield
    except ValueError as error:
        if access is Access.WRITE:
            raise
        raise _broken(path, f"a row that drivegain did not write: {error}") from error
    except sqlite3.Error as error:
        name = getattr(error, "sqlite_errorname", "") or type(error).__name__
        if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
            raise HistoryUnreadable(
                str(path),
                found=f"another program that keeps it locked for more than {BUSY_S:g} s",
                expected="a lock for as long as a row takes",
                remedy="see who has it open (`fuser`), and try again",
            ) from error
        if name.startswith(_NOT_WRITABLE) and access is Access.WRITE:
            raise OutputFailed(
                str(path),
                found=f"{error} ({name})",
                expected="a file in a folder that can be written, with room",
                remedy="nothing was entered; free space or rights",
            ) from error
        raise _broken(path, f"{error} ({name})") from error


def _broken(path: Path, found: str) -> HistoryUnreadable:
    return HistoryUnreadable(
        str(path),
        found=found,
        expected="the history that drivegain keeps of a cell",
        remedy="check its rights; if it is broken keep a copy, restore the last good one from a backup, or enter "
        "the calibrations anew in another file (`drivegain history CELL --add CALIBRATION`)",
    )


class HistoryStore:
    """The history's file; use as a context manager. Without a file it is empty, and the first `add` makes it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._connection: sqlite3.Connection | None = None

    def __enter__(self) -> Self:
        """Open it.

        Raises:
            HistoryUnreadable: it is no history, of another version, broken, or locked for long.
        """
        if self.path.exists():
            self._connection = connect(self.path, Access.READ)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def add(self, calibration: Calibration, *, digest: str, at: datetime) -> bool:
        """Enter a calibration.

        Args:
            calibration: of this cell.
            digest: SHA-256 of its file.
            at: now, with its zone.

        Returns:
            whether it is new: the same file is entered once.

        Raises:
            DataError: another cell, other axes, or a gain in another unit than the history's.
            HistoryUnreadable: see `__enter__`.
            OutputFailed: the file cannot be written.
        """
        with self._writing() as connection:
            if connection.execute("SELECT 1 FROM calibration WHERE digest = ?", (digest,)).fetchone():
                return False
            self._check_like(calibration)
            connection.execute(
                f"INSERT INTO calibration (digest, {', '.join(COLUMNS)}, document)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (digest, *columns_of(calibration, digest, at).values(), encode(calibration).decode()),
            )
            connection.executemany(
                "INSERT INTO gain (digest, place, axis, value, std, unit, nameplate) VALUES (?, ?, ?, ?, ?, ?, ?)",
                [(digest, place, *gain.values()) for place, gain in enumerate(gain_columns_of(calibration))],
            )
        return True

    def applied(
        self,
        digest: str,
        *,
        at: datetime,
        who: str,
        target: str,
        audit: str | None = None,
        sha256_after: str | None = None,
    ) -> None:
        """Enter a write of a calibration's gains.

        Args:
            digest: of the calibration, which was entered before.
            at: when, with its zone.
            who: the person or the job.
            target: the controller's file, as the audit log names it.
            audit: SHA-256 of its entry in the audit log; by it `drivegain history --verify` notices an audit log
                whose end was cut off.
            sha256_after: of the target's content now, by which a rollback to it is recognised.

        Raises:
            ValueError: the calibration was never entered, or the time has no zone.
            HistoryUnreadable, OutputFailed: as `add`.
        """
        with self._writing() as connection:
            if not connection.execute("SELECT 1 FROM calibration WHERE digest = ?", (digest,)).fetchone():
                raise ValueError(f"calibration {digest[:12]}… is not in the history")
            self._note(connection, Event(digest, WriteAction.APPLIED, at, who, target, audit, sha256_after))

    def rolled_back(
        self, *, at: datetime, who: str, target: str, sha256_after: str, audit: str | None = None
    ) -> str | None:
        """Enter that the last write to `target` was undone.

        Args:
            at, who, target, audit: as in `applied`.
            sha256_after: of the target's content now. The gains of a calibration are recognised by it; numbers that a
                person entered in between are in no calibration.

        Returns:
            digest of the calibration with these gains, None without one.
        """
        with self._writing() as connection:
            same = [event for event in self.events() if (event.target, event.sha256_after) == (target, sha256_after)]
            digest = same[-1].digest if same else None
            self._note(connection, Event(digest, WriteAction.ROLLED_BACK, at, who, target, audit, sha256_after))
        return digest

    def acknowledge(self, noted: Acknowledgement) -> None:
        """Enter an explained change of a gain. Raises as `applied`."""
        with self._writing() as connection:
            connection.execute(
                "INSERT INTO acknowledgement (axis, since, at, who, why, audit) VALUES (?, ?, ?, ?, ?, ?)",
                (noted.axis, iso(noted.since), iso(noted.at), noted.who, noted.why, noted.audit),
            )

    def entries(self) -> tuple[Entry, ...]:
        """Return all calibrations in the order in which they were fitted."""
        events = self.events()
        rows = self._rows(f"SELECT digest, {', '.join(COLUMNS)} FROM calibration ORDER BY created, entered, digest")
        gains: dict[str, list[Gain]] = {}
        for digest, *gain in self._rows("SELECT digest, axis, value, std, unit, nameplate FROM gain ORDER BY place"):
            gains.setdefault(digest, []).append(Gain(*gain))
        with translate_sqlite_errors(self.path, Access.READ):
            return tuple(_entry(row, gains.get(row[0], []), events) for row in rows)

    def events(self) -> tuple[Event, ...]:
        """Return all writes to controllers, oldest first."""
        rows = self._rows("SELECT digest, deed, at, who, target, audit, sha256_after FROM event ORDER BY number")
        with translate_sqlite_errors(self.path, Access.READ):
            return tuple(Event(row[0], WriteAction(row[1]), zoned(row[2]), *row[3:]) for row in rows)

    def acknowledgements(self) -> tuple[Acknowledgement, ...]:
        """Return all acknowledgements, oldest first."""
        rows = self._rows("SELECT axis, since, at, who, why, audit FROM acknowledgement ORDER BY number")
        with translate_sqlite_errors(self.path, Access.READ):
            return tuple(Acknowledgement(row[0], zoned(row[1]), zoned(row[2]), *row[3:]) for row in rows)

    def audited(self) -> frozenset[str]:
        """Return the SHA-256 of all entries that the audit log must have."""
        noted = {event.audit for event in self.events()} | {noted.audit for noted in self.acknowledgements()}
        return frozenset(sha256 for sha256 in noted if sha256 is not None)

    def in_force(self, target: str | None = None) -> str | None:
        """Return the digest of the calibration of a controller's last write, None for numbers of no calibration.

        Args:
            target: the controller's file; None for the controller that was written last.
        """
        events = [event for event in self.events() if target in {None, event.target}]
        return events[-1].digest if events else None

    def document(self, digest: str) -> bytes | None:
        """Return the calibration file of this digest, None where it was never entered."""
        rows = self._rows("SELECT document FROM calibration WHERE digest = ?", (digest,))
        return str(rows[0][0]).encode() if rows else None

    def integrity(self) -> tuple[str, ...]:
        """Check the file by itself: SQLite's own check, and rows that contradict each other.

        No key guards the rows: consistent changes of all of them are found only by comparison with the audit log.

        Returns:
            sentences with found and expected; none for a sound file.
        """
        found = [str(row[0]) for row in self._rows("PRAGMA integrity_check")]
        found += [f"row of {row[0]} without its {row[2]}" for row in self._rows("PRAGMA foreign_key_check")]
        found = [text for text in found if text != "ok"]
        if found:  # rows of a broken file prove nothing
            return tuple(found)
        calibrations = self._rows(
            f"SELECT digest, document, {', '.join(COLUMNS)} FROM calibration ORDER BY created, digest"
        )
        gains = self._rows(f"SELECT digest, {', '.join(GAIN_COLUMNS)} FROM gain ORDER BY digest, place")
        with translate_sqlite_errors(self.path, Access.READ):
            return (
                *calibration_flaws(calibrations, gains),
                *(flaw for table in ("event", "acknowledgement") for flaw in gap_flaws(table, *self._numbers(table))),
                *early_flaws(self.acknowledgements()),
            )

    def _numbers(self, table: str) -> tuple[set[int], int]:
        """Return the numbers of a table's rows, and the last one that SQLite gave."""
        there = {int(row[0]) for row in self._rows(f"SELECT number FROM {table}")}
        given = self._rows("SELECT seq FROM sqlite_sequence WHERE name = ?", (table,))
        return there, max([*there, *(int(row[0]) for row in given), 0])

    def _check_like(self, calibration: Calibration) -> None:
        entries = self.entries()
        if not entries:
            return
        known = entries[-1]
        mine, theirs = ({g.axis: g.unit for g in gains} for gains in (calibration.gains, known.gains))
        other = [axis for axis in mine if axis in theirs and mine[axis] != theirs[axis]]
        if calibration.cell != known.cell:
            found, expected = (
                f"a calibration of cell {calibration.cell!r}",
                f"of {known.cell!r}, as all in this history",
            )
        elif mine.keys() != theirs.keys():
            found, expected = f"gains of {', '.join(mine)}", f"of {', '.join(theirs)}"
        elif other:
            axis = other[0]
            found, expected = f"the gain of {axis} in {mine[axis]}", f"{theirs[axis]}, as in the calibrations before"
        else:
            return
        raise DataError(
            str(self.path),
            found=found,
            expected=expected,
            remedy="gains are compared over time only where they mean the same: begin another history "
            "(`history.store` of the cell file); nothing was entered",
        )

    def _note(self, connection: sqlite3.Connection, event: Event) -> None:
        connection.execute(
            "INSERT INTO event (digest, deed, at, who, target, audit, sha256_after) VALUES (?, ?, ?, ?, ?, ?, ?)",
            (
                event.digest,
                event.action.value,
                iso(event.at),
                event.who,
                event.target,
                event.audit,
                event.sha256_after,
            ),
        )

    def _rows(self, query: str, values: tuple[object, ...] = ()) -> list[tuple[Any, ...]]:
        if self._connection is None:
            return []
        with translate_sqlite_errors(self.path, Access.READ):
            if schema.is_empty(self._connection):
                return []
            return self._connection.execute(query, values).fetchall()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        if self._connection is None:
            self._connection = connect(self.path, Access.WRITE)
        with transaction(self._connection, self.path):
            yield self._connection


def _entry(row: tuple[Any, ...], gains: list[Gain], events: tuple[Event, ...]) -> Entry:
    columns: dict[str, Any] = dict(zip(("digest", *COLUMNS), row, strict=True))
    columns |= {name: zoned(columns[name]) for name in ("created", "recorded", "entered")}
    own = tuple(event for event in events if event.digest == columns["digest"])
    return Entry(**columns, gains=tuple(gains), events=own)
