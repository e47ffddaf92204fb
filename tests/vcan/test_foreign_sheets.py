"""Drives of makers' data sheets (`canopen.LocalNode`) on the kernel's CAN:
found, set up, moved and restored.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.canopen.bus import BusAddress
from drivers.canopen.network import CanopenNetwork
from drivers.motion.execute import execute
from drivers.profiles.cia402 import State, decode
from drivers.profiles.profile import Axis
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from tests.chaos.ends import ChaosBus
from tests.chaos.processes import Objects
from tests.drivers.foreign import MAKES, MOVE, ForeignNode, shipped
from tests.drivers.scripted import PERIOD_NS, permission
from tests.vcan.devices import devices
from tests.vcan.run import INTERFACE

NODES = (1, 2)
POSITION = 0x6064
STATUSWORD = 0x6041


@pytest.mark.parametrize(("file", "profile"), MAKES.items())
def test_a_drive_of_this_data_sheet_is_found_set_up_moved_and_restored(
    file: str, profile: str, shared_data: Path, figure: Callable[[str], None]
) -> None:
    sheet = shared_data / "eds" / file
    axes = tuple(Axis(f"J{node}", node, shipped(profile)) for node in NODES)
    address = BusAddress("socketcan", INTERFACE)
    with devices(lambda _: [ForeignNode(node, sheet) for node in NODES]):
        objects = Objects(ChaosBus())
        try:
            before = [objects.settings(node) for node in NODES]
            begun_s = time.monotonic()
            with CanopenNetwork(address, axes) as network:
                found = network.scan(wait_s=0.5)
                assert [(node.node_id, node.state, node.problems) for node in found] == [
                    (node, State.SWITCH_ON_DISABLED, ()) for node in NODES
                ]
                network.prepare()
                assert [objects.settings(node) for node in NODES] != before
                # Each SYNC waits for the answers to the one before: a drive in Python keeps no
                # time.
                samples = list(
                    execute(
                        network, SyncStream(network, LockstepSync(PERIOD_NS)), (MOVE,), permission()
                    )
                )
            assert not any(sample.missing for sample in samples)
            assert samples[-1].position_counts == MOVE.target_counts
            assert [_signed(objects.read(node, POSITION, 0)) for node in NODES] == list(
                MOVE.target_counts
            )
            assert {decode(objects.read(node, STATUSWORD, 0) or 0) for node in NODES} == {
                State.SWITCH_ON_DISABLED
            }
            assert [objects.settings(node) for node in NODES] == before
        finally:
            objects.close()
    figure(f"{file}: {len(samples)} samples, {time.monotonic() - begun_s:.1f} s")


def _signed(value: int | None) -> int | None:
    return None if value is None else (value ^ 1 << 31) - (1 << 31)
