"""The command `drivegain`."""

from daq.cli.app import main

__all__ = ["main"]
