"""Open a CAN bus by its address, with one kind of error for everything that can go wrong.

A bus between processes of one machine is a socketcand hub (drivers/simulation/hub.py). Its client
here notices when the server is gone, and handles frames in bursts. Protocol:
github.com/linux-can/socketcand, doc/protocol.md (raw mode). Frames to the bus are ``< send ID DLC
B0 B1 ... >``, frames from the bus ``< frame ID SECONDS HEX >``; an identifier of three hexadecimal
digits is a base one, of eight an extended one. There are neither remote frames nor CAN FD.
"""

from __future__ import annotations

import re
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from queue import Empty, Queue, SimpleQueue
from types import MethodType
from typing import cast

import can
from can.interfaces.virtual import VirtualBus
from can.typechecking import CanFilter

from drivers.canopen.interfaces import SOCKETCAN, SOCKETCAND, VIRTUAL, BusInterface, interface_of
from drivers.canopen.socketcan import BurstBus, open_socketcan, receive_within
from drivers.errors import BusError

CONNECT_TIMEOUT_S = 5.0
#: Longest time in which a server may accept nothing; a frame sent in part cannot be recalled
SEND_S = 2.0
_RECEIVE_BYTES = 1 << 16
# Frames for devices (CiA 301): NMT, SYNC, RPDOs, SDO requests, heartbeats.
_TO_DEVICES: list[CanFilter] = [
    CanFilter(can_id=cob_id, can_mask=0x780 if cob_id > 0x080 else 0x7FF, extended=False)
    for cob_id in (0x000, 0x080, 0x200, 0x300, 0x400, 0x500, 0x600, 0x700)
]
LONGEST_BYTES = 4096
"""Longest unfinished message; a frame has some 50.

A server that never ends a message speaks another protocol.
"""
_LONGEST_IDENTIFIER, _LONGEST_DATA = 8, 16  #: Hexadecimal digits
_SHOWN = 60
_ADDRESS = re.compile(r"([\w-]+):([^@]+)(?:@([^:]+):(\d+))?")
# Possessive, and never past the next '<': each byte of a mismatch is read once.
_FRAME = re.compile(rb"< (?:frame ([0-9A-Fa-f]++) ([0-9]++\.?+[0-9]*+) ([0-9A-Fa-f]*+)|([^<>]*)) >")


@dataclass(frozen=True, slots=True)
class BusAddress:
    """Address of a bus."""

    #: one of `INTERFACES` (drivers/canopen/interfaces.py), or the name of any other of python-can
    interface: str
    channel: str  #: of the interface, such as ``can0``
    #: of the wire; buses of the kernel and of a hub have theirs already
    bitrate_bit_s: int = 1_000_000
    host: str = "127.0.0.1"  #: of the hub (socketcand only)
    port: int = 29536  #: of the hub (socketcand only)

    @property
    def kind(self) -> BusInterface:
        """What its interface can do."""
        return interface_of(self.interface)

    def __str__(self) -> str:
        if self.kind.has_server:
            where = f"@{self.host}:{self.port}"
        else:
            where = ""
        return f"{self.interface}:{self.channel}{where}"

    @classmethod
    def parse(cls, text: str) -> BusAddress:
        """Read an address such as ``socketcan:can0`` or ``socketcand:can0@127.0.0.1:29536``.

        Raises:
            BusError: the text has another form.
        """
        match = _ADDRESS.fullmatch(text)
        if match is None:
            raise BusError(
                text,
                "expected INTERFACE:CHANNEL or INTERFACE:CHANNEL@HOST:PORT, such as socketcan:can0",
            )
        interface, channel, host, port = match.groups()
        if host is None:
            return cls(interface, channel)
        return cls(interface, channel, host=host, port=int(port))


@contextmanager
def bus_errors(address: object) -> Iterator[None]:
    """Turn errors of python-can and the operating system into BusError with this address."""
    try:
        yield
    except (can.CanError, OSError) as error:
        raise BusError(str(address), str(error) or type(error).__name__) from error


def open_bus(address: BusAddress, *, answering: bool = False) -> can.BusABC:
    """Open one end of a bus.

    A ``virtual`` bus keeps every unread frame without limit (a limit would block the *sender* for
    ever), so close ends that are not read. No end receives its own frames, except the SYNCs on
    ``socketcan``, which return with their time and ``is_rx`` False (drivers/canopen/socketcan.py).

    Args:
        address: of the bus.
        answering: for a device that answers each frame: on ``socketcan`` without the capture
            process.

    Raises:
        BusError: the interface is unknown, the device is absent, or the hub does not answer.
    """
    with bus_errors(address):
        if address.kind is SOCKETCAND:
            # python-can's own client mistakes a closed hub for silence.
            return SocketcandBus(address.channel, address.host, address.port)
        if address.kind is SOCKETCAN and not answering:
            # python-can's own loses frames while this interpreter is busy, and cannot count them.
            return open_socketcan(address.channel)
        if address.kind is VIRTUAL:
            return VirtualEnd(address.channel)
        try:
            # A user's python-can configuration file must not change the cell's configuration.
            bus = can.Bus(
                interface=address.interface,
                channel=address.channel,
                bitrate=address.bitrate_bit_s,
                receive_own_messages=False,
                ignore_config=True,
                can_filters=_TO_DEVICES if answering else None,
            )
        except (ValueError, TypeError, ImportError, NotImplementedError) as error:
            raise BusError(str(address), str(error)) from error
        # Each interface has a class of its own; the waiting alone is replaced, on the object.
        bus.recv = MethodType(receive_within, bus)  # type: ignore[method-assign]
        return bus


def base_frame(cob_id: int, data: bytes = b"") -> can.Message:
    """Return a data frame with a base identifier."""
    return can.Message(arbitration_id=cob_id, is_extended_id=False, data=data)


def is_plain(message: can.Message) -> bool:
    """Return whether a frame is a data frame with a base identifier, as all of CANopen are."""
    return not (message.is_error_frame or message.is_extended_id or message.is_remote_frame)


def send_burst(bus: can.BusABC, messages: Sequence[can.Message]) -> None:
    """Send several frames, in one call where the bus has a ``send_burst``."""
    burst: Callable[[Sequence[can.Message]], None] | None = getattr(bus, "send_burst", None)
    if burst is not None:
        burst(messages)
    else:
        for message in messages:
            bus.send(message)


class VirtualEnd(BurstBus, VirtualBus):
    """One end of python-can's bus of one process;
    its deep copies and its queue took half of a simulated cycle.
    """

    def __init__(self, channel: str) -> None:
        self._received = deque()
        super().__init__(channel)
        self.channel[self.channel.index(self.queue)] = self.queue = cast(
            "Queue[can.Message]", SimpleQueue()
        )

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._check_if_open()
        for queue in self.channel:
            if queue is not self.queue:
                frame = msg.__copy__()
                frame.data = msg.data[:]
                frame.timestamp = time.time()
                frame.channel = self.channel_id
                frame.is_rx = True
                queue.put(frame)

    def _fill(self, timeout_s: float | None) -> None:
        self._check_if_open()
        with suppress(Empty):
            self._received.append(self.queue.get(timeout=timeout_s))
            for _ in range(self.queue.qsize()):  # not until it is empty: in a flood it never is
                self._received.append(self.queue.get_nowait())


class SocketcandBus(BurstBus):
    """One end of a bus of a socketcand server.

    Raises:
        can.CanInitializationError: the server refused the channel.
        OSError: no server listens at this address.
    """

    def __init__(self, channel: str, host: str, port: int) -> None:
        self.channel_info = f"socketcand {channel}@{host}:{port}"
        self._channel = channel
        self._received = deque()
        self._buffer = b""
        self._stuck: str | None = None
        self._socket = socket.create_connection((host, port), timeout=CONNECT_TIMEOUT_S)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._expect("hi")
            self._socket.sendall(f"< open {channel} >".encode("ascii"))
            self._expect("ok")
            self._socket.sendall(b"< rawmode >")
            self._expect("ok")
            self._socket.settimeout(None)
            self._parse(self._buffer)
        except BaseException:
            self._socket.close()
            raise
        super().__init__(channel=channel)

    def _expect(self, word: str) -> None:
        # Only up to the first '>': frames of the bus may follow the last answer at once.
        while b">" not in self._buffer:
            if len(self._buffer) > LONGEST_BYTES:
                raise can.CanInitializationError(self._endless(self._buffer))
            chunk = self._socket.recv(_RECEIVE_BYTES)
            if not chunk:
                raise can.CanInitializationError(
                    f"{self.channel_info}: closed during the handshake"
                )
            self._buffer += chunk
        answer, _, self._buffer = self._buffer.partition(b">")
        found = answer.strip(b"< ").decode("ascii", "replace")
        if found != word:
            raise can.CanInitializationError(
                f"{self.channel_info}: expected '{word}', the server sent '{found}'"
            )

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.send_burst((msg,))

    def send_burst(self, messages: Sequence[can.Message]) -> None:
        """Send frames, in one system call if the server accepts them."""
        if self._stuck is not None:
            raise can.CanOperationError(self._stuck)
        data = memoryview(b"".join(map(_command, messages)))
        end_s = time.monotonic() + SEND_S
        while data:
            try:
                data = data[self._socket.send(data, socket.MSG_DONTWAIT) :]
            except BlockingIOError:
                left_s = end_s - time.monotonic()
                if left_s <= 0 or not select.select((), (self._socket,), (), left_s)[1]:
                    self._stuck = (
                        f"{self.channel_info}: the server accepts nothing for {SEND_S:g} s"
                    )
                    raise can.CanOperationError(self._stuck) from None
            except OSError as error:
                raise can.CanOperationError(f"{self.channel_info}: {error}") from error

    def _fill(self, timeout_s: float | None) -> None:
        try:
            if not select.select((self._socket,), (), (), timeout_s)[0]:
                return
            chunk = self._socket.recv(_RECEIVE_BYTES)
        except (OSError, ValueError) as error:
            raise can.CanOperationError(f"{self.channel_info}: {error}") from error
        if not chunk:
            raise can.CanOperationError(f"{self.channel_info}: the server closed the connection")
        self._parse(self._buffer + chunk)

    def _parse(self, buffer: bytes) -> None:
        end = 0
        for match in _FRAME.finditer(buffer):
            end = match.end()
            identifier, seconds, data, other = match.groups()
            if other is not None:
                if other.startswith(b"error"):
                    raise can.CanOperationError(
                        f"{self.channel_info}: {other.decode('ascii', 'replace')}"
                    )
                continue
            if len(data) % 2 or len(data) > _LONGEST_DATA or len(identifier) > _LONGEST_IDENTIFIER:
                shown = match.group()[:_SHOWN].decode("ascii")
                raise can.CanOperationError(
                    f"{self.channel_info}: a frame of {len(identifier)} digits of identifier and "
                    f"{len(data)} of data: {shown}"
                )
            self._received.append(
                can.Message(
                    timestamp=float(seconds),
                    arbitration_id=int(identifier, 16),
                    is_extended_id=len(identifier) != 3,
                    data=bytearray.fromhex(data.decode("ascii")),
                    channel=self._channel,
                )
            )
        self._buffer = buffer[end:]
        if len(self._buffer) > LONGEST_BYTES:
            raise can.CanOperationError(self._endless(self._buffer))

    def _endless(self, buffer: bytes) -> str:
        return (
            f"{self.channel_info}: {len(buffer)} bytes without the end of a message, beginning "
            f"with {buffer[:_SHOWN]!r}: is this a socketcand server?"
        )

    def shutdown(self) -> None:
        super().shutdown()
        self._socket.close()


def _command(message: can.Message) -> bytes:
    """Return a frame as the protocol's ``send`` command."""
    if message.is_remote_frame or message.is_fd or message.is_error_frame:
        raise can.CanOperationError(
            f"the socketcand protocol has no remote, FD or error frames to send: {message}"
        )
    if message.is_extended_id:
        identifier = f"{message.arbitration_id:08X}"
    else:
        identifier = f"{message.arbitration_id:03X}"
    return f"< send {identifier} {message.dlc:X} {message.data.hex(' ')} >".encode("ascii")
