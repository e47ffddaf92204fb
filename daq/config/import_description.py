"""An import description: the layout of the CSV files of another controller (configs/imports/tx40.yaml)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from daq.config.yaml_file import Fault, FileName, Name, StrictModel, describe, parse_yaml, read_bytes, read_model
from daq.errors import ConfigurationInconsistent

Column = Annotated[str, Field(min_length=1)] | Annotated[int, Field(ge=1)]
"""Name in the header, or number counted from 1."""
SomeColumns = Annotated[tuple[Column, ...], Field(min_length=1)]


class PositionUnit(Enum):
    """Unit of the position columns."""

    RAD = "rad"
    DEG = "deg"
    COUNTS = "counts"


class Side(Enum):
    """Side of the gears that the positions refer to: q_motor = R q_joint."""

    MOTOR = "motor"
    JOINT = "joint"


class TimeUnit(Enum):
    """Unit of the time column."""

    SECOND = "s"
    MILLISECOND = "ms"
    MICROSECOND = "us"
    NANOSECOND = "ns"

    @property
    def seconds(self) -> float:
        """The unit in seconds."""
        return {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[self.value]


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Layout of the files."""

    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ","  #: between fields; " " means any white space
    decimal: Annotated[str, Field(pattern=r"^[.,]$")] = "."  #: point or comma
    skip_rows: Annotated[int, Field(ge=0)] = 0  #: lines before the header
    header: bool = True  #: whether a line of names precedes the numbers

    @model_validator(mode="after")
    def _check_delimiter(self) -> Table:
        if self.delimiter == self.decimal:
            raise ValueError("a delimiter that is not the decimal sign")
        return self


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionColumns:
    """Position columns, one for each axis."""

    file: FileName
    columns: SomeColumns
    unit: PositionUnit
    side: Side


@dataclass(frozen=True, slots=True, kw_only=True)
class CurrentColumns:
    """Columns of the current-loop reference, one for each axis; numbers × factor are in the gains' unit."""

    file: FileName
    columns: SomeColumns
    unit: Annotated[str, Field(min_length=1)]
    factor: Annotated[float, Field(ge=-1e9, le=1e9)] = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeColumn:
    """The time column, instead of a rate."""

    file: FileName
    column: Column
    unit: TimeUnit


class ImportDescription(StrictModel):
    """A whole import description."""

    name: Name  #: name of the recording
    cell: FileName  #: cell file, relative to this one
    table: Table = Table()  #: layout of the files
    position: PositionColumns  #: column of the position
    current: CurrentColumns  #: column of the current
    rate_hz: Annotated[float, Field(ge=1.0, le=1e6)] | None = None  #: sampling rate [Hz]; either this or `time`
    time: TimeColumn | None = None  #: the time column, instead of a rate
    payload: Name | None = None  #: mounted payload, as named in the cell; None without load
    mounting: Name | None = None  #: its mounting, as named in the cell; None without load
    operator: str = ""  #: person who recorded it


def load_import(path: Path) -> ImportDescription:
    """Read an import description.

    Raises:
        ConfigurationError: the file is missing or wrong.
    """
    document = parse_yaml(read_bytes(path), str(path))
    wanted = read_model(document, ImportDescription)
    faults = []
    if wanted.rate_hz is not None and wanted.time is not None:
        faults.append(Fault(("time",), "both rate_hz and time", "one of them"))
    if wanted.rate_hz is None and wanted.time is None:
        faults.append(Fault(("rate_hz",), "neither rate_hz nor time", "one of them"))
    if wanted.position.unit is PositionUnit.COUNTS and wanted.position.side is Side.JOINT:
        expected = "motor; counts are of the motor encoder"
        faults.append(Fault(("position", "side"), "joint, with encoder counts", expected))
    if wanted.current.factor == 0.0:
        faults.append(Fault(("current", "factor"), "0", "the unit of the gain for each unit in the file"))
    if len(wanted.position.columns) != len(wanted.current.columns):
        found = f"{len(wanted.current.columns)} columns"
        faults.append(Fault(("current", "columns"), found, f"{len(wanted.position.columns)}, as many as of position"))
    named = [c for c in (*wanted.position.columns, *wanted.current.columns) if isinstance(c, str)]
    if named and not wanted.table.header:
        faults.append(Fault(("table", "header"), f"false, and column {named[0]!r} by name", "column numbers from 1"))
    if faults:
        raise ConfigurationInconsistent(**describe(document, faults), remedy="correct the import description")
    return wanted
