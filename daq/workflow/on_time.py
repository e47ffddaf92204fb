"""What lets a recorder send SYNC on time: no long search for garbage, threads that give way soon,
memory that stays, and real-time priority.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

NEVER = 2**31 - 1  #: Searches of the middle generation before one of everything
SWITCH_S = 0.0005  #: Time after which a thread gives way to one that waits; Python's own is 5 ms
#: mlockall(2): all that the process has mapped now, each page from when it is first used
MCL_CURRENT = 1
MCL_ONFAULT = 4


@contextmanager
def on_time() -> Iterator[None]:
    """Let the calling thread be on time while the block runs: all of the below."""
    with defer_full_gc(), switch_threads_soon(), memory_stays(), real_time_priority():
        yield


@contextmanager
def defer_full_gc() -> Iterator[None]:
    """Defer full collections until the block ends; young objects are still collected.

    A search through all that the program and its libraries have made takes tens of milliseconds, in
    which nothing else of the process runs: so many periods without SYNC at 1 kHz, and a run that is
    marked invalid. So what there is already is searched now, once: it would all be part of the
    first search of the middle generation, which comes within the first minute of a recording.
    """
    before = gc.get_threshold()
    gc.collect()
    # Python's own limits for young objects, which the command line raises: each of these searches
    # takes microseconds.
    gc.set_threshold(700, 10, NEVER)
    try:
        yield
    finally:
        gc.set_threshold(*before)


@contextmanager
def switch_threads_soon() -> Iterator[None]:
    """Let no thread keep the one that paces SYNC waiting for longer than half a millisecond.

    While another thread runs Python code, this one waits for Python's switch interval. On a
    terminal, a thread draws the progress five times a second.
    """
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before_s)


@contextmanager
def memory_stays() -> Iterator[None]:
    """Let the kernel take no page of the program away, where that is permitted.

    Under pressure, or where it reclaims what has not been used for a while, the kernel drops pages
    of a program and reads them again from the disk when they are needed. The thread that needs them
    waits for the disk, whatever its priority, and so does every thread that waits for it.

    Only what is mapped now is kept: with what comes later (MCL_FUTURE), a limit that is nearly
    reached would make an allocation fail in the run.
    """
    libc = ctypes.CDLL(None)
    # Without the right to it (CAP_IPC_LOCK, or a limit memlock that is large enough), it changes
    # nothing.
    libc.mlockall(MCL_CURRENT | MCL_ONFAULT)
    try:
        yield
    finally:
        libc.munlockall()


@contextmanager
def real_time_priority() -> Iterator[None]:
    """Run the calling thread before programs without real-time priority, where that is permitted.

    It is the lowest one, that of the process which stamps frames (`drivers/canopen/capture.py`).
    Threads and processes that are started in the block do not inherit it. A priority that the
    program was started with stays.
    """
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    if policy != os.SCHED_OTHER:
        yield
        return
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    try:
        yield
    finally:
        # The flag stays, because not everyone may clear it: without priority it changes nothing.
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
