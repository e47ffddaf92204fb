"""Whether this machine keeps the times of a cell just now.

    python -m tests.vcan.punctuality        (prints what it measured)

One process plays the recorder, another one the amplifiers: a datagram every 20 ms, a short piece
of work, six answers. A cycle is late when its answers are not complete after half a period; a
recording of some hundred cycles then loses some of them, whatever the recorder does. It shares no
code with the product, so a slow product does not excuse itself.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

CYCLES = 1000
"""Twice as many as a recording of these tests has, about."""
PERIOD_S = 0.02
ANSWERS = 6
MANY_LATE = 3
"""With so many in 1000, one recording of 700 cycles in eight is complete by chance."""
WORK = tuple(range(100_000))
"""Some 3 ms of a processor, which recorder, amplifiers and listener take for a cycle in a guest."""


@dataclass(frozen=True)
class Punctuality:
    """What was measured.

    Attributes:
        cycles: number of them.
        late: how many were late.
        longest_s: longest time from the moment a cycle was due to its last answer.
    """

    cycles: int
    late: int
    longest_s: float

    @property
    def is_enough(self) -> bool:
        """Whether one recording in some attempts can have lost nothing."""
        return self.late < MANY_LATE

    def __str__(self) -> str:
        return (
            f"{self.late} of {self.cycles} cycles of {1e3 * PERIOD_S:.0f} ms were late; "
            f"the slowest took {1e3 * self.longest_s:.0f} ms"
        )


def measure_punctuality(cycles: int = CYCLES) -> Punctuality:
    """Play the cycles; they take 20 s."""
    took_s = []
    with _answering_process() as end:
        due_s = time.monotonic() + PERIOD_S
        for _ in range(cycles):
            time.sleep(max(0.0, due_s - time.monotonic()))
            end.send(b"sync")
            for _ in range(ANSWERS):
                end.recv(8)
            took_s.append(time.monotonic() - due_s)
            due_s += PERIOD_S
    late = sum(one_s > PERIOD_S / 2 for one_s in took_s)
    return Punctuality(cycles, late, max(took_s))


@contextmanager
def _answering_process() -> Iterator[socket.socket]:
    """The amplifiers; yields the recorder's end of the connection."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    command = [sys.executable, "-m", "tests.vcan.punctuality", str(theirs.fileno())]
    with ours, subprocess.Popen(command, pass_fds=(theirs.fileno(),)) as process:
        theirs.close()
        ours.recv(8)  # it is there
        try:
            yield ours
        finally:
            ours.shutdown(socket.SHUT_RDWR)
            process.wait()


def answer(end: socket.socket) -> None:
    """Answer each datagram until the other end is closed."""
    end.send(b"ready")
    while end.recv(8):
        sum(WORK)
        for _ in range(ANSWERS):
            end.send(b"answer")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        answer(socket.socket(fileno=int(sys.argv[1])))
    else:
        print(measure_punctuality())  # noqa: T201
