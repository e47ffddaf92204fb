"""What becomes of a calibration, by statistics and by policy, over many weeks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daq.cli.app import main
from daq.errors import CalibrationRefused, ExitCode, ModelContradicted
from daq.history.store import HistoryStore
from daq.recalibration.session import Outcome
from daq.write_back.audit import AuditAction
from drivers.errors import DriveFault
from tests.daq.recalibration.rig import Made, Rig, made_rig

BY_A_PERSON, BY_THE_JOB = (
    {"motion": "allowed", "apply": {"by": by, "max_std_percent": 8, "max_age_days": None}} for by in ("person", "job")
)
"""The logs of these tests are as old as the year in which they play."""


def test_a_change_waits_for_a_person_who_applies_it_with_the_command_that_was_told(
    tmp_path: Path, made: Made, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = made_rig(tmp_path / "cell", made, policy=BY_A_PERSON)
    before = rig.controller.read_bytes()
    ended = rig.job()
    assert (ended.outcome, ended.exit_code) == (Outcome.PROPOSED, ExitCode.PROPOSED)
    assert rig.controller.read_bytes() == before
    assert [entry.action for entry in rig.audit][1:] == [AuditAction.PROPOSED, AuditAction.RECALIBRATION_ENDED]
    assert "+    gain: -9." in (rig.session.folder / "proposal.diff").read_text()
    *_, command = json.loads((rig.session.folder / "summary.json").read_text())["to_do"]
    assert main(command.split()[1:]) == ExitCode.OK
    capsys.readouterr()
    assert rig.controller.read_bytes() != before
    with HistoryStore(rig.cells / "demo.history.sqlite") as store:
        assert store.in_force(str(rig.controller)) == rig.audit[2].details["calibration_sha256"]
    # The next week nothing is new: the σ of what the person applied is known from the history.
    rig.clock.go_on(days=7)
    assert rig.job().outcome is Outcome.UNCHANGED
    decision = rig.sessions[-1].state.decision
    assert decision is not None
    assert all(gain.old_std > 0 for gain in decision.gains)


def test_a_closed_gate_refuses_and_the_next_job_records_anew(tmp_path: Path, made: Made) -> None:
    strict = {"motion": "allowed", "apply": {"by": "job", "max_std_percent": 0.01}}
    rig = made_rig(tmp_path / "cell", made, policy=strict)
    before = rig.controller.read_bytes()
    for number in (1, 2):
        with pytest.raises(CalibrationRefused, match="σ"):
            rig.job()
        rig.clock.go_on(hours=1)
        assert len(rig.sessions) == number
        assert rig.sessions[-1].state.outcome is Outcome.REFUSED
        assert rig.sessions[-1].state.exit_code == ExitCode.CALIBRATION_REFUSED
    assert rig.controller.read_bytes() == before
    actions = [entry.action for entry in rig.audit]
    assert actions[:3] == [
        AuditAction.RECALIBRATION_BEGUN,
        AuditAction.REFUSED,
        AuditAction.RECALIBRATION_ENDED,
    ]


def test_recordings_that_contradict_the_model_are_not_fitted_twice(tmp_path: Path, made: Made) -> None:
    rig = made_rig(tmp_path / "cell", made)
    known = rig.tools

    def contradicted(*_: Any, **__: Any) -> Any:
        raise ModelContradicted("the fit", found="80 %", expected="5 %", remedy="look")

    rig.tools = replace(known, fit=contradicted)
    with pytest.raises(ModelContradicted):
        rig.job()
    assert (rig.session.state.outcome, rig.session.state.exit_code) == (Outcome.UNFIT, ExitCode.DATA_UNFIT)
    rig.tools = known
    assert rig.job().outcome is Outcome.APPLIED
    assert len(rig.sessions) == 2


def test_a_timer_over_many_weeks(tmp_path: Path, made: Made) -> None:
    """The job once a day at three, due once a week: it acts where something has changed, and only there."""
    rig = made_rig(tmp_path / "cell", made, policy=BY_THE_JOB, every_h=160, keep_sessions=4)
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
    assert outcomes == [
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
    decision = rig.sessions[-1].state.decision
    assert decision is not None
    assert not any(gain.differs for gain in decision.gains)
    assert len(rig.sessions) == 4
    assert len(rig.backups) == 2
    begun, ended = (
        [entry for entry in rig.audit if entry.action is action]
        for action in (AuditAction.RECALIBRATION_BEGUN, AuditAction.RECALIBRATION_ENDED)
    )
    assert len(begun) == len(ended) == len(outcomes)


def failing_once(rig: Rig) -> Any:
    """A drive fails in the second run."""
    tools = rig.tools
    copied = tools.record

    def record(*given: Any, **further: Any) -> Any:
        if given[3].stem == "loaded-1":
            raise DriveFault(3, "EMCY 7305h")
        return copied(*given, **further)

    return replace(tools, record=record)
