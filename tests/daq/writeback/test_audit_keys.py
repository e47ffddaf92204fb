"""The audit log's page gives the keys that a write has, and no others."""

from __future__ import annotations

import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from daq.errors import CalibrationRefused
from daq.ledger.audit import AuditEntry, head_file, read
from daq.writeback.drive_target import DriveTarget
from daq.writeback.file_target import FileTarget
from daq.writeback.request import Request
from daq.writeback.target import apply, propose, rollback
from drivers.canopen.bus import BusAddress
from tests.daq.calibrations import KEYS, demo_calibration
from tests.daq.documented_keys import documented_keys, undocumented_keys, written_keys
from tests.daq.drives import demo_cell, network_of, simulated

NOW = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)


def _refused_request() -> Request:
    """Return a request to write gains that no cell's policy accepts."""
    calibration = demo_calibration()
    gains = tuple(replace(gain, value=100.0 * gain.value) for gain in calibration.gains)
    return Request(replace(calibration, gains=gains), NOW)


def _file_entries(folder: Path, checkout: Path) -> tuple[AuditEntry, ...]:
    """Every entry that writes to a controller's file make."""
    controller = folder / "demo.yaml"
    shutil.copyfile(checkout / "configs/controllers/demo.yaml", controller)
    target = FileTarget(controller, KEYS)
    audit = folder / "audit.jsonl"
    request = Request(demo_calibration(), NOW)
    with pytest.raises(CalibrationRefused):
        rollback(target, NOW, audit=audit)
    with pytest.raises(CalibrationRefused):
        apply(propose(target, _refused_request()), NOW, audit=audit)
    apply(propose(target, request), NOW, audit=audit)
    apply(propose(target, request), NOW, audit=audit)
    entries = read(audit)
    audit.unlink()
    head_file(audit).unlink()
    rollback(target, NOW, audit=audit)
    entries += read(audit)
    audit.unlink()
    head_file(audit).unlink()
    apply(propose(target, request), NOW, audit=audit)
    return entries + read(audit)


def _drive_entries(folder: Path, bus: str) -> tuple[AuditEntry, ...]:
    """Every entry of a write into drives, and of its rollback."""
    cell = demo_cell(folder)
    assert cell.history is not None
    audit = cell.history.audit
    address = BusAddress("virtual", bus)
    request = Request(demo_calibration(), NOW, accepts_changed_configuration=True)
    with simulated(address), network_of(cell, address) as network:
        target = DriveTarget(cell, network)
        apply(propose(target, request), NOW, audit=audit)
        rollback(target, NOW, audit=audit)
    return read(audit)


def test_the_page_has_every_key_of_a_write_and_of_its_refusals(
    tmp_path: Path, checkout: Path, request: pytest.FixtureRequest
) -> None:
    entries = _file_entries(tmp_path, checkout)
    entries += _drive_entries(tmp_path, request.node.nodeid)
    assert undocumented_keys(entries) == {}
    written = written_keys(entries)
    assert set(written) == {
        "apply begun",
        "applied",
        "rollback begun",
        "rolled back",
        "refused",
        "nothing to do",
        "calibration entered",
    }
    assert documented_keys("apply begun") == written["apply begun"]
    # Its row refers to the one above for the drives
    assert {"sha256_before", "sha256_after", "restored"} <= written["rollback begun"]
    assert written["refused"] >= {"refusals", "gate", "subject", "found", "asked"}
