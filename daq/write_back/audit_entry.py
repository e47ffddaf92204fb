"""One line of the audit: what was asked of a controller, by whom, and the digest that chains it to the line before."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

FIRST = "0" * 64
"""What the first entry follows."""

_BEGINNING = b'{"action":"'
"""Of every line: the keys are sorted."""


class AuditAction(Enum):
    """What happened."""

    PROPOSED = "proposed"
    REFUSED = "refused"
    APPLY_BEGUN = "apply begun"
    APPLIED = "applied"
    ROLLBACK_BEGUN = "rollback begun"
    ROLLED_BACK = "rolled back"
    FAILED = "failed"
    NOTHING_TO_DO = "nothing to do"
    """Somebody asked for a write of what stands there already."""
    RECALIBRATION_BEGUN = "recalibration begun"
    RECALIBRATION_ENDED = "recalibration ended"
    ACKNOWLEDGED = "acknowledged"
    TORN_LINE = "torn line"
    """The line before is what a writer left that was killed or had no room; details: its length and SHA-256."""


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """One entry.

    Attributes:
        number: from 1, without gaps.
        at: ISO 8601 time with its zone.
        who: the person or the job.
        action: what happened.
        subject: what it happened to: for a write, the controller file with symbolic links followed.
        details: plain JSON; see docs/write-back.md for what each action says.
        previous: `sha256` of the entry before, `FIRST` for the first.
        sha256: of the canonical JSON of all of the above, hexadecimal.
    """

    number: int
    at: str
    who: str
    action: AuditAction
    subject: str
    details: dict[str, object]
    previous: str
    sha256: str

    @property
    def holds(self) -> bool:
        """Whether the entry is what its digest was computed from."""
        return self.sha256 == _digest(_content(self))


def entry(
    number: int, at: str, who: str, action: AuditAction, subject: str, details: Mapping[str, object], previous: str
) -> AuditEntry:
    """A new entry with its digest.

    Raises:
        TypeError, ValueError: the details are no JSON, or have a number that is not finite.
    """
    # As it will be read: with lists for tuples, so that what is returned is what is in the file.
    plain: dict[str, object] = json.loads(_canonical(dict(details)))
    unsigned = AuditEntry(number, at, who, action, subject, plain, previous, "")
    return AuditEntry(number, at, who, action, subject, plain, previous, _digest(_content(unsigned)))


def encode(one: AuditEntry) -> bytes:
    """The line, without its end."""
    return _canonical({**_content(one), "sha256": one.sha256})


def decode(line: bytes) -> AuditEntry | None:
    """The entry in a line, its digest not yet compared; None where the line is not one that `encode` could write."""
    try:
        tree = json.loads(line)
        found = _entry(tree)
        return found if found is not None and encode(found) == line else None
    except (ValueError, TypeError, RecursionError):
        return None


def is_fragment(line: bytes) -> bool:
    """Whether a line can be the beginning of an entry that a writer did not finish: such a beginning is never JSON.

    Zeros behind it, or alone, are what a power cut leaves. Any other text is somebody else's file.
    """
    begun = line.rstrip(b"\0")
    if not begun.startswith(_BEGINNING) and not _BEGINNING.startswith(begun):
        return False
    try:
        json.loads(line)
    except ValueError:
        return True
    except RecursionError:
        return False
    return False


def _entry(tree: Any) -> AuditEntry | None:
    if not isinstance(tree, dict):
        return None
    texts = [tree.get(key) for key in ("at", "who", "action", "subject", "previous", "sha256")]
    number, details = tree.get("number"), tree.get("details")
    if not all(isinstance(text, str) for text in texts) or not isinstance(details, dict) or type(number) is not int:
        return None
    at, who, action, subject, previous, sha256 = map(str, texts)
    return AuditEntry(number, at, who, AuditAction(action), subject, details, previous, sha256)


def _content(one: AuditEntry) -> dict[str, object]:
    return {
        "number": one.number,
        "at": one.at,
        "who": one.who,
        "action": one.action.value,
        "subject": one.subject,
        "details": one.details,
        "previous": one.previous,
    }


def _canonical(tree: object) -> bytes:
    """One spelling for one content: sorted keys, no spaces, ASCII, no NaN (which is no JSON)."""
    return json.dumps(tree, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _digest(content: dict[str, object]) -> str:
    return hashlib.sha256(_canonical(content)).hexdigest()
