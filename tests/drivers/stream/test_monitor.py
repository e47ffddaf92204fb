"""Watching a bus without changing it: readings, samples and silence, with or without a master."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import replace

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
    CellReading,
    ObjectRefusal,
    ReadingSource,
)
from tests.drivers.quiet_bus import QuietBus, frame, overheard_cycle
from tests.drivers.scripted import PROFILE, FakeClock

NUMBERS = range(1, 7)
AXES = tuple(Axis(f"J{number}", number) for number in NUMBERS)
STATUSWORD = ObjectEntry(0x6041, 0, 16)
POSITION_INDEX = bytes((0x64, 0x60))  #: 6064h, as a request has it
STATUSWORD_INDEX = bytes((0x41, 0x60))  #: 6041h, likewise
OFFSET_NS = 1_700_000_000_000_000_000


@pytest.fixture
def bus() -> Iterator[QuietBus]:
    """Closed at the end."""
    made = QuietBus(FakeClock())
    yield made
    made.shutdown()


def link(bus: QuietBus) -> Link:
    """Open the bus."""
    address = BusAddress("virtual", "monitored")
    made = Link(address, SdoPolicy(), bus.clock, lambda _address: bus)
    made.names = {axis.node_id: axis.name for axis in AXES}
    made.open()
    return made


def monitor_of(bus: QuietBus, samples: list[Sample] | None = None) -> CellMonitor:
    """Monitor of six axes."""
    if samples is None:
        samples = []
    return CellMonitor(link(bus), AXES, samples.append, OFFSET_NS)


def receive(bus: QuietBus, identifier: int, data: bytes, after_ns: int = 0) -> None:
    """Let a frame come, now or after a while."""
    at_ns = bus.clock.now_ns + after_ns
    bus.coming.append((at_ns, frame(identifier, data)))


def first_axis(reading: CellReading) -> AxisReading:
    """Reading of J1."""
    return reading.axes[0]


def positions(reading: CellReading) -> list[int | None]:
    """Position of each axis."""
    return [axis.position_counts for axis in reading.axes]


def answer_all(
    bus: QuietBus, monkeypatch: pytest.MonkeyPatch, reply_to: Callable[[int, bytes], bytes | None]
) -> None:
    """Let nodes answer each request 2 ms later."""

    def answer(msg: can.Message, timeout: float | None = None) -> None:
        node = msg.arbitration_id & 0x7F
        bus.sent.append(msg)
        reply = reply_to(node, bytes(msg.data))
        if reply is not None:
            receive(bus, 0x580 + node, reply, after_ns=2_000_000)

    monkeypatch.setattr(bus, "send", answer)


def value_reply(data: bytes, value: int) -> bytes:
    """Answer of an expedited upload of four bytes."""
    index_and_subindex = data[1:4]
    return b"\x43" + index_and_subindex + value.to_bytes(4, "little")


def short_value_reply(data: bytes, value: int) -> bytes:
    """Answer of an expedited upload of two bytes."""
    index_and_subindex = data[1:4]
    return b"\x4b" + index_and_subindex + value.to_bytes(2, "little") + bytes(2)


def position_reply(position: int) -> bytes:
    """Answer to a request of the position."""
    return b"\x43" + POSITION_INDEX + struct.pack("<xi", position)


def test_each_overheard_cycle_is_a_sample_and_a_gap_is_counted(bus: QuietBus) -> None:
    samples: list[Sample] = []
    monitor = monitor_of(bus, samples)
    monitor.period_ns = 10_000_000
    start = bus.clock.now_ns
    for cycle in (*range(20), *range(25, 40)):  # five SYNCs that this program missed
        silent = None
        if cycle == 30:
            silent = 3
        at_ns = start + (cycle + 1) * 10_000_000
        frames = overheard_cycle(at_ns, cycle, silent=silent)
        _, sync = frames[0]
        sync.timestamp = 1.7e9 + 0.01 * cycle
        bus.coming += frames

    monitor.watch(0.5)

    # The last may still be answered
    cycles = [sample.cycle for sample in samples]
    assert cycles == [*range(20), *range(25, 39)]
    incomplete = [sample.cycle for sample in samples if sample.missing]
    assert incomplete == [30]
    assert samples[25].missing == 0b100
    for sample in samples:
        if not sample.missing:
            position = [1000 * node + sample.cycle for node in NUMBERS]
            assert list(sample.position_counts) == position
        assert sample.current_raw == (-1, -2, -3, -4, -5, -6)
        assert sample.statusword == (0x1237,) * 6


def test_a_quiet_bus_is_asked_by_uploads_alone_and_silence_is_counted(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    monitor.watch(QUIET_S - 0.01)
    assert bus.sent == []
    reading = monitor.watch(9.5 * ABANDONED_S)
    arbitration_ids = {message.arbitration_id for message in bus.sent}
    requests = {0x600 + node for node in NUMBERS}
    assert arbitration_ids == requests
    commands = {message.data[0] for message in bus.sent}
    assert commands == {0x40}
    assert reading.source is ReadingSource.ASKED
    for axis in reading.axes:
        assert 8 <= axis.lost <= 10
        assert axis.position_counts is None
        assert axis.rate_hz == 0
        assert not axis.heard


@pytest.mark.parametrize("identifier", [0x000, 0x080, 0x601])
def test_asking_ends_when_another_master_speaks(bus: QuietBus, identifier: int) -> None:
    monitor = monitor_of(bus)
    monitor.watch(QUIET_S + 0.1)
    sent = len(bus.sent)
    receive(bus, identifier, bytes(8))
    source = monitor.watch(QUIET_S - 0.01).source
    assert source is ReadingSource.OVERHEARD
    assert len(bus.sent) <= sent + 6  # those that left before it spoke
    sent = len(bus.sent)
    monitor.watch(0.1)
    assert len(bus.sent) == sent + 6


def test_nothing_is_sent_once_a_recorder_has_the_bus(bus: QuietBus) -> None:
    """It listens before its first frame, and would refuse to begin."""
    locks: list[str] = []
    monitor = CellMonitor(link(bus), AXES, taken=lambda: bool(locks))
    monitor.watch(QUIET_S + 0.5)
    sent = len(bus.sent)
    assert sent > 0
    locks.append("recorder")
    source = monitor.watch(1.0).source
    assert source is ReadingSource.OVERHEARD
    assert len(bus.sent) == sent


def test_a_late_answer_to_another_client_is_no_reading(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    monitor.watch(QUIET_S + 0.01)
    rated_current = bytes((0x43, 0x75, 0x60, 0)) + struct.pack("<I", 2000)
    receive(bus, 0x581, rated_current)
    reading = monitor.watch(0.05)
    assert first_axis(reading).position_counts is None
    receive(bus, 0x581, position_reply(-7))
    reading = monitor.watch(0.05)
    assert first_axis(reading).position_counts == -7


@pytest.mark.parametrize("identifier", [0x081, 0x181, 0x701])
def test_a_node_that_only_sends_by_itself_is_not_silent(bus: QuietBus, identifier: int) -> None:
    monitor = monitor_of(bus)
    monitor.watch(QUIET_S)
    receive(bus, identifier, b"\x05", after_ns=200_000_000)
    reading = monitor.watch(1.5)
    heard = [axis.heard for axis in reading.axes]
    assert heard == [True, False, False, False, False, False]
    reading = monitor.watch(0.5)
    for axis in reading.axes:
        assert not axis.heard  # longer ago than ABANDONED_S


def test_overheard_readings_are_those_of_our_mapping_with_rates_and_frames(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    start = bus.clock.now_ns
    for cycle in range(100):
        silent = None
        if cycle in (50, 51):
            silent = 3
        at_ns = start + (cycle + 1) * 10_000_000
        bus.coming += overheard_cycle(at_ns, cycle, silent)
    reading = monitor.watch(1.0)
    assert bus.sent == []
    assert reading.source is ReadingSource.OVERHEARD
    assert reading.seconds == pytest.approx(1.0)
    # The hundredth SYNC comes with the end of the second; its answers come behind it.
    assert reading.sync_hz == pytest.approx(100.0)
    assert positions(reading) == [1000 * node + 98 for node in NUMBERS]
    current_raw = [axis.current_raw for axis in reading.axes]
    assert current_raw == [-1, -2, -3, -4, -5, -6]
    rate_hz = [axis.rate_hz for axis in reading.axes]
    assert rate_hz == pytest.approx([99, 99, 97, 99, 99, 99])
    lost = [axis.lost for axis in reading.axes]
    assert lost == [0, 0, 2, 0, 0, 0]
    answers = 6 * 99 - 2
    assert reading.frames == ((100, 0, 0, 0, 0, 0, 0, 0, answers),)


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
    assert first_axis(reading).rate_hz == pytest.approx(10 / 0.205)
    assert reading.frames[0][8] == 60


def test_a_frame_of_another_mapping_is_no_value(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    receive(bus, 0x181, bytes(6), after_ns=1000)
    reading = monitor.watch(0.01)
    axis = first_axis(reading)
    assert axis.position_counts is None
    assert axis.current_raw is None
    assert axis.statusword is None
    assert axis.rate_hz == 0.0


def test_a_set_of_two_frames_counts_when_both_came_also_without_sync(bus: QuietBus) -> None:
    wide = replace(PROFILE, current=ObjectEntry(0x2077, 0, 32, signed=True))
    axis = Axis("J1", 1, wide)
    monitor = CellMonitor(link(bus), (axis,))
    for cycle in range(20):
        after_ns = (cycle + 1) * 10_000_000
        receive(bus, 0x181, bytes(8), after_ns)
        receive(bus, 0x281, bytes(2), after_ns + 1000)
    reading = monitor.watch(0.5)
    assert first_axis(reading).position_counts == 0
    assert first_axis(reading).rate_hz == pytest.approx(20 / 0.5)


def test_queried_values_are_samples_with_wall_time_ten_times_a_second(
    bus: QuietBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples: list[Sample] = []
    monitor = monitor_of(bus, samples)
    values = {0x6064: 70_000, 0x6074: 0xFFF6, 0x6041: 0x237}

    def reply(node: int, data: bytes) -> bytes:
        index = int.from_bytes(data[1:3], "little")
        value = values[index]
        if index == 0x6064:
            return value_reply(data, value + node)
        return short_value_reply(data, value)

    monitor.watch(QUIET_S)
    answer_all(bus, monkeypatch, reply)
    reading = monitor.watch(1.0)
    assert reading.source is ReadingSource.ASKED
    expected = [70_000 + node for node in NUMBERS]
    assert positions(reading) == expected
    for axis in reading.axes:
        assert axis.current_raw == -10
        assert axis.statusword == 0x237
        assert axis.lost == 0
    axis = first_axis(reading)
    assert axis.rate_hz == pytest.approx(10.0, abs=1.0)
    assert axis.delay_s == pytest.approx(0.002, abs=0.002)
    assert len(samples) == pytest.approx(10, abs=1)
    last = samples[-1]
    assert last.missing == 0
    assert list(last.position_counts) == expected
    assert last.cycle == len(samples) - 1
    now_ns = OFFSET_NS + bus.clock.now_ns
    assert 0 <= now_ns - last.time_ns <= 1.5e9 * READING_S
    # Requests and answers, each of eight bytes.
    messages = reading.frames[0][8]
    assert messages == pytest.approx(2 * 6 * 3 * 10, rel=0.15)


def test_a_queried_axis_that_stops_to_answer_is_missing_from_then_on(
    bus: QuietBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples: list[Sample] = []
    monitor = monitor_of(bus, samples)
    dead: list[int] = []

    def reply(node: int, data: bytes) -> bytes | None:
        if node in dead:
            return None
        return value_reply(data, 7)

    monitor.watch(QUIET_S)
    answer_all(bus, monkeypatch, reply)
    monitor.watch(1.0)
    assert samples[-1].missing == 0
    dead.append(2)
    monitor.watch(2 * READING_S + ANSWER_S + 0.2)
    last = samples[-1]
    assert last.missing == 0b10
    assert last.position_counts[1] == 7


def test_a_request_that_is_abandoned_begins_the_reading_again(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    monitor.watch(QUIET_S + 0.01)
    receive(bus, 0x581, position_reply(5))
    monitor.watch(0.05)
    bus.sent.clear()
    reading = monitor.watch(ABANDONED_S + 0.02)
    requests = [message for message in bus.sent if message.arbitration_id == 0x601]
    indices = [bytes(request.data[1:3]) for request in requests]
    # The second object was not answered, so the axis is asked for the first one again.
    assert indices == [POSITION_INDEX]
    assert first_axis(reading).lost == 1


def test_an_aborted_object_is_named_until_it_is_given(
    bus: QuietBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monitor = monitor_of(bus)
    aborting = [True]

    def reply(_node: int, data: bytes) -> bytes:
        if data[1:3] == STATUSWORD_INDEX and aborting[0]:
            return bytes.fromhex("8041600000000206")
        return value_reply(data, 0x250)

    monitor.watch(QUIET_S)
    answer_all(bus, monkeypatch, reply)
    reading = monitor.watch(0.5)
    axis = first_axis(reading)
    refusal = ObjectRefusal(STATUSWORD, 0x0602_0000)
    assert axis.refused == (refusal,)
    assert axis.statusword is None
    assert axis.rate_hz == 0.0
    assert axis.heard is True
    aborting[0] = False
    reading = monitor.watch(0.5)
    axis = first_axis(reading)
    assert axis.refused == ()
    assert axis.statusword == 0x250


@pytest.mark.parametrize("refused_index", [POSITION_INDEX, STATUSWORD_INDEX])
def test_an_axis_that_refuses_an_object_is_missing_with_its_last_values(
    bus: QuietBus, monkeypatch: pytest.MonkeyPatch, refused_index: bytes
) -> None:
    samples: list[Sample] = []
    monitor = monitor_of(bus, samples)
    aborting: list[int] = []

    def reply(node: int, data: bytes) -> bytes:
        if data[1:3] == refused_index and node in aborting:
            return b"\x80" + data[1:4] + bytes.fromhex("22000008")
        return value_reply(data, 0x237)

    monitor.watch(QUIET_S)
    answer_all(bus, monkeypatch, reply)
    monitor.watch(1.0)
    assert samples[-1].missing == 0
    samples.clear()
    aborting.append(2)
    reading = monitor.watch(4 * READING_S)
    assert reading.axes[1].refused
    # The first sample may be of the values before the refusal.
    assert {sample.missing for sample in samples[1:]} == {0b10}
    for sample in samples:
        assert sample.position_counts == (0x237,) * 6
        assert sample.statusword == (0x237,) * 6
    aborting.clear()
    monitor.watch(3 * READING_S)
    assert samples[-1].missing == 0


def test_heartbeats_and_emergencies_of_axes_are_reported(bus: QuietBus) -> None:
    monitor = monitor_of(bus)
    receive(bus, 0x702, b"\x05", after_ns=1000)
    emcy = bytes.fromhex("1186010000000000")
    receive(bus, 0x083, emcy, after_ns=2000)
    reading = monitor.watch(0.1)
    nmts = [axis.nmt for axis in reading.axes]
    assert nmts == [None, 5, None, None, None, None]
    (emergency,) = (event for event in reading.events if event.kind is EventKind.EMCY)
    assert emergency.axis == 2
    assert emergency.code == 0x8611


@pytest.mark.parametrize(
    ("statusword", "in_fault"), [(None, False), (0x237, False), (0x218, True), (0x21F, True)]
)
def test_an_axis_is_in_fault_by_its_statusword(statusword: int | None, in_fault: bool) -> None:
    axis = AxisReading(0, 0, statusword, 5, 1.0, 0)
    assert axis.in_fault is in_fault


@pytest.mark.parametrize(
    ("delay_s", "is_late"), [(None, False), (ANSWER_S, False), (ANSWER_S + 0.001, True)]
)
def test_an_answer_is_late_beyond_its_time(delay_s: float | None, is_late: bool) -> None:
    axis = AxisReading(0, 0, 0x237, 5, 1.0, 0, delay_s=delay_s)
    assert axis.is_late is is_late


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
