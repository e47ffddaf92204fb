"""A small socketcand-protocol server: a CAN bus between processes of one machine,
without any kernel driver.

Every frame of one client goes to all other clients of its channel; one that no CAN bus carries is
refused to its sender and reaches no client. The server listens on the loopback interface alone. A
client that does not read is disconnected when ``BACKLOG_BYTES`` wait for it, so that no frame is
lost silently: its next call fails.

The first client of a channel is the cell that the hub was started for, and is never disconnected.
While it has more to read than ``FULL_BYTES``, the others are not read: they cannot send faster than
it lives, as on a wire. Neither is a client that does not read the hub's own answers.
"""

from __future__ import annotations

import asyncio
import errno
import re
import threading
import time
from typing import Self, cast

from drivers.canopen.bus import BusAddress
from drivers.canopen.interfaces import SOCKETCAND
from drivers.errors import BusError

HOST = "127.0.0.1"
BACKLOG_BYTES = 8 << 20
FULL_BYTES = 64 << 10  #: About 1500 frames, 50 ms of a simulated cell
# Possessive: each byte is read a bounded number of times, so that no line takes long.
_COMMAND = re.compile(rb"<\s*+(?:send ([0-9A-Fa-f]++) ([0-9A-Fa-f]++)([0-9A-Fa-f ]*+)|([^<>]*+))>")
_MAX_COMMAND_BYTES = 256
#: Hexadecimal digits of an identifier of 11 and of 29 bits
_BASE_DIGITS = 3
_EXTENDED_DIGITS = 8
_LONGEST_DATA = 8  #: Bytes of a CAN frame
_REMEDIES = {
    errno.EADDRINUSE: ": another hub runs on this port; use that one, end it, or choose another "
    "port (0: a free one)",
    errno.EACCES: ": ports below 1024 are the system's; choose another port (0: a free one)",
}


class Hub:
    """The server; runs in a thread of its own between ``__enter__`` and ``__exit__``.

    Args:
        channels: names that clients may open; each is a bus of its own. Another name is refused, so
            that a typing error does not open an empty bus.
        port: to listen on; 0 chooses a free one, see ``address``.
    """

    def __init__(self, channels: tuple[str, ...], port: int = 0) -> None:
        self.channels = channels
        self.clients: set[_Client] = set()
        self.cells: dict[str, _Client] = {}  #: the first client of each channel
        self._port = port
        self._server: asyncio.Server | None = None

    def address(self, channel: str | None = None) -> BusAddress:
        """Return the address of a channel (by default the first) while the hub runs."""
        if self._server is None:
            raise BusError(f"hub {HOST}:{self._port}", "is not running")
        port = self._server.sockets[0].getsockname()[1]
        return BusAddress(SOCKETCAND.name, channel or self.channels[0], host=HOST, port=port)

    def __enter__(self) -> Self:
        self._loop = asyncio.new_event_loop()
        try:
            starting = self._loop.create_server(lambda: _Client(self), HOST, self._port)
            self._server = self._loop.run_until_complete(starting)
        except OSError as error:
            self._loop.close()
            remedy = _REMEDIES.get(error.errno or 0, "")
            reason = f"{error.strerror or error}{remedy}"
            raise BusError(f"hub {HOST}:{self._port}", reason) from error
        self._thread = threading.Thread(
            target=self._loop.run_forever, name="socketcand hub", daemon=True
        )
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        if self._server is not None:
            self._server.close()
        for client in tuple(self.clients):
            client.drop()
        # Aborted connections close in the loop's next turn
        self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()
        self._server = None


class _Client(asyncio.Protocol):
    """One connection: its channel once that is open, and its unfinished command."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._channel: str | None = None
        self._raw = False
        self._incoming = b""
        self._full = False  # more waits for it than FULL_BYTES
        self._answered = False  # some of that may be answers of the hub itself

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(high=FULL_BYTES)
        self._hub.clients.add(self)
        self._write(b"< hi >")

    def connection_lost(self, exc: Exception | None) -> None:
        self._forget()

    def drop(self) -> None:
        self._forget()
        self._transport.abort()

    def _forget(self) -> None:
        self._hub.clients.discard(self)
        if self._is_cell:
            del self._hub.cells[cast(str, self._channel)]
            self._throttle_others()

    @property
    def _is_cell(self) -> bool:
        return self._channel is not None and self._hub.cells.get(self._channel) is self

    def pause_writing(self) -> None:
        self._full = True
        self._throttle()
        if self._is_cell:
            self._throttle_others()

    def resume_writing(self) -> None:
        self._full = False
        self._throttle()
        if self._is_cell:
            self._throttle_others()

    def _throttle_others(self) -> None:
        for other in self._hub.clients:
            if other is not self and other._channel == self._channel:
                other._throttle()

    def _throttle(self) -> None:
        """Read this client only while there is room for what it sends."""
        cell = None
        if self._channel is not None:
            cell = self._hub.cells.get(self._channel)
        waits_for_cell = cell is not None and cell is not self and cell._full
        if waits_for_cell or (self._full and self._answered):
            self._transport.pause_reading()
        else:
            self._transport.resume_reading()

    def _write(self, data: bytes) -> None:
        if self._transport.is_closing():
            return  # asyncio would print a warning for each
        self._transport.write(data)
        if not self._is_cell and self._transport.get_write_buffer_size() > BACKLOG_BYTES:
            self.drop()

    def _say(self, answers: list[bytes]) -> None:
        """Write answers of the hub itself at once:
        asyncio counts all that waits again with each write.
        """
        if answers:
            self._answered = True
            self._write(b"".join(answers))

    def data_received(self, data: bytes) -> None:
        if not self._full:
            self._answered = False
        buffer = self._incoming + data
        end = 0
        frames = []
        answers = []
        stamp = b"%.6f" % time.time()
        for match in _COMMAND.finditer(buffer):
            end = match.end()
            identifier, length, payload, command = match.groups()
            if command is not None or not self._raw:
                answers.append(self._answer_to(command))
            elif len(match[0]) <= _MAX_COMMAND_BYTES and (
                frame := _frame(identifier, int(length, 16), payload, stamp)
            ):
                frames.append(frame)
            else:
                answers.append(b"< error malformed frame >")
        self._say(answers)
        self._incoming = buffer[end:]
        if len(self._incoming) > _MAX_COMMAND_BYTES:
            self.drop()  # this is not the socketcand protocol
        if frames:
            burst = b"".join(frames)
            for other in tuple(self._hub.clients):
                if other is not self and other._raw and other._channel == self._channel:
                    other._write(burst)
        self._throttle()

    def _answer_to(self, command: bytes | None) -> bytes:
        """Do what a command says, and return the answer;
        None is a frame that is sent before the raw mode.
        """
        words = b"send"
        if command is not None:
            words = command[:_MAX_COMMAND_BYTES]
        word, _, argument = words.decode("ascii", "replace").strip().partition(" ")
        if word == "open" and self._raw:
            return b"< error a bus is open >"
        if word == "open" and argument in self._hub.channels:
            self._channel = argument
            return b"< ok >"
        if word == "open":
            known = ", ".join(self._hub.channels)
            return f"< error no bus {argument}, there is {known} >".encode("ascii", "replace")
        if word == "rawmode" and self._channel is not None:
            self._raw = True
            self._hub.cells.setdefault(self._channel, self)
            return b"< ok >"
        if word == "echo":
            return b"< echo >"
        return b"< error unknown command >"


def _frame(identifier: bytes, length: int, payload: bytes, stamp: bytes) -> bytes | None:
    """Return a frame as the other clients receive it, or None where no CAN bus carries it.

    Args:
        identifier: hexadecimal digits, up to three for a base one (11 bits) and eight for an
            extended one (29 bits).
        length: stated number of data bytes.
        payload: the data, two digits a byte, or one for a small byte between spaces.
        stamp: seconds since 1970.
    """
    extended = len(identifier) > _BASE_DIGITS
    if length > _LONGEST_DATA or (extended and len(identifier) != _EXTENDED_DIGITS):
        return None
    digits = payload.replace(b" ", b"")
    if len(digits) != 2 * length:
        # The protocol allows one digit for a small byte, and python-can writes it so.
        tokens = payload.split()
        if len(tokens) != length or any(len(token) > 2 for token in tokens):
            return None
        digits = b"".join(token.rjust(2, b"0") for token in tokens)
    if int(identifier, 16) > (0x1FFF_FFFF if extended else 0x7FF):
        return None
    return b"< frame %s %s %s >" % (identifier.upper().rjust(_BASE_DIGITS, b"0"), stamp, digits)
