"""SYNC producers other than this process: started, and stopped again."""

from __future__ import annotations

import socket
import struct

import pytest

from drivers.errors import BusError, ObjectAccessError
from drivers.stream.producers import PRODUCES, DriveProducer, KernelProducer, setup_message
from tests.drivers.scripted import ScriptedBus, ScriptedNode, abort_answer, cell

PERIOD_US = 2000


def with_sync_objects(node: ScriptedNode, cob_id: int = 0x80, period_us: int = 0) -> ScriptedNode:
    node.objects[0x1005, 0] = (cob_id, 4)
    node.objects[0x1006, 0] = (period_us, 4)
    return node


def written(bus: ScriptedBus, node_id: int) -> list[tuple[int, int]]:
    """Index and value of every object that was written, in their order."""
    requests = [
        bytes(m.data)
        for m in bus.sent
        if m.arbitration_id == 0x600 + node_id and m.data[0] >> 5 == 1
    ]
    found = []
    for data in requests:
        found.append((int.from_bytes(data[1:3], "little"), int.from_bytes(data[4:8], "little")))
    return found


@pytest.mark.parametrize(
    ("cob_id", "period_us"), [(0x80, 0), (0x80, 500), (0x80 | PRODUCES, 1000), (0x85, 0)]
)
def test_a_drive_produces_last_and_gets_its_objects_back(cob_id: int, period_us: int) -> None:
    network, bus = cell()
    node = with_sync_objects(bus.nodes[1], cob_id, period_us)
    with network:
        with DriveProducer(network, 1, PERIOD_US) as producer:
            assert network.link.sync_producer is None
            producer.start()
            assert network.link.sync_producer == "J2"
            assert written(bus, 2) == [
                (0x1005, 0x80),
                (0x1006, PERIOD_US),
                (0x1005, 0x80 | PRODUCES),
            ]
            bus.sent.clear()
        assert network.link.sync_producer is None
        assert written(bus, 2)[0] == (0x1005, 0x80)  # it falls silent first
        assert node.value(0x1005, 0) == cob_id
        assert node.value(0x1006, 0) == period_us


@pytest.mark.parametrize("cob_id", [0x85, 0x85 | PRODUCES])
def test_a_drive_whose_identifier_is_fixed_while_it_produces_gets_its_own_back(
    monkeypatch: pytest.MonkeyPatch, cob_id: int
) -> None:
    """CiA 301, 1005h: bits 0 to 29 must not change while bit 30 is 1."""
    network, bus = cell()
    node = with_sync_objects(bus.nodes[1], cob_id, 500)
    answer = node.sdo

    def strict_answer(data: bytes) -> bytes | None:
        is_write = data[0] >> 5 == 1
        if is_write and data[1:4] == bytes((0x05, 0x10, 0)):
            before = node.value(0x1005, 0)
            changed = before ^ int.from_bytes(data[4:8], "little")
            if before & PRODUCES and changed & (PRODUCES - 1):
                return abort_answer(0x1005, 0, 0x06090030)
        return answer(data)

    monkeypatch.setattr(node, "sdo", strict_answer)
    with network:
        with DriveProducer(network, 1, PERIOD_US) as producer:
            producer.start()
        assert node.value(0x1005, 0) == cob_id
        assert node.value(0x1006, 0) == 500


def test_a_drive_pauses_without_being_waited_for_and_starts_again() -> None:
    network, bus = cell()
    node = with_sync_objects(bus.nodes[1], 0x80, 500)
    with network:
        with DriveProducer(network, 1, PERIOD_US) as producer:
            producer.pause()
            assert bus.sent == []  # it was not started
            producer.start()
            bus.sent.clear()
            begun_ns = bus.clock.now_ns
            producer.pause()
            assert bus.clock.now_ns == begun_ns
            assert node.value(0x1005, 0) == 0x80
            assert network.link.sync_producer == "J2"  # a SYNC on its way is no foreign one
            producer.start()
            assert node.value(0x1005, 0) == 0x80 | PRODUCES
        assert node.value(0x1005, 0) == 0x80
        assert node.value(0x1006, 0) == 500


def test_a_drive_that_rests_goes_on_in_its_phase() -> None:
    network, bus = cell()
    node = with_sync_objects(bus.nodes[1], 0x80, 500)
    with network, DriveProducer(network, 1, PERIOD_US) as producer:
        producer.start()
        bus.sent.clear()
        producer.rest()
        assert bus.sent == []
        assert node.value(0x1005, 0) == 0x80 | PRODUCES


def test_the_kernel_that_rests_sends_no_sync_and_stays_the_producer() -> None:
    network, _ = cell()
    near, far = socket.socketpair()
    with network, far, KernelProducer(network, PERIOD_US) as producer:
        producer._socket = near
        network.link.sync_producer = producer.name
        producer.rest()
        # The broadcast manager ends with its socket.
        assert near.fileno() == -1
        assert network.link.sync_producer == "the kernel"  # a SYNC on its way is no foreign one


def test_a_drive_that_cannot_produce_says_so_and_is_given_back() -> None:
    network, bus = cell()
    first_node = bus.nodes[0]
    node = with_sync_objects(first_node, period_us=7)
    node.aborts[0x1006, 0] = 0x06010002
    refused = pytest.raises(ObjectAccessError, match="1006h")
    with network, refused as refusal, DriveProducer(network, 0, PERIOD_US) as producer:
        producer.start()
    assert node.value(0x1005, 0) == 0x80
    assert network.link.sync_producer is None
    assert "while stopping SYNC" in " ".join(refusal.value.__notes__)


def test_a_drive_that_refuses_one_object_gets_the_other_back() -> None:
    network, bus = cell()
    node = with_sync_objects(bus.nodes[0], 0x85, 7)
    node.aborts[0x1006, 0] = 0x06010002
    refused = pytest.raises(ObjectAccessError, match="1006h")
    with network, refused as refusal, DriveProducer(network, 0, PERIOD_US) as producer:
        producer.start()
    assert node.value(0x1005, 0) == 0x85
    (note,) = refusal.value.__notes__
    assert "1006h" in note


def test_each_object_that_a_drive_does_not_get_back_is_named() -> None:
    network, bus = cell()
    node = with_sync_objects(bus.nodes[0], 0x85, 7)
    refused = pytest.raises(ObjectAccessError, match="1005h")
    with network:
        with refused as refusal, DriveProducer(network, 0, PERIOD_US) as producer:
            producer.start()
            node.aborts[0x1005, 0] = 0x08000022
            node.aborts[0x1006, 0] = 0x08000022
        assert network.link.sync_producer is None
        (note,) = refusal.value.__notes__
        assert "while stopping SYNC" in note
        assert "1006h" in note


def test_what_a_drive_does_not_get_back_is_noted_at_the_error_that_ended_the_run() -> None:
    network, bus = cell()
    node = with_sync_objects(bus.nodes[0], 0x85, 7)
    error = RuntimeError("a full disk")
    failed = pytest.raises(RuntimeError, match="a full disk")
    with network, failed, DriveProducer(network, 0, PERIOD_US) as producer:
        producer.start()
        node.aborts[0x1005, 0] = 0x08000022
        node.aborts[0x1006, 0] = 0x08000022
        raise error
    of_identifier, of_period = error.__notes__
    assert "while stopping SYNC" in of_identifier
    assert "1005h" in of_identifier
    assert "while stopping SYNC" in of_period
    assert "1006h" in of_period


def test_a_drive_that_has_fallen_silent_is_not_asked() -> None:
    network, bus = cell()
    with_sync_objects(bus.nodes[0])
    with network:
        with DriveProducer(network, 0, PERIOD_US) as producer:
            producer.start()
            bus.sent.clear()
            network.link.silent.add(1)
        assert written(bus, 1) == []


def test_a_producer_that_was_not_started_changes_nothing() -> None:
    network, bus = cell()
    with network:
        with DriveProducer(network, 0, PERIOD_US), KernelProducer(network, PERIOD_US):
            pass
        assert bus.sent == []


def test_the_kernel_sends_on_its_own_buses_alone() -> None:
    network, _ = cell()
    with network, KernelProducer(network, PERIOD_US) as producer:
        with pytest.raises(BusError, match="needs one bus of interface socketcan"):
            producer.start()
        assert network.link.sync_producer is None


@pytest.mark.parametrize("period_us", [1000, 20_000, 1_000_000])
def test_the_kernel_sends_for_less_than_the_amplifiers_wait_and_then_no_more(
    period_us: int,
) -> None:
    """Struct bcm_msg_head: `count` frames every ival1, and then, with ival2 = 0, none."""
    opcode, flags, count, *rest = struct.unpack_from("@3I4l2I0q", setup_message(1, period_us))
    expected = (1, 1, [*divmod(period_us, 1_000_000), 0, 0, 0x80, 1])
    assert (opcode, flags, rest) == expected
    largest_expected = max(3, 400_000 // period_us)
    assert count == largest_expected
