"""An import description: how the CSV files of another controller are to be read (configs/imports/tx40.yaml)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from daq.config.cell_schema import FileName, Name
from daq.config.yaml_file import Document, Fault, StrictModel, describe, parse_yaml, read_bytes, read_model
from daq.errors import ConfigurationInconsistent


class PositionUnit(Enum):
    """Of the numbers in the position columns."""

    RAD = "rad"
    DEG = "deg"
    COUNTS = "counts"


class Side(Enum):
    """On which side of the gears the positions are: q_motor = R q_joint."""

    MOTOR = "motor"
    JOINT = "joint"


class TimeUnit(Enum):
    """Of the numbers in the time column."""

    SECOND = "s"
    MILLISECOND = "ms"
    MICROSECOND = "us"
    NANOSECOND = "ns"

    @property
    def seconds(self) -> float:
        """The unit in seconds."""
        return {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[self.value]


Column = Annotated[str, Field(min_length=1)] | Annotated[int, Field(ge=1)]
"""Name in the header, or number counted from 1."""


@dataclass(frozen=True, slots=True)
class Columns:
    """Some columns of one file, one an axis, by header name or by number from 1."""

    file: str
    columns: tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class TimeColumn:
    """Where the time stands, instead of a rate."""

    columns: Columns
    unit: TimeUnit


@dataclass(frozen=True, slots=True)
class Table:
    """How the files are laid out.

    Attributes:
        delimiter: between fields; " " stands for any white space.
        decimal: point or comma.
        skip_rows: lines before the header.
        header: whether a line of names comes before the numbers.
    """

    delimiter: str
    decimal: str
    skip_rows: int
    header: bool


@dataclass(frozen=True, slots=True)
class ImportDescription:
    """A whole import description.

    Attributes:
        name: of the recording.
        cell: path of the cell file.
        table: layout of the files.
        position, position_unit, side: joint or motor positions.
        current, current_unit, current_factor: the current-loop reference; numbers × factor are in the unit, which is
            the one of the cell's gains.
        rate: samples a second, or the column that tells it.
        payload, mounting: name of what was mounted and how, as in the cell; None without load.
        operator: who recorded it.
    """

    name: str
    cell: Path
    table: Table
    position: Columns
    position_unit: PositionUnit
    side: Side
    current: Columns
    current_unit: str
    current_factor: float
    rate: float | TimeColumn
    payload: str | None
    mounting: str | None
    operator: str


class TableModel(StrictModel):
    """Layout of the files."""

    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ","
    decimal: Annotated[str, Field(pattern=r"^[.,]$")] = "."
    skip_rows: Annotated[int, Field(ge=0)] = 0
    header: bool = True

    @model_validator(mode="after")
    def _distinct(self) -> TableModel:
        if self.delimiter == self.decimal:
            raise ValueError("a delimiter that is not the decimal sign")
        return self


class PositionModel(StrictModel):
    """The position columns."""

    file: FileName
    columns: Annotated[tuple[Column, ...], Field(min_length=1)]
    unit: PositionUnit
    side: Side


class CurrentModel(StrictModel):
    """The current columns."""

    file: FileName
    columns: Annotated[tuple[Column, ...], Field(min_length=1)]
    unit: Annotated[str, Field(min_length=1)]
    factor: Annotated[float, Field(ge=-1e9, le=1e9)] = 1.0


class TimeModel(StrictModel):
    """The time column."""

    file: FileName
    column: Column
    unit: TimeUnit


class ImportModel(StrictModel):
    """A whole import description."""

    name: Name
    cell: FileName
    table: TableModel = TableModel()
    position: PositionModel
    current: CurrentModel
    rate_hz: Annotated[float, Field(ge=1.0, le=1e6)] | None = None
    time: TimeModel | None = None
    payload: Name | None = None
    mounting: Name | None = None
    operator: str = ""


def load_import(path: Path) -> ImportDescription:
    """Read an import description.

    Raises:
        ConfigurationError: the file is missing or wrong.
    """
    document = parse_yaml(read_bytes(path), str(path))
    model = read_model(document, ImportModel)
    faults = _faults(model)
    if faults:
        raise ConfigurationInconsistent(**describe(document, faults), remedy="correct the import description")
    return ImportDescription(
        name=model.name,
        cell=path.parent / model.cell,
        table=Table(**model.table.model_dump()),
        position=Columns(model.position.file, model.position.columns),
        position_unit=model.position.unit,
        side=model.position.side,
        current=Columns(model.current.file, model.current.columns),
        current_unit=model.current.unit,
        current_factor=model.current.factor,
        rate=_rate(model, document),
        payload=model.payload,
        mounting=model.mounting,
        operator=model.operator,
    )


def _rate(model: ImportModel, document: Document) -> float | TimeColumn:
    if model.time is not None:
        return TimeColumn(Columns(model.time.file, (model.time.column,)), model.time.unit)
    if model.rate_hz is not None:
        return model.rate_hz
    faults = [Fault(("rate_hz",), "neither rate_hz nor time", "one of them")]
    raise ConfigurationInconsistent(**describe(document, faults), remedy="correct the import description")


def _faults(model: ImportModel) -> list[Fault]:
    faults = []
    if model.rate_hz is not None and model.time is not None:
        faults.append(Fault(("time",), "both rate_hz and time", "one of them"))
    if model.position.unit is PositionUnit.COUNTS and model.position.side is Side.JOINT:
        faults.append(
            Fault(("position", "side"), "joint, with encoder counts", "motor; counts are of the motor encoder")
        )
    if model.current.factor == 0.0:
        faults.append(Fault(("current", "factor"), "0", "the unit of the gain for each unit in the file"))
    if len(model.position.columns) != len(model.current.columns):
        found = f"{len(model.current.columns)} columns"
        faults.append(Fault(("current", "columns"), found, f"{len(model.position.columns)}, as many as of position"))
    named = [c for c in (*model.position.columns, *model.current.columns) if isinstance(c, str)]
    if named and not model.table.header:
        faults.append(Fault(("table", "header"), f"false, and column {named[0]!r} by name", "column numbers from 1"))
    return faults
