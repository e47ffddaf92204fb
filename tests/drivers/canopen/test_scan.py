"""A scan of nodes that answer badly, without end or twice:
every node is reported, in a bounded time.
"""

from __future__ import annotations

import binascii
import re
import struct
from contextlib import nullcontext

import can
import pytest

from drivers.canopen.link import Link
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.node_scan import SCAN_S, scan, scan_link
from drivers.errors import BusBusy, DriveFault, ObjectAccessError, SetupRefused
from drivers.profiles.profile import ObjectEntry
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync, TimedSync
from tests.drivers.hostile import HOSTILE, NAME, Answer, Hostile, about, endless, silent
from tests.drivers.scripted import PERIOD_NS, ScriptedBus, ScriptedNode, cell, lose_first_answer


@pytest.mark.parametrize(("answer", "problem"), HOSTILE)
def test_every_node_is_reported_whatever_one_of_them_does(answer: Answer, problem: str) -> None:
    network, bus = cell(3)
    hostile = Hostile(2, bus, answer)
    bus.nodes = (bus.nodes[0], hostile, bus.nodes[2])
    begun_ns = bus.clock.now_ns
    with network:
        found = network.scan(wait_s=0.05)
    node_ids = [node.node_id for node in found]
    assert node_ids == [1, 2, 3]
    assert [node.identity is not None and node.device_name == "axis" for node in found[::2]] == [
        True,
        True,
    ]
    problems = [node.problems for node in found[::2]]
    assert problems == [(), ()]
    assert any(re.search(problem, text) for text in found[1].problems)
    assert bus.clock.now_ns - begun_ns < 5_000_000_000


@pytest.mark.slow
def test_a_scan_of_many_nodes_that_do_not_end_ends() -> None:
    network, bus = cell(40)
    bus.nodes = tuple(Hostile(node.node_id, bus, silent) for node in bus.nodes)
    begun_ns = bus.clock.now_ns
    with network:
        found = network.scan(wait_s=0.05)
    elapsed_ns = bus.clock.now_ns - begun_ns
    assert elapsed_ns < (SCAN_S + 10.0) * 1e9
    expected = list(range(1, 41))
    assert [node.node_id for node in found] == expected
    problems = found[-1].problems
    assert "the scan was over after 30 s; is the bus flooded?" in problems[0]


def test_an_object_of_unbounded_length_is_no_reason_to_ask_again() -> None:
    network, bus = cell(1)
    bus.nodes = (Hostile(1, bus, endless),)
    with network:
        with pytest.raises(
            ObjectAccessError, match="no end, expected at most 4096 bytes within 2 s"
        ):
            network.link.objects(1).read_bytes(NAME, 0)
        found = network.link.objects(1).read(ObjectEntry(0x6075, 0, 32, signed=False))
        assert found == 2000
    frames = [
        frame for frame in bus.sent if frame.data[0] == 0x40 and about(bytes(frame.data)) == NAME
    ]
    assert len(frames) == 1


def test_a_slow_node_is_said_to_be_slow() -> None:
    def slow(data: bytes, bus: ScriptedBus) -> None:
        if about(data) != 0x1000:
            bus.clock.now_ns += 800_000_000

    network, bus = cell(1)
    bus.nodes = (Hostile(1, bus, slow),)
    with network:
        (found,) = network.scan(wait_s=0.05)
    assert "the rest was not asked: its answers took longer than 3 s" in found.problems


TEXT = b"a name that its node has by block transfer alone " * 20


class BlockServer(ScriptedNode):
    """A node that gives its name by block upload alone (CiA 301);
    `spoilt` sends another checksum.
    """

    def __init__(self, bus: ScriptedBus, *, spoilt: bool = False) -> None:
        super().__init__(1)
        self._bus = bus
        self._spoilt = spoilt
        self._rest = [TEXT[at : at + 7] for at in range(0, len(TEXT), 7)]

    def sdo(self, data: bytes) -> bytes | None:
        if data[0] >> 5 != 5:
            packed = struct.pack("<L", 0x05040001)
            refused = bytes((0x80, *data[1:4])) + packed
            if about(data) == NAME:
                return refused
            return super().sdo(data)
        if data[0] & 3 == 0:
            return bytes((0xC6, *data[1:4])) + struct.pack("<L", len(TEXT))
        if data[0] & 3 == 1:
            return None
        if data[0] & 3 == 2:
            del self._rest[: data[1]]
        if not self._rest:
            unused = -len(TEXT) % 7
            checksum = binascii.crc_hqx(TEXT, 0) ^ self._spoilt
            return struct.pack("<BH5x", 0xC1 | unused << 2, checksum)
        for number, segment in enumerate(self._rest[:127], start=1):
            last = 0x80 if number == len(self._rest) else 0
            frame = bytes((number | last,)) + segment.ljust(7, b"\0")
            message = can.Message(arbitration_id=0x581, is_extended_id=False, data=frame)
            self._bus.inject(message)
        return None


def test_an_object_that_comes_by_block_transfer_alone_is_read_so() -> None:
    network, bus = cell(1)
    bus.nodes = (BlockServer(bus),)
    with network:
        content = network.link.objects(1).read_bytes(NAME, 0)
        assert content == TEXT


def test_a_block_transfer_with_a_wrong_checksum_is_not_believed() -> None:
    network, bus = cell(1)
    bus.nodes = (BlockServer(bus, spoilt=True),)
    with network, pytest.raises(ObjectAccessError, match="1008h:00: "):
        network.link.objects(1).read_bytes(NAME, 0)


# -- two devices with one node id
# --------------------------------------------------------------------------------------


def twins(serial: int = 8) -> tuple[CanopenNetwork, ScriptedBus]:
    """Axes 1 and 2, and a second device with node id 2."""
    network, bus = cell(2)
    bus.nodes = (*bus.nodes, ScriptedNode(2, serial))
    return network, bus


@pytest.mark.parametrize("serial", [7, 8], ids=["equal answers", "other serial"])
def test_two_devices_with_one_node_id_are_found(serial: int) -> None:
    network, _ = twins(serial)
    with network:
        found = network.scan(wait_s=0.05)
    expected = [(1, False), (2, True)]
    assert [(node.node_id, bool(node.shared)) for node in found] == expected
    assert "two answers to one request for 10" in found[1].shared


def test_a_late_answer_to_another_program_is_no_second_device() -> None:
    """After 20 MB from one client, the simulated cell still answered the scan before."""
    network, bus = cell(2)
    answers: list[can.Message] = []

    def late_once(message: can.Message) -> tuple[can.Message, ...]:
        if message.arbitration_id != 0x582 or answers:
            return (message,)
        answers.append(message)
        return (message, message)

    with network:
        bus.tamper = late_once
        found = network.scan(wait_s=0.05)
    assert len(answers) == 1
    assert [node.shared for node in found] == ["", ""]


@pytest.mark.parametrize("serial", [7, 8], ids=["equal answers", "other serial"])
def test_they_are_refused_before_anything_is_written(serial: int) -> None:
    network, bus = twins(serial)
    with (
        network,
        pytest.raises(
            SetupRefused,
            match=r"J2 \(node 2\): found two answers to one "
            r"request .* two have it",
        ),
    ):
        network.prepare()
    assert [f for f in bus.sent if 0x600 < f.arbitration_id < 0x680 and f.data[0] >> 5 == 1] == []


def test_a_second_device_that_refuses_first_is_named_too() -> None:
    network, bus = cell(2)
    other = Hostile(2, bus, lambda data, _: None)
    other.objects = {
        key: value for key, value in other.objects.items() if key[0] in (0x1000, 0x1017)
    }
    bus.nodes = (bus.nodes[0], other, bus.nodes[1])
    with (
        network,
        pytest.raises(
            SetupRefused,
            match=r"J2 \(node 2\): found two answers .* "
            r"two have it",
        ),
    ):
        network.prepare()


def test_a_second_device_that_answers_late_and_refuses_is_named() -> None:
    """It is silent, as a busy one is, until the PDOs are mapped:
    an abort alone would send one to the mapping.
    """
    network, bus = cell(2)
    other = Hostile(2, bus, lambda data, _: None if about(data) >= 0x1600 else b"")
    other.objects = {
        key: value for key, value in other.objects.items() if key[0] in (0x1000, 0x1017)
    }
    other.beats = False
    bus.nodes = (bus.nodes[0], other, bus.nodes[1])
    with (
        network,
        pytest.raises(
            SetupRefused,
            match=r"J2 \(node 2\): found two answers .* "
            r"two have it",
        ),
    ):
        network.prepare()


def heartbeat(state: int) -> can.Message:
    return can.Message(arbitration_id=0x702, is_extended_id=False, data=bytes((state,)))


def listen(network: CanopenNetwork, bus: ScriptedBus, states: list[int], every_ns: int) -> Link:
    for state in states:
        bus.inject(heartbeat(state))
        network.link.pump(0.0)
        bus.clock.now_ns += every_ns
    return network.link


def test_two_boot_ups_right_after_another_are_two_devices() -> None:
    network, bus = cell(2)
    with network:
        states = [0, 0, 127]
        link = listen(network, bus, states, 50_000_000)
        assert link.shared_id(2, 0) == "2 boot-up messages within 0.5 s"
        assert link.shared_id(1, 0) == ""


def test_a_node_that_boots_again_later_is_one_device() -> None:
    network, bus = cell(2)
    with network:
        states = [0, 127, 0, 127]
        found = listen(network, bus, states, 300_000_000).shared_id(2, 0)
        assert found == ""


@pytest.mark.parametrize(("every_ms", "shared"), [(50, True), (100, False)])
def test_two_heartbeats_a_period_are_two_devices(every_ms: int, shared: bool) -> None:
    network, bus = cell(2)
    with network:
        states = [5] * 30
        every_ns = every_ms * 1_000_000
        link = listen(network, bus, states, every_ns)
        assert bool(link.shared_id(2, 100)) is shared
        assert (link.shared_id(2, 100) == "8 heartbeats in 350 ms, its period is 100 ms") is shared


def test_one_late_heartbeat_is_no_second_device() -> None:
    network, bus = cell(2)
    with network:
        for every_ms in (100, 100, 190, 10, 100, 100, 100):
            every_ns = every_ms * 1_000_000
            link = listen(network, bus, [5], every_ns)
        assert link.shared_id(2, 100) == ""


def test_heartbeats_of_two_states_in_turn_are_two_devices() -> None:
    network, bus = cell(2)
    with network:
        # One change may be commanded
        states = [5, 127, 5]
        found = listen(network, bus, states, 100_000_000).shared_id(2, 0)
        assert found == ""
        assert listen(network, bus, [127, 5], 100_000_000).shared_id(2, 0) == (
            "heartbeats OPERATIONAL and PRE-OPERATIONAL in turn"
        )


def sync() -> can.Message:
    return can.Message(arbitration_id=0x80, is_extended_id=False)


def listen_beside_sync(
    network: CanopenNetwork, bus: ScriptedBus, beats: int, every_ms: int
) -> Link:
    """Hear heartbeats, each behind a SYNC of another producer."""
    for _ in range(beats):
        bus.inject(sync())
        every_ns = every_ms * 1_000_000
        listen(network, bus, [5], every_ns)
    return network.link


def test_heartbeats_of_a_cell_in_lockstep_are_no_second_device() -> None:
    """Its time goes as fast as SYNC comes: heartbeats of 100 ms may come every 20 ms."""
    network, bus = cell(2)
    with network:
        found = listen_beside_sync(network, bus, 30, 20).shared_id(2, 100)
        assert found == ""


def test_two_devices_are_found_by_their_heartbeats_once_no_sync_is_between_them() -> None:
    network, bus = cell(2)
    with network:
        found = listen_beside_sync(network, bus, 30, 20).shared_id(2, 100)
        assert found == ""
        states = [5] * 8
        link = listen(network, bus, states, 50_000_000)
        assert link.shared_id(2, 100) == "8 heartbeats in 350 ms, its period is 100 ms"


@pytest.mark.parametrize("serial", [7, 8], ids=["equal answers", "other serial"])
def test_two_devices_are_found_by_their_answers_beside_sync(serial: int) -> None:
    network, bus = twins(serial)
    bus.tamper = lambda message: (message, sync())
    with network:
        found = scan_link(network.link, range(1, 5), 0.05)
    expected = [(1, False), (2, True)]
    assert [(node.node_id, bool(node.shared)) for node in found] == expected
    assert "two answers to one request for 10" in found[1].shared


MASTERS = {
    "SYNC": (sync(), r"a SYNC \(080h\)"),
    "NMT": (
        can.Message(arbitration_id=0, is_extended_id=False, data=bytes((1, 0))),
        "an NMT command",
    ),
    "SDO": (
        can.Message(
            arbitration_id=0x602, is_extended_id=False, data=bytes.fromhex("4041600000000000")
        ),
        r"an SDO request to J2 \(node 2\)",
    ),
    "set-point": (
        can.Message(arbitration_id=0x201, is_extended_id=False, data=bytes(6)),
        r"a set-point of J1",
    ),
}
"""A frame of another master, and its description."""


@pytest.mark.parametrize("name", MASTERS)
def test_a_scan_beside_another_master_sends_nothing(name: str) -> None:
    """It may be a recorder on another computer, in the middle of a motion."""
    frame, text = MASTERS[name]
    network, bus = cell(2)
    with network:
        bus.inject(frame)
        with pytest.raises(BusBusy, match=f"{text}.* that we did not send"):
            network.scan(wait_s=0.05)
        assert bus.sent == []
        assert len(network.scan(wait_s=0.05)) == 2  # the other master has ended


def test_the_scan_of_the_library_beside_another_master_sends_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    network, bus = cell(2)
    monkeypatch.setattr("drivers.canopen.node_scan.Link", lambda *_: network.link)
    bus.inject(sync())
    with pytest.raises(BusBusy, match="a SYNC"):
        scan("virtual:scripted")
    assert bus.sent == []


class Beating(ScriptedNode):
    """A device that sends heartbeats, and answers nothing."""

    def __init__(self, node_id: int, period_ms: int) -> None:
        super().__init__(node_id)
        self.store(0x1017, 0, period_ms)
        self.next_beat_ns = 1_000_000_000 + 300_000 * period_ms

    def sdo(self, data: bytes) -> bytes | None:
        return None

    def on_sync(self, cycle: int, counted: bool = False) -> list[can.Message]:
        return []


def silent_twin(period_ms: int) -> tuple[CanopenNetwork, ScriptedBus]:
    """Axes 1 and 2 with this period, and beside axis 2 a device that sends its heartbeats as
    well.
    """
    network, bus = cell(2)
    for node in bus.nodes:
        node.store(0x1017, 0, period_ms)
    bus.nodes = (*bus.nodes, Beating(2, period_ms))
    return network, bus


@pytest.mark.parametrize("period_ms", [100, 500, 1000])
def test_a_silent_twin_is_found_by_its_heartbeats(period_ms: int) -> None:
    network, bus = silent_twin(period_ms)
    begun_ns = bus.clock.now_ns
    with network:
        found = network.scan(wait_s=0.05)
    expected = [(1, False), (2, True)]
    assert [(node.node_id, "heartbeats in" in node.shared) for node in found] == expected
    assert bus.clock.now_ns - begun_ns < 4_000_000_000


def test_a_scan_does_not_wait_for_ever_for_a_slow_heartbeat() -> None:
    network, bus = silent_twin(60_000)
    begun_ns = bus.clock.now_ns
    with network:
        assert len(network.scan(wait_s=0.05)) == 2
    assert bus.clock.now_ns - begun_ns < 4_000_000_000


def test_a_silent_twin_is_refused_before_motion() -> None:
    network, bus = silent_twin(20)
    with (
        network,
        pytest.raises(
            SetupRefused,
            match=r"J2 \(node 2\): found \d heartbeats in .* "
            r"two have it",
        ),
    ):
        network.prepare()
    powered_cycles = [node.powered_cycles for node in bus.nodes]
    assert powered_cycles == [0, 0, 0]


@pytest.mark.parametrize("timed", [True, False])
def test_a_silent_twin_that_comes_in_a_run_stops_it(timed: bool) -> None:
    network, bus = cell(2)
    with network:
        network.prepare()
        twin = Beating(2, 20)
        bus.nodes = (*bus.nodes, twin)
        twin.nmt = 5
        pacing = (
            TimedSync(PERIOD_NS, 0, bus.clock)
            if timed
            else LockstepSync(PERIOD_NS, clock=bus.clock)
        )
        stream = SyncStream(network, pacing)
        for _ in range(300):
            stream.advance()
        # In lockstep the cell's time is not that of the clock.
        with (
            pytest.raises(DriveFault, match="two devices have this node id")
            if timed
            else nullcontext()
        ):
            stream.check()
            assert not timed


def test_an_answer_to_another_program_is_no_second_device() -> None:
    network, bus = cell(1)
    with network:
        access = network.link.objects(1)
        for _ in range(3):
            object_entry = ObjectEntry(0x6075, 0, 32, signed=False)
            access.read(object_entry)
            message = can.Message(
                arbitration_id=0x601, is_extended_id=False, data=bytes.fromhex("4075600000000000")
            )
            bus.inject(message)
            answer = can.Message(
                arbitration_id=0x581, is_extended_id=False, data=bytes.fromhex("43756000d0070000")
            )
            bus.inject(answer)
        assert network.link.shared_id(1, 0) == ""


def test_a_late_answer_to_a_request_that_was_repeated_is_no_second_device() -> None:
    network, bus = cell(1)
    lose_first_answer(bus, repeats=False)
    with network:
        access = network.link.objects(1)
        for _ in range(3):
            object_entry = ObjectEntry(0x6075, 0, 32, signed=False)
            access.read(object_entry)
        assert network.link.shared_id(1, 0) == ""
