"""A guided session whose gains are in the drives:
written with `yes`, read back before the moves that accept them.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daq.config.cell import Cell
from daq.config.cell_buses import bus_address
from daq.documents.calibration_file import load_calibration
from daq.documents.session_state import GuidedState, Outcome
from daq.errors import ConfigurationInconsistent, ControllerChanged, ExitCode
from daq.jobs.gain_target import file_of, target_of
from daq.ledger.audit import AuditAction
from daq.writeback.drive_target import DriveTarget
from daq.writeback.request import Request
from daq.writeback.target import apply, propose
from drivers.canopen.network import CanopenNetwork, SignalBlocker
from drivers.canopen.parameters import Saving
from drivers.errors import ParameterRefused
from drivers.profiles.profile import Mapping
from tests.daq.calibrations import NAMEPLATE
from tests.daq.drives import entered_gain, network_of, saved_gain
from tests.daq.histories import history_of
from tests.daq.jobs.made_session import MadeSession, given_answers, made_session_rig, run_session
from tests.daq.jobs.rig import Rig, serving

OBJECT = {"index": 0x2003, "subindex": 1, "type": "i32", "factor": 1000.0}


def drives_rig(folder: Path, made: MadeSession, mapping: Mapping = Mapping.STORED) -> Rig:
    """A rig whose cell has its gains in the drives, which do that with mappings when they save."""
    rig = made_session_rig(folder, made)
    document = json.loads(rig.cell_file.read_text())
    document["controller"] = {"objects": [OBJECT] * len(rig.cell.axes)}
    rig.cell_file.write_text(json.dumps(document))

    def quick_network(cell: Cell, _block_signals: SignalBlocker) -> CanopenNetwork:
        return network_of(cell, bus_address(cell), mapping)

    rig.tools = replace(rig.tools, network=quick_network)
    return rig


def state_of(rig: Rig) -> GuidedState:
    state = rig.session.state
    assert isinstance(state, GuidedState)
    return state


def actions_of(rig: Rig) -> list[AuditAction]:
    return [entry.action for entry in rig.audit]


def test_gains_in_drives_are_written_read_back_and_accepted(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = drives_rig(folder, made_session)
    with serving(rig) as cell:
        assert run_session(rig).exit_code == ExitCode.OK
        for node, gain in zip(cell.nodes, made_session.calibration.gains, strict=True):
            assert entered_gain(node) == pytest.approx(gain.value, abs=0.001)
            assert saved_gain(node) == pytest.approx(gain.value, abs=0.001)
    state = state_of(rig)
    assert state.outcome is Outcome.APPLIED
    assert state.acceptance is not None
    assert state.acceptance.accepted
    assert (
        actions_of(rig).count(AuditAction.APPLIED)
        == actions_of(rig).count(AuditAction.ACCEPTED)
        == 1
    )
    events = [event["event"] for event in rig.events]
    assert events.index("the gains were read back from the drives") > events.index(
        "written to the controller's file"
    )
    assert len(history_of(rig.cell_file).events) == 1
    report_folder = rig.session.folder / "report"
    page = (report_folder / "report.html").read_text()
    assert "to the drives; accepted on " in page
    proposal_path = rig.session.folder / "proposal.diff"
    assert "J1, 2003h:01" in proposal_path.read_text()
    text = (rig.session.folder / "summary.txt").read_text()
    assert (f"drivegain rollback {rig.cell_file} --drives --yes") in text


def test_a_session_that_ends_after_the_write_to_drives_does_not_write_again(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = drives_rig(folder, made_session)
    tools = rig.tools

    def interrupted(*given: Any, **further: Any) -> Any:
        tools.apply(*given, **further)
        raise KeyboardInterrupt

    rig.tools = replace(tools, apply=interrupted)
    with serving(rig):
        with pytest.raises(KeyboardInterrupt):
            run_session(rig)
        rig.tools = tools
        rig.clock.go_on(minutes=5)
        assert run_session(rig).outcome is Outcome.APPLIED
    assert actions_of(rig).count(AuditAction.APPLY_BEGUN) == 1
    assert state_of(rig).acceptance is not None


def test_drives_that_lost_their_gains_are_noticed_before_anything_moves(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = drives_rig(folder, made_session)
    tools = rig.tools
    with serving(rig) as cell:
        before = cell.nodes[1].read(0x2003, 1)

        def lost(*given: Any, **further: Any) -> Any:
            written = tools.apply(*given, **further)
            cell.nodes[1].write(0x2003, 1, before)
            return written

        rig.tools = replace(tools, apply=lost)
        with pytest.raises(ControllerChanged, match="nothing has moved"):
            run_session(rig)
    acceptance_path = rig.session.folder / "acceptance.mcap"
    assert not acceptance_path.exists()
    assert AuditAction.ACCEPTED not in actions_of(rig)


def test_drives_that_refuse_to_save_are_written_with_apply_and_the_session_goes_on(
    tmp_path: Path, made_session: MadeSession
) -> None:
    """As `apply --drives --save-unknown` does it."""
    folder = tmp_path / "cell"
    rig = drives_rig(folder, made_session, Mapping.UNKNOWN)
    with serving(rig):
        with pytest.raises(ParameterRefused, match="nothing was written"):
            run_session(rig)
        assert rig.session.state.outcome is Outcome.STOPPED
        file = rig.session.folder / "calibration.yaml"
        request = Request(load_calibration(file), rig.clock(), file=file, content=file.read_bytes())
        address = bus_address(rig.cell)
        with network_of(rig.cell, address, Mapping.UNKNOWN) as network:
            target = DriveTarget(rig.cell, network, Saving.ANY)
            proposal = propose(target, request)
            apply(proposal, rig.clock(), audit=rig.cells / "demo.audit.jsonl", who="Kim")
        assert run_session(rig).exit_code == ExitCode.OK
    assert (
        actions_of(rig).count(AuditAction.APPLIED)
        == actions_of(rig).count(AuditAction.ACCEPTED)
        == 1
    )
    report_folder = rig.session.folder / "report"
    page = (report_folder / "report.html").read_text()
    assert "by Kim to the drives; accepted on " in page


def test_without_yes_the_drives_keep_their_gains_and_the_command_for_later_is_said(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = drives_rig(folder, made_session)
    with serving(rig) as cell:
        operator = given_answers(rig, writes=False)
        assert run_session(rig, operator).outcome is Outcome.PROPOSED
        assert [entered_gain(node) for node in cell.nodes] == pytest.approx(NAMEPLATE)
    summary_path = rig.session.folder / "summary.txt"
    assert " --drives --yes --base " in summary_path.read_text()


def test_a_job_without_an_operator_takes_no_gains_in_drives(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    rig = drives_rig(folder, made_session)
    assert target_of(rig.cell).in_drives
    file_folder = tmp_path / "file"
    cell = made_session_rig(file_folder, made_session).cell
    assert not target_of(cell).in_drives
    with pytest.raises(ConfigurationInconsistent, match="drivegain calibrate"):
        file_of(rig.cell)
    changed_cell = replace(rig.cell, controller=None)
    with pytest.raises(ConfigurationInconsistent, match="neither a file nor objects"):
        target_of(changed_cell)
