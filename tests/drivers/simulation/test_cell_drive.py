"""The driver against the simulated cell: two programs that share nothing but the standards,
over two kinds of bus.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import can
import pytest

from daq.config.cell_buses import drive_axes
from daq.config.cell_file import load_cell
from daq.simulation.simulation_file import load_simulation
from drivers.canopen.bus import BusAddress, open_bus
from drivers.canopen.network import Bounds, CanopenNetwork
from drivers.errors import DriveFault
from drivers.messages import CellEvent, EventKind
from drivers.motion.execute import execute
from drivers.move import AxisLimits, MotionPermission, synchronised_move
from drivers.profiles.cia402 import State
from drivers.profiles.profile import Axis
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.hub import Hub
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync

CONFIGS = Path(__file__).parents[3] / "configs"
PERIOD_NS = 1_000_000
ROOM = (AxisLimits(-20_000_000, 20_000_000, 900_000.0, 6_000_000.0),) * 6
PERMISSION = MotionPermission("the test", ROOM)
#: A busy machine keeps any of the three threads waiting for seconds: no limit of the wall clock
#: decides a test.
PATIENT = Bounds(
    answer_s=30.0, silence_s=10.0, nmt_s=30.0, mode_s=30.0, disable_s=30.0, closing_s=120.0
)
GUARD_MS = 60_000


@pytest.fixture(scope="module")
def axes() -> tuple[Axis, ...]:
    path = CONFIGS / "cells" / "demo.yaml"
    return drive_axes(load_cell(path))


@pytest.fixture(params=["virtual", "socketcand"])
def address(request: pytest.FixtureRequest) -> Iterator[BusAddress]:
    if request.param == "virtual":
        yield BusAddress("virtual", request.node.nodeid)
    else:
        with Hub(("can0",)) as hub:
            yield hub.address()


@pytest.fixture
def cell(address: BusAddress) -> Iterator[SimulatedCell]:
    bus: can.BusABC = open_bus(address)
    try:
        path = CONFIGS / "simulation" / "clean.yaml"
        with SimulatedCell(load_simulation(path), bus) as running:
            yield running
    finally:
        bus.shutdown()


def settings(network: CanopenNetwork) -> list[tuple[bytes, ...]]:
    """Objects that ``prepare`` changes: heartbeat, mode,
    and the communication and mapping of the first PDOs.
    """
    objects = (
        (0x1017, 0),
        (0x6060, 0),
        (0x1800, 1),
        (0x1800, 2),
        (0x1A00, 0),
        (0x1A00, 1),
        (0x1400, 2),
        (0x1600, 0),
    )
    found = []
    for node_id in network.node_ids:
        node = network.link.objects(node_id)
        found.append(tuple(node.read_bytes(index, sub) for index, sub in objects))
    return found


@pytest.mark.slow
@pytest.mark.usefixtures("cell")
def test_scan_prepare_move_and_give_back(address: BusAddress, axes: tuple[Axis, ...]) -> None:
    events: list[CellEvent] = []
    with CanopenNetwork(address, axes, guard_ms=GUARD_MS, bounds=PATIENT) as network:
        found = network.scan(range(1, 20))
        expected = [(n, State.SWITCH_ON_DISABLED) for n in range(1, 7)]
        assert [(node.node_id, node.state) for node in found] == expected
        identities = [axis.identity for axis in axes]
        assert [node.identity for node in found] == identities
        before = settings(network)
        network.prepare()
        assert settings(network) != before
        assert network.ampere_per_unit() == pytest.approx(
            (0.002, 0.002, 0.002, 0.0015, 0.0015, 0.0015)
        )
        pacing = LockstepSync(PERIOD_NS, 10.0)
        stream = SyncStream(network, pacing, events.append)
        start = next(stream).position_counts
        target = tuple(
            position + step for position, step in zip(start, (1, -1, 0, 2, -2, 3), strict=True)
        )
        target = tuple(a + 30_000 * (b - a) for a, b in zip(start, target, strict=True))
        moves = (
            synchronised_move(start, target, ROOM, dwell_cycles=20),
            synchronised_move(target, start, ROOM, dwell_cycles=20),
        )
        with closing(execute(network, stream, moves, PERMISSION)) as samples:
            recorded = list(samples)
        cycles = [sample.cycle for sample in recorded]
        assert cycles == list(range(1, len(recorded) + 1))
        assert stream.statistics.frames == 6 * stream.statistics.cycles
        assert (
            stream.statistics.missing
            == stream.statistics.duplicate
            == stream.statistics.surplus
            == 0
        )
        marks = [
            event for event in events if event.kind in (EventKind.MOVE_START, EventKind.MOVE_END)
        ]
        codes = [mark.code for mark in marks]
        assert codes == [0, 0, 1, 1]
        arrived = next(sample for sample in recorded if sample.time_ns == marks[1].time_ns)
        for position, wanted in zip(arrived.position_counts, target, strict=True):
            assert abs(position - wanted) < 2000
        assert any(any(sample.current_raw) for sample in recorded)
    with CanopenNetwork(address, axes, guard_ms=GUARD_MS, bounds=PATIENT) as network:
        nodes = network.scan(range(1, 7))
        states = {node.state for node in nodes}
        assert states == {State.SWITCH_ON_DISABLED}
        assert settings(network) == before


@pytest.mark.slow
@pytest.mark.usefixtures("cell")
def test_a_closed_run_leaves_no_axis_with_power(
    address: BusAddress, axes: tuple[Axis, ...]
) -> None:
    with CanopenNetwork(address, axes, guard_ms=GUARD_MS, bounds=PATIENT) as network:
        network.prepare()
        pacing = LockstepSync(PERIOD_NS, 10.0)
        stream = SyncStream(network, pacing)
        start = next(stream).position_counts
        target_counts = tuple(position + 300_000 for position in start)
        far = synchronised_move(start, target_counts, ROOM)
        with closing(execute(network, stream, (far,), PERMISSION)) as samples:
            for sample in samples:
                position_count_difference = sample.position_counts[0] - start[0]
                if position_count_difference > 50_000:
                    break
        stopped = next(stream)
        assert max(stopped.position_counts[0] - start[0], 0) < 300_000
        for word in stopped.statusword:
            assert word & 0x6F == 0x40


@pytest.mark.slow
@pytest.mark.usefixtures("cell")
def test_an_emergency_of_a_node_stops_the_others(
    address: BusAddress, axes: tuple[Axis, ...]
) -> None:
    intruder = open_bus(address)
    try:
        with CanopenNetwork(address, axes, guard_ms=GUARD_MS, bounds=PATIENT) as network:
            network.prepare()
            pacing = LockstepSync(PERIOD_NS, 10.0)
            stream = SyncStream(network, pacing)
            start = next(stream).position_counts
            target_counts = tuple(position + 300_000 for position in start)
            far = synchronised_move(start, target_counts, ROOM)
            with (
                pytest.raises(DriveFault, match=r"J3 \(node 3\): .*2310h"),
                closing(execute(network, stream, (far,), PERMISSION)) as samples,
            ):
                for sample in samples:
                    if sample.cycle == 100:
                        data = b"\x10\x23\x03" + bytes(5)
                        emcy = can.Message(
                            arbitration_id=0x83,
                            is_extended_id=False,
                            data=data,
                        )
                        intruder.send(emcy)
            for word in network.statuswords():
                assert word & 0x6F == 0x40
    finally:
        intruder.shutdown()
