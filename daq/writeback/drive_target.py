"""The drives of a cell as a target: one object in each drive holds the gain of its axis.

`drivers.canopen.parameters` writes them: without power, read back, saved, all of them or none. A
record of the write, with the previous gains, is on the disk before the first drive is touched. It
is called <time>.json and is never changed. It carries the digest of its content: a rollback writes
its numbers back into the drives.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from daq.arguments import of_kind, require_fields
from daq.config.cell import Cell
from daq.config.controller import GainObject
from daq.config.yaml_file import DocumentKind, StrictModel
from daq.errors import (
    CalibrationRefused,
    ConfigurationInconsistent,
    ControllerChanged,
    ControllerUnfit,
    OutputFailed,
    counted,
    reason_of,
)
from daq.files import read_regular, replace_file, sha256
from daq.ledger.fold import NEVER, utc
from daq.ledger.ledger import present_name
from daq.ledger.names import drives_of
from daq.writeback.file_access import exclusive_writer, next_order
from daq.writeback.request import Edit, GainChange, GateFinding, is_writable, require_axes
from daq.writeback.target import Written
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.parameters import (
    ParameterValue,
    ParameterWrite,
    Saving,
    read_parameters,
    write_parameters,
)
from drivers.profiles.profile import Axis, DriveParameter, ParameterKind
from ident.calibration import Calibration, Gain

_NAME = re.compile(r"([0-9]{8}T[0-9]{6}Z)(?:-([0-9]+))?\.json")
_MAX_BYTES = 2**20
_U32 = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]


class DriveNote(StrictModel):
    """One drive in a record."""

    axis: str  #: name of the axis
    node_id: Annotated[int, Field(ge=1, le=127)]  #: its node id
    vendor_id: _U32  #: vendor that the drive reported (1018h:1)
    product_code: _U32 | None  #: product (1018h:2)
    serial: _U32 | None  #: serial number (1018h:4)
    #: index of the object that was to be written
    index: Annotated[int, Field(ge=0x1000, le=0xFFFF)]
    subindex: Annotated[int, Field(ge=0, le=0xFF)]  #: its subindex
    type: ParameterKind  #: its data type
    old: _U32  #: bits of the previous gain
    new: _U32  #: bits of the gain that was to be written

    @property
    def parameter(self) -> DriveParameter:
        """The object."""
        return DriveParameter(self.index, self.subindex, self.type)


class DriveRecord(StrictModel):
    """One write to the drives of a cell."""

    document_kind: ClassVar[DocumentKind | None] = DocumentKind.DRIVE_RECORD

    format: Literal["drivegain drive record 1"]
    cell: str  #: name of the cell
    at: str  #: time, ISO 8601
    who: str  #: the operator or the job
    drives: tuple[DriveNote, ...]  #: one for each axis
    sha256: str  #: of all of the above


def record_folder(cell: Cell) -> Path:
    """Return the folder of a cell's records: `demo.drives`, by the name of `history.store`.

    Raises:
        ConfigurationInconsistent: the cell was read from a log, and has no folder.
    """
    if cell.history is None:
        raise ConfigurationInconsistent(
            f"cell {cell.name!r}",
            found="no folder of its own",
            expected="the cell's file",
            remedy="use the cell file, not the copy in a log",
        )
    store = cell.history.store
    # `demo.history.sqlite` and `demo.sqlite` both give `demo.drives`.
    stem = store.name.removesuffix(".sqlite").removesuffix(".history")
    return store.with_name(f"{stem}.drives")


def write_record(
    folder: Path, cell: str, now: datetime, who: str, drives: tuple[DriveNote, ...]
) -> Path:
    """Put a record on the disk, later in order than every other.

    Returns:
        Its path.

    Raises:
        OSError: from the file system.
    """
    folder.mkdir(parents=True, exist_ok=True)
    taken = list(_records(folder))
    path = folder / f"{next_order(taken, now)}.json"
    record = DriveRecord(
        format="drivegain drive record 1",
        cell=cell,
        at=now.isoformat(),
        who=who,
        drives=drives,
        sha256="",
    )
    content = {**_content_without_digest(record), "sha256": _digest(record)}
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    replace_file(path, text.encode())
    return path


def read_records(folder: Path) -> tuple[Path, ...]:
    """List the records of a folder, oldest first; none where there is no folder."""
    return tuple(_records(folder).values())


def _records(folder: Path) -> dict[tuple[str, int], Path]:
    """Return the records of a folder by time and count in their names, in that order."""
    if not folder.is_dir():
        return {}
    records: dict[tuple[str, int], Path] = {}
    for path in folder.iterdir():
        match = _NAME.fullmatch(path.name)
        if match is not None:
            time = match[1]
            count = int(match[2] or 0)
            records[(time, count)] = path
    return dict(sorted(records.items()))


def read_record(path: Path) -> DriveRecord:
    """Read a record.

    Raises:
        ControllerUnfit: it cannot be read, is no record, or was changed.
    """
    try:
        record = DriveRecord.model_validate_json(read_regular(path, _MAX_BYTES))
    except (OSError, ValueError) as error:
        first_line = str(error).splitlines()[0]
        raise _unfit(path, first_line[:200]) from error
    digest = _digest(record)
    if record.sha256 != digest:
        raise _unfit(
            path,
            f"content with SHA-256 {digest[:12]}…, not {record.sha256[:12]}… as it says",
        )
    return record


def _content_without_digest(record: DriveRecord) -> dict[str, object]:
    """Return what the digest of a record is taken of, as plain JSON."""
    return record.model_dump(mode="json", exclude={"sha256"})


def _digest(record: DriveRecord) -> str:
    """Return the SHA-256 of a record without its own, whatever the order of the keys."""
    text = json.dumps(_content_without_digest(record), sort_keys=True)
    return sha256(text.encode())


def _unfit(path: Path, found: str) -> ControllerUnfit:
    """Return the error for a file that is no record, or was changed."""
    return ControllerUnfit(
        str(path),
        found=found,
        expected="the record of a write to drives, as drivegain wrote it",
        remedy="nothing was written; enter the previous gains with the drives' own tool",
    )


_REVIEW_REMEDY = "take a dry run, review it, and repeat it with the --base that it prints"


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveEdit(Edit):
    """Planned change of the drives of a cell."""

    folder: Path  #: of the records
    values: tuple[ParameterValue, ...]  #: current gains in the drives
    writes: tuple[ParameterWrite, ...]  #: values to be written
    #: of the write that a rollback undoes; None for a calibration
    record: DriveRecord | None = None

    @property
    def place(self) -> Path:
        """The folder of the records."""
        return self.folder

    @property
    def diff(self) -> str:
        """A line for each drive: its object, its value now, and the one to be written."""
        lines = []
        for change, current in zip(self.changes, self.values, strict=True):
            lines.append(f"{change.key}: {current.value:.9g} -> {change.spelling}\n")
        return "".join(lines)

    @property
    def has_effect(self) -> bool:
        """Always true: drives that have these gains in RAM already are made to save them,
        in the place of what they had saved.
        """
        return True


@dataclass(frozen=True, slots=True)
class DriveTarget:
    """The drives of a cell."""

    cell: Cell  #: as it is now, with `controller.objects`
    network: CanopenNetwork  #: of all axes of the cell, open, and not prepared for recording
    saving: Saving = Saving.KNOWN  #: whether the drives save what is written

    @property
    def subject(self) -> str:
        """The drives, as audit and history name them."""
        return drives_of(self.cell.name)

    def check_fields(self) -> None:
        """See `Target.check_fields`."""
        call = "write DriveTarget(cell, network)"
        require_fields("the DriveTarget", self, _DRIVE_TARGET_FIELDS, call)

    def plan(self, calibration: Calibration) -> DriveEdit:
        """See `Target.plan`.

        Raises:
            ConfigurationInconsistent: the cell has no objects for the gains.
            CalibrationRefused: the calibration has other axes than the cell.
            ControllerUnfit: an object cannot hold a gain to within its σ.
            DriverError: see `drivers.canopen.parameters.read_parameters`.
        """
        objects = () if self.cell.controller is None else self.cell.controller.objects
        if not objects:
            raise ConfigurationInconsistent(
                f"cell {self.cell.name!r}: controller",
                found="no objects in the drives",
                expected="the object of each axis's gain",
                remedy="add `controller: {objects: [{index: ..., subindex: ..., type: ..., factor: "
                "...}, ...]}` to the cell file, one for each axis (docs/how-to/write-gains.md)",
            )
        require_axes(calibration, self.cell.axis_names)
        gains = {gain.axis: gain for gain in calibration.gains}
        parameters = [gain_object.parameter for gain_object in objects]
        current = read_parameters(
            self.network, list(zip(self.network.axes, parameters, strict=True))
        )
        changes: list[GainChange] = []
        writes: list[ParameterWrite] = []
        for value, gain_object in zip(current, objects, strict=True):
            change, write = _plan_drive(gains[value.axis.name], value, gain_object)
            changes.append(change)
            writes.append(write)
        folder = record_folder(self.cell)
        return DriveEdit(
            subject=self.subject,
            before=content_of(current),
            after=content_of(current, tuple(writes)),
            changes=tuple(changes),
            unexpected=_changed_since_record(current, folder),
            folder=folder,
            values=current,
            writes=tuple(writes),
        )

    def plan_rollback(self) -> DriveEdit:
        """See `Target.plan_rollback`: undo the last write that changed the drives,
        whole or cut off by a kill.

        Raises:
            CalibrationRefused: there is no record of such a write; or the drives have the gains
                from before the last one, so that nothing of it needs to be undone.
            ControllerUnfit: its record was changed, or is of another cell.
            ControllerChanged: a drive was exchanged, or a gain was changed since.
            DriverError: see `drivers.canopen.parameters.read_parameters`.
        """
        folder = record_folder(self.cell)
        paths = read_records(folder)
        for place in reversed(range(len(paths))):
            path = paths[place]
            record = read_record(path)
            current = read_parameters(self.network, self._recorded_parameters(path, record))
            if _has_previous_gains(current, record):
                if not _changes_gains(record) or _is_rollback(record, paths[:place]):
                    # Drives that saved what they had; or a rollback that was not made: this one
                    # makes it.
                    continue
                raise _not_in_drives(self.subject, path, record)
            _check_untouched(path, record, current)
            writes = []
            for value, note in zip(current, record.drives, strict=True):
                writes.append(ParameterWrite(value.axis, note.parameter, note.old))
            return DriveEdit(
                subject=self.subject,
                before=content_of(current),
                after=content_of(current, tuple(writes)),
                source=path,
                folder=folder,
                values=current,
                writes=tuple(writes),
                record=record,
            )
        found = f"no record in {folder}"
        if paths:
            found = f"{counted(len(paths), 'record')} of the current gains"
        raise CalibrationRefused(
            self.subject,
            found=found,
            expected="the record of a write that changed them",
            remedy="nothing was written",
        )

    @contextlib.contextmanager
    def lock(self, edit: DriveEdit) -> Iterator[None]:
        """See `Target.lock`; the drives are compared when they are written."""
        edit.folder.parent.mkdir(parents=True, exist_ok=True)
        with exclusive_writer(edit.folder):
            yield

    def details(self, edit: DriveEdit) -> Mapping[str, object]:
        """See `Target.details`; values as bits, which are finite."""
        drives = []
        for value, write in zip(edit.values, edit.writes, strict=True):
            drives.append(
                {
                    "axis": value.axis.name,
                    "node_id": value.axis.node_id,
                    "serial": value.identity.serial,
                    "object": str(value.parameter),
                    "type": value.parameter.kind.value,
                    "old": value.word,
                    "new": write.word,
                }
            )
        details: dict[str, object] = {"saving": self.saving.value, "drives": drives}
        if edit.source is not None:
            details["restored"] = str(edit.source)
        return details

    def write(self, edit: DriveEdit, now: datetime, who: str) -> Written:
        """See `Target.write` and `drivers.canopen.parameters.write_parameters`.

        Raises:
            OutputFailed: the record of the previous gains is not on the disk; no drive was written.
        """
        records: list[Path] = []  # one, once `record_before_writing` was called

        def record_before_writing(current: tuple[ParameterValue, ...]) -> None:
            if content_of(current) != edit.before:
                raise ControllerChanged(
                    edit.subject,
                    found="other current gains in the drives, or other drives",
                    expected="those that the change was planned for",
                    remedy="take a new dry run; nothing was written",
                )
            drives = []
            for value, write in zip(current, edit.writes, strict=True):
                drives.append(_note_of(value, write))
            try:
                record = write_record(edit.folder, self.cell.name, now, who, tuple(drives))
            except OSError as error:
                raise OutputFailed(
                    str(edit.folder),
                    found=reason_of(error),
                    expected="a record of the previous gains on the disk, before any drive",
                    remedy="nothing was written to the drives; free space or rights",
                ) from error
            records.append(record)

        parameters = write_parameters(self.network, edit.writes, self.saving, record_before_writing)
        return Written(edit, records[0], parameters)

    def _recorded_parameters(
        self, path: Path, record: DriveRecord
    ) -> list[tuple[Axis, DriveParameter]]:
        """Return the objects that a record names, with the axes of this cell.

        Raises:
            ControllerUnfit: the record is of another cell, or of other axes.
        """
        axes = {(axis.name, axis.node_id): axis for axis in self.network.axes}
        unknown_axes = []
        for note in record.drives:
            if (note.axis, note.node_id) not in axes:
                unknown_axes.append(note.axis)
        name_now = present_name(self.cell, record.cell, utc(record.at, NEVER))
        if name_now != self.cell.name or unknown_axes:
            found = f"a write to cell {record.cell!r} at {record.at}"
            if name_now != record.cell:
                found += f", which is called {name_now!r} now"
            if unknown_axes:
                found += f", with {', '.join(unknown_axes)} that this cell does not have"
            raise ControllerUnfit(
                str(path),
                found=found,
                expected=f"one to the drives of the cell that is called {self.cell.name!r} now",
                remedy="nothing was written; has the cell file been changed since, or the cell "
                "been renamed (`drivegain history`)?",
            )
        return [(axes[note.axis, note.node_id], note.parameter) for note in record.drives]


def _note_of(value: ParameterValue, write: ParameterWrite) -> DriveNote:
    """Return what a record says of one drive: its value now, and the one to be written."""
    return DriveNote(
        axis=value.axis.name,
        node_id=value.axis.node_id,
        vendor_id=value.identity.vendor_id,
        product_code=value.identity.product_code,
        serial=value.identity.serial,
        index=value.parameter.index,
        subindex=value.parameter.subindex,
        type=value.parameter.kind,
        old=value.word,
        new=write.word,
    )


_DRIVE_TARGET_FIELDS = {
    "cell": of_kind(Cell),
    "network": of_kind(CanopenNetwork),
    "saving": of_kind(Saving),
}


def content_of(
    base: tuple[ParameterValue, ...], writes: tuple[ParameterWrite, ...] | None = None
) -> bytes:
    """Encode drives and their values, or the values to be written,
    as the bytes that digests are taken of.
    """
    if writes is None:
        words = [value.word for value in base]
    else:
        words = [write.word for write in writes]
    drives = []
    for value, word in zip(base, words, strict=True):
        axis = value.axis
        drives.append([axis.name, axis.node_id, value.identity.serial, str(value.parameter), word])
    return json.dumps(drives).encode()


def _plan_drive(
    gain: Gain, current: ParameterValue, gain_object: GainObject
) -> tuple[GainChange, ParameterWrite]:
    """Plan the write to one drive.

    Args:
        gain: the identified gain.
        current: what the object holds now.
        gain_object: the object, with the factor from the gain to its number.

    Returns:
        The change of the gain, and the bits to write. A gain that is no number leaves the current
        bits, and a gate refuses it.

    Raises:
        ControllerUnfit: the object cannot hold the gain to within its σ.
    """
    parameter = gain_object.parameter
    factor = gain_object.factor
    key = f"{current.axis.name}, {parameter}"
    current_gain = current.value / factor
    if not is_writable(gain):
        unchanged = ParameterWrite(current.axis, parameter, current.word)
        return GainChange.of(gain, key, 0, current_gain, None), unchanged
    wanted = factor * gain.value
    std = abs(factor) * gain.std
    try:
        word = parameter.word(wanted)
    except ValueError as error:
        raise ControllerUnfit(
            key,
            found=str(error),
            expected="a gain that fits",
            remedy="check `type` and `factor` in `controller.objects` of the cell file; "
            "nothing was written",
        ) from error
    # The number that the object holds for the wanted one: an integer, or a float of 32 bits.
    representable = parameter.value(word)
    rounding = abs(representable - wanted)
    # A gain that was held fixed has σ = 0, which says nothing of a rounding.
    is_above_std = 0 < std < rounding
    if representable == 0 or is_above_std:
        raise ControllerUnfit(
            key,
            found=f"{wanted:.6g} ± {std:.2g}, which the number {representable:.9g} does not "
            "represent",
            expected="a rounding below σ",
            remedy="this object is too coarse for the gain: use another one, or another factor "
            "in `controller.objects`; nothing was written",
        )
    new_and_spelling = (representable / factor, f"{representable:.9g}")
    change = GainChange.of(gain, key, 0, current_gain, new_and_spelling)
    return change, ParameterWrite(current.axis, parameter, word)


def _changed_since_record(
    current: tuple[ParameterValue, ...], folder: Path
) -> tuple[GateFinding, ...]:
    """Return the drives that differ from the newest record, which stands in for the log:
    logs do not carry the values of the drives.

    A drive has the written value, or the one before it, where the write was rolled back or never
    saved. Before the first write there is no record, and nothing to compare with.
    """
    paths = read_records(folder)
    if not paths:
        return ()
    newest = paths[-1]
    try:
        record = read_record(newest)
    except ControllerUnfit as error:
        return ((error.subject, error.found, error.expected, _REVIEW_REMEDY),)
    notes = {(note.axis, note.parameter): note for note in record.drives}
    findings = []
    for value in current:
        note = notes.get((value.axis.name, value.parameter))
        if note is None or value.word in {note.old, note.new}:
            continue
        subject = f"{value.axis.name}, {value.parameter}"
        new = value.parameter.value(note.new)
        old = value.parameter.value(note.old)
        expected = (
            f"{new:.9g}, as written according to {newest.name}, or {old:.9g} as before that write"
        )
        remedy = f"the gain was changed since, or the drive exchanged: {_REVIEW_REMEDY}"
        findings.append((subject, f"{value.value:.9g}", expected, remedy))
    return tuple(findings)


def _has_previous_gains(current: tuple[ParameterValue, ...], record: DriveRecord) -> bool:
    """Whether every drive has the gain that it had before a recorded write."""
    pairs = zip(current, record.drives, strict=True)
    return all(value.word == note.old for value, note in pairs)


def _changes_gains(record: DriveRecord) -> bool:
    """Whether a recorded write was to change the gain of any drive."""
    return any(note.old != note.new for note in record.drives)


def _is_rollback(record: DriveRecord, earlier: tuple[Path, ...]) -> bool:
    """Whether a recorded write was to undo one of the earlier writes.

    Raises:
        ControllerUnfit: an earlier record cannot be read, or was changed.
    """
    undone = []
    for note in record.drives:
        undone.append(note.model_copy(update={"old": note.new, "new": note.old}))
    return any(read_record(path).drives == tuple(undone) for path in earlier)


def _not_in_drives(subject: str, path: Path, record: DriveRecord) -> CalibrationRefused:
    """Return the error for the rollback of a write that the drives do not have."""
    return CalibrationRefused(
        subject,
        found=f"the gains from before the last write, begun by {record.who} at {record.at}: that "
        "write was not made, was taken back, or was not saved",
        expected="a write to take back",
        remedy="nothing was written, and nothing needs to be undone; to take back the write before "
        f"it all the same, apply the calibration of that time again ({path.parent} has the "
        "previous gains of each write)",
    )


def _check_untouched(path: Path, record: DriveRecord, current: tuple[ParameterValue, ...]) -> None:
    """Refuse a rollback that would lose a change by another hand.

    Raises:
        ControllerChanged: a drive was exchanged, or has neither gain of the record.
    """
    for value, note in zip(current, record.drives, strict=True):
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
                remedy=f"nothing was written: the gain was changed since; {path} has the "
                "previous gains",
            )
