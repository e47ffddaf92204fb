"""A small socketcand-protocol server: a CAN bus between processes of one machine, without any kernel driver.

Every frame of one client goes to all other clients of its channel. The server listens on the loopback interface alone.
A client that does not read is disconnected when ``BACKLOG_BYTES`` wait for it, so that no frame is lost silently: its
next call fails.
"""

from __future__ import annotations

import errno
import re
import selectors
import socket
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from drivers.canopen.bus import BusAddress
from drivers.errors import BusError

HOST = "127.0.0.1"
BACKLOG_BYTES = 8 << 20
_RECEIVE_BYTES = 1 << 16
_COMMAND = re.compile(rb"<\s*(?:send ([0-9A-Fa-f]+) ([0-9A-Fa-f]+) ?([0-9A-Fa-f ]*)|([^<>]*?))\s*>")
_MAX_COMMAND_BYTES = 256


class _Client:
    """One connection: its unfinished command, and the bytes that wait to be sent to it."""

    __slots__ = ("channel", "handle", "incoming", "outgoing", "raw")

    def __init__(self, handle: socket.socket) -> None:
        self.handle = handle
        self.channel: str | None = None
        self.raw = False
        self.incoming = b""
        self.outgoing = bytearray()


class Hub:
    """The server; runs in a thread of its own between ``__enter__`` and ``__exit__``.

    Args:
        channels: names that clients may open; each is a bus of its own. Another name is refused, so that a typing
            error does not open an empty bus.
        port: to listen on; 0 chooses a free one, see ``address``.
        clock: wall clock [s] for the frames' time stamps.
    """

    def __init__(self, channels: tuple[str, ...], port: int = 0, clock: Callable[[], float] = time.time) -> None:
        self._channels = channels
        self._port = port
        self._clock = clock
        self._listener: socket.socket | None = None
        self._waker: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._clients: dict[socket.socket, _Client] = {}

    def address(self, channel: str | None = None) -> BusAddress:
        """Return the address of a channel (by default the first) while the hub runs."""
        if self._listener is None:
            raise BusError(f"hub {HOST}:{self._port}", "is not running")
        return BusAddress("socketcand", channel or self._channels[0], host=HOST, port=self._listener.getsockname()[1])

    def __enter__(self) -> Self:
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((HOST, self._port))
            listener.listen()
            listener.setblocking(False)
        except OSError as error:
            listener.close()
            raise BusError(f"hub {HOST}:{self._port}", _hint(error)) from error
        self._listener = listener
        self._waker, wake = socket.socketpair()
        self._thread = threading.Thread(target=self._serve, args=(listener, wake), name="socketcand hub", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._waker is not None and self._thread is not None:
            self._waker.close()
            self._thread.join()
        self._listener = self._waker = self._thread = None

    def _serve(self, listener: socket.socket, wake: socket.socket) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(listener, selectors.EVENT_READ)
            selector.register(wake, selectors.EVENT_READ)
            try:
                while True:
                    for key, _ in selector.select():
                        handle = key.fileobj
                        if handle is wake:
                            return
                        if handle is listener:
                            self._accept(listener, selector)
                        elif isinstance(handle, socket.socket) and handle in self._clients:
                            self._receive(self._clients[handle], selector)
                    for client in tuple(self._clients.values()):
                        if client.outgoing:
                            self._flush(client, selector)
            finally:
                for handle in (*self._clients, listener, wake):
                    handle.close()
                self._clients.clear()

    def _accept(self, listener: socket.socket, selector: selectors.BaseSelector) -> None:
        try:
            handle, _ = listener.accept()
        except OSError:
            return  # the client left before it was accepted
        handle.setblocking(False)
        handle.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = self._clients[handle] = _Client(handle)
        client.outgoing += b"< hi >"
        selector.register(handle, selectors.EVENT_READ)

    def _drop(self, client: _Client, selector: selectors.BaseSelector) -> None:
        if self._clients.pop(client.handle, None) is not None:
            selector.unregister(client.handle)
            client.handle.close()

    def _receive(self, client: _Client, selector: selectors.BaseSelector) -> None:
        try:
            chunk = client.handle.recv(_RECEIVE_BYTES)
        except BlockingIOError:
            return  # only writable
        except OSError:
            chunk = b""
        if not chunk:
            self._drop(client, selector)
            return
        buffer, end, frames = client.incoming + chunk, 0, []
        stamp = b"%.6f" % self._clock()
        for match in _COMMAND.finditer(buffer):
            end = match.end()
            identifier, length, data, command = match.groups()
            if command is None and client.raw:
                payload = _payload(data, int(length, 16))
                if payload is not None:
                    frames.append(b"< frame %s %s %s >" % (identifier.upper(), stamp, payload))
                else:
                    client.outgoing += b"< error malformed frame >"
            else:
                self._answer(client, command)
        client.incoming = buffer[end:]
        if len(client.incoming) > _MAX_COMMAND_BYTES:
            self._drop(client, selector)  # this is not the socketcand protocol
        if frames:
            burst = b"".join(frames)
            for other in self._clients.values():
                if other is not client and other.raw and other.channel == client.channel:
                    other.outgoing += burst

    def _answer(self, client: _Client, command: bytes | None) -> None:
        word, _, argument = (command or b"send").decode("ascii", "replace").partition(" ")
        if word == "open" and argument in self._channels:
            client.channel = argument
            client.outgoing += b"< ok >"
        elif word == "open":
            known = ", ".join(self._channels)
            client.outgoing += f"< error no bus {argument}, there is {known} >".encode("ascii", "replace")
        elif word == "rawmode" and client.channel is not None:
            client.raw = True
            client.outgoing += b"< ok >"
        elif word == "echo":
            client.outgoing += b"< echo >"
        else:
            client.outgoing += b"< error unknown command >"

    def _flush(self, client: _Client, selector: selectors.BaseSelector) -> None:
        try:
            sent = client.handle.send(client.outgoing)
        except BlockingIOError:
            sent = 0
        except OSError:
            self._drop(client, selector)
            return
        del client.outgoing[:sent]
        if len(client.outgoing) > BACKLOG_BYTES:
            self._drop(client, selector)
            return
        waiting = selectors.EVENT_WRITE if client.outgoing else 0
        if selector.get_key(client.handle).events != selectors.EVENT_READ | waiting:
            selector.modify(client.handle, selectors.EVENT_READ | waiting)


def _hint(error: OSError) -> str:
    """Return the reason why the hub cannot listen, and the remedy."""
    reason = error.strerror or str(error)
    if error.errno == errno.EADDRINUSE:
        return f"{reason}: another hub runs on this port; use that one, end it, or choose another port (0: a free one)"
    if error.errno == errno.EACCES:
        return f"{reason}: ports below 1024 are the system's; choose another port (0: a free one)"
    return reason


def _payload(data: bytes, length: int) -> bytes | None:
    """Return the hexadecimal digits of a frame, two a byte, or None when they are not ``length`` bytes."""
    digits = data.replace(b" ", b"")
    if len(digits) != 2 * length:
        # The protocol allows one digit for a small byte, and python-can writes it so.
        tokens = data.split()
        if len(tokens) != length or any(len(token) > 2 for token in tokens):
            return None
        digits = b"".join(token.rjust(2, b"0") for token in tokens)
    return digits if length <= 8 else None
