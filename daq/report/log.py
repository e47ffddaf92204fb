"""Reports of the verbs that write a log,
and the contents of one as `drivegain info` shows them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text

from daq.config.cell_buses import bus_loads
from daq.log.metadata import RECORDED
from daq.log.motion import judge_log
from daq.report.bus_views import current_signals
from daq.report.document import Figure, Report
from daq.report.text import entry_lines, printable
from drivers.messages import EventKind

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.log.bag_writer import BagWritten
    from daq.log.export import Exported, TableFormat
    from daq.log.importing import Imported
    from daq.log.metadata import RunInfo, Timing
    from daq.log.salvage import Salvaged
    from daq.workflow.record import Recorded


class BusLoadEntry(Report):
    """Load of one bus [%]."""

    bus: str
    mean_percent: float
    worst_percent: float


class NewLog(Report):
    """A log that was written, with its losses."""

    log: str
    samples: int
    lost_cycles: int
    missing: list[int]
    """samples without an answer, an axis each"""
    valid: bool
    reason: str
    """why it is not valid"""


class RecordReport(NewLog):
    """`record`."""

    warnings: list[str]
    bus_load: list[BusLoadEntry]


class StampSummary(Report):
    """Time stamps of an imported recording, and the uniform clock that its log has."""

    rows: int
    rate_hz: float
    usual_step_s: float
    longest_step_s: float
    jitter_s: float
    """standard deviation of the steps, missing samples apart"""
    drift_s: float
    """largest distance of a stamp from a uniform clock that starts with the first one"""
    missing: int
    """samples between the first and the last that were interpolated"""
    resampled: bool
    """whether the samples were moved to a uniform clock"""
    duplicates: int
    """rows that repeat the one before and were left out"""
    close: int
    """samples too close to the one before to give a speed, which were left out"""
    started_s: Figure
    """first stamp by the file's clock; null before zero, as of a trigger's"""


class MountedPayload(Report):
    """Payload of a log."""

    name: str
    mounting: str
    known: dict[str, float]


class LogEvent(Report):
    """Event of a recording that is no routine."""

    time_ns: int
    axis: int | None
    """index from 0; null for the cell"""
    kind: str
    code: int
    text: str


class InfoReport(Report):
    """`info`."""

    log: str
    sha256: str
    run_id: str
    cell: str
    cell_sha256: str
    axes: list[str]
    current: dict[str, str]
    """by axis: what was recorded as its current, an object of its drive or a column of a file"""
    role: str
    payload: MountedPayload | None
    rate_hz: float
    speed: float
    """speed of the moves as a share of the plan's"""
    samples: int
    duration_s: float
    stamped_duration_s: float
    """from the first stamp to the last; `duration_s` counts the samples"""
    moves: int
    slow_readings: dict[str, int]
    lost_cycles: int
    missing: dict[str, int]
    partial: bool
    valid: bool
    reason: str
    events: list[LogEvent]
    operator: str
    software: str
    started: str | None
    wall_minus_monotonic_s: float
    wall_clock_step_s: Figure
    """how far the wall clock was set during the run; null where it was not read at the end"""
    origin: str
    timing: StampSummary | None
    attachments: dict[str, int]
    """size of each [bytes]"""


class HoldoutLog(Report):
    """The log of the held-out part of an import."""

    log: str
    samples: int


class ImportReport(NewLog):
    """`import`."""

    partial: bool
    wall_minus_monotonic_ns: int | None
    timing: StampSummary | None
    remarks: list[str]
    holdout: HoldoutLog | None


class SalvageReport(Report):
    """`salvage`."""

    log: str
    partial: bool
    samples: int
    duration_s: float
    lost_cycles: int
    missing: list[int]
    """samples without an answer, an axis each"""
    valid: bool
    reason: str
    """why it is not valid"""
    left_out_bytes: int
    """size of the damaged file from the first damaged byte"""
    damage: str
    """empty where only the summary at the end of the file is missing or damaged"""


class TableReport(Report):
    """`export log`."""

    log: str
    table: str
    format: str
    rows: int
    columns: list[str]
    partial: bool
    valid: bool


class BagReport(Report):
    """`export bag`."""

    log: str
    bag: str
    duration_s: float
    messages: dict[str, int]
    effort: bool
    partial: bool
    valid: bool


_ROUTINE = {EventKind.MOVE_START, EventKind.MOVE_END, EventKind.NMT, EventKind.STATE}
"""Events of every run; all others are shown."""


def record_report(path: Path, recorded: Recorded, cell: Cell) -> RecordReport:
    """Return a finished recording: the log with its losses, warnings about the currents,
    and the load of the buses.
    """
    loads = []
    for bus, load in bus_loads(cell):
        entry = BusLoadEntry(
            bus=bus.name, mean_percent=100 * load.mean, worst_percent=100 * load.worst
        )
        loads.append(entry)
    statistics = recorded.log
    return RecordReport.of(statistics, recorded, log=path, bus_load=loads)


def import_report(path: Path, imported: Imported, holdout: Path | None) -> ImportReport:
    """Return the log of an import with its losses, what its time stamps show,
    and the log of its held-out part.

    Args:
        path: of the log.
        imported: with or without a held-out part.
        holdout: the log of that part; None where there is none.

    Raises:
        ValueError: there is such a part, and no path of its log.
    """
    held_out = None
    if imported.holdout is not None:
        if holdout is None:
            raise ValueError("found no path of the log of the held-out part; expected one")
        held_out = HoldoutLog(log=str(holdout), samples=imported.holdout.samples)
    return ImportReport.of(imported.statistics, imported, log=path, holdout=held_out)


def salvage_report(path: Path, saved: Salvaged) -> SalvageReport:
    """Return the log of a salvage with its losses, and what was left out."""
    return SalvageReport.of(saved.statistics, saved, log=path)


def table_report(log: Path, table: Path, kind: TableFormat, written: Exported) -> TableReport:
    """Return the table that was made of a log."""
    return TableReport.of(written, log=log, table=table, format=kind)


def bag_report(log: Path, bag: Path, written: BagWritten, *, effort: bool) -> BagReport:
    """Return the bag that was made of a log;
    `effort` says whether a calibration gave its joint states efforts.
    """
    return BagReport.of(written, log=log, bag=bag, effort=effort)


def info_report(path: Path) -> InfoReport:
    """Read everything known of a log, in one pass and bounded memory.

    Raises:
        LogUnreadable: the log cannot be read, or its parts contradict each other.
        ConfigurationError: the cell in it is inconsistent.
    """
    reader, cell, (valid, reason) = judge_log(path)
    head = reader.head
    statistics = reader.statistics
    run = head.run
    samples = reader.checks.samples
    # How far the wall clock was set during the run; it may not have been read at the end
    clock_step_s = None
    if statistics.wall_minus_monotonic_ns is not None:
        clock_step_s = (statistics.wall_minus_monotonic_ns - run.wall_minus_monotonic_ns) * 1e-9
    started = None
    if run.started_wall_ns:
        started = datetime.fromtimestamp(run.started_wall_ns / 1e9, UTC)
    return InfoReport.of(
        run,
        statistics,
        log=path,
        sha256=reader.digest,
        cell=cell.name,
        cell_sha256=cell.digest,
        axes=cell.axis_names,
        current=_recorded_currents(run, cell),
        samples=samples,
        duration_s=samples / run.rate_hz,
        stamped_duration_s=reader.checks.span_ns * 1e-9,
        moves=sum(event.kind is EventKind.MOVE_START for event in reader.events),
        slow_readings=Counter(reading.quantity.value for reading in reader.readings),
        missing=dict(zip(cell.axis_names, statistics.missing, strict=True)),
        partial=reader.partial,
        valid=valid,
        reason=reason,
        events=[event for event in reader.events if event.kind not in _ROUTINE],
        started=started,
        wall_minus_monotonic_s=run.wall_minus_monotonic_ns * 1e-9,
        wall_clock_step_s=clock_step_s,
        attachments={name: len(data) for name, data in sorted(head.files.items())},
    )


def _recorded_currents(run: RunInfo, cell: Cell) -> dict[str, str]:
    """Return what the current of each axis is: an object of its drive, or a column of a file."""
    currents = current_signals(cell)
    if run.origin.startswith(RECORDED):
        return currents
    # Its cell file names objects of drives, but no drive was read for an import.
    return dict.fromkeys(currents, "a column of the imported file")


def timing_text(timing: Timing) -> str:
    """Describe the time stamps of an import, for a sentence."""
    parts = [
        f"usual step {1e3 * timing.usual_step_s:.6g} ms, longest "
        f"{1e3 * timing.longest_step_s:.6g} ms",
        f"jitter {1e3 * timing.jitter_s:.3f} ms",
        f"drift {1e3 * timing.drift_s:.3f} ms",
    ]
    counts = (
        (timing.missing, "missing and interpolated"),
        (timing.duplicates, "duplicated and dropped"),
        (timing.close, "too close to the one before and dropped"),
    )
    parts += [f"{count} {text}" for count, text in counts if count]
    clock = "uniform at"
    if timing.resampled:
        clock = "resampled to"
    # Seven digits: a rate of 1 MHz would be written with an exponent otherwise.
    return f"{clock} {timing.rate_hz:.7g} Hz: {', '.join(parts)}"


FOR_PROGRAMS = frozenset({"wall_minus_monotonic_s"})
"""Keys that a person has no use for: the offset of two clocks. Its change during the run, which a
person may want, is `wall_clock_step_s`.
"""


def log_lines(description: Mapping[str, Any], width: int) -> Iterator[Text]:
    """Yield the lines of a log's description, at most `width` columns wide where words allow it."""
    shown = {key: value for key, value in description.items() if key not in FOR_PROGRAMS}
    indent = max(map(len, shown)) + 2
    for key, value in shown.items():
        name = key.replace("_", " ")
        text = printable(_readable(value)).replace("\n", " ")
        for line in entry_lines(name, text, indent, width):
            yield Text(line)


def _yes_or_no(value: bool) -> str:
    if value:
        return "yes"
    return "no"


def _readable(value: Any) -> str:
    if value is None or value in ("", [], {}):
        return "-"
    if isinstance(value, bool):
        return _yes_or_no(value)
    if isinstance(value, float):
        return _readable_float(value)
    if isinstance(value, dict):
        return ", ".join(f"{key} {_readable(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(_readable(item) for item in value)
    return str(value)


def _readable_float(value: float) -> str:
    # People read large numbers better without an exponent: 1234567.8 s is 1234568, not
    # 1.23457e+06.
    rounded = f"{value:.0f}"
    if len(rounded) > 6 and abs(value) < 1e15:
        return rounded
    return f"{value:g}"
