"""Whether the rows of a history are what drivegain wrote, as far as they tell of each other; no key guards them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from itertools import islice
from typing import Any

from daq.calibration_file import decode
from daq.errors import DaqError
from daq.history.entry import Acknowledgement, iso, logs_of, recorded_at, utc, zoned
from ident.calibration import Calibration

COLUMNS = (
    "created",
    "recorded",
    "logs",
    "entered",
    "cell",
    "configuration_sha256",
    "method",
    "software",
    "error_percent",
    "holdout_percent",
    "rows",
)
GAIN_COLUMNS = ("axis", "value", "std", "unit", "nameplate")


def columns_of(calibration: Calibration, digest: str, entered: datetime) -> dict[str, object]:
    """What the row of a calibration says, besides digest and document."""
    holdout, created = calibration.holdout_error_percent, utc(calibration.created, entered)
    told = (
        iso(created),
        iso(recorded_at(calibration, created)),
        logs_of(calibration, digest),
        iso(entered),
        calibration.cell,
        calibration.configuration_sha256,
        calibration.method,
        calibration.software,
        calibration.relative_error_percent.total,
        None if holdout is None else holdout.total,
        calibration.rows,
    )
    return dict(zip(COLUMNS, told, strict=True))


def gain_columns_of(calibration: Calibration) -> list[dict[str, object]]:
    """What the rows of its gains say, in the order of the axes."""
    return [{name: getattr(gain, name) for name in GAIN_COLUMNS} for gain in calibration.gains]


def calibration_flaws(calibrations: Sequence[tuple[Any, ...]], gains: Sequence[tuple[Any, ...]]) -> Iterator[str]:
    """Rows of calibrations that are not what their own document says, as sentences.

    Args:
        calibrations: digest, document, and `COLUMNS` of each.
        gains: digest of the calibration, and `GAIN_COLUMNS` of each.

    Raises:
        ValueError: a time is none.
    """
    rows_of: dict[str, list[tuple[Any, ...]]] = {}
    for digest, *gain in gains:
        rows_of.setdefault(digest, []).append(tuple(gain))
    for digest, document, *columns in calibrations:
        name = f"calibration {digest[:12]}…"
        stands = dict(zip(COLUMNS, columns, strict=True))
        entered = zoned(stands["entered"])
        try:
            calibration = decode(document.encode(), f"document of {name}")
        except DaqError as error:
            yield f"{name}: its document is {error.found}, expected {error.expected}"
            continue
        yield from _differences(f"row of {name}", stands, columns_of(calibration, digest, entered))
        expected = gain_columns_of(calibration)
        rows = [dict(zip(GAIN_COLUMNS, row, strict=True)) for row in rows_of.get(digest, [])]
        axes, wanted = ([row["axis"] for row in some] for some in (rows, expected))
        if axes != wanted:
            yield f"gains of {name}: found {_listed(axes)}, expected {_listed(wanted)} as its document says"
            continue
        for row, told in zip(rows, expected, strict=True):
            yield from _differences(f"gain of {row['axis']} in {name}", row, told)


def gap_flaws(table: str, there: set[int], last: int) -> Iterator[str]:
    """Rows that are missing: they are numbered from 1 without gaps, and none is ever taken away.

    Args:
        table: its name.
        there: numbers of its rows.
        last: number that was given last.
    """
    missing = list(islice((number for number in range(1, last + 1) if number not in there), 5))
    if missing:
        yield f"{table} {_listed(missing)}: found no such row, expected all from 1 to {last}"


def early_flaws(acknowledgements: Iterable[Acknowledgement]) -> Iterator[str]:
    """Acknowledgements that would silence an axis beforehand."""
    for noted in acknowledgements:
        if noted.since > noted.at:
            yield (
                f"acknowledgement of {noted.axis} at {iso(noted.at)}: found a baseline since {iso(noted.since)}, "
                "expected one that does not begin later than the acknowledgement itself"
            )


def _differences(name: str, stands: dict[str, Any], expected: dict[str, Any]) -> Iterator[str]:
    for column, told in expected.items():
        # SQLite has no NaN: it keeps NULL.
        wanted = None if isinstance(told, float) and math.isnan(told) else told
        if stands[column] != wanted:
            yield f"{name}: found {column} {stands[column]!r}, expected {wanted!r} as its document says"


def _listed(names: Iterable[object]) -> str:
    return ", ".join(map(str, names)) or "none"
