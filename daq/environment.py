"""The installation and the user: shipped configurations, version, login."""

from __future__ import annotations

import os
import pwd
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from daq.errors import ConfigurationMissing


def shipped_configurations() -> Path:
    """Return the folder with cells/, drives/, robots/, controllers/, imports/ and simulation/.

    Raises:
        ConfigurationMissing: it is neither in the wheel nor in a checkout.
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


def require_packages(subject: str, purpose: str, extra: str, *packages: str) -> None:
    """Check that the packages of an optional extra are installed, before any work.

    Raises:
        ConfigurationMissing: names the extra to install.
    """
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        raise ConfigurationMissing(
            subject,
            found=f"no package {' and '.join(missing)}",
            expected=f"{purpose} of the optional extra `{extra}`",
            remedy=f"pip install 'drivegain[{extra}]'",
        )


def software() -> str:
    """Return name and version for logs and calibrations."""
    try:
        return f"drivegain {version('drivegain')}"
    except PackageNotFoundError:
        return "drivegain (not installed)"


def login() -> str:
    """Return the name of the user of this process, or the number of a user without a name.

    LOGNAME and USER, which `getpass.getuser` prefers, are ignored: with them one person could pass
    for two.
    """
    number = os.getuid()
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"uid {number}"
