"""One node on the bus: SDO, PDO mapping rules, NMT and stored parameters, as CiA 301 wants them."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace

import can
import canopen
import pytest

from drivers.simulation.cell import SimulatedCell
from tests.drivers.simulation.cells import STOPPED_CLOCK, Master, clean_cell, running

SIX = range(1, 7)

UNSUPPORTED = 0x06010000
NO_OBJECT = 0x06020000
NO_SUBINDEX = 0x06090011
READ_ONLY = 0x06010002
NOT_MAPPABLE = 0x06040041
TOO_LONG_PDO = 0x06040042
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
INVALID_VALUE = 0x06090030


@pytest.fixture
def master(request: pytest.FixtureRequest) -> Iterator[Master]:
    with running(clean_cell(), request.node.name) as (_, master):
        yield master


def test_boot_up_and_identity(master: Master) -> None:
    for axis in clean_cell().axes:
        found = [master.read(axis.node_id, 0x1018, sub, "I") for sub in range(1, 5)]
        expected = [axis.vendor_id, axis.product_code, axis.revision, axis.serial]
        assert found == expected
        assert master.read(axis.node_id, 0x1000, 0, "I") & 0xFFFF == 402
    boots = [can_id for can_id, data in master.others if data == b"\x00"]
    node_ids = [0x700 + node_id for node_id in SIX]
    assert boots == node_ids


def test_an_independent_sdo_client_understands_the_server(request: pytest.FixtureRequest) -> None:
    channel = request.node.name
    with (
        can.Bus(interface="virtual", channel=channel) as far,
        SimulatedCell(clean_cell(), far, STOPPED_CLOCK),
    ):
        network = canopen.Network()
        network.connect(interface="virtual", channel=channel)
        try:
            node = network.add_node(3, canopen.ObjectDictionary())
            # Segmented
            text = node.sdo.upload(0x1008, 0).decode()
            assert text == "drivegain simulated CiA 402 amplifier"
            packed = struct.pack("<I", 1234)
            node.sdo.download(0x6081, 0, packed)
            expected = struct.pack("<I", 1234)
            assert node.sdo.upload(0x6081, 0) == expected
            node.sdo.download(0x6083, 0, struct.pack("<I", 77), force_segment=True)
            assert node.sdo.upload(0x6083, 0) == struct.pack("<I", 77)
            with pytest.raises(canopen.SdoAbortedError) as caught:
                node.sdo.upload(0x2000, 0)
            assert caught.value.code == NO_OBJECT
        finally:
            network.disconnect()


@pytest.mark.parametrize(
    ("index", "subindex", "kind", "value", "abort"),
    [
        (0x2000, 0, "I", 0, NO_OBJECT),
        (0x1018, 9, "I", 0, NO_SUBINDEX),
        (0x6064, 0, "i", 0, READ_ONLY),
        (0x6040, 0, "I", 6, TOO_LONG),
        (0x607A, 0, "H", 6, TOO_SHORT),
        (0x6060, 0, "b", 8, INVALID_VALUE),
        (0x6081, 0, "I", 0, INVALID_VALUE),
        (0x1010, 1, "I", 1, 0x08000020),
        (0x1405, 1, "I", 0, NO_OBJECT),
        (0x1800, 2, "B", 245, INVALID_VALUE),
        (0x1800, 4, "B", 0, NO_SUBINDEX),
        (0x1800, 1, "I", 0x40000222, INVALID_VALUE),  # another identifier while the PDO exists
        (0x1A00, 0, "B", 0, UNSUPPORTED),  # mapped while the PDO exists
    ],
)
def test_refusals(
    master: Master, index: int, subindex: int, kind: str, value: int, abort: int
) -> None:
    assert master.write(2, index, subindex, kind, value) == abort


def test_mapping_in_the_right_order_and_in_no_other(master: Master) -> None:
    assert master.write(1, 0x1800, 1, "I", 0xC0000181) == 0
    assert master.write(1, 0x1A00, 1, "I", 0x60640020) == UNSUPPORTED  # count is not zero yet
    assert master.write(1, 0x1A00, 0, "B", 0) == 0
    assert master.write(1, 0x1A00, 1, "I", 0x60640010) == NOT_MAPPABLE  # wrong width
    assert master.write(1, 0x1A00, 1, "I", 0x60810020) == NOT_MAPPABLE  # not a transmit object
    assert master.write(1, 0x1A00, 1, "I", 0x20000020) == NO_OBJECT
    for k, entry in enumerate((0x60640020, 0x606C0020, 0x60740010), start=1):
        assert master.write(1, 0x1A00, k, "I", entry) == 0
    assert master.write(1, 0x1A00, 0, "B", 3) == TOO_LONG_PDO
    assert master.write(1, 0x1A00, 0, "B", 2) == 0
    assert master.write(1, 0x1800, 1, "I", 0x40000181) == 0
    assert [master.read(1, 0x1A00, k, "I" if k else "B") for k in range(3)] == [
        2,
        0x60640020,
        0x606C0020,
    ]


def test_transmission_type_counts_syncs(master: Master) -> None:
    master.set_up(SIX)
    assert master.write(1, 0x1800, 2, "B", 3) == 0
    frames: list[int] = []
    for _ in range(9):
        master.sync(5 + ((len(frames) + 1) % 3 == 0))
        frames.append(sum(can_id == 0x181 for can_id, _ in master.answers))
    expected = [0, 0, 1, 1, 1, 2, 2, 2, 3]
    assert frames == expected


def test_synchronous_receive_pdos_wait_for_sync_and_event_driven_ones_do_not(
    master: Master,
) -> None:
    master.set_up(SIX)
    master.control(SIX, 0x06)
    found = master.read(1, 0x6041, 0, "H") & 0x6F
    assert found == 0x40
    master.sync()
    assert master.read(1, 0x6041, 0, "H") & 0x6F == 0x21
    assert master.write(1, 0x1400, 2, "B", 255) == 0
    master.send(0x201, struct.pack("<H", 0x07))
    assert master.read(1, 0x6041, 0, "H") & 0x6F == 0x23


def test_event_driven_transmit_pdo_reports_a_change_of_state(master: Master) -> None:
    master.send(0x000, bytes([1, 4]))
    assert master.receive()[0] == 0x701  # boot-ups first
    for _ in range(5):
        master.receive()
    expected = (0x184, struct.pack("<H", 0x0250))
    assert master.receive() == expected
    assert master.write(4, 0x6040, 0, "H", 0x06) == 0
    assert master.receive() == (0x184, struct.pack("<H", 0x0231))


def test_a_stopped_node_is_silent_but_for_its_heartbeat(master: Master) -> None:
    master.set_up(SIX)
    master.sync()
    master.send(0x000, bytes([2, 3]))
    packed = struct.pack("<BHBI", 0x40, 0x6041, 0, 0)
    master.send(0x603, packed)
    master.others.clear()
    for _ in range(250):
        answer = master.sync(5)
        assert len(answer) == 5
    can_ids = [can_id for can_id, _ in master.answers[6:] if can_id == 0x183]
    assert not can_ids
    assert not [can_id for can_id, _ in master.others if can_id == 0x583]
    assert master.read(2, 0x6041, 0, "H")  # the others still answer
    master.send(0x000, bytes([1, 3]))
    assert len(master.sync(6)) == 6


def test_heartbeats_follow_plant_time_and_report_the_nmt_state(master: Master) -> None:
    master.set_up(SIX)
    assert master.write(5, 0x1017, 0, "H", 10) == 0
    master.send(0x000, bytes([0x80, 5]))
    for _ in range(101):
        master.sync(5)
    beats = [data for can_id, data in master.others if can_id == 0x705 and data != b"\x00"]
    assert beats == [b"\x7f"] * 10


def test_heartbeats_come_by_wall_time_without_sync(request: pytest.FixtureRequest) -> None:
    now_s = [0.0]

    def clock() -> float:
        now_s[0] += 0.03  # each look at the clock finds it later
        return now_s[0]

    channel = request.node.name
    with (
        can.Bus(interface="virtual", channel=channel) as near,
        can.Bus(interface="virtual", channel=channel) as far,
        SimulatedCell(clean_cell(), far, clock),
    ):
        seen = [Master(near).receive() for _ in range(18)]
    expected = [(0x700 + node_id, b"\x00") for node_id in SIX]
    assert seen[:6] == expected
    assert seen[6:12] == [(0x700 + node_id, b"\x7f") for node_id in SIX]


def test_reset_brings_back_defaults_or_what_was_saved(master: Master) -> None:
    default = master.read(6, 0x6081, 0, "I")
    assert master.write(6, 0x6081, 0, "I", 4321) == 0
    master.send(0x000, bytes([0x81, 6]))
    assert master.read(6, 0x6081, 0, "I") == default
    assert master.write(6, 0x6081, 0, "I", 4321) == 0
    found = master.write(6, 0x1010, 1, "I", int.from_bytes(b"save", "little"))
    assert found == 0
    assert master.write(6, 0x6081, 0, "I", 99) == 0
    master.send(0x000, bytes([0x81, 6]))
    assert master.read(6, 0x6081, 0, "I") == 4321
    assert master.write(6, 0x1011, 1, "I", int.from_bytes(b"load", "little")) == 0
    master.send(0x000, bytes([0x81, 6]))
    assert master.read(6, 0x6081, 0, "I") == default


def test_no_object_reports_the_true_gain(request: pytest.FixtureRequest) -> None:
    reported = []
    for scale in (1.0, 1.3):
        spec = clean_cell()
        axes = tuple(replace(axis, gain_nm_per_a=scale * axis.gain_nm_per_a) for axis in spec.axes)
        with can.Bus(interface="virtual", channel=request.node.name) as far:
            changed_spec = replace(spec, axes=axes)
            cell = SimulatedCell(changed_spec, far, STOPPED_CLOCK)
            entries = []
            for i in range(0x1000, 0x7000):
                for s in range(9):
                    if not 0x1400 <= i <= 0x1BFF:
                        entries.append((i, s))
            known = [
                key for key in entries if key in cell.nodes[0]._dictionary and key != (0x1003, 1)
            ]
            objects: list[bytes] = []
            for node in cell.nodes:
                objects += [node.read(*key) for key in known]
            reported.append(objects)
    assert len(reported[0]) > 200
    assert reported[0] == reported[1]
