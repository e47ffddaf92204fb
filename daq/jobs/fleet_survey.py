"""Survey the logs of a fleet: the cell of each log, read from its head alone."""

from __future__ import annotations

import hashlib
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Any

from daq.config.cell_file import cell_from_bundle, digest
from daq.errors import ConfigurationMissing, DaqError, LogMissing, LogUnreadable
from daq.files import open_regular
from daq.log.metadata import READBACK
from daq.log.reader import LogHead, LogReader

ENDING = ".mcap"
PIECE_BYTES = 2**20


@dataclass(frozen=True, slots=True)
class StoredLog:
    """One log of a fleet, by name; any process that sees the same store can open it."""

    address: str  #: path, or address in an object store
    name: str  #: below the folder that was given, for people

    @property
    def remote(self) -> bool:
        """It is no file of this machine's folders."""
        return "://" in self.address


def list_logs(place: str) -> tuple[StoredLog, ...]:
    """Whatever has the name of a finished log at a place and in the folders below it, by name.

    A folder, a pipe or a link that leads nowhere may have such a name: `fingerprint` reports it.

    Raises:
        LogMissing: there is no such folder, or no log in it.
        ConfigurationMissing: the address needs a package that is not installed.
    """
    if "://" in place:  # for fsspec; a path otherwise
        with _name_errors(place):
            store, root = _store(place)
            if isinstance(store, import_module("fsspec.implementations.local").LocalFileSystem):
                # `file://` may have links, pipes and devices, which fsspec does not report.
                logs = _listed_local(Path(root))
            else:
                below = root.rstrip("/") + "/"
                paths = [path for path in store.find(root) if path.endswith(ENDING)]
                logs = [
                    StoredLog(store.unstrip_protocol(path), path.removeprefix(below))
                    for path in paths
                ]
    else:
        logs = _listed_local(Path(place))
    if not logs:
        raise LogMissing(
            place,
            found=f"no file *{ENDING}",
            expected="a folder with the logs of cells",
            remedy="check the place",
        )
    return tuple(sorted(logs, key=lambda log: log.name))


def at_hand(log: StoredLog, folder: Path) -> Path:
    """A log as a file: itself, or a copy of the same name in a folder of its own below `folder`.

    Raises:
        LogMissing: it cannot be read, or is no regular file.
    """
    if not log.remote:
        with _name_errors(log.address):
            return _regular(Path(log.address))
    copy = _copy(log, folder)
    with _name_errors(log.address):
        store, path = _store(log.address)
        with store.open(path, "rb") as source, copy.open("wb") as target:
            shutil.copyfileobj(source, target, PIECE_BYTES)
    return copy


def fingerprint(log: StoredLog) -> str:
    """Fingerprint of a log: the digest of a file, or the store's data about an object.

    Raises:
        LogMissing: it cannot be read, or is no regular file.
    """
    with _name_errors(log.address):
        if log.remote:
            store, path = _store(log.address)
            return str(store.ukey(path))
        with open_regular(_regular(Path(log.address))) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()


def _listed_local(folder: Path) -> list[StoredLog]:
    if not folder.is_dir():
        raise LogMissing(
            str(folder),
            found="no such folder",
            expected="a folder with the logs of cells",
            remedy="check the name",
        )
    # Absolute: a worker may run elsewhere. Entries that are no files stay: one may be in place of a
    # cell's log.
    paths = folder.rglob(f"*{ENDING}")
    return [StoredLog(str(path.absolute()), str(path.relative_to(folder))) for path in paths]


def _regular(path: Path) -> Path:
    """Check that a log is a regular file before it is opened:
    a pipe or a device would never end.
    """
    if path.is_symlink() and not path.exists():
        found = f"a link to {path.readlink()}, which leads nowhere"
        remedy = "mount or copy what it leads to, or move the link away"
    elif not stat.S_ISREG(mode := path.stat().st_mode):
        found = "something that is no regular file"
        if stat.S_ISDIR(mode):
            found = "a folder"
        remedy = f"put the log there, or give this a name without {ENDING}"
    else:
        return path
    raise LogMissing(
        str(path), found=found, expected="a log: a regular file, or a link to one", remedy=remedy
    )


def _copy(log: StoredLog, folder: Path) -> Path:
    # A fit calls a run by the name of its file, and two of a cell's logs may share it.
    return Path(tempfile.mkdtemp(dir=folder)) / PurePosixPath(log.name).name


def _store(address: str) -> tuple[Any, str]:
    """The file system of an address, and the path in it."""
    try:
        # Untyped, and an optional dependency.
        store, path = import_module("fsspec.core").url_to_fs(address)
    except (ImportError, ValueError) as error:
        if find_spec("fsspec") is None:
            remedy = "pip install 'drivegain[fleet]'"
        else:
            remedy = "install what it names (for s3://: pip install s3fs)"
        raise ConfigurationMissing(
            address,
            found=str(error),
            expected="an address that fsspec can read with what is installed",
            remedy=remedy,
        ) from error
    return store, path


@contextmanager
def _name_errors(address: str) -> Iterator[None]:
    try:
        yield
    except DaqError:
        raise
    except Exception as error:  # every store has errors of its own, and few of them are an OSError
        found = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise LogMissing(
            address,
            found=found.lower(),
            expected="a log that can be read",
            remedy="check the place, and the rights to read there",
        ) from error


HEAD_BYTES = 4 * 2**20
"""First read of a log in an object store;
it usually holds the configuration files and the first samples.
"""


@dataclass(frozen=True, slots=True)
class SeenLog:
    """A log and its cell."""

    log: StoredLog  #: by name
    fingerprint: str  #: changes when the log does
    cell: str  #: name in the configuration that the log carries
    configuration_sha256: str  #: digest of that configuration
    mounting: str | None  #: of the payload; None without load
    started_ns: int  #: Unix time of its start [ns]


@dataclass(frozen=True, slots=True)
class UnknownLog:
    """A log whose cell is unknown."""

    log: StoredLog  #: by name
    error: BaseException  #: why not


@dataclass(frozen=True, slots=True)
class CellLogs:
    """The logs of one cell in one configuration."""

    cell: str  #: name of the cell of all of them
    configuration_sha256: str  #: of all of them
    fit: tuple[SeenLog, ...]  #: logs of the fit, in the order in which they were made
    holdout: tuple[SeenLog, ...]  #: logs that the fit must not see


def survey(logs: Sequence[StoredLog]) -> tuple[SeenLog | UnknownLog, ...]:
    """Read the heads of some logs; errors take the place of their log."""
    known: dict[str, tuple[str, str]] = {}
    found: list[SeenLog | UnknownLog] = []
    for log in logs:
        try:
            mark = fingerprint(log)
            head = _head(log)
            cell, cell_sha256 = _described(log, head, known)
        except DaqError as error:
            found.append(UnknownLog(log, error))
            continue
        mounting = None
        if head.run.payload is not None:
            mounting = head.run.payload.mounting
        found.append(SeenLog(log, mark, cell, cell_sha256, mounting, head.run.started_wall_ns))
    return tuple(found)


def by_cell(seen: Iterable[SeenLog]) -> tuple[CellLogs, ...]:
    """The logs of each cell and configuration, by name and digest.

    The newest run with a payload is held out where the fit keeps another one with the same mounting
    and one without load: its error is then measured on moves that no estimate has seen, and all
    gains can still be found.
    """
    groups: dict[tuple[str, str], list[SeenLog]] = {}
    # The order of a session, and by content where clocks agree: a fit's last digits depend on the
    # order.
    for log in sorted(seen, key=lambda log: (log.started_ns, log.fingerprint, log.log.name)):
        groups.setdefault((log.cell, log.configuration_sha256), []).append(log)
    cells = []
    for (cell, cell_sha256), logs in sorted(groups.items()):
        mountings = [log.mounting for log in logs]
        loaded = [log for log in logs if log.mounting is not None]
        holdout: list[SeenLog] = []
        if None in mountings and loaded and mountings.count(loaded[-1].mounting) > 1:
            holdout = loaded[-1:]
        used = tuple(log for log in logs if log not in holdout)
        cells.append(CellLogs(cell, cell_sha256, used, tuple(holdout)))
    return tuple(cells)


def _described(log: StoredLog, head: LogHead, known: dict[str, tuple[str, str]]) -> tuple[str, str]:
    """Name and digest of a configuration; one that several logs share is read once."""
    files = {name: data for name, data in head.files.items() if name != READBACK}
    key = digest(files)
    if key not in known:
        cell = cell_from_bundle(files, names={"cell.yaml": f"{log.address}, cell.yaml"})
        known[key] = cell.name, cell.digest
    return known[key]


def _head(log: StoredLog) -> LogHead:
    with tempfile.TemporaryDirectory(prefix="drivegain-fleet-") as folder:
        if log.remote:
            copy = _copy(log, Path(folder))
            with _name_errors(log.address):
                store, place = _store(log.address)
                copy.write_bytes(store.cat_file(place, start=0, end=HEAD_BYTES))
            try:
                return _unfinished_head(copy)
            except LogUnreadable:
                pass  # a longer head, or an older log: read all of it
        path = at_hand(log, Path(folder))
        reader = LogReader(path)
        try:
            next(iter(reader), None)
            head = reader.head
        except LogUnreadable as damage:
            # A log with a damaged end still names its cell; the fit of that cell then reports the
            # damage.
            try:
                return _unfinished_head(path)
            except LogUnreadable:
                raise damage from None
        return head


def _unfinished_head(path: Path) -> LogHead:
    reader = LogReader(path)
    next(reader.until_damage(), None)
    return reader.head
