"""Standard output and error that never block whoever prints.

A terminal whose output is stopped (Ctrl-S), a pipe that nobody reads, and an SSH connection that is
gone block a write for as long as they like. Here a thread of its own writes, in order, what the
verbs print, and they go on: the axes are stopped, the log is finished and the bus is free, also
when the screen is gone. Where nobody reads, progress is left out first (`is_behind`), then remarks,
and their number is printed as soon as somebody reads again. Results are never left out: the end of
the command waits for their reader.
"""

from __future__ import annotations

import io
import math
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum, auto
from queue import SimpleQueue
from types import TracebackType
from typing import IO, TextIO

REMARKS_BYTES = 1 << 20  #: Remarks that may wait for a reader
PROGRESS_BYTES = 4096  #: With more than this waiting, no progress is drawn
CHUNK_BYTES = 4096  #: Of one write: what a pipe takes as a whole
#: Remarks, and what an interrupt has left, wait so long for a reader that takes nothing
PATIENCE_S = 2.0
POLL_S = 0.002  #: Between two looks whether the reader has taken everything


class OutputKind(Enum):
    """What a piece of output is."""

    RESULT = auto()  #: Never left out
    REMARK = auto()  #: Left out where too much waits
    LOSSES = auto()  #: The place of remarks that were left out
    END = auto()  #: The thread ends here


@dataclass(frozen=True, slots=True)
class Piece:
    """What was printed at once."""

    kind: OutputKind
    content: bytes = b""


def losses_line(lines: int) -> str:
    """Say how many lines were left out."""
    return f"({lines} lines were left out here: nothing read the output)\n"


class OutputWriter:
    """Writes to one file from a thread of its own.

    Waiting is polling: a signal may end it at any instruction, and must not leave a lock taken.
    """

    def __init__(
        self,
        descriptor: int,
        write: Callable[[int, bytes], int] = os.write,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Store the arguments; `start` begins to write.

        Args:
            descriptor: of the file; the writer does not close it.
            write: writes a part of some bytes and returns their number, as `os.write`.
            clock: monotonic time [s].
        """
        self.losses_line: Callable[[int], str] = losses_line  #: how the stream says what it lacks
        self.results_are_awaited = True  #: the end of the command waits for their reader
        self.error: OSError | None = None  #: of the file, which takes nothing any more
        self._descriptor = descriptor
        self._write = write
        self._clock = clock
        self._pieces: SimpleQueue[Piece] = SimpleQueue()
        # Guards the numbers below; it is never held for longer than it takes to change them.
        self._lock = threading.Lock()
        self._waiting_bytes = 0
        self._waiting_results = 0  # pieces
        self._lost_lines = 0  # not yet said
        self._has_lost_result = False
        self._is_abandoned = False
        self._taken_bytes = 0  # by the reader, in all
        self._thread = threading.Thread(target=self._run, name="output", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def put(self, piece: Piece) -> None:
        """Take a piece, and return at once.

        Raises:
            OSError: a result, where the file takes nothing any more.
        """
        if self.error is not None:
            if piece.kind is OutputKind.RESULT:
                self._has_lost_result = True
                raise self.error
            return
        size_bytes = len(piece.content)
        with self._lock:
            if piece.kind is OutputKind.REMARK:
                # Until the losses are said, what comes later stays out as well: lines keep their
                # order.
                is_first = self._lost_lines == 0
                is_full = (
                    self._waiting_bytes > 0 and self._waiting_bytes + size_bytes > REMARKS_BYTES
                )
                if is_full or not is_first:
                    if is_first:
                        self._pieces.put(Piece(OutputKind.LOSSES))
                    self._lost_lines += max(1, piece.content.count(b"\n"))
                    return
            if piece.kind is OutputKind.RESULT:
                self._waiting_results += 1
            self._waiting_bytes += size_bytes
            self._pieces.put(piece)

    @property
    def is_behind(self) -> bool:
        """Whether the reader does not keep up, so that progress would only wait."""
        return self._waiting_bytes > PROGRESS_BYTES

    @property
    def has_reader(self) -> bool:
        """Whether the other end of a pipe, a socket or a terminal is open; true of a file."""
        poll = select.poll()
        poll.register(self._descriptor, 0)
        closed = select.POLLERR | select.POLLHUP
        return not any(events & closed for _, events in poll.poll(0))

    @property
    def _is_empty(self) -> bool:
        return self._waiting_bytes == 0 and self._lost_lines == 0

    def wait(self) -> None:
        """Wait until everything was written, for as long as the reader takes.

        Raises:
            OSError: of the file, where a result was lost.
        """
        self._wait(lambda: self._is_empty)
        self._require_results()

    def wait_for_results(self) -> None:
        """Wait until every result was written, unless an interrupt has ended the command.

        Raises:
            OSError: as `wait`.
        """
        if self.results_are_awaited:
            self._wait(lambda: self._waiting_results == 0)
        self._require_results()

    def close(self, patience_s: float = PATIENCE_S) -> None:
        """Wait for the reader, but for `patience_s` after the last byte that it took;
        then end the thread.
        """
        try:
            self._wait(lambda: self._is_empty, patience_s)
        finally:
            self._is_abandoned = True
            self._pieces.put(Piece(OutputKind.END))

    def _wait(self, is_done: Callable[[], bool], patience_s: float = math.inf) -> None:
        taken_bytes = self._taken_bytes
        last_s = self._clock()
        while not is_done() and self.error is None:
            now_s = self._clock()
            if self._taken_bytes != taken_bytes:
                taken_bytes = self._taken_bytes
                last_s = now_s
            if now_s - last_s > patience_s:
                return
            time.sleep(POLL_S)

    def _require_results(self) -> None:
        if self.error is None:
            return
        if self._waiting_results > 0 or self._has_lost_result:
            raise self.error

    def _run(self) -> None:
        # The main thread handles them
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        while True:
            piece = self._pieces.get()
            if piece.kind is OutputKind.END:
                return
            content = piece.content
            if piece.kind is OutputKind.LOSSES:
                content = self._taken_losses()
            is_complete = self._write_out(content)
            is_result = piece.kind is OutputKind.RESULT
            if is_result and not is_complete:
                # Before it is no longer counted: one of both tells of it at any time
                self._has_lost_result = True
            with self._lock:
                self._waiting_bytes -= len(content)
                self._waiting_results -= is_result

    def _taken_losses(self) -> bytes:
        """Return the sentence about lines that were left out,
        which counts as waiting from now on.
        """
        with self._lock:
            content = self.losses_line(self._lost_lines).encode()
            self._lost_lines = 0
            self._waiting_bytes += len(content)
        return content

    def _write_out(self, content: bytes) -> bool:
        """Write a piece; return whether all of it was taken."""
        rest = memoryview(content)
        while rest and self.error is None and not self._is_abandoned:
            try:
                written = self._write_once(bytes(rest[:CHUNK_BYTES]))
            except OSError as error:
                self.error = error
            else:
                self._taken_bytes += written
                rest = rest[written:]
        return not rest

    def _write_once(self, content: bytes) -> int:
        try:
            return self._write(self._descriptor, content)
        except BlockingIOError:  # another program has made the file non-blocking
            select.select([], [self._descriptor], [])
            return 0


class _QueuedFile(io.RawIOBase):
    """File that passes what is written to an `OutputWriter`."""

    def __init__(self, writer: OutputWriter, kind: OutputKind, descriptor: int, name: str) -> None:
        super().__init__()
        self.writer = writer
        self.name = name
        self._kind = kind
        self._descriptor = descriptor

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def write(self, content: object) -> int:
        taken = bytes(content)  # type: ignore[call-overload]  # a buffer, as typeshed has it since 3.12
        self.writer.put(Piece(self._kind, taken))
        return len(taken)


class QueuedOutput:
    """Context manager within which `sys.stdout` and `sys.stderr` never block;
    a stream without a file stays.

    Where both are one file, such as a terminal, one writer keeps the order of what is printed.
    """

    def __init__(self) -> None:
        self._before: tuple[TextIO, TextIO] = (sys.stdout, sys.stderr)
        self._writers: list[tuple[os.stat_result, OutputWriter]] = []

    def __enter__(self) -> QueuedOutput:
        self._before = (sys.stdout, sys.stderr)
        sys.stdout = self._queued(sys.stdout, OutputKind.RESULT)
        sys.stderr = self._queued(sys.stderr, OutputKind.REMARK)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        try:
            for _status, writer in self._writers:
                writer.close()
        finally:
            sys.stdout, sys.stderr = self._before

    def wait_for_results(self) -> None:
        """Wait until somebody has taken what was printed on stdout.

        Raises:
            OSError: it cannot be written.
        """
        for _status, writer in self._writers:
            writer.wait_for_results()

    def _queued(self, stream: TextIO, kind: OutputKind) -> TextIO:
        try:
            descriptor = stream.fileno()
            status = os.fstat(descriptor)
            stream.flush()
        except (AttributeError, OSError, ValueError):  # none, in memory, or closed
            return stream
        writer = self._writer_of(status, descriptor)
        file = _QueuedFile(writer, kind, descriptor, stream.name)
        # RawIOBase is what `python -u` has there, too.
        raw: IO[bytes] = file  # type: ignore[assignment]
        return io.TextIOWrapper(
            raw, encoding=stream.encoding, errors=stream.errors, write_through=True
        )

    def _writer_of(self, status: os.stat_result, descriptor: int) -> OutputWriter:
        for known, writer in self._writers:
            if os.path.samestat(known, status):
                return writer
        writer = OutputWriter(descriptor)
        writer.start()
        self._writers.append((status, writer))
        return writer


def writer_of(stream: object) -> OutputWriter | None:
    """Return the writer of a stream; None where it is written directly.

    A stream that rich has replaced counts.
    """
    file = getattr(stream, "buffer", None)
    writer = getattr(file, "writer", None)
    return writer if isinstance(writer, OutputWriter) else None


def is_behind(stream: object) -> bool:
    """Whether progress on a stream would only wait for its reader."""
    writer = writer_of(stream)
    return writer is not None and writer.is_behind


def wait_until_shown(*streams: object) -> None:
    """Wait until all that was printed is on its way to a reader,
    before a question or a write that it announces.

    Raises:
        OSError: a result cannot be written.
    """
    for stream in streams:
        writer = writer_of(stream)
        if writer is not None:
            writer.wait()


def has_reader(stream: object) -> bool:
    """Whether a stream that is written by a writer still has one that may read it.

    Of a file, of a stream in memory and of a closed one it is true.
    """
    writer = writer_of(stream)
    return writer is None or writer.has_reader


def release_results() -> None:
    """Let the command end without a reader of its results: an interrupt has ended it."""
    writer = writer_of(sys.stdout)
    if writer is not None:
        writer.results_are_awaited = False


def say_losses_as(line: Callable[[int], str]) -> None:
    """Choose the line on stderr that says how many were left out,
    for a stream that a program reads.
    """
    writer = writer_of(sys.stderr)
    if writer is not None:
        writer.losses_line = line


def write_if_taken(text: str) -> None:
    """Write a short text on stderr, outside `QueuedOutput`, unless that would block."""
    with suppress(AttributeError, OSError, ValueError):
        _, ready, _ = select.select([], [sys.stderr], [], 0.0)
        if ready:
            sys.stderr.write(text)
