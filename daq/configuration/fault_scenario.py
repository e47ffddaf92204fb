"""What goes wrong in a simulated cell, and when: `faults` of a simulation file, or a scenario file of faults alone."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from daq.configuration.yaml_file import Fault, StrictModel, describe, parse_yaml, read_bytes, read_model
from daq.errors import ConfigurationInconsistent
from drivers.simulated.fault import FaultKind, FaultSpec

AxisName = Annotated[str, Field(pattern=r"^J[1-9][0-9]?$")] | Annotated[int, Field(ge=1)]
"""J3, or 3."""


LONGEST_S = 1e6
LAST_CYCLE = 10**12
"""No simulated cell runs for that long; beyond 2⁶³ periods nothing could count them."""


class FaultModel(StrictModel):
    """Something that goes wrong; times count from power-on, in the time of the plant."""

    fault: FaultKind
    axis: AxisName | None = None
    at_s: Annotated[float, Field(ge=0, le=LONGEST_S)] | None = None
    at_cycle: Annotated[int, Field(ge=0, le=LAST_CYCLE)] | None = None
    for_s: Annotated[float, Field(gt=0, le=LONGEST_S)] | None = None
    cycles: Annotated[int, Field(ge=1, le=LAST_CYCLE)] | None = None
    emcy_code: Annotated[int, Field(ge=0x1000, le=0xFFFF)] | None = None

    @model_validator(mode="after")
    def _one_spelling(self) -> FaultModel:
        if self.at_s is not None and self.at_cycle is not None:
            raise ValueError("at_s or at_cycle, not both")
        if self.for_s is not None and self.cycles is not None:
            raise ValueError("for_s or cycles, not both")
        if (self.emcy_code is not None) != (self.fault is FaultKind.EMERGENCY):
            raise ValueError("emcy_code for the fault emergency, and for no other")
        return self

    def spec(self, period_us: int) -> FaultSpec:
        """In SYNCs."""
        begin = self.at_cycle or 0 if self.at_s is None else round(self.at_s * 1e6 / period_us)
        cycles = self.cycles if self.for_s is None else max(1, round(self.for_s * 1e6 / period_us))
        axis = None if self.axis is None else axis_index(self.axis)
        return FaultSpec(self.fault, axis, begin, cycles, self.emcy_code or 0)


class ScenarioModel(StrictModel):
    """A whole scenario file."""

    faults: Annotated[tuple[FaultModel, ...], Field(min_length=1)]


def load_scenario(path: Path, axes: int, period_us: int) -> tuple[FaultSpec, ...]:
    """Read a scenario file; its faults come on top of those of the simulation file.

    Args:
        path: of the file.
        axes: that the cell has.
        period_us: of its SYNC.

    Raises:
        ConfigurationError: the file is missing, wrong, or names an axis that the cell lacks.
    """
    document = parse_yaml(read_bytes(path), str(path))
    model = read_model(document, ScenarioModel)
    if wrong := absent_axes(model.faults, axes):
        raise ConfigurationInconsistent(**describe(document, wrong), remedy="correct the scenario file")
    return tuple(fault.spec(period_us) for fault in model.faults)


def absent_axes(faults: Sequence[FaultModel], axes: int) -> list[Fault]:
    """What is wrong with faults on axes that the cell lacks."""
    return [
        Fault(("faults", number, "axis"), f"axis {fault.axis}", f"J1 to J{axes}")
        for number, fault in enumerate(faults)
        if fault.axis is not None and axis_index(fault.axis) >= axes
    ]


def axis_index(axis: str | int) -> int:
    """Index from 0 of an axis given as "J3" or by its number from 1."""
    number = int(re.sub(r"^J", "", axis)) if isinstance(axis, str) else axis
    return number - 1
