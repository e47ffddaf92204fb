"""Nodes that answer SDO requests badly: without end, with other sizes, nonsense, or not at all."""

from __future__ import annotations

from collections.abc import Callable

import can

from tests.drivers.scripted import ScriptedBus, ScriptedNode

NAME = 0x1008
STATUSWORD = 0x6041
Answer = Callable[[bytes, ScriptedBus], bytes | None]


class Hostile(ScriptedNode):
    """A node that answers some requests in a way of its own;
    an answer of None is that of a sound node.
    """

    def __init__(self, node_id: int, bus: ScriptedBus, answer: Answer) -> None:
        super().__init__(node_id)
        self._bus = bus
        self._own = answer

    def sdo(self, data: bytes) -> bytes | None:
        own = self._own(data, self._bus)
        return super().sdo(data) if own is None else own or None


def about(data: bytes) -> int:
    return int.from_bytes(data[1:3], "little")


def endless(data: bytes, _: ScriptedBus) -> bytes | None:
    """Send a name of seven bytes after the other."""
    if data[0] >> 5 == 3:
        return bytes((data[0] & 0x10,)) + b"endless"
    if about(data) == NAME:
        return bytes((0x40, *data[1:4])) + bytes(4)
    return None


def huge(data: bytes, _: ScriptedBus) -> bytes | None:
    """Announce a name of 4 GB."""
    if about(data) == NAME:
        return bytes((0x41, *data[1:4])) + b"\xff" * 4
    return None


def one_byte(data: bytes, _: ScriptedBus) -> bytes | None:
    if about(data) == STATUSWORD:
        return bytes((0x4F, *data[1:4])) + bytes(4)
    return None


def nonsense(data: bytes, _: ScriptedBus) -> bytes | None:
    if about(data) != 0x1000:
        return bytes((0xE7, *data[1:4])) + b"\xff" * 4
    return None


def flood(data: bytes, bus: ScriptedBus) -> bytes | None:
    """Answer every request with answers about something else."""
    if about(data) == 0x1000:
        return None
    for _ in range(200):
        other = can.Message(
            arbitration_id=0x582, is_extended_id=False, data=bytes.fromhex("4399999900000000")
        )
        bus.inject(other)
    return b""


def silent(data: bytes, _: ScriptedBus) -> bytes | None:
    return None if about(data) == 0x1000 else b""


HOSTILE = (
    (endless, r"1008h:00: found \d+ bytes and no end, expected at most 256 bytes"),
    (huge, "1008h:00: found 4294967295 bytes and no end"),
    (one_byte, "6041h:00: has 8 bits, expected 16"),
    (nonsense, "1018h:01: Unexpected response 0xE7"),
    (flood, "1018h:01: 64 answers to other requests"),
    (silent, "1018h:01: no answer within 0.5 s"),
)
"""Each kind of bad answers, and the problem that a scan reports (a pattern)."""
