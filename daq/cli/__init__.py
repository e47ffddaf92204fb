"""The command `drivegain`."""

import os

# Several threads make linear algebra of this size slower and take several times the processor time; the libraries read
# this when they are loaded. Who wants another number says so in the environment.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from daq.cli.app import main

__all__ = ["main"]
