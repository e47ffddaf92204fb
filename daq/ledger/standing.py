"""State of one calibration by the ledger of its cell: written, accepted or not, replaced, or none of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import Enum

from daq.ledger.audit import AuditEntry, begun_by, noted_heads, verify
from daq.ledger.fold import Event, History, RecordedAcceptance
from daq.ledger.ledger import Ledger, read_history


class StandingState(Enum):
    """States of a calibration."""

    NOT_KNOWN = "not known"  #: no ledger was read
    NOT_WRITTEN = "not written"
    WRITTEN = "written"  #: a controller has its gains
    ACCEPTED = "accepted"  #: it was tried in the cell, and accepted
    NOT_ACCEPTED = "not accepted"  #: it was tried in the cell, and new moves contradict it
    REPLACED = "replaced"  #: its gains were written, and were replaced or rolled back since


@dataclass(frozen=True, slots=True)
class Standing:
    """State of one calibration at one time."""

    as_of: datetime | None  #: when the ledger was read, with zone; None where it was not
    unknown: str = ""  #: why it was not, in words; empty where it was
    write: Event | None = None  #: last write of its gains, one that is in force if there is any; None if never written
    #: Next write or rollback at the same place; None while the gains are in force.
    ended: Event | None = None
    #: Gains that were at that place before the write, by axis; empty where the ledger does not have them.
    before: Mapping[str, float] = field(default_factory=dict)
    acceptance: RecordedAcceptance | None = None  #: result of the last new moves with these gains
    history: History = field(default_factory=lambda: History((), (), ()))  #: that it was read from

    @property
    def state(self) -> StandingState:
        """State in one word."""
        if self.as_of is None:
            return StandingState.NOT_KNOWN
        if self.ended is not None:
            return StandingState.REPLACED
        if self.acceptance is not None and not self.acceptance.accepted:
            return StandingState.NOT_ACCEPTED
        if self.acceptance is not None:
            return StandingState.ACCEPTED
        if self.write is not None:
            return StandingState.WRITTEN
        return StandingState.NOT_WRITTEN


def read_standing(ledger: Ledger, digest: str, as_of: datetime, place: str | None = None) -> Standing:
    """Read the state of a calibration from the ledger of its cell.

    Args:
        ledger: of the cell.
        digest: SHA-256 of the calibration's file.
        as_of: time now, with zone.
        place: controller's file, whose write counts before others where it is in force; None for any place.

    Raises:
        AuditUnusable: the audit log is no regular file, or it cannot be read.
        HistoryUnreadable: there is a history of an earlier version that cannot be read.
    """
    history = read_history(ledger)
    # Entries that were edited prove nothing.
    entries = verify(ledger.audit, noted_heads(ledger.audit)).intact
    write = _last_write(history, digest, place)
    acceptances = [one for one in history.acceptances if one.digest == digest]
    before: dict[str, float] = {}
    ended: Event | None = None
    if write is not None:
        before = _gains_before(write, entries)
        ended = _next_at_its_place(history, write)
    return Standing(
        as_of=as_of,
        write=write,
        ended=ended,
        before=before,
        acceptance=acceptances[-1] if acceptances else None,
        history=history,
    )


def _last_write(history: History, digest: str, place: str | None) -> Event | None:
    """Return the last write of a calibration's gains, one that is in force if there is any, and `place` first."""
    newest = {event.target: event for event in history.events}
    in_force = [event for event in newest.values() if event.digest == digest]
    here = [event for event in in_force if event.target == place]
    writes = here or in_force or [event for event in history.events if event.digest == digest]
    return max(writes, key=lambda event: event.at, default=None)


def _next_at_its_place(history: History, write: Event) -> Event | None:
    """Return the write or rollback that followed a write at the same place; None where there was none."""
    later = history.events[history.events.index(write) + 1 :]
    return next((event for event in later if event.target == write.target), None)


def _gains_before(write: Event, entries: Sequence[AuditEntry]) -> dict[str, float]:
    """Return the gains that a controller's file had before a write, by axis; none where the audit log lacks them."""
    by_digest = {entry.sha256: entry for entry in entries}
    by_number = {entry.number: entry for entry in entries}
    ended = by_digest.get(write.audit or "")
    if ended is None:
        return {}
    # The end names the begin, which has the numbers; a write that its killed writer did not end is the begin itself.
    begun = by_number.get(begun_by(ended), ended)
    changes = begun.details.get("changes")
    if not isinstance(changes, list):
        return {}
    before = {}
    for change in changes:
        if not isinstance(change, dict):
            continue
        axis = change.get("axis")
        old = change.get("old")
        if isinstance(axis, str) and isinstance(old, float | int) and math.isfinite(old):
            before[axis] = float(old)
    return before
