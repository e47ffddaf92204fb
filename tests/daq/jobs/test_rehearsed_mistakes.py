"""Mistakes that were rehearsed in a guided session: each is noticed at its block, with what to do.

Here: a block with losses, an axis that trips, a bus that goes away, a full disk. The others are in
`test_guided`:

- a payload in a bare block, or forgotten in a loaded one, and the other payload (1.7 kg in the
  place of 4.6 kg): `test_a_block_with_the_wrong_body_is_recorded_again_and_kept`;
- a mass in grams: `test_a_mass_in_grams_or_of_another_body_is_not_taken`;
- a changed cell file: `test_a_cell_file_that_changes_between_blocks_is_refused_with_the_way_out`;
- a second terminal: `test_a_second_terminal_learns_that_the_bus_is_taken`.
"""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import daq.workflow.record
from daq.cli.failure import ErrorParts
from daq.documents.session_state import Outcome
from daq.errors import DiskSpaceShort, ExitCode, OutputFailed, RunInvalid
from daq.ledger.audit import AuditAction
from daq.workflow.record import Recorded, RecordingRequest
from drivers.errors import BusError, DriveFault, SampleLost
from drivers.simulation.faults import FaultKind, FaultSpec
from tests.daq.jobs.made_session import MadeSession, made_session_rig, run_session, session_rig
from tests.daq.jobs.rig import Rig, powerless, serving

STRIKE = 120  #: SYNCs since power-on: in the first move of the first block
FIRST = "block-1-bare"
LOADED = "block-2-loaded"


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulated cell in this process is never that late;
    waiting for one that is silent would be most of the time.
    """
    monkeypatch.setattr(daq.workflow.record, "LOCKSTEP_TIMEOUT_S", 0.4)


def ends_at(rig: Rig, kind: type[Exception], code: ExitCode, block: str, kept: str) -> ErrorParts:
    """Run a session that ends with an error; it says what to do, and the block does not count."""
    before = rig.controller.read_bytes()
    with pytest.raises(kind) as caught:
        run_session(rig)
    parts = ErrorParts.of(caught.value, "calibrate")
    assert parts.do
    assert parts.exit_code == code
    assert parts.notes["kept"] == kept
    again = f"then start the same command: it records {block} again"
    assert again in parts.notes["hint"]
    summary = (rig.session.folder / "summary.txt").read_text()
    assert again in summary
    state = rig.session.state
    assert (state.outcome, state.exit_code) == (Outcome.STOPPED, code)
    assert block not in {run.name for run in state.runs}
    assert rig.controller.read_bytes() == before
    return parts


def goes_on(rig: Rig, made: MadeSession) -> None:
    """The same command, once the cause is removed:
    it ends with one write, and each block counts once.
    """
    rig.tools = made.tools(rig)
    rig.clock.go_on(minutes=5)
    assert run_session(rig).exit_code == ExitCode.OK
    runs = rig.session.state.runs
    assert [run.name for run in runs] == [FIRST, LOADED, "block-3-held-out"]
    actions = [entry.action for entry in rig.audit]
    assert actions.count(AuditAction.APPLIED) == 1


def with_real_recorder(rig: Rig, made: MadeSession) -> None:
    """Moves that are made already, recorded by the rig's own recorder."""
    own = rig.tools
    rig.tools = replace(made.tools(rig), drives=own.drives, record=own.record)


def test_an_axis_that_trips_ends_the_block_and_says_how_to_reset_it(
    tmp_path: Path, made_session: MadeSession, impatient: None
) -> None:
    rig = session_rig(tmp_path / "cell")
    with_real_recorder(rig, made_session)
    fault_spec = FaultSpec(FaultKind.EMERGENCY, 2, STRIKE, None, 0x7305)
    with serving(rig, fault_spec) as cell:
        parts = ends_at(rig, DriveFault, ExitCode.DEVICE_FAULT, FIRST, "no block yet")
        assert powerless(cell)
    assert parts.error.startswith("J3 (node 3)")
    assert "--reset-faults" in parts.do
    assert (rig.session.folder / f"{FIRST}.mcap.part").exists()
    goes_on(rig, made_session)
    assert (rig.session.folder / f"{FIRST}-partial-1.mcap").exists()


@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        (FaultSpec(FaultKind.BUS_OFF, None, STRIKE), BusError),
        (FaultSpec(FaultKind.SILENT, None, STRIKE), SampleLost),
    ],
    ids=["bus off", "silent"],
)
def test_a_bus_that_goes_away_ends_the_block_and_says_what_to_check(
    tmp_path: Path,
    made_session: MadeSession,
    impatient: None,
    fault: FaultSpec,
    kind: type[Exception],
) -> None:
    rig = session_rig(tmp_path / "cell")
    with_real_recorder(rig, made_session)
    with serving(rig, fault):
        parts = ends_at(rig, kind, ExitCode.DEVICE_FAULT, FIRST, "no block yet")
    assert "check" in parts.do
    # What could not be reached may still have power, and that is said first.
    assert parts.unconfirmed or parts.powered
    goes_on(rig, made_session)


def test_a_disk_that_fills_up_in_a_block_ends_it_and_nothing_moves_before_there_is_room(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    copied = rig.tools.record

    def fills_up(request: RecordingRequest, **further: Any) -> Recorded:
        if request.out.stem == LOADED:
            raise OutputFailed.of(request.out, OSError(errno.ENOSPC, "No space left on device"))
        recorded: Recorded = copied(request, **further)
        return recorded

    rig.tools = replace(rig.tools, record=fills_up)
    parts = ends_at(rig, OutputFailed, ExitCode.UNEXPECTED, LOADED, FIRST)
    assert "free space" in parts.do
    asked: list[str] = []

    def moved(request: RecordingRequest, **further: Any) -> Recorded:
        asked.append(request.out.stem)
        raise AssertionError

    tools = rig.tools
    rig.tools = replace(tools, record=moved, free=lambda _: 10_000)
    with pytest.raises(DiskSpaceShort, match="nothing has moved; free space"):
        run_session(rig)
    assert asked == []
    rig.tools = tools
    goes_on(rig, made_session)


def test_a_block_with_losses_is_recorded_again_at_once_and_the_lossy_log_is_kept(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    lossy_blocks = iter([LOADED])
    copied = rig.tools.record

    def with_losses(request: RecordingRequest, **further: Any) -> Recorded:
        recorded: Recorded = copied(request, **further)
        if request.out.stem != next(lossy_blocks, ""):
            return recorded
        log = replace(recorded.log, valid=False, reason="3 cycles lost", lost_cycles=3)
        return replace(recorded, log=log)

    def first_is_clean(request: RecordingRequest, **further: Any) -> Recorded:
        if request.out.stem == FIRST:
            return copied(request, **further)
        return with_losses(request, **further)

    rig.tools = replace(rig.tools, record=first_is_clean)
    assert run_session(rig).exit_code == ExitCode.OK
    runs = rig.session.state.runs
    (run,) = [run for run in runs if run.name == LOADED]
    assert run.attempts == 2
    assert run.lost_cycles >= 3
    assert (rig.session.folder / f"{LOADED}-aside-1.mcap").exists()
    events = [event["event"] for event in rig.events]
    noticed = events.index("recording is invalid")
    assert events[noticed:].count("recorded") == 3  # this block again, and those after it
    assert len(rig.session.state.runs) == 3


def test_a_block_that_has_losses_each_time_ends_the_session_there(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = made_session_rig(folder, made_session)
    copied = rig.tools.record

    def with_losses(request: RecordingRequest, **further: Any) -> Recorded:
        recorded: Recorded = copied(request, **further)
        is_lossy = request.out.stem == LOADED
        log = replace(recorded.log, valid=not is_lossy, reason="3 cycles lost")
        return replace(recorded, log=log)

    rig.tools = replace(rig.tools, record=with_losses)
    parts = ends_at(rig, RunInvalid, ExitCode.DATA_UNFIT, LOADED, FIRST)
    assert "see to the bus" in parts.do
    goes_on(rig, made_session)
