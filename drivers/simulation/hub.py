"""A small socketcand-protocol server: a CAN bus between processes of one machine,
without any kernel driver.

Every frame of one client goes to all other clients of its channel. A frame that no CAN bus carries
is refused: its sender gets an error, and no client gets the frame. The server listens on the
loopback interface alone. A client that does not read is disconnected when ``BACKLOG_BYTES`` wait
for it, so that no frame is lost silently: its next call fails.

The first client of a channel is the simulated cell, and is never disconnected. While more than
``THROTTLE_BYTES`` wait for it, the server reads no other client, so that nobody sends faster
than the cell receives, as on a real bus. Nor does it read a client that leaves the server's own
answers unread.
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
THROTTLE_BYTES = 64 << 10  #: About 1500 frames, 50 ms of a simulated cell
# ``< send ID LENGTH DATA >`` as three groups, or any other command as the fourth. Possessive: each
# byte is read a bounded number of times, so that no line takes long.
_COMMAND = re.compile(
    rb"<\s*+(?:"
    rb"send ([0-9A-Fa-f]++) ([0-9A-Fa-f]++)([0-9A-Fa-f ]*+)"
    rb"|([^<>]*+)"
    rb")>"
)
_MAX_COMMAND_BYTES = 256
#: Hexadecimal digits of an identifier of 11 and of 29 bits
_BASE_DIGITS = 3
_EXTENDED_DIGITS = 8
_LONGEST_DATA = 8  #: Bytes of a CAN frame
_LARGEST_BASE = 0x7FF
_LARGEST_EXTENDED = 0x1FFF_FFFF
_UNKNOWN_COMMAND = b"< error unknown command >"
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
        self._in_raw_mode = False
        self._incoming = b""
        # Whether more than THROTTLE_BYTES wait to be sent to it
        self._send_buffer_full = False
        # Whether answers of the server itself may be among them
        self._answers_unread = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(high=THROTTLE_BYTES)
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
        self._send_buffer_full = True
        self._throttle()
        if self._is_cell:
            self._throttle_others()

    def resume_writing(self) -> None:
        self._send_buffer_full = False
        self._throttle()
        if self._is_cell:
            self._throttle_others()

    def _throttle_others(self) -> None:
        for other in self._hub.clients:
            if other is not self and other._channel == self._channel:
                other._throttle()

    def _throttle(self) -> None:
        """Read this client only while there is room for its frames and for the answers to it."""
        cell = None
        if self._channel is not None:
            cell = self._hub.cells.get(self._channel)
        waits_for_cell = cell is not None and cell is not self and cell._send_buffer_full
        leaves_answers = self._send_buffer_full and self._answers_unread
        if waits_for_cell or leaves_answers:
            self._transport.pause_reading()
        else:
            self._transport.resume_reading()

    def _write(self, data: bytes) -> None:
        if self._transport.is_closing():
            # asyncio would print a warning for each.
            return
        self._transport.write(data)
        if not self._is_cell and self._transport.get_write_buffer_size() > BACKLOG_BYTES:
            self.drop()

    def _write_answers(self, answers: list[bytes]) -> None:
        """Write answers of the server itself.

        In one call: with each one asyncio adds up the sizes of all waiting writes.
        """
        if answers:
            self._answers_unread = True
            self._write(b"".join(answers))

    def data_received(self, data: bytes) -> None:
        if not self._send_buffer_full:
            self._answers_unread = False
        buffer = self._incoming + data
        end = 0
        frames = []
        answers = []
        stamp = b"%.6f" % time.time()
        for match in _COMMAND.finditer(buffer):
            end = match.end()
            identifier, length, payload, command = match.groups()
            if command is not None:
                answers.append(self._answer_to(command))
                continue
            if not self._in_raw_mode:
                answers.append(_UNKNOWN_COMMAND)
                continue
            frame = None
            if len(match[0]) <= _MAX_COMMAND_BYTES:
                frame = _frame(identifier, int(length, 16), payload, stamp)
            if frame is not None:
                frames.append(frame)
            else:
                answers.append(b"< error malformed frame >")
        self._write_answers(answers)
        self._incoming = buffer[end:]
        if len(self._incoming) > _MAX_COMMAND_BYTES:
            # This is not the socketcand protocol.
            self.drop()
        if frames:
            burst = b"".join(frames)
            for other in tuple(self._hub.clients):
                if other is not self and other._in_raw_mode and other._channel == self._channel:
                    other._write(burst)
        self._throttle()

    def _answer_to(self, command: bytes) -> bytes:
        """Execute a command other than ``send``, and return the answer."""
        text = command[:_MAX_COMMAND_BYTES].decode("ascii", "replace")
        word, _, argument = text.strip().partition(" ")
        if word == "open" and self._in_raw_mode:
            return b"< error a bus is open >"
        if word == "open" and argument in self._hub.channels:
            self._channel = argument
            return b"< ok >"
        if word == "open":
            known = ", ".join(self._hub.channels)
            return f"< error no bus {argument}, there is {known} >".encode("ascii", "replace")
        if word == "rawmode" and self._channel is not None:
            self._in_raw_mode = True
            self._hub.cells.setdefault(self._channel, self)
            return b"< ok >"
        if word == "echo":
            return b"< echo >"
        return _UNKNOWN_COMMAND


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
    largest = _LARGEST_BASE
    if extended:
        largest = _LARGEST_EXTENDED
        if len(identifier) != _EXTENDED_DIGITS:
            return None
    if length > _LONGEST_DATA or int(identifier, 16) > largest:
        return None
    digits = payload.replace(b" ", b"")
    if len(digits) != 2 * length:
        # The protocol allows one digit for a small byte, and python-can writes it so.
        tokens = payload.split()
        if len(tokens) != length or any(len(token) > 2 for token in tokens):
            return None
        digits = b"".join(token.rjust(2, b"0") for token in tokens)
    padded_identifier = identifier.upper().rjust(_BASE_DIGITS, b"0")
    return b"< frame %s %s %s >" % (padded_identifier, stamp, digits)
