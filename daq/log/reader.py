"""Read a log into arrays: every chunk of samples is one `frombuffer`, without a Python loop over messages."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np
from mcap.records import Attachment, Chunk, Header, McapRecord, Metadata
from numpy.typing import NDArray

from daq.errors import LogIncomplete, LogMissing, LogUnreadable
from daq.log.bag_table import foreign_recording
from daq.log.container import UNFINISHED, ChunkContents, RecordFile
from daq.log.message import ENCAPSULATION_WORD, SAMPLES_TOPIC
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
from drivers.stream.sample import CellEvent, SlowReading

BLOCK_SAMPLES = 4096  #: Samples of a block; at most these and one chunk are in memory


@dataclass(frozen=True, slots=True, eq=False)
class SampleBlock:
    """Samples of k cycles, in the order of the log."""

    cycle: NDArray[np.uint64]  #: number of the sampling period, shape (k,), uint64
    time_ns: NDArray[np.int64]  #: time of the SYNC [ns], shape (k,), int64
    position_counts: NDArray[np.int32]  #: shape (k, n), int32
    current_raw: NDArray[np.int32]  #: shape (k, n), int32
    statusword: NDArray[np.uint16]  #: shape (k, n), uint16
    missing: NDArray[np.uint32]  #: bit i for axis i, shape (k,), uint32


@dataclass(frozen=True, slots=True)
class LogHead:
    """Everything before the samples."""

    run: RunInfo  #: facts about the recording
    readback: Readback  #: answers of the amplifiers
    files: Mapping[str, bytes]  #: all attachments by name, with the cell's bundle


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """A whole log.

    Attributes:
        path, digest: path and sha256 (hex) of the file.
        head: everything before the samples.
        samples: all samples.
        events: in the order of the log.
        readings: torques and temperatures that were read beside the samples, in the order of the log.
        statistics: the recorder's summary at the end.
        partial: the end of the recording is unknown: it was salvaged, or never got its final name.
    """

    path: Path
    digest: str
    head: LogHead
    samples: SampleBlock
    events: tuple[CellEvent, ...]
    readings: tuple[SlowReading, ...]
    statistics: RunStatistics
    partial: bool


class LogReader:
    """Read a log once in bounded memory: iterate over blocks, then use the other properties.

    Raises (while iterating):
        LogUnreadable: one of its kinds, with the place in the file.
    """

    def __init__(self, path: Path) -> None:
        """Store the path."""
        self.path = path
        self.damage: LogUnreadable | None = None
        self._file = RecordFile(path)
        self._chunks = ChunkContents(self._file)
        self._attachments: dict[str, bytes] = {}
        self._metadata: dict[str, dict[str, str]] = {}

    def __iter__(self) -> Iterator[SampleBlock]:
        """Yield blocks of samples; events are collected meanwhile."""
        try:
            yield from self._blocks(self._file)
        except LogUnreadable as error:
            foreign = foreign_recording(self.path)
            if foreign is None:
                raise
            raise foreign from error

    def until_damage(self) -> Iterator[SampleBlock]:
        """Yield the blocks before the damage of a log without a valid end; `damage` is then its description.

        Raises:
            LogMissing: the file does not exist.
        """
        try:
            yield from self._blocks(self._checked(self._file.unfinished()))
        except LogMissing:
            raise
        except LogUnreadable as damage:
            self.damage = foreign_recording(self.path) or damage

    @property
    def events(self) -> list[CellEvent]:
        """Events read so far."""
        return self._chunks.events

    @property
    def readings(self) -> list[SlowReading]:
        """Slow readings read so far."""
        return self._chunks.readings

    @property
    def whole_bytes(self) -> int:
        """Size of the undamaged part of the file, after `until_damage`."""
        return self._file.whole_bytes

    @property
    def concluded(self) -> bool:
        """Whether the recorder's summary has been read."""
        return STATISTICS in self._metadata

    def _checked(self, records: Iterator[tuple[int, McapRecord]]) -> Iterator[tuple[int, McapRecord]]:
        """Refuse metadata without a seal: only the end of the file would cover them."""
        for offset, record in records:
            if isinstance(record, Metadata) and SEAL not in record.metadata:
                raise self._file.corrupt(offset, f"metadata {record.name!r} without a seal", f"an entry {SEAL!r}")
            yield offset, record

    def _blocks(self, records: Iterable[tuple[int, McapRecord]]) -> Iterator[SampleBlock]:
        """Join several chunks to a block: numpy's calls cost more than the 150 samples of one chunk."""
        waiting: list[NDArray[np.void]] = []
        start = 0
        try:
            for offset, chunk in self._sample_chunks(records):
                if waiting and (chunk.dtype != waiting[0].dtype or sum(map(len, waiting)) >= BLOCK_SAMPLES):
                    yield self._block(start, waiting)
                    waiting = []
                start = start if waiting else offset
                waiting.append(chunk)
        except LogUnreadable:
            if waiting:  # undamaged samples before the damage
                yield self._block(start, waiting)
            raise
        if waiting:
            yield self._block(start, waiting)

    def _sample_chunks(self, records: Iterable[tuple[int, McapRecord]]) -> Iterator[tuple[int, NDArray[np.void]]]:
        for offset, record in records:
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

    def _block(self, offset: int, chunks: list[NDArray[np.void]]) -> SampleBlock:
        # Joined as bytes: numpy would convert the fields chunk by chunk.
        records = np.frombuffer(b"".join(chunk.tobytes() for chunk in chunks), dtype=chunks[0].dtype)
        axes = records["position_counts"].shape[1]
        fixed = [records[name] for name in ("positions", "currents", "statuswords", "encapsulation")]
        if any(
            (column != word).any() for column, word in zip(fixed, (axes, axes, axes, ENCAPSULATION_WORD), strict=True)
        ):
            raise self._file.corrupt(offset, "samples of another layout", f"little-endian CDR of {axes} axes")
        if (records["seconds"] < 0).any() or (records["nanoseconds"] >= 1_000_000_000).any():
            raise self._file.corrupt(offset, "samples from before 1970 or of a second that is too long", "Unix time")
        return SampleBlock(
            cycle=records["cycle"].astype(np.uint64),
            time_ns=records["seconds"].astype(np.int64) * 1_000_000_000 + records["nanoseconds"],
            position_counts=records["position_counts"].astype(np.int32),
            current_raw=records["current_raw"].astype(np.int32),
            statusword=records["statusword"].astype(np.uint16),
            missing=records["missing"].astype(np.uint32),
        )

    def _incomplete(self, error: Exception, expected: str) -> LogIncomplete:
        found = f"none ({error.args[0]!r})" if isinstance(error, KeyError) else str(error)
        return LogIncomplete(
            str(self.path), found=found, expected=expected, remedy="record or import the run again with this software"
        )


def read_log(path: Path | str) -> Log:
    """Read a whole log.

    Raises:
        LogUnreadable: one of its kinds, with the place in the file.
    """
    path = Path(path)
    reader = LogReader(path)
    blocks = list(reader)
    head, statistics = reader.head, reader.statistics
    if not blocks:
        raise LogIncomplete(
            str(path), found="no samples", expected=f"some on {SAMPLES_TOPIC}", remedy="record or import the run again"
        )
    axes = len(head.readback.axes)
    widths = {block.position_counts.shape[1] for block in blocks}
    if widths != {axes}:
        raise LogIncomplete(
            str(path),
            found=f"samples of {', '.join(map(str, sorted(widths)))} axes",
            expected=f"{axes}, as in its readback",
            remedy="record or import the run again",
        )
    if foreign := {reading.axis for reading in reader.readings} - set(range(axes)):
        raise LogIncomplete(
            str(path),
            found=f"a torque or temperature of axis {max(foreign)}, counted from 0",
            expected=f"those of {axes} axes, as in its readback",
            remedy="record or import the run again",
        )
    count = sum(len(block.cycle) for block in blocks)
    if count != statistics.samples:
        raise LogIncomplete(
            str(path),
            found=f"{count} samples",
            expected=f"{statistics.samples}, as its recorder counted",
            remedy="another tool may have cut the log; take the original",
        )
    columns = {name: [getattr(block, name) for block in blocks] for name in SampleBlock.__slots__}
    blocks.clear()  # so that a long log is not in memory twice
    samples = SampleBlock(**{name: np.concatenate(columns.pop(name)) for name in SampleBlock.__slots__})
    events, readings = tuple(reader.events), tuple(reader.readings)
    return Log(path, reader.digest, head, samples, events, readings, statistics, reader.partial)


class LossyLogs(Enum):
    """Whether to use a log that its recorder marked invalid because of losses that are masked (`Loss.masked`)."""

    REFUSED = "refused"
    ACCEPTED = "accepted"
