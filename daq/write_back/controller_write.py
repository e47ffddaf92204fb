"""The controller file on the disk: one writer at a time, a backup first, replaced whole, and back again.

A backup is called FILE.<time>.<was>-<became>.bak. Both digests are the first of SHA-256: of what is in the backup, and
of what took its place. So a backup says by itself whether somebody has changed it, and whether somebody has changed the
controller file since; no other file could be lost, or disagree.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import re
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from daq.atomic_file import replace_file
from daq.errors import BackupMissing, ControllerBusy, ControllerChanged, ControllerUnfit
from daq.write_back.controller_file import decode, read_bytes

_STAMP = "%Y%m%dT%H%M%SZ"
_DIGEST = 12
"""Hexadecimal digits of SHA-256 in a backup's name: 48 bits tell a few hundred contents apart."""


@dataclass(frozen=True, slots=True)
class Written:
    """What a replacement did.

    Attributes:
        file: the file that was replaced, symbolic links followed.
        backup: where its former content is.
        before, after: content.
    """

    file: Path
    backup: Path
    before: bytes
    after: bytes


@dataclass(frozen=True, slots=True)
class Restored:
    """What a way back did.

    Attributes:
        file: the controller file, symbolic links followed.
        source: the backup that it was restored from.
        backup: where its former content is, None where the file was gone.
        before, after: content; before is empty where the file was gone.
    """

    file: Path
    source: Path
    backup: Path | None
    before: bytes
    after: bytes


@dataclass(frozen=True, slots=True)
class Backup:
    """A backup beside a controller file, as its name tells.

    Attributes:
        path: of it.
        stamp, count: its place in the order of time.
        was: digest of what is in it.
        became: digest of what took its place in the controller file.
    """

    path: Path
    stamp: str
    count: int
    was: str
    became: str


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


def roll_back(file: Path, now: datetime) -> Restored:
    """Take the last write back: put the newest backup that differs from the file in its place.

    What it replaces becomes a backup too, so that a second way back undoes the first. A file that was deleted comes
    back as it was before the last write.

    Raises:
        BackupMissing: there is none.
        ControllerBusy: somebody is writing the file.
        ControllerChanged: the file is not what was written when that backup was made: somebody has edited it since.
        ControllerUnfit: the file cannot be read; the backup was changed, or is no YAML.
        OSError: from the file system; the file stands as it was.
    """
    target = file.resolve()
    with _only_writer(target):
        before = read_bytes(target) if target.exists() else None
        found = backups(target)
        for backup in reversed(found):
            # A writer that was killed before it replaced the file leaves a backup of what is still there.
            if before is None or backup.was != _digest(before):
                after = _content(backup)
                if before is not None:
                    _check_unedited(file, before, backup)
                return _restore(target, before, after, backup, now)
    raise BackupMissing(
        str(file),
        found=f"{len(found)} backups with the same content" if found else "no backup beside it",
        expected=f"{target.name}.<time>.<digests>.bak with another content",
        remedy="nothing was changed",
    )


def backups(target: Path) -> tuple[Backup, ...]:
    """Backups beside a controller file, oldest first."""
    found = (_backup(target, path) for path in target.parent.iterdir())
    return tuple(sorted((backup for backup in found if backup is not None), key=lambda b: (b.stamp, b.count)))


def _content(backup: Backup) -> bytes:
    """What is in a backup.

    Raises:
        ControllerUnfit: it is not what was put there.
    """
    content = backup.path.read_bytes()
    if _digest(content) != backup.was:
        raise ControllerUnfit(
            str(backup.path),
            found=f"{len(content)} bytes with SHA-256 {_digest(content)}…",
            expected=f"{backup.was}…, as its name says",
            remedy="this backup was changed after it was made, and nothing was restored; if its gains are right, copy "
            "it over the controller file by hand",
        )
    return content


def _check_unedited(file: Path, before: bytes, backup: Backup) -> None:
    if _digest(before) != backup.became:
        one, other = shlex.quote(str(backup.path)), shlex.quote(str(file))
        raise ControllerChanged(
            str(file),
            found=f"content {_digest(before)}…",
            expected=f"{backup.became}…, as drivegain wrote it when it made {backup.path.name}",
            remedy="somebody has edited the file since, and going back would lose that; look at the difference with "
            f"`diff {one} {other}`; to go back all the same, `cp {one} {other}`",
        )


def _restore(target: Path, before: bytes | None, after: bytes, source: Backup, now: datetime) -> Restored:
    check = partial(_check_parses, name=str(source.path))
    if before is not None:
        written = _replace(target, before, after, check, now)
        return Restored(target, source.path, written.backup, before, after)
    try:
        replace_file(target, after, check=check, like=source.path)
    except BaseException:  # an interrupt too: what is restored is there whole, or not at all
        target.unlink(missing_ok=True)
        raise
    return Restored(target, source.path, None, b"", after)


def _replace(target: Path, before: bytes, after: bytes, check: Callable[[bytes], None], now: datetime) -> Written:
    backup = _back_up(target, before, after, now)
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


def _back_up(target: Path, before: bytes, after: bytes, now: datetime) -> Path:
    """Write a complete backup, later in order than every other."""
    stamp, count = now.astimezone(UTC).strftime(_STAMP), 0
    taken = backups(target)
    if taken and (taken[-1].stamp, taken[-1].count) >= (stamp, count):
        # A clock set back, or two writes in one second, must not make an older backup look newer.
        stamp, count = taken[-1].stamp, taken[-1].count + 1
    order = f"{stamp}-{count}" if count else stamp
    backup = target.with_name(f"{target.name}.{order}.{_digest(before)}-{_digest(after)}.bak")
    # The lock keeps every other drivegain out, and time and count are beyond every backup: nobody has this name.
    try:
        replace_file(backup, before, like=target)
    except BaseException:
        backup.unlink(missing_ok=True)
        raise
    return backup


def _backup(target: Path, path: Path) -> Backup | None:
    """A backup by its name, None for any other file."""
    match = re.fullmatch(
        re.escape(target.name) + r"\.([0-9]{8}T[0-9]{6}Z)(?:-([0-9]+))?\.([0-9a-f]{12})-([0-9a-f]{12})\.bak", path.name
    )
    return None if match is None else Backup(path, match[1], int(match[2] or 0), match[3], match[4])


def _digest(content: bytes) -> str:
    return sha256(content)[:_DIGEST]


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
