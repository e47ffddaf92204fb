"""A history that another program has changed, or that a killed writer never entered: refused, reported, repaired."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.config.policy import HistoryPlace
from daq.errors import ExitCode, HistoryUnreadable
from daq.ledger.audit import AuditAction, read
from daq.ledger.entry import WriteAction
from daq.ledger.store import HistoryStore
from tests.daq.calibrations import calibration_for

NOT_DRIVEGAINS = {
    "view": "CREATE VIEW v AS SELECT 1",
    "index": "CREATE INDEX i ON event (who)",
    "table": "CREATE TABLE another (a)",
    "column": "ALTER TABLE gain ADD COLUMN more REAL",
    "trigger": "CREATE TRIGGER t AFTER INSERT ON event BEGIN UPDATE event SET digest = NULL; END",
    "a view that never ends": "ALTER TABLE gain RENAME TO kept; CREATE VIEW gain AS WITH RECURSIVE c (x) AS "
    "(SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT '' AS digest, x AS place, 'J1' AS axis, 1.0 AS value, 1.0 AS std, "
    "'' AS unit, 1.0 AS nameplate FROM c",
}
NONSENSE = {
    "infinite gain": "UPDATE gain SET value = 9e999 WHERE axis = 'J4'",
    "infinite sigma": "UPDATE gain SET std = 9e999 WHERE axis = 'J4'",
    "negative sigma": "UPDATE gain SET std = -1 WHERE axis = 'J4'",
    "infinite nameplate": "UPDATE gain SET nameplate = -9e999",
    "infinite error": "UPDATE calibration SET error_percent = 9e999",
    "negative error": "UPDATE calibration SET holdout_percent = -1",
    "a long text": "UPDATE calibration SET software = hex(zeroblob(5000000))",
}
CHANGED = {
    "sha256_after": "UPDATE event SET sha256_after = NULL",
    "entered": "UPDATE calibration SET entered = '2001-01-01T00:00:00.000000+00:00'",
    "numbered": "UPDATE gain SET place = place + 1",
    "nameplate": "UPDATE gain SET nameplate = 1",
    "rows": "UPDATE calibration SET rows = 9223372036854775807",
    "who": "UPDATE event SET who = 'another'",
}


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    """The demo cell in a folder of its own."""
    kept = shutil.ignore_patterns("*.jsonl", "*.sqlite*")
    shutil.copytree(Path(__file__).parents[3] / "configs", tmp_path / "configs", ignore=kept)
    return tmp_path / "configs" / "cells" / "demo.yaml"


@pytest.fixture
def applied(cell: Path) -> Path:
    """A calibration that the cell's controller has."""
    calibration = calibration_for(cell)
    assert main(["apply", str(cell), str(calibration), "--yes"]) == ExitCode.OK
    assert main(["history", str(cell), "--verify"]) == ExitCode.OK
    return calibration


def place_of(cell: Path) -> HistoryPlace:
    place = load_cell(cell).history
    assert place is not None
    return place


def change(cell: Path, statements: str) -> None:
    with closing(sqlite3.connect(place_of(cell).store)) as other:
        other.executescript(f"{statements};")
        other.commit()


@pytest.mark.parametrize("statements", [*NOT_DRIVEGAINS.values(), *NONSENSE.values()], ids=[*NOT_DRIVEGAINS, *NONSENSE])
def test_a_history_of_another_shape_or_with_nonsense_is_refused_and_made_anew(
    cell: Path, applied: Path, statements: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before a query of it is made: a view need not end, and a trigger changes what is entered."""
    change(cell, statements)
    for options in ((), ("--verify",), ("--add", str(applied))):
        assert main(["history", str(cell), *options]) == ExitCode.DATA_UNFIT
        assert "--rebuild" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(HistoryUnreadable), HistoryStore(place_of(cell).store) as store:
        store.entries()
    # The write-back goes on without it: the gains are judged by the calibration and the controller's file.
    assert main(["apply", str(cell), str(applied)]) == ExitCode.OK
    assert main(["history", str(cell), "--rebuild", "--verify"]) == ExitCode.OK


@pytest.mark.parametrize(("column", "statement"), CHANGED.items())
def test_a_change_of_any_column_is_noticed(
    cell: Path, applied: Path, column: str, statement: str, capsys: pytest.CaptureFixture[str]
) -> None:
    change(cell, statement)
    capsys.readouterr()
    assert main(["history", str(cell), "--verify"]) == ExitCode.DATA_UNFIT
    assert column in capsys.readouterr().err
    assert main(["history", str(cell), "--rebuild", "--verify"]) == ExitCode.OK


def test_more_rows_than_a_history_has_are_refused(
    cell: Path, applied: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("daq.ledger.store.MAX_ROWS", 5)
    assert main(["history", str(cell)]) == ExitCode.DATA_UNFIT
    assert "more than 5 rows" in capsys.readouterr().err
    monkeypatch.setattr("daq.ledger.store.MAX_BYTES", 100)
    assert main(["history", str(cell)]) == ExitCode.DATA_UNFIT
    assert "more than 100" in capsys.readouterr().err


def test_an_audit_of_any_length_is_not_read_into_memory(
    cell: Path, applied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with place_of(cell).audit.open("ab") as stream:
        stream.truncate(1 << 40)  # no block of it is on the disk
    assert main(["history", str(cell), "--verify"]) == ExitCode.DATA_UNFIT
    assert main(["apply", str(cell), str(calibration_for(cell, 1.01)), "--yes"]) == ExitCode.CALIBRATION_REFUSED
    assert capsys.readouterr().err.count("more than 1073741824 bytes") == 2


def kill_before_the_end(cell: Path) -> None:
    """Leave what a writer leaves that is killed right after the rename: the begin in the audit, and no history."""
    place = place_of(cell)
    begun, *_ = place.audit.read_bytes().splitlines(keepends=True)
    place.audit.write_bytes(begun)
    place.store.unlink()


@pytest.mark.parametrize("repair", ["apply", "add", "rollback"])
def test_a_write_that_was_killed_before_its_end_is_a_finding_until_it_is_entered(
    cell: Path, applied: Path, repair: str, capsys: pytest.CaptureFixture[str]
) -> None:
    kill_before_the_end(cell)
    assert main(["history", str(cell), "--verify"]) == ExitCode.DATA_UNFIT
    said = " ".join(capsys.readouterr().err.split())
    assert "no event of entry 1 of the audit, apply begun" in said
    assert "history CELL --add CALIBRATION" in said
    if repair == "apply":
        assert main(["apply", str(cell), str(applied), "--yes"]) == ExitCode.OK
    else:
        assert main(["history", str(cell), "--add", str(applied)]) == ExitCode.OK
    if repair == "rollback":
        assert main(["rollback", str(cell)]) == ExitCode.OK
    for options in (["--verify"], ["--rebuild", "--verify"]):
        assert main(["history", str(cell), *options]) == ExitCode.OK
        with HistoryStore(place_of(cell).store) as store:
            found = [event.action for event in store.events()]
        assert found == [WriteAction.APPLIED, *([WriteAction.ROLLED_BACK] if repair == "rollback" else [])]
    assert [entry.action for entry in read(place_of(cell).audit)].count(AuditAction.WRITE_FOUND) == 1


def test_a_write_that_was_killed_is_entered_before_the_one_that_follows(cell: Path, applied: Path) -> None:
    kill_before_the_end(cell)
    assert main(["history", str(cell), "--add", str(applied)]) == ExitCode.OK
    later = calibration_for(cell, 1.02)
    assert main(["apply", str(cell), str(later), "--yes"]) == ExitCode.OK
    for options in (["--verify"], ["--rebuild", "--verify"]):
        assert main(["history", str(cell), *options]) == ExitCode.OK
        with HistoryStore(place_of(cell).store) as store:
            first, second = store.entries()
            assert [event.digest for event in store.events()] == [first.digest, second.digest]
