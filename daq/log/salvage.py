"""Salvage a recording that was never finished: its samples become a new log, marked partial."""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from daq.config.cell import Cell
from daq.errors import LogIncomplete, LogTruncated, LogUnreadable, UsageError
from daq.files import open_regular
from daq.log.container import UNFINISHED
from daq.log.conversion import scaling
from daq.log.metadata import RunStatistics
from daq.log.motion import MotionWatch
from daq.log.reader import LogReader, SampleBlock
from daq.log.writer import LogContent, LogWriter
from drivers.messages import EventKind, Sample

_HARMLESS = (
    EventKind.EMCY_RESET,
    EventKind.NMT,
    EventKind.STATE,
    EventKind.LIMIT,
    EventKind.MOVE_START,
    EventKind.MOVE_END,
    EventKind.CAPTURE,
    EventKind.STOP,
)
"""Events of sound runs; after any other a recorder might have marked the run invalid."""


@dataclass(frozen=True, slots=True)
class Salvaged:
    """Result of a salvage."""

    log: Path  #: the new file
    #: of the new file; partial, and valid as far as samples and events show
    statistics: RunStatistics
    duration_s: float  #: duration of the samples [s]
    left_out_bytes: int  #: size of the damaged file from the first damaged byte
    damage: str  #: description of the damage; empty if only the end of the file is missing


def salvage(
    damaged: Path, out: Path, progress: Callable[[int], None] = lambda _samples: None
) -> Salvaged:
    """Write everything before the damage of a log to a new log. The damaged file is only read.

    Args:
        damaged: a `.part` whose recorder died, or a log that was cut off or damaged later.
        out: the log to write; must not exist.
        progress: called with the number of samples so far.

    Raises:
        UsageError: the recorder still writes the file, or the file is whole.
        UsageError, OutputFailed: the log cannot be written.
        LogUnreadable: not even one sample, or not the start of the log, can be saved.
        ConfigurationError: the cell configuration in it is inconsistent.
    """
    _refuse_running(damaged)
    if damaged == out.with_name(out.name + UNFINISHED):
        raise UsageError(
            str(out),
            found="the name of the whole recording",
            expected="a name that shows that it is partial",
            remedy=f"choose another --out, such as {out.stem}-partial{out.suffix}",
        )
    if not damaged.name.endswith(UNFINISHED):
        with suppress(LogUnreadable):
            for _ in LogReader(damaged):
                pass
            expected = "a damaged or unfinished one"
            raise UsageError(
                str(damaged), found="a whole log", expected=expected, remedy="use it as it is"
            )
    reader = LogReader(damaged)
    blocks = reader.until_damage()
    first = next(blocks, None)
    if first is None and isinstance(reader.damage, LogTruncated):
        raise _nothing_saved(damaged, f"{reader.damage.found}, and no samples") from reader.damage
    if first is None:
        raise reader.damage or _nothing_saved(damaged, "no samples")
    head = reader.head
    cell = head.cell(damaged)
    scale = scaling(cell, head.readback)
    origin = f"{head.run.origin}; salvaged from {damaged.name}"
    run = replace(head.run, origin=origin)
    content = LogContent.of(cell, run, head.files, head.readback)
    # A crash loses only this new file, so no clock is needed to flush in time.
    with LogWriter(
        out, content, scale.joint_position_of, clock_ns=lambda: 0, keeps_part=False
    ) as log:
        _copy(reader, chain((first,), blocks), log, cell, progress)
    size = damaged.stat().st_size
    damage = ""
    bytes_left_out = 0
    if reader.damage is not None:
        damage = f"{reader.damage.subject}: {reader.damage.found}"
        bytes_left_out = size - reader.whole_bytes
    duration_s = log.statistics.samples / run.rate_hz
    return Salvaged(out, log.statistics, duration_s, bytes_left_out, damage)


def _copy(
    reader: LogReader,
    blocks: Iterable[SampleBlock],
    log: LogWriter,
    cell: Cell,
    progress: Callable[[int], None],
) -> None:
    known_events = 0
    known_readings = 0
    axes = len(cell.axes)
    watch = MotionWatch(cell, reader.head)
    for block in chain(blocks, (None,)):  # events and readings may follow the last samples
        for event in reader.events[known_events:]:
            log.event(event)
        known_events = len(reader.events)
        fresh = reader.readings[known_readings:]
        foreign = {reading.axis for reading in fresh if reading.axis >= axes}
        if foreign:
            surplus = f"a torque or temperature of axis {max(foreign)}, counted from 0"
            raise _foreign(reader.path, surplus, f"those of {axes} axes")
        log.readings(fresh)
        known_readings = len(reader.readings)
        if block is None:
            break
        width = block.position_counts.shape[1]
        if width != axes:
            raise _foreign(reader.path, f"samples of {width} axes", f"{axes}")
        watch.take(block)
        columns = (getattr(block, name).tolist() for name in SampleBlock.__slots__)
        for cycle, time_ns, position, current, statusword, missing in zip(*columns, strict=True):
            sample = Sample(
                cycle=cycle,
                time_ns=time_ns,
                position_counts=tuple(position),
                current_raw=tuple(current),
                statusword=tuple(statusword),
                missing=missing,
            )
            log.write(sample)
        progress(log.statistics.samples)
    if reader.concluded:
        faults = _faults_of_recorder(reader)
    else:
        faults = _faults_of_samples(reader, log.statistics)
    judged = RunStatistics(0, 0, (), valid=not faults, reason=", ".join(faults))
    verdict = watch.verdict(reader.checks, judged, lambda: LogReader(reader.path).until_damage())
    log.conclude(*verdict, partial=True)


def _faults_of_recorder(reader: LogReader) -> list[str]:
    """Return why the recorder's own verdict, or what contradicts it, makes a log invalid."""
    if not reader.statistics.valid:
        return [reader.statistics.reason or "no reason given"]
    contradiction = reader.contradiction
    if contradiction is None:
        return []
    return [f"{contradiction.found}; expected {contradiction.expected}"]


def _faults_of_samples(reader: LogReader, statistics: RunStatistics) -> list[str]:
    """Return the losses and the first three faults in samples and events,
    where the recorder left no verdict.
    """
    faults = []
    if statistics.lost_cycles:
        faults.append(f"{statistics.lost_cycles} cycles lost")
    if any(statistics.missing):
        faults.append(f"{sum(statistics.missing)} missing answers")
    harmful = [event for event in reader.events if event.kind not in _HARMLESS]
    faults += [f"{event.kind.value} ({event.text})" for event in harmful[:3]]
    return faults


def _foreign(path: Path, found: str, expected: str) -> LogIncomplete:
    return LogIncomplete(
        str(path),
        found=found,
        expected=f"{expected}, as in its cell configuration",
        remedy="it is not a recording of this software",
    )


def _refuse_running(damaged: Path) -> None:
    with suppress(OSError), open_regular(damaged) as stream:  # also of a file system without locks
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(
                str(damaged),
                found="a recording that still runs",
                expected="one whose recorder has ended",
                remedy="wait for its end, or interrupt it with Ctrl-C, which stops the axes",
            ) from error


def _nothing_saved(damaged: Path, found: str) -> LogIncomplete:
    return LogIncomplete(
        str(damaged),
        found=found,
        expected="at least one sample",
        remedy="nothing can be saved: record the run again",
    )
