"""A recorder that ends without a word, as kill -9 ends it: the amplifiers stop by themselves."""

from __future__ import annotations

import time
from itertools import islice

import can
import pytest

from daq.config.bus import drive_axes
from daq.config.cell_file import load_cell
from daq.simulation.simulation_file import load_simulation
from drivers.canopen.bus import BusAddress, open_bus
from drivers.canopen.network import CanopenNetwork
from drivers.motion.execute import execute
from drivers.motion.move import MotionPermission, synchronised_move
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.drive import PowerState
from drivers.simulation.faults import FaultKind
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from tests.faults.cells import CONFIGS, PERIOD_NS, ROOM, let_pass

GUARD_MS = 2000
TRAVEL_COUNTS = 2_000_000
"""Longer than the amplifiers wait, shorter than the test looks on."""


@pytest.mark.parametrize(
    ("guarded", "foreign"), [(True, False), (True, True), (False, False)], ids=["1016h", "foreign 127", "without"]
)
def test_amplifiers_stop_by_themselves_when_the_recorder_is_killed(guarded: bool, foreign: bool) -> None:
    """Without 1016h the same axes go on to their target and keep their power: the guard is what stops them.

    A device with the highest node id, and a heartbeat of its own, does not take the recorder's place.
    """
    address = BusAddress("virtual", f"killed {guarded} {foreign}")
    bus = open_bus(address)
    device = open_bus(address)
    if foreign:
        device.send_periodic(can.Message(arbitration_id=0x77F, is_extended_id=False, data=b"\x05"), 0.01)
    cell = SimulatedCell(
        load_simulation(CONFIGS / "simulation" / "clean.yaml"),
        bus,
        lambda: time.monotonic() + cell.cycles * PERIOD_NS * 1e-9,
    )
    if not guarded:
        for node in cell.nodes:
            node.inject(FaultKind.NO_GUARD)
    axes = drive_axes(load_cell(CONFIGS / "cells" / "demo.yaml"))
    with cell:
        network = CanopenNetwork(address, axes, guard_ms=GUARD_MS)
        network.link.open()
        network.prepare()
        stream = SyncStream(network, LockstepSync(PERIOD_NS, 5.0))
        start, start_rad = next(stream).position_counts, cell.plant.motor_rad.copy()
        far = synchronised_move(start, tuple(count + TRAVEL_COUNTS for count in start), ROOM)
        samples = execute(network, stream, (far,), MotionPermission("the test", ROOM))
        moving = list(islice(samples, 300))[-1]
        assert all(word & 0x6F == 0x27 for word in moving.statusword)
        network.link.close()  # the process is gone, without another frame
        let_pass(cell, address, GUARD_MS + 500)
        states = {node.drive.state for node in cell.nodes}
        turned = abs(cell.plant.motor_rad - start_rad) * 65536 / (2 * 3.141592653589793)
        assert states == {PowerState.SWITCH_ON_DISABLED if guarded else PowerState.OPERATION_ENABLED}
        assert bool((turned > 0.99 * TRAVEL_COUNTS).all()) != guarded
        samples.close()
    device.shutdown()
    bus.shutdown()
