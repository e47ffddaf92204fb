"""A guided session: order of blocks, outcome, interrupts at any call, mistakes in blocks,
answers of a person.
"""

from __future__ import annotations

import errno
import io
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from html import escape
from itertools import count, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from daq.cli import calibrate as calibrate_verb
from daq.cli.app import main
from daq.cli.calibrate import Person
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.recalibration import PlannedRun
from daq.documents.session_state import Block, GuidedState, Outcome
from daq.environment import shipped_configurations
from daq.errors import (
    BusTaken,
    CalibrationRefused,
    ConfigurationError,
    ConfigurationInconsistent,
    DataError,
    ExitCode,
    JobHeld,
    NotReleased,
    OutputFailed,
    UsageError,
)
from daq.jobs import calibrate as guided_session
from daq.jobs import job, reporting
from daq.jobs.acceptance import TOLERANCE, Accept
from daq.jobs.block_check import (
    BlockFacts,
    compared_with,
    look_at_block,
    look_at_geometry,
    mistake_in,
)
from daq.jobs.block_order import FIRST_BLOCKS
from daq.jobs.certificate import save_certificate
from daq.jobs.context import Tools
from daq.jobs.operator import GivenAnswers
from daq.jobs.reporting import SUMMARY_TEXT, Conclusion, ending, to_do
from daq.jobs.session import Session
from daq.jobs.stages import TO_DECISION, Certify, Decide, Identify, Record, Stage, WatchDrift
from daq.ledger.audit import AuditAction
from daq.report.plan_preview import save_preview
from daq.simulation import demo
from daq.simulation.simulation_file import load_simulation
from daq.workflow.bus_lock import bus_lock
from daq.workflow.experiment import PlannedMove
from daq.workflow.fit import Fit
from daq.workflow.plan import Plan, load_plan, plan
from daq.workflow.record import Recorded, RecordingRequest
from drivers.errors import MotionRefused
from ident.errors import CORRECTION_UNCLEAR, ChannelsExchanged, Diagnosis, GeometryTurned
from tests.daq.documented_keys import undocumented_keys
from tests.daq.histories import history_of
from tests.daq.jobs.made_session import (
    BLOCK_S,
    MASS_KG,
    MadeSession,
    given_answers,
    made_session_rig,
    run_session,
)
from tests.daq.jobs.rig import BEGAN, WHO, Rig, serving

pytestmark = pytest.mark.slow

NOT_BETWEEN_FILES = {"monotonic_s", "now", "network", "geometry"}
TOOLS = tuple(field.name for field in fields(Tools))
CALLED = tuple(name for name in TOOLS if name not in NOT_BETWEEN_FILES)
"""Tools between which a session reads and writes its own files; the clock is read beside each of
them, gains that are in a file need no network, and the geometry is judged only where a block shows
a mistake.
"""
QUICK = ("drives", "record", "fit", "save_report", "apply", "validate", "certify")
"""Tools at which every test run interrupts; `processes` takes every call of every tool."""


FIRST_NAMES = ["block-1-bare", "block-2-loaded", "block-3-held-out"]


def state_of(rig: Rig) -> GuidedState:
    state = rig.session.state
    assert isinstance(state, GuidedState)
    return state


def names_of(blocks: Sequence[Any]) -> list[str]:
    """Names of blocks or of runs, in their order."""
    return [block.name for block in blocks]


def events_named(rig: Rig, name: str) -> list[dict[str, Any]]:
    """Entries of one kind in the session's record of events."""
    return [event for event in rig.events if event["event"] == name]


def only_event(rig: Rig, name: str) -> dict[str, Any]:
    """The one entry of a kind in the session's record of events."""
    (event,) = events_named(rig, name)
    return event


def of_axis(values: Sequence[Any], axis: str) -> Any:
    """The one value of an axis."""
    (value,) = [value for value in values if value.axis == axis]
    return value


def distance_to_target(state: GuidedState) -> list[float]:
    """Each gain's σ as a multiple of its target."""
    return [gain.std_percent / gain.target_percent for gain in state.gains]


def change_cell_file(rig: Rig, **changed: Any) -> None:
    """Replace some keys of the cell file."""
    text = rig.cell_file.read_text(encoding="utf-8")
    document = json.loads(text)
    document.update(changed)
    rig.cell_file.write_text(json.dumps(document), encoding="utf-8")


def test_a_session_over_the_driver_finds_the_gains_writes_them_once_and_accepts_them(
    whole_session: tuple[Rig, MadeSession],
) -> None:
    rig, _ = whole_session
    state = state_of(rig)
    assert state.outcome is Outcome.APPLIED
    assert names_of(state.blocks) == FIRST_NAMES
    assert names_of(state.runs) == FIRST_NAMES
    assert all(gain.is_precise for gain in state.gains)
    path = shipped_configurations() / "simulation" / "demo.yaml"
    truth = load_simulation(path, None)
    calibration_path = rig.session.folder / "calibration.yaml"
    calibration = yaml.safe_load(calibration_path.read_text())
    document = yaml.safe_load(rig.controller.read_text())
    written = document["drives"]
    for gain, axis in zip(calibration["gains"], truth.axes, strict=True):
        name = gain["axis"]
        difference = abs(gain["value"] - axis.gain_nm_per_a)
        four_sigma = 4.0 * gain["std"]
        assert difference < four_sigma, name
        written_gain = written[name]["gain"]
        assert written_gain == pytest.approx(gain["value"], rel=1e-3)
    actions = [entry.action for entry in rig.audit]
    assert actions == [
        AuditAction.RECALIBRATION_BEGUN,
        AuditAction.CALIBRATION_ENTERED,
        AuditAction.APPLY_BEGUN,
        AuditAction.APPLIED,
        AuditAction.ACCEPTED,
        AuditAction.RECALIBRATION_ENDED,
    ]
    assert undocumented_keys(rig.audit) == {}
    events = history_of(rig.cell_file).events
    assert len(events) == 1
    assert len(rig.backups) == 1


def test_new_moves_show_which_gains_were_wrong_before_the_write(
    whole_session: tuple[Rig, MadeSession],
) -> None:
    acceptance = state_of(whole_session[0]).acceptance
    assert acceptance is not None
    assert acceptance.accepted
    assert acceptance.new_error_percent is not None
    assert acceptance.old_error_percent is not None
    assert acceptance.new_error_percent < acceptance.old_error_percent
    # The previous gain of J4 is 25 % larger than the truth, so its torque is as much too large.
    scale_of_j4 = of_axis(acceptance.scales, "J4")
    too_large = 11.52 / 9.21
    assert scale_of_j4.old == pytest.approx(too_large, rel=0.02)
    for scale in acceptance.scales:
        assert scale.new == pytest.approx(1.0, abs=0.02)


def test_a_gain_that_is_wrong_after_the_write_is_not_accepted(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    # The controller did not take the gains that were written: it has the previous gains.
    unchanged = (made_session.before,)
    rig.tools = replace(rig.tools, validate=lambda *_: unchanged)
    ended = run_session(rig)
    assert ended.outcome is Outcome.APPLIED
    assert ended.exit_code == ExitCode.NOT_ACCEPTED
    assert state_of(rig).exit_code == ExitCode.NOT_ACCEPTED
    acceptance = state_of(rig).acceptance
    assert acceptance is not None
    assert not acceptance.accepted
    decision = state_of(rig).decision
    assert decision is not None
    gain = of_axis(decision.gains, "J4")
    scale = of_axis(acceptance.scales, "J4")
    # The torque by the previous gain is as much larger than the identified gain predicts.
    assert scale.new is not None
    predicted_scale = gain.old / gain.new
    assert scale.new == pytest.approx(predicted_scale, abs=TOLERANCE)
    excess_percent = 100.0 * (scale.new - 1.0)
    assert f"J4 {excess_percent:+.1f}" in acceptance.remark
    summary = (rig.session.folder / "summary.txt").read_text()
    assert "NOT ACCEPTED" in summary
    undo = f"drivegain rollback {rig.cell_file}"
    assert f"undo the write: {undo}" in summary
    (entry,) = [entry for entry in rig.audit if entry.action is AuditAction.NOT_ACCEPTED]
    assert entry.details["remark"] == acceptance.remark
    assert entry.details["undo"] == undo
    assert undocumented_keys(rig.audit) == {}
    event = only_event(rig, "not accepted")
    assert event["undo"] == undo
    report_folder = rig.session.folder / "report"
    page = (report_folder / "report.html").read_text()
    assert "NOT ACCEPTED on " in page
    assert undo in page
    (calibration,) = history_of(rig.cell_file).entries
    assert calibration.acceptance is not None
    assert not calibration.acceptance.accepted


def test_the_session_leaves_files_that_the_other_verbs_read(
    tmp_path: Path, made_session: MadeSession, capsys: pytest.CaptureFixture[str]
) -> None:
    # The verbs have the clock of this computer, and the logs are of another year.
    policy = {
        "motion": "allowed",
        "apply": {"by": "job", "max_std_percent": 8, "max_age_days": None},
    }
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session, policy=policy)
    assert run_session(rig).exit_code == ExitCode.OK
    cell_file = str(rig.cell_file)
    calibration = str(rig.session.folder / "calibration.yaml")
    assert main(["history", cell_file, "--verify"]) == ExitCode.OK
    assert main(["rollback", cell_file]) == ExitCode.OK
    assert main(["apply", cell_file, calibration, "--json"]) == ExitCode.OK
    capsys.readouterr()
    summary_path = rig.session.folder / "summary.json"
    summary = json.loads(summary_path.read_text())
    assert summary["format"] == "drivegain-session"
    assert summary["outcome"] == "applied"
    assert "drivegain rollback" in " ".join(summary["to_do"])


class Interruption:
    """Counts the calls of a session's tools, and raises an error at one of them:
    before it, or after it.
    """

    def __init__(
        self, error: BaseException | None = None, at: int = -1, *, after: bool = False
    ) -> None:
        self.calls: list[str] = []
        self._error = error
        self._at = at
        self._after = after

    def tools(self, tools: Tools) -> Tools:
        """Return the tools with their calls counted."""
        counted = {}
        for name in CALLED:
            function = getattr(tools, name)
            counted[name] = self._counted(name, function)
        return replace(tools, **counted)

    def _counted(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **further: Any) -> Any:
            is_here = len(self.calls) == self._at
            self.calls.append(name)
            if is_here and not self._after:
                self._raise()
            found = function(*given, **further)
            if is_here:
                self._raise()
            return found

        return call

    def _raise(self) -> None:
        assert self._error is not None
        raise self._error


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory, made_session: MadeSession) -> list[str]:
    """Calls of a session that runs to its end."""
    folder = tmp_path_factory.mktemp("counted") / "cell"
    rig = made_session_rig(folder, made_session)
    counted = Interruption()
    rig.tools = counted.tools(rig.tools)
    assert run_session(rig).outcome is Outcome.APPLIED
    return counted.calls


def test_every_tool_is_among_the_calls(calls: list[str]) -> None:
    assert set(calls) == set(CALLED)
    expected = len(FIRST_BLOCKS) + 1
    assert calls.count("record") == expected


def ends_the_same_after(rig: Rig, interruption: Interruption, error: BaseException) -> None:
    """Interrupt a session there; the same call again has the same outcome,
    with one write in every record.
    """
    tools = rig.tools
    rig.tools = interruption.tools(tools)
    with pytest.raises(type(error)):
        run_session(rig)
    rig.tools = tools
    rig.clock.go_on(minutes=5)
    assert run_session(rig).outcome is Outcome.APPLIED
    state = state_of(rig)
    assert state.acceptance is not None
    assert state.acceptance.accepted
    assert names_of(state.runs) == names_of(state.blocks)
    actions = [entry.action for entry in rig.audit]
    assert actions.count(AuditAction.APPLY_BEGUN) == 1
    assert actions.count(AuditAction.APPLIED) == 1
    assert actions.count(AuditAction.CALIBRATION_ENTERED) == 1
    assert actions.count(AuditAction.ACCEPTED) == 1
    assert len(rig.backups) == 1
    events = history_of(rig.cell_file).events
    assert len(events) == 1


ERRORS = (KeyboardInterrupt, JobHeld)


def job_error() -> JobHeld:
    """An error that ends a session for now."""
    return JobHeld("x", found="y", expected="z", remedy="w")


def interrupted_at_each(
    folder: Path,
    made: MadeSession,
    calls: list[str],
    names: tuple[str, ...],
    kind: type[BaseException],
    *,
    after: bool,
) -> int:
    """Interrupt a session of its own at each call of some tools; return how many there were."""
    interrupted = 0
    for at, name in enumerate(calls):
        if name not in names:
            continue
        error: BaseException = job_error()
        if kind is KeyboardInterrupt:
            error = KeyboardInterrupt()
        rig = made_session_rig(folder / f"{at}-{name}", made)
        interruption = Interruption(error, at, after=after)
        ends_the_same_after(rig, interruption, error)
        interrupted += 1
    return interrupted


@pytest.mark.processes
@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
@pytest.mark.parametrize("kind", ERRORS)
def test_a_session_that_is_interrupted_at_any_call_ends_with_the_same_outcome(
    tmp_path: Path,
    made_session: MadeSession,
    calls: list[str],
    kind: type[BaseException],
    after: bool,
) -> None:
    interrupted = interrupted_at_each(tmp_path, made_session, calls, CALLED, kind, after=after)
    assert interrupted == len(calls)


@pytest.mark.parametrize("name", QUICK)
def test_a_session_that_is_interrupted_goes_on_with_the_same_command(
    tmp_path: Path, made_session: MadeSession, calls: list[str], name: str
) -> None:
    """At the last call of a tool; Ctrl-C before it, an error right after it has done its work."""
    last = max(at for at, call in enumerate(calls) if call == name)
    before = KeyboardInterrupt()
    before_folder = tmp_path / "before"
    rig = made_session_rig(before_folder, made_session)
    interruption = Interruption(before, last)
    ends_the_same_after(rig, interruption, before)
    after = job_error()
    after_folder = tmp_path / "after"
    rig = made_session_rig(after_folder, made_session)
    interruption = Interruption(after, last, after=True)
    ends_the_same_after(rig, interruption, after)


@pytest.mark.parametrize("killed_at", ["", "propose", "apply", "certify"])
def test_the_certificate_says_who_wrote_and_accepted_the_gains(
    tmp_path: Path, made_session: MadeSession, calls: list[str], killed_at: str
) -> None:
    """Also where the command that has the fit was ended before the write:
    its details are still on the page.
    """
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    save_report = partial(save_certificate, rig.cell_file, rig.cell)
    tools = replace(rig.tools, save_report=save_report)
    rig.tools = tools
    if killed_at:
        interruption = Interruption(KeyboardInterrupt(), calls.index(killed_at))
        rig.tools = interruption.tools(tools)
        with pytest.raises(KeyboardInterrupt):
            run_session(rig)
        report_folder = rig.session.folder / "report"
        assert "not written (as of " in (report_folder / "report.html").read_text()
        rig.tools = tools
    assert run_session(rig).outcome is Outcome.APPLIED
    report_path = rig.session.folder / "report" / "report.html"
    page = report_path.read_text()
    assert f"by {escape(WHO)} to demo.yaml; accepted on " in page
    assert "not written" not in page
    assert "Measured and predicted torques" in page
    event = only_event(rig, "certified")
    assert event["id"] in page
    assert "accepted on " in event["text"]


def test_a_certificate_that_cannot_be_written_again_is_a_warning_with_what_to_do(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)

    def refused(*_: object) -> Any:
        no_space = OSError(errno.ENOSPC, "No space left on device")
        raise OutputFailed.of(Path("report.html"), no_space)

    rig.tools = replace(rig.tools, certify=refused)
    assert run_session(rig).exit_code == ExitCode.OK
    (event,) = [
        event
        for event in rig.events
        if event["event"].startswith("the certificate is that of before")
    ]
    assert "drivegain certificate " in event["text"]


def test_a_result_that_is_no_number_accepts_nothing(
    tmp_path: Path, made_session: MadeSession
) -> None:
    """An axis that did not move in the acceptance run has no scale."""
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    moved = made_session.after.use.copy()
    moved[-1] = False
    validation = replace(made_session.after, use=moved)
    rig.tools = replace(rig.tools, validate=lambda *_: (validation,))
    with np.errstate(invalid="ignore"):
        assert run_session(rig).outcome is Outcome.APPLIED
    acceptance = state_of(rig).acceptance
    assert acceptance is not None
    assert "J6 did not move" in acceptance.remark
    actions = {entry.action for entry in rig.audit}
    assert AuditAction.NOT_ACCEPTED in actions


def test_a_session_that_was_killed_right_after_its_write_does_not_write_again(
    tmp_path: Path, made_session: MadeSession
) -> None:
    """As a loss of power leaves it: the controller's file is new,
    and the state is that of before the write.
    """
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    before: list[bytes] = []
    write = rig.tools.apply

    def lost_power(*given: Any, **further: Any) -> Any:
        state_path = rig.session.folder / "state.json"
        before.append(state_path.read_bytes())
        write(*given, **further)
        raise KeyboardInterrupt

    rig.tools = replace(rig.tools, apply=lost_power)
    with pytest.raises(KeyboardInterrupt):
        run_session(rig)
    (rig.session.folder / "state.json").write_bytes(before[0])
    written = rig.controller.read_bytes()
    rig.tools = made_session.tools(rig)
    rig.clock.go_on(minutes=5)
    assert run_session(rig).outcome is Outcome.APPLIED
    assert rig.controller.read_bytes() == written
    actions = [entry.action for entry in rig.audit]
    assert actions.count(AuditAction.APPLY_BEGUN) == 1
    assert state_of(rig).acceptance is not None


def test_the_interlock_is_asked_before_every_motion(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session, warm_up_min=0)
    events: list[str] = []
    tools = rig.tools

    def run(command: Any, *further: Any) -> Any:
        events.append("interlock")
        return tools.run(command, *further)

    def record(request: RecordingRequest, **further: Any) -> Recorded:
        recorded: Recorded = tools.record(request, **further)
        events.append("motion")
        return recorded

    rig.tools = replace(tools, run=run, record=record)
    run_session(rig)
    motion_count = len(FIRST_BLOCKS) + 1
    assert events.count("motion") == motion_count
    for before, event in pairwise(["", *events]):
        if event == "motion":
            assert before == "interlock"


def test_an_interlock_that_opens_between_blocks_ends_the_session_there(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)

    def put(payload: str | None) -> None:
        if payload is not None:
            rig.closed.unlink()

    operator = given_answers(rig, put=put)
    assert ended_with(rig, operator) == ExitCode.NOT_RELEASED
    runs = rig.session.state.runs
    assert names_of(runs) == ["block-1-bare"]
    rig.closed.touch()
    assert run_session(rig).outcome is Outcome.APPLIED
    assert rig.session.state.attempt == 2


def ended_with(rig: Rig, operator: GivenAnswers) -> int | None:
    """Exit code of a session that an error ends."""
    with pytest.raises((NotReleased, CalibrationRefused)):
        run_session(rig, operator)
    return rig.session.state.exit_code


def test_a_session_ends_when_its_time_is_up_and_says_what_was_not_reached(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    ended = run_session(rig, target_percent=0.1, time_limit_min=0.3)
    state = state_of(rig)
    assert ended.outcome is Outcome.APPLIED
    assert len(state.blocks) == len(FIRST_BLOCKS)
    assert "the target is 0.1 %" in state.missing
    assert "J3" in state.missing
    text = (rig.session.folder / "summary.txt").read_text()
    assert f"Not reached: {state.missing}" in text


def test_a_closed_gate_refuses_the_write_and_the_session_is_over(
    tmp_path: Path, made_session: MadeSession
) -> None:
    policy = {"motion": "allowed", "apply": {"by": "job", "max_std_percent": 0.2}}
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    change_cell_file(rig, policy=policy)
    before = rig.controller.read_bytes()
    assert ended_with(rig, given_answers(rig)) == ExitCode.CALIBRATION_REFUSED
    assert rig.controller.read_bytes() == before
    assert rig.session.state.outcome is Outcome.REFUSED
    assert rig.session.finished


def test_without_yes_nothing_is_written_and_the_command_for_later_is_said(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    before = rig.controller.read_bytes()
    operator = given_answers(rig, writes=False)
    ended = run_session(rig, operator)
    assert ended.outcome is Outcome.PROPOSED
    assert ended.exit_code == ExitCode.PROPOSED
    assert rig.controller.read_bytes() == before
    assert state_of(rig).acceptance is None
    text = (rig.session.folder / "summary.txt").read_text()
    assert f"drivegain apply {rig.cell_file}" in text


def test_a_rehearsal_makes_the_moves_of_the_first_blocks_slowly_and_leaves_no_log(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    made: list[tuple[str, float, float]] = []
    record = rig.tools.record

    def noting(request: RecordingRequest, **further: Any) -> Recorded:
        name = request.out.stem
        made.append((name, request.speed, request.plan.duration_s))
        if name != "warm-up":
            recorded: Recorded = record(request, **further)
            return recorded
        further["require_released"]()
        request.out.touch()
        if len(made) == 2:
            raise KeyboardInterrupt
        return made_session.recorded["block-1-bare"]

    rig.tools = replace(rig.tools, record=noting)
    with pytest.raises(KeyboardInterrupt):
        run_session(rig, rehearse=True)
    outcome = run_session(rig, rehearse=True).outcome
    assert outcome is Outcome.APPLIED
    slow = [entry for entry in made if entry[0] == "warm-up"]
    speeds = [speed for _, speed, _ in slow]
    assert speeds == [0.25] * 4
    seeds = (0, 1, 1, 2)
    for (_, _, slow_s), seed in zip(slow, seeds, strict=True):
        full_s = made_session.plans[seed].duration_s
        assert slow_s > 2.0 * full_s
    files = rig.session.folder.glob("warm-up*")
    assert not list(files)
    at_full_speed = [name for name, speed, _ in made if speed == 1.0]
    assert at_full_speed == [*FIRST_NAMES, "acceptance"]


def test_a_second_terminal_learns_that_the_bus_is_taken(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    taken = bus_lock(rig.cell, rig.folder)
    with taken, pytest.raises(BusTaken, match="one at a time"):
        run_session(rig)
    assert rig.sessions == ()


def test_the_target_is_in_the_cell_file_and_no_log_depends_on_it(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    before = rig.cell
    assert before.target_sigma_percent == 0.5
    change_cell_file(rig, target_sigma_percent=0.8)
    assert rig.cell.target_sigma_percent == 0.8
    assert rig.cell.recording_digest == before.recording_digest
    change_cell_file(rig, target_sigma_percent=0.0)
    with pytest.raises(ConfigurationError, match="target_sigma_percent"):
        load_cell(rig.cell_file)


def test_job_session_and_demonstration_take_the_same_stages(
    tmp_path: Path, made_session: MadeSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They differ in the schedule of runs and in the operator;
    a session accepts, and the demonstration has no page.
    """
    taken: list[tuple[Stage, ...]] = []

    def noting(stages: tuple[Stage, ...], *_: object) -> Session:
        taken.append(stages)
        raise job_error()

    for module in (job, guided_session, demo):
        monkeypatch.setattr(module, "run_stages", noting)
    folder = tmp_path / "job"
    with pytest.raises(JobHeld):
        made_session_rig(folder, made_session).job()
    session_folder = tmp_path / "session"
    with pytest.raises(JobHeld):
        run_session(made_session_rig(session_folder, made_session))
    cell_file = shipped_configurations() / "cells" / "demo.yaml"
    out = tmp_path / "demo"
    out.mkdir()
    simulation = tmp_path / "not-read.yaml"
    settings = demo.Settings(out, simulation, 1, 10.0)
    reporter = demo.ProgressReporter(lambda _: None, lambda *_: None)
    cell = load_cell(cell_file)
    demo_stages = demo.DemoStages(settings, cell, lambda: BEGAN, reporter)
    with pytest.raises(JobHeld):
        demo_stages.run(cell_file)
    of_job, of_session, of_demo = taken
    expected = [Record, Identify, WatchDrift, Decide]
    assert [type(stage) for stage in of_demo] == expected
    assert of_demo is TO_DECISION
    assert of_job[:-1] == of_demo
    assert of_session[:-2] == of_demo
    assert type(of_session[-2]) is Accept
    assert type(of_session[-1]) is Certify
    assert type(of_job[-1]) is Certify


# Blocks for the worst gain


LATER_BLOCKS = {
    "block-2-bare": "block-1-bare",
    "block-4-loaded": "block-2-loaded",
    "block-5-loaded": "block-2-loaded",
    "block-5-bare": "block-1-bare",
}
"""Which of the first blocks another one is a copy of."""


def aimed_rig(folder: Path, made: MadeSession, planned: list[dict[str, Any]]) -> Rig:
    """A session whose gains are never precise:
    later blocks are copies of the first ones, with plans of their own.
    """
    rig = made_session_rig(folder, made)
    tools = rig.tools

    def plan_later(cell: Cell, *, seed: int, duration_s: float, **further: Any) -> Plan:
        if "box" not in further:
            return made.plans[seed]
        planned.append(further)
        return plan(cell, seed=seed, duration_s=duration_s, exchanges=24, **further)

    def record_later(request: RecordingRequest, **further: Any) -> Recorded:
        name = LATER_BLOCKS.get(request.out.stem)
        if name is None:
            recorded: Recorded = tools.record(request, **further)
            return recorded
        # The same content, which the calibration that was made names as its source.
        content = request.out.with_name(f"{name}.mcap").read_bytes()
        request.out.write_bytes(content)
        return replace(made.recorded[name], path=request.out)

    rig.tools = replace(tools, plan=plan_later, record=record_later, preview=save_preview)
    return rig


@pytest.fixture(scope="module")
def aimed_session(
    tmp_path_factory: pytest.TempPathFactory, made_session: MadeSession
) -> tuple[Rig, list[dict[str, Any]], Conclusion]:
    """A session of five blocks, at whose end the time is up."""
    planned: list[dict[str, Any]] = []
    folder = tmp_path_factory.mktemp("aimed") / "cell"
    rig = aimed_rig(folder, made_session, planned)
    time_limit_min = 5 * BLOCK_S / 60.0
    ended = run_session(rig, target_percent=0.05, time_limit_min=time_limit_min)
    return rig, planned, ended


def test_from_the_fourth_block_on_moves_are_for_the_worst_gain(
    aimed_session: tuple[Rig, list[dict[str, Any]], Conclusion],
) -> None:
    rig, planned, _ = aimed_session
    state = state_of(rig)
    later_blocks = names_of(state.blocks)[3:]
    assert later_blocks == ["block-4-loaded", "block-5-bare"]
    mounted = [further["experiment"].mounted for further in planned]
    assert mounted == [(0,), (None,)]
    for further in planned:
        goal = further["goal"]
        design = further["experiment"].design
        # By the plan's own ratio the worst gain is that of the last estimate.
        std_percent = design.std_percent(goal.recorded)
        ratio = goal.ratio(std_percent)
        estimated = distance_to_target(state)
        assert ratio.tolist() == pytest.approx(estimated)
    worst = max(state.gains, key=lambda gain: gain.std_percent)
    page = (rig.session.folder / "plan-4.html").read_text()
    assert (
        f"Planned for the gain that is farthest from its target after 3 blocks: {worst.axis},"
    ) in page
    plan_1_path = rig.session.folder / "plan-1.html"
    assert "Planned for" not in plan_1_path.read_text()
    assert all(gain.cause for gain in state.gains)


def test_with_friction_by_payload_all_bare_blocks_come_before_the_payload(
    tmp_path: Path, made_session: MadeSession
) -> None:
    planned: list[dict[str, Any]] = []
    folder = tmp_path / "cell"
    rig = aimed_rig(folder, made_session, planned)
    change_cell_file(rig, friction_by_payload=True)
    predicted_percent = max(made_session.plans[0].predicted_std_percent)
    # By the first plan two bare blocks are enough. This rig has no third block that is loaded.
    time_limit_min = 20 * BLOCK_S / 60.0
    target_percent = predicted_percent / 1.3
    with pytest.raises(KeyError, match="block-3-loaded"):
        run_session(rig, target_percent=target_percent, time_limit_min=time_limit_min)
    state = state_of(rig)
    assert state.bare_first == 2
    assert names_of(state.blocks) == ["block-1-bare", "block-2-bare", "block-3-loaded"]
    assert planned == []


def moves_of_plans(rig: Rig, *numbers: int) -> list[PlannedMove]:
    """Moves of a session's plans, one plan after another."""
    moves: list[PlannedMove] = []
    for number in numbers:
        path = rig.session.folder / f"plan-{number}.yaml"
        moves.extend(load_plan(path, rig.cell).moves)
    return moves


def test_later_blocks_stay_where_the_accepted_ones_were(
    aimed_session: tuple[Rig, list[dict[str, Any]], Conclusion],
) -> None:
    rig, _, _ = aimed_session
    accepted = moves_of_plans(rig, 1, 2, 3)
    target_rad = [move.target_rad for move in accepted]
    lower = np.min(target_rad, axis=0) - 2e-5
    upper = np.max(target_rad, axis=0) + 2e-5
    largest_velocity = max(move.velocity for move in accepted)
    largest_acceleration = max(move.acceleration for move in accepted)
    for move in moves_of_plans(rig, 4, 5):
        target = np.array(move.target_rad)
        assert (target >= lower).all()
        assert (target <= upper).all()
        assert move.velocity <= largest_velocity
        assert move.acceleration <= largest_acceleration


def test_at_the_time_limit_it_says_what_is_missing_and_what_would_help(
    aimed_session: tuple[Rig, list[dict[str, Any]], Conclusion],
) -> None:
    rig, _, ended = aimed_session
    state = state_of(rig)
    assert state.complete
    assert "the target is 0.05 %" in state.missing
    more_time, *by_axis = state.would_help
    assert "--time-limit" in more_time
    helped_axes = [line.split(":")[0] for line in by_axis]
    assert helped_axes == [gain.axis for gain in state.gains]
    event = only_event(rig, "time is up")
    assert event["would_help"] == list(state.would_help)
    said = ending(ended, rig.cell_file)
    assert "What would help:" in said
    assert more_time in said
    # σ falls as 1/√time of the blocks that are in the fit.
    worst = max(distance_to_target(state))
    fitted_s = state.progress[-1].fitted_s
    assert fitted_s == 4 * BLOCK_S
    further_s = 4 * BLOCK_S * (worst**2 - 1.0)
    needed_min = (5 * BLOCK_S + further_s) / 60.0
    time_limit = math.ceil(needed_min)
    assert f"--time-limit {time_limit})" in more_time


def test_a_damaged_plan_for_the_worst_gain_is_made_again_in_the_same_room(
    tmp_path: Path, made_session: MadeSession
) -> None:
    planned: list[dict[str, Any]] = []
    folder = tmp_path / "cell"
    rig = aimed_rig(folder, made_session, planned)

    def stop_before(payload: str | None) -> None:
        runs = rig.session.state.runs
        if len(runs) == len(FIRST_BLOCKS):
            raise KeyboardInterrupt

    time_limit_min = 4 * BLOCK_S / 60.0
    limits: dict[str, Any] = {"target_percent": 0.05, "time_limit_min": time_limit_min}
    operator = given_answers(rig, put=stop_before)
    with pytest.raises(KeyboardInterrupt):
        run_session(rig, operator, **limits)
    (rig.session.folder / "plan-4.yaml").write_text("damaged")
    rig.clock.go_on(minutes=5)
    run_session(rig, **limits)
    aimed, again = planned
    assert "goal" in aimed
    assert "goal" not in again
    lower = again["box"].lower.tolist()
    expected = aimed["box"].lower.tolist()
    assert lower == expected
    assert again["speed"] == aimed["speed"]


# Mistakes in a block


PAYLOAD = "disc"


class Scale:
    """Says what is on the flange, as `look_at_block` finds it by the moves;
    what is mounted is in a file.

    Attributes:
        looked: name of each block that was looked at.
    """

    def __init__(self, rig: Rig, *bodies: float) -> None:
        """Store the masses that the blocks have carried, in the order of their recording [kg]."""
        self.looked: list[str] = []
        self._bodies = list(bodies)
        self._carried: dict[bytes, float] = {}

    def __call__(self, cell: Cell, log: Path, earlier: Sequence[Path]) -> BlockFacts:
        """Return the mass beyond the earlier blocks."""
        self.looked.append(log.stem)
        carried_kg = self._bodies.pop(0)
        self._carried[log.read_bytes()] = carried_kg
        others = [self._carried[one.read_bytes()] for one in earlier]
        if not others:
            return BlockFacts()
        added_kg = carried_kg - sum(others) / len(others)
        return BlockFacts(added_kg=added_kg, added_std_kg=0.08)

    def numbers(self) -> str:
        """Return the numbers of the blocks that were looked at, in their order."""
        numbers = [name.split("-")[1] for name in self.looked]
        return "".join(numbers)


@pytest.mark.parametrize(
    ("bodies", "looked", "said"),
    [
        ((0.0, 4.6, 4.6), "123", ""),
        ((0.0, 0.1, 4.6, 4.6), "1223", "DISC was missing. Mount it"),
        ((4.6, 0.0, 0.0, 4.6, 4.6), "12123", "the two were exchanged"),
        ((0.0, 1.7, 4.6, 4.6), "1223", "another body was mounted"),
        ((0.0, 4.6, 0.0, 4.6), "1233", "4.6 kg less than in the loaded blocks before"),
        ((0.0, 4.6, 6.3, 4.6), "1233", "1.7 kg more than in the loaded blocks before"),
    ],
)
def test_a_block_with_the_wrong_body_is_recorded_again_and_kept(
    tmp_path: Path, made_session: MadeSession, bodies: tuple[float, ...], looked: str, said: str
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    scale = Scale(rig, *bodies)
    rig.tools = replace(rig.tools, look=scale)
    assert run_session(rig).outcome is Outcome.APPLIED
    assert scale.numbers() == looked
    mistakes = events_named(rig, "mistake in a block")
    assert len(mistakes) == int(bool(said))
    for mistake in mistakes:
        assert said in mistake["text"]
    replaced = list(rig.session.folder.glob("*-aside-*.mcap"))
    recorded_again = len(looked) - len(FIRST_BLOCKS)
    assert len(replaced) == recorded_again
    runs = state_of(rig).runs
    assert len(runs) == len(FIRST_BLOCKS)


def test_a_body_that_was_there_from_the_beginning_costs_every_block(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    scale = Scale(rig, 4.6, 4.6, 4.6, 0.0, 4.6, 4.6)
    rig.tools = replace(rig.tools, look=scale)
    assert run_session(rig).outcome is Outcome.APPLIED
    assert scale.numbers() == "122123"
    first, second = events_named(rig, "mistake in a block")
    assert "DISC was missing" in first["text"]
    assert (
        "if DISC is mounted now, it was there before, too. All of these are recorded again"
    ) in second["text"]


def made_block(name: str, payload: str | None) -> Block:
    """A recorded block, weighed where it has a payload."""
    mass_kg = None
    if payload is not None:
        mass_kg = MASS_KG
    return Block(name=name, payload=payload, mass_kg=mass_kg, holdout=False, plan="")


def test_bare_blocks_are_compared_before_any_payload_was_weighed(
    tmp_path: Path, made_session: MadeSession
) -> None:
    """With `friction_by_payload`, several bare blocks come first."""
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    names = ("block-1-bare", "block-2-bare", "block-3-bare")
    blocks = [made_block(name, None) for name in names]
    facts = BlockFacts(added_kg=4.4, added_std_kg=0.05)
    left_on = mistake_in(rig.cell, PAYLOAD, blocks, facts)
    assert left_on is not None
    assert left_on.blocks == ("block-3-bare",)
    assert "take DISC off" in left_on.text
    block_facts = BlockFacts(added_kg=-4.4, added_std_kg=0.05)
    was_there = mistake_in(rig.cell, PAYLOAD, blocks, block_facts)
    assert was_there is not None
    assert was_there.blocks == names
    assert "4.4 kg less than in block-1-bare and block-2-bare" in was_there.text


def test_a_body_left_on_in_a_later_bare_block_is_noticed_there(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    blocks = [
        made_block("block-1", None),
        made_block("block-2", "disc"),
        made_block("block-3", "disc"),
        made_block("block-4", None),
    ]
    assert names_of(compared_with(blocks)) == ["block-1"]
    facts = BlockFacts(added_kg=4.5, added_std_kg=0.05)
    mistake = mistake_in(rig.cell, PAYLOAD, blocks, facts)
    assert mistake is not None
    assert mistake.blocks == ("block-4",)
    assert "take DISC off" in mistake.text
    block_facts = BlockFacts(added_kg=0.3, added_std_kg=0.05)
    assert mistake_in(rig.cell, PAYLOAD, blocks, block_facts) is None
    # A weighing that is too coarse tells nothing.
    too_coarse = BlockFacts(added_kg=4.5, added_std_kg=0.8)
    assert mistake_in(rig.cell, PAYLOAD, blocks, too_coarse) is None


def test_a_body_that_was_turned_between_two_loaded_blocks_is_noticed(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    blocks = [
        made_block("block-1", None),
        made_block("block-2", "disc"),
        made_block("block-3", "disc"),
    ]
    same_mass = BlockFacts(
        added_kg=0.1, added_std_kg=0.05, added_moment_kg_m=0.5, added_moment_std_kg_m=0.01
    )
    turned = mistake_in(rig.cell, PAYLOAD, blocks, same_mass)
    assert turned is not None
    assert turned.blocks == ("block-3",)
    assert "about 109 mm away" in turned.text
    facts = replace(same_mass, added_moment_kg_m=0.05)
    mistake = mistake_in(rig.cell, PAYLOAD, blocks, facts)
    assert mistake is None
    changed_same_mass = replace(same_mass, added_moment_std_kg_m=0.2)
    assert mistake_in(rig.cell, PAYLOAD, blocks, changed_same_mass) is None


def test_a_bare_block_that_is_recorded_again_is_weighed_beside_loaded_ones(
    tmp_path: Path, made_session: MadeSession
) -> None:
    """The log of the first block was damaged; nothing is wrong with the others."""
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    blocks = [
        made_block("block-2", "disc"),
        made_block("block-3", "disc"),
        made_block("block-1", None),
    ]
    assert names_of(compared_with(blocks)) == ["block-2", "block-3"]
    facts = BlockFacts(added_kg=-MASS_KG, added_std_kg=0.05)
    mistake = mistake_in(rig.cell, PAYLOAD, blocks, facts)
    assert mistake is None
    block_facts = BlockFacts(added_kg=0.1, added_std_kg=0.05)
    still_on = mistake_in(rig.cell, PAYLOAD, blocks, block_facts)
    assert still_on is not None
    assert still_on.blocks == ("block-1",)
    assert still_on.text.endswith("take DISC off.")


def test_a_session_goes_on_with_its_own_payload_alone(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    document = json.loads(rig.cell_file.read_text(encoding="utf-8"))
    payloads = document["payloads"]
    other = {**payloads[0], "name": "ring", "mounting": "ring-a"}
    change_cell_file(rig, payloads=[*payloads, other])

    def stop_before_the_third(payload: str | None) -> None:
        if len(rig.session.state.runs) == 2:
            raise KeyboardInterrupt

    operator = given_answers(rig, put=stop_before_the_third)
    with pytest.raises(KeyboardInterrupt):
        run_session(rig, operator)
    rig.clock.go_on(minutes=5)
    with pytest.raises(
        ConfigurationInconsistent, match="found a session whose blocks carry 'disc'"
    ) as caught:
        run_session(rig, payload="ring")
    assert "--payload disc" in str(caught.value)


def test_an_axis_at_its_current_limit_and_an_unreadable_log_are_mistakes(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    blocks = [made_block("block-1-bare", None)]
    saturated_percent = (0.0, 0.0, 4.2, 0.0, 0.0, 0.0)
    facts = BlockFacts(saturated_percent=saturated_percent)
    saturated = mistake_in(rig.cell, PAYLOAD, blocks, facts)
    assert saturated is not None
    assert "J3 was at its current limit for 4.2 %" in saturated.text
    block_facts = BlockFacts(unreadable="a jump of 3 rad: see to the encoder")
    unreadable = mistake_in(rig.cell, PAYLOAD, blocks, block_facts)
    assert unreadable is not None
    assert "see to the encoder" in unreadable.text


def test_a_mistake_that_stays_ends_the_session_with_what_to_do(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    unreadable = BlockFacts(unreadable="no encoder: see to it")
    rig.tools = replace(rig.tools, look=lambda *_: unreadable)
    with pytest.raises(JobHeld, match="a mistake in 4 recordings"):
        run_session(rig)
    rig.tools = made_session.tools(rig)
    assert run_session(rig).outcome is Outcome.APPLIED


def test_a_person_may_keep_a_block_with_a_mistake(
    tmp_path: Path, made_session: MadeSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    scale = Scale(rig, 0.0, 1.7, 1.7)
    rig.tools = replace(rig.tools, look=scale)
    typed = [*ENTER, *WEIGHED, *ENTER, "keep", *ENTER, "yes", *ENTER]
    operator = person(rig, monkeypatch, lines(typed))
    assert run_session(rig, operator).outcome is Outcome.APPLIED
    assert len(scale.looked) == len(FIRST_BLOCKS)


def test_a_block_that_no_fit_can_use_is_recorded_again_without_a_question(
    tmp_path: Path, made_session: MadeSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kept, it would end every fit of the session."""
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    look = rig.tools.look
    looked: list[Path] = []

    def unreadable_at_first(cell: Cell, log: Path, earlier: Sequence[Path]) -> BlockFacts:
        looked.append(log)
        if len(looked) == 1:
            return BlockFacts(unreadable="a jump of 3 rad: see to the encoder")
        return look(cell, log, earlier)

    rig.tools = replace(rig.tools, look=unreadable_at_first)
    typed = [*ENTER, *ENTER, *WEIGHED, *ENTER, *ENTER, "yes", *ENTER]
    operator = person(rig, monkeypatch, lines(typed))
    assert run_session(rig, operator).outcome is Outcome.APPLIED
    assert len(looked) == len(FIRST_BLOCKS) + 1
    assert looked[0] == looked[1]


def test_an_earlier_log_that_cannot_be_read_is_no_mistake_of_a_sound_block(
    tmp_path: Path, made_session: MadeSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = made_session_rig(tmp_path / "cell", made_session)
    sound = tmp_path / "sound.mcap"
    torn = tmp_path / "torn.mcap"

    def load(log: Path, _cell: Cell) -> tuple[SimpleNamespace, None]:
        if log == torn:
            raise DataError(str(log), found="torn", expected="a log", remedy="record it again")
        return SimpleNamespace(recording=None), None

    monkeypatch.setattr("daq.jobs.block_check.load_run", load)
    facts = look_at_block(rig.cell, sound, [torn])
    assert facts.unreadable == ""
    assert look_at_block(rig.cell, torn, [sound]).unreadable != ""


def test_the_moves_show_what_is_on_the_flange(whole_session: tuple[Rig, MadeSession]) -> None:
    """Weighed with the nameplate gains, which are up to 25 % off,
    from the recordings of a real session.
    """
    rig, made = whole_session
    bare = made.logs["block-1-bare"]
    loaded = made.logs["block-2-loaded"]
    held_out = made.logs["block-3-held-out"]
    first = look_at_block(rig.cell, loaded, [bare])
    again = look_at_block(rig.cell, held_out, [loaded])
    exchanged = look_at_block(rig.cell, bare, [loaded])
    assert first.added_kg == pytest.approx(MASS_KG, rel=0.1)
    assert again.added_kg == pytest.approx(0.0, abs=0.3)
    assert again.added_moment_kg_m < 0.02 * MASS_KG
    assert first.added_moment_kg_m > 0.05 * MASS_KG
    assert exchanged.added_kg == pytest.approx(-MASS_KG, rel=0.1)
    look = look_at_block(rig.cell, bare, [])
    assert look.added_kg is None
    assert first.unreadable == ""


def test_a_cell_file_that_changes_between_blocks_is_refused_with_the_way_out(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    before = rig.cell_file.read_bytes()

    def put(payload: str | None) -> None:
        rig.cell_file.write_bytes(before + b"\n# looked at\n")

    operator = given_answers(rig, put=put)
    with pytest.raises(ConfigurationInconsistent, match="put the old content back") as caught:
        run_session(rig, operator)
    assert "residual" not in str(caught.value)  # no block with the payload yet
    runs = rig.session.state.runs
    assert names_of(runs) == ["block-1-bare"]
    rig.cell_file.write_bytes(before)
    assert run_session(rig).outcome is Outcome.APPLIED
    assert rig.session.state.attempt == 2


def test_blocks_of_a_session_whose_cell_file_was_corrected_are_not_lost(
    tmp_path: Path, made_session: MadeSession
) -> None:
    cell_folder = tmp_path / "cell"
    rig = made_session_rig(cell_folder, made_session)
    before = rig.cell_file.read_bytes()
    mounted = count(1)

    def put(payload: str | None) -> None:
        if next(mounted) == 2:
            rig.cell_file.write_bytes(before + b"\n# looked at\n")

    operator = given_answers(rig, put=put)
    with pytest.raises(ConfigurationInconsistent) as caught:
        run_session(rig, operator)
    folder = rig.session.folder
    command = (
        f"`drivegain residual {folder}/block-1-bare.mcap {folder}/block-2-loaded.mcap --cell "
        f"{rig.cell_file} --out {folder}/corrected.yaml`"
    )
    message = str(caught.value)
    hint = f"The recorded blocks are not lost: {command} fits them with the new content"
    assert hint in message

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    rig.tools = replace(rig.tools, drives=stop)  # before anything moves
    with pytest.raises(KeyboardInterrupt):
        run_session(rig)
    event = only_event(rig, "an unfinished session is not taken up")
    assert f"Its blocks are not lost: {command}" in event["reason"]


def test_what_the_fit_says_to_check_is_to_do(tmp_path: Path, made_session: MadeSession) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    late = Diagnosis(
        "current-late",
        (),
        ("J2",),
        "a current that is late by 2 ms",
        "no delay",
        "declare its delay",
    )
    made = rig.tools.calibration

    def with_late_current(*given: Any) -> Any:
        return replace(made(*given), diagnoses=(late,))

    rig.tools = replace(rig.tools, calibration=with_late_current)
    ended = run_session(rig)
    assert ended.outcome is Outcome.APPLIED
    check = "CHECK J2: declare its delay"
    steps = to_do(ended, rig.cell_file)
    assert steps[-1] == check
    unchanged = replace(ended, outcome=Outcome.UNCHANGED)
    assert to_do(unchanged, rig.cell_file) == [check]


@pytest.mark.parametrize(("name", "is_mended"), [("zero-off", True), (CORRECTION_UNCLEAR, False)])
def test_a_wrong_description_is_to_be_corrected_before_anything_is_applied(
    tmp_path: Path,
    made_session: MadeSession,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    is_mended: bool,
) -> None:
    """Where two corrections are alike, none is to be made, and no blocks are fitted with it."""
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    ended = run_session(rig)
    wrong = Diagnosis(
        name, (), ("J2",), "the zero of J2 off by 2°", "that of the URDF", "see to J2"
    )
    calibration = replace(made_session.calibration, diagnoses=(wrong,))
    monkeypatch.setattr(reporting, "calibration_of_session", lambda _: calibration)
    proposed = replace(ended, outcome=Outcome.PROPOSED)
    steps = to_do(proposed, rig.cell_file)
    check = steps.index("CHECK J2: see to J2")
    is_applying = [step.startswith("drivegain apply") for step in steps]
    applying = is_applying.index(True)
    assert (check < applying) is is_mended
    refits = [step for step in steps if step.startswith("with the corrected file")]
    assert len(refits) == int(is_mended)


TURNED = Diagnosis(
    "gravity-turned", (), (), "gravity along [0, 1, 0]", "gravity along [0, 0, -1]", "correct it"
)


def test_a_wrong_geometry_ends_the_session_before_a_payload_is_blamed(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    judged: list[list[str]] = []

    def geometry(cell: Cell, logs: Sequence[Path]) -> Diagnosis | None:
        judged.append([log.stem for log in logs])
        return TURNED

    look = Scale(rig, 0.0, 0.1)
    rig.tools = replace(rig.tools, look=look, geometry=geometry)
    with pytest.raises(GeometryTurned, match="the mounting: found gravity along") as caught:
        run_session(rig)
    assert judged == [["block-1-bare", "block-2-loaded"]]
    assert events_named(rig, "mistake in a block") == []
    runs = rig.session.state.runs
    assert names_of(runs) == ["block-1-bare", "block-2-loaded"]
    kept, hint = caught.value.__notes__
    assert kept == "kept: block-1-bare, block-2-loaded"
    assert hint.startswith("hint: correct the cell file; `drivegain residual")
    assert hint.endswith("the same command begins a new session")


def test_a_wrong_geometry_of_the_fit_asks_for_no_further_block(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    turned = replace(made_session.fitted, diagnoses=(TURNED,))
    rig.tools = replace(rig.tools, fit=lambda logs, *, holdout: turned)
    with pytest.raises(GeometryTurned, match="the mounting: found gravity along"):
        run_session(rig)
    runs = rig.session.state.runs
    assert len(runs) == len(FIRST_BLOCKS)
    assert rig.session.state.outcome is Outcome.UNFIT


def test_exchanged_currents_ask_for_no_further_block(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)

    def refused(logs: Sequence[Path], *, holdout: Sequence[Path]) -> Fit:
        raise ChannelsExchanged(
            "J1 and J2", found="each other's", expected="their own", remedy="record again"
        )

    rig.tools = replace(rig.tools, fit=refused)
    with pytest.raises(ChannelsExchanged) as caught:
        run_session(rig)
    runs = rig.session.state.runs
    assert len(runs) == len(FIRST_BLOCKS)
    next_step = "correct the wiring or the cell file; the same command then begins a new session"
    last_note = caught.value.__notes__[-1]
    assert last_note == f"hint: {next_step}"
    first = rig.session.folder
    assert next_step in (first / SUMMARY_TEXT).read_text()
    # The wiring was corrected, and the cell file is what it was: other blocks are recorded.
    rig.tools = made_session.tools(rig)
    rig.clock.go_on(minutes=5)
    assert run_session(rig).outcome is Outcome.APPLIED
    assert len(rig.sessions) == 2


def test_gravity_that_is_described_wrongly_is_found_in_two_blocks(
    whole_session: tuple[Rig, MadeSession],
) -> None:
    rig, made = whole_session
    logs = [made.logs["block-1-bare"], made.logs["block-2-loaded"]]
    assert look_at_geometry(rig.cell, logs) is None
    x, y, z = rig.cell.gravity_m_s2
    gravity_m_s2 = (z, y, x)
    on_the_wall = replace(rig.cell, gravity_m_s2=gravity_m_s2)
    found = look_at_geometry(on_the_wall, logs)
    assert found is not None
    assert found.name == "gravity-turned"


def test_a_log_that_is_damaged_before_the_end_is_recorded_again_in_its_place(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    tools = rig.tools

    def interrupted(*_: object, **__: object) -> Any:
        raise KeyboardInterrupt

    rig.tools = replace(tools, close_loop=interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_session(rig)
    (rig.session.folder / "block-2-loaded.mcap").write_bytes(b"damaged")
    rig.tools = tools
    assert run_session(rig).outcome is Outcome.APPLIED
    blocks = state_of(rig).blocks
    assert names_of(blocks) == FIRST_NAMES
    runs = state_of(rig).runs
    assert names_of(runs) == ["block-1-bare", "block-3-held-out", "block-2-loaded"]


# A person at the terminal


ENTER = ("", "")
"""A person who has mounted the payload, and lets the robot move."""
WEIGHED = ("4.59", "4.59")
TO_THE_WRITE = (*ENTER, *WEIGHED, *ENTER, *ENTER)
"""What a person types before the gains are to be written."""


def lines(typed: Sequence[str]) -> str:
    """Input with each entry on a line."""
    return "".join(f"{entry}\n" for entry in typed)


def person(rig: Rig, monkeypatch: pytest.MonkeyPatch, typed: str, **changed: Any) -> Person:
    """A person who types these lines."""
    typing = io.StringIO(typed)
    monkeypatch.setattr(sys, "stdin", typing)
    operator = Person(rig.cell, "a person", may_move=True, asks_before_motion=True)
    return replace(operator, **changed)


def test_a_person_who_answers_every_prompt_calibrates(
    tmp_path: Path,
    made_session: MadeSession,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    typed = [*ENTER, "4.59", "4,59", *ENTER, *ENTER, "yes", *ENTER]
    operator = person(rig, monkeypatch, lines(typed))
    assert run_session(rig, operator).outcome is Outcome.APPLIED
    assert sys.stdin.read() == ""
    said = capsys.readouterr().err
    assert "NOTHING on the flange" in said
    assert "DISC (4.59 kg)" in said
    blocks = state_of(rig).blocks
    mass_kg = {block.mass_kg for block in blocks}
    assert mass_kg == {None, MASS_KG}
    (applied,) = [entry for entry in rig.audit if entry.action is AuditAction.APPLIED]
    assert applied.who == "a person"


@pytest.mark.parametrize("answer", ["Yes", "YES", "y\nyes"])
def test_yes_in_either_case_writes_and_a_slip_is_asked_again(
    tmp_path: Path,
    made_session: MadeSession,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    answer: str,
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    typed = [*TO_THE_WRITE, answer, *ENTER]
    operator = person(rig, monkeypatch, lines(typed))
    assert run_session(rig, operator).outcome is Outcome.APPLIED
    error_output = capsys.readouterr().err
    is_repeated = "Found 'y', expected yes, or Enter alone." in error_output
    assert is_repeated == answer.startswith("y\n")


@pytest.mark.parametrize("answer", ["", "no", "No", "y\n"])
def test_anything_but_yes_leaves_the_controller(
    tmp_path: Path, made_session: MadeSession, monkeypatch: pytest.MonkeyPatch, answer: str
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    typed = [*TO_THE_WRITE, answer]
    operator = person(rig, monkeypatch, lines(typed))
    ended = run_session(rig, operator)
    assert ended.outcome is Outcome.PROPOSED


@pytest.mark.parametrize(
    ("typed", "is_again"), [("keep\n", False), ("Keep\n", False), ("\n", True), ("kep\n\n", True)]
)
def test_keep_in_either_case_keeps_a_block(
    tmp_path: Path,
    made_session: MadeSession,
    monkeypatch: pytest.MonkeyPatch,
    typed: str,
    is_again: bool,
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    run = PlannedRun(name="bare-1", plan_file=Path("plan-1.yaml"))
    operator = person(rig, monkeypatch, typed)
    assert operator.record_again(run, ["bare-1"], "a mistake") == is_again
    assert sys.stdin.read() == ""


def test_the_mass_is_asked_again_until_it_is_the_same_twice(
    tmp_path: Path,
    made_session: MadeSession,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    operator = person(rig, monkeypatch, "4.59\n4.95\n" + "x\nx\n" + "4.59\n4.59\n")
    assert operator.weigh("disc") == MASS_KG
    error_output = capsys.readouterr().err
    assert error_output.count("two different numbers, or none") == 2


@pytest.mark.parametrize(
    ("typed", "expected"),
    [("4590\n4590\n", "in grams"), ("5.1\n5.1\n", "4.59 kg within 0.005 kg")],
)
def test_a_mass_in_grams_or_of_another_body_is_not_taken(
    tmp_path: Path,
    made_session: MadeSession,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    typed: str,
    expected: str,
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    operator = person(rig, monkeypatch, typed + "4.59\n4.59\n")
    assert operator.weigh("disc") == MASS_KG
    assert expected in capsys.readouterr().err


def test_input_that_ends_ends_the_session_where_it_is(
    tmp_path: Path, made_session: MadeSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    operator = person(rig, monkeypatch, "\n\n4.59\n")
    with pytest.raises(JobHeld, match="the input has ended"):
        run_session(rig, operator)
    runs = rig.session.state.runs
    assert names_of(runs) == ["block-1-bare"]
    assert run_session(rig).outcome is Outcome.APPLIED


def test_a_controllers_file_that_this_user_cannot_replace_is_said_before_anything_moves(
    tmp_path: Path, made_session: MadeSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another user may apply the calibration: the session goes on."""
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    (rig.controller.parent / f".{rig.controller.name}.lock").mkdir()
    operator = person(rig, monkeypatch, "")
    with pytest.raises(JobHeld, match="the input has ended"):
        run_session(rig, operator)
    said = rig.said.getvalue()
    assert said.count("this user cannot write the gains") == 1
    assert rig.session.state.runs == ()


def test_each_block_asks_before_power_comes_on(
    tmp_path: Path, made_session: MadeSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    block = PlannedRun(name="block-1-bare", plan_file=Path("plan-1.yaml"))
    without_enter = person(rig, monkeypatch, "")
    with pytest.raises(JobHeld, match="robot moves now"):
        without_enter.permit_motion(block)
    refused = person(rig, monkeypatch, "\n", may_move=False)
    with pytest.raises(MotionRefused, match="--enable-motion"):
        refused.permit_motion(block)
    assert sys.stdin.read() == "\n"


def test_the_verb_moves_nothing_without_enable_motion(
    tmp_path: Path, made_session: MadeSession, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    arguments = ["calibrate", str(rig.cell_file)]
    assert main(arguments) == ExitCode.USAGE
    assert "--enable-motion" in capsys.readouterr().err
    assert rig.sessions == ()


def test_yes_move_is_for_simulated_cells(
    tmp_path: Path, made_session: MadeSession, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    document = json.loads(rig.cell_file.read_text())
    document["bus"] = {"interface": "socketcan", "channel": "can7", "bitrate_bit_s": 1_000_000}
    document["sync"]["pacing"] = "timed"
    rig.cell_file.write_text(json.dumps(document))
    arguments = ["calibrate", str(rig.cell_file), "--enable-motion", "--yes-move"]
    assert main(arguments) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert UsageError.__name__ in said or "--yes-move" in said
    assert "socketcan" in said


@pytest.fixture
def _quick_planner(monkeypatch: pytest.MonkeyPatch) -> None:
    """The verb plans with 100 exchanges of moves in place of 3000:
    how good the plan is, is no matter of the table.
    """
    tools = calibrate_verb._tools

    def with_quick_plan(*given: Any) -> Tools:
        quick = partial(plan, exchanges=100, largest_condition=1e6, largest_std_percent=100.0)
        return replace(tools(*given), plan=quick)

    monkeypatch.setattr(calibrate_verb, "_tools", with_quick_plan)


@pytest.mark.usefixtures("_quick_planner")
def test_check_says_what_is_there_and_what_a_first_session_can_show(
    tmp_path: Path, made_session: MadeSession, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session, min_free_mb=1)
    arguments = ["calibrate", str(rig.cell_file), "--check", "--block", "8"]
    with serving(rig):
        assert main(arguments) == ExitCode.OK
        said = capsys.readouterr().out
        assert said.count("✓") == 4
        assert "disc, 4.59 kg within 0.005 kg" in said
        assert "J6" in said
        rig.closed.unlink()
        assert main(arguments) == ExitCode.CONFIGURATION
    said = capsys.readouterr().out
    assert "✗ disk, interlock, drives" in said
    assert "close the cell" in said
    assert rig.sessions == ()


@pytest.mark.usefixtures("_quick_planner")
def test_check_of_a_payload_that_the_cell_lacks_is_a_line_of_the_table(
    tmp_path: Path, made_session: MadeSession, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session, min_free_mb=1)
    cell_file = str(rig.cell_file)
    arguments = ["calibrate", cell_file, "--check", "--block", "8", "--payload", "anvil"]
    with serving(rig):
        assert main(arguments) == ExitCode.CONFIGURATION
    said = capsys.readouterr().out
    assert "✗ payload" in said
    assert "'anvil'" in said
    assert said.count("✓") == 3
