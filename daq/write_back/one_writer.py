"""One writer of a controller file at a time."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from daq.errors import ControllerBusy


@contextlib.contextmanager
def only_writer(target: Path) -> Iterator[None]:
    """Hold the file's lock; the system gives it back even after a kill.

    The lock file is removed at the end. A second writer may have opened it just before: its lock is then on a file
    that has no name any more, which it sees by the inode, and takes the lock anew.

    Raises:
        ControllerBusy: somebody else holds it.
        OSError: from the file system.
    """
    lock = target.parent / f".{target.name}.lock"
    while True:
        descriptor = _opened(lock)
        try:
            _take(descriptor, target)
            if _is_at(descriptor, lock):
                try:
                    yield
                finally:
                    lock.unlink(missing_ok=True)
                return
        finally:
            os.close(descriptor)


def _opened(lock: Path) -> int:
    """The lock's file, which everybody may open: one that a killed writer left must not keep other users out.

    To hold a lock nothing need be written, and where others may write it the next user could not tell who did.
    """
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        descriptor = os.open(lock, flags | os.O_CREAT | os.O_EXCL, 0o644)
    except FileExistsError:
        # Without O_CREAT: in a folder with the sticky bit the system refuses it for another user's file.
        try:
            return os.open(lock, flags)
        except FileNotFoundError:  # its owner was done just now
            return os.open(lock, flags | os.O_CREAT, 0o644)
    os.fchmod(descriptor, 0o644)  # whatever the umask
    return descriptor


def _take(descriptor: int, target: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise ControllerBusy(
            str(target),
            found="another drivegain writing it",
            expected="one writer at a time",
            remedy="wait until it has finished, then look at a new dry run",
        ) from error


def _is_at(descriptor: int, path: Path) -> bool:
    with contextlib.suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(descriptor), path.stat())
    return False
