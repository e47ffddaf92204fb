"""The main job of a cell on two buses: scan, prepare, record, a valid log of one plant;
and one bus that dies.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import can
import pytest

from daq.cli.app import main
from daq.config.cell import Cell
from daq.config.cell_buses import bus_parts, cell_address, drive_axes
from daq.config.cell_file import load_cell
from daq.errors import ExitCode
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from daq.workflow.record import network_of
from drivers.canopen.bus import open_bus
from drivers.canopen.network import Bounds, CanopenNetwork
from drivers.canopen.split_bus import CellAddress, SplitAddress, SplitBus, open_cell_bus
from drivers.errors import BusError
from drivers.motion.execute import execute
from drivers.move import AxisLimits, MotionPermission, synchronised_move
from drivers.simulation.cell import SimulatedCell
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from tests.conftest import CHECKOUT
from tests.two_buses import LEFT, RIGHT, on_two_buses

pytestmark = pytest.mark.processes

PERIOD_NS = 1_000_000
ROOM = (AxisLimits(-20_000_000, 20_000_000, 900_000.0, 6_000_000.0),) * 6
PERMISSION = MotionPermission("the test", ROOM)


@dataclass
class Wiring:
    """A cell on two buses of this test, and its amplifiers.

    Attributes:
        path, cell: the cell file.
        simulated: what answers.
        witnesses: an end of each bus, which only listens.
    """

    path: Path
    cell: Cell
    simulated: SimulatedCell
    witnesses: list[can.BusABC] = field(default_factory=list)

    def heard(self) -> list[Counter[int]]:
        """How often each COB-ID came on each bus."""
        counts = []
        for witness in self.witnesses:
            counts.append(Counter[int]())
            while (message := witness.recv(0.0)) is not None:
                counts[-1][message.arbitration_id] += 1
        return counts


@pytest.fixture
def wiring(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Wiring]:
    """Serving."""
    text = (CHECKOUT / "configs/cells/demo.yaml").read_text(encoding="utf-8")
    text = text.replace("../robots", str(CHECKOUT / "configs/robots"))
    path = tmp_path / "cell.yaml"
    name = request.node.name.replace("[", " ").replace("]", "")
    path.write_text(
        on_two_buses(text, "virtual", f"{name} left", f"{name} right"), encoding="utf-8"
    )
    cell = load_cell(path)
    ends = open_cell_bus(cell_address(cell))
    witnesses = [open_bus(part.address) for part in bus_parts(cell)]
    try:
        with SimulatedCell(load_simulation(shipped_simulation("clean")), ends) as simulated:
            yield Wiring(path, cell, simulated, witnesses)
    finally:
        for end in (ends, *witnesses):
            end.shutdown()


def test_scan_reports_the_bus_of_each_node(
    wiring: Wiring, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["scan", str(wiring.path), "--json"]) == ExitCode.OK
    rows = json.loads(capsys.readouterr().out)["nodes"]
    assert [(row["bus"], row["node_id"], row["axis"], row["verdict"]) for row in rows] == [
        ("left" if node in LEFT else "right", node, f"J{node}", "ok") for node in (*LEFT, *RIGHT)
    ]
    assert main(["scan", str(wiring.path)]) == ExitCode.OK
    lines = capsys.readouterr().out.splitlines()
    assert (
        sum(line.startswith("left") for line in lines)
        == sum(line.startswith("right") for line in lines)
        == 3
    )


def test_an_amplifier_on_the_wrong_bus_is_found_there(
    wiring: Wiring, capsys: pytest.CaptureFixture[str]
) -> None:
    text = wiring.path.read_text(encoding="utf-8")
    swapped = text.replace("node_id: 3\n    bus: left", "node_id: 3\n    bus: right")
    assert swapped != text
    wiring.path.write_text(swapped, encoding="utf-8")
    assert main(["scan", str(wiring.path), "--json"]) == ExitCode.DEVICE_FAULT
    rows = json.loads(capsys.readouterr().out)["nodes"]
    found = {(row["bus"], row["verdict"]) for row in rows if row["node_id"] == 3}
    assert found == {("left", "belongs on right"), ("right", "missing")}


def test_the_monitor_shows_both_buses(
    wiring: Wiring, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.stream.monitor.QUIET_S", 0.1)
    assert main(["monitor", str(wiring.path), "--json", "--interval", "0.5"]) == ExitCode.OK
    document = json.loads(capsys.readouterr().out)
    assert [axis["silent"] for axis in document["axes"]] == [False] * 6
    assert [bus["bus"] for bus in document["buses"]] == ["left", "right"]
    assert all(bus["load_percent"] > 0 for bus in document["buses"])
    assert wiring.simulated.cycles == 0


def test_a_short_recording_is_valid(
    wiring: Wiring, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.yaml"
    out = tmp_path / "bare.mcap"
    short = ["--duration", "5", "--exchanges", "2", "--seed", "1", "--condition", "1e9"]
    assert main(["plan", str(wiring.path), "--out", str(plan), *short]) == ExitCode.OK
    capsys.readouterr()
    moving = ["--enable-motion", "--operator", "test", "--json"]
    assert main(["record", str(wiring.path), str(plan), "--out", str(out), *moving]) == ExitCode.OK
    said = capsys.readouterr()
    done = json.loads(said.out)
    assert (done["valid"], done["lost_cycles"], done["missing"]) == (True, 0, [0] * 6)
    assert done["samples"] > 3000
    assert [round(bus["mean_percent"]) for bus in done["bus_load"]] == [41, 41]
    assert "left (virtual:" in said.err
    left, right = wiring.heard()
    syncs = wiring.simulated.cycles
    assert left[0x080] == right[0x080] == syncs  # one plant: time has moved once for both
    for counts, here, there in ((left, LEFT, RIGHT), (right, RIGHT, LEFT)):
        assert all(counts[0x180 + node] >= done["samples"] for node in here)
        for node in there:
            for base in (0x180, 0x200, 0x580, 0x600, 0x700):
                assert counts[base + node] == 0
        assert counts[0x77F] > 10  # the recorder's heartbeat, which the amplifiers of both watch


def _turn(network: CanopenNetwork, at_cycle: int, then: Callable[[], None]) -> None:
    """A move of all axes; at a cycle of it something happens."""
    stream = SyncStream(network, LockstepSync(PERIOD_NS))
    start = next(stream).position_counts
    target = tuple(position + 60_000 for position in start)
    with closing(
        execute(network, stream, (synchronised_move(start, target, ROOM),), PERMISSION)
    ) as samples:
        for number, _ in enumerate(samples):
            if number == at_cycle:
                then()


def test_all_axes_start_with_the_same_sync(wiring: Wiring) -> None:
    first: dict[int, int] = {}
    with network_of(wiring.cell) as network:
        network.prepare()
        stream = SyncStream(network, LockstepSync(PERIOD_NS))
        start = next(stream).position_counts
        move = synchronised_move(start, tuple(position + 60_000 for position in start), ROOM)
        for sample in execute(network, stream, (move,), PERMISSION):
            for axis, word in enumerate(sample.statusword):
                if word & 0x1000:  # set-point acknowledged
                    first.setdefault(axis, sample.cycle)
    assert len(first) == 6
    assert len(set(first.values())) == 1


class CutBus(SplitBus):
    """A split bus of which one wire can be cut."""

    def cut(self, index: int) -> None:
        self._ends[index].shutdown()


@pytest.mark.parametrize("cut", [0, 1])
def test_when_one_bus_dies_the_axes_on_the_other_are_stopped(wiring: Wiring, cut: int) -> None:
    ends: list[CutBus] = []

    def opener(address: CellAddress) -> can.BusABC:
        assert isinstance(address, SplitAddress)
        ends.append(CutBus(address, [open_bus(part.address) for part in address.parts]))
        return ends[-1]

    name, alive = (("left", RIGHT), ("right", LEFT))[cut]
    network = CanopenNetwork(
        cell_address(wiring.cell),
        drive_axes(wiring.cell),
        bounds=Bounds(silence_s=0.3),
        opener=opener,
    )
    with pytest.raises(BusError, match=rf"bus {name} \(virtual:") as caught, network:
        network.prepare()
        _turn(network, 200, lambda: ends[0].cut(cut))
    notes = " ".join(caught.value.__notes__)
    dead = tuple(node for node in (*LEFT, *RIGHT) if node not in alive)
    assert ", ".join(f"J{node} (node {node})" for node in dead) + " did not answer" in notes
    nodes = {node.node_id: node for node in wiring.simulated.nodes}
    assert not any(nodes[node].drive.powered for node in alive)
