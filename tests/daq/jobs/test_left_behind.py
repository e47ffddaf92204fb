"""Drives that a killed recorder left with power:
waited for, taken over at standstill, or left to a person.
"""

from __future__ import annotations

import struct
import threading
from contextlib import nullcontext
from pathlib import Path

import can
import pytest

import daq.jobs.context
import daq.workflow.record
from daq.config.cell import PacingMode
from daq.config.cell_buses import bus_address
from daq.jobs.context import check_drives
from drivers.canopen.bus import open_bus
from drivers.errors import BusBusy, StateRefused
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.drive import PowerState
from tests.daq.jobs.rig import make_rig, serving

AXIS = 2
GUARD_MS = 300
STAYS = PowerState.QUICK_STOP_ACTIVE


@pytest.fixture(autouse=True)
def _short_guard(monkeypatch: pytest.MonkeyPatch) -> None:
    """A job waits for as long as a guard and a stop may take."""
    monkeypatch.setattr(daq.workflow.record, "GUARD_MS", dict.fromkeys(PacingMode, GUARD_MS))
    monkeypatch.setattr(daq.jobs.context, "STOP_S", 0.2)


def leave(cell: SimulatedCell, state: PowerState, recorder_id: int = 127) -> PowerState:
    """Leave an axis as a killed recorder does, if it has that id;
    the axis does not leave a quick stop by itself.
    """
    node = cell.nodes[AXIS]
    packed = struct.pack("<h", 6)
    node.write(0x605A, 0, packed)
    node.write(0x1016, 1, struct.pack("<I", recorder_id << 16 | GUARD_MS))
    node.drive.state = state
    return state


@pytest.mark.parametrize("state", [STAYS, PowerState.SWITCHED_ON])
@pytest.mark.parametrize("take_over", [True, False], ids=["job", "dry run"])
def test_a_drive_that_was_left_without_motion_loses_its_power_to_a_job_alone(
    tmp_path: Path, one_move: Path, state: PowerState, take_over: bool
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move)
    with serving(rig) as cell:
        leave(cell, state)
        check_drives(rig.cell, nullcontext, take_over)
        drive = cell.nodes[AXIS].drive
        assert drive.state is (PowerState.SWITCH_ON_DISABLED if take_over else state)
        assert cell.plant.time_s < 1.0


@pytest.mark.parametrize(
    ("state", "recorder_id"),
    [
        (STAYS, 0),
        (STAYS, 3),
        (STAYS, 100),
        (PowerState.OPERATION_ENABLED, 0),
        (PowerState.OPERATION_ENABLED, 127),
    ],
    ids=lambda value: getattr(value, "name", str(value)),
)
def test_a_drive_that_is_anothers_or_did_not_stop_is_a_persons_business(
    tmp_path: Path, one_move: Path, state: PowerState, recorder_id: int
) -> None:
    """An axis with id 3 is there, and no recorder takes 100:
    neither was a recorder that is gone.
    """
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move)
    with serving(rig) as cell:
        leave(cell, state, recorder_id)
        with pytest.raises(
            StateRefused,
            match=r"J3 .*no power before a job.*nothing was "
            r"changed.*drivegain record",
        ):
            check_drives(rig.cell, nullcontext, True)
        assert cell.nodes[AXIS].drive.state is state


def test_a_drive_that_moves_in_its_quick_stop_is_left_alone(
    tmp_path: Path, one_move: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = iter(((0,), (17,)))
    monkeypatch.setattr(daq.jobs.context, "_positions", lambda *_: next(places))
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move)
    with serving(rig) as cell:
        leave(cell, STAYS)
        with pytest.raises(StateRefused, match=r"17 counts in 0\.2 s: press the emergency stop"):
            check_drives(rig.cell, nullcontext, True)
        assert cell.nodes[AXIS].drive.state is STAYS


def test_a_job_beside_a_master_whose_lock_is_not_seen_sends_nothing(
    tmp_path: Path, one_move: Path
) -> None:
    """A recorder on another computer: the axes may be in the middle of its motion."""
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move)
    over = threading.Event()
    with serving(rig), open_bus(bus_address(rig.cell)) as master:

        def lead() -> None:
            while not over.wait(0.01):
                message = can.Message(arbitration_id=0x80, is_extended_id=False)
                master.send(message)

        leading = threading.Thread(target=lead)
        leading.start()
        try:
            with pytest.raises(BusBusy, match="a SYNC"):
                check_drives(rig.cell, nullcontext, True)
        finally:
            over.set()
            leading.join()
        heard = [frame.arbitration_id for frame in iter(lambda: master.recv(0.0), None)]
    numbers = [number for number in heard if 0x600 < number < 0x680]
    assert numbers == []
