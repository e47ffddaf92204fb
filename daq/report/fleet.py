"""The results of a fleet: rows for a spreadsheet, a document for a program."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

from daq.jobs.cell_fit import Failure
from daq.jobs.fleet import FleetRow
from daq.jobs.fleet_survey import Summary
from daq.report.text import inert, inert_row
from ident.calibration import Gain

FIRST_COLUMNS = ("cell", "configuration_sha256", "fit", "holdout")
LAST_COLUMNS = (
    "worst_axis",
    "worst_std_percent",
    "error_percent",
    "error_on",
    "effects",
    "partial",
    "seconds",
    "exit_code",
    "error_kind",
    "error",
    "calibration",
)


def fleet_csv(rows: Sequence[FleetRow]) -> str:
    """A line a cell, numbers to the last digit; gain, σ and unit of every axis that any of the cells has.

    What a cell lacks is empty. No text in it is a formula to a spreadsheet.
    """
    summaries = [row.result for row in rows if isinstance(row.result, Summary)]
    axes = list(dict.fromkeys(gain.axis for summary in summaries for gain in summary.gains))
    of_axes = [f"{axis} {what}" for axis in axes for what in ("gain", "std", "unit")]
    text = io.StringIO()
    headings = (*FIRST_COLUMNS, *of_axes, *LAST_COLUMNS)
    table = csv.DictWriter(text, headings, restval="", lineterminator="\n")
    table.writerow({heading: inert(heading) for heading in headings})
    for row in rows:
        table.writerow(inert_row(_line(row)))
    return text.getvalue()


def fleet_document(rows: Sequence[FleetRow]) -> dict[str, Any]:
    """The object of --json."""
    fitted = sum(row.fitted for row in rows)
    return {"cells": [_document(row) for row in rows], "fitted": fitted, "failed": len(rows) - fitted}


def _line(row: FleetRow) -> dict[str, Any]:
    result = row.result
    line: dict[str, Any] = {
        "cell": row.cell,
        "configuration_sha256": row.configuration_sha256,
        "fit": " ".join(row.fit),
        "holdout": " ".join(row.holdout),
        "seconds": f"{row.seconds:.3f}",
    }
    if isinstance(result, Failure):
        return line | {"exit_code": result.exit_code, "error_kind": result.kind, "error": result.text}
    for gain in result.gains:
        line |= {f"{gain.axis} gain": gain.value, f"{gain.axis} std": gain.std, f"{gain.axis} unit": gain.unit}
    return line | {
        "worst_axis": result.worst.axis,
        "worst_std_percent": result.worst.std_percent,
        "error_percent": result.error_percent,
        "error_on": _measured_on(result),
        "effects": "; ".join(f"{name} {axis}" for name, axis in result.effects),
        "partial": result.partial,
        "exit_code": 0,
        "calibration": "" if row.file is None else str(row.file),
    }


def _document(row: FleetRow) -> dict[str, Any]:
    result = row.result
    failure = result if isinstance(result, Failure) else None
    summary = result if isinstance(result, Summary) else None
    return {
        "cell": _spelt(row.cell),
        "configuration_sha256": row.configuration_sha256 or None,
        "configurations": row.configurations,
        "fit": [_spelt(name) for name in row.fit],
        "holdout": [_spelt(name) for name in row.holdout],
        "gains": [] if summary is None else [_gain(gain) for gain in summary.gains],
        "worst": None if summary is None else _gain(summary.worst),
        "error_percent": None if summary is None else summary.error_percent,
        "error_on": None if summary is None else _measured_on(summary),
        "effects": [] if summary is None else [{"name": name, "axis": axis} for name, axis in summary.effects],
        "partial": None if summary is None else summary.partial,
        "seconds": row.seconds,
        "kept": row.kept,
        "calibration": None if row.file is None else _spelt(str(row.file)),
        "exit_code": 0 if failure is None else failure.exit_code,
        "error": None if failure is None else {"kind": failure.kind, "text": _spelt(failure.text)},
    }


def _spelt(text: str) -> str:
    """Bytes of a file's name that are no UTF-8, and so can be in no document, as `\\udcff`."""
    return text.encode(errors="backslashreplace").decode()


def _measured_on(summary: Summary) -> str:
    return "holdout" if summary.held_out else "fit"


def _gain(gain: Gain) -> dict[str, Any]:
    return {
        "axis": gain.axis,
        "value": gain.value,
        "std": gain.std,
        "std_percent": gain.std_percent,
        "unit": gain.unit,
    }
