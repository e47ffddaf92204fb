"""Symbolic and hard links to a controller's file, and which of them a write may follow."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import shlex
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from daq.errors import CalibrationRefused, ControllerUnfit
from daq.files import fsync_folder, replace_file
from daq.writeback.formats.document import read_bytes


def resolve_links(file: Path) -> Path:
    """Resolve the symbolic links of a file's name, those of its folders included.

    A file that is gone resolves to where its links still lead.

    Args:
        file: as it was declared. A name that was resolved before has no links left to judge.

    Raises:
        ControllerUnfit: the links form a circle, one of them belongs to another user, or they lead into a folder in
            which everybody may exchange the file.
    """
    try:
        target, links = file.resolve(), _links(file)
    except RuntimeError as error:  # of Python before 3.13
        raise _circle(file) from error
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _circle(file) from error
        raise
    status, folder = _status(target), _status(target.parent)
    owner = None if status is None else status.st_uid
    for link in links:
        made_by = link.lstat().st_uid
        if made_by not in {0, os.geteuid(), owner}:
            named = "" if link == file else f" ({link})"
            whose = f"to {target}, which is not there" if owner is None else f"to a file of user {owner}"
            raise ControllerUnfit(
                str(file),
                found=f"a symbolic link{named} that user {made_by} has made, {whose}",
                expected="a link of the file's owner, or of you",
                remedy="name the file itself, or make the link anew",
            )
    if links and folder is not None and folder.st_mode & stat.S_IWOTH:
        raise ControllerUnfit(
            str(file),
            found=f"a symbolic link into {target.parent}, a folder that everybody may write",
            expected="a folder in which nobody else can exchange the file",
            remedy="take that right away (`chmod o-w`), or name the file itself",
        )
    return target


def _links(file: Path) -> tuple[Path, ...]:
    """Symbolic links on the way to a file, the links that they lead to included."""
    found: dict[Path, None] = {}
    names = [file.absolute()]
    while names:
        name = names.pop()
        for place in (name, *name.parents):
            if place not in found and place.is_symlink():
                found[place] = None
                names.append(place.parent / place.readlink())
    return tuple(found)


def _status(file: Path) -> os.stat_result | None:
    """Status of a file, None where it is gone or may not be looked at."""
    try:
        return file.lstat()
    except OSError:
        return None


def require_existing(file: Path) -> None:
    """Refuse a symbolic link that leads nowhere, by that name: "no such file" would be hard to believe.

    A file of several names (hard links) is refused too: a new file takes the place of one name, and whoever reads the
    others goes on with the old gains.

    Raises:
        ControllerUnfit: for either; and see `resolve_links`.
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
            expected="one name: under the others the old gains would stay",
            remedy="find the others (`find / -xdev -samefile FILE`) and make symbolic links of them, or give this name "
            f"a file of its own: cp -p {quoted} {quoted}.new && mv {quoted}.new {quoted}",
        )


def _circle(file: Path) -> ControllerUnfit:
    return ControllerUnfit(
        str(file),
        found="symbolic links that go round in a circle",
        expected="a link that leads to the controller's file",
        remedy="correct the link, or name the file itself",
    )


# One writer of a controller file at a time.


_MODE = 0o644
"""Everybody may read it, and that is enough to lock it (not on NFS, which wants it writable)."""


@contextlib.contextmanager
def exclusive_writer(target: Path) -> Iterator[None]:
    """Hold the file's lock; the system gives it back even after a kill.

    The lock file is removed at the end. A second writer may have opened it just before: its lock is then on a file
    that has no name any more, which it sees by the inode, and takes the lock anew.

    Raises:
        CalibrationRefused: somebody else holds it.
        OSError: from the file system.
    """
    lock = target.parent / f".{target.name}.lock"
    while True:
        descriptor = _opened(lock)
        try:
            _take(descriptor, target)
            if _is_at(descriptor, lock):
                try:
                    yield
                finally:
                    # Another user's may stay, where only they may remove it: nobody holds it.
                    with contextlib.suppress(PermissionError):
                        lock.unlink(missing_ok=True)
                return
        finally:
            os.close(descriptor)


def _opened(lock: Path) -> int:
    """The lock's file, made where there is none; one that another user has left does not keep anybody out."""
    flags = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    while True:
        with contextlib.suppress(FileExistsError):
            descriptor = os.open(lock, flags | os.O_RDWR | os.O_CREAT | os.O_EXCL, _MODE)
            try:
                os.fchmod(descriptor, _MODE)  # whatever the umask
            except BaseException:  # an interrupt too: a lock that others cannot open must not stay behind
                os.close(descriptor)
                lock.unlink(missing_ok=True)
                raise
            return descriptor
        # Without O_CREAT: in a folder with the sticky bit the system refuses it for another user's file.
        with contextlib.suppress(FileNotFoundError):  # whose owner was done just now
            try:
                return os.open(lock, flags | os.O_RDWR)
            except PermissionError:
                return os.open(lock, flags | os.O_RDONLY)


def _take(descriptor: int, target: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise CalibrationRefused(
            str(target),
            found="another drivegain writing it",
            expected="one writer at a time",
            remedy="wait until it has finished, then look at a new dry run",
        ) from error


def _is_at(descriptor: int, path: Path) -> bool:
    with contextlib.suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(descriptor), path.stat())
    return False


# Backups beside a controller file.
#
# A backup is called FILE.<time>.<was>-<became>.bak. Both digests are the first of SHA-256: of what is in the backup,
# and
# of what took its place. So a backup says by itself whether somebody has changed it, and whether somebody has changed
# the
# controller file since; no other file could be lost, or disagree.


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
    after_digest: str

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
