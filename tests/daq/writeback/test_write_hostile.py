"""Files that are no files: links, loops, pipes, devices.

A clear message for each, and no waiting.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.config.cell_file import load_cell
from daq.documents import calibration_file
from daq.errors import CalibrationMissing, ControllerUnfit, ExitCode, OutputFailed
from daq.ledger.audit import (
    BACKUPS_WITHOUT_LOG,
    AuditAction,
    Content,
    append,
    head_file,
    read,
    verify,
)
from daq.writeback.file_target import FileTarget
from daq.writeback.request import Request
from daq.writeback.target import apply, propose, rollback
from tests.daq.calibrations import KEYS, demo_calibration

CONFIGS = Path(__file__).parents[3] / "configs"
NOW = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)


@pytest.fixture
def controller(tmp_path: Path) -> Path:
    """In a folder of its own."""
    path = tmp_path / "controllers" / "demo.yaml"
    path.parent.mkdir()
    demo_path = CONFIGS / "controllers" / "demo.yaml"
    shutil.copyfile(demo_path, path)
    return path


def _directory(path: Path) -> None:
    path.mkdir()


def _fifo(path: Path) -> None:
    os.mkfifo(path)


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _huge(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(1 << 40)  # no block of it is on the disk


def _nothing(path: Path) -> None:
    path.unlink(missing_ok=True)


@pytest.mark.parametrize("made", [_directory, _fifo, _device, _huge, _nothing])
def test_what_is_no_regular_file_is_no_controller_and_no_calibration(
    tmp_path: Path, made: Callable[[Path], None]
) -> None:
    path = tmp_path / "x.yaml"
    made(path)
    request = Request(demo_calibration(), NOW)
    with pytest.raises(ControllerUnfit):
        propose(FileTarget(path, KEYS), request)
    with pytest.raises(CalibrationMissing):
        calibration_file.load_calibration(path)


def test_a_link_that_leads_nowhere_says_where(tmp_path: Path) -> None:
    link = tmp_path / "link.yaml"
    demo_path = tmp_path / "gone" / "demo.yaml"
    link.symlink_to(demo_path)
    request = Request(demo_calibration(), NOW)
    with pytest.raises(
        ControllerUnfit,
        match=r"a symbolic link to .*gone/demo\.yaml, which is "
        r"not there",
    ):
        propose(FileTarget(link, KEYS), request)


def test_links_in_a_circle_are_called_so(tmp_path: Path) -> None:
    one = tmp_path / "one.yaml"
    other = tmp_path / "other.yaml"
    one.symlink_to(other)
    other.symlink_to(one)
    request = Request(demo_calibration(), NOW)
    with pytest.raises(ControllerUnfit, match="round in a circle"):
        propose(FileTarget(one, KEYS), request)
    with pytest.raises(ControllerUnfit, match="round in a circle"):
        rollback(FileTarget(one), NOW)
    with pytest.raises(CalibrationMissing):
        calibration_file.load_calibration(one)


def test_a_link_into_a_folder_that_everybody_may_write_is_not_followed(
    controller: Path, tmp_path: Path
) -> None:
    link = tmp_path / "link.yaml"
    link.symlink_to(controller)
    controller.parent.chmod(0o777)
    request = Request(demo_calibration(), NOW)
    with pytest.raises(ControllerUnfit, match="everybody may write"):
        propose(FileTarget(link, KEYS), request)
    # An operator who names the file itself has chosen it.
    target = FileTarget(controller, KEYS)
    refusals = propose(target, Request(demo_calibration(), NOW)).refusals
    assert refusals == ()
    controller.parent.chmod(0o755)
    file_target = FileTarget(link, KEYS)
    assert propose(file_target, Request(demo_calibration(), NOW)).refusals == ()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a link away")
def test_the_link_of_another_user_is_not_followed(controller: Path, tmp_path: Path) -> None:
    link = tmp_path / "link.yaml"
    link.symlink_to(controller)
    os.lchown(link, 4711, 4711)
    request = Request(demo_calibration(), NOW)
    with pytest.raises(ControllerUnfit, match="user 4711 has made"):
        propose(FileTarget(link, KEYS), request)
    os.chown(controller, 4711, 4711)
    target = FileTarget(link, KEYS)
    proposal = propose(target, Request(demo_calibration(), NOW))
    written = apply(proposal, NOW)
    assert written is not None
    assert written.backup is not None
    assert controller.stat().st_uid == 4711
    assert written.backup.stat().st_uid == 4711


def test_a_file_of_two_names_is_not_written_under_one_of_them(
    controller: Path, tmp_path: Path
) -> None:
    """The other name would keep the current gains, and its readers would not know."""
    other = tmp_path / "plc's.yaml"
    other.hardlink_to(controller)
    for name in (controller, other):
        request = Request(demo_calibration(), NOW)
        with pytest.raises(ControllerUnfit, match=r"2 names \(hard links\)") as caught:
            propose(FileTarget(name, KEYS), request)
    remedy = str(caught.value).rpartition("of its own: ")[2]
    completed = subprocess.run(remedy, shell=True, check=False)
    assert completed.returncode == 0
    assert controller.stat().st_nlink == 1
    assert other.read_bytes() == controller.read_bytes()
    target = FileTarget(other, KEYS)
    refusals = propose(target, Request(demo_calibration(), NOW)).refusals
    assert refusals == ()
    file_target = FileTarget(controller, KEYS)
    proposal = propose(file_target, Request(demo_calibration(), NOW))
    assert apply(proposal, NOW) is not None


def test_a_link_between_the_look_and_the_write_changes_nothing(
    controller: Path, tmp_path: Path
) -> None:
    """The lock's name is no way to another file either."""
    request = Request(demo_calibration(), NOW)
    target = FileTarget(controller, KEYS)
    proposal = propose(target, request)
    victim = tmp_path / "victim"
    (controller.parent / ".demo.yaml.lock").symlink_to(victim)
    with pytest.raises(OutputFailed, match=r"\.demo\.yaml\.lock: found .*symbolic link"):
        apply(proposal, NOW)
    assert not victim.exists()


def test_a_deleted_file_comes_back_through_its_link_and_is_recorded(
    controller: Path, tmp_path: Path
) -> None:
    audit = tmp_path / "audit.jsonl"
    link = tmp_path / "link.yaml"
    link.symlink_to(controller)
    before = controller.read_bytes()
    request = Request(demo_calibration(), NOW)
    target = FileTarget(link, KEYS)
    proposal = propose(target, request)
    apply(
        proposal,
        NOW,
        audit=audit,
        who="Ada",
    )
    controller.unlink()
    edit = rollback(FileTarget(link), NOW, audit=audit, who="Bob").edit
    assert edit.subject == str(controller)
    assert controller.read_bytes() == before
    entries = read(audit)
    expected = [AuditAction.ROLLBACK_BEGUN, AuditAction.ROLLED_BACK]
    actions = [entry.action for entry in entries]
    assert actions[2:] == expected
    assert entries[2].details["sha256_before"] is None
    subjects = {entry.subject for entry in entries}
    assert subjects == {str(controller)}


def test_what_fails_within_a_write_is_recorded_as_failed(
    controller: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    audit = tmp_path / "audit.jsonl"
    before = controller.read_bytes()
    request = Request(demo_calibration(), NOW)
    target = FileTarget(controller, KEYS)
    proposal = propose(target, request)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("daq.writeback.file_target.replace_file", full)
    with pytest.raises(OSError, match="No space"):
        apply(proposal, NOW, audit=audit, who="Ada")
    assert controller.read_bytes() == before
    begun, failed = read(audit)
    expected = (AuditAction.APPLY_BEGUN, AuditAction.FAILED)
    assert (begun.action, failed.action) == expected
    assert failed.details["begun"] == begun.number
    assert "No space" in str(failed.details["error"])
    assert failed.details["sha256_found"] == begun.details["sha256_before"]


def test_an_end_that_cannot_be_recorded_leaves_the_write_and_a_warning(
    controller: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    audit = tmp_path / "audit.jsonl"

    def full_at_the_end(path: Path, action: AuditAction, **rest: object) -> object:
        if action is AuditAction.APPLIED:
            raise OSError(28, "No space left on device")
        return append(path, action, **rest)  # type: ignore[arg-type]

    monkeypatch.setattr("daq.writeback.target.record_write", full_at_the_end)
    request = Request(demo_calibration(), NOW)
    target = FileTarget(controller, KEYS)
    proposal = propose(target, request)
    assert apply(proposal, NOW, audit=audit, who="Ada") is not None
    assert "the audit log may lack the entry that it is applied" in caplog.text
    (left,) = verify(audit).open_writes
    assert left.content is Content.AFTER


def _write_and_delete_log(controller: Path, audit: Path) -> None:
    """Apply a calibration, and remove the audit log of it with the note of its last entry."""
    request = Request(demo_calibration(), NOW)
    target = FileTarget(controller, KEYS)
    proposal = propose(target, request)
    assert (
        apply(
            proposal,
            NOW,
            audit=audit,
        )
        is not None
    )
    audit.unlink()
    head_file(audit).unlink()


def test_a_rollback_beside_a_deleted_log_works_and_the_new_log_says_what_is_missing(
    controller: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    audit = tmp_path / "audit.jsonl"
    original = controller.read_bytes()
    _write_and_delete_log(controller, audit)
    assert caplog.text == ""
    rollback(FileTarget(controller), NOW, audit=audit, who="Ada")
    assert controller.read_bytes() == original
    assert "is absent, although" in caplog.text
    assert "1 backup of earlier writes" in caplog.text
    begun, _ = read(audit)
    assert begun.details[BACKUPS_WITHOUT_LOG] == 1
    caplog.clear()
    rollback(FileTarget(controller), NOW, audit=audit, who="Ada")  # the log is there again
    assert caplog.text == ""
    details = read(audit)[-2].details
    assert BACKUPS_WITHOUT_LOG not in details


def test_a_first_write_misses_no_log(
    controller: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    audit = tmp_path / "audit.jsonl"
    request = Request(demo_calibration(), NOW)
    target = FileTarget(controller, KEYS)
    proposal = propose(target, request)
    apply(proposal, NOW, audit=audit)
    assert caplog.text == ""
    for entry in read(audit):
        assert BACKUPS_WITHOUT_LOG not in entry.details


def test_history_is_not_called_sound_where_backups_show_that_its_log_is_gone(
    tmp_path: Path, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    not_histories = shutil.ignore_patterns("*.jsonl*", "*.sqlite*", "*.bak")
    shutil.copytree(checkout / "configs", tmp_path / "configs", ignore=not_histories)
    cell_file = tmp_path / "configs/cells/demo.yaml"
    controller = load_cell(cell_file).controller_path
    assert controller is not None
    place = load_cell(cell_file).history
    assert place is not None
    _write_and_delete_log(controller, place.audit)
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.DATA_UNFIT
    output = capsys.readouterr()
    assert "1 backup of earlier writes next to it" in " ".join(output.err.split())
    assert "sound" not in output.out
    assert main(["history", str(cell_file), "--verify", "--json"]) == ExitCode.DATA_UNFIT
    assert main(["rollback", str(cell_file), "--yes"]) == ExitCode.OK
    capsys.readouterr()
    assert main(["history", str(cell_file), "--verify"]) == ExitCode.OK
    printed = capsys.readouterr().out
    assert "an earlier log was removed or moved" in " ".join(printed.split())
