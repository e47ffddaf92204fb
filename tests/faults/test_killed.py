"""A recorder that ends without a word, as kill -9 ends it: the amplifiers stop by themselves."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from itertools import islice

import canopen
import pytest
from canopen import ObjectDictionary
from canopen.objectdictionary import UNSIGNED16, UNSIGNED32, ODVariable

from daq.config.bus import drive_axes
from daq.config.cell_file import load_cell
from daq.simulation.simulation_file import load_simulation
from drivers.canopen.bus import BusAddress, open_bus
from drivers.canopen.network import CanopenNetwork
from drivers.errors import DriverError
from drivers.motion.execute import execute
from drivers.motion.move import MotionPermission, synchronised_move
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.drive import PowerState
from drivers.simulation.faults import FaultKind
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from tests.faults.cells import CONFIGS, PERIOD_NS, ROOM, let_pass

GUARD_MS = 2000
HEARTBEAT_MS = 20
TRAVEL_COUNTS = 2_000_000
"""Longer than the amplifiers wait, shorter than the test looks on."""


@contextmanager
def foreign_device(address: BusAddress, node_id: int) -> Iterator[None]:
    """A plain device of another stack with a heartbeat of its own: `canopen.LocalNode` on the bus."""
    dictionary = ObjectDictionary()
    for index, kind in ((0x1000, UNSIGNED32), (0x1017, UNSIGNED16)):
        variable = ODVariable(f"object {index:04X}h", index)
        variable.data_type, variable.default = kind, 0
        dictionary.add_object(variable)
    with canopen.Network().connect(interface=address.interface, channel=address.channel) as network:
        node = network.create_node(node_id, dictionary)
        node.nmt.state = "PRE-OPERATIONAL"
        node.sdo[0x1017].raw = HEARTBEAT_MS
        yield
        node.nmt.stop_heartbeat()


@dataclass(frozen=True)
class Killed:
    """End of axes whose recorder was killed while they moved; `refused` where it did not move them at all."""

    refused: DriverError | None
    states: frozenset[PowerState]
    arrived: bool


def kill_recorder(name: str, *, guarded: bool = True, foreign_id: int | None = None) -> Killed:
    """Kill the recorder in the middle of a move, and look on for longer than the amplifiers wait."""
    address = BusAddress("virtual", f"killed {name}")
    device = nullcontext() if foreign_id is None else foreign_device(address, foreign_id)
    with open_bus(address) as bus, device:
        cell = SimulatedCell(
            load_simulation(CONFIGS / "simulation" / "clean.yaml"),
            bus,
            lambda: time.monotonic() + cell.cycles * PERIOD_NS * 1e-9,
        )
        if not guarded:
            for node in cell.nodes:
                node.inject(FaultKind.NO_GUARD)
        axes = drive_axes(load_cell(CONFIGS / "cells" / "demo.yaml"))
        start_rad = cell.plant.motor_rad.copy()
        with cell:
            network = CanopenNetwork(address, axes, guard_ms=GUARD_MS)
            network.link.open()
            try:
                network.prepare()
            except DriverError as error:
                network.link.close()
                return Killed(error, frozenset(node.drive.state for node in cell.nodes), arrived=False)
            stream = SyncStream(network, LockstepSync(PERIOD_NS, 5.0))
            start, start_rad = next(stream).position_counts, cell.plant.motor_rad.copy()
            far = synchronised_move(start, tuple(count + TRAVEL_COUNTS for count in start), ROOM)
            samples = execute(network, stream, (far,), MotionPermission("the test", ROOM))
            moving = list(islice(samples, 300))[-1]
            assert all(word & 0x6F == 0x27 for word in moving.statusword)
            network.link.close()  # the process is gone, without another frame
            let_pass(cell, address, GUARD_MS + 500)
            turned = abs(cell.plant.motor_rad - start_rad) * 65536 / (2 * 3.141592653589793)
            states = frozenset(node.drive.state for node in cell.nodes)
            samples.close()
    return Killed(None, states, bool((turned > 0.99 * TRAVEL_COUNTS).all()))


@pytest.mark.parametrize("guarded", [True, False], ids=["1016h", "without"])
def test_amplifiers_stop_by_themselves_when_the_recorder_is_killed(guarded: bool) -> None:
    """Without 1016h the same axes go on to their target and keep their power: the guard is what stops them."""
    end = kill_recorder(str(guarded), guarded=guarded)
    assert end.states == {PowerState.SWITCH_ON_DISABLED if guarded else PowerState.OPERATION_ENABLED}
    assert end.arrived != guarded


@pytest.mark.parametrize("node_id", [3, 7, 64, 127])
def test_no_foreign_device_takes_the_place_of_a_killed_recorder(node_id: int) -> None:
    """One with an id of an axis is refused. `python -m tests.faults.test_killed` tries every id."""
    end = kill_recorder(f"beside {node_id}", foreign_id=node_id)
    assert end.states == {PowerState.SWITCH_ON_DISABLED}
    assert not end.arrived
    assert (end.refused is not None) is (node_id <= 6)
    if end.refused is not None:
        assert "J3 (node 3): found" in str(end.refused)
        assert "two have it" in str(end.refused)


if __name__ == "__main__":
    for every_id in range(1, 128):
        outcome = kill_recorder(f"sweep {every_id}", foreign_id=every_id)
        stopped = outcome.states == {PowerState.SWITCH_ON_DISABLED} and not outcome.arrived
        sys.stdout.write(f"{every_id} {'stopped' if stopped else 'MOVES ON'} {outcome.refused or ''}\n")
