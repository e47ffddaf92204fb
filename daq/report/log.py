"""The contents of a log, as `drivegain info` shows them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.text import Text

from daq.config.cell import Cell
from daq.config.cell_buses import bus_loads
from daq.config.cell_file import cell_from_bundle
from daq.log.metadata import Timing
from daq.log.motion import MotionWatch, log_verdict
from daq.log.reader import LogReader
from daq.report.bus_views import current_signals
from daq.report.log_schemas import BusLoadEntry, RecordReport
from daq.report.text import entry_lines, picked, printable
from daq.workflow.record import Recorded
from drivers.messages import EventKind

_ROUTINE = {EventKind.MOVE_START, EventKind.MOVE_END, EventKind.NMT, EventKind.STATE}
"""Events of every run; all others are shown."""


def record_report(path: Path, recorded: Recorded, cell: Cell) -> RecordReport:
    """Return a finished recording: the log with its losses, warnings about the currents, and the load of the buses."""
    statistics = recorded.log
    return RecordReport(
        log=str(path),
        samples=statistics.samples,
        lost_cycles=statistics.lost_cycles,
        missing=list(statistics.missing),
        valid=statistics.valid,
        reason=statistics.reason,
        warnings=list(recorded.warnings),
        bus_load=[
            BusLoadEntry(bus=bus.name, mean_percent=100 * load.mean, worst_percent=100 * load.worst)
            for bus, load in bus_loads(cell)
        ],
    )


def describe_log(path: Path) -> dict[str, Any]:
    """Read everything known of a log, in one pass and bounded memory.

    Raises:
        LogUnreadable: the log cannot be read, or its parts contradict each other.
        ConfigurationError: the cell in it is inconsistent.
    """
    reader = LogReader(path)
    first_ns: int | None = None
    last_ns = 0
    watch: MotionWatch | None = None
    for block in reader:
        if watch is None:
            first_ns = int(block.time_ns[0])
            cell = cell_from_bundle(reader.head.files, names={"cell.yaml": f"{path}, cell.yaml"})
            watch = MotionWatch(cell, reader.head)
        watch.take(block)
        last_ns = int(block.time_ns[-1])
    assert first_ns is not None  # the reader refuses a log without samples
    assert watch is not None
    head, statistics = reader.head, reader.statistics
    run, samples = head.run, reader.checks.samples
    valid, reason = log_verdict(cell, head, reader.checks, statistics, watch, lambda: LogReader(path))
    return {
        "log": str(path),
        "sha256": reader.digest,
        "run_id": run.run_id,
        "cell": cell.name,
        "cell_sha256": cell.digest,
        "axes": list(cell.axis_names),
        "current": current_signals(cell),
        "role": run.role.value,
        "payload": None if run.payload is None else picked(run.payload, "name", "mounting", "known"),
        **picked(run, "rate_hz", "speed"),
        "samples": samples,
        "duration_s": samples / run.rate_hz,
        "stamped_duration_s": (last_ns - first_ns) * 1e-9,
        "moves": sum(event.kind is EventKind.MOVE_START for event in reader.events),
        "slow_readings": dict(Counter(reading.quantity.value for reading in reader.readings)),
        "lost_cycles": statistics.lost_cycles,
        "missing": dict(zip(cell.axis_names, statistics.missing, strict=True)),
        "partial": reader.partial,
        "valid": valid,
        "reason": reason,
        "events": [
            {"time_ns": e.time_ns, "axis": e.axis, "kind": e.kind.value, "code": e.code, "text": e.text}
            for e in reader.events
            if e.kind not in _ROUTINE
        ],
        **picked(run, "operator", "software"),
        "started": datetime.fromtimestamp(run.started_wall_ns / 1e9, UTC).isoformat() if run.started_wall_ns else None,
        "wall_minus_monotonic_s": run.wall_minus_monotonic_ns * 1e-9,
        "wall_clock_step_s": None
        if statistics.wall_minus_monotonic_ns is None
        else (statistics.wall_minus_monotonic_ns - run.wall_minus_monotonic_ns) * 1e-9,
        "origin": run.origin,
        "timing": None if run.timing is None else asdict(run.timing),
        "attachments": {name: len(data) for name, data in sorted(head.files.items())},
    }


def timing_text(timing: Timing) -> str:
    """Describe the time stamps of an import in a sentence: `stamps at 90.9 Hz: steps of 12 ms at most, ...`."""
    parts = [
        f"usual step {1e3 * timing.usual_step_s:.6g} ms, longest {1e3 * timing.longest_step_s:.6g} ms",
        f"jitter {1e3 * timing.jitter_s:.3g} ms",
        f"drift {1e3 * timing.drift_s:.3g} ms",
    ]
    counts = (
        (timing.missing, "missing and interpolated"),
        (timing.duplicates, "duplicated and dropped"),
        (timing.close, "too close to the one before and dropped"),
    )
    parts += [f"{count} {text}" for count, text in counts if count]
    return f"{'resampled to' if timing.resampled else 'uniform at'} {timing.rate_hz:.6g} Hz: {', '.join(parts)}"


def log_lines(description: Mapping[str, Any], width: int) -> Iterator[Text]:
    """Lines of a log's description, at most `width` columns wide where words allow it."""
    indent = max(map(len, description)) + 2
    for key, value in description.items():
        text = printable(_readable(value)).replace("\n", " ")
        yield from map(Text, entry_lines(key.replace("_", " "), text, indent, width))


def _readable(value: Any) -> str:
    if value is None or value in ("", [], {}):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_readable(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(_readable(item) for item in value)
    return str(value)
