"""Time to report a refused NMT command, by a clock that passes only while code waits."""

from __future__ import annotations

import can
import pytest

from drivers.canopen.link import NmtCommand
from drivers.errors import StateRefused
from tests.drivers.scripted import ScriptedBus, cell


@pytest.mark.parametrize("number", [0, 1])
def test_a_refused_nmt_command_is_reported_within_its_bound(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, bus = cell(2)
    commanded_ns: dict[bytes, int] = {}
    send = ScriptedBus.send

    def noting(self: ScriptedBus, message: can.Message, timeout: float | None = None) -> None:
        if message.arbitration_id == 0:
            commanded_ns.setdefault(bytes(message.data), self.clock.now_ns)
        send(self, message, timeout)

    monkeypatch.setattr(ScriptedBus, "send", noting)
    bus.nodes[number].obeys_nmt = False
    with network:
        with pytest.raises(
            StateRefused,
            match=rf"J{number + 1} \(node {number + 1}\): asked for "
            r"NMT OPERATIONAL",
        ):
            network.prepare()
        waited_ns = bus.clock.now_ns - commanded_ns[bytes((NmtCommand.START, number + 1))]
        # The nodes before it are waited for first: sound ones confirm with their next heartbeat.
        assert waited_ns <= network.bounds.nmt_s * 1e9 + number * network.heartbeat_ms * 1e6
