"""Which software this is."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def software() -> str:
    """Name and version, as logs and calibrations keep it."""
    try:
        return f"drivegain {version('drivegain')}"
    except PackageNotFoundError:
        return "drivegain (not installed)"
