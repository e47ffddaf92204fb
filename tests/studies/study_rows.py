"""Units of work of a resumable study: each leaves a CSV file of its rows,
and is not done again while it is the same.

A row is a frozen dataclass of texts, numbers, flags and tuples of these. The files of all units
together are the study's table; pieces of a study run apart (`Shard`), and each ends at its time
(`work_off`).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Protocol, TypeVar, get_args, get_origin, get_type_hints

from daq.files import replace_file
from tests.studies.fingerprint import finish, is_finished

Row = TypeVar("Row")
SEPARATOR = "; "  #: Between the entries of a tuple
YES = "yes"  #: Of a flag that is set; "no" otherwise


class Unit(Protocol):
    """One piece of work that is done as a whole."""

    @property
    def name(self) -> str:
        """Name of its file."""
        ...


AnyUnit = TypeVar("AnyUnit", bound=Unit)


def to_csv(kind: type[Row], rows: Iterable[Row]) -> str:
    """Table of rows, one line a row under the names of their fields."""
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]  # a dataclass, which TypeVar cannot say
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        writer.writerow([_to_text(getattr(row, name)) for name in names])
    return text.getvalue()


def from_csv(kind: type[Row], text: str) -> tuple[Row, ...]:
    """Rows of a table that `to_csv` wrote."""
    hints = get_type_hints(kind)
    rows = []
    for line in csv.DictReader(io.StringIO(text)):
        values = {name: _from_text(hints[name], cell) for name, cell in line.items()}
        rows.append(kind(**values))
    return tuple(rows)


def with_tuples(document: dict[str, Any]) -> dict[str, Any]:
    """Fields of a row that was read back from JSON, with tuples in the place of lists."""
    fields_of_row: dict[str, Any] = {}
    for name, value in document.items():
        if isinstance(value, list):
            fields_of_row[name] = tuple(value)
        else:
            fields_of_row[name] = value
    return fields_of_row


def _to_text(value: object) -> str:
    if isinstance(value, tuple):
        return SEPARATOR.join(_to_text(entry) for entry in value)
    if isinstance(value, bool):
        return YES if value else "no"
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def _from_text(kind: Any, text: str) -> Any:
    if get_origin(kind) is tuple:
        entry = get_args(kind)[0]
        parts = text.split(SEPARATOR) if text else []
        return tuple(_from_text(entry, part) for part in parts)
    return text == YES if kind is bool else kind(text)


def rows_path(out: Path, unit: Unit) -> Path:
    """File of a unit's rows in the folder of a study."""
    return out / f"{unit.name}.csv"


def rows_of_unit(
    out: Path,
    unit: AnyUnit,
    kind: type[Row],
    fingerprint: str,
    make: Callable[[AnyUnit], Sequence[Row]],
) -> tuple[Row, ...]:
    """Rows of a unit, which is done unless its file is there with this fingerprint."""
    path = rows_path(out, unit)
    if not is_finished(path, fingerprint):
        out.mkdir(parents=True, exist_ok=True)
        content = to_csv(kind, make(unit)).encode()
        replace_file(path, content)
        finish(path, fingerprint)
    text = path.read_text(encoding="utf-8")
    return from_csv(kind, text)


def finished_rows(
    out: Path, units: Iterable[AnyUnit], kind: type[Row], fingerprint_of: Callable[[AnyUnit], str]
) -> tuple[Row, ...]:
    """Rows of all units that are done: a file of another fingerprint is of another state of the
    code.
    """
    rows: list[Row] = []
    for unit in units:
        path = rows_path(out, unit)
        if is_finished(path, fingerprint_of(unit)):
            text = path.read_text(encoding="utf-8")
            rows += from_csv(kind, text)
    return tuple(rows)


def work_off(
    units: Sequence[AnyUnit],
    do: Callable[[AnyUnit], str],
    minutes: float,
    clock_s: Callable[[], float],
    report_line: Callable[[str], None],
) -> int:
    """Do units one after the other; none is begun after so many minutes.

    Args:
        units: to do.
        do: does one, or finds it done; returns a line about it.
        minutes: after which no unit is begun.
        clock_s: seconds that pass.
        report_line: receives the line of each unit.

    Returns:
        number of units that were not begun.
    """
    end_s = clock_s() + 60.0 * minutes
    for number, unit in enumerate(units):
        if clock_s() >= end_s:
            return len(units) - number
        report_line(do(unit))
    return 0
