"""Opening a CAN bus by its address, with one kind of error for everything that can go wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import can

from drivers.errors import BusError
from drivers.socketcan import open_socketcan
from drivers.socketcand import SocketcandBus


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
def bus_errors(address: object) -> Iterator[None]:
    """Turn what python-can and the operating system raise into BusError; the address says of which bus, or buses."""
    try:
        yield
    except (can.CanError, OSError) as error:
        raise BusError(str(address), str(error) or type(error).__name__) from error


def open_bus(address: BusAddress) -> can.BusABC:
    """Open one end of a bus.

    A ``virtual`` bus keeps every frame that is not read, without bound (a bounded one would block the *sender* for
    ever): close the ends that nobody reads. No end receives what it sent itself, but for the SYNCs on ``socketcan``,
    which come back with their time and ``is_rx`` False (drivers/socketcan.py).

    Raises:
        BusError: the interface is unknown, the device is absent, or the hub does not answer.
    """
    with bus_errors(address):
        if address.interface == "socketcand":
            # Not python-can's client: to that one a closed hub looks like silence.
            return SocketcandBus(address.channel, address.host, address.port)
        if address.interface == "socketcan":
            # Not python-can's: that one loses frames while this interpreter is busy, and cannot say how many.
            return open_socketcan(address.channel)
    return open_answering_bus(address)


def open_answering_bus(address: BusAddress) -> can.BusABC:
    """As `open_bus`, for whoever answers each frame and keeps none: on ``socketcan`` without a process in between.

    Raises:
        BusError: as `open_bus`.
    """
    if address.interface == "socketcand":
        return open_bus(address)
    with bus_errors(address):
        try:
            # Users' python-can configuration files must not turn the cell's configuration into another one.
            return can.Bus(
                interface=address.interface,
                channel=address.channel,
                bitrate=address.bitrate_bit_s,
                receive_own_messages=False,
                ignore_config=True,
            )
        except (ValueError, TypeError, ImportError, NotImplementedError) as error:
            raise BusError(str(address), str(error)) from error


def send_burst(bus: can.BusABC, messages: Sequence[can.Message]) -> None:
    """Send several frames; in one go where the bus has a ``send_burst`` of its own."""
    burst: Callable[[Sequence[can.Message]], None] | None = getattr(bus, "send_burst", None)
    if burst is not None:
        burst(messages)
        return
    for message in messages:
        bus.send(message)
