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

REMARKS_BYTES = 1 << 20  #: Output that may wait for a reader before remarks are left out
PROGRESS_BYTES = 4096  #: Output that may wait for a reader before progress is not drawn
CHUNK_BYTES = 4096  #: Largest single write: what a pipe takes as a whole
PATIENCE_S = 2.0
"""Time for which the end of a command waits for a reader that takes nothing:
for remarks, and for what an interrupt has left.
"""
POLL_S = 0.002  #: Time between two looks whether the reader has taken everything


class OutputKind(Enum):
    """What a piece of output is."""

    RESULT = auto()  #: Never left out
    REMARK = auto()  #: Left out where too much waits
    #: Stands in the place of remarks that were left out; the thread fills in how many lines
    LOSSES = auto()
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

    Who waits for the thread polls: a signal may raise at any instruction of the wait, and a lock or
    a condition that is waited for could then stay taken.
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
        # Guards the three numbers that follow; it is taken only while they change.
        self._lock = threading.Lock()
        self._waiting_bytes = 0  # put, and not yet written
        self._waiting_results = 0  # pieces of results among them
        self._unsaid_lines = 0  # left out, and no line has said so yet
        self._has_lost_result = False
        self._is_closed = False  # the thread gives up what it cannot write
        self._written_bytes = 0  # since the start
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
        with self._lock:
            if piece.kind is OutputKind.REMARK and self._must_leave_out(piece):
                if self._unsaid_lines == 0:
                    self._pieces.put(Piece(OutputKind.LOSSES))
                self._unsaid_lines += max(1, piece.content.count(b"\n"))
                return
            if piece.kind is OutputKind.RESULT:
                self._waiting_results += 1
            self._waiting_bytes += len(piece.content)
            self._pieces.put(piece)

    def _must_leave_out(self, remark: Piece) -> bool:
        """Whether there is no room for a remark; the lock is taken.

        A remark that is larger than the room has it where nothing else waits.
        """
        if self._unsaid_lines > 0:
            # Until the line about the losses is written, what comes later is left out as well, so
            # that lines keep their order.
            return True
        if self._waiting_bytes == 0:
            return False
        return self._waiting_bytes + len(remark.content) > REMARKS_BYTES

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
    def _is_all_written(self) -> bool:
        """Whether nothing waits, the line about losses included."""
        return self._waiting_bytes == 0 and self._unsaid_lines == 0

    def wait(self) -> None:
        """Wait until everything was written, for as long as the reader takes.

        Raises:
            OSError: of the file, where a result was lost.
        """
        self._wait_until(lambda: self._is_all_written)
        self._require_results()

    def wait_for_results(self) -> None:
        """Wait until every result was written, unless an interrupt has ended the command.

        Raises:
            OSError: as `wait`.
        """
        if self.results_are_awaited:
            self._wait_until(lambda: self._waiting_results == 0)
        self._require_results()

    def close(self, patience_s: float = PATIENCE_S) -> None:
        """Wait for the reader, but for `patience_s` after the last byte that it took;
        then end the thread.
        """
        try:
            self._wait_until(lambda: self._is_all_written, patience_s)
        finally:
            self._is_closed = True
            self._pieces.put(Piece(OutputKind.END))

    def _wait_until(self, is_done: Callable[[], bool], patience_s: float = math.inf) -> None:
        """Wait until something is done, the file has failed, or the reader takes nothing.

        Args:
            is_done: what is waited for.
            patience_s: longest time in which the reader takes no byte; it begins again with each.
        """
        written_bytes = self._written_bytes
        last_progress_s = self._clock()
        while not is_done() and self.error is None:
            now_s = self._clock()
            if self._written_bytes != written_bytes:
                written_bytes = self._written_bytes
                last_progress_s = now_s
            if now_s - last_progress_s > patience_s:
                return
            time.sleep(POLL_S)

    def _require_results(self) -> None:
        """Raise the error of the file where a result is lost by it."""
        if self.error is None:
            return
        if self._waiting_results > 0 or self._has_lost_result:
            raise self.error

    def _run(self) -> None:
        """Write the pieces in their order, in the thread."""
        # Signals are for the main thread.
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        while True:
            piece = self._pieces.get()
            if piece.kind is OutputKind.END:
                return
            content = piece.content
            if piece.kind is OutputKind.LOSSES:
                content = self._take_losses()
            is_complete = self._write_out(content)
            is_result = piece.kind is OutputKind.RESULT
            # `_require_results` reads both in another thread: a lost result is marked before it is
            # no longer counted as waiting, so that one of them tells of it at any time.
            if is_result and not is_complete:
                self._has_lost_result = True
            with self._lock:
                self._waiting_bytes -= len(content)
                if is_result:
                    self._waiting_results -= 1

    def _take_losses(self) -> bytes:
        """Return the line about what was left out, which counts as waiting from now on;
        later remarks are written again.
        """
        with self._lock:
            content = self.losses_line(self._unsaid_lines).encode()
            self._unsaid_lines = 0
            self._waiting_bytes += len(content)
        return content

    def _write_out(self, content: bytes) -> bool:
        """Write a piece; return whether all of it was written.

        It was not where the file has failed, now or earlier, or the writer was closed.
        """
        rest = memoryview(content)
        while rest and self.error is None and not self._is_closed:
            try:
                written_bytes = self._write_once(bytes(rest[:CHUNK_BYTES]))
            except OSError as error:
                self.error = error
                return False
            self._written_bytes += written_bytes
            rest = rest[written_bytes:]
        return not rest

    def _write_once(self, content: bytes) -> int:
        """Return the number of bytes that the file has taken, 0 after a wait for it."""
        try:
            return self._write(self._descriptor, content)
        except BlockingIOError:
            # Another program has made the file non-blocking.
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
        # The caller may use its buffer again: the piece is a copy.
        copied = bytes(content)  # type: ignore[call-overload]  # a buffer, as typeshed has it since 3.12
        self.writer.put(Piece(self._kind, copied))
        return len(copied)


class QueuedOutput:
    """Context manager within which `sys.stdout` and `sys.stderr` never block;
    a stream without a file stays.

    Where both are one file, such as a terminal, one writer keeps the order of what is printed.
    """

    def __init__(self) -> None:
        self._direct_streams: tuple[TextIO, TextIO] = (sys.stdout, sys.stderr)
        self._writers: list[tuple[os.stat_result, OutputWriter]] = []  # with the status of its file

    def __enter__(self) -> QueuedOutput:
        self._direct_streams = (sys.stdout, sys.stderr)
        sys.stdout = self._queued_stream(sys.stdout, OutputKind.RESULT)
        sys.stderr = self._queued_stream(sys.stderr, OutputKind.REMARK)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        try:
            for _status, writer in self._writers:
                writer.close()
        finally:
            sys.stdout, sys.stderr = self._direct_streams

    def wait_for_results(self) -> None:
        """Wait until somebody has taken what was printed on stdout.

        Raises:
            OSError: it cannot be written.
        """
        for _status, writer in self._writers:
            writer.wait_for_results()

    def _queued_stream(self, stream: TextIO, kind: OutputKind) -> TextIO:
        """Return a stream whose text goes through a writer; the stream itself without a file."""
        try:
            descriptor = stream.fileno()
            status = os.fstat(descriptor)
            stream.flush()
        except (AttributeError, OSError, ValueError):
            # There is no stream, it is in memory, or it is closed.
            return stream
        writer = self._writer_of(status, descriptor)
        file = _QueuedFile(writer, kind, descriptor, stream.name)
        # typeshed asks for a buffered file; `python -u` has an unbuffered one there, too.
        buffer: IO[bytes] = file  # type: ignore[assignment]
        return io.TextIOWrapper(
            buffer, encoding=stream.encoding, errors=stream.errors, write_through=True
        )

    def _writer_of(self, status: os.stat_result, descriptor: int) -> OutputWriter:
        """Return the writer of the file with this status; stdout and stderr may be one file."""
        for known_status, writer in self._writers:
            if os.path.samestat(known_status, status):
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


def output_error(stream: object) -> OSError | None:
    """The error of a stream that takes nothing any more; None where it has none."""
    writer = writer_of(stream)
    if writer is None:
        return None
    return writer.error


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
        _, writable, _ = select.select([], [sys.stderr], [], 0.0)
        if writable:
            sys.stderr.write(text)
