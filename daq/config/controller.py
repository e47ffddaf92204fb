"""Where the gains of a cell go: a file of its controller, objects of its drives, or both (`controller`)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Annotated

from pydantic import Discriminator, Field, Tag, model_validator

from daq.config.yaml_file import Fault, StrictModel, not_in_file
from drivers.profiles.profile import Parameter, ParameterKind

_FileName = Annotated[str, Field(min_length=1, max_length=400, pattern=r"^[^\x00]+$")]
_Factor = Annotated[float, Field(allow_inf_nan=False)]


class ControllerFormat(Enum):
    """How a controller's file is written."""

    YAML = "yaml"
    JSON = "json"
    XML = "xml"
    DCF = "dcf"


@dataclass(frozen=True, slots=True)
class GainObject:
    """Where a drive keeps its gain: number in the drive = gain × factor."""

    parameter: Parameter
    factor: float


@dataclass(frozen=True, slots=True)
class Controller:
    """Where the gains are written.

    Attributes:
        file: of the controller, relative to the cell file; None where they only go into the drives.
        gains: in it, key of each axis's number; none without a file.
        factors: number in the file = gain × factor, one for each of `gains`.
        format: of the file; None where its suffix tells.
        objects: in the drives, one for each axis; none where nothing is written there.
    """

    file: str | None
    gains: tuple[str, ...]
    factors: tuple[float, ...] = ()
    format: ControllerFormat | None = None
    objects: tuple[GainObject, ...] = ()


class GainKeyModel(StrictModel):
    """A key of a controller that keeps its gains in another unit, or with another sign."""

    key: _FileName
    factor: _Factor = 1.0


class GainObjectModel(StrictModel):
    """An object of a drive."""

    index: Annotated[int, Field(ge=0x1000, le=0xFFFF)]
    subindex: Annotated[int, Field(ge=0, le=0xFF)] = 0
    type: ParameterKind
    factor: _Factor = 1.0


_KEY, _KEY_AND_FACTOR = not_in_file("key"), not_in_file("key and factor")


def _entry_kind(value: object) -> str:
    return _KEY_AND_FACTOR if isinstance(value, dict | GainKeyModel) else _KEY


_Gain = Annotated[
    Annotated[_FileName, Tag(_KEY)] | Annotated[GainKeyModel, Tag(_KEY_AND_FACTOR)], Discriminator(_entry_kind)
]
"""A key alone, or {key: ..., factor: ...}."""


class ControllerModel(StrictModel):
    """`controller`."""

    file: _FileName | None = None
    format: ControllerFormat | None = None
    gains: tuple[_Gain, ...] = ()
    objects: tuple[GainObjectModel, ...] = ()

    @model_validator(mode="after")
    def _one_target_at_least(self) -> ControllerModel:
        if (self.file is None) != (not self.gains) or (self.file is None and not self.objects):
            raise ValueError("file and gains of the controller, objects of the drives, or all three")
        if self.file is None and self.format is not None:
            raise ValueError("format only beside file")
        return self

    @property
    def controller(self) -> Controller:
        """As the write-back takes it."""
        gain_entry = tuple(gain if isinstance(gain, GainKeyModel) else GainKeyModel(key=gain) for gain in self.gains)
        return Controller(
            file=self.file,
            gains=tuple(gain.key for gain in gain_entry),
            factors=tuple(gain.factor for gain in gain_entry),
            format=self.format,
            objects=tuple(
                GainObject(Parameter(gain_entry.index, gain_entry.subindex, gain_entry.type), gain_entry.factor)
                for gain_entry in self.objects
            ),
        )


def controller_faults(model: ControllerModel, axes: int, *, on_a_bus: bool) -> Iterator[Fault]:
    """What is well-formed and fits no cell of so many axes.

    Args:
        model: of the cell file.
        axes: how many.
        on_a_bus: whether every axis has a node id and a drive profile.
    """
    if model.gains and len(model.gains) != axes:
        yield Fault(("controller", "gains"), f"{len(model.gains)} keys", f"{axes}, one for each axis")
    if model.objects and len(model.objects) != axes:
        yield Fault(("controller", "objects"), f"{len(model.objects)} objects", f"{axes}, one for each axis")
    if model.objects and not on_a_bus:
        yield Fault(
            ("controller", "objects"),
            "objects of drives that no bus leads to",
            "bus, and node_id and drive of each axis",
        )
    factors = [(("gains", i), entry.factor) for i, entry in enumerate(model.gains) if isinstance(entry, GainKeyModel)]
    factors += [(("objects", i), entry.factor) for i, entry in enumerate(model.objects)]
    for (kind, index), factor in factors:
        if factor == 0.0 or not math.isfinite(factor):
            yield Fault(("controller", kind, index, "factor"), f"{factor:g}", "a factor that is not zero")
