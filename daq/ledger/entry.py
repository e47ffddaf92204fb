"""What a history consists of: calibrations, writes to controllers, and acknowledged changes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from enum import Enum
from typing import Any

from ident.calibration import Calibration, Gain, Source


class WriteAction(Enum):
    """Kinds of writes to a controller."""

    APPLIED = "applied"
    ROLLED_BACK = "rolled back"


@dataclass(frozen=True, slots=True)
class Event:
    """A write to a controller."""

    #: Of the calibration whose gains the controller had afterwards; None for a rollback to gains of no calibration.
    digest: str | None
    action: WriteAction  #: its kind
    at: datetime  #: when, UTC
    who: str  #: the person or the job
    target: str  #: the controller's file, or the drives
    audit: str | None = None  #: SHA-256 of its entry in the audit log, None where none was given
    sha256_after: str | None = None  #: of the target's content afterwards, None where none was given


@dataclass(frozen=True, slots=True)
class Entry:
    """One calibration."""

    digest: str  #: SHA-256 of its file
    created: datetime  #: when it was fitted, UTC; when it was entered where its own time cannot be read
    recorded: datetime  #: when the newest log of its fit was recorded, UTC; as `created` where no log has a time
    logs: str  #: digest of the logs of its fit, as a set; calibrations with the same one rest on the same recordings
    entered: datetime  #: when it was entered, UTC
    cell: str  #: name of the cell
    configuration_sha256: str  #: of the cell configuration that its logs carry
    method: str  #: of the fit
    software: str  #: that made it
    error_percent: float  #: relative error of the fit [%]
    holdout_percent: float | None  #: relative error on held-out data [%], None without any
    rows: int  #: of the observation
    gains: tuple[Gain, ...]  #: one an axis, in the order of the axes
    events: tuple[Event, ...]  #: writes after which a controller had its gains, oldest first

    @property
    def applied(self) -> bool:
        """Whether a controller ever had its gains."""
        return bool(self.events)


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """A change that a person has explained; a new baseline begins."""

    axis: str  #: whose gain changed
    since: datetime  #: calibrations from this time on make the new baseline, UTC
    at: datetime  #: when it was acknowledged, UTC
    who: str  #: the person
    why: str  #: what had happened
    audit: str  #: SHA-256 of its entry in the audit log


def drives_of(cell: str) -> str:
    """Return the name of a cell's drives in audit and history."""
    return f"drives of cell {cell}"


def recorded_at(calibration: Calibration, otherwise: datetime) -> datetime:
    """Return when the newest log of a fit was recorded, UTC; `otherwise` where no log has a time."""
    times_s = [one.recording.recorded_s for one in _fitted(calibration) if one.recording is not None]
    try:
        return datetime.fromtimestamp(max(seconds for seconds in times_s if seconds is not None), UTC)
    except (ValueError, OverflowError, OSError):
        return otherwise.astimezone(UTC)


def logs_of(calibration: Calibration, digest: str) -> str:
    """Return the digest of the set of logs of a fit; that of the calibration itself without logs."""
    logs = sorted({one.sha256 for one in _fitted(calibration)})
    return hashlib.sha256("\n".join(logs).encode()).hexdigest() if logs else digest


def _fitted(calibration: Calibration) -> list[Source]:
    return [one for one in calibration.sources if one.role == "fit"]


def utc(text: str, otherwise: datetime) -> datetime:
    """Parse an ISO 8601 time as UTC, one without a zone as UTC; `otherwise` where the text is no time."""
    try:
        read = datetime.fromisoformat(text)
        return (read.replace(tzinfo=UTC) if read.tzinfo is None else read).astimezone(UTC)
    except (ValueError, OverflowError):
        return otherwise.astimezone(UTC)


def iso(at: datetime) -> str:
    """Format a time: UTC, of one length, so that times sort as text.

    Raises:
        ValueError: a time without its zone.
    """
    if at.tzinfo is None:
        raise ValueError(f"expected a time with its zone, found {at}")
    return at.astimezone(UTC).isoformat(timespec="microseconds")


def zoned(text: str) -> datetime:
    """Parse a time with its zone.

    Raises:
        ValueError: no time, or without a zone.
    """
    found = datetime.fromisoformat(text)
    if found.tzinfo is None:
        raise ValueError(f"{text!r} is a time without its zone")
    return found


def figures_of(calibration: Calibration, digest: str, entered: datetime) -> dict[str, object]:
    """Return what a history shows of a calibration, as plain JSON: parsing its document takes a hundred times as long.

    Args:
        calibration: of the document.
        digest: SHA-256 of its file.
        entered: when it was entered.
    """
    created = utc(calibration.created, entered)
    holdout = calibration.holdout_error_percent
    return {
        "created": iso(created),
        "recorded": iso(recorded_at(calibration, created)),
        "logs": logs_of(calibration, digest),
        "configuration_sha256": calibration.configuration_sha256,
        "method": calibration.method,
        "software": calibration.software,
        "error_percent": calibration.relative_error_percent.total,
        "holdout_percent": None if holdout is None else holdout.total,
        "rows": calibration.rows,
        "gains": [asdict(gain) for gain in calibration.gains],
    }


def entry_of(digest: str, cell: str, entered: datetime, figures: Mapping[str, Any], events: Sequence[Event]) -> Entry:
    """Return a calibration by its `figures_of`; `events` are the writes of its gains, oldest first.

    Raises:
        KeyError, TypeError, ValueError: the figures are others than those of `figures_of`.
    """
    others = dict(figures)
    gains = tuple(Gain(**gain) for gain in others.pop("gains"))
    created = zoned(others.pop("created"))
    recorded = zoned(others.pop("recorded"))
    return Entry(
        digest=digest,
        cell=cell,
        entered=entered,
        created=created,
        recorded=recorded,
        gains=gains,
        events=tuple(events),
        **others,
    )
