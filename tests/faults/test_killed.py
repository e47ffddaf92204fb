"""A recorder that ends without a word, as kill -9 ends it: the amplifiers stop by themselves.

Most tests abandon a recorder in their own process; ``python -m tests.faults.test_killed`` kills a
process of its own with SIGKILL, with a foreign node on every id from 1 to 127, or on those that are
named.
"""

from __future__ import annotations

import logging
import math
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from itertools import islice

import canopen
import numpy as np
import pytest
from canopen import ObjectDictionary
from canopen.objectdictionary import UNSIGNED16, UNSIGNED32, ODVariable
from numpy.typing import NDArray

from daq.config.cell_buses import drive_axes
from daq.config.cell_file import load_cell
from daq.simulation.simulation_file import load_simulation
from drivers.canopen.bus import BusAddress, open_bus
from drivers.canopen.network import CanopenNetwork
from drivers.errors import DriverError
from drivers.messages import Sample
from drivers.motion.execute import execute
from drivers.move import MotionPermission, synchronised_move
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.drive import PowerState
from drivers.simulation.faults import FaultKind
from drivers.simulation.hub import HOST, Hub
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from tests.faults.cells import CONFIGS, PERIOD_NS, ROOM, let_pass

GUARD_MS = 2000
HEARTBEAT_MS = 20
TRAVEL_COUNTS = 2_000_000
"""Longer than the amplifiers wait, shorter than the test looks on."""
MOVING = "moving"
READY_S = 60.0
CHANNEL, AXES = "can0", range(1, 7)


@contextmanager
def foreign_device(address: BusAddress, node_id: int) -> Iterator[None]:
    """A plain device of another stack with a heartbeat of its own:
    `canopen.LocalNode` on the bus.
    """
    dictionary = ObjectDictionary()
    for index, kind in ((0x1000, UNSIGNED32), (0x1017, UNSIGNED16)):
        variable = ODVariable(f"object {index:04X}h", index)
        variable.data_type, variable.default = kind, 0
        dictionary.add_object(variable)
    server = (
        {"host": address.host, "port": address.port} if address.interface == "socketcand" else {}
    )
    with canopen.Network().connect(
        interface=address.interface, channel=address.channel, **server
    ) as network:
        node = network.create_node(node_id, dictionary)
        node.nmt.state = "PRE-OPERATIONAL"
        node.sdo[0x1017].raw = HEARTBEAT_MS
        yield
        node.nmt.stop_heartbeat()


@dataclass(frozen=True)
class Killed:
    """End of axes whose recorder was killed while they moved;
    `refused` where it did not move them at all.
    """

    refused: str
    states: frozenset[PowerState]
    arrived: bool


@contextmanager
def powered_cell(address: BusAddress, *, guarded: bool = True) -> Iterator[SimulatedCell]:
    """The demo cell in this process; its clock runs with the plant's time beside the wall's."""
    with open_bus(address) as bus:
        cell = SimulatedCell(
            load_simulation(CONFIGS / "simulation" / "clean.yaml"),
            bus,
            lambda: time.monotonic() + cell.cycles * PERIOD_NS * 1e-9,
        )
        if not guarded:
            for node in cell.nodes:
                node.inject(FaultKind.NO_GUARD)
        with cell:
            yield cell


def moving(network: CanopenNetwork) -> Generator[Sample, None, None]:
    """Move all axes of a prepared network far away."""
    stream = SyncStream(network, LockstepSync(PERIOD_NS, 5.0))
    start = next(stream).position_counts
    far = synchronised_move(start, tuple(count + TRAVEL_COUNTS for count in start), ROOM)
    yield from execute(network, stream, (far,), MotionPermission("the test", ROOM))


def demo_network(address: BusAddress) -> CanopenNetwork:
    return CanopenNetwork(
        address, drive_axes(load_cell(CONFIGS / "cells" / "demo.yaml")), guard_ms=GUARD_MS
    )


def end_of(cell: SimulatedCell, start_rad: NDArray[np.float64], refused: str = "") -> Killed:
    """The end of the axes now."""
    turned = abs(cell.plant.motor_rad - start_rad) * 65536 / math.tau
    states = frozenset(node.drive.state for node in cell.nodes)
    return Killed(refused, states, bool((turned > 0.99 * TRAVEL_COUNTS).all()))


def kill_recorder(name: str, *, guarded: bool = True, foreign_id: int | None = None) -> Killed:
    """Abandon a recorder of this process in the middle of a move,
    and look on for longer than the amplifiers wait.
    """
    address = BusAddress("virtual", f"killed {name}")
    device = nullcontext() if foreign_id is None else foreign_device(address, foreign_id)
    with device, powered_cell(address, guarded=guarded) as cell:
        start_rad = cell.plant.motor_rad.copy()
        network = demo_network(address)
        network.link.open()
        try:
            network.prepare()
        except DriverError as error:
            network.link.close()
            return end_of(cell, start_rad, str(error))
        samples = moving(network)
        last = list(islice(samples, 300))[-1]
        assert all(word & 0x6F == 0x27 for word in last.statusword)
        network.link.close()  # the process is gone, without another frame
        let_pass(cell, address, GUARD_MS + 500)
        end = end_of(cell, start_rad)
        samples.close()
    return end


def record_until_killed(port: int, samples: int, say: Callable[[str], object]) -> None:
    """Move the axes, and say so after so many samples; or say why they are not moved."""
    with demo_network(BusAddress("socketcand", CHANNEL, host=HOST, port=port)) as network:
        try:
            network.prepare()
        except DriverError as error:
            say(str(error))
            return
        for number, sample in enumerate(moving(network)):
            if number == samples:
                say(
                    MOVING
                    if all(word & 0x6F == 0x27 for word in sample.statusword)
                    else "no axis is enabled"
                )


def kill_process(foreign_id: int) -> Killed:
    """Kill a recorder with SIGKILL, at another moment of its move for each id,
    beside a foreign node of this id.
    """
    (port_end, port_in), (said_end, said_in) = os.pipe(), os.pipe()
    # Forked while this process has one thread: bus, cell and device come afterwards.
    pid = os.fork()
    if pid == 0:
        try:
            port = int(os.read(port_end, 16))
            record_until_killed(
                port, 100 + 3 * foreign_id, lambda text: os.write(said_in, text.encode())
            )
        finally:
            os._exit(0)
    try:
        with ExitStack() as stack:
            address = stack.enter_context(Hub((CHANNEL,))).address()
            stack.enter_context(foreign_device(address, foreign_id))
            cell = stack.enter_context(powered_cell(address))
            start_rad = cell.plant.motor_rad.copy()
            os.write(port_in, str(address.port).encode())
            said = (
                os.read(said_end, 4096).decode()
                if select.select((said_end,), (), (), READY_S)[0]
                else "no answer"
            )
            if said == MOVING:
                os.kill(pid, signal.SIGKILL)
            ended = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            if said != MOVING:
                return end_of(cell, start_rad, said)
            assert ended == -signal.SIGKILL
            let_pass(cell, address, GUARD_MS + 500)
            return end_of(cell, start_rad)
    finally:
        for end in (port_end, port_in, said_end, said_in):
            os.close(end)


@pytest.mark.slow
@pytest.mark.parametrize("guarded", [True, False], ids=["1016h", "without"])
def test_amplifiers_stop_by_themselves_when_the_recorder_is_killed(guarded: bool) -> None:
    """Without 1016h the same axes go on to their target and keep their power:
    the guard is what stops them.
    """
    end = kill_recorder(str(guarded), guarded=guarded)
    assert end.states == {
        PowerState.SWITCH_ON_DISABLED if guarded else PowerState.OPERATION_ENABLED
    }
    assert end.arrived != guarded


@pytest.mark.slow
@pytest.mark.parametrize("node_id", [3, 7, 64, 127])
def test_no_foreign_device_takes_the_place_of_a_killed_recorder(node_id: int) -> None:
    """One with an id of an axis is refused. `make guard-study` tries every id."""
    end = kill_recorder(f"beside {node_id}", foreign_id=node_id)
    assert end.states == {PowerState.SWITCH_ON_DISABLED}
    assert not end.arrived
    assert bool(end.refused) is (node_id <= 6)
    if end.refused:
        assert "J3 (node 3): found" in end.refused
        assert "two have it" in end.refused


@pytest.mark.processes
def test_a_process_that_is_killed_leaves_no_axis_with_power() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.faults.test_killed", "3", "100"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 refused, 1 killed while the axes moved: all stopped by themselves" in done.stdout


def main(ids: Sequence[int]) -> int:
    """Kill a recorder beside a foreign node of each id; 1 if an axis moved on."""
    logging.getLogger("can").setLevel(logging.ERROR)  # of frames that came in two parts
    refused, stopped, moved_on = 0, 0, []
    for every_id in ids:
        outcome = kill_process(every_id)
        good = outcome.states == {PowerState.SWITCH_ON_DISABLED} and not outcome.arrived
        refused, stopped = refused + bool(outcome.refused), stopped + (good and not outcome.refused)
        moved_on += [] if good and (not outcome.refused or every_id in AXES) else [every_id]
        sys.stdout.write(f"{every_id} {'stopped' if good else 'MOVES ON'} {outcome.refused}\n")
        sys.stdout.flush()
    verdict = f"NOT as it must be: {moved_on}" if moved_on else "all stopped by themselves"
    sys.stdout.write(
        f"{len(ids)} ids: {refused} refused, {stopped} killed while the axes moved: {verdict}\n"
    )
    return int(bool(moved_on))


if __name__ == "__main__":
    sys.exit(main([int(word) for word in sys.argv[1:]] or range(1, 128)))
