"""Fate of a calibration, by statistics and by policy, over many weeks."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from daq.cli.app import main
from daq.documents.session_state import Outcome
from daq.errors import CalibrationRefused, ExitCode, HistoryUnreadable
from daq.ledger.audit import AuditAction, append, read
from daq.ledger.ledger import MAY_LACK
from daq.workflow.record import RecordingRequest
from daq.writeback.signature import generate
from drivers.errors import DriveFault
from ident.errors import ModelContradicted
from tests.daq.histories import history_of
from tests.daq.jobs.made import Made, made_rig
from tests.daq.jobs.rig import Rig

pytestmark = pytest.mark.slow

NEEDS_PERSON, BY_THE_JOB = (
    {"motion": "allowed", "apply": {"by": by, "max_std_percent": 8, "max_age_days": None}}
    for by in ("person", "job")
)
"""The logs of these tests are as old as the year in which they play."""


def test_a_job_that_writes_makes_its_certificate_once_more(tmp_path: Path, made: Made) -> None:
    """The first one is made before the decision;
    what stays must not say that the gains are still to be written.
    """
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    tools = rig.tools
    before: list[str] = []

    def ends_first(*_: object) -> Any:
        report_folder = rig.session.folder / "report"
        before.append((report_folder / "report.html").read_text())
        raise KeyboardInterrupt

    rig.tools = replace(tools, certify=ends_first)
    with pytest.raises(KeyboardInterrupt):
        rig.job()
    assert not rig.session.finished
    rig.tools = tools
    rig.clock.go_on(minutes=5)
    assert rig.job().outcome is Outcome.APPLIED
    report_path = rig.session.folder / "report" / "report.html"
    page = report_path.read_text()
    assert "written on 2026-01-05" not in before[0]
    assert "written on 2026-01-05" in page
    actions = [entry.action for entry in rig.audit]
    assert actions.count(AuditAction.APPLIED) == 1
    attempt = rig.session.state.attempt
    assert (attempt, rig.session.finished) == (2, True)


def test_a_change_waits_for_a_person_who_applies_it_with_the_command_that_was_shown(
    tmp_path: Path, made: Made, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=NEEDS_PERSON)
    before = rig.controller.read_bytes()
    ended = rig.job()
    expected = (Outcome.PROPOSED, ExitCode.PROPOSED)
    assert (ended.outcome, ended.exit_code) == expected
    assert rig.controller.read_bytes() == before
    actions = [entry.action for entry in rig.audit]
    assert actions[1:] == [
        AuditAction.CALIBRATION_ENTERED,
        AuditAction.PROPOSED,
        AuditAction.RECALIBRATION_ENDED,
    ]
    proposal_path = rig.session.folder / "proposal.diff"
    assert "+    gain: -9." in proposal_path.read_text()
    text = (rig.session.folder / "summary.json").read_text()
    *_, command = json.loads(text)["to_do"]
    assert main(command.split()[1:]) == ExitCode.OK
    capsys.readouterr()
    assert rig.controller.read_bytes() != before
    in_force = history_of(rig.cell_file).in_force(str(rig.controller))
    calibration_sha256 = rig.audit[2].details["calibration_sha256"]
    assert in_force == calibration_sha256
    # The next week nothing is new: the σ of what the person applied is known from the history.
    rig.clock.go_on(days=7)
    assert rig.job().outcome is Outcome.UNCHANGED
    decision = rig.sessions[-1].state.decision
    assert decision is not None
    assert all(gain.old_std > 0 for gain in decision.gains)


def test_a_failed_check_refuses_and_the_next_job_records_anew(tmp_path: Path, made: Made) -> None:
    strict = {"motion": "allowed", "apply": {"by": "job", "max_std_percent": 0.01}}
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=strict)
    before = rig.controller.read_bytes()
    for number in (1, 2):
        with pytest.raises(CalibrationRefused, match="σ"):
            rig.job()
        rig.clock.go_on(hours=1)
        assert len(rig.sessions) == number
        last_session = rig.sessions[-1]
        assert last_session.state.outcome is Outcome.REFUSED
        state = rig.sessions[-1].state
        assert state.exit_code == ExitCode.CALIBRATION_REFUSED
    assert rig.controller.read_bytes() == before
    actions = [entry.action for entry in rig.audit]
    expected = [
        AuditAction.RECALIBRATION_BEGUN,
        AuditAction.CALIBRATION_ENTERED,
        AuditAction.REFUSED,
        AuditAction.RECALIBRATION_ENDED,
    ]
    assert actions[:4] == expected


def test_recordings_that_contradict_the_model_are_not_fitted_twice(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    known = rig.tools

    def contradicted(*_: Any, **__: Any) -> Any:
        raise ModelContradicted("the fit", found="80 %", expected="5 %", remedy="look")

    rig.tools = replace(known, fit=contradicted)
    with pytest.raises(ModelContradicted):
        rig.job()
    expected = (Outcome.UNFIT, ExitCode.DATA_UNFIT)
    outcome = rig.session.state.outcome
    assert (outcome, rig.session.state.exit_code) == expected
    rig.tools = known
    assert rig.job().outcome is Outcome.APPLIED
    assert len(rig.sessions) == 2


def test_a_timer_over_many_weeks(tmp_path: Path, made: Made) -> None:
    """The job once a day at three, due once a week:
    it acts where something has changed, and only there.
    """
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=BY_THE_JOB, every_h=160, keep_sessions=4)
    days = 7 * 8
    outcomes: list[tuple[int, str]] = []
    for day in range(days):
        rig.tools = made.tools(rig, **({"J4": 0.9} if day >= 28 else {}))
        if day == 14:
            rig.tools = failing_once(rig)
        if day == 43:
            rig.closed.unlink()
        if day == 44:
            rig.closed.touch()
        before = rig.controller.read_bytes()
        try:
            outcome = rig.job().outcome.value
        except Exception as error:  # noqa: BLE001 - the kinds are what is compared
            outcome = type(error).__name__
        assert (rig.controller.read_bytes() != before) == (outcome == "applied"), day
        if outcome != "not due":
            outcomes.append((day, outcome))
        rig.clock.go_on(days=1, seconds=-rig.clock.at.timestamp() % 60)
    expected = [
        (0, "applied"),
        (7, "unchanged"),
        (14, "DriveFault"),
        # The session of the day before is too old to be taken up.
        (15, "unchanged"),
        (22, "unchanged"),
        (29, "applied"),
        (36, "unchanged"),
        (43, "NotReleased"),
        (44, "unchanged"),
        (51, "unchanged"),
    ]
    assert outcomes == expected
    decision = rig.sessions[-1].state.decision
    assert decision is not None
    assert not any(gain.differs for gain in decision.gains)
    # The last four, and the one whose gains are in force: its logs are what the controller rests
    # on.
    assert len(rig.sessions) == 5
    state = rig.sessions[0].state
    assert state.outcome is Outcome.APPLIED
    fitted = rig.sessions[0].state.fitted
    assert fitted is not None
    assert history_of(rig.cell_file).in_force() == fitted.calibration_sha256
    assert len(rig.backups) == 2
    begun = [entry for entry in rig.audit if entry.action is AuditAction.RECALIBRATION_BEGUN]
    ended = [entry for entry in rig.audit if entry.action is AuditAction.RECALIBRATION_ENDED]
    assert len(begun) == len(ended) == len(outcomes)


def test_a_write_that_the_history_does_not_contain_is_known_by_its_numbers(
    tmp_path: Path, made: Made
) -> None:
    """Their writer was killed right after the write:
    taken for exact, they would differ from each new one too often.
    """
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=BY_THE_JOB, every_h=160)
    assert rig.job().outcome is Outcome.APPLIED
    _forget_the_write(rig)
    assert history_of(rig.cell_file).events == ()
    rig.clock.go_on(days=7)
    assert rig.job().outcome is Outcome.UNCHANGED
    decision = rig.sessions[-1].state.decision
    assert decision is not None
    assert all(gain.old_std > 0 for gain in decision.gains)


def test_a_drift_is_reported_although_the_job_applies_it_in_slices(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=BY_THE_JOB, every_h=160)
    for week in range(12):
        rig.tools = made.tools(rig, J4=0.98**week)
        outcome = rig.job().outcome
        assert outcome in (Outcome.APPLIED, Outcome.UNCHANGED)
        watched = rig.sessions[-1].state.watched
        alarms = {gain.axis: gain.alarm for gain in watched}
        if any(alarms.values()):
            break
        rig.clock.go_on(days=7)
    assert [axis for axis, alarm in alarms.items() if alarm] == ["J4"]
    warned = [event for event in rig.events if event["event"] == "drift"]
    expected = [("warning", "J4", alarms["J4"])]
    assert [(event["level"], event["axis"], event["text"]) for event in warned] == expected
    last_session = rig.sessions[-1]
    summary_path = last_session.folder / "summary.txt"
    assert alarms["J4"] in summary_path.read_text()
    metrics = (rig.cells / "drivegain_demo.prom").read_text()
    reported = [f'drift_alarm{{axis="J{n}",cell="demo"}} {float(n == 4)}' for n in range(1, 7)]
    lines = [line for line in reported if line not in metrics]
    assert lines == []


def test_nothing_is_removed_while_no_one_knows_what_is_in_force(tmp_path: Path, made: Made) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=BY_THE_JOB, every_h=160, keep_sessions=1)
    for outcome in (Outcome.APPLIED, Outcome.UNCHANGED):
        assert rig.job().outcome is outcome
        rig.clock.go_on(days=7)
    demo_path = rig.cells / "demo.history.sqlite"
    demo_path.write_bytes(b"no database at all" * 100)
    with pytest.raises(HistoryUnreadable):
        rig.job()
    assert len(rig.sessions) == 3
    events = {event["event"] for event in rig.events}
    assert "no old session removed" in events


def test_a_job_says_that_its_history_may_lack_something_and_removes_nothing(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=BY_THE_JOB, every_h=160, keep_sessions=1)
    assert rig.job().outcome is Outcome.APPLIED
    rig.clock.go_on(days=7)
    audit = rig.cells / "demo.audit.jsonl"
    lines = audit.read_bytes().splitlines(keepends=True)
    audit.write_bytes(b"".join(lines[1:]))
    assert rig.job().outcome is Outcome.UNCHANGED
    assert len(rig.sessions) == 2
    said = {event["event"]: event["text"] for event in rig.events if event["level"] == "warning"}
    assert said["history may be incomplete"] == said["no old session removed"] == MAY_LACK


def test_what_is_written_stays_reported_as_written_whatever_becomes_of_the_history(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=BY_THE_JOB)
    apply = rig.tools.apply

    def breaks_the_history(*given: Any, **further: Any) -> Any:
        demo_path = rig.cells / "demo.history.sqlite"
        demo_path.write_bytes(b"no database at all" * 100)
        return apply(*given, **further)

    rig.tools = replace(rig.tools, apply=breaks_the_history)
    before = rig.controller.read_bytes()
    assert rig.job().outcome is Outcome.APPLIED
    assert rig.controller.read_bytes() != before
    events = {event["event"] for event in rig.events}
    assert (
        "the history may lack this write; the next job, apply or history --add enters it" in events
    )
    summary_path = rig.session.folder / "summary.json"
    document = json.loads(summary_path.read_text())
    assert "drivegain rollback" in " ".join(document["to_do"])


def test_a_history_that_cannot_be_read_is_reported_before_anything_moves(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    demo_path = rig.cells / "demo.history.sqlite"
    demo_path.write_bytes(b"no database at all" * 100)
    with pytest.raises(HistoryUnreadable):
        rig.job()
    assert rig.session.state.runs == ()


def test_a_calibration_that_a_second_person_must_sign_says_so_in_what_is_to_do(
    tmp_path: Path, made: Made, capsys: pytest.CaptureFixture[str]
) -> None:
    public = generate(tmp_path, "bob")[1].line
    signed = {
        "by": "person",
        "max_std_percent": 8,
        "max_age_days": None,
        "signatures": 1,
        "signers": {"bob": public},
    }
    folder = tmp_path / "cell"
    policy = {**NEEDS_PERSON, "apply": signed}
    rig = made_rig(folder, made, policy=policy)
    assert rig.job().outcome is Outcome.PROPOSED
    text = (rig.session.folder / "summary.json").read_text()
    sign, _, _, apply = json.loads(text)["to_do"]
    assert main(apply.split()[1:]) == ExitCode.CALIBRATION_REFUSED
    options = sign.partition("drivegain ")[2].replace("KEY", str(tmp_path / "bob.key"))
    changed_options = options.replace("NAME", "bob")
    assert main(changed_options.split()) == ExitCode.OK
    assert main(apply.split()[1:]) == ExitCode.OK
    capsys.readouterr()


def _forget_the_write(rig: Rig) -> None:
    """Take the only write out of the audit log, as if its writer had had another one."""
    audit = rig.cells / "demo.audit.jsonl"
    entries = read(audit)
    audit.unlink()
    for one in entries:
        if one.action not in (AuditAction.APPLY_BEGUN, AuditAction.APPLIED):
            at = datetime.fromisoformat(one.at)
            append(audit, one.action, at=at, who=one.who, subject=one.subject, details=one.details)


def failing_once(rig: Rig) -> Any:
    """A drive fails in the second run."""
    tools = rig.tools
    copied = tools.record

    def record(request: RecordingRequest, **further: Any) -> Any:
        if request.out.stem == "loaded-1":
            raise DriveFault(3, "EMCY 7305h")
        return copied(request, **further)

    return replace(tools, record=record)
