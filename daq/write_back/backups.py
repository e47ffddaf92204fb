"""Backups beside a controller file.

A backup is called FILE.<time>.<was>-<became>.bak. Both digests are the first of SHA-256: of what is in the backup, and
of what took its place. So a backup says by itself whether somebody has changed it, and whether somebody has changed the
controller file since; no other file could be lost, or disagree.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from daq.atomic_file import replace_file
from daq.errors import ControllerUnfit
from daq.folder import fsync_folder
from daq.write_back.controller_file import read_bytes

_STAMP = "%Y%m%dT%H%M%SZ"
_DIGEST = 12
"""Hexadecimal digits of SHA-256 in a backup's name: 48 bits tell a few hundred contents apart."""


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

    def content(self) -> bytes:
        """What is in it.

        Raises:
            ControllerUnfit: it is not what was put there, or cannot be read.
        """
        content = read_bytes(self.path)
        if short_digest(content) != self.was:
            raise ControllerUnfit(
                str(self.path),
                found=f"{len(content)} bytes with SHA-256 {short_digest(content)}…",
                expected=f"{self.was}…, as its name says",
                remedy="this backup was changed after it was made, and nothing was restored; if its gains are right, "
                "copy it over the controller file by hand",
            )
        return content


def backups(target: Path) -> tuple[Backup, ...]:
    """Backups beside a controller file, oldest first."""
    found = (_backup(target, path) for path in target.parent.iterdir())
    return tuple(sorted((backup for backup in found if backup is not None), key=lambda b: (b.stamp, b.count)))


def back_up(target: Path, before: bytes, after: bytes, now: datetime) -> Path:
    """Write a complete backup, later in order than every other; the caller holds the file's lock.

    Args:
        target: the controller file; mode and owner are taken from it.
        before: its content.
        after: what will take its place.
        now: time for the name.

    Raises:
        OSError: from the file system; no backup is left.
    """
    stamp, count = now.astimezone(UTC).strftime(_STAMP), 0
    taken = backups(target)
    if taken and (taken[-1].stamp, taken[-1].count) >= (stamp, count):
        # A clock set back, or two writes in one second, must not make an older backup look newer.
        stamp, count = taken[-1].stamp, taken[-1].count + 1
    order = f"{stamp}-{count}" if count else stamp
    backup = target.with_name(f"{target.name}.{order}.{short_digest(before)}-{short_digest(after)}.bak")
    # The lock keeps every other drivegain out, and time and count are beyond every backup: nobody has this name.
    try:
        replace_file(backup, before, like=target)
    except BaseException:
        backup.unlink(missing_ok=True)
        raise
    return backup


def put_back(backup: Path, target: Path) -> None:
    """Give a backup the name of the file again that took its place; it is none any more.

    Raises:
        OSError: from the file system; a failing fsync of the folder is passed over, as the name is there.
    """
    backup.replace(target)
    with contextlib.suppress(OSError):
        fsync_folder(target.parent)


def short_digest(content: bytes) -> str:
    """The digest of a content as it stands in a backup's name."""
    return hashlib.sha256(content).hexdigest()[:_DIGEST]


def _backup(target: Path, path: Path) -> Backup | None:
    """A backup by its name, None for any other file."""
    match = re.fullmatch(
        re.escape(target.name) + r"\.([0-9]{8}T[0-9]{6}Z)(?:-([0-9]+))?\.([0-9a-f]{12})-([0-9a-f]{12})\.bak", path.name
    )
    return None if match is None else Backup(path, match[1], int(match[2] or 0), match[3], match[4])
