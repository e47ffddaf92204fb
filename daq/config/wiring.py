"""The part of a cell file that finds its drives: buses, node ids, identities and profiles.

`scan` is how the drives of a new cell are found, so a number that is missing or wrong elsewhere
must not keep it from them. Where a cell file is refused, its wiring is read by itself, axis by
axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, field_validator

from daq.config.cell import Bus, Cell
from daq.config.cell_file import drive_path, load_cell
from daq.config.cell_schema import Buses, buses_of
from daq.config.drive import drive_from_text
from daq.config.yaml_file import Name, StrictModel, parse_yaml, read_model, read_yaml_bytes
from daq.errors import ConfigurationError
from drivers.profiles.profile import DriveProfile, Identity


@dataclass(frozen=True, slots=True)
class AxisWiring:
    """One amplifier, as far as the cell file says where it is."""

    name: str
    node_id: int
    bus: str
    identity: Identity | None  #: None where the file has none that can be compared
    profile: DriveProfile | None  #: None where it cannot be used
    profile_fault: str  #: why it cannot; empty where it can


@dataclass(frozen=True, slots=True)
class Wiring:
    """Buses and amplifiers of a cell file whose other content may be wrong."""

    name: str
    buses: tuple[Bus, ...]
    axes: tuple[AxisWiring, ...]  #: without those whose bus or node id is not known
    #: why every other verb refuses the file, apart from the profiles; empty where none does
    fault: str


class _Lenient(StrictModel):
    """A section of which only some keys are read."""

    model_config = ConfigDict(extra="ignore")


class _AxisModel(_Lenient):
    """One axis. A value that is wrong here costs this axis, not the others."""

    name: Name
    node_id: Any = None
    bus: Any = None
    drive: Any = None
    identity: Any = None


class _WiringModel(_Lenient):
    """A cell file, of which only buses and axes are read."""

    name: Name
    bus: Buses
    axes: tuple[_AxisModel, ...] = Field(min_length=1)

    @field_validator("axes")
    @classmethod
    def _check_nodes(cls, axes: tuple[_AxisModel, ...]) -> tuple[_AxisModel, ...]:
        if not any(_is_node_id(axis.node_id) for axis in axes):
            raise ValueError("an axis with a node_id of 1 to 127")
        return axes


def read_wiring(path: Path) -> tuple[Wiring, Cell | None]:
    """Read the wiring of a cell file, and the cell where the file is right.

    Raises:
        ConfigurationError: of the file, where not even its wiring can be read.
    """
    try:
        cell = load_cell(path)
    except ConfigurationError as error:
        return _wiring_alone(path, error), None
    axes = [
        AxisWiring(axis.name, axis.node_id, axis.bus, axis.identity, axis.profile, "")
        for axis in cell.axes
        if axis.node_id is not None and axis.bus is not None
    ]
    return Wiring(cell.name, cell.buses, tuple(axes), ""), cell


def _wiring_alone(path: Path, refused: ConfigurationError) -> Wiring:
    """Read the wiring of a file that is refused.

    Raises:
        ConfigurationError: the refusal, where the wiring cannot be read either.
    """
    try:
        model = read_model(parse_yaml(read_yaml_bytes(path), str(path)), _WiringModel)
    except ConfigurationError:
        raise refused from None
    buses = buses_of(model.bus)
    names = [bus.name for bus in buses]
    axes = list[AxisWiring]()
    taken = set[int]()
    for axis in model.axes:
        if axis.bus is None and len(names) == 1:
            bus = names[0]
        else:
            bus = axis.bus
        if bus not in names or not _is_node_id(axis.node_id) or axis.node_id in taken:
            continue  # the refusal names it
        taken.add(axis.node_id)
        profile, fault = _profile_of(path, axis.drive)
        identity = _identity_of(axis.identity)
        axes.append(AxisWiring(axis.name, axis.node_id, bus, identity, profile, fault))
    of_profile = str(refused) in {axis.profile_fault for axis in axes}
    return Wiring(model.name, buses, tuple(axes), "" if of_profile else str(refused))


def _is_node_id(value: Any) -> bool:
    if not isinstance(value, int) or isinstance(value, bool):
        return False
    return 1 <= value <= 127


def _identity_of(value: Any) -> Identity | None:
    try:
        return TypeAdapter(Identity).validate_python(value)
    except ValidationError:
        return None


def _profile_of(cell_file: Path, drive: Any) -> tuple[DriveProfile | None, str]:
    """Return the profile of a drive, or why it cannot be used."""
    if not isinstance(drive, str) or not drive:
        return None, "its `drive` names no profile, so its current and position are not known"
    try:
        path = drive_path(cell_file.parent, drive)
        return drive_from_text(read_yaml_bytes(path), str(path)), ""
    except ConfigurationError as error:
        return None, str(error)
