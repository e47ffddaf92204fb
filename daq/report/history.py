"""The picture of a history: each gain over time with its baseline, and beneath it what raises alarms."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.files import replace_file
from daq.ledger.watch import Series
from daq.report.picture import BLUE, DPI, GREY, ORANGE, PURPLE, SKY, legend_below, panels, unformatted
from daq.report.text import inert_row
from ident.drift.change import CHART, Chart

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_SIGMAS = 2.0
_COLUMNS = 2
_FIRST_DAY, _LAST_DAY = -719_162.0, 2_932_896.999  #: 1 January 1 and 31 December 9999: matplotlib draws no dates beyond


def plot_history(path: Path, all_series: Sequence[Series], *, title: str, chart: Chart = CHART) -> None:
    """Draw gains ± 2σ, those that a controller had filled, alarms; CUSUM, trend and deviations over their limits.

    Args:
        path: of the picture, .png or .svg.
        all_series: one an axis, at least one.
        title: says which cell it is.
        chart: limits that `all_series` was watched with.

    Raises:
        OSError: from the file system.
    """
    columns = min(_COLUMNS, len(all_series))
    bands = -(-len(all_series) // columns)
    figure, places = panels(2 * columns * bands, columns, unformatted(title))
    for number, series in enumerate(all_series):
        band, column = divmod(number, columns)
        above, beneath = (places[(2 * band + row) * columns + column] for row in range(2))
        _draw_gains(above, series)
        _draw_limits(beneath, series, chart)
    for empty in range(len(all_series), columns * bands):
        for row in range(2):
            places[(2 * (bands - 1) + row) * columns + empty % columns].set_axis_off()
    _date(places, [_days(point.entry.recorded) for series in all_series for point in series.points])
    upper = [place for row in range(0, len(places), 2 * columns) for place in places[row : row + columns]]
    legend_below(figure, *upper)
    # One legend for both kinds of panels would be wider than the picture of one axis.
    places[columns].legend(loc="best", ncols=2, fontsize=7, edgecolor="none", handles=_once(places[columns]))
    _save(figure, path)


def _draw_gains(place: Axes, series: Series) -> None:
    times = [_days(point.entry.recorded) for point in series.points]
    values = [point.gain.value for point in series.points]
    widths = [_SIGMAS * series.dispersion * point.gain.std for point in series.points]
    place.errorbar(times, values, yerr=widths, fmt="none", ecolor=BLUE, elinewidth=1.0, capsize=2)
    place.plot(times, values, "o", color=BLUE, markerfacecolor="white", markersize=4, label=f"gain ± {_SIGMAS:g} σ")
    held = [(_days(point.entry.recorded), point.gain.value) for point in series.points if point.entry.applied]
    place.plot(*_columns(held), "o", color=BLUE, markersize=4, label="applied")
    alarmed = [(times[i], values[i]) for i in range(len(times)) if series.alarm_at(i) is not None]
    place.plot(*_columns(alarmed), "o", color=ORANGE, markerfacecolor="none", markersize=9, label="alarm")
    for stretch in series.stretches:
        drift = stretch.drift
        ends = [times[stretch.began], times[stretch.ended - 1]]
        low, high = (drift.baseline + sign * _SIGMAS * drift.baseline_std for sign in (-1.0, 1.0))
        place.fill_between(ends, low, high, color=SKY, alpha=0.3, linewidth=0)
        place.plot(ends, [drift.baseline] * 2, color=GREY, linestyle="--", linewidth=1.2, label="baseline")
        if drift.steady:
            reached = drift.baseline * (1.0 + drift.change_percent / 100.0)
            place.plot(ends, [drift.baseline, reached], color=ORANGE, linewidth=1.2, label="steady change")
    for noted in series.acknowledged:
        place.axvline(_days(noted.since), color=PURPLE, linestyle=":", linewidth=1.2, label="change acknowledged")
    place.set_ylabel(unformatted(f"{series.axis} [{series.unit}]"), fontsize=8)


def _draw_limits(place: Axes, series: Series, chart: Chart) -> None:
    place.axhline(0.0, color=GREY, linewidth=0.8)
    for sign in (-1.0, 1.0):
        place.axhline(sign, color=ORANGE, linestyle="--", linewidth=1.0, label="limit")
    for stretch in series.stretches:
        times = [_days(point.entry.recorded) for point in series.points[stretch.began : stretch.ended]]
        drift = stretch.drift
        for sums in (drift.upper, -drift.lower):
            place.step(times, sums / chart.threshold, where="mid", color=BLUE, linewidth=1.4, label="CUSUM up, down")
        place.plot(times, drift.trend / chart.trend, color=PURPLE, linewidth=1.0, label="trend")
        place.plot(times, drift.deviations / chart.single, ".", color=GREY, markersize=4, label="one calibration")
    place.set_ylabel("over its limit", fontsize=8)


def _once(place: Axes) -> list[Any]:
    """One handle a label."""
    handles, labels = place.get_legend_handles_labels()
    return list(dict(zip(labels, handles, strict=True)).values())


def _days(at: datetime) -> float:
    """As matplotlib counts dates: days since 1970, UTC."""
    return at.timestamp() / 86_400.0


def _columns(points: list[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [when for when, _ in points], [value for _, value in points]


def _date(places: list[Axes], days: list[float]) -> None:
    import matplotlib.dates  # noqa: PLC0415

    dates: Any = matplotlib.dates  # without types
    # Of a single day there would be no range to label.
    beside = max(0.5, 0.03 * (max(days) - min(days)))
    for place in places:
        place.set_xlim(max(min(days) - beside, _FIRST_DAY), min(max(days) + beside, _LAST_DAY))
        # At most so many labels as fit beside each other.
        locator = dates.AutoDateLocator(maxticks=7)
        place.xaxis.set_major_locator(locator)
        place.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))


def _save(figure: Figure, path: Path) -> None:
    from matplotlib import rc_context  # noqa: PLC0415

    drawn = io.BytesIO()
    kind = path.suffix.lower().removeprefix(".")
    # Neither time nor random names: the same history gives the same bytes.
    metadata = {"Date": None} if kind == "svg" else {"Software": None}
    with rc_context({"svg.hashsalt": "drivegain"}):
        figure.savefig(drawn, format=kind, dpi=DPI, metadata=metadata)
    replace_file(path, drawn.getvalue())


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
    """Return one row a point, by COLUMNS; None for a missing value."""
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
