"""Records of writes to the drives of a cell: the backup, on the disk before the first drive is touched.

A record is called <time>.json and is never changed. It carries the digest of its content: a rollback writes its numbers
back into the drives.
"""

from __future__ import annotations

import hashlib
import json
import re
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from daq.config.cell import Cell
from daq.config.yaml_file import StrictModel
from daq.errors import ConfigurationInconsistent, ControllerUnfit
from daq.files import read_regular, replace_file
from daq.writeback.file_access import next_order
from drivers.profiles.profile import Parameter, ParameterKind

_NAME = re.compile(r"([0-9]{8}T[0-9]{6}Z)(?:-([0-9]+))?\.json")
_MAX_BYTES = 2**20
_U32 = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]


class DriveNote(StrictModel):
    """One drive in a record."""

    axis: str  #: which
    node_id: Annotated[int, Field(ge=1, le=127)]  #: which
    vendor_id: _U32  #: identity that the drive reported (1018h)
    product_code: _U32  #: identity that the drive reported (1018h)
    serial: _U32 | None  #: identity that the drive reported (1018h)
    index: Annotated[int, Field(ge=0x1000, le=0xFFFF)]  #: the object that was to be written
    subindex: Annotated[int, Field(ge=0, le=0xFF)]  #: the object that was to be written
    type: ParameterKind  #: the object that was to be written
    old: _U32  #: its bits before the write, and as they were to be
    new: _U32  #: its bits before the write, and as they were to be

    @property
    def parameter(self) -> Parameter:
        """The object."""
        return Parameter(self.index, self.subindex, self.type)


class DriveRecord(StrictModel):
    """One write to the drives of a cell."""

    format: Literal["drivegain drive record 1"] = "drivegain drive record 1"
    cell: str  #: name of the cell
    at: str  #: time, ISO 8601
    who: str  #: the operator or the job
    drives: tuple[DriveNote, ...]  #: one for each axis


class _RecordFile(DriveRecord):
    """The record as it is on the disk, with its own digest."""

    format: Literal["drivegain drive record 1"]
    sha256: str


def record_folder(cell: Cell) -> Path:
    """Return the folder of a cell's records: `demo.drives` beside `demo.history.sqlite`.

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


def write_record(folder: Path, cell: str, now: datetime, who: str, drives: tuple[DriveNote, ...]) -> Path:
    """Put a record on the disk, later in order than every other.

    Raises:
        OSError: from the file system.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{next_order([(stamp, count) for stamp, count, _ in _names(folder)], now)}.json"
    body = DriveRecord(cell=cell, at=now.isoformat(), who=who, drives=drives).model_dump(mode="json")
    text = json.dumps({**body, "sha256": _digest(body)}, indent=1, ensure_ascii=False)
    replace_file(path, (text + "\n").encode())
    return path


def read_records(folder: Path) -> tuple[Path, ...]:
    """List the records of a folder, oldest first; none where there is no folder."""
    return tuple(path for _, _, path in _names(folder))


def read_record(path: Path) -> DriveRecord:
    """Read a record.

    Raises:
        ControllerUnfit: it cannot be read, is no record, or was changed.
    """
    try:
        content = read_regular(path, _MAX_BYTES)
        record = _RecordFile.model_validate_json(content)
        body: dict[str, Any] = json.loads(content)
    except (OSError, ValueError) as error:
        raise _unfit(path, str(error).splitlines()[0][:200]) from error
    del body["sha256"]
    if record.sha256 != _digest(body):
        raise _unfit(path, f"content with SHA-256 {_digest(body)[:12]}…, not {record.sha256[:12]}… as it says")
    return record


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
