"""A robot of one linear axis, with a cell file as short as possible:
its recording imports in m or mm.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from daq.cli.app import main
from daq.config.cell import model_of
from daq.errors import ExitCode
from daq.log.conversion import load_run
from ident.estimators.identify import identify
from ident.estimators.method import Method
from tests.daq.command_line import run_verb

URDF = """<robot name="slide"><link name="base"/>
<link name="carriage"><inertial><mass value="{mass}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="X" type="{kind}"><parent link="base"/><child link="carriage"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" velocity="2" effort="400"/></joint></robot>"""
CELL = """name: slide
robot: {urdf: slide.urdf, gravity_m_s2: [0.0, 0.0, -9.81]}
drive_train: {ratio: [[1.0]]}
axes:
  - {name: X, nameplate_gain: 35.0, gain_unit: N/V,
     limits: {position_mm: [-800, 800], velocity_mm_s: 2000, acceleration_mm_s2: 20000}}
"""
MASS_KG = 95.0
GAIN_N_V = 35.0


@pytest.fixture
def slide(tmp_path: Path) -> Path:
    """A cell file and the recording of a slide that goes to and fro, with rests."""
    text = URDF.format(mass=MASS_KG, kind="prismatic")
    (tmp_path / "slide.urdf").write_text(text)
    (tmp_path / "cell.yaml").write_text(CELL)
    time_s = np.arange(0.0, 30.0, 0.002)
    phase = np.minimum(time_s % 1.5, 1.0)
    phase_rad = np.pi * phase
    way = (1.0 - np.cos(phase_rad)) / 2.0
    there = np.floor(time_s / 1.5)
    ends = 0.3 * np.sin(1.0 + 2.0 * np.arange(40))
    end_difference = ends[there.astype(int) + 1] - ends[there.astype(int)]
    position_m = ends[there.astype(int)] + way * (end_difference)
    position_m_gradient = np.gradient(position_m, time_s)
    position_m_gradient_gradient = np.gradient(position_m_gradient, time_s)
    direction = np.sign(np.gradient(position_m))
    force = MASS_KG * position_m_gradient_gradient + 20.0 * direction
    table = np.column_stack((time_s, position_m, 1000.0 * position_m, force / GAIN_N_V))
    np.savetxt(
        tmp_path / "run.csv", table, delimiter=",", header="t,m,mm,V", comments="", fmt="%.9g"
    )
    return tmp_path


def _import(folder: Path, unit: str) -> int:
    """Import the recording by its column in that unit."""
    position = {"file": "run.csv", "columns": [unit], "unit": unit, "side": "joint"}
    current = {"file": "run.csv", "columns": ["V"], "unit": "V"}
    description = {
        "name": "run",
        "cell": "cell.yaml",
        "position": position,
        "current": current,
        "rate_hz": 500,
    }
    (folder / f"{unit}.yaml").write_text(json.dumps(description))
    return run_verb(
        "import", folder / f"{unit}.yaml", "--data", folder, "--out", folder / f"{unit}.mcap"
    )


@pytest.mark.slow
def test_metres_and_millimetres_are_the_same_run(slide: Path) -> None:
    assert _import(slide, "m") == _import(slide, "mm") == ExitCode.OK
    path = slide / "m.mcap"
    (first, cell), (second, _) = load_run(path), load_run(slide / "mm.mcap")
    np.testing.assert_allclose(first.position_rad, second.position_rad, atol=2e-9)
    position_range_rad = np.ptp(first.position_rad)
    assert position_range_rad == pytest.approx(0.6, abs=0.02)
    found = identify(
        model_of(cell),
        [first],
        cell.conditioning,
        method=Method.ML,
        fixed_gains=np.array([GAIN_N_V]),
    )
    names = [column.name for column in found.estimate.unknowns]
    units = [column.unit for column in found.estimate.unknowns]
    assert found.estimate.parameters[names.index("fs1")] == pytest.approx(20.0, rel=0.05)
    assert units[names.index("fs1")] == "N"


def test_metres_of_an_axis_that_turns(slide: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = URDF.format(mass=MASS_KG, kind="revolute")
    (slide / "slide.urdf").write_text(text)
    changed_cell = CELL.replace("N/V", "Nm/V")
    turning = changed_cell.replace("_mm", "_deg").replace("-800, 800", "-50, 50")
    (slide / "cell.yaml").write_text(turning)
    assert _import(slide, "m") == ExitCode.CONFIGURATION
    assert "m, while axis X turns" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("section", "number", "factor"),
    [("position", 1.5e308, 1.0), ("current", 1e305, 1e9), ("torque", 1e305, 1e9)],
)
def test_a_number_that_no_robot_has(
    section: str, number: float, factor: float, slide: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first was a traceback, the last a log that nothing could read."""
    table = np.loadtxt(slide / "run.csv", delimiter=",", skiprows=1)
    table[5000, {"position": 1, "current": 3, "torque": 2}[section]] = number
    np.savetxt(slide / "run.csv", table, delimiter=",", header="t,m,mm,V", comments="", fmt="%.9g")
    description = {
        "name": "run",
        "cell": "cell.yaml",
        "position": {"file": "run.csv", "columns": ["m"], "unit": "m", "side": "joint"},
        "current": {
            "file": "run.csv",
            "columns": ["V"],
            "unit": "V",
            "factor": factor if section == "current" else 1,
        },
        "torque": {"file": "run.csv", "columns": ["mm"], "side": "joint", "factor": factor},
        "rate_hz": 500,
    }
    (slide / "run.yaml").write_text(json.dumps(description))
    code = main(
        ["import", str(slide / "run.yaml"), "--data", str(slide), "--out", str(slide / "run.mcap")]
    )
    assert code == ExitCode.DATA_UNFIT
    error_output = capsys.readouterr().err
    assert f"as {section}" in error_output
    assert not list(slide.glob("run.mcap*"))


def test_kelvin_are_no_celsius(slide: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = np.loadtxt(slide / "run.csv", delimiter=",", skiprows=1)
    table[:, 2] = 310.0
    np.savetxt(slide / "run.csv", table, delimiter=",", header="t,m,mm,V", comments="", fmt="%.9g")
    description = {
        "name": "run",
        "cell": "cell.yaml",
        "position": {"file": "run.csv", "columns": ["m"], "unit": "m", "side": "joint"},
        "current": {"file": "run.csv", "columns": ["V"], "unit": "V"},
        "temperature": {"file": "run.csv", "columns": ["mm"]},
        "rate_hz": 500,
    }
    (slide / "run.yaml").write_text(json.dumps(description))
    code = main(
        ["import", str(slide / "run.yaml"), "--data", str(slide), "--out", str(slide / "run.mcap")]
    )
    assert code == ExitCode.DATA_UNFIT
    assert "from -60 to 250" in capsys.readouterr().err
