"""The buses: one contract for all, and what each may do wrong."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from queue import Queue, SimpleQueue
from typing import cast

import can
import pytest
from can.interfaces.socketcand import SocketCanDaemonBus
from can.interfaces.virtual import VirtualBus
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.canopen.bus import BusAddress, SocketcandBus, VirtualEnd, open_bus
from drivers.canopen.link import Link
from drivers.canopen.sdo import SdoPolicy
from drivers.errors import BusError
from drivers.simulation.hub import HOST, Hub
from tests.drivers.bus_contract import WAIT_S, BusContract, Ends, same
from tests.drivers.raw_client import raw_client
from tests.drivers.scripted import FakeClock

LONG_S = 2.0  #: A step of the clock, and so the wait that it led to


def three_ends(address: BusAddress) -> Iterator[Ends]:
    ends = open_bus(address), open_bus(address), open_bus(address)
    try:
        yield ends
    finally:
        for end in ends:
            end.shutdown()


class TestVirtual(BusContract):
    @pytest.fixture
    def ends(self, request: pytest.FixtureRequest) -> Iterator[Ends]:
        address = BusAddress("virtual", request.node.nodeid)
        yield from three_ends(address)


@contextmanager
def _own(_monkeypatch: pytest.MonkeyPatch) -> Iterator[can.BusABC]:
    address = BusAddress("virtual", "clock set back")
    with open_bus(address) as end:
        yield end


@contextmanager
def _of_a_hub(_monkeypatch: pytest.MonkeyPatch) -> Iterator[can.BusABC]:
    with Hub(("can0",)) as hub, open_bus(hub.address()) as end:
        yield end


@contextmanager
def _foreign(monkeypatch: pytest.MonkeyPatch) -> Iterator[can.BusABC]:
    """An interface of python-can that drivegain has no class for."""
    monkeypatch.setattr(can, "Bus", lambda **_: VirtualBus("clock set back, foreign"))
    address = BusAddress("pcan", "PCAN_USBBUS1")
    with open_bus(address) as end:
        yield end


@pytest.mark.parametrize("opened", [_own, _of_a_hub, _foreign])
def test_a_wait_does_not_become_longer_when_the_wall_clock_is_set_back(
    monkeypatch: pytest.MonkeyPatch,
    opened: Callable[[pytest.MonkeyPatch], AbstractContextManager[can.BusABC]],
) -> None:
    """python-can waits by the wall clock: SYNC was not sent until the next frame came."""
    with opened(monkeypatch) as end:
        true_s = iter([time.monotonic()])
        monkeypatch.setattr("can.bus.time", lambda: next(true_s, time.monotonic() - LONG_S))
        begun_s = time.monotonic()
        assert end.recv(timeout=0.05) is None
        waited_s = time.monotonic() - begun_s
        assert 0.05 <= waited_s < LONG_S / 2


class _Flood(SimpleQueue[can.Message]):
    """A queue that fills faster than it is read."""

    def get_nowait(self) -> can.Message:
        message = can.Message(arbitration_id=0x7F, is_extended_id=False)
        self.put(message)
        assert self.qsize() < 1000, "a reader that never ends"
        self.put(can.Message(arbitration_id=0x7F, is_extended_id=False))
        return super().get_nowait()


def test_a_flood_does_not_keep_a_reader() -> None:
    address = BusAddress("virtual", "flooded")
    with open_bus(address) as end:
        assert isinstance(end, VirtualEnd)
        end.channel.remove(end.queue)
        end.queue = cast("Queue[can.Message]", _Flood())
        end.channel.append(end.queue)
        for _ in range(3):
            message = can.Message(arbitration_id=0x81, is_extended_id=False)
            end.queue.put(message)
        arbitration_ids = [
            frame.arbitration_id for frame in (end.recv(0.0), end.recv(0.0)) if frame
        ]
        assert arbitration_ids == [
            0x81,
            0x81,
        ]


def test_an_end_of_python_cans_own_is_on_the_same_bus() -> None:
    frame = can.Message(arbitration_id=0x81, is_extended_id=False, data=b"\x01\xab")
    with (
        can.Bus(interface="virtual", channel="mixed") as theirs,
        open_bus(BusAddress("virtual", "mixed")) as ours,
    ):
        ours.send(frame)
        assert same(theirs.recv(WAIT_S), frame)
        theirs.send(frame)
        assert same(ours.recv(WAIT_S), frame)


def test_a_frame_that_changes_after_it_was_sent_arrives_as_it_was_sent() -> None:
    address = BusAddress("virtual", "changed")
    with open_bus(address) as near, open_bus(address) as far:
        frame = can.Message(arbitration_id=0x81, is_extended_id=False, data=b"\x01")
        near.send(frame)
        frame.data[0], frame.arbitration_id = 2, 0x82
        heard = far.recv(WAIT_S)
    assert heard is not None
    expected = (0x81, b"\x01", True, "changed")
    assert (heard.arbitration_id, bytes(heard.data), heard.is_rx, heard.channel) == expected
    with pytest.raises(can.CanOperationError, match="closed"):
        far.recv(0.0)
    with pytest.raises(can.CanOperationError, match="closed"):
        near.send(frame)


class TestHub(BusContract):
    @pytest.fixture
    def ends(self) -> Iterator[Ends]:
        with Hub(("can0",)) as hub:
            yield from three_ends(hub.address())


def test_channels_of_a_hub_are_buses_of_their_own() -> None:
    with Hub(("left", "right")) as hub:
        left, other, right = (open_bus(hub.address(name)) for name in ("left", "left", "right"))
        message = can.Message(arbitration_id=1, is_extended_id=False)
        left.send(message)
        assert other.recv(WAIT_S) is not None
        assert right.recv(0.0) is None
        for end in (left, other, right):
            end.shutdown()


def test_an_unknown_channel_is_refused_with_the_known_ones() -> None:
    with Hub(("can0",)) as hub, pytest.raises(BusError, match=r"no bus can1, there is can0"):
        open_bus(hub.address("can1"))


def test_a_closed_hub_does_not_look_like_silence() -> None:
    with Hub(("can0",)) as hub:
        link = Link(hub.address(), SdoPolicy(), FakeClock())
        link.open()
    with pytest.raises(BusError, match="closed the connection"):
        link.pump(WAIT_S)
    link.close()


def test_no_one_listens() -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        port = taken.getsockname()[1]
        address = BusAddress("socketcand", "can0", port=port)
        with pytest.raises(BusError, match=str(port)):
            open_bus(address)
        taken.listen()
        with (
            pytest.raises(BusError, match=f"{port}: .*another hub runs on this port"),
            Hub(("can0",), port=port),
        ):
            pass


def test_an_unknown_interface_is_a_bus_error() -> None:
    with pytest.raises(BusError, match="carrier-pigeon"):
        open_bus(BusAddress("carrier-pigeon", "can0"))


def test_a_hub_that_does_not_run_has_no_address() -> None:
    with pytest.raises(BusError, match="not running"):
        Hub(("can0",)).address()


def test_python_cans_own_client_understands_the_hub() -> None:
    with Hub(("can0",)) as hub:
        address = hub.address()
        theirs = SocketCanDaemonBus("can0", address.host, address.port)
        ours = open_bus(address)
        for data in (b"", b"\x01\xab", bytes(8)):
            frame = can.Message(arbitration_id=0x81, is_extended_id=False, data=data)
            ours.send(frame)
            assert same(theirs.recv(WAIT_S), frame)
            theirs.send(frame)
            assert same(ours.recv(WAIT_S), frame)
        theirs.shutdown()
        ours.shutdown()


@pytest.mark.parametrize(
    ("said", "answer"),
    [
        (b"< send 080 0 >", b"< error unknown command >"),
        (b"< rawmode >", b"< error unknown command >"),
        (b"< open can0 >< rawmode >< send 080 2 1 >", b"< ok >< ok >< error malformed frame >"),
        (
            b"< open can0 >< rawmode >< send 080 9 1 1 1 1 1 1 1 1 1 >",
            b"< ok >< ok >< error malformed frame >",
        ),
        (b"< echo >", b"< echo >"),
    ],
)
def test_the_hub_answers_what_it_does_not_understand(said: bytes, answer: bytes) -> None:
    with (
        Hub(("can0",)) as hub,
        socket.create_connection((HOST, hub.address().port), timeout=WAIT_S) as client,
    ):
        client.sendall(said)
        expected = b"< hi >" + answer
        heard = b""
        while len(heard) < len(expected):
            heard += client.recv(256)
        assert heard == expected


def test_the_hub_hangs_up_on_what_is_no_socketcand() -> None:
    with (
        Hub(("can0",)) as hub,
        socket.create_connection((HOST, hub.address().port), timeout=WAIT_S) as client,
    ):
        client.sendall(b"GET / HTTP/1.1 " + b"x" * 1000)
        heard = b""
        while chunk := client.recv(256):
            heard += chunk
        assert heard == b"< hi >"


HOSTILE_FRAMES = (
    b"< send FFFFFFFFFFFFFFFF 1 00 >",
    b"< send FFFFFFFF 1 00 >",
    b"< send 20000000 1 00 >",
    b"< send 800 1 00 >",
    b"< send 12345 1 00 >",
    b"< send %s 1 00 >" % (b"1" * 100),
    b"< send %s 1 00 >" % (b"0" * 50_000),
    b"< send 123 %s 00 >" % (b"F" * 50_000),
    b"< send 123 FFFFFFFFFFFFFFFFFFFF 00 >",
    b"< send 123 9 00 00 00 00 00 00 00 00 00 >",
    b"< send 123 1 %s >" % (b"00" * 50_000),
    b"< send 123 >",
    b"< send >",
    b"< \xff\xfe\0 >",
    b"< open %s >" % (b"x" * 50_000),
    b"<" + b" " * 60_000 + b">",
    b"<" * 60_000 + b">",
)
"""Lines of any length and of any content, whole messages of the protocol all of them."""


def _arrives_alone(hub: Hub, ends: Sequence[can.BusABC]) -> None:
    """Send a frame from the first end to the second:
    it is the next one, and the hub answers in time.
    """
    frame = can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x2a")
    ends[0].send(frame)
    assert same(ends[1].recv(WAIT_S), frame)


@pytest.mark.parametrize("line", HOSTILE_FRAMES, ids=range(len(HOSTILE_FRAMES)))
def test_no_line_of_one_client_reaches_or_ends_another(line: bytes) -> None:
    with Hub(("can0",)) as hub:
        ends = [open_bus(hub.address()) for _ in range(2)]
        with raw_client(hub) as hostile:
            hostile.sendall(line)
            hostile.settimeout(WAIT_S)
            # The hub may hang up on it, and on no other client
            with suppress(ConnectionResetError):
                assert hostile.recv(256)[:8] in (b"< error ", b"")
            _arrives_alone(hub, ends)
        for end in ends:
            end.shutdown()


@pytest.mark.slow
@settings(
    max_examples=150,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
@given(lines=st.lists(st.one_of(
    st.binary(max_size=40),
    st.from_regex(rb"< ?send [0-9A-Fa-f]{1,20} [0-9A-Fa-f]{1,3} "
                  rb"([0-9A-Fa-f]{1,2} ){0,10}>", fullmatch=True),
), max_size=8))  # fmt: skip
def test_a_frame_that_arrives_is_one_that_a_bus_carries(lines: list[bytes]) -> None:
    with Hub(("can0",)) as hub:
        listening = open_bus(hub.address())
        with raw_client(hub) as hostile:
            hostile.sendall(b"".join(lines) + b"><>< echo >")
            heard = b""
            while not heard.endswith(b"< echo >") and (chunk := hostile.recv(4096)):
                heard += chunk
        while (frame := listening.recv(0.0)) is not None:
            assert frame.arbitration_id <= (0x1FFF_FFFF if frame.is_extended_id else 0x7FF)
        listening.shutdown()


@pytest.mark.parametrize(
    "unfinished", [b"<" + b" " * 200_000, b"< send " + b"1" * 200_000, b"<\t " * 60_000]
)
def test_an_unfinished_line_holds_up_no_other(unfinished: bytes) -> None:
    """The hub reads each byte a bounded number of times:
    these took it minutes, and no other client was served.
    """
    with Hub(("can0",)) as hub:
        ends = [open_bus(hub.address()) for _ in range(2)]
        with raw_client(hub) as hostile, suppress(ConnectionResetError, BrokenPipeError):
            hostile.sendall(unfinished)
            while hostile.recv(4096):
                pass
        _arrives_alone(hub, ends)
        for end in ends:
            end.shutdown()


def test_a_server_that_takes_nothing_is_not_waited_for_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("drivers.canopen.bus.SEND_S", 0.02)
    ours, theirs = socket.socketpair()
    theirs.sendall(b"< hi >< ok >< ok >")
    monkeypatch.setattr(socket, "create_connection", lambda *_, **__: ours)
    monkeypatch.setattr(ours.__class__, "setsockopt", lambda *_: None)
    end = SocketcandBus("can0", HOST, 1)
    frame = can.Message(arbitration_id=1, is_extended_id=False, data=bytes(8))
    with theirs:
        with pytest.raises(can.CanOperationError, match=r"accepts nothing for 0\.02 s"):
            for _ in range(100_000):
                messages = (frame,) * 100
                end.send_burst(messages)
        # Half a frame may have gone out
        with pytest.raises(can.CanOperationError, match="accepts nothing"):
            end.send(frame)
    end.shutdown()


ENDLESS = {
    "nothing": b"x" * 100_000,
    "beginnings": b"< " * 50_000,
    "a frame": b"< frame 123 1.0 " + b"0" * 100_000,
    "digits": b"< frame 123 " + b"1" * 100_000,
    "an identifier": b"< frame " + b"1" * 100_000,
}


@pytest.mark.parametrize("kind", ENDLESS)
def test_a_server_that_never_ends_a_message_is_reported_and_not_parsed_ever_slower(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = socket.socketpair()
    theirs.sendall(b"< hi >< ok >< ok >")
    monkeypatch.setattr(socket, "create_connection", lambda *_, **__: ours)
    monkeypatch.setattr(ours.__class__, "setsockopt", lambda *_: None)
    end = SocketcandBus("can0", HOST, 1)
    with theirs:
        theirs.sendall(ENDLESS[kind])
        with pytest.raises(
            can.CanOperationError,
            match=r"without the end of a "
            r"message.*socketcand server",
        ):
            for _ in range(100):
                end.recv(WAIT_S)
    end.shutdown()


def test_a_handshake_without_end_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = socket.socketpair()
    theirs.sendall(b"< hi" + b" " * 100_000)
    monkeypatch.setattr(socket, "create_connection", lambda *_, **__: ours)
    monkeypatch.setattr(ours.__class__, "setsockopt", lambda *_: None)
    with theirs, pytest.raises(can.CanInitializationError, match="without the end of a message"):
        SocketcandBus("can0", HOST, 1)


@pytest.mark.parametrize(
    "said", ["< frame 123456789 1.0 00 >", "< frame 123 1.0 000000000000000000 >"]
)
def test_a_frame_that_no_bus_carries_is_reported(
    said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = socket.socketpair()
    theirs.sendall(b"< hi >< ok >< ok >")
    monkeypatch.setattr(socket, "create_connection", lambda *_, **__: ours)
    monkeypatch.setattr(ours.__class__, "setsockopt", lambda *_: None)
    end = SocketcandBus("can0", HOST, 1)
    with theirs:
        theirs.sendall(said.encode())
        with pytest.raises(can.CanOperationError, match="a frame of"):
            end.recv(WAIT_S)
    end.shutdown()


def test_remote_frames_are_refused_where_the_protocol_has_none() -> None:
    with Hub(("can0",)) as hub:
        end = open_bus(hub.address())
        message = can.Message(arbitration_id=0x701, is_extended_id=False, is_remote_frame=True)
        with pytest.raises(can.CanOperationError, match="remote"):
            end.send(message)
        end.shutdown()
