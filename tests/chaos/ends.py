"""The bus of a round, and the ends at which chaos hears and speaks: the kernel's CAN or a hub.

The standard library alone: nothing of the product decodes these frames.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Self

from tests.chaos.faults import KERNEL_ONLY, Act
from tests.vcan.judgement import SAME_SYNC_NS
from tests.vcan.listener import HUB_CHANNEL, connect_to_hub, frames_of_hub
from tests.vcan.run import INTERFACE

FRAME = struct.Struct("=IB3x8s")  # linux/can.h
EXTENDED = 0x8000_0000
REMOTE = 0x4000_0000
ERROR = 0x2000_0000
DRAIN_S = 0.5
HUB_HOST = "127.0.0.1"
Heard = tuple[int, bytes]
"""Identifier and data of a frame."""


class End(ABC):
    """One end of a bus that hears base data frames of some identifiers.

    Args:
        wanted: identifiers and masks; none hears nothing.
    """

    def __init__(self, wanted: Sequence[tuple[int, int]]) -> None:
        self._wanted = tuple(wanted)
        self._socket = self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def hear(self, seconds: float) -> list[Heard]:
        """Return the frames that wait, or the first that come within a time;
        an interface that is down has none.
        """
        if not select.select((self._socket,), (), (), seconds)[0]:
            return []
        with suppress(OSError):
            return [one for one in self._receive() if self._hears(one[0])]
        return []

    def drain(self) -> None:
        """Forget what waits."""
        end_s = time.monotonic() + DRAIN_S  # in a flood more comes for ever
        while select.select((self._socket,), (), (), 0.0)[0] and time.monotonic() < end_s:
            with suppress(OSError):
                self._receive()

    def _hears(self, identifier: int) -> bool:
        return any(identifier & mask == base for base, mask in self._wanted)

    @abstractmethod
    def _open(self) -> socket.socket: ...

    @abstractmethod
    def _receive(self) -> list[Heard]: ...

    @abstractmethod
    def send(self, identifier: int, data: bytes = b"") -> None:
        """Send a frame; flags of the identifier as in linux/can.h."""


class KernelEnd(End):
    """An end on the kernel's CAN."""

    def _open(self) -> socket.socket:
        end = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        flags = EXTENDED | REMOTE
        packed = b"".join(struct.pack("=II", base, mask | flags) for base, mask in self._wanted)
        end.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)
        end.bind((INTERFACE,))
        return end

    def _receive(self) -> list[Heard]:
        identifier, length, data = FRAME.unpack(self._socket.recv(FRAME.size))
        return [(identifier, data[:length])]

    def send(self, identifier: int, data: bytes = b"") -> None:
        self._socket.send(FRAME.pack(identifier, len(data), data.ljust(8, b"\0")))


class HubEnd(End):
    """An end on a hub, which has neither remote nor error frames."""

    def __init__(self, address: str, wanted: Sequence[tuple[int, int]]) -> None:
        self._address = address
        self._rest = b""
        super().__init__(wanted)

    def _open(self) -> socket.socket:
        return connect_to_hub(self._address)

    def _receive(self) -> list[Heard]:
        chunk = self._socket.recv(1 << 20)
        if not chunk:
            time.sleep(0.001)  # the hub is gone
        frames, self._rest = frames_of_hub(self._rest + chunk)
        return [(one.identifier, one.data) for one in frames]

    def send(self, identifier: int, data: bytes = b"") -> None:
        if identifier & EXTENDED:
            name = f"{identifier & ~EXTENDED:08X}"
        else:
            name = f"{identifier:03X}"
        words = f"< send {name} {len(data):X} {data.hex(' ')} >"
        self._socket.sendall(words.encode("ascii"))


@dataclass(frozen=True, slots=True)
class ChaosBus:
    """A bus between the processes of a round."""

    port: int | None = None  #: of the hub; None is the kernel's vcan0
    pid: int | None = None  #: process of the hub

    @property
    def address(self) -> str:
        """For the listener."""
        if self.port is None:
            return INTERFACE
        return f"{HUB_HOST}:{self.port}"

    @property
    def settings(self) -> str:
        """Lines of the cell file."""
        if self.port is None:
            return (
                f"bus:\n  interface: socketcan\n  channel: {INTERFACE}\n  bitrate_bit_s: 1000000\n"
            )
        return (
            f"bus:\n  interface: socketcand\n  channel: {HUB_CHANNEL}\n  host: {HUB_HOST}\n  port: "
            f"{self.port}\n"
            "  bitrate_bit_s: 1000000\n"
        )

    @property
    def absent(self) -> frozenset[Act]:
        """Acts that are impossible on it."""
        return frozenset() if self.port is None else KERNEL_ONLY

    @property
    def same_sync_ns(self) -> int:
        """Largest difference between the times of a sample and of its SYNC [ns];
        a hub stamps what it has received.
        """
        return SAME_SYNC_NS if self.port is None else 9_500_000

    @property
    def in_order(self) -> bool:
        """Whether samples and SYNCs are paired by their order:
        a hub loses none, but a busy host stamps late.
        """
        return self.port is not None

    @property
    def flood_hz(self) -> int:
        """Rate of a flood; a hub and its readers are Python."""
        return 4000 if self.port is None else 1000

    def end(self, wanted: Sequence[tuple[int, int]] = ()) -> End:
        """Open an end that hears base data frames of these identifiers and masks."""
        if self.port is None:
            return KernelEnd(wanted)
        return HubEnd(self.address, wanted)


def flood(bus: ChaosBus, identifier: int = 0x7F0) -> int:
    """Send an identifier that nobody uses, at the rate of a flood, until the process is killed."""
    with bus.end() as end:
        next_s = time.monotonic()
        while True:
            with suppress(OSError):
                end.send(identifier, bytes(8))
            next_s += 1.0 / bus.flood_hz
            time.sleep(max(0.0, next_s - time.monotonic()))


def free_disk(place: os.PathLike[str]) -> int:
    """Free bytes of a file system."""
    found = os.statvfs(place)
    return found.f_bavail * found.f_frsize
