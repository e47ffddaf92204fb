"""`drivegain apply --drives` and `rollback --drives`: text and JSON."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import typer

from daq.cli.apply import ApplyOptions, rollback_command, rollback_drives, saving_of
from daq.config.cell import Cell
from daq.documents.calibration_file import encode_calibration
from daq.errors import BusTaken, CalibrationRefused, UsageError
from daq.ledger.audit import AuditAction, read
from daq.ledger.ledger import Ledger, read_history
from daq.report.proposal import DriveChange, DriveRollback
from daq.workflow.bus_lock import bus_lock
from drivers.canopen.parameters import Saving
from drivers.canopen.sdo import ObjectAccess
from drivers.simulation.cell import SimulatedCell
from tests.daq.calibrations import IDENTIFIED, NAMEPLATE, demo_calibration
from tests.daq.drives import (
    ACTOR,
    NOW,
    apply_in_drives,
    entered_gain,
    saved_gain,
)


def _back(cell: Cell, *, yes: bool = True, as_json: bool = False) -> None:
    assert cell.history is not None
    rollback_drives(
        cell,
        now=NOW,
        actor=ACTOR,
        saving=Saving.KNOWN,
        audit=cell.history.audit,
        yes=yes,
        json=as_json,
    )


def test_look_write_and_go_back(
    drive_cell: Cell, simulation: SimulatedCell, capsys: pytest.CaptureFixture[str]
) -> None:
    apply_in_drives(drive_cell)
    shown = capsys.readouterr().out
    assert "current gain" in shown
    assert "J4, 2003h:01: -11520 -> -9210" in shown
    assert "Dry run, nothing was written." in shown
    assert [entered_gain(node) for node in simulation.nodes] == pytest.approx(NAMEPLATE)
    words = shown.split("--base ")
    base = words[1].split()[0]

    apply_in_drives(drive_cell, yes=True, base=base)
    output = capsys.readouterr().out
    assert "Written to the drives and read back" in output
    assert "To undo: drivegain rollback --cell cells/demo.yaml --drives" in output
    assert [saved_gain(node) for node in simulation.nodes] == pytest.approx(IDENTIFIED)
    apply_in_drives(drive_cell)
    assert "The drives have these gains already" in capsys.readouterr().out

    _back(drive_cell, yes=False)
    output = capsys.readouterr().out
    assert "J4, 2003h:01: -9210 -> -11520" in output
    assert "the write of 2025-01-02T03:04:05+00:00 by Kim (login kim)" in output
    assert "Dry run, nothing was written." in output
    assert [saved_gain(node) for node in simulation.nodes] == pytest.approx(IDENTIFIED)
    _back(drive_cell)
    output = capsys.readouterr().out
    assert "J4, 2003h:01: -9210 -> -11520" in output
    assert "The drives have saved." in output
    assert [saved_gain(node) for node in simulation.nodes] == pytest.approx(NAMEPLATE)
    assert drive_cell.history is not None
    entered = AuditAction.CALIBRATION_ENTERED
    actions = (
        AuditAction.APPLY_BEGUN,
        AuditAction.APPLIED,
        entered,
        AuditAction.ROLLBACK_BEGUN,
        AuditAction.ROLLED_BACK,
    )
    entries = read(drive_cell.history.audit)
    assert [(entry.action, entry.who, entry.subject) for entry in entries] == [
        (
            action,
            "Kim (login kim)",
            "history of demo" if action is entered else "drives of cell demo",
        )
        for action in actions
    ]
    evidence = read(drive_cell.history.audit)[0].details
    assert evidence["configuration_sha256"] == demo_calibration().configuration_sha256
    sha256 = hashlib.sha256(encode_calibration(demo_calibration())).hexdigest()
    file = str(Path("calibration.yaml").absolute())
    expected = {
        "file": file,
        "sha256": sha256,
        "cell": "demo",
        "created": demo_calibration().created,
        "software": demo_calibration().software,
    }
    assert evidence["calibration"] == expected
    ledger = Ledger.of(drive_cell)
    assert ledger is not None
    history = read_history(ledger)
    targets = [event.target for event in history.events]
    assert targets == ["drives of cell demo"] * 2
    assert history.in_force() is None
    # The two entries that record how the writes ended.
    audits = {event.audit for event in history.events}
    assert audits == {entry.sha256 for entry in read(drive_cell.history.audit)[1::3]}
    _back(drive_cell)
    assert (
        read_history(ledger).in_force()
        == hashlib.sha256(encode_calibration(demo_calibration())).hexdigest()
    )


@pytest.mark.usefixtures("simulation")
def test_a_program_gets_all_of_it(drive_cell: Cell, capsys: pytest.CaptureFixture[str]) -> None:
    apply_in_drives(drive_cell, as_json=True)
    reviewed = json.loads(capsys.readouterr().out)
    assert reviewed["applied"] is False
    assert reviewed["refusals"] == []
    assert reviewed["changes"][3]["new"] == -9.21
    apply_in_drives(drive_cell, as_json=True, yes=True, saving=Saving.RAM)
    text = capsys.readouterr().out
    written = json.loads(text)
    DriveChange.model_validate_json(text)
    assert written["applied"] is True
    assert written["saved"] is False
    assert written["base_sha256"] == reviewed["base_sha256"]
    assert Path(written["record"]).is_file()
    for yes in (False, True):
        _back(drive_cell, yes=yes, as_json=True)
        text = capsys.readouterr().out
        document = json.loads(text)
        DriveRollback.model_validate_json(text)
        expected = (written["record"], yes)
        assert (document["source"], document["restored"]) == expected
        assert document["changes"][3] == {
            "axis": "J4",
            "object": "2003h:01",
            "old": -9210.0,
            "new": -11520.0,
        }


@pytest.mark.parametrize("yes", [False, True])
@pytest.mark.parametrize("as_json", [False, True])
def test_a_failed_check_is_reported_and_nothing_written(
    drive_cell: Cell,
    simulation: SimulatedCell,
    capsys: pytest.CaptureFixture[str],
    yes: bool,
    as_json: bool,
) -> None:
    calibration = demo_calibration()
    changed_gain = replace(calibration.gains[0], std=5.0)
    gains = (changed_gain, *calibration.gains[1:])
    far = replace(calibration, gains=gains)
    with pytest.raises(CalibrationRefused, match="J1: found σ"):
        apply_in_drives(drive_cell, calibration=far, yes=yes, as_json=as_json)
    shown = capsys.readouterr().out
    if as_json:
        refusals = json.loads(shown)["refusals"]
        gates = [one["gate"] for one in refusals]
        assert gates == ["uncertainty"]
    assert [entered_gain(node) for node in simulation.nodes] == pytest.approx(NAMEPLATE)


def test_an_interrupt_puts_back_what_was_written(
    drive_cell: Cell,
    simulation: SimulatedCell,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    check = ObjectAccess.read
    reads = 0

    def interrupted(access: ObjectAccess, entry: object) -> int:
        nonlocal reads
        value = check(access, entry)  # type: ignore[arg-type]
        if access.node_id == 3 and value == 24200:
            reads += 1
            if reads == 1:
                raise KeyboardInterrupt
        return value

    monkeypatch.setattr(ObjectAccess, "read", interrupted)
    with pytest.raises(typer.Exit) as caught:
        apply_in_drives(drive_cell, yes=True)
    assert caught.value.exit_code == 130
    assert (
        "interrupted: kept: the previous values are restored in J1, J2, J3"
    ) in capsys.readouterr().err
    assert [entered_gain(node) for node in simulation.nodes] == pytest.approx(NAMEPLATE)


@pytest.mark.usefixtures("simulation")
def test_a_bus_that_another_client_has_is_left_alone(drive_cell: Cell) -> None:
    with bus_lock(drive_cell), pytest.raises(BusTaken):
        apply_in_drives(drive_cell)
    apply_in_drives(drive_cell)


def test_the_two_options_of_saving() -> None:
    expected = [
        Saving.KNOWN,
        Saving.RAM,
        Saving.ANY,
    ]
    assert [saving_of(False, False), saving_of(True, False), saving_of(False, True)] == expected
    with pytest.raises(UsageError, match="one of them"):
        saving_of(True, True)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, "drivegain rollback press.yaml"),
        ({"to": Path("a copy.xml")}, "drivegain rollback press.yaml --to 'a copy.xml'"),
        ({"drives": True}, "drivegain rollback press.yaml --drives --yes"),
        (
            {"drives": True, "ram_only": True},
            "drivegain rollback press.yaml --drives --ram-only --yes",
        ),
        (
            {"drives": True, "save_unknown": True},
            "drivegain rollback press.yaml --drives --save-unknown --yes",
        ),
    ],
)
def test_the_command_to_undo_a_write_undoes_it_as_it_is_printed(
    given: dict[str, Any], expected: str
) -> None:
    """A rollback of drives without --yes only shows, and saves as it is told to."""
    options = ApplyOptions(Path("press.yaml"), Path("calibration.yaml"), yes=True, **given)
    assert rollback_command(options) == expected
