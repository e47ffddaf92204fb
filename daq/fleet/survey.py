"""Which cell each log is of, by its head alone, and what a fit makes of the logs of one cell."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from daq.configuration.cell_file import cell_from_bundle
from daq.errors import DaqError, LogUnreadable
from daq.fleet.log_store import StoredLog, at_hand, beginning, fingerprint
from daq.log.readback import NAME as READBACK
from daq.log.reader import LogHead, LogReader

HEAD_BYTES = 4 * 2**20
"""Of a log in an object store, to begin with: its configuration files and first samples are within, as a rule."""


@dataclass(frozen=True, slots=True)
class SeenLog:
    """A log and whose it is.

    Attributes:
        log: by name.
        fingerprint: changes when the log does.
        cell: name in the configuration that the log carries.
        configuration_sha256: digest of that configuration.
        mounting: of the payload; None without load.
        started_ns: Unix time of its start [ns].
    """

    log: StoredLog
    fingerprint: str
    cell: str
    configuration_sha256: str
    mounting: str | None
    started_ns: int


@dataclass(frozen=True, slots=True)
class UnknownLog:
    """A log that does not tell whose it is.

    Attributes:
        log: by name.
        error: why not.
    """

    log: StoredLog
    error: BaseException


@dataclass(frozen=True, slots=True)
class CellLogs:
    """The logs of one cell in one configuration.

    Attributes:
        cell, configuration_sha256: of all of them.
        fit: logs of the fit, in the order in which they were made.
        holdout: logs that the fit must not see.
    """

    cell: str
    configuration_sha256: str
    fit: tuple[SeenLog, ...]
    holdout: tuple[SeenLog, ...]


def survey(logs: Sequence[StoredLog]) -> tuple[SeenLog | UnknownLog, ...]:
    """Look at the heads of some logs; what is wrong with one is told in its place."""
    known: dict[str, tuple[str, str]] = {}
    return tuple(_seen(log, known) for log in logs)


def by_cell(seen: Iterable[SeenLog]) -> tuple[CellLogs, ...]:
    """The logs of each cell and configuration, by name and digest.

    The newest run with a payload is held out where the fit keeps another one with the same mounting and one without
    load: its error is then measured on moves that no estimate has seen, and all gains can still be found.
    """
    groups: dict[tuple[str, str], list[SeenLog]] = {}
    for log in seen:
        groups.setdefault((log.cell, log.configuration_sha256), []).append(log)
    return tuple(_roles(*key, groups[key]) for key in sorted(groups))


def _roles(cell: str, digest: str, logs: list[SeenLog]) -> CellLogs:
    # The order of a session, and by content where a clock does not tell: a fit's last digits depend on the order.
    logs = sorted(logs, key=lambda log: (log.started_ns, log.fingerprint, log.log.name))
    mountings = [log.mounting for log in logs]
    loaded = [log for log in logs if log.mounting is not None]
    held = loaded[-1:] if None in mountings and loaded and mountings.count(loaded[-1].mounting) > 1 else []
    return CellLogs(cell, digest, tuple(log for log in logs if log not in held), tuple(held))


def _seen(log: StoredLog, known: dict[str, tuple[str, str]]) -> SeenLog | UnknownLog:
    try:
        mark = fingerprint(log)
        head = _head(log)
        cell, digest = _described(log, head, known)
    except DaqError as error:
        return UnknownLog(log, error)
    mounting = None if head.run.payload is None else head.run.payload.mounting
    return SeenLog(log, mark, cell, digest, mounting, head.run.started_wall_ns)


def _described(log: StoredLog, head: LogHead, known: dict[str, tuple[str, str]]) -> tuple[str, str]:
    """Name and digest of a configuration; one that several logs share is read once."""
    files = {name: data for name, data in head.files.items() if name != READBACK}
    total = hashlib.sha256()
    for name, data in sorted(files.items()):
        total.update(f"{name}\0{len(data)}\0".encode() + data)
    key = total.hexdigest()
    if key not in known:
        cell = cell_from_bundle(files, names={"cell.yaml": f"{log.address}, cell.yaml"})
        known[key] = cell.name, cell.digest
    return known[key]


def _head(log: StoredLog) -> LogHead:
    with tempfile.TemporaryDirectory(prefix="drivegain-fleet-") as folder:
        if log.remote:
            try:
                return _unfinished_head(beginning(log, HEAD_BYTES, Path(folder)))
            except LogUnreadable:
                pass  # a longer head, or an older log: the whole of it tells
        path = at_hand(log, Path(folder))
        try:
            return _whole_head(path)
        except LogUnreadable as damage:
            # A log with a damaged end still tells whose it is; the fit of its cell then tells of the damage.
            try:
                return _unfinished_head(path)
            except LogUnreadable:
                raise damage from None


def _whole_head(path: Path) -> LogHead:
    reader = LogReader(path)
    next(iter(reader), None)
    return reader.head


def _unfinished_head(path: Path) -> LogHead:
    reader = LogReader(path)
    next(reader.until_damage(), None)
    return reader.head
