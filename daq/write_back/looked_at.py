"""What somebody has looked at before a write: what stood there, and what would stand there in its place.

Both as the first digits of their SHA-256, before-after, as a backup is named. Who repeats it at the write gets the
change that was shown: not another one because the calibration, the keys or the file have become others meanwhile.
"""

from __future__ import annotations

from dataclasses import dataclass

from daq.digest import sha256
from daq.errors import UsageError
from daq.write_back.backups import short_digest
from daq.write_back.gates import Gate, Refusal


@dataclass(frozen=True, slots=True)
class LookedAt:
    """What somebody says that they have looked at.

    Attributes:
        base_sha256: digest of what stood there; None where they say nothing.
        became: first digits of the digest of what would take its place; None where that is not told.
    """

    base_sha256: str | None
    became: str | None


def change_of(before: bytes, after: bytes) -> str:
    """By which a change is recognised, for --base."""
    return f"{short_digest(before)}-{short_digest(after)}"


def look(told: str | None, before: bytes) -> LookedAt:
    """Read what --base says.

    Args:
        told: `change_of` a change, or the whole SHA-256 of what stood there; None where nobody has looked.
        before: what stands there now. Where its digest begins with the digits that were told, it is what was meant.

    Raises:
        UsageError: it is neither.
    """
    if told is None:
        return LookedAt(None, None)
    was, joined, became = told.strip().lower().partition("-")
    digits = len(short_digest(before))
    if not joined and len(was) == len(sha256(before)) and _is_hex(was):
        return LookedAt(was, None)
    if not (len(was) == len(became) == digits and _is_hex(was + became)):
        raise UsageError(
            f"--base {told}",
            found="no digest",
            expected=f"what a dry run tells: {digits} digits, a hyphen, {digits} digits",
            remedy="copy it from the last line of the dry run",
        )
    return LookedAt(sha256(before) if was == short_digest(before) else was, became)


def other_change(looked: LookedAt, subject: str, before: bytes, after: bytes) -> tuple[Refusal, ...]:
    """Closed where another content would be written than the one that was shown.

    Args:
        looked: what somebody has looked at.
        subject: what would be written to.
        before, after: what stands there, and what would stand there. Where something else stands there than was shown,
            the gate of the base says so, and this one says nothing.
    """
    if looked.became in {None, short_digest(after)} or looked.base_sha256 != sha256(before):
        return ()
    return (
        Refusal(
            Gate.BASE,
            subject,
            f"a change to {short_digest(after)}…",
            f"to {looked.became}…, as --base says",
            "the calibration, the keys or the factors have changed since the dry run: look at a new one",
        ),
    )


def _is_hex(text: str) -> bool:
    return set(text) <= set("0123456789abcdef")
