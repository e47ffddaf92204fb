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
NODES = {"left": LEFT, "right": RIGHT}
SYNC = 0x080


class Wire(can.BusABC):
    """An end whose frames a test writes down; it may break.

    ``log`` is shared by the ends of one split bus.
    """

    def __init__(self, name: str, log: list[tuple[str, int]], clock: FakeClock) -> None:
        self.name = name
        self.log = log
        self.clock = clock
        self.coming: deque[can.Message] = deque()
        self.broken = False
        self.stuck = False
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
        timeout_s = timeout or 0.0
        self.asked_s.append(timeout_s)
        if self.coming:
            return self.coming.popleft()
        self.clock.now_ns += round(timeout_s * 1e9)
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
        self.left = Wire("left", self.log, self.clock)
        self.right = Wire("right", self.log, self.clock)
        self.address = SplitAddress((self._part("left"), self._part("right")))
        ends = (self.left, self.right)
        self.bus = SplitBus(self.address, ends, self._now_s)

    def _part(self, name: str) -> BusPart:
        address = BusAddress("scripted", name)
        return BusPart(name, address, NODES[name], {1: "J1"})

    def _now_s(self) -> float:
        return self.clock.now_ns * 1e-9


@pytest.fixture
def pair() -> Iterator[Pair]:
    made = Pair()
    yield made
    made.left.stuck = False
    made.right.stuck = False
    made.bus.shutdown()


def frame(identifier: int, at_s: float = 0.0, data: bytes = b"", **more: bool) -> can.Message:
    kind = {"is_extended_id": False} | more
    return can.Message(timestamp=at_s, arbitration_id=identifier, data=data, **kind)


def setpoints_and_sync() -> list[can.Message]:
    """The burst of a cycle: a set-point for each of six nodes, and the SYNC."""
    burst = [frame(0x200 + node) for node in range(1, 7)]
    burst.append(frame(SYNC))
    return burst


class FarEnd(SplitBus):
    """The other ends of the wires; a frame that arrives on all of them counts once."""

    def recv(self, timeout: float | None = None) -> can.Message | None:
        first = str(self.address.parts[0])
        while (message := super().recv(timeout)) is not None:
            is_of_one_bus = len(self.address.route(message)) == 1
            if is_of_one_bus or message.channel == first:
                return message
        return None


def _split(kind: type[SplitBus], address: SplitAddress) -> SplitBus:
    return kind(address, [open_bus(part.address) for part in address.parts])


def _three(one: BusAddress, other: BusAddress) -> Iterator[Ends]:
    low = frozenset(range(1, 64))
    high = frozenset(range(64, 128))
    parts = (BusPart("low", one, low), BusPart("high", other, high))
    address = SplitAddress(parts)
    near = _split(SplitBus, address)
    far = _split(FarEnd, address)
    further = _split(FarEnd, address)
    ends = (near, far, further)
    try:
        yield ends
    finally:
        for end in ends:
            end.shutdown()


class TestSplitVirtual(BusContract):
    @pytest.fixture
    def ends(self, request: pytest.FixtureRequest) -> Iterator[Ends]:
        name = request.node.nodeid
        low = BusAddress("virtual", f"{name}-low")
        high = BusAddress("virtual", f"{name}-high")
        yield from _three(low, high)


def test_every_frame_goes_to_the_bus_of_its_node(pair: Pair) -> None:
    expected = []
    for service in (0x080, 0x180, 0x200, 0x300, 0x400, 0x580, 0x600, 0x700):
        for node_id, name in ((1, "left"), (2, "right")):
            identifier = service + node_id
            pair.bus.send(frame(identifier))
            expected.append((name, identifier))
    for node_id, name in ((1, "left"), (2, "right")):
        data = bytes((NmtCommand.START, node_id))
        pair.bus.send(frame(0x000, data=data))
        expected.append((name, 0x000))
    assert pair.log == expected


def test_what_concerns_everybody_goes_to_all(pair: Pair) -> None:
    stop_all = bytes((NmtCommand.STOP, 0))
    for message in (
        frame(SYNC),
        frame(0x000, data=stop_all),
        frame(0x77F, data=b"\5"),  # the recorder's heartbeat: its id is no node's
        frame(0x67D),  # a node with this id may be on either
        frame(0x12345, is_extended_id=True),
    ):
        pair.log.clear()
        pair.bus.send(message)
        identifier = message.arbitration_id
        assert pair.log == [("left", identifier), ("right", identifier)]


def test_the_syncs_of_a_burst_follow_each_other_behind_all_setpoints(pair: Pair) -> None:
    send_burst(pair.bus, setpoints_and_sync())
    assert pair.log[-2:] == [("left", SYNC), ("right", SYNC)]
    assert pair.log[:6] == [
        ("left", 0x201),
        ("right", 0x202),
        ("left", 0x203),
        ("right", 0x204),
        ("left", 0x205),
        ("right", 0x206),
    ]


@settings(deadline=None)
@given(
    left=st.lists(st.integers(0, 50), max_size=30),
    right=st.lists(st.integers(0, 50), max_size=30),
)
def test_received_frames_come_in_the_order_of_their_time_stamps(
    left: list[int], right: list[int]
) -> None:
    pair = Pair()
    for wire, identifier, stamps in ((pair.left, 0x181, left), (pair.right, 0x182, right)):
        for number, at_s in enumerate(sorted(stamps)):
            content = number.to_bytes(2, "big")
            wire.coming.append(frame(identifier, at_s, content))
    left_name, right_name = map(str, pair.address.parts)
    names = {0x181: left_name, 0x182: right_name}
    stamps_s = []
    numbers: dict[int, list[int]] = {0x181: [], 0x182: []}
    while (message := pair.bus.recv(0.0)) is not None:
        identifier = message.arbitration_id
        assert message.channel == names[identifier]
        stamps_s.append(message.timestamp)
        number = int.from_bytes(message.data, "big")
        numbers[identifier].append(number)
    assert stamps_s == sorted([*left, *right])
    assert numbers[0x181] == list(range(len(left)))
    assert numbers[0x182] == list(range(len(right)))
    pair.bus.shutdown()


def test_a_bus_whose_clock_lags_behind_does_not_silence_the_other(pair: Pair) -> None:
    for _ in range(1000):
        pair.left.coming.append(frame(0x181, 0.0))
    pair.right.coming.append(frame(0x182, 100.0))
    received = None
    for _ in range(LARGEST_RUN + 1):
        received = pair.bus.recv(0.0)
    assert received is not None
    assert received.arbitration_id == 0x182


def test_waiting_at_one_bus_never_lasts_while_the_other_may_have_frames(pair: Pair) -> None:
    """Neither has a file descriptor, as python-can's virtual bus."""
    begun_ns = pair.clock.now_ns
    assert pair.bus.recv(0.1) is None
    elapsed_ns = pair.clock.now_ns - begun_ns
    assert elapsed_ns == pytest.approx(0.1e9, abs=1e6)
    largest_asked_s = max(pair.left.asked_s + pair.right.asked_s)
    assert largest_asked_s < 0.001
    at_left_s = sum(pair.left.asked_s)
    at_right_s = sum(pair.right.asked_s)
    assert at_left_s == pytest.approx(at_right_s, abs=0.001)


@pytest.mark.parametrize("name", NAMES)
def test_buses_with_file_descriptors_are_waited_for_together(name: str) -> None:
    with Hub(NAMES) as hub:
        left = BusPart("left", hub.address("left"), LEFT)
        right = BusPart("right", hub.address("right"), RIGHT)
        bus = open_cell_bus(SplitAddress((left, right)))
        far = open_bus(hub.address(name))
        try:
            assert bus.recv(0.0) is None
            far.send(frame(0x201))
            heard = bus.recv(WAIT_S)
            assert heard is not None
            assert heard.channel == f"{name} ({hub.address(name)})"
        finally:
            bus.shutdown()
            far.shutdown()


def test_a_foreign_sync_on_either_bus_is_foreign(pair: Pair) -> None:
    policy = SdoPolicy()
    for wire in (pair.left, pair.right):
        link = Link(pair.address, policy, pair.clock, lambda _address: pair.bus)
        link.open()
        wire.coming.append(frame(SYNC))
        link.pump(0.0)
        assert link.foreign == {SYNC: 1}


def test_our_own_sync_comes_back_once(pair: Pair) -> None:
    """SocketCAN gives it back for the sake of its time, on every bus."""
    for at_s, wire in ((1.0, pair.right), (1.1, pair.left)):
        message = frame(SYNC, at_s)
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
        left = Hoarder("left", one)
        right = Hoarder("right", other)
        bus = SplitBus(pair.address, (left, right))
        echo = frame(SYNC)
        echo.is_rx = False
        right.coming.append(echo)
        right.coming.append(frame(0x184))
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
        identifier = 0x182
    else:
        broken = pair.right
        sound = pair.left
        identifier = 0x181
    broken.broken = True
    pattern = rf"{failing} \(scripted:{failing}\): the wire was cut"
    expected = []
    with pytest.raises(BusError, match=pattern):
        if sending:
            expected.append((sound.name, SYNC))
            pair.bus.send(frame(SYNC))
        else:
            pair.bus.recv(0.0)
    assert pair.log == expected  # the others got it all the same
    pair.log.clear()
    send_burst(pair.bus, setpoints_and_sync())
    names = [name for name, _ in pair.log]
    assert names == [sound.name] * 4
    sound.coming.append(frame(identifier))
    assert pair.bus.recv(0.0) is not None
    sound.broken = True
    with pytest.raises(BusError, match=sound.name):
        pair.bus.send(frame(SYNC))
    for _ in range(2):
        with pytest.raises(BusError, match="all of them have failed"):
            pair.bus.send(frame(SYNC))
        with pytest.raises(BusError, match="all of them have failed"):
            pair.bus.recv(0.1)


def test_buses_that_fail_in_one_burst_are_all_named_and_the_third_goes_on() -> None:
    clock = FakeClock()
    log: list[tuple[str, int]] = []
    wires = [Wire(name, log, clock) for name in ("left", "middle", "right")]
    parts = []
    for number, wire in enumerate(wires, start=1):
        address = BusAddress("scripted", wire.name)
        parts.append(BusPart(wire.name, address, frozenset((number,))))
    bus = SplitBus(SplitAddress(tuple(parts)), wires, lambda: clock.now_ns * 1e-9)
    left, _, right = wires
    left.broken = True
    right.broken = True
    with pytest.raises(BusError, match=r"bus left .*; bus right .*: the wire was cut"):
        bus.send(frame(SYNC))
    bus.send(frame(SYNC))
    assert bus.recv(0.0) is None
    assert log == [("middle", SYNC)] * 2
    bus.shutdown()


def test_a_controller_that_went_off_its_bus_is_named(pair: Pair) -> None:
    bus_off = frame(BUS_OFF, is_error_frame=True, data=bytes(8))
    pair.right.coming.append(bus_off)
    with pytest.raises(BusError, match=r"right \(scripted:right\): bus-off"):
        pair.bus.recv(0.0)
    pair.bus.send(frame(SYNC))
    assert pair.log == [("left", SYNC)]


def test_a_node_on_the_other_bus_is_reported_once_and_not_believed(pair: Pair) -> None:
    for _ in range(3):
        pair.right.coming.append(frame(0x181, data=bytes(8)))
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
    parts = []
    for name in NAMES:
        address = BusAddress("carrier-pigeon", name)
        parts.append(BusPart(name, address, frozenset((3, 4))))
    with pytest.raises(
        BusError, match="node 3 is on left and on right; give one of the two another"
    ):
        open_cell_bus(SplitAddress(tuple(parts)))


def test_a_bus_that_cannot_be_opened_is_named_and_the_others_are_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened: list[can.BusABC] = []

    def remember(address: BusAddress, *, answering: bool) -> can.BusABC:
        opened.append(open_bus(address, answering=answering))
        return opened[-1]

    monkeypatch.setattr("drivers.canopen.split_bus.open_bus", remember)
    left = BusPart("left", BusAddress("virtual", "opened first"), LEFT)
    right = BusPart("right", BusAddress("carrier-pigeon", "can1"), RIGHT)
    parts = (left, right)
    with pytest.raises(BusError, match=r"right \(carrier-pigeon:can1\)"):
        open_cell_bus(SplitAddress(parts))
    with pytest.raises(can.CanOperationError):
        opened[0].send(frame(SYNC))


@pytest.mark.parametrize("answering", [False, True])
def test_every_bus_is_opened_for_devices_that_answer(
    monkeypatch: pytest.MonkeyPatch, answering: bool
) -> None:
    """A simulated cell answers each frame: on SocketCAN a process in between would cost time."""
    asked: list[bool] = []

    def remember(address: BusAddress, *, answering: bool) -> can.BusABC:
        asked.append(answering)
        return open_bus(address)

    monkeypatch.setattr("drivers.canopen.split_bus.open_bus", remember)
    left = BusPart("left", BusAddress("virtual", "answers left"), LEFT)
    right = BusPart("right", BusAddress("virtual", "answers right"), RIGHT)
    open_cell_bus(SplitAddress((left, right)), answering=answering).shutdown()
    open_cell_bus(left.address, answering=answering).shutdown()
    assert asked == [answering] * 3


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
    wires = (pair.left, pair.right, pair.left, pair.right)
    for number, wire in enumerate(wires):
        at_ns = 5_000_000_000 + 100 * number
        monotonic_s = at_ns * 1e-9
        set_by_s = step_s * number
        node_id = number % 2 + 1
        message = CapturedMessage(
            timestamp=1.7e9 + monotonic_s + set_by_s,
            arbitration_id=0x700 + node_id,
            is_extended_id=False,
            data=bytes((number,)),
        )
        message.kernel_ns = 0
        message.monotonic_ns = at_ns
        message.local = False
        wire.coming.append(message)
    for number in range(4):
        heard = pair.bus.recv(0.0)
        assert heard is not None
        assert heard.data[0] == number
