"""Where the configurations that drivegain ships are: in the wheel, or in a checkout."""

from __future__ import annotations

from pathlib import Path

from daq.errors import ConfigurationMissing


def shipped_configurations() -> Path:
    """The folder with cells/, drives/, robots/, controllers/, imports/ and simulation/.

    Raises:
        ConfigurationMissing: neither the wheel's copy nor a checkout's is there.
    """
    package = Path(__file__).resolve().parent
    candidates = (package / "_configs", package.parent / "configs")
    for candidate in candidates:
        if (candidate / "cells").is_dir():
            return candidate
    raise ConfigurationMissing(
        "the configurations shipped with drivegain",
        found="neither " + " nor ".join(map(str, candidates)),
        expected="one of them",
        remedy="install drivegain again",
    )
