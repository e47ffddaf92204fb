"""An audit log on a disk that takes a part of a write, and then the rest, or no more."""

from __future__ import annotations

import errno
import os
from datetime import UTC, datetime
from pathlib import Path

import pytest

from daq.errors import OutputFailed, WriteUnconfirmed, writing
from daq.files import replace_file
from daq.ledger.audit import (
    AuditAction,
    AuditEntry,
    append,
    head_file,
    note_obstacle,
    noted_heads,
    verify,
)
from daq.ledger.ledger import record_session

NOW = datetime(2026, 1, 5, 6, 0, tzinfo=UTC)


def _append(audit: Path, who: str = "T") -> AuditEntry:
    return append(audit, AuditAction.PROPOSED, at=NOW, who=who, subject="x", details={})


class _FullDisk:
    """Takes so many bytes of the writes to a note, half of the rest at a time, and then no more."""

    def __init__(self, room: int) -> None:
        self._room = room

    def pwrite(self, descriptor: int, data: bytes, offset: int) -> int:
        if self._room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken = min(self._room, max(1, len(data) // 2))
        self._room -= taken
        return _PWRITE(descriptor, data[:taken], offset)


_PWRITE = os.pwrite


def test_a_note_that_is_taken_in_parts_has_the_last_entry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    audit = tmp_path / "audit.jsonl"
    _append(audit)
    monkeypatch.setattr(os, "pwrite", _FullDisk(1000).pwrite)
    last = _append(audit)
    assert noted_heads(audit) == (last.sha256,)


@pytest.mark.parametrize("room", [0, 1, 32, 64])
def test_a_note_of_which_the_disk_takes_a_part_accuses_no_sound_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    audit = tmp_path / "audit.jsonl"
    first = _append(audit)
    monkeypatch.setattr(os, "pwrite", _FullDisk(room).pwrite)
    _append(audit)
    noted = noted_heads(audit)
    expected = (first.sha256,) if room == 0 else ()
    assert noted == expected
    assert verify(audit, noted).holds
    monkeypatch.undo()
    last = _append(audit)
    assert noted_heads(audit) == (last.sha256,)


def test_a_note_keeps_the_entries_that_are_missing_where_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    audit = tmp_path / "audit.jsonl"
    first = _append(audit)
    removed = _append(audit, who="U")
    lines = audit.read_bytes().splitlines(keepends=True)
    audit.write_bytes(lines[0])
    _append(audit)
    assert noted_heads(audit)[0] == removed.sha256
    # Room for the first of two lines, and a part of the second.
    monkeypatch.setattr(os, "pwrite", _FullDisk(80).pwrite)
    _append(audit)
    assert noted_heads(audit) == (removed.sha256,)
    assert not verify(audit, noted_heads(audit)).holds
    assert first.sha256 not in head_file(audit).read_text()


def _fails(*_: object) -> None:
    raise OSError(errno.EIO, "Input/output error")


def test_an_entry_whose_flush_fails_is_not_called_unwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    audit = tmp_path / "audit.jsonl"
    monkeypatch.setattr(os, "fsync", _fails)
    with pytest.raises(OutputFailed, match="it may have the new content") as caught:
        record_session(audit, AuditAction.PROPOSED, at=NOW, who="T", subject="x", details={})
    assert "it is as it was" not in str(caught.value)
    assert len(verify(audit).entries) == 1


def test_a_part_of_an_entry_is_not_called_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    audit = tmp_path / "audit.jsonl"
    write = os.write
    taken: list[int] = []

    def in_part(descriptor: int, data: bytes) -> int:
        if taken:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken.append(write(descriptor, data[:10]))
        return taken[0]

    monkeypatch.setattr(os, "write", in_part)
    with pytest.raises(WriteUnconfirmed):
        _append(audit)
    assert audit.stat().st_size == 10
    monkeypatch.setattr(os, "write", _fails)
    with pytest.raises(OSError, match="Input/output error") as caught:
        _append(audit)
    assert not isinstance(caught.value, WriteUnconfirmed)
    assert audit.stat().st_size == 10


def test_a_file_whose_folder_cannot_be_flushed_is_not_called_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "state.json"
    path.write_text("old")
    monkeypatch.setattr("daq.files.fsync_folder", _fails)
    with pytest.raises(OutputFailed, match="it may have the new content"), writing(path):
        replace_file(path, b"new")
    assert path.read_text() == "new"
    with pytest.raises(OutputFailed, match="it is as it was"), writing(tmp_path):
        replace_file(tmp_path, b"new")


@pytest.mark.parametrize("failing", ["ftruncate", "pwrite"])
def test_a_note_is_said_to_be_lacking_where_it_is(
    failing: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    audit = tmp_path / "audit.jsonl"
    _append(audit, "before")

    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    # The length of the note is set after all of it was taken.
    with monkeypatch.context() as patched:
        patched.setattr(os, failing, fail)
        entry = _append(audit, "after")
    is_noted = noted_heads(audit)[-1] == entry.sha256
    assert is_noted == (failing == "ftruncate")
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == (0 if is_noted else 1)
    assert is_noted or "cannot be noted" in said[0]


def test_a_note_that_is_not_there_needs_a_folder_that_takes_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    audit = tmp_path / "audit.jsonl"
    _append(audit)
    head_file(audit).unlink()
    assert note_obstacle(audit) == ""
    # Root may write everywhere but on a disk that is mounted read-only.
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "no file can be made in its folder" in note_obstacle(audit)
