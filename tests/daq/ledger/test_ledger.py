"""The ledger of a cell: one chain of entries, and the history that is folded from it."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import decode_calibration, encode_calibration
from daq.errors import DataError, ExitCode, OutputFailed, exit_code
from daq.ledger.audit import AuditAction, append, head_file, read, verify
from daq.ledger.fold import Acknowledgement, WriteAction, iso, utc
from daq.ledger.ledger import (
    MAY_LACK,
    Ledger,
    acknowledge,
    enter_calibration,
    read_history,
    record_session,
    record_write,
    verify_ledger,
)
from ident.calibration import Calibration
from tests.daq.calibrations import AXES, calibration_for, demo_calibration
from tests.daq.command_line import run_verb
from tests.daq.file_marks import IMMUTABLE, file_mark
from tests.daq.histories import (
    BEGIN,
    calibration_of,
    digest_of,
    enter,
    history_of,
    ledger_in,
    ledger_of,
    write,
)

FORK = multiprocessing.get_context("fork")
NO_ONE = 65534


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    """An empty ledger."""
    return ledger_in(tmp_path)


def test_without_a_file_it_is_empty_and_makes_none(ledger: Ledger) -> None:
    history = read_history(ledger)
    assert not any((history.entries, history.events, history.acknowledgements))
    assert history.in_force() is None
    assert not ledger.audit.exists()


def test_a_calibration_comes_back_as_it_was(ledger: Ledger) -> None:
    given_ = demo_calibration()
    digest = digest_of(given_)
    assert enter_calibration(ledger, given_, digest=digest, who="anna", at=BEGIN)
    (entry,) = read_history(ledger).entries
    (entered,) = read(ledger.audit)
    document = str(entered.details["document"]).encode()
    assert document == encode_calibration(given_)
    assert decode_calibration(document, "document") == given_
    assert entry.gains == given_.gains
    expected = (digest, "demo", "ml", 14400)
    assert (entry.digest, entry.cell, entry.method, entry.rows) == expected
    assert entry.error_percent == 3.2
    assert entry.holdout_percent == 3.3
    created = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
    assert entry.created == created
    assert entry.entered == BEGIN
    assert not entry.applied


def test_the_same_file_is_entered_once(ledger: Ledger) -> None:
    calibration = calibration_of(0)
    digest = enter(ledger, calibration)
    entered_again = enter_calibration(ledger, calibration, digest=digest, who="anna", at=BEGIN)
    assert not entered_again
    assert len(read(ledger.audit)) == 1
    # Two processes at once may both find that it is not there.
    (entry,) = read(ledger.audit)
    entered = iso(BEGIN + timedelta(hours=1))
    later = {**entry.details, "entered": entered}
    append(ledger.audit, entry.action, at=BEGIN, who="kim", subject=entry.subject, details=later)
    (found,) = read_history(ledger).entries
    assert found.entered == BEGIN


def test_entries_are_in_the_order_in_which_they_were_fitted(ledger: Ledger) -> None:
    def enter_later(calibration: Calibration, days: int) -> None:
        at = BEGIN + timedelta(weeks=4, days=days)
        digest = digest_of(calibration)
        enter_calibration(ledger, calibration, digest=digest, who="anna", at=at)

    for day, week in enumerate((3, 0, 2, 1)):
        enter_later(calibration_of(week), day)
    # Of another time zone, and at another spelling of it.
    hour_later = BEGIN + timedelta(hours=1)
    zone = timezone(-timedelta(hours=9))
    created = hour_later.astimezone(zone).isoformat()
    late = replace(calibration_of(0), created=created)
    enter_later(late, 4)
    entries = read_history(ledger).entries
    found = [entry.created for entry in entries]
    weeks_later = [BEGIN + timedelta(weeks=week) for week in (1, 2, 3)]
    assert found == [BEGIN, hour_later, *weeks_later]


def test_a_calibration_without_a_time_has_that_of_its_entry(ledger: Ledger) -> None:
    timeless = replace(calibration_of(0), created="yesterday")
    digest = "1" * 64
    enter_calibration(ledger, timeless, digest=digest, who="anna", at=BEGIN)
    first_entry = read_history(ledger).entries[0]
    assert first_entry.created == BEGIN


@pytest.mark.parametrize("different", ["cell", "axes", "unit"])
def test_what_cannot_be_compared_is_refused(ledger: Ledger, different: str) -> None:
    known = calibration_of(0)
    changed_calibration = replace(calibration_of(1), cell="another")
    *others, last = known.gains
    in_peak_amperes = replace(last, unit="Nm/A_peak")
    gains = (*others, in_peak_amperes)
    axes = replace(calibration_of(1), gains=known.gains[:5])
    unit = replace(calibration_of(1), gains=gains)
    other = {
        "cell": changed_calibration,
        "axes": axes,
        "unit": unit,
    }[different]
    enter(ledger, known)
    with pytest.raises(DataError) as refused:
        enter(ledger, other)
    entries = read_history(ledger).entries
    assert len(read(ledger.audit)) == 1
    assert len(entries) == 1
    assert exit_code(DataError) == 4
    assert "it was not entered" in refused.value.remedy


def test_the_first_calibration_has_the_axes_of_the_cell(ledger: Ledger) -> None:
    """Those of a history never change: with others, every right calibration would be refused."""
    known = calibration_of(0)
    first, *others = known.gains
    renamed = replace(first, axis="A1")
    of_other_axes = replace(known, gains=(renamed, *others))
    with pytest.raises(DataError) as refused:
        enter(ledger, of_other_axes)
    assert "the axes of the cell file" in refused.value.expected
    assert read_history(ledger).entries == ()
    enter(ledger, known)


def test_what_is_applied_and_rolled_back_is_reported(ledger: Ledger) -> None:
    first = enter(ledger, calibration_of(0))
    second = enter(ledger, calibration_of(1))
    reported = []
    name_of = {None: "-", first: "first", second: "second"}

    def in_force() -> None:
        digest = read_history(ledger).in_force("x.yaml")
        reported.append(name_of[digest])

    write(ledger, "x.yaml", "1", digest=first)
    in_force()
    write(ledger, "x.yaml", "0")
    in_force()
    write(ledger, "x.yaml", "1")  # undoes the rollback
    in_force()
    write(ledger, "x.yaml", "2", digest=second)
    in_force()
    write(ledger, "another.yaml", "1", digest=second)
    write(ledger, "x.yaml", "1")
    in_force()
    expected = ["first", "-", "first", "second", "first"]
    assert reported == expected
    history = read_history(ledger)
    assert history.in_force("another.yaml") == second
    assert history.in_force() == first
    events = history.entries[0].events
    actions = [event.action for event in events]
    assert actions == [
        WriteAction.APPLIED,
        WriteAction.ROLLED_BACK,
        WriteAction.ROLLED_BACK,
    ]
    for entry in history.entries:
        assert entry.applied


def test_what_a_person_entered_between_two_writes_is_no_calibration(ledger: Ledger) -> None:
    """The target of a rollback follows from the content, not from the order of the writes."""
    first = enter(ledger, calibration_of(0))
    second = enter(ledger, calibration_of(1))
    write(ledger, "x.yaml", "1", digest=first)
    write(ledger, "x.yaml", "2", digest=second)  # over what was entered by hand
    write(ledger, "x.yaml", "entered by hand")
    assert read_history(ledger).in_force("x.yaml") is None
    write(ledger, "x.yaml", "2")
    assert read_history(ledger).in_force("x.yaml") == second


def test_acknowledgements_come_back(ledger: Ledger) -> None:
    later = BEGIN + timedelta(days=1)
    acknowledge(ledger, "J4", since=BEGIN, at=later, who="anna", why="gearbox — changed")
    (entry,) = read(ledger.audit)
    expected = Acknowledgement("J4", BEGIN, later, "anna", "gearbox — changed", entry.sha256)
    assert read_history(ledger).acknowledgements == (expected,)


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(
    st.datetimes(
        min_value=datetime(2, 1, 1), max_value=datetime(9998, 1, 1), timezones=st.timezones()
    )
)
def test_times_are_kept_in_utc_in_their_order(at: datetime) -> None:
    kept = iso(at)
    # Of a time that a clock shows twice, or never, Python says that it equals none.
    at = at.astimezone(UTC)
    assert utc(kept, BEGIN) == at
    assert len(kept) == len(iso(BEGIN))
    assert kept.endswith("+00:00")
    assert (kept < iso(BEGIN)) == (at < BEGIN)


def test_a_time_without_its_zone_is_refused(ledger: Ledger) -> None:
    calibration = calibration_of(0)
    digest = "0" * 64
    without_zone = datetime(2026, 1, 1)
    with pytest.raises(ValueError, match="zone"):
        enter_calibration(ledger, calibration, digest=digest, who="anna", at=without_zone)
    assert read_history(ledger).entries == ()


def test_a_step_of_a_write_is_no_step_of_a_session(ledger: Ledger) -> None:
    given_: dict[str, Any] = {"at": BEGIN, "who": "anna", "subject": "x", "details": {}}
    with pytest.raises(ValueError, match="no step of a session"):
        record_session(ledger.audit, AuditAction.APPLIED, **given_)
    with pytest.raises(ValueError, match="no step of a write"):
        record_write(ledger.audit, AuditAction.RECALIBRATION_ENDED, **given_)
    assert not ledger.audit.exists()


def _write_on(folder: Path, week: int, written: Any, begun: Any) -> None:
    ledger = ledger_in(folder)
    digest = enter(ledger, calibration_of(week))
    begun.set()
    while True:
        write(ledger, "x.yaml", "1", digest=digest)
        written.value += 1


@pytest.mark.slow
def test_a_writer_killed_at_any_moment_leaves_a_whole_history(tmp_path: Path) -> None:
    """Ended writes are there, others are not, and none is half."""
    rng = random.Random(7)
    written = FORK.RawValue("i", 0)  # without a lock, which a killed writer would keep
    known = 0
    for week in range(20):
        begun = FORK.Event()
        writer = FORK.Process(target=_write_on, args=(tmp_path, week, written, begun))
        writer.start()
        assert begun.wait(60)
        writer.join(rng.uniform(0.0, 0.05))
        assert writer.pid is not None
        os.kill(writer.pid, signal.SIGKILL)
        writer.join()
        assert writer.exitcode == -signal.SIGKILL
        ledger = ledger_in(tmp_path)
        assert verify(ledger.audit).holds
        history = read_history(ledger)
        assert len(history.entries) == week + 1
        for entry in history.entries:
            axes = [gain.axis for gain in entry.gains]
            assert axes == list(AXES)
        # One may have been ended whose writer did not live to say so.
        event_count = len(history.events)
        assert known <= written.value <= event_count <= written.value + 1
        written.value = event_count
        known = event_count


def _add_many(folder: Path, weeks: range) -> None:
    for week in weeks:
        enter(ledger_in(folder), calibration_of(week))


@pytest.mark.slow
def test_two_processes_at_once_lose_nothing(tmp_path: Path) -> None:
    writers = []
    for first in (0, 10, 20):
        weeks = range(first, 30)
        writers.append(FORK.Process(target=_add_many, args=(tmp_path, weeks)))
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    exit_codes = [writer.exitcode for writer in writers]
    assert exit_codes == [0, 0, 0]
    ledger = ledger_in(tmp_path)
    assert verify(ledger.audit).holds
    assert len(read_history(ledger).entries) == 30


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


def test_where_nothing_can_be_written_reading_works(ledger: Ledger) -> None:
    enter(ledger, calibration_of(0))
    ledger.audit.chmod(0o444)
    ledger.audit.parent.chmod(0o555)
    for folder in ledger.audit.parents[1:4]:
        st_mode = folder.stat().st_mode
        folder.chmod(st_mode | 0o011)
    try:
        with _no_one():
            assert len(read_history(ledger).entries) == 1
            with pytest.raises(OutputFailed):
                enter(ledger, calibration_of(1))
        assert len(read_history(ledger).entries) == 1
    finally:
        ledger.audit.parent.chmod(0o755)


def test_a_folder_that_is_not_there_is_reported(tmp_path: Path) -> None:
    folder = tmp_path / "none"
    with pytest.raises(OutputFailed):
        enter(ledger_in(folder), calibration_of(0))


def test_a_folder_may_have_any_name(tmp_path: Path) -> None:
    name = os.fsdecode(b"b\xff ?#%")
    folder = tmp_path / name
    folder.mkdir()
    digest = enter(ledger_in(folder), calibration_of(0))
    entries = read_history(ledger_in(folder)).entries
    digests = [one.digest for one in entries]
    assert digests == [digest]


def test_a_write_of_a_killed_process_is_entered_by_the_next_one(cell_file: Path) -> None:
    """The controller has its content, and no entry ends it."""
    ledger = ledger_of(cell_file)
    digest = enter(ledger, calibration_of(0))
    controller = load_cell(cell_file).controller_path
    assert controller is not None
    controller.write_bytes(b"new")
    subject = str(controller.resolve())
    calibration = {"sha256": digest, "cell": "demo"}
    details = {
        "sha256_before": "0" * 64,
        "sha256_after": "11507a0e2f5e69d5dfa40a62a1bd7b6ee57e6bcd85c67c9b8431b36fff21c437",
        "calibration": calibration,
    }
    append(
        ledger.audit,
        AuditAction.APPLY_BEGUN,
        at=BEGIN,
        who="anna",
        subject=subject,
        details=details,
    )
    assert history_of(cell_file).events == ()  # a history does not depend on what a file is today
    assert run_verb("history", cell_file, "--verify") == 4
    for _ in range(2):
        enter(ledger, calibration_of(0))
        events = history_of(cell_file).events
        (event,) = events
        assert event.who == "anna"
        assert event.at == BEGIN
        actions = [entry.action for entry in read(ledger.audit)]
        assert actions.count(AuditAction.WRITE_FOUND) == 1
    assert run_verb("history", cell_file, "--verify") == 0
    controller.write_bytes(b"edited")
    assert len(history_of(cell_file).events) == 1
    # Its writer was not killed after all, only late.
    append(
        ledger.audit,
        AuditAction.APPLIED,
        at=BEGIN,
        who="anna",
        subject=subject,
        details={"begun": 2},
    )
    assert len(history_of(cell_file).events) == 1


def test_the_next_write_proves_the_killed_one_before_it(cell_file: Path) -> None:
    ledger = ledger_of(cell_file)
    first = enter(ledger, calibration_of(0))
    second = enter(ledger, calibration_of(1))
    subject = str(load_cell(cell_file).controller_path)
    calibration = {"sha256": first, "cell": "demo"}
    details = {"sha256_before": "0" * 64, "sha256_after": "1" * 64, "calibration": calibration}
    append(
        ledger.audit,
        AuditAction.APPLY_BEGUN,
        at=BEGIN,
        who="anna",
        subject=subject,
        details=details,
    )
    write(ledger, subject, "2" * 64, digest=second, before="1" * 64)
    events = history_of(cell_file).events
    digests = [event.digest for event in events]
    assert digests == [first, second]
    write(ledger, subject, "1" * 64, before="2" * 64)
    assert history_of(cell_file).in_force(subject) == first
    assert run_verb("history", cell_file, "--verify") == 0


def test_another_cell_of_the_same_audit_has_its_own(cell_file: Path) -> None:
    ledger = ledger_of(cell_file)
    subject = str(load_cell(cell_file).controller_path)
    digest = enter(ledger, calibration_of(0))
    write(ledger, subject, "0" * 64, digest=digest)
    before = history_of(cell_file)
    calibration = {"sha256": "2" * 64, "cell": "another"}
    details = {"sha256_after": "1" * 64, "calibration": calibration}
    begun = append(
        ledger.audit, AuditAction.APPLY_BEGUN, at=BEGIN, who="ben", subject=subject, details=details
    )
    applied = {"begun": begun.number}
    entered = {"cell": "another", "sha256": "2" * 64, "entered": "x", "document": "y"}
    since = BEGIN.isoformat()
    acknowledged = {"cell": "another", "axis": "J4", "since": since, "why": "z"}
    details_of_action: dict[AuditAction, dict[str, Any]] = {
        AuditAction.APPLIED: applied,
        AuditAction.CALIBRATION_ENTERED: entered,
        AuditAction.ACKNOWLEDGED: acknowledged,
    }
    for action, more in details_of_action.items():
        append(ledger.audit, action, at=BEGIN, who="ben", subject=subject, details=more)
    assert history_of(cell_file) == before


def test_a_calibration_that_cannot_be_read_is_a_finding(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another program entered it, or a later version."""
    ledger = ledger_of(cell_file)
    enter(ledger, calibration_of(0))
    unreadable: list[dict[str, object]] = [
        {"document": "no calibration"},
        {"figures": {"gains": 1}},
    ]
    for number, more in enumerate(unreadable):
        sha256 = f"{number}" * 64
        details = {"cell": "demo", "sha256": sha256, "entered": iso(BEGIN), **more}
        append(
            ledger.audit,
            AuditAction.CALIBRATION_ENTERED,
            at=BEGIN,
            who="ben",
            subject="x",
            details=details,
        )
    assert len(history_of(cell_file).entries) == 1
    assert run_verb("history", cell_file, "--verify") == 4
    error_output = capsys.readouterr().err
    said = " ".join(error_output.split())
    assert "calibration 000000000000… of entry 2: its document is" in said
    assert "calibration 111111111111… of entry 3: its figures are not those" in said


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["edited", "first removed", "end cut off", "deleted"])
def test_a_damaged_log_is_reported_by_each_command_that_reads_or_adds_to_it(
    cell_file: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A calibration that is missing changes the judgement of a gain and of its drift."""
    for factor in (1.0, 1.02, 1.01):
        calibration_text = str(calibration_for(cell_file, factor))
        code = main(["apply", str(cell_file), calibration_text, "--yes"])
        assert code == ExitCode.OK
    ledger = ledger_of(cell_file)
    assert not read_history(ledger).may_lack
    lines = ledger.audit.read_bytes().splitlines(keepends=True)
    changed_line = lines[0].replace(b"demo", b"dema", 1)
    without_first = lines[1:]
    damaged = {
        "edited": [changed_line, *without_first],
        "first removed": without_first,
        "end cut off": lines[:-1],
        "deleted": [],
    }
    content = b"".join(damaged[damage])
    ledger.audit.write_bytes(content)
    if damage == "deleted":
        ledger.audit.unlink()
    assert read_history(ledger).may_lack
    assert verify_ledger(ledger).history.may_lack
    calibration = str(calibration_for(cell_file, 1.005))
    cell = str(cell_file)
    apply = ["apply", cell, calibration]
    history = ["history", cell]
    rollback = ["rollback", cell]
    for command in (apply, history, rollback):
        caplog.clear()
        assert main(command) == ExitCode.OK
        assert MAY_LACK in caplog.text


@pytest.mark.parametrize("cut_bytes", [20, 300])
def test_verify_of_a_torn_noted_entry_names_it_before_and_after_the_next_entry(
    cell_file: Path, cut_bytes: int, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = calibration_for(cell_file)
    assert run_verb("history", cell_file, "--add", calibration) == ExitCode.OK
    path = ledger_of(cell_file).audit
    lost = read(path)[-1].sha256
    content = path.read_bytes()
    path.write_bytes(content[:-cut_bytes])
    for factor in (1.01, 1.02):
        capsys.readouterr()
        assert run_verb("history", cell_file, "--verify") == ExitCode.DATA_UNFIT
        captured = capsys.readouterr()
        printed = " ".join(captured.out.split())
        error_output = " ".join(captured.err.split())
        assert "chain BROKEN" in printed
        assert "They are no flaw" not in printed
        assert lost[:12] in error_output
        assert "A power failure" in error_output
        assert "trust the controller's file" not in error_output
        later = calibration_for(cell_file, factor)
        assert run_verb("history", cell_file, "--add", later) == ExitCode.OK


def test_a_log_without_its_note_is_said_to_be_one(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration_text = str(calibration_for(cell_file))
    assert run_verb("history", cell_file, "--add", calibration_text) == ExitCode.OK
    note = head_file(ledger_of(cell_file).audit)
    for spoil in (note.unlink, lambda: note.write_text("no digest\n")):
        spoil()
        assert run_verb("history", cell_file, "--verify") == ExitCode.OK
        printed = capsys.readouterr().out
        assert ("a missing end of the audit log would not be noticed") in " ".join(printed.split())
    code = run_verb("history", cell_file, "--add", calibration_for(cell_file, 1.01))
    assert code == ExitCode.OK
    capsys.readouterr()
    assert run_verb("history", cell_file, "--verify") == ExitCode.OK
    assert "cannot be seen" not in capsys.readouterr().out


@contextmanager
def _note_that_cannot_be_written(note: Path, kind: str) -> Iterator[None]:
    """Let the next entry not be noted next to the audit log."""
    if kind == "immutable":
        with file_mark(note, IMMUTABLE):
            yield
        return
    note.unlink()
    if kind == "folder":
        note.mkdir()
    elif kind == "pipe":
        os.mkfifo(note)
    else:
        note.symlink_to("elsewhere")
    yield


def _write_as_shown(
    verb: list[str],
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Make the change that a verb shows in its dry run; of a rollback it has no base."""
    capsys.readouterr()
    assert main(verb) == ExitCode.OK
    shown = re.search(r"--base \S+", capsys.readouterr().out)
    base = shown[0].split() if shown else []
    caplog.clear()
    assert main([*verb, "--yes", *base]) == ExitCode.OK


@pytest.mark.parametrize(
    ("kind", "remedy"),
    [
        ("immutable", "marked as immutable or append-only): a missing end"),
        ("folder", "remove what has its name"),
        ("pipe", "remove what has its name"),
        ("link", "remove what has its name"),
    ],
)
def test_an_entry_that_cannot_be_noted_is_said_once_by_each_verb(
    cell_file: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    kind: str,
    remedy: str,
) -> None:
    """`rollback` and `apply` said nothing, and neither did `--verify`."""
    calibration = str(calibration_for(cell_file))
    _write_as_shown(["apply", str(cell_file), calibration], capsys, caplog)
    note = head_file(ledger_of(cell_file).audit)
    verbs = (["rollback", str(cell_file)], ["apply", str(cell_file), calibration])
    with _note_that_cannot_be_written(note, kind):
        for verb in verbs:
            _write_as_shown(verb, capsys, caplog)
            count = caplog.text.count(f"cannot be noted in {note}")
            assert count == 1, verb[0]
            assert remedy in caplog.text
        capsys.readouterr()
        assert run_verb("history", cell_file, "--verify") == ExitCode.OK
        printed = " ".join(capsys.readouterr().out.split())
        assert "NOT NOTED: the digest of the last entry cannot be noted in" in printed
        assert "The next entry writes it again" not in printed
        assert run_verb("history", cell_file, "--verify", "--json") == ExitCode.OK
        audit = json.loads(capsys.readouterr().out)["audit"]
        assert audit["noted"] is False
        assert "cannot be noted in" in audit["not_noted"]


def test_a_path_that_is_not_utf_8_is_in_the_history(
    cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = "/other/ctl\udcff.yaml"
    ledger = ledger_of(cell_file)
    subject = str(load_cell(cell_file).controller_path)
    first = enter(ledger, calibration_of(0))
    write(ledger, other, "1" * 64, digest=first)
    digest = enter(ledger, calibration_of(1))
    write(ledger, subject, "2" * 64, digest=digest)
    acknowledge(ledger, "J4", since=BEGIN, at=BEGIN, who="anna", why="gearbox \udcff")
    history = history_of(cell_file)
    targets = [event.target for event in history.events]
    assert targets == [other, subject]
    assert history.in_force(other) == first
    assert run_verb("history", cell_file, "--verify") == 0
    table = str(cell_file.with_suffix(".csv"))
    for arguments in (["--axis", "J4"], ["--json"], ["--csv", table]):
        assert run_verb("history", cell_file, *arguments) == 0
    assert "ctl\udcff" not in capsys.readouterr().out
