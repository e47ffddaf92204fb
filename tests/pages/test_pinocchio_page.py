"""The torque of the page on Pinocchio is that of the calibration."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from daq.cli.app import main
from tests.daq.robot_calibrations import apart, robot_of
from tests.pages.blocks import blocks_of

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "use-pinocchio.md"


def test_the_script_of_the_page_has_the_predicted_torque(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An arm with the coupled wrist of the tutorial's, and no effects."""
    pytest.importorskip("pinocchio")
    monkeypatch.chdir(tmp_path)
    robot = robot_of("tx40")
    calibration = robot.saved(tmp_path)
    assert (
        main(
            [
                "export",
                "urdf",
                str(robot.cell_file),
                str(calibration),
                "--out",
                "robot.urdf",
                "--json",
            ]
        )
        == 0
    )
    Path("robot.json").write_text(capsys.readouterr().out, encoding="utf-8")
    (script,) = [
        block for block in blocks_of(PAGE.read_text(encoding="utf-8")) if block.saved_as is not None
    ]
    Path("torque.py").write_text(script.text, encoding="utf-8")
    torque_nm = runpy.run_path("torque.py")["torque_nm"]
    states = robot.states
    samples = zip(
        states.position_rad, states.velocity_rad_s, states.acceleration_rad_s2, strict=True
    )
    found = np.array([torque_nm(*sample) for sample in samples]).T
    assert apart(found, robot.predicted_nm()) <= 1e-6
