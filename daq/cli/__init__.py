"""The command `drivegain`."""

import os

# More threads make linear algebra of this size slower and take several times the processor time. The libraries read the
# variable when they are loaded; a value from the environment is kept.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# pydantic reads the metadata of every installed package in search of plugins; there are none for us.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

from daq.cli.app import main

__all__ = ["main"]
