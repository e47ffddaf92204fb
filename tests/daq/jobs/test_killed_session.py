"""A guided session that is killed (-9) at a random moment;
the same command ends with 0, and has written once.
"""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from daq.documents.session_state import GuidedState, Outcome
from daq.errors import ExitCode
from daq.jobs.certificate import save_certificate
from daq.jobs.context import Tools
from daq.ledger.audit import AuditAction
from daq.ledger.ledger import verify_ledger
from daq.workflow.fit import Fit
from daq.workflow.record import Recorded, RecordingRequest
from ident.calibration import Calibration
from ident.discovery.before_after import Account
from tests.daq.histories import history_of, ledger_of
from tests.daq.jobs.made_session import MadeSession, run_session, session_rig
from tests.daq.jobs.rig import Rig
from tests.daq.killing import in_a_child

CALLED = tuple(
    field.name
    for field in fields(Tools)
    if field.name not in {"monotonic_s", "now", "network", "geometry"}
)
"""Tools whose calls are the moments from which a kill is drawn: they are in every stage."""
INTERLOCK = {"command": ["sh", "-c", "echo interlock >> events && test -e closed"]}
"""An interlock that releases the robot and leaves a line."""
MOTION = "motion"  #: Line of an axis that is going to move
ATTEMPTS = 3  #: Of the same command, until it ends with 0


@dataclass(frozen=True)
class Moment:
    """A moment of a session.

    Attributes:
        tool: name of a tool.
        number: of its call, from 0.
        wait_s: after the begin of this call.
    """

    tool: str
    number: int
    wait_s: float


@dataclass(frozen=True)
class TimedCall:
    """A call of a tool in a session that nothing ends.

    Attributes:
        tool: its name.
        duration_s: until the next call.
    """

    tool: str
    duration_s: float


@dataclass(frozen=True)
class Killed:
    """What a kill has left, and how the session went on.

    Attributes:
        tool: that was called last.
        in_time: whether the session had not ended before.
        was_written: whether the controller had the new gains.
        attempts: of the same command after it, until the one that ended with 0.
    """

    tool: str
    in_time: bool
    was_written: bool
    attempts: int


def killed_rig(folder: Path, made: MadeSession, *, real: bool = False) -> Rig:
    """A rig that keeps its certificate, and whose interlock and motions leave a line each.

    Args:
        folder: of the cell.
        made: session whose plans and fits are known; and its recordings, without `real`.
        real: record over the driver.
    """
    rig = session_rig(folder, metrics=None, interlock=INTERLOCK)
    own = rig.tools
    tools = made.tools(rig)
    if real:
        tools = replace(tools, drives=own.drives, record=own.record)

    def save_page(fitted: Fit, changed: Account, calibration: Calibration, report: Path) -> object:
        # The cell file may get another bus once there is a cell.
        return save_certificate(rig.cell_file, rig.cell, fitted, changed, calibration, report)

    record = moving(rig, tools.record)
    rig.tools = replace(tools, save_report=save_page, record=record)
    return rig


def moving(rig: Rig, record: Callable[..., Recorded]) -> Callable[..., Recorded]:
    """A recorder that leaves a line once the interlock was asked for the last time,
    right before power comes on.
    """

    def recorded(
        request: RecordingRequest, *, require_released: Callable[[], None], **further: Any
    ) -> Recorded:
        asked: list[int] = []

        def ask() -> None:
            require_released()
            asked.append(1)
            if len(asked) == 2:
                leave_line(rig, MOTION)

        return record(request, require_released=ask, **further)

    return recorded


def leave_line(rig: Rig, text: str) -> None:
    events_folder = rig.cells / "events"
    with events_folder.open("a") as file:
        file.write(f"{text}\n")


def noting(rig: Rig) -> Tools:
    """The tools of a rig, which leave a line in `calls` as each call begins."""
    calls = rig.cells / "calls"

    def noted(name: str) -> Callable[..., Any]:
        function = getattr(rig.tools, name)

        def call(*given: Any, **further: Any) -> Any:
            with calls.open("a") as file:
                file.write(f"{name}\n")
            return function(*given, **further)

        return call

    return replace(rig.tools, **{name: noted(name) for name in CALLED})


def calls_of(rig: Rig) -> list[str]:
    """Calls that were begun."""
    path = rig.cells / "calls"
    return path.read_text().split() if path.exists() else []


def session_in_a_child(rig: Rig) -> int:
    """Begin the session, or go on with it, in a process of its own; return its process id."""
    tools = noting(rig)

    def work() -> int:
        changed_rig = replace(rig, tools=tools)
        return run_session(changed_rig).exit_code

    return in_a_child(work)


def timed_calls(rig: Rig) -> list[TimedCall]:
    """Calls of a whole session, as a child makes them."""
    child = session_in_a_child(rig)
    begun_s: list[float] = []
    ended = 0
    while not ended:
        ended, status = os.waitpid(child, os.WNOHANG)
        now_s = time.monotonic()
        begun_s += [now_s] * (len(calls_of(rig)) - len(begun_s))
        time.sleep(0.001)
    assert os.waitstatus_to_exitcode(status) == ExitCode.OK
    ends_s = [*begun_s[1:], time.monotonic()]
    return [
        TimedCall(name, end - begin)
        for name, begin, end in zip(calls_of(rig), begun_s, ends_s, strict=True)
    ]


def drawn_moment(calls: list[TimedCall], chance: random.Random) -> Moment:
    """Any tool first, so that a short stage is as likely as a long one;
    then any of its calls, and any moment of it.
    """
    tools = {call.tool for call in calls}
    tool = chance.choice(sorted(tools))
    of_tool = [call for call in calls if call.tool == tool]
    number = chance.randrange(len(of_tool))
    wait_s = chance.uniform(0.0, of_tool[number].duration_s)
    return Moment(tool, number, wait_s)


def killed_at(rig: Rig, moment: Moment) -> bool:
    """Run the session in a child and kill it at that moment;
    return whether it had not ended before.
    """
    child = session_in_a_child(rig)
    ended = 0
    while not ended and calls_of(rig).count(moment.tool) <= moment.number:
        time.sleep(0.001)
        ended, status = os.waitpid(child, os.WNOHANG)
    if ended:
        return False
    time.sleep(moment.wait_s)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


def ends_well_after(rig: Rig, moment: Moment) -> Killed:
    """Kill a session at a moment; the same command ends with 0,
    with one certificate and one write.
    """
    before = rig.controller.read_bytes()
    in_time = killed_at(rig, moment)
    tool = calls_of(rig)[-1]
    left = rig.controller.read_bytes()
    attempts = 0
    is_over = bool(rig.sessions) and rig.session.finished
    while not is_over:
        attempts += 1
        assert attempts <= ATTEMPTS
        rig.clock.go_on(minutes=5)
        _, status = os.waitpid(session_in_a_child(rig), 0)
        is_over = os.waitstatus_to_exitcode(status) == ExitCode.OK
    after = rig.controller.read_bytes()
    assert after != before
    assert left in (before, after)
    written_once(rig, before)
    released_before_each_motion(rig)
    return Killed(tool, in_time, was_written=left == after, attempts=attempts)


def written_once(rig: Rig, before: bytes) -> None:
    """Check that one write is in every record, and that the one certificate says who wrote and
    accepted it.
    """
    state = rig.session.state
    assert isinstance(state, GuidedState)
    assert state.outcome is Outcome.APPLIED
    expected = [block.name for block in state.blocks]
    assert [run.name for run in state.runs] == expected
    actions = [entry.action for entry in rig.audit]
    assert actions.count(AuditAction.APPLIED) <= 1
    assert actions.count(AuditAction.ACCEPTED) == 1
    assert actions.count(AuditAction.CALIBRATION_ENTERED) == 1
    # Killed between backup and replacement, the next command backs the same content up once more.
    contents = {backup.read_bytes() for backup in rig.backups}
    assert contents == {before}
    history = history_of(rig.cell_file)
    assert len(history.events) == len(history.entries) == 1
    found = verify_ledger(ledger_of(rig.cell_file))
    assert found.complete
    assert found.broken == ()
    (page,) = rig.session.folder.parent.glob("*/report/report.html")
    text = page.read_text()
    assert "; accepted on " in text
    assert "not written" not in text
    assert (rig.session.folder / "summary.json").exists()


def released_before_each_motion(rig: Rig) -> None:
    """Check that the interlock was asked right before each motion."""
    events_folder = rig.cells / "events"
    events = events_folder.read_text().split()
    assert events.count(MOTION) >= 4  # three blocks and the acceptance
    assert events[0] != MOTION
    assert all(one != MOTION for one, other in pairwise(events) if other == MOTION)


@pytest.mark.processes
def test_a_session_that_is_killed_at_a_random_moment_ends_with_the_same_command(
    tmp_path: Path, made_session: MadeSession
) -> None:
    """A few moments; `tests.studies.session_kills` takes more."""
    folder = tmp_path / "timed"
    calls = timed_calls(killed_rig(folder, made_session))
    tools = {call.tool for call in calls}
    assert tools == set(CALLED)
    chance = random.Random(1)
    for number in range(4):
        rig = killed_rig(tmp_path / f"{number}", made_session)
        ends_well_after(rig, drawn_moment(calls, chance))
