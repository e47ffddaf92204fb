"""The speed override of a first run: slower profiles for the amplifiers,
in the log and in the report of a fit.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.errors import ExitCode
from daq.log.conversion import load_run
from daq.log.metadata import run_from_record, run_record
from daq.log.reader import read_log
from daq.simulation.simulation_file import load_simulation
from drivers.canopen.bus import open_bus
from drivers.simulation.cell import SimulatedCell
from tests.daq.logs import content
from tests.faults.cells import CONFIGS
from tests.faults.test_scenario import PLAN

PROFILE_VELOCITY = 0x6081
PROFILE_ACCELERATION = 0x6083
PROFILE_DECELERATION = 0x6084


def profiles(cell: SimulatedCell, index: int) -> list[int]:
    """Last profile of the amplifiers; not the sixth,
    which rests where J5 and J6 turn against each other.
    """
    return [int.from_bytes(node.read(index, 0), "little") for node in cell.nodes[:5]]


def recorded(folder: Path, speed: float) -> tuple[Path, list[list[int]]]:
    """A log, and the profile velocities, accelerations and decelerations of its last move."""
    cell_file = CONFIGS / "cells" / "demo.yaml"
    plan = folder / "plan.yaml"
    out = folder / f"{speed}.mcap"
    plan.write_text(PLAN, encoding="utf-8")
    spec = load_simulation(CONFIGS / "simulation" / "clean.yaml")
    with open_bus(bus_address(load_cell(cell_file))) as bus, SimulatedCell(spec, bus) as cell:
        arguments = [
            "record",
            str(cell_file),
            str(plan),
            "--out",
            str(out),
            "--enable-motion",
            "--speed",
            str(speed),
        ]
        assert main([*arguments, "--operator", "test"]) == ExitCode.OK
        reported = [
            profiles(cell, i)
            for i in (PROFILE_VELOCITY, PROFILE_ACCELERATION, PROFILE_DECELERATION)
        ]
    return out, reported


@pytest.mark.slow
def test_a_first_run_is_slower_in_speed_and_ramps_and_its_log_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, planned = recorded(tmp_path, 1.0)
    slow, slowed = recorded(tmp_path, 0.5)
    for one, other, share in zip(planned, slowed, (0.5, 0.25, 0.25), strict=True):
        assert other == pytest.approx([share * value for value in one], rel=2e-3, abs=2.0)
    assert [read_log(path).head.run.speed for path in (whole, slow)] == [1.0, 0.5]
    capsys.readouterr()
    assert main(["info", str(slow), "--json"]) == ExitCode.OK
    assert json.loads(capsys.readouterr().out)["speed"] == 0.5
    with caplog.at_level(logging.WARNING):
        load_run(whole)
        assert not caplog.messages
        load_run(slow)
    assert [
        message for message in caplog.messages if "recorded at 50 % of the plan's speed" in message
    ]


@pytest.mark.parametrize("speed", ["0", "-0.5", "1.5", "nan", "fast"])
def test_a_log_with_another_share_is_refused(speed: str) -> None:
    with pytest.raises(ValueError, match=r"speed|could not convert"):
        run_from_record({**run_record(content(6).run), "speed": speed})


def test_a_log_of_an_earlier_version_was_recorded_at_the_plans_speed() -> None:
    record = run_record(content(6).run)
    del record["speed"]
    assert run_from_record(record) == content(6).run
