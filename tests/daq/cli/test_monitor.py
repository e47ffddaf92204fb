"""`drivegain monitor`: what it shows of a cell, and that it leaves the cell alone."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from daq.cli.app import main
from daq.config.bus import answer_us, drive_axes
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.errors import ExitCode
from daq.report.bus import bus_loads_percent, joint_positions, monitor_document, monitor_view
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from daq.workflow.safeguards import bus_lock, bus_taken
from drivers.canopen.bus import BusAddress, open_bus
from drivers.canopen.link import Link
from drivers.canopen.sdo import SdoPolicy
from drivers.simulation.cell import SimulatedCell
from drivers.stream.monitor import ANSWER_S, QUIET_S, READING_S, AxisReading, CellMonitor, CellReading, ReadingSource
from tests.drivers.scripted import FakeClock

CHECKOUT = Path(__file__).parents[3]
CELL = load_cell(CHECKOUT / "configs/cells/demo.yaml")
ADDRESS = BusAddress("virtual", "monitored")
WATCH_S = 1.0


class QuietBus(can.BusABC):
    """A bus on which a test says what comes; waiting for a frame lets the clock's time pass."""

    def __init__(self, clock: FakeClock) -> None:
        self.clock = clock
        self.sent: list[can.Message] = []
        self.coming: list[tuple[int, can.Message]] = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Keep it."""
        self.sent.append(msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame, if it comes in this time."""
        until_ns = self.clock.now_ns + max(1, round((timeout or 0.0) * 1e9))
        if self.coming and self.coming[0][0] <= until_ns:
            at_ns, message = self.coming.pop(0)
            self.clock.now_ns = max(self.clock.now_ns, at_ns)
            return message
        self.clock.now_ns = until_ns
        return None

    def shutdown(self) -> None:
        """Nothing to close."""
        self._is_shutdown = True


def _frame(identifier: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


@pytest.fixture
def bus() -> Iterator[QuietBus]:
    """Closed at the end."""
    made = QuietBus(FakeClock())
    yield made
    made.shutdown()


def _monitor(bus: QuietBus) -> CellMonitor:
    link = Link(ADDRESS, SdoPolicy(), bus.clock, lambda _address: bus)
    link.open()
    return CellMonitor(link, drive_axes(CELL))


def _answers(at_ns: int, cycle: int, silent: int | None = None) -> list[tuple[int, can.Message]]:
    frames = [(at_ns, _frame(0x80))]
    for node in range(1, 7):
        if node != silent:
            data = struct.pack("<ihH", 1000 * node + cycle, -node, 0x1237)
            frames.append((at_ns + 1000 * node, _frame(0x180 + node, data)))
    return frames


def test_nothing_is_sent_while_another_master_leads_and_its_losses_are_counted(bus: QuietBus) -> None:
    monitor = _monitor(bus)
    start = bus.clock.now_ns
    for cycle in range(500):
        bus.coming += _answers(start + (cycle + 1) * 10_000_000, cycle, silent=3 if cycle in (200, 201) else None)
    reading = monitor.watch(5.005)
    assert bus.sent == []
    assert reading.source is ReadingSource.OVERHEARD
    assert [axis.position_counts for axis in reading.axes] == [1000 * node + 499 for node in range(1, 7)]
    assert [axis.current_raw for axis in reading.axes] == [-1, -2, -3, -4, -5, -6]
    assert [axis.lost for axis in reading.axes] == [0, 0, 2, 0, 0, 0]
    assert reading.sync_hz == pytest.approx(100, rel=0.01)
    assert reading.axes[0].rate_hz == pytest.approx(100, rel=0.01)
    assert reading.axes[2].rate_hz == pytest.approx(498 / 5.005, rel=1e-6)
    # SYNC and six answers in 10 ms, by the count that a recording is refused with.
    profiles = [axis.profile for axis in CELL.axes if axis.profile is not None]
    assert bus_loads_percent(CELL, reading)[0] == pytest.approx(answer_us(profiles, 1_000_000) / 100.0, rel=0.01)


def test_a_quiet_bus_is_asked_by_uploads_alone_and_silence_is_counted(bus: QuietBus) -> None:
    monitor = _monitor(bus)
    monitor.watch(QUIET_S - 0.01)
    assert bus.sent == []
    reading = monitor.watch(10 * ANSWER_S)
    assert {message.arbitration_id for message in bus.sent} == {0x600 + node for node in range(1, 7)}
    assert {message.data[0] for message in bus.sent} == {0x40}
    assert reading.source is ReadingSource.ASKED
    assert all(8 <= axis.lost <= 10 and axis.position_counts is None and axis.rate_hz == 0 for axis in reading.axes)


def test_asking_leaves_the_bus_to_others(bus: QuietBus) -> None:
    """Every request is answered at once; still a reading is asked for ten times a second and no more."""
    monitor = _monitor(bus)
    monitor.watch(QUIET_S)
    answered = 0

    def answer(msg: can.Message, timeout: float | None = None) -> None:
        nonlocal answered
        answered += 1
        reply = bytes((0x43, *msg.data[1:4])) + bytes(4)
        bus.coming.append((bus.clock.now_ns, _frame(msg.arbitration_id - 0x80, reply)))

    bus.send = answer  # type: ignore[method-assign]
    reading = monitor.watch(5.0)
    assert all(axis.rate_hz == pytest.approx(1 / READING_S, rel=0.15) for axis in reading.axes)
    assert answered == pytest.approx(6 * 3 * 5.0 / READING_S, rel=0.15)
    assert bus_loads_percent(CELL, reading)[0] < 6.0


@pytest.mark.parametrize("identifier", [0x000, 0x080, 0x601])
def test_asking_ends_when_another_master_speaks(bus: QuietBus, identifier: int) -> None:
    monitor = _monitor(bus)
    monitor.watch(QUIET_S + 0.1)
    asked = len(bus.sent)
    bus.coming.append((bus.clock.now_ns, _frame(identifier, bytes(8))))
    assert monitor.watch(QUIET_S - 0.01).source is ReadingSource.OVERHEARD
    assert len(bus.sent) <= asked + 6  # those that left before it spoke
    asked = len(bus.sent)
    monitor.watch(0.1)
    assert len(bus.sent) == asked + 6


def test_a_late_answer_to_another_client_is_no_reading(bus: QuietBus) -> None:
    monitor = _monitor(bus)
    monitor.watch(QUIET_S + 0.01)
    other = bytes((0x43, 0x75, 0x60, 0)) + struct.pack("<I", 2000)
    bus.coming.append((bus.clock.now_ns, _frame(0x581, other)))
    assert monitor.watch(0.05).axes[0].position_counts is None
    mine = bytes((0x43, 0x64, 0x60, 0)) + struct.pack("<i", -7)
    bus.coming.append((bus.clock.now_ns, _frame(0x581, mine)))
    assert monitor.watch(0.05).axes[0].position_counts == -7


@settings(deadline=None)
@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6), st.integers(0, 5))
def test_positions_are_those_of_the_joints_and_unknown_where_a_motor_is(joints: list[float], unknown: int) -> None:
    motor = CELL.ratio @ (np.array(joints) - [axis.zero_offset_rad for axis in CELL.axes])
    counts: list[int | None] = [round(turn * 65536 / (2 * np.pi)) for turn in motor]
    reading = _reading(counts)
    assert joint_positions(CELL, reading) == pytest.approx(joints, abs=1e-5)
    counts[unknown] = None
    shown = joint_positions(CELL, _reading(counts))
    # Motor 6 turns with joints 5 and 6: without motor 5 neither of the two is known (paper eq. 24).
    assert {number for number, value in enumerate(shown) if value is None} == ({4, 5} if unknown == 4 else {unknown})


def _reading(counts: list[int | None]) -> CellReading:
    axes = tuple(AxisReading(count, 5, 0x237, 5, 10.0, 0) for count in counts)
    return CellReading(ReadingSource.ASKED, 0.5, axes, 0.0, ((0,) * 9,), ())


def test_what_is_not_known_is_shown_as_that() -> None:
    out = io.StringIO()
    dead = AxisReading(None, None, None, None, 0.0, 3)
    reading = _reading([0] * 6)
    reading = CellReading(reading.source, 0.5, (*reading.axes[:5], dead), 0.0, ((0,) * 9,), ())
    document = monitor_document(CELL, reading, [0.002, None, None, None, None, None], ["a\x1b[2Jb"])
    Console(file=out, width=100).print(monitor_view(document))
    text = out.getvalue()
    assert "+0.010 A" in text
    assert "+5 raw" in text
    assert "(SILENT)" in text
    assert "operation enabled (ENABLED)" in text
    assert "\x1b[2J" not in text


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The demo cell on a bus of this test, without other traffic: a short silence will do."""
    monkeypatch.setattr("drivers.stream.monitor.QUIET_S", 0.1)
    text = (CHECKOUT / "configs/cells/demo.yaml").read_text().replace("../robots", str(CHECKOUT / "configs/robots"))
    path = tmp_path / "cell.yaml"
    path.write_text(text.replace("channel: demo", "channel: monitored"))
    return path


def test_a_simulated_cell_is_shown_and_left_as_it_was(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bus, witness = open_bus(ADDRESS), open_bus(ADDRESS)
    try:
        simulated = SimulatedCell(load_simulation(shipped_simulation("clean")), bus)
        with simulated:
            assert main(["monitor", str(cell), "--json", "--interval", "0.5"]) == ExitCode.OK
        document = json.loads(capsys.readouterr().out)
        asked = []
        while (message := witness.recv(0.0)) is not None:
            if not message.arbitration_id & 0x80 or message.arbitration_id == 0x80:
                asked.append((message.arbitration_id, message.data[0] if message.data else None))
    finally:
        bus.shutdown()
        witness.shutdown()
    assert simulated.cycles == 0
    aborted = 0x80  # where an answer comes too late on a loaded machine, the client ends the transfer, and nothing else
    masters = {one for one in asked if one[0] < 0x700 and one[1] != aborted}
    assert masters == {(0x600 + node, 0x40) for node in range(1, 7)}
    assert document["source"] == "asked"
    declared: Cell = load_cell(cell)
    for axis, expected in zip(document["axes"], [0.0, 0.0, 90.0, 0.0, 0.0, 0.0], strict=True):
        assert axis["position"] == pytest.approx(expected, abs=1e-2)
        assert (axis["state"], axis["enabled"], axis["silent"]) == ("SWITCH ON DISABLED", False, False)
        assert axis["current_a"] is not None
        assert axis["rate_hz"] > 0
    assert [axis["axis"] for axis in document["axes"]] == list(declared.axis_names)
    assert document["bus_load_percent"] > 0


def test_a_cell_that_is_not_there_is_a_device_fault(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["monitor", str(cell), "--once", "--interval", "0.1"]) == ExitCode.DEVICE_FAULT
    streams = capsys.readouterr()
    assert "(SILENT)" in streams.out
    assert "did not answer" in streams.err


def test_our_own_recorder_is_no_other_master(tmp_path: Path) -> None:
    assert not bus_taken(CELL, tmp_path)
    with bus_lock(CELL, tmp_path):
        assert bus_taken(CELL, tmp_path)
    assert not bus_taken(CELL, tmp_path)
    assert not bus_taken(CELL, tmp_path, tmp_path / "no list of locks")
    axis = AxisReading(0, 1, 0x1208, None, 1.0, 0)
    reading = CellReading(ReadingSource.OVERHEARD, 1.0, (axis,) * 6, 100.0, ((0,) * 9,), ())
    said = []
    for recorder in (False, True):
        out = io.StringIO()
        document = monitor_document(CELL, reading, [None] * 6, [], recorder=recorder)
        Console(file=out, width=200).print(monitor_view(document))
        said.append(out.getvalue())
    assert "another master" in said[0]
    assert "drivegain's recorder" in said[1]
    assert "another master" not in said[1]
    assert "--reset-faults" in said[0]
