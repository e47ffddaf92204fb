"""A scan on the kernel's CAN beside a node that answers SDO requests badly:
it ends in time and reports every node.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable

import pytest

from drivers.canopen.bus import BusAddress
from drivers.canopen.node_scan import NODE_S, SCAN_POLICY, scan
from tests.drivers.hostile import HOSTILE, Answer, Hostile
from tests.drivers.scripted import ScriptedNode
from tests.vcan.devices import devices
from tests.vcan.run import INTERFACE

WAIT_S = 0.5
SOUND_S = 1.0  #: For the sound nodes, in a guest whose host gives its time to others
BOUND_S = WAIT_S + NODE_S + SCAN_POLICY.attempts * SCAN_POLICY.transfer_s + SOUND_S


@pytest.mark.parametrize(
    ("answer", "problem"), HOSTILE, ids=[answer.__name__ for answer, _ in HOSTILE]
)
def test_a_scan_ends_within_its_bound_and_reports_every_node(
    answer: Answer, problem: str, figure: Callable[[str], None]
) -> None:
    sound = devices(lambda _: (ScriptedNode(1), ScriptedNode(3)))
    with sound, devices(lambda bus: (Hostile(2, bus, answer),)):
        begun_s = time.monotonic()
        found = scan(BusAddress("socketcan", INTERFACE), wait_s=WAIT_S)
        lasted_s = time.monotonic() - begun_s
    assert [node.node_id for node in found] == [1, 2, 3]
    assert [
        (node.identity is not None, node.device_name, node.problems) for node in found[::2]
    ] == [(True, "axis", ())] * 2
    assert any(re.search(problem, text) for text in found[1].problems), found[1].problems
    assert lasted_s < BOUND_S
    figure(f"hostile SDO server, {answer.__name__}: scan in {lasted_s:.1f} s")
