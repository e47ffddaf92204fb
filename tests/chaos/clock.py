"""A wall clock that is stepped for one process alone, at any moment,
without touching the machine's.

The C library's clock is replaced through LD_PRELOAD (clock.c), so what the interpreter reads is
stepped, too. It needs a C compiler; without one the acts on the clock are left out.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

PRELOAD = "LD_PRELOAD"
BUILT = "DRIVEGAIN_CHAOS_CLOCK"


class StepClock:
    """Step of the wall clock [s] of the processes that adopt it; shared with them."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, mmap.PAGESIZE)
        self._step = ctypes.c_int64.from_buffer(self._memory)

    def adopt(self) -> None:
        """Let this process, a fork, have this clock."""
        ctypes.CDLL(None).chaos_clock(ctypes.byref(self._step))

    def step(self, seconds: int) -> None:
        """Set the clock to its true time and so many seconds."""
        self._step.value = seconds


def available() -> bool:
    """Whether this process runs on the replaced clock."""
    return BUILT in os.environ


def begin_again(module: str) -> None:
    """Start this program anew on the replaced clock;
    return where that is done already, or impossible.
    """
    compiler = shutil.which("cc")
    if available() or compiler is None:
        return
    folder = Path(tempfile.mkdtemp(prefix="chaos-clock-"))
    library = folder / "clock.so"
    source = Path(__file__).with_name("clock.c")
    command = [compiler, "-shared", "-fPIC", "-O1", "-fno-builtin", "-o", str(library), str(source)]
    if subprocess.run(command, check=False).returncode != 0:
        shutil.rmtree(folder)
        return
    environment = {**os.environ, PRELOAD: str(library), BUILT: str(folder)}
    os.execve(sys.executable, [sys.executable, "-m", module, *sys.argv[1:]], environment)


def leave() -> None:
    """Remove what `begin_again` built."""
    built = os.environ.get(BUILT)
    if built is not None:
        shutil.rmtree(built, ignore_errors=True)
