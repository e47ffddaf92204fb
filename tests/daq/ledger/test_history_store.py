"""The history's file: whole after every kill, by several writers at once, readable where nothing can be written."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.documents.calibration_file import decode_calibration, encode_calibration
from daq.errors import DataError, HistoryUnreadable, OutputFailed, exit_code
from daq.ledger.entry import Acknowledgement, WriteAction, iso, utc
from daq.ledger.store import VERSION, HistoryStore
from tests.daq.calibrations import AXES, demo_calibration
from tests.daq.histories import BEGIN, calibration_of, digest_of, enter

FORK = multiprocessing.get_context("fork")
NO_ONE = 65534


def test_without_a_file_it_is_empty_and_makes_none(tmp_path: Path) -> None:
    path = tmp_path / "demo.history.sqlite"
    with HistoryStore(path) as store:
        assert not any((store.entries(), store.events(), store.acknowledgements(), store.audited()))
        assert store.in_force() is None
        assert store.document("0" * 64) is None
        assert store.integrity() == ()
    assert not path.exists()


def test_a_calibration_comes_back_as_it_was(tmp_path: Path) -> None:
    given_ = demo_calibration()
    digest = digest_of(given_)
    with HistoryStore(tmp_path / "h") as store:
        assert store.add(given_, digest=digest, at=BEGIN)
    with HistoryStore(tmp_path / "h") as store:
        (entry,) = store.entries()
        document = store.document(digest)
        assert store.integrity() == ()
    assert document == encode_calibration(given_)
    assert decode_calibration(document, "document") == given_
    assert entry.gains == given_.gains
    assert (entry.digest, entry.cell, entry.method, entry.rows) == (digest, "demo", "ml", 14400)
    assert (entry.error_percent, entry.holdout_percent) == (3.2, 3.3)
    assert entry.created == datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
    assert entry.entered == BEGIN
    assert not entry.applied


def test_the_same_file_is_entered_once(tmp_path: Path) -> None:
    with HistoryStore(tmp_path / "h") as store:
        digest = enter(store, calibration_of(0))
        assert not store.add(calibration_of(0), digest=digest, at=BEGIN)
        assert len(store.entries()) == 1


def test_entries_are_in_the_order_in_which_they_were_fitted(tmp_path: Path) -> None:
    with HistoryStore(tmp_path / "h") as store:
        for week in (3, 0, 2, 1):
            enter(store, calibration_of(week))
        # Of another time zone, and at another spelling of it.
        late = replace(
            calibration_of(0),
            created=(BEGIN + timedelta(hours=1)).astimezone(timezone(-timedelta(hours=9))).isoformat(),
        )
        enter(store, late)
        found = [entry.created for entry in store.entries()]
    assert found == [BEGIN, BEGIN + timedelta(hours=1), *(BEGIN + timedelta(weeks=week) for week in (1, 2, 3))]


def test_a_calibration_without_a_time_has_that_of_its_entry(tmp_path: Path) -> None:
    with HistoryStore(tmp_path / "h") as store:
        store.add(replace(calibration_of(0), created="yesterday"), digest="1" * 64, at=BEGIN)
        assert store.entries()[0].created == BEGIN


@pytest.mark.parametrize("different", ["cell", "axes", "unit"])
def test_what_cannot_be_compared_is_refused(tmp_path: Path, different: str) -> None:
    known = calibration_of(0)
    other = {
        "cell": replace(calibration_of(1), cell="another"),
        "axes": replace(calibration_of(1), gains=known.gains[:5]),
        "unit": replace(calibration_of(1), gains=(*known.gains[:5], replace(known.gains[5], unit="Nm/A_peak"))),
    }[different]
    with HistoryStore(tmp_path / "h") as store:
        enter(store, known)
        with pytest.raises(DataError) as refused:
            enter(store, other)
        assert len(store.entries()) == 1
    assert exit_code(DataError) == 4
    assert "nothing was entered" in refused.value.remedy


def test_what_is_applied_and_rolled_back_is_reported(tmp_path: Path) -> None:
    with HistoryStore(tmp_path / "h") as store:
        first, second = (enter(store, calibration_of(week)) for week in range(2))
        reported = []

        def in_force() -> None:
            reported.append({None: "-", first: "first", second: "second"}[store.in_force("x.yaml")])

        def back(to: str, target: str = "x.yaml") -> str | None:
            return store.rolled_back(at=BEGIN, who="anna", target=target, sha256_after=to)

        store.applied(first, at=BEGIN, who="anna", target="x.yaml", audit="a" * 64, sha256_after="1")
        in_force()
        assert back("0") is None
        in_force()
        assert back("1") == first  # undoes the rollback
        in_force()
        store.applied(second, at=BEGIN, who="job", target="x.yaml", sha256_after="2")
        in_force()
        store.applied(second, at=BEGIN, who="job", target="another.yaml", sha256_after="1")
        assert back("1") == first
        in_force()
        assert reported == ["first", "-", "first", "second", "first"]
        assert store.in_force("another.yaml") == second
        assert store.in_force() == first
        assert store.audited() == {"a" * 64}
        assert [event.action for event in store.entries()[0].events] == [
            WriteAction.APPLIED,
            WriteAction.ROLLED_BACK,
            WriteAction.ROLLED_BACK,
        ]
        assert all(entry.applied for entry in store.entries())
        with pytest.raises(ValueError, match="not in the history"):
            store.applied("0" * 64, at=BEGIN, who="anna", target="x.yaml")


def test_what_a_person_entered_between_two_writes_is_no_calibration(tmp_path: Path) -> None:
    """The target of a rollback follows from the content, not from the order of the writes."""
    with HistoryStore(tmp_path / "h") as store:
        first, second = (enter(store, calibration_of(week)) for week in range(2))
        store.applied(first, at=BEGIN, who="anna", target="x.yaml", sha256_after="1")
        store.applied(second, at=BEGIN, who="anna", target="x.yaml", sha256_after="2")  # over what was entered by hand
        assert store.rolled_back(at=BEGIN, who="anna", target="x.yaml", sha256_after="entered by hand") is None
        assert store.in_force("x.yaml") is None
        assert store.rolled_back(at=BEGIN, who="anna", target="x.yaml", sha256_after="2") == second
        assert store.events()[0].sha256_after == "1"


def test_acknowledgements_come_back(tmp_path: Path) -> None:
    noted = Acknowledgement("J4", BEGIN, BEGIN + timedelta(days=1), "anna", "gearbox — changed", "b" * 64)
    with HistoryStore(tmp_path / "h") as store:
        store.acknowledge(noted)
    with HistoryStore(tmp_path / "h") as store:
        assert store.acknowledgements() == (noted,)
        assert store.audited() == {"b" * 64}


@settings(max_examples=200, deadline=None)
@given(st.datetimes(min_value=datetime(2, 1, 1), max_value=datetime(9998, 1, 1), timezones=st.timezones()))
def test_times_are_kept_in_utc_in_their_order(at: datetime) -> None:
    kept = iso(at)
    # Of a time that a clock shows twice, or never, Python says that it equals none.
    at = at.astimezone(UTC)
    assert utc(kept, BEGIN) == at
    assert len(kept) == len(iso(BEGIN))
    assert kept.endswith("+00:00")
    assert (kept < iso(BEGIN)) == (at < BEGIN)


def test_a_time_without_its_zone_is_refused(tmp_path: Path) -> None:
    with HistoryStore(tmp_path / "h") as store, pytest.raises(ValueError, match="zone"):
        store.add(calibration_of(0), digest="0" * 64, at=datetime(2026, 1, 1))
    with HistoryStore(tmp_path / "h") as store:
        assert store.entries() == ()


def _write_on(path: Path, week: int, written: Any, begun: Any) -> None:
    with HistoryStore(path) as store:
        digest = enter(store, calibration_of(week))
        begun.set()
        while True:
            store.applied(digest, at=BEGIN, who="anna", target="x.yaml")
            written.value += 1


def test_a_writer_killed_at_any_moment_leaves_a_whole_history(tmp_path: Path) -> None:
    """Committed entries are there, others are not, and none is half."""
    rng = random.Random(7)
    for kill in range(40):
        path, week = tmp_path / f"h{kill // 10}", kill % 10  # another file now and then: all of it is read each time
        if week == 0:
            written = FORK.RawValue("i", 0)  # without a lock, which a killed writer would keep
            known = 0
        begun = FORK.Event()
        writer = FORK.Process(target=_write_on, args=(path, week, written, begun))
        writer.start()
        assert begun.wait(60)
        writer.join(rng.uniform(0.0, 0.05))
        assert writer.pid is not None
        os.kill(writer.pid, signal.SIGKILL)
        writer.join()
        assert writer.exitcode == -signal.SIGKILL
        with HistoryStore(path) as store:
            assert store.integrity() == ()
            entries, events = store.entries(), store.events()
        assert len(entries) == week + 1
        assert all([gain.axis for gain in entry.gains] == list(AXES) for entry in entries)
        # One may have been committed whose writer did not live to say so.
        assert known <= written.value <= len(events) <= written.value + 1
        written.value = known = len(events)


def _add_many(path: Path, weeks: range) -> None:
    with HistoryStore(path) as store:
        for week in weeks:
            enter(store, calibration_of(week))


def _die_while_writing(path: Path) -> None:
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("PRAGMA cache_size = 1")  # pages go to the file, and the old ones to the journal, at once
    connection.execute("BEGIN IMMEDIATE")
    connection.execute("UPDATE calibration SET document = document || zeroblob(100000)")
    connection.execute("DELETE FROM gain")
    os.kill(os.getpid(), signal.SIGKILL)


def test_an_unfinished_transaction_is_rolled_back_by_the_next_program_that_opens_the_file(tmp_path: Path) -> None:
    path = tmp_path / "h"
    with HistoryStore(path) as store:
        for week in range(30):
            enter(store, calibration_of(week))
        before = store.entries()
    content = path.read_bytes()
    writer = FORK.Process(target=_die_while_writing, args=(path,))
    writer.start()
    writer.join()
    journal = Path(f"{path}-journal")
    assert journal.stat().st_size
    assert path.read_bytes() != content
    with HistoryStore(path) as store:
        assert store.entries() == before
        assert store.integrity() == ()
    assert not journal.exists()
    assert path.read_bytes() == content


def test_a_file_whose_first_writer_was_killed_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "h"
    path.touch()
    with HistoryStore(path) as store:
        assert store.entries() == ()
        enter(store, calibration_of(0))
        assert len(store.entries()) == 1


def test_two_processes_at_once_lose_nothing(tmp_path: Path) -> None:
    path = tmp_path / "h"
    writers = [FORK.Process(target=_add_many, args=(path, range(first, 30))) for first in (0, 10, 20)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0, 0]
    with HistoryStore(path) as store:
        assert len(store.entries()) == 30
        assert store.integrity() == ()


def test_who_waits_too_long_is_reported_by_whom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "h"
    with HistoryStore(path) as store:
        enter(store, calibration_of(0))
    monkeypatch.setattr("daq.ledger.store.BUSY_S", 0.01)
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(HistoryUnreadable, match="keeps it locked"), HistoryStore(path) as store:
            store.entries()
        other.execute("ROLLBACK")
        other.execute("BEGIN IMMEDIATE")
        with HistoryStore(path) as store:
            assert len(store.entries()) == 1  # who only reads does not wait for who is about to write
            with pytest.raises(HistoryUnreadable, match="keeps it locked"):
                enter(store, calibration_of(1))


@pytest.mark.parametrize("content", [b"not SQLite at all, and long enough to be examined" * 100, b"\x00" * 4096, None])
def test_a_foreign_file_is_refused_and_left_alone(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "h"
    if content is None:
        with closing(sqlite3.connect(path)) as other:
            other.execute("CREATE TABLE another (else_ INTEGER)")
            other.commit()
    else:
        path.write_bytes(content)
    before = path.read_bytes()
    with pytest.raises(HistoryUnreadable), HistoryStore(path) as store:
        enter(store, calibration_of(0))
    assert path.read_bytes() == before
    assert exit_code(HistoryUnreadable) == 4


@pytest.mark.parametrize("version", [0, 2, 7])
def test_another_version_is_refused_and_left_alone(tmp_path: Path, version: int) -> None:
    path = tmp_path / "h"
    with HistoryStore(path) as store:
        enter(store, calibration_of(0))
    with closing(sqlite3.connect(path)) as other:
        other.execute(f"PRAGMA user_version = {version}")
    before = path.read_bytes()
    with pytest.raises(HistoryUnreadable, match=f"version {version}") as refused, HistoryStore(path):
        pass
    assert ("later drivegain" in refused.value.remedy) == (version > VERSION)
    assert path.read_bytes() == before


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Content of a file with four calibrations."""
    path = tmp_path_factory.mktemp("four") / "h"
    with HistoryStore(path) as store:
        for week in range(4):
            enter(store, calibration_of(week))
    return path.read_bytes()


@settings(max_examples=30, deadline=None)
@given(random_=st.randoms(use_true_random=False))
def test_a_damaged_file_is_reported_and_never_a_surprise(four: bytes, random_: random.Random) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "h"
        damaged = bytearray(four)
        for _ in range(random_.randint(1, 400)):
            damaged[random_.randrange(len(damaged))] = random_.randrange(256)
        path.write_bytes(damaged[: random_.randint(1, len(damaged))] if random_.random() < 0.3 else damaged)
        try:
            with HistoryStore(path) as store:
                store.entries()
                store.integrity()
                enter(store, calibration_of(9))
        except (DataError, OutputFailed) as error:
            assert str(path) in str(error)


@pytest.mark.parametrize(
    "change", ["calibration SET created = 'once'", "calibration SET entered = '2026-01-01'", "event SET at = ''"]
)
def test_a_row_that_someone_wrote_is_reported(tmp_path: Path, change: str) -> None:
    path = tmp_path / "h"
    with HistoryStore(path) as store:
        store.applied(enter(store, calibration_of(0)), at=BEGIN, who="anna", target="x.yaml")
    with closing(sqlite3.connect(path)) as other:
        other.execute(f"UPDATE {change}")
        other.commit()
    with HistoryStore(path) as store, pytest.raises(HistoryUnreadable, match="did not write"):
        store.entries()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            "UPDATE gain SET value = 1.5 WHERE axis = 'J4'",
            "gain of J4 in calibration {digest}…: found value 1.5, ",
        ),
        ("UPDATE gain SET std = 0 WHERE axis = 'J4'", "gain of J4 in calibration {digest}…: found std 0.0, expected"),
        ("UPDATE gain SET unit = 'mNm/A' WHERE axis = 'J4'", "found unit 'mNm/A', expected 'Nm/A'"),
        ("UPDATE gain SET axis = 'J7' WHERE axis = 'J6'", "found J1, J2, J3, J4, J5, J7, expected J1, J2, J3, J4, J5"),
        ("DELETE FROM gain", "gains of calibration {digest}…: found none, expected J1"),
        ("UPDATE calibration SET rows = 1", "row of calibration {digest}…: found rows 1, expected"),
        ("UPDATE calibration SET recorded = '2025-01-01T00:00:00.000000+00:00'", "found recorded '2025-01-01T00:00:00"),
        ("UPDATE calibration SET document = 'x'", "calibration {digest}…: its document is"),
        (
            "UPDATE calibration SET document = replace(document, 'rows: ', 'rows: 1')",
            "its document is a change by hand",
        ),
        ("UPDATE acknowledgement SET since = '2130-01-01T00:00:00+00:00'", "acknowledgement of J4 at 2026-01-05"),
        ("DELETE FROM acknowledgement", "acknowledgement 1: found no such row, expected all from 1 to 1"),
        ("UPDATE event SET number = 9000000000000000000", "event 1, 2, 3, 4, 5: found no such row"),
    ],
)
def test_rows_that_contradict_each_other_are_reported(tmp_path: Path, change: str, says: str) -> None:
    path = tmp_path / "h"
    with HistoryStore(path) as store:
        digest = enter(store, calibration_of(0))
        store.applied(digest, at=BEGIN, who="anna", target="x.yaml")
        store.acknowledge(Acknowledgement("J4", BEGIN, BEGIN, "anna", "gearbox changed", "0" * 64))
        assert store.integrity() == ()
    with closing(sqlite3.connect(path)) as other:
        other.execute(change)
        other.commit()
    with HistoryStore(path) as store:
        reported = store.integrity()
    assert any(says.format(digest=digest[:12]) in sentence for sentence in reported), reported


@contextmanager
def _no_one() -> Iterator[None]:
    """Without root's leave to write everywhere."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(NO_ONE)
    try:
        yield
    finally:
        os.seteuid(0)


def test_where_nothing_can_be_written_reading_works() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder, path = Path(name), Path(name) / "h"
        with HistoryStore(path) as store:
            enter(store, calibration_of(0))
        path.chmod(0o444)
        folder.chmod(0o555)
        try:
            with _no_one(), HistoryStore(path) as store:
                assert len(store.entries()) == 1
                assert store.integrity() == ()
                with pytest.raises(OutputFailed) as refused:
                    enter(store, calibration_of(1))
            assert "nothing was entered" in refused.value.remedy
            assert len(list(folder.iterdir())) == 1
        finally:
            folder.chmod(0o755)


def test_a_folder_that_is_not_there_is_reported(tmp_path: Path) -> None:
    with HistoryStore(tmp_path / "none" / "h") as store, pytest.raises(OutputFailed):
        enter(store, calibration_of(0))
    with pytest.raises(HistoryUnreadable), HistoryStore(tmp_path) as store:
        store.entries()


def test_the_disk_being_full_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "h"
    with HistoryStore(path) as store:
        enter(store, calibration_of(0))
        assert store._connection is not None
        (pages,) = store._connection.execute("PRAGMA page_count").fetchone()
        store._connection.execute(f"PRAGMA max_page_count = {pages}")
        with pytest.raises(OutputFailed, match="SQLITE_FULL"):
            enter(store, calibration_of(1))
        assert len(store.entries()) == 1
        assert store.integrity() == ()


def test_tables_are_strict(tmp_path: Path) -> None:
    path = tmp_path / "h"
    with HistoryStore(path) as store:
        enter(store, calibration_of(0))
    with closing(sqlite3.connect(path)) as other:
        tables = other.execute("SELECT name, strict FROM pragma_table_list WHERE schema = 'main' AND type = 'table'")
        found = {name: strict for name, strict in tables if not name.startswith("sqlite_")}
        assert found == dict.fromkeys(("calibration", "gain", "event", "acknowledgement"), 1)
        with pytest.raises(sqlite3.IntegrityError):
            other.execute("UPDATE gain SET value = 'much'")


def test_a_folder_may_have_any_name(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/b\xff ?#%"))
    folder.mkdir()
    with HistoryStore(folder / "h") as store:
        digest = enter(store, calibration_of(0))
    with HistoryStore(folder / "h") as store:
        assert [one.digest for one in store.entries()] == [digest]
