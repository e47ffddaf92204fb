"""What must hold before a gain is written to a controller; each gate closes for a reason of its own.

The gates of a gain are in `gain_gates` and `axis_gates`, of the fit in `fit_gates`, of the logs in `source_gates` and
`role_gates`, of the controller's file and of who stands for the calibration in `base_gate` and `signature_gate`.
docs/write-back.md has them in a table.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Gate(Enum):
    """Why a calibration is refused."""

    NOT_FINITE = "not finite"
    NOT_IDENTIFIED = "not identified"
    SIGN = "sign"
    CHANGE = "change"
    NAMEPLATE = "nameplate"
    UNIT = "unit"
    UNCERTAINTY = "uncertainty"
    CELL = "cell"
    CONFIGURATION = "configuration"
    ERROR = "error"
    HOLDOUT = "hold-out error"
    HOLDOUT_STILL = "axis at rest in the hold-out"
    EFFECT = "effect"
    SOURCES = "sources"
    PARTIAL = "partial"
    LOSSY = "lossy"
    STALE = "stale"
    SERIAL = "serial number"
    SATURATED = "saturated"
    MASS = "payload mass"
    BASE = "base file"
    SIGNATURE = "signature"


@dataclass(frozen=True, slots=True)
class Refusal:
    """One closed gate: what was found, what would have opened it, what to do."""

    gate: Gate
    subject: str
    found: str
    expected: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.subject}: found {self.found}; expected {self.expected}; {self.remedy}"
