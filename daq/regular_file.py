"""Reading what must be a regular file of bounded size: nobody waits at a pipe, and no device fills the memory."""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path


def open_regular(path: Path) -> BufferedReader:
    """A file, open for reading.

    Raises:
        OSError: there is none, it is no regular file, or cannot be read; ``strerror`` says which.
    """
    # Looked at before it is opened: opening may rewind a tape, or wake up whoever waits at a pipe.
    _check(path.stat(), path)
    stream = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    try:
        _check(os.fstat(stream.fileno()), path)
    except OSError:
        stream.close()
        raise
    return stream


def read_regular(path: Path, largest_bytes: int) -> bytes:
    """The content of a file.

    Raises:
        OSError: there is none, it is no regular file, is larger, or cannot be read; ``strerror`` says which.
    """
    with open_regular(path) as stream:
        content = stream.read(largest_bytes + 1)
    if len(content) > largest_bytes:
        raise OSError(errno.EFBIG, f"more than {largest_bytes} bytes", str(path))
    return content


def _check(found: os.stat_result, path: Path) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, "is a directory", str(path))
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "something that is no regular file", str(path))
