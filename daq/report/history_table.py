"""The history as rows of numbers: one a gain of a calibration, for spreadsheets and for --json."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

from daq.history.watch import Series
from daq.report.spreadsheet import inert_row

COLUMNS = (
    "axis",
    "recorded",
    "gain",
    "std",
    "unit",
    "nameplate",
    "change_percent",
    "change_sigmas",
    "change_probability",
    "deviation_sigmas",
    "cusum_up",
    "cusum_down",
    "trend_sigmas",
    "alarm",
    "baseline",
    "applied_at",
    "applied_by",
    "applied_to",
    "error_percent",
    "holdout_percent",
    "rows",
    "method",
    "software",
    "configuration_sha256",
    "created",
    "entered",
    "digest",
)


def rows(series: Series) -> list[dict[str, Any]]:
    """One row a point, by COLUMNS; None where there is nothing to tell."""
    return [_row(series, index) for index in range(len(series.points))]


def csv_text(all_series: Sequence[Series]) -> str:
    """All rows with a header (RFC 4180); no text in it is a formula to a spreadsheet."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\r\n")
    writer.writeheader()
    for series in all_series:
        writer.writerows(map(inert_row, rows(series)))
    return text.getvalue()


def _row(series: Series, index: int) -> dict[str, Any]:
    point, stretch = series.points[index], series.stretch_at(index)
    entry, gain, change = point.entry, point.gain, point.change
    drift, place = stretch.drift, index - stretch.began
    alarm = series.alarm_at(index)
    last = entry.events[-1] if entry.events else None
    return {
        "axis": series.axis,
        "recorded": entry.recorded.isoformat(),
        "gain": gain.value,
        "std": gain.std,
        "unit": gain.unit,
        "nameplate": gain.nameplate,
        "change_percent": None if change is None else change.percent,
        "change_sigmas": None if change is None else change.sigmas,
        "change_probability": None if change is None else change.probability,
        "deviation_sigmas": float(drift.deviations[place]),
        "cusum_up": float(drift.upper[place]),
        "cusum_down": float(drift.lower[place]),
        "trend_sigmas": float(drift.trend[place]),
        "alarm": None if alarm is None else alarm.kind.value,
        "baseline": drift.baseline,
        "applied_at": None if last is None else last.at.isoformat(),
        "applied_by": None if last is None else last.who,
        "applied_to": None if last is None else last.target,
        "error_percent": entry.error_percent,
        "holdout_percent": entry.holdout_percent,
        "rows": entry.rows,
        "method": entry.method,
        "software": entry.software,
        "configuration_sha256": entry.configuration_sha256,
        "created": entry.created.isoformat(),
        "entered": entry.entered.isoformat(),
        "digest": entry.digest,
    }
