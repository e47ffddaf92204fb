"""Status of a calibration on its certificate: written, accepted or not, replaced, not written; date and person."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from daq.ledger.fold import Event, RecordedAcceptance, WriteAction
from daq.ledger.ledger import MAY_LACK
from daq.ledger.standing import StandingState
from daq.report.comparison import Comparison
from daq.report.document import Report
from daq.report.text import minute_text

_VERBS = {WriteAction.APPLIED: "written", WriteAction.ROLLED_BACK: "restored by a rollback"}
_ENDS = {WriteAction.APPLIED: "replaced by other gains", WriteAction.ROLLED_BACK: "rolled back"}


class StatusEvent(Report):
    """A write, a rollback, or new moves with the gains."""

    at: str
    who: str


class StatusWrite(StatusEvent):
    """A write, or a rollback that restored these gains."""

    target: str
    """the controller's file, or the drives"""


class StatusAcceptance(StatusEvent):
    """Result of new moves with these gains."""

    accepted: bool
    remark: str
    """what was found"""
    undo: str
    """command that undoes the write; empty where they were accepted"""


class CertificateStatus(Report):
    """State of a calibration by the audit log of its cell, and by the controller's file where it was read."""

    state: str
    """written, accepted, not accepted, replaced, not written, or not known"""
    text: str
    """the same as a sentence"""
    as_of: str | None
    """when the audit log was read; null where it was not"""
    write: StatusWrite | None
    """last write of these gains; null where there was none"""
    ended: StatusEvent | None
    """write or rollback that put other gains in their place; null where there was none"""
    acceptance: StatusAcceptance | None
    """result of the last new moves with these gains; null where there were none"""


def certificate_status(comparison: Comparison) -> CertificateStatus:
    """Return the status for the document of the certificate."""
    return CertificateStatus.of(comparison.standing, state=_state(comparison).value, text=status_text(comparison))


def _state(comparison: Comparison) -> StandingState:
    if comparison.changed_by_hand:
        return StandingState.REPLACED
    return comparison.standing.state


def status_text(comparison: Comparison) -> str:
    """Return the status in words."""
    standing = comparison.standing
    if standing.as_of is None:
        return f"not known: {standing.unknown}"
    parts = ["not written"]
    if standing.write is not None:
        parts = [write_text(standing.write)]
    if standing.ended is not None:
        parts.append(f"{_ENDS[standing.ended.action]} on {_when(standing.ended.at)} by {standing.ended.who}")
    elif comparison.changed_by_hand:
        parts.append("the file has other gains now")
    if standing.acceptance is not None:
        parts.append(_acceptance_text(standing.acceptance, is_in_place=comparison.in_force is not None))
    if standing.history.may_lack:
        parts.append(MAY_LACK)
    return f"{'; '.join(parts)} (as of {_when(standing.as_of)})"


def _acceptance_text(acceptance: RecordedAcceptance, *, is_in_place: bool) -> str:
    """Say when new moves accepted the gains; otherwise what failed, and how to undo the write if it is in place."""
    if acceptance.accepted:
        return f"accepted on {_when(acceptance.at)} by {acceptance.who}"
    text = f"NOT ACCEPTED on {_when(acceptance.at)} by {acceptance.who}"
    if acceptance.remark:
        text += f": {acceptance.remark}"
    if is_in_place and acceptance.undo:
        text += f"; to undo the write: {acceptance.undo}"
    return text


def write_text(write: Event) -> str:
    """Say when a write was made, by whom and where."""
    place = "the drives"
    target = Path(write.target)
    if target.is_absolute():
        place = target.name
    return f"{_VERBS[write.action]} on {_when(write.at)} by {write.who} to {place}"


def _when(at: datetime) -> str:
    return minute_text(at.isoformat())
