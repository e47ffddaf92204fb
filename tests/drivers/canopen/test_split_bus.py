"""Several buses as one: every frame to its bus, every frame back in order,
and one that fails takes no other along.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Iterator

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen.bus import BusAddress, open_bus, send_burst
from drivers.canopen.link import Link, NmtCommand
from drivers.canopen.sdo import SdoPolicy
from drivers.canopen.socketcan import CapturedMessage, Losses, losses_of, remarks_of
from drivers.canopen.split_bus import (
    BUS_OFF,
    LARGEST_RUN,
    BusPart,
    SplitAddress,
    SplitBus,
    open_cell_bus,
)
from drivers.errors import BusError, NodeMisplaced
from drivers.simulation.hub import Hub
from tests.drivers.bus_contract import WAIT_S, BusContract, Ends
from tests.drivers.scripted import FakeClock

LEFT = frozenset((1, 3, 5))
RIGHT = frozenset((2, 4, 6))
NAMES = ("left", "right")


class Wire(can.BusABC):
    """An end whose frames a test writes down; it may break.

    ``log`` is shared by the ends of one split bus.
    """

    def __init__(self, name: str, log: list[tuple[str, int]], clock: FakeClock) -> None:
        self.name = name
        self.log = log
        self.clock = clock
        self.coming: deque[can.Message] = deque()
        self.broken = self.stuck = False
        self.asked_s: list[float] = []
        self.closed = 0
        self.losses = Losses()
        self.remarks = tuple[str, ...]()
        super().__init__(channel=name)

    def _check(self) -> None:
        if self.broken:
            raise can.CanOperationError("the wire was cut")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._check()
        self.log.append((self.name, msg.arbitration_id))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self._check()
        self.asked_s.append(0.0 if timeout is None else timeout)
        if self.coming:
            return self.coming.popleft()
        self.clock.now_ns += round((timeout or 0.0) * 1e9)
        return None

    def shutdown(self) -> None:
        super().shutdown()
        self.closed += 1
        if self.stuck:
            raise can.CanOperationError("does not close")


class Pair:
    """A split bus over two of those."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.log: list[tuple[str, int]] = []
        self.left, self.right = (Wire(name, self.log, self.clock) for name in NAMES)
        parts = tuple(
            BusPart(name, BusAddress("scripted", name), nodes, {1: "J1"})
            for name, nodes in zip(NAMES, (LEFT, RIGHT), strict=True)
        )
        self.address = SplitAddress(parts)
        ends = (self.left, self.right)
        self.bus = SplitBus(self.address, ends, lambda: self.clock.now_ns * 1e-9)


@pytest.fixture
def pair() -> Iterator[Pair]:
    made = Pair()
    yield made
    made.left.stuck = made.right.stuck = False
    made.bus.shutdown()


def frame(identifier: int, at_s: float = 0.0, data: bytes = b"", **more: bool) -> can.Message:
    return can.Message(
        timestamp=at_s, arbitration_id=identifier, data=data, **{"is_extended_id": False, **more}
    )


class FarEnd(SplitBus):
    """The other ends of the wires; a frame that arrives on all of them counts once."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        while (message := super().recv(timeout)) is not None:
            if len(self.address.route(message)) == 1 or message.channel == str(
                self.address.parts[0]
            ):
                return message
        return None


def _split(kind: type[SplitBus], address: SplitAddress) -> SplitBus:
    return kind(address, [open_bus(part.address) for part in address.parts])


def _three(one: BusAddress, other: BusAddress) -> Iterator[Ends]:
    low = frozenset(range(1, 64))
    node_ids = frozenset(range(64, 128))
    bus_part = BusPart("low", one, low)
    parts = (bus_part, BusPart("high", other, node_ids))
    address = SplitAddress(parts)
    ends = _split(SplitBus, address), _split(FarEnd, address), _split(FarEnd, address)
    try:
        yield ends
    finally:
        for end in ends:
            end.shutdown()


class TestSplitVirtual(BusContract):
    @pytest.fixture
    def ends(self, request: pytest.FixtureRequest) -> Iterator[Ends]:
        name = request.node.nodeid
        channel = name + "-low"
        bus_address = BusAddress("virtual", name + "-high")
        yield from _three(BusAddress("virtual", channel), bus_address)


def test_every_frame_goes_to_the_bus_of_its_node(pair: Pair) -> None:
    expected = []
    for service in (0x080, 0x180, 0x200, 0x300, 0x400, 0x580, 0x600, 0x700):
        for node_id, name in ((1, "left"), (2, "right")):
            identifier = service + node_id
            pair.bus.send(frame(identifier))
            expected.append((name, service + node_id))
    for node_id, name in ((1, "left"), (2, "right")):
        data = bytes((NmtCommand.START, node_id))
        pair.bus.send(frame(0x000, data=data))
        expected.append((name, 0x000))
    assert pair.log == expected


def test_what_concerns_everybody_goes_to_all(pair: Pair) -> None:
    for message in (
        frame(0x080),
        frame(0x000, data=bytes((NmtCommand.STOP, 0))),
        frame(0x77F, data=b"\5"),  # the recorder's heartbeat: its id is no node's
        frame(0x67D),  # a node with this id may be on either
        frame(0x12345, is_extended_id=True),
    ):
        pair.log.clear()
        pair.bus.send(message)
        expected = [(name, message.arbitration_id) for name in NAMES]
        assert pair.log == expected


def test_the_syncs_of_a_burst_follow_each_other_behind_all_setpoints(pair: Pair) -> None:
    messages = [*(frame(0x200 + node) for node in range(1, 7)), frame(0x080)]
    send_burst(pair.bus, messages)
    expected = [("left", 0x080), ("right", 0x080)]
    assert pair.log[-2:] == expected
    assert pair.log[:6] == [(NAMES[(node + 1) % 2], 0x200 + node) for node in range(1, 7)]


@settings(deadline=None)
@given(
    left=st.lists(st.integers(0, 50), max_size=30),
    right=st.lists(st.integers(0, 50), max_size=30),
)
def test_received_frames_come_in_the_order_of_their_time_stamps(
    left: list[int], right: list[int]
) -> None:
    pair = Pair()
    for wire, node, stamps in ((pair.left, 1, sorted(left)), (pair.right, 2, sorted(right))):
        wire.coming.extend(
            frame(0x180 + node, at_s, n.to_bytes(2, "big")) for n, at_s in enumerate(stamps)
        )
    received = []
    while (message := pair.bus.recv(0.0)) is not None:
        received.append(message)
    expected = sorted([*left, *right])
    assert [message.timestamp for message in received] == expected
    for identifier, stamps in ((0x181, left), (0x182, right)):
        numbers = [
            int.from_bytes(m.data, "big") for m in received if m.arbitration_id == identifier
        ]
        assert numbers == list(range(len(stamps)))
    names = dict(zip((0x181, 0x182), map(str, pair.address.parts), strict=True))
    assert all(message.channel == names[message.arbitration_id] for message in received)
    pair.bus.shutdown()


def test_a_bus_whose_clock_lags_behind_does_not_silence_the_other(pair: Pair) -> None:
    pair.left.coming.extend(frame(0x181, 0.0) for _ in range(1000))
    pair.right.coming.append(frame(0x182, 100.0))
    received = [pair.bus.recv(0.0) for _ in range(LARGEST_RUN + 1)]
    assert received[-1] is not None
    assert received[-1].arbitration_id == 0x182


def test_waiting_at_one_bus_never_lasts_while_the_other_may_have_frames(pair: Pair) -> None:
    """Neither has a file descriptor, as python-can's virtual bus."""
    begun_ns = pair.clock.now_ns
    assert pair.bus.recv(0.1) is None
    elapsed_ns = pair.clock.now_ns - begun_ns
    assert elapsed_ns == pytest.approx(0.1e9, abs=1e6)
    largest_asked_s = max(pair.left.asked_s + pair.right.asked_s)
    assert largest_asked_s < 0.001
    expected = sum(pair.right.asked_s)
    assert sum(pair.left.asked_s) == pytest.approx(expected, abs=0.001)


@pytest.mark.parametrize("name", NAMES)
def test_buses_with_file_descriptors_are_waited_for_together(name: str) -> None:
    with Hub(NAMES) as hub:
        parts = tuple(
            BusPart(part, hub.address(part), nodes)
            for part, nodes in zip(NAMES, (LEFT, RIGHT), strict=True)
        )
        bus = open_cell_bus(SplitAddress(parts))
        far = open_bus(hub.address(name))
        try:
            assert bus.recv(0.0) is None
            far.send(frame(0x201))
            heard = bus.recv(WAIT_S)
            assert heard is not None
            expected = f"{name} ({hub.address(name)})"
            assert heard.channel == expected
        finally:
            bus.shutdown()
            far.shutdown()


def test_a_foreign_sync_on_either_bus_is_foreign(pair: Pair) -> None:
    for wire in (pair.left, pair.right):
        link = Link(pair.address, SdoPolicy(), pair.clock, lambda _address: pair.bus)
        link.open()
        wire.coming.append(frame(0x080))
        link.pump(0.0)
        assert link.foreign == {0x080: 1}


def test_our_own_sync_comes_back_once(pair: Pair) -> None:
    """SocketCAN gives it back for the sake of its time, on every bus."""
    for at_s, wire in ((1.0, pair.right), (1.1, pair.left)):
        message = frame(0x080, at_s)
        message.is_rx = False
        wire.coming.append(message)
    heard = pair.bus.recv(0.0)
    assert heard is not None
    assert heard.timestamp == 1.1
    assert pair.bus.recv(0.0) is None


class Hoarder(Wire):
    """An end that has read a burst from its socket, while its file descriptor stays silent."""

    def __init__(self, name: str, silent: socket.socket) -> None:
        super().__init__(name, [], FakeClock())
        self._silent = silent

    def fileno(self) -> int:
        return self._silent.fileno()


def test_frames_behind_one_that_is_left_out_are_not_waited_for(pair: Pair) -> None:
    one, other = socket.socketpair()
    with one, other:
        ends = Hoarder("left", one), Hoarder("right", other)
        bus = SplitBus(pair.address, ends)
        echo = frame(0x080)
        echo.is_rx = False
        coming = ends[1].coming
        coming.extend((echo, frame(0x184)))
        assert bus.recv(0.0) is not None
        bus.shutdown()


@pytest.mark.parametrize("failing", NAMES)
@pytest.mark.parametrize("sending", [True, False])
def test_a_bus_that_fails_is_named_once_and_the_other_goes_on(
    pair: Pair, failing: str, sending: bool
) -> None:
    if failing == "left":
        broken = pair.left
        sound = pair.right
    else:
        broken = pair.right
        sound = pair.left
    node_id = 2 if failing == "left" else 1
    broken.broken = True
    pattern = rf"{failing} \(scripted:{failing}\): the wire was cut"
    with pytest.raises(BusError, match=pattern):
        pair.bus.send(frame(0x080)) if sending else pair.bus.recv(0.0)
    expected = [(sound.name, 0x080)] if sending else []
    assert pair.log == expected  # the others got it all the same
    pair.log.clear()
    messages = [*(frame(0x200 + node) for node in range(1, 7)), frame(0x080)]
    send_burst(pair.bus, messages)
    assert {name for name, _ in pair.log} == {sound.name}
    assert len(pair.log) == 4
    identifier = 0x180 + node_id
    sound.coming.append(frame(identifier))
    assert pair.bus.recv(0.0) is not None
    sound.broken = True
    with pytest.raises(BusError, match=sound.name):
        pair.bus.send(frame(0x080))
    for _ in range(2):
        with pytest.raises(BusError, match="all of them have failed"):
            pair.bus.send(frame(0x080))
        with pytest.raises(BusError, match="all of them have failed"):
            pair.bus.recv(0.1)


def test_a_controller_that_went_off_its_bus_is_named(pair: Pair) -> None:
    pair.right.coming.append(frame(BUS_OFF, is_error_frame=True, data=bytes(8)))
    with pytest.raises(BusError, match=r"right \(scripted:right\): bus-off"):
        pair.bus.recv(0.0)
    pair.bus.send(frame(0x080))
    assert pair.log == [("left", 0x080)]


def test_a_node_on_the_other_bus_is_reported_once_and_not_believed(pair: Pair) -> None:
    pair.right.coming.extend(frame(0x181, data=bytes(8)) for _ in range(3))
    pair.left.coming.append(frame(0x181, 1.0, b"mine"))
    with pytest.raises(
        NodeMisplaced,
        match=r"J1 \(node 1\) is heard on bus right .* has it "
        r"on bus left",
    ):
        pair.bus.recv(0.0)
    heard = pair.bus.recv(0.0)
    assert heard is not None
    assert heard.data == b"mine"
    assert pair.bus.recv(0.0) is None


def test_a_flood_of_frames_that_are_left_out_does_not_keep_the_reader(
    pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[can.Message] = []

    def flood(_timeout: float | None) -> can.Message:
        assert len(read) < 1000, "a reader that never ends"
        read.append(frame(0x181, data=bytes(8)))
        pair.clock.now_ns += 1_000_000
        return read[-1]

    monkeypatch.setattr(pair.right, "recv", flood)
    with pytest.raises(NodeMisplaced):
        pair.bus.recv(0.0)
    assert pair.bus.recv(0.01) is None


def test_one_node_id_on_two_buses_is_refused_before_anything_is_opened() -> None:
    parts = tuple(
        BusPart(name, BusAddress("carrier-pigeon", name), frozenset((3, 4))) for name in NAMES
    )
    with pytest.raises(
        BusError, match="node 3 is on left and on right; give one of the two another"
    ):
        open_cell_bus(SplitAddress(parts))


def test_a_bus_that_cannot_be_opened_is_named_and_the_others_are_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened: list[can.BusABC] = []

    def remember(address: BusAddress) -> can.BusABC:
        opened.append(open_bus(address))
        return opened[-1]

    monkeypatch.setattr("drivers.canopen.split_bus.open_bus", remember)
    bus_address = BusAddress("virtual", "opened first")
    bus_part = BusPart("left", bus_address, LEFT)
    parts = (
        bus_part,
        BusPart("right", BusAddress("carrier-pigeon", "can1"), RIGHT),
    )
    with pytest.raises(BusError, match=r"right \(carrier-pigeon:can1\)"):
        open_cell_bus(SplitAddress(parts))
    with pytest.raises(can.CanOperationError):
        opened[0].send(frame(0x080))


def test_closing_closes_all_although_one_fails(pair: Pair) -> None:
    pair.left.stuck = True
    with pytest.raises(BusError, match=r"left \(scripted:left\): does not close"):
        pair.bus.shutdown()
    assert pair.left.closed == 1
    assert pair.right.closed == 1


def test_losses_of_all_buses_count_and_remarks_have_their_bus(pair: Pair) -> None:
    assert losses_of(pair.bus) == Losses()
    pair.left.losses = Losses(kernel=3, backlog=1)
    pair.right.losses = Losses(kernel=4)
    pair.right.remarks = ("a small buffer",)
    expected = Losses(kernel=7, backlog=1)
    assert losses_of(pair.bus) == expected
    assert remarks_of(pair.bus) == ("right (scripted:right): a small buffer",)


@pytest.mark.parametrize("step_s", [0.0, -3600.0, 3600.0])
def test_frames_of_two_buses_come_in_the_order_of_the_monotonic_clock(
    pair: Pair, step_s: float
) -> None:
    """Also when the wall clock is set between them;
    its seconds as a float cannot resolve 100 ns.
    """
    for number, wire in enumerate((pair.left, pair.right, pair.left, pair.right)):
        at_ns = 5_000_000_000 + 100 * number
        timestamp = 1.7e9 + at_ns * 1e-9 + step_s * number
        arbitration_id = 0x700 + number % 2 + 1
        message = CapturedMessage(
            timestamp=timestamp,
            arbitration_id=arbitration_id,
            is_extended_id=False,
            data=bytes((number,)),
        )
        message.kernel_ns = 0
        message.monotonic_ns = at_ns
        message.local = False
        wire.coming.append(message)
    got = [pair.bus.recv(0.0) for _ in range(4)]
    expected = [0, 1, 2, 3]
    assert [message.data[0] for message in got if message is not None] == expected
