"""The smallest cell file, as the page on MuJoCo shows it: a calibration of arrays leaves by it."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

import daq
import ident
from daq.cli import main

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "how-to" / "simulate-in-mujoco.md"
EXAMPLE = SimpleNamespace(**runpy.run_path(str(ROOT / "examples" / "gains_from_arrays.py")))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the example's calibration, its URDF and the cell file of the page."""
    found = EXAMPLE.main()
    calibration = ident.calibration_of(found, ["J1", "J2", "J3"], EXAMPLE.NAMEPLATE_NM_A)
    room = tmp_path_factory.mktemp("library")
    daq.save_calibration(calibration, room / "calibration.yaml")
    (room / "arm.urdf").write_text(EXAMPLE.URDF)
    (block,) = re.findall(r"```yaml\n(name: robot\n.*?)```", PAGE.read_text(), flags=re.DOTALL)
    (room / "robot.cell.yaml").write_text(block)
    return room


def test_a_calibration_of_arrays_is_exported_with_the_cell_file_of_the_page(folder: Path) -> None:
    cell, calibration, model = (
        str(folder / name) for name in ("robot.cell.yaml", "calibration.yaml", "robot.xml")
    )
    assert main(["export", "mjcf", cell, calibration, "--out", model]) == 0
    loaded = mujoco.MjModel.from_xml_path(model)
    gains = loaded.actuator_gear[:, 0]
    assert np.abs(gains) == pytest.approx(np.abs(EXAMPLE.TRUE_GAINS_NM_A), rel=0.02)


def test_another_name_is_refused_with_both_names(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = folder / "other.cell.yaml"
    other.write_text(
        (folder / "robot.cell.yaml").read_text().replace("name: robot\n", "name: arm\n", 1)
    )
    model = folder / "other.xml"
    assert (
        main(["export", "mjcf", str(other), str(folder / "calibration.yaml"), "--out", str(model)])
        != 0
    )
    said = capsys.readouterr().err
    assert "'arm'" in said
    assert "'robot'" in said
    assert not model.exists()
