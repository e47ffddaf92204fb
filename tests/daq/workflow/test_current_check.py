"""The nameplate gains of a cell against the drives and the controller."""

from __future__ import annotations

import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.errors import ConfigurationInconsistent
from daq.workflow.nameplates import check_controller, check_nameplates, nameplate_warnings
from drivers.canopen.scale import ScaleReading
from drivers.profiles.profile import TapPoint
from ident.model.model import DriveTrain


def readings(cell: Cell, factor: float = 1.0) -> list[ScaleReading]:
    """Readings of drives whose torque constants are the cell's, times a factor;
    each motor has 2 A.
    """
    reduction = DriveTrain(cell.ratio).reduction
    constants = [abs(a.nameplate_gain / n) for a, n in zip(cell.axes, reduction, strict=True)]
    return [ScaleReading(0.002, {}, 2.0, 2.0 * factor * constant, ()) for constant in constants]


@pytest.mark.parametrize("name", ["demo", "gantry", "seven-axis"])
def test_nameplates_that_agree_say_nothing_whatever_the_drive_train(
    name: str, checkout: Path
) -> None:
    path = checkout / f"configs/cells/{name}.yaml"
    cell = load_cell(path)
    check_nameplates(path, cell, readings(cell))
    assert nameplate_warnings(cell, readings(cell)) == ()


def test_root_two_is_a_warning_for_each_axis(checkout: Path) -> None:
    path = checkout / "configs/cells/demo.yaml"
    cell = load_cell(path)
    found = nameplate_warnings(cell, readings(cell, math.sqrt(2)))
    assert sorted(", ".join(line.partition(":")[0] for line in found).split(", ")) == list(
        cell.axis_names
    )
    assert all("near √2" in line for line in found)


@pytest.mark.parametrize(
    ("factor", "refused"), [(0.32, True), (0.35, False), (2.9, False), (3.1, True)]
)
def test_a_torque_constant_beyond_a_factor_of_three_is_refused_with_the_line(
    checkout: Path, factor: float, refused: bool
) -> None:
    path = checkout / "configs/cells/demo.yaml"
    cell = load_cell(path)
    reported = readings(cell)
    rated_torque_nm = factor * (reported[3].rated_torque_nm or 0.0)
    reported[3] = replace(reported[3], rated_torque_nm=rated_torque_nm)
    lines = path.read_text().splitlines()
    line = 1 + next(n for n, text in enumerate(lines) if "-11.52" in text)
    if refused:
        where = re.escape(f"demo.yaml:{line}: axes[3].nameplate_gain_nm_per_a")
        with pytest.raises(
            ConfigurationInconsistent, match=f"{where}: .*-11.52 Nm/A, while .* drive's motor"
        ):
            check_nameplates(path, cell, reported)
    else:
        check_nameplates(path, cell, reported)
        (warning,) = nameplate_warnings(cell, reported)
        assert warning.startswith("J4: torque constants differ")


def test_a_controller_with_another_gain_is_refused_with_both_lines(
    checkout: Path, tmp_path: Path
) -> None:
    configs = Path(shutil.copytree(checkout / "configs", tmp_path / "configs"))
    path = configs / "cells/demo.yaml"
    controller = configs / "controllers/demo.yaml"
    check_controller(path, load_cell(path))
    text = controller.read_text()
    line = 1 + next(n for n, line in enumerate(text.splitlines()) if "25.65" in line)
    controller.write_text(text.replace("25.65", "25650"))
    words = (
        "axes[2].nameplate_gain_nm_per_a: found 25.65 Nm/A, while the current gain is 2.565e+04 "
        f"(demo.yaml, line {line})"
    )
    with pytest.raises(ConfigurationInconsistent, match=re.escape(words)):
        check_controller(path, load_cell(path))
    # In another unit by declaration, it is the same gain.
    changed_text = path.read_text().replace(
        "drives.J3.gain,", "{key: drives.J3.gain, factor: 1000},"
    )
    path.write_text(changed_text)
    check_controller(path, load_cell(path))
    controller.unlink()
    check_controller(path, load_cell(path))


def test_what_was_not_checked_and_what_is_no_reference_is_said(checkout: Path) -> None:
    path = checkout / "configs/cells/demo.yaml"
    cell = load_cell(path)
    first = cell.axes[0]
    assert first.profile is not None
    profile = replace(first.profile, tap=TapPoint.ACTUAL)
    actual = replace(first, profile=profile, gain_unit="Nm/A(actual)")
    other = replace(cell.axes[1], gain_unit="Nm/V")
    axes = (actual, other, *cell.axes[2:])
    changed = replace(cell, axes=axes)
    reported = readings(cell)
    for index in (2, 4):
        reported[index] = replace(reported[index], rated_torque_nm=None, warnings=("nothing",))
    note, unit, nothing = nameplate_warnings(changed, reported)
    assert note.startswith("J1: ACTUAL current, not the reference (generic-cia402 reports none)")
    assert unit == "J2: the gain is in Nm/V; the torque constant cannot be checked"
    assert nothing == "J3, J5: nothing"
