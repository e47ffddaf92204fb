"""Python's search for garbage, kept short while SYNC must go out in time."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

NEVER = 2**31 - 1
"""Searches of the middle generation before one of everything."""


@contextmanager
def short_searches() -> Iterator[None]:
    """What has lived for long is not searched until the block ends; what is made meanwhile is.

    A search through all that the program and its libraries have made takes tens of milliseconds, in which nothing else
    of the process runs: so many periods without SYNC at 1 kHz, and a run that is marked invalid.
    """
    young, middle, old = gc.get_threshold()
    gc.set_threshold(young, middle, NEVER)
    try:
        yield
    finally:
        gc.set_threshold(young, middle, old)
