"""A history of an earlier version, in SQLite:
migrated once, kept aside, and never believed against the audit log.

`tests/data/make_two_ledgers.py` made the files: Ada applied a calibration, Bert another one, which
Cleo rolled back; a third one was entered by hand, and Dora acknowledged a change of J4.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import closing
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.cli.app import main
from daq.errors import ExitCode, HistoryUnreadable
from daq.ledger import ledger as ledger_module
from daq.ledger import migration as migration_module
from daq.ledger.audit import AuditAction, read
from daq.ledger.fold import WriteAction
from daq.ledger.ledger import Ledger, migrate, read_history
from daq.ledger.migration import VERSION, read_stored
from tests.daq.calibrations import calibration_for
from tests.daq.command_line import run_verb
from tests.daq.histories import BEGIN, history_of, ledger_of

FILES = Path(__file__).parents[2] / "data" / "two_ledgers"
WRITERS = ["Ada", "Bert", "Cleo"]


@pytest.fixture
def cell_file(cell_file: Path) -> Path:
    """The demo cell with audit log, history and controller file of the version before."""
    for name in ("demo.audit.jsonl", "demo.history.sqlite"):
        shutil.copy(FILES / name, cell_file.with_name(name))
    controllers_folder = cell_file.parents[1] / "controllers"
    shutil.copy(FILES / "controller.yaml", controllers_folder / "demo.yaml")
    return cell_file


def stored_of(cell_file: Path) -> Path:
    return cell_file.with_name("demo.history.sqlite")


def audit_of(cell_file: Path) -> Path:
    return cell_file.with_name("demo.audit.jsonl")


def change(cell_file: Path, statements: str) -> None:
    with closing(sqlite3.connect(stored_of(cell_file))) as other:
        other.executescript(f"{statements};")
        other.commit()


def shown(cell_file: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """What `history --json` prints."""
    capsys.readouterr()
    assert run_verb("history", cell_file, "--json") == ExitCode.OK
    printed = capsys.readouterr().out
    found: dict[str, Any] = json.loads(printed)
    return found


def writers_of(cell_file: Path) -> list[str]:
    events = history_of(cell_file).events
    return [event.who.split()[0] for event in events]


def asides_of(cell_file: Path) -> list[Path]:
    return sorted(cell_file.parent.glob("demo.history.sqlite.*.bak"))


def test_the_first_command_migrates_it_and_shows_what_the_version_before_showed(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = stored_of(cell_file).read_bytes()
    text = (FILES / "history.json").read_text()
    expected = json.loads(text)
    assert shown(cell_file, capsys) == expected
    assert not stored_of(cell_file).exists()
    (aside,) = asides_of(cell_file)
    assert aside.read_bytes() == content
    entries = read(audit_of(cell_file))
    assert len(entries) == 13  # the figures of three calibrations
    assert run_verb("history", cell_file, "--verify") == ExitCode.OK
    assert shown(cell_file, capsys) == expected
    assert read(audit_of(cell_file)) == entries
    assert writers_of(cell_file) == WRITERS


def test_what_reads_only_shows_the_same_and_writes_nothing(cell_file: Path) -> None:
    before = {path: path.read_bytes() for path in cell_file.parent.iterdir() if path.is_file()}
    ledger = ledger_of(cell_file)
    history = read_history(ledger)
    assert {
        path: path.read_bytes() for path in cell_file.parent.iterdir() if path.is_file()
    } == before
    migrate(ledger, who="anna", at=BEGIN)
    after = read_history(ledger)
    expected = (history.entries, history.events, history.acknowledgements)
    assert (after.entries, after.events, after.acknowledgements) == expected


@pytest.mark.parametrize("command", ["apply", "add", "migrate"])
def test_each_command_that_enters_something_migrates_it(cell_file: Path, command: str) -> None:
    calibration = str(calibration_for(cell_file, 1.005))
    arguments = {
        "apply": ["apply", str(cell_file), calibration, "--yes"],
        "add": ["history", str(cell_file), "--add", calibration],
        "migrate": ["history", str(cell_file), "--migrate"],
    }[command]
    assert main(arguments) == ExitCode.OK
    assert not stored_of(cell_file).exists()
    assert len(asides_of(cell_file)) == 1
    assert writers_of(cell_file)[:3] == WRITERS
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.OK


def test_what_only_the_history_had_gets_into_the_audit(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A write without an audit log, as a program could make it,
    and one whose entry names only its begin.
    """
    change(
        cell_file,
        "INSERT INTO event (digest, deed, at, who, target) SELECT digest, 'applied', "
        "'2027-01-01T00:00:00.000000+00:00', 'kim', '/other.yaml' FROM calibration LIMIT 1",
    )
    before = read_history(ledger_of(cell_file))
    assert shown(cell_file, capsys)["calibrations"] == 3
    assert writers_of(cell_file) == [*WRITERS, "kim"]
    (found,) = [one for one in read(audit_of(cell_file)) if one.action is AuditAction.WRITE_FOUND]
    assert found.details["migrated"] is True
    after = history_of(cell_file)
    expected = [event.action for event in before.events]
    actions = [event.action for event in after.events]
    assert actions == expected
    assert after.in_force("/other.yaml") == before.in_force("/other.yaml")
    # An earlier version was run again, and found no history of its own.
    first_aside = asides_of(cell_file)[0]
    first_aside.rename(stored_of(cell_file))
    assert shown(cell_file, capsys)["calibrations"] == 3
    assert writers_of(cell_file) == [*WRITERS, "kim"]


def test_a_history_of_a_version_whose_audit_has_no_calibrations(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only the last lines of the audit log are of calibrations:
    without them it is one of that version.
    """
    audit = audit_of(cell_file)
    lines = audit.read_bytes().splitlines(keepends=True)
    audit.write_bytes(b"".join(lines[:2]))
    change(
        cell_file,
        "DELETE FROM event WHERE number > 1; DELETE FROM acknowledgement; DELETE FROM "
        "sqlite_sequence",
    )
    calibrations = read_stored(stored_of(cell_file)).calibrations
    digests = {one.digest for one in calibrations}
    assert len(digests) == 3
    assert run_verb("history", cell_file, "--verify") == ExitCode.OK
    entries = history_of(cell_file).entries
    assert {one.digest for one in entries} == digests
    assert writers_of(cell_file) == ["Ada"]


@pytest.mark.parametrize("calls", range(4))
def test_a_migration_that_is_killed_is_finished_by_the_next_command(
    cell_file: Path, calls: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before each of the three entries, and before the file is renamed."""
    left = [calls]

    def killed_later(genuine: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given_: Any, **further: Any) -> Any:
            if not left[0]:
                raise KeyboardInterrupt
            left[0] -= 1
            return genuine(*given_, **further)

        return call

    with monkeypatch.context() as patch:
        for name in ("append", "set_aside"):
            patch.setattr(ledger_module, name, killed_later(getattr(ledger_module, name)))
        with pytest.raises(KeyboardInterrupt):
            migrate(ledger_of(cell_file), who="anna", at=BEGIN)
    assert stored_of(cell_file).exists()
    assert len(read(audit_of(cell_file))) == 10 + calls
    assert shown(cell_file, capsys) == json.loads((FILES / "history.json").read_text())
    assert len(read(audit_of(cell_file))) == 13
    assert len(asides_of(cell_file)) == 1


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE event SET who = 'kim'",
        "UPDATE event SET target = '/other.yaml'",
        "UPDATE event SET at = '2026-02-02T00:00:00.000000+00:00'",
        "UPDATE event SET deed = 'rolled back'",
        "UPDATE event SET digest = NULL",
        "UPDATE event SET sha256_after = 'ab'",
        "UPDATE event SET number = number + 7",
        "DELETE FROM event WHERE number = 2",
        "UPDATE acknowledgement SET who = 'kim'",
        "UPDATE acknowledgement SET axis = 'J2'",
        "UPDATE acknowledgement SET why = 'x'",
        "UPDATE acknowledgement SET since = '2026-01-01T00:00:00.000000+00:00'",
        "UPDATE acknowledgement SET since = '2130-01-01T00:00:00.000000+00:00'",
        "UPDATE acknowledgement SET audit = (SELECT audit FROM event)",
        "UPDATE calibration SET document = (SELECT max(document) FROM calibration)",
        "UPDATE calibration SET entered = '2001-01-01T00:00:00.000000+00:00'",
    ],
)
def test_a_row_of_what_the_audit_log_has_is_never_believed(
    cell_file: Path, statement: str, capsys: pytest.CaptureFixture[str]
) -> None:
    change(cell_file, statement)
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.OK
    assert shown(cell_file, capsys) == json.loads((FILES / "history.json").read_text())
    assert writers_of(cell_file) == WRITERS
    # With the figures of three calibrations, and nothing of that row
    assert len(read(audit_of(cell_file))) == 13
    assert len(asides_of(cell_file)) == 1


@pytest.mark.parametrize("document", ["'x'", "replace(document, 'rows: ', 'rows: 1')"])
def test_a_calibration_that_is_damaged_is_reported_and_nothing_is_taken_over(
    cell_file: Path, document: str, capsys: pytest.CaptureFixture[str]
) -> None:
    audit = audit_of(cell_file).read_bytes()
    change(cell_file, f"UPDATE calibration SET document = {document}")
    for options in ((), ("--verify",)):
        assert main(["history", str(cell_file), *options]) == ExitCode.DATA_UNFIT
        error_output = capsys.readouterr().err
        said = " ".join(error_output.split())
        assert "--migrate" in said
        assert "…: its document is" in said
    assert stored_of(cell_file).exists()
    assert main(["history", str(cell_file), "--migrate", "--verify"]) == ExitCode.OK
    assert "what only it had was not taken over" in " ".join(capsys.readouterr().err.split())
    assert audit_of(cell_file).read_bytes().startswith(audit)
    assert len(asides_of(cell_file)) == 1
    assert shown(cell_file, capsys) == json.loads((FILES / "history.json").read_text())


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("text", lambda path: path.write_bytes(b"no history" * 1000)),
        ("zeros", lambda path: path.write_bytes(bytes(4096))),
        ("another program's", lambda path: _pragma(path, "application_id = 7")),
        ("a later version", lambda path: _pragma(path, f"user_version = {VERSION + 1}")),
        ("without a table", lambda path: _execute(path, "DROP TABLE event")),
        ("with a time that is none", lambda path: _execute(path, "UPDATE event SET at = ''")),
    ],
)
def test_a_file_that_is_no_history_is_refused_and_kept(
    cell_file: Path, name: str, spoil: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(stored_of(cell_file))
    content = stored_of(cell_file).read_bytes()
    calibration_text = str(calibration_for(cell_file))
    for options in ((), ("--verify",), ("--add", calibration_text)):
        assert main(["history", str(cell_file), *options]) == ExitCode.DATA_UNFIT, name
        error_output = capsys.readouterr().err
        assert "--migrate" in " ".join(error_output.split())
    # The write-back goes on without it: the gains are judged by the calibration and the
    # controller's file.
    assert main(["apply", str(cell_file), str(calibration_for(cell_file))]) == ExitCode.OK
    assert stored_of(cell_file).read_bytes() == content
    assert main(["history", str(cell_file), "--migrate", "--verify"]) == ExitCode.OK
    assert "what only it had was not taken over" in " ".join(capsys.readouterr().err.split())
    (aside,) = asides_of(cell_file)
    assert aside.read_bytes() == content
    assert writers_of(cell_file) == WRITERS


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("calibration", "digest", "x'00'"),
        ("calibration", "entered", "x'00'"),
        ("calibration", "document", "x'00'"),
        ("calibration", "document", "NULL"),
        ("event", "digest", "x'00'"),
        ("event", "deed", "x'00'"),
        ("event", "at", "NULL"),
        ("event", "who", "7"),
        ("event", "target", "x'00'"),
        ("event", "audit", "x'00'"),
        ("event", "sha256_after", "x'00'"),
        ("acknowledgement", "axis", "x'00'"),
        ("acknowledgement", "since", "7"),
        ("acknowledgement", "at", "x'00'"),
        ("acknowledgement", "who", "x'00'"),
        ("acknowledgement", "why", "NULL"),
        ("acknowledgement", "audit", "NULL"),
    ],
)
def test_a_value_that_is_no_text_is_a_row_of_another_program(
    cell_file: Path, table: str, column: str, value: str
) -> None:
    """Tables of drivegain refuse such a value, those of another program may have it."""
    path = stored_of(cell_file)
    columns = {
        "calibration": "digest, created, entered, document",
        "event": "number, digest, deed, at, who, target, audit, sha256_after",
        "acknowledgement": "number, axis, since, at, who, why, audit",
    }[table]
    _execute(
        path,
        f"CREATE TABLE of_any_type AS SELECT {columns} FROM {table}; "
        f"DROP TABLE {table}; CREATE TABLE {table} ({columns}); "
        f"INSERT INTO {table} SELECT * FROM of_any_type; DROP TABLE of_any_type; "
        f"UPDATE {table} SET {column} = {value}",
    )
    with pytest.raises(HistoryUnreadable, match="a row that drivegain did not write: "):
        read_stored(path)


def test_a_sound_file_that_cannot_be_read_now_is_never_put_aside(
    cell_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(migration_module, "BUSY_S", 0.05)
    before = read(audit_of(cell_file))
    with closing(sqlite3.connect(stored_of(cell_file), isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        assert run_verb("history", cell_file, "--migrate") == ExitCode.DATA_UNFIT
    error_output = capsys.readouterr().err
    said = " ".join(error_output.split())
    assert "SQLITE_BUSY" in said
    assert "try again" in said
    assert asides_of(cell_file) == []
    assert read(audit_of(cell_file)) == before
    assert run_verb("history", cell_file, "--migrate", "--verify") == ExitCode.OK
    assert writers_of(cell_file) == WRITERS


@pytest.mark.parametrize(
    "error", [PermissionError(13, "Permission denied"), FileNotFoundError(2, "No such file")]
)
def test_a_file_that_keeps_its_name_keeps_no_calibration_out(
    cell_file: Path,
    error: OSError,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Its folder may be read only, or another process may rename it first."""

    def refuse(path: Path, at: datetime) -> Path:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(ledger_module, "set_aside", refuse)
        calibration_text = str(calibration_for(cell_file, 1.005))
        assert main(["history", str(cell_file), "--add", calibration_text]) == ExitCode.OK
    assert ("keeps its name" in caplog.text) == isinstance(error, PermissionError)
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.OK
    assert len(history_of(cell_file).entries) == 4
    assert len(asides_of(cell_file)) == 1


def _pragma(path: Path, setting: str) -> None:
    _execute(path, f"PRAGMA {setting}")


def _execute(path: Path, statements: str) -> None:
    with closing(sqlite3.connect(path)) as other:
        other.executescript(f"{statements};")
        other.commit()


def test_an_empty_file_is_an_empty_history(cell_file: Path) -> None:
    stored_of(cell_file).write_bytes(b"")
    assert run_verb("history", cell_file, "--verify") == ExitCode.OK
    assert writers_of(cell_file) == WRITERS


@settings(max_examples=30, deadline=None)
@given(random_=st.randoms(use_true_random=False))
def test_a_damaged_file_is_reported_and_never_a_surprise(random_: random.Random) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "h"
        damaged = bytearray((FILES / "demo.history.sqlite").read_bytes())
        for _ in range(random_.randint(1, 400)):
            damaged[random_.randrange(len(damaged))] = random_.randrange(256)
        path.write_bytes(
            damaged[: random_.randint(1, len(damaged))] if random_.random() < 0.3 else damaged
        )
        try:
            read_stored(path)
        except HistoryUnreadable as error:
            assert str(path) in str(error)
            assert "with text" not in str(error)


def test_an_unfinished_transaction_of_a_killed_writer_is_undone_first(cell_file: Path) -> None:
    child = os.fork()
    if child == 0:
        connection = sqlite3.connect(stored_of(cell_file), isolation_level=None)
        # Pages go to the file, and the old ones to the journal, at once
        connection.execute("PRAGMA cache_size = 1")
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("UPDATE calibration SET document = document || zeroblob(100000)")
        connection.execute("DELETE FROM event")
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    journal = stored_of(cell_file).with_name("demo.history.sqlite-journal")
    content = (FILES / "demo.history.sqlite").read_bytes()
    assert journal.stat().st_size
    assert stored_of(cell_file).read_bytes() != content
    # Whatever only reads the history undoes it, too.
    read_history(ledger_of(cell_file))
    assert not journal.exists()
    assert stored_of(cell_file).read_bytes() == content
    assert run_verb("history", cell_file, "--verify") == ExitCode.OK
    assert writers_of(cell_file) == WRITERS
    (aside,) = asides_of(cell_file)
    assert aside.read_bytes() == content


def test_one_that_is_locked_for_long_is_reported(
    cell_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("daq.ledger.migration.BUSY_S", 0.01)
    with closing(sqlite3.connect(stored_of(cell_file), isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        assert run_verb("history", cell_file) == ExitCode.DATA_UNFIT
        error_output = capsys.readouterr().err
        assert "who has it open" in " ".join(error_output.split())
        other.execute("ROLLBACK")
    assert run_verb("history", cell_file) == ExitCode.OK


@pytest.mark.parametrize("lost", ["changed", "deleted", "cut off"])
def test_nothing_is_migrated_into_an_audit_that_was_changed(
    cell_file: Path, lost: str, capsys: pytest.CaptureFixture[str]
) -> None:
    audit = audit_of(cell_file)
    content = audit.read_bytes()
    if lost == "changed":
        audit.write_bytes(content.replace(b'"who":"Ada', b'"who":"Eve', 1))
    elif lost == "cut off":
        lines = content.splitlines(keepends=True)
        audit.write_bytes(b"".join(lines[:4]))
    else:
        audit.unlink()
    stored = stored_of(cell_file).read_bytes()
    for options in (["--migrate"], ["--verify"]):
        assert main(["history", str(cell_file), *options]) == ExitCode.DATA_UNFIT
        assert "demo.audit.jsonl" in capsys.readouterr().err
        assert stored_of(cell_file).read_bytes() == stored
    # What is left is shown all the same, and the write-back goes on.
    assert main(["history", str(cell_file)]) == ExitCode.OK
    calibration_text = str(calibration_for(cell_file, 1.005))
    assert main(["apply", str(cell_file), calibration_text, "--yes"]) == ExitCode.OK
    assert len(history_of(cell_file).entries) == 4
    assert stored_of(cell_file).read_bytes() == stored
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.DATA_UNFIT


def test_a_cell_whose_gains_are_applied_again_knows_the_old_write(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The controller has the gains of Ada's calibration; the audit log names another folder."""
    ledger = ledger_of(cell_file)
    events = read_history(ledger).events
    (first,) = [event for event in events if event.who.startswith("Ada")]
    assert first.action is WriteAction.APPLIED
    in_force = shown(cell_file, capsys)["in_force"]
    assert in_force == first.digest


def test_another_audit_than_the_cells_has_no_history_of_sqlite(
    cell_file: Path, tmp_path: Path
) -> None:
    cell = ledger_of(cell_file).cell
    ledger = Ledger.of(cell, tmp_path / "another.jsonl")
    assert ledger is not None
    assert not ledger.outdated
    assert read_history(ledger).entries == ()
