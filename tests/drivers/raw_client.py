"""A client of the hub that sends what a test writes, and reads nothing by itself."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from drivers.simulation.hub import HOST, Hub

WAIT_S = 30.0


@contextmanager
def raw_client(hub: Hub) -> Iterator[socket.socket]:
    """Open a connection to a hub of this process in raw mode."""
    port = hub.address().port
    assert port is not None
    with raw_client_at(port) as client:
        yield client


@contextmanager
def raw_client_at(port: int) -> Iterator[socket.socket]:
    """Open a connection in raw mode to the hub that listens there."""
    with socket.create_connection((HOST, port), timeout=WAIT_S) as client:
        client.sendall(b"< open can0 >< rawmode >")
        heard = b""
        while heard != b"< hi >< ok >< ok >":
            heard += client.recv(256)
        yield client
        with suppress(OSError):
            client.shutdown(socket.SHUT_RDWR)  # a thread that waits in a write of it goes on
