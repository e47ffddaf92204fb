"""A recording of drives that move on another CANopen stack, value by value and bit for bit beside
what an independent listener heard.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.cli.app import main
from daq.errors import ExitCode
from drivers.simulation.hub import Hub
from tests.drivers.moving_nodes import PERIOD_S, START_COUNTS, moving_nodes
from tests.vcan.cells import write_cell
from tests.vcan.judgement import SYNC, compare
from tests.vcan.listener import HUB_CHANNEL, heard, listening
from tests.vcan.log_reader import read_recorded

PERIOD_US = round(1e6 * PERIOD_S)
RESTING = 3  #: Index of the axis that stays where it is, below zero
PLAN = """format: drivegain-plan
cell: demo
seed: 1
condition: 100.0
moves:
  - {target_deg: [20, -20, 70, 10, -20, 10], velocity: 0.5, acceleration: 0.5, dwell_s: 0.01}
  - {target_deg: [0, 0, 90, 10, 0, 0], velocity: 0.5, acceleration: 0.5, dwell_s: 0.01}
"""
HUB_STAMPS_NS = 500_000_000
"""Largest difference between a sample's time and its SYNC's: a lockstep cell has a time of its own,
so samples and SYNCs are paired by their order.
"""


@pytest.mark.processes
def test_drives_of_another_stack_are_recorded_bit_for_bit(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN, encoding="utf-8")
    with Hub((HUB_CHANNEL,)) as hub:
        address = hub.address()
        where = f"{address.host}:{address.port}"
        settings = (
            f"bus:\n  interface: socketcand\n  channel: {HUB_CHANNEL}\n  host: {address.host}\n"
            f"  port: {address.port}\n  bitrate_bit_s: 1000000\n"
        )
        cell = write_cell(tmp_path, PERIOD_US, "lockstep", settings)
        with moving_nodes(where), listening(where, tmp_path / "frames"):
            code = main(
                [
                    "record",
                    str(cell),
                    str(plan),
                    "--out",
                    str(log),
                    "--enable-motion",
                    "--operator",
                    "test",
                ]
            )
    assert code == ExitCode.OK
    recorded = read_recorded(log)
    assert recorded is not None
    frames = heard(tmp_path / "frames")
    found = compare(recorded, frames, same_sync_ns=HUB_STAMPS_NS, in_order=True)
    assert found.violations == []
    assert (found.values, found.flagged, found.neighbours) == (recorded.missing.size * 6, 0, 0)
    # The recording is whole: no SYNC between its first and its last is without a sample.
    syncs = [place for place, frame in enumerate(frames) if frame.identifier == SYNC]
    first = syncs.index(found.syncs[0])
    assert found.syncs == syncs[first : first + len(found.syncs)]
    assert list(recorded.cycle) == list(range(recorded.cycle[0], recorded.cycle[-1] + 1))
    # Five axes moved, from where they were at power-on; one rested below zero.
    positions = recorded.values[:, :, 0]
    assert tuple(positions[0]) == START_COUNTS
    ways = np.ptp(positions, axis=0)
    assert ways[RESTING] == 0
    assert (np.delete(ways, RESTING) > 1000).all()
    currents = recorded.values[:, :, 1]
    assert (currents.min(axis=0) < 0).all()
    assert (currents.max(axis=0) > 0).all()
