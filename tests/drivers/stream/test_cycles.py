"""What every pacing shares: the time of a SYNC in the samples, the frames that wait,
and a reader that is too late.
"""

from __future__ import annotations

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen.bus import BusAddress
from drivers.canopen.link import Link
from drivers.canopen.sdo import SdoPolicy
from drivers.errors import BusError
from drivers.messages import CellEvent, EventKind
from drivers.stream.cycles import (
    FRAMES_PER_CLOCK_CHECK,
    LARGEST_LAG_NS,
    CycleBus,
    arrived_ns,
    is_sync,
)
from tests.drivers.quiet_bus import QuietBus, frame
from tests.drivers.scripted import FakeClock

START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000


class _BusOfCycles:
    """A cycle bus on a bus on which a test says what comes."""

    def __init__(self) -> None:
        self.wire = QuietBus(FakeClock())
        link = Link(BusAddress("virtual", "a"), SdoPolicy(), self.wire.clock, lambda _: self.wire)
        link.open()
        self.events: list[CellEvent] = []
        self.read: list[can.Message] = []
        self.bus = CycleBus(link, self.wire.clock, START_NS, self.events.append, self.read.append)

    def sent_ids(self) -> list[int]:
        return [message.arbitration_id for message in self.wire.sent]


@given(first_ns=st.integers(0, 10**18), later_ns=st.integers(0, 10**12))
@settings(max_examples=20)
def test_the_first_sync_is_at_the_start_and_others_as_long_after_it_as_by_the_clock(
    first_ns: int, later_ns: int
) -> None:
    bus = _BusOfCycles().bus
    bus.stamp(first_ns)
    assert bus.time_ns == START_NS
    bus.cycles = 1
    bus.stamp(first_ns + later_ns)
    assert bus.time_ns == START_NS + later_ns


def test_a_report_has_the_time_of_the_last_sync() -> None:
    made = _BusOfCycles()
    made.bus.time_ns = START_NS + 5
    made.bus.report(1, EventKind.LIMIT, 7, "a limit")
    assert made.events == [CellEvent(START_NS + 5, 1, EventKind.LIMIT, 7, "a limit")]


def test_a_reader_may_be_a_second_late_and_no_nanosecond_more() -> None:
    bus = _BusOfCycles().bus
    assert not bus.check_lag(LARGEST_LAG_NS)
    assert not bus.faults
    assert LARGEST_LAG_NS == SECOND_NS
    assert bus.check_lag(LARGEST_LAG_NS + 1)
    assert len(bus.faults) == 1


def test_a_late_reader_is_reported_once_with_its_bus_and_how_late_it_is() -> None:
    bus = _BusOfCycles().bus
    assert bus.check_lag(2_300_000_000)
    assert bus.check_lag(9_000_000_000)
    (fault,) = bus.faults
    assert isinstance(fault, BusError)
    assert str(fault).startswith("bus virtual:a: read 2.3 s late: moving axes cannot be watched")


def test_waiting_frames_are_read_in_their_order_before_the_next_sync() -> None:
    made = _BusOfCycles()
    now_ns = made.wire.clock.now_ns
    made.wire.coming = [(now_ns, frame(0x181)), (now_ns, frame(0x182))]
    made.bus.read_waiting()
    assert [message.arbitration_id for message in made.read] == [0x181, 0x182]
    assert not made.bus.faults


def test_a_reader_that_is_too_late_leaves_the_rest_and_is_a_fault() -> None:
    made = _BusOfCycles()
    now_ns = made.wire.clock.now_ns
    made.wire.coming = [(now_ns, frame(0x181)), (now_ns, frame(0x182))]
    for message in made.bus.arrived_frames():
        made.read.append(message)
        made.wire.clock.now_ns += 2 * SECOND_NS
    assert [message.arbitration_id for message in made.read] == [0x181]
    assert len(made.bus.faults) == 1


def test_frames_that_wait_are_sent_once_right_before_the_sync() -> None:
    made = _BusOfCycles()
    made.bus.outgoing.append(frame(0x201))
    made.bus.low_priority = lambda _: (frame(0x301),)
    made.bus.send_sync()
    assert made.sent_ids() == [0x201, 0x80]
    made.bus.send_sync()
    assert made.sent_ids() == [0x201, 0x80, 0x301, 0x80]


def test_spare_frames_are_asked_for_by_the_time_of_the_last_sync() -> None:
    bus = _BusOfCycles().bus
    asked_ns: list[int] = []

    def none(time_ns: int) -> tuple[can.Message, ...]:
        asked_ns.append(time_ns)
        return ()

    bus.low_priority = none
    bus.time_ns = START_NS + 3
    assert bus.take_outgoing() == ()
    assert asked_ns == [START_NS + 3]


def test_every_64th_batched_frame_is_left_for_a_look_at_the_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = _BusOfCycles()
    message = frame(0x181)
    monkeypatch.setattr(made.wire, "take", lambda: message, raising=False)
    assert made.bus.next_of_burst() is None  # not begun
    made.bus.begin()
    taken = [made.bus.next_of_burst() is message for _ in range(2 * FRAMES_PER_CLOCK_CHECK)]
    left = [number for number, is_taken in enumerate(taken, start=2) if not is_taken]
    assert left == [64, 128]


def test_a_sync_is_a_plain_frame_with_its_identifier() -> None:
    assert is_sync(frame(0x80))
    assert not is_sync(frame(0x81))
    remote = can.Message(arbitration_id=0x80, is_extended_id=False, is_remote_frame=True)
    assert not is_sync(remote)
    extended = can.Message(arbitration_id=0x80, is_extended_id=True)
    assert not is_sync(extended)


def test_a_frame_without_a_stamp_has_arrived_now() -> None:
    assert arrived_ns(frame(0x181), 42) == 42
