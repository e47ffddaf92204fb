"""Units that a CSV file states for its columns, in a line below the header or in the names,
against the description.

A unit is a kind of quantity and a scale. Two units contradict each other where both are known and
the kind or the scale differ; a unit that is not known says nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import pi
from pathlib import Path

from daq.config.import_description import (
    Column,
    ImportDescription,
    ScaledColumns,
    Section,
    TimeColumn,
)
from daq.errors import TableUnfit

NEAR_FACTOR = 10.0
"""Largest ratio of a factor to that of its two units:
it may hold a gauge's scale, or that of rms to amplitude.
"""
_IN_BRACKETS = re.compile(r"\[([^\[\]]+)\]\s*$")


@dataclass(frozen=True, slots=True)
class ColumnUnit:
    """A unit of a column."""

    kind: str  #: of the quantity, for messages
    scale: float  #: in the kind's first unit


_RAD = ColumnUnit("angle", 1.0)
_DEG = ColumnUnit("angle", pi / 180.0)
_RAD_S = ColumnUnit("angular velocity", 1.0)
_DEG_S = ColumnUnit("angular velocity", pi / 180.0)
_RPM = ColumnUnit("angular velocity", pi / 30.0)
_MICROSECOND = ColumnUnit("time", 1e-6)
_AMPERE = ColumnUnit("current", 1.0)
_NM = ColumnUnit("torque", 1.0)
_COUNT = ColumnUnit("counts", 1.0)
_CELSIUS = ColumnUnit("temperature", 1.0)
_FAHRENHEIT = ColumnUnit("temperature in °F", 1.0)
UNITS = {
    "rad": _RAD,
    "deg": _DEG,
    "°": _DEG,
    "m": ColumnUnit("length", 1.0),
    "mm": ColumnUnit("length", 1e-3),
    "rad/s": _RAD_S,
    "deg/s": _DEG_S,
    "°/s": _DEG_S,
    "rpm": _RPM,
    "1/min": _RPM,
    "m/s": ColumnUnit("velocity", 1.0),
    "mm/s": ColumnUnit("velocity", 1e-3),
    "rad/s^2": ColumnUnit("angular acceleration", 1.0),
    "s": ColumnUnit("time", 1.0),
    "sec": ColumnUnit("time", 1.0),
    "ms": ColumnUnit("time", 1e-3),
    "us": _MICROSECOND,
    "\u00b5s": _MICROSECOND,
    "\u03bcs": _MICROSECOND,
    "ns": ColumnUnit("time", 1e-9),
    "a": _AMPERE,
    "arms": _AMPERE,
    "ma": ColumnUnit("current", 1e-3),
    "nm": _NM,
    "n.m": _NM,
    "n·m": _NM,
    "n*m": _NM,
    "mnm": ColumnUnit("torque", 1e-3),
    "n": ColumnUnit("force", 1.0),
    "kn": ColumnUnit("force", 1e3),
    "v": ColumnUnit("voltage", 1.0),
    "mv": ColumnUnit("voltage", 1e-3),
    "%": ColumnUnit("share", 1e-2),
    "‰": ColumnUnit("share", 1e-3),
    "counts": _COUNT,
    "count": _COUNT,
    "inc": _COUNT,
    "incr": _COUNT,
    "ticks": _COUNT,
    "c": _CELSIUS,
    "°c": _CELSIUS,
    "degc": _CELSIUS,
    "°f": _FAHRENHEIT,
    "degf": _FAHRENHEIT,
    "k": ColumnUnit("absolute temperature", 1.0),
    "w": ColumnUnit("power", 1.0),
    "hz": ColumnUnit("frequency", 1.0),
}
"""Known units in lower case.

Effective and peak amperes are the same here: few files tell which they hold.
"""
TWINS = {"rad": "m", "deg": "mm", "rad/s": "m/s", "deg/s": "mm/s"}
"""Unit of the prismatic axes of a robot that has both, by that of the description."""


def column_unit_of(text: str) -> ColumnUnit | None:
    """Return the unit that a field is, with brackets or without; None if it is not known."""
    return UNITS.get(bare_unit(text).lower())


def bare_unit(field: str) -> str:
    """Return a unit without brackets and space."""
    return field.strip(" []()<>{}").replace(" ", "")


@dataclass(frozen=True, slots=True)
class Expected:
    """What the description says of a column."""

    key: str  #: of the section
    column: Column
    texts: tuple[str, ...]  #: units that the numbers, times the factor, may have
    factor: float | None  #: None where the section has none


def expected_units(
    path: Path, wanted: ImportDescription, time: TimeColumn | None
) -> Iterator[Expected]:
    """Yield the columns of a file that have a unit by the description.

    Args:
        path: of the file.
        wanted: with units and factors in the order of the axes, or one for all.
        time: the time column, if it is in this file.
    """
    if time is not None and not time.unit.is_text:
        yield Expected("time", time.column, (time.unit.value,), None)
    position = wanted.position.unit.value
    for _, column in _columns_here(path, wanted.position):
        yield Expected("position", column, _with_twin(position), None)
    if wanted.velocity is not None:
        velocity = wanted.velocity.unit.value
        for _, column in _columns_here(path, wanted.velocity):
            yield Expected("velocity", column, _with_twin(velocity), None)
    for axis, column in _columns_here(path, wanted.current):
        text = wanted.current.unit
        if isinstance(text, tuple) and axis < len(text):
            text = text[axis]
        if isinstance(text, str):
            yield Expected("current", column, (text,), _factor_of(wanted.current, axis))
    if wanted.torque is not None:
        for axis, column in _columns_here(path, wanted.torque):
            factor = _factor_of(wanted.torque, axis)
            yield Expected("torque", column, ("Nm", "N"), factor)
    if wanted.temperature is not None:
        for _, column in _columns_here(path, wanted.temperature):
            yield Expected("temperature", column, ("°C",), None)


def _with_twin(unit: str) -> tuple[str, ...]:
    if unit in TWINS:
        return (unit, TWINS[unit])
    return (unit,)


def _factor_of(section: ScaledColumns, axis: int) -> float | None:
    """Return the factor of an axis; None where it is stated by names,
    which the file does not have.
    """
    factor = section.factor
    if isinstance(factor, float):
        return factor
    if isinstance(factor, tuple) and axis < len(factor):
        return factor[axis]
    return None


def _columns_here(path: Path, section: Section) -> list[tuple[int, Column]]:
    """Return number and column of each axis with numbers in this file."""
    found = []
    for axis, (name, column) in enumerate(section.places):
        parts = Path(name).parts
        if parts == path.parts[-len(parts) :]:
            found.append((axis, column))
    return found


def check_unit(place: str, stated: str, expected: Expected, *, in_name: bool = False) -> None:
    """Refuse a unit in a file that contradicts the import description.

    Args:
        place: of the unit, for messages.
        stated: the unit in the file.
        expected: what the description says of the column.
        in_name: it is in the column's name, where letters may mean something else than a quantity
            of another kind.

    Raises:
        TableUnfit: both units are known, and they contradict each other.
    """
    unit = column_unit_of(stated)
    if unit is None:
        return
    allowed = []
    for text in expected.texts:
        allowed_unit = column_unit_of(text)
        if allowed_unit is None:
            return
        allowed.append(allowed_unit)
    kinds = {allowed_unit.kind for allowed_unit in allowed}
    if in_name and unit.kind not in kinds:
        return
    if any(_agree(unit, allowed_unit, expected) for allowed_unit in allowed):
        return
    by_factor = ""
    corrections = f"the unit of `{expected.key}`"
    if expected.factor is not None:
        by_factor = f", with the factor {expected.factor:g}"
        corrections = f"the unit or `factor` of `{expected.key}`"
    place_of_unit = "the name of the column" if in_name else "the line of units"
    if expected.key in {"torque", "temperature"}:
        corrections = f"`{expected.key}`"
    raise TableUnfit(
        place,
        found=f"unit {bare_unit(stated)!r} in {place_of_unit}",
        expected=f"{expected.texts[0]!r}, the unit of `{expected.key}` in the import "
        f"description{by_factor}",
        remedy=f"if the file is right, correct {corrections} or the column there; if not, correct "
        "the unit in the file",
    )


def _agree(unit: ColumnUnit, described: ColumnUnit, expected: Expected) -> bool:
    """Whether a column may have a unit, under a factor that may convert it."""
    factor = 1.0 if expected.factor is None else abs(expected.factor)
    if factor == 1.0:
        return unit == described
    if unit.kind != described.kind:
        return True  # as % or Nm that the factor makes A
    ratio = factor * described.scale / unit.scale
    return 1.0 / NEAR_FACTOR <= ratio <= NEAR_FACTOR


def name_unit(name: str) -> str | None:
    """Return what is in square brackets at the end of a column's name; None without them."""
    match = _IN_BRACKETS.search(name)
    if match is None:
        return None
    return match[1]


def check_units(
    place: str,
    fields: Sequence[str] | None,
    names: Sequence[str],
    expected: Sequence[Expected],
) -> None:
    """Refuse units in a file that contradict the import description.

    Args:
        place: of the line of units, or of the header without one.
        fields: of the line of units; None without one.
        names: of the columns.
        expected: what the description says of the columns.

    Raises:
        TableUnfit: a unit contradicts the description, or the line of units the name of its column.
    """
    for one in expected:
        index = _index(one.column, names)
        if index is None:
            continue
        at = f"{place}, column {one.column}"
        in_name = name_unit(names[index])
        if fields is not None:
            check_unit(at, fields[index], one)
            if in_name is not None:
                _require_alike(at, fields[index], in_name)
        elif in_name is not None:
            check_unit(at, in_name, one, in_name=True)


def _require_alike(place: str, in_line: str, in_name: str) -> None:
    """Refuse a unit in the line of units that differs from one of the same quantity in the column's
    name.

    Letters in a name may mean something else than a quantity of another kind.
    """
    stated = column_unit_of(in_line)
    named = column_unit_of(in_name)
    if stated is None or named is None:
        return
    if stated.kind != named.kind or stated == named:
        return
    raise TableUnfit(
        place,
        found=f"unit {bare_unit(in_line)!r} in the line of units, and {bare_unit(in_name)!r} in "
        "the name of the column",
        expected="one unit of a column",
        remedy="correct the one that is wrong in the file",
    )


def _index(column: Column, names: Sequence[str]) -> int | None:
    if isinstance(column, int):
        if column <= len(names):
            return column - 1
    elif column in names:
        return names.index(column)
    return None
