"""A bus on which a test says what comes, and frames as a cell of six axes sends them."""

from __future__ import annotations

import struct

import can

from tests.drivers.scripted import FakeClock


class QuietBus(can.BusABC):
    """A bus on which a test says what comes; waiting for a frame lets the clock's time pass."""

    def __init__(self, clock: FakeClock) -> None:
        self.clock = clock
        self.sent: list[can.Message] = []
        self.coming: list[tuple[int, can.Message]] = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Keep it."""
        self.sent.append(msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame, if it comes in this time."""
        until_ns = self.clock.now_ns + max(1, round((timeout or 0.0) * 1e9))
        if self.coming and self.coming[0][0] <= until_ns:
            at_ns, message = self.coming.pop(0)
            self.clock.now_ns = max(self.clock.now_ns, at_ns)
            return message
        self.clock.now_ns = until_ns
        return None

    def shutdown(self) -> None:
        """Nothing to close."""
        self._is_shutdown = True


def frame(identifier: int, data: bytes = b"") -> can.Message:
    """A frame with an identifier of 11 bits."""
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def overheard_cycle(
    at_ns: int, cycle: int, silent: int | None = None
) -> list[tuple[int, can.Message]]:
    """SYNC of another master and the answers of six nodes, but for one, with their times in ns."""
    frames = [(at_ns, frame(0x80))]
    for node in range(1, 7):
        if node != silent:
            data = struct.pack("<ihH", 1000 * node + cycle, -node, 0x1237)
            frames.append((at_ns + 1000 * node, frame(0x180 + node, data)))
    return frames
