"""Samples do not depend on when frames are read: made-up frames with stamps, on a made-up clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen.bus import BusAddress
from drivers.canopen.network import CanopenNetwork
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
IN_TIME_NS = 300_000  #: delay of an answer well before the next SYNC
LATE_NS = PERIOD_NS + 200_000  #: delay of an answer that comes after the next SYNC
NO_FRAME_NS = 10**18  #: when a frame can be read, where none waits


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
        self.begun_ns = self.clock.now_ns
        if self.producer:
            self.begun_ns += PERIOD_NS
        super().__init__(channel="timeline")

    @property
    def read_until_ns(self) -> int:
        now_ns = self.clock.now_ns - self.begun_ns
        stopped_ns = [begin for begin, end in self.stops_ns if begin <= now_ns < end]
        return self.begun_ns + min([now_ns, *stopped_ns])

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if msg.arbitration_id == 0x80:
            if not self.syncs:
                self.begun_ns = self.clock.now_ns
            self._sync(self.clock.now_ns, is_rx=False)

    def _sync(self, at_ns: int, *, is_rx: bool) -> None:
        self._put(at_ns, 0x80, b"", is_rx=is_rx)
        self.sent_ns.append(at_ns)
        last_cycle = min(self.syncs, CYCLES - 1)
        data = self.syncs.to_bytes(4, "little") + b"\0\0\x50\x02"
        for node in self.nodes:
            delay_ns = self.delays_ns[node - 1][last_cycle]
            if delay_ns < NEVER:
                answered_ns = at_ns + 1 + delay_ns
                self._put(answered_ns, 0x180 + node, data)
        self.syncs += 1

    def _put(self, at_ns: int, identifier: int, data: bytes, *, is_rx: bool = True) -> None:
        message = CapturedMessage(
            arbitration_id=identifier, is_extended_id=False, data=data, is_rx=is_rx
        )
        message.kernel_ns = at_ns
        message.monotonic_ns = at_ns
        message.local = True
        order = len(self.sent_ns) * 10 + identifier % 0x80
        heappush(self._frames, (at_ns, order, message))

    def pause(self) -> None:
        """Stop the producer."""
        self.producer = False

    def _readable_ns(self, at_ns: int) -> int:
        since_ns = at_ns - self.begun_ns
        ends_ns = [self.begun_ns + end for begin, end in self.stops_ns if begin <= since_ns]
        return max([at_ns, *ends_ns])

    def _first_readable_ns(self) -> int:
        """When the first frame that waits can be read."""
        if not self._frames:
            return NO_FRAME_NS
        at_ns = self._frames[0][0]
        return self._readable_ns(at_ns)

    def _send_due_syncs(self, end_ns: int) -> None:
        """Send each SYNC of the producer that is due before a frame can be read."""
        while self.producer:
            due_ns = self.begun_ns + self.syncs * PERIOD_NS
            if due_ns > end_ns or self._first_readable_ns() < due_ns:
                break
            self._sync(due_ns, is_rx=True)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        end_ns = self.clock.now_ns
        if timeout:
            timeout_ns = round(timeout * 1e9)
            end_ns += max(1, timeout_ns)
        self._send_due_syncs(end_ns)
        readable_ns = self._first_readable_ns()
        if readable_ns <= end_ns:
            self.clock.now_ns = max(self.clock.now_ns, readable_ns)
            _, _, message = heappop(self._frames)
            return message
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


def _timelines(
    clock: FakeClock,
    delays_ns: Sequence[Sequence[int]],
    stops_ns: Sequence[tuple[int, int]],
    *,
    producer: bool,
    buses: int,
) -> list[Timeline]:
    """One bus with both axes, or one for each, of which the first is stopped."""
    if buses == 1:
        return [Timeline(clock, delays_ns, stops_ns, producer)]
    stopped = Timeline(clock, delays_ns, stops_ns, producer, nodes=(1,))
    other = Timeline(clock, delays_ns, (), producer, nodes=(2,))
    return [stopped, other]


def _split_bus(timelines: list[Timeline], clock: FakeClock) -> SplitBus:
    """One bus over those of both axes."""
    parts = []
    for node in (1, 2):
        name = str(node - 1)
        address = BusAddress("virtual", name)
        parts.append(BusPart(name, address, frozenset((node,))))
    return SplitBus(SplitAddress(tuple(parts)), timelines, lambda: clock.now_ns * 1e-9)


def _pacing(
    network: CanopenNetwork, timeline: Timeline, *, producer: bool
) -> FollowedSync | TimedSync:
    """Follow the producer on a timeline, or send SYNC."""
    clock = timeline.clock
    if not producer:
        network.link.sync_producer = None
        return TimedSync(PERIOD_NS, 0, clock)
    network.link.sync_producer = "J1"
    return FollowedSync(PERIOD_NS, ProducerOnTimeline(timeline), timeout_s=0.1, clock=clock)


def _faults_of(stream: SyncStream) -> list[DriverError]:
    """All faults that a stream has to report."""
    faults = []
    while True:
        try:
            stream.check()
        except DriverError as fault:
            faults.append(fault)
        else:
            return faults


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
    timelines = _timelines(clock, delays_ns, stops_ns, producer=producer, buses=buses)
    first = timelines[0]
    bus: can.BusABC = first
    if buses == 2:
        bus = _split_bus(timelines, clock)
    network.link._bus = bus
    pacing = _pacing(network, first, producer=producer)
    stream = SyncStream(network, pacing)
    samples = [stream.advance() for _ in range(CYCLES)]
    if to_the_end:
        seconds = (MAX_MISSING_CYCLES + 2) * PERIOD_NS * 1e-9
        stream.read_on(seconds, lag_s=1.0)
    statistics = stream.statistics
    faults = _faults_of(stream)
    bus.shutdown()
    return samples, statistics, faults


def _delays_ns(*late_ns: int) -> list[int]:
    """Delays of an axis that answers in time, but from the fifth cycle on with these."""
    delays_ns = [IN_TIME_NS] * CYCLES
    end = 4 + len(late_ns)
    delays_ns[4:end] = late_ns
    return delays_ns


def _bus_errors(faults: list[DriverError]) -> list[DriverError]:
    """Those of the bus."""
    return [fault for fault in faults if isinstance(fault, BusError)]


def _missing(samples: list[Sample]) -> list[int]:
    """Bits of the axes that each sample lacks."""
    return [sample.missing for sample in samples]


def _in_order(begins_and_ms: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Begin and end of stops, in the order of their begins."""
    stops_ns = []
    for begin, ms in sorted(begins_and_ms):
        end = begin + 1_000_000 * ms
        stops_ns.append((begin, end))
    return stops_ns


delays = st.one_of(
    st.integers(0, PERIOD_NS - 2000), st.integers(0, PERIOD_NS - 2000), st.just(NEVER)
)
late_too = st.one_of(delays, st.integers(PERIOD_NS, 2 * PERIOD_NS - 2000))
begins = st.integers(0, CYCLES * PERIOD_NS)
durations_ms = st.sampled_from((1, 3, 10))
stops = st.lists(st.tuples(begins, durations_ms), max_size=3).map(_in_order)


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
    assert _bus_errors(faults) == []


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
            is_late = PERIOD_NS <= before_ns < NEVER
            is_also_late = delay_ns >= PERIOD_NS
            is_overtaken = delay_ns + PERIOD_NS <= before_ns
            if is_late and (is_also_late or is_overtaken):
                of_axis[number] = before_ns - PERIOD_NS + 1000
    samples, _, _ = run(delays_ns, stops_ns, producer=producer)
    for axis in range(2):
        for sample in samples:
            is_missing = sample.missing >> axis & 1
            if not is_missing:
                assert sample.position_counts[axis] == sample.cycle


@settings(deadline=None, max_examples=15)
@given(st.lists(st.lists(delays, min_size=CYCLES, max_size=CYCLES), min_size=2, max_size=2), stops)
def test_each_bus_of_two_has_its_own_order(
    delays_ns: list[list[int]], stops_ns: list[tuple[int, int]]
) -> None:
    plain, counts, _ = run(delays_ns, (), producer=False)
    stopped, counts_stopped, _ = run(delays_ns, stops_ns, producer=False, buses=2)
    assert len(stopped) == len(plain)
    for found, expected in zip(stopped, plain, strict=True):
        assert found.cycle == expected.cycle
        assert found.position_counts == expected.position_counts
        assert found.missing == expected.missing
    assert counts_stopped == counts


def test_axes_whose_answers_are_doubtful_are_not_called_silent() -> None:
    delays_ns = _delays_ns(NEVER, NEVER, NEVER)
    _, _, faults = run([delays_ns, delays_ns], (), producer=True)
    fault_texts = [str(fault) for fault in faults if isinstance(fault, SampleLost)]
    assert fault_texts == ["cycle 7: no answer from J1 (node 1), J2 (node 2)"]


@pytest.mark.parametrize("producer", [True, False])
def test_two_answers_late_in_a_row_are_in_no_other_sample(producer: bool) -> None:
    late = _delays_ns(LATE_NS, LATE_NS)
    samples, counts, _ = run([late, late], (), producer=producer)
    assert _missing(samples) == [0, 0, 0, 0, 3, 3, 0, 0, 0, 0, 0, 0]
    position_counts = [sample.position_counts[0] for sample in samples if not sample.missing]
    assert position_counts == [0, 1, 2, 3, 6, 7, 8, 9, 10, 11]
    assert counts.missing == 4
    assert counts.duplicate == 0


@pytest.mark.parametrize("producer", [True, False], ids=["producer", "own"])
@pytest.mark.parametrize("late_ns", [200_000, 900_000, PERIOD_NS + 400_000])
def test_answers_that_stay_late_are_not_accepted(late_ns: int, producer: bool) -> None:
    late = [PERIOD_NS + late_ns] * (CYCLES - 4)
    delays_ns = [_delays_ns(*late), _delays_ns()]
    # The capture process is stopped at the end: what it has not received yet counts too.
    stops_ns = [(12_500_000, 90_000_000)]
    samples, counts, _ = run(delays_ns, stops_ns, producer=producer, to_the_end=True)
    position_counts = [sample.position_counts[1] for sample in samples]
    assert position_counts == list(range(CYCLES))
    assert counts.duplicate >= 1


@pytest.mark.parametrize("producer", [True, False], ids=["producer", "own"])
def test_an_answer_that_was_lost_is_no_reason_against_those_after_it(producer: bool) -> None:
    delays_ns = [_delays_ns(NEVER), _delays_ns()]
    samples, counts, _ = run(delays_ns, (), producer=producer, to_the_end=True)
    assert _missing(samples) == [0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0, 0]
    frames = 2 * CYCLES - 2
    assert counts == StreamStatistics(cycles=CYCLES, frames=frames, missing=2, late=1)


@pytest.mark.parametrize("producer", [True, False])
@pytest.mark.parametrize("stop_ms", [30, 100, 300])
def test_a_stop_of_many_periods_loses_nothing(stop_ms: int, producer: bool) -> None:
    sixth_ns = 5 * PERIOD_NS
    stop = (sixth_ns + 1000, sixth_ns + 1_000_000 * stop_ms)
    delays_ns = [_delays_ns(), _delays_ns()]
    samples, counts, faults = run(delays_ns, [stop], producer=producer)
    assert _missing(samples) == [0] * CYCLES
    assert counts == StreamStatistics(cycles=CYCLES, frames=2 * CYCLES)
    assert _bus_errors(faults) == []


@pytest.mark.parametrize("producer", [True, False])
def test_a_capture_process_that_stays_stopped_is_a_fault(producer: bool) -> None:
    stops_ns = [(5 * PERIOD_NS, 3 * SECOND_NS)]
    delays_ns = [[0] * CYCLES] * 2
    _, _, faults = run(delays_ns, stops_ns, producer=producer)
    assert _bus_errors(faults) != []


def test_sync_goes_out_on_schedule_while_frames_are_waited_for() -> None:
    network, scripted = cell()
    stops_ns = [(3 * PERIOD_NS, 7 * PERIOD_NS)]
    delays_ns = [[0] * CYCLES] * 2
    bus = Timeline(scripted.clock, delays_ns, stops_ns)
    network.link._bus = bus
    pacing = TimedSync(PERIOD_NS, 0, scripted.clock)
    stream = SyncStream(network, pacing)
    for _ in range(CYCLES):
        stream.advance()
    bus.shutdown()
    steps_ns = np.diff(bus.sent_ns)
    assert set(steps_ns.tolist()) == {PERIOD_NS}


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
    delays_ns = [[1000] * CYCLES] * 2
    timeline = BeatingTimeline(clock, delays_ns)
    network.link._bus = timeline
    pacing = TimedSync(PERIOD_NS, 0, clock)
    stream = SyncStream(network, pacing)
    begun_ns = clock.now_ns
    network.link.start_heartbeat(127, 3)
    for _ in range(CYCLES):
        stream.advance()
    passed_ns = clock.now_ns - begun_ns
    passed_ms = passed_ns / 1e6
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
    delays_ns = [_delays_ns(), _delays_ns()]
    timeline = TimelineWithOlderFrames(clock, delays_ns, producer=producer)
    network.link._bus = timeline
    pacing = _pacing(network, timeline, producer=producer)
    stream = SyncStream(network, pacing)
    samples = [stream.advance() for _ in range(CYCLES)]
    timeline.shutdown()
    positions = [sample.position_counts for sample in samples]
    assert positions == [(number, number) for number in range(CYCLES)]
    first_ns = samples[0].time_ns
    times_ns = [sample.time_ns - first_ns for sample in samples]
    assert times_ns == [number * PERIOD_NS for number in range(CYCLES)]
    frames = 2 * CYCLES
    foreign = len(timeline.nodes)
    assert stream.statistics == StreamStatistics(cycles=CYCLES, frames=frames, foreign=foreign)
