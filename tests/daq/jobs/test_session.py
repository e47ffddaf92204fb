"""Sessions of several cells in one folder, states that are not ours,
and files of metrics with names of their own.
"""

from __future__ import annotations

import io
import json
import os
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.documents.session_state import JobState, Outcome, PlannedWrite
from daq.errors import ExitCode
from daq.jobs.context import sessions_that_count
from daq.jobs.journal import Form
from daq.jobs.recording import calibration_of_session
from daq.jobs.reporting import Conclusion, file_stem, to_do
from daq.jobs.session import (
    CLOCK_SLACK,
    STATE,
    Basis,
    Session,
    begin,
    begun_until,
    remove_old,
    save,
    sessions,
)
from daq.jobs.story import Story
from tests.daq.jobs.made import Made, made_rig
from tests.daq.jobs.rig import BEGAN, make_rig

BASIS = Basis("demo", "c" * 64, "b" * 64)


def test_two_cells_of_one_folder_have_sessions_of_their_own(tmp_path: Path) -> None:
    folder = tmp_path / "cell"
    plan_file = tmp_path / "plan.yaml"
    rig = make_rig(folder, plan_file)
    other = rig.cell_file.with_name("other.yaml")
    shutil.copyfile(rig.cell_file, other)
    folders = [
        section.folder.name
        for file in (rig.cell_file, other)
        if (section := load_cell(file).recalibration)
    ]
    assert folders == ["demo.recalibration", "other.recalibration"]


@pytest.mark.slow
def test_a_cell_is_due_whatever_another_one_keeps_in_its_folder(tmp_path: Path, made: Made) -> None:
    cell_folder = tmp_path / "cell"
    rig = made_rig(cell_folder, made, keep_sessions=1, every_h=1)
    folder = rig.cells / "demo.recalibration"
    for minutes in range(3):
        now = BEGAN - timedelta(minutes=30 - minutes)
        basis = replace(BASIS, cell="another")
        one = begin(folder, basis, now)
        state = one.state.with_(outcome=Outcome.APPLIED, ended=one.state.began)
        save(replace(one, state=state))
    assert rig.job().outcome is Outcome.APPLIED
    rig.clock.go_on(hours=2)
    assert rig.job().outcome is Outcome.UNCHANGED
    assert len(sessions(folder, "another")) == 3
    assert len(sessions(folder)) == 3 + len(rig.sessions)
    drivegain_demo_path = rig.cells / "drivegain_demo.prom"
    assert "last_success_timestamp_seconds" in drivegain_demo_path.read_text()


def test_what_another_cell_keeps_is_not_removed(tmp_path: Path) -> None:
    for week in range(3):
        for cell in ("demo", "another"):
            days = 7 * week
            now = BEGAN + timedelta(days=days)
            basis = replace(BASIS, cell=cell)
            begin(tmp_path, basis, now)
    assert len(remove_old(sessions(tmp_path, "demo"), 1, ())) == 2
    assert (len(sessions(tmp_path, "demo")), len(sessions(tmp_path, "another"))) == (1, 3)


def test_sessions_that_a_killed_job_left_half_made_or_half_removed_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = [begin(tmp_path, BASIS, BEGAN + timedelta(days=7 * week)) for week in range(3)]
    whole = shutil.rmtree

    def killed(folder: Path, **_: object) -> None:
        (folder / STATE).unlink()
        (folder / "bare-1.mcap").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "rmtree", killed)
    with pytest.raises(KeyboardInterrupt):
        remove_old(sessions(tmp_path), 2, ())
    monkeypatch.setattr(shutil, "rmtree", whole)
    stateless, damaged, later = (
        tmp_path / name for name in ("20260101T000000Z", "20260102T000000Z-02", "20990101T000000Z")
    )
    for folder in (stateless, damaged, later):
        folder.mkdir()
        (folder / f".{STATE}.4711-0.tmp").touch()
    (damaged / "bare-1.mcap").touch()
    assert remove_old(sessions(tmp_path), 2, ()) == ()
    left = {made[1].folder, made[2].folder, damaged, later}
    assert set(tmp_path.iterdir()) == left


def test_no_one_waits_for_a_pipe_in_the_place_of_a_state(tmp_path: Path) -> None:
    session = begin(tmp_path, BASIS, BEGAN)
    (session.folder / STATE).unlink()
    os.mkfifo(session.folder / STATE)
    assert sessions(tmp_path) == ()


def test_a_file_in_the_place_of_the_folder_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cell"
    plan_file = tmp_path / "plan.yaml"
    rig = make_rig(folder, plan_file)
    (rig.cells / "demo.recalibration").write_text("no folder")
    for verb in (
        ["history", str(rig.cell_file), "--verify", "--json"],
        ["recalibrate", str(rig.cell_file), "--json"],
    ):
        assert main(verb) == ExitCode.CONFIGURATION
        output = capsys.readouterr()
        assert output.out == ""
        (line,) = output.err.splitlines()
        text = json.dumps(json.loads(line))
        assert "demo.recalibration" in text
        assert "not a directory" in line


@pytest.mark.parametrize("key", ["attempts", "samples", "lost_cycles"])
@pytest.mark.parametrize("number", ["-1", "1" + 400 * "0", "NaN"])
def test_a_state_with_a_count_that_is_none_is_no_session(
    tmp_path: Path, key: str, number: str
) -> None:
    run = {
        "name": "a",
        "sha256": "0" * 64,
        "attempts": 1,
        "samples": 2,
        "lost_cycles": 0,
        "missing": [0],
    }
    session = begin(tmp_path, BASIS, BEGAN)
    state = json.loads((session.folder / STATE).read_text())
    (session.folder / STATE).write_text(json.dumps({**state, "runs": [run]}))
    assert len(sessions(tmp_path)) == 1
    text = json.dumps({**state, "runs": [{**run, key: 0}]}).replace(
        f'"{key}": 0', f'"{key}": {number}'
    )
    (session.folder / STATE).write_text(text)
    assert sessions(tmp_path) == ()


@pytest.mark.slow
def test_a_calibration_of_other_logs_is_none_of_the_session(tmp_path: Path, made: Made) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    rig.job()
    session = rig.session
    assert calibration_of_session(session) is not None
    first, *others = session.state.runs
    update = {"sha256": "0" * 64}
    for runs in ((first.model_copy(update=update), *others), tuple(others)):
        state = session.state.with_(runs=runs)
        changed_session = replace(session, state=state)
        assert calibration_of_session(changed_session) is None


@pytest.mark.parametrize("key", ["began", "attempt_began", "ended"])
@pytest.mark.parametrize(
    "time", ["2026-01-05T02:00:00", "yesterday", "", "2026-13-01T00:00:00+00:00"]
)
def test_a_state_whose_times_are_none_is_no_session(tmp_path: Path, key: str, time: str) -> None:
    session = begin(tmp_path, BASIS, BEGAN)
    text = (session.folder / STATE).read_text()
    state = json.loads(text)
    (session.folder / STATE).write_text(json.dumps({**state, key: time}))
    assert sessions(tmp_path) == ()


@given(st.datetimes(timezones=st.just(UTC)), st.integers(0, 10**9))
def test_any_time_in_a_state_is_judged_without_a_crash(began: datetime, later_s: int) -> None:
    at = BEGAN + timedelta(seconds=later_s)
    reported = began.isoformat()
    state = JobState(
        session="s", cell="demo", configuration_sha256="", began=reported, attempt_began=reported
    )
    session = Session(Path("s"), state)
    counted = begun_until((session,), at)
    assert counted == (() if began > at + CLOCK_SLACK else (session,))


@pytest.mark.slow
def test_a_session_of_the_far_future_is_reported_and_does_not_end_all_calibrations(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    demo_path = rig.cells / "demo.recalibration"
    basis = replace(BASIS, cell="demo")
    now = BEGAN.replace(year=2099)
    foreign = begin(demo_path, basis, now)
    ended = foreign.state.with_(
        outcome=Outcome.APPLIED, ended=BEGAN.isoformat(), attempt_began=BEGAN.isoformat()
    )
    save(replace(foreign, state=ended))
    assert rig.job().outcome is Outcome.APPLIED
    (said,) = [
        event
        for event in rig.events
        if event["event"] == "a session from the future does not count"
    ]
    assert said["folder"] == str(foreign.folder)
    assert "move the folder away" in said["text"]
    assert foreign.folder.is_dir()


def test_a_person_reads_which_session_does_not_count(tmp_path: Path) -> None:
    present = begin(tmp_path, BASIS, BEGAN)
    now = BEGAN + timedelta(days=730)
    future = begin(tmp_path, BASIS, now)
    terminal = io.StringIO()
    story = Story(terminal, Form.TEXT, lambda: BEGAN)
    for _ in range(2):  # said once
        assert sessions_that_count(sessions(tmp_path), BEGAN + timedelta(hours=1), story) == (
            present,
        )
    said = " ".join(terminal.getvalue().split())
    assert said.startswith("! a session from the future does not count: found")
    assert said.count(future.state.began) == 1
    assert "timedatectl" in said


def test_a_session_from_the_future_is_neither_removed_nor_taken_for_the_newest(
    tmp_path: Path,
) -> None:
    """The newest one is asked what killed jobs have left before it;
    by a wrong date, that is all there is.
    """
    made = [begin(tmp_path, BASIS, BEGAN + timedelta(days=7 * week)) for week in range(3)]
    now = BEGAN + timedelta(days=730)
    future = begin(tmp_path, BASIS, now)
    just_begun = tmp_path / "20260201T000000Z"
    just_begun.mkdir()
    counted = begun_until(sessions(tmp_path), BEGAN + timedelta(days=15))
    assert counted == tuple(made)
    assert remove_old(counted, 2, ()) == (made[0].folder,)
    assert future.folder.is_dir()
    assert just_begun.is_dir()


@given(st.lists(st.text(min_size=1, max_size=8), min_size=2, max_size=2, unique=True))
def test_two_cells_never_share_a_file_of_metrics(cells: list[str]) -> None:
    one, other = map(file_stem, cells)
    assert one != other
    assert one.isascii()
    assert "/" not in one


def test_what_to_do_can_be_typed_in_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    base_sha256 = "a" * 64
    after_sha256 = "b" * 64
    target = PlannedWrite(file="gains.yaml", base_sha256=base_sha256, after_sha256=after_sha256)
    for outcome in (Outcome.PROPOSED, Outcome.APPLIED):
        session = begin(tmp_path, BASIS, BEGAN).update(target=target, outcome=outcome)
        conclusion = Conclusion(outcome, 0, session, "")
        lines = to_do(conclusion, Path("cells/demo.yaml"))
        last_line = lines[-1]
        assert f" {tmp_path}/cells/demo.yaml" in last_line


def test_a_plain_name_is_its_own() -> None:
    assert file_stem("press-4") == "press-4"
    assert file_stem("Пресс 4") != file_stem("Робот 4")
    assert file_stem("press 4").startswith("press_4_")
