"""Where the configurations that drivegain ships are: in the wheel, or in a checkout."""

from __future__ import annotations

import os
import pwd
from importlib.metadata import PackageNotFoundError, version
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


# Which software this is.


def software() -> str:
    """Name and version, as logs and calibrations keep it."""
    try:
        return f"drivegain {version('drivegain')}"
    except PackageNotFoundError:
        return "drivegain (not installed)"


# Who runs this program, as the operating system knows them.


def login() -> str:
    """Name of the user whose process this is, or the number of one without a name.

    Not what LOGNAME or USER say, which `getpass.getuser` asks first: a name that anybody may choose makes no second
    person.
    """
    number = os.getuid()
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"uid {number}"
