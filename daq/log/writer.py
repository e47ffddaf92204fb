"""Write a log that survives a crash.

At most the last 200 ms are only in memory, and what a slow disk has not taken yet.
"""

from __future__ import annotations

import fcntl
import os
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from io import BufferedWriter
from pathlib import Path
from types import TracebackType

from mcap.writer import CompressionType, Writer

from daq.config.cell import Cell, joint_names
from daq.errors import OutputFailed, UsageError, reason_of
from daq.files import fsync_folder, require_new
from daq.log.container import UNFINISHED
from daq.log.message import (
    CURRENTS_TOPIC,
    DEFINITIONS,
    EVENTS_TOPIC,
    JOINTS_TOPIC,
    READING_TOPICS,
    SAMPLES_TOPIC,
    SCHEMA_OF,
    URDF_TOPIC,
    currents_bytes,
    event_bytes,
    joint_state_bytes,
    joint_state_prefix,
    reading_bytes,
    sample_bytes,
    sample_struct,
    text_bytes,
)
from daq.log.metadata import (
    READBACK,
    RUN,
    STATISTICS,
    Readback,
    RunInfo,
    RunStatistics,
    readback_bytes,
    run_record,
    sealed,
    statistics_record,
)
from daq.log.queued_file import QueuedFile
from drivers.messages import CellEvent, Sample, SlowReading

FLUSH_NS = 150_000_000
"""Time between two flushes, recorded or wall time, whichever ends first [ns].

A kill may cost 200 ms: the rest is for the cycle on the bus and the chunk that is being packed.
"""
JOINT_STATE_NS = 20_000_000  #: Time between two joint states, over which their velocity is the mean
CHUNK_BYTES = 4 * 2**20  #: Never reached between two flushes; a chunk ends with one


@dataclass(frozen=True, slots=True)
class LogContent:
    """Start of a log."""

    run: RunInfo  #: facts about the recording
    files: Mapping[str, bytes]  #: the cell's bundle: configuration, drive profiles, URDF
    readback: Readback  #: answers of the amplifiers
    joint_names: tuple[str, ...]  #: joints of the URDF, one for each axis
    urdf: str = ""  #: text of the URDF, its held joints fixed, for viewers; empty without one

    @classmethod
    def of(
        cls, cell: Cell, run: RunInfo, files: Mapping[str, bytes], readback: Readback
    ) -> LogContent:
        """The start of a log of a cell."""
        return cls(run, files, readback, joint_names(cell), cell.urdf)


class LogWriter:
    """Context manager that writes one log.

    The log is `PATH.part` until the block ends without an error; then it is finished, synced and
    renamed. After an error the `.part` keeps everything up to that moment, or is removed if the log
    can be made again.

    Raises (on entry and later):
        UsageError: the log, or a `.part` of the same name, already exists. At the end: a file of
            that name has appeared; the `.part` is then the whole log.
        OutputFailed: the file system refuses.
    """

    def __init__(
        self,
        path: Path,
        content: LogContent,
        joint_position: Callable[[tuple[int, ...]], Sequence[float]],
        clock_ns: Callable[[], int],
        *,
        keeps_part: bool = True,
        waits_for_disk: bool = True,
    ) -> None:
        """Store the arguments.

        Args:
            path: path of the finished log.
            content: start of the log.
            joint_position: converts motor counts to joint positions [rad or m], for /joint_states.
            clock_ns: monotonic clock, for the flush by wall time.
            keeps_part: whether an error leaves the `.part`.
            waits_for_disk: whether a flush returns once the system has what was flushed. A recorder
                does not wait: a thread writes (`QueuedFile`).
        """
        self.path = path
        self.part = path.with_name(path.name + UNFINISHED)
        self._content = content
        self._joint_position = joint_position
        self._clock_ns = clock_ns
        self._keeps_part = keeps_part
        self._waits_for_disk = waits_for_disk
        self._queued: QueuedFile | None = None
        self._axes = len(content.readback.axes)
        self._layout = sample_struct(self._axes)
        self._prefix = joint_state_prefix(content.joint_names)
        self._held: list[tuple[int, int, bytes]] = []
        self._channels: dict[str, int] = {}  # by topic
        self._samples = 0
        self._lost = 0
        self._missing = [0] * self._axes
        self._highest_cycle: int | None = None
        self._flushed_recorded_ns = self._flushed_wall_ns = 0
        self._joint_state_due_ns = 0
        self._joint_state_before: tuple[int, Sequence[float]] | None = None
        self._ampere_per_unit = [axis.current_per_unit for axis in content.readback.axes]
        self._conclusion = RunStatistics(0, 0, (), valid=False, reason="not concluded")

    def __enter__(self) -> LogWriter:
        """Open the file and write everything before the first sample."""
        require_new(self.path, "choose another name, or move it away")
        try:
            self._stream = self._new_part()
        except FileExistsError as error:
            raise UsageError(
                str(self.part),
                found="an unfinished log of that name",
                expected="none",
                remedy="its recorder still runs or was killed; move the file away to keep "
                "its samples",
            ) from error
        except OSError as error:
            raise self._failed(error) from error
        with suppress(OSError):  # a file system without locks; only `salvage` asks for this one
            fcntl.flock(self._stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        try:
            self._open()
        except OSError as error:
            with suppress(OSError):  # closing flushes, and a full disk refuses that a second time
                self._stream.close()
            self.part.unlink(missing_ok=True)
            raise self._failed(error) from error
        return self

    def _new_part(self) -> BufferedWriter:
        if self._waits_for_disk:
            return self.part.open("xb")
        self._queued = QueuedFile(self.part.open("xb", buffering=0))
        return BufferedWriter(self._queued)

    @property
    def longest_wait_s(self) -> float:
        """Longest time that the disk has taken for a part of the log [s]; 0 where `write` waits."""
        if self._queued is None:
            return 0.0
        return self._queued.longest_wait_s

    def write(self, sample: Sample) -> None:
        """Append one sample.

        Raises:
            ValueError: it does not fit the log: other number of axes, or a value outside its type.
            OutputFailed: the file system refuses.
        """
        try:
            data = sample_bytes(self._layout, sample)
        except struct.error as error:
            raise ValueError(
                f"{sample} does not fit a log of {self._axes} axes: {error}"
            ) from error
        self._count(sample)
        wall_ns = self._clock_ns()
        if self._samples == 1:
            self._flushed_recorded_ns = sample.time_ns
            self._flushed_wall_ns = wall_ns
            self._joint_state_due_ns = sample.time_ns
        elif (
            self._samples == 2  # the first one by itself: a log that has begun can be salvaged
            or sample.time_ns - self._flushed_recorded_ns >= FLUSH_NS
            or wall_ns - self._flushed_wall_ns >= FLUSH_NS
        ):
            self.flush()
            self._flushed_recorded_ns = sample.time_ns
            self._flushed_wall_ns = wall_ns
        try:
            channel = self._channel(SAMPLES_TOPIC)
            self._mcap.add_message(
                channel, sample.time_ns, data, sample.time_ns, sample.cycle & 0xFFFFFFFF
            )
        except OSError as error:
            raise self._failed(error) from error
        if sample.time_ns >= self._joint_state_due_ns:
            self._joint_state_due_ns = sample.time_ns + JOINT_STATE_NS
            self._hold_state(sample)

    def _hold_state(self, sample: Sample) -> None:
        """Append what viewers show of a sample, in SI."""
        time_ns = sample.time_ns
        position = self._joint_position(sample.position_counts)
        before_ns, before = self._joint_state_before or (time_ns, position)
        elapsed_s = max(time_ns - before_ns, 1) * 1e-9
        velocity = [(now - then) / elapsed_s for now, then in zip(position, before, strict=True)]
        self._joint_state_before = time_ns, position
        current = [
            raw * unit for raw, unit in zip(sample.current_raw, self._ampere_per_unit, strict=True)
        ]
        self._hold(
            JOINTS_TOPIC, time_ns, joint_state_bytes(self._prefix, time_ns, position, velocity)
        )
        self._hold(CURRENTS_TOPIC, time_ns, currents_bytes(time_ns, current))

    def event(self, event: CellEvent) -> None:
        """Append one event."""
        self._hold(EVENTS_TOPIC, event.time_ns, event_bytes(event))

    def reading(self, reading: SlowReading) -> None:
        """Append one slow reading."""
        self._hold(READING_TOPICS[reading.quantity], reading.time_ns, reading_bytes(reading))

    def readings(self, readings: Iterable[SlowReading]) -> None:
        """Append several slow readings."""
        for reading in readings:
            self.reading(reading)

    def conclude(
        self,
        valid: bool,
        reason: str = "",
        *,
        partial: bool = False,
        wall_minus_monotonic_ns: int | None = None,
    ) -> None:
        """Set the outcome; without it the log is not valid.

        Args:
            valid, reason: whether the run may be used, and why not.
            partial: the end of the recording is unknown.
            wall_minus_monotonic_ns: difference of the two clocks at the end [ns].
        """
        self._conclusion = RunStatistics(0, 0, (), valid, reason, partial, wall_minus_monotonic_ns)

    @property
    def statistics(self) -> RunStatistics:
        """Statistics so far."""
        return replace(
            self._conclusion,
            samples=self._samples,
            lost_cycles=self._lost,
            missing=tuple(self._missing),
        )

    def flush(self) -> None:
        """Write everything to the file, or give it to the thread that does.

        Samples get chunks of their own, so that a reader takes a whole chunk at once; the rest
        follows in another.
        """
        try:
            self._mcap.flush()
            for channel, time_ns, data in self._held:
                self._mcap.add_message(channel, time_ns, data, time_ns)
            self._held.clear()
            self._mcap.flush()
        except OSError as error:
            raise self._failed(error) from error

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Finish and rename after success; keep the `.part` after an error, which propagates."""
        try:
            with self._stream:
                self.flush()
                if error is not None:
                    return
                self._mcap.add_metadata(STATISTICS, sealed(statistics_record(self.statistics)))
                self._mcap.finish()
                self._stream.flush()
                if self._queued is not None:
                    self._queued.drain()
                os.fsync(self._stream.fileno())
            self._take_name()
            fsync_folder(self.path.parent)
        except (OSError, OutputFailed) as failure:
            if error is not None:  # it came first, and it may carry notes about the stop
                error.add_note(f"the log keeps less than it could: {failure}")
                return
            raise (
                failure if isinstance(failure, OutputFailed) else self._failed(failure)
            ) from failure
        finally:
            if not self._keeps_part:
                self.part.unlink(missing_ok=True)  # after a success it has the name of the log

    def _take_name(self) -> None:
        """Rename the finished log without replacing a file that has appeared meanwhile."""
        try:
            self.path.hardlink_to(self.part)
        except OSError as error:
            # Without an existing file it is a file system without hard links.
            if isinstance(error, FileExistsError) or self.path.exists():
                self._keeps_part = True
                raise UsageError(
                    str(self.path),
                    found="a file of that name, which was not there when the recording began",
                    expected="none",
                    remedy=f"nothing was replaced: the whole recording is {self.part}; give it "
                    f"another name without {UNFINISHED}, or move the other file away",
                ) from error
            self.part.rename(self.path)
        else:
            self.part.unlink()

    def _open(self) -> None:
        # Data CRCs protect attachments and metadata too, which are outside chunks.
        self._mcap = Writer(
            self._stream,
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._mcap.start(profile="ros2", library=self._content.run.software)
        started_ns = self._content.run.started_wall_ns
        for name, data in {
            **self._content.files,
            READBACK: readback_bytes(self._content.readback),
        }.items():
            self._mcap.add_attachment(
                started_ns, started_ns, name, "application/octet-stream", data
            )
        self._mcap.add_metadata(RUN, sealed(run_record(self._content.run)))
        # Also those without a message
        for topic in (SAMPLES_TOPIC, EVENTS_TOPIC, JOINTS_TOPIC, CURRENTS_TOPIC):
            self._channel(topic)
        if self._content.urdf:
            self._hold(URDF_TOPIC, started_ns, text_bytes(self._content.urdf))
        self._mcap.flush()

    def _channel(self, topic: str) -> int:
        """Return the channel of a topic, which is new at its first message."""
        if topic not in self._channels:
            schema = SCHEMA_OF[topic]
            identifier = self._mcap.register_schema(schema, "ros2msg", DEFINITIONS[schema].encode())
            self._channels[topic] = self._mcap.register_channel(topic, "cdr", identifier)
        return self._channels[topic]

    def _hold(self, topic: str, time_ns: int, data: bytes) -> None:
        """Keep a message for the chunk after the samples."""
        self._held.append((self._channel(topic), time_ns, data))

    def _count(self, sample: Sample) -> None:
        self._samples += 1
        if self._highest_cycle is not None:
            self._lost += max(0, sample.cycle - self._highest_cycle - 1)
        self._highest_cycle = max(sample.cycle, self._highest_cycle or 0)
        if sample.missing:
            for axis in range(self._axes):
                self._missing[axis] += sample.missing >> axis & 1

    def _failed(self, error: OSError) -> OutputFailed:
        missing = OutputFailed.of_missing_folder(self.path, error)
        if missing is not None and not self._samples:
            return missing
        remedy = "nothing was written; free space or rights, or choose another folder"
        if self._keeps_part:
            remedy = (
                "what was recorded until then stays in that file, which no fit reads (`drivegain "
                "salvage` saves it); free space or take another disk, and record again"
            )
        return OutputFailed(
            str(self.part),
            found=reason_of(error),
            expected="a folder that can be written, with room",
            remedy=remedy,
        )
