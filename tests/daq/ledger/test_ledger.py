"""The history is an index of the audit log: what is killed in between is repaired, and all of it can be made anew."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from datetime import timedelta
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.policy import HistoryPlace
from daq.ledger.audit import AuditAction, append, read
from daq.ledger.entry import WriteAction
from daq.ledger.ledger import Ledger, rebuild
from daq.ledger.store import HistoryStore
from tests.daq.histories import BEGIN, calibration_of, digest_of, enter

OTHER = "/other/controller.yaml"


class Bench:
    """A cell with its ledger.

    Args:
        file: of the cell.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self.cell: Cell = load_cell(file)
        assert self.cell.history is not None
        self.place: HistoryPlace = self.cell.history
        self.controller = str(self.cell.controller_path)

    def ledger(self) -> Ledger:
        return Ledger(self.cell, self.place, "anna")

    def write(self, week: int, target: str | None = None) -> str:
        """Enter a calibration, and write it as `apply` does; SHA-256 of the entry that ends the write."""
        with self.ledger() as ledger:
            digest = enter(ledger, calibration_of(week))
            entry = self.append_write(digest, week, target)
            at = BEGIN + timedelta(weeks=week)
            ledger.applied(
                digest, at=at, who="anna", target=target or self.controller, audit=entry, sha256_after=digest[::-1]
            )
        return entry

    def append_write(self, digest: str, week: int, target: str | None = None) -> str:
        at, subject = BEGIN + timedelta(weeks=week), target or self.controller
        details = {
            "sha256_before": "0" * 64,
            "sha256_after": digest[::-1],
            "calibration": {"sha256": digest, "cell": self.cell.name},
        }
        begun = append(self.place.audit, AuditAction.APPLY_BEGUN, at=at, who="anna", subject=subject, details=details)
        ended = append(
            self.place.audit, AuditAction.APPLIED, at=at, who="anna", subject=subject, details={"begun": begun.number}
        )
        return ended.sha256

    def rows(self) -> tuple[object, ...]:
        """All that the history has."""
        with HistoryStore(self.place.store) as store:
            entries = store.entries()
            return entries, store.events(), store.acknowledgements(), [store.document(one.digest) for one in entries]

    def rebuild(self) -> bool:
        return rebuild(self.cell, self.place, who="anna", at=BEGIN).trusted

    def verify(self) -> int:
        return main(["history", str(self.file), "--verify"])


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    """The demo cell in a folder of its own."""
    kept = shutil.ignore_patterns("*.jsonl", "*.sqlite*")
    shutil.copytree(Path(__file__).parents[3] / "configs", tmp_path / "configs", ignore=kept)
    return Bench(tmp_path / "configs" / "cells" / "demo.yaml")


def test_the_history_is_made_anew_from_the_audit_alone(bench: Bench) -> None:
    for week in range(2):
        bench.write(week)
    bench.write(2, OTHER)
    with bench.ledger() as ledger:
        enter(ledger, calibration_of(3))
        ledger.acknowledge_change("J4", since=BEGIN, at=BEGIN, who="anna", why="gearbox changed")
    before, entries = bench.rows(), len(read(bench.place.audit))
    assert bench.verify() == 0
    bench.place.store.unlink()
    bench.rebuild()
    assert bench.rows() == before
    assert len(read(bench.place.audit)) == entries
    assert bench.verify() == 0


def test_a_broken_history_is_made_anew_and_kept(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    bench.write(0)
    before = bench.rows()
    bench.place.store.write_bytes(b"no history" * 1000)
    assert main(["history", str(bench.file), "--rebuild", "--verify"]) == 0
    assert "The old history was broken" in " ".join(capsys.readouterr().err.split())
    assert bench.rows() == before
    (kept,) = bench.file.parent.glob("*.bak")
    assert kept.read_bytes() == b"no history" * 1000


@pytest.mark.parametrize(
    "change",
    ["DELETE FROM event", "UPDATE event SET who = 'kim'", "DELETE FROM gain", "UPDATE acknowledgement SET why = 'x'"],
)
def test_what_someone_changed_in_the_history_never_gets_into_the_audit(bench: Bench, change: str) -> None:
    bench.write(0)
    with bench.ledger() as ledger:
        ledger.acknowledge_change("J4", since=BEGIN, at=BEGIN, who="anna", why="gearbox changed")
    before, audit = bench.rows(), bench.place.audit.read_bytes()
    with closing(sqlite3.connect(bench.place.store)) as other:
        other.execute(change)
        other.commit()
    assert bench.verify() == 4
    assert not bench.rebuild()
    assert (bench.rows(), bench.place.audit.read_bytes()) == (before, audit)
    assert bench.verify() == 0


def test_a_history_of_an_earlier_version_enters_the_audit_once(bench: Bench) -> None:
    """It has calibrations, and a write without an entry that ends it, which the audit has not."""
    first = bench.append_write(digest_of(calibration_of(0)), 0)
    with HistoryStore(bench.place.store) as store:
        one, two = (enter(store, calibration_of(week)) for week in range(2))
        target, after = bench.controller, "2" * 64
        store.applied(one, at=BEGIN, who="anna", target=target, audit=first, sha256_after=one[::-1])
        store.applied(two, at=BEGIN + timedelta(days=1), who="kim", target=target, sha256_after=after)
    third = bench.append_write(one, 2)
    with HistoryStore(bench.place.store) as store:
        at = BEGIN + timedelta(weeks=2)
        store.applied(one, at=at, who="anna", target=target, audit=third, sha256_after=one[::-1])
    assert bench.verify() == 0
    assert bench.rebuild()
    bench.place.store.unlink()
    for _ in range(2):
        bench.rebuild()
        with HistoryStore(bench.place.store) as store:
            assert [(event.digest, event.who) for event in store.events()] == [
                (one, "anna"),
                (two, "kim"),
                (one, "anna"),
            ]
        actions = [entry.action for entry in read(bench.place.audit)]
        assert actions.count(AuditAction.CALIBRATION_ENTERED) == 2
        assert actions.count(AuditAction.WRITE_FOUND) == 1
        assert bench.verify() == 0


def test_a_process_killed_before_the_index_is_repaired_by_the_next(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, bench.ledger() as ledger:
        patch.setattr(HistoryStore, "add", killed)
        patch.setattr(HistoryStore, "acknowledge", killed)
        with pytest.raises(KeyboardInterrupt):
            enter(ledger, calibration_of(0))
        with pytest.raises(KeyboardInterrupt):
            ledger.acknowledge_change("J4", since=BEGIN, at=BEGIN, who="anna", why="gearbox changed")
    bench.append_write(digest_of(calibration_of(0)), 0)
    assert bench.verify() == 4
    with bench.ledger() as ledger:
        assert [write.action for write in ledger.catch_up()] == [WriteAction.APPLIED]
        assert (len(ledger.entries()), len(ledger.acknowledgements())) == (1, 1)
    assert bench.verify() == 0


def test_a_rollback_enters_the_killed_write_before_it(bench: Bench) -> None:
    with bench.ledger() as ledger:
        digest = enter(ledger, calibration_of(0))
    bench.append_write(digest, 0)
    details = {"sha256_before": digest[::-1], "sha256_after": "0" * 64}
    begun = append(
        bench.place.audit, AuditAction.ROLLBACK_BEGUN, at=BEGIN, who="anna", subject=bench.controller, details=details
    )
    ended = append(
        bench.place.audit,
        AuditAction.ROLLED_BACK,
        at=BEGIN,
        who="anna",
        subject=bench.controller,
        details={"begun": begun.number},
    )
    with bench.ledger() as ledger:
        ledger.record_rolled_back(at=BEGIN, target=bench.controller, sha256_after="0" * 64, entry=ended.sha256)
        assert [event.action for event in ledger.events()] == [WriteAction.APPLIED, WriteAction.ROLLED_BACK]
    assert bench.verify() == 0


def test_a_late_write_is_put_in_its_place(bench: Bench) -> None:
    with bench.ledger() as ledger:
        one, two = (enter(ledger, calibration_of(week)) for week in range(2))
    bench.append_write(one, 0)
    bench.write(1)
    assert bench.verify() == 4
    bench.rebuild()
    with HistoryStore(bench.place.store) as store:
        assert [event.digest for event in store.events()] == [one, two]
    assert bench.verify() == 0


def test_a_calibration_that_was_exchanged_in_the_history_is_reported(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    """Document, row and gains agree with each other: only the audit has what was entered."""
    with bench.ledger() as ledger:
        digest = enter(ledger, calibration_of(0))
    bench.place.store.unlink()
    with HistoryStore(bench.place.store) as store:
        store.add(calibration_of(1), digest=digest, at=BEGIN)
    assert bench.verify() == 4
    assert "document of calibration" in " ".join(capsys.readouterr().err.split())
    bench.place.store.unlink()
    assert bench.verify() == 4
    assert "found no such row" in " ".join(capsys.readouterr().err.split())


def test_nothing_is_made_anew_from_an_audit_that_was_changed(bench: Bench) -> None:
    bench.write(0)
    audit = bench.place.audit
    audit.write_bytes(audit.read_bytes().replace(b'"who":"anna"', b'"who":"kim"', 1))
    before = bench.place.store.read_bytes()
    assert main(["history", str(bench.file), "--rebuild"]) == 4
    assert bench.place.store.read_bytes() == before
    audit.unlink()
    assert main(["history", str(bench.file), "--rebuild"]) == 4
    assert bench.place.store.read_bytes() == before


def test_another_cell_of_the_same_audit_has_its_own(bench: Bench) -> None:
    bench.write(0)
    before = bench.rows()
    details = {"sha256_after": "1" * 64, "calibration": {"sha256": "2" * 64, "cell": "another"}}
    begun = append(
        bench.place.audit, AuditAction.APPLY_BEGUN, at=BEGIN, who="ben", subject=bench.controller, details=details
    )
    for action, more in (
        (AuditAction.APPLIED, {"begun": begun.number}),
        (AuditAction.CALIBRATION_ENTERED, {"cell": "another", "sha256": "2" * 64, "entered": "x", "document": "y"}),
        (AuditAction.ACKNOWLEDGED, {"cell": "another", "axis": "J4", "since": BEGIN.isoformat(), "why": "z"}),
    ):
        append(bench.place.audit, action, at=BEGIN, who="ben", subject=bench.controller, details=more)
    bench.rebuild()
    assert bench.rows() == before


def test_a_path_that_is_not_utf_8_is_in_the_history(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    other = "/other/ctl\udcff.yaml"
    bench.write(0, other)
    bench.write(1)
    with bench.ledger() as ledger:
        ledger.acknowledge_change("J4", since=BEGIN, at=BEGIN, who="anna", why="gearbox \udcff")
        assert [event.target for event in ledger.events()] == [other, bench.controller]
        assert ledger.in_force(other) == digest_of(calibration_of(0))
    assert bench.verify() == 0
    before = bench.rows()
    bench.place.store.unlink()
    assert main(["history", str(bench.file), "--rebuild", "--axis", "J4"]) == 0
    assert bench.rows() == before
    assert bench.verify() == 0
    for arguments in (["--axis", "J4"], ["--json"], ["--csv", str(bench.file.with_suffix(".csv"))]):
        assert main(["history", str(bench.file), *arguments]) == 0
    assert "ctl\udcff" not in capsys.readouterr().out
