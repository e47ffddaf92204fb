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
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
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
