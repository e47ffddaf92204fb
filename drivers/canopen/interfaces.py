"""The interfaces that drivegain treats in a way of their own;
any other of python-can is opened by its name alone.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BusInterface:
    """An interface and what it can do; by default that of an adapter with a machine on it."""

    name: str  #: as in cell files and to python-can
    is_simulated: bool = False  #: only simulated cells are on it, whose time may be simulated too
    #: an address has host and port of a server, which carries no error frames
    has_server: bool = False
    is_of_process: bool = False  #: a bus of that name in another process is another bus
    has_kernel_sync: bool = False  #: the kernel can send SYNC on it


VIRTUAL = BusInterface("virtual", is_simulated=True, is_of_process=True)
SOCKETCAND = BusInterface("socketcand", is_simulated=True, has_server=True)
SOCKETCAN = BusInterface("socketcan", has_kernel_sync=True)
INTERFACES = {one.name: one for one in (VIRTUAL, SOCKETCAND, SOCKETCAN)}


def interface_of(name: str) -> BusInterface:
    """Return what an interface can do."""
    return INTERFACES.get(name, BusInterface(name))
