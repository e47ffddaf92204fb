"""Opening a CAN bus by its address, with one kind of error for everything that can go wrong."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import can

from drivers.errors import BusError
from drivers.socketcand import SocketcandBus

RECEIVE_BUFFER_BYTES = 4 << 20
"""A kernel buffer of 208 KiB holds 43 ms of a full bus; a busy interpreter needs more."""
SO_RCVBUFFORCE = 33  # linux/socket.h; allowed to CAP_NET_ADMIN


@dataclass(frozen=True, slots=True)
class BusAddress:
    """Where a bus is.

    Attributes:
        interface: ``virtual`` (one process), ``socketcand`` (a hub, across processes), ``socketcan`` (kernel), or the
            name of any other python-can interface.
        channel: of the interface, e.g. ``can0``.
        bitrate_bit_s: of the wire; the kernel's and the hub's buses have theirs already.
        host, port: of the hub (socketcand only).
    """

    interface: str
    channel: str
    bitrate_bit_s: int = 1_000_000
    host: str = "127.0.0.1"
    port: int = 29536

    def __str__(self) -> str:
        where = f"@{self.host}:{self.port}" if self.interface == "socketcand" else ""
        return f"{self.interface}:{self.channel}{where}"


@contextmanager
def bus_errors(address: BusAddress) -> Iterator[None]:
    """Turn what python-can and the operating system raise into BusError."""
    try:
        yield
    except (can.CanError, OSError) as error:
        raise BusError(str(address), str(error) or type(error).__name__) from error


def open_bus(address: BusAddress) -> can.BusABC:
    """Open one end of a bus.

    A ``virtual`` bus keeps every frame that is not read, without bound (a bounded one would block the *sender* for
    ever): close the ends that nobody reads. No end receives what it sent itself.

    Raises:
        BusError: the interface is unknown, the device is absent, or the hub does not answer.
    """
    with bus_errors(address):
        if address.interface == "socketcand":
            # Not python-can's client: to that one a closed hub looks like silence.
            return SocketcandBus(address.channel, address.host, address.port)
        try:
            # Users' python-can configuration files must not turn the cell's configuration into another one.
            bus = can.Bus(
                interface=address.interface,
                channel=address.channel,
                bitrate=address.bitrate_bit_s,
                receive_own_messages=False,
                ignore_config=True,
            )
        except (ValueError, TypeError, ImportError, NotImplementedError) as error:
            raise BusError(str(address), str(error)) from error
    if address.interface == "socketcan":
        _enlarge_receive_buffer(bus)
    return bus


def _enlarge_receive_buffer(bus: can.BusABC) -> None:
    handle = getattr(bus, "socket", None)
    if not isinstance(handle, socket.socket):
        return
    try:
        handle.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
    except PermissionError:
        handle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)


def send_burst(bus: can.BusABC, messages: Sequence[can.Message]) -> None:
    """Send several frames; in one system call where the bus can."""
    if isinstance(bus, SocketcandBus):
        bus.send_burst(messages)
        return
    for message in messages:
        bus.send(message)
