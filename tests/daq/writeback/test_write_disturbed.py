"""A file system that fails at any call of a write:
every message says what is true, and the next command repairs.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.errors import ExitCode
from daq.ledger.audit import AuditAction, read
from tests.daq.calibrations import calibration_for

CALLS = ("open", "close", "fsync", "write", "replace", "unlink", "fchmod", "listxattr")
WRITING = ("fsync", "write", "replace", "unlink", "fchmod")
DENIALS = ("nothing was", "it is as it was", "as before")


class Disk:
    """Counts the calls of the operating system, and fails at one of them or from one of them on."""

    def __init__(
        self, patch: pytest.MonkeyPatch, at: int | None = None, *, lasting: bool = False
    ) -> None:
        self.calls: list[str] = []
        self.renamed: int | None = None  #: number of the call that put the new content in its place
        self._at, self._lasting = at, lasting
        for name in CALLS:
            patch.setattr(os, name, self._counted(name, getattr(os, name)))

    def _counted(self, name: str, genuine: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            number = len(self.calls)
            self.calls.append(name)
            if (
                name == "replace"
                and str(given[1]).endswith("controllers/demo.yaml")
                and self.renamed is None
            ):
                self.renamed = number
            later = self._lasting and self._at is not None and number > self._at and name in WRITING
            if number == self._at or later:
                if name == "close":
                    genuine(*given)  # the descriptor is closed, whatever close(2) says
                code = errno.EROFS if self._lasting else errno.EIO
                raise OSError(code, os.strerror(code))
            return genuine(*given, **named)

        return call


def apply(cell_file: Path, calibration: Path) -> int:
    return main(["apply", str(cell_file), str(calibration), "--yes"])


def controller_of(cell_file: Path) -> Path:
    path = load_cell(cell_file).controller_path
    assert path is not None
    return path


@pytest.mark.slow
@pytest.mark.parametrize("lasting", [False, True], ids=["once", "from then on"])
@pytest.mark.parametrize("verb", ["apply", "rollback"])
def test_no_message_denies_a_write_and_the_next_command_enters_it(
    cell_file: Path,
    verb: str,
    lasting: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    controller, calibration = controller_of(cell_file), calibration_for(cell_file)
    if verb == "rollback":
        assert apply(cell_file, calibration) == ExitCode.OK
    work: Callable[[], int] = (
        (lambda: apply(cell_file, calibration))
        if verb == "apply"
        else lambda: main([verb, str(cell_file)])
    )
    kept = cell_file.parents[1].with_name("kept")
    shutil.copytree(cell_file.parents[1], kept)
    before = controller.read_bytes()

    def run(at: int | None) -> tuple[int, Disk]:
        shutil.rmtree(cell_file.parents[1])
        shutil.copytree(kept, cell_file.parents[1])
        capsys.readouterr()
        with monkeypatch.context() as patch:
            disk = Disk(patch, at, lasting=lasting)
            return work(), disk

    code, whole = run(None)
    assert code == ExitCode.OK
    assert whole.renamed is not None
    after = controller.read_bytes()
    assert after != before
    for at in range(whole.renamed - 4, len(whole.calls)):
        code, _ = run(at)
        error_output = capsys.readouterr().err
        said, found = " ".join(error_output.split()), controller.read_bytes()
        assert found in (before, after), at
        if found == after:
            assert not any(denial in said for denial in DENIALS), (at, said)
            assert code == ExitCode.OK or "has the new content" in said, (at, said)
        else:
            assert code == ExitCode.UNEXPECTED, (at, said)
        if verb == "apply":
            assert apply(cell_file, calibration) == ExitCode.OK, at
            assert controller.read_bytes() == after
        else:
            assert main(["history", str(cell_file), "--add", str(calibration)]) == ExitCode.OK, at
        assert main(["history", str(cell_file), "--verify"]) == ExitCode.OK, (
            at,
            capsys.readouterr().err,
        )


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_an_audit_that_takes_no_entry_is_named_and_nothing_is_written(
    cell_file: Path, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    controller = controller_of(cell_file)
    calibration = calibration_for(cell_file)
    genuine = os.write
    before = controller.read_bytes()

    def full(descriptor: int, data: bytes) -> int:
        path = Path(f"/proc/self/fd/{descriptor}")
        if path.readlink().name.endswith("audit.jsonl"):
            raise OSError(code, os.strerror(code))
        return genuine(descriptor, data)

    monkeypatch.setattr(os, "write", full)
    assert apply(cell_file, calibration) == ExitCode.UNEXPECTED
    said = capsys.readouterr().err
    assert "demo.audit.jsonl" in said.splitlines()[0]
    assert "nothing was written to the controller" in said
    assert controller.read_bytes() == before


def test_what_is_in_place_is_called_applied_by_the_audit(
    cell_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The folder cannot be flushed, and the old content cannot be put back either."""
    genuine, renamed = os.replace, list[str]()

    def once(source: Any, target: Any, **named: Any) -> None:
        if str(target).endswith("controllers/demo.yaml"):
            if renamed:
                raise OSError(errno.EROFS, os.strerror(errno.EROFS))
            renamed.append(str(target))
        genuine(source, target, **named)

    def unflushed(_: Path) -> None:
        if renamed:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    calibration = calibration_for(cell_file)
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", once)
        patch.setattr("daq.files.fsync_folder", unflushed)
        assert apply(cell_file, calibration) == ExitCode.UNEXPECTED
    error_output = capsys.readouterr().err
    said = " ".join(error_output.split())
    assert "has the new content, complete; the history lacks this write" in said
    history = load_cell(cell_file).history
    assert history is not None
    actions = [entry.action for entry in read(history.audit)]
    assert actions == [
        AuditAction.APPLY_BEGUN,
        AuditAction.APPLIED,
    ]
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.DATA_UNFIT
    assert main(["history", str(cell_file), "--add", str(calibration)]) == ExitCode.OK
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.OK


@pytest.mark.parametrize("flushed_before", [0, 1], ids=["backup", "controller's file"])
def test_a_write_that_is_undone_after_a_flush_is_called_undone(
    cell_file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    flushed_before: int,
) -> None:
    """The folder cannot be flushed once: the old file is there, and no message doubts it."""
    calibration = calibration_for(cell_file)
    controller = load_cell(cell_file).controller_path
    assert controller is not None
    before = controller.read_bytes()
    flushed: list[Path] = []

    def flush(folder: Path) -> None:
        flushed.append(folder)
        if len(flushed) == flushed_before + 1:
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("daq.files.fsync_folder", flush)
    assert main(["apply", str(cell_file), str(calibration), "--yes"]) == ExitCode.UNEXPECTED
    assert controller.read_bytes() == before
    files = controller.parent.glob("*.bak")
    assert list(files) == []
    error_output = capsys.readouterr().err
    said = " ".join(error_output.split())
    assert "it is as it was" in said
    assert "it may have the new content" not in said
