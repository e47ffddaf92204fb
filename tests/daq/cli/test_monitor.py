"""`drivegain monitor`: what it shows of a cell, and that it leaves the cell alone."""

from __future__ import annotations

import io
import json
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import cast

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
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
    kept: list[Sample] = [] if samples is None else samples
    return CellMonitor(_link(bus), drive_axes(CELL), kept.append)


def _watch(
    bus: QuietBus,
    cell_file: Path,
    calibration: Calibration | None = None,
    feed: Feed | None = None,
    cell: Cell = CELL,
) -> CellWatch:
    network = cast(CanopenNetwork, Network(_link(bus), drive_axes(CELL)))
    return CellWatch(
        cell_file, cell, network, feed or Feed(cell_file, stop=None), calibration, None
    )


def test_nothing_is_sent_while_another_master_leads_and_its_losses_are_counted(
    bus: QuietBus,
) -> None:
    monitor = _monitor(bus)
    start = bus.clock.now_ns
    for cycle in range(500):
        silent = 3 if cycle in (200, 201) else None
        at_ns = start + (cycle + 1) * 10_000_000
        bus.coming += overheard_cycle(at_ns, cycle, silent=silent)
    reading = monitor.watch(5.005)
    assert bus.sent == []
    assert reading.source is ReadingSource.OVERHEARD
    expected = [1000 * node + 499 for node in range(1, 7)]
    assert [axis.position_counts for axis in reading.axes] == expected
    current_raw = [axis.current_raw for axis in reading.axes]
    assert current_raw == [-1, -2, -3, -4, -5, -6]
    assert [axis.lost for axis in reading.axes] == [0, 0, 2, 0, 0, 0]
    assert reading.sync_hz == pytest.approx(100, rel=0.01)
    rate_hz = reading.axes[0].rate_hz
    assert rate_hz == pytest.approx(100, rel=0.01)
    assert reading.axes[2].rate_hz == pytest.approx(498 / 5.005, rel=1e-6)
    # SYNC and six answers in 10 ms, by the count that a recording is refused with.
    profiles = [axis.profile for axis in CELL.axes if axis.profile is not None]
    assert bus_loads_percent(CELL, reading)[0] == pytest.approx(
        answer_us(profiles, 1_000_000) / 100.0, rel=0.01
    )


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
        reply = bytes((0x43, *msg.data[1:4])) + bytes(4)
        bus.coming.append((bus.clock.now_ns, frame(msg.arbitration_id - 0x80, reply)))

    monkeypatch.setattr(bus, "send", answer)
    reading = monitor.watch(5.0)
    for axis in reading.axes:
        assert axis.rate_hz == pytest.approx(1 / READING_S, rel=0.15)
    expected = 6 * 3 * 5.0 / READING_S
    assert answered == pytest.approx(expected, rel=0.15)
    assert bus_loads_percent(CELL, reading)[0] < 6.0
    assert len(samples) == pytest.approx(5.0 / READING_S, rel=0.15)
    assert {sample.missing for sample in samples[5:]} == {0}


@settings(deadline=None)
@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6), st.integers(0, 5))
def test_positions_are_those_of_the_joints_and_unknown_where_a_motor_is(
    joints: list[float], unknown: int
) -> None:
    motor = CELL.ratio @ (np.array(joints) - [axis.zero_offset_rad for axis in CELL.axes])
    counts: list[int | None] = [round(turn * 65536 / (2 * np.pi)) for turn in motor]
    reading = _reading(counts)
    assert joint_positions(CELL, reading) == pytest.approx(joints, abs=1e-5)
    counts[unknown] = None
    shown = joint_positions(CELL, _reading(counts))
    # Motor 6 turns with joints 5 and 6: without motor 5 neither of the two is known (paper eq. 24).
    expected = {4, 5} if unknown == 4 else {unknown}
    assert {number for number, value in enumerate(shown) if value is None} == expected


def _reading(counts: list[int | None]) -> CellReading:
    axes = tuple(AxisReading(count, 5, 0x237, 5, 10.0, 0) for count in counts)
    return CellReading(ReadingSource.ASKED, 0.5, axes, 0.0, ((0,) * 9,), ())


def test_what_is_not_known_is_shown_as_that() -> None:
    out = io.StringIO()
    dead = AxisReading(None, None, None, None, 0.0, 3, heard=False)
    reading = _reading([0] * 6)
    axes = (*reading.axes[:5], dead)
    reading = CellReading(reading.source, 0.5, axes, 0.0, ((0,) * 9,), ())
    event = CellEvent(0, None, EventKind.CONTROLLER, 0, "a\x1b[2Jb")
    ampere = (0.002, None, None, None, None, None)
    watched = WatchedCell(reading, joint_positions(CELL, reading), ampere, (event,))
    report = monitor_report(CELL, watched)
    Console(file=out, width=100).print(monitor_view(report))
    text = out.getvalue()
    assert "+0.010 A" in text
    assert "+5 raw" in text
    assert "(SILENT)" in text
    assert "operation enabled (ENABLED)" in text
    assert "no power" not in text
    off = tuple(replace(axis, statusword=0x250) for axis in reading.axes[:5])
    without = replace(reading, axes=(*off, dead))
    report = monitor_report(CELL, WatchedCell(without, joint_positions(CELL, without), ampere, ()))
    current_a = report.axes[0].current_a
    assert current_a == pytest.approx(0.01)  # the document has what the drive says
    out = io.StringIO()
    Console(file=out, width=100).print(monitor_view(report))
    assert out.getvalue().count("no power") == 5
    assert " A " not in out.getvalue()
    assert "\x1b[2J" not in text


@pytest.fixture
def quiet_cell_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The demo cell on a bus of this test, without other traffic: a short silence will do."""
    monkeypatch.setattr("drivers.stream.monitor.QUIET_S", 0.1)
    text = (
        (CHECKOUT / "configs/cells/demo.yaml")
        .read_text()
        .replace("../robots", str(CHECKOUT / "configs/robots"))
    )
    path = tmp_path / "cell.yaml"
    path.write_text(text.replace("channel: demo", "channel: monitored"))
    return path


def test_a_simulated_cell_is_shown_and_left_as_it_was(
    quiet_cell_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bus = open_bus(ADDRESS)
    witness = open_bus(ADDRESS)
    try:
        simulated = SimulatedCell(load_simulation(shipped_simulation("clean")), bus)
        with simulated:
            assert (
                run_verb("monitor", quiet_cell_file, "--json", "--interval", "0.5") == ExitCode.OK
            )
        document = json.loads(capsys.readouterr().out)
        asked = []
        while (message := witness.recv(0.0)) is not None:
            if not message.arbitration_id & 0x80 or message.arbitration_id == 0x80:
                asked.append((message.arbitration_id, message.data[0] if message.data else None))
    finally:
        bus.shutdown()
        witness.shutdown()
    assert simulated.cycles == 0
    # Where an answer comes too late on a loaded machine, the client ends the transfer, and nothing
    # else
    aborted = 0x80
    masters = {one for one in asked if one[0] < 0x700 and one[1] != aborted}
    assert masters == {(0x600 + node, 0x40) for node in range(1, 7)}
    assert document["source"] == "asked"
    declared: Cell = load_cell(quiet_cell_file)
    for axis, expected in zip(document["axes"], [0.0, 0.0, 90.0, 0.0, 0.0, 0.0], strict=True):
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
    assert (
        run_verb("monitor", quiet_cell_file, "--once", "--interval", "0.1") == ExitCode.DEVICE_FAULT
    )
    streams = capsys.readouterr()
    assert "(SILENT)" in streams.out
    assert "start `drivegain simulate demo`" in streams.err


def test_a_node_that_aborts_is_not_called_silent(
    quiet_cell_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither its position nor its answers are lost, and the reason is shown."""
    with (
        open_bus(ADDRESS) as bus,
        SimulatedCell(load_simulation(shipped_simulation("clean")), bus) as simulated,
    ):
        node = simulated.nodes[2]
        sound = node.read

        def read(index: int, subindex: int) -> bytes:
            if index == 0x6041:
                raise SdoAbort(0x06020000)
            return sound(index, subindex)

        monkeypatch.setattr(node._sdo, "_read", read)
        assert run_verb("monitor", quiet_cell_file, "--json", "--interval", "0.5") == ExitCode.OK
    document = json.loads(capsys.readouterr().out)
    refusing = document["axes"][2]
    assert refusing["silent"] is False
    assert refusing["rate_hz"] == 0.0
    assert refusing["state"] is None
    assert refusing["position"] == pytest.approx(90.0, abs=1e-2)
    assert refusing["current_a"] is not None
    assert refusing["refused"] == [{"object": "6041h:00", "abort_code": 0x06020000}]
    assert refusing["remark"].startswith("answers with abort 0x06020000 for 6041h:00")
    assert ("J3 answers with abort 0x06020000 for 6041h:00") in _view(
        MonitorReport.model_validate(document)
    )
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
    _answering(bus, monkeypatch, lambda data: answers[0] if data[1:3] == b"\x41\x60" else None)
    watch = _watch(bus, tmp_path / "cell.yaml")
    watch.listen(QUIET_S)
    report = monitor_report(CELL, watch.read(0.5))
    remarks = [axis.remark for axis in report.axes]
    assert remarks == [remark] * 6
    assert {(axis.statusword, axis.rate_hz, axis.lost) for axis in report.axes} == {(None, 0.0, 0)}
    answers[0] = bytes.fromhex("4b41600050020000")
    report = monitor_report(CELL, watch.read(0.5))
    assert {(axis.remark, axis.statusword) for axis in report.axes} == {("", 0x250)}
    assert report.axes[0].rate_hz > 5.0


def test_a_node_that_answers_after_400_ms_is_called_slow(
    bus: QuietBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _answering(bus, monkeypatch, lambda _: None, slow={1: 400_000_000})
    watch = _watch(bus, tmp_path / "cell.yaml")
    watch.listen(QUIET_S)
    reports = [monitor_report(CELL, watch.read(0.5)) for _ in range(10)]
    slow = [report.axes[0] for report in reports]
    assert {axis.remark for axis in slow} == {"answers after 400 ms"}
    assert 0.5 * sum(axis.rate_hz for axis in slow) >= 3  # in 5 s; a reading has three objects
    assert {(axis.silent, axis.lost) for axis in slow} == {(False, 0)}
    assert slow[-1].position_counts == 0
    remarks = {report.axes[1].remark for report in reports}
    assert remarks == {""}
    assert "J1 answers after 400 ms" in _view(reports[-1])


def test_a_cell_that_is_slower_than_one_reading_gets_more_time(
    quiet_cell_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        open_bus(ADDRESS) as bus,
        SimulatedCell(load_simulation(shipped_simulation("clean")), bus) as simulated,
    ):
        prompt = simulated.nodes[0].request

        def late(data: bytes) -> None:
            time.sleep(0.3)
            prompt(data)

        monkeypatch.setattr(simulated.nodes[0], "request", late)
        for node in simulated.nodes:
            node.write(0x1017, 0, bytes(2))  # no heartbeat
        assert run_verb("monitor", quiet_cell_file, "--json", "--interval", "0.1") == ExitCode.OK
    assert json.loads(capsys.readouterr().out)["axes"][0]["remark"].startswith("answers after ")


def _answering(
    bus: QuietBus,
    monkeypatch: pytest.MonkeyPatch,
    own: Callable[[bytes], bytes | None],
    slow: dict[int, int] | None = None,
) -> None:
    """Let all nodes answer with 0 or with an answer of their own,
    one of them later by so many nanoseconds.
    """

    def answer(msg: can.Message, timeout: float | None = None) -> None:
        data = bytes(msg.data)
        reply = own(data) or bytes((0x43, *data[1:4])) + bytes(4)
        at_ns = bus.clock.now_ns + (slow or {}).get(msg.arbitration_id & 0x7F, 0)
        bus.coming.append((at_ns, frame(msg.arbitration_id - 0x80, reply)))
        bus.coming.sort(key=lambda one: one[0])

    monkeypatch.setattr(bus, "send", answer)


def _view(report: MonitorReport) -> str:
    out = io.StringIO()
    Console(file=out, width=200).print(monitor_view(report))
    return out.getvalue()


def test_our_own_recorder_is_no_other_master(tmp_path: Path) -> None:
    assert not bus_taken(CELL, tmp_path)
    with bus_lock(CELL, tmp_path):
        assert bus_taken(CELL, tmp_path)
    assert not bus_taken(CELL, tmp_path)
    assert not bus_taken(CELL, tmp_path, tmp_path / "no list of locks")
    axis = AxisReading(0, 1, 0x1208, None, 1.0, 0)
    axes = (axis,) * 6
    reading = CellReading(ReadingSource.OVERHEARD, 1.0, axes, 100.0, ((0,) * 9,), ())
    said = []
    for recorder in (False, True):
        out = io.StringIO()
        watched = WatchedCell(reading, (None,) * 6, (None,) * 6, (), recorder=recorder)
        report = monitor_report(CELL, watched)
        Console(file=out, width=200).print(monitor_view(report))
        said.append(out.getvalue())
    assert "another master" in said[0]
    assert "drivegain's recorder" in said[1]
    assert "another master" not in said[1]
    assert "--reset-faults" in said[0]


RATED_CURRENT = bytes((0x75, 0x60))  #: Index of 6075h, as a request has it


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


def _moving(bus: QuietBus, seconds: float, factor: float) -> RunFacts:
    """Let all motors move under SYNC with the currents of a known calibration,
    the fourth times a factor.
    """
    calibration = predicting_calibration()
    model = model_of(CELL)
    time_s = np.arange(round(seconds * PREDICTED_HZ)) / PREDICTED_HZ
    omega: FloatArray = 2.0 * np.pi * np.linspace(0.5, 1.0, 6)
    phase = omega * time_s[:, None]
    acceleration_rad_s2 = -0.5 * omega**2 * np.sin(phase)
    velocity_rad_s = 0.5 * omega * np.cos(phase)
    position_rad = 0.5 * np.sin(phase)
    motion = Motion(position_rad, velocity_rad_s, acceleration_rad_s2)
    current = predict_current(calibration, model, planned(motion, PREDICTED_HZ, None))
    current[:, 3] *= factor
    run = replace(facts(CELL, Path("run.mcap")), rate_hz=PREDICTED_HZ)
    # Fine enough that an acceleration shows no count; 16 bits hold the currents.
    current_per_unit = (np.abs(current).max(axis=0) / 3e4).tolist()
    run = replace(run, rad_per_count=[1e-7] * 6, current_per_unit=current_per_unit)
    counts = np.rint(motion.position_rad / 1e-7).astype(int)
    raw = np.rint(current / run.current_per_unit).astype(int)
    start = bus.clock.now_ns
    for cycle in range(len(time_s)):
        at_ns = start + round((cycle + 1) * 1e9 / PREDICTED_HZ)
        bus.coming.append((at_ns, frame(0x80)))
        for node in range(1, 7):
            data = struct.pack("<ihH", counts[cycle, node - 1], raw[cycle, node - 1], 0x1237)
            bus.coming.append((at_ns + 1000 * node, frame(0x180 + node, data)))
    return run


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
    report = [monitor_report(CELL, watch.read(0.5)) for _ in range(7)][-1]
    assert report.recorder
    assert report.prediction == PredictionState(payload=None, remark="")
    predictions = [axis.prediction for axis in report.axes if axis.prediction is not None]
    assert [found.conspicuous for found in predictions] == [
        False,
        False,
        False,
        factor > 1.0,
        False,
        False,
    ]
    for number, found in enumerate(predictions):
        wrong = factor > 1.0 and number == 3
        assert found.residual_rms is not None and found.band is not None
        assert found.outside_share > 0.8 if wrong else found.residual_rms < 0.1 * found.band
        if found.predicted is not None:
            assert found.measured == pytest.approx(
                found.predicted * (factor if wrong else 1.0), abs=0.01
            )
    out = io.StringIO()
    Console(file=out, width=80, force_terminal=True, color_system="standard").print(
        monitor_view(report)
    )
    coloured = [line for line in out.getvalue().splitlines() if "33m" in line]
    assert [line.split("J")[1][0] for line in coloured] == (["4"] if factor > 1.0 else [])
    off = report.axes[0].model_copy(update={"enabled": False})
    _, without = prediction_view(report.model_copy(update={"axes": [off, *report.axes[1:]]}))
    assert isinstance(without, Table)
    assert next(str(cell) for cell in without.columns[1].cells) == "no power"
    bus.coming.clear()
    report = monitor_report(CELL, watch.read(0.5))
    assert report.prediction is not None
    assert report.prediction.remark == "no prediction: there is no SYNC"
    assert not any(axis.silent for axis in report.axes)  # they were not asked


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
    reports = [monitor_report(CELL, watch.read(0.5)) for _ in range(6)]
    assert watch._facts is not None
    assert watch._facts.rate_hz == pytest.approx(PREDICTED_HZ, rel=0.01)
    axes = reports[-1].axes
    predictions = [axis.prediction for axis in axes if axis.prediction is not None]
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
        if msg.arbitration_id == 0x603:
            value = values.get(index, 0)
        else:
            value = 0
        reply = bytes((0x43, *msg.data[1:4])) + value.to_bytes(4, "little")
        bus.coming.append((bus.clock.now_ns, frame(msg.arbitration_id - 0x80, reply)))

    monkeypatch.setattr(bus, "send", answer)
    feed = Feed(tmp_path / "cell.yaml", stop=None)
    watch = _watch(bus, tmp_path / "cell.yaml", predicting_calibration(), feed)
    watch.listen(QUIET_S)
    report = monitor_report(CELL, watch.read(0.5))
    assert report.source == "asked"
    assert report.prediction is not None
    assert "10 positions a second are too few" in report.prediction.remark
    predictions = [axis.prediction for axis in report.axes]
    assert predictions == [None] * 6
    assert [axis.fault is not None for axis in report.axes] == [
        False,
        False,
        True,
        False,
        False,
        False,
    ]
    fault = report.axes[2].fault
    assert fault is not None
    assert fault.model_dump() == asdict(explain_error_code(0x7305))
    out = io.StringIO()
    Console(file=out, width=200).print(monitor_view(report))
    assert (
        "J3 is in fault: 7305h incremental sensor 1 fault; check the plugs and cables of encoder"
    ) in out.getvalue()
    # A console gets it too, however late it comes.
    assert [(event["axis"], event["code"]) for event in feed._events] == [(2, 0x7305)]
    bus.coming.append((bus.clock.now_ns, frame(0x82, struct.pack("<HB5x", 0x3210, 1))))
    for node in range(1, 7):  # other events do not displace it
        bus.coming.append((bus.clock.now_ns, frame(0x700 + node, b"\x05")))
    notices = monitor_report(CELL, watch.read(0.5)).notices
    (notice,) = (one for one in notices if one.alarm)
    expected = asdict(notice_of(EventKind.EMCY, 0x3210, "J2", notice.text))
    assert notice.model_dump() == expected
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
    expected = [[one.name for one in CELL.buses]] * 2
    assert [list(load) for load in loads] == expected
    for load_of_bus in loads:
        for load in load_of_bus.values():
            assert 0.0 < load < 0.06


def test_a_terminal_shows_one_reading_after_another_until_ctrl_c(
    quiet_cell_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ampere = (0.002,) * 6
    waiting = []
    for current_raw in (500, 1000):
        reading = _reading([0] * 6)
        axes = tuple(replace(axis, current_raw=current_raw) for axis in reading.axes)
        reading = replace(reading, axes=axes)
        waiting.append(WatchedCell(reading, joint_positions(CELL, reading), ampere, ()))

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
