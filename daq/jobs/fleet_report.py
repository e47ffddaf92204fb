"""The results of a fleet: a table, a CSV, and JSON."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from typing import Any, Literal

from rich.console import RenderableType
from rich.text import Text

from daq.jobs.cell_fit import Failure, Summary
from daq.jobs.fleet import FleetRow
from daq.report.gains import with_deviation
from daq.report.job_schemas import FleetCell, FleetEffect, FleetFailure, FleetGain, FleetReport
from daq.report.text import WholeTable, inert, inert_row, printable, spelled_bytes
from ident.calibration import Gain

FIRST_COLUMNS = ("cell", "configuration_sha256", "fit", "holdout")
LAST_COLUMNS = (
    *("worst_axis", "worst_std_percent", "error_percent", "error_on", "effects", "partial"),
    *("seconds", "exit_code", "error_kind", "error", "calibration"),
)


def fleet_view(rows: Sequence[FleetRow]) -> Iterator[RenderableType]:
    """Table of the cells, a row each, and remarks on it; errors are red."""
    table = WholeTable()
    table.add_column("cell", overflow="fold")
    table.add_column("gains ± σ", ratio=1)
    table.add_column("worst σ %", justify="right", no_wrap=True)
    table.add_column("error %", justify="right", no_wrap=True)
    effects = any(isinstance(row.result, Summary) and row.result.effects for row in rows)
    if effects:
        table.add_column("effects")
    table.add_column("s", justify="right", no_wrap=True)
    for row in rows:
        if isinstance(row.result, Failure):
            cells, style = (printable(f"{row.result.kind}: {row.result.text}"), "", "", ""), "bold red"
        else:
            cells, style = _summary_cells(row.result), None
        shown = (*cells[:3], *(cells[3:] if effects else ()), f"{row.seconds:.2f}")
        table.add_row(*map(Text, (printable(row.cell), *shown)), style=style)
    yield table
    yield from map(printable, _remarks(rows))


def _summary_cells(summary: Summary) -> tuple[str, str, str, str]:
    """Gains, the worst of them, the error and the effects."""
    # Lines break between gains, not within one.
    gains = ", ".join(with_deviation(gain.value, gain.std).replace(" ", "\xa0") for gain in summary.gains)
    units = ", ".join(dict.fromkeys(gain.unit for gain in summary.gains))
    worst = f"{summary.worst.axis} {summary.worst.std_percent:.2f}"
    error = f"{summary.error_percent:.2f}" + ("" if summary.held_out else "*")
    effects = ", ".join(f"{name} {axis}" for name, axis in summary.effects)
    return f"{gains} {printable(units)}", printable(worst), error, printable(effects)


def _remarks(rows: Sequence[FleetRow]) -> list[str]:
    fitted = [(row, row.result) for row in rows if isinstance(row.result, Summary)]
    kept = sum(row.kept for row, _ in fitted)
    again = f" ({kept} of them kept from earlier, with the same logs)" if kept else ""
    lines = [f"{len(fitted)} of {len(rows)} fitted{again}."]
    if not all(summary.held_out for _, summary in fitted):
        lines.append("* on the moves of the fit: the cell has no second run with the same payload to hold out.")
    several = {row.cell: row.configurations for row in rows if row.configurations > 1}
    lines += [
        f"{cell}: logs of {count} configurations, each fitted on its own; check which one is current."
        for cell, count in several.items()
    ]
    lines += [
        f"{row.cell}: PARTIAL or lossy data: not for a controller; `apply` refuses it."
        for row, summary in fitted
        if summary.partial
    ]
    return lines


def fleet_csv(rows: Sequence[FleetRow]) -> str:
    """Write a line per cell, with all digits; gain, σ and unit of every axis that any of the cells has.

    Missing values are empty. No text is a formula to a spreadsheet.
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


def fleet_report(rows: Sequence[FleetRow]) -> FleetReport:
    """Return the cells of a fleet."""
    fitted = sum(row.fitted for row in rows)
    return FleetReport(cells=[_fleet_cell(row) for row in rows], fitted=fitted, failed=len(rows) - fitted)


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


def _fleet_cell(row: FleetRow) -> FleetCell:
    result = row.result
    failure = result if isinstance(result, Failure) else None
    summary = result if isinstance(result, Summary) else None
    return FleetCell(
        cell=spelled_bytes(row.cell),
        configuration_sha256=row.configuration_sha256 or None,
        configurations=row.configurations,
        fit=[spelled_bytes(name) for name in row.fit],
        holdout=[spelled_bytes(name) for name in row.holdout],
        gains=[] if summary is None else [_fleet_gain(gain) for gain in summary.gains],
        worst=None if summary is None else _fleet_gain(summary.worst),
        error_percent=None if summary is None else summary.error_percent,
        error_on=None if summary is None else _measured_on(summary),
        effects=[] if summary is None else [FleetEffect(name=name, axis=axis) for name, axis in summary.effects],
        partial=None if summary is None else summary.partial,
        seconds=row.seconds,
        kept=row.kept,
        calibration=None if row.file is None else spelled_bytes(str(row.file)),
        exit_code=0 if failure is None else failure.exit_code,
        error=None if failure is None else FleetFailure(kind=failure.kind, text=spelled_bytes(failure.text)),
    )


def _measured_on(summary: Summary) -> Literal["holdout", "fit"]:
    return "holdout" if summary.held_out else "fit"


def _fleet_gain(gain: Gain) -> FleetGain:
    return FleetGain(axis=gain.axis, value=gain.value, std=gain.std, std_percent=gain.std_percent, unit=gain.unit)
