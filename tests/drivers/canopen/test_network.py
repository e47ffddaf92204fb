"""The network of a cell against scripted nodes that deviate one at a time."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.canopen.link import NmtCommand, NmtState
from drivers.canopen.network import Bounds, CanopenNetwork
from drivers.canopen.sdo import SdoPolicy
from drivers.errors import (
    POWERED,
    WHILE,
    BusError,
    DriverError,
    MotionRefused,
    NodeMisplaced,
    NodeMissing,
    ObjectAccessError,
    SetupRefused,
    StateRefused,
)
from drivers.messages import EventKind
from drivers.profiles.cia402 import State
from drivers.profiles.profile import Axis, Identity, ObjectEntry
from tests.drivers.scripted import (
    ADDRESS,
    PROFILE,
    FakeClock,
    ScriptedBus,
    ScriptedNode,
    cell,
    lose_first_answer,
)

STATUSWORD = ObjectEntry(0x6041, 0, 16)
COMMANDED = {(0x6040, 0), (0x6041, 0)}  #: Controlword and statusword are no settings


def error_frame(identifier: int) -> can.Message:
    """An error frame of the controller of this end."""
    return can.Message(
        arbitration_id=identifier,
        is_extended_id=True,
        is_error_frame=True,
        data=bytes(8),
    )


def is_request(message: can.Message) -> bool:
    """Whether a frame is an SDO request."""
    return 0x600 < message.arbitration_id < 0x680


def written_indices(bus: ScriptedBus) -> list[int]:
    """Indices of the objects that SDO requests have written."""
    indices = []
    for message in bus.sent:
        if not is_request(message):
            continue
        command, low, high = message.data[:3]
        if command >> 5 == 1:
            indices.append(high << 8 | low)
    return indices


def silence(bus: ScriptedBus, node_id: int) -> None:
    """Let a node answer no SDO request any more."""

    def without_answers(message: can.Message) -> tuple[can.Message, ...]:
        if message.arbitration_id == 0x580 + node_id:
            return ()
        return (message,)

    bus.tamper = without_answers


def test_scan_reports_who_is_there_and_changes_nothing() -> None:
    network, bus = cell(2)
    bus.nodes[1].nmt = 4  # stopped: answers no SDO, but says so by heartbeat
    bus.nodes[1].store(0x1017, 0, 10)
    before = [copy.deepcopy(node.objects) for node in bus.nodes]
    with network:
        first, second = network.scan(wait_s=0.05)
    expected = Identity(0x29A, 0x40200, 7)
    assert first.identity == expected
    assert first.node_id == 1
    assert first.device_name == "axis"
    assert first.state == State.SWITCH_ON_DISABLED
    assert second.node_id == 2
    assert second.identity is None
    assert second.nmt == NmtState.STOPPED
    for node, objects in zip(bus.nodes, before, strict=True):
        after = dict(node.objects)
        # A statusword is no setting.
        del after[0x6041, 0]
        del objects[0x6041, 0]
        assert after == objects
    frames = [frame for frame in bus.sent if frame.arbitration_id < 0x580]
    assert not frames


def test_a_node_without_name_and_serial_is_described_as_far_as_it_reports() -> None:
    network, bus = cell(1)
    for key in ((0x1008, 0), (0x1018, 4), (0x6041, 0)):
        del bus.nodes[0].objects[key]
    with network:
        (found,) = network.scan(wait_s=0.05)
    expected = Identity(0x29A, 0x40200, None)
    assert found.identity == expected
    assert found.device_name is None
    assert found.state is None


def test_a_node_with_a_vendor_alone_has_an_identity() -> None:
    network, bus = cell(1)
    for subindex in (2, 3, 4):
        del bus.nodes[0].objects[0x1018, subindex]
    changed_axis = replace(network.axes[0], identity=Identity(0x29A))
    network.axes = (changed_axis,)
    with network:
        (found,) = network.scan(wait_s=0.05)
        identities = network.check_identities()
    assert identities == (Identity(0x29A),)
    assert found.identity == Identity(0x29A)
    assert found.problems == ()


def test_prepare_sets_up_and_leaving_restores_everything() -> None:
    network, bus = cell(2)
    before = [copy.deepcopy(node.objects) for node in bus.nodes]
    with network:
        network.prepare()
        node = bus.nodes[0]
        assert node.nmt == NmtState.OPERATIONAL
        assert node.value(0x1800, 1) == 0x181
        assert node.value(0x1800, 2) == 1
        assert node.value(0x1A00, 0) == 3
        mapping = [node.value(0x1A00, sub) for sub in (1, 2, 3)]
        assert mapping == [
            0x60640020,
            0x60740010,
            0x60410010,
        ]
        assert node.value(0x1801, 1) >> 31 == 1  # the default TPDO2 would come between ours
        assert node.value(0x6061, 0) == 1
        assert network.ampere_per_unit() == pytest.approx((0.002, 0.002))
        report = network.readback()["J1"]
        assert isinstance(report, dict)
        assert report["serial"] == 7
        assert report["scale_objects"] == {"6075h:00": 2000}
        assert report["amplitude"] == "rms"
        assert report["tap"] == "reference"
        assert report["mapping"][0] == "TPDO1: COB-ID 00000181h, type 1, 60640020 60740010 60410010"
    for node, objects in zip(bus.nodes, before, strict=True):
        assert node.nmt == NmtState.PRE_OPERATIONAL
        for key, value in objects.items():
            index, sub = key
            # Entries beyond the count mean nothing.
            is_mapping = 0x1600 <= index < 0x1C00 and sub > 1
            if key not in COMMANDED and not is_mapping:
                assert node.objects[key] == value, key


def test_a_body_that_fails_still_restores() -> None:
    network, bus = cell(1)
    with pytest.raises(MotionRefused), network:
        network.prepare()
        raise MotionRefused("whatever")
    assert bus.nodes[0].value(0x1800, 2) == 255
    assert bus.nodes[0].nmt == NmtState.PRE_OPERATIONAL


def test_an_axis_that_someone_enabled_is_without_power_afterwards() -> None:
    network, bus = cell(1)
    with network:
        network.prepare()
        for command in (6, 7, 15):
            bus.nodes[0].control(command, 0)
        first_statusword = network.statuswords()[0]
        assert first_statusword & 0x6F == 0x27
    statusword = bus.nodes[0].statusword
    assert statusword & 0x6F == 0x40


@pytest.mark.slow
def test_an_axis_that_stays_in_quick_stop_is_without_power_afterwards() -> None:
    network, bus = cell(1)
    bus.nodes[0].quick_stop_stays = True
    with network:
        network.prepare()
        for command in (6, 7, 15):
            bus.nodes[0].control(command, 0)
    statusword = bus.nodes[0].statusword
    assert statusword & 0x6F == 0x40


def test_axes_that_stay_in_quick_stop_are_waited_for_together() -> None:
    """Their ramps run at the same time: one after the other would take longer than a closing
    network has.
    """
    network, bus = cell(5)
    with network:
        network.prepare()
        for node in bus.nodes:
            node.quick_stop_stays = True
            for command in (6, 7, 15):
                node.control(command, 0)
        begin_ns = bus.clock()
        ramp_end_ns = network.begin_stop(network.axes)
        for axis in network.axes:
            network.disable(axis, ramp_end_ns=ramp_end_ns)
        took_s = (bus.clock() - begin_ns) * 1e-9
    states = [node.statusword & 0x6F for node in bus.nodes]
    assert states == [0x40] * 5
    assert took_s < 2 * network.bounds.disable_s


def test_an_axis_whose_quick_stop_had_no_effect_gets_its_own_time_for_the_ramp() -> None:
    network, bus = cell(1)
    (node,) = bus.nodes
    with network:
        network.prepare()
        for command in (6, 7, 15):
            node.control(command, 0)
        node.quick_stop_stays = True
        over_ns = bus.clock() - 1
        begin_ns = bus.clock()
        network.disable(network.axes[0], ramp_end_ns=over_ns)
        written = [frame.data[4] for frame in bus.sent if frame.data[1:3] == b"\x40\x60"]
        took_s = (bus.clock() - begin_ns) * 1e-9
    assert written[-2] & 0x0F == 0x02  # quick stop, before its power is taken
    assert took_s < 2 * network.bounds.disable_s


def test_a_missing_node_is_named_with_those_that_answered() -> None:
    clock = FakeClock()
    nodes = (ScriptedNode(1),)
    bus = ScriptedBus(nodes, clock)
    axes = (Axis("J1", 1, PROFILE), Axis("J2", 2, PROFILE))
    network = CanopenNetwork(ADDRESS, axes, clock=clock, opener=lambda address: bus)
    with (
        network,
        pytest.raises(NodeMissing, match=r"J2 \(node 2\) did not answer .*answered: 1") as missing,
    ):
        network.prepare()
    assert missing.value.node_ids == (2,)


def test_nodes_have_a_second_to_answer_where_nothing_else_is_said() -> None:
    network, bus = cell(1)
    network.bounds = Bounds()
    bus.tamper = lambda _: ()
    with network:
        begun_ns = bus.clock.now_ns
        with pytest.raises(NodeMissing, match=r"did not answer within 1 s"):
            network.check_identities()
        taken_ns = bus.clock.now_ns - begun_ns
        assert taken_ns == pytest.approx(1e9, abs=5e6)


class LateBus(ScriptedBus):
    """A bus on which one frame comes at a time of its own.

    Attributes:
        late: the frame, and when it comes [ns].
    """

    late: tuple[int, can.Message] | None = None

    def _beat(self) -> None:
        super()._beat()
        if self.late is None:
            return
        at_ns, message = self.late
        if self.clock.now_ns >= at_ns:
            self.late = None
            self.inject(message)


@pytest.mark.parametrize(
    ("delay_ms", "words"), [(45, "two have it"), (60, r"1018h:01 \(identity\) refused")]
)
def test_a_second_device_has_50_ms_to_answer_after_a_refusal(delay_ms: int, words: str) -> None:
    clock = FakeClock()
    node = ScriptedNode(1)
    del node.objects[0x1018, 1]
    bus = LateBus((node,), clock)
    axes = (Axis("J1", 1, PROFILE),)
    policy = SdoPolicy(0.02, 2)
    network = CanopenNetwork(ADDRESS, axes, policy=policy, clock=clock, opener=lambda address: bus)
    identity = bytes.fromhex("431810019a020000")
    vendor = can.Message(arbitration_id=0x581, is_extended_id=False, data=identity)

    def answer_again(message: can.Message) -> tuple[can.Message, ...]:
        is_refusal = message.arbitration_id == 0x581 and message.data[0] == 0x80
        if is_refusal and bus.late is None:
            at_ns = clock.now_ns + delay_ms * 1_000_000
            bus.late = (at_ns, vendor)
        return (message,)

    bus.tamper = answer_again
    with network, pytest.raises(SetupRefused, match=words):
        network.check_identities()


@pytest.mark.parametrize(
    ("sub", "field", "number"),
    [(1, "vendor id", "0x1234"), (2, "product code", "0x1234"), (4, "serial number", "4660")],
    ids=["vendor", "product", "serial"],
)
def test_another_amplifier_is_refused_before_anything_is_written(
    sub: int, field: str, number: str
) -> None:
    network, bus = cell(2)
    bus.nodes[1].store(0x1018, sub, 0x1234)
    with network, pytest.raises(SetupRefused, match=rf"J2 \(node 2\): {field} .*is {number},"):
        network.prepare()
    assert written_indices(bus) == []


def test_a_node_that_ignores_nmt_is_refused() -> None:
    network, bus = cell(2)
    bus.nodes[1].obeys_nmt = False
    with (
        network,
        pytest.raises(
            StateRefused, match=r"J2 \(node 2\): asked for NMT OPERATIONAL.*PRE-OPERATIONAL"
        ),
    ):
        network.prepare()
    assert bus.nodes[0].value(0x1800, 2) == 255


def test_the_wait_for_an_nmt_state_is_counted_from_its_command() -> None:
    """It was "after 0 s" for a node that was asked behind others."""
    network, bus = cell(1)
    with network:
        bus.nodes[0].obeys_nmt = False
        since_ns = network.link.command_nmt(1, NmtCommand.START)
        bus.clock.now_ns += 2_000_000_000
        with pytest.raises(StateRefused, match="after 2 s"):
            network.link.confirm_nmt(1, NmtState.OPERATIONAL, since_ns, 0.0)


def test_a_node_without_heartbeat_cannot_confirm() -> None:
    network, bus = cell(1)
    bus.nodes[0].beats = False
    with pytest.raises(StateRefused, match="nothing") as refused, network:
        network.prepare()
    while_closing = [note for note in refused.value.__notes__ if "closing the network" in note]
    assert while_closing != []


@pytest.mark.parametrize("guard_ms", [None, 100])
def test_a_drive_that_answers_sdo_and_sends_no_heartbeat_is_named(guard_ms: int | None) -> None:
    """It was "its heartbeat still says nothing; read its error register"."""
    network, bus = cell(2)
    bus.nodes[1].beats = False
    if guard_ms is not None:
        bus.nodes[1].objects[0x100C, 0] = (guard_ms, 2)
    with pytest.raises(StateRefused) as refused, network:
        network.prepare()
    said = str(refused.value)
    assert "J2 (node 2)" in said
    assert "it answers SDO and sends no heartbeat (1017h = 20)" in said
    assert ("has node guarding (100Ch = 100)" in said) is (guard_ms is not None)
    assert "use a firmware of the drive that has heartbeats" in said


def test_a_drive_with_node_guarding_alone_is_refused_before_anything_is_written() -> None:
    network, bus = cell(2)
    del bus.nodes[1].objects[0x1017, 0]
    bus.nodes[1].objects[0x100C, 0] = (100, 2)
    with (
        network,
        pytest.raises(
            SetupRefused,
            match=r"no object 1017h:00 \(heartbeat period\).*node guarding \(100Ch\)",
        ),
    ):
        network.prepare()
    assert written_indices(bus) == []


REFUSED = 0x08000022  # "because of the present device state"
SETTINGS = (
    (0x1017, 0),
    (0x6060, 0),
    (0x1800, 1),
    (0x1800, 2),
    (0x1A00, 0),
    (0x1400, 1),
    (0x1600, 0),
)


def _settings_of(bus: ScriptedBus) -> list[list[int]]:
    """Values of the settings of each node."""
    found = []
    for node in bus.nodes:
        values = [node.value(index, sub) for index, sub in SETTINGS]
        found.append(values)
    return found


@pytest.mark.parametrize(
    ("index", "found", "expected", "remedy"),
    [
        (
            0x1017,
            "writing 1017h:00 is refused",
            "heartbeats of 20 ms",
            "firmware of the drive that has heartbeats",
        ),
        (
            0x6060,
            "writing 6060h:00 is refused",
            "profile position mode (1)",
            "choose the mode with its own tool",
        ),
    ],
)
def test_a_setting_that_a_drive_refuses_is_named_and_the_others_are_restored(
    index: int, found: str, expected: str, remedy: str
) -> None:
    """It was the bare abort code of an object."""
    network, bus = cell(2)
    bus.nodes[1].aborts[index, 0] = REFUSED
    before = _settings_of(bus)
    with pytest.raises(SetupRefused) as refused, network:
        network.prepare()
    after = _settings_of(bus)
    said = str(refused.value)
    assert said.startswith("J2 (node 2): found")
    for part in (found, "present device state", expected, remedy):
        assert part in said
    assert getattr(refused.value, "__notes__", []) == []
    assert after == before


@pytest.mark.parametrize(("modes", "named"), [(0b1, False), (0b1000_0000, True)])
def test_a_drive_without_profile_position_mode_is_told_from_one_that_is_in_another(
    modes: int, named: bool
) -> None:
    network, bus = cell(1)
    bus.nodes[0].aborts[0x6060, 0] = 0x06090030
    bus.nodes[0].objects[0x6502, 0] = (modes, 4)
    with pytest.raises(SetupRefused) as refused, network:
        network.prepare()
    assert ("6502h = 0x80, bit 0 is 0" in str(refused.value)) is named


def test_a_drive_that_waits_for_sync_with_a_counter_gets_it_without_and_its_own_setting_back() -> (
    None
):
    network, bus = cell(2)
    bus.nodes[1].objects[0x1019, 0] = (10, 1)
    with network:
        network.prepare()
        assert bus.nodes[1].value(0x1019, 0) == 0
        (answer, *_) = bus.nodes[1].on_sync(0)
        assert answer.arbitration_id == 0x182
    assert bus.nodes[1].value(0x1019, 0) == 10


def test_a_drive_that_keeps_waiting_for_a_counter_is_named() -> None:
    network, bus = cell(2)
    bus.nodes[1].objects[0x1019, 0] = (10, 1)
    # CiA 301: while its communication cycle period (1006h) is not 0
    bus.nodes[1].aborts[0x1019, 0] = REFUSED
    with (
        pytest.raises(
            SetupRefused, match=r"J2 .*writing 1019h:00 is refused.*counter \(1019h = 10\)"
        ),
        network,
    ):
        network.prepare()
    assert bus.nodes[1].on_sync(0) == []


class BootingNode(ScriptedNode):
    """Answers nothing until it has booted, and then sends its boot-up message."""

    def __init__(self, node_id: int, clock: FakeClock, boots_s: float) -> None:
        super().__init__(node_id)
        self._clock = clock
        self._up_ns = clock() + round(boots_s * 1e9)
        self.nmt = 0
        # One heartbeat when it is up: that of state 0 is the boot-up message
        self.store(0x1017, 0, 60_000)
        self.next_beat_ns = self._up_ns

    def sdo(self, data: bytes) -> bytes | None:
        if self._clock() < self._up_ns:
            return None
        if self.nmt == 0:
            self.nmt = 127
            self.store(0x1017, 0, 0)
            self.next_beat_ns = 0
        return super().sdo(data)


def slowly_booting(boots_s: float) -> tuple[CanopenNetwork, ScriptedBus]:
    network, bus = cell(2)
    booting_node = BootingNode(2, bus.clock, boots_s)
    bus.nodes = (bus.nodes[0], booting_node)
    return network, bus


def test_a_drive_that_boots_while_it_is_searched_is_asked_again() -> None:
    boots_s = network_listens_s() + 0.05
    network, bus = slowly_booting(boots_s)
    with network:
        network.prepare()
        assert bus.nodes[1].nmt == 5


def test_a_drive_that_boots_later_is_said_to_be_missing_or_booting() -> None:
    network, _ = slowly_booting(60.0)
    with (
        network,
        pytest.raises(NodeMissing, match=r"J2 \(node 2\) did not answer .*switched on just now"),
    ):
        network.prepare()


def network_listens_s() -> float:
    network, _ = cell(1)
    return network.bounds.listen_s


def test_a_mapping_that_reads_back_differently_is_refused() -> None:
    network, bus = cell(1)
    bus.nodes[0].lies[0x1A00, 2] = 0x60770010
    with (
        pytest.raises(
            SetupRefused, match=r"TPDO1: reads back as .*60770010.*written was .*60740010"
        ),
        network,
    ):
        network.prepare()


@pytest.mark.parametrize(
    ("where", "code", "words"),
    [
        ((0x1A00, 2), 0x06040041, "60740010 to 1A00h:02.*cannot be mapped"),
        ((0x1A00, 0), 0x06040042, "1A00h:00.*length exceeded"),
        ((0x1600, 0), 0x06010002, "RPDO1: writing 0x0 to 1600h:00.*read only"),
    ],
)
def test_aborts_of_the_mapping_are_shown(where: tuple[int, int], code: int, words: str) -> None:
    network, bus = cell(1)
    bus.nodes[0].aborts[where] = code
    with pytest.raises(SetupRefused, match=words), network:
        network.prepare()


def test_a_pdo_whose_cob_id_is_fixed_gets_the_rest() -> None:
    network, bus = cell(1)
    bus.nodes[0].aborts[0x1801, 1] = 0x06010002
    before = copy.deepcopy(bus.nodes[0].objects)
    with network:
        # TPDO2 carries the statusword by default: it cannot be switched off, but it can be used
        network.prepare()
        feedback = network.pdos[0].feedback
        entries = [record.entries for record in feedback]
        expected = [(0x60640020, 0x60740010), (0x60410010,)]
        assert entries == expected
        assert bus.nodes[0].value(0x1801, 2) == 1
    after = bus.nodes[0].objects
    for key in (
        (0x1800, 1),
        (0x1800, 2),
        (0x1801, 1),
        (0x1801, 2),
        (0x1A00, 0),
        (0x1A00, 1),
        (0x1A01, 0),
    ):
        assert after[key] == before[key]


def test_a_multiplexed_pdo_is_switched_off_and_on_again() -> None:
    network, bus = cell(1)
    bus.nodes[0].store(0x1A01, 0, 255)
    with network:
        network.prepare()
        found = bus.nodes[0].value(0x1801, 1) >> 31
        assert found == 1
    assert bus.nodes[0].value(0x1801, 1) == 0x281
    assert bus.nodes[0].value(0x1A01, 0) == 255


def test_a_drive_with_small_pdos_gets_more_of_them() -> None:
    network, bus = cell(1)
    bus.nodes[0].largest_pdo_bits = 48
    with network:
        network.prepare()
        feedback = network.pdos[0].feedback
        entry_counts = [len(record.entries) for record in feedback]
        assert entry_counts == [2, 1]
        setpoints = network.pdos[0].setpoints
        entry_counts = [len(record.entries) for record in setpoints]
        assert entry_counts == [2, 1, 1, 1]


def test_a_mode_that_is_not_taken_is_refused() -> None:
    network, bus = cell(1)
    bus.nodes[0].lies[0x6061, 0] = 8
    with network, pytest.raises(SetupRefused, match="mode 8 in 6061h") as refused:
        network.prepare()
    assert "statusword" not in str(refused.value)
    assert "choose the mode with its own tool" in str(refused.value)


def test_a_lost_answer_is_asked_for_again_and_a_late_one_not_believed() -> None:
    network, bus = cell(1)
    lose_first_answer(bus, repeats=True)
    with network:
        access = network.link.objects(1)
        vendor_id = ObjectEntry(0x1018, 1, 32)
        assert access.read(vendor_id) == 0x29A
        rated_current = ObjectEntry(0x6075, 0, 32)
        assert access.read(rated_current) == 2000


def test_sdo_failures_name_node_object_and_reason() -> None:
    network, bus = cell(1)
    with network:
        access = network.link.objects(1)
        unknown = ObjectEntry(0x2000, 0, 32)
        with pytest.raises(
            ObjectAccessError, match=r"J1 \(node 1\): object 2000h:00: aborted.*does not exist"
        ) as aborted:
            access.read(unknown)
        assert aborted.value.abort_code == 0x06020000
        too_wide = ObjectEntry(0x6074, 0, 32, signed=True)
        with pytest.raises(ObjectAccessError, match="has 16 bits, expected 32"):
            access.read(too_wide)
        controlword = ObjectEntry(0x6040, 0, 16)
        with pytest.raises(ObjectAccessError, match="does not fit 16 bits"):
            access.write(controlword, 70000)
        of_missing_node = network.link.objects(9, SdoPolicy(0.01, 3))
        with pytest.raises(
            ObjectAccessError, match=r"node 9: .*no answer within 0.01 s, asked 3 times"
        ):
            of_missing_node.read(STATUSWORD)
        bus.broken = True
        with pytest.raises(BusError, match="wire was cut"):
            access.read(STATUSWORD)


def test_faults_are_reset_only_on_request_and_never_into_power() -> None:
    network, bus = cell(2)
    bus.nodes[1].fault()
    with network:
        network.prepare()
        statusword = bus.nodes[1].statusword
        assert statusword & 0x4F == 0x08
        network.reset_faults()
        statusword = bus.nodes[1].statusword
        assert statusword & 0x6F == 0x40
    for node in bus.nodes:
        assert node.powered_cycles == 0


def test_bus_off_is_an_error_and_other_error_frames_are_not() -> None:
    network, bus = cell(1)
    with network:
        bus.inject(error_frame(0x04))
        network.link.pump(0.0)
        bus.inject(error_frame(0x40))
        with pytest.raises(BusError, match="bus-off"):
            network.link.pump(0.0)


def test_emcy_and_its_end_are_reported_in_words() -> None:
    network, bus = cell(1)
    with network:
        bus.inject(bus.nodes[0].emcy(0x2310))
        bus.inject(bus.nodes[0].emcy(0x0000))
        network.link.pump(0.0)
        first, second = network.link.take_events(5, (1,))
    assert first.kind is EventKind.EMCY
    assert first.code == 0x2310
    assert first.axis == 0
    assert first.time_ns == 5
    assert "EMCY 2310h continuous over-current" in first.text
    assert second.kind is EventKind.EMCY_RESET


def test_nothing_can_be_done_on_a_closed_network() -> None:
    network, _ = cell(1)
    with pytest.raises(BusError, match="not open"):
        network.prepare()


def test_preparing_twice_still_restores_the_first_settings() -> None:
    network, bus = cell(1)
    with network:
        network.prepare()
        network.prepare()
    assert bus.nodes[0].value(0x1800, 2) == 255
    assert bus.nodes[0].value(0x6060, 0) == 8
    assert bus.nodes[0].value(0x1017, 0) == 0


def test_a_step_of_restoring_that_fails_does_not_keep_the_others_from_it() -> None:
    network, bus = cell(2)
    with pytest.raises(SetupRefused, match=r"J1 \(node 1\): TPDO1") as refused, network:
        network.prepare()
        bus.nodes[0].aborts[0x1800, 2] = 0x06010002
    assert bus.nodes[0].value(0x1400, 2) == 255
    assert bus.nodes[0].value(0x1017, 0) == 0
    assert bus.nodes[1].value(0x1800, 2) == 255
    notes = " ".join(refused.value.__notes__)
    assert re.search(r"settings not restored \(.*\): J1: TPDO1; switch these drives off", notes)


def test_an_ampere_that_cannot_be_true_is_refused_before_an_axis_has_power() -> None:
    network, bus = cell(2)
    bus.nodes[1].store(0x6075, 0, 0)
    with pytest.raises(SetupRefused, match=r"node 2.*6075h:00 = 0"), network:
        network.prepare()
    for node in bus.nodes:
        assert not node.powered_cycles
    assert bus.nodes[0].value(0x6060, 0) == 8  # everything was given back


@pytest.mark.parametrize("times", [1, 100])
def test_one_bus_that_fails_while_the_network_closes_does_not_leave_the_other_axes_with_power(
    times: int,
) -> None:
    network, bus = cell(2)
    send = bus.send
    reported = 0

    def fail(msg: can.Message, timeout: float | None = None) -> None:
        nonlocal reported
        if is_request(msg) and reported < times:
            reported += 1
            raise BusError("bus B", "bus-off")  # as a split bus does, once
        send(msg, timeout)

    with pytest.raises(BusError, match="bus B: bus-off"), network:
        network.prepare()
        for node in bus.nodes:
            node.statusword = 0x0227
        bus.send = fail  # type: ignore[method-assign]
    states = [node.statusword & 0x6F for node in bus.nodes]
    modes = [node.value(0x6060, 0) for node in bus.nodes]
    if times > 1:  # nothing more is tried
        assert states == [0x27, 0x27]
        assert modes == [1, 1]
        assert reported == 4
    else:
        assert states == [0x40, 0x40]
        assert modes == [8, 8]
        assert reported == 1


def lose_answers(bus: ScriptedBus, node_id: int, number: int) -> None:
    """Lose the next SDO answers of a node, so many of them."""
    lost: list[can.Message] = []

    def tamper(message: can.Message) -> tuple[can.Message, ...]:
        if message.arbitration_id == 0x580 + node_id and len(lost) < number:
            lost.append(message)
            return ()
        return (message,)

    bus.tamper = tamper


def test_an_axis_whose_first_answer_is_lost_while_the_network_closes_is_stopped_and_restored() -> (
    None
):
    network, bus = cell(2)
    with network:
        network.prepare()
        bus.nodes[1].statusword = 0x0227
        lose_answers(bus, 2, number=1)
    assert bus.nodes[1].statusword & 0x6F == 0x40
    assert bus.nodes[1].value(0x6060, 0) == 8


def test_an_axis_that_does_not_answer_while_the_network_closes_gets_a_quick_stop_all_the_same() -> (
    None
):
    network, bus = cell(2)
    with pytest.raises(NodeMissing, match=r"J2 \(node 2\) did not answer"), network:
        network.prepare()
        bus.nodes[1].statusword = 0x0227
        silence(bus, 2)
    assert bus.nodes[1].statusword & 0x6F == 0x07
    assert bus.nodes[1].nmt == 127


def test_a_stop_that_used_up_its_time_leaves_that_for_closing_the_network() -> None:
    network, bus = cell(2)
    with network:
        network.prepare()
        network.begin_closing()
        bus.clock.now_ns += 11_000_000_000
        bus.nodes[0].statusword = 0x0227
    assert bus.nodes[0].statusword & 0x6F == 0x40
    assert [node.value(0x6060, 0) for node in bus.nodes] == [8, 8]


def _fail_as_a_pulled_adapter() -> None:
    raise can.CanOperationError("the adapter was pulled")


def test_an_adapter_that_cannot_be_closed_does_not_hide_what_was_not_restored(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    network, bus = cell(2)
    monkeypatch.setattr(bus, "shutdown", _fail_as_a_pulled_adapter)
    with pytest.raises(ValueError, match="cause") as error, network:
        network.prepare()
        silence(bus, 2)
        raise ValueError("cause")
    notes = " ".join(error.value.__notes__)
    assert "settings of J2 (node 2) not restored" in notes
    assert "the adapter was pulled" in notes


def test_an_adapter_that_cannot_be_closed_is_an_error_of_the_bus(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    network, bus = cell(2)
    monkeypatch.setattr(bus, "shutdown", _fail_as_a_pulled_adapter)
    with pytest.raises(BusError, match="the adapter was pulled"), network:
        network.prepare()
    with pytest.raises(BusError, match="is not open"):
        network.prepare()


def failing_with(
    bus: ScriptedBus, failures: list[DriverError]
) -> Callable[[can.Message, float | None], None]:
    """Return `send` of a bus of which each SDO request meets one of these failures first."""
    send = bus.send

    def fail(msg: can.Message, timeout: float | None = None) -> None:
        if is_request(msg) and failures:
            raise failures.pop()
        send(msg, timeout)

    return fail


def test_several_failures_while_the_network_closes_do_not_leave_a_good_bus_with_power(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    network, bus = cell(2)
    failures: list[DriverError] = [
        NodeMisplaced(9, "A", "B"),
        BusError("bus C", "no answer"),
        BusError("bus B", "bus-off"),
    ]
    with pytest.raises(BusError, match="bus B: bus-off") as error, network:
        network.prepare()
        for node in bus.nodes:
            node.statusword = 0x0227
        monkeypatch.setattr(bus, "send", failing_with(bus, failures))
    assert [node.statusword & 0x6F for node in bus.nodes] == [0x40, 0x40]
    assert [node.value(0x6060, 0) for node in bus.nodes] == [8, 8]
    notes = " ".join(error.value.__notes__)
    assert "bus C: no answer" in notes
    assert "node 9 is heard on bus B" in notes


def test_a_misplaced_node_that_is_heard_while_an_axis_is_disabled_does_not_end_that(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    network, bus = cell(2)
    disable = network.disable
    failures: list[DriverError] = [NodeMisplaced(9, "A", "B")]

    def fail_once(axis: Axis, ramp_end_ns: int) -> None:
        if failures:
            raise failures.pop()
        disable(axis, ramp_end_ns=ramp_end_ns)

    with pytest.raises(NodeMisplaced), network:
        network.prepare()
        bus.nodes[0].quick_stop_stays = True
        bus.nodes[0].statusword = 0x0227
        monkeypatch.setattr(network, "disable", fail_once)
    assert bus.nodes[0].statusword & 0x6F == 0x40


@dataclass(frozen=True)
class Closed:
    """Two axes after their network was closed.

    Attributes:
        changed: by axis, the objects that are not as they were before.
        powered: by axis.
        notes: on the error that the network was closed for.
    """

    changed: tuple[set[tuple[int, int]], ...]
    powered: tuple[bool, ...]
    notes: str


def closed_off_the_bus(reports_at: Collection[int]) -> Closed:
    """Close a network of two axes with power while the controller reports that it is off the bus.

    Args:
        reports_at: places among the answers to SDO requests, counted from the beginning of the
            closing, before each of which comes such a report.
    """
    network, bus = cell(2)
    before = [copy.deepcopy(node.objects) for node in bus.nodes]
    off = error_frame(0x40)
    answers = 0

    def reporting(message: can.Message) -> tuple[can.Message, ...]:
        nonlocal answers
        if message.arbitration_id & ~0x7F != 0x580:
            return (message,)
        answers += 1
        if answers - 1 in reports_at:
            return (off, message)
        return (message,)

    with pytest.raises(BusError) as caught, network:
        network.prepare()
        for node in bus.nodes:
            node.statusword = 0x0227
        bus.tamper = reporting
        raise BusError("bus A", "bus-off")
    changed = []
    powered = []
    for node, objects in zip(bus.nodes, before, strict=True):
        differing = {key for key, value in objects.items() if node.objects[key] != value}
        changed.append(differing - COMMANDED)
        powered.append(node.statusword & 0x6F != 0x40)
    notes = getattr(caught.value, "__notes__", ())
    return Closed(tuple(changed), tuple(powered), " ".join(notes))


@pytest.mark.parametrize("place", range(50))
def test_one_report_of_bus_off_while_the_network_closes_leaves_no_setting_behind(
    place: int,
) -> None:
    undisturbed = closed_off_the_bus(())
    closed = closed_off_the_bus({place})
    # Entries of a mapping behind their count stay as they were written.
    assert closed.changed == undisturbed.changed
    assert closed.powered == (False, False)


@given(st.sets(st.integers(0, 80)))
@settings(deadline=None, max_examples=60)
def test_settings_that_many_reports_of_bus_off_leave_behind_are_named(places: set[int]) -> None:
    closed = closed_off_the_bus(places)
    undisturbed = closed_off_the_bus(()).changed
    for name, changed, expected in zip(("J1", "J2"), closed.changed, undisturbed, strict=True):
        if changed != expected:
            assert "not restored" in closed.notes
            assert name in closed.notes


def test_giving_back_is_undisturbed_and_says_when_it_was_cut_short() -> None:
    network, bus = cell(1)
    inside: list[bool] = []

    @contextmanager
    def block_signals() -> Iterator[None]:
        inside.append(True)
        yield

    network.block_signals = block_signals
    send = bus.send

    def cut(msg: can.Message, timeout: float | None = None) -> None:
        if inside:
            raise KeyboardInterrupt
        send(msg, timeout)

    bus.send = cut  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt) as interrupt, network:
        network.prepare()
    (note,) = interrupt.value.__notes__
    assert "cut short" in note


def deaf_from_now_on(bus: ScriptedBus, node_id: int) -> None:
    """A node that answers no SDO request any more, in a flood of frames of no importance."""
    silence(bus, node_id)
    bus.flood_period_ns = 90_000  # 11 000 frames/s


@pytest.mark.parametrize("asked", [False, True])
def test_closing_has_one_time_limit_and_names_what_it_left(asked: bool) -> None:
    network, bus = cell(3)
    network.bounds = replace(network.bounds, closing_s=0.2)

    @contextmanager
    def block_signals() -> Iterator[Callable[[], bool]]:
        yield lambda: asked

    network.block_signals = block_signals
    with pytest.raises(DriverError) as left, network:
        network.prepare()
        deaf_from_now_on(bus, 2)
        begun_ns = bus.clock.now_ns
    taken_ns = bus.clock.now_ns - begun_ns
    assert taken_ns < 300_000_000
    said = "; ".join((str(left.value), *left.value.__notes__))
    assert "J2 (node 2) did not answer" in said
    if asked:
        assert "settings not restored (asked a second time): J1: TPDO1" in said
        assert "6060h, 1017h; switch these drives off and on" in said
    assert "not confirmed without power" not in said  # none of them ever had it


def test_asked_a_second_time_nothing_more_is_restored_and_every_axis_is_named() -> None:
    network, bus = cell(3)
    network.bounds = replace(network.bounds, closing_s=10.0)

    @contextmanager
    def block_signals() -> Iterator[Callable[[], bool]]:
        yield lambda: True

    network.block_signals = block_signals
    with (
        pytest.raises(BusError, match=r"settings not restored \(asked a second time\)") as left,
        network,
    ):
        network.prepare()
        bus.sent.clear()
    settings_written = [index for index in written_indices(bus) if index != 0x6040]
    assert settings_written == []
    matches = re.findall(r"(J\d): TPDO1", str(left.value))
    assert matches == ["J1", "J2", "J3"]


def test_an_axis_that_had_power_and_fell_silent_is_named_alone() -> None:
    network, bus = cell(3)
    with pytest.raises(ValueError, match="cause") as error, network:
        network.prepare()
        network.powered.update(network.node_ids)
        silence(bus, 2)
        raise ValueError("cause")
    notes = [note for note in error.value.__notes__ if note.startswith(POWERED)]
    assert notes == [f"{POWERED}J2 (node 2)"]


@pytest.mark.parametrize("cause", [True, False], ids=["beside another error", "alone"])
def test_the_operator_reads_whose_settings_were_not_restored(cause: bool) -> None:
    network, bus = cell(3)
    with pytest.raises((ValueError, DriverError)) as error, network:
        network.prepare()
        silence(bus, 2)
        if cause:
            raise ValueError("cause")
    said = [note for note in error.value.__notes__ if "not restored" in note]
    assert len(said) == 1
    assert said[0].startswith(f"{WHILE}closing the network: settings of J2 (node 2) not restored")


def test_a_bus_that_is_cut_leaves_the_settings_of_all_axes_and_that_is_said() -> None:
    network, bus = cell(2)
    with pytest.raises(ValueError, match="cause") as error, network:
        network.prepare()
        bus.broken = True
        raise ValueError("cause")
    expected = "settings of J1 (node 1), J2 (node 2) not restored"
    said = [note for note in error.value.__notes__ if expected in note]
    assert said != []


def test_a_request_after_the_time_for_closing_is_not_sent_and_says_so_alone() -> None:
    network, bus = cell(1)
    with network:
        network.link.deadline_ns = network.link.clock()
        sent = len(bus.sent)
        access = network.objects(network.axes[0])
        with pytest.raises(ObjectAccessError) as failure:
            access.read(STATUSWORD)
        assert len(bus.sent) == sent
        network.end_closing()
    # Not "…, asked 2 times": it was not asked.
    assert failure.value.reason == "the time for closing the network was over"
