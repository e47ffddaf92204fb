"""Whether the ampere that the drives tell can be true of the motors of the cell; asked before anything is recorded."""

from __future__ import annotations

from collections.abc import Sequence

from daq.configuration.cell import Cell
from daq.report.current_signal import actual_current_note
from drivers.scale import ScaleReading, check_name_plate
from ident.drive_train import DriveTrain


def check_currents(cell: Cell, readings: Sequence[ScaleReading]) -> tuple[str, ...]:
    """Hold each drive's torque constant against the cell's nameplate gain, g = N·Gt·Kt (paper eq. 4).

    Args:
        cell: with nameplate gains and drive train.
        readings: of its drives, in the order of the axes (drivers.scale.read_scale).

    Returns:
        What people must know of the recorded currents: no reference, what could not be checked, what fits badly.

    Raises:
        ScaleImplausible: the two torque constants differ by a factor of five or more.
    """
    told: dict[str, list[str]] = {}
    for axis, reduction, reading in zip(cell.axes, DriveTrain(cell.ratio).reduction, readings, strict=True):
        found = reading.warnings
        if axis.profile is None or not axis.gain_unit.startswith(("Nm/A", "N/A")):
            found += (f"the gain is in {axis.gain_unit}; the torque constant cannot be checked",)
        else:
            found += check_name_plate(reading, axis.profile.amplitude, axis.nameplate_gain / float(reduction))
        for warning in found:
            told.setdefault(warning, []).append(axis.name)
    note = actual_current_note(cell)
    grouped = tuple(f"{', '.join(names)}: {warning}" for warning, names in told.items())
    return grouped if note is None else (note, *grouped)
