"""Every fault of tests/faults in a job: exit code, the controller's file untouched, audit,
axes without power.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

import daq.workflow.record
from daq.cli.app import main
from daq.documents.session_state import Outcome
from daq.environment import shipped_configurations
from daq.errors import ExitCode, JobHeld, RunInvalid, exit_code
from daq.ledger.audit import AuditAction
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.errors import BusError, DriveFault, MotionRefused, SampleLost, StateRefused
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.drive import PowerState
from drivers.simulation.faults import FaultKind, FaultSpec
from tests.daq.jobs.rig import Rig, make_rig, powerless, serving
from tests.faults.test_at_start import REFUSALS
from tests.faults.test_in_motion import STOPS

pytestmark = pytest.mark.slow  # each fault takes a job of its own

STRIKE = 120
"""SYNCs since power-on: in the first move of the first recording,
which begins at about 30 and takes more than 500.
"""
AXIS = 2
CUT_OFF = {
    "silent": (FaultSpec(FaultKind.SILENT, None, STRIKE), SampleLost),
    "silent axis": (FaultSpec(FaultKind.SILENT, AXIS, STRIKE), SampleLost),
    "bus off": (FaultSpec(FaultKind.BUS_OFF, None, STRIKE), BusError),
}
COUNTED = (FaultKind.LOST, FaultKind.LATE, FaultKind.DUPLICATE, FaultKind.SHORT_PDO)
BORNE = (
    FaultSpec(FaultKind.NO_GUARD, AXIS),
    FaultSpec(FaultKind.REFUSES_WRITE, AXIS),
    FaultSpec(FaultKind.REFUSES_SAVE, AXIS),
    FaultSpec(FaultKind.ERROR_PASSIVE, None, STRIKE),
)
"""No run ends of them: one is warned of, one is noted in the log,
and a job writes no gain into a drive.
"""
ONLY_BARE = {"command": ["sh", "-c", 'test "$1" = none', "mount"]}


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulated cell in this process is never that late;
    waiting for one that is silent would be most of the time.
    """
    monkeypatch.setattr(daq.workflow.record, "LOCKSTEP_TIMEOUT_S", 0.4)


def fails(rig: Rig, cell: SimulatedCell, kind: type[Exception]) -> Exception:
    """Run the job, which ends with an error of that kind; what is promised of every such end."""
    before = rig.controller.read_bytes()
    with pytest.raises(kind) as caught:
        rig.job()
    cell.check()
    code = exit_code(type(caught.value))
    session = rig.session
    assert rig.controller.read_bytes() == before
    assert rig.backups == []
    assert (session.state.outcome, session.state.exit_code) == (Outcome.STOPPED, code)
    actions = [entry.action for entry in rig.audit]
    assert actions == [
        AuditAction.RECALIBRATION_BEGUN,
        AuditAction.RECALIBRATION_ENDED,
    ]
    details = rig.audit[-1].details
    assert details["outcome"] == "stopped"
    assert rig.audit[-1].details["exit_code"] == code
    assert type(caught.value).__name__ in session.state.problem
    text = (rig.cells / "drivegain_demo.prom").read_text()
    assert f'exit_code{{cell="demo"}} {code}.0' in text
    summary_path = session.folder / "summary.txt"
    assert "stopped" in summary_path.read_text()
    return caught.value


@pytest.mark.slow
@pytest.mark.parametrize("name", STOPS)
def test_a_fault_in_motion_ends_the_job_and_leaves_the_controller_as_it_was(
    tmp_path: Path, short_plan: Path, name: str
) -> None:
    promise = STOPS[name]
    folder = tmp_path / "cell"
    rig = make_rig(folder, short_plan)
    if promise.toggle_bit is not None:
        with_toggle_bit(rig, promise.toggle_bit)
    changed_fault = replace(promise.fault, at_cycle=STRIKE)
    with serving(rig, changed_fault, toggle_bit=promise.toggle_bit) as cell:
        fails(rig, cell, promise.error)
        assert powerless(cell)
    assert exit_code(promise.error) == ExitCode.DEVICE_FAULT
    assert (rig.session.folder / "bare-1.mcap.part").exists()
    assert rig.session.state.runs == ()


@pytest.mark.parametrize("name", CUT_OFF)
def test_a_cell_that_is_cut_off_ends_the_job_and_what_no_one_can_reach_is_said(
    tmp_path: Path, short_plan: Path, name: str
) -> None:
    fault, kind = CUT_OFF[name]
    folder = tmp_path / "cell"
    rig = make_rig(folder, short_plan)
    with serving(rig, fault) as cell:
        error = fails(rig, cell, kind)
        # Those that can be reached are stopped; the others stop by themselves (tests/faults), after
        # this test ends.
        others = [
            node
            for index, node in enumerate(cell.nodes)
            if fault.axis is not None and index != fault.axis
        ]
        states = {node.drive.state for node in others}
        assert states <= {PowerState.SWITCH_ON_DISABLED}
    assert any(note.startswith("while stopping") for note in error.__notes__)
    summary_path = rig.session.folder / "summary.txt"
    assert "while stopping" in summary_path.read_text()


@pytest.mark.parametrize("kind", REFUSALS, ids=lambda kind: kind.value)
def test_a_fault_from_the_start_ends_the_job_before_anything_moves(
    tmp_path: Path, short_plan: Path, kind: FaultKind
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, short_plan)
    with serving(rig, FaultSpec(kind, 1)) as cell:
        fails(rig, cell, REFUSALS[kind][0])
        states = {node.drive.state for node in cell.nodes}
        assert states == {PowerState.SWITCH_ON_DISABLED}
        assert cell.plant.time_s < 1.0


def test_a_drive_that_refuses_its_mapping_ends_the_command_with_its_error(
    tmp_path: Path, short_plan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a timer calls it: an SDO abort of the library is behind the error that its feed
    describes.
    """
    folder = tmp_path / "cell"
    rig = make_rig(folder, short_plan)
    fault_spec = FaultSpec(FaultKind.REFUSES_MAPPING, 1)
    with serving(rig, fault_spec) as cell:
        assert main(["recalibrate", str(rig.cell_file)]) == ExitCode.DEVICE_FAULT
        states = {node.drive.state for node in cell.nodes}
        assert states == {PowerState.SWITCH_ON_DISABLED}
    lines = capsys.readouterr().err.splitlines()
    last = json.loads(lines[-1])
    assert (last["event"], last["error"]) == ("failed", "SetupRefused")
    assert last["text"].startswith("J2 (node 2): TPDO1: writing 0x0 to 1A00h:00: aborted")
    expected = (Outcome.STOPPED, ExitCode.DEVICE_FAULT)
    outcome = rig.session.state.outcome
    assert (outcome, rig.session.state.exit_code) == expected


@pytest.mark.slow
def test_a_run_with_a_single_bad_frame_is_recorded_again(tmp_path: Path, one_move: Path) -> None:
    """Once its recorder accepts the run the job goes on,
    here to a payload that is never mounted.
    """
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move, retries=1, mount=ONLY_BARE)
    fault_spec = FaultSpec(FaultKind.LOST, AXIS, STRIKE, 1)
    with serving(rig, fault_spec) as cell:
        assert "mount command" in str(fails(rig, cell, JobHeld))
        assert powerless(cell)
    (run,) = rig.session.state.runs
    assert (run.name, run.attempts) == ("bare-1", 2)
    assert (rig.session.folder / "bare-1-aside-1.mcap").exists()


@pytest.mark.slow
def test_faults_with_which_a_run_goes_on_do_not_end_the_job(tmp_path: Path, one_move: Path) -> None:
    policy = {"motion": "allowed", "unguarded": "allowed"}
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move, policy=policy, retries=0, mount=ONLY_BARE)
    with serving(rig, *BORNE) as cell:
        assert "mount command" in str(fails(rig, cell, JobHeld))
        assert powerless(cell)
    runs = rig.session.state.runs
    assert [run.name for run in runs] == ["bare-1"]
    warned = [event["text"] for event in rig.events if event["level"] == "warning"]
    assert [text for text in warned if "no 1016h" in text]


def test_a_job_moves_no_axis_that_would_go_on_without_it_unless_the_cell_says_so(
    tmp_path: Path, one_move: Path
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move)
    fault_spec = FaultSpec(FaultKind.NO_GUARD, AXIS)
    with serving(rig, fault_spec) as cell:
        error = fails(rig, cell, MotionRefused)
        states = {node.drive.state for node in cell.nodes}
        assert states == {PowerState.SWITCH_ON_DISABLED}
        assert cell.plant.time_s < 1.0
    assert exit_code(type(error)) == ExitCode.USAGE
    assert "J3: no 1016h" in str(error)
    assert "`policy: {unguarded: allowed}`" in str(error)


@pytest.mark.parametrize("allowed", [False, True])
def test_an_axis_beyond_its_limit_is_brought_back_by_a_job_where_the_cell_says_so(
    tmp_path: Path, one_move: Path, allowed: bool
) -> None:
    """In the simulated cell, with friction and noise;
    the run after it is refused only for its payload.
    """
    if allowed:
        policy = {"motion": "allowed", "recovery_motion": "allowed"}
    else:
        policy = {"motion": "allowed"}
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move, policy=policy, mount=ONLY_BARE)
    spec = load_simulation(shipped_simulation("demo"))
    start_rad = spec.start_rad.copy()
    limits = rig.cell.axes[AXIS].limits
    limit_rad = limits.position[1]
    start_rad[AXIS] = limit_rad + 0.002
    changed_spec = replace(spec, start_rad=start_rad)
    with serving(rig, spec=changed_spec) as cell:
        error = fails(rig, cell, JobHeld if allowed else MotionRefused)
        assert powerless(cell)
        assert bool(cell.plant.position_rad[AXIS] < limit_rad) is allowed
    warned = [event["text"] for event in rig.events if event["level"] == "warning"]
    assert any("brought back slowly" in text for text in warned) is allowed
    assert ("recovery_motion" in str(error)) is not allowed
    expected = ["bare-1"] * allowed
    runs = rig.session.state.runs
    assert [run.name for run in runs] == expected


def test_no_kind_of_fault_is_left_out() -> None:
    seen = {promise.fault.kind for promise in STOPS.values()} | {
        fault.kind for fault, _ in CUT_OFF.values()
    }
    assert seen | {*REFUSALS, *COUNTED, *(fault.kind for fault in BORNE)} == set(FaultKind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", COUNTED, ids=lambda kind: kind.value)
def test_a_run_that_is_invalid_whenever_it_is_made_ends_the_job(
    tmp_path: Path, one_move: Path, kind: FaultKind
) -> None:
    """A single bad frame of any kind makes it so."""
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move, retries=0)
    fault_spec = FaultSpec(kind, AXIS, STRIKE, 1)
    with serving(rig, fault_spec) as cell:
        fails(rig, cell, RunInvalid)
        assert powerless(cell)
    assert rig.session.state.exit_code == ExitCode.DATA_UNFIT


def test_a_drive_in_fault_and_one_that_has_power_are_a_persons_business(
    tmp_path: Path, short_plan: Path
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, short_plan)
    with serving(rig) as cell:
        cell.nodes[AXIS].drive.state = PowerState.FAULT
        fails(rig, cell, DriveFault)
        drive = cell.nodes[AXIS].drive
        assert drive.state is PowerState.FAULT
    other_folder = tmp_path / "other"
    rig = make_rig(other_folder, short_plan)
    with serving(rig) as cell:
        cell.nodes[AXIS].drive.state = PowerState.OPERATION_ENABLED
        fails(rig, cell, StateRefused)


def with_toggle_bit(rig: Rig, bit: int) -> None:
    """A profile beside the cell that has one."""
    shipped = shipped_configurations() / "drives" / "generic-cia402.yaml"
    profile = yaml.safe_load(shipped.read_text(encoding="utf-8"))
    profile["toggle_bit"] = bit
    profile["facts"]["toggle_bit"] = {
        "basis": "assumed",
        "where": "of a drive that this test makes up",
    }
    (rig.cells / "drives").mkdir()
    drives_folder = rig.cells / "drives"
    (drives_folder / shipped.name).write_text(yaml.safe_dump(profile), encoding="utf-8")
