"""Figures of a history, by which a change of gains is judged."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from daq.config.cell import Cell
from daq.config.same_cell import calibrated_robot
from daq.ledger.ledger import enter_calibration, plan_rename, read_history, rename_cell
from daq.ledger.names import drives_of
from daq.writeback.judgement import NO_HISTORY, read_history_figures
from daq.writeback.request import GainChange, Request
from tests.daq.histories import BEGIN, calibration_of, digest_of, ledger_in

LATER = BEGIN + timedelta(weeks=10)


def _with_another_drive(cell: Cell) -> Cell:
    axis = cell.axes[3]
    assert axis.identity is not None
    identity = replace(axis.identity, product_code=0x40300)
    exchanged = replace(axis, identity=identity)
    axes = (*cell.axes[:3], exchanged, *cell.axes[4:])
    return replace(cell, axes=axes)


def test_the_gains_of_a_renamed_cell_are_taken_as_exact_under_its_old_name(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Another robot has the name now, and a calibration of a version that named no robot."""
    ledger = ledger_in(tmp_path)
    cell = ledger.cell
    first = replace(calibration_of(0), robot=calibrated_robot(cell))
    enter_calibration(ledger, first, digest=digest_of(first), who="anna", at=BEGIN)
    renamed = replace(ledger, cell=replace(cell, name="press"))
    rename_cell(renamed, plan_rename(renamed, "demo"), who="anna", at=LATER)
    other = replace(ledger, cell=_with_another_drive(cell))
    unnamed = replace(calibration_of(11), robot=None)
    enter_calibration(other, unnamed, digest=digest_of(unnamed), who="anna", at=LATER)
    assert read_history(ledger).entries

    cell_without_history = replace(cell, history=None)
    request = Request(calibration_of(12), LATER)
    changes = []
    for gain in unnamed.gains:
        change = GainChange.of(gain, "key", 1, gain.value, None)
        changes.append(change)
    figures = read_history_figures(
        cell_without_history, drives_of("demo"), request, changes, ledger.audit
    )
    assert "is under its name 'press', so the current gains are taken as exact" in caplog.text
    assert figures is NO_HISTORY
