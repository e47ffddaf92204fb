"""The ampere of the drives against the name plates of the cell."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.workflow.safeguards import check_currents
from drivers.errors import SetupRefused
from drivers.profiles.profile import TapPoint
from drivers.profiles.scale import ScaleReading
from ident.model.model import DriveTrain


def readings(cell: Cell, factor: float = 1.0) -> list[ScaleReading]:
    """Readings of drives whose torque constants are the cell's, times a factor; each motor has 2 A."""
    constants = [abs(a.nameplate_gain / n) for a, n in zip(cell.axes, DriveTrain(cell.ratio).reduction, strict=True)]
    return [
        ScaleReading(number, "", "generic-cia402", 0.002, {}, 2.0, 2.0 * factor * constant, ())
        for number, constant in enumerate(constants, start=1)
    ]


@pytest.mark.parametrize("name", ["demo", "gantry", "seven-axis"])
def test_name_plates_that_agree_say_nothing_whatever_the_drive_train(name: str, checkout: Path) -> None:
    cell = load_cell(checkout / f"configs/cells/{name}.yaml")
    assert check_currents(cell, readings(cell)) == ()


def test_root_two_is_a_warning_for_each_axis_and_a_thousand_is_refused(checkout: Path) -> None:
    cell = load_cell(checkout / "configs/cells/demo.yaml")
    found = check_currents(cell, readings(cell, math.sqrt(2)))
    assert sorted(", ".join(line.partition(":")[0] for line in found).split(", ")) == list(cell.axis_names)
    assert all("near √2" in line for line in found)
    with pytest.raises(SetupRefused, match=r"node 1: profile generic-cia402: .* 1e\+03 times"):
        check_currents(cell, readings(cell, 1000.0))


def test_what_was_not_checked_and_what_is_no_reference_is_said(checkout: Path) -> None:
    cell = load_cell(checkout / "configs/cells/demo.yaml")
    first = cell.axes[0]
    assert first.profile is not None
    actual = replace(first, profile=replace(first.profile, tap=TapPoint.ACTUAL), gain_unit="Nm/A(actual)")
    other = replace(cell.axes[1], gain_unit="Nm/V")
    changed = replace(cell, axes=(actual, other, *cell.axes[2:]))
    reported = readings(cell)
    for index in (2, 4):
        reported[index] = replace(reported[index], rated_torque_nm=None, warnings=("nothing",))
    note, unit, nothing = check_currents(changed, reported)
    assert note.startswith("J1: ACTUAL current, not the reference (generic-cia402 reports none)")
    assert unit == "J2: the gain is in Nm/V; the torque constant cannot be checked"
    assert nothing == "J3, J5: nothing"
