"""That somebody wants a calibration to be applied, and what they say of it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from daq.config.policy import ApplyPolicy
from daq.errors import UsageError
from daq.files import sha256
from daq.workflow.calibration_file import encode
from daq.writeback.file_access import short_digest
from daq.writeback.gates.table import Gate, Refusal
from ident.calibration import Calibration


@dataclass(frozen=True, slots=True)
class Request:
    """The same for a controller's file and for the drives.

    Attributes:
        calibration: with the identified gains.
        now: for the age of the logs.
        policy: bounds; the cell's when None.
        configuration_changed: they have looked at what changed in the cell's configuration since the recording.
        entered_kg: masses that were read off the scale once more, by the payload's name [kg].
        looked_at: `Proposal.looked_at` of the change that they have looked at, or the digest of the controller file
            alone: then whatever the calibration changes in it.
        appliers: names of whoever applies it, the login last; their signatures do not count.
        file: of the calibration, where signatures are looked for; None where it is in no file.
        content: of that file, as it was read; None where it is in no file.
    """

    calibration: Calibration
    now: datetime
    policy: ApplyPolicy | None = None
    configuration_changed: bool = False
    entered_kg: Mapping[str, float] = field(default_factory=dict)
    looked_at: str | None = None
    appliers: Collection[str] = ()
    file: Path | None = None
    content: bytes | None = None

    @property
    def signed(self) -> bytes:
        """What a signature must be of."""
        return encode(self.calibration) if self.content is None else self.content


# What somebody has looked at before a write: what stood there, and what would stand there in its place.
#
# Both as the first digits of their SHA-256, before-after, as a backup is named. Who repeats it at the write gets the
# change that was shown: not another one because the calibration, the keys or the file have become others meanwhile.


@dataclass(frozen=True, slots=True)
class ReviewedChange:
    """What somebody says that they have looked at.

    Attributes:
        base_sha256: digest of what stood there; None where they say nothing.
        became: first digits of the digest of what would take its place; None where that is not told.
    """

    base_sha256: str | None
    after_digest: str | None


def change_digest(before: bytes, after: bytes) -> str:
    """By which a change is recognised, for --base."""
    return f"{short_digest(before)}-{short_digest(after)}"


def parse_base(base: str | None, before: bytes) -> ReviewedChange:
    """Read what --base says.

    Args:
        base: `change_digest` a change, or the whole SHA-256 of what stood there; None where nobody has looked.
        before: what stands there now. Where its digest begins with the digits that were told, it is what was meant.

    Raises:
        UsageError: it is neither.
    """
    if base is None:
        return ReviewedChange(None, None)
    was, joined, after_digest = base.strip().lower().partition("-")
    digits = len(short_digest(before))
    if not joined and len(was) == len(sha256(before)) and _is_hex(was):
        return ReviewedChange(was, None)
    if not (len(was) == len(after_digest) == digits and _is_hex(was + after_digest)):
        raise UsageError(
            f"--base {base}",
            found="no digest",
            expected=f"what a dry run tells: {digits} digits, a hyphen, {digits} digits",
            remedy="copy it from the last line of the dry run",
        )
    return ReviewedChange(sha256(before) if was == short_digest(before) else was, after_digest)


def changed_since_review(reviewed: ReviewedChange, subject: str, before: bytes, after: bytes) -> tuple[Refusal, ...]:
    """Closed where another content would be written than the one that was shown.

    Args:
        looked: what somebody has looked at.
        subject: what would be written to.
        before, after: what stands there, and what would stand there. Where something else stands there than was shown,
            the gate of the base says so, and this one says nothing.
    """
    if reviewed.after_digest in {None, short_digest(after)} or reviewed.base_sha256 != sha256(before):
        return ()
    return (
        Refusal(
            Gate.BASE,
            subject,
            f"a change to {short_digest(after)}…",
            f"to {reviewed.after_digest}…, as --base says",
            "the calibration, the keys or the factors have changed since the dry run: look at a new one",
        ),
    )


def _is_hex(text: str) -> bool:
    return set(text) <= set("0123456789abcdef")


# What a write rests on, for the audit: digests of calibration, configuration and logs.


def evidence_of(calibration: Calibration, content: bytes, file: Path | None) -> dict[str, object]:
    """As plain JSON.

    Args:
        calibration: whose gains are written.
        content: of its file.
        file: where that is, None where there is none.
    """
    return {
        "calibration": {
            "file": None if file is None else str(file.absolute()),
            "sha256": sha256(content),
            "cell": calibration.cell,
            "created": calibration.created,
            "software": calibration.software,
        },
        "configuration_sha256": calibration.configuration_sha256,
        "logs": [{"name": one.name, "sha256": one.sha256, "role": one.role} for one in calibration.sources],
    }
