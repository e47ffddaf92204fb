"""A history on the screen and as one JSON object."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from daq.config.cell import Cell
from daq.errors import ControllerUnfit
from daq.ledger.audit import AuditEntry
from daq.ledger.entry import Entry, Event, WriteAction
from daq.ledger.ledger import Verification
from daq.ledger.store import HistoryStore
from daq.ledger.watch import Point, Series, alarm_text, pattern_of, questions
from daq.report.gains import with_deviation
from daq.report.history import rows
from daq.report.text import printable
from daq.writeback.drive_record import drives_of
from daq.writeback.file_access import resolve_links
from daq.writeback.formats.document import decode, read_bytes
from daq.writeback.formats.scalar import Scalar, rewrite_gain
from ident.drift.change import CHART


def show(entries: Sequence[Entry], all_series: Sequence[Series], actions: Mapping[str, str], console: Console) -> None:
    """The calibrations, a line each, with what was done with each by its digest; then each gain as it is now."""
    if not entries:
        console.print("The history is empty: no calibration was applied or entered yet.")
        console.print("To enter one: drivegain history CELL --add CALIBRATION")
        return
    console.print(calibration_table(entries, all_series, actions))
    console.print()
    console.print(gain_table(all_series))
    say_alarms(all_series, console)


def show_axis(series: Series, all_series: Sequence[Series], actions: Mapping[str, str], console: Console) -> None:
    """Every calibration of one gain."""
    console.print(axis_table(series, actions))
    for noted in series.acknowledged:
        console.print(
            f"New baseline of {series.axis} from {noted.since:%Y-%m-%d %H:%M} on: {printable(noted.why)} "
            f"({printable(noted.who)}, {noted.at:%Y-%m-%d})"
        )
    words = alarm_text(series)
    if words is not None:
        say_alarms(all_series, console)
    elif series.drift is not None:
        console.print(f"No alarm. σ of the changes is {series.dispersion:.2f} × that of the fits.")


def say_alarms(all_series: Sequence[Series], console: Console) -> None:
    """Print what changed, and possible causes."""
    alarms = [words for series in all_series if (words := alarm_text(series)) is not None]
    console.print("No alarm." if not alarms else "")
    for words in alarms:
        console.print(f"ALARM: {words}", style="bold")
    for question in questions(all_series):
        console.print(question[0].upper() + question[1:])
    if alarms:
        console.print('When it is explained: drivegain history CELL --acknowledge AXIS --why "what happened"')


def calibration_table(entries: Sequence[Entry], all_series: Sequence[Series], actions: Mapping[str, str]) -> Table:
    """One row a calibration."""
    table = _table("recorded (UTC)", "calibration")
    table.add_column("error %", justify="right", no_wrap=True)
    table.add_column("largest change", justify="right", no_wrap=True)
    table.add_column("alarms", no_wrap=True)
    table.add_column("applied")
    changes = {
        (series.axis, point.entry.digest): (index, point)
        for series in all_series
        for index, point in enumerate(series.points)
    }
    for entry in sorted(entries, key=lambda one: one.recorded):
        points = [(s, *changes[s.axis, entry.digest]) for s in all_series if (s.axis, entry.digest) in changes]
        alarms = [s.axis for s, index, _ in points if s.alarm_at(index) is not None]
        error = entry.error_percent if entry.holdout_percent is None else entry.holdout_percent
        table.add_row(
            f"{entry.recorded:%Y-%m-%d %H:%M}",
            entry.digest[:8],
            f"{error:.2f}",
            _largest([point for _, _, point in points]),
            ", ".join(alarms) or "-",
            printable(actions[entry.digest]),
        )
    return table


def gain_table(all_series: Sequence[Series]) -> Table:
    """Each gain as it was found last, beside its baseline."""
    table = _table("axis")
    for heading in ("gain ± σ", "nameplate", "since baseline %", "σ", "state"):
        table.add_column(heading, justify="left" if heading == "state" else "right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for series in all_series:
        if not series.points:
            table.add_row(printable(series.axis), "not identified", "-", "-", "-", "-", printable(series.unit))
            continue
        gain, drift = series.points[-1].gain, series.drift
        count = len(series.points) - series.began
        known = drift is not None and count > 1
        state = (
            "ALARM" if series.alarmed else "ok" if count > CHART.baseline else f"baseline: {count} of {CHART.baseline}"
        )
        table.add_row(
            printable(series.axis),
            with_deviation(gain.value, gain.std),
            f"{gain.nameplate:.4g}",
            f"{drift.change_percent:+.2f}" if drift is not None and known else "-",
            f"{abs(drift.change_sigmas):.1f}" if drift is not None and known else "-",
            state,
            printable(series.unit),
        )
    return table


def axis_table(series: Series, actions: Mapping[str, str]) -> Table:
    """Every calibration of one gain, with the two sums and the slope that are watched."""
    table = _table("recorded (UTC)")
    headings = (f"{printable(series.axis)} [{printable(series.unit)}]", "change %", "σ", "CUSUM +", "CUSUM −", "trend")
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("alarm", no_wrap=True)
    table.add_column("applied")
    for index, point in enumerate(series.points):
        stretch = series.stretch_at(index)
        place = index - stretch.began
        alarm = series.alarm_at(index)
        table.add_row(
            f"{point.entry.recorded:%Y-%m-%d %H:%M}",
            with_deviation(point.gain.value, point.gain.std),
            "-" if point.change is None else f"{point.change.percent:+.2f}",
            "-" if point.change is None else f"{abs(point.change.sigmas):.1f}",
            f"{stretch.drift.upper[place]:.1f}",
            f"{stretch.drift.lower[place]:.1f}",
            f"{stretch.drift.trend[place]:+.1f}",
            "-" if alarm is None else alarm.kind.value,
            printable(actions[point.entry.digest]),
        )
    return table


def describe(
    cell: str,
    entries: Sequence[Entry],
    chosen: Sequence[Series],
    all_series: Sequence[Series],
    in_force: str | None,
) -> dict[str, Any]:
    """All of it for --json; `chosen` are the axes that were asked for."""
    return {
        "cell": cell,
        "calibrations": len(entries),
        "in_force": in_force,
        "chart": {
            "reference": CHART.reference,
            "threshold": CHART.threshold,
            "single": CHART.single,
            "trend": CHART.trend,
            "baseline": CHART.baseline,
        },
        "pattern": pattern_of(all_series).value,
        "questions": list(questions(all_series)),
        "axes": [
            {
                "axis": series.axis,
                "unit": series.unit,
                "dispersion": series.dispersion,
                "alarmed": series.alarmed,
                "alarm": alarm_text(series),
                "since": None if series.onset is None else series.onset.isoformat(),
                "change_percent": None if series.drift is None else series.drift.change_percent,
                "change_sigmas": None if series.drift is None else series.drift.change_sigmas,
                "baseline": None if series.drift is None else series.drift.baseline,
                "baseline_std": None if series.drift is None else series.drift.baseline_std,
                "acknowledged": [
                    {"since": a.since.isoformat(), "at": a.at.isoformat(), "who": a.who, "why": a.why}
                    for a in series.acknowledged
                ],
                "points": rows(series),
            }
            for series in chosen
        ],
    }


def say_verification(found: Verification, console: Console) -> None:
    """Print the state of audit log and history; flaws are in the error."""
    place, verdict = found.place, found.verdict
    console.print(f"{place.audit}: {len(verdict.entries)} entries, chain {'unbroken' if verdict.holds else 'BROKEN'}.")
    if verdict.torn:
        lines = ", ".join(map(str, verdict.torn))
        console.print(f"Unfinished lines, left by a writer that was killed: {lines}. They are no flaw.")
    for one in verdict.open_writes:
        begun = one.begun
        console.print(
            f"Line of entry {begun.number}: {begun.action.value} by {printable(begun.who)} at {begun.at} was never "
            f"ended; {printable(begun.subject)} was found {one.content.value}."
        )
    console.print(f"{place.store}: {'BROKEN' if found.broken else 'NOT COMPLETE' if found.unknown else 'sound'}.")


def describe_verification(found: Verification) -> dict[str, Any]:
    """Return the same for --json."""
    verdict = found.verdict
    return {
        "file": str(found.place.audit),
        "entries": len(verdict.entries),
        "holds": verdict.holds,
        "broken_line": verdict.broken,
        "flaws": [{"line": f.line, "flaw": f.flaw.value, "says": f.says} for f in verdict.flaws],
        "torn_lines": list(verdict.torn),
        "open_writes": [{**_described(one.begun), "content": one.content.value} for one in verdict.open_writes],
        "history_broken": [printable(one) for one in found.broken],
        "unknown_writes": [
            {**_described(one.ended), "action": one.ended.action.value, "calibration_sha256": one.calibration}
            for one in found.unknown
        ],
    }


def _described(entry: AuditEntry) -> dict[str, Any]:
    return {"number": entry.number, "at": entry.at, "who": entry.who, "file": entry.subject}


def _table(*first: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for heading in first:
        table.add_column(heading, no_wrap=True)
    return table


def _largest(points: Sequence[Point]) -> str:
    changes = [(abs(point.change.sigmas), point) for point in points if point.change is not None]
    if not changes:
        return "-"
    sigmas, point = max(changes, key=lambda pair: pair[0])
    percent = 0.0 if point.change is None else point.change.percent
    return f"{printable(point.gain.axis)} {percent:+.1f} % {sigmas:.1f} σ"


_WORDS = {WriteAction.APPLIED: "applied", WriteAction.ROLLED_BACK: "restored"}
"""Words for an event after which a controller had the gains of a calibration."""


def in_force(cell: Cell, store: HistoryStore) -> str | None:
    """Return the digest of the calibration whose gains this cell's own controller has.

    The controller's file is read: it may have been edited, or a backup copied back by hand, and a write to another file
    (`apply --to`) is not in this controller. Drives are not read; the last write of the history counts.

    Returns:
        None where the file has other numbers than every calibration, or cannot be read.
    """
    controller, file = cell.controller, cell.controller_path
    if controller is None:
        return None
    if file is None or not controller.gains:
        return store.in_force(drives_of(cell.name)) if controller.objects else None
    try:
        target = str(resolve_links(file))
        scalars = decode(read_bytes(file), str(file), controller.format).locate(controller.gains)
    except (ControllerUnfit, OSError):
        return None
    factors = controller.factors or (1.0,) * len(scalars)
    numbers = dict(zip(cell.axis_names, zip(scalars, factors, strict=True), strict=True))
    known, writes = store.in_force(target), [event.digest for event in store.events()]
    # Where several have these numbers: the one that the history names, else the one that was written last.
    order = [digest for digest in (known, *reversed(writes)) if digest is not None]
    having = [entry.digest for entry in reversed(store.entries()) if _has(entry, numbers)]
    return next((digest for digest in (*order, *having) if digest in having), None)


def describe_actions(entries: Sequence[Entry], events: Sequence[Event], digest_in_force: str | None) -> dict[str, str]:
    """Return the writes of each calibration in words, by its digest.

    Args:
        entries: the calibrations.
        events: of all controllers, oldest first.
        digest_in_force: see `in_force`.
    """
    return {entry.digest: _words(entry.digest, events, digest_in_force) for entry in entries}


def _words(digest: str, events: Sequence[Event], digest_in_force: str | None) -> str:
    mine = [place for place, event in enumerate(events) if event.digest == digest]
    parts = []
    if mine:
        last = events[mine[-1]]
        parts.append(f"{_WORDS[last.action]} by {last.who}")
        then = next((event for event in events[mine[-1] + 1 :] if event.target == last.target), None)
        if then is not None and then.action is WriteAction.ROLLED_BACK:
            parts.append(f"rolled back by {then.who}")
    if digest == digest_in_force:
        parts.append("in force")
    return ", ".join(parts) or "-"


def _has(entry: Entry, numbers: dict[str, tuple[Scalar, float]]) -> bool:
    """Whether a write of this calibration would change no number."""
    gains = {gain.axis: gain for gain in entry.gains}
    if gains.keys() != numbers.keys():
        return False
    for axis, (scalar, factor) in numbers.items():
        gain = gains[axis]
        if not (math.isfinite(gain.value) and math.isfinite(gain.std) and gain.value):
            return False
        try:
            put = rewrite_gain(scalar, gain.value, gain.std, factor)
        except ControllerUnfit:
            return False
        if put.new != put.old:
            return False
    return True
