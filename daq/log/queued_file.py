"""A file that is written by a thread, so that a slow disk delays nothing else.

A write to a file waits for the disk now and then: for tens of milliseconds on a busy computer, for
seconds on a memory card. A recorder that waits sends no SYNC meanwhile, and the samples of those
cycles are lost.
"""

from __future__ import annotations

import errno
import io
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

BEHIND_S = 5.0  #: A disk that is farther behind has failed


@dataclass(frozen=True, slots=True)
class _Piece:
    """Bytes that the disk does not have yet."""

    given_s: float  #: when `write` took them
    data: bytes


class QueuedFile(io.RawIOBase):
    """A raw binary file whose `write` returns at once.

    What the disk refuses is raised by the next `write`, by `drain` or by `close`, and nothing is
    written after it.
    """

    def __init__(self, file: io.RawIOBase, clock_s: Callable[[], float] = time.monotonic) -> None:
        """Start the thread.

        Args:
            file: an open raw file, which is closed with this one.
            clock_s: monotonic time [s].
        """
        super().__init__()
        self.longest_wait_s = 0.0
        """Longest time until the disk had what a `write` took [s]."""
        self._file = file
        self._clock_s = clock_s
        self._size_bytes = 0
        self._error: OSError | None = None
        #: Guards the three below
        self._changed = threading.Condition()
        self._waiting: deque[_Piece] = deque()  # the first one is being written
        self._ends = False
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def writable(self) -> bool:
        """Return that it can be written."""
        return True

    def fileno(self) -> int:
        """Return the file's descriptor."""
        return self._file.fileno()

    def tell(self) -> int:
        """Return the number of bytes given so far."""
        return self._size_bytes

    def write(self, data: ReadableBuffer, /) -> int:
        """Take some bytes, and return their number at once.

        Raises:
            OSError: the disk refused what was given before, or is more than `BEHIND_S` behind.
        """
        piece = _Piece(self._clock_s(), bytes(data))
        with self._changed:
            self._raise_error()
            if self._waiting and piece.given_s - self._waiting[0].given_s > BEHIND_S:
                raise OSError(errno.ETIMEDOUT, f"the disk is more than {BEHIND_S:g} s behind")
            self._waiting.append(piece)
            self._changed.notify_all()
        self._size_bytes += len(piece.data)
        return len(piece.data)

    def drain(self) -> None:
        """Wait until the disk has taken everything.

        Raises:
            OSError: it refused.
        """
        with self._changed:
            self._changed.wait_for(lambda: not self._waiting)
            self._raise_error()

    def close(self) -> None:
        """Wait until everything is written, and close the file.

        Raises:
            OSError: the disk refused.
        """
        if self.closed:
            return
        with self._changed:
            self._ends = True
            self._changed.notify_all()
        self._thread.join()
        self._file.close()
        super().close()
        self._raise_error()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        """Write piece after piece until the end; none after one that the disk refused."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._ends)
                if not self._waiting:
                    return
                piece = self._waiting[0]
            if self._error is None:
                self._write(piece.data)
            waited_s = self._clock_s() - piece.given_s
            with self._changed:
                self.longest_wait_s = max(self.longest_wait_s, waited_s)
                self._waiting.popleft()
                self._changed.notify_all()

    def _write(self, data: bytes) -> None:
        """Write all of a piece, or keep the error."""
        rest = memoryview(data)
        try:
            while rest:
                written = self._file.write(rest)
                rest = rest[written:]
        except OSError as error:
            self._error = error
