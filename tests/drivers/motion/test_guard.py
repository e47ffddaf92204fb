"""Amplifiers that watch the recorder: what is set, what is given back, and what they lack."""

from __future__ import annotations

from itertools import pairwise

import can
import pytest

from drivers.canopen.network import CanopenNetwork
from drivers.errors import BusBusy, MotionRefused, MotionTimeout, ObjectAccessError, SetupRefused
from drivers.messages import CellEvent, EventKind
from drivers.motion.execute import execute
from drivers.move import Move
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from tests.drivers.scripted import PERIOD_NS, ScriptedBus, ScriptedNode, cell, frame, permission

RECORDER = 127
TARGET_COUNTS = (50_000, -40_000)
MOVE = Move(TARGET_COUNTS, (100_000, 80_000), (1_000_000, 800_000))


def watches(node_id: int, time_ms: int = 500) -> int:
    """Entry of 1016h by which a drive watches another node's heartbeat."""
    return node_id << 16 | time_ms


WATCHES_RECORDER = watches(RECORDER)


def give_guard(node: ScriptedNode, entry: int = 0, option: int | None = 1) -> None:
    node.objects[0x1016, 0] = (1, 1)
    node.objects[0x1016, 1] = (entry, 4)
    if option is not None:
        node.objects[0x6007, 0] = (option, 2)


def guarded_cell() -> tuple[CanopenNetwork, ScriptedBus]:
    """Two axes that can watch the recorder, and watch no node yet."""
    network, bus = cell(2)
    for node in bus.nodes:
        give_guard(node)
    return network, bus


def watched(*nodes: ScriptedNode) -> list[int]:
    """First entry of 1016h of some nodes."""
    return [node.value(0x1016, 1) for node in nodes]


def reactions(*nodes: ScriptedNode) -> list[int]:
    """6007h of some nodes: how they stop."""
    return [node.value(0x6007, 0) for node in nodes]


def states(bus: ScriptedBus) -> list[int]:
    """States of CiA 402 of all nodes."""
    return [node.statusword & 0x6F for node in bus.nodes]


def stream_of(
    network: CanopenNetwork, bus: ScriptedBus, events: list[CellEvent] | None = None
) -> SyncStream:
    """A stream in the time of the bus."""
    pacing = LockstepSync(PERIOD_NS, 0.005, clock=bus.clock)
    if events is None:
        return SyncStream(network, pacing)
    return SyncStream(network, pacing, events.append)


def make_moves(network: CanopenNetwork, stream: SyncStream, move: Move = MOVE) -> None:
    """Make one move to its end."""
    list(execute(network, stream, (move,), permission()))


def inject_at(bus: ScriptedBus, frames: dict[int, can.Message]) -> None:
    """Let frames of others come in some cycles from now on."""

    def on_cycle(cycle: int) -> None:
        if cycle in frames:
            bus.inject(frames[cycle])

    bus.cycle = -1
    bus.on_cycle = on_cycle


def codes_of_busy_bus(events: list[CellEvent]) -> list[int]:
    """Codes of the events that name another master or device."""
    return [event.code for event in events if event.kind is EventKind.BUS_BUSY]


@pytest.mark.parametrize(
    "before", [0, 0x00050000, WATCHES_RECORDER], ids=["free", "no time", "left by a killed one"]
)
def test_an_amplifier_watches_the_recorder_and_gets_its_settings_back(before: int) -> None:
    network, bus = cell(2)
    for node in bus.nodes:
        give_guard(node, before)
    with network:
        network.prepare()
        assert watched(*bus.nodes) == [WATCHES_RECORDER, WATCHES_RECORDER]
        assert reactions(*bus.nodes) == [3, 3]
        assert network.unguarded() == ()
    expected = before
    if before >> 16 == RECORDER:
        expected = 0
    assert watched(*bus.nodes) == [expected, expected]
    assert reactions(*bus.nodes) == [1, 1]


def test_an_amplifier_that_cannot_be_disabled_goes_on_watching_the_recorder() -> None:
    network, bus = guarded_cell()
    refusing = bus.nodes[0]
    with pytest.raises(ObjectAccessError) as failure, network:
        network.prepare()
        network.guard()
        refusing.statusword = 0x0227
        refusing.aborts[0x6040, 0] = 0x08000022
    assert watched(*bus.nodes) == [WATCHES_RECORDER, 0]
    assert reactions(*bus.nodes) == [3, 1]
    assert refusing.value(0x6060, 0) == 8
    notes = " ".join(failure.value.__notes__)
    assert "the watch of J1 (node 1) (1016h) is not restored" in notes


def test_the_way_of_stopping_is_restored_where_the_watch_cannot_be() -> None:
    network, bus = guarded_cell()
    with pytest.raises(ObjectAccessError) as refused, network:
        network.prepare()
        bus.nodes[0].aborts[0x1016, 1] = 0x08000022
    assert reactions(*bus.nodes) == [1, 1]
    assert "J1: 1016h;" in " ".join(refused.value.__notes__)


def test_the_end_of_a_run_restores_the_way_of_stopping_where_the_watch_cannot_be() -> None:
    network, bus = guarded_cell()
    with pytest.raises(ObjectAccessError), network:
        network.prepare()
        network.guard()
        bus.nodes[0].aborts[0x1016, 1] = 0x08000022
        network.unguard()
        assert reactions(*bus.nodes) == [1, 1]


def test_a_second_motion_is_refused_where_the_first_took_the_watch_off() -> None:
    network, bus = guarded_cell()
    with network:
        network.prepare()
        make_moves(network, stream_of(network, bus))
        assert network.without_guard() == ("J1", "J2")
        with pytest.raises(MotionRefused, match="prepare the network again"):
            make_moves(network, stream_of(network, bus))
        assert states(bus) == [0x40, 0x40]
        network.prepare()
        assert network.without_guard() == ()
        assert watched(*bus.nodes) == [WATCHES_RECORDER, WATCHES_RECORDER]
        make_moves(network, stream_of(network, bus))
    assert watched(*bus.nodes) == [0, 0]


def test_an_amplifier_that_never_heard_the_recorder_gets_its_watch_back() -> None:
    network, bus = guarded_cell()
    refusing = bus.nodes[0]
    with pytest.raises(ObjectAccessError), network:
        network.prepare()
        refusing.statusword = 0x0227
        refusing.aborts[0x6040, 0] = 0x08000022
    assert watched(*bus.nodes) == [0, 0]


def test_what_an_amplifier_lacks_is_said() -> None:
    network, bus = cell(3)
    node = bus.nodes[1]
    give_guard(node, option=None)
    # It watches another device, and must not be changed
    give_guard(bus.nodes[2], entry=0x0005_01F4)
    with network:
        network.prepare()
        assert network.unguarded() == (
            "J1: no 1016h: it does NOT stop by itself when the recorder is killed",
            "J2: no 6007h: when the recorder is killed it stops in the way that its maker decided",
            "J3: no free 1016h: it does NOT stop by itself when the recorder is killed",
        )
    assert bus.nodes[2].value(0x1016, 1) == 0x0005_01F4


@pytest.mark.parametrize(
    ("refused", "lack", "entry", "option"),
    [
        (
            (0x6007, 0),
            "6007h = 1 rules how it stops when the recorder is killed: 3 is abort",
            WATCHES_RECORDER,
            1,
        ),
        (
            (0x1016, 1),
            "it does NOT stop by itself when the recorder is killed: 1016h is aborted",
            0,
            1,
        ),
    ],
)
def test_an_amplifier_that_refuses_to_watch_is_recorded_all_the_same(
    refused: tuple[int, int], lack: str, entry: int, option: int
) -> None:
    network, bus = cell(1)
    (node,) = bus.nodes
    give_guard(node)
    node.aborts[refused] = 0x06090030
    with network:
        network.prepare()
        (said,) = network.unguarded()
        assert lack in said
        assert watched(node) == [entry]
        assert reactions(node) == [option]
    assert watched(node) == [0]
    assert reactions(node) == [1]


def test_our_heartbeat_comes_in_its_period_while_axes_have_power_and_at_no_other_time() -> None:
    network, bus = guarded_cell()
    powered: list[bool] = []
    beats_ns: list[int] = []
    send = bus.send

    def listen(msg: can.Message, timeout: float | None = None) -> None:
        if msg.arbitration_id == 0x700 + RECORDER:
            beats_ns.append(bus.clock.now_ns)
            (entry,) = watched(bus.nodes[0])
            powered.append(entry != 0)
        send(msg, timeout)

    bus.send = listen  # type: ignore[method-assign]
    with network:
        network.prepare()
        stream = stream_of(network, bus)
        for _ in range(100):
            next(stream)
        assert not beats_ns
        make_moves(network, stream)
        count = len(beats_ns)
        assert count > 5
        longest_ns = 1.5 * network.heartbeat_ms * 1e6
        for before_ns, after_ns in pairwise(beats_ns):
            assert after_ns - before_ns <= longest_ns
        # No watch while the log is finished
        assert watched(*bus.nodes) == [0, 0]
    assert len(beats_ns) == count
    assert all(powered)


def join(bus: ScriptedBus, node_id: int, *, beat_ms: int = 0, answers: bool = True) -> ScriptedNode:
    """Another device, which is no axis; its first heartbeat comes as late as one can."""
    device = ScriptedNode(node_id)
    device.obeys_nmt = False
    device.store(0x1017, 0, beat_ms)
    device.next_beat_ns = bus.clock.now_ns + beat_ms * 1_000_000
    device.nmt = 5 if answers else 4  # a scripted node that is stopped answers no SDO request
    bus.nodes = (*bus.nodes, device)
    return device


HEARTBEAT_OF_ANOTHER = frame(0x700 + RECORDER, b"\x05")
BOOT_UP_OF_ANOTHER = frame(0x700 + RECORDER, b"\x00")


@pytest.mark.parametrize(
    ("beat_ms", "answers"),
    [(400, False), (100, True), (0, True)],
    ids=["heartbeat", "both", "SDO server"],
)
def test_a_node_id_that_another_device_uses_is_not_the_recorder_s(
    beat_ms: int, answers: bool
) -> None:
    """Its heartbeat would keep the axes running when the recorder is killed."""
    network, bus = cell(2)
    for node in bus.nodes:
        # And it is not a recorder's that was killed, though it looks like one
        give_guard(node, WATCHES_RECORDER)
        node.objects[0x1016, 0] = (2, 1)
        node.objects[0x1016, 2] = (0, 4)
    axes = bus.nodes
    join(bus, 127, beat_ms=beat_ms, answers=answers)
    join(bus, 126, beat_ms=beat_ms, answers=answers)
    with network:
        network.prepare()
        assert network.recorder_id == 125
        assert watched(*axes) == [WATCHES_RECORDER, WATCHES_RECORDER]
        for node in axes:
            assert node.value(0x1016, 2) == watches(125)
        make_moves(network, stream_of(network, bus))
        identifiers = {message.arbitration_id for message in bus.sent}
        beats = {identifier for identifier in identifiers if identifier > 0x700}
        assert beats == {0x700 + 125}
    assert watched(*axes) == [WATCHES_RECORDER, WATCHES_RECORDER]
    for node in axes:
        assert node.value(0x1016, 2) == 0


def test_a_node_id_that_an_amplifier_waits_for_is_left_to_the_device_that_is_off_now() -> None:
    network, bus = guarded_cell()
    first, second = bus.nodes
    waits = watches(RECORDER, 2000)
    second.store(0x1016, 1, waits)
    with network:
        network.prepare()
        assert network.recorder_id == 126
        assert watched(first) == [watches(126)]
        (text,) = network.unguarded()
        assert text.partition(":")[0] == "J2"
    assert watched(first, second) == [0, waits]


def test_what_a_killed_recorder_left_under_another_id_is_used_again() -> None:
    """Another device had the highest id at that time."""
    network, bus = cell(1)
    (node,) = bus.nodes
    give_guard(node, watches(126))
    with network:
        network.prepare()
        assert watched(node) == [WATCHES_RECORDER]
    assert watched(node) == [0]


@pytest.mark.slow
def test_a_device_with_any_node_id_leaves_the_recorder_an_id_of_its_own_or_the_run_is_refused() -> (
    None
):
    for node_id in range(1, 128):
        network, bus = guarded_cell()
        axes = bus.nodes
        join(bus, node_id, beat_ms=100)
        if node_id <= 2:
            pattern = f"J{node_id} .*two have it"
            with pytest.raises(SetupRefused, match=pattern), network:
                network.prepare()
            continue
        with network:
            network.prepare()
            expected = 126 if node_id == 127 else 127
            assert network.recorder_id == expected
            watched_ids = [entry >> 16 for entry in watched(*axes)]
            assert watched_ids == [expected, expected]


def test_a_bus_without_a_free_node_id_is_refused_before_anything_is_set_up() -> None:
    network, bus = guarded_cell()
    axes = bus.nodes
    for node_id in range(3, 128):
        join(bus, node_id)
    with (
        pytest.raises(
            BusBusy,
            match=r"found no free node id.*expected an id.*nothing "
            r"has moved",
        ),
        network,
    ):
        network.prepare()
    assert watched(*axes) == [0, 0]
    for node in bus.nodes:
        assert node.powered_cycles == 0


FRAMES_OF_ANOTHER = pytest.mark.parametrize(
    "message", [HEARTBEAT_OF_ANOTHER, BOOT_UP_OF_ANOTHER], ids=["heartbeat", "boot-up"]
)


@FRAMES_OF_ANOTHER
def test_a_device_with_our_node_id_that_comes_before_the_run_refuses_it(
    message: can.Message,
) -> None:
    network, bus = cell(2)
    move = Move((50_000, 0), (100_000, 100_000), (1_000_000, 1_000_000))
    with network:
        network.prepare()
        stream = stream_of(network, bus)
        bus.inject(message)
        with pytest.raises(BusBusy, match="77Fh of another device, which has node id 127 too"):
            make_moves(network, stream, move)
    for node in bus.nodes:
        assert node.powered_cycles == 0


SERVICES = range(0x80, 0x600, 0x80)
OUR_IDENTIFIERS = [service + RECORDER for service in SERVICES]
LSS_IDENTIFIERS = [0x7E4, 0x7E5]


@pytest.mark.parametrize("identifier", [*OUR_IDENTIFIERS, *LSS_IDENTIFIERS], ids=hex)
def test_any_frame_with_our_node_id_and_any_lss_frame_stops_the_axes(identifier: int) -> None:
    words = f"a frame {identifier:03X}h of another device, which has node id 127 too"
    if identifier in LSS_IDENTIFIERS:
        words = f"a layer setting service, which changes node ids .{identifier:03X}h."
    network, bus = guarded_cell()
    with network:
        network.prepare()
        inject_at(bus, {60: frame(identifier, bytes(8))})
        stream = stream_of(network, bus)
        with pytest.raises(BusBusy, match=words):
            make_moves(network, stream)
        assert bus.cycle < 70
    assert states(bus) == [0x40, 0x40]


@pytest.mark.parametrize("command", [0x23, 0x2B, 0x3F, 0x21, 0x00, 0xC6], ids=hex)
def test_another_master_that_writes_stops_the_axes(command: int) -> None:
    network, bus = guarded_cell()
    read = bytes((0x40, 0x41, 0x60, 0, 0, 0, 0, 0))
    write = bytes((command, 0x81, 0x60, 0, 1, 0, 0, 0))
    with network:
        network.prepare()
        inject_at(bus, {50: frame(0x602, read), 60: frame(0x602, write)})
        stream = stream_of(network, bus)
        with pytest.raises(
            BusBusy,
            match=r"an SDO download \(it writes\) to J2 \(node "
            r"2\) \(602h\)",
        ):
            make_moves(network, stream)
        assert 60 <= bus.cycle < 70
    assert states(bus) == [0x40, 0x40]


@pytest.mark.parametrize(
    ("node_id", "command"), [(2, 0x40), (2, 0x60), (2, 0xA4), (2, 0x80), (9, 0x23)]
)
def test_another_master_that_only_reads_is_an_event_and_named_behind_a_late_move(
    node_id: int, command: int
) -> None:
    network, bus = guarded_cell()
    identifier = 0x600 + node_id
    request = frame(identifier, bytes((command, *bytes(7))))
    receiver = f"node {node_id}"
    if node_id == 2:
        receiver = "J2 (node 2)"
    events: list[CellEvent] = []
    with network:
        network.prepare()
        inject_at(bus, {60: request})
        make_moves(network, stream_of(network, bus, events))
        expected = f"an SDO request to {receiver} (60{node_id}h)"
        assert expected in network.other_master()
    assert codes_of_busy_bus(events) == [identifier]
    late = MotionTimeout(0, (1,), (), 1.0, other_master=network.other_master())
    assert "another master was on the bus: an SDO request" in str(late)
    assert "end the other program first; else check brakes" in str(late)


def test_axes_without_guard_are_named() -> None:
    network, bus = cell(2)
    node = bus.nodes[0]
    give_guard(node, option=None)
    with network:
        network.prepare()
        assert network.without_guard() == ("J2",)


@FRAMES_OF_ANOTHER
def test_a_device_with_our_node_id_that_joins_in_the_run_stops_the_axes(
    message: can.Message,
) -> None:
    network, bus = cell(2)
    events: list[CellEvent] = []
    with network:
        network.prepare()
        inject_at(bus, {60: message, 61: message})
        stream = stream_of(network, bus, events)
        with pytest.raises(
            BusBusy,
            match=r"found a heartbeat 77Fh .*expected an id .*give that "
            r"device another",
        ):
            make_moves(network, stream)
        assert bus.cycle < 70
        assert states(bus) == [0x40, 0x40]
        assert codes_of_busy_bus(events) == [0x77F]
    for node in bus.nodes:
        assert abs(node.position) < 40_000
