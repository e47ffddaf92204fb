"""The stream against frames that are lost, late, doubled, cut and unasked for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen.socketcan import CapturedMessage, Losses
from drivers.errors import BusBusy, BusError, DriveFault, DriverError, SampleLost
from drivers.messages import CellEvent, EventKind
from drivers.stream import sync
from drivers.stream.answers import StreamStatistics
from drivers.stream.producers import steered_us
from drivers.stream.stream import SyncStream
from drivers.stream.sync import FollowedSync, LockstepSync, SyncRate, TimedSync
from tests.drivers.scripted import PERIOD_NS, ScriptedBus, cell

FIRST_NS = 77  #: time of the first SYNC
BIT_AND_COB_ID = ((0b01, 0x181), (0b10, 0x182))
"""Bit of `missing` and identifier of the answer of each axis."""

Prepared = tuple[SyncStream, ScriptedBus, list[CellEvent]]


def prepared(axes: int = 2, timed: bool = False) -> Iterator[Prepared]:
    """A lockstep (or timed) stream of a prepared network;
    the position of every axis is its cycle number.
    """
    network, bus = cell(axes)
    events: list[CellEvent] = []

    def count_cycles(cycle: int) -> None:
        for node in bus.nodes:
            node.position = cycle

    with network:
        network.prepare()
        bus.cycle = -1
        bus.on_cycle = count_cycles
        if timed:
            pacing: TimedSync | LockstepSync = TimedSync(PERIOD_NS, FIRST_NS, bus.clock)
        else:
            pacing = LockstepSync(PERIOD_NS, 0.01, FIRST_NS, bus.clock)
        sync_stream = SyncStream(network, pacing, events.append)
        yield sync_stream, bus, events
        bus.tamper = lambda message: (message,)
        for node in bus.nodes:
            node.beats = True
            node.nmt = 5


@pytest.fixture
def lockstep() -> Iterator[Prepared]:
    yield from prepared()


@pytest.fixture
def timed() -> Iterator[Prepared]:
    yield from prepared(timed=True)


def faults_of(stream: SyncStream) -> Iterator[str]:
    """Remove and return the faults that wait to be raised."""
    while True:
        try:
            stream.check()
        except DriverError as fault:
            yield str(fault)
        else:
            return


def drop(bus: ScriptedBus, cob_id: int, cycles: range) -> None:
    def tamper(message: can.Message) -> tuple[can.Message, ...]:
        is_dropped = message.arbitration_id == cob_id and bus.cycle in cycles
        return () if is_dropped else (message,)

    bus.tamper = tamper


def drop_all(bus: ScriptedBus, cob_id: int) -> None:
    """Drop each of these frames, in whatever cycle it comes."""
    bus.tamper = lambda message: () if message.arbitration_id == cob_id else (message,)


def send_twice(bus: ScriptedBus, cob_id: int, cycle: int) -> None:
    def tamper(message: can.Message) -> tuple[can.Message, ...]:
        is_sent_twice = message.arbitration_id == cob_id and bus.cycle == cycle
        return (message, message) if is_sent_twice else (message,)

    bus.tamper = tamper


def frame(cob_id: int, data: bytes, **fields: bool) -> can.Message:
    extended = fields.pop("is_extended_id", False)
    return can.Message(arbitration_id=cob_id, is_extended_id=extended, data=data, **fields)


def events_of(events: list[CellEvent], kind: EventKind) -> list[CellEvent]:
    return [event for event in events if event.kind is kind]


def sync_times_ns(count: int, period_ns: int = PERIOD_NS) -> list[int]:
    return [FIRST_NS + period_ns * cycle for cycle in range(count)]


def both_axes(counts: Iterable[int]) -> list[tuple[int, int]]:
    """Positions of two axes that count the same."""
    return [(count, count) for count in counts]


def missing_of_next(stream: SyncStream, count: int) -> list[int]:
    samples = [next(stream) for _ in range(count)]
    return [sample.missing for sample in samples]


def test_samples_carry_the_syncs_time_and_all_axes(lockstep: Prepared) -> None:
    stream, _, _ = lockstep
    samples = [next(stream) for _ in range(5)]
    expected = [0, 1, 2, 3, 4]
    assert [sample.cycle for sample in samples] == expected
    time_ns = [sample.time_ns for sample in samples]
    assert time_ns == sync_times_ns(5)
    position_counts = [sample.position_counts for sample in samples]
    assert position_counts == both_axes(range(5))
    stream_statistics = StreamStatistics(cycles=5, frames=10)
    assert stream.statistics == stream_statistics


def test_a_missing_frame_is_a_bit_and_repeats_the_last_value(lockstep: Prepared) -> None:
    stream, bus, events = lockstep
    drop(bus, 0x182, range(2, 3))
    samples = [next(stream) for _ in range(5)]
    expected = [0, 0, 0b10, 0, 0]
    assert [sample.missing for sample in samples] == expected
    position_counts = [sample.position_counts[1] for sample in samples]
    assert position_counts == [0, 1, 1, 3, 4]
    of_first = [sample.position_counts[0] for sample in samples]
    assert of_first == [0, 1, 2, 3, 4]
    stream_statistics = StreamStatistics(cycles=5, frames=9, missing=1)
    assert stream.statistics == stream_statistics
    (lost,) = events_of(events, EventKind.SAMPLE_LOST)
    assert lost.axis == 1
    assert lost.code == 2
    assert lost.time_ns == samples[2].time_ns


def test_a_late_frame_is_never_taken_for_the_next_cycles(lockstep: Prepared) -> None:
    stream, bus, _ = lockstep
    held: list[can.Message] = []

    def hold_one(message: can.Message) -> tuple[can.Message, ...]:
        if message.arbitration_id == 0x182 and bus.cycle == 2:
            held.append(message)
            return ()
        if held and message.arbitration_id == 0x182:
            return (held.pop(), message)
        return (message,)

    bus.tamper = hold_one
    samples = [next(stream) for _ in range(5)]
    expected = [0, 0, 0b10, 0, 0]
    assert [sample.missing for sample in samples] == expected
    position_counts = [sample.position_counts[1] for sample in samples]
    assert position_counts == [0, 1, 1, 3, 4]
    stream_statistics = StreamStatistics(cycles=5, frames=9, missing=1, late=1)
    assert stream.statistics == stream_statistics


def test_a_late_frame_between_two_syncs_is_dropped(lockstep: Prepared) -> None:
    stream, bus, _ = lockstep
    drop(bus, 0x181, range(1, 2))
    assert missing_of_next(stream, 2) == [0, 1]
    bus.inject(frame(0x181, b"\xff" * 8))
    sample = next(stream)
    assert sample.missing == 0
    assert sample.position_counts[0] == 2
    assert stream.statistics.late == 1


def test_a_duplicate_is_counted_and_changes_nothing(lockstep: Prepared) -> None:
    stream, bus, _ = lockstep
    send_twice(bus, 0x181, cycle=1)
    samples = [next(stream) for _ in range(4)]
    expected = [(k, k) for k in range(4)]
    assert [sample.position_counts for sample in samples] == expected
    stream_statistics = StreamStatistics(cycles=4, frames=8, duplicate=1)
    assert stream.statistics == stream_statistics


def test_a_duplicate_of_the_last_axis_is_found_before_the_next_sync(lockstep: Prepared) -> None:
    stream, bus, _ = lockstep
    send_twice(bus, 0x182, cycle=1)
    samples = [next(stream) for _ in range(4)]
    expected = [(k, k) for k in range(4)]
    assert [sample.position_counts for sample in samples] == expected
    assert stream.statistics.duplicate == 1


@pytest.mark.parametrize("length", [0, 7])
def test_a_cut_frame_is_counted_and_missing(lockstep: Prepared, length: int) -> None:
    stream, bus, _ = lockstep

    def cut(message: can.Message) -> tuple[can.Message, ...]:
        if message.arbitration_id == 0x181 and bus.cycle == 1:
            data = message.data[:length]
            return (can.Message(arbitration_id=0x181, is_extended_id=False, data=data),)
        return (message,)

    bus.tamper = cut
    assert missing_of_next(stream, 3) == [0, 1, 0]
    expected = StreamStatistics(cycles=3, frames=5, missing=1, wrong_length=1)
    assert stream.statistics == expected


def cut_second(bus: ScriptedBus, cob_id: int, cycle: int) -> None:
    """Let a frame of seven bytes follow one of these frames."""

    def tamper(message: can.Message) -> tuple[can.Message, ...]:
        if message.arbitration_id == cob_id and bus.cycle == cycle:
            return (message, frame(cob_id, bytes(7)))
        return (message,)

    bus.tamper = tamper


def test_a_cut_frame_between_two_cycles_is_of_wrong_length(lockstep: Prepared) -> None:
    stream, bus, events = lockstep
    cut_second(bus, 0x182, cycle=1)
    assert missing_of_next(stream, 3) == [0, 0, 0]
    expected = StreamStatistics(cycles=3, frames=6, wrong_length=1)
    assert stream.statistics == expected
    (event,) = events_of(events, EventKind.PDO_LENGTH)
    assert event.axis == 1


def test_a_cut_frame_behind_the_last_cycle_is_counted(lockstep: Prepared) -> None:
    stream, bus, _ = lockstep
    cut_second(bus, 0x182, cycle=1)
    assert missing_of_next(stream, 2) == [0, 0]
    stream.read_on(0.05)
    expected = StreamStatistics(cycles=2, frames=4, wrong_length=1)
    assert stream.statistics == expected


def test_frames_of_others_and_from_before_are_foreign(lockstep: Prepared) -> None:
    stream, bus, _ = lockstep
    # Before the first SYNC
    bus.inject(frame(0x181, b"\xff" * 8))
    next(stream)
    # Of a foreign node
    bus.inject(frame(0x385, bytes(8)))
    # Another identifier
    bus.inject(frame(0x181, b"\xff" * 8, is_extended_id=True))
    assert next(stream).position_counts == (1, 1)
    expected = StreamStatistics(cycles=2, frames=4, foreign=3)
    assert stream.statistics == expected


def test_a_frame_that_an_axis_was_not_asked_to_send_is_surplus(lockstep: Prepared) -> None:
    stream, bus, _ = lockstep
    next(stream)
    # TPDO4 of node 1
    bus.inject(frame(0x481, bytes(8)))
    assert next(stream).position_counts == (1, 1)
    expected = StreamStatistics(cycles=2, frames=4, surplus=1)
    assert stream.statistics == expected


def test_too_many_missing_cycles_in_a_row_end_the_stream(lockstep: Prepared) -> None:
    stream, bus, _ = lockstep
    drop(bus, 0x182, range(1, 100))
    samples = [next(stream) for _ in range(5)]
    expected = [0, 2, 2, 2, 2]
    assert [sample.missing for sample in samples] == expected
    with pytest.raises(SampleLost, match="cycle 4: no answer from J2"):
        next(stream)


def test_emcy_is_an_event_then_a_fault(lockstep: Prepared) -> None:
    stream, bus, events = lockstep
    next(stream)
    bus.inject(bus.nodes[1].emcy(0x7305))
    sample = next(stream)
    emcy = events_of(events, EventKind.EMCY)[0]
    assert emcy.axis == 1
    assert emcy.code == 0x7305
    assert emcy.time_ns == sample.time_ns
    with pytest.raises(DriveFault, match=r"J2 \(node 2\): .*7305h") as fault:
        next(stream)
    assert fault.value.emcy_code == 0x7305


@pytest.mark.parametrize("following_error", [False, True])
def test_a_new_fault_is_seen_in_the_sample_and_raised_after_it(
    lockstep: Prepared, following_error: bool
) -> None:
    stream, bus, events = lockstep
    next(stream)
    bus.nodes[0].fault(following_error)
    assert next(stream).statusword[0] & 0x08
    states = events_of(events, EventKind.STATE)
    assert any("FAULT" in state.text for state in states)
    with pytest.raises(DriveFault, match="FAULT"):
        next(stream)


def test_a_fault_from_before_does_not_forbid_to_look(lockstep: Prepared) -> None:
    stream, bus, _ = lockstep
    bus.nodes[0].fault()
    cycles = [next(stream).cycle for _ in range(3)]
    assert cycles == [0, 1, 2]


@pytest.mark.parametrize("following_error", [False, True])
def test_an_old_fault_of_an_axis_that_answers_late_is_still_old(
    lockstep: Prepared, following_error: bool
) -> None:
    """Its statusword before its first answer is undefined: the first one is no change."""
    stream, bus, events = lockstep
    bus.nodes[1].fault(following_error)
    drop(bus, 0x182, range(2))
    samples = [next(stream) for _ in range(6)]
    expected = [2, 2, 0, 0, 0, 0]
    assert [sample.missing for sample in samples] == expected
    states = events_of(events, EventKind.STATE)
    (state,) = [state for state in states if state.axis == 1]
    third = samples[2]
    assert state.time_ns == third.time_ns
    assert state.code == third.statusword[1]
    bus.nodes[1].fault()
    bus.nodes[0].fault()
    next(stream)
    with pytest.raises(DriveFault, match="node 1"):
        next(stream)


def test_a_limit_that_acts_is_an_event_alone(lockstep: Prepared) -> None:
    stream, bus, events = lockstep
    next(stream)
    bus.nodes[0].statusword |= 1 << 11
    next(stream)
    bus.nodes[0].statusword &= ~(1 << 11)
    next(stream)
    texts = [limit.text for limit in events_of(events, EventKind.LIMIT)]
    assert texts == [
        "J1: a limit is active",
        "J1: the limit is no longer active",
    ]


def test_heartbeat_loss_is_noticed_within_two_and_a_half_periods(lockstep: Prepared) -> None:
    stream, bus, events = lockstep
    for _ in range(100):
        next(stream)
        bus.clock.now_ns += PERIOD_NS
    silent_since = stream.time_ns
    bus.nodes[1].beats = False
    with pytest.raises(DriveFault, match="node 2"):
        for _ in range(1000):
            next(stream)
            bus.clock.now_ns += PERIOD_NS
    lost = events_of(events, EventKind.HEARTBEAT_LOST)[0]
    assert lost.axis == 1
    gap_ns = lost.time_ns - silent_since
    limit = 2.5 * stream.network.heartbeat_ms * 1_000_000
    assert gap_ns <= limit


def test_a_fast_simulation_is_no_heartbeat_loss(lockstep: Prepared) -> None:
    stream, bus, _ = lockstep
    bus.nodes[0].beats = bus.nodes[1].beats = False
    begin = bus.clock.now_ns
    for _ in range(100):  # 100 ms of samples in 25 ms of the clock
        next(stream)
    elapsed_ns = bus.clock.now_ns - begin
    limit = 2 * stream.network.heartbeat_ms * 1_000_000
    assert elapsed_ns < limit


def test_a_node_that_falls_back_is_a_fault(lockstep: Prepared) -> None:
    stream, bus, events = lockstep
    for _ in range(3):
        next(stream)
    message = can.Message(arbitration_id=0x702, is_extended_id=False, data=b"\x7f")
    bus.inject(message)
    next(stream)
    last_event = events[-1]
    assert last_event.kind is EventKind.NMT
    with pytest.raises(DriveFault, match="left OPERATIONAL, is PRE-OPERATIONAL"):
        next(stream)


def test_a_cut_wire_is_a_bus_error(lockstep: Prepared) -> None:
    stream, bus, _ = lockstep
    next(stream)
    bus.broken = True
    with pytest.raises(BusError, match="wire was cut"):
        next(stream)
    bus.broken = False


def test_timed_syncs_keep_to_the_schedule(timed: Prepared) -> None:
    stream, _, _ = timed
    times_ns = [next(stream).time_ns for _ in range(20)]
    assert times_ns == sync_times_ns(20)


def test_before_the_first_sync_it_is_already_the_start(timed: Prepared, lockstep: Prepared) -> None:
    timed_stream, _, _ = timed
    lockstep_stream, _, _ = lockstep
    assert timed_stream.time_ns == FIRST_NS
    assert lockstep_stream.time_ns == FIRST_NS


def test_a_slipped_schedule_leaves_periods_out_and_counts_them(timed: Prepared) -> None:
    stream, bus, _ = timed
    first = next(stream).time_ns
    bus.clock.now_ns += round(3.5 * PERIOD_NS)
    second = next(stream)
    third = next(stream)
    assert stream.statistics.skipped_periods == 2
    assert (second.cycle, third.cycle) == (3, 4)  # periods 1 and 2 had no SYNC
    expected = third.cycle * PERIOD_NS
    assert (third.time_ns - first) == expected


def test_a_timed_cycle_does_not_wait_beyond_its_period(timed: Prepared) -> None:
    stream, bus, _ = timed
    drop(bus, 0x181, range(1, 3))
    samples = [next(stream) for _ in range(5)]
    # The answer after it may be a late one
    expected = [0, 1, 1, 1, 0]
    assert [sample.missing for sample in samples] == expected
    first_ns = samples[0].time_ns
    after_first_ns = [sample.time_ns - first_ns for sample in samples]
    assert after_first_ns == [PERIOD_NS * cycle for cycle in range(5)]


@pytest.mark.slow
@settings(deadline=None)
@given(st.sets(st.tuples(st.integers(0, 29), st.sampled_from((0x181, 0x182))), max_size=12))
def test_every_dropped_frame_is_exactly_one_bit(dropped: set[tuple[int, int]]) -> None:
    for stream, bus, _ in prepared():

        def tamper(message: can.Message, bus: ScriptedBus = bus) -> tuple[can.Message, ...]:
            is_dropped = (bus.cycle, message.arbitration_id) in dropped
            return () if is_dropped else (message,)

        bus.tamper = tamper
        samples = [stream.advance() for _ in range(30)]
        for sample in samples:
            missing = 0
            for bit, cob_id in BIT_AND_COB_ID:
                if (sample.cycle, cob_id) in dropped:
                    missing |= bit
            assert sample.missing == missing
            for axis in range(2):
                if not sample.missing >> axis & 1:
                    assert sample.position_counts[axis] == sample.cycle
        assert stream.statistics.missing == len(dropped)
        bus.tamper = lambda m: (m,)


class Producer(sync.Producer):
    """Sends SYNC on the scripted bus, whether the stream reads or not;
    each axis' position is its number.

    Attributes:
        pulses: SYNCs sent.
        steered: what the stream said that it saw.
    """

    def __init__(self, bus: ScriptedBus) -> None:
        super().__init__("J1", PERIOD_NS // 1000)
        self._bus = bus
        self.pulses = 0
        self.at_ns = bus.clock.now_ns
        self.steered: list[tuple[int, int]] = []

    def pulse(self, after_ns: int = PERIOD_NS, local: bool = True) -> None:
        """A SYNC so long after the last one, and its answers."""
        self.at_ns += after_ns
        sync = CapturedMessage(arbitration_id=0x80, is_extended_id=False)
        sync.kernel_ns = 0
        sync.monotonic_ns = self.at_ns
        sync.local = local
        self._bus.inject(sync)
        for node in self._bus.nodes:
            node.position = self.pulses
            for answer in node.on_sync(self.pulses):
                for frame in self._bus.tamper(answer):
                    self._bus.inject(frame)
        self.pulses += 1

    def seen(self, monotonic_ns: int, periods: int) -> None:
        self.steered.append((monotonic_ns, periods))


Followed = tuple[SyncStream, ScriptedBus, Producer, list[CellEvent]]


def followed_stream() -> Iterator[Followed]:
    network, bus = cell()
    events: list[CellEvent] = []
    with network:
        network.prepare()
        network.link.sync_producer = "J1"
        producer = Producer(bus)
        pacing = FollowedSync(PERIOD_NS, producer, timeout_s=0.01, start_ns=77, clock=bus.clock)
        stream = SyncStream(network, pacing, events.append)
        receive = bus.recv

        def recv(timeout: float | None = None) -> can.Message | None:
            message = receive(timeout)
            if message is None and timeout == 0.0 and producer.pulses == 0:
                # The first: once the stream has thrown away what waited before it began
                producer.pulse()
            return message

        bus.recv = recv  # type: ignore[method-assign]
        yield stream, bus, producer, events
        bus.tamper = lambda message: (message,)
        for node in bus.nodes:
            node.beats = True
            node.nmt = 5


@pytest.fixture
def followed() -> Iterator[Followed]:
    yield from followed_stream()


def test_a_followed_sync_opens_a_cycle_with_its_own_time(followed: Followed) -> None:
    stream, bus, producer, _ = followed
    sent = len(bus.sent)
    samples = [next(stream)]
    for _ in range(4):
        producer.pulse()
        bus.clock.now_ns += 7 * PERIOD_NS  # the time of reading does not matter
        samples.append(next(stream))
    expected = list(range(5))
    assert [sample.cycle for sample in samples] == expected
    time_ns = [sample.time_ns for sample in samples]
    assert time_ns == sync_times_ns(5)
    position_counts = [sample.position_counts for sample in samples]
    assert position_counts == both_axes(range(5))
    assert len(bus.sent) == sent
    stream_statistics = StreamStatistics(cycles=5, frames=10)
    assert stream.statistics == stream_statistics
    steered_periods = [periods for _, periods in producer.steered]
    assert steered_periods == [0, 1, 1, 1, 1]


def test_a_reader_that_is_late_loses_nothing(followed: Followed) -> None:
    """A thousand cycles wait; they are distinguished by their order, not by the clock."""
    stream, bus, producer, _ = followed
    next(stream)
    for _ in range(1000):
        producer.pulse()
    bus.clock.now_ns += 10**12
    samples = [stream.advance() for _ in range(1000)]
    expected = both_axes(range(1, 1001))
    assert [sample.position_counts for sample in samples] == expected
    time_ns = [sample.time_ns for sample in samples]
    with_first = sync_times_ns(1001)
    assert time_ns == with_first[1:]
    stream_statistics = StreamStatistics(cycles=1001, frames=2002)
    assert stream.statistics == stream_statistics
    # But axes do not move on such old news
    with pytest.raises(BusError, match=r"read 1000\.0 s late"):
        stream.check()
    stream.check()


@pytest.mark.parametrize("late_periods", [6, 50, 900])
def test_a_late_reader_without_stamps_accuses_no_other_master(
    followed: Followed, late_periods: int
) -> None:
    stream, bus, _, events = followed
    next(stream)
    for cycle in range(1, late_periods + 1):
        bus.inject(frame(0x80, b""))
        for node in bus.nodes:
            for answer in node.on_sync(cycle):
                bus.inject(answer)
    bus.clock.now_ns += late_periods * PERIOD_NS
    for _ in range(late_periods):
        stream.advance()
    assert stream.statistics.missing == 0
    assert [event for event in events if event.kind is EventKind.BUS_BUSY] == []


def test_a_second_producer_is_detected_without_stamps(followed: Followed) -> None:
    stream, bus, _, events = followed
    next(stream)
    for cycle in range(1, 40):
        bus.clock.now_ns += PERIOD_NS // 2
        bus.inject(frame(0x80, b""))
        for node in bus.nodes:
            for answer in node.on_sync(cycle):
                bus.inject(answer)
        stream.advance()
    assert [event for event in events if event.kind is EventKind.BUS_BUSY] != []
    with pytest.raises(BusBusy):
        stream.check()


def test_a_sync_that_did_not_come_is_a_period_that_was_left_out(followed: Followed) -> None:
    stream, _, producer, _ = followed
    next(stream)
    producer.pulse(3 * PERIOD_NS)
    after_ns = PERIOD_NS // 2 * 3 - 1
    producer.pulse(after_ns)  # late, but none is missing
    samples = [next(stream), next(stream)]
    cycles = [sample.cycle for sample in samples]
    assert cycles == [3, 4]
    assert stream.statistics.skipped_periods == 2


def test_a_missing_answer_ends_with_the_next_sync(followed: Followed) -> None:
    stream, bus, producer, _ = followed
    next(stream)
    drop_all(bus, 0x182)
    producer.pulse()
    bus.tamper = lambda message: (message,)
    producer.pulse()
    producer.pulse()
    producer.pulse()
    samples = [next(stream) for _ in range(3)]
    # The answer after it may be a late one
    missing = [sample.missing for sample in samples]
    assert missing == [2, 2, 0]
    expected = [(1, 0), (2, 0), (3, 3)]
    assert [sample.position_counts for sample in samples] == expected
    stream_statistics = StreamStatistics(cycles=4, frames=6, missing=2, late=1)
    assert stream.statistics == stream_statistics


def test_a_silence_that_is_read_late_has_its_own_length(followed: Followed) -> None:
    """Five periods without an answer are five periods, also when they are read within no time."""
    stream, bus, producer, _ = followed
    next(stream)
    bus.tamper = lambda _message: ()
    for _ in range(6):
        producer.pulse()
    for _ in range(5):
        stream.advance()
    with pytest.raises(SampleLost, match=r"no axis answered within 0\.004 s"):
        stream.check()


def test_what_is_to_be_sent_goes_out_at_once(followed: Followed) -> None:
    stream, bus, producer, _ = followed
    next(stream)
    frame = can.Message(arbitration_id=0x201, is_extended_id=False, data=bytes(6))
    stream.bus.outgoing.append(frame)
    producer.pulse()
    next(stream)
    assert bus.sent[-1] is frame


def test_a_producer_that_dies_is_a_fault_and_the_axes_can_still_be_stopped(
    followed: Followed,
) -> None:
    stream, bus, _, events = followed
    next(stream)
    last_ns = stream.time_ns
    assert stream.advance().missing == 0  # by a SYNC of ours
    lost = events_of(events, EventKind.SYNC_LOST)[0]
    assert lost.time_ns == last_ns
    with pytest.raises(BusError, match=r"no SYNC from J1 for 0\.01 s"):
        next(stream)
    before = bus.cycle
    missing = [stream.advance().missing for _ in range(3)]
    assert missing == [0, 0, 0]
    assert bus.cycle == before + 3


def test_the_periods_without_a_producer_are_a_gap_in_the_cycles(followed: Followed) -> None:
    """Number and time of a sample belong together,
    also when this program sends SYNC after a wait.
    """
    stream, bus, producer, _ = followed
    first = next(stream)
    producer.pulse()
    bus.clock.now_ns = producer.at_ns
    before = next(stream)
    after = stream.advance()
    gap_ns = after.time_ns - first.time_ns
    passed = (gap_ns + PERIOD_NS // 2) // PERIOD_NS
    assert (before.cycle, after.cycle) == (1, passed)
    assert passed >= 11  # the producer may be silent for ten periods
    assert stream.statistics.skipped_periods == passed - 2
    cycle = stream.advance().cycle
    assert cycle == passed + 1


def test_heartbeats_do_not_hide_that_a_producer_is_dead() -> None:
    """A bus is never silent for as long as a producer may be:
    the drives' heartbeats come in between.
    """
    for stream, bus, _, events in followed_stream():
        bus.nodes[0].store(0x1017, 0, 8)
        bus.nodes[1].store(0x1017, 0, 8)
        bus.nodes[1].next_beat_ns = bus.clock.now_ns + 4_000_000
        next(stream)
        stream.network.link.start_heartbeat(127, 5)
        begun_ns = bus.clock.now_ns
        sent = len(bus.sent)
        assert stream.advance().missing == 0
        assert bus.clock.now_ns - begun_ns <= 12_000_000
        found = [event.kind for event in events].count(EventKind.SYNC_LOST)
        assert found == 1
        frames = bus.sent[sent:]
        arbitration_ids = [frame.arbitration_id for frame in frames]
        assert 0x77F in arbitration_ids  # and ours goes on


def test_a_producer_that_dies_before_an_answer_came_is_noticed_in_one_bound(
    followed: Followed,
) -> None:
    stream, bus, producer, events = followed
    next(stream)
    drop_all(bus, 0x182)
    producer.pulse()
    bus.tamper = lambda message: (message,)
    begun_ns = bus.clock.now_ns
    assert stream.advance().missing == 2
    assert stream.advance().missing == 2  # by a SYNC of ours; the answer may be a late one
    assert bus.clock.now_ns - begun_ns <= 17_000_000
    assert events_of(events, EventKind.SYNC_LOST)


def test_a_lost_sync_that_cannot_be_replaced_is_not_waited_for_again(followed: Followed) -> None:
    """The stop of the axes comes next, and must not wait for the dead producer a second time."""
    stream, bus, _, events = followed
    next(stream)
    send = bus.send

    def refuse_sync(msg: can.Message, timeout: float | None = None) -> None:
        if msg.arbitration_id == 0x80:
            raise can.CanOperationError("the wire was cut")
        send(msg, timeout)

    bus.send = refuse_sync  # type: ignore[method-assign]
    with pytest.raises(BusError, match="the wire was cut"):
        stream.advance()
    begun_ns = bus.clock.now_ns
    with pytest.raises(BusError, match="the wire was cut"):
        stream.advance()
    bus.send = send  # type: ignore[method-assign]
    elapsed_ns = bus.clock.now_ns - begun_ns
    assert elapsed_ns <= 2 * PERIOD_NS
    found = [event.kind for event in events].count(EventKind.SYNC_LOST)
    assert found == 1


def test_a_flood_of_other_frames_is_no_sign_of_a_producer(followed: Followed) -> None:
    stream, bus, _, events = followed
    next(stream)
    receive = bus.recv

    def flood(timeout: float | None = None) -> can.Message | None:
        if not events_of(events, EventKind.SYNC_LOST):
            bus.clock.now_ns += 20_000
            return can.Message(arbitration_id=0x7FF, is_extended_id=False)
        return receive(timeout)

    bus.recv = flood  # type: ignore[method-assign]
    stream.advance()
    bus.recv = receive  # type: ignore[method-assign]
    with pytest.raises(BusError, match="no SYNC from J1"):
        stream.check()


def test_a_bus_that_never_falls_silent_does_not_keep_the_sync_for_ever(timed: Prepared) -> None:
    stream, bus, _ = timed
    next(stream)
    receive = bus.recv
    before = bus.cycle

    def flood(timeout: float | None = None) -> can.Message | None:
        if bus.cycle > before:
            return receive(timeout)
        bus.clock.now_ns += 20_000_000
        return can.Message(arbitration_id=0x7FF, is_extended_id=False)

    bus.recv = flood  # type: ignore[method-assign]
    stream.advance()
    bus.recv = receive  # type: ignore[method-assign]
    with pytest.raises(BusError, match=r"read 1\.0 s late"):
        stream.check()


def test_a_schedule_that_slips_by_more_than_a_second_is_a_fault(timed: Prepared) -> None:
    stream, bus, _ = timed
    next(stream)
    reported: list[str] = []
    for late_ns in (900_000_000, 1_100_000_000):
        bus.clock.now_ns += late_ns
        stream.advance()
        reported.append("; ".join(faults_of(stream)))  # the heartbeats were not read either
    before, after = reported
    assert "read 1.1 s late" not in before
    assert "read 1.1 s late" in after


def test_set_points_of_another_master_are_a_fault(lockstep: Prepared) -> None:
    stream, bus, events = lockstep
    next(stream)
    # Of a node that is no axis
    bus.inject(frame(0x27E, bytes(6)))
    own = frame(0x201, bytes(6), is_rx=False)
    bus.inject(own)
    next(stream)
    stream.check()
    bus.inject(frame(0x402, bytes(6)))
    next(stream)
    (busy,) = events_of(events, EventKind.BUS_BUSY)
    assert busy.code == 0x402
    with pytest.raises(BusBusy, match=r"a set-point of J2 \(node 2\) \(402h\)"):
        next(stream)
    assert stream.statistics.surplus == 0


def test_what_comes_behind_the_last_cycle_is_counted(lockstep: Prepared) -> None:
    stream, bus, events = lockstep
    bus.losses = Losses()
    send_twice(bus, 0x182, cycle=1)
    next(stream)
    next(stream)
    before = stream.statistics
    sent = len(bus.sent)
    begun_ns = bus.clock.now_ns
    bus.losses = Losses(interface=3)
    stream.read_on(0.25)
    assert bus.clock.now_ns - begun_ns == 250_000_000
    assert len(bus.sent) == sent
    expected = replace(before, duplicate=1, interface_dropped=3)
    assert stream.statistics == expected
    assert events_of(events, EventKind.FRAMES_DROPPED)


def test_cycles_of_a_producer_that_goes_on_are_no_ones(followed: Followed) -> None:
    stream, bus, producer, _ = followed
    next(stream)
    # Doubled, before the next SYNC
    message = can.Message(arbitration_id=0x182, is_extended_id=False, data=bytes(8))
    bus.inject(message)
    for _ in range(5):
        producer.pulse()
    stream.read_on(0.05)
    expected = StreamStatistics(cycles=1, frames=2, duplicate=1)
    assert stream.statistics == expected


def test_a_cut_answer_to_a_sync_behind_the_last_cycle_is_counted(followed: Followed) -> None:
    stream, bus, producer, _ = followed
    next(stream)

    def cut(message: can.Message) -> tuple[can.Message, ...]:
        if message.arbitration_id == 0x182:
            return (frame(0x182, bytes(7)),)
        return (message,)

    bus.tamper = cut
    producer.pulse()
    stream.read_on(0.05)
    expected = StreamStatistics(cycles=1, frames=2, wrong_length=1)
    assert stream.statistics == expected


def test_a_second_producer_is_another_master(followed: Followed) -> None:
    stream, _, producer, _ = followed
    next(stream)
    with pytest.raises(BusBusy, match="a SYNC"):
        for _ in range(20):
            producer.pulse(PERIOD_NS // 2)
            next(stream)
    assert producer.pulses < 12


@settings(deadline=None)
@given(st.lists(st.integers(-400_000, 400_000), min_size=50, max_size=50))
def test_jitter_is_no_second_producer(late_ns: list[int]) -> None:
    rate = SyncRate(PERIOD_NS)
    before_ns = 0
    for number, late in enumerate(late_ns, start=1):
        scheduled_ns = number * PERIOD_NS * 9999 // 10000  # its clock is 100 ppm fast
        at_ns = scheduled_ns + late
        since_last_ns = at_ns - before_ns
        assert not rate.too_fast(since_last_ns, PERIOD_NS)
        before_ns = at_ns


def test_the_kernels_sync_never_comes_from_the_wire(followed: Followed) -> None:
    stream, _, producer, _ = followed
    producer.in_kernel = True
    pacing = FollowedSync(PERIOD_NS, producer, timeout_s=0.01, clock=stream.pacing.clock)
    stream = SyncStream(stream.network, pacing)
    next(stream)
    producer.pulse(local=False)
    next(stream)
    with pytest.raises(BusBusy, match="a SYNC"):
        next(stream)


@pytest.mark.slow
@settings(deadline=None)
@given(st.sets(st.tuples(st.integers(0, 29), st.sampled_from((0x181, 0x182))), max_size=12))
def test_after_an_answer_dropped_from_a_followed_cycle_the_next_is_doubtful(
    dropped: set[tuple[int, int]],
) -> None:
    for stream, bus, producer, _ in followed_stream():
        next(stream)

        def tamper(message: can.Message, producer: Producer = producer) -> tuple[can.Message, ...]:
            last_pulse = producer.pulses - 1
            is_dropped = (last_pulse, message.arbitration_id) in dropped
            return () if is_dropped else (message,)

        bus.tamper = tamper
        for _ in range(31):
            producer.pulse()
        samples = [stream.advance() for _ in range(30)]
        for number, sample in enumerate(samples):
            missing = 0
            for bit, cob_id in BIT_AND_COB_ID:
                of_this_pulse = (number, cob_id) in dropped
                of_pulse_before = (number - 1, cob_id) in dropped
                if of_this_pulse or of_pulse_before:
                    missing |= bit
            assert sample.missing == missing
            for axis in range(2):
                if not sample.missing >> axis & 1:
                    assert sample.position_counts[axis] == number + 1
        missing_counts = [sample.missing.bit_count() for sample in samples]
        assert stream.statistics.missing == sum(missing_counts)
        missing_difference = stream.statistics.missing - stream.statistics.late
        assert missing_difference == len(dropped)


@settings(deadline=None)
@given(st.integers(250, 100_000), st.floats(0.0, 0.1), st.floats(-0.002, 0.002))
def test_the_kernel_is_steered_to_its_period(period_us: int, late: float, noise: float) -> None:
    """Each interval becomes longer by what the timer is late:
    the schedule still keeps the period.
    """
    interval_us = period_us
    phase_ns = 0.0
    window = max(8, round(250_000 / period_us))
    late_us = late * period_us
    noise_us = noise * period_us
    for number in range(40):
        sign = 1.0 if number % 2 else -1.0
        lasts_us = interval_us + late_us + sign * noise_us
        late_ns = 1000 * window * (lasts_us - period_us)
        phase_ns += late_ns
        late_by = round(late_ns)
        phase = round(phase_ns)
        interval_us = steered_us(period_us, interval_us, late_by, phase, window)
    limit_us = 1.0 + 5 * abs(noise_us)
    limit_ns = 1000 * window * limit_us
    assert abs(phase_ns) < limit_ns


def test_frames_that_this_machine_lost_are_counted_and_reported(lockstep: Prepared) -> None:
    stream, bus, events = lockstep
    bus.losses = Losses(kernel=5)  # before the first SYNC: they do not count
    next(stream)
    bus.losses = Losses(kernel=7, backlog=1, interface=4)
    sample = next(stream)
    next(stream)
    expected = StreamStatistics(
        cycles=3, frames=6, kernel_dropped=2, backlog_dropped=1, interface_dropped=4
    )
    assert stream.statistics == expected
    reported = events_of(events, EventKind.FRAMES_DROPPED)
    counts = [event.code for event in reported]
    assert counts == [2, 4, 1]
    times_ns = {event.time_ns for event in reported}
    assert times_ns == {sample.time_ns}


@pytest.mark.parametrize("after_the_last_cycle", [False, True])
def test_frames_that_were_lost_before_the_bus_failed_are_counted(
    lockstep: Prepared, after_the_last_cycle: bool
) -> None:
    stream, bus, events = lockstep
    bus.losses = Losses()
    next(stream)
    bus.losses = Losses(kernel=2)
    bus.broken = True
    with pytest.raises(BusError, match="the wire was cut"):
        if after_the_last_cycle:
            stream.read_on(0.25)
        else:
            next(stream)
    bus.broken = False
    assert stream.statistics.kernel_dropped == 2
    (dropped,) = events_of(events, EventKind.FRAMES_DROPPED)
    assert dropped.code == 2


def test_what_is_to_be_known_of_the_bus_is_reported_at_the_start(lockstep: Prepared) -> None:
    stream, bus, events = lockstep
    bus.remarks = ("a small buffer",)
    next(stream)
    next(stream)
    (remark,) = events_of(events, EventKind.CAPTURE)
    assert remark.text == "a small buffer"


def test_a_timed_sync_has_the_kernels_time(timed: Prepared) -> None:
    """Our own SYNC comes back with it, before its answers."""
    stream, bus, _ = timed
    bus.read_until_ns = 0
    send = bus.send

    def echo(msg: can.Message, timeout: float | None = None) -> None:
        if msg.arbitration_id == 0x80:
            sync = CapturedMessage(arbitration_id=0x80, is_extended_id=False, is_rx=False)
            sync.kernel_ns = 0
            sync.local = True
            later_ns = 10 * (bus.cycle + 1)
            sync.monotonic_ns = bus.clock.now_ns + 1000 + later_ns
            bus.inject(sync)
        send(msg, timeout)

    bus.send = echo  # type: ignore[method-assign]
    samples = [next(stream) for _ in range(5)]
    expected = sync_times_ns(5, period_ns=PERIOD_NS + 10)
    assert [sample.time_ns for sample in samples] == expected
    stream_statistics = StreamStatistics(cycles=5, frames=10)
    assert stream.statistics == stream_statistics
    bus.send = send  # type: ignore[method-assign]
