"""Parameters of scripted drives are read, and written in all drives or in none."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import can
import pytest

from drivers.canopen.network import CanopenNetwork
from drivers.canopen.parameters import (
    ParameterChange,
    ParameterValue,
    ParameterWrite,
    Saving,
    read_parameters,
    recording_leftover,
    write_parameters,
)
from drivers.errors import BusError, ObjectAccessError, ParameterRefused, ParametersMixed
from drivers.profiles.profile import (
    DriveParameter,
    Identity,
    Mapping,
    ObjectEntry,
    ParameterKind,
    Save,
)
from tests.drivers.scripted import ScriptedBus, cell

GAIN = DriveParameter(0x2003, 1, ParameterKind.I32)
SAVE_COMMAND = ObjectEntry(0x1010, 1, 32)
SIGNATURE = 0x65766173
OLD = 100
NEW = 200
OPERATION_ENABLED = 0x237


def drives(
    mapping: Mapping | None = Mapping.SEPARATE, axes: int = 3
) -> tuple[CanopenNetwork, ScriptedBus]:
    """Drives with a gain and, unless the mapping is None, a known save."""
    network, bus = cell(axes)
    for node in bus.nodes:
        node.objects[0x2003, 1] = (OLD, 4)
        node.objects[0x1010, 1] = (0, 4)
    if mapping is not None:
        save = Save(SAVE_COMMAND, SIGNATURE, mapping)
        network.axes = tuple(
            replace(axis, profile=replace(axis.profile, save=save)) for axis in network.axes
        )
    return network, bus


def writes_of(network: CanopenNetwork, *words: int) -> tuple[ParameterWrite, ...]:
    """One write for each of the first axes."""
    return tuple(
        ParameterWrite(axis, GAIN, word) for axis, word in zip(network.axes, words, strict=False)
    )


def gains(bus: ScriptedBus) -> list[int]:
    return [node.value(0x2003, 1) for node in bus.nodes]


def saves(bus: ScriptedBus) -> list[int]:
    """Nodes that were told to save, in order."""
    command = bytes((0x23, 0x10, 0x10, 0x01)) + SIGNATURE.to_bytes(4, "little")
    return [sent.arbitration_id - 0x600 for sent in bus.sent if bytes(sent.data) == command]


def downloads(bus: ScriptedBus) -> int:
    """Number of objects that were written or tried."""
    return sum(0x600 < sent.arbitration_id < 0x680 and sent.data[0] >> 5 == 1 for sent in bus.sent)


def _ignore(_old: tuple[ParameterValue, ...]) -> None:
    """Nothing to do before the first write."""


def _refusal(network: CanopenNetwork, saving: Saving = Saving.KNOWN) -> str:
    with network, pytest.raises(ParameterRefused) as refusal:
        writes = writes_of(network, NEW, NEW, NEW)
        write_parameters(network, writes, saving, _ignore)
    return str(refusal.value)


def test_a_parameter_is_read_with_the_identity_of_its_own_drive() -> None:
    network, bus = drives()
    bus.nodes[1].store(0x2003, 1, 0xFFFF_FFFE)
    bus.nodes[1].store(0x1018, 4, 8)
    network.axes = tuple(replace(axis, identity=None) for axis in network.axes)
    with network:
        wanted = [(network.axes[1], GAIN), (network.axes[0], GAIN)]
        second, first = read_parameters(network, wanted)
    assert first.axis.name == "J1"
    assert first.word == OLD
    assert first.value == 100.0
    assert second.axis.name == "J2"
    assert second.word == 0xFFFF_FFFE
    assert second.value == -2.0
    assert first.identity == Identity(0x29A, 0x40200, 7)
    assert second.identity == Identity(0x29A, 0x40200, 8)
    assert downloads(bus) == 0


def test_every_drive_is_written_read_back_and_saved() -> None:
    network, bus = drives()
    before: list[tuple[int, ...]] = []

    def begin(old: tuple[ParameterValue, ...]) -> None:
        assert downloads(bus) == 0
        before.append(tuple(value.word for value in old))

    with network:
        writes = writes_of(network, 201, OLD, 203)
        changes = write_parameters(network, writes, Saving.KNOWN, begin)
    assert before == [(OLD, OLD, OLD)]
    assert gains(bus) == [201, OLD, 203]
    assert saves(bus) == [1, 2, 3]
    expected = (
        ParameterChange("J1", GAIN, OLD, 201, saved=True),
        ParameterChange("J2", GAIN, OLD, OLD, saved=True),
        ParameterChange("J3", GAIN, OLD, 203, saved=True),
    )
    assert changes == expected
    # Two gains that change, and three saves.
    assert downloads(bus) == 5


def test_written_to_ram_nothing_is_saved() -> None:
    network, bus = drives(mapping=None)
    with network:
        changes = write_parameters(network, writes_of(network, NEW), Saving.RAM, _ignore)
    assert gains(bus) == [NEW, OLD, OLD]
    assert saves(bus) == []
    expected = (ParameterChange("J1", GAIN, OLD, NEW, saved=False),)
    assert changes == expected


def test_a_record_that_fails_before_the_first_write_leaves_the_drives_alone() -> None:
    network, bus = drives()

    def begin(_old: tuple[ParameterValue, ...]) -> None:
        raise OSError("the disk is full")

    with network, pytest.raises(OSError, match="the disk is full"):
        write_parameters(network, writes_of(network, NEW), Saving.KNOWN, begin)
    assert downloads(bus) == 0


def test_one_axis_with_power_forbids_every_write_although_it_is_not_written() -> None:
    network, bus = drives()
    bus.nodes[2].statusword = OPERATION_ENABLED
    with network, pytest.raises(ParameterRefused) as refusal:
        write_parameters(network, writes_of(network, NEW), Saving.KNOWN, _ignore)
    expected = "J3 (node 3): OPERATION ENABLED (statusword 0x0237): its power stage is not off"
    assert str(refusal.value).startswith(expected)
    assert refusal.value.node_id == 3
    assert downloads(bus) == 0


def test_a_bus_that_fails_for_good_is_named_once_with_all_drives_behind_it() -> None:
    network, bus = drives()
    third = bus.nodes[2]

    def cut_the_wire(sent: can.Message) -> list[can.Message]:
        bus.broken = third.value(0x2003, 1) == NEW
        return [sent]

    bus.tamper = cut_the_wire
    with suppress(BusError), network:
        writes = writes_of(network, NEW, NEW, NEW)
        with pytest.raises(ParametersMixed) as failure:
            write_parameters(network, writes, Saving.KNOWN, _ignore)
    assert failure.value.restored == ()
    (problem,) = failure.value.problems
    assert problem.startswith("J1, J2, J3: bus ")
    assert problem.endswith("the wire was cut")


def test_power_that_comes_with_the_second_write_puts_the_first_back() -> None:
    network, bus = drives()
    first, second, _ = bus.nodes
    power_up(bus, lambda: second.value(0x2003, 1) == NEW)
    with network, pytest.raises(ParametersMixed) as failure:
        writes = writes_of(network, NEW, NEW, NEW)
        write_parameters(network, writes, Saving.KNOWN, _ignore)
    # What has power is not written any more, so that drive keeps the new gain and is named.
    assert gains(bus) == [OLD, NEW, OLD]
    assert failure.value.restored == ("J1",)
    (problem,) = failure.value.problems
    assert problem.startswith("J2 (node 2): OPERATION ENABLED")
    assert isinstance(failure.value.__cause__, ParameterRefused)
    assert saves(bus) == []
    assert first.value(0x2003, 1) == OLD


def power_up(bus: ScriptedBus, when: Callable[[], bool]) -> None:
    """Give the second drive power as soon as something is so."""

    def tamper(message: can.Message) -> tuple[can.Message, ...]:
        if when():
            bus.nodes[1].statusword = OPERATION_ENABLED
        return (message,)

    bus.tamper = tamper


def test_an_abort_puts_back_what_was_written_and_says_where() -> None:
    network, bus = drives()
    bus.nodes[1].aborts[0x2003, 1] = 0x0609_0030
    with network, pytest.raises(ObjectAccessError) as failure:
        writes = writes_of(network, NEW, NEW, NEW)
        write_parameters(network, writes, Saving.KNOWN, _ignore)
    assert failure.value.abort_code == 0x0609_0030
    assert gains(bus) == [OLD, OLD, OLD]
    assert "kept: the previous values are restored in J1, J2" in failure.value.__notes__
    assert saves(bus) == []


def test_a_save_that_is_aborted_saves_the_old_values_where_new_ones_were_saved() -> None:
    network, bus = drives()
    bus.nodes[1].aborts[0x1010, 1] = 0x0800_0020
    with network, pytest.raises(ObjectAccessError) as failure:
        writes = writes_of(network, NEW, NEW, NEW)
        write_parameters(network, writes, Saving.KNOWN, _ignore)
    assert gains(bus) == [OLD, OLD, OLD]
    # The second drive has saved nothing, as its abort says, and the third was not told to.
    assert saves(bus) == [1, 2, 1]
    assert "kept: the previous values are restored in J1, J2, J3" in failure.value.__notes__


def test_a_value_that_reads_back_otherwise_is_shown_in_numbers_and_bits() -> None:
    network, bus = drives()
    bus.nodes[0].lies[0x2003, 1] = 0xFFFF_FFFF
    with network, pytest.raises(ParameterRefused) as failure:
        write_parameters(network, writes_of(network, NEW), Saving.KNOWN, _ignore)
    assert str(failure.value).startswith(
        "J1 (node 1): object 2003h:01 reads back as -1 (0xffffffff), written was 200 (0xc8); does"
    )


def test_a_drive_without_a_known_save_is_refused_before_anything_is_written() -> None:
    network, bus = drives(mapping=None)
    text = _refusal(network)
    assert text.startswith("J1 (node 1): nothing was written, because saving it is not described")
    assert "its profile generic; describe it there" in text
    assert downloads(bus) == 0


def test_a_save_of_unknown_extent_is_made_only_if_asked_for() -> None:
    network, bus = drives(Mapping.UNKNOWN)
    assert "may store more than the gain (generic: )" in _refusal(network)
    assert downloads(bus) == 0
    network, bus = drives(Mapping.UNKNOWN)
    with network:
        write_parameters(network, writes_of(network, NEW), Saving.ANY, _ignore)
    assert saves(bus) == [1]


def test_what_a_killed_recording_left_is_found_where_a_save_would_keep_it() -> None:
    network, bus = drives(Mapping.STORED)
    node = bus.nodes[0]
    node.objects[0x1600, 0] = (1, 1)
    with network:
        assert recording_leftover(network, network.axes[0]) == ""
    # TPDO1 with our three objects after each SYNC, as a recording maps it.
    for sub, entry in enumerate((0x60640020, 0x60740010, 0x60410010), start=1):
        node.store(0x1A00, sub, entry)
    node.store(0x1A00, 0, 3)
    node.store(0x1800, 2, 1)
    with network:
        left = recording_leftover(network, network.axes[0])
    assert re.fullmatch(r"TPDO1: .*60640020 60740010 60410010", left)
    text = _refusal(network)
    assert f"would keep settings of a recording that was killed ({left})" in text
    assert downloads(bus) == 0


def test_a_mapping_like_ours_of_another_transmission_is_no_recordings() -> None:
    network, bus = drives(Mapping.STORED)
    node = bus.nodes[0]
    for sub, entry in enumerate((0x60640020, 0x60740010, 0x60410010), start=1):
        node.store(0x1A00, sub, entry)
    node.store(0x1A00, 0, 3)
    node.store(0x1800, 2, 254)
    with network:
        assert recording_leftover(network, network.axes[0]) == ""


def test_a_watch_for_the_recorders_heartbeat_is_found_behind_another() -> None:
    network, bus = drives(Mapping.STORED)
    node = bus.nodes[0]
    node.objects[0x1016, 0] = (2, 1)
    node.objects[0x1016, 1] = (0x0005_0064, 4)
    with network:
        # Node 127, as the highest free id on this bus, watched for 100 ms.
        node.objects[0x1016, 2] = (0x007F_0064, 4)
        ours = network.was_ours(0x007F_0064)
        left = recording_leftover(network, network.axes[0])
    assert ours
    assert left == "1016h:02 = 007F0064h watches the recorder"
