"""`controller` of a cell file: the controller file, the objects of the drives, or both,
that receive the gains.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Annotated

from pydantic import Discriminator, Field, Tag, model_validator

from daq.config.yaml_file import Fault, FileName, not_in_file
from drivers.profiles.profile import DriveParameter, ParameterKind

_Factor = Annotated[float, Field(allow_inf_nan=False)]


class ControllerFormat(Enum):
    """Format of a controller file."""

    YAML = "yaml"
    JSON = "json"
    XML = "xml"
    DCF = "dcf"


@dataclass(frozen=True, slots=True)
class GainKey:
    """Key of a current gain that is kept in another unit, or with another sign."""

    key: FileName  #: of the number in the file
    factor: _Factor = 1.0  #: number in the file = gain × factor


@dataclass(frozen=True, slots=True, kw_only=True)
class GainObject:
    """Object of a drive that holds its gain."""

    index: Annotated[int, Field(ge=0x1000, le=0xFFFF)]  #: of the object
    subindex: Annotated[int, Field(ge=0, le=0xFF)] = 0  #: of the object
    type: ParameterKind  #: how the drive holds the number
    factor: _Factor = 1.0  #: number in the drive = gain × factor

    @property
    def parameter(self) -> DriveParameter:
        """The object for `drivers`."""
        return DriveParameter(self.index, self.subindex, self.type)


_KEY = not_in_file("key")
_KEY_AND_FACTOR = not_in_file("key and factor")


def _entry_kind(value: object) -> str:
    if isinstance(value, dict | GainKey):
        return _KEY_AND_FACTOR
    return _KEY


_Gain = Annotated[
    Annotated[FileName, Tag(_KEY)] | Annotated[GainKey, Tag(_KEY_AND_FACTOR)],
    Discriminator(_entry_kind),
]
"""A key alone, or {key: ..., factor: ...}."""


@dataclass(frozen=True, slots=True)
class Controller:
    """Destination of the gains."""

    #: the controller file, relative to the cell file; None if only the drives are written
    file: FileName | None = None
    format: ControllerFormat | None = None  #: format of the file; None to derive it from the suffix
    #: key of each axis's current gain in the file; empty without a file
    gains: tuple[_Gain, ...] = ()
    #: Objects of the drives, one for each axis; empty if the drives are not written.
    objects: tuple[GainObject, ...] = ()

    @model_validator(mode="after")
    def _check_targets(self) -> Controller:
        if (self.file is None) != (not self.gains) or (self.file is None and not self.objects):
            raise ValueError(
                "file and gains of the controller, objects of the drives, or all three"
            )
        if self.file is None and self.format is not None:
            raise ValueError("format without file")
        return self

    @property
    def keys(self) -> tuple[str, ...]:
        """Key of each current gain in the file."""
        return tuple(gain.key if isinstance(gain, GainKey) else gain for gain in self.gains)

    @property
    def factors(self) -> tuple[float, ...]:
        """Factor of each gain: number in the file = gain × factor."""
        return tuple(gain.factor if isinstance(gain, GainKey) else 1.0 for gain in self.gains)


def controller_faults(section: Controller, axes: int, *, on_a_bus: bool) -> Iterator[Fault]:
    """Find keys and objects that do not match the axes, and factors of zero.

    Args:
        section: `controller` of the cell file.
        axes: number of axes.
        on_a_bus: whether every axis has a node id and a drive profile.
    """
    if section.gains and len(section.gains) != axes:
        found = f"{len(section.gains)} keys"
        yield Fault(("controller", "gains"), found, f"{axes}, one for each axis")
    if section.objects and len(section.objects) != axes:
        found = f"{len(section.objects)} objects"
        yield Fault(("controller", "objects"), found, f"{axes}, one for each axis")
    if section.objects and not on_a_bus:
        expected = "bus, and node_id and drive of each axis"
        yield Fault(("controller", "objects"), "objects of drives that no bus leads to", expected)
    factors = {
        "gains": section.factors,
        "objects": tuple(entry.factor for entry in section.objects),
    }
    for kind, values in factors.items():
        for index, factor in enumerate(values):
            if factor == 0.0 or not math.isfinite(factor):
                path = ("controller", kind, index, "factor")
                yield Fault(path, f"{factor:g}", "a factor that is not zero")
