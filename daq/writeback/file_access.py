"""Access to a controller's file: which links may be followed, one writer at a time,
and backups next to it.

A backup is called FILE.<time>.<was>-<became>.bak. Both digests are the first digits of SHA-256: of
the backup's content, and of the content that replaced it. So a backup shows by itself whether it
was changed, and whether the controller file was changed since; there is no other file that could be
lost or disagree.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from daq.errors import (
    CalibrationRefused,
    ControllerUnfit,
    OutputFailed,
    WriteUnconfirmed,
    reason_of,
)
from daq.files import follow_links, hold_lock, open_folder, replace_file
from daq.formats.document import read_controller_file
from daq.writeback.request import short_digest


def resolve_links(file: Path) -> Path:
    """Resolve the symbolic links of a file's name, those of its folders included.

    A file that is gone resolves to where its links still lead.

    Args:
        file: as it was declared. A name that was resolved before has no links left to judge.

    Raises:
        ControllerUnfit: the name is too long, the links form a circle, one of them belongs to
            another user, or they lead into a folder in which every user may exchange the file.
    """
    try:
        target = follow_links(file)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise ControllerUnfit(
                str(file),
                found=reason_of(error),
                expected="a name that the file system takes",
                remedy="correct `controller.file` of the cell configuration, or give --to FILE",
            ) from error
        if error.errno not in (errno.ELOOP, errno.EPERM):
            raise
        raise ControllerUnfit(
            str(file),
            found=error.strerror or "",
            expected="a link of the file's owner, or of you, that leads to the controller's file",
            remedy="name the file itself, or make the link anew",
        ) from error
    if (folder := open_folder(file, target)) is not None:
        raise ControllerUnfit(
            str(file),
            found=f"a symbolic link into {folder}, a folder that everybody may write",
            expected="a folder in which no other user can exchange the file",
            remedy="take that right away (`chmod o-w`), or name the file itself",
        )
    return target


def require_existing(file: Path) -> None:
    """Refuse a symbolic link that leads nowhere, by that name,
    and a file of several names (hard links).

    A new file takes the place of one name; a controller that reads another one would keep the
    current gains.

    Raises:
        ControllerUnfit: for either; see also `resolve_links`.
    """
    target = resolve_links(file)
    if file.is_symlink() and not target.exists():
        raise ControllerUnfit(
            str(file),
            found=f"a symbolic link to {target}, which is not there",
            expected="a link that leads to the controller's file",
            remedy="correct the link, or name the file itself",
        )
    if target.is_file() and (names := target.stat().st_nlink) > 1:
        quoted = shlex.quote(str(target))
        raise ControllerUnfit(
            str(file),
            found=f"a file with {names} names (hard links)",
            expected="one name: under the others the current gains would stay",
            remedy="find the others (`find / -xdev -samefile FILE`) and make symbolic links of "
            f"them, or give this name a file of its own: cp -p {quoted} {quoted}.new && mv "
            f"{quoted}.new {quoted}",
        )


@contextlib.contextmanager
def exclusive_writer(target: Path) -> Iterator[None]:
    """Exclude other writers of a file, and remove the copies that killed ones have left.

    Raises:
        CalibrationRefused: another drivegain writes it.
        OutputFailed: the lock file cannot be made, or something else has its name.
    """
    lock = target.parent / f".{target.name}.lock"
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(hold_lock(lock))
        except BlockingIOError as error:
            raise CalibrationRefused(
                str(target),
                found="another drivegain writing it",
                expected="one writer at a time",
                remedy="wait until it has finished, then take a new dry run",
            ) from error
        except OSError as error:
            # Not "it is as it was": an empty lock file may stay behind where the disk refuses to
            # remove it.
            raise OutputFailed(
                str(lock),
                found=reason_of(error),
                expected="a lock file next to the controller's file",
                remedy="nothing was written to the controller; free space or rights",
            ) from error
        _remove_unfinished(target)
        yield


def _remove_unfinished(target: Path) -> None:
    """Remove unfinished copies of a file and of its backups, as `replace_file` names them.

    Whoever has the lock knows that no writer works on them.
    """
    name = re.compile(rf"\.{re.escape(target.name)}(\..*\.bak)?\.\d+-\d+\.tmp")
    with contextlib.suppress(OSError):
        for found in target.parent.iterdir():
            if name.fullmatch(found.name):
                found.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class Backup:
    """A backup next to a controller file; all but its content is in its name."""

    path: Path  #: file
    stamp: str  #: time in its name
    count: int  #: number among those of that time
    was: str  #: digest of its content
    after_digest: str  #: digest of the content that replaced it in the controller file

    def content(self) -> bytes:
        """Read the backup.

        Raises:
            ControllerUnfit: it was changed, or cannot be read.
        """
        content = read_controller_file(self.path)
        if short_digest(content) != self.was:
            raise ControllerUnfit(
                str(self.path),
                found=f"{len(content)} bytes with SHA-256 {short_digest(content)}…",
                expected=f"{self.was}…, as its name says",
                remedy="this backup was changed after it was made, and nothing was restored; if "
                "its gains are right, copy it over the controller file by hand",
            )
        return content


def backups(target: Path) -> tuple[Backup, ...]:
    """Backups next to a controller file, oldest first."""
    name = re.compile(
        re.escape(target.name)
        + r"\.([0-9]{8}T[0-9]{6}Z)(?:-([0-9]+))?\.([0-9a-f]{12})-([0-9a-f]{12})\.bak"
    )
    found = [
        Backup(path, match[1], int(match[2] or 0), match[3], match[4])
        for path in target.parent.iterdir()
        if (match := name.fullmatch(path.name)) is not None
    ]
    return tuple(sorted(found, key=lambda one: (one.stamp, one.count)))


def backups_without_log(audit: Path, target: Path) -> int:
    """Return the number of backups next to a controller file whose audit log is absent;
    0 where there is a log.

    A write that is audited leaves both: backups alone show that the log was removed or moved, or
    that another is used.
    """
    if os.path.lexists(audit):
        return 0
    try:
        return len(backups(target))
    except OSError:  # a folder that is gone or may not be read
        return 0


def back_up(target: Path, before: bytes, after: bytes, now: datetime) -> Path:
    """Write a complete backup, later in order than every other; the caller holds the file's lock.

    Mode and owner are taken from the file.

    Raises:
        OSError: from the file system; no backup is left.
    """
    order = next_order([(one.stamp, one.count) for one in backups(target)], now)
    backup = target.with_name(
        f"{target.name}.{order}.{short_digest(before)}-{short_digest(after)}.bak"
    )
    # The lock excludes every other drivegain, and time and count are beyond every backup: the name
    # is free.
    try:
        replace_file(backup, before, like=target)
    except BaseException as error:
        backup.unlink(missing_ok=True)
        if isinstance(error, WriteUnconfirmed):
            # It is about the backup, which is gone: the controller's file is as it was.
            raise OSError(error.errno, error.strerror, str(backup)) from error
        raise
    return backup


def next_order(taken: Sequence[tuple[str, int]], now: datetime) -> str:
    """Return time and count for the name of a backup, later in order than all others.

    A clock that was set back, or two writes in one second, must not make an older one look newer.
    `taken` has time and count of the others, in order.
    """
    stamp = now.astimezone(UTC).strftime("%Y%m%dT%H%M%SZ")
    count = 0
    if taken and taken[-1] >= (stamp, count):
        stamp = taken[-1][0]
        count = taken[-1][1] + 1
    return f"{stamp}-{count}" if count else stamp
