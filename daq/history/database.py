"""An SQLite file that is opened, written and complained about in one way."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from urllib.parse import quote

from daq.errors import HistoryUnreadable, OutputFailed
from daq.history import schema

BUSY_S = 20.0
"""How long to wait for another process' transaction: each is a few rows."""

_NOT_WRITABLE = ("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_READONLY", "SQLITE_CANTOPEN")


class Access(Enum):
    """What is wanted of the file; the value is SQLite's `mode` of a URI."""

    READ = "rw"
    """Of a file that is there; SQLite opens for reading only what it may not write. Not "ro": that could not take back
    what a killed writer left unfinished."""
    WRITE = "rwc"


def connect(path: Path, access: Access) -> sqlite3.Connection:
    """Open the file, and look at whether it is a history.

    Raises:
        HistoryUnreadable: it is none, of another version, broken, or locked for long.
        OutputFailed: there is none, and none can be made.
    """
    with telling(path, access):
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
    """All that is written within is in the file, or nothing; the tables are made where there are none yet.

    Raises:
        HistoryUnreadable, OutputFailed: see `connect`.
    """
    with telling(path, Access.WRITE):
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
def telling(path: Path, access: Access) -> Iterator[None]:
    """What SQLite raises, in our words.

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
