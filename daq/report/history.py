"""A history on the screen, as one JSON object, as a table for a spreadsheet,
and as a picture of each gain.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table

from daq.config.cell import Cell
from daq.errors import ControllerUnfit, counted
from daq.formats.document import decode_document, read_controller_file
from daq.formats.scalar import Scalar, rewrite_gain
from daq.ledger.audit import BACKUPS_WITHOUT_LOG, Content, OpenWrite, head_file
from daq.ledger.fold import Entry, Event, History, WriteAction
from daq.ledger.ledger import Verification
from daq.ledger.names import drives_of
from daq.ledger.watch import Point, Series, alarm_text, pattern_of, questions
from daq.report.document import Figure, Report
from daq.report.gains import with_deviation
from daq.report.picture import (
    BLUE,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    legend_below,
    panels,
    render,
    unformatted,
)
from daq.report.text import SHOWN_SIGMAS, inert_row, plain_table, printable
from daq.writeback.file_access import resolve_links
from daq.writeback.request import is_writable
from ident.drift.change import CHART

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Acknowledged(Report):
    """A change that was explained."""

    since: str
    at: str
    who: str
    why: str


class HistoryPoint(Report):
    """One calibration of a gain; the columns of `--csv`."""

    axis: str
    recorded: str
    gain: float
    std: float
    unit: str
    nameplate: float
    change_percent: Figure
    change_sigmas: Figure
    change_probability: Figure
    deviation_sigmas: Figure
    cusum_up: Figure
    cusum_down: Figure
    trend_sigmas: Figure
    alarm: str | None
    baseline: Figure
    applied_at: str | None
    applied_by: str | None
    applied_to: str | None
    error_percent: Figure
    holdout_percent: Figure
    rows: int
    method: str
    software: str
    configuration_sha256: str
    created: str
    entered: str
    digest: str
    accepted: bool | None = None
    """whether new moves confirm the gains of this calibration; left out where none were made"""
    accepted_at: str | None = None
    accepted_by: str | None = None
    misdated: str | None = None
    """`created` by the clock of that day, where the order of the audit log shows that it was wrong:
    `recorded` and `created` are then what that order allows; left out where it was right
    """


class HistoryAxis(Report):
    """One gain over time."""

    axis: str
    unit: str
    dispersion: Figure
    alarmed: bool
    alarm: str | None
    since: str | None
    change_percent: Figure
    change_sigmas: Figure
    baseline: Figure
    baseline_std: Figure
    acknowledged: list[Acknowledged]
    points: list[HistoryPoint]


class FlawedLine(Report):
    """A line of the audit log that is not what was written."""

    line: int
    """in the file, from 1"""
    flaw: str
    says: str
    """the same as a sentence"""


class NamedEntry(Report):
    """An entry of the audit log."""

    number: int
    """from 1"""
    at: str
    who: str
    file: str
    """the controller's file, or the drives"""


class UnendedWrite(NamedEntry):
    """A write that was begun and never ended."""

    content: str
    """of the file afterwards"""


class UnknownWrite(NamedEntry):
    """A write that the history lacks."""

    action: str
    calibration_sha256: str | None


class AuditReport(Report):
    """State of the audit log and of the history in it."""

    file: str
    entries: int
    holds: bool
    """no line was changed or removed, as far as the chain shows it"""
    broken_line: int | None
    """the first that is not what was written"""
    flaws: list[FlawedLine]
    torn_lines: list[int]
    """left by a writer that was killed; they are no flaw"""
    noted: bool
    """the digest of the last entry is noted next to the audit log: a missing end would show"""
    not_noted: str | None
    """why the next entry cannot be noted either"""
    open_writes: list[UnendedWrite]
    history_broken: list[str]
    """what the history cannot show"""
    unknown_writes: list[UnknownWrite]


class HistoryReport(Report):
    """`history`."""

    cell: str
    calibrations: int
    in_force: str | None
    chart: dict[str, int | float]
    """limits of the control chart"""
    pattern: str
    questions: list[str]
    axes: list[HistoryAxis]
    audit: AuditReport | None = None
    """with --verify"""
    other_robots: list[str] | None = None
    """calibrations of another robot with the cell's name, each with what differs;
    left out where there are none
    """
    not_compared: list[str] | None = None
    """calibrations with other axes or units than the newest one, each with what differs;
    left out where there are none
    """


def show_history(
    entries: Sequence[Entry],
    all_series: Sequence[Series],
    actions: Mapping[str, str],
    console: Console,
) -> None:
    """The calibrations, a line each, with what was done with each by its digest;
    then each gain as it is now.
    """
    if not entries:
        console.print("The history is empty: no calibration was applied or entered yet.")
        console.print("To enter one: drivegain history CELL --add CALIBRATION")
        return
    console.print(calibration_table(entries, all_series, actions))
    for entry in entries:
        if entry.created_by_clock is not None:
            console.print(_misdated_text(entry), style="yellow")
    console.print()
    console.print(history_gain_table(all_series))
    say_alarms(all_series, console)


def _misdated_text(entry: Entry) -> str:
    """Say that a calibration was entered while the clock was wrong."""
    return (
        f"Calibration {entry.digest[:12]}…: found the date {entry.created_by_clock:%Y-%m-%d}; "
        f"expected one about {entry.created:%Y-%m-%d}, by the order of the audit log. The clock "
        "was wrong then, so it is shown there. The files keep their dates; gates judge the age of "
        "its logs by them."
    )


def show_axis(
    series: Series, all_series: Sequence[Series], actions: Mapping[str, str], console: Console
) -> None:
    """Every calibration of one gain."""
    console.print(axis_table(series, actions))
    for noted in series.acknowledged:
        console.print(
            f"New baseline of {series.axis} from {noted.since:%Y-%m-%d %H:%M} on: "
            f"{printable(noted.why)} ({printable(noted.who)}, {noted.at:%Y-%m-%d})"
        )
    words = alarm_text(series)
    if words is not None:
        say_alarms(all_series, console)
    elif series.drift is not None:
        console.print(
            f"No alarm. The changes scatter {series.dispersion:.2f} times as much as σ "
            "of the fits says."
        )


def say_alarms(all_series: Sequence[Series], console: Console) -> None:
    """Print what changed, and possible causes."""
    alarms = [words for series in all_series if (words := alarm_text(series)) is not None]
    console.print("No alarm." if not alarms else "")
    for words in alarms:
        console.print(f"ALARM: {words}", style="bold")
    for question in questions(all_series):
        console.print(question[0].upper() + question[1:])
    if alarms:
        console.print(
            'When it is explained: drivegain history CELL --acknowledge AXIS --why "what happened"'
        )


def _points_of(series: Series, entry: Entry) -> list[tuple[Series, int, Point]]:
    """Return the points of a calibration in the series of an axis, each with its index."""
    points = enumerate(series.points)
    return [(series, index, point) for index, point in points if point.entry.digest == entry.digest]


def calibration_table(
    entries: Sequence[Entry], all_series: Sequence[Series], actions: Mapping[str, str]
) -> Table:
    """One row a calibration."""
    headings = ("recorded (UTC)", "calibration", "error %", "largest change", "alarms", "applied")
    table = plain_table(headings, left=(0, 1, 4, 5), wrap=(5,))
    for entry in sorted(entries, key=lambda one: one.recorded):
        points: list[tuple[Series, int, Point]] = []
        for series in all_series:
            points += _points_of(series, entry)
        alarms = [series.axis for series, index, _ in points if series.alarm_at(index) is not None]
        changes = [
            (point.change, point.gain.axis) for _, _, point in points if point.change is not None
        ]
        largest = "-"
        if changes:
            change, axis = max(changes, key=lambda pair: abs(pair[0].sigmas))
            largest = f"{printable(axis)} {change.percent:+.1f} % {abs(change.sigmas):.1f} σ"
        error = entry.holdout_percent
        if error is None:
            error = entry.error_percent
        table.add_row(
            f"{entry.recorded:%Y-%m-%d %H:%M}",
            entry.digest[:8],
            f"{error:.2f}",
            largest,
            ", ".join(alarms) or "-",
            printable(actions[entry.digest]),
        )
    return table


def history_gain_table(all_series: Sequence[Series]) -> Table:
    """Each gain as it was identified last, with its baseline."""
    headings = ("axis", "identified ± σ", "nameplate", "since baseline %", "in σ", "state", "unit")
    table = plain_table(headings, left=(0, 5, 6), wrap=(3,))
    for series in all_series:
        if not series.points:
            table.add_row(
                printable(series.axis), "not identified", "-", "-", "-", "-", printable(series.unit)
            )
            continue
        gain = series.points[-1].gain
        count = len(series.points) - series.began
        drift = None
        if count > 1:
            drift = series.drift
        state = f"baseline: {count} of {CHART.baseline}"
        if series.alarmed:
            state = "ALARM"
        elif count > CHART.baseline:
            state = "ok"
        change_percent = "-"
        change_sigmas = "-"
        if drift is not None:
            change_percent = f"{drift.change_percent:+.2f}"
            change_sigmas = f"{abs(drift.change_sigmas):.1f}"
        table.add_row(
            printable(series.axis),
            with_deviation(gain.value, gain.std),
            f"{gain.nameplate:.4g}",
            change_percent,
            change_sigmas,
            state,
            printable(series.unit),
        )
    return table


def axis_table(series: Series, actions: Mapping[str, str]) -> Table:
    """Every calibration of one gain, with the two sums and the slope that are watched."""
    figures = (f"{series.axis} [{series.unit}]", "change %", "σ", "CUSUM +", "CUSUM −", "trend")
    table = plain_table(("recorded (UTC)", *figures, "alarm", "applied"), left=(0, 7, 8), wrap=(8,))
    for index, point in enumerate(series.points):
        stretch = series.stretch_at(index)
        place = index - stretch.began
        alarm = series.alarm_at(index)
        change_percent = "-"
        change_sigmas = "-"
        if point.change is not None:
            change_percent = f"{point.change.percent:+.2f}"
            change_sigmas = f"{abs(point.change.sigmas):.1f}"
        kind = "-"
        if alarm is not None:
            kind = alarm.kind.value
        drift = stretch.drift
        table.add_row(
            f"{point.entry.recorded:%Y-%m-%d %H:%M}",
            with_deviation(point.gain.value, point.gain.std),
            change_percent,
            change_sigmas,
            f"{drift.upper[place]:.1f}",
            f"{drift.lower[place]:.1f}",
            f"{drift.trend[place]:+.1f}",
            kind,
            printable(actions[point.entry.digest]),
        )
    return table


def history_report(
    cell: str,
    history: History,
    chosen: Sequence[Series],
    all_series: Sequence[Series],
    in_force: str | None,
    checked: Verification | None = None,
) -> HistoryReport:
    """Return the history of a cell.

    Args:
        cell: its name.
        history: of the cell.
        chosen: axes that were asked for.
        all_series: all axes.
        in_force: digest of the calibration whose gains are the current gains.
        checked: state of audit log and history; None where it was not asked for.
    """
    others: dict[str, Any] = {}
    if checked is not None:
        others = {"audit": audit_report(checked)}
    if history.other_robots:
        others["other_robots"] = [str(one) for one in history.other_robots]
    if history.not_compared:
        others["not_compared"] = [str(one) for one in history.not_compared]
    return HistoryReport.of(
        cell=cell,
        calibrations=len(history.entries),
        in_force=in_force,
        chart=asdict(CHART),
        pattern=pattern_of(all_series),
        questions=questions(all_series),
        axes=[_history_axis(series) for series in chosen],
        **others,
    )


def _history_axis(series: Series) -> HistoryAxis:
    return HistoryAxis.of(
        series,
        series.drift,
        alarm=alarm_text(series),
        since=series.onset,
        points=history_points(series),
    )


def _unended_text(write: OpenWrite) -> str:
    """Say that a write was never ended, and what its file has."""
    begun = write.begun
    subject = printable(begun.subject)
    found = f"{subject} was found {write.content.value}"
    if write.content is Content.UNKNOWN:
        found = (
            f"what is in {subject} is not known: a file that cannot be read, drives, which are "
            "not asked here, or an entry without digests"
        )
    return (
        f"Line of entry {begun.number}: {begun.action.value} by {printable(begun.who)} at "
        f"{begun.at} was never ended; {found}."
    )


def say_verification(found: Verification, console: Console) -> None:
    """Print the state of audit log and history; flaws are in the error."""
    verdict = found.verdict
    chain = "BROKEN"
    if verdict.holds:
        chain = "unbroken"
    entries = counted(len(verdict.entries), "entry")
    console.print(f"{found.audit}: {entries}, chain {chain}.")
    if not found.noted and not found.note_obstacle:
        console.print(
            f"No {head_file(found.audit).name} with the digest of the last entry: a missing end of "
            "the audit log would not be noticed. The next entry writes it again."
        )
    if found.note_obstacle:
        console.print(printable(f"NOT NOTED: {found.note_obstacle}"))
    if verdict.torn:
        lines = ", ".join(map(str, verdict.torn))
        if verdict.may_be_torn:
            console.print(f"Unfinished lines: {lines}. One may be what is left of a missing entry.")
        else:
            console.print(
                f"Unfinished lines, left by a writer that was killed: {lines}. They are no flaw."
            )
    for write in verdict.open_writes:
        console.print(_unended_text(write))
    for entry in verdict.entries:
        count = entry.details.get(BACKUPS_WITHOUT_LOG)
        if isinstance(count, int):
            console.print(
                f"Entry {entry.number} began this audit log, although {printable(entry.subject)} "
                f"had {counted(count, 'backup')} of earlier writes: an earlier log was removed or "
                "moved."
            )
    state = "sound"
    if not verdict.holds:
        state = "not known, because entries may be missing"
    elif found.broken:
        state = "BROKEN"
    elif found.unknown:
        state = "NOT COMPLETE"
    console.print(f"History: {state}.")


def audit_report(found: Verification) -> AuditReport:
    """Return the state of audit log and history."""
    verdict = found.verdict
    open_writes = []
    for write in verdict.open_writes:
        begun = write.begun
        open_writes.append(UnendedWrite.of(begun, file=begun.subject, content=write.content))
    unknown_writes = []
    for unknown in found.unknown:
        ended = unknown.ended
        unknown_writes.append(
            UnknownWrite.of(ended, file=ended.subject, calibration_sha256=unknown.calibration)
        )
    return AuditReport.of(
        verdict,
        file=found.audit,
        entries=len(verdict.entries),
        broken_line=verdict.broken,
        torn_lines=verdict.torn,
        noted=found.noted,
        not_noted=printable(found.note_obstacle) or None,
        open_writes=open_writes,
        history_broken=[printable(one) for one in found.broken],
        unknown_writes=unknown_writes,
    )


_WORDS = {
    WriteAction.APPLIED: "applied by",
    WriteAction.ROLLED_BACK: "gains restored by the rollback of",
}
"""Words for an event after which the gains of a calibration were the current gains."""
_VERDICTS = {True: "accepted by", False: "NOT ACCEPTED by"}
"""Words for what new moves with these gains have shown."""


def in_force(cell: Cell, history: History) -> str | None:
    """Return the digest of the calibration whose gains are the current gains of this cell.

    The controller's file is read: it may have been edited, or a backup copied back by hand, and a
    write to another file (`apply --to`) is not in this controller. Drives are not read; the last
    write of the history counts. None where the file has other numbers than every calibration, or
    cannot be read.
    """
    controller = cell.controller
    file = cell.controller_path
    if controller is None:
        return None
    if file is None or not controller.gains:
        if controller.objects:
            return history.in_force(drives_of(cell.name))
        return None
    try:
        target = str(resolve_links(file))
        content = read_controller_file(file)
        document = decode_document(content, str(file), controller.format)
        scalars = document.locate(controller.keys)
    except (ControllerUnfit, OSError):
        return None
    numbers = dict(zip(cell.axis_names, zip(scalars, controller.factors, strict=True), strict=True))
    known = history.in_force(target)
    having = [entry.digest for entry in reversed(history.entries) if _has(entry, numbers)]
    # Where several have these numbers: the one that the history names, else the one that was
    # written last.
    order = (known, *(event.digest for event in reversed(history.events)), *having)
    return next((digest for digest in order if digest in having), None)


def describe_actions(
    entries: Sequence[Entry], events: Sequence[Event], digest_in_force: str | None
) -> dict[str, str]:
    """Return what was done with each calibration in words, by its digest:
    writes, rollbacks and acceptance.

    Args:
        entries: the calibrations.
        events: writes to all controllers, oldest first.
        digest_in_force: of the calibration whose gains the controller has; None for other numbers.
    """
    described = {}
    for entry in entries:
        parts = []
        mine = [place for place, event in enumerate(events) if event.digest == entry.digest]
        if mine:
            last = events[mine[-1]]
            parts.append(f"{_WORDS[last.action]} {last.who}")
            later = events[mine[-1] + 1 :]
            then = next((event for event in later if event.target == last.target), None)
            if then is not None and then.action is WriteAction.ROLLED_BACK:
                parts.append(f"rolled back by {then.who}")
        if entry.acceptance is not None:
            verdict = _VERDICTS[entry.acceptance.accepted]
            parts.append(f"{verdict} {entry.acceptance.who}")
        if entry.digest == digest_in_force:
            parts.append("in force")
        described[entry.digest] = ", ".join(parts) or "-"
    return described


def _has(entry: Entry, numbers: dict[str, tuple[Scalar, float]]) -> bool:
    """Whether a write of this calibration would change no number."""
    if {gain.axis for gain in entry.gains} != numbers.keys():
        return False
    if not all(map(is_writable, entry.gains)):
        return False
    try:
        put = []
        for gain in entry.gains:
            number, scale = numbers[gain.axis]
            put.append(rewrite_gain(number, gain.value, gain.std, scale))
    except ControllerUnfit:
        return False
    return all(one.new == one.current_gain for one in put)


COLUMNS = tuple(HistoryPoint.model_fields)
"""Headings of the table for a spreadsheet."""


def csv_text(all_series: Sequence[Series]) -> str:
    """All calibrations of all gains with a header (RFC 4180);
    no text in it is a formula to a spreadsheet.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\r\n")
    writer.writeheader()
    for series in all_series:
        writer.writerows(inert_row(dict(point)) for point in history_points(series))
    return text.getvalue()


def history_points(series: Series) -> list[HistoryPoint]:
    """Return the calibrations of a gain, oldest first; None for a missing value."""
    return [_history_point(series, index) for index in range(len(series.points))]


def _history_point(series: Series, index: int) -> HistoryPoint:
    point = series.points[index]
    stretch = series.stretch_at(index)
    drift = stretch.drift
    place = index - stretch.began
    known: dict[str, object] = {}
    if point.change is not None:
        known["change_percent"] = point.change.percent
        known["change_sigmas"] = point.change.sigmas
        known["change_probability"] = point.change.probability
    if alarm := series.alarm_at(index):
        known["alarm"] = alarm.kind
    if point.entry.events:
        last = point.entry.events[-1]
        known |= {"applied_at": last.at, "applied_by": last.who, "applied_to": last.target}
    if point.entry.created_by_clock is not None:
        known["misdated"] = point.entry.created_by_clock
    acceptance = point.entry.acceptance
    if acceptance is not None:
        known["accepted"] = acceptance.accepted
        known["accepted_at"] = acceptance.at
        known["accepted_by"] = acceptance.who
    return HistoryPoint.of(
        point.entry,
        None,
        axis=series.axis,
        gain=point.gain.value,
        std=point.gain.std,
        unit=point.gain.unit,
        nameplate=point.gain.nameplate,
        deviation_sigmas=drift.deviations[place],
        cusum_up=drift.upper[place],
        cusum_down=drift.lower[place],
        trend_sigmas=drift.trend[place],
        baseline=drift.baseline,
        **known,
    )


_COLUMNS = 2
#: 1 January 1 and 31 December 9999: matplotlib draws no dates beyond
_FIRST_DAY = -719_162.0
_LAST_DAY = 2_932_896.999


def plot_history(all_series: Sequence[Series], kind: str, *, title: str) -> bytes:
    """Draw gains ± 2σ, those that were written filled, alarms;
    CUSUM, trend and deviations over their limits.

    There is at least one series; the kind is png or svg.
    """
    import matplotlib.dates  # noqa: PLC0415

    dates: Any = matplotlib.dates  # without types
    columns = min(_COLUMNS, len(all_series))
    bands = math.ceil(len(all_series) / columns)
    figure, places = panels(2 * columns * bands, columns, unformatted(title))
    grid = np.array(places).reshape(bands, 2, columns)
    for number, series in enumerate(all_series):
        band, column = divmod(number, columns)
        _draw_gains(grid[band, 0, column], series)
        _draw_limits(grid[band, 1, column], series)
    in_last_band = len(all_series) - columns * (bands - 1)
    for place in grid[-1, :, in_last_band:].flat:
        place.set_axis_off()
    days: list[float] = []
    for series in all_series:
        days += [_days(point.entry.recorded) for point in series.points]
    first_day = min(days)
    last_day = max(days)
    # Of a single day there would be no range to label.
    margin = max(0.5, 0.03 * (last_day - first_day))
    begin = max(first_day - margin, _FIRST_DAY)
    end = min(last_day + margin, _LAST_DAY)
    for place in places:
        place.set_xlim(begin, end)
        # At most so many labels as fit next to each other.
        locator = dates.AutoDateLocator(maxticks=7)
        place.xaxis.set_major_locator(locator)
        place.xaxis.set_major_formatter(dates.ConciseDateFormatter(locator))
    legend_below(figure, *grid[:, 0].flat)
    # One legend for both kinds of panels would be wider than the picture of one axis.
    limits = grid[0, 1, 0]
    handles, labels = limits.get_legend_handles_labels()
    once = list(dict(zip(labels, handles, strict=True)).values())
    limits.legend(loc="best", ncols=2, fontsize=7, edgecolor="none", handles=once)
    return render(figure, kind)


def _draw_gains(place: Axes, series: Series) -> None:
    points = series.points
    times = np.array([_days(point.entry.recorded) for point in points])
    values = np.array([point.gain.value for point in points])
    widths = [SHOWN_SIGMAS * series.dispersion * point.gain.std for point in points]
    label = f"gain ± {SHOWN_SIGMAS:g} σ"
    place.errorbar(times, values, yerr=widths, fmt="none", ecolor=BLUE, elinewidth=1.0, capsize=2)
    place.plot(times, values, "o", color=BLUE, markerfacecolor="white", markersize=4, label=label)
    applied = np.array([point.entry.applied for point in points], dtype=np.bool_)
    place.plot(times[applied], values[applied], "o", color=BLUE, markersize=4, label="applied")
    alarms = [series.alarm_at(index) for index in range(len(points))]
    alarmed = np.array([alarm is not None for alarm in alarms], dtype=np.bool_)
    place.plot(
        times[alarmed],
        values[alarmed],
        "o",
        color=ORANGE,
        markerfacecolor="none",
        markersize=9,
        label="alarm",
    )
    for stretch in series.stretches:
        drift = stretch.drift
        ends = times[[stretch.began, stretch.ended - 1]]
        half = SHOWN_SIGMAS * drift.baseline_std
        lower = drift.baseline - half
        upper = drift.baseline + half
        place.fill_between(ends, lower, upper, color=SKY, alpha=0.3, linewidth=0)
        place.plot(
            ends, [drift.baseline] * 2, color=GREY, linestyle="--", linewidth=1.2, label="baseline"
        )
        if drift.steady:
            reached = drift.baseline * (1.0 + drift.change_percent / 100.0)
            place.plot(
                ends, [drift.baseline, reached], color=ORANGE, linewidth=1.2, label="steady change"
            )
    for noted in series.acknowledged:
        place.axvline(
            _days(noted.since),
            color=PURPLE,
            linestyle=":",
            linewidth=1.2,
            label="change acknowledged",
        )
    place.set_ylabel(unformatted(f"{series.axis} [{series.unit}]"), fontsize=8)


def _draw_limits(place: Axes, series: Series) -> None:
    place.axhline(0.0, color=GREY, linewidth=0.8)
    for sign in (-1.0, 1.0):
        place.axhline(sign, color=ORANGE, linestyle="--", linewidth=1.0, label="limit")
    for stretch in series.stretches:
        points = series.points[stretch.began : stretch.ended]
        times = [_days(point.entry.recorded) for point in points]
        drift = stretch.drift
        for sums in (drift.upper, -drift.lower):
            share = sums / CHART.threshold
            place.step(times, share, where="mid", color=BLUE, linewidth=1.4, label="CUSUM up, down")
        trend = drift.trend / CHART.trend
        single = drift.deviations / CHART.single
        place.plot(times, trend, color=PURPLE, linewidth=1.0, label="trend")
        place.plot(times, single, ".", color=GREY, markersize=4, label="one calibration")
    place.set_ylabel("over its limit", fontsize=8)


def _days(at: datetime) -> float:
    """As matplotlib counts dates: days since 1970, UTC."""
    return at.timestamp() / 86_400.0
