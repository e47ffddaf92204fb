"""Salvage a recording that was never finished: its samples become a new log, marked partial."""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Iterable, Iterator
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
"""Events that a valid run may have; after any other a recorder might have marked it invalid."""


@dataclass(frozen=True, slots=True)
class Salvaged:
    """Result of a salvage."""

    log: Path  #: the new file
    #: of the new file; partial, and valid as far as samples and events show
    statistics: RunStatistics
    duration_s: float  #: duration of the samples [s]
    left_out_bytes: int  #: size of the damaged file from the first damaged byte
    #: Description of the damage, also where the file only ends too early; empty where the recording
    #: itself ends with its closing mark, and only the summary behind it is missing or damaged.
    damage: str


def salvage(
    damaged: Path, out: Path, progress: Callable[[int], None] = lambda _samples: None
) -> Salvaged:
    """Write everything before the damage of a log to a new log. The damaged file is only read.

    Args:
        damaged: a `.part` whose recorder died, or a log that was cut off or damaged later.
        out: the log to write; must not exist.
        progress: called with the number of samples so far.

    Raises:
        UsageError: the recorder still writes the file, the file is whole, or `out` is the name
            that the whole recording would have.
        UsageError, OutputFailed: the log cannot be written.
        LogUnreadable: not even one sample, or not the start of the log, can be saved; or samples or
            readings are of another number of axes than the cell.
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
        _refuse_whole(damaged)
    reader = LogReader(damaged)
    blocks = reader.until_damage()
    first_block = next(blocks, None)
    if first_block is None:
        if isinstance(reader.damage, LogTruncated):
            found = f"{reader.damage.found}, and no samples"
            raise _nothing_saved(damaged, found) from reader.damage
        if reader.damage is not None:
            raise reader.damage
        raise _nothing_saved(damaged, "no samples")
    head = reader.head
    cell = head.cell(damaged)
    scale = scaling(cell, head.readback)
    origin = f"{head.run.origin}; salvaged from {damaged.name}"
    run = replace(head.run, origin=origin)
    content = LogContent.of(cell, run, head.files, head.readback)
    # A crash loses only this new file, which can be made again. So a clock that stands still
    # flushes nothing, and an unfinished file is not kept.
    with LogWriter(
        out, content, scale.joint_position_of, clock_ns=lambda: 0, keeps_part=False
    ) as log:
        _copy(reader, chain((first_block,), blocks), log, cell, progress)
    damage = ""
    left_out_bytes = 0
    if reader.damage is not None:
        damage = f"{reader.damage.subject}: {reader.damage.found}"
        left_out_bytes = damaged.stat().st_size - reader.whole_bytes
    return Salvaged(
        log=out,
        statistics=log.statistics,
        duration_s=log.statistics.samples / run.rate_hz,
        left_out_bytes=left_out_bytes,
        damage=damage,
    )


def _copy(
    reader: LogReader,
    blocks: Iterable[SampleBlock],
    log: LogWriter,
    cell: Cell,
    progress: Callable[[int], None],
) -> None:
    """Copy samples, events and slow readings to the new log, and conclude it with a verdict.

    Raises:
        LogIncomplete: samples or readings are of another number of axes than the cell.
    """
    copied_events = 0
    copied_readings = 0
    axes = len(cell.axes)
    watch = MotionWatch(cell, reader.head)
    for block in chain(blocks, (None,)):  # events and readings may follow the last samples
        for event in reader.events[copied_events:]:
            log.event(event)
        copied_events = len(reader.events)
        new_readings = reader.readings[copied_readings:]
        foreign_axes = {reading.axis for reading in new_readings if reading.axis >= axes}
        if foreign_axes:
            found = f"a torque or temperature of axis {max(foreign_axes)}, counted from 0"
            raise _foreign(reader.path, found, f"those of {axes} axes")
        log.readings(new_readings)
        copied_readings = len(reader.readings)
        if block is None:
            break
        width = block.position_counts.shape[1]
        if width != axes:
            raise _foreign(reader.path, f"samples of {width} axes", f"{axes}")
        watch.take(block)
        for sample in _samples(block):
            log.write(sample)
        progress(log.statistics.samples)
    if reader.concluded:
        faults = _faults_of_recorder(reader)
    else:
        faults = _faults_of_samples(reader, log.statistics)
    # The watch takes only the verdict of these statistics: the recorder's, or else that of the
    # samples and events.
    judged = RunStatistics(0, 0, (), valid=not faults, reason=", ".join(faults))
    valid, reason = watch.verdict(
        reader.checks, judged, lambda: LogReader(reader.path).until_damage()
    )
    log.conclude(valid, reason, partial=True)


def _samples(block: SampleBlock) -> Iterator[Sample]:
    """Yield the samples of a block, with numbers of Python."""
    columns = zip(
        block.cycle.tolist(),
        block.time_ns.tolist(),
        block.position_counts.tolist(),
        block.current_raw.tolist(),
        block.statusword.tolist(),
        block.missing.tolist(),
        strict=True,
    )
    for cycle, time_ns, position_counts, current_raw, statusword, missing in columns:
        yield Sample(
            cycle=cycle,
            time_ns=time_ns,
            position_counts=tuple(position_counts),
            current_raw=tuple(current_raw),
            statusword=tuple(statusword),
            missing=missing,
        )


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


def _refuse_whole(log: Path) -> None:
    """Refuse a log that can be read to its end.

    Raises:
        UsageError: it can.
    """
    try:
        for _ in LogReader(log):
            pass
    except LogUnreadable:
        return
    raise UsageError(
        str(log),
        found="a whole log",
        expected="a damaged or unfinished one",
        remedy="use it as it is",
    )


def _refuse_running(damaged: Path) -> None:
    """Refuse a file that its recorder still has locked; a file system may have no locks.

    Raises:
        UsageError: it is locked.
    """
    with suppress(OSError), open_regular(damaged) as stream:
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
