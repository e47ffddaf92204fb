"""Safeguards of a recording: bus lock, disk space, the payload's mass, deferred garbage collection.

Every recording and every job takes the lock of its bus before it sends anything to the drives. It is the lock of
flock(2) on a file in a folder of the system, and ends with its process. It excludes other programs of drivegain on this
computer; a foreign master is detected on the bus itself (BusBusy).
"""

from __future__ import annotations

import gc
import os
import re
import shutil
import socket
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path

from daq.config.cell import Bus, Cell, WeighedPayload
from daq.config.cell_file import URDF
from daq.errors import BusTaken, DiskSpaceShort, OutputFailed, UsageError, writing
from daq.files import hold_lock
from daq.log.message import currents_bytes, joint_state_bytes, joint_state_prefix, sample_dtype
from daq.log.writer import JOINT_STATE_NS
from ident.model.bodies import Payload

SHARED_FOLDERS = (Path("/run/lock"), Path("/var/lock"), Path("/tmp"))
"""Tried in this order; all users of a computer must come to the same one, so TMPDIR is not asked."""
VIRTUAL = "virtual"  #: python-can's bus within one process: a bus of that name in another process is another bus


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
    with ExitStack() as held:
        # In one order for all: two cells that share two buses must not wait for, or refuse, each other crosswise.
        for name, bus in sorted({lock_name(bus): bus for bus in cell.buses}.items()):
            lock = where / name
            try:
                held.enter_context(hold_lock(lock))
            except BlockingIOError as error:
                raise BusTaken(
                    f"bus {bus.interface}:{bus.channel}",
                    found=f"another recording or job of drivegain on it (it holds {lock})",
                    expected="one at a time: two of them would move one robot",
                    remedy=f"wait for its end; `fuser {lock}` shows its process",
                ) from error
            except OSError as error:
                raise OutputFailed.of(lock, error) from error
        yield


def bus_taken(cell: Cell, folder: Path | None = None, locks: Path = Path("/proc/locks")) -> bool:
    """Whether a recording or job of this computer has a bus of the cell; the lock itself is not touched."""
    try:
        lines = [line for line in locks.read_text().splitlines() if " FLOCK " in line]
        held = {int(line.split()[-3].rpartition(":")[2]) for line in lines}
        files = [(folder or _shared_folder()) / lock_name(bus) for bus in cell.buses]
        return any(file.exists() and file.stat().st_ino in held for file in files)
    except (OSError, ValueError, IndexError):
        return False  # a kernel that does not list locks


def lock_name(bus: Bus) -> str:
    """Name of a bus's lock file: by interface and channel, for a hub by its host's address and port."""
    parts = [bus.interface, bus.channel]
    if bus.interface == "socketcand":
        parts += [_address(bus), str(bus.port)]
    elif bus.interface == VIRTUAL:
        parts.append(str(os.getpid()))
    return "drivegain-" + "-".join(re.sub(r"[^A-Za-z0-9.]", "_", part) for part in parts) + ".lock"


def _address(bus: Bus) -> str:
    """One for all names of a host; its name where it has no address, since it is unreachable then."""
    try:
        found = socket.getaddrinfo(bus.host, bus.port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return bus.host.lower()
    # Servers of names answer in changing order; and whether a hub is reached by IPv4 or IPv6, it is one.
    addresses: list[IPv4Address | IPv6Address] = []
    for *_, where in found:
        address = ip_address(str(where[0]))
        # One of IPv4 within IPv6 (::ffff:10.0.0.7) is that of IPv4.
        addresses.append((address.ipv4_mapped or address) if isinstance(address, IPv6Address) else address)
    address = min(addresses, key=lambda one: (one.version, str(one)))
    # Who connects to the unspecified address comes to this machine, as by a loopback address.
    return "localhost" if address.is_loopback or address.is_unspecified else str(address)


def _shared_folder() -> Path:
    for folder in SHARED_FOLDERS:
        with suppress(OSError):
            if folder.stat().st_mode & stat.S_IWOTH:
                return folder
    return SHARED_FOLDERS[-1]


FreeBytes = Callable[[Path], int]  #: Room left for this user on the disk of a folder [bytes]

RESERVE_BYTES = 64 * 2**20
"""Never used: others write to the same disk, and the stop of the axes and the end of the log need some too."""
INDEX_BYTES = 16  #: Index entry of a message, behind its chunk
MESSAGE_HEAD_BYTES = 31
CHUNKS_BYTES_S = 4096.0  #: Heads and indexes of the chunks of one second
ENDS_BYTES = 2**16  #: Definitions and metadata, at the start and again at the end


def free_bytes(folder: Path) -> int:
    """Room left for this user on the disk of a folder [bytes]; OSError when there is no such folder."""
    return shutil.disk_usage(folder).free


def largest_log_bytes(names: tuple[str, ...], rate_hz: float, duration_s: float, attached: Mapping[str, bytes]) -> int:
    """Size of a log at most: as if nothing could be compressed [bytes]."""
    zeros = [0.0] * len(names)
    shown = (joint_state_bytes(joint_state_prefix(names), 0, zeros, zeros), currents_bytes(0, zeros))
    of_samples = rate_hz * (sample_dtype(len(names)).itemsize + INDEX_BYTES)
    of_states = 1e9 / JOINT_STATE_NS * sum(MESSAGE_HEAD_BYTES + len(message) + INDEX_BYTES for message in shown)
    growth_bytes_s = of_samples + of_states + CHUNKS_BYTES_S
    files = sum(map(len, attached.values())) + len(attached.get(URDF, b""))  # a topic has it too, for viewers
    return round(duration_s * growth_bytes_s) + ENDS_BYTES + files


class DiskRoom:
    """The room for one log."""

    def __init__(self, log: Path, free: FreeBytes = free_bytes) -> None:
        self._log = log
        self._free = free

    def require(self, needed_bytes: int) -> None:
        """Ask before anything moves.

        Raises:
            DiskSpaceShort: there is less than that, and a reserve.
            OutputFailed: there is no such folder.
        """
        self._require(
            needed_bytes + RESERVE_BYTES,
            f"{_megabytes(needed_bytes)} for the log of this plan and {_megabytes(RESERVE_BYTES)} in reserve",
            "nothing has moved; free space, name a folder on another disk, or plan a shorter run",
        )

    def check(self) -> None:
        """Ask while the log grows.

        Raises:
            DiskSpaceShort: the reserve is all that is left.
            OutputFailed: the folder has gone.
        """
        self._require(
            RESERVE_BYTES,
            f"{_megabytes(RESERVE_BYTES)} in reserve",
            "the axes were sent a stop; the log up to there is finished and marked invalid: free space, record again",
        )

    def _require(self, least_bytes: int, expected: str, remedy: str) -> None:
        with writing(self._log.parent):
            free = self._free(self._log.parent)
        if free < least_bytes:
            found = f"{_megabytes(free)} left on its disk"
            raise DiskSpaceShort(str(self._log), found=found, expected=expected, remedy=remedy)


def _megabytes(number: int) -> str:
    return f"{number / 1e6:.1f} MB"


_ROUNDING_KG = 1e-9  #: Two spellings of one number are one number


def tolerance_kg(payloads: Iterable[WeighedPayload], name: str) -> float:
    """How far two weighings of a body may differ [kg]; 0 for one that the cell does not have."""
    return next((payload.mass_tolerance_kg for payload in payloads if payload.name == name), 0.0)


def agree(one_kg: float, other_kg: float, within_kg: float) -> bool:
    """Whether two weighings are of the same body."""
    return abs(one_kg - other_kg) <= within_kg + _ROUNDING_KG


def check_entered_mass(cell: Cell, payload: Payload | None, entered_kg: float | None) -> None:
    """Refuse a mass from the scale that is not the cell file's, before anything moves.

    Raises:
        UsageError: it differs by more than the payload's `mass_tolerance_kg`, or nothing is mounted.
    """
    if entered_kg is None:
        return
    if payload is None:
        raise UsageError(
            "--mass",
            found=f"{entered_kg:g} kg and no payload",
            expected="the mass of what is mounted",
            remedy="name the payload too, or leave out its mass",
        )
    declared_kg, within_kg = payload.known["m"], tolerance_kg(cell.payloads, payload.name)
    if not agree(entered_kg, declared_kg, within_kg):
        raise UsageError(
            f"payload {payload.name!r}",
            found=f"{entered_kg:g} kg from the scale",
            expected=f"{declared_kg:g} kg within {within_kg:g} kg, as in the cell file",
            remedy="weigh it again and correct the wrong one of the two: all gains are in proportion to this mass",
        )


NEVER = 2**31 - 1  #: Searches of the middle generation before one of everything


@contextmanager
def defer_full_gc() -> Iterator[None]:
    """Defer full collections until the block ends; young objects are still collected.

    A search through all that the program and its libraries have made takes tens of milliseconds, in which nothing else
    of the process runs: so many periods without SYNC at 1 kHz, and a run that is marked invalid.
    """
    before = gc.get_threshold()
    # Python's own limits for young objects, which the command line raises: each of these searches takes microseconds.
    gc.set_threshold(700, 10, NEVER)
    try:
        yield
    finally:
        gc.set_threshold(*before)
