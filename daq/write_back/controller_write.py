"""The controller file on the disk: one writer at a time, a backup first, replaced whole, and back again."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from daq.atomic_file import replace_file
from daq.errors import BackupMissing, ControllerBusy, ControllerChanged
from daq.write_back.controller_file import decode, read_bytes

_STAMP = "%Y%m%dT%H%M%SZ"


@dataclass(frozen=True, slots=True)
class Written:
    """What a replacement did.

    Attributes:
        file: the file that was replaced, symbolic links followed.
        backup: where its former content is.
        before, after: content.
        restored: the backup that `after` came from, None where it did not.
    """

    file: Path
    backup: Path
    before: bytes
    after: bytes
    restored: Path | None = None


def sha256(content: bytes) -> str:
    """Digest by which a base file is recognised."""
    return hashlib.sha256(content).hexdigest()


def write(file: Path, after: bytes, base_sha256: str, check: Callable[[bytes], None], now: datetime) -> Written:
    """Replace a controller file, if it is still the one that was looked at.

    Args:
        file: the controller file, or a symbolic link to it.
        after: its new content.
        base_sha256: digest of the content that the change was worked out for.
        check: called with what the disk gives back before anything is replaced.
        now: time for the backup's name.

    Raises:
        ControllerChanged: somebody has changed the file since.
        ControllerBusy: somebody is writing it.
        ControllerUnfit: from `check`, or it cannot be read.
        OSError: from the file system; the old content stands, and neither backup nor temporary file is left.
    """
    target = file.resolve()
    with _only_writer(target):
        before = read_bytes(target)
        found = sha256(before)
        if found != base_sha256:
            raise ControllerChanged(
                str(file),
                found=f"content {found[:12]}…",
                expected=f"{base_sha256[:12]}…, for which the change was shown",
                remedy="somebody has changed the file: look at a new dry run",
            )
        return _replace(target, before, after, check, now)


def roll_back(file: Path, now: datetime) -> Written:
    """Put back the newest backup that differs from the file; what it replaces becomes a backup too.

    Raises:
        BackupMissing: there is none.
        ControllerBusy: somebody is writing the file.
        ControllerUnfit: the file cannot be read, or the backup is no YAML.
        OSError: from the file system; the file stands as it was.
    """
    target = file.resolve()
    with _only_writer(target):
        before = read_bytes(target)
        names = backups(target)
        for backup in reversed(names):
            after = backup.read_bytes()
            # An empty backup is only a name, kept by a writer that was killed before it filled it.
            if after and after != before:
                written = _replace(target, before, after, partial(_check_parses, name=str(backup)), now)
                return replace(written, restored=backup)
    raise BackupMissing(
        str(file),
        found=f"{len(names)} backups with the same content" if names else "no backup beside it",
        expected=f"{target.name}.<time>.bak with another content",
        remedy="nothing was changed",
    )


def backups(target: Path) -> tuple[Path, ...]:
    """Backups beside a controller file, oldest first."""
    found = [(order, path) for path in target.parent.iterdir() if (order := _order(target, path.name)) is not None]
    return tuple(path for _, path in sorted(found))


def _replace(target: Path, before: bytes, after: bytes, check: Callable[[bytes], None], now: datetime) -> Written:
    backup = _back_up(target, before, now)
    try:
        replace_file(target, after, check=check)
    except BaseException:
        # Before the rename the old file still stands; after it (the folder's fsync failed) the backup takes its place.
        if target.read_bytes() == before:
            backup.unlink()
        else:
            backup.replace(target)
        raise
    return Written(target, backup, before, after)


def _back_up(target: Path, content: bytes, now: datetime) -> Path:
    """Write a complete backup under a name that nothing had, later in order than every other backup."""
    stamp, count = now.astimezone(UTC).strftime(_STAMP), 0
    taken = backups(target)
    newest = _order(target, taken[-1].name) if taken else None
    if newest is not None and newest >= (stamp, count):
        # A clock set back, or two writes in one second, must not make an older backup look newer.
        stamp, count = newest[0], newest[1] + 1
    name = _reserve(target, stamp, count)
    try:
        replace_file(name, content, like=target)
    except BaseException:
        name.unlink()
        raise
    return name


def _reserve(target: Path, stamp: str, count: int) -> Path:
    while True:
        name = target.parent / f"{target.name}.{stamp}{f'-{count}' if count else ''}.bak"
        with contextlib.suppress(FileExistsError):
            os.close(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
            return name
        count += 1


def _order(target: Path, name: str) -> tuple[str, int] | None:
    """(time stamp, counter) of a backup's name, None for any other file."""
    match = re.fullmatch(re.escape(target.name) + r"\.([0-9]{8}T[0-9]{6}Z)(?:-([0-9]+))?\.bak", name)
    return None if match is None else (match[1], int(match[2] or 0))


@contextlib.contextmanager
def _only_writer(target: Path) -> Iterator[None]:
    """Hold the file's lock; the system gives it back even after a kill.

    The lock file is removed at the end. A second writer may have opened it just before: its lock is then on a file
    that has no name any more, which it sees by the inode, and takes the lock anew.
    """
    lock = target.parent / f".{target.name}.lock"
    while True:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
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


def _check_parses(content: bytes, name: str) -> None:
    decode(content, name).locate(())
