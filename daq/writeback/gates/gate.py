"""Gate, refusal and the context that every gate reads."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from daq.config.cell import Cell
from daq.config.policy import ApplyPolicy
from daq.ledger.names import RenamedCell
from daq.writeback.request import Edit, Request
from ident.calibration import Calibration


class Gate(Enum):
    """Why a calibration is refused; the rows of `daq.writeback.gates.table`."""

    NOT_FINITE = "not finite"
    NOT_IDENTIFIED = "not identified"
    SIGN = "sign"
    CHANGE = "change"
    NAMEPLATE = "nameplate"
    UNIT = "unit"
    UNCERTAINTY = "uncertainty"
    CELL = "cell"
    CONFIGURATION = "configuration"
    DESCRIPTION = "description of the robot"
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
    """One failed check: found, expected, and what to do."""

    gate: Gate  #: the check that failed
    subject: str  #: thing that was checked
    found: str  #: its state
    expected: str  #: state with which the check passes
    remedy: str  #: advice for the operator

    def __str__(self) -> str:
        return f"{self.subject}: found {self.found}; expected {self.expected}; {self.remedy}"


@dataclass(frozen=True, slots=True)
class GateContext:
    """All that the gates compare."""

    request: Request  #: calibration, policy, time, and what the operator states
    edit: Edit  #: planned change of the target
    #: as it is now; None for a library without one, where nothing is compared with it
    cell: Cell | None = None
    #: of the cell's robot, where the cell has the name from before it; None where it has not
    renamed: RenamedCell | None = None

    @property
    def calibration(self) -> Calibration:
        """The calibration to be written."""
        return self.request.calibration

    @property
    def policy(self) -> ApplyPolicy:
        """Bounds of the request, else those of the cell."""
        return self.request.policy or (ApplyPolicy() if self.cell is None else self.cell.apply)

    @property
    def axis_names(self) -> list[str]:
        """Axes of the calibration, in its order."""
        return [gain.axis for gain in self.calibration.gains]
