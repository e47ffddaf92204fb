"""The audit log's page gives the keys of the entries that make up a history."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from daq.ledger.audit import AuditAction, append, read
from daq.ledger.ledger import acknowledge, plan_rename, rename_cell
from tests.daq.documented_keys import undocumented_keys, written_keys
from tests.daq.histories import BEGIN, calibration_of, enter, ledger_in


def test_the_page_has_every_key_of_a_history(tmp_path: Path) -> None:
    ledger = ledger_in(tmp_path)
    enter(ledger, calibration_of(0))
    acknowledge(ledger, "J1", since=BEGIN, at=BEGIN, who="anna", why="the motor is new")
    with ledger.audit.open("ab") as stream:
        stream.write(b'{"action":"apply begun"')  # a writer was killed
    cell = replace(ledger.cell, name="press-4")
    renamed = replace(ledger, cell=cell)
    planned = plan_rename(renamed, "demo")
    rename_cell(renamed, planned, who="anna", at=BEGIN)
    entries = read(ledger.audit)
    assert undocumented_keys(entries) == {}
    assert set(written_keys(entries)) == {
        "calibration entered",
        "acknowledged",
        "torn line",
        "renamed",
    }


@pytest.mark.parametrize("key", ["sigma", "writes"])
def test_a_key_that_the_page_lacks_is_named(tmp_path: Path, key: str) -> None:
    audit = tmp_path / "audit.jsonl"
    details: dict[str, object] = {"changes": [{"axis": "J1", key: 1.0}]}
    append(audit, AuditAction.APPLY_BEGUN, at=BEGIN, who="anna", subject="x", details=details)
    assert undocumented_keys(read(audit)) == {"apply begun": {key}}
