"""Rows of a history: calibrations, writes to controllers, and acknowledged changes; and the checks of these rows."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum
from itertools import islice
from typing import Any

from daq.errors import DaqError
from daq.workflow.calibration_file import decode
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
    error_percent: float  #: relative error of the fit, and on held-out data [%]; None where there was none
    holdout_percent: float | None  #: relative error of the fit, and on held-out data [%]; None where there was none
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
    """Format a time for the store: UTC, of one length, so that times sort as text.

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


COLUMNS = (
    "created",
    "recorded",
    "logs",
    "entered",
    "cell",
    "configuration_sha256",
    "method",
    "software",
    "error_percent",
    "holdout_percent",
    "rows",
)
GAIN_COLUMNS = ("axis", "value", "std", "unit", "nameplate")


def columns_of(calibration: Calibration, digest: str, entered: datetime) -> dict[str, object]:
    """Return the columns of a calibration's row, besides digest and document."""
    holdout, created = calibration.holdout_error_percent, utc(calibration.created, entered)
    values = (
        iso(created),
        iso(recorded_at(calibration, created)),
        logs_of(calibration, digest),
        iso(entered),
        calibration.cell,
        calibration.configuration_sha256,
        calibration.method,
        calibration.software,
        calibration.relative_error_percent.total,
        None if holdout is None else holdout.total,
        calibration.rows,
    )
    return dict(zip(COLUMNS, values, strict=True))


def gain_columns_of(calibration: Calibration) -> list[dict[str, object]]:
    """Return the columns of its gains' rows, in the order of the axes."""
    return [{name: getattr(gain, name) for name in GAIN_COLUMNS} for gain in calibration.gains]


def calibration_flaws(calibrations: Sequence[tuple[Any, ...]], gains: Sequence[tuple[Any, ...]]) -> Iterator[str]:
    """Report rows of calibrations that contradict their own document, as sentences.

    Args:
        calibrations: digest, document, and `COLUMNS` of each.
        gains: digest of the calibration, and `GAIN_COLUMNS` of each.

    Raises:
        ValueError: a row has no valid time.
    """
    rows_of: dict[str, list[tuple[Any, ...]]] = {}
    for digest, *gain in gains:
        rows_of.setdefault(digest, []).append(tuple(gain))
    for digest, document, *columns in calibrations:
        name = f"calibration {digest[:12]}…"
        found_row = dict(zip(COLUMNS, columns, strict=True))
        entered = zoned(found_row["entered"])
        try:
            calibration = decode(document.encode(), f"document of {name}")
        except DaqError as error:
            yield f"{name}: its document is {error.found}, expected {error.expected}"
            continue
        yield from _differences(f"row of {name}", found_row, columns_of(calibration, digest, entered))
        expected = gain_columns_of(calibration)
        rows = [dict(zip(GAIN_COLUMNS, row, strict=True)) for row in rows_of.get(digest, [])]
        axes, wanted = ([row["axis"] for row in some] for some in (rows, expected))
        if axes != wanted:
            yield f"gains of {name}: found {_listed(axes)}, expected {_listed(wanted)} as its document says"
            continue
        for row, expected_row in zip(rows, expected, strict=True):
            yield from _differences(f"gain of {row['axis']} in {name}", row, expected_row)


def gap_flaws(table: str, there: set[int], last: int) -> Iterator[str]:
    """Report missing rows: `there` are the numbers of a table's rows, which go from 1 to `last` without gaps."""
    missing = list(islice((number for number in range(1, last + 1) if number not in there), 5))
    if missing:
        yield f"{table} {_listed(missing)}: found no such row, expected all from 1 to {last}"


def early_flaws(acknowledgements: Iterable[Acknowledgement]) -> Iterator[str]:
    """Report acknowledgements that would silence an axis beforehand."""
    for noted in acknowledgements:
        if noted.since > noted.at:
            yield (
                f"acknowledgement of {noted.axis} at {iso(noted.at)}: found a baseline since {iso(noted.since)}, "
                "expected one that does not begin later than the acknowledgement itself"
            )


def _differences(name: str, found_row: dict[str, Any], expected: dict[str, Any]) -> Iterator[str]:
    for column, expected_value in expected.items():
        # SQLite has no NaN: it keeps NULL.
        wanted = None if isinstance(expected_value, float) and math.isnan(expected_value) else expected_value
        if found_row[column] != wanted:
            yield f"{name}: found {column} {found_row[column]!r}, expected {wanted!r} as its document says"


def _listed(names: Iterable[object]) -> str:
    return ", ".join(map(str, names)) or "none"
