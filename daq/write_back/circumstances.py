"""What a calibration is held against: the cell as it is now, the scale, and the calendar."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime

from daq.configuration.cell import Axis, Cell, WeighedPayload


@dataclass(frozen=True, slots=True)
class Circumstances:
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
    def told(self) -> bool:
        """Whether there is anything to compare with."""
        return any(one is not None for one in (self.now, self.serials, self.payloads, self.axes))


def circumstances(cell: Cell, now: datetime, entered_kg: Mapping[str, float]) -> Circumstances:
    """All of them, of one cell."""
    serials = {axis.name: None if axis.identity is None else axis.identity.serial for axis in cell.axes}
    return Circumstances(now, serials, cell.payloads, entered_kg, cell.axes)
