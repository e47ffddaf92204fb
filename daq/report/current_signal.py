"""What the recorded current is, in words: a gain by the actual current is not one by the reference."""

from __future__ import annotations

from daq.configuration.cell import Cell
from drivers.profile import TapPoint


def signals(cell: Cell) -> dict[str, str]:
    """Of each axis with an amplifier: "current reference 6074h:00, rms" or "ACTUAL current 6077h:00, unstated"."""
    return {
        axis.name: f"{axis.profile.signal}, amplitude {axis.profile.amplitude.value}"
        for axis in cell.axes
        if axis.profile is not None
    }


def actual_current_note(cell: Cell) -> str | None:
    """A warning where an axis has no current reference, None where every axis has one."""
    actual = [axis for axis in cell.axes if axis.profile is not None and axis.profile.tap is TapPoint.ACTUAL]
    if not actual:
        return None
    drives = ", ".join(dict.fromkeys(axis.profile.name for axis in actual if axis.profile is not None))
    return (
        f"{', '.join(axis.name for axis in actual)}: ACTUAL current, not the reference ({drives} has none to log): its "
        "gains are Nm per A of actual current"
    )
