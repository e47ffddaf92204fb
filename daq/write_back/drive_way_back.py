"""From the records of writes to the drives back: what would be put back, and whether that loses somebody's work."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from daq.configuration.cell import Cell
from daq.errors import BackupMissing, ControllerChanged, ControllerUnfit
from daq.write_back.drive_proposal import drives_of
from daq.write_back.drive_record import DriveRecord, read_record, read_records, record_folder
from drivers.axis import Axis
from drivers.network import CanopenNetwork
from drivers.parameter import Parameter
from drivers.parameter_write import ParameterValue, ParameterWrite, read_parameters


@dataclass(frozen=True, slots=True)
class DriveWayBack:
    """A way back that has been worked out and not gone.

    Attributes:
        cell: its name.
        folder: of the records.
        record: of the write that is taken back.
        base: what stands in the drives.
        writes: what would stand there.
    """

    cell: str
    folder: Path
    record: DriveRecord
    base: tuple[ParameterValue, ...]
    writes: tuple[ParameterWrite, ...]


def way_back_of_drives(declared: Cell, network: CanopenNetwork) -> DriveWayBack:
    """What stood in the drives before the last write that changed them, whole or cut off by a kill; reads only.

    Args:
        declared: the cell.
        network: of all axes of the cell, open, and not prepared for recording.

    Raises:
        BackupMissing: there is no record of such a write.
        ControllerUnfit: its record was changed, or is of another cell.
        ControllerChanged: a drive was exchanged, or somebody has changed a gain since.
        DriverError: see `drivers.parameter_write.read_parameters`.
    """
    folder = record_folder(declared)
    paths = read_records(folder)
    for path in reversed(paths):
        record = read_record(path)
        base = read_parameters(network, _recorded(declared, network, record))
        # A writer that was killed before its first write leaves a record of what still stands.
        if all(value.word == note.old for value, note in zip(base, record.drives, strict=True)):
            continue
        _check_untouched(record, base)
        writes = tuple(
            ParameterWrite(value.axis, note.parameter, note.old)
            for value, note in zip(base, record.drives, strict=True)
        )
        return DriveWayBack(declared.name, folder, record, base, writes)
    raise BackupMissing(
        drives_of(declared.name),
        found=f"{len(paths)} records of what stands there now" if paths else f"no record in {folder}",
        expected="the record of a write that changed them",
        remedy="nothing was written",
    )


def _recorded(declared: Cell, network: CanopenNetwork, record: DriveRecord) -> list[tuple[Axis, Parameter]]:
    axes = {(axis.name, axis.node_id): axis for axis in network.axes}
    strangers = [note.axis for note in record.drives if (note.axis, note.node_id) not in axes]
    if record.cell != declared.name or strangers:
        raise ControllerUnfit(
            str(record.path),
            found=f"a write to cell {record.cell!r}"
            + (f", with {', '.join(strangers)} that this cell has not" if strangers else ""),
            expected=f"one to the drives of cell {declared.name!r}",
            remedy="nothing was written; has the cell file been changed since?",
        )
    return [(axes[note.axis, note.node_id], note.parameter) for note in record.drives]


def _check_untouched(record: DriveRecord, base: tuple[ParameterValue, ...]) -> None:
    """Refuse where going back would lose what somebody else did."""
    for value, note in zip(base, record.drives, strict=True):
        told = (value.identity.vendor_id, value.identity.product_code, value.identity.serial)
        if told != (note.vendor_id, note.product_code, note.serial):
            raise ControllerChanged(
                f"{note.axis} (node {note.node_id})",
                found=f"another drive, with serial number {value.identity.serial}",
                expected=f"the one that was written, with {note.serial}",
                remedy="nothing was written; calibrate again after an exchange",
            )
        if value.word not in (note.old, note.new):
            raise ControllerChanged(
                f"{note.axis}, {note.parameter}",
                found=f"{value.value:.9g}",
                expected=f"{note.parameter.value(note.new):.9g} as drivegain wrote it, or "
                f"{note.parameter.value(note.old):.9g} as before",
                remedy=f"nothing was written: somebody has changed it since; {record.path} has the old values",
            )
