"""Samples do not depend on when frames are read: made-up frames with stamps, on a made-up clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen.bus import BusAddress
from drivers.canopen.socketcan import CapturedMessage
from drivers.canopen.split_bus import BusPart, SplitAddress, SplitBus
from drivers.errors import BusError, DriverError, SampleLost
from drivers.messages import Sample
from drivers.stream.answers import StreamStatistics
from drivers.stream.stream import MAX_MISSING_CYCLES, SyncStream
from drivers.stream.sync import FollowedSync, Producer, TimedSync
from tests.drivers.scripted import PERIOD_NS, FakeClock, cell

CYCLES = 12
NEVER = 10**12
SECOND_NS = 1_000_000_000


@dataclass
class Timeline(can.BusABC):
    """A bus whose frames have their times, with a capture process that is stopped now and then.

    Attributes:
        clock: advances only while a caller waits.
        delays_ns: of the answers of each axis to each SYNC; later than a period, they come after
            the next SYNC.
        stops_ns: begin and end of the times, since the first SYNC, in which the capture process is
            stopped.
        producer: SYNC comes by itself.
        nodes: that are on this bus.
    """

    clock: FakeClock
    delays_ns: Sequence[Sequence[int]]
    stops_ns: Sequence[tuple[int, int]] = ()
    producer: bool = False
    nodes: Sequence[int] = (1, 2)
    begun_ns: int = 0
    syncs: int = 0
    sent_ns: list[int] = field(default_factory=list)
    _frames: list[tuple[int, int, CapturedMessage]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.begun_ns = self.clock.now_ns + (PERIOD_NS if self.producer else 0)
        super().__init__(channel="timeline")

    @property
    def read_until_ns(self) -> int:
        now_ns = self.clock.now_ns - self.begun_ns
        return self.begun_ns + min(
            [now_ns, *(begin for begin, end in self.stops_ns if begin <= now_ns < end)]
        )

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if msg.arbitration_id == 0x80:
            if not self.syncs:
                self.begun_ns = self.clock.now_ns
            self._sync(self.clock.now_ns, is_rx=False)

    def _sync(self, at_ns: int, *, is_rx: bool) -> None:
        self._put(at_ns, 0x80, b"", is_rx=is_rx)
        self.sent_ns.append(at_ns)
        for node in self.nodes:
            smallest_sync = min(self.syncs, CYCLES - 1)
            delay_ns = self.delays_ns[node - 1][smallest_sync]
            data = self.syncs.to_bytes(4, "little") + b"\0\0\x50\x02"
            if delay_ns < NEVER:
                self._put(at_ns + 1 + delay_ns, 0x180 + node, data)
        self.syncs += 1

    def _put(self, at_ns: int, identifier: int, data: bytes, *, is_rx: bool = True) -> None:
        message = CapturedMessage(
            arbitration_id=identifier, is_extended_id=False, data=data, is_rx=is_rx
        )
        message.kernel_ns = at_ns
        message.monotonic_ns = at_ns
        message.local = True
        heappush(self._frames, (at_ns, len(self.sent_ns) * 10 + identifier % 0x80, message))

    def pause(self) -> None:
        """Stop the producer."""
        self.producer = False

    def _readable_ns(self, at_ns: int) -> int:
        return max(
            [
                at_ns,
                *(
                    self.begun_ns + end
                    for begin, end in self.stops_ns
                    if begin <= at_ns - self.begun_ns
                ),
            ]
        )

    def recv(self, timeout: float | None = None) -> can.Message | None:
        end_ns = self.clock.now_ns + (max(1, round(timeout * 1e9)) if timeout else 0)
        while self.producer and (due_ns := self.begun_ns + self.syncs * PERIOD_NS) <= end_ns:
            if self._frames and self._readable_ns(self._frames[0][0]) < due_ns:
                break
            self._sync(due_ns, is_rx=True)
        if self._frames and (readable_ns := self._readable_ns(self._frames[0][0])) <= end_ns:
            self.clock.now_ns = max(self.clock.now_ns, readable_ns)
            return heappop(self._frames)[2]
        self.clock.now_ns = end_ns
        return None


class ProducerOnTimeline(Producer):
    """The axis that sends SYNC by itself on such a bus."""

    def __init__(self, timeline: Timeline) -> None:
        super().__init__("J1", PERIOD_NS // 1000)
        self._timeline = timeline

    def pause(self) -> None:
        """Stop it at once."""
        self._timeline.pause()


def run(
    delays_ns: Sequence[Sequence[int]],
    stops_ns: Sequence[tuple[int, int]],
    *,
    producer: bool,
    buses: int = 1,
    to_the_end: bool = False,
) -> tuple[list[Sample], StreamStatistics, list[DriverError]]:
    """Samples, statistics and faults of the bus of a stream;
    on two buses the capture process of the first stops.
    """
    network, scripted = cell()
    clock = scripted.clock
    faults = list[DriverError]()
    ends = []
    for number in range(buses):
        ends.append(
            Timeline(
                clock,
                delays_ns,
                () if number else stops_ns,
                producer,
                (1, 2) if buses == 1 else (number + 1,),
            )
        )
    bus: can.BusABC = ends[0]
    if buses == 2:
        parts = []
        for n in range(2):
            node_ids = frozenset((n + 1,))
            parts.append(BusPart(f"{n}", BusAddress("virtual", f"{n}"), node_ids))
        address = SplitAddress(tuple(parts))
        bus = SplitBus(address, ends, lambda: clock.now_ns * 1e-9)
    network.link._bus = bus
    network.link.sync_producer = "J1" if producer else None
    producer_on_timeline = ProducerOnTimeline(ends[0])
    followed = FollowedSync(PERIOD_NS, producer_on_timeline, timeout_s=0.1, clock=clock)
    pacing = followed if producer else TimedSync(PERIOD_NS, 0, clock)
    stream = SyncStream(network, pacing)
    samples = [stream.advance() for _ in range(CYCLES)]
    if to_the_end:
        seconds = (MAX_MISSING_CYCLES + 2) * PERIOD_NS * 1e-9
        stream.read_on(seconds, lag_s=1.0)
    found = stream.statistics
    while True:
        try:
            stream.check()
        except DriverError as fault:
            faults.append(fault)
        else:
            break
    bus.shutdown()
    return samples, found, faults


delays = st.one_of(
    st.integers(0, PERIOD_NS - 2000), st.integers(0, PERIOD_NS - 2000), st.just(NEVER)
)
late_too = st.one_of(delays, st.integers(PERIOD_NS, 2 * PERIOD_NS - 2000))
stops = st.lists(
    st.tuples(st.integers(0, CYCLES * PERIOD_NS), st.sampled_from((1, 3, 10))), max_size=3
).map(lambda found: [(begin, begin + 1_000_000 * ms) for begin, ms in sorted(found)])  # fmt: skip


@settings(deadline=None, max_examples=15)
@given(
    st.lists(st.lists(late_too, min_size=CYCLES, max_size=CYCLES), min_size=2, max_size=2),
    stops,
    st.booleans(),
)
def test_a_capture_process_that_is_stopped_changes_no_sample(
    delays_ns: list[list[int]], stops_ns: list[tuple[int, int]], producer: bool
) -> None:
    plain, counts, _ = run(delays_ns, (), producer=producer)
    stopped, counts_stopped, faults = run(delays_ns, stops_ns, producer=producer)
    assert stopped == plain
    assert counts_stopped == counts
    assert [fault for fault in faults if isinstance(fault, BusError)] == []


@settings(deadline=None, max_examples=15)
@given(
    st.lists(st.lists(late_too, min_size=CYCLES, max_size=CYCLES), min_size=2, max_size=2),
    stops,
    st.booleans(),
)
def test_no_sample_without_its_bit_holds_another_cycles_answer(
    delays_ns: list[list[int]], stops_ns: list[tuple[int, int]], producer: bool
) -> None:
    # No queue of answers: a late one is followed by one in time.
    for of_axis in delays_ns:
        for number, delay_ns in enumerate(of_axis[1:], start=1):
            before_ns = of_axis[number - 1]
            if PERIOD_NS <= before_ns < NEVER and (
                delay_ns >= PERIOD_NS or delay_ns + PERIOD_NS <= before_ns
            ):
                of_axis[number] = before_ns - PERIOD_NS + 1000
    samples, _, _ = run(delays_ns, stops_ns, producer=producer)
    for axis in range(2):
        for sample in samples:
            if not sample.missing >> axis & 1:
                assert sample.position_counts[axis] == sample.cycle


@settings(deadline=None, max_examples=15)
@given(st.lists(st.lists(delays, min_size=CYCLES, max_size=CYCLES), min_size=2, max_size=2), stops)
def test_each_bus_of_two_has_its_own_order(
    delays_ns: list[list[int]], stops_ns: list[tuple[int, int]]
) -> None:
    plain, counts, _ = run(delays_ns, (), producer=False)
    stopped, counts_stopped, _ = run(delays_ns, stops_ns, producer=False, buses=2)
    expected = [(s.cycle, s.position_counts, s.missing) for s in plain]
    assert [(s.cycle, s.position_counts, s.missing) for s in stopped] == expected
    assert counts_stopped == counts


def test_axes_whose_answers_are_doubtful_are_not_called_silent() -> None:
    delays_ns = [300_000] * 4 + [NEVER] * 3 + [300_000] * (CYCLES - 7)
    _, _, faults = run([delays_ns] * 2, (), producer=True)
    fault_texts = [str(fault) for fault in faults if isinstance(fault, SampleLost)]
    assert fault_texts == ["cycle 7: no answer from J1 (node 1), J2 (node 2)"]


@pytest.mark.parametrize("producer", [True, False])
def test_two_answers_late_in_a_row_are_in_no_other_sample(producer: bool) -> None:
    late = [300_000] * 4 + [PERIOD_NS + 200_000, PERIOD_NS + 200_000] + [300_000] * (CYCLES - 6)
    delays_ns = [late] * 2
    samples, counts, _ = run(delays_ns, (), producer=producer)
    expected = [0] * 4 + [3, 3] + [0] * (CYCLES - 6)
    assert [sample.missing for sample in samples] == expected
    position_counts = [sample.position_counts[0] for sample in samples if not sample.missing]
    assert position_counts == [
        0,
        1,
        2,
        3,
        *range(6, CYCLES),
    ]
    assert (counts.missing, counts.duplicate) == (4, 0)


@pytest.mark.parametrize("producer", [True, False], ids=["producer", "own"])
@pytest.mark.parametrize("late_ns", [200_000, 900_000, PERIOD_NS + 400_000])
def test_answers_that_stay_late_are_not_accepted(late_ns: int, producer: bool) -> None:
    delays_ns = [[300_000] * 4 + [PERIOD_NS + late_ns] * (CYCLES - 4), [300_000] * CYCLES]
    # The capture process is stopped at the end: what it has not received yet counts too.
    stops_ns = [(12_500_000, 90_000_000)]
    samples, counts, _ = run(delays_ns, stops_ns, producer=producer, to_the_end=True)
    position_counts = [sample.position_counts[1] for sample in samples]
    assert position_counts == list(range(CYCLES))
    assert counts.duplicate >= 1


@pytest.mark.parametrize("producer", [True, False], ids=["producer", "own"])
def test_an_answer_that_was_lost_is_no_reason_against_those_after_it(producer: bool) -> None:
    delays_ns = [[300_000] * 4 + [NEVER] + [300_000] * (CYCLES - 5), [300_000] * CYCLES]
    samples, counts, _ = run(delays_ns, (), producer=producer, to_the_end=True)
    expected = [0] * 4 + [1, 1] + [0] * (CYCLES - 6)
    assert [sample.missing for sample in samples] == expected
    frames = 2 * CYCLES - 2
    stream_statistics = StreamStatistics(cycles=CYCLES, frames=frames, missing=2, late=1)
    assert counts == stream_statistics


@pytest.mark.parametrize("producer", [True, False])
@pytest.mark.parametrize("stop_ms", [30, 100, 300])
def test_a_stop_of_many_periods_loses_nothing(stop_ms: int, producer: bool) -> None:
    stop = (5 * PERIOD_NS + 1000, 5 * PERIOD_NS + 1_000_000 * stop_ms)
    delays_ns = [[300_000] * CYCLES] * 2
    samples, counts, faults = run(delays_ns, [stop], producer=producer)
    expected = [0] * CYCLES
    assert [sample.missing for sample in samples] == expected
    frames = 2 * CYCLES
    stream_statistics = StreamStatistics(cycles=CYCLES, frames=frames)
    assert counts == stream_statistics
    assert [fault for fault in faults if isinstance(fault, BusError)] == []


@pytest.mark.parametrize("producer", [True, False])
def test_a_capture_process_that_stays_stopped_is_a_fault(producer: bool) -> None:
    stops_ns = [(5 * PERIOD_NS, 3 * SECOND_NS)]
    delays_ns = [[0] * CYCLES] * 2
    _, _, faults = run(delays_ns, stops_ns, producer=producer)
    assert any(isinstance(fault, BusError) for fault in faults)


def test_sync_goes_out_on_schedule_while_frames_are_waited_for() -> None:
    network, scripted = cell()
    stops_ns = [(3 * PERIOD_NS, 7 * PERIOD_NS)]
    delays_ns = [[0] * CYCLES] * 2
    network.link._bus = bus = Timeline(scripted.clock, delays_ns, stops_ns)
    pacing = TimedSync(PERIOD_NS, 0, scripted.clock)
    stream = SyncStream(network, pacing)
    for _ in range(CYCLES):
        stream.advance()
    bus.shutdown()
    steps = {after - before for before, after in zip(bus.sent_ns, bus.sent_ns[1:], strict=False)}
    assert steps == {PERIOD_NS}


class BeatingTimeline(Timeline):
    """A timeline that counts the heartbeats of the recorder, whose node id is 127."""

    beats = 0

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if msg.arbitration_id == 0x77F:
            self.beats += 1
        super().send(msg, timeout)


def test_our_heartbeat_goes_on_while_sync_comes_back() -> None:
    network, scripted = cell()
    clock = scripted.clock
    timeline = BeatingTimeline(clock, [[1000] * CYCLES, [1000] * CYCLES])
    network.link._bus = timeline
    stream = SyncStream(network, TimedSync(PERIOD_NS, 0, clock))
    begun_ns = clock.now_ns
    network.link.start_heartbeat(127, 3)
    for _ in range(CYCLES):
        stream.advance()
    passed_ms = (clock.now_ns - begun_ns) / 1e6
    timeline.shutdown()
    assert passed_ms > 10.0
    assert timeline.beats == pytest.approx(passed_ms / 3.0, abs=1.0)


class TimelineWithOlderFrames(Timeline):
    """A timeline whose capture process hands over a SYNC and its answers a moment too late:
    they are older than the stream, and come after it has begun.
    """

    OLD_NS = 12 * PERIOD_NS
    LAG_NS = 100_000
    OLD_ANSWER = bytes((99, 0, 0, 0)) + b"\0\0\x50\x02"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.opened_ns = self.clock.now_ns
        at_ns = self.opened_ns - self.OLD_NS
        self._put(at_ns, 0x80, b"", is_rx=self.producer)
        for node in self.nodes:
            self._put(at_ns + 1, 0x180 + node, self.OLD_ANSWER)

    def _readable_ns(self, at_ns: int) -> int:
        if at_ns < self.opened_ns:
            return self.opened_ns + self.LAG_NS
        return super()._readable_ns(at_ns)


@pytest.mark.parametrize("producer", [True, False], ids=["producer", "own"])
def test_a_sync_from_before_the_stream_that_is_handed_over_late_begins_no_cycle(
    producer: bool,
) -> None:
    network, scripted = cell()
    clock = scripted.clock
    timeline = TimelineWithOlderFrames(clock, [[300_000] * CYCLES] * 2, producer=producer)
    network.link._bus = timeline
    network.link.sync_producer = "J1" if producer else None
    pacing: FollowedSync | TimedSync = TimedSync(PERIOD_NS, 0, clock)
    if producer:
        pacing = FollowedSync(PERIOD_NS, ProducerOnTimeline(timeline), 0.1, clock=clock)
    stream = SyncStream(network, pacing)
    samples = [stream.advance() for _ in range(CYCLES)]
    timeline.shutdown()
    positions = [sample.position_counts for sample in samples]
    assert positions == [(number, number) for number in range(CYCLES)]
    times_ns = [sample.time_ns - samples[0].time_ns for sample in samples]
    assert times_ns == [number * PERIOD_NS for number in range(CYCLES)]
    foreign = len(timeline.nodes)
    assert stream.statistics == StreamStatistics(cycles=CYCLES, frames=2 * CYCLES, foreign=foreign)
