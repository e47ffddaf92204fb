"""What stood in the drives of a cell before a write: a file that is on the disk before the first drive is touched.

A record is called <time>.json and is never changed. It carries the digest of what is in it: its numbers go back into
drives.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from daq.config.cell import Cell
from daq.config.yaml_file import StrictModel
from daq.errors import ConfigurationInconsistent, ControllerUnfit
from daq.files import read_regular, replace_file
from drivers.profiles.profile import Parameter, ParameterKind

_STAMP = "%Y%m%dT%H%M%SZ"
_NAME = re.compile(r"([0-9]{8}T[0-9]{6}Z)(?:-([0-9]+))?\.json")
_MAX_BYTES = 2**20
_U32 = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]


@dataclass(frozen=True, slots=True)
class DriveNote:
    """What stood in one drive, and what was to be written.

    Attributes:
        axis, node_id: which.
        vendor_id, product_code, serial: of the drive, as it told (1018h).
        parameter: that was to be written.
        old, new: its bits.
    """

    axis: str
    node_id: int
    vendor_id: int
    product_code: int
    serial: int | None
    parameter: Parameter
    old: int
    new: int


@dataclass(frozen=True, slots=True)
class DriveRecord:
    """One write to the drives of a cell.

    Attributes:
        path: of the file.
        cell: its name.
        at: when, ISO 8601.
        who: the person or the job.
        drives: one for each axis.
    """

    path: Path
    cell: str
    at: str
    who: str
    drives: tuple[DriveNote, ...]


class _NoteModel(StrictModel):
    axis: str
    node_id: Annotated[int, Field(ge=1, le=127)]
    vendor_id: _U32
    product_code: _U32
    serial: _U32 | None
    index: Annotated[int, Field(ge=0x1000, le=0xFFFF)]
    subindex: Annotated[int, Field(ge=0, le=0xFF)]
    type: ParameterKind
    old: _U32
    new: _U32


class _RecordModel(StrictModel):
    format: Literal["drivegain drive record 1"]
    cell: str
    at: str
    who: str
    drives: tuple[_NoteModel, ...]
    sha256: str


def record_folder(cell: Cell) -> Path:
    """Where the records of a cell are: beside its history, `demo.drives` beside `demo.history.sqlite`.

    Raises:
        ConfigurationInconsistent: the cell was read from a log, and has no place.
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


def write_record(folder: Path, cell: str, now: datetime, who: str, drives: tuple[DriveNote, ...]) -> Path:
    """Put a record on the disk, later in order than every other.

    Raises:
        OSError: from the file system.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stamp, count = now.astimezone(UTC).strftime(_STAMP), 0
    taken = _names(folder)
    if taken and taken[-1][:2] >= (stamp, count):
        # A clock set back, or two writes in one second, must not make an older record look newer.
        stamp, count = taken[-1][0], taken[-1][1] + 1
    path = folder / f"{stamp}{f'-{count}' if count else ''}.json"
    body = {
        "format": "drivegain drive record 1",
        "cell": cell,
        "at": now.isoformat(),
        "who": who,
        "drives": [
            {
                "axis": note.axis,
                "node_id": note.node_id,
                "vendor_id": note.vendor_id,
                "product_code": note.product_code,
                "serial": note.serial,
                "index": note.parameter.index,
                "subindex": note.parameter.subindex,
                "type": note.parameter.kind.value,
                "old": note.old,
                "new": note.new,
            }
            for note in drives
        ],
    }
    text = json.dumps({**body, "sha256": _digest(body)}, indent=1, ensure_ascii=False)
    replace_file(path, (text + "\n").encode())
    return path


def read_records(folder: Path) -> tuple[Path, ...]:
    """The records of a folder, oldest first; none where there is no folder."""
    return tuple(path for _, _, path in _names(folder))


def read_record(path: Path) -> DriveRecord:
    """A record.

    Raises:
        ControllerUnfit: it cannot be read, is none, or somebody has changed it.
    """
    try:
        content = read_regular(path, _MAX_BYTES)
        model = _RecordModel.model_validate_json(content)
        body: dict[str, Any] = json.loads(content)
    except (OSError, ValueError, ValidationError) as error:
        raise _unfit(path, str(error).splitlines()[0][:200]) from error
    recorded_digest = body.pop("sha256")
    if recorded_digest != _digest(body):
        raise _unfit(path, f"content with SHA-256 {_digest(body)[:12]}…, not {recorded_digest[:12]}… as it says")
    notes = tuple(
        DriveNote(
            note.axis,
            note.node_id,
            note.vendor_id,
            note.product_code,
            note.serial,
            Parameter(note.index, note.subindex, note.type),
            note.old,
            note.new,
        )
        for note in model.drives
    )
    return DriveRecord(path, model.cell, model.at, model.who, notes)


def _names(folder: Path) -> list[tuple[str, int, Path]]:
    if not folder.is_dir():
        return []
    found = [(match, path) for path in folder.iterdir() if (match := _NAME.fullmatch(path.name)) is not None]
    return sorted((match[1], int(match[2] or 0), path) for match, path in found)


def _digest(body: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def _unfit(path: Path, found: str) -> ControllerUnfit:
    return ControllerUnfit(
        str(path),
        found=found,
        expected="the record of a write to drives, as drivegain wrote it",
        remedy="nothing was written; enter the old gains with the drives' own tool",
    )
