"""Watching a bus without changing it: readings, samples and silence, with or without a master."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator

import can
import pytest

from drivers.canopen.bus import BusAddress
from drivers.canopen.link import Link
from drivers.canopen.sdo import SdoPolicy
from drivers.messages import EventKind, Sample
from drivers.profiles.profile import Axis, ObjectEntry
from drivers.stream.monitor import (
    ABANDONED_S,
    ANSWER_S,
    QUIET_S,
    READING_S,
    AxisReading,
    CellMonitor,
    ObjectRefusal,
    ReadingSource,
)
from tests.drivers.quiet_bus import QuietBus, frame, overheard_cycle
from tests.drivers.scripted import FakeClock

AXES = tuple(Axis(f"J{number}", number) for number in range(1, 7))
STATUSWORD = ObjectEntry(0x6041, 0, 16)
OFFSET_NS = 1_700_000_000_000_000_000


@pytest.fixture
def bus() -> Iterator[QuietBus]:
    """Closed at the end."""
    made = QuietBus(FakeClock())
    yield made
    made.shutdown()


def link(bus: QuietBus) -> Link:
    """Open the bus."""
    made = Link(BusAddress("virtual", "monitored"), SdoPolicy(), bus.clock, lambda _address: bus)
    made.names = {axis.node_id: axis.name for axis in AXES}
    made.open()
    return made


def monitor_of(bus: QuietBus, samples: list[Sample] | None = None) -> CellMonitor:
    """Monitor of six axes."""
    kept: list[Sample] = [] if samples is None else samples
    return CellMonitor(link(bus), AXES, kept.append, OFFSET_NS)


def answer_all(
    bus: QuietBus, monkeypatch: pytest.MonkeyPatch, reply_to: Callable[[int, bytes], bytes | None]
) -> None:
    """Let nodes answer each request 2 ms later."""

    def answer(msg: can.Message, timeout: float | None = None) -> None:
        bus.sent.append(msg)
        reply = reply_to(msg.arbitration_id & 0x7F, bytes(msg.data))
        if reply is not None:
            at_ns = bus.clock.now_ns + 2_000_000
            bus.coming.append((at_ns, frame(msg.arbitration_id - 0x80, reply)))

    monkeypatch.setattr(bus, "send", answer)


def value_reply(data: bytes, value: int) -> bytes:
    """Answer of an expedited upload of four bytes."""
    return bytes((0x43, *data[1:4])) + value.to_bytes(4, "little")


def test_each_overheard_cycle_is_a_sample_and_a_gap_is_counted(bus: QuietBus) -> None:
    samples: list[Sample] = []
    monitor = monitor_of(bus, samples)
    monitor.period_ns = 10_000_000
    start = bus.clock.now_ns
    for cycle in (*range(20), *range(25, 40)):  # five SYNCs that this program missed
        silent = 3 if cycle == 30 else None
        at_ns = start + (cycle + 1) * 10_000_000
        frames = overheard_cycle(at_ns, cycle, silent=silent)
        frames[0][1].timestamp = 1.7e9 + 0.01 * cycle
        bus.coming += frames
    monitor.watch(0.5)
    # The last may still be answered
    cycles = [sample.cycle for sample in samples]
    assert cycles == [*range(20), *range(25, 39)]
    assert [sample.cycle for sample in samples if sample.missing] == [30]
    assert samples[25].missing == 0b100
    for sample in samples:
        position = [1000 * node + sample.cycle for node in range(1, 7)]
        assert sample.missing or list(sample.position_counts) == position
        expected = (-1, -2, -3, -4, -5, -6)
        assert sample.current_raw == expected
        assert sample.statusword == (0x1237,) * 6


def test_a_quiet_bus_is_asked_by_uploads_alone_and_silence_is_counted(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    monitor.watch(QUIET_S - 0.01)
    assert bus.sent == []
    reading = monitor.watch(9.5 * ABANDONED_S)
    arbitration_ids = {message.arbitration_id for message in bus.sent}
    expected = {0x600 + node for node in range(1, 7)}
    assert arbitration_ids == expected
    assert {message.data[0] for message in bus.sent} == {0x40}
    assert reading.source is ReadingSource.ASKED
    for axis in reading.axes:
        assert 8 <= axis.lost <= 10
        assert axis.position_counts is None
        assert axis.rate_hz == 0
    assert not any(axis.heard for axis in reading.axes)


@pytest.mark.parametrize("identifier", [0x000, 0x080, 0x601])
def test_asking_ends_when_another_master_speaks(bus: QuietBus, identifier: int) -> None:
    monitor = monitor_of(bus)
    monitor.watch(QUIET_S + 0.1)
    asked = len(bus.sent)
    bus.coming.append((bus.clock.now_ns, frame(identifier, bytes(8))))
    source = monitor.watch(QUIET_S - 0.01).source
    assert source is ReadingSource.OVERHEARD
    assert len(bus.sent) <= asked + 6  # those that left before it spoke
    asked = len(bus.sent)
    monitor.watch(0.1)
    assert len(bus.sent) == asked + 6


def test_nothing_is_sent_once_a_recorder_has_the_bus(bus: QuietBus) -> None:
    """It listens before its first frame, and would refuse to begin."""
    held: list[bool] = []
    monitor = CellMonitor(link(bus), AXES, taken=lambda: bool(held))
    monitor.watch(QUIET_S + 0.5)
    asked = len(bus.sent)
    assert asked > 0
    held.append(True)
    assert monitor.watch(1.0).source is ReadingSource.OVERHEARD
    assert len(bus.sent) == asked


def test_a_late_answer_to_another_client_is_no_reading(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    monitor.watch(QUIET_S + 0.01)
    other = bytes((0x43, 0x75, 0x60, 0)) + struct.pack("<I", 2000)
    bus.coming.append((bus.clock.now_ns, frame(0x581, other)))
    axes = monitor.watch(0.05).axes
    assert axes[0].position_counts is None
    mine = bytes((0x43, 0x64, 0x60, 0)) + struct.pack("<i", -7)
    bus.coming.append((bus.clock.now_ns, frame(0x581, mine)))
    position_counts = monitor.watch(0.05).axes[0].position_counts
    assert position_counts == -7


@pytest.mark.parametrize("identifier", [0x081, 0x181, 0x701])
def test_a_node_that_only_sends_by_itself_is_not_silent(bus: QuietBus, identifier: int) -> None:
    monitor = monitor_of(bus)
    monitor.watch(QUIET_S)
    bus.coming.append((bus.clock.now_ns + 200_000_000, frame(identifier, b"\x05")))
    axes = monitor.watch(1.5).axes
    heards = [axis.heard for axis in axes]
    expected = [True, *[False] * 5]
    assert heards == expected
    for axis in monitor.watch(0.5).axes:
        assert not axis.heard  # longer ago than ABANDONED_S


def test_overheard_readings_are_those_of_our_mapping_with_rates_and_frames(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    start = bus.clock.now_ns
    for cycle in range(100):
        silent = 3 if cycle in (50, 51) else None
        at_ns = start + (cycle + 1) * 10_000_000
        bus.coming += overheard_cycle(at_ns, cycle, silent)
    reading = monitor.watch(1.0)
    assert bus.sent == []
    assert reading.source is ReadingSource.OVERHEARD
    assert reading.seconds == pytest.approx(1.0)
    # The hundredth SYNC comes with the end of the second; its answers come behind it.
    assert reading.sync_hz == pytest.approx(100.0)
    expected = [1000 * node + 98 for node in range(1, 7)]
    assert [axis.position_counts for axis in reading.axes] == expected
    current_raw = [axis.current_raw for axis in reading.axes]
    assert current_raw == [-1, -2, -3, -4, -5, -6]
    rate_hz = [axis.rate_hz for axis in reading.axes]
    assert rate_hz == pytest.approx([99, 99, 97, 99, 99, 99])
    assert [axis.lost for axis in reading.axes] == [0, 0, 2, 0, 0, 0]
    assert reading.frames == ((100, 0, 0, 0, 0, 0, 0, 0, 6 * 99 - 2),)


def test_each_reading_counts_its_own_time_alone(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    start = bus.clock.now_ns
    for cycle in range(30):
        at_ns = start + (cycle + 1) * 10_000_000
        bus.coming += overheard_cycle(at_ns, cycle)
    monitor.watch(0.205)
    reading = monitor.watch(0.205)
    assert reading.seconds == pytest.approx(0.205)
    assert reading.sync_hz == pytest.approx(10 / 0.205)
    rate_hz = reading.axes[0].rate_hz
    assert rate_hz == pytest.approx(10 / 0.205)
    assert reading.frames[0][8] == 60


def test_a_frame_of_another_mapping_is_no_value(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    bus.coming.append((bus.clock.now_ns + 1000, frame(0x181, bytes(6))))
    axis = monitor.watch(0.01).axes[0]
    assert axis.position_counts is None
    assert axis.current_raw is None
    assert axis.statusword is None
    assert axis.rate_hz == 0.0


def test_queried_values_are_samples_with_wall_time_ten_times_a_second(
    bus: QuietBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples: list[Sample] = []
    monitor = monitor_of(bus, samples)
    values = {0x6064: 70_000, 0x6074: 0xFFF6, 0x6041: 0x237}

    def reply(node: int, data: bytes) -> bytes:
        index = int.from_bytes(data[1:3], "little")
        if index == 0x6064:
            return value_reply(data, values[index] + node)
        return bytes((0x4B, *data[1:4])) + values[index].to_bytes(2, "little") + bytes(2)

    monitor.watch(QUIET_S)
    answer_all(bus, monkeypatch, reply)
    reading = monitor.watch(1.0)
    assert reading.source is ReadingSource.ASKED
    expected = [70_000 + node for node in range(1, 7)]
    assert [axis.position_counts for axis in reading.axes] == expected
    current_raw = {axis.current_raw for axis in reading.axes}
    assert current_raw == {-10}
    statuswords = {axis.statusword for axis in reading.axes}
    assert statuswords == {0x237}
    assert {axis.lost for axis in reading.axes} == {0}
    rate_hz = reading.axes[0].rate_hz
    assert rate_hz == pytest.approx(10.0, abs=1.0)
    delay_s = reading.axes[0].delay_s
    assert delay_s == pytest.approx(0.002, abs=0.002)
    assert len(samples) == pytest.approx(10, abs=1)
    last = samples[-1]
    assert last.missing == 0
    assert last.position_counts == tuple(70_000 + node for node in range(1, 7))
    assert last.cycle == len(samples) - 1
    assert 0 <= OFFSET_NS + bus.clock.now_ns - last.time_ns <= 1.5e9 * READING_S
    # Requests and answers, each of eight bytes.
    assert reading.frames[0][8] == pytest.approx(2 * 6 * 3 * 10, rel=0.15)


def test_a_queried_axis_that_stops_to_answer_is_missing_from_then_on(
    bus: QuietBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples: list[Sample] = []
    monitor = monitor_of(bus, samples)
    dead: list[int] = []

    def reply(node: int, data: bytes) -> bytes | None:
        return None if node in dead else value_reply(data, 7)

    monitor.watch(QUIET_S)
    answer_all(bus, monkeypatch, reply)
    monitor.watch(1.0)
    assert samples[-1].missing == 0
    dead.append(2)
    monitor.watch(2 * READING_S + ANSWER_S + 0.2)
    assert samples[-1].missing == 0b10
    position_counts = samples[-1].position_counts
    assert position_counts[1] == 7


def test_a_request_that_is_abandoned_begins_the_reading_again(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    monitor.watch(QUIET_S + 0.01)
    position = bytes((0x43, 0x64, 0x60, 0)) + struct.pack("<i", 5)
    bus.coming.append((bus.clock.now_ns, frame(0x581, position)))
    monitor.watch(0.05)
    bus.sent.clear()
    reading = monitor.watch(ABANDONED_S + 0.02)
    asked = [bytes(sent.data[1:3]) for sent in bus.sent if sent.arbitration_id == 0x601]
    # The second object was not answered, so the axis is asked for the first one again.
    assert asked == [bytes((0x64, 0x60))]
    assert reading.axes[0].lost == 1


def test_an_aborted_object_is_named_until_it_is_given(
    bus: QuietBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monitor = monitor_of(bus)
    aborting = [True]

    def reply(_node: int, data: bytes) -> bytes:
        if data[1:3] == b"\x41\x60" and aborting[0]:
            return bytes.fromhex("8041600000000206")
        return value_reply(data, 0x250)

    monitor.watch(QUIET_S)
    answer_all(bus, monkeypatch, reply)
    axis = monitor.watch(0.5).axes[0]
    assert axis.refused == (ObjectRefusal(STATUSWORD, 0x0602_0000),)
    assert axis.statusword is None
    assert axis.rate_hz == 0.0
    assert axis.heard is True
    aborting[0] = False
    axis = monitor.watch(0.5).axes[0]
    assert axis.refused == ()
    assert axis.statusword == 0x250


def test_heartbeats_and_emergencies_of_axes_are_reported(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    bus.coming.append((bus.clock.now_ns + 1000, frame(0x702, b"\x05")))
    bus.coming.append((bus.clock.now_ns + 2000, frame(0x083, bytes.fromhex("1186010000000000"))))
    reading = monitor.watch(0.1)
    nmts = [axis.nmt for axis in reading.axes]
    assert nmts == [None, 5, None, None, None, None]
    emergencies = [event for event in reading.events if event.kind is EventKind.EMCY]
    assert [(event.axis, event.code) for event in emergencies] == [(2, 0x8611)]


@pytest.mark.parametrize(
    ("statusword", "in_fault"), [(None, False), (0x237, False), (0x218, True), (0x21F, True)]
)
def test_an_axis_is_in_fault_by_its_statusword(statusword: int | None, in_fault: bool) -> None:
    assert AxisReading(0, 0, statusword, 5, 1.0, 0).in_fault is in_fault


@pytest.mark.parametrize(
    ("delay_s", "is_late"), [(None, False), (ANSWER_S, False), (ANSWER_S + 0.001, True)]
)
def test_an_answer_is_late_beyond_its_time(delay_s: float | None, is_late: bool) -> None:
    assert AxisReading(0, 0, 0x237, 5, 1.0, 0, delay_s=delay_s).is_late is is_late


@pytest.mark.parametrize(
    ("silent_ns", "source"),
    [(1_999_999_999, ReadingSource.OVERHEARD), (2_000_000_000, ReadingSource.ASKED)],
)
def test_other_masters_are_gone_after_two_seconds_of_silence(
    bus: QuietBus, silent_ns: int, source: ReadingSource
) -> None:
    monitor = monitor_of(bus)
    bus.clock.now_ns += silent_ns
    assert monitor.source is source
