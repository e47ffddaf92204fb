"""A file is replaced whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path


def replace_file(
    path: Path, content: bytes, *, check: Callable[[bytes], None] | None = None, like: Path | None = None
) -> None:
    """Put `content` at `path`: temporary file in the same folder → fsync → read back and check → rename → fsync folder.

    Until the rename the old file stands untouched, after it the new one is complete: a kill at any point leaves
    one of the two. Mode and owner of an existing file are kept, and a symbolic link keeps pointing where it
    points: the file behind it is replaced.

    Args:
        path: file to make or replace; its folder must exist.
        content: all of it.
        check: called with what the disk gives back, before the rename; whatever it raises stops the replacement.
        like: file whose mode and owner it takes instead.

    Raises:
        OSError: from the file system; nothing but a failing fsync of the folder leaves the new content in place.
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
    _fsync_folder(target.parent)


def _write_beside(target: Path, content: bytes, like: Path | None) -> Path:
    """Write `content`, flushed to the disk, into a new hidden file in the folder of `target`.

    Args:
        target: the file that it will become.
        content: all of it.
        like: file whose mode and owner it takes, or None for those of any new file.

    Returns:
        the temporary file; removed already when anything raises.

    Raises:
        OSError: from the file system, with PermissionError where the owner cannot be kept.
    """
    temporary, descriptor = _new_file(target)
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


def _fsync_folder(folder: Path) -> None:
    """Flush the folder itself: without it a rename may not survive a power cut (POSIX fsync, open(2))."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _new_file(target: Path) -> tuple[Path, int]:
    """A hidden file that nobody else has (O_EXCL), with the mode that the process gives any new file."""
    attempt = 0
    while True:
        temporary = target.parent / f".{target.name}.{os.getpid()}-{attempt}.tmp"
        with contextlib.suppress(FileExistsError):
            return temporary, os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        attempt += 1


def _take_mode_and_owner(descriptor: int, like: Path | None) -> None:
    if like is None:
        return
    wanted = like.stat()
    found = os.fstat(descriptor)
    if (found.st_uid, found.st_gid) != (wanted.st_uid, wanted.st_gid):
        os.fchown(descriptor, wanted.st_uid, wanted.st_gid)
    os.fchmod(descriptor, wanted.st_mode & 0o7777)
    # Access lists and labels (SELinux) ride on extended attributes; a file system without them has none to keep.
    with contextlib.suppress(OSError):
        for name in os.listxattr(like):
            os.setxattr(descriptor, name, os.getxattr(like, name))
