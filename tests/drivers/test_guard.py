"""Amplifiers that watch the recorder: what is set, what is given back, and what they lack."""

from __future__ import annotations

from itertools import pairwise

import can
import pytest

from drivers.motion import execute
from drivers.move import Move
from drivers.pacing import LockstepSync
from drivers.stream import SyncStream
from tests.drivers.scripted import PERIOD_NS, ScriptedNode, cell, permission

RECORDER = 127


def give_guard(node: ScriptedNode, entry: int = 0, option: int | None = 1) -> None:
    node.objects[0x1016, 0] = (1, 1)
    node.objects[0x1016, 1] = (entry, 4)
    if option is not None:
        node.objects[0x6007, 0] = (option, 2)


@pytest.mark.parametrize(
    "before", [0, 0x00050000, RECORDER << 16 | 500], ids=["free", "unused", "left by a killed one"]
)
def test_an_amplifier_is_told_to_watch_us_and_gets_its_settings_back(before: int) -> None:
    network, bus = cell(2)
    for node in bus.nodes:
        give_guard(node, before)
    with network:
        network.prepare()
        assert [node.value(0x1016, 1) for node in bus.nodes] == [RECORDER << 16 | 500] * 2
        assert [node.value(0x6007, 0) for node in bus.nodes] == [3, 3]
        assert network.unguarded() == ()
    expected = 0 if before >> 16 == RECORDER else before
    assert [(node.value(0x1016, 1), node.value(0x6007, 0)) for node in bus.nodes] == [(expected, 1)] * 2


def test_what_an_amplifier_lacks_is_said() -> None:
    network, bus = cell(3)
    give_guard(bus.nodes[1], option=None)
    give_guard(bus.nodes[2], entry=0x0005_01F4)  # it watches somebody else, and that is not ours to change
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
        ((0x1016, 1), "it does NOT stop by itself when the recorder is killed: 1016h is aborted", 0, 1),
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
        assert (bus.nodes[0].value(0x1016, 1), bus.nodes[0].value(0x6007, 0)) == (entry, option)
    assert (bus.nodes[0].value(0x1016, 1), bus.nodes[0].value(0x6007, 0)) == (0, 1)


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
        stream = SyncStream(network, LockstepSync(PERIOD_NS, 0.005, clock=bus.clock))
        for _ in range(100):
            next(stream)
        assert not beats_ns
        move = Move((50_000, -40_000), (100_000, 80_000), (1_000_000, 800_000))
        list(execute(network, stream, (move,), permission()))
        count = len(beats_ns)
        assert count > 5
        assert max(b - a for a, b in pairwise(beats_ns)) <= 1.5 * network.heartbeat_ms * 1e6
        assert [node.value(0x1016, 1) for node in bus.nodes] == [0, 0]  # nobody watches while the log is finished
    assert len(beats_ns) == count
    assert all(powered)
