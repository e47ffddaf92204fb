"""A cell whose master is gone: after the heartbeat guard has expired its time goes on without SYNC,
never before.
"""

from __future__ import annotations

import numpy as np
import pytest

from drivers.simulation.drive import PowerState
from tests.drivers.simulation.cells import Master, clean_cell, running
from tests.drivers.simulation.test_cell import SIX, begin_move

GUARD_MS = 500
RECORDER = 127
ENABLING = 3  #: SYNCs of `set_up`
CYCLES = 200  #: SYNCs of the master: in the middle of the move


class Clock:
    """A clock that the test moves."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def set_up(master: Master, guarded: range = SIX, option: int = 2) -> None:
    """Map the nodes, let some watch the master, and enable all."""
    master.set_up(SIX)
    for node_id in SIX:
        if node_id in guarded:
            watched = RECORDER << 16 | GUARD_MS
        else:
            watched = 0
        assert master.write(node_id, 0x1016, 1, "I", watched) == 0
        assert master.write(node_id, 0x6007, 0, "h", 3) == 0
        assert master.write(node_id, 0x605A, 0, "h", option) == 0
    master.send(0x700 + RECORDER, b"\x05")
    master.enable(SIX)


def let_go_on(master: Master, clock: Clock, seconds: float) -> None:
    """Let the clock go on in steps; the cell looks at it with every frame."""
    for _ in range(round(seconds / 0.02)):
        clock.now_s += 0.02
        master.read(1, 0x6041, 0, "H")
    # Answered when the cell has done what the last look at the clock called for
    master.read(1, 0x6041, 0, "H")


@pytest.mark.parametrize(
    ("option", "state"), [(2, PowerState.SWITCH_ON_DISABLED), (6, PowerState.QUICK_STOP_ACTIVE)]
)
def test_axes_of_a_killed_master_come_to_rest_without_sync(
    option: int, state: PowerState, request: pytest.FixtureRequest
) -> None:
    spec = clean_cell()
    clock = Clock()
    with running(spec, request.node.name, clock) as (cell, master):
        set_up(master, option=option)
        target = spec.start_rad + 0.8
        begin_move(master, spec, target, 0.5, 0.1)
        for _ in range(CYCLES):
            master.sync()
        absolute_velocity_rad_s = np.abs(cell.plant.velocity_rad_s)
        assert absolute_velocity_rad_s.min() > 0.5
        frozen = cell.cycles
        seconds = 0.001 * GUARD_MS - 0.04
        let_go_on(master, clock, seconds)
        # The guard has not expired: a late master finds everything as it was
        assert cell.cycles == frozen
        let_go_on(master, clock, 2.0)
        states = {node.drive.state for node in cell.nodes}
        assert states == {state}
        largest_error = np.abs(cell.plant.velocity_rad_s).max()
        assert largest_error < 1e-3
        rested = cell.cycles
        assert 100 < rested - frozen < 1000
        let_go_on(master, clock, 1.0)
        assert cell.cycles == rested  # at rest time stops again
        assert (0x081, b"\x30\x81\x00\x00\x00\x00\x00\x00") in master.others


def test_an_axis_that_watches_no_one_ends_its_move_as_at_a_bus_with_time_of_its_own(
    request: pytest.FixtureRequest,
) -> None:
    spec = clean_cell()
    clock = Clock()
    with running(spec, request.node.name, clock) as (cell, master):
        set_up(master, guarded=range(2, 7))
        target = spec.start_rad + 0.8
        begin_move(master, spec, target, 0.5, 0.1)
        for _ in range(CYCLES):
            master.sync()
        let_go_on(master, clock, 3.0)
        states = [node.drive.state for node in cell.nodes]
        expected = [PowerState.OPERATION_ENABLED, *[PowerState.SWITCH_ON_DISABLED] * 5]
        assert states == expected
        assert cell.plant.position_rad[0] == pytest.approx(spec.start_rad[0] + 0.8, abs=0.01)
        limit = spec.start_rad[1] + 0.7
        assert cell.plant.position_rad[1] < limit


def test_an_axis_that_is_only_switched_on_goes_off_with_its_master(
    request: pytest.FixtureRequest,
) -> None:
    clock = Clock()
    with running(clean_cell(), request.node.name, clock) as (cell, master):
        set_up(master)
        for controlword in (0x00, 0x06, 0x07):
            master.control(SIX, controlword)
            master.sync()
        states = {node.drive.state for node in cell.nodes}
        assert states == {PowerState.SWITCHED_ON}
        let_go_on(master, clock, 1.0)
        assert {node.drive.state for node in cell.nodes} == {PowerState.SWITCH_ON_DISABLED}


def test_a_sync_ends_the_time_without_sync(request: pytest.FixtureRequest) -> None:
    """The next program brings its own time:
    between its SYNCs nothing moves, however long it takes.
    """
    spec = clean_cell()
    clock = Clock()
    with running(spec, request.node.name, clock) as (cell, master):
        set_up(master)
        target = spec.start_rad + 0.8
        begin_move(master, spec, target, 0.5, 0.1)
        for _ in range(CYCLES):
            master.sync()
        seconds = 0.001 * GUARD_MS + 0.06
        let_go_on(master, clock, seconds)
        stopping = cell.cycles
        states = {node.drive.state for node in cell.nodes}
        assert states == {PowerState.QUICK_STOP_ACTIVE}
        master.send(0x080, b"")
        master.read(1, 0x6041, 0, "H")
        let_go_on(master, clock, 2.0)
        assert cell.cycles == stopping + 1


def test_a_cell_that_a_busy_machine_held_up_does_not_blame_its_master(
    request: pytest.FixtureRequest,
) -> None:
    """SYNCs and heartbeats that came meanwhile wait to be read; the first frame is a SYNC."""
    spec = clean_cell()
    clock = Clock()
    with running(spec, request.node.name, clock) as (cell, master):
        set_up(master)
        target = spec.start_rad + 0.8
        begin_move(master, spec, target, 0.5, 0.1)
        for _ in range(CYCLES):
            master.sync()
        clock.now_s += 4.0 * 0.001 * GUARD_MS
        for _ in range(3):
            master.sync()
            master.send(0x700 + RECORDER, b"\x05")
        states = {node.drive.state for node in cell.nodes}
        assert states == {PowerState.OPERATION_ENABLED}
        expected = CYCLES + 3 + ENABLING
        assert cell.cycles == expected
        # A master that is gone is still found, one guard time later.
        seconds = 0.001 * GUARD_MS + 0.06
        let_go_on(master, clock, seconds)
        assert {node.drive.state for node in cell.nodes} == {PowerState.QUICK_STOP_ACTIVE}


def test_a_master_that_is_late_within_the_guard_gets_the_same_bytes(
    request: pytest.FixtureRequest,
) -> None:
    """A busy machine keeps a recorder waiting for almost as long as its guard allows,
    again and again.
    """

    def story(pause_s: float) -> list[tuple[int, bytes]]:
        spec = clean_cell("disc")
        clock = Clock()
        with running(spec, request.node.name, clock) as (_, master):
            set_up(master)
            target = spec.start_rad + 0.3
            begin_move(master, spec, target, 0.25, 0.1)
            for cycle in range(120):
                if cycle % 30 == 0:
                    let_go_on(master, clock, pause_s)
                    master.send(0x700 + RECORDER, b"\x05")
                master.sync()
            return master.answers

    assert story(0.48) == story(0.0)
