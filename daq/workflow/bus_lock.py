"""Bus lock: one program of drivegain at a time sends to the drives of a bus.

Every verb and job that moves, scans or writes to drives takes the lock of their bus first.
`monitor` takes none, and sends nothing while another program has it; a call of the library takes
none. It is the lock of flock(2) on a file in a folder of the system, and ends with its process. It
excludes other programs of drivegain on this computer; a foreign master, or a recorder on another
computer, is detected on the bus itself (BusBusy).
"""

from __future__ import annotations

import os
import re
import socket
import stat
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path

from daq.config.cell import Bus, Wired
from daq.errors import BusTaken, OutputFailed
from daq.files import hold_lock
from drivers.canopen.bus import BusAddress

AnyBus = Bus | BusAddress  #: A bus of a cell file, or by its address
SHARED_FOLDERS = (Path("/run/lock"), Path("/var/lock"), Path("/tmp"))
"""Tried in this order; all users of a computer must come to the same one,
so TMPDIR is not asked.
"""


@contextmanager
def bus_lock(cell: Wired, folder: Path | None = None) -> Iterator[None]:
    """Keep all buses of a cell for oneself.

    Args:
        cell: its file; one without a bus needs no lock.
        folder: of the lock files; the first folder of SHARED_FOLDERS that everybody may write into,
            when None.

    Raises:
        BusTaken: another program has one of them.
        OutputFailed: the lock file cannot be made, or something else is there.
    """
    where = folder or _shared_folder()
    with ExitStack() as held:
        # In one order for all: two cells that share two buses must not wait for, or refuse, each
        # other crosswise.
        for name, bus in sorted({lock_name(bus): bus for bus in cell.buses}.items()):
            lock = where / name
            try:
                held.enter_context(hold_lock(lock))
            except BlockingIOError as error:
                raise BusTaken(
                    f"bus {bus.interface}:{bus.channel}",
                    found="another program of drivegain on it, such as a recording or a job (it "
                    f"holds {lock})",
                    expected="one at a time: two of them would move one robot, or disturb "
                    "its motion",
                    remedy=f"wait for its end; `fuser {lock}` shows its process",
                ) from error
            except OSError as error:
                raise OutputFailed.of(lock, error) from error
        yield


def bus_taken(cell: Wired, folder: Path | None = None, locks: Path = Path("/proc/locks")) -> bool:
    """Whether another program of this computer has a bus of the cell;
    the lock itself is not touched.
    """
    return bool(taken_of(cell.buses, folder, locks))


def taken_of(
    buses: Iterable[AnyBus], folder: Path | None = None, locks: Path = Path("/proc/locks")
) -> tuple[AnyBus, ...]:
    """Return the buses that a program of this computer has;
    none on a kernel that does not list its locks.
    """
    try:
        lines = [line for line in locks.read_text().splitlines() if " FLOCK " in line]
        locked_inodes = set(map(_inode, lines))
        where = folder or _shared_folder()
        taken = []
        for bus in dict.fromkeys(buses):
            file = where / lock_name(bus)
            if file.exists() and file.stat().st_ino in locked_inodes:
                taken.append(bus)
        return tuple(taken)
    except (OSError, ValueError, IndexError):
        return ()


def _inode(line: str) -> int:
    """Return the inode of a line of /proc/locks: `1: FLOCK ADVISORY WRITE 7 08:01:42 0 EOF`."""
    device_and_inode = line.split()[-3]
    _, _, inode = device_and_inode.rpartition(":")
    return int(inode)


def require_untaken(buses: Iterable[AnyBus], folder: Path | None = None) -> None:
    """Refuse to put simulated amplifiers on a bus that a recording or a job uses;
    the lock is not taken.

    Raises:
        BusTaken: a program of this computer has one of them.
    """
    for bus in taken_of(buses, folder):
        raise BusTaken(
            f"bus {bus.interface}:{bus.channel}",
            found="another program of drivegain on it, such as a recording or a job",
            expected="none while amplifiers are added: they would answer in the middle of "
            "its motion",
            remedy="wait for its end, or choose another --channel",
        )


def lock_name(bus: AnyBus) -> str:
    """Name of a bus's lock file: by interface and channel,
    for a hub by its host's address and port.
    """
    parts = [bus.interface, bus.channel]
    if bus.kind.has_server:
        parts += [_address(bus), str(bus.port)]
    elif bus.kind.is_of_process:
        parts.append(str(os.getpid()))
    escaped = [re.sub(r"[^A-Za-z0-9.]", "_", part) for part in parts]
    name = "-".join(escaped)
    return f"drivegain-{name}.lock"


def _address(bus: AnyBus) -> str:
    """One for all names of a host; its name where it has no address,
    since it is unreachable then.
    """
    try:
        found = socket.getaddrinfo(bus.host, bus.port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return bus.host.lower()
    # Servers of names answer in changing order; and whether a hub is reached by IPv4 or IPv6, it is
    # one.
    addresses: list[IPv4Address | IPv6Address] = []
    for *_, where in found:
        address = ip_address(str(where[0]))
        # One of IPv4 within IPv6 (::ffff:10.0.0.7) is that of IPv4.
        if isinstance(address, IPv6Address):
            address = address.ipv4_mapped or address
        addresses.append(address)
    address = min(addresses, key=lambda one: (one.version, str(one)))
    # Who connects to the unspecified address comes to this machine, as by a loopback address.
    if address.is_loopback or address.is_unspecified:
        return "localhost"
    return str(address)


def _shared_folder() -> Path:
    for folder in SHARED_FOLDERS:
        with suppress(OSError):
            if folder.stat().st_mode & stat.S_IWOTH:
                return folder
    return SHARED_FOLDERS[-1]
