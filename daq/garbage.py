"""Python's search for garbage, kept short while SYNC must go out in time."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def settled() -> Iterator[None]:
    """What is there now, garbage included, is not searched until the block ends.

    A search through all that the program and its libraries have made takes tens of milliseconds, in which nothing else
    of the process runs: so many periods without SYNC at 1 kHz, and a run that is marked invalid.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
