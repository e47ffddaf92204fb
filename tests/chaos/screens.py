"""What a recorder prints to: a file, a pipe with a reader, or a terminal;
readers stop, or go away.
"""

from __future__ import annotations

import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from tests.chaos.faults import Act, Fault

ROWS = 50
COLUMNS = 250
FILLER = b"\0"
ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\0|\r")
READER_S = 5.0
STOPPED_STATES = "TtXZ"  #: States of a process that reads no more (proc_pid_stat(5))


class Screen:
    """A pipe or a terminal, and the process that reads it into a file.

    Attributes:
        inside: descriptor that the recorder writes to.
        terminal: whether it is a terminal.
    """

    def __init__(self, words: Path, *, terminal: bool) -> None:
        self.terminal = terminal
        outside, self.inside = pty.openpty() if terminal else os.pipe()
        if terminal:
            fcntl.ioctl(self.inside, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        with words.open("wb") as file:
            self._reader = subprocess.Popen(
                ["cat"], stdin=outside, stdout=file, stderr=subprocess.DEVNULL
            )
        os.close(outside)

    def stop(self) -> None:
        """Stop the reader; a pipe is full then, so that the next byte would have to wait."""
        self._reader.send_signal(signal.SIGSTOP)
        end_s = time.monotonic() + READER_S
        while self._reader_state() not in STOPPED_STATES and time.monotonic() < end_s:
            time.sleep(0.001)  # until then it may read on
        if self.terminal:
            return
        # The file description of its own: the recorder's must not become non-blocking.
        filling = os.open(f"/proc/self/fd/{self.inside}", os.O_WRONLY | os.O_NONBLOCK)
        try:
            for size in (4096, 1):
                with suppress(BlockingIOError):
                    while True:
                        os.write(filling, FILLER * size)
        finally:
            os.close(filling)

    def _reader_state(self) -> str:
        with suppress(OSError):
            return (
                Path(f"/proc/{self._reader.pid}/stat")
                .read_text(encoding="ascii")
                .rpartition(") ")[2][:1]
            )
        return "X"

    def go_on(self) -> None:
        """Let the reader go on."""
        self._reader.send_signal(signal.SIGCONT)

    def close_reader(self) -> None:
        """End the reader: a pipe without one breaks, a terminal hangs up."""
        self._reader.kill()
        self._reader.wait()

    def close(self) -> None:
        """Close this end and wait for the reader."""
        os.close(self.inside)
        self.go_on()
        try:
            self._reader.wait(READER_S)
        except subprocess.TimeoutExpired:
            self.close_reader()


def screen_of(faults: Collection[Fault], words: Path) -> Screen | None:
    """Return the screen that the acts of a round need; without such acts a file does."""
    for fault in faults:
        if fault.kind is Act.TERMINAL_CLOSED:
            return Screen(words, terminal=True)
    for fault in faults:
        if fault.kind is Act.SCREEN_CLOSED:
            return Screen(words, terminal=False)
    for fault in faults:
        if fault.kind is Act.SCREEN_STOPPED:
            return Screen(words, terminal=fault.value % 2 == 1)
    return None


def plain(words: str) -> str:
    """Return what was printed without the escapes of a terminal and what only filled a pipe."""
    return ESCAPES.sub("", words)
