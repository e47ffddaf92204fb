"""Writing back: every failure of the disk, two writers, and rollback.

The gates are in test_gates.py.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import itertools
import json
import os
import shlex
import shutil
import stat
import tempfile
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from daq.errors import CalibrationRefused, ControllerChanged, ControllerUnfit, OutputFailed
from daq.ledger.audit import AuditAction, read
from daq.ledger.ledger import record_write
from daq.writeback.file_access import backups, exclusive_writer
from daq.writeback.file_target import FileEdit, FileTarget
from daq.writeback.request import Request
from daq.writeback.target import Proposal, apply, propose, rollback
from ident.calibration import Calibration
from tests.daq.calibrations import AXES, KEYS, demo_calibration
from tests.daq.command_line import run_verb

CONFIGS = Path(__file__).parents[3] / "configs"
NOW = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)


@pytest.fixture
def controller(tmp_path: Path) -> Path:
    """A copy of the demo controller's file in a folder of its own."""
    path = tmp_path / "the controllers" / "demo.yaml"
    path.parent.mkdir()
    demo_path = CONFIGS / "controllers" / "demo.yaml"
    shutil.copyfile(demo_path, path)
    return path


def _propose(calibration: Calibration, controller: Path) -> Proposal[FileEdit]:
    target = FileTarget(controller, KEYS)
    return propose(target, Request(calibration, NOW))


def test_a_dry_run_shows_and_writes_nothing(controller: Path) -> None:
    before = controller.read_bytes()
    proposal = _propose(demo_calibration(), controller)
    assert proposal.refusals == ()
    axes = [change.axis for change in proposal.edit.changes]
    assert axes == list(AXES)
    assert "-    gain: -11.52       # Nm at the joint per A\n" in proposal.edit.diff
    assert "+    gain: -9.2100       # Nm at the joint per A\n" in proposal.edit.diff
    assert proposal.edit.diff.count("\n+ ") == proposal.edit.diff.count("\n- ") == 6
    assert controller.read_bytes() == before
    files = list(controller.parent.iterdir())
    assert files == [controller]


def test_applying_changes_the_six_numbers_and_keeps_a_backup(controller: Path) -> None:
    controller.chmod(0o640)
    before = controller.read_bytes()
    proposal = _propose(demo_calibration(), controller)
    written = apply(proposal, NOW)
    assert written is not None
    expected = before
    for old, new in (
        (b"25.65", b"24.2000"),
        (b"-11.52", b"-9.2100"),
        (b"18.48", b"16.3000"),
        (b" 7.68", b" 6.7900"),
    ):
        assert expected.count(old) == 1
        expected = expected.replace(old, new)
    changed_expected = expected.replace(b"32.96", b"33.900", 1)
    expected = changed_expected.replace(b"32.96", b"32.400", 1)
    assert controller.read_bytes() == expected
    digests = "-".join(hashlib.sha256(content).hexdigest()[:12] for content in (before, expected))
    assert written.backup == controller.parent / f"demo.yaml.20250102T030405Z.{digests}.bak"
    assert written.backup.read_bytes() == before
    sorted_files = sorted(controller.parent.iterdir())
    assert sorted_files == sorted([controller, written.backup])
    assert {stat.S_IMODE(path.stat().st_mode) for path in (controller, written.backup)} == {0o640}


def test_applying_twice_changes_nothing_the_second_time(controller: Path) -> None:
    proposal = _propose(demo_calibration(), controller)
    apply(proposal, NOW)
    again = _propose(demo_calibration(), controller)
    assert again.edit.diff == ""
    assert apply(again, NOW) is None
    assert len(backups(controller)) == 1


def test_other_axes_than_the_cell_has_are_refused(controller: Path) -> None:
    gains = demo_calibration().gains[:5]
    fewer = replace(demo_calibration(), gains=gains)
    with pytest.raises(CalibrationRefused, match="J1, J2, J3, J4, J5; expected"):
        _propose(fewer, controller)
    target = FileTarget(controller, {**KEYS, "J2": "drives.J1.gain"})
    request = Request(demo_calibration(), NOW)
    with pytest.raises(ControllerUnfit, match=r"drives\.J1\.gain for more than one axis"):
        propose(
            target,
            request,
        )


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("  J6:", "  J7:", "no key 'J6' in drives"),
        ("loop: {kp", "loop: kp", None),
        ("drives:", "drives: [", "no YAML"),
        ("gain: 7.68", "gain: unknown", "'unknown'"),
    ],
)
def test_a_controller_file_that_does_not_fit_is_refused(
    controller: Path, old: str, new: str, says: str | None
) -> None:
    changed_text = controller.read_text().replace(old, new)
    controller.write_text(changed_text)
    with pytest.raises(ControllerUnfit, match=says):
        _propose(demo_calibration(), controller)


def test_a_missing_controller_file_or_a_folder_is_refused(controller: Path) -> None:
    with pytest.raises(ControllerUnfit, match="no such file"):
        _propose(demo_calibration(), controller.with_name("none.yaml"))
    with pytest.raises(ControllerUnfit, match="is a directory"):
        _propose(demo_calibration(), controller.parent)


def test_a_file_changed_since_the_diff_is_refused(controller: Path) -> None:
    proposal = _propose(demo_calibration(), controller)
    controller.write_text(controller.read_text() + "# seen by K.\n")
    changed = controller.read_bytes()
    with pytest.raises(ControllerChanged):
        apply(proposal, NOW)
    assert controller.read_bytes() == changed
    files = list(controller.parent.iterdir())
    assert files == [controller]


def test_a_second_writer_is_refused(controller: Path) -> None:
    proposal = _propose(demo_calibration(), controller)
    before = controller.read_bytes()
    lock = controller.parent / ".demo.yaml.lock"
    with lock.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(CalibrationRefused, match="another drivegain writing it"):
            apply(proposal, NOW)
        assert lock.exists()
    assert controller.read_bytes() == before
    # The lock of a writer that was killed is free, whatever its file says.
    assert apply(proposal, NOW) is not None
    assert not lock.exists()


def test_the_next_writer_removes_what_killed_ones_have_left_unfinished(controller: Path) -> None:
    folder = controller.parent
    left = [
        folder / ".demo.yaml.4711-0.tmp",
        folder / ".demo.yaml.20250102T030405Z.0123456789ab-ba9876543210.bak.4711-3.tmp",
    ]
    kept = [folder / ".other.yaml.4711-0.tmp", folder / "demo.yaml.tmp", folder / ".demo.yaml.tmp"]
    for file in (*left, *kept):
        file.write_text("half")
    apply(_propose(demo_calibration(), controller), NOW)
    assert not any(file.exists() for file in left)
    assert all(file.exists() for file in kept)


def test_the_lock_that_a_killed_writer_leaves_keeps_no_other_user_out(tmp_path: Path) -> None:
    file = tmp_path / "x.yaml"
    lock = tmp_path / ".x.yaml.lock"
    made = 0
    umask = os.umask(0o077)
    try:
        with exclusive_writer(file):
            made = stat.S_IMODE(lock.stat().st_mode)
    finally:
        os.umask(umask)
    assert made == 0o644
    assert not lock.exists()
    if os.geteuid() != 0:
        pytest.skip("only root can be another user")
    lock.touch(0o644)
    held = os.open(lock, os.O_RDONLY)
    # The folders above are pytest's own, for root alone: a folder of its own, by its descriptor.
    shared = Path(tempfile.mkdtemp())
    lock = lock.rename(shared / lock.name)
    shared.chmod(0o1777)
    busy = pytest.raises(CalibrationRefused, match="another drivegain writing it")
    os.seteuid(65534)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        with busy, exclusive_writer(shared / "x.yaml"):
            pass
        fcntl.flock(held, fcntl.LOCK_UN)
        with exclusive_writer(shared / "x.yaml"), busy, exclusive_writer(shared / "x.yaml"):
            pass
        assert lock.exists()  # root's, in a folder where each removes their own
    finally:
        os.seteuid(0)
        os.close(held)
        shutil.rmtree(shared)


@pytest.mark.parametrize(
    ("name", "content", "keys"),
    [
        (
            "x.dcf",
            "[2003]\nObjectType=0x9\nSubNumber=2\n[2003sub1]\nDataType=0x0008\nParameterValue=32.96\n",
            ("2003:01", "2003sub1"),
        ),
        (
            "x.xml",
            "<c><Axis name='J1'><gain>32.96</gain></Axis></c>",
            ("c/Axis[1]/gain", "c/Axis[@name='J1']/gain"),
        ),
    ],
)
def test_two_names_of_one_number_are_refused(
    tmp_path: Path, name: str, content: str, keys: tuple[str, str]
) -> None:
    file = tmp_path / name
    file.write_text(content)
    gains = demo_calibration().gains[:2]
    two = replace(demo_calibration(), gains=gains)
    target = FileTarget(file, dict(zip(("J1", "J2"), keys, strict=True)))
    with pytest.raises(ControllerUnfit, match="which name the same number"):
        propose(target, Request(two, NOW))


def test_a_link_that_leads_elsewhere_since_the_dry_run_is_named(
    controller: Path, tmp_path: Path
) -> None:
    link = tmp_path / "current.yaml"
    link.symlink_to(controller)
    proposal = _propose(demo_calibration(), link)
    copy = tmp_path / "copy.yaml"
    shutil.copyfile(controller, copy)
    link.unlink()
    link.symlink_to(copy)
    with pytest.raises(
        ControllerChanged, match=rf"found a link that leads to {copy}; expected {controller}, as"
    ):
        apply(proposal, NOW)
    assert copy.read_bytes() == controller.read_bytes()


def test_a_symbolic_link_stays_one(controller: Path, tmp_path: Path) -> None:
    link = tmp_path / "link.yaml"
    link.symlink_to(controller)
    proposal = _propose(demo_calibration(), link)
    written = apply(proposal, NOW)
    assert written is not None
    assert written.backup is not None
    assert link.is_symlink()
    assert written.edit.subject == str(controller)
    assert written.backup.parent == controller.parent
    assert b"-9.2100" in controller.read_bytes()
    edit = rollback(FileTarget(link), NOW).edit
    assert edit.subject == str(controller)
    assert b"-11.52" in controller.read_bytes()


class _Failing:
    """Replaces a system call and fails on its n-th use, when the disk is full."""

    def __init__(self, call: Callable[..., object], at: int) -> None:
        self.call = call
        self.at = at
        self.uses = 0

    def __call__(self, *arguments: object, **options: object) -> object:
        self.uses += 1
        if self.uses == self.at:
            raise OSError(28, "No space left on device")
        return self.call(*arguments, **options)


@pytest.mark.parametrize("name", ["open", "fchmod", "fsync", "replace"])
def test_whatever_step_fails_the_old_file_stays_and_nothing_is_left(
    controller: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every use of every system call on the way fails in turn, until one run goes through."""
    before = controller.read_bytes()
    failures = 0
    while True:
        proposal = _propose(demo_calibration(), controller)
        call = getattr(os, name)
        failing = _Failing(call, failures + 1)
        with monkeypatch.context() as patch:
            patch.setattr(os, name, failing)
            try:
                written = apply(proposal, NOW)
            except (OSError, OutputFailed, ControllerUnfit):  # a file that cannot be read is unfit
                written = None
        if failing.uses <= failures:
            break
        failures += 1
        assert written is None
        assert controller.read_bytes() == before
        files = list(controller.parent.iterdir())
        assert files == [controller]
    assert written is not None
    assert failures >= {"open": 5, "fchmod": 2, "fsync": 4, "replace": 2}[name]


def test_a_disk_that_gives_back_something_else_is_noticed(
    controller: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = controller.read_bytes()
    proposal = _propose(demo_calibration(), controller)
    read = Path.read_bytes

    def flipped(path: Path) -> bytes:
        content = read(path)
        if path.suffix == ".tmp":
            return content.replace(b"kp: 120.0", b"kp: 120.1")
        return content

    monkeypatch.setattr(Path, "read_bytes", flipped)
    with pytest.raises(ControllerUnfit, match=r"another value at drives\.J1\.loop\.kp"):
        apply(proposal, NOW)
    monkeypatch.undo()
    assert controller.read_bytes() == before
    files = list(controller.parent.iterdir())
    assert files == [controller]


@pytest.mark.parametrize("does", ["saves it", "deletes it"])
def test_what_a_person_saves_during_the_write_is_not_lost(
    controller: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, does: str
) -> None:
    """An editor takes no lock: the last check is right before the rename."""
    proposal = _propose(demo_calibration(), controller)
    fsync = os.fsync
    edited = controller.read_bytes() + b"# by hand\n"

    def meanwhile(descriptor: int) -> None:
        fsync(descriptor)
        path = Path(f"/proc/self/fd/{descriptor}")
        if path.readlink().suffix == ".tmp" and backups(controller):
            if does == "saves it":
                controller.write_bytes(edited)
            else:
                controller.unlink()

    audit = tmp_path / "audit.jsonl"
    monkeypatch.setattr(os, "fsync", meanwhile)
    with pytest.raises(ControllerChanged, match="meanwhile"):
        apply(proposal, NOW, audit=audit, who="T")
    monkeypatch.undo()
    files = list(controller.parent.iterdir())
    expected = [controller] if does == "saves it" else []
    assert files == expected
    assert not controller.exists() or controller.read_bytes() == edited
    actions = [entry.action for entry in read(audit)]
    assert actions == [AuditAction.APPLY_BEGUN, AuditAction.FAILED]


def test_a_file_that_someone_makes_during_a_rollback_stays(
    controller: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    proposal = _propose(demo_calibration(), controller)
    apply(proposal, NOW)
    controller.unlink()
    fsync = os.fsync

    def meanwhile(descriptor: int) -> None:
        fsync(descriptor)
        controller.write_bytes(b"by: hand\n")

    monkeypatch.setattr(os, "fsync", meanwhile)
    with pytest.raises(ControllerChanged, match="meanwhile"):
        rollback(FileTarget(controller), NOW)
    assert controller.read_bytes() == b"by: hand\n"


def test_rollback_restores_and_a_second_one_undoes_it(controller: Path) -> None:
    original = controller.read_bytes()
    proposal = _propose(demo_calibration(), controller)
    first = apply(proposal, NOW)
    assert first is not None
    calibrated = controller.read_bytes()

    now = NOW + timedelta(minutes=1)
    back = rollback(FileTarget(controller), now)
    assert controller.read_bytes() == original
    assert back.edit.source == first.backup
    assert back.backup is not None
    assert back.backup.read_bytes() == calibrated

    rollback(FileTarget(controller), NOW + timedelta(minutes=2))
    assert controller.read_bytes() == calibrated
    assert len(backups(controller)) == 3


def test_no_backup_is_ever_overwritten_even_by_a_clock_set_back(controller: Path) -> None:
    proposal = _propose(demo_calibration(), controller)
    apply(proposal, NOW)
    for step in (0, -3600, 0, -7200):
        now = NOW + timedelta(seconds=step)
        rollback(FileTarget(controller), now)
    expected = [("20250102T030405Z", k) for k in range(5)]
    assert [(one.stamp, one.count) for one in backups(controller)] == expected
    contents = [one.path.read_bytes() for one in backups(controller)]
    for a, b in itertools.pairwise(contents):
        assert a != b


def _make_backup(
    controller: Path, was: bytes, after_digest: bytes, stamp: str = "20250102T030405Z"
) -> Path:
    digests = "-".join(hashlib.sha256(content).hexdigest()[:12] for content in (was, after_digest))
    path = controller.parent / f"demo.yaml.{stamp}.{digests}.bak"
    path.write_bytes(was)
    return path


def test_without_a_backup_there_is_nothing_to_roll_back(controller: Path) -> None:
    with pytest.raises(CalibrationRefused, match="no backup next to it"):
        rollback(FileTarget(controller), NOW)
    # A backup of a writer that was killed before it replaced the file does not allow a rollback
    # either.
    _make_backup(controller, controller.read_bytes(), b"never written")
    with pytest.raises(CalibrationRefused, match="same content"):
        rollback(FileTarget(controller), NOW)
    controller.with_name("demo.yaml.bak").write_text("a human's own")
    controller.unlink()
    controller.parent.joinpath("other.yaml").write_text("x: 1\n")
    file = controller.with_name("other.yaml")
    with pytest.raises(CalibrationRefused, match="no backup next to it"):
        rollback(FileTarget(file), NOW)


def test_a_write_that_was_killed_half_way_is_passed_over(controller: Path) -> None:
    original = controller.read_bytes()
    proposal = _propose(demo_calibration(), controller)
    apply(proposal, NOW)
    _make_backup(controller, controller.read_bytes(), b"never written", "20250102T040405Z")
    now = NOW + timedelta(hours=2)
    rollback(FileTarget(controller), now)
    assert controller.read_bytes() == original


def _kill_a_write(
    controller: Path, audit: Path, action: AuditAction = AuditAction.APPLY_BEGUN
) -> None:
    """Leave what a writer leaves that is killed before it makes its write."""
    digests = {
        "sha256_before": hashlib.sha256(controller.read_bytes()).hexdigest(),
        "sha256_after": hashlib.sha256(b"never written").hexdigest(),
    }
    subject = str(controller.resolve())
    record_write(audit, action, at=NOW, who="bert", subject=subject, details=digests)


@pytest.mark.parametrize("is_tried_again", [False, True])
@pytest.mark.parametrize("has_earlier_write", [False, True])
def test_a_write_that_was_never_made_is_not_rolled_back_in_the_place_of_another(
    controller: Path, tmp_path: Path, is_tried_again: bool, has_earlier_write: bool
) -> None:
    audit = tmp_path / "audit.jsonl"
    if has_earlier_write:
        apply(_propose(demo_calibration(), controller), NOW, audit=audit, who="anna")
    before = controller.read_bytes()
    _kill_a_write(controller, audit)
    for _ in range(2 if is_tried_again else 1):
        with pytest.raises(
            CalibrationRefused,
            match=r"begun by bert at 2025-.*, that was not made.*nothing needs to be undone",
        ):
            rollback(FileTarget(controller), NOW, audit=audit, who="bert")
    assert controller.read_bytes() == before
    # The next write is made, and can be taken back.
    if not has_earlier_write:
        apply(_propose(demo_calibration(), controller), NOW, audit=audit, who="bert")
        rollback(FileTarget(controller), NOW, audit=audit, who="bert")
        assert controller.read_bytes() == before


def test_a_write_that_failed_is_not_rolled_back_in_the_place_of_another(
    controller: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    audit = tmp_path / "audit.jsonl"
    apply(_propose(demo_calibration(), controller), NOW, audit=audit, who="anna")
    before = controller.read_bytes()
    other = demo_calibration()
    first, *others = other.gains
    higher = replace(first, value=1.01 * first.value)
    proposal = _propose(replace(other, gains=(higher, *others)), controller)
    assert proposal.refusals == ()

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "no space")

    with monkeypatch.context() as patch:
        patch.setattr("daq.writeback.file_target.replace_file", refuse)
        with pytest.raises((OSError, OutputFailed)):
            apply(proposal, NOW, audit=audit, who="bert")
    assert read(audit)[-1].action is AuditAction.FAILED
    with pytest.raises(CalibrationRefused, match=r"begun by bert .* that was not made"):
        rollback(FileTarget(controller), NOW, audit=audit, who="bert")
    assert controller.read_bytes() == before


def test_a_rollback_that_was_never_made_is_made_by_the_next_one(
    controller: Path, tmp_path: Path
) -> None:
    audit = tmp_path / "audit.jsonl"
    original = controller.read_bytes()
    apply(_propose(demo_calibration(), controller), NOW, audit=audit, who="anna")
    _kill_a_write(controller, audit, AuditAction.ROLLBACK_BEGUN)
    rollback(FileTarget(controller), NOW, audit=audit, who="bert")
    assert controller.read_bytes() == original


def test_a_backup_that_is_no_yaml_is_not_restored(controller: Path) -> None:
    before = controller.read_bytes()
    _make_backup(controller, b"drives: [", before)
    with pytest.raises(ControllerUnfit, match="no YAML"):
        rollback(FileTarget(controller), NOW)
    assert controller.read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"drives: {}\n"])
def test_a_backup_that_was_gutted_is_not_restored(controller: Path, content: bytes) -> None:
    proposal = _propose(demo_calibration(), controller)
    written = apply(proposal, NOW)
    assert written is not None
    assert written.backup is not None
    written.backup.write_bytes(content)
    calibrated = controller.read_bytes()
    for deleted in (False, True):
        if deleted:
            controller.unlink()
        with pytest.raises(ControllerUnfit, match="as its name says"):
            rollback(FileTarget(controller), NOW)
        assert controller.exists() is not deleted
    assert written.edit.after == calibrated
    files = list(controller.parent.iterdir())
    assert files == [written.backup]


def test_a_deleted_file_comes_back(controller: Path, capsys: pytest.CaptureFixture[str]) -> None:
    controller.chmod(0o640)
    original = controller.read_bytes()
    proposal = _propose(demo_calibration(), controller)
    apply(proposal, NOW)
    controller.unlink()
    assert run_verb("rollback", "--to", controller, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["backup"] is None
    assert controller.read_bytes() == original
    st_mode = controller.stat().st_mode
    assert stat.S_IMODE(st_mode) == 0o640
    controller.unlink()
    assert run_verb("rollback", "--to", controller) == 0
    assert "the file was gone" in capsys.readouterr().out


def test_an_edit_since_the_write_is_not_lost(
    controller: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    my_controllers_folder = controller.parent.parent / "my controllers"
    folder = controller.parent.rename(my_controllers_folder)
    controller = folder / controller.name
    proposal = _propose(demo_calibration(), controller)
    written = apply(proposal, NOW)
    assert written is not None
    edited = controller.read_bytes().replace(b"120.0", b"130.0")
    controller.write_bytes(edited)
    assert run_verb("rollback", "--to", controller) == 3
    error_output = capsys.readouterr().err
    output = " ".join(error_output.split())
    expected = f"`diff {shlex.quote(str(written.backup))} {shlex.quote(str(controller))}`"
    assert expected in output
    assert controller.read_bytes() == edited
