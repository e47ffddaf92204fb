"""What must hold before a gain is written to a controller; each gate closes for a reason of its own.

The gates of a gain are in `gain_gates` and `axis_gates`, of the fit in `fit_gates`, of the logs in `source_gates` and
`role_gates`, of the controller's file and of who stands for the calibration in `base_gate` and `signature_gate`.
docs/reference/gates.md has them in a table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import Enum

from daq.config.cell import Axis, Cell, WeighedPayload
from daq.errors import CalibrationRefused


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


# The error for closed gates.


def refusal_error(target: str, refusals: Sequence[Refusal]) -> CalibrationRefused:
    """What to raise for at least one closed gate; several are listed one a line.

    Args:
        target: what was not written.
        refusals: the closed gates.
    """
    if len(refusals) == 1:
        only = refusals[0]
        return CalibrationRefused(only.subject, found=only.found, expected=only.expected, remedy=only.remedy)
    listed = "".join(f"\n  {refusal}" for refusal in refusals)
    return CalibrationRefused(
        target,
        found=f"{len(refusals)} closed gates{listed}\n ",
        expected="none",
        remedy="nothing was written",
    )


# What a calibration is held against: the cell as it is now, the scale, and the calendar.


@dataclass(frozen=True, slots=True)
class GateContext:
    """Whatever is None is not compared.

    Attributes:
        now: with time zone; None where the age of logs does not matter.
        serials: serial number of each axis's drive, None for one that the cell file does not tell.
        payloads: of the cell, with their masses and tolerances.
        entered_kg: masses entered a second time at the write-back, by the payload's name [kg].
        axes: of the cell, with the unit and the nameplate of each gain.
    """

    now: datetime | None = None
    serials: Mapping[str, int | None] | None = None
    payloads: tuple[WeighedPayload, ...] | None = None
    entered_kg: Mapping[str, float] = field(default_factory=dict)
    axes: tuple[Axis, ...] | None = None

    @property
    def is_given(self) -> bool:
        """Whether there is anything to compare with."""
        return any(one is not None for one in (self.now, self.serials, self.payloads, self.axes))


def gate_context(cell: Cell, now: datetime, entered_kg: Mapping[str, float]) -> GateContext:
    """All of them, of one cell."""
    serials = {axis.name: None if axis.identity is None else axis.identity.serial for axis in cell.axes}
    return GateContext(now, serials, cell.payloads, entered_kg, cell.axes)
