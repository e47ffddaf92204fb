"""Disks that take what is written to them late, or refuse it."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class Disk(io.RawIOBase):
    """A raw file on a disk to which something happens before each write."""

    def __init__(
        self, file: io.FileIO, happens: Callable[[], object], largest_bytes: int = 2**20
    ) -> None:
        """Store the arguments.

        Args:
            file: closed with this one.
            happens: called before each write.
            largest_bytes: most bytes that one write takes.
        """
        super().__init__()
        self._file = file
        self._happens = happens
        self._largest_bytes = largest_bytes

    def writable(self) -> bool:
        """Return that it can be written."""
        return True

    def fileno(self) -> int:
        """Return the file's descriptor."""
        return self._file.fileno()

    def write(self, data: ReadableBuffer, /) -> int:
        """Write, after what happens before."""
        self._happens()
        taken = memoryview(data)[: self._largest_bytes]
        return os.write(self._file.fileno(), taken)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


def refuse() -> None:
    """Raise what a full disk does."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
