"""Nodes of the scripted bus on the kernel's CAN, in a process of their own."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from drivers.canopen.bus import BusAddress, open_bus
from tests.drivers.scripted import FakeClock, ScriptedBus, ScriptedNode
from tests.vcan.run import INTERFACE

READY_S = 60.0
WAIT_S = 0.01

RECEIVED = (0x000, 0x080, 0x200, 0x300, 0x400, 0x500, 0x600)
"""COB-IDs of what a node receives, without its node id: the frames of others cost it no time."""

Nodes = Callable[[ScriptedBus], Sequence[ScriptedNode]]


class WallClock(FakeClock):
    """Monotonic time that passes by itself; nodes that would set it cannot."""

    @property
    def now_ns(self) -> int:
        """Return the time [ns]."""
        return time.monotonic_ns()

    @now_ns.setter
    def now_ns(self, value: int) -> None:
        pass


@contextmanager
def devices(nodes: Nodes) -> Iterator[None]:
    """Let nodes answer on vcan0 until the block ends."""
    context = multiprocessing.get_context("fork")
    ready = context.Event()
    process = context.Process(target=_serve, args=(nodes, ready.set), daemon=True)
    process.start()
    try:
        if not ready.wait(READY_S):
            raise RuntimeError(f"no devices on {INTERFACE}")
        yield
        if not process.is_alive():
            raise RuntimeError(f"the devices ended with {process.exitcode}")
    finally:
        process.kill()
        process.join()


def _serve(nodes: Nodes, ready: Callable[[], None]) -> None:
    script = ScriptedBus((), WallClock())
    script.nodes = tuple(nodes(script))
    with open_bus(BusAddress("socketcan", INTERFACE)) as end:
        end.set_filters([{"can_id": base, "can_mask": 0x780} for base in RECEIVED])
        ready()
        while True:
            message = end.recv(WAIT_S)
            if message is not None and not (message.is_error_frame or message.is_extended_id):
                script.send(message)
            script._beat()
            while (answer := script.recv(0.0)) is not None:
                end.send(answer)
