"""The drives of a cell written with the gains of a calibration, and back again.

The drives are written by drivers/canopen/parameters.py: without power, read back, saved, all of them or none. What
stood there is on the disk before the first is touched (drive_record.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path

from daq.config.cell import Cell
from daq.errors import CalibrationRefused, ControllerChanged, ControllerUnfit
from daq.files import sha256
from daq.ledger.audit import AuditAction, AuditRecorder
from daq.writeback.drive_proposal import DriveProposal, canonical, digest, drives_of, refused
from daq.writeback.drive_record import DriveNote, DriveRecord, read_record, read_records, record_folder, write_record
from daq.writeback.file_access import exclusive_writer
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.parameters import (
    ParameterChange,
    ParameterValue,
    ParameterWrite,
    Saving,
    read_parameters,
    write_parameters,
)
from drivers.profiles.profile import Axis, Parameter

# From the records of writes to the drives back: what would be put back, and whether that loses somebody's work.


@dataclass(frozen=True, slots=True)
class DriveRollback:
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


def plan_drive_rollback(declared: Cell, network: CanopenNetwork) -> DriveRollback:
    """What stood in the drives before the last write that changed them, whole or cut off by a kill; reads only.

    Args:
        declared: the cell.
        network: of all axes of the cell, open, and not prepared for recording.

    Raises:
        CalibrationRefused: there is no record of such a write.
        ControllerUnfit: its record was changed, or is of another cell.
        ControllerChanged: a drive was exchanged, or somebody has changed a gain since.
        DriverError: see `drivers.canopen.parameters.read_parameters`.
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
        return DriveRollback(declared.name, folder, record, base, writes)
    raise CalibrationRefused(
        drives_of(declared.name),
        found=f"{len(paths)} records of what stands there now" if paths else f"no record in {folder}",
        expected="the record of a write that changed them",
        remedy="nothing was written",
    )


def _recorded(declared: Cell, network: CanopenNetwork, record: DriveRecord) -> list[tuple[Axis, Parameter]]:
    axes = {(axis.name, axis.node_id): axis for axis in network.axes}
    unknown_axes = [note.axis for note in record.drives if (note.axis, note.node_id) not in axes]
    if record.cell != declared.name or unknown_axes:
        raise ControllerUnfit(
            str(record.path),
            found=f"a write to cell {record.cell!r}"
            + (f", with {', '.join(unknown_axes)} that this cell has not" if unknown_axes else ""),
            expected=f"one to the drives of cell {declared.name!r}",
            remedy="nothing was written; has the cell file been changed since?",
        )
    return [(axes[note.axis, note.node_id], note.parameter) for note in record.drives]


def _check_untouched(record: DriveRecord, base: tuple[ParameterValue, ...]) -> None:
    """Refuse where going back would lose what somebody else did."""
    for value, note in zip(base, record.drives, strict=True):
        identity = (value.identity.vendor_id, value.identity.product_code, value.identity.serial)
        if identity != (note.vendor_id, note.product_code, note.serial):
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


_BEGINS_AND_ENDS = {
    AuditAction.APPLY_BEGUN: AuditAction.APPLIED,
    AuditAction.ROLLBACK_BEGUN: AuditAction.ROLLED_BACK,
}


@dataclass(frozen=True, slots=True)
class DrivesWritten:
    """What was done to the drives.

    Attributes:
        target: what the audit calls them.
        record: file with what stood there before.
        changes: one a drive.
        sha256_after: digest of what stands in the drives now, and of which drives they are.
        source: record that was gone back to; None for a calibration.
        audit_sha256: of the audit's entry that tells of it, for whoever keeps it elsewhere; None without an audit.
    """

    target: str
    record: Path
    changes: tuple[ParameterChange, ...]
    sha256_after: str
    source: Path | None = None
    audit_sha256: str | None = None


def apply_to_drives(
    proposal: DriveProposal,
    network: CanopenNetwork,
    now: datetime,
    *,
    saving: Saving = Saving.KNOWN,
    audit: Path | None = None,
    who: str = "",
) -> DrivesWritten:
    """Make a proposed change.

    Drives that have these gains already are told to save them: that they stand in RAM does not say that they stay.

    Args:
        proposal: without refusals.
        network: as in `propose_to_drives`.
        now: for the record's name and the audit.
        saving: whether the drives keep it.
        audit, who: as in `daq.writeback.file_proposal.apply`.

    Raises:
        CalibrationRefused: a gate is closed, with every one of them.
        ControllerChanged: something else stands in the drives than when the change was worked out.
        CalibrationRefused: another drivegain writes them.
        AuditUnusable: what is done could not be written down.
        DriverError: see `drivers.canopen.parameters.write_parameters`.
        OSError: the record could not be written; nothing was written to the drives.
    """
    if proposal.refusals:
        AuditRecorder(audit, who, now).record_refusal(
            Path(drives_of(proposal.cell)), proposal.refusals, proposal.evidence
        )
        raise refused(proposal)
    details = {"drives": _documented(proposal.base, proposal.writes), **proposal.evidence}
    with exclusive_writer(_made(proposal.folder)):
        return _write(
            network, proposal.cell, proposal.folder, proposal.base, proposal.writes, saving, now,
            begun=AuditAction.APPLY_BEGUN, audit=audit, who=who, details=details,
        )  # fmt: skip


def roll_back_drives(
    rollback: DriveRollback,
    network: CanopenNetwork,
    now: datetime,
    *,
    saving: Saving = Saving.KNOWN,
    audit: Path | None = None,
    who: str = "",
) -> DrivesWritten:
    """Put back what stood in the drives before a write.

    What it replaces is recorded too, so that a second way back undoes the first.

    Args:
        rollback: as it was worked out.
        network, now, saving, audit, who: as in `apply_to_drives`.

    Raises:
        ControllerChanged: something else stands in the drives than when the way was worked out.
        CalibrationRefused, AuditUnusable, DriverError, OSError: see `apply_to_drives`.
    """
    details = {"drives": _documented(rollback.base, rollback.writes), "restored": str(rollback.record.path)}
    with exclusive_writer(_made(rollback.folder)):
        written = _write(
            network, rollback.cell, rollback.folder, rollback.base, rollback.writes, saving, now,
            begun=AuditAction.ROLLBACK_BEGUN, audit=audit, who=who, details=details,
        )  # fmt: skip
    return replace(written, source=rollback.record.path)


def _write(
    network: CanopenNetwork,
    cell: str,
    folder: Path,
    base: tuple[ParameterValue, ...],
    writes: tuple[ParameterWrite, ...],
    saving: Saving,
    now: datetime,
    *,
    begun: AuditAction,
    audit: Path | None,
    who: str,
    details: Mapping[str, object],
) -> DrivesWritten:
    records: list[Path] = []

    def begin(found: tuple[ParameterValue, ...]) -> None:
        if digest(found) != digest(base):
            raise ControllerChanged(
                drives_of(cell),
                found="other values in the drives, or other drives",
                expected="those that the change was worked out for",
                remedy="look at a new dry run; nothing was written",
            )
        records.append(write_record(folder, cell, now, who, _notes(found, writes)))

    target = Path(drives_of(cell))
    before, after = canonical(base), canonical(base, tuple(write.word for write in writes))
    ended = _BEGINS_AND_ENDS[begun]
    changes, audit_digest = AuditRecorder(audit, who, now).record_write(
        begun, ended, target, before, after, {"saving": saving.value, **details},
        partial(write_parameters, network, writes, saving, begin),
    )  # fmt: skip
    return DrivesWritten(str(target), records[0], changes, sha256(after), audit_sha256=audit_digest)


def _notes(found: tuple[ParameterValue, ...], writes: tuple[ParameterWrite, ...]) -> tuple[DriveNote, ...]:
    return tuple(
        DriveNote(
            value.axis.name,
            value.axis.node_id,
            value.identity.vendor_id,
            value.identity.product_code,
            value.identity.serial,
            value.parameter,
            value.word,
            write.word,
        )
        for value, write in zip(found, writes, strict=True)
    )


def _documented(base: tuple[ParameterValue, ...], writes: tuple[ParameterWrite, ...]) -> list[dict[str, object]]:
    """For the audit, which takes finite numbers only: the bits are whole."""
    return [
        {
            "axis": value.axis.name,
            "node_id": value.axis.node_id,
            "serial": value.identity.serial,
            "object": str(value.parameter),
            "type": value.parameter.kind.value,
            "old": value.word,
            "new": write.word,
        }
        for value, write in zip(base, writes, strict=True)
    ]


def _made(folder: Path) -> Path:
    """The folder of the records; its lock is beside it."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    return folder
