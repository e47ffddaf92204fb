"""A file is replaced whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import stat
from collections.abc import Callable
from contextlib import suppress
from io import BufferedReader
from pathlib import Path

# A folder on the disk.


def fsync_folder(folder: Path) -> None:
    """Flush the folder itself: without it a new name in it may not survive a power cut (POSIX fsync, open(2)).

    Raises:
        OSError: from the file system.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_file(
    path: Path, content: bytes, *, check: Callable[[bytes], None] | None = None, like: Path | None = None
) -> None:
    """Put `content` at `path`: temporary file in the same folder → fsync → read back and check → rename → fsync folder.

    Until the rename the old file stands untouched, after it the new one is complete: a kill at any point leaves
    one of the two. Mode, owner and access lists of an existing file are kept, and a symbolic link keeps pointing
    where it points: the file behind it is replaced.

    Args:
        path: file to make or replace; its folder must exist.
        content: all of it.
        check: called with what the disk gives back, before the rename; whatever it raises stops the replacement.
        like: file whose mode, owner and access lists it takes instead.

    Raises:
        OSError: from the file system, also where owner or access lists cannot be kept; nothing but a failing fsync of
            the folder leaves the new content in place.
    """
    target = path.resolve()
    model = like or (target if target.exists() else None)
    temporary = _write_beside(target, content, model)
    try:
        if check is not None:
            check(temporary.read_bytes())
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    fsync_folder(target.parent)


def _write_beside(target: Path, content: bytes, like: Path | None) -> Path:
    """Write `content`, flushed to the disk, into a new hidden file in the folder of `target`.

    Args:
        target: the file that it will become.
        content: all of it.
        like: file whose mode, owner and access lists it takes, or None for those of any new file.

    Returns:
        the temporary file; removed already when anything raises.

    Raises:
        OSError: from the file system, also where owner or access lists cannot be kept.
    """
    # Nobody may open it before it has the rights of the other: who has it open reads on.
    temporary, descriptor = _new_file(target, 0o666 if like is None else 0o600)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            _take_mode_and_owner(stream.fileno(), like)
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return temporary


def _new_file(target: Path, mode: int) -> tuple[Path, int]:
    """A hidden file that nobody else has (O_EXCL), with as much of the mode as the process gives a new file."""
    attempt = 0
    while True:
        temporary = target.parent / f".{target.name}.{os.getpid()}-{attempt}.tmp"
        with contextlib.suppress(FileExistsError):
            return temporary, os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
        attempt += 1


def _take_mode_and_owner(descriptor: int, like: Path | None) -> None:
    if like is None:
        return
    wanted = like.stat()
    found = os.fstat(descriptor)
    if (found.st_uid, found.st_gid) != (wanted.st_uid, wanted.st_gid):
        os.fchown(descriptor, wanted.st_uid, wanted.st_gid)
    _take_attributes(descriptor, like)
    os.fchmod(descriptor, wanted.st_mode & 0o7777)


_ACCESS = "system.posix_acl_"
_KERNEL = ("security.", "trusted.")
"""Labels (SELinux), capabilities, checksums (IMA): many of them the kernel alone may set, and sets anew by itself."""


def _take_attributes(descriptor: int, like: Path) -> None:
    """Access lists, and whatever else rides on extended attributes.

    Raises:
        OSError: one that is there cannot be kept: without its access list a file is open to more people, or to fewer.
    """
    try:
        wanted, found = os.listxattr(like), os.listxattr(descriptor)
    except OSError as error:
        if error.errno == errno.ENOTSUP:
            return
        raise
    for name in found:
        # What the folder gives every new file (setfacl -d) would let in whom the old file kept out.
        if name.startswith(_ACCESS) and name not in wanted:
            os.removexattr(descriptor, name)
    for name in wanted:
        try:
            os.setxattr(descriptor, name, os.getxattr(like, name))
        except OSError as error:
            if not name.startswith(_KERNEL) and error.errno != errno.ENOTSUP:
                raise


# Reading what must be a regular file of bounded size: nobody waits at a pipe, and no device fills the memory.


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


# By what a content is recognised: SHA-256, hexadecimal.


def sha256(content: bytes) -> str:
    """Of bytes that have been read."""
    return hashlib.sha256(content).hexdigest()


def sha256_of(path: Path) -> str | None:
    """Of a file, read piece by piece; None where there is no regular file that can be read."""
    with suppress(OSError), open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
    return None
