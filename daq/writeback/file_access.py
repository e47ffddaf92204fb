"""Access to a controller's file: which links may be followed, one writer at a time,
and backups next to it.

A backup is called FILE.<time>.<before>-<after>.bak. Both digests are the first digits of SHA-256:
of the backup's content, and of the content that replaced it. So the name alone shows whether the
backup was changed, and whether the controller file was changed since. No other file is needed that
could be lost or disagree.
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
from daq.files import (
    follow_links,
    hold_lock,
    open_folder,
    replace_file,
    target_of_copy,
    try_replacing,
)
from daq.formats.document import read_controller_file
from daq.writeback.request import short_digest


def resolve_links(file: Path) -> Path:
    """Resolve the symbolic links of a file's name, those of its folders included.

    If the file is gone, the result is the place to which its links still lead.

    Args:
        file: as it was declared, not as it was resolved: the links themselves are judged.

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
    folder = open_folder(file, target)
    if folder is not None:
        raise ControllerUnfit(
            str(file),
            found=f"a symbolic link into {folder}, a folder that everybody may write",
            expected="a folder in which no other user can exchange the file",
            remedy="take that right away (`chmod o-w`), or name the file itself",
        )
    return target


def require_existing(file: Path) -> None:
    """Refuse a symbolic link that leads nowhere, and a file of several names (hard links).

    A write replaces the file under one name; a controller that reads it under another one would
    keep the current gains.

    Args:
        file: as it was declared; an error has this name.

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
    if not target.is_file():
        return
    name_count = target.stat().st_nlink
    if name_count > 1:
        quoted = shlex.quote(str(target))
        raise ControllerUnfit(
            str(file),
            found=f"a file with {name_count} names (hard links)",
            expected="one name: under the others the current gains would stay",
            remedy="find the others (`find / -xdev -samefile FILE`) and make symbolic links of "
            f"them, or give this name a file of its own: cp -p {quoted} {quoted}.new && mv "
            f"{quoted}.new {quoted}",
        )


@contextlib.contextmanager
def exclusive_writer(target: Path) -> Iterator[None]:
    """Exclude other writers of a file, and remove the copies that killed writers have left.

    Raises:
        CalibrationRefused: another drivegain writes it.
        OutputFailed: the lock file cannot be made, or something else has its name.
    """
    lock = _lock_of(target)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(hold_lock(lock))
        except BlockingIOError as error:
            raise CalibrationRefused(
                str(target),
                found="another drivegain writing it",
                expected="one writer at a time",
                remedy="wait until it has finished, then take a new dry run",
            ) from error
        except OSError as error:
            # The message does not say that nothing has changed: on a disk that refuses to remove
            # it, an empty lock file may remain.
            raise OutputFailed(
                str(lock),
                found=reason_of(error),
                expected="a lock file next to the controller's file",
                remedy="nothing was written to the controller; free space or rights",
            ) from error
        _remove_unfinished(target)
        yield


def _lock_of(target: Path) -> Path:
    """Return the lock file of a controller's file."""
    return target.parent / f".{target.name}.lock"


def try_writing(file: Path, now: datetime) -> None:
    """Try whether a write of a controller's file could make its files: lock, backup, new content.

    Each of them is made empty and removed again; the controller's file is only read. Nothing is
    tried while another process writes it: then there is room for them, and an unfinished copy would
    be removed by that process.

    Args:
        file: as it was declared.
        now: time, for the name of the backup.

    Raises:
        ControllerUnfit: see `resolve_links` and `require_existing`; or it cannot be read.
        OSError: from the file system; its ``filename`` is that of the file that cannot be made.
    """
    require_existing(file)
    target = resolve_links(file)
    content = read_controller_file(target)
    # The digest of the new content is not known yet; a name has the same length with any.
    backup = _new_backup(target, content, content, now)
    with contextlib.suppress(BlockingIOError), hold_lock(_lock_of(target)):
        try_replacing(backup, like=target)
        try_replacing(target)


def _remove_unfinished(target: Path) -> None:
    """Remove unfinished copies of a file and of its backups.

    The caller has the lock, so no writer works on them.
    """
    backup_name = _backup_name(target)
    with contextlib.suppress(OSError):
        for path in target.parent.iterdir():
            name = target_of_copy(path)
            if name is None:
                continue
            if name == target.name or backup_name.fullmatch(name):
                path.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class Backup:
    """A backup next to a controller file; everything but its content is in its name."""

    path: Path  #: the backup itself
    stamp: str  #: time in its name, in UTC, as YYYYMMDDThhmmssZ
    count: int  #: number among the backups of that time, from 0
    before_digest: str  #: digest of its content
    after_digest: str  #: digest of the content that replaced it in the controller file

    def content(self) -> bytes:
        """Read the backup.

        Raises:
            ControllerUnfit: it was changed, or cannot be read.
        """
        content = read_controller_file(self.path)
        digest = short_digest(content)
        if digest != self.before_digest:
            raise ControllerUnfit(
                str(self.path),
                found=f"{len(content)} bytes with SHA-256 {digest}…",
                expected=f"{self.before_digest}…, as its name says",
                remedy="this backup was changed after it was made, and nothing was restored; if "
                "its gains are right, copy it over the controller file by hand",
            )
        return content


def backups(target: Path) -> tuple[Backup, ...]:
    """Return the backups next to a controller file, oldest first."""
    backup_name = _backup_name(target)
    found = []
    for path in target.parent.iterdir():
        match = backup_name.fullmatch(path.name)
        if match is None:
            continue
        backup = Backup(
            path=path,
            stamp=match["stamp"],
            count=int(match["count"] or 0),
            before_digest=match["before"],
            after_digest=match["after"],
        )
        found.append(backup)
    found.sort(key=lambda backup: (backup.stamp, backup.count))
    return tuple(found)


def _backup_name(target: Path) -> re.Pattern[str]:
    """Return the pattern of the names of a file's backups."""
    file_name = re.escape(target.name)
    return re.compile(file_name + _AFTER_FILE_NAME)


_AFTER_FILE_NAME = (
    r"\.(?P<stamp>[0-9]{8}T[0-9]{6}Z)(?:-(?P<count>[0-9]+))?"
    r"\.(?P<before>[0-9a-f]{12})-(?P<after>[0-9a-f]{12})\.bak"
)
"""Pattern of a backup's name after the name of the file."""


def backups_without_log(audit: Path, target: Path) -> int:
    """Return the number of backups next to a controller file without an audit log;
    0 where there is a log.

    An audited write leaves a log and a backup. Backups alone show that the log was removed or
    moved, or that another log is used.
    """
    if os.path.lexists(audit):
        return 0
    try:
        return len(backups(target))
    except OSError:  # the folder is gone, or may not be read
        return 0


def back_up(target: Path, before: bytes, after: bytes, now: datetime) -> Path:
    """Write a complete backup, later in order than every other; the caller has the file's lock.

    Mode and owner are taken from the file.

    Args:
        target: the controller file.
        before: its content, which the backup gets.
        after: the content that will replace it.
        now: time, for the name.

    Raises:
        OSError: from the file system; no backup is left.
    """
    backup = _new_backup(target, before, after, now)
    # No file has this name: the lock excludes other processes of drivegain, and time and count are
    # beyond every backup.
    try:
        replace_file(backup, before, like=target)
    except BaseException as error:
        backup.unlink(missing_ok=True)
        if isinstance(error, WriteUnconfirmed):
            # Only the backup was unconfirmed, and it is gone: the controller's file is unchanged.
            raise OSError(error.errno, error.strerror, str(backup)) from error
        raise
    return backup


def _new_backup(target: Path, before: bytes, after: bytes, now: datetime) -> Path:
    """Return the name of the next backup of a controller file; as `back_up`."""
    taken = [(backup.stamp, backup.count) for backup in backups(target)]
    order = next_order(taken, now)
    before_digest = short_digest(before)
    after_digest = short_digest(after)
    return target.with_name(f"{target.name}.{order}.{before_digest}-{after_digest}.bak")


def next_order(taken: Sequence[tuple[str, int]], now: datetime) -> str:
    """Return time and count for the name of a backup, later in order than all others.

    The count is needed where the clock was set back, or where two writes are in one second: an
    older backup must not look newer.

    Args:
        taken: time and count of the other backups, in order.
        now: time of the backup.
    """
    stamp = now.astimezone(UTC).strftime("%Y%m%dT%H%M%SZ")
    count = 0
    if taken and taken[-1] >= (stamp, count):
        last_stamp, last_count = taken[-1]
        stamp = last_stamp
        count = last_count + 1
    if count == 0:
        return stamp
    return f"{stamp}-{count}"
