"""`drivegain monitor`: what it shows of a cell, and that it leaves the cell alone."""

from __future__ import annotations

import io
import json
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from daq.advice import for_command_line
from daq.config.cell import Cell, PacingMode, model_of
from daq.config.cell_buses import answer_us, bus_loads_percent, drive_axes
from daq.config.cell_file import load_cell
from daq.errors import ExitCode
from daq.log.feed import Feed, RunFacts
from daq.report.bus_views import (
    MonitorReport,
    PredictionState,
    monitor_report,
    monitor_view,
    prediction_view,
)
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from daq.workflow.bus_lock import bus_lock, bus_taken
from daq.workflow.events import explain_error_code, notice_of
from daq.workflow.monitor import CellWatch, WatchedCell, joint_positions
from drivers.canopen.bus import BusAddress, open_bus
from drivers.canopen.emcy import remedy_of
from drivers.canopen.link import Link
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.sdo import SdoPolicy
from drivers.messages import CellEvent, EventKind, Sample
from drivers.profiles.profile import Axis
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.spec import SdoAbort
from drivers.stream.monitor import (
    QUIET_S,
    READING_S,
    AxisReading,
    CellMonitor,
    CellReading,
    ReadingSource,
)
from ident.arrays import FloatArray
from ident.calibration import Calibration
from ident.data.dataset import planned
from ident.model.robot import Motion
from ident.prediction import predict_current
from tests.daq.command_line import run_verb
from tests.daq.console.feeds import facts, predicting_calibration
from tests.drivers.quiet_bus import QuietBus, frame, overheard_cycle
from tests.drivers.scripted import FakeClock

CHECKOUT = Path(__file__).parents[3]
CELL = load_cell(CHECKOUT / "configs/cells/demo.yaml")
ADDRESS = BusAddress("virtual", "monitored")
ABORT = 0x80  #: Command byte that ends an SDO transfer


@dataclass(frozen=True)
class Network:
    """The part of a network that a monitor needs."""

    link: Link
    axes: tuple[Axis, ...]


@pytest.fixture
def bus() -> Iterator[QuietBus]:
    """Closed at the end."""
    made = QuietBus(FakeClock())
    yield made
    made.shutdown()


def _link(bus: QuietBus) -> Link:
    link = Link(ADDRESS, SdoPolicy(), bus.clock, lambda _address: bus)
    link.names = {axis.node_id: axis.name for axis in drive_axes(CELL)}
    link.open()
    return link


def _monitor(bus: QuietBus, samples: list[Sample] | None = None) -> CellMonitor:
    link = _link(bus)
    axes = drive_axes(CELL)
    if samples is None:
        samples = []
    return CellMonitor(link, axes, samples.append)


def _watch(
    bus: QuietBus,
    cell_file: Path,
    calibration: Calibration | None = None,
    feed: Feed | None = None,
    cell: Cell = CELL,
) -> CellWatch:
    link = _link(bus)
    network = cast(CanopenNetwork, Network(link, drive_axes(CELL)))
    if feed is None:
        feed = Feed(cell_file, stop=None)
    return CellWatch(cell_file, cell, network, feed, calibration, None)


def _next_report(watch: CellWatch) -> MonitorReport:
    """Report of what is read in the next half second."""
    watched = watch.read(0.5)
    return monitor_report(CELL, watched)


def _watched(
    reading: CellReading, amperes: tuple[float | None, ...], *events: CellEvent
) -> WatchedCell:
    """A reading with the positions of its joints, and what the current's units are in A."""
    positions = joint_positions(CELL, reading)
    return WatchedCell(reading, positions, amperes, events)


def _view(report: MonitorReport, width: int = 200) -> str:
    """What a terminal without colours shows of a report."""
    out = io.StringIO()
    console = Console(file=out, width=width)
    console.print(monitor_view(report))
    return out.getvalue()


def _coloured_view(report: MonitorReport) -> str:
    """What a terminal with colours shows of a report."""
    out = io.StringIO()
    console = Console(file=out, width=80, force_terminal=True, color_system="standard")
    console.print(monitor_view(report))
    return out.getvalue()


def _reply(bus: QuietBus, request: can.Message, data: bytes, after_ns: int = 0) -> None:
    """Let a node answer an SDO request, now or after a while."""
    at_ns = bus.clock.now_ns + after_ns
    answer = frame(request.arbitration_id - 0x80, data)
    bus.coming.append((at_ns, answer))


def _upload(request: bytes, value: int = 0) -> bytes:
    """Data of the answer to an SDO request, with a value of four bytes."""
    index_and_subindex = request[1:4]
    return b"\x43" + index_and_subindex + value.to_bytes(4, "little")


def test_nothing_is_sent_while_another_master_leads_and_its_losses_are_counted(
    bus: QuietBus,
) -> None:
    monitor = _monitor(bus)
    start = bus.clock.now_ns
    for cycle in range(500):
        at_ns = start + (cycle + 1) * 10_000_000
        if cycle in (200, 201):
            bus.coming += overheard_cycle(at_ns, cycle, silent=3)
        else:
            bus.coming += overheard_cycle(at_ns, cycle, silent=None)

    reading = monitor.watch(5.005)

    assert bus.sent == []
    assert reading.source is ReadingSource.OVERHEARD
    position_counts = [axis.position_counts for axis in reading.axes]
    assert position_counts == [1499, 2499, 3499, 4499, 5499, 6499]
    current_raw = [axis.current_raw for axis in reading.axes]
    assert current_raw == [-1, -2, -3, -4, -5, -6]
    lost = [axis.lost for axis in reading.axes]
    assert lost == [0, 0, 2, 0, 0, 0]
    assert reading.sync_hz == pytest.approx(100, rel=0.01)
    rates_hz = [axis.rate_hz for axis in reading.axes]
    assert rates_hz[0] == pytest.approx(100, rel=0.01)
    assert rates_hz[2] == pytest.approx(498 / 5.005, rel=1e-6)
    # SYNC and six answers in 10 ms, by the count that a recording is refused with.
    profiles = [axis.profile for axis in CELL.axes if axis.profile is not None]
    counted_percent = answer_us(profiles, 1_000_000) / 100.0
    load_percent = bus_loads_percent(CELL, reading)[0]
    assert load_percent == pytest.approx(counted_percent, rel=0.01)


def test_asking_leaves_the_bus_to_others(bus: QuietBus, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every request is answered at once;
    still a reading is asked for ten times a second and no more.
    """
    samples: list[Sample] = []
    monitor = _monitor(bus, samples)
    monitor.watch(QUIET_S)
    answered = 0

    def answer(msg: can.Message, timeout: float | None = None) -> None:
        nonlocal answered
        answered += 1
        _reply(bus, msg, _upload(bytes(msg.data)))

    monkeypatch.setattr(bus, "send", answer)
    reading = monitor.watch(5.0)
    for axis in reading.axes:
        assert axis.rate_hz == pytest.approx(1 / READING_S, rel=0.15)
    readings = 5.0 / READING_S
    assert answered == pytest.approx(6 * 3 * readings, rel=0.15)
    load_percent = bus_loads_percent(CELL, reading)[0]
    assert load_percent < 6.0
    assert len(samples) == pytest.approx(readings, rel=0.15)
    missing = {sample.missing for sample in samples[5:]}
    assert missing == {0}


@settings(deadline=None)
@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6), st.integers(0, 5))
def test_positions_are_those_of_the_joints_and_unknown_where_a_motor_is(
    joints: list[float], unknown: int
) -> None:
    zero_offsets = [axis.zero_offset_rad for axis in CELL.axes]
    motor_turns = CELL.ratio @ (np.array(joints) - zero_offsets) / (2 * np.pi)
    counts: list[int | None] = [round(turns * 65536) for turns in motor_turns]
    reading = _reading(counts)
    assert joint_positions(CELL, reading) == pytest.approx(joints, abs=1e-5)

    counts[unknown] = None
    reading = _reading(counts)
    positions = joint_positions(CELL, reading)
    unknown_joints = [joint for joint in range(6) if positions[joint] is None]
    if unknown == 4:
        # Motor 6 turns with joints 5 and 6: without motor 5 neither of the two is known (paper
        # eq. 24).
        assert unknown_joints == [4, 5]
    else:
        assert unknown_joints == [unknown]


def _reading(counts: list[int | None]) -> CellReading:
    axes = [AxisReading(count, 5, 0x237, 5, 10.0, 0) for count in counts]
    return _reading_of(axes)


def _reading_of(axes: Sequence[AxisReading]) -> CellReading:
    """Half a second in which axes were queried."""
    return CellReading(ReadingSource.ASKED, 0.5, tuple(axes), 0.0, ((0,) * 9,), ())


def test_what_is_not_known_is_shown_as_that() -> None:
    dead = AxisReading(None, None, None, None, 0.0, 3, heard=False)
    alive = _reading([0] * 5).axes
    reading = _reading_of([*alive, dead])
    event = CellEvent(0, None, EventKind.CONTROLLER, 0, "a\x1b[2Jb")
    amperes = (0.002, None, None, None, None, None)

    report = monitor_report(CELL, _watched(reading, amperes, event))
    text = _view(report, width=100)

    assert "+0.010 A" in text
    assert "+5 raw" in text
    assert "(SILENT)" in text
    assert "operation enabled (ENABLED)" in text
    assert "no power" not in text
    assert "\x1b[2J" not in text

    off = [replace(axis, statusword=0x250) for axis in alive]
    without_power = _reading_of([*off, dead])
    report = monitor_report(CELL, _watched(without_power, amperes))
    current_a = report.axes[0].current_a
    assert current_a == pytest.approx(0.01)  # the document has what the drive says
    text = _view(report, width=100)
    assert text.count("no power") == 5
    assert " A " not in text


@pytest.fixture
def quiet_cell_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The demo cell on a bus of this test, without other traffic: a short silence will do."""
    monkeypatch.setattr("drivers.stream.monitor.QUIET_S", 0.1)
    shipped = CHECKOUT / "configs/cells/demo.yaml"
    robots = CHECKOUT / "configs/robots"
    text = shipped.read_text()
    text = text.replace("../robots", str(robots))
    text = text.replace("channel: demo", "channel: monitored")
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    return path


def _run_monitor(cell_file: Path, *options: str) -> int:
    """Run the verb; return its status."""
    return run_verb("monitor", cell_file, *options)


def _printed_document(capsys: pytest.CaptureFixture[str]) -> Any:
    """The JSON document that the verb printed."""
    printed = capsys.readouterr().out
    return json.loads(printed)


def _simulated_cell(bus: can.BusABC) -> SimulatedCell:
    """The demo cell without faults."""
    simulation = load_simulation(shipped_simulation("clean"))
    return SimulatedCell(simulation, bus)


def _received(bus: can.BusABC) -> list[can.Message]:
    """The messages that are waiting at a bus."""
    messages = []
    message = bus.recv(0.0)
    while message is not None:
        messages.append(message)
        message = bus.recv(0.0)
    return messages


def _commands_of_masters(messages: list[can.Message]) -> set[tuple[int, int | None]]:
    """Identifiers and first bytes of the messages that no node sends, without aborts.

    Where an answer comes too late on a loaded machine, the client ends the transfer, and nothing
    else.
    """
    commands = set()
    for message in messages:
        number = message.arbitration_id
        is_of_a_node = number != 0x80 and bool(number & 0x80)
        if is_of_a_node or number >= 0x700:
            continue
        command = None
        if message.data:
            command = message.data[0]
        if command != ABORT:
            commands.add((number, command))
    return commands


def test_a_simulated_cell_is_shown_and_left_as_it_was(
    quiet_cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bus = open_bus(ADDRESS)
    witness = open_bus(ADDRESS)
    try:
        simulated = _simulated_cell(bus)
        with simulated:
            status = _run_monitor(quiet_cell_file, "--json", "--interval", "0.5")
        assert status == ExitCode.OK
        document = _printed_document(capsys)
        messages = _received(witness)
    finally:
        bus.shutdown()
        witness.shutdown()
    assert simulated.cycles == 0
    commands = _commands_of_masters(messages)
    uploads = {(0x600 + node, 0x40) for node in range(1, 7)}
    assert commands == uploads
    assert document["source"] == "asked"
    declared: Cell = load_cell(quiet_cell_file)
    expected_deg = [0.0, 0.0, 90.0, 0.0, 0.0, 0.0]
    for axis, expected in zip(document["axes"], expected_deg, strict=True):
        assert axis["position"] == pytest.approx(expected, abs=1e-2)
        assert axis["state"] == "SWITCH ON DISABLED"
        assert axis["enabled"] is False
        assert axis["silent"] is False
        assert axis["current_a"] is not None
        assert axis["rate_hz"] > 0
    axes = [axis["axis"] for axis in document["axes"]]
    assert axes == list(declared.axis_names)
    assert document["bus_load_percent"] > 0


def test_a_cell_that_is_not_there_is_a_device_fault(
    quiet_cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = _run_monitor(quiet_cell_file, "--once", "--interval", "0.1")
    assert status == ExitCode.DEVICE_FAULT
    streams = capsys.readouterr()
    assert "(SILENT)" in streams.out
    assert "start `drivegain simulate demo`" in streams.err


def test_a_node_that_aborts_is_not_called_silent(
    quiet_cell_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither its position nor its answers are lost, and the reason is shown."""
    with open_bus(ADDRESS) as bus, _simulated_cell(bus) as simulated:
        node = simulated.nodes[2]
        sound = node.read

        def read(index: int, subindex: int) -> bytes:
            if index == 0x6041:
                raise SdoAbort(0x06020000)
            return sound(index, subindex)

        monkeypatch.setattr(node._sdo, "_read", read)
        status = _run_monitor(quiet_cell_file, "--json", "--interval", "0.5")
    assert status == ExitCode.OK
    document = _printed_document(capsys)
    refusing = document["axes"][2]
    assert refusing["silent"] is False
    assert refusing["rate_hz"] == 0.0
    assert refusing["state"] is None
    assert refusing["position"] == pytest.approx(90.0, abs=1e-2)
    assert refusing["current_a"] is not None
    assert refusing["refused"] == [{"object": "6041h:00", "abort_code": 0x06020000}]
    remark = "answers with abort 0x06020000 for 6041h:00"
    assert refusing["remark"].startswith(remark)
    report = MonitorReport.model_validate(document)
    assert f"J3 {remark}" in _view(report)
    assert document["axes"][1]["refused"] == []


@pytest.mark.parametrize(
    ("answer", "remark"),
    [
        (bytes.fromhex("4f41600000000000"), "answers without a value of 16 bits for 6041h:00"),
        (bytes.fromhex("8041600000000206"), "answers with abort 0x06020000 for 6041h:00"),
    ],
)
def test_a_refused_object_is_no_value_and_forgotten_when_it_is_given(
    bus: QuietBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: bytes, remark: str
) -> None:
    answers = [answer]

    def own(data: bytes) -> bytes | None:
        if data[1:3] == STATUSWORD:
            return answers[0]
        return None

    _answering(bus, monkeypatch, own)
    watch = _watch(bus, tmp_path / "cell.yaml")
    watch.listen(QUIET_S)
    report = _next_report(watch)
    remarks = [axis.remark for axis in report.axes]
    assert remarks == [remark] * 6
    for axis in report.axes:
        assert axis.statusword is None
        assert axis.rate_hz == 0.0
        assert axis.lost == 0

    answers[0] = bytes.fromhex("4b41600050020000")
    report = _next_report(watch)
    assert len(report.axes) == 6
    for axis in report.axes:
        assert axis.remark == ""
        assert axis.statusword == 0x250
    assert report.axes[0].rate_hz > 5.0


def test_a_node_that_answers_after_400_ms_is_called_slow(
    bus: QuietBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _answering(bus, monkeypatch, lambda _: None, slow={1: 400_000_000})
    watch = _watch(bus, tmp_path / "cell.yaml")
    watch.listen(QUIET_S)
    reports = [_next_report(watch) for _ in range(10)]
    slow = [report.axes[0] for report in reports]
    for axis in slow:
        assert axis.remark == "answers after 400 ms"
        assert not axis.silent
        assert axis.lost == 0
    readings = 0.5 * sum(axis.rate_hz for axis in slow)
    assert readings >= 3  # in 5 s; a reading has three objects
    assert slow[-1].position_counts == 0
    remarks = {report.axes[1].remark for report in reports}
    assert remarks == {""}
    assert "J1 answers after 400 ms" in _view(reports[-1])


def test_a_cell_that_is_slower_than_one_reading_gets_more_time(
    quiet_cell_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_bus(ADDRESS) as bus, _simulated_cell(bus) as simulated:
        prompt = simulated.nodes[0].request

        def late(data: bytes) -> None:
            time.sleep(0.3)
            prompt(data)

        monkeypatch.setattr(simulated.nodes[0], "request", late)
        for node in simulated.nodes:
            node.write(0x1017, 0, bytes(2))  # no heartbeat
        status = _run_monitor(quiet_cell_file, "--json", "--interval", "0.1")
    assert status == ExitCode.OK
    document = _printed_document(capsys)
    remark = document["axes"][0]["remark"]
    assert remark.startswith("answers after ")


def _answering(
    bus: QuietBus,
    monkeypatch: pytest.MonkeyPatch,
    own: Callable[[bytes], bytes | None],
    slow: dict[int, int] | None = None,
) -> None:
    """Let all nodes answer with 0 or with an answer of their own,
    one of them later by so many nanoseconds.
    """

    delays_ns = slow or {}

    def answer(msg: can.Message, timeout: float | None = None) -> None:
        request = bytes(msg.data)
        node = msg.arbitration_id & 0x7F
        data = own(request) or _upload(request)
        _reply(bus, msg, data, after_ns=delays_ns.get(node, 0))
        bus.coming.sort(key=lambda one: one[0])

    monkeypatch.setattr(bus, "send", answer)


def test_our_own_recorder_is_no_other_master(tmp_path: Path) -> None:
    assert not bus_taken(CELL, tmp_path)
    with bus_lock(CELL, tmp_path):
        assert bus_taken(CELL, tmp_path)
    assert not bus_taken(CELL, tmp_path)
    assert not bus_taken(CELL, tmp_path, tmp_path / "no list of locks")
    axis = AxisReading(0, 1, 0x1208, None, 1.0, 0)
    axes = (axis,) * 6
    reading = CellReading(ReadingSource.OVERHEARD, 1.0, axes, 100.0, ((0,) * 9,), ())
    nothing = (None,) * 6
    led = WatchedCell(reading, nothing, nothing, (), recorder=False)
    recorded = WatchedCell(reading, nothing, nothing, (), recorder=True)

    by_another_master = _view(monitor_report(CELL, led))
    by_the_recorder = _view(monitor_report(CELL, recorded))

    assert "another master" in by_another_master
    assert "drivegain's recorder" in by_the_recorder
    assert "another master" not in by_the_recorder
    assert "--reset-faults" in by_another_master


RATED_CURRENT = bytes((0x75, 0x60))  #: Index of 6075h, as a request has it
STATUSWORD = bytes((0x41, 0x60))  #: Index of 6041h, likewise


def test_a_recorder_that_comes_while_the_axes_are_queried_hears_no_further_request(
    bus: QuietBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recorder takes the lock, listens for 0.2 s,
    and refuses a bus on which it hears a request.
    """
    scaled: list[bytes] = []

    def note(data: bytes) -> None:
        if data[1:3] == RATED_CURRENT:
            scaled.append(data)

    _answering(bus, monkeypatch, note)
    monkeypatch.setattr("daq.workflow.monitor.bus_taken", lambda _cell: bool(scaled))
    watch = _watch(bus, tmp_path / "cell.yaml")
    watch.listen(2.0)
    watch.read(0.5)
    assert len(scaled) == 1  # of the first axis; the five others are not asked


PREDICTED_HZ = 250.0
RAD_PER_COUNT = 1e-7  #: fine enough that an acceleration shows no count


def _sine_motion(seconds: float) -> Motion:
    """A sine motion of each joint, with its exact derivatives."""
    time_s = np.arange(round(seconds * PREDICTED_HZ)) / PREDICTED_HZ
    omega: FloatArray = 2.0 * np.pi * np.linspace(0.5, 1.0, 6)
    phase = omega * time_s[:, None]
    acceleration_rad_s2 = -0.5 * omega**2 * np.sin(phase)
    velocity_rad_s = 0.5 * omega * np.cos(phase)
    position_rad = 0.5 * np.sin(phase)
    return Motion(position_rad, velocity_rad_s, acceleration_rad_s2)


def _rounded(values: FloatArray) -> NDArray[np.int64]:
    """Nearest integers."""
    return np.rint(values).astype(np.int64)


def _moving(bus: QuietBus, seconds: float, factor: float) -> RunFacts:
    """Let all motors move under SYNC with the currents of a known calibration,
    the fourth times a factor.
    """
    motion = _sine_motion(seconds)
    data = planned(motion, PREDICTED_HZ, None)
    current = predict_current(predicting_calibration(), model_of(CELL), data)
    current[:, 3] *= factor
    largest_current = np.abs(current).max(axis=0)
    current_per_unit = largest_current / 3e4  # 16 bits hold the currents
    counts = _rounded(motion.position_rad / RAD_PER_COUNT)
    raw = _rounded(current / current_per_unit)

    start = bus.clock.now_ns
    for cycle in range(len(counts)):
        at_ns = start + round((cycle + 1) * 1e9 / PREDICTED_HZ)
        bus.coming.append((at_ns, frame(0x80)))
        for axis in range(6):
            node = axis + 1
            data_of_node = struct.pack("<ihH", counts[cycle, axis], raw[cycle, axis], 0x1237)
            answer = frame(0x180 + node, data_of_node)
            bus.coming.append((at_ns + 1000 * node, answer))

    return replace(
        facts(CELL, Path("run.mcap")),
        rate_hz=PREDICTED_HZ,
        rad_per_count=[RAD_PER_COUNT] * 6,
        current_per_unit=current_per_unit.tolist(),
    )


@pytest.mark.parametrize("factor", [1.0, 1.2])
def test_the_predicted_current_is_shown_beside_the_measured_one_and_only_a_wrong_gain_is_coloured(
    bus: QuietBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factor: float
) -> None:
    calibration = predicting_calibration()
    run = _moving(bus, 6.0, factor)
    monkeypatch.setattr("daq.workflow.monitor.bus_taken", lambda _cell: True)
    monkeypatch.setattr("daq.workflow.monitor.facts_of_recorder", lambda *_: run)
    watch = _watch(bus, tmp_path / "cell.yaml", calibration)
    watch.listen(2.0)
    for _ in range(7):
        report = _next_report(watch)

    assert report.recorder
    assert report.prediction == PredictionState(payload=None, remark="")
    is_wrong = factor > 1.0
    predictions = [axis.prediction for axis in report.axes if axis.prediction is not None]
    conspicuous = [found.conspicuous for found in predictions]
    assert conspicuous == [False, False, False, is_wrong, False, False]
    factors = [1.0, 1.0, 1.0, factor, 1.0, 1.0]
    for found, axis_factor in zip(predictions, factors, strict=True):
        assert found.residual_rms is not None
        assert found.band is not None
        if axis_factor > 1.0:
            assert found.outside_share > 0.8
        else:
            assert found.residual_rms < 0.1 * found.band
        if found.predicted is not None:
            expected = axis_factor * found.predicted
            assert found.measured == pytest.approx(expected, abs=0.01)
    lines = _coloured_view(report).splitlines()
    coloured_axes = [line.split("J")[1][0] for line in lines if "33m" in line]
    if is_wrong:
        assert coloured_axes == ["4"]
    else:
        assert coloured_axes == []

    first, *others = report.axes
    off = first.model_copy(update={"enabled": False})
    with_one_off = report.model_copy(update={"axes": [off, *others]})
    _, table = prediction_view(with_one_off)
    assert isinstance(table, Table)
    first_cell = next(iter(table.columns[1].cells))
    assert str(first_cell) == "no power"

    bus.coming.clear()
    report = _next_report(watch)
    assert report.prediction is not None
    assert report.prediction.remark == "no prediction: there is no SYNC"
    silent = [axis.axis for axis in report.axes if axis.silent]
    assert silent == []  # they were not queried


def test_the_rate_of_another_master_is_measured_once_its_sync_is_steady(
    bus: QuietBus, tmp_path: Path
) -> None:
    """Its drives' current has no known scale:
    what is predicted has no measured current beside it.
    """
    bus.clock.now_ns += 300_000_000
    _moving(bus, 4.0, 1.0)
    bus.clock.now_ns -= 300_000_000  # it begins within the first reading
    assert CELL.sync is not None
    sync = replace(CELL.sync, pacing=PacingMode.TIMED)
    timed = replace(CELL, sync=sync)
    watch = _watch(bus, tmp_path / "cell.yaml", predicting_calibration(), cell=timed)
    watch.listen(0.5)
    assert watch._facts is None
    for _ in range(6):
        report = _next_report(watch)
    assert watch._facts is not None
    assert watch._facts.rate_hz == pytest.approx(PREDICTED_HZ, rel=0.01)
    predictions = [axis.prediction for axis in report.axes if axis.prediction is not None]
    assert len(predictions) == 6
    for found in predictions:
        assert found.measured is None
        assert found.residual_rms is None


def test_queried_axes_are_too_slow_for_a_prediction_and_their_faults_have_a_remedy(
    bus: QuietBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = {0x6041: 0x1208, 0x603F: 0x7305}

    def answer(msg: can.Message, timeout: float | None = None) -> None:
        index = int.from_bytes(msg.data[1:3], "little")
        value = 0
        if msg.arbitration_id == 0x603:
            value = values.get(index, 0)
        _reply(bus, msg, _upload(bytes(msg.data), value))

    monkeypatch.setattr(bus, "send", answer)
    feed = Feed(tmp_path / "cell.yaml", stop=None)
    watch = _watch(bus, tmp_path / "cell.yaml", predicting_calibration(), feed)
    watch.listen(QUIET_S)
    report = _next_report(watch)
    assert report.source == "asked"
    assert report.prediction is not None
    assert "10 positions a second are too few" in report.prediction.remark
    predictions = [axis.prediction for axis in report.axes]
    assert predictions == [None] * 6
    has_fault = [axis.fault is not None for axis in report.axes]
    assert has_fault == [False, False, True, False, False, False]
    fault = report.axes[2].fault
    assert fault is not None
    explained = explain_error_code(0x7305)
    assert fault.model_dump() == asdict(explained)
    assert (
        "J3 is in fault: 7305h incremental sensor 1 fault; check the plugs and cables of encoder"
    ) in _view(report)
    # A console gets it too, however late it comes.
    (event,) = feed._events
    assert event["axis"] == 2
    assert event["code"] == 0x7305

    emcy = struct.pack("<HB5x", 0x3210, 1)
    bus.coming.append((bus.clock.now_ns, frame(0x82, emcy)))
    for node in range(1, 7):  # other events do not displace it
        heartbeat = frame(0x700 + node, b"\x05")
        bus.coming.append((bus.clock.now_ns, heartbeat))
    notices = _next_report(watch).notices
    (notice,) = (one for one in notices if one.alarm)
    expected = notice_of(EventKind.EMCY, 0x3210, "J2", notice.text)
    assert notice.model_dump() == asdict(expected)
    assert notice.text.startswith("EMCY 3210h")
    assert notice.remedy == for_command_line(remedy_of(0x3210))


def test_each_reading_publishes_the_load_of_the_buses(
    bus: QuietBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    feed = Feed(tmp_path / "cell.yaml", stop=None)
    loads = list[dict[str, float]]()
    monkeypatch.setattr(feed, "measured", loads.append)
    watch = _watch(bus, tmp_path / "cell.yaml", predicting_calibration(), feed)
    watch.listen(QUIET_S)
    for _ in range(2):
        watch.read(1.1)
    names = [one.name for one in CELL.buses]
    names_of_loads = [list(load) for load in loads]
    assert names_of_loads == [names, names]
    for load_of_bus in loads:
        for load in load_of_bus.values():
            assert 0.0 < load < 0.06


def test_a_terminal_shows_one_reading_after_another_until_ctrl_c(
    quiet_cell_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    amperes = (0.002,) * 6
    waiting = []
    for current_raw in (500, 1000):
        axes = [replace(axis, current_raw=current_raw) for axis in _reading([0] * 6).axes]
        reading = _reading_of(axes)
        waiting.append(_watched(reading, amperes))

    def read(*_: object) -> WatchedCell:
        if not waiting:
            raise KeyboardInterrupt
        return waiting.pop(0)

    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr(CellWatch, "listen", lambda *_: None)
    monkeypatch.setattr(CellWatch, "read", read)
    assert run_verb("monitor", quiet_cell_file) == ExitCode.OK
    shown = capsys.readouterr().out
    assert shown.count("+1.000 A") == 6
    # The last reading is drawn once more when the display ends.
    assert shown.count("+2.000 A") >= 6
    assert shown.index("+1.000 A") < shown.index("+2.000 A")
