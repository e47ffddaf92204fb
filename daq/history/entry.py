"""What the history knows: calibrations, what was done with them, and changes that somebody has explained."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum

from ident.calibration import Gain


class Deed(Enum):
    """What was done to a controller."""

    APPLIED = "applied"
    ROLLED_BACK = "rolled back"


@dataclass(frozen=True, slots=True)
class Event:
    """A write to a controller.

    Attributes:
        digest: of the calibration whose gains the controller had afterwards; None where that is not known: a
            rollback to gains that are in no calibration.
        deed: what was done.
        at: when, UTC.
        who: the person or the job.
        target: the controller's file.
        audit: SHA-256 of the entry in the audit that tells of it, None where none was given.
    """

    digest: str | None
    deed: Deed
    at: datetime
    who: str
    target: str
    audit: str | None = None


@dataclass(frozen=True, slots=True)
class Entry:
    """One calibration.

    Attributes:
        digest: SHA-256 of its file.
        created: when it was fitted, UTC; when it was entered where its own time cannot be read.
        entered: when it was entered, UTC.
        cell: name of the cell.
        configuration_sha256: of the cell configuration that its logs carry.
        method: of the fit.
        software: that made it.
        error_percent, holdout_percent: relative error of the fit, and on held-out data [%]; None where there was none.
        rows: of the observation.
        gains: one an axis, in the order of the axes.
        events: writes after which a controller had its gains, oldest first.
    """

    digest: str
    created: datetime
    entered: datetime
    cell: str
    configuration_sha256: str
    method: str
    software: str
    error_percent: float
    holdout_percent: float | None
    rows: int
    gains: tuple[Gain, ...]
    events: tuple[Event, ...]

    @property
    def applied(self) -> bool:
        """Whether a controller ever had its gains."""
        return bool(self.events)


@dataclass(frozen=True, slots=True)
class GainRecord:
    """One gain of one calibration.

    Attributes:
        digest: of the calibration.
        created: of the calibration, UTC.
        gain: value ± σ, unit, nameplate.
        applied: whether a controller ever had it.
    """

    digest: str
    created: datetime
    gain: Gain
    applied: bool


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """A change that somebody has explained; a new baseline begins.

    Attributes:
        axis: whose gain changed.
        since: calibrations from this time on make the new baseline, UTC.
        at: when it was acknowledged, UTC.
        who: the person.
        why: what had happened.
        audit: SHA-256 of the entry in the audit that tells of it.
    """

    axis: str
    since: datetime
    at: datetime
    who: str
    why: str
    audit: str


def utc(text: str, otherwise: datetime) -> datetime:
    """A time in ISO 8601 as UTC, one without a zone taken for UTC; `otherwise` where the text is no time."""
    try:
        read = datetime.fromisoformat(text)
        return (read.replace(tzinfo=UTC) if read.tzinfo is None else read).astimezone(UTC)
    except (ValueError, OverflowError):
        return otherwise.astimezone(UTC)


def iso(at: datetime) -> str:
    """As the store keeps times: UTC, of one length, so that their order is that of the text.

    Raises:
        ValueError: a time without its zone.
    """
    if at.tzinfo is None:
        raise ValueError(f"expected a time with its zone, found {at}")
    return at.astimezone(UTC).isoformat(timespec="microseconds")
