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
    return store.with_name(store.name.removesuffix(".sqlite").removesuffix(".history") + ".drives")


def write_record(
    folder: Path, cell: str, now: datetime, who: str, drives: tuple[DriveNote, ...]
) -> Path:
    """Put a record on the disk, later in order than every other.

    Raises:
        OSError: from the file system.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{next_order(list(_records(folder)), now)}.json"
    record = DriveRecord(
        format="drivegain drive record 1",
        cell=cell,
        at=now.isoformat(),
        who=who,
        drives=drives,
        sha256="",
    )
    body = {**_body(record), "sha256": _digest(record)}
    replace_file(path, (json.dumps(body, indent=1, ensure_ascii=False) + "\n").encode())
    return path


def read_records(folder: Path) -> tuple[Path, ...]:
    """List the records of a folder, oldest first; none where there is no folder."""
    return tuple(_records(folder).values())


def _records(folder: Path) -> dict[tuple[str, int], Path]:
    """Return the records of a folder by time and count in their names, in that order."""
    found: dict[tuple[str, int], Path] = {}
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _NAME.fullmatch(path.name)
        if match is not None:
            found[match[1], int(match[2] or 0)] = path
    return dict(sorted(found.items()))


def read_record(path: Path) -> DriveRecord:
    """Read a record.

    Raises:
        ControllerUnfit: it cannot be read, is no record, or was changed.
    """
    try:
        record = DriveRecord.model_validate_json(read_regular(path, _MAX_BYTES))
    except (OSError, ValueError) as error:
        raise _unfit(path, str(error).splitlines()[0][:200]) from error
    if record.sha256 != _digest(record):
        raise _unfit(
            path,
            f"content with SHA-256 {_digest(record)[:12]}…, not {record.sha256[:12]}… as it says",
        )
    return record


def _body(record: DriveRecord) -> dict[str, object]:
    return record.model_dump(mode="json", exclude={"sha256"})


def _digest(record: DriveRecord) -> str:
    return sha256(json.dumps(_body(record), sort_keys=True).encode())


def _unfit(path: Path, found: str) -> ControllerUnfit:
    return ControllerUnfit(
        str(path),
        found=found,
        expected="the record of a write to drives, as drivegain wrote it",
        remedy="nothing was written; enter the previous gains with the drives' own tool",
    )


_REVIEW = "take a dry run, review it, and repeat it with the --base that it prints"


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
        lines = [
            f"{change.key}: {value.value:.9g} -> {change.spelling}\n"
            for change, value in zip(self.changes, self.values, strict=True)
        ]
        return "".join(lines)

    @property
    def has_effect(self) -> bool:
        """Always: drives that have these gains in RAM are made to save them,
        and lose what they had saved.
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
        pairs = [
            (axis, one.parameter) for axis, one in zip(self.network.axes, objects, strict=True)
        ]
        base = read_parameters(self.network, pairs)
        planned = [
            _change(gains[value.axis.name], value, one)
            for value, one in zip(base, objects, strict=True)
        ]
        writes = tuple(write for _, write in planned)
        folder = record_folder(self.cell)
        return DriveEdit(
            subject=self.subject,
            before=content_of(base),
            after=content_of(base, writes),
            changes=tuple(change for change, _ in planned),
            unexpected=_changed_since_record(base, folder),
            folder=folder,
            values=base,
            writes=writes,
        )

    def plan_rollback(self) -> DriveEdit:
        """See `Target.plan_rollback`: undo the last write that changed the drives,
        whole or cut off by a kill.

        Raises:
            CalibrationRefused: there is no record of such a write.
            ControllerUnfit: its record was changed, or is of another cell.
            ControllerChanged: a drive was exchanged, or a gain was changed since.
            DriverError: see `drivers.canopen.parameters.read_parameters`.
        """
        folder = record_folder(self.cell)
        paths = read_records(folder)
        for path in reversed(paths):
            record = read_record(path)
            base = read_parameters(self.network, self._recorded(path, record))
            # A writer that was killed before its first write leaves a record of the current gains.
            if all(value.word == note.old for value, note in zip(base, record.drives, strict=True)):
                continue
            _check_untouched(path, record, base)
            writes = tuple(
                ParameterWrite(value.axis, note.parameter, note.old)
                for value, note in zip(base, record.drives, strict=True)
            )
            return DriveEdit(
                subject=self.subject,
                before=content_of(base),
                after=content_of(base, writes),
                source=path,
                folder=folder,
                values=base,
                writes=writes,
                record=record,
            )
        raise CalibrationRefused(
            self.subject,
            found=f"{counted(len(paths), 'record')} of the current gains"
            if paths
            else f"no record in {folder}",
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
        drives = [
            {
                "axis": value.axis.name,
                "node_id": value.axis.node_id,
                "serial": value.identity.serial,
                "object": str(value.parameter),
                "type": value.parameter.kind.value,
                "old": value.word,
                "new": write.word,
            }
            for value, write in zip(edit.values, edit.writes, strict=True)
        ]
        if edit.source is None:
            restored = {}
        else:
            restored = {"restored": str(edit.source)}
        return {"saving": self.saving.value, "drives": drives, **restored}

    def write(self, edit: DriveEdit, now: datetime, who: str) -> Written:
        """See `Target.write` and `drivers.canopen.parameters.write_parameters`.

        Raises:
            OutputFailed: the record of the previous gains is not on the disk; no drive was written.
        """
        records: list[Path] = []

        def begin(found: tuple[ParameterValue, ...]) -> None:
            if content_of(found) != edit.before:
                raise ControllerChanged(
                    edit.subject,
                    found="other current gains in the drives, or other drives",
                    expected="those that the change was planned for",
                    remedy="take a new dry run; nothing was written",
                )
            drives = tuple(
                DriveNote(
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
                for value, write in zip(found, edit.writes, strict=True)
            )
            try:
                records.append(write_record(edit.folder, self.cell.name, now, who, drives))
            except OSError as error:
                raise OutputFailed(
                    str(edit.folder),
                    found=reason_of(error),
                    expected="a record of the previous gains on the disk, before any drive",
                    remedy="nothing was written to the drives; free space or rights",
                ) from error

        parameters = write_parameters(self.network, edit.writes, self.saving, begin)
        return Written(edit, records[0], parameters)

    def _recorded(self, path: Path, record: DriveRecord) -> list[tuple[Axis, DriveParameter]]:
        axes = {(axis.name, axis.node_id): axis for axis in self.network.axes}
        unknown_axes = [
            note.axis for note in record.drives if (note.axis, note.node_id) not in axes
        ]
        present = present_name(self.cell, record.cell, utc(record.at, NEVER))
        if present != self.cell.name or unknown_axes:
            found = f"a write to cell {record.cell!r} at {record.at}"
            if present != record.cell:
                found += f", which is called {present!r} now"
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
    listed = [
        [value.axis.name, value.axis.node_id, value.identity.serial, str(value.parameter), word]
        for value, word in zip(base, words, strict=True)
    ]
    return json.dumps(listed).encode()


def _change(
    gain: Gain, value: ParameterValue, gain_object: GainObject
) -> tuple[GainChange, ParameterWrite]:
    """Plan one drive; a gain that is no number leaves the present bits, and a gate refuses it."""
    parameter = gain_object.parameter
    factor = gain_object.factor
    key = f"{value.axis.name}, {parameter}"
    word = value.word
    planned = None
    if is_writable(gain):
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
        held = parameter.value(word)
        if held == 0 or 0 < std < abs(held - wanted):
            raise ControllerUnfit(
                key,
                found=f"{wanted:.6g} ± {std:.2g}, which the number {held:.9g} does not represent",
                expected="a rounding below σ",
                remedy="this object is too coarse for the gain: use another one, or another factor "
                "in `controller.objects`; nothing was written",
            )
        planned = (held / factor, f"{held:.9g}")
    return GainChange.of(gain, key, 0, value.value / factor, planned), ParameterWrite(
        value.axis, parameter, word
    )


def _changed_since_record(
    base: tuple[ParameterValue, ...], folder: Path
) -> tuple[GateFinding, ...]:
    """Compare the drives with the newest record, as logs do not carry their values.

    A drive has the written value, or the one before it, where the write was rolled back or never
    saved. Before the first write there is no record, and nothing to compare with.
    """
    records = read_records(folder)
    if not records:
        return ()
    try:
        notes = {(note.axis, note.parameter): note for note in read_record(records[-1]).drives}
    except ControllerUnfit as error:
        return ((error.subject, error.found, error.expected, _REVIEW),)
    found = []
    for value in base:
        note = notes.get((value.axis.name, value.parameter))
        if note is not None and value.word not in {note.old, note.new}:
            new = value.parameter.value(note.new)
            old = value.parameter.value(note.old)
            expected = (
                f"{new:.9g}, as written according to {records[-1].name}, or {old:.9g} as "
                "before that write"
            )
            remedy = f"the gain was changed since, or the drive exchanged: {_REVIEW}"
            found.append(
                (f"{value.axis.name}, {value.parameter}", f"{value.value:.9g}", expected, remedy)
            )
    return tuple(found)


def _check_untouched(path: Path, record: DriveRecord, base: tuple[ParameterValue, ...]) -> None:
    """Refuse a rollback that would lose a change by another hand."""
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
                remedy=f"nothing was written: the gain was changed since; {path} has the "
                "previous gains",
            )
