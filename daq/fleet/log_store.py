"""Where the logs of a fleet lie: a folder, or an object store by its address (s3://…, through fsspec)."""

from __future__ import annotations

import hashlib
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Any

from daq.errors import ConfigurationMissing, DaqError, LogMissing
from daq.regular_file import open_regular

ENDING = ".mcap"
PIECE_BYTES = 2**20


@dataclass(frozen=True, slots=True)
class StoredLog:
    """One log of a fleet, by name; any process that sees the same store can open it.

    Attributes:
        address: path, or address in an object store.
        name: below the folder that was given, for people.
    """

    address: str
    name: str

    @property
    def remote(self) -> bool:
        """It is no file of this machine's folders."""
        return is_address(self.address)


def is_address(place: str) -> bool:
    """Whether a place is an address for fsspec, and not a path."""
    return "://" in place


def list_logs(place: str) -> tuple[StoredLog, ...]:
    """Whatever has the name of a finished log at a place and in the folders below it, by name.

    A folder, a pipe or a link that leads nowhere may have such a name: `fingerprint` tells of it.

    Raises:
        LogMissing: there is no such folder, or no log in it.
        ConfigurationMissing: the address needs a package that is not installed.
    """
    logs = _listed_remote(place) if is_address(place) else _listed_local(Path(place))
    if not logs:
        raise LogMissing(
            place, found=f"no file *{ENDING}", expected="a folder with the logs of cells", remedy="check the place"
        )
    return tuple(sorted(logs, key=lambda log: log.name))


def at_hand(log: StoredLog, folder: Path) -> Path:
    """A log as a file: itself, or a copy of the same name in a folder of its own below `folder`.

    Raises:
        LogMissing: it cannot be read, or is no regular file.
    """
    if not log.remote:
        with _told(log.address):
            return _regular(Path(log.address))
    copy = _copy(log, folder)
    with _told(log.address):
        store, path = _store(log.address)
        with store.open(path, "rb") as source, copy.open("wb") as target:
            shutil.copyfileobj(source, target, PIECE_BYTES)
    return copy


def beginning(log: StoredLog, size: int, folder: Path) -> Path:
    """The first bytes of a log in an object store, as a file below `folder`.

    Raises:
        LogMissing: it cannot be read.
    """
    copy = _copy(log, folder)
    with _told(log.address):
        store, path = _store(log.address)
        copy.write_bytes(store.cat_file(path, start=0, end=size))
    return copy


def fingerprint(log: StoredLog) -> str:
    """What changes when the log does: the digest of a file, what the store tells of an object.

    Raises:
        LogMissing: it cannot be read, or is no regular file.
    """
    with _told(log.address):
        if log.remote:
            store, path = _store(log.address)
            return str(store.ukey(path))
        with open_regular(_regular(Path(log.address))) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()


def _listed_local(folder: Path) -> list[StoredLog]:
    if not folder.is_dir():
        raise LogMissing(
            str(folder), found="no such folder", expected="a folder with the logs of cells", remedy="check the name"
        )
    # Absolute: a worker may stand elsewhere. What is no file is not left out: it may stand for a log of a cell.
    return [StoredLog(str(path.absolute()), str(path.relative_to(folder))) for path in folder.rglob(f"*{ENDING}")]


def _listed_remote(place: str) -> list[StoredLog]:
    with _told(place):
        store, root = _store(place)
        if isinstance(store, import_module("fsspec.implementations.local").LocalFileSystem):
            return _listed_local(Path(root))  # file://: with links, pipes and devices, of which fsspec does not tell
        found = [path for path in store.find(root) if path.endswith(ENDING)]
    below = root.rstrip("/") + "/"
    return [StoredLog(store.unstrip_protocol(path), path.removeprefix(below)) for path in found]


def _regular(path: Path) -> Path:
    """A log in a folder, looked at before anybody opens it: a pipe or a device would never end."""
    if path.is_symlink() and not path.exists():
        found = f"a link to {path.readlink()}, which leads nowhere"
        raise _no_log(path, found, "mount or copy what it leads to, or move the link away")
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode):
        found = "a folder" if stat.S_ISDIR(mode) else "something that is no regular file"
        raise _no_log(path, found, f"put the log there, or give this a name without {ENDING}")
    return path


def _no_log(path: Path, found: str, remedy: str) -> LogMissing:
    return LogMissing(str(path), found=found, expected="a log: a regular file, or a link to one", remedy=remedy)


def _copy(log: StoredLog, folder: Path) -> Path:
    # A fit calls a run by the name of its file, and two of a cell's logs may share it.
    return Path(tempfile.mkdtemp(dir=folder)) / PurePosixPath(log.name).name


def _store(address: str) -> tuple[Any, str]:
    """The file system of an address, and the path in it."""
    try:
        # Untyped, and in no installation that nobody asked it into.
        store, path = import_module("fsspec.core").url_to_fs(address)
    except (ImportError, ValueError) as error:
        bare = find_spec("fsspec") is None
        raise ConfigurationMissing(
            address,
            found=str(error),
            expected="an address that fsspec can read with what is installed",
            remedy="pip install 'drivegain[fleet]'" if bare else "install what it names (for s3://: pip install s3fs)",
        ) from error
    return store, path


@contextmanager
def _told(address: str) -> Iterator[None]:
    try:
        yield
    except DaqError:
        raise
    except Exception as error:  # every store has errors of its own, and few of them are an OSError
        raise LogMissing(
            address,
            found=(getattr(error, "strerror", None) or str(error) or type(error).__name__).lower(),
            expected="a log that can be read",
            remedy="check the place, and the rights to read there",
        ) from error
