"""Tables of the history's SQLite file, and whether a file is one."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from daq.errors import HistoryUnreadable

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


def is_empty(connection: sqlite3.Connection) -> bool:
    """Whether nothing was ever written: a new file, or one whose first writer was killed before it was done."""
    (tables,) = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()
    return not tables and not _number(connection, "application_id")


def create(connection: sqlite3.Connection) -> None:
    """Make the tables, within the transaction that is open."""
    for statement in filter(str.strip, _TABLES.split(";\n")):
        connection.execute(statement)
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {VERSION}")


def check(connection: sqlite3.Connection, path: Path) -> None:
    """Whether a file that is not empty is a history of this version.

    Raises:
        HistoryUnreadable: it is none, or of another version.
    """
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


def _number(connection: sqlite3.Connection, pragma: str) -> int:
    (value,) = connection.execute(f"PRAGMA {pragma}").fetchone()
    return int(value)
