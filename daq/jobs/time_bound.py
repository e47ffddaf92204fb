"""Time limit of a job: an alarm that stops the axes, and is deferred while they are being stopped."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType

from daq.errors import TimeBoundReached
from drivers.canopen.network import SignalBlocker

AGAIN_S = 1.0  #: After an alarm that came while the axes were being stopped for another reason


@contextmanager
def time_bound(minutes: float) -> Iterator[SignalBlocker]:
    """Raise TimeBoundReached in the block when its time is up; yields a function that defers it during a stop.

    There is no alarm outside the main thread, where Python handles no signals.

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
            remedy="the axes were commanded to stop; the next job resumes the session; raise max_duration_min, or "
            "see what takes so long in its log",
        )

    @contextmanager
    def block_signals() -> Iterator[None]:
        nonlocal stopping
        stopping += 1
        try:
            yield
        finally:
            stopping -= 1

    before = signal.signal(signal.SIGALRM, up)
    signal.setitimer(signal.ITIMER_REAL, 60.0 * minutes)
    try:
        yield block_signals
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
