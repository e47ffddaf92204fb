"""An import description: the layout of the files of another controller
(configs/imports/tx40.yaml).
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from math import inf
from pathlib import Path
from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from daq.config.yaml_file import (
    DocumentKind,
    Fault,
    FileName,
    Name,
    StrictModel,
    fault_texts,
    parse_yaml,
    read_model,
    read_yaml_bytes,
)
from daq.errors import ConfigurationInconsistent, counted

Column = Annotated[str, Field(min_length=1)] | Annotated[int, Field(ge=1)]
"""Name in the header, or number counted from 1."""
RATES_HZ = (1.0, 1e6)  #: Least and largest sampling rate, stated or by the stamps
Rate = Annotated[float, Field(ge=RATES_HZ[0], le=RATES_HZ[1])]
UnitName = Annotated[str, Field(min_length=1)]
Factor = Annotated[float, Field(ge=-1e9, le=1e9)]
SMALLEST_FACTOR = 1e-9
Topic = Annotated[str, Field(min_length=1)]
SomeColumns = Annotated[tuple[Column, ...], Field(min_length=1)]


class PositionUnit(Enum):
    """Unit of the position columns; `rad` and `deg` are m and mm for the prismatic axes of a robot
    that has both.
    """

    RAD = "rad"
    DEG = "deg"
    M = "m"
    MM = "mm"
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
    ISO_8601 = "iso8601"  #: Date and time with a zone: 2026-03-01T08:00:00.004+01:00
    CLOCK = "clock"  #: Time of day, with a date before it or not, without a zone: 08:00:00.004

    @property
    def digits(self) -> int:
        """Decimal digits below a second: 3 for milliseconds."""
        return {"s": 0, "ms": 3, "us": 6, "ns": 9, "iso8601": 0, "clock": 0}[self.value]

    @property
    def is_text(self) -> bool:
        """Whether a stamp is a text, not a number."""
        return self in {TimeUnit.ISO_8601, TimeUnit.CLOCK}

    @property
    def seconds(self) -> float:
        """The unit in seconds."""
        return 10.0**-self.digits


@dataclass(frozen=True, slots=True, kw_only=True)
class CsvLayout:
    """Layout of CSV files."""

    #: between fields; " " means any white space
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ","
    decimal: Annotated[str, Field(pattern=r"^[.,]$")] = "."  #: point or comma
    skip_rows: Annotated[int, Field(ge=0)] = 0  #: lines before the header
    header: bool = True  #: whether a line of names precedes the numbers
    #: Begin of lines among the rows that are left out; before and after the rows, #, % and // are
    #: known.
    comment: Annotated[str, Field(min_length=1, max_length=4)] | None = None

    @model_validator(mode="after")
    def _check_delimiter(self) -> CsvLayout:
        if self.delimiter == self.decimal:
            raise ValueError("a delimiter that is not the decimal sign")
        delimiter = self.delimiter
        is_of_text = delimiter.isalnum() or delimiter in "\"'+-._"
        is_control = not delimiter.isprintable() and delimiter != "\t"
        if is_of_text or is_control:
            raise ValueError("a delimiter that no number or name has, as , ; | or a tab")
        first = "#" if self.comment is None else self.comment[0]
        if first in "+-.," or first.isspace() or first.isdigit():
            raise ValueError("a comment that begins as no number does, as #")
        return self


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """Columns of a quantity, one for each axis."""

    #: One file, or one for each axis; their rows belong together.
    file: FileName | Annotated[tuple[FileName, ...], Field(min_length=1)]
    columns: SomeColumns  #: one column of several files has the same name in each

    @property
    def places(self) -> tuple[tuple[str, Column], ...]:
        """File and column of each axis."""
        if isinstance(self.file, str):
            return tuple((self.file, column) for column in self.columns)
        columns = self.columns * len(self.file) if len(self.columns) == 1 else self.columns
        return tuple(zip(self.file, columns, strict=True))

    @property
    def files(self) -> tuple[str, ...]:
        """The files, each once."""
        return (self.file,) if isinstance(self.file, str) else tuple(dict.fromkeys(self.file))

    @model_validator(mode="after")
    def _check_files(self) -> Self:
        if isinstance(self.file, tuple) and len(self.columns) not in {1, len(self.file)}:
            raise ValueError(
                "as many files as columns, or one column of the same name in each file"
            )
        return self


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedColumns(Section):
    """Columns of a quantity that a bag has, too."""

    #: topic of these columns in a bag; that of the description by default
    topic: Topic | None = None
    #: their publisher; that of the description by default
    publisher: Annotated[int, Field(ge=1)] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionColumns(PublishedColumns):
    """Position columns, one for each axis."""

    unit: PositionUnit
    side: Side
    reversed: tuple[Name, ...] = ()  #: axes whose positions in the file count the other way


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaledColumns(PublishedColumns):
    """Columns of a quantity, one for each axis, and the factor to its unit."""

    #: One for all axes, a list in their order, or a mapping from their names.
    factor: Factor | Annotated[tuple[Factor, ...], Field(min_length=1)] | dict[Name, Factor] = 1.0

    @property
    def stated_factors(self) -> tuple[float, ...]:
        """The factors as they are written, one of all axes alone."""
        if isinstance(self.factor, float):
            return (self.factor,)
        return tuple(self.factor.values()) if isinstance(self.factor, dict) else self.factor

    def factors(self, axes: Sequence[str]) -> tuple[float, ...] | None:
        """Return the factor of each axis; None if other axes have one."""
        if isinstance(self.factor, float):
            return (self.factor,) * len(axes)
        if isinstance(self.factor, dict):
            return (
                tuple(self.factor[axis] for axis in axes)
                if self.factor.keys() == set(axes)
                else None
            )
        return self.factor if len(self.factor) == len(axes) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class CurrentColumns(ScaledColumns):
    """Columns of the current-loop reference; numbers × factor are in the gains' unit."""

    #: One for all axes, a list in their order, or a mapping from their names.
    unit: UnitName | Annotated[tuple[UnitName, ...], Field(min_length=1)] | dict[Name, UnitName]

    def units(self, axes: Sequence[str]) -> tuple[str, ...] | None:
        """Return the unit of each axis; None if other axes have one."""
        if isinstance(self.unit, str):
            return (self.unit,) * len(axes)
        if isinstance(self.unit, dict):
            return (
                tuple(self.unit[axis] for axis in axes) if self.unit.keys() == set(axes) else None
            )
        return self.unit if len(self.unit) == len(axes) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class TorqueColumns(ScaledColumns):
    """Columns of the controller's own torque, for a comparison with the gains;
    numbers × factor are Nm (or N).
    """

    side: Side


@dataclass(frozen=True, slots=True, kw_only=True)
class TemperatureColumns(Section):
    """Columns of the temperature of each motor or its drive [°C]."""


class VelocityUnit(Enum):
    """Unit of the velocity columns, as PositionUnit."""

    RAD = "rad/s"
    DEG = "deg/s"
    M = "m/s"
    MM = "mm/s"


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityColumns(PublishedColumns):
    """Velocity columns, one for each axis: a check of the positions and the time; not imported."""

    unit: VelocityUnit
    side: Side
    reversed: tuple[Name, ...] = ()  #: as of the positions
    #: Largest difference between the way by the velocities and by the positions, as a share of the
    #: latter.
    tolerance: Annotated[float, Field(gt=0.0, le=1.0)] = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeColumn:
    """The time column, instead of a rate: a stamp is the time of its sample."""

    file: FileName
    column: Column
    unit: TimeUnit
    rate_hz: Rate | None = None  #: rate to resample to [Hz]; that of the stamps by default
    #: Longest step that is interpolated, in usual steps; a longer one is a gap, and refused.
    largest_gap_periods: Annotated[float, Field(ge=1.5, le=100.0)] = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptPart:
    """Part of a recording that is imported: rows of numbers, counted from 1,
    or seconds since the first of them.
    """

    from_row: Annotated[int, Field(ge=1)] | None = None  #: first row
    to_row: Annotated[int, Field(ge=1)] | None = None  #: last row
    from_s: Annotated[float, Field(ge=0.0, le=1e9)] | None = None  #: begin
    to_s: Annotated[float, Field(ge=0.0, le=1e9)] | None = None  #: end

    @property
    def is_by_time(self) -> bool:
        """Whether times are stated."""
        return self.from_s is not None or self.to_s is not None

    @property
    def is_by_row(self) -> bool:
        """Whether rows are stated."""
        return self.from_row is not None or self.to_row is not None

    @property
    def rows(self) -> slice:
        """The rows, counted from 0; all of them where only times are stated."""
        return slice((self.from_row or 1) - 1, self.to_row)

    @model_validator(mode="after")
    def _check_ends(self) -> KeptPart:
        if self.is_by_time and self.is_by_row:
            raise ValueError("rows or times, not both")
        last_row = self.to_row or sys.maxsize
        last_s = inf if self.to_s is None else self.to_s
        if (self.from_row or 1) > last_row or (self.from_s or 0.0) >= last_s:
            raise ValueError("a begin before the end")
        return self


@dataclass(frozen=True, slots=True, kw_only=True)
class HoldoutPart:
    """End of a recording that becomes a log of its own, for the final error of a fit."""

    #: its begin, since the first sample that is imported [s]
    from_s: Annotated[float, Field(gt=0.0, le=1e9)]


class ImportDescription(StrictModel):
    """A whole import description."""

    reference: ClassVar[str] = "schemas.md"
    document_kind: ClassVar[DocumentKind | None] = DocumentKind.IMPORT

    name: Name  #: name of the recording
    cell: FileName  #: cell file, relative to this one
    table: CsvLayout = CsvLayout()  #: layout of CSV files
    position: PositionColumns  #: column of the position
    current: CurrentColumns  #: column of the current
    velocity: VelocityColumns | None = None  #: columns of the velocity, for a check alone
    #: columns of the controller's own torque, for a comparison alone
    torque: TorqueColumns | None = None
    temperature: TemperatureColumns | None = None  #: columns of the temperature
    rate_hz: Rate | None = None  #: sampling rate [Hz]; either this or `time`
    time: TimeColumn | None = None  #: the time column, instead of a rate
    keep: KeptPart | None = None  #: part of the recording that is imported; all of it by default
    holdout: HoldoutPart | None = None  #: end of it that becomes a second log
    #: topic of the joint states in a ROS 2 bag; needed if it has several
    topic: Topic | None = None
    #: Which publisher of that topic, by the number that an import names; needed if several publish
    #: the same joints.
    publisher: Annotated[int, Field(ge=1)] | None = None
    #: Which of two even rows of stamps in a bag; needed if nothing else tells two publishers apart.
    rhythm: Annotated[int, Field(ge=1, le=2)] | None = None
    payload: Name | None = None  #: mounted payload, as named in the cell; None without load
    mounting: Name | None = None  #: its mounting, as named in the cell; None without load
    operator: str = ""  #: person who recorded it

    def sections(self) -> tuple[tuple[str, Section], ...]:
        """Return the sections with a column for each axis, by their keys."""
        stated = (
            (key, getattr(self, key))
            for key in ("position", "current", "velocity", "torque", "temperature")
        )
        return tuple((key, section) for key, section in stated if section is not None)

    def published(self) -> tuple[PublishedColumns, ...]:
        """Return the sections that a bag may have."""
        stated = (self.position, self.current, self.velocity, self.torque)
        return tuple(section for section in stated if section is not None)

    def files(self) -> dict[str, tuple[Column, ...]]:
        """Return the files, each with its columns of numbers; the time column is not among them."""
        columns: dict[str, dict[Column, None]] = {}
        for _, section in self.sections():
            for file, column in section.places:
                columns.setdefault(file, {})[column] = None
        if self.time is not None:
            columns.setdefault(self.time.file, {})
        return {file: tuple(found) for file, found in columns.items()}


def load_import(path: Path) -> ImportDescription:
    """Read an import description.

    Raises:
        ConfigurationError: the file is missing or wrong.
    """
    document = parse_yaml(read_yaml_bytes(path), str(path))
    wanted = read_model(document, ImportDescription)
    faults = []
    if wanted.rate_hz is not None and wanted.time is not None:
        faults.append(Fault(("time",), "both rate_hz and time", "one of them"))
    if wanted.rate_hz is None and wanted.time is None:
        faults.append(Fault(("rate_hz",), "neither rate_hz nor time", "one of them"))
    if wanted.position.unit is PositionUnit.COUNTS and wanted.position.side is Side.JOINT:
        expected = "motor; counts are of the motor encoder"
        faults.append(Fault(("position", "side"), "joint, with encoder counts", expected))
    if wanted.mounting is not None and wanted.payload is None:
        expected = "`payload` with it, or neither"
        faults.append(Fault(("mounting",), f"{wanted.mounting!r} without `payload`", expected))
    axes = len(wanted.position.places)
    for name, section in wanted.sections():
        factors = section.stated_factors if isinstance(section, ScaledColumns) else ()
        if any(abs(one) < SMALLEST_FACTOR for one in factors):
            expected = (
                f"the unit of the log for each unit in the file, at least {SMALLEST_FACTOR:g}"
            )
            faults.append(Fault((name, "factor"), f"{min(factors, key=abs):g}", expected))
        reversed_axes = Counter(getattr(section, "reversed", ()))
        repeated = [axis for axis, count in reversed_axes.items() if count > 1]
        if repeated:
            found = f"{', '.join(repeated)} more than once"
            faults.append(Fault((name, "reversed"), found, "each axis once"))
        # One name may be a whole matrix or field (daq.log.importing.with_columns); then the import
        # counts.
        own = len(section.places)
        if own != axes and 1 not in {axes, own}:
            found = counted(own, "column")
            faults.append(Fault((name, "columns"), found, f"{axes}, as many as of position"))
    columns: list[object] = []
    for of_file in wanted.files().values():
        columns += of_file
    if wanted.time is not None:
        columns.append(wanted.time.column)
    named = [column for column in columns if isinstance(column, str)]
    if named and not wanted.table.header:
        found = f"false, and column {named[0]!r} by name"
        faults.append(Fault(("table", "header"), found, "column numbers from 1"))
    if faults:
        raise ConfigurationInconsistent(
            **fault_texts(document, faults), remedy="correct the import description"
        )
    return wanted
