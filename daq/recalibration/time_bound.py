"""A bound on the time of a whole job, which also ends a motion: by the alarm that the system keeps for each process."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType

from daq.errors import TimeBoundReached
from drivers.network import Undisturbed

AGAIN_S = 1.0
"""After an alarm that came while the axes were being stopped for another reason."""


@contextmanager
def time_bound(minutes: float) -> Iterator[Undisturbed]:
    """Raise where the block is, once the time is up; what is yielded keeps the alarm from disturbing a stop.

    In another thread than the main one there is no alarm: Python handles no signals there.

    Args:
        minutes: of the block [min].

    Raises:
        TimeBoundReached: in the block.
    """
    if threading.current_thread() is not threading.main_thread():
        yield nullcontext
        return
    stopping = 0

    def up(_number: int, _frame: FrameType | None) -> None:
        if stopping:
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
            return
        raise TimeBoundReached(
            "the job",
            found=f"more than {minutes:g} min since it began",
            expected="its end within max_duration_min",
            remedy="the axes were told to stop; the next job goes on where this one ended; raise max_duration_min, or "
            "see what takes so long in its log",
        )

    @contextmanager
    def undisturbed() -> Iterator[None]:
        nonlocal stopping
        stopping += 1
        try:
            yield
        finally:
            stopping -= 1

    before = signal.signal(signal.SIGALRM, up)
    signal.setitimer(signal.ITIMER_REAL, 60.0 * minutes)
    try:
        yield undisturbed
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
