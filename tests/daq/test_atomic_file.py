"""A file that is replaced keeps its rights: mode, owner, access lists."""

from __future__ import annotations

import errno
import os
import re
import stat
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from daq.errors import FileImmutable, OutputFailed, OwnerNotKept
from daq.files import replace_file
from tests.daq.file_marks import APPEND_ONLY, IMMUTABLE, file_mark

ACCESS = "system.posix_acl_access"
DEFAULT = "system.posix_acl_default"
READ = 4
WRITE = 2
_OWNER = 0x01
_USER = 0x02
_GROUP = 0x04
_MASK = 0x10
_OTHERS = 0x20
_NO_ONE = 0xFFFFFFFF


def _access_list(user: int) -> bytes:
    """As Linux keeps it (version 2): the owner and one more user may read and write,
    no one else.
    """
    entries = (
        (_OWNER, READ | WRITE, _NO_ONE),
        (_USER, READ | WRITE, user),
        (_GROUP, 0, _NO_ONE),
        (_MASK, READ | WRITE, _NO_ONE),
        (_OTHERS, 0, _NO_ONE),
    )
    packed = struct.pack("<I", 2)
    return packed + b"".join(struct.pack("<HHI", *entry) for entry in entries)


def _set(path: Path, name: str, value: bytes) -> None:
    try:
        os.setxattr(path, name, value)
    except OSError as error:
        if error.errno != errno.ENOTSUP:
            raise
        pytest.skip(f"this file system keeps no {name}")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A controller file with an access list and a note."""
    path = tmp_path / "demo.yaml"
    path.write_bytes(b"old")
    path.chmod(0o600)
    _set(path, "user.note", b"K. has weighed it")
    _set(path, ACCESS, _access_list(4711))
    return path


def _rights(path: Path) -> dict[str, bytes | int]:
    attributes: dict[str, bytes | int] = {
        name: os.getxattr(path, name) for name in os.listxattr(path)
    }
    s_imode = stat.S_IMODE(path.stat().st_mode)
    return attributes | {"mode": s_imode}


def test_mode_access_list_and_attributes_stay(file: Path) -> None:
    before = _rights(file)
    replace_file(file, b"new")
    assert file.read_bytes() == b"new"
    assert _rights(file) == before
    assert before["mode"] == 0o660


def _refusing(prefix: str, number: int) -> object:
    """`os.setxattr` of a user, or a file system, that may not set some attributes."""
    true = os.setxattr

    def setxattr(path: int, name: str, value: bytes) -> None:
        if name.startswith(prefix):
            raise OSError(number, os.strerror(number))
        true(path, name, value)

    return setxattr


def _with_capability(monkeypatch: pytest.MonkeyPatch, file: Path, name: str) -> None:
    """The file has an attribute more, named first, that no test may set."""
    listed = os.listxattr
    got = os.getxattr

    def listxattr(path: object) -> list[str]:
        return [name, *listed(path)] if path == file else listed(path)  # type: ignore[arg-type]

    def getxattr(path: object, asked: str) -> bytes:
        return b"\x01" if asked == name else got(path, asked)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "listxattr", listxattr)
    monkeypatch.setattr(os, "getxattr", getxattr)


@pytest.mark.parametrize("name", ["security.capability", "security.ima", "trusted.overlay.origin"])
def test_a_label_that_the_kernel_alone_sets_takes_no_access_list_with_it(
    file: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    before = _rights(file)
    with monkeypatch.context() as patch:
        _with_capability(patch, file, name)
        patch.setattr(os, "setxattr", _refusing(name, errno.EPERM))
        replace_file(file, b"new")
    assert _rights(file) == before


@pytest.mark.parametrize("name", [ACCESS, "user.note"])
def test_an_access_list_that_cannot_be_kept_stops_the_write(
    file: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(os, "setxattr", _refusing(name, errno.EPERM))
    with pytest.raises(PermissionError):
        replace_file(file, b"new")
    assert file.read_bytes() == b"old"
    assert [path.name for path in file.parent.iterdir()] == ["demo.yaml"]


def test_a_file_system_without_attributes_has_none_to_keep(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "setxattr", _refusing("", errno.ENOTSUP))
    replace_file(file, b"new")
    assert file.read_bytes() == b"new"

    def unsupported(_: object) -> list[str]:
        raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))

    monkeypatch.setattr(os, "listxattr", unsupported)
    replace_file(file, b"newer")
    assert file.read_bytes() == b"newer"


def test_whom_the_folder_lets_into_new_files_stays_out_of_an_old_one(tmp_path: Path) -> None:
    path = tmp_path / "demo.yaml"
    path.write_bytes(b"old")
    path.chmod(0o640)
    _set(tmp_path, DEFAULT, _access_list(4712))
    replace_file(path, b"new")
    assert _rights(path) == {"mode": 0o640}


def test_no_one_else_can_open_the_unfinished_copy_of_a_file_of_one_s_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before it has the file's rights: who has it open reads on."""
    path = tmp_path / "demo.yaml"
    path.write_bytes(b"old")
    path.chmod(0o600)
    modes = []
    true = os.fchmod

    def fchmod(descriptor: int, mode: int) -> None:
        st_mode = os.fstat(descriptor).st_mode
        modes.append(stat.S_IMODE(st_mode))
        true(descriptor, mode)

    monkeypatch.setattr(os, "fchmod", fchmod)
    replace_file(path, b"new")
    assert modes == [0o600]


_NOBODY = 65534
_FOREIGN = 4711  #: A user and group that no one is in


@pytest.fixture
def shared_folder() -> Iterator[Path]:
    """A folder that every user can write to; those above a folder of pytest are for root alone."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o777)
        yield folder


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a file to another user")
@pytest.mark.parametrize(
    ("owner", "group", "says"),
    [
        (_NOBODY, _FOREIGN, r"a file of its group 4711, not \S+$"),
        (_FOREIGN, _FOREIGN, r"a file of its owner 4711, not \S+ and group 4711, not \S+$"),
    ],
)
def test_a_file_whose_owner_or_group_cannot_be_kept_stays_and_the_difference_is_named(
    shared_folder: Path, owner: int, group: int, says: str
) -> None:
    path = shared_folder / "controller.yaml"
    path.write_bytes(b"old")
    os.chown(path, owner, group)
    os.seteuid(_NOBODY)
    try:
        with pytest.raises(OwnerNotKept) as caught:
            replace_file(path, b"new")
    finally:
        os.seteuid(0)
    assert re.search(says, str(caught.value.strerror))
    assert path.read_bytes() == b"old"
    assert list(shared_folder.iterdir()) == [path]


def test_an_owner_that_cannot_be_kept_is_no_matter_of_free_space() -> None:
    error = OwnerNotKept(Path("controller.yaml"), "group plc, not users")
    failed = OutputFailed.of(Path("controller.yaml"), error)
    assert failed.found == "this user may not make a file of its group plc, not users"
    assert "free space" not in failed.remedy
    assert "chgrp" in failed.remedy
    other = OutputFailed.of(Path("controller.yaml"), OSError(28, "No space left on device"))
    assert "free space" in other.remedy


@pytest.mark.parametrize("bit", [IMMUTABLE, APPEND_ONLY], ids=["immutable", "append-only"])
@pytest.mark.parametrize("of_folder", [False, True], ids=["file", "folder"])
def test_a_mark_of_the_file_system_is_named_with_the_command_that_takes_it_off(
    tmp_path: Path, bit: int, of_folder: bool
) -> None:
    """It was "operation not permitted … free space or rights", also for root."""
    folder = tmp_path / "the controllers"
    folder.mkdir()
    path = folder / "controller.yaml"
    path.write_bytes(b"old")
    marked = folder if of_folder else path
    with file_mark(marked, bit), pytest.raises(FileImmutable) as caught:
        replace_file(path, b"new")
    failed = OutputFailed.of(path, caught.value)
    assert failed.found == f"{marked} is marked as immutable or append-only (`chattr`)"
    assert f"`chattr -i -a '{marked}'`" in failed.remedy
    assert "free space" not in failed.remedy
    assert path.read_bytes() == b"old"
    # In a folder that may only grow, a temporary file could not be removed
    assert list(folder.iterdir()) == [path]
    replace_file(path, b"new")
    assert path.read_bytes() == b"new"
