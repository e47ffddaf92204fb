"""A job that is killed (-9) at any step, and the next one, which goes on:
what was found is applied exactly once.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from daq.documents.session_state import Outcome
from daq.errors import ExitCode
from daq.jobs.context import Tools
from daq.ledger.audit import AuditAction
from daq.ledger.ledger import Verification, verify_ledger
from daq.workflow.record import RecordingRequest
from daq.writeback.file_target import FileTarget
from daq.writeback.target import rollback
from tests.daq.histories import history_of, ledger_of
from tests.daq.jobs.made import Made, made_rig
from tests.daq.jobs.rig import Rig
from tests.daq.killing import in_a_child

pytestmark = pytest.mark.processes

#: Tools that a job does not call
OF_GUIDED_SESSIONS = {"preview", "look", "validate", "network", "geometry"}
CALLED = tuple(
    field.name
    for field in fields(Tools)
    if field.name not in {"monotonic_s", "plan"} | OF_GUIDED_SESSIONS
)
"""What a job hands its work to: between two of these calls it reads and writes its own files."""


EFFECTS = ("record", "save_report", "apply", "certify")
PURE = ("close_loop", "calibration", "account")
"""Nothing is written between the fit and these: to be killed there is to be killed at the fit."""
FREQUENT = {"now": 6, "run": 6, "record": 2, "free": 2}
"""Of these calls every so manieth is enough here;
`tests.studies.recalibration_study --kills` takes every call.
"""


class Kill:
    """Counts the calls of a job's tools, and kills the process at one of them:
    before it, or behind it.
    """

    def __init__(self, at: int | None = None, *, behind: bool = False) -> None:
        self.calls: list[str] = []
        self._at = at
        self._behind = behind

    def tools(self, tools: Tools) -> Tools:
        return replace(tools, **{name: self._called(name, getattr(tools, name)) for name in CALLED})

    def _called(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **further: Any) -> Any:
            mine = len(self.calls) == self._at
            self.calls.append(name)
            if mine and not self._behind:
                os.kill(os.getpid(), signal.SIGKILL)
            found = function(*given, **further)
            if mine:
                os.kill(os.getpid(), signal.SIGKILL)
            return found

        return call


def killed_job(rig: Rig, kill: Kill) -> None:
    """The job in a process of its own, which does not survive it."""
    child = in_a_child(lambda: replace(rig, tools=kill.tools(rig.tools)).job().exit_code)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status)
    assert os.WTERMSIG(status) == signal.SIGKILL


def applied_once(rig: Rig) -> None:
    """Check the single write in every record of it."""
    session = rig.session
    assert session.state.outcome is Outcome.APPLIED
    actions = [entry.action for entry in rig.audit]
    assert actions.count(AuditAction.APPLIED) <= 1
    assert actions.count(AuditAction.APPLY_BEGUN) == 1
    assert actions[0] is AuditAction.RECALIBRATION_BEGUN
    assert actions[-1] is AuditAction.RECALIBRATION_ENDED
    assert len(rig.backups) == 1
    history = history_of(rig.cell_file)
    assert len(history.events) == len(history.entries) == 1
    assert rig.job().outcome is Outcome.NOT_DUE


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory, made: Made) -> list[str]:
    """System calls of a job that runs to its end."""
    folder = tmp_path_factory.mktemp("counted") / "cell"
    rig = made_rig(folder, made, metrics=None)
    kill = Kill()
    tools = kill.tools(rig.tools)
    changed_rig = replace(rig, tools=tools)
    assert changed_rig.job().outcome is Outcome.APPLIED
    return kill.calls


def test_every_step_is_among_the_calls(calls: list[str]) -> None:
    assert set(calls) == set(CALLED)
    assert calls.count("record") == 3
    assert calls.count("run") >= 6


@pytest.mark.parametrize("behind", [False, True], ids=["before", "behind"])
def test_a_job_that_is_killed_at_any_call_is_finished_by_the_next(
    tmp_path: Path, made: Made, calls: list[str], behind: bool
) -> None:
    """Before each call, and behind each that has an effect:
    what it made is there, and the state does not know it.
    """
    for at, name in enumerate(calls):
        chosen = name not in PURE and calls[:at].count(name) % FREQUENT.get(name, 1) == 0
        if chosen and (name in EFFECTS or not behind):
            folder = tmp_path / f"{at}-{name}"
            rig = made_rig(folder, made, metrics=None)
            kill = Kill(at, behind=behind)
            finished_by_the_next(rig, kill)


def finished_by_the_next(rig: Rig, kill: Kill) -> None:
    """Kill a job there, and let the next one finish it:
    what was found is in the controller's file, once.
    """
    before = rig.controller.read_bytes()
    killed_job(rig, kill)
    begun = bool(rig.sessions)
    whole = rig.controller.read_bytes()
    rig.clock.go_on(minutes=10)
    # Killed as the very last thing it was done already.
    outcome = rig.job().outcome
    if outcome is not Outcome.NOT_DUE:
        assert outcome is Outcome.APPLIED
        attempt = rig.session.state.attempt
        assert attempt == 1 + begun
    assert rig.controller.read_bytes() != before
    if whole != before:
        assert rig.controller.read_bytes() == whole
    applied_once(rig)


def killed_after(rig: Rig, wait_s: float) -> bool:
    """Run the job in a process of its own, and kill that after so long;
    return whether it was not done before.
    """
    child = in_a_child(lambda: rig.job().exit_code)
    time.sleep(wait_s)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


def finished_from_any_moment(rig: Rig, wait_s: float) -> tuple[bool, bool]:
    """Kill a job after so long, judge what it left, and let the next one finish it.

    Returns:
        whether it was killed before its end, and whether the controller had the new gains by then.
    """
    before = rig.controller.read_bytes()
    killed = killed_after(rig, wait_s)
    left = rig.controller.read_bytes()
    entered = bool(history_of(rig.cell_file).events)
    found = _verified(rig)
    # Killed before it ended its write, it left a begin: verify says so, and the next job ends it.
    assert found.complete == (left == before or entered)
    rig.clock.go_on(minutes=10)
    assert rig.job().exit_code == ExitCode.OK
    after = rig.controller.read_bytes()
    assert after != before
    assert left in (before, after)
    # Killed between backup and replacement, the next job backs the same content up once more.
    contents = {backup.read_bytes() for backup in rig.backups}
    assert contents == {before}
    assert _verified(rig).complete
    return killed, left == after


def _verified(rig: Rig) -> Verification:
    """`drivegain history --verify`, of an audit that holds and a history without a flaw,
    whatever it lacks.
    """
    found = verify_ledger(ledger_of(rig.cell_file))
    assert found.verdict.holds
    assert found.broken == ()
    return found


def test_a_job_that_is_killed_at_a_random_moment_is_finished_by_the_next(
    tmp_path: Path, made: Made
) -> None:
    """A few moments; `tests.studies.recalibration_study --moments 60` takes more."""
    folder = tmp_path / "whole"
    whole_s = job_duration_s(made_rig(folder, made, metrics=None))
    chance = random.Random(1)
    for number in range(4):
        rig = made_rig(tmp_path / str(number), made, metrics=None)
        wait_s = chance.uniform(0.0, whole_s)
        finished_from_any_moment(rig, wait_s)


def job_duration_s(rig: Rig) -> float:
    """Duration of a whole job [s]."""
    began_s = time.monotonic()
    assert rig.job().outcome is Outcome.APPLIED
    return time.monotonic() - began_s


@pytest.mark.parametrize("way", ["rollback", "cp", "edited"])
def test_a_rollback_by_hand_after_a_killed_write_is_not_written_again(
    tmp_path: Path, made: Made, calls: list[str], way: str
) -> None:
    """The file is as it was before the write; only the audit knows that there was one."""
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    kill = Kill(calls.index("apply"), behind=True)
    killed_job(rig, kill)
    assert rig.session.state.outcome is None
    (backup,) = rig.backups
    if way == "rollback":
        target = FileTarget(rig.controller)
        rollback(
            target,
            rig.clock(),
            audit=rig.cells / "demo.audit.jsonl",
            who="a person",
        )
    else:
        shutil.copyfile(backup, rig.controller)
    if way == "edited":
        rig.controller.write_text(rig.controller.read_text() + "\n# reviewed\n")
    rolled_back = rig.controller.read_bytes()
    rig.clock.go_on(minutes=10)
    ended = rig.job()
    expected = (Outcome.PROPOSED, ExitCode.PROPOSED)
    assert (ended.outcome, ended.exit_code) == expected
    assert "rolled back since the session began" in ended.remark
    assert rig.controller.read_bytes() == rolled_back
    actions = [entry.action for entry in rig.audit]
    assert actions.count(AuditAction.APPLIED) == 1
    assert rig.job().outcome is Outcome.NOT_DUE
    assert rig.controller.read_bytes() == rolled_back


def test_half_a_recording_is_kept_as_partial_and_recorded_again(tmp_path: Path, made: Made) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    whole = made.logs["loaded-1"].read_bytes()
    copied = rig.tools.record

    def dies(request: RecordingRequest, **further: Any) -> Any:
        out = request.out
        if out.stem == "loaded-1":
            out.with_name(out.name + ".part").write_bytes(whole[: len(whole) // 2])
            os.kill(os.getpid(), signal.SIGKILL)
        return copied(request, **further)

    rig.tools = replace(rig.tools, record=dies)
    killed_job(rig, Kill())
    runs = rig.session.state.runs
    assert [run.name for run in runs] == ["bare-1"]
    rig.tools = replace(rig.tools, record=copied)
    assert rig.job().outcome is Outcome.APPLIED
    files = rig.session.folder.iterdir()
    names = {path.name for path in files}
    assert "loaded-1-partial-1.mcap" in names
    assert "loaded-1.mcap.part" not in names
    applied_once(rig)


def test_a_log_that_is_not_what_was_recorded_is_recorded_again(
    tmp_path: Path, made: Made, calls: list[str]
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    kill = Kill(calls.index("fit"))
    killed_job(rig, kill)
    log = rig.session.folder / "bare-1.mcap"
    log.write_bytes(log.read_bytes()[:-1] + b"\0")
    assert rig.job().outcome is Outcome.APPLIED
    assert (rig.session.folder / "bare-1-aside-1.mcap").exists()
    last_run = rig.session.state.runs[-1]
    assert last_run.name == "bare-1"


def too_old(rig: Rig) -> None:
    rig.clock.go_on(hours=3)


def of_another_configuration(rig: Rig) -> None:
    rig.cell_file.write_text(rig.cell_file.read_text() + "\n# another comment\n")


def with_another_plan(rig: Rig) -> None:
    """Other moves have been approved: half of the logs would be of these, half of those."""
    plan = rig.cells / "plan.yaml"
    plan.write_bytes(plan.read_bytes() + b"\n# approved again\n")


@pytest.mark.parametrize("change", [too_old, of_another_configuration, with_another_plan])
def test_a_session_of_something_else_is_not_taken_up(
    tmp_path: Path, made: Made, calls: list[str], change: Callable[[Rig], None]
) -> None:
    cells_folder = tmp_path / "cell" / "cells"
    plan_file = cells_folder / "plan.yaml"
    own = replace(made, plan_file=plan_file)
    folder = tmp_path / "cell"
    rig = made_rig(folder, own, resume_within_h=2)
    shutil.copyfile(made.plan_file, own.plan_file)
    kill = Kill(calls.index("fit"))
    killed_job(rig, kill)
    change(rig)
    rig.tools = own.tools(rig)
    assert rig.job().outcome is Outcome.APPLIED
    old, new = rig.sessions
    assert old.state.outcome is None
    assert (len(old.state.runs), len(new.state.runs)) == (3, 3)
