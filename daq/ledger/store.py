"""The history of a cell in one SQLite file: calibrations, writes to controllers, acknowledged changes.

It is the index of the audit log (docs/decisions/0031). SQLite's rollback journal, not its write-ahead log, makes it one
file that can be copied, and that opens on read-only media and network folders. A killed writer leaves a journal, and
the next process that opens the file undoes the unfinished transaction (docs/decisions/0024).
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from datetime import datetime
from functools import cache
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

from daq.config import yaml_file
from daq.documents.calibration_file import decode_calibration, encode_calibration
from daq.errors import DaqError, DataError, HistoryUnreadable, OutputFailed
from daq.ledger.entry import Acknowledgement, Entry, Event, WriteAction, differences, iso, listed, row_of, zoned
from ident.calibration import Calibration, Gain

BUSY_S = 5.0  #: How long to wait for another process' transaction: each is a few rows
MAX_BYTES = 2**30  #: Largest file; a calibration a day for a hundred years is smaller
MAX_ROWS = 200_000  #: Most rows of one query, besides MAX_TEXT the bound on what is read into memory
MAX_TEXT = 2 * yaml_file.MAX_BYTES  #: Longest value [bytes]; a calibration's file is the longest

APPLICATION_ID = 0x64726776  #: In the header of every history (PRAGMA application_id); read as text it says drgv
VERSION = 1

_TABLES = """
CREATE TABLE calibration (
    digest               TEXT NOT NULL PRIMARY KEY,  -- SHA-256 of calibration.yaml
    created              TEXT NOT NULL,              -- ISO 8601, UTC, as all times here
    recorded             TEXT NOT NULL,              -- newest log of the fit; as created without one
    logs                 TEXT NOT NULL,              -- SHA-256 of the digests of the fit's logs, sorted
    entered              TEXT NOT NULL,
    cell                 TEXT NOT NULL,
    configuration_sha256 TEXT NOT NULL,
    method               TEXT NOT NULL,
    software             TEXT NOT NULL,
    error_percent        REAL NOT NULL,
    holdout_percent      REAL,
    rows                 INTEGER NOT NULL,
    document             TEXT NOT NULL               -- calibration.yaml: also parameters, effects, logs' digests
) STRICT;
CREATE TABLE gain (
    digest    TEXT NOT NULL REFERENCES calibration,
    place     INTEGER NOT NULL,
    axis      TEXT NOT NULL,
    value     REAL NOT NULL,
    std       REAL NOT NULL,                         -- 0 where the fit held it fixed
    unit      TEXT NOT NULL,
    nameplate REAL NOT NULL,
    PRIMARY KEY (digest, axis)
) STRICT;
CREATE TABLE event (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    digest TEXT REFERENCES calibration,              -- whose gains the target had afterwards, NULL where unknown
    deed   TEXT NOT NULL CHECK (deed IN ('applied', 'rolled back')),
    at     TEXT NOT NULL,
    who    TEXT NOT NULL,
    target TEXT NOT NULL,
    audit  TEXT,                                     -- SHA-256 of its entry in the audit log
    sha256_after TEXT                                -- of its content afterwards, NULL where unknown
) STRICT;
CREATE TABLE acknowledgement (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    axis   TEXT NOT NULL,
    since  TEXT NOT NULL,                            -- calibrations from then on make the new baseline
    at     TEXT NOT NULL,
    who    TEXT NOT NULL,
    why    TEXT NOT NULL,
    audit  TEXT NOT NULL
) STRICT;
"""


_SCHEMA_ROWS = 64  #: More than a history has


@cache
def _own_schema() -> frozenset[tuple[str, str, str]]:
    """Return kind, name and SQL of everything in the schema of a new history."""
    with contextlib.closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript(_TABLES)
        return _schema(connection)


def _schema(connection: sqlite3.Connection) -> frozenset[tuple[str, str, str]]:
    """Return kind, name and SQL of what a file's schema has, without comments and spacing."""
    rows = connection.execute("SELECT type, name, sql FROM sqlite_schema").fetchmany(_SCHEMA_ROWS)
    return frozenset(
        (str(kind), str(name), " ".join(re.sub("--.*", "", sql or "").split())) for kind, name, sql in rows
    )


_COLUMNS = ", ".join(one.name for one in fields(Entry) if one.name not in ("gains", "events"))
_NOT_WRITABLE = ("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_READONLY", "SQLITE_CANTOPEN")


def _connect(path: Path, *, write: bool = False) -> sqlite3.Connection:
    """Open the file, made where it is missing and is to be written, and check that it is a history.

    Raises:
        HistoryUnreadable: it is none, of another version, broken, changed in its schema, too large, or locked for long.
        OutputFailed: there is none, and none can be made.
    """
    with _translate_sqlite_errors(path, write=write):
        with contextlib.suppress(OSError):  # SQLite finds out what is wrong with it
            if (size := path.stat().st_size) > MAX_BYTES:
                raise _broken(path, f"{size} bytes, more than {MAX_BYTES}")
        # Not "ro" to read, which could not undo an unfinished transaction; "rw" opens a read-only file all the same.
        address = f"file:{quote(os.fsencode(path.absolute()))}?mode={'rwc' if write else 'rw'}"
        connection = sqlite3.connect(address, uri=True, timeout=BUSY_S, isolation_level=None)
        try:
            connection.row_factory = sqlite3.Row
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_TEXT)
            connection.execute("PRAGMA foreign_keys = ON")
            connection.execute("PRAGMA trusted_schema = OFF")
            # EXTRA: a power cut behind the commit does not bring the journal, and the old content, back.
            connection.execute("PRAGMA synchronous = EXTRA")
            if not _is_empty(connection):
                _check(connection, path)
        except BaseException:
            connection.close()
            raise
    return connection


def _is_empty(connection: sqlite3.Connection) -> bool:
    """Whether nothing was ever written: a new file, or one whose first writer was killed before it was done."""
    (tables,) = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()
    return not tables and not _number(connection, "application_id")


def _number(connection: sqlite3.Connection, pragma: str) -> int:
    (value,) = connection.execute(f"PRAGMA {pragma}").fetchone()
    return int(value)


def _check(connection: sqlite3.Connection, path: Path) -> None:
    version = _number(connection, "user_version")
    if _number(connection, "application_id") != APPLICATION_ID:
        raise HistoryUnreadable(
            str(path),
            found="an SQLite file of another program",
            expected="the history that drivegain keeps of a cell",
            remedy="name another file in `history.store` of the cell; nothing was written",
        )
    if version != VERSION:
        later = version > VERSION
        raise HistoryUnreadable(
            str(path),
            found=f"a history of version {version}",
            expected=f"version {VERSION}",
            remedy="a later drivegain made it: use that one; nothing was written"
            if later
            else "no drivegain ever made this version: restore the file from a backup; nothing was written",
        )
    # A view in the place of a table need never end, and a trigger changes what is entered.
    if differing := _schema(connection) ^ _own_schema():
        kind, name, _ = min(differing, key=lambda one: (one not in _schema(connection), one))
        raise _broken(path, f"{kind} {name!r} in its schema, which drivegain did not make so")


@contextlib.contextmanager
def _translate_sqlite_errors(path: Path, *, write: bool = False) -> Iterator[None]:
    """Translate the errors of SQLite.

    Raises:
        HistoryUnreadable: broken, no SQLite file, locked for long, or not readable.
        OutputFailed: the disk is full, or the file or its folder cannot be written.
    """
    try:
        yield
    except ValueError as error:
        if write:
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
        if name.startswith(_NOT_WRITABLE) and write:
            raise OutputFailed(
                str(path),
                found=f"{error} ({name})",
                expected="a file in a folder that can be written, with room",
                remedy="nothing was entered; free space or rights",
            ) from error
        # Without the bytes of a damaged row.
        raise _broken(path, f"{str(error).partition(' with text ')[0]} ({name})") from error


def _broken(path: Path, found: str) -> HistoryUnreadable:
    return HistoryUnreadable(
        str(path),
        found=found,
        expected="the history that drivegain keeps of a cell",
        remedy="check its rights; if it is broken make it anew from the audit (`drivegain history CELL --rebuild`, "
        "which keeps a copy), or restore the last good one from a backup",
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
            self._connection = _connect(self.path)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def add(self, calibration: Calibration, *, digest: str, at: datetime) -> bool:
        """Enter a calibration, with the SHA-256 of its file; return whether it is new: a file is entered once.

        Raises:
            DataError: another cell, other axes, or a gain in another unit than the history's.
            HistoryUnreadable: see `__enter__`.
            OutputFailed: the file cannot be written.
        """
        with self._writing() as connection:
            if connection.execute("SELECT 1 FROM calibration WHERE digest = ?", (digest,)).fetchone():
                return False
            self._check_like(calibration)
            row = {**row_of(calibration, digest, at), "document": encode_calibration(calibration).decode()}
            _insert(connection, "calibration", row)
            for place, gain in enumerate(calibration.gains):
                _insert(connection, "gain", {"digest": digest, "place": place, **asdict(gain)})
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
        """Enter a write of a calibration's gains; the arguments are those of `Event`.

        By `audit`, `drivegain history --verify` notices an audit log whose end was cut off. By `sha256_after`, a
        rollback to this content is recognised.

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

        Returns:
            digest of the calibration whose gains are recognised by `sha256_after`; None for numbers that a person
            entered in between, which are in no calibration.
        """
        with self._writing() as connection:
            same = [event for event in self.events() if (event.target, event.sha256_after) == (target, sha256_after)]
            digest = same[-1].digest if same else None
            self._note(connection, Event(digest, WriteAction.ROLLED_BACK, at, who, target, audit, sha256_after))
        return digest

    def acknowledge(self, noted: Acknowledgement) -> None:
        """Enter an explained change of a gain. Raises as `applied`."""
        with self._writing() as connection:
            row = {**asdict(noted), "since": iso(noted.since), "at": iso(noted.at)}
            _insert(connection, "acknowledgement", row)

    def entries(self) -> tuple[Entry, ...]:
        """Return all calibrations in the order in which they were fitted."""
        events = self.events()
        rows = self._rows(f"SELECT {_COLUMNS} FROM calibration ORDER BY created, entered, digest")
        gains: dict[str, list[Gain]] = {}
        for row in self._rows("SELECT digest, axis, value, std, unit, nameplate FROM gain ORDER BY place"):
            gains.setdefault(row["digest"], []).append(Gain(*row[1:]))
        with _translate_sqlite_errors(self.path):
            for row in rows:
                _check_numbers(
                    row["digest"], gains.get(row["digest"], ()), row["error_percent"], row["holdout_percent"]
                )
            return tuple(
                Entry(
                    **{**dict(row), **{name: zoned(row[name]) for name in ("created", "recorded", "entered")}},
                    gains=tuple(gains.get(row["digest"], ())),
                    events=tuple(event for event in events if event.digest == row["digest"]),
                )
                for row in rows
            )

    def events(self) -> tuple[Event, ...]:
        """Return all writes to controllers, oldest first."""
        rows = self._rows("SELECT digest, deed, at, who, target, audit, sha256_after FROM event ORDER BY number")
        with _translate_sqlite_errors(self.path):
            return tuple(Event(row[0], WriteAction(row[1]), zoned(row[2]), *map(_raw, row[3:])) for row in rows)

    def acknowledgements(self) -> tuple[Acknowledgement, ...]:
        """Return all acknowledgements, oldest first."""
        rows = self._rows("SELECT axis, since, at, who, why, audit FROM acknowledgement ORDER BY number")
        with _translate_sqlite_errors(self.path):
            return tuple(Acknowledgement(row[0], zoned(row[1]), zoned(row[2]), *map(_raw, row[3:])) for row in rows)

    def audited(self) -> frozenset[str]:
        """Return the SHA-256 of all entries that the audit log must have."""
        noted = {event.audit for event in self.events()} | {noted.audit for noted in self.acknowledgements()}
        return frozenset(sha256 for sha256 in noted if sha256 is not None)

    def in_force(self, target: str | None = None) -> str | None:
        """Return the digest of the calibration in a target, or in the last written one; None for other numbers."""
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
        with _translate_sqlite_errors(self.path):
            return (*self._calibration_flaws(), *self._gap_flaws("event"), *self._gap_flaws("acknowledgement"))

    def _calibration_flaws(self) -> Iterator[str]:
        """Report rows of calibrations that contradict their own document, and acknowledgements of the future."""
        for row in self._rows("SELECT * FROM calibration ORDER BY created, digest"):
            digest, name = row["digest"], f"calibration {row['digest'][:12]}…"
            entered = zoned(row["entered"])
            try:
                calibration = decode_calibration(row["document"].encode(), f"document of {name}")
            except DaqError as error:
                yield f"{name}: its document is {error.found}, expected {error.expected}"
                continue
            said = "as its document says"
            yield from differences(f"row of {name}", dict(row), row_of(calibration, digest, entered), said)
            gains = self._rows("SELECT * FROM gain WHERE digest = ? ORDER BY place", (digest,))
            axes, wanted = [gain["axis"] for gain in gains], [gain.axis for gain in calibration.gains]
            if axes != wanted or [gain["place"] for gain in gains] != list(range(len(gains))):
                places = f", numbered {listed(gain['place'] for gain in gains)}" if axes == wanted else ""
                yield f"gains of {name}: found {listed(axes)}{places}, expected {listed(wanted)} {said}, from 0"
                continue
            for found, expected in zip(gains, calibration.gains, strict=True):
                yield from differences(f"gain of {expected.axis} in {name}", dict(found), asdict(expected), said)
        for noted in self.acknowledgements():
            if noted.since > noted.at:
                yield (
                    f"acknowledgement of {noted.axis} at {iso(noted.at)}: found a baseline since {iso(noted.since)}, "
                    "expected one that does not begin later than the acknowledgement itself"
                )

    def _gap_flaws(self, table: str) -> Iterator[str]:
        """Report missing rows of a table: their numbers go from 1 to the last that SQLite gave, without gaps."""
        there = {int(row[0]) for row in self._rows(f"SELECT number FROM {table}")}
        given = self._rows("SELECT seq FROM sqlite_sequence WHERE name = ?", (table,))
        last = max([*there, *(int(row[0]) for row in given), 0])
        missing = list(islice((number for number in range(1, last + 1) if number not in there), 5))
        if missing:
            yield f"{table} {listed(missing)}: found no such row, expected all from 1 to {last}"

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
        row = {**asdict(event), "at": iso(event.at), "deed": event.action.value}
        del row["action"]
        _insert(connection, "event", row)

    def _rows(self, query: str, values: tuple[object, ...] = ()) -> list[sqlite3.Row]:
        if self._connection is None:
            return []
        with _translate_sqlite_errors(self.path):
            if _is_empty(self._connection):
                return []
            rows = self._connection.execute(query, values).fetchmany(MAX_ROWS + 1)
        if len(rows) > MAX_ROWS:
            raise _broken(self.path, f"more than {MAX_ROWS} rows")
        return rows

    @contextlib.contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """Write all or nothing; an empty file gets its tables."""
        if self._connection is None:
            self._connection = _connect(self.path, write=True)
        connection = self._connection
        with _translate_sqlite_errors(self.path, write=True):
            connection.execute("BEGIN IMMEDIATE")
            try:
                if _is_empty(connection):
                    for statement in filter(str.strip, _TABLES.split(";\n")):
                        connection.execute(statement)
                    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                    connection.execute(f"PRAGMA user_version = {VERSION}")
                yield connection
                connection.execute("COMMIT")
            except BaseException:
                with contextlib.suppress(sqlite3.Error):
                    connection.execute("ROLLBACK")
                raise


def _check_numbers(digest: str, gains: Sequence[Gain], *errors_percent: float | None) -> None:
    """Check the numbers of a calibration's rows.

    Raises:
        ValueError: one is not finite, or σ or an error is negative.
    """
    numbers = [number for gain in gains for number in (gain.value, gain.std, gain.nameplate)]
    positive = [*(gain.std for gain in gains), *(error for error in errors_percent if error is not None)]
    if not all(map(math.isfinite, (*numbers, *positive))) or min(positive, default=0.0) < 0.0:
        raise ValueError(f"calibration {digest[:12]}… with a number that is not finite, or a σ or an error below zero")


def _insert(connection: sqlite3.Connection, table: str, row: Mapping[str, object]) -> None:
    places = ", ".join("?" * len(row))
    # SQLite refuses bytes of a file's name that are not UTF-8: they are spelled as in the audit log, \udcff.
    values = [v.encode(errors="backslashreplace").decode() if isinstance(v, str) else v for v in row.values()]
    connection.execute(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({places})", values)


def _raw(text: Any) -> Any:
    """Turn bytes that `_insert` has spelled into what they were, so that paths are equal to those of the audit log."""
    return text and re.sub(r"\\u(d[89a-f][0-9a-f]{2})", lambda found: chr(int(found[1], 16)), text)
