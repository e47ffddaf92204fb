"""Being told to stop while a robot moves: by Ctrl-C, by a service manager (SIGTERM), by a terminal that has gone."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType

from drivers.network import Undisturbed

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
GRACE_S = 10.0
"""Longer than a stop of all axes takes."""


@contextmanager
def interruptible(
    clock: Callable[[], float] = time.monotonic, signals: tuple[signal.Signals, ...] = SIGNALS
) -> Iterator[Undisturbed]:
    """Turn some signals within the block into KeyboardInterrupt; pass over those that follow too soon.

    By default SIGTERM and SIGHUP end a process at once, and the axes would go on; a shell script starts what it puts
    into the background (&) deaf to SIGINT, and only a handler of its own makes it hear again. What follows the first
    signal is the stop of the axes: a second one, of an impatient person, must not cut that short. Later ones count
    again, so that nobody is left without a way out. A stop that a fault began is protected as long by whoever makes it,
    with what is yielded; a signal that comes meanwhile is dropped, for it asks for what is being done. In another
    thread than the main one nothing changes: Python handles no signals there.

    Args:
        clock: monotonic time [s].
        signals: those that interrupt.
    """
    if threading.current_thread() is not threading.main_thread():
        yield nullcontext
        return

    deaf_until_s = float("-inf")

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        nonlocal deaf_until_s
        if clock() >= deaf_until_s:
            deaf_until_s = clock() + GRACE_S
            raise KeyboardInterrupt

    @contextmanager
    def undisturbed() -> Iterator[None]:
        nonlocal deaf_until_s
        earlier_s, deaf_until_s = deaf_until_s, max(deaf_until_s, clock() + GRACE_S)
        try:
            yield
        finally:
            deaf_until_s = earlier_s

    before = [(number, signal.signal(number, interrupt)) for number in signals]
    try:
        yield undisturbed
    finally:
        for number, handler in before:
            signal.signal(number, handler)
