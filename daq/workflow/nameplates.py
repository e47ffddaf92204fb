"""Compare the nameplate gains of a cell with the current gains,
and with the motors' data in the drives.

A mistyped nameplate is found before anything moves. What tolerances and gear losses can explain is
a warning at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from daq.config.cell import Cell, CellAxis
from daq.config.yaml_file import Fault, fault_texts, parse_yaml
from daq.config.yaml_file import read_yaml_bytes as read_configuration
from daq.errors import ConfigurationInconsistent, ControllerUnfit
from daq.formats.document import decode_document, read_controller_file
from drivers.canopen.scale import ScaleReading, check_nameplate
from drivers.profiles.profile import TapPoint
from ident.model.model import DriveTrain
from ident.plausible import NAMEPLATE_RATIO


@dataclass(frozen=True, slots=True)
class Reference:
    """What a nameplate is compared with:
    the current gain, or N·Kt of the motor's data in the drive.
    """

    gain: float  #: in the unit of the nameplate
    name: str  #: what it is, in words
    source: str  #: where it was read


def check_controller(cell_file: Path, cell: Cell) -> None:
    """Compare each nameplate with the current gain in the controller's file.

    A file that cannot be read, or without such a number, is left to `drivegain apply`: there need
    not be one before.

    Args:
        cell_file: file of the cell, for the lines.
        cell: content of it.

    Raises:
        ConfigurationInconsistent: one is more than NAMEPLATE_RATIO times the other.
    """
    controller = cell.controller
    file = cell.controller_path
    if controller is None or file is None:
        return
    try:
        content = read_controller_file(file)
        document = decode_document(content, str(file), controller.format)
        numbers = document.locate(controller.keys)
    except ControllerUnfit:
        return
    current_gains = []
    for number, factor in zip(numbers, controller.factors, strict=True):
        source = f"{file.name}, line {number.line}"
        current_gains.append(Reference(number.value / factor, "the current gain", source))
    _require_alike(cell_file, cell, current_gains)


def check_nameplates(cell_file: Path, cell: Cell, readings: Sequence[ScaleReading | None]) -> None:
    """Compare each nameplate with the current gain, and with N·Kt of the motor's data in the drive
    (paper eq. 4).

    Args:
        cell_file: file of the cell, for the lines.
        cell: content of it.
        readings: of each drive; None for one that does not answer.

    Raises:
        ConfigurationInconsistent: one is more than NAMEPLATE_RATIO times the other.
    """
    check_controller(cell_file, cell)
    references = list[Reference | None]()
    reductions = DriveTrain(cell.ratio).reduction.tolist()
    for axis, reduction, reading in zip(cell.axes, reductions, readings, strict=True):
        constant = None if reading is None else reading.torque_constant_nm_per_a
        if reading is None or constant is None or not _comparable(axis):
            references.append(None)
            continue
        source = f"{reading.rated_torque_nm} Nm / {reading.rated_current_a} A"
        gain = constant * abs(reduction)
        references.append(Reference(gain, "N·Kt of the drive's motor", source))
    _require_alike(cell_file, cell, references)


def nameplate_warnings(cell: Cell, readings: Sequence[ScaleReading | None]) -> tuple[str, ...]:
    """Return warnings about the recorded currents:
    no reference, what cannot be checked, what differs.

    Args:
        cell: content of its file.
        readings: of each drive; None for one that does not answer.
    """
    axes_by_warning: dict[str, list[str]] = {}
    reductions = DriveTrain(cell.ratio).reduction.tolist()
    for axis, reduction, reading in zip(cell.axes, reductions, readings, strict=True):
        if reading is None:
            continue
        found = reading.warnings
        if axis.profile is None or not _comparable(axis):
            found += (f"the gain is in {axis.gain_unit}; the torque constant cannot be checked",)
        else:
            motor_gain = axis.nameplate_gain / reduction
            found += check_nameplate(reading, axis.profile.amplitude, motor_gain)
        for warning in found:
            axes_by_warning.setdefault(warning, []).append(axis.name)
    warnings = []
    note = actual_current_note(cell)
    if note is not None:
        warnings.append(note)
    for warning, axes in axes_by_warning.items():
        names = ", ".join(axes)
        warnings.append(f"{names}: {warning}")
    return tuple(warnings)


def _comparable(axis: CellAxis) -> bool:
    """Whether the gain is per ampere, as the torque constant is."""
    if axis.profile is None:
        return False
    return axis.gain_unit.startswith(("Nm/A", "N/A"))


def actual_current_note(cell: Cell) -> str | None:
    """Warning where an axis has no current reference:
    its gain is per actual current, not per reference.
    """
    axis_names = []
    profile_names = []
    for axis in cell.axes:
        if axis.profile is not None and axis.profile.tap is TapPoint.ACTUAL:
            axis_names.append(axis.name)
            profile_names.append(axis.profile.name)
    if not axis_names:
        return None
    axes = ", ".join(axis_names)
    drives = ", ".join(dict.fromkeys(profile_names))
    return (
        f"{axes}: ACTUAL current, not the reference ({drives} reports none): the gains are Nm per "
        "A of actual current"
    )


def _require_alike(cell_file: Path, cell: Cell, references: Sequence[Reference | None]) -> None:
    """Refuse nameplates whose size is beyond NAMEPLATE_RATIO of a reference;
    signs are compared before a write.
    """
    wrong: dict[int, Reference] = {}
    for index, reference in enumerate(references):
        nameplate = cell.axes[index].nameplate_gain
        if reference is not None and not _alike(nameplate, reference.gain):
            wrong[index] = reference
    if not wrong:
        return
    document = parse_yaml(read_configuration(cell_file), str(cell_file))
    faults = []
    for index, reference in wrong.items():
        axis = cell.axes[index]
        keys = document.tree["axes"][index]
        key = next(key for key in keys if key.startswith("nameplate_gain"))
        written = f"{axis.nameplate_gain:g} {axis.gain_unit}"
        other = f"{reference.name} is {reference.gain:.4g} ({reference.source})"
        found = f"{written}, while {other}"
        expected = f"the same within a factor of {NAMEPLATE_RATIO:g}"
        faults.append(Fault(("axes", index, key), found, expected))
    raise ConfigurationInconsistent(
        **fault_texts(document, faults),
        remedy="correct the nameplate, the gear ratio or the other number: is one of them in "
        "another unit (mA, mNm), on the motor's side, or of another axis?",
    )


def _alike(one: float, other: float) -> bool:
    smaller, larger = sorted((abs(one), abs(other)))
    return larger < NAMEPLATE_RATIO * smaller
