"""A file that a thread of its own writes, so that a slow disk holds up nobody.

A write to a file waits for the disk now and then: for tens of milliseconds on a busy computer, for
seconds on a memory card. A recorder that waits sends no SYNC meanwhile, and the samples of those
cycles are lost.
"""

from __future__ import annotations

import errno
import io
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

#: A disk that takes nothing for so long is taken for one that has failed [s]
STALLED_S = 5.0


class QueuedFile(io.RawIOBase):
    """A new binary file whose `write` returns at once.

    What the disk refuses is raised by the next `write`, by `drain` or by `close`, and nothing
    is written behind it.
    """

    def __init__(
        self,
        descriptor: int,
        write: Callable[[int, memoryview], int] = os.write,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start the thread.

        Args:
            descriptor: of the file, which is closed with this one.
            write: writes a part of some bytes and returns their number, as `os.write`.
            clock_s: monotonic time [s].
        """
        super().__init__()
        self._descriptor = descriptor
        self.longest_wait_s = 0.0
        """Longest time between a `write` and the disk's having taken it [s]."""
        self._write = write
        self._clock_s = clock_s
        self._size_bytes = 0
        self._error: OSError | None = None
        #: Bytes with the time they were given at; None ends the thread
        self._pieces: SimpleQueue[tuple[float, bytes] | None] = SimpleQueue()
        self._untaken = 0  # pieces that the disk does not have yet
        self._oldest_s = 0.0  # when the piece that is being written was given
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    @classmethod
    def create(
        cls,
        path: Path,
        write: Callable[[int, memoryview], int] = os.write,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> QueuedFile:
        """Create a file of that name; the other arguments are those of the class.

        Raises:
            FileExistsError: there is a file of that name.
            OSError: the file system refuses.
        """
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        return cls(os.open(path, flags, 0o666), write, clock_s)

    def writable(self) -> bool:
        """Return that it can be written."""
        return True

    def fileno(self) -> int:
        """Return the file's descriptor."""
        return self._descriptor

    def tell(self) -> int:
        """Return the number of bytes given so far."""
        return self._size_bytes

    def write(self, data: ReadableBuffer, /) -> int:
        """Take some bytes, and return their number at once.

        Raises:
            OSError: the disk refused what was given before, or has taken nothing for `STALLED_S`.
        """
        now_s = self._clock_s()
        piece = bytes(data)
        with self._changed:
            self._raise_error()
            if self._untaken == 0:
                self._oldest_s = now_s
            elif now_s - self._oldest_s > STALLED_S:
                raise OSError(errno.ETIMEDOUT, f"the disk took nothing for {STALLED_S:g} s")
            self._untaken += 1
        self._size_bytes += len(piece)
        self._pieces.put((now_s, piece))
        return len(piece)

    def drain(self) -> None:
        """Wait until the disk has taken everything.

        Raises:
            OSError: it refused.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._untaken == 0)
            self._raise_error()

    def close(self) -> None:
        """Wait until everything is written, and close the file.

        Raises:
            OSError: the disk refused.
        """
        if self.closed:
            return
        self._pieces.put(None)
        self._thread.join()
        os.close(self._descriptor)
        super().close()
        self._raise_error()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        """Write piece by piece until the end, or until the disk refuses one."""
        while (piece := self._pieces.get()) is not None:
            given_s, data = piece
            with self._changed:
                self._oldest_s = given_s
            if self._error is None:
                try:
                    self._write_all(data)
                except OSError as error:
                    self._error = error
            waited_s = self._clock_s() - given_s
            with self._changed:
                self.longest_wait_s = max(self.longest_wait_s, waited_s)
                self._untaken -= 1
                self._changed.notify_all()

    def _write_all(self, data: bytes) -> None:
        rest = memoryview(data)
        while rest:
            written = self._write(self._descriptor, rest)
            rest = rest[written:]
