"""A person records in a cell that has a scheduled job:
the policy permits the job alone, the interlock holds both.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.errors import ExitCode, NotReleased
from daq.workflow.plan import load_plan
from daq.workflow.record import RecordingRequest, record
from drivers.errors import MotionRefused
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.drive import PowerState
from tests.daq.jobs.rig import Rig, make_rig, serving

CLOSED_ONCE = {"command": ["sh", "-c", "test -e closed && rm closed"]}
"""An interlock that releases the robot once: the door is opened while the drives are prepared."""


def unmoved(cell: SimulatedCell) -> bool:
    """Whether no axis ever had power."""
    states = {node.drive.state for node in cell.nodes}
    return states == {PowerState.SWITCH_ON_DISABLED} and cell.plant.time_s < 0.1


def record_by_hand(rig: Rig, plan: Path, *options: str) -> int:
    """Record as a person does."""
    out = rig.folder / "by-hand.mcap"
    return main(["record", str(rig.cell_file), str(plan), "--out", str(out), "--json", *options])


@pytest.mark.slow
def test_the_policy_for_jobs_moves_no_axis_for_a_person(
    tmp_path: Path, one_move: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move, policy={"motion": "allowed"})
    with serving(rig) as cell:
        assert record_by_hand(rig, one_move) == ExitCode.USAGE
        assert unmoved(cell)
    lines = capsys.readouterr().err.splitlines()
    failure = json.loads(lines[-1])
    assert failure["kind"] == "MotionRefused"
    assert failure["do"] == "pass --enable-motion"
    assert not list(rig.folder.glob("*.mcap*"))


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["ask", "allowed"])
def test_an_interlock_that_says_no_holds_a_person_too(
    tmp_path: Path, one_move: Path, motion: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move, policy={"motion": motion})
    rig.closed.unlink()
    with serving(rig) as cell:
        assert record_by_hand(rig, one_move, "--enable-motion") == ExitCode.NOT_RELEASED
        assert cell.cycles == 0
        lines = capsys.readouterr().err.splitlines()
        failure = json.loads(lines[-1])
        assert (failure["kind"], failure["exit_code"]) == ("NotReleased", ExitCode.NOT_RELEASED)
        assert "start again" in failure["do"]
        assert not list(rig.folder.glob("*.mcap*"))
        rig.closed.touch()
        assert record_by_hand(rig, one_move, "--enable-motion") == ExitCode.OK


def test_a_program_that_records_is_held_by_a_door_that_opens_before_power(
    tmp_path: Path, one_move: Path
) -> None:
    """The library has the same guard as the command: the drives were prepared, and get no power."""
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move, interlock=CLOSED_ONCE)
    out = rig.folder / "a.mcap"
    plan = load_plan(one_move, rig.cell)
    request = RecordingRequest(
        rig.cell_file,
        rig.cell,
        plan,
        out,
        payload=None,
        operator="Ada",
        granted_by=None,
        run_id="1",
    )
    with serving(rig) as cell:
        with pytest.raises(MotionRefused, match="--enable-motion"):
            record(request)
        assert rig.closed.exists()
        with pytest.raises(NotReleased):
            record(replace(request, granted_by="Ada"))
        assert unmoved(cell)
        assert cell.cycles > 0
    assert not rig.closed.exists()
    assert not list(rig.folder.glob("*.mcap*"))
