"""The end of a SocketCAN bus and its capture process,
with a pair of packet sockets in place of the kernel's CAN.
"""

from __future__ import annotations

import errno
import os
import signal
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, cast

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen.bus import BusAddress
from drivers.canopen.capture import RECORD, Capture, MonotonicTime, RecordKind
from drivers.canopen.link import SYNC_COB_ID, Link
from drivers.canopen.sdo import SdoPolicy
from drivers.canopen.socketcan import (
    CapturedMessage,
    Losses,
    SocketcanBus,
    lags_behind,
    losses_of,
    open_socketcan,
    remarks_of,
)
from drivers.errors import BusError
from drivers.messages import EventKind
from tests.drivers.scripted import FakeClock, cell

ADDRESS = BusAddress("socketcan", "pair")
WAIT_S = 10.0
FRAME = struct.Struct("=IB3x8s")
NO_INTERFACE = "no-such-interface"
Pair = tuple[SocketcanBus, socket.socket]

u64 = st.integers(0, 2**64 - 1)
times = st.integers(-(2**63), 2**63 - 1)
records = st.tuples(
    times,
    times,
    u64,
    u64,
    u64,
    st.integers(0, 2**32 - 1),
    st.sampled_from(RecordKind).map(int),
    st.integers(0, 8),
    st.booleans(),
    st.booleans(),
    st.binary(min_size=8, max_size=8),
)


@pytest.fixture
def pair() -> Iterator[Pair]:
    """A bus whose wire is the other socket."""
    ours, wire = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with wire:
        bus = SocketcanBus(NO_INTERFACE, ours)
        yield bus, wire
        bus.shutdown()


def received(bus: SocketcanBus) -> CapturedMessage:
    message = bus.recv(WAIT_S)
    assert isinstance(message, CapturedMessage)
    return message


@given(records)
def test_a_record_comes_out_as_it_went_in(record: tuple[object, ...]) -> None:
    assert RECORD.unpack(RECORD.pack(*record)) == record


def test_a_frame_that_was_queued_before_drops_does_not_lower_their_count(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wire, bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    out, parent = socket.socketpair()
    with wire, bus, out, parent:
        capture = Capture(bus, out, NO_INTERFACE)
        counts = iter((7, 5, 9))
        monkeypatch.setattr(
            capture._batch, "metadata", lambda _number: (FRAME.size, 0, 1, next(counts))
        )
        for total in (7, 7, 9):
            wire.send(FRAME.pack(0x181, 0, bytes(8)))
            assert capture.receive() == 0
            assert capture._losses[0] == total


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 10**9), st.integers(0, 10**7)), min_size=1, max_size=30),
    st.integers(0, 29),
    st.integers(-(10**15), 10**15),
)
def test_no_setting_of_the_wall_clock_moves_a_stamp(
    frames: list[tuple[int, int]], when: int, jump_ns: int
) -> None:
    """Each frame comes some time after the last and waits to be read;
    once the clock is set while one waits.
    """
    now_ns = offset_ns = last_ns = 10**18
    wall_ns = now_ns + offset_ns
    time = MonotonicTime(wall_ns, now_ns)
    for number, (gap_ns, wait_ns) in enumerate(frames):
        true_ns = now_ns + gap_ns
        stamp_ns = true_ns + offset_ns
        now_ns = true_ns + wait_ns
        offset_ns += jump_ns if number == when else 0
        found_ns = time.convert(stamp_ns, now_ns + offset_ns, now_ns)
        assert last_ns <= found_ns <= now_ns
        # A step that could as well be time that has passed since the last frame cannot be
        # distinguished from it.
        if number == when and abs(jump_ns) <= gap_ns + wait_ns + 10**6:
            doubt_ns = abs(jump_ns)
        else:
            doubt_ns = 0
        assert abs(found_ns - true_ns) <= doubt_ns
        last_ns = found_ns


frames = st.builds(
    lambda extended, remote, number, data: can.Message(
        arbitration_id=number if extended else number & 0x7FF,
        is_extended_id=extended,
        is_remote_frame=remote,
        data=b"" if remote else data,
        dlc=len(data),
    ),
    st.booleans(),
    st.booleans(),
    st.integers(0, 0x1FFF_FFFF),
    st.binary(max_size=8),
)


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(st.lists(frames, min_size=1, max_size=20))
def test_what_is_sent_is_what_the_other_end_receives(burst: list[can.Message]) -> None:
    # Two buses over one wire: what the first packs the second unpacks.
    ours, wire = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    first = SocketcanBus(NO_INTERFACE, ours)
    second = SocketcanBus(NO_INTERFACE, wire)
    for frame in burst:
        first.send(frame)
    for frame in burst:
        assert received(second).equals(
            frame, timestamp_delta=None, check_channel=False, check_direction=False
        )
    assert second.recv(0.0) is None
    first.shutdown()
    second.shutdown()


def test_stamps_are_whole_nanoseconds_that_never_go_back(pair: Pair) -> None:
    bus, wire = pair
    for number in range(300):
        wire.send(FRAME.pack(0x181, 2, number.to_bytes(8, "little")))
    messages = [received(bus) for _ in range(300)]
    expected = list(range(300))
    assert [int.from_bytes(message.data, "little") for message in messages] == expected
    stamps = [message.monotonic_ns for message in messages]
    for stamp in stamps:
        assert type(stamp) is int
    assert stamps == sorted(stamps)
    assert losses_of(bus) == Losses()
    assert remarks_of(bus) == ()


def test_a_stamp_of_0_is_a_stamp(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only a frame without any stamp gets the time at which it was read."""
    wire, bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    out, parent = socket.socketpair()
    with wire, bus, out, parent:
        capture = Capture(bus, out, NO_INTERFACE)
        stamps = iter((0, None))
        monkeypatch.setattr(
            capture._batch, "metadata", lambda _number: (FRAME.size, 0, next(stamps), None)
        )
        for _ in range(2):
            wire.send(FRAME.pack(0x181, 0, bytes(8)))
        before_ns = time.time_ns()
        assert capture.receive() == 0
        assert capture.forward()
        timeout = 1 << 20
        records = RECORD.iter_unpack(parent.recv(timeout))
        stamped_ns, unstamped_ns = (record[0] for record in records)
    assert stamped_ns == 0
    assert unstamped_ns >= before_ns


@pytest.mark.parametrize(
    ("until_ns", "behind"),
    [(0, True), (4, True), (5, False), (None, False)],
    ids=["nothing yet", "4", "5", "no stamps"],
)
def test_a_bus_is_behind_until_it_has_read_to_a_time(until_ns: int | None, behind: bool) -> None:
    bus = SimpleNamespace(read_until_ns=until_ns)
    lags = lags_behind(cast("can.BusABC", bus), 5)
    assert lags is behind


def test_a_full_backlog_is_counted_to_the_frame() -> None:
    """Without a reader, frames beyond the backlog and the pair are lost,
    and the next record carries their count.
    """
    wire, bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    out, parent = socket.socketpair()
    sent = 0
    with wire, bus, out, parent:
        capture = Capture(bus, out, NO_INTERFACE, backlog_records=10)
        for _ in range(2000):
            for _ in range(8):
                wire.send(FRAME.pack(0x181, 0, bytes(8)))
            sent += 8
            assert capture.receive() == 0
            assert capture.forward()
        parent.setblocking(False)
        chunks = b""
        while capture.forward():
            try:
                timeout = 1 << 20
                chunks += parent.recv(timeout)
            except BlockingIOError:
                break
        reported = list(RECORD.iter_unpack(chunks))
        got = sum(kind == RecordKind.FRAME for *_, kind, _length, _own, _local, _data in reported)
        assert got < sent
        lost = [backlog_dropped for _, _, _, _, backlog_dropped, *_ in reported]
        assert got + lost[-1] == sent
        assert lost == sorted(lost)


def test_a_capture_process_that_dies_is_named(pair: Pair) -> None:
    bus, wire = pair
    wire.send(FRAME.pack(0x181, 0, bytes(8)))
    assert received(bus).arbitration_id == 0x181
    os.kill(bus.capture_pid, signal.SIGKILL)
    with pytest.raises(can.CanOperationError, match=r"capture process ended by itself \(-9\)"):
        bus.recv(WAIT_S)
    with pytest.raises(can.CanOperationError, match="capture process ended"):
        bus.recv(0.0)


def test_an_interface_that_goes_is_named_after_its_last_frames() -> None:
    ours, wire = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    bus = SocketcanBus(NO_INTERFACE, ours)
    wire.send(FRAME.pack(0x181, 0, bytes(8)))
    wire.close()
    assert received(bus).arbitration_id == 0x181
    with pytest.raises(can.CanOperationError, match="interface is gone \\(ENODEV\\)"):
        bus.recv(WAIT_S)
    bus.shutdown()


def test_an_interrupt_while_records_are_read_loses_and_misaligns_none(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, wire = pair
    make = bus._message
    calls = 0

    def interrupted(*fields: Any) -> CapturedMessage:
        nonlocal calls
        calls += 1
        if calls in (1, 3):
            raise KeyboardInterrupt
        return make(*fields)

    monkeypatch.setattr(bus, "_message", interrupted)
    for number in range(20):
        wire.send(FRAME.pack(0x181, 1, bytes((number,)) * 8))
    got: list[int] = []
    while len(got) < 20:
        with suppress(KeyboardInterrupt):
            got.append(received(bus).data[0])
    assert got == list(range(20))
    assert calls > 20


def test_ctrl_c_does_not_end_the_capture(pair: Pair) -> None:
    bus, wire = pair
    assert os.getsid(bus.capture_pid) != os.getsid(0)
    os.kill(bus.capture_pid, signal.SIGINT)
    wire.send(FRAME.pack(0x181, 0, bytes(8)))
    assert received(bus).arbitration_id == 0x181


def test_shutdown_ends_the_capture(pair: Pair) -> None:
    bus, _ = pair
    bus.shutdown()
    with pytest.raises(ProcessLookupError):
        os.kill(bus.capture_pid, 0)
    with pytest.raises(can.CanOperationError):
        bus.recv(0.0)
    bus.shutdown()


def _dispatch(*frames: bytes) -> Link:
    """A link that has heard these frames."""
    ours, wire = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    link = Link(
        ADDRESS, SdoPolicy(), FakeClock(), lambda _address: SocketcanBus(NO_INTERFACE, ours)
    )
    link.open()
    with wire:
        for frame in frames:
            wire.send(frame)
        try:
            for _ in frames:
                link.pump(WAIT_S)
        finally:
            link.close()
    return link


def _error_frame(kind: int, controller: int = 0) -> bytes:
    return FRAME.pack(0x2000_0000 | kind, 8, bytes((0, controller, 0, 0, 0, 0, 0, 0)))


def test_bus_off_ends_it() -> None:
    with pytest.raises(BusError, match="bus-off"):
        _dispatch(_error_frame(0x40))


@pytest.mark.parametrize(
    ("frame", "kind", "says"),
    [
        (_error_frame(0x4, 0x10), EventKind.BUS_PASSIVE, "error passive"),
        (_error_frame(0x4, 0x20), EventKind.BUS_PASSIVE, "error passive"),
        (_error_frame(0x4, 0x01), EventKind.CONTROLLER, "overflows"),
        (_error_frame(0x4, 0x08), EventKind.CONTROLLER, "counts errors"),
        (_error_frame(0x4, 0x40), EventKind.CONTROLLER, "recovered"),
        (_error_frame(0x100), EventKind.CONTROLLER, "restarted"),
    ],
)
def test_what_the_controller_says_of_itself_is_an_event(
    frame: bytes, kind: EventKind, says: str
) -> None:
    (event,) = _dispatch(frame).take_events(5, ())
    assert event.kind == kind
    assert event.axis is None
    assert event.time_ns == 5
    assert says in event.text


def test_a_sync_of_another_client_is_foreign_until_we_asked_for_it() -> None:
    frame = FRAME.pack(SYNC_COB_ID, 0, bytes(8))
    assert _dispatch(frame).foreign == {SYNC_COB_ID: 1}


@pytest.mark.parametrize("number", [errno.ENOBUFS, errno.EAGAIN])
def test_a_full_transmit_queue_is_waited_for_and_then_named(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    bus, _ = pair
    tries = 0

    class Full:
        def send(self, _frame: bytes, flags: int) -> int:
            assert flags & socket.MSG_DONTWAIT
            nonlocal tries
            tries += 1
            if tries == 3:
                return 16
            raise OSError(number, "full")

    monkeypatch.setattr(bus, "_can_socket", Full())
    message = can.Message(arbitration_id=1, is_extended_id=False)
    bus.send(message)
    assert tries == 3
    with pytest.raises(can.CanOperationError, match="does any node acknowledge"):
        bus.send(can.Message(arbitration_id=1, is_extended_id=False), timeout=0.001)
    monkeypatch.undo()


def test_the_filter_passes_all_that_is_watched(monkeypatch: pytest.MonkeyPatch) -> None:
    network, bus = cell(2)
    filters = list[tuple[int, int]]()
    monkeypatch.setattr(bus, "receive_only", filters.extend, raising=False)
    with network:
        network.prepare()
    commands = {0x000, 0x080, 0x7E4, 0x7E5, *range(0x601, 0x680)}
    of_axes = set()
    for service in (0x080, *range(0x180, 0x600, 0x80), 0x700):
        for node in (1, 2):
            of_axes.add(service + node)
    services = range(0x080, 0x780, 0x80)
    own = {service + network.recorder_id for service in services}
    passed = set()
    for number in range(0x800):
        if any((number ^ wanted) & mask == 0 for wanted, mask in filters):
            passed.add(number)
    found = (commands | of_axes | own) - passed
    assert found == set()
    assert {
        0x181 + 0x20,
        0x732,
        0x7F0,
    } & passed == set()  # of other devices


def test_an_interface_that_is_not_there() -> None:
    with pytest.raises(OSError):
        open_socketcan(NO_INTERFACE)
