"""A file is replaced whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Callable
from pathlib import Path

from daq.folder import fsync_folder


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
