"""Amplifiers that watch the recorder: what is set, what is given back, and what they lack."""

from __future__ import annotations

from itertools import pairwise

import can
import pytest

from drivers.errors import BusBusy, MotionTimeout, SetupRefused
from drivers.messages import CellEvent, EventKind
from drivers.motion.execute import execute
from drivers.move import Move
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from tests.drivers.scripted import PERIOD_NS, ScriptedBus, ScriptedNode, cell, permission

RECORDER = 127
MOVE = Move((50_000, -40_000), (100_000, 80_000), (1_000_000, 800_000))


def give_guard(node: ScriptedNode, entry: int = 0, option: int | None = 1) -> None:
    node.objects[0x1016, 0] = (1, 1)
    node.objects[0x1016, 1] = (entry, 4)
    if option is not None:
        node.objects[0x6007, 0] = (option, 2)


@pytest.mark.parametrize(
    "before", [0, 0x00050000, RECORDER << 16 | 500], ids=["free", "no time", "left by a killed one"]
)
def test_an_amplifier_watches_the_recorder_and_gets_its_settings_back(before: int) -> None:
    network, bus = cell(2)
    for node in bus.nodes:
        give_guard(node, before)
    with network:
        network.prepare()
        assert [node.value(0x1016, 1) for node in bus.nodes] == [RECORDER << 16 | 500] * 2
        assert [node.value(0x6007, 0) for node in bus.nodes] == [3, 3]
        assert network.unguarded() == ()
    expected = 0 if before >> 16 == RECORDER else before
    assert [(node.value(0x1016, 1), node.value(0x6007, 0)) for node in bus.nodes] == [
        (expected, 1)
    ] * 2


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
            RECORDER << 16 | 500,
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
    give_guard(bus.nodes[0])
    bus.nodes[0].aborts[refused] = 0x06090030
    with network:
        network.prepare()
        (said,) = network.unguarded()
        assert lack in said
        assert bus.nodes[0].value(0x1016, 1) == entry
        assert bus.nodes[0].value(0x6007, 0) == option
    assert bus.nodes[0].value(0x1016, 1) == 0
    assert bus.nodes[0].value(0x6007, 0) == 1


def test_our_heartbeat_comes_in_its_period_while_axes_have_power_and_at_no_other_time() -> None:
    network, bus = cell(2)
    for node in bus.nodes:
        give_guard(node)
    powered: list[bool] = []
    beats_ns: list[int] = []
    send = bus.send

    def listen(msg: can.Message, timeout: float | None = None) -> None:
        if msg.arbitration_id == 0x700 + RECORDER:
            beats_ns.append(bus.clock.now_ns)
            powered.append(bus.nodes[0].value(0x1016, 1) != 0)
        send(msg, timeout)

    bus.send = listen  # type: ignore[method-assign]
    with network:
        network.prepare()
        pacing = LockstepSync(PERIOD_NS, 0.005, clock=bus.clock)
        stream = SyncStream(network, pacing)
        for _ in range(100):
            next(stream)
        assert not beats_ns
        target_counts = (50_000, -40_000)
        move = Move(target_counts, (100_000, 80_000), (1_000_000, 800_000))
        list(execute(network, stream, (move,), permission()))
        count = len(beats_ns)
        assert count > 5
        limit = 1.5 * network.heartbeat_ms * 1e6
        assert max(b - a for a, b in pairwise(beats_ns)) <= limit
        # No watch while the log is finished
        assert [node.value(0x1016, 1) for node in bus.nodes] == [0, 0]
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


HEARTBEAT_OF_ANOTHER = can.Message(
    arbitration_id=0x700 + RECORDER, is_extended_id=False, data=b"\x05"
)
BOOT_UP_OF_ANOTHER = can.Message(
    arbitration_id=0x700 + RECORDER, is_extended_id=False, data=b"\x00"
)


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
        entry = RECORDER << 16 | 500
        give_guard(node, entry)
        node.objects[0x1016, 0], node.objects[0x1016, 2] = (2, 1), (0, 4)
    join(bus, 127, beat_ms=beat_ms, answers=answers)
    join(bus, 126, beat_ms=beat_ms, answers=answers)
    with network:
        network.prepare()
        assert network.recorder_id == 125
        for node in bus.nodes[:2]:
            assert node.value(0x1016, 1) == RECORDER << 16 | 500
            assert node.value(0x1016, 2) == 125 << 16 | 500
        pacing = LockstepSync(PERIOD_NS, 0.005, clock=bus.clock)
        stream = SyncStream(network, pacing)
        target_counts = (50_000, -40_000)
        move = Move(target_counts, (100_000, 80_000), (1_000_000, 800_000))
        list(execute(network, stream, (move,), permission()))
        beats = {frame.arbitration_id for frame in bus.sent if frame.arbitration_id > 0x700}
        assert beats == {0x700 + 125}
    for node in bus.nodes[:2]:
        expected = RECORDER << 16 | 500
        assert node.value(0x1016, 1) == expected
        assert node.value(0x1016, 2) == 0


def test_a_node_id_that_an_amplifier_waits_for_is_left_to_the_device_that_is_off_now() -> None:
    network, bus = cell(2)
    for node in bus.nodes:
        give_guard(node)
    bus.nodes[1].store(0x1016, 1, RECORDER << 16 | 2000)
    with network:
        network.prepare()
        assert network.recorder_id == 126
        assert bus.nodes[0].value(0x1016, 1) == 126 << 16 | 500
        assert [text.partition(":")[0] for text in network.unguarded()] == ["J2"]
    expected = [0, RECORDER << 16 | 2000]
    assert [node.value(0x1016, 1) for node in bus.nodes] == expected


def test_what_a_killed_recorder_left_under_another_id_is_used_again() -> None:
    """Another device had the highest id at that time."""
    network, bus = cell(1)
    entry = 126 << 16 | 500
    give_guard(bus.nodes[0], entry)
    with network:
        network.prepare()
        expected = RECORDER << 16 | 500
        assert bus.nodes[0].value(0x1016, 1) == expected
    assert bus.nodes[0].value(0x1016, 1) == 0


@pytest.mark.slow
def test_a_device_with_any_node_id_leaves_the_recorder_an_id_of_its_own_or_the_run_is_refused() -> (
    None
):
    for node_id in range(1, 128):
        network, bus = cell(2)
        for node in bus.nodes:
            give_guard(node)
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
            nodes = bus.nodes[:2]
            assert [node.value(0x1016, 1) >> 16 for node in nodes] == [network.recorder_id] * 2


def test_a_bus_without_a_free_node_id_is_refused_before_anything_is_set_up() -> None:
    network, bus = cell(2)
    for node in bus.nodes:
        give_guard(node)
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
    nodes = bus.nodes[:2]
    assert [node.value(0x1016, 1) for node in nodes] == [0, 0]
    assert all(node.powered_cycles == 0 for node in bus.nodes)


@pytest.mark.parametrize(
    "frame", [HEARTBEAT_OF_ANOTHER, BOOT_UP_OF_ANOTHER], ids=["heartbeat", "boot-up"]
)
def test_a_device_with_our_node_id_that_comes_before_the_run_refuses_it(frame: can.Message) -> None:
    network, bus = cell(2)
    with network:
        network.prepare()
        pacing = LockstepSync(PERIOD_NS, 0.005, clock=bus.clock)
        stream = SyncStream(network, pacing)
        bus.inject(frame)
        move = Move((50_000, 0), (100_000, 100_000), (1_000_000, 1_000_000))
        moves = (move,)
        with pytest.raises(BusBusy, match="77Fh of another device, which has node id 127 too"):
            list(
                execute(
                    network,
                    stream,
                    moves,
                    permission(),
                )
            )
    for node in bus.nodes:
        assert node.powered_cycles == 0


def frame_of_another(identifier: int) -> can.Message:
    return can.Message(arbitration_id=identifier, is_extended_id=False, data=bytes(8))


EVERY_FRAME_OF_OUR_ID = [
    frame_of_another(service + RECORDER) for service in range(0x80, 0x600, 0x80)
]
LSS_FRAMES = [frame_of_another(0x7E4), frame_of_another(0x7E5)]


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        *((frame, f"a frame {frame.arbitration_id:03X}h of another device, which has node "
                  "id 127 too")
          for frame in EVERY_FRAME_OF_OUR_ID),
        *((frame, f"a layer setting service, which changes node ids .{frame.arbitration_id:03X}h.")
          for frame in LSS_FRAMES),
    ],
)  # fmt: skip
def test_any_frame_with_our_node_id_and_any_lss_frame_stops_the_axes(
    frame: can.Message, words: str
) -> None:
    network, bus = cell(2)
    for node in bus.nodes:
        give_guard(node)
    with network:
        network.prepare()
        bus.cycle = -1
        bus.on_cycle = lambda cycle: bus.inject(frame) if cycle == 60 else None
        pacing = LockstepSync(PERIOD_NS, 0.005, clock=bus.clock)
        stream = SyncStream(network, pacing)
        with pytest.raises(BusBusy, match=words):
            list(execute(network, stream, (MOVE,), permission()))
        assert bus.cycle < 70
    assert [node.statusword & 0x6F for node in bus.nodes] == [0x40, 0x40]


@pytest.mark.parametrize("command", [0x23, 0x2B, 0x3F, 0x21, 0x00, 0xC6], ids=hex)
def test_another_master_that_writes_stops_the_axes(command: int) -> None:
    network, bus = cell(2)
    for node in bus.nodes:
        give_guard(node)
    data = bytes((0x40, 0x41, 0x60, 0, 0, 0, 0, 0))
    reading = can.Message(arbitration_id=0x602, is_extended_id=False, data=data)
    writing = can.Message(
        arbitration_id=0x602, is_extended_id=False, data=bytes((command, 0x81, 0x60, 0, 1, 0, 0, 0))
    )
    with network:
        network.prepare()
        bus.cycle = -1
        bus.on_cycle = lambda cycle: (
            bus.inject(reading if cycle < 60 else writing) if cycle in (50, 60) else None
        )
        pacing = LockstepSync(PERIOD_NS, 0.005, clock=bus.clock)
        stream = SyncStream(network, pacing)
        with pytest.raises(
            BusBusy,
            match=r"an SDO download \(it writes\) to J2 \(node "
            r"2\) \(602h\)",
        ):
            list(execute(network, stream, (MOVE,), permission()))
        assert 60 <= bus.cycle < 70
    assert [node.statusword & 0x6F for node in bus.nodes] == [0x40, 0x40]


@pytest.mark.parametrize(
    ("node_id", "command"), [(2, 0x40), (2, 0x60), (2, 0xA4), (2, 0x80), (9, 0x23)]
)
def test_another_master_that_only_reads_is_an_event_and_named_behind_a_late_move(
    node_id: int, command: int
) -> None:
    network, bus = cell(2)
    for node in bus.nodes:
        give_guard(node)
    arbitration_id = 0x600 + node_id
    data = bytes((command, *bytes(7)))
    frame = can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=data)
    events: list[CellEvent] = []
    with network:
        network.prepare()
        bus.cycle = -1
        bus.on_cycle = lambda cycle: bus.inject(frame) if cycle == 60 else None
        pacing = LockstepSync(PERIOD_NS, 0.005, clock=bus.clock)
        stream = SyncStream(network, pacing, events.append)
        for _ in execute(network, stream, (MOVE,), permission()):
            pass
        expected = f"an SDO request to {'J2 (node 2)' if node_id == 2 else 'node 9'} (60{node_id}h)"
        assert expected in network.other_master()
    codes = [event.code for event in events if event.kind is EventKind.BUS_BUSY]
    assert codes == [0x600 + node_id]
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


@pytest.mark.parametrize(
    "frame", [HEARTBEAT_OF_ANOTHER, BOOT_UP_OF_ANOTHER], ids=["heartbeat", "boot-up"]
)
def test_a_device_with_our_node_id_that_joins_in_the_run_stops_the_axes(frame: can.Message) -> None:
    network, bus = cell(2)
    events: list[CellEvent] = []
    with network:
        network.prepare()
        bus.cycle = -1
        bus.on_cycle = lambda cycle: bus.inject(frame) if cycle in (60, 61) else None
        pacing = LockstepSync(PERIOD_NS, 0.005, clock=bus.clock)
        stream = SyncStream(network, pacing, events.append)
        target_counts = (50_000, -40_000)
        move = Move(target_counts, (100_000, 80_000), (1_000_000, 800_000))
        moves = (move,)
        with pytest.raises(
            BusBusy,
            match=r"found a heartbeat 77Fh .*expected an id .*give that "
            r"device another",
        ):
            list(
                execute(
                    network,
                    stream,
                    moves,
                    permission(),
                )
            )
        assert bus.cycle < 70
        assert [node.statusword & 0x6F for node in bus.nodes] == [0x40, 0x40]
        codes = [event.code for event in events if event.kind is EventKind.BUS_BUSY]
        assert codes == [0x77F]
    assert [abs(node.position) < 40_000 for node in bus.nodes] == [True, True]
