"""One mover a bus: a lock that every recording and every job takes before it says anything to the drives.

The locks are those of flock(2) on files in a folder of the system: they end with their process, however it ends. They
keep out other programs of drivegain on this computer; somebody else's master is heard on the bus itself (BusBusy).
"""

from __future__ import annotations

import fcntl
import os
import re
import socket
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path

from daq.configuration.cell import Bus, Cell
from daq.errors import BusTaken, OutputFailed

SHARED_FOLDERS = (Path("/run/lock"), Path("/var/lock"), Path("/tmp"))
"""Tried in this order; all users of a computer must come to the same one, so TMPDIR is not asked."""
MODE = 0o644
VIRTUAL = "virtual"
"""python-can's bus within one process: a bus of that name in another process is another bus."""


@contextmanager
def bus_lock(cell: Cell, folder: Path | None = None) -> Iterator[None]:
    """Keep all buses of a cell for oneself.

    Args:
        cell: its file; one without a bus needs no lock.
        folder: of the lock files; the first folder of SHARED_FOLDERS that everybody may write into, when None.

    Raises:
        BusTaken: another recording or job has one of them.
        OutputFailed: the lock file cannot be made, or something else is there.
    """
    where = folder or _shared_folder()
    # In one order for all: two cells that share two buses must not wait for, or refuse, each other crosswise.
    buses = sorted({lock_name(bus): bus for bus in cell.buses}.items())
    with ExitStack() as held:
        for name, bus in buses:
            held.enter_context(_held(where / name, bus))
        yield


def lock_name(bus: Bus) -> str:
    """Of a bus's lock file: by its interface and channel, and of a hub by its host's address and its port."""
    parts = [bus.interface, bus.channel]
    if bus.interface == "socketcand":
        parts += [_address(bus), str(bus.port)]
    elif bus.interface == VIRTUAL:
        parts.append(str(os.getpid()))
    return "drivegain-" + "-".join(re.sub(r"[^A-Za-z0-9.]", "_", part) for part in parts) + ".lock"


def _address(bus: Bus) -> str:
    """One for all names of a host; its name where nobody knows an address, since then nobody reaches it either."""
    try:
        found = socket.getaddrinfo(bus.host, bus.port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return bus.host.lower()
    # Servers of names answer in changing order; and whether a hub is reached by IPv4 or IPv6, it is one.
    address = min((_unmapped(str(where[0])) for *_, where in found), key=lambda one: (one.version, str(one)))
    # Who connects to the unspecified address comes to this machine, as by a loopback address.
    return "localhost" if address.is_loopback or address.is_unspecified else str(address)


def _unmapped(written: str) -> IPv4Address | IPv6Address:
    """An address; of one of IPv4 within IPv6 (::ffff:10.0.0.7) that of IPv4."""
    address = ip_address(written)
    return (address.ipv4_mapped or address) if isinstance(address, IPv6Address) else address


def _shared_folder() -> Path:
    for folder in SHARED_FOLDERS:
        with suppress(OSError):
            if folder.stat().st_mode & stat.S_IWOTH:
                return folder
    return SHARED_FOLDERS[-1]


@contextmanager
def _held(lock: Path, bus: Bus) -> Iterator[None]:
    """The file is removed at the end: whoever opened it just before sees by the inode that it has no name any more."""
    while True:
        try:
            descriptor = _open(lock)
        except OSError as error:
            raise OutputFailed.of(lock, error) from error
        try:
            _check_regular(descriptor, lock)
            _take(descriptor, lock, bus)
            if _is_at(descriptor, lock):
                try:
                    yield
                finally:
                    # In a shared folder it stays where another user made it.
                    with suppress(OSError):
                        lock.unlink()
                return
        finally:
            os.close(descriptor)


def _open(lock: Path) -> int:
    """To read is enough to lock; and to open another user's file in a shared folder, O_CREAT must not be asked for."""
    while True:
        with suppress(FileNotFoundError):
            # O_NONBLOCK: a FIFO of that name must not keep us waiting for its other end.
            return os.open(lock, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        with suppress(FileExistsError):
            made = os.open(lock, os.O_RDONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, MODE)
            # Whatever the umask says: who cannot open it would not learn that the bus is taken.
            os.fchmod(made, MODE)
            return made


def _check_regular(descriptor: int, lock: Path) -> None:
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        raise OutputFailed(
            str(lock),
            found="something that is no regular file",
            expected="the lock file of the bus, or none",
            remedy="nothing has moved; see who has put it there, and remove it",
        )


def _take(descriptor: int, lock: Path, bus: Bus) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise BusTaken(
            f"bus {bus.interface}:{bus.channel}",
            found=f"another recording or job of drivegain on it (it holds {lock})",
            expected="one at a time: two of them would move one robot",
            remedy=f"wait for its end; `fuser {lock}` shows its process",
        ) from error


def _is_at(descriptor: int, path: Path) -> bool:
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(descriptor), path.stat())
    return False
