"""A request to write a calibration to a controller, and the planned change that it leads to.

`--base` ties the two together. A dry run prints the digests of the content before and after the
change; the write repeats them, and only that change is made: not another one because the
calibration, the keys or the file have changed in between.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import Enum
from pathlib import Path

from daq.arguments import (
    A_FLAG,
    A_MOMENT,
    A_NUMBER,
    A_PATH_OBJECT,
    A_TEXT,
    BYTES,
    TEXTS,
    by_name,
    of_kind,
    optional,
    require_fields,
)
from daq.config.policy import ApplyPolicy
from daq.documents.calibration_file import encode_calibration
from daq.errors import CalibrationRefused, UsageError
from daq.files import sha256
from ident.calibration import Calibration, Gain

_DIGITS = 12
"""Hexadecimal digits of SHA-256 in the name of a backup and in --base:
48 bits distinguish a few hundred contents.
"""


@dataclass(frozen=True, slots=True)
class Request:
    """Request to write a calibration, the same for a controller's file and for the drives."""

    calibration: Calibration  #: the identified gains
    now: datetime  #: wall-clock time, for the age of the logs
    policy: ApplyPolicy | None = None  #: bounds; those of the cell when None
    #: The operator accepts that the cell's configuration changed since the recording.
    accepts_changed_configuration: bool = False
    #: Masses weighed again for this write, by the payload's name [kg].
    entered_kg: Mapping[str, float] = field(default_factory=dict)
    #: Value of --base: `Edit.base` of the reviewed change, or the SHA-256 of its content, for any
    #: change.
    base: str | None = None
    #: names of the operator, the login last; their own signatures do not count
    appliers: Collection[str] = ()
    #: calibration file, next to which signatures are searched; None without one
    file: Path | None = None
    content: bytes | None = None  #: bytes of that file as they were read; None without one

    def check_fields(self) -> None:
        """Refuse fields of another type.

        Raises:
            UsageError: there is one; it is named.
        """
        require_fields("the request", self, _REQUEST_FIELDS, "write Request(calibration, now)")

    @property
    def signed(self) -> bytes:
        """The bytes that a signature must cover."""
        if self.content is None:
            return encode_calibration(self.calibration)
        return self.content

    @property
    def evidence(self) -> dict[str, object]:
        """Digests of calibration, configuration and logs as plain JSON, for the audit."""
        calibration = self.calibration
        return {
            "calibration": {
                "file": None if self.file is None else str(self.file.absolute()),
                "sha256": sha256(self.signed),
                "cell": calibration.cell,
                "created": calibration.created,
                "software": calibration.software,
            },
            "configuration_sha256": calibration.configuration_sha256,
            "logs": [
                {"name": one.name, "sha256": one.sha256, "role": one.role}
                for one in calibration.sources
            ],
        }


_REQUEST_FIELDS = {
    "calibration": of_kind(Calibration),
    "now": A_MOMENT,
    "policy": optional(of_kind(ApplyPolicy)),
    "accepts_changed_configuration": A_FLAG,
    "entered_kg": by_name(A_NUMBER),
    "base": optional(A_TEXT),
    "appliers": TEXTS,
    "file": optional(A_PATH_OBJECT),
    "content": optional(BYTES),
}


class GainOrigin(Enum):
    """Origin of the gain that a new one is compared with;
    the value is the word for it in messages.
    """

    CURRENT = "current gain"  #: what the controller has
    NAMEPLATE = "nameplate"  #: from the data sheet, as the cell file has it
    PREVIOUS = "previous gain"  #: what the controller had before the last write
    EARLIER = "earlier calibration"  #: from another calibration of the cell


@dataclass(frozen=True, slots=True)
class GainChange:
    """A new gain with the one that it is compared with: in a planned write, the current gain."""

    axis: str  #: name of the axis
    key: str  #: place of the number: its key in the controller file, or the drive's object
    line: int  #: of the number in the file, from 1; 0 in a drive
    #: gain that the new one is compared with [unit]; `compared_with` says which
    compared_gain: float
    new: float  #: gain as it will be read back [unit], NaN where there is none to write
    std: float  #: standard deviation of the identified gain [unit]
    unit: str  #: Nm at the joint per unit of the current-loop reference
    nameplate_gain: float  #: gain of the data sheet [unit]
    #: the new number as written, in the controller's own unit; empty where none can be written
    spelling: str
    compared_with: GainOrigin = GainOrigin.CURRENT

    @classmethod
    def of(
        cls, gain: Gain, key: str, line: int, current_gain: float, planned: tuple[float, str] | None
    ) -> GainChange:
        """Make the change of one gain; `planned` is `new` and `spelling`,
        None where there is none to write.
        """
        new, spelling = planned or (gain.value, "")
        return cls(
            gain.axis, key, line, current_gain, new, gain.std, gain.unit, gain.nameplate, spelling
        )

    @property
    def current_gain(self) -> float:
        """Gain that the controller has [unit];
        NaN where the new one is compared with another gain.
        """
        if self.compared_with is not GainOrigin.CURRENT:
            return math.nan
        return self.compared_gain

    @property
    def change_percent(self) -> float:
        """Change from the gain that is compared [%]; inf from zero."""
        return _percent(self.new - self.compared_gain, self.compared_gain)

    @property
    def nameplate_percent(self) -> float:
        """Change from the nameplate [%]; inf from zero."""
        return _percent(self.new - self.nameplate_gain, self.nameplate_gain)

    @property
    def std_percent(self) -> float:
        """Relative standard deviation [%]; inf for a gain of zero."""
        return _percent(self.std, abs(self.new))


#: Reason to refuse a write: subject, found, expected, remedy
GateFinding = tuple[str, str, str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Edit:
    """Planned change of a target; nothing is written yet."""

    subject: str  #: the target, as audit and history name it
    before: bytes | None  #: its content now; None where the file is gone
    after: bytes  #: its content after the change
    #: one for each gain, in the order of the calibration; none in a rollback
    changes: tuple[GainChange, ...] = ()
    #: where the content now is not the one that drivegain expects there
    unexpected: tuple[GateFinding, ...] = ()
    source: Path | None = None  #: backup or record that a rollback restores; None for a calibration

    @property
    def name(self) -> str:
        """The target as the cell names it."""
        return self.subject

    @property
    def diff(self) -> str:
        """The change as text, empty where there is none."""
        return ""

    @property
    def place(self) -> Path:
        """File or folder that an error of the file system is reported for."""
        return Path(self.subject)

    @property
    def has_effect(self) -> bool:
        """Whether there is anything to write."""
        return self.before != self.after

    @property
    def keeps_all(self) -> bool:
        """Whether the controller has exactly these gains already,
        so that a write would lose nothing.
        """
        return not self.has_effect and all(change.spelling for change in self.changes)

    @property
    def base_sha256(self) -> str:
        """SHA-256 of the content now."""
        return sha256(self.before or b"")

    @property
    def base(self) -> str:
        """The value of --base that approves exactly this change."""
        return change_digest(self.before or b"", self.after)


def require_axes(calibration: Calibration, axes: Collection[str]) -> None:
    """Refuse a calibration that has not exactly one gain for each axis of the target.

    Raises:
        CalibrationRefused: it has not.
    """
    found = [gain.axis for gain in calibration.gains]
    if sorted(found) != sorted(axes):
        raise CalibrationRefused(
            "calibration",
            found=f"gains of {', '.join(found) or 'no axis'}",
            expected=f"one for each axis of the cell: {', '.join(axes) or 'none'}",
            remedy="give the calibration and the configuration of the same cell",
        )


def is_writable(gain: Gain) -> bool:
    """Whether a gain can be written; one that cannot is refused by a gate."""
    return math.isfinite(gain.value) and math.isfinite(gain.std) and gain.value != 0


def short_digest(content: bytes) -> str:
    """First digits of the SHA-256 of a content."""
    return sha256(content)[:_DIGITS]


def change_digest(before: bytes, after: bytes) -> str:
    """Identify a change by the digests of its two contents."""
    return f"{short_digest(before)}-{short_digest(after)}"


def parse_base(base: str, before: bytes) -> tuple[str, str | None]:
    """Read the value of --base: `change_digest` of a change,
    or the whole SHA-256 of the content before it.

    Args:
        base: as the operator gave it.
        before: content now; a short digest that fits it means this content.

    Returns:
        SHA-256 of the reviewed content, and the first digits of that after the change; None where
        any is accepted.

    Raises:
        UsageError: it is neither.
    """
    was, joined, after_digest = base.strip().lower().partition("-")
    if not joined and len(was) == len(sha256(before)) and _is_hex(was):
        return was, None
    if not (len(was) == len(after_digest) == _DIGITS and _is_hex(was + after_digest)):
        raise UsageError(
            f"--base {base}",
            found="no digest",
            expected=f"the value that a dry run prints: {_DIGITS} digits, a hyphen, "
            f"{_DIGITS} digits",
            remedy="copy it from the last line of the dry run",
        )
    return sha256(before) if was == short_digest(before) else was, after_digest


def _is_hex(text: str) -> bool:
    return set(text) <= set("0123456789abcdef")


def _percent(part: float, whole: float) -> float:
    return 100.0 * part / whole if whole else math.inf
