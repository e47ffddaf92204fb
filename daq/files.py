"""Read, replace, hash and lock files: a file is replaced whole or not at all,
and only regular files are read.
"""

from __future__ import annotations

import errno
import fcntl
import grp
import hashlib
import os
import pwd
import re
import stat
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path

from daq.errors import FileImmutable, OwnerNotKept, UsageError, WriteUnconfirmed

# ioctl_iflags(2): command and bits
_FS_IOC_GETFLAGS = 0x80086601
_FS_APPEND_FL = 0x20
_FS_IMMUTABLE_FL = 0x10


def replace_file(
    path: Path,
    content: bytes,
    *,
    check: Callable[[bytes], None] | None = None,
    like: Path | None = None,
) -> None:
    """Put `content` at `path`: temporary file in the same folder → fsync → read back and check →
    rename → fsync folder.

    Until the rename the old file is untouched, after it the new one is complete: a kill at any
    point leaves one of the two. Mode, owner and access lists of an existing file are kept. A
    symbolic link that `judge_target` trusts stays: the file behind it is replaced.

    Args:
        path: file to make or replace; its folder must exist.
        content: new content.
        check: called with the content read back from the disk, before the rename; an exception
            stops the replacement.
        like: file whose mode, owner and access lists are used instead.

    Raises:
        OSError: from the file system, also if owner or access lists cannot be kept, or file or
            folder is immutable (`FileImmutable`); as `judge_target`; or a folder is at `path`. The
            old content is in place.
        WriteUnconfirmed: the fsync of the folder failed; the new content is in place.
    """
    target = _require_replaceable(path)
    temporary, descriptor, model = _temporary_file(target, like)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            if model is not None:
                _copy_rights(stream.fileno(), model)
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        if check is not None:
            check(temporary.read_bytes())
        temporary.replace(target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    try:
        fsync_folder(target.parent)
    except OSError as error:
        raise WriteUnconfirmed.of(path, error) from error


def try_replacing(path: Path, *, like: Path | None = None) -> None:
    """Try whether `replace_file` could put a file at `path`:
    its temporary file is made, gets its rights, and is removed.

    Args:
        path, like: as of `replace_file`.

    Raises:
        OSError: as `replace_file`, but for what only the content shows, such as a full disk.
    """
    target = _require_replaceable(path)
    temporary, descriptor, model = _temporary_file(target, like)
    try:
        if model is not None:
            _copy_rights(descriptor, model)
    finally:
        os.close(descriptor)
        temporary.unlink(missing_ok=True)


def require_takes_files(folder: Path) -> None:
    """Refuse a folder in which this user can make no file; none is made.

    Raises:
        OSError: it is not there, or takes none; ``strerror`` gives the reason.
    """
    is_read_only = bool(os.statvfs(folder).f_flag & os.ST_RDONLY)
    number = errno.EACCES
    if is_read_only:
        number = errno.EROFS
    elif os.access(folder, os.W_OK | os.X_OK):
        return
    raise OSError(number, os.strerror(number), str(folder))


def _require_replaceable(path: Path) -> Path:
    """Resolve the name of a file to replace; refuse a folder, and what has a mark.

    Raises:
        OSError: as `replace_file`.
    """
    target = judge_target(path)
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, "is a directory", str(path))
    _require_unmarked(path, target)
    return target


def _temporary_file(target: Path, like: Path | None) -> tuple[Path, int, Path | None]:
    """Make the temporary file of a replacement; return its name, its descriptor,
    and the file whose rights it gets, None for the usual ones.
    """
    model = like
    if model is None and target.exists():
        model = target
    # For the owner alone until it has the rights of the other file: an open descriptor outlives a
    # later chmod.
    mode = 0o600
    if model is None:
        mode = 0o666
    temporary, descriptor = _new_file(target, mode)
    return temporary, descriptor, model


def _require_unmarked(path: Path, target: Path) -> None:
    """Refuse to replace a file where it or its folder is marked as immutable or append-only.

    This comes before a temporary file is made, which could not be removed from a folder that is
    append-only.

    Args:
        path: the file as it was named.
        target: where it is.

    Raises:
        FileImmutable: one of the two has such a mark.
        OSError: one of the two cannot be opened, for another reason than missing rights.
    """
    for place in (target, target.parent):
        if is_marked(place):
            raise FileImmutable(path, place)


def is_marked(place: Path) -> bool:
    """Whether a file or folder is immutable or append-only; not where that cannot be asked."""
    try:
        descriptor = os.open(place, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (FileNotFoundError, PermissionError):
        return False
    answer = bytearray(struct.calcsize("l"))
    try:
        fcntl.ioctl(descriptor, _FS_IOC_GETFLAGS, answer)
    except OSError:  # the file system has no such marks
        return False
    finally:
        os.close(descriptor)
    marks = int.from_bytes(answer[:4], sys.byteorder)
    return bool(marks & (_FS_APPEND_FL | _FS_IMMUTABLE_FL))


def judge_target(path: Path) -> Path:
    """Resolve the name of a file or folder to write to,
    if no other user can choose what it leads to.

    Raises:
        OSError: as `follow_links`; its links lead into a folder as of `open_folder` (EPERM); or it
            is neither a file nor a folder (EINVAL). ``strerror`` says so.
    """
    target = follow_links(path)
    if (folder := open_folder(path, target)) is not None:
        raise OSError(
            errno.EPERM,
            f"a symbolic link into {folder}, a folder that everybody may write",
            str(path),
        )
    with suppress(FileNotFoundError, NotADirectoryError):
        mode = target.lstat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise OSError(errno.EINVAL, "something that is no regular file", str(path))
    return target


def open_folder(path: Path, target: Path) -> Path | None:
    """Folder behind the links of a name in which every user may exchange the target;
    None where there is none.

    In a folder with the sticky bit, such as /tmp, only its owner may exchange a file or folder.

    Args:
        path: as it was declared.
        target: as `follow_links` resolves it.
    """
    try:
        folder = target.parent.lstat()
    except OSError:  # it is gone, or access is denied
        return None
    if not folder.st_mode & stat.S_IWOTH or not _links(path):
        return None
    if folder.st_mode & stat.S_ISVTX:
        with suppress(OSError):
            if target.lstat().st_uid in {0, os.geteuid()}:
                return None
    return target.parent


def is_taken(path: Path) -> bool:
    """Whether a name leads anywhere or is a link:
    a new file of that name would replace it, or be made elsewhere.
    """
    return path.exists() or path.is_symlink()


def require_new(path: Path, remedy: str) -> None:
    """Refuse a name that is taken.

    Raises:
        UsageError: a file, folder or link has it.
    """
    if is_taken(path):
        raise UsageError(str(path), found=what_has_name(path), expected="none", remedy=remedy)


def what_has_name(path: Path) -> str:
    """Say what has a name that is taken: a folder, a link that leads nowhere, or a file."""
    if path.is_dir():
        return "a folder of that name"
    if path.is_symlink() and not path.exists():
        return f"a link of that name to {path.readlink()}, where nothing is"
    return "a file of that name"


def follow_links(path: Path) -> Path:
    """Resolve the symbolic links of a name, those of its folders included,
    as long as they can be trusted.

    A file that is gone resolves to where its links still lead.

    Args:
        path: as it was declared. A name that was resolved before has no links left to judge.

    Raises:
        OSError: the links form a circle (ELOOP), or another user, neither root nor the owner of the
            file, has made one (EPERM); ``strerror`` says so. Where the file is gone, the owner of
            its folder counts.
    """
    links = _links(path)
    target = Path(os.path.realpath(path))
    owner = None
    there = False
    try:
        there = os.path.lexists(target)
        owner = (target if there else target.parent).lstat().st_uid
    except OSError as error:  # else access is denied, or the folder is gone
        if error.errno == errno.ELOOP:
            raise _circle(path) from error
    if target.is_symlink():
        raise _circle(path)
    for link in links:
        made_by = link.lstat().st_uid
        if made_by not in {0, os.geteuid(), owner}:
            named = "" if link == path else f" ({link})"
            if there:
                whose = f"to a file of user {owner}"
            else:
                whose = f"to {target}, which is not there"
            raise OSError(
                errno.EPERM,
                f"a symbolic link{named} that user {made_by} has made, {whose}",
                str(path),
            )
    return target


def _circle(path: Path) -> OSError:
    return OSError(errno.ELOOP, "symbolic links that go round in a circle", str(path))


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


def fsync_folder(folder: Path) -> None:
    """Flush a folder, so that a new name in it survives a power cut.

    Source: POSIX fsync, open(2).

    Raises:
        OSError: from the file system.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file for reading, without blocking at a pipe.

    Raises:
        OSError: the file does not exist, is not a regular file, or cannot be read; ``strerror``
            gives the reason.
    """
    # Checked before it is opened: opening may rewind a tape, or wake a process at the other end of
    # a pipe.
    _check(path.stat(), path)
    return os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")


def read_regular(path: Path, largest_bytes: int) -> bytes:
    """Read a regular file of bounded size.

    Raises:
        OSError: as `open_regular`, or the file is larger.
    """
    with open_regular(path) as stream:
        large = os.fstat(stream.fileno()).st_size > largest_bytes
        content = b"" if large else stream.read(largest_bytes + 1)
    if large or len(content) > largest_bytes:
        raise OSError(errno.EFBIG, f"more than {largest_bytes} bytes", str(path))
    return content


def sha256(content: bytes) -> str:
    """Return the SHA-256 of bytes, hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def sha256_of(path: Path) -> str | None:
    """Return the SHA-256 of a file, read piece by piece;
    None if it is not a readable regular file.
    """
    with suppress(OSError), open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
    return None


#: Every user may read it, and that is enough to lock it (not on NFS, which requires write access)
_LOCK_MODE = 0o644


@contextmanager
def hold_lock(lock: Path) -> Iterator[None]:
    """Hold a lock file; the system releases it even after a kill.

    The file is removed at the end. Another process may have opened it just before: its lock is then
    on a file without a name, which it detects by the inode, and it takes the lock anew.

    Raises:
        BlockingIOError: another process holds it.
        OSError: from the file system, or something else has that name.
    """
    while True:
        descriptor = _open_lock(lock)
        try:
            held = os.fstat(descriptor)
            _check(held, lock)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            try:
                is_named = os.path.samestat(held, lock.stat())
            except FileNotFoundError:
                is_named = False
            if is_named:
                try:
                    yield
                finally:
                    # Another user's may stay, where only they may remove it: it is not held.
                    with suppress(OSError):
                        lock.unlink()
                return
        finally:
            # The work under it is done; the descriptor is closed all the same (close(2))
            with suppress(OSError):
                os.close(descriptor)


def _open_lock(lock: Path) -> int:
    """Open the lock file, made where there is none;
    one that another user has left excludes no process.
    """
    # A FIFO of that name must not keep us waiting
    flags = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    while True:
        with suppress(FileExistsError):
            descriptor = os.open(lock, flags | os.O_RDWR | os.O_CREAT | os.O_EXCL, _LOCK_MODE)
            try:
                os.fchmod(descriptor, _LOCK_MODE)  # whatever the umask
            # An interrupt too: a lock that others cannot open must not stay behind.
            except BaseException:
                os.close(descriptor)
                lock.unlink(missing_ok=True)
                raise
            return descriptor
        # Without O_CREAT: in a folder with the sticky bit the system refuses it for another user's
        # file.
        with suppress(FileNotFoundError):  # whose owner was done just now
            try:
                return os.open(lock, flags | os.O_RDWR)
            except PermissionError:
                return os.open(lock, flags | os.O_RDONLY)


def _check(found: os.stat_result, path: Path) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, "is a directory", str(path))
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "something that is no regular file", str(path))


def target_of_copy(copy: Path) -> str | None:
    """Return the name of the file that an unfinished copy is of; None for any other file.

    `replace_file` leaves such a copy only if it is killed.
    """
    match = _COPY_NAME.fullmatch(copy.name)
    if match is None:
        return None
    return match["target"]


_COPY_NAME = re.compile(r"\.(?P<target>.+)\.[0-9]+-[0-9]+\.tmp")
"""Names that `_new_file` gives."""


def _new_file(target: Path, mode: int) -> tuple[Path, int]:
    """Create a hidden file under a new name (O_EXCL);
    the umask of the process applies to its mode.
    """
    attempt = 0
    while True:
        temporary = target.parent / f".{target.name}.{os.getpid()}-{attempt}.tmp"
        with suppress(FileExistsError):
            return temporary, os.open(
                temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode
            )
        attempt += 1


def _ownership_differences(found: os.stat_result, wanted: os.stat_result) -> str:
    """Say in what owner and group of a new file differ from those of the file that it would
    replace.
    """
    differing = []
    if found.st_uid != wanted.st_uid:
        differing.append(f"owner {_user_name(wanted.st_uid)}, not {_user_name(found.st_uid)}")
    if found.st_gid != wanted.st_gid:
        differing.append(f"group {_group_name(wanted.st_gid)}, not {_group_name(found.st_gid)}")
    return " and ".join(differing)


def _user_name(number: int) -> str:
    """Return the name of a user; the number where no one has it."""
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)


def _group_name(number: int) -> str:
    """Return the name of a group; the number where none has it."""
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def _copy_rights(descriptor: int, like: Path) -> None:
    wanted = like.stat()
    found = os.fstat(descriptor)
    if (found.st_uid, found.st_gid) != (wanted.st_uid, wanted.st_gid):
        try:
            os.fchown(descriptor, wanted.st_uid, wanted.st_gid)
        except PermissionError as error:
            raise OwnerNotKept(like, _ownership_differences(found, wanted)) from error
    _copy_attributes(descriptor, like)
    os.fchmod(descriptor, wanted.st_mode & 0o7777)


_ACCESS = "system.posix_acl_"
_KERNEL = ("security.", "trusted.")
"""Labels (SELinux), capabilities, checksums (IMA):
many of them only the kernel may set, and it sets them itself.
"""


def _copy_attributes(descriptor: int, like: Path) -> None:
    """Copy access lists and other extended attributes;
    without its list a file is open to more people, or to fewer.
    """
    try:
        wanted = os.listxattr(like)
        found = os.listxattr(descriptor)
    except OSError as error:
        if error.errno == errno.ENOTSUP:
            return
        raise
    for name in found:
        # The folder's default list (setfacl -d) could admit users whom the old file kept out.
        if name.startswith(_ACCESS) and name not in wanted:
            os.removexattr(descriptor, name)
    for name in wanted:
        try:
            os.setxattr(descriptor, name, os.getxattr(like, name))
        except OSError as error:
            if not name.startswith(_KERNEL) and error.errno != errno.ENOTSUP:
                raise
