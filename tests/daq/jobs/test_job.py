"""The job as a whole: what it makes, when it is not due, what it refuses,
and what it leaves to a person.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from daq.cli.app import main
from daq.documents.session_state import Outcome
from daq.errors import ExitCode
from daq.jobs import session as sessions
from daq.jobs.recording import basis_of
from daq.ledger.audit import AuditAction, noted_heads
from tests.daq.documented_keys import undocumented_keys
from tests.daq.histories import history_of
from tests.daq.jobs.made import Made, made_rig
from tests.daq.jobs.rig import WHO, Rig


def test_a_whole_job_applies_what_it_found_and_leaves_everything_that_records_it(
    whole_job: tuple[Rig, Made],
) -> None:
    rig, _ = whole_job
    session = rig.session
    assert session.state.outcome is Outcome.APPLIED
    assert session.state.exit_code == ExitCode.OK
    files = session.folder.rglob("*")
    names = {path.name for path in files}
    assert {
        "calibration.yaml",
        "report.html",
        "residual.json",
        "summary.txt",
        "proposal.diff",
        "state.json",
    } <= names
    text = (session.folder / "calibration.yaml").read_text()
    gains = yaml.safe_load(text)["gains"]
    found = {gain["axis"]: gain["value"] for gain in gains}
    document = yaml.safe_load(rig.controller.read_text())
    written = document["drives"]
    for axis, value in found.items():
        assert written[axis]["gain"] == pytest.approx(value, rel=1e-3)
    actions = [entry.action for entry in rig.audit]
    expected = [
        AuditAction.RECALIBRATION_BEGUN,
        AuditAction.CALIBRATION_ENTERED,
        AuditAction.APPLY_BEGUN,
        AuditAction.APPLIED,
        AuditAction.RECALIBRATION_ENDED,
    ]
    assert actions == expected
    assert undocumented_keys(rig.audit) == {}
    details = rig.audit[-1].details
    assert details["outcome"] == "applied"
    sha256 = rig.audit[-1].sha256
    assert sha256 == session.state.audit_sha256
    history = history_of(rig.cell_file)
    assert [(event.who, event.audit) for event in history.events] == [(WHO, rig.audit[3].sha256)]
    assert history.in_force(str(rig.controller)) == rig.audit[-1].details["calibration_sha256"]
    # By which `history --verify` notices an audit whose end was cut off.
    demo_path = rig.cells / "demo.audit.jsonl"
    assert noted_heads(demo_path) == (rig.audit[-1].sha256,)
    # The current gains are the nameplates, which have no σ.
    assert session.state.decision is not None
    old_stds = {gain.old_std for gain in session.state.decision.gains}
    assert old_stds == {0.0}
    alarms = [gain.alarm for gain in session.state.watched]
    assert alarms == [""] * 6
    summary_path = session.folder / "summary.json"
    summary = json.loads(summary_path.read_text())
    assert list(summary)[:6] == ["outcome", "exit_code", "remark", "to_do", "folder", "format"]
    assert summary["outcome"] == "applied"
    assert "drivegain rollback" in " ".join(summary["to_do"])
    metrics = (rig.cells / "drivegain_demo.prom").read_text()
    assert 'drivegain_recalibration_outcome{cell="demo",outcome="applied"} 1.0' in metrics
    assert 'drivegain_recalibration_gain_drift_sigma{axis="J4",cell="demo"}' in metrics
    levels = {event["level"] for event in rig.events}
    assert levels <= {"info", "notice", "warning"}


@pytest.mark.slow
def test_the_rollback_and_its_rollback_to_what_a_job_wrote_is_known(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    rig.job()
    target = str(rig.controller)
    details = rig.audit[-1].details
    digest = details["calibration_sha256"]
    known: list[str | None] = []
    for _ in range(2):
        assert main(["rollback", "--cell", str(rig.cell_file), "--by", "a person"]) == ExitCode.OK
        known.append(history_of(rig.cell_file).in_force(target))
    assert known == [None, digest]


def test_the_payload_was_changed_between_the_runs(whole_job: tuple[Rig, Made]) -> None:
    """By the mount command alone; a fit of runs that all carried the same would have found no
    gain.
    """
    rig, made = whole_job
    mounted_folder = rig.cells / "mounted"
    assert mounted_folder.read_text() == "disc\n"
    mounted = [event["payload"] for event in rig.events if event["event"] == "mounted"]
    assert mounted == ["none", "disc", "disc"]
    assert made.closed.final.training_error.total < 10.0


@pytest.mark.slow
def test_a_session_that_was_begun_with_now_is_taken_up_by_a_plain_job(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, every_h=144, resume_within_h=12)
    assert rig.job().outcome is Outcome.APPLIED
    section = rig.cell.recalibration
    cell = rig.cell
    assert section is not None
    rig.clock.go_on(hours=1)
    basis = basis_of(cell, section)
    stopped = sessions.begin(section.folder, basis, rig.clock())
    rig.clock.go_on(minutes=10)
    ended = rig.clock().isoformat()
    stopped.update(outcome=Outcome.STOPPED, ended=ended)
    rig.clock.go_on(hours=13)
    assert rig.job().outcome is Outcome.NOT_DUE
    rig.clock.go_on(hours=-12)
    assert rig.job().outcome is Outcome.UNCHANGED
    last = rig.sessions[-1].state
    expected = (stopped.state.session, 2)
    assert (last.session, last.attempt) == expected


@pytest.mark.slow
def test_nothing_is_due_while_the_last_good_calibration_is_young(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, every_h=144)
    assert rig.job().outcome is Outcome.APPLIED
    before = rig.controller.read_bytes()
    for hours in (1, 100, 42):
        rig.clock.go_on(hours=hours)
        assert rig.job().outcome is Outcome.NOT_DUE
    assert len(rig.sessions) == 1
    assert len(rig.audit) == 5
    rig.clock.go_on(hours=2)
    # The same logs again: what is found is what the controller has.
    assert rig.job().outcome is Outcome.UNCHANGED
    assert rig.controller.read_bytes() == before
    assert len(rig.sessions) == 2
    assert len(rig.backups) == 1
