"""Screens that take nothing, and printing to them."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from daq.cli.output import QueuedOutput


@contextmanager
def full_pipe() -> Iterator[tuple[int, int]]:
    """A pipe full of dots, which takes nothing any more: its ends to read and to write."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writing, b"." * 4096)
    os.set_blocking(writing, True)
    try:
        yield reading, writing
    finally:
        os.close(reading)
        with suppress(OSError):  # closed already, for the reader to see the end
            os.close(writing)


@contextmanager
def printing_to(writing: int) -> Iterator[QueuedOutput]:
    """Let `sys.stdout` and `sys.stderr` be one file within the block, and queue what is printed."""
    before = (sys.stdout, sys.stderr)
    with os.fdopen(os.dup(writing), "w") as out, os.fdopen(os.dup(writing), "w") as err:
        sys.stdout = out
        sys.stderr = err
        try:
            with QueuedOutput() as output:
                yield output
        finally:
            sys.stdout, sys.stderr = before
