"""An SDO abort at every step of the set-up:
each object that a drive may refuse, read or written.
"""

from __future__ import annotations

import struct

import pytest

from drivers.canopen.network import CanopenNetwork
from drivers.errors import SetupRefused
from tests.drivers.scripted import ScriptedBus, cell

ABORT = 0x08000022  #: "because of the present device state"
NODE = 1  #: index of the node that refuses
Step = tuple[str, int, int]
"""Read or write, index and sub-index."""
NOT_NEEDED: frozenset[Step] = frozenset(
    {
        ("read", 0x1000, 0),  # any answer shows that the node is there
        ("read", 0x1016, 0),  # without its watch the recording goes on, and says so
        ("read", 0x1016, 1),
        ("write", 0x1016, 1),
        ("read", 0x6007, 0),
        ("write", 0x6007, 0),
        ("read", 0x1019, 0),
        ("read", 0x6502, 0),
        # Present, though they cannot be read now: a PDO carries them.
        *(("read", index, 0) for index in (0x6040, 0x6064, 0x6074, 0x607A, 0x6081, 0x6083)),
    }
)


def rich_cell() -> tuple[CanopenNetwork, ScriptedBus]:
    """Drives with the objects that are optional, too."""
    network, bus = cell(2)
    for node in bus.nodes:
        node.objects |= {(0x1016, 0): (1, 1), (0x1016, 1): (0, 4), (0x6007, 0): (1, 2)}
    return network, bus


def steps_of_setup() -> list[Step]:
    """Every object that the set-up of a drive reads or writes, in order."""
    network, bus = rich_cell()
    with network:
        network.prepare()
        frames = [frame for frame in bus.sent if frame.arbitration_id == 0x601 + NODE]
    found: dict[Step, None] = {}
    for frame in frames:
        command, index, sub = struct.unpack_from("<BHB", frame.data)
        found["read" if command == 0x40 else "write", index, sub] = None
    return list(found)


STEPS = steps_of_setup()


def test_the_steps_are_those_of_a_whole_setup() -> None:
    assert len(STEPS) > 80
    indices = {index for _, index, _ in STEPS}
    assert indices >= {
        0x1016,
        0x1017,
        0x1018,
        0x1400,
        0x1600,
        0x1800,
        0x1A00,
        0x6007,
        0x6041,
        0x6060,
        0x6061,
        0x6075,
    }


@pytest.mark.parametrize("step", STEPS, ids=lambda step: f"{step[0]}-{step[1]:04X}h-{step[2]:02X}")
def test_an_abort_names_axis_object_and_remedy_and_the_other_axis_is_restored(step: Step) -> None:
    action, index, sub = step
    network, bus = rich_cell()
    refusing = bus.nodes[NODE]
    if action == "read":
        aborts = refusing.read_aborts
    else:
        aborts = refusing.aborts
    aborts[index, sub] = ABORT
    settings = [
        (0x1017, 0),
        (0x6060, 0),
        (0x6007, 0),
        (0x1016, 1),
        (0x1800, 1),
        (0x1800, 2),
        (0x1A00, 0),
        (0x1400, 1),
    ]
    before = [bus.nodes[0].value(*key) for key in settings]
    try:
        with network:
            network.prepare()
            is_ready = True
    except SetupRefused as refused:
        is_ready = False
        said = str(refused)
        assert said.startswith("J2 (node 2): ")
        assert refused.node_id == 2
        is_of_identity = index == 0x1018 and sub > 1
        assert is_of_identity or f"{index:04X}h:{sub:02X}" in said
        assert is_of_identity or "present device state" in said
        assert "expect" in said
        assert said.count(";") >= 1  # and what to do
    # PDOs of fewer objects are mapped instead
    unused = {("write", 0x1A00, 3), ("write", 0x1601, 2)}
    assert is_ready is (step in NOT_NEEDED | unused)
    assert [bus.nodes[0].value(*key) for key in settings] == before
    for node in bus.nodes:
        assert node.statusword & 0x6F == 0x40
