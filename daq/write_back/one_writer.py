"""One writer of a controller file at a time."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from daq.errors import ControllerBusy

_MODE = 0o644
"""Everybody may read it, and that is enough to lock it (not on NFS, which wants it writable)."""


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
                    # Another user's may stay, where only they may remove it: nobody holds it.
                    with contextlib.suppress(PermissionError):
                        lock.unlink(missing_ok=True)
                return
        finally:
            os.close(descriptor)


def _opened(lock: Path) -> int:
    """The lock's file, made where there is none; one that another user has left does not keep anybody out."""
    flags = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    while True:
        with contextlib.suppress(FileExistsError):
            descriptor = os.open(lock, flags | os.O_RDWR | os.O_CREAT | os.O_EXCL, _MODE)
            try:
                os.fchmod(descriptor, _MODE)  # whatever the umask
            except BaseException:  # an interrupt too: a lock that others cannot open must not stay behind
                os.close(descriptor)
                lock.unlink(missing_ok=True)
                raise
            return descriptor
        # Without O_CREAT: in a folder with the sticky bit the system refuses it for another user's file.
        with contextlib.suppress(FileNotFoundError):  # whose owner was done just now
            try:
                return os.open(lock, flags | os.O_RDWR)
            except PermissionError:
                return os.open(lock, flags | os.O_RDONLY)


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
