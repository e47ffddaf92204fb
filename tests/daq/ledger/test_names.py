"""A history is of one robot: another one of its name is left out and named,
and a renamed cell keeps its history.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.same_cell import calibrated_robot
from daq.documents.calibration_file import save_calibration
from daq.documents.session_state import GuidedState
from daq.errors import DataError, ExitCode
from daq.files import sha256
from daq.jobs.position import sessions_folder
from daq.jobs.session import Basis, begin, rename_sessions, sessions
from daq.ledger import ledger as ledger_module
from daq.ledger.audit import AuditAction, append, read, verify
from daq.ledger.fold import figures_of
from daq.ledger.ledger import (
    Ledger,
    acknowledge,
    enter_calibration,
    plan_rename,
    present_name,
    read_history,
    read_standing,
    record_session,
    rename_cell,
    verify_ledger,
)
from daq.ledger.names import drives_of, former_names
from daq.ledger.watch import watch
from ident.calibration import Calibration
from tests.daq.histories import BEGIN, calibration_of, digest_of, ledger_in, write
from tests.daq.killing import killed_where

LATER = BEGIN + timedelta(weeks=10)
FALLEN = (1.0, 1.0, 1.0, 0.8, 1.0, 1.0)  #: Gain of J4, 20 % less


def _other_robot(cell: Cell) -> Cell:
    """The same cell with another drive on J4."""
    axis = cell.axes[3]
    assert axis.identity is not None
    identity = replace(axis.identity, product_code=0x40300)
    exchanged = replace(axis, identity=identity)
    axes = (*cell.axes[:3], exchanged, *cell.axes[4:])
    return replace(cell, axes=axes)


def _made(cell: Cell, week: int, factors: tuple[float, ...] = (1.0,) * 6) -> Calibration:
    """A calibration that names its robot."""
    return replace(calibration_of(week, factors), cell=cell.name, robot=calibrated_robot(cell))


def _enter(ledger: Ledger, calibration: Calibration, week: int) -> str:
    digest = digest_of(calibration)
    at = BEGIN + timedelta(weeks=week)
    enter_calibration(ledger, calibration, digest=digest, who="anna", at=at)
    return digest


def _named(ledger: Ledger, name: str) -> Ledger:
    cell = replace(ledger.cell, name=name)
    return replace(ledger, cell=cell)


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    """An empty ledger of the demo cell."""
    return ledger_in(tmp_path)


@pytest.fixture
def renamed(ledger: Ledger) -> Ledger:
    """The ledger of cell `press`, which was called demo and has three calibrations,
    a write and a session.
    """
    digests = [_enter(ledger, _made(ledger.cell, week), week) for week in range(3)]
    write(ledger, drives_of("demo"), sha256(b"1"), digest=digests[0], at=BEGIN)
    acknowledge(ledger, "J1", since=BEGIN, at=BEGIN, who="anna", why="new gearbox")
    details = {"session": "s", "cell": "demo", "calibration_sha256": digests[0]}
    record_session(
        ledger.audit, AuditAction.ACCEPTED, at=BEGIN, who="anna", subject="s", details=details
    )
    return _named(ledger, "press")


def test_no_drift_is_computed_over_two_robots(ledger: Ledger) -> None:
    for week in range(3):
        calibration = _made(ledger.cell, week)
        _enter(ledger, calibration, week)
    cell = _other_robot(ledger.cell)
    other = replace(ledger, cell=cell)
    with pytest.raises(
        DataError,
        match=r"drive of J4 with product code 0x40200; expected "
        r".*0x40300",
    ):
        _enter(other, _made(other.cell, 3, FALLEN), 3)
    history = read_history(other)
    assert history.entries == ()
    assert watch(history.entries, history.acknowledgements) == ()
    entries = read_history(ledger).entries
    expected = [one.digest for one in entries]
    digests = [one.entry.digest for one in history.other_robots]
    assert digests == expected
    said = str(history.other_robots[0])
    assert (
        "is of another robot with the cell name 'demo': found drive of J4 with product code 0x40200"
    ) in said
    assert "expected drive of J4 with product code 0x40300, as in the cell file" in said
    assert verify_ledger(other).unknown == ()


def test_a_calibration_of_another_robot_is_not_entered(ledger: Ledger) -> None:
    calibration = _made(ledger.cell, 0)
    _enter(ledger, calibration, 0)
    cell = _other_robot(ledger.cell)
    with pytest.raises(DataError, match="another robot with the cell name 'demo'"):
        _enter(ledger, _made(cell, 1, FALLEN), 1)
    assert len(read(ledger.audit)) == 1


def test_calibrations_of_earlier_versions_are_compared_as_before(ledger: Ledger) -> None:
    _enter(ledger, calibration_of(0), 0)
    calibration = _made(ledger.cell, 1)
    _enter(ledger, calibration, 1)
    history = read_history(ledger)
    assert [entry.robot is None for entry in history.entries] == [True, False]
    assert history.other_robots == ()


def test_a_renamed_cell_has_its_history_under_the_new_name(ledger: Ledger, renamed: Ledger) -> None:
    before = read_history(ledger)
    lines = ledger.audit.read_bytes()
    assert read_history(renamed).entries == ()
    assert read_history(renamed).possible_names == ("demo",)
    planned = plan_rename(renamed, "demo")
    expected = (3, 1, 1, 0)
    assert (
        planned.calibrations,
        planned.writes,
        planned.acknowledgements,
        planned.undescribed,
    ) == expected
    assert ledger.audit.read_bytes() == lines
    rename_cell(renamed, planned, who="anna", at=LATER)
    # The chain is what it was, and one entry longer.
    assert ledger.audit.read_bytes().startswith(lines)
    assert verify(ledger.audit).holds
    action = read(ledger.audit)[-1].action
    assert action is AuditAction.RENAMED
    after = read_history(renamed)
    changed_entries = [replace(entry, cell="demo", events=()) for entry in after.entries]
    changed_entries_expected = [replace(entry, events=()) for entry in before.entries]
    assert changed_entries == changed_entries_expected
    targets = [event.target for event in after.events]
    assert targets == [drives_of("press")]
    assert after.acknowledgements == before.acknowledgements
    assert after.acceptances == before.acceptances
    assert after.in_force(drives_of("press")) == before.entries[0].digest
    digest = before.entries[0].digest
    standing = read_standing(renamed, digest, LATER)
    assert standing.state.value == "accepted"
    assert verify_ledger(renamed).complete
    # A change is judged against the baseline of the old name.
    calibration = _made(renamed.cell, 11, FALLEN)
    _enter(renamed, calibration, 11)
    history = read_history(renamed)
    (of_j4,) = [one for one in watch(history.entries, history.acknowledgements) if one.axis == "J4"]
    assert len(of_j4.points) == 4
    assert of_j4.alarmed


def test_what_is_entered_under_the_old_name_later_is_of_another_cell(
    ledger: Ledger, renamed: Ledger
) -> None:
    planned = plan_rename(renamed, "demo")
    rename_cell(renamed, planned, who="anna", at=LATER)
    # The same robot, by a cell file that still has the old name.
    calibration = _made(ledger.cell, 11)
    with pytest.raises(DataError, match=r"'demo', which this robot had until .*expected 'press'"):
        _enter(ledger, calibration, 11)
    # Another robot may take the name.
    cell = _other_robot(ledger.cell)
    other = replace(ledger, cell=cell)
    digest = _enter(other, _made(other.cell, 12), 12)
    entries = read_history(other).entries
    digests = [entry.digest for entry in entries]
    assert digests == [digest]
    assert len(read_history(renamed).entries) == 3


def test_a_cell_may_be_renamed_twice_and_back(ledger: Ledger, renamed: Ledger) -> None:
    planned = plan_rename(renamed, "demo")
    rename_cell(renamed, planned, who="anna", at=LATER)
    third = _named(ledger, "press-4")
    rename = plan_rename(third, "press")
    rename_cell(third, rename, who="anna", at=LATER)
    assert len(read_history(third).entries) == 3
    back = plan_rename(ledger, "press-4")
    rename_cell(ledger, back, who="anna", at=LATER)
    assert len(read_history(ledger).entries) == 3
    assert read_history(ledger).renamed is None
    for left in (renamed, third):
        history = read_history(left)
        assert history.entries == ()
        assert history.renamed is not None


def _rename(ledger: Ledger, old: str, week: int) -> None:
    planned = plan_rename(ledger, old)
    rename_cell(ledger, planned, who="anna", at=BEGIN + timedelta(weeks=week))


def test_a_name_that_a_rename_has_freed_may_be_that_of_another_cell(ledger: Ledger) -> None:
    """The name that one robot had is another one's by now: each keeps its own calibrations."""
    first = ledger
    second = _named(ledger, "press")
    calibration = _made(first.cell, 0)
    of_first = _enter(first, calibration, 0)
    of_second = _enter(second, _made(second.cell, 1, FALLEN), 1)
    line = _named(ledger, "line")
    _rename(line, "press", 2)
    press = _named(ledger, "press")
    _rename(press, "demo", 3)
    digests = [entry.digest for entry in read_history(press).entries]
    assert digests == [of_first]
    assert [entry.digest for entry in read_history(line).entries] == [of_second]
    entries = read(press.audit)
    assert former_names(entries, "press") == {"demo"}
    assert former_names(entries, "line") == {"press"}
    again = plan_rename(press, "demo")
    expected = BEGIN + timedelta(weeks=3)
    assert again.entered_at == expected


def test_a_job_that_was_held_for_its_old_name_is_no_history_of_that_name(renamed: Ledger) -> None:
    _rename(renamed, "demo", 11)
    before = len(read(renamed.audit))
    began = AuditAction.RECALIBRATION_BEGUN
    record_session(
        renamed.audit, began, at=LATER, who="timer", subject="s", details={"cell": "demo"}
    )
    planned = plan_rename(renamed, "demo")
    assert planned.entered_at is not None
    rename_cell(renamed, planned, who="anna", at=LATER)
    assert len(read(renamed.audit)) == before + 1


def test_a_rename_to_the_name_of_another_robot_is_refused(ledger: Ledger) -> None:
    press = _named(ledger, "press")
    calibration = _made(ledger.cell, 0)
    _enter(ledger, calibration, 0)
    cell = _other_robot(press.cell)
    other = replace(press, cell=cell)
    _enter(other, _made(other.cell, 0), 0)
    lines = ledger.audit.read_bytes()
    for wanted, name in ((press, "press"), (other, "demo")):
        with pytest.raises(
            DataError, match=f"another robot with the cell name '{name}': found drive of J4"
        ):
            plan_rename(wanted, "demo")
    assert ledger.audit.read_bytes() == lines


def test_a_name_that_the_log_does_not_have_is_refused_with_those_that_it_has(
    renamed: Ledger,
) -> None:
    with pytest.raises(DataError, match="nothing of a cell 'dmeo'; cells in it: 'demo'"):
        plan_rename(renamed, "dmeo")


def test_nothing_is_renamed_in_a_log_that_was_changed(renamed: Ledger) -> None:
    changed_content = renamed.audit.read_bytes().replace(b"new gearbox", b"old gearbox")
    renamed.audit.write_bytes(changed_content)
    with pytest.raises(DataError, match="not what was written"):
        plan_rename(renamed, "demo")


def _sessions_of(folder: Path, cell: str, count: int) -> None:
    for number in range(count):
        configuration_sha256 = "c" * 64
        basis = Basis(cell, configuration_sha256, "")
        now = BEGIN + timedelta(days=number)
        begin(folder, basis, now, GuidedState)


def test_sessions_get_the_new_name_unless_they_began_after_the_rename(tmp_path: Path) -> None:
    _sessions_of(tmp_path, "demo", 3)
    _sessions_of(tmp_path, "gantry", 1)
    until = BEGIN + timedelta(days=1)
    folders = [tmp_path, tmp_path / "none"]
    count = rename_sessions(folders, "demo", "press", until)
    assert count == 2
    assert len(sessions(tmp_path, "press")) == 2
    assert len(sessions(tmp_path, "demo")) == 1
    assert len(sessions(tmp_path, "gantry")) == 1


@pytest.mark.slow
def test_a_rename_that_is_killed_at_any_system_call_is_completed_by_the_next_one(
    tmp_path: Path,
) -> None:
    """Kill it at every eighth call: before the entry, in the middle of the sessions,
    and behind them.
    """

    def prepared(folder: Path) -> tuple[Ledger, Callable[[], int]]:
        folder.mkdir()
        ledger = ledger_in(folder)
        calibration = _made(ledger.cell, 0)
        _enter(ledger, calibration, 0)
        _sessions_of(folder / "sessions", "demo", 3)
        press = _named(ledger, "press")

        def rename() -> int:
            planned = plan_rename(press, "demo")
            rename_cell(press, planned, who="anna", at=LATER)
            folders = [folder / "sessions"]
            rename_sessions(folders, "demo", "press", planned.entered_at or LATER)
            return 0

        return press, rename

    _, warm_up = prepared(tmp_path / "warm")
    warm_up()  # nothing is left to import
    states = set()
    call = 1
    while True:
        folder = tmp_path / str(call)
        press, rename = prepared(folder)
        killed = killed_where(lambda number, last=call: number >= last, rename)  # type: ignore[misc]
        assert verify(press.audit).holds
        has_entry = read_history(press).entries != ()
        done = len(sessions(folder / "sessions", "press"))
        states.add((has_entry, done))
        assert len(sessions(folder / "sessions")) == 3
        assert has_entry or done == 0
        rename()
        assert len(read_history(press).entries) == 1
        assert len(sessions(folder / "sessions", "press")) == 3
        assert sum(one.action is AuditAction.RENAMED for one in read(press.audit)) == 1
        if not killed:
            break
        call += 8
    assert {(False, 0), (True, 3)} <= states
    assert states & {(True, 0), (True, 1), (True, 2)}


@pytest.fixture
def cell_file(checkout: Path, tmp_path: Path) -> Path:
    """A demo cell, with two calibrations and a guided session under its name."""
    text = (
        (checkout / "configs/cells/demo.yaml")
        .read_text(encoding="utf-8")
        .replace("../", f"{checkout}/configs/")
    )
    path = tmp_path / "cell.yaml"
    path.write_text(text, encoding="utf-8")
    ledger = Ledger.of(load_cell(path))
    assert ledger is not None
    for week in range(2):
        calibration = _made(ledger.cell, week)
        _enter(ledger, calibration, week)
    _sessions_of(sessions_folder(path), "demo", 1)
    return path


def test_the_verb_shows_a_rename_and_makes_it_with_yes(
    cell_file: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    text = cell_file.read_text(encoding="utf-8")
    cell_file.write_text(text.replace("name: demo", "name: press", 1))
    audit = cell_file.with_name("cell.audit.jsonl")
    lines = audit.read_bytes()
    assert main(["history", str(cell_file)]) == ExitCode.OK
    assert f"`drivegain history {cell_file} --rename demo`" in caplog.text
    capsys.readouterr()
    assert main(["history", str(cell_file), "--rename", "demo"]) == ExitCode.OK
    error_output = capsys.readouterr().err
    said = " ".join(error_output.split())
    assert (
        "Would rename 'demo' to 'press': 2 calibrations, 0 writes, 0 explained changes, 1 session."
    ) in said
    assert audit.read_bytes() == lines
    assert len(sessions(sessions_folder(cell_file), "demo")) == 1
    assert main(["history", str(cell_file), "--rename", "demo", "--yes", "--json"]) == ExitCode.OK
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    assert document["calibrations"] == 2
    assert "drivegain-recalibrate-demo.timer" in captured.err
    assert len(sessions(sessions_folder(cell_file), "press")) == 1
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.OK
    press = load_cell(cell_file)
    assert present_name(press, "demo", BEGIN) == "press"
    assert present_name(press, "demo", datetime.now(UTC)) == "demo"
    assert present_name(press, "press", BEGIN) == "press"
    # A copy of the cell file with the old name, as a schedule may have.
    changed_text = cell_file.read_text(encoding="utf-8").replace("name: press", "name: demo", 1)
    cell_file.write_text(changed_text)
    assert main(["history", str(cell_file)]) == ExitCode.OK
    assert "this cell was renamed: found the name 'demo', expected 'press'" in caplog.text
    assert "if it is another robot, give it another name, or another audit log" in caplog.text


def test_a_twin_that_takes_a_freed_name_learns_how_to_begin_its_own_history(
    ledger: Ledger, renamed: Ledger
) -> None:
    planned = plan_rename(renamed, "demo")
    rename_cell(renamed, planned, who="anna", at=LATER)
    twin = _made(ledger.cell, 12)
    with pytest.raises(DataError, match="which this robot had until") as caught:
        _enter(ledger, twin, 12)
    assert "if it is another robot, give it another name, or another audit log" in str(caught.value)
    # Either way is one that works.
    named = _named(ledger, "twin")
    calibration = replace(twin, cell="twin")
    _enter(named, calibration, 12)
    assert len(read_history(named).entries) == 1
    audit = ledger.audit.with_name("twin.audit.jsonl")
    elsewhere = replace(ledger, audit=audit)
    _enter(elsewhere, twin, 12)
    assert len(read_history(elsewhere).entries) == 1
    assert read_history(elsewhere).renamed is None


def test_a_rename_finds_the_sessions_that_a_cell_file_of_another_name_has_left(
    cell_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = cell_file.read_text(encoding="utf-8").replace("name: demo", "name: press", 1)
    text = text.replace("name: press", "name: press\nhistory: {audit: cell.audit.jsonl}", 1)
    press = cell_file.with_name("press.yaml")
    cell_file.rename(press)
    press.write_text(text, encoding="utf-8")
    left_behind = sessions_folder(cell_file)
    elsewhere = tmp_path / "elsewhere"
    _sessions_of(elsewhere, "demo", 1)
    # Beside its own cell file, which is still there, a session is of that one.
    others = tmp_path / "other.sessions"
    _sessions_of(others, "demo", 1)
    others.with_suffix(".yaml").touch()
    absent = ["--rename", "demo", "--sessions", str(tmp_path / "absent")]
    assert main(["history", str(press), *absent]) == ExitCode.USAGE
    options = ["--rename", "demo", "--sessions", str(elsewhere)]
    assert main(["history", str(press), *options]) == ExitCode.OK
    error_output = capsys.readouterr().err
    said = " ".join(error_output.split())
    assert "2 sessions. Nothing was renamed; --yes does it." in said
    assert main(["history", str(press), *options, "--yes"]) == ExitCode.OK
    said = " ".join(capsys.readouterr().err.split())
    assert f"1 session in {left_behind}, where `drivegain calibrate` looks with --sessions" in said
    assert len(sessions(left_behind, "press")) == 1
    assert len(sessions(elsewhere, "press")) == 1
    assert len(sessions(others, "demo")) == 1


def test_who_adds_or_renames_is_recorded(cell_file: Path) -> None:
    added = cell_file.with_name("calibration.yaml")
    calibration = _made(load_cell(cell_file), 5)
    save_calibration(calibration, added)
    audit = cell_file.with_name("cell.audit.jsonl")
    assert main(["history", str(cell_file), "--add", str(added), "--by", "Ada"]) == ExitCode.OK
    action = read(audit)[-1].action
    assert action is AuditAction.CALIBRATION_ENTERED
    assert read(audit)[-1].who.startswith("Ada")
    text = cell_file.read_text(encoding="utf-8").replace("name: demo", "name: press", 1)
    cell_file.write_text(text, encoding="utf-8")
    rename = ["--rename", "demo", "--yes", "--by", "Bert"]
    assert main(["history", str(cell_file), *rename]) == ExitCode.OK
    assert read(audit)[-1].action is AuditAction.RENAMED
    assert read(audit)[-1].who.startswith("Bert")
    assert main(["history", str(cell_file), "--by", "Cleo"]) == ExitCode.USAGE


@pytest.mark.parametrize("verb", ["--add", "--rename", "--acknowledge"])
def test_an_interrupt_after_an_entry_says_what_was_entered(
    cell_file: Path,
    verb: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    added = cell_file.with_name("calibration.yaml")
    name = "demo"
    if verb == "--rename":
        name = "press"
    text = cell_file.read_text(encoding="utf-8").replace("name: demo", f"name: {name}", 1)
    cell_file.write_text(text, encoding="utf-8")
    calibration = _made(load_cell(cell_file), 5)
    save_calibration(calibration, added)
    arguments, entering, expected = {
        "--add": ([str(added)], "enter_calibration", f"{added} was entered into"),
        "--rename": (["demo", "--yes"], "rename_cell", "has the rename of 'demo' to 'press'"),
        "--acknowledge": (
            ["J1", "--why", "new gearbox"],
            "acknowledge",
            "the change of J1 was entered as explained into",
        ),
    }[verb]
    enter = getattr(ledger_module, entering)

    def enter_and_interrupt(*values: object, **options: object) -> object:
        result = enter(*values, **options)
        signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(ledger_module, entering, enter_and_interrupt)
    path = cell_file.with_name("cell.audit.jsonl")
    before = len(read(path))
    assert main(["history", str(cell_file), verb, *arguments]) == ExitCode.INTERRUPTED
    assert len(read(cell_file.with_name("cell.audit.jsonl"))) == before + 1
    error_output = capsys.readouterr().err
    said = " ".join(error_output.split())
    assert expected in said
    assert "no file was written" not in said


def _enter_unchecked(ledger: Ledger, calibration: Calibration, at: datetime) -> str:
    """Enter a calibration as earlier versions did, which compared neither axes nor units."""
    digest = digest_of(calibration)
    details = {
        "sha256": digest,
        "cell": ledger.cell.name,
        "entered": at.isoformat(),
        "figures": figures_of(calibration, digest, at),
    }
    subject = f"history of {ledger.cell.name}"
    append(
        ledger.audit,
        AuditAction.CALIBRATION_ENTERED,
        at=at,
        who="anna",
        subject=subject,
        details=details,
    )
    return digest


def test_calibrations_with_other_axes_or_units_are_counted_and_their_writes_known(
    cell_file: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    ledger = Ledger.of(load_cell(cell_file))
    assert ledger is not None
    four = _made(ledger.cell, 3)
    four = replace(four, gains=four.gains[:4])
    milli = _made(ledger.cell, 4)
    first = replace(milli.gains[0], unit="Nm/mA")
    gains = (first, *milli.gains[1:])
    milli = replace(milli, gains=gains)
    digests = []
    for week, calibration in ((3, four), (4, milli)):
        at = BEGIN + timedelta(weeks=week)
        digest = _enter_unchecked(ledger, calibration, at)
        write(ledger, drives_of("demo"), sha256(str(week).encode()), digest=digest, at=at)
        digests.append(digest)
    _enter_unchecked(ledger, _made(ledger.cell, 5), BEGIN + timedelta(weeks=5))
    assert main(["history", str(cell_file), "--json"]) == ExitCode.OK
    report = json.loads(capsys.readouterr().out)
    assert report["calibrations"] == 3
    by_axes, by_unit = report["not_compared"]
    assert digests[0][:12] in by_axes
    assert "found gains of J1, J2, J3, J4; expected of J1, J2, J3, J4, J5, J6, as in" in by_axes
    assert digests[1][:12] in by_unit
    assert "found J1 in Nm/mA; expected J1 in" in by_unit
    assert "2 calibrations left out of tables, drift and alarms" in caplog.text
    assert by_axes in caplog.text
    assert verify_ledger(ledger).unknown == ()
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.OK


def test_the_verb_says_in_what_another_robot_differs(
    cell_file: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    text = cell_file.read_text(encoding="utf-8")
    cell_file.write_text(text.replace("0x00040200", "0x00040300"))
    assert main(["history", str(cell_file), "--json"]) == ExitCode.OK
    report = json.loads(capsys.readouterr().out)
    assert report["calibrations"] == 0
    assert len(report["other_robots"]) == 2
    assert "drive of J1 with product code 0x40200" in report["other_robots"][0]
    assert "J3 with product code 0x40200; and 3 more; expected" in report["other_robots"][0]
    assert "no change of a gain is computed with it" in caplog.text
    # Nor may its calibration be entered beside the others.
    own = cell_file.with_name("calibration.yaml")
    calibration = _made(load_cell(cell_file), 5)
    save_calibration(calibration, own)
    assert main(["history", str(cell_file), "--add", str(own)]) == ExitCode.DATA_UNFIT


@pytest.mark.parametrize("options", [["--rename", "demo"], ["--yes"]])
def test_the_verb_needs_an_earlier_name(
    options: list[str], cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["history", str(cell_file), *options]) == ExitCode.USAGE
    error_output = capsys.readouterr().err
    said = " ".join(error_output.split())
    assert "--rename" in said
