"""Read a log into arrays: every chunk of samples is one `frombuffer`,
without a Python loop over messages.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Chunk, Header, Metadata
from numpy.typing import NDArray

from daq.arguments import A_PATH, checks_arguments
from daq.config.cell import Cell
from daq.config.cell_file import cell_from_bundle
from daq.config.yaml_file import MAX_BYTES
from daq.errors import (
    ClockImplausible,
    CyclesLost,
    DataError,
    LogIncomplete,
    LogMissing,
    LogUnreadable,
)
from daq.log.container import UNFINISHED, ChunkContents, PlacedRecord, RecordArray, RecordFile
from daq.log.mcap_bag import foreign_recording
from daq.log.message import ENCAPSULATION_WORD, LARGEST_AXES, SAMPLES_TOPIC, RawArray
from daq.log.metadata import (
    READBACK,
    RUN,
    SEAL,
    STATISTICS,
    Readback,
    RunInfo,
    RunStatistics,
    readback_from_bytes,
    run_from_record,
    statistics_from_record,
    unsealed,
)
from drivers.messages import CellEvent, SlowReading
from ident.arrays import IntArray

BLOCK_SAMPLES = 4096  #: Samples of a block; at most these and one chunk are in memory
LARGEST_ENTRIES = 1000  #: Attachments and metadata of a log; those of the shipped cells are a dozen
LARGEST_METADATA = 2**20  #: Characters of one metadata record; ours have a few hundred
STEP_TOLERANCE = 0.5
"""Largest deviation of a time step, as a share of the period.

From half a period on it could be another cycle.
"""
#: From this step on no SYNC came late: a recorder would have counted the cycles in between as lost
NO_LATE_SYNC_NS = 1_000_000_000
#: Largest relative difference between the requested rate and that of the time stamps
RATE_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class SampleBlock:
    """Samples of k cycles, in the order of the log."""

    cycle: NDArray[np.uint64]  #: number of the sampling period, shape (k,), uint64
    time_ns: IntArray  #: time of the SYNC [ns], shape (k,), int64
    position_counts: RawArray  #: shape (k, n), int32
    current_raw: RawArray  #: shape (k, n), int32
    statusword: NDArray[np.uint16]  #: shape (k, n), uint16
    missing: NDArray[np.uint32]  #: bit i for axis i, shape (k,), uint32


@dataclass(frozen=True, slots=True)
class LogHead:
    """Everything before the samples."""

    run: RunInfo  #: facts about the recording
    readback: Readback  #: answers of the amplifiers
    files: Mapping[str, bytes]  #: all attachments by name, with the cell's bundle

    def cell(self, log: Path) -> Cell:
        """Return the cell of the log, which is named in messages.

        Raises:
            ConfigurationError: its configuration is inconsistent.
        """
        return cell_from_bundle(self.files, names={"cell.yaml": f"{log}, cell.yaml"})


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """A whole log."""

    path: Path  #: file
    digest: str  #: its SHA-256, hexadecimal
    head: LogHead  #: everything before the samples
    samples: SampleBlock  #: all samples
    events: tuple[CellEvent, ...]  #: in the order of the log
    #: torques and temperatures read alongside the samples, in the order of the log
    readings: tuple[SlowReading, ...]
    statistics: RunStatistics  #: the recorder's summary at the end
    #: the end of the recording is unknown: it was salvaged, or never got its final name
    partial: bool


class SampleChecks:
    """Counts, cycles and time steps of a log's samples, block by block in bounded memory."""

    def __init__(self, path: Path) -> None:
        """Store the path, for messages."""
        self.samples = 0  #: number of samples
        self.lost_cycles = 0  #: cycles missing between them
        #: samples without an answer, for each axis
        self.missing = np.zeros(LARGEST_AXES, dtype=np.int64)
        self.widths: set[int] = set()  #: numbers of axes of the samples
        self._path = path
        self._highest = np.zeros(0, dtype=np.uint64)
        self._last = np.zeros(0, dtype=np.uint64), np.zeros(0, dtype=np.int64)
        self._first_ns = 0
        self._gaps = 0
        self._first_gap = ""
        self._steps: dict[int, str] = {}  # the shortest and the longest [ns], with their cycles

    def take(self, block: SampleBlock) -> None:
        """Count the next samples."""
        if not len(block.cycle):
            return
        if not self.samples:
            self._first_ns = int(block.time_ns[0])
        self.samples += len(block.cycle)
        self.widths.add(block.position_counts.shape[1])
        missing = block.missing[block.missing != 0]
        if missing.size:
            for axis in range(LARGEST_AXES):
                is_missing = missing >> np.uint32(axis) & 1
                self.missing[axis] += np.count_nonzero(is_missing)
        cycles = np.concatenate((self._highest, block.cycle))
        highest = np.maximum.accumulate(cycles)
        advance = np.diff(highest)
        jumps = advance[advance > 1].tolist()
        self.lost_cycles += sum(jumps) - len(jumps)
        self._highest = highest[-1:]
        last_cycle, last_ns = self._last
        cycle = np.concatenate((last_cycle, block.cycle))
        time_ns = np.concatenate((last_ns, block.time_ns))
        self._last = cycle[-1:], time_ns[-1:]
        if len(cycle) < 2:
            return
        gaps = np.flatnonzero(np.diff(cycle) != 1)
        if gaps.size and not self._gaps:
            before = gaps[0]
            self._first_gap = f"cycle {cycle[before + 1]} after {cycle[before]}"
        self._gaps += gaps.size
        step_ns = np.diff(time_ns)
        for place in (int(np.argmin(step_ns)), int(np.argmax(step_ns))):
            cycles_of_step = f"cycle {cycle[place + 1]} {{}} after cycle {cycle[place]}"
            self._steps.setdefault(int(step_ns[place]), cycles_of_step)
        extremes_ns = (min(self._steps), max(self._steps))
        self._steps = {step_ns: self._steps[step_ns] for step_ns in extremes_ns}

    @property
    def span_ns(self) -> int:
        """Time from the first sample to the last [ns]."""
        return int(self._last[1][0]) - self._first_ns

    def contradiction(
        self, head: LogHead, statistics: RunStatistics, readings: Iterable[SlowReading]
    ) -> LogIncomplete | None:
        """Return the error for a log whose parts contradict each other;
        None for a sound one, lossy or not.
        """
        axes = len(head.readback.axes)
        missing = tuple(self.missing[:axes].tolist())
        widths = ", ".join(map(str, sorted(self.widths)))
        foreign_axes = [reading.axis for reading in readings if reading.axis >= axes]
        if not self.samples:
            found = "no samples"
            expected = f"some on {SAMPLES_TOPIC}"
        elif not self.widths <= {axes}:
            found = f"samples of {widths} axes"
            expected = f"{axes}, as in its readback"
        elif foreign_axes:
            found = f"a torque or temperature of axis {max(foreign_axes)}, counted from 0"
            expected = f"those of {axes} axes, as in its readback"
        elif self.samples != statistics.samples:
            found = f"{self.samples} samples"
            expected = f"{statistics.samples}, as its recorder counted"
        elif self.lost_cycles != statistics.lost_cycles:
            found = f"{self.lost_cycles} lost cycles"
            expected = f"{statistics.lost_cycles}, as its recorder counted"
        elif len(statistics.missing) != axes:
            found = f"losses of {len(statistics.missing)} axes"
            expected = f"{axes}"
        elif missing != statistics.missing:
            found = f"{list(missing)} missing answers of its axes"
            expected = f"{list(statistics.missing)}, as its recorder counted"
        else:
            return None
        remedy = "another tool may have cut or changed the log; take the original, or record again"
        return LogIncomplete(str(self._path), found=found, expected=expected, remedy=remedy)

    def fault(self, rate_hz: float) -> DataError | None:
        """Return why no fit takes these samples:
        lost or repeated cycles, uneven time steps, another rate.
        """
        path = str(self._path)
        if self.samples < 2:
            return CyclesLost(path, found="one sample", expected="a run", remedy="record it again")
        if self._gaps:
            return CyclesLost(
                path,
                found=f"{self._first_gap} ({self._gaps} gaps)",
                expected="every SYNC cycle once",
                remedy="record again with less load on the bus and the computer; lost cycles are "
                "never interpolated",
            )
        period_ns = 1e9 / rate_hz
        step_ns = max(self._steps, key=lambda step_ns: abs(step_ns - period_ns))
        # Central differences assume evenly spaced samples.
        if abs(step_ns - period_ns) > STEP_TOLERANCE * period_ns:
            return self._uneven(step_ns, period_ns)
        stamped_hz = (self.samples - 1) * 1e9 / self.span_ns
        if abs(stamped_hz / rate_hz - 1.0) > RATE_TOLERANCE:
            return ClockImplausible(
                path,
                found=f"time stamps at {stamped_hz:.6g} Hz",
                expected=f"{rate_hz:.6g} Hz, as requested",
                remedy="was the computer's clock set during the run? record it again",
            )
        return None

    def _uneven(self, step_ns: int, period_ns: float) -> ClockImplausible:
        """Error for the most uneven step of the stamps.

        A recorder stamps by a monotonic clock, and counts a period without SYNC as a lost cycle.
        """
        step = f"{step_ns * 1e-6:.4g} ms"
        remedy = (
            "SYNC came late: record again with less load on the computer, or with a longer "
            "sync.period_us"
        )
        if abs(step_ns) >= NO_LATE_SYNC_NS:
            step = f"{step_ns * 1e-9:.4g} s"
        if not 0 < step_ns < NO_LATE_SYNC_NS:
            remedy = (
                "a recorder's stamps go on evenly, whatever the clock of its computer: another "
                "tool has changed the log; take the original, or record again"
            )
        period_ms = period_ns * 1e-6
        found = self._steps[step_ns].format(step)
        return ClockImplausible(
            str(self._path),
            found=f"{found}, its most uneven step",
            expected=f"{period_ms:.4g} ms, give or take {100.0 * STEP_TOLERANCE:g} %",
            remedy=remedy,
        )

    def verdict(self, rate_hz: float, statistics: RunStatistics) -> tuple[bool, str]:
        """Return whether the run is valid by its recorder and by its samples, and why not."""
        fault = self.fault(rate_hz) if statistics.valid else None
        if fault is None:
            return (statistics.valid, statistics.reason)
        return (False, fault.found)


class LogReader:
    """Read a log once in bounded memory: iterate over blocks, then use the other properties.

    Every verb reads logs here, so all refuse the same ones: damaged ones, and those whose parts
    contradict each other.

    Raises (while iterating):
        LogUnreadable: one of its kinds, with the place in the file.
    """

    def __init__(self, path: Path) -> None:
        """Store the path."""
        self.path = path
        self.damage: LogUnreadable | None = None
        self._file = RecordFile(path)
        self._chunks = ChunkContents(self._file)
        self.events = self._chunks.events  #: read so far
        self.readings = self._chunks.readings  #: slow ones, read so far
        self._attachments: dict[str, bytes] = {}
        self._metadata: dict[str, dict[str, str]] = {}
        self.checks = SampleChecks(path)  #: of the samples read so far

    def __iter__(self) -> Iterator[SampleBlock]:
        """Yield blocks of samples; events are collected meanwhile."""
        try:
            with closing(iter(self._file)) as records:
                yield from self._blocks(records)
            contradiction = self.contradiction
            if contradiction is not None:
                raise contradiction
        except LogUnreadable as error:
            foreign = foreign_recording(self.path)
            if foreign is None:
                raise
            raise foreign from error

    def until_damage(self) -> Iterator[SampleBlock]:
        """Yield the blocks before the damage of a log without a valid end;
        `damage` is then its description.

        Raises:
            LogMissing: the file does not exist.
        """
        try:
            with closing(self._file.unfinished()) as records:
                yield from self._blocks(self._checked(records))
        except LogMissing:
            raise
        except LogUnreadable as damage:
            self.damage = foreign_recording(self.path) or damage

    @property
    def contradiction(self) -> LogIncomplete | None:
        """Error for a log whose samples contradict its recorder's counts or its readback;
        after the iteration.

        Raises:
            LogIncomplete: the counts or the readback are missing.
        """
        return self.checks.contradiction(self.head, self.statistics, self.readings)

    @property
    def whole_bytes(self) -> int:
        """Size of the undamaged part of the file, after `until_damage`."""
        return self._file.whole_bytes

    @property
    def concluded(self) -> bool:
        """Whether the recorder's summary has been read."""
        return STATISTICS in self._metadata

    def _checked(self, records: Iterator[PlacedRecord]) -> Iterator[PlacedRecord]:
        """Refuse metadata without a seal: only the end of the file would cover them."""
        for offset, record in records:
            if isinstance(record, Metadata) and SEAL not in record.metadata:
                raise self._file.corrupt(
                    offset, f"metadata {record.name!r} without a seal", f"an entry {SEAL!r}"
                )
            yield offset, record

    def _blocks(self, records: Iterable[PlacedRecord]) -> Iterator[SampleBlock]:
        """Join several chunks to a block: numpy's calls cost more than the 150 samples of one
        chunk.
        """
        waiting: list[RecordArray] = []
        start = 0
        try:
            for offset, chunk in self._sample_chunks(records):
                if waiting and not _continues(waiting, chunk):
                    yield self._block(start, waiting)
                    waiting = []
                if not waiting:
                    start = offset
                waiting.append(chunk)
        except LogUnreadable:
            if waiting:  # undamaged samples before the damage
                yield self._block(start, waiting)
            raise
        if waiting:
            yield self._block(start, waiting)

    def _sample_chunks(self, records: Iterable[PlacedRecord]) -> Iterator[tuple[int, RecordArray]]:
        for offset, record in records:
            if isinstance(record, Attachment | Metadata):
                self._check_entry(offset, record)
            if isinstance(record, Attachment):
                self._attachments[record.name] = record.data
            elif isinstance(record, Metadata):
                try:
                    self._metadata[record.name] = unsealed(record.metadata)
                except ValueError as error:
                    found = f"metadata {record.name!r} with {error}"
                    raise self._file.corrupt(offset, found, "those that were sealed") from error
            elif isinstance(record, Header) and record.profile != "ros2":
                raise self._file.foreign(f"profile {record.profile!r}", "ros2")
            elif isinstance(record, Chunk):
                yield from self._chunks.samples(offset, self._file.unpack(offset, record))
            else:
                self._chunks.define(record)

    def _check_entry(self, offset: int, record: Attachment | Metadata) -> None:
        """Refuse a second record of a name, of which a reader could take either,
        and more than a log ever has.
        """
        known: Mapping[str, object] = self._attachments
        kind = "attachment"
        size = 0
        largest = MAX_BYTES
        if isinstance(record, Attachment):
            size = len(record.data)
        else:
            known = self._metadata
            kind = "metadata"
            largest = LARGEST_METADATA
            size = sum(len(key) + len(value) for key, value in record.metadata.items())
        entry = f"{kind} {record.name!r:.80}"
        if record.name in known:
            raise self._file.corrupt(offset, f"a second {entry}", "one of each name")
        entries = len(self._attachments) + len(self._metadata)
        if entries >= LARGEST_ENTRIES:
            found = f"more than {LARGEST_ENTRIES} attachments and metadata"
            raise self._file.corrupt(offset, found, "a log of a cell")
        if size > largest:
            raise self._file.corrupt(offset, f"{entry} of {size} bytes", f"at most {largest}")

    @property
    def digest(self) -> str:
        """sha256 of the file, after the iteration."""
        return self._file.sha256

    @property
    def head(self) -> LogHead:
        """Everything before the samples, complete from the first block on.

        Raises:
            LogIncomplete: it is missing or unreadable.
        """
        try:
            run = run_from_record(self._metadata[RUN])
            readback = readback_from_bytes(self._attachments[READBACK])
        except (KeyError, ValueError, RecursionError) as error:
            incomplete = self._incomplete(error, f"metadata {RUN!r} and attachment {READBACK!r}")
            raise foreign_recording(self.path) or incomplete from error
        return LogHead(run, readback, self._attachments)

    @property
    def statistics(self) -> RunStatistics:
        """The recorder's summary, after the iteration.

        Raises:
            LogIncomplete: it is missing or unreadable.
        """
        try:
            return statistics_from_record(self._metadata[STATISTICS])
        except (KeyError, ValueError, RecursionError) as error:
            raise self._incomplete(error, f"metadata {STATISTICS!r}") from error

    @property
    def partial(self) -> bool:
        """See `Log.partial`; after the iteration."""
        return self.statistics.partial or self.path.name.endswith(UNFINISHED)

    def _block(self, offset: int, chunks: list[RecordArray]) -> SampleBlock:
        # Joined as bytes: numpy would convert the fields chunk by chunk.
        content = b"".join([chunk.tobytes() for chunk in chunks])
        records = np.frombuffer(content, dtype=chunks[0].dtype)
        axes = records["position_counts"].shape[1]
        lengths = np.stack([records[name] for name in ("positions", "currents", "statuswords")])
        is_other_length = lengths != axes
        is_other_encoding = records["encapsulation"] != ENCAPSULATION_WORD
        if is_other_length.any() or is_other_encoding.any():
            raise self._file.corrupt(
                offset, "samples of another layout", f"little-endian CDR of {axes} axes"
            )
        seconds = records["seconds"]
        nanoseconds = records["nanoseconds"]
        if (seconds < 0).any() or (nanoseconds >= 1_000_000_000).any():
            raise self._file.corrupt(
                offset, "samples from before 1970 or of a second that is too long", "Unix time"
            )
        block = SampleBlock(
            cycle=records["cycle"].astype(np.uint64),
            time_ns=seconds.astype(np.int64) * 1_000_000_000 + nanoseconds,
            position_counts=records["position_counts"].astype(np.int32),
            current_raw=records["current_raw"].astype(np.int32),
            statusword=records["statusword"].astype(np.uint16),
            missing=records["missing"].astype(np.uint32),
        )
        self.checks.take(block)
        return block

    def _incomplete(self, error: Exception, expected: str) -> LogIncomplete:
        if isinstance(error, KeyError):
            found = f"none ({error.args[0]!r})"
        else:
            found = str(error)
        return LogIncomplete(
            str(self.path),
            found=found,
            expected=expected,
            remedy="record or import the run again with this software",
        )


@checks_arguments(path=A_PATH)
def read_log(path: Path | str) -> Log:
    """Read a whole log.

    Raises:
        UsageError: the argument is no path.
        LogUnreadable: one of its kinds, with the place in the file.
    """
    path = Path(path)
    reader = LogReader(path)
    samples = joined(reader)
    return Log(
        path=path,
        digest=reader.digest,
        head=reader.head,
        samples=samples,
        events=tuple(reader.events),
        readings=tuple(reader.readings),
        statistics=reader.statistics,
        partial=reader.partial,
    )


def read_cell_of(log: Path) -> Cell:
    """Read the cell of a log from its beginning, whatever comes after its first samples.

    Raises:
        LogUnreadable: its beginning cannot be read.
        ConfigurationError: its configuration is inconsistent.
    """
    reader = LogReader(log)
    for _ in reader:  # what comes before the samples has the configuration
        break
    return reader.head.cell(log)


def joined(blocks: Iterable[SampleBlock]) -> SampleBlock:
    """Return all samples of a log, of one block at least, as one block."""
    waiting = list(blocks)
    columns = {}
    for name in SampleBlock.__slots__:
        columns[name] = [getattr(block, name) for block in waiting]
    waiting.clear()  # so that a long log is not in memory twice
    joined_columns = {}
    for name in SampleBlock.__slots__:
        joined_columns[name] = np.concatenate(columns.pop(name))
    return SampleBlock(**joined_columns)


def _continues(waiting: Sequence[RecordArray], chunk: RecordArray) -> bool:
    """Whether a chunk goes into the same block as those before it."""
    if chunk.dtype != waiting[0].dtype:
        return False
    return sum(map(len, waiting)) < BLOCK_SAMPLES


class LossyLogs(Enum):
    """Whether to use a log that its recorder marked invalid because of losses that are masked
    (`Loss.masked`).
    """

    REFUSED = "refused"
    ACCEPTED = "accepted"
