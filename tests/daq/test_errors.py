"""Every error of the three packages has an exit code, and says what to do."""

from __future__ import annotations

import errno
import importlib
import inspect
import pkgutil
from pathlib import Path

import pytest

import daq
import drivers
import ident
from daq.errors import (
    CalibrationRefused,
    DaqError,
    FileImmutable,
    OutputFailed,
    OwnerNotKept,
    SchemaMismatch,
    UsageError,
    WriteUnconfirmed,
    exit_code,
    first_few,
    writing,
)
from daq.log.feed import FeedUnfit
from daq.workflow.mesh_files import ShapeUnreadable
from drivers.canopen.sdo import TransferUnboundedError
from drivers.errors import DriverError, SetupRefused
from drivers.simulation.spec import SdoAbort
from ident.errors import IdentificationError, RankDeficient


def _exceptions() -> set[type[BaseException]]:
    found: set[type[BaseException]] = set()
    for package in (daq, drivers, ident):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            members = vars(importlib.import_module(module.name)).values()
            found |= {m for m in members if inspect.isclass(m) and issubclass(m, BaseException)}
    return {kind for kind in found if kind.__module__.split(".")[0] in {"daq", "drivers", "ident"}}


def test_every_exception_class_has_an_exit_code() -> None:
    kinds = _exceptions()
    assert {SetupRefused, RankDeficient, SchemaMismatch} <= kinds
    # The root of daq is never raised; SdoAbort is how a simulated node says no on the bus,
    # FeedUnfit is said on the console's page, TransferUnboundedError becomes an ObjectAccessError,
    # OwnerNotKept, FileImmutable and WriteUnconfirmed are OSErrors that become an OutputFailed,
    # ShapeUnreadable is listed in a model: they end no command.
    inner = {
        DaqError,
        SdoAbort,
        FeedUnfit,
        TransferUnboundedError,
        OwnerNotKept,
        FileImmutable,
        WriteUnconfirmed,
        ShapeUnreadable,
    }
    unmapped = {kind.__qualname__ for kind in kinds - inner if exit_code(kind) is None}
    assert not unmapped


def test_foreign_exceptions_have_none() -> None:
    assert exit_code(ValueError) is None
    assert exit_code(DaqError) is None


def test_codes_are_those_of_the_command_line_contract() -> None:
    kinds = (
        UsageError,
        CalibrationRefused,
        IdentificationError,
        DriverError,
        SchemaMismatch,
        OutputFailed,
    )
    assert [exit_code(kind) for kind in kinds] == [2, 3, 4, 5, 6, 1]


def test_an_error_carries_its_evidence() -> None:
    error = UsageError("here", found="this", expected="that", remedy="do so")
    expected = ("here", "this", "that", "do so")
    assert (error.subject, error.found, error.expected, error.remedy) == expected
    assert str(error) == "here: found this; expected that; do so"


def test_a_message_does_not_repeat_a_damaged_file() -> None:
    error = UsageError("here", found="x" * 10**6, expected="that", remedy="do so")
    assert len(str(error)) < 5000
    assert "996000 more characters" in str(error)


@pytest.mark.parametrize(
    ("count", "shown"),
    [
        (0, ""),
        (1, "a"),
        (3, "a, b, c"),
        (4, "a, b, c, and 1 more (see below)"),
        (6, "a, b, c, and 3 more (see below)"),
    ],
)
def test_the_first_of_many_texts_are_shown_with_the_number_of_the_others(
    count: int, shown: str
) -> None:
    assert first_few("abcdef"[:count], 3, separator=", ", note=" (see below)") == shown


def test_a_missing_folder_of_an_output_is_named(tmp_path: Path) -> None:
    path = tmp_path / "none" / "table.csv"
    with pytest.raises(OutputFailed, match=r"no folder .*none; .*mkdir -p"), writing(path):
        path.write_text("")
    (tmp_path / "none").write_text("a file")
    with pytest.raises(OutputFailed, match=r"found .*none is a file"), writing(path):
        path.write_text("")


def test_folders_that_cannot_be_looked_at_do_not_hide_the_refusal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was a PermissionError without a word of what to do."""
    closed = PermissionError(errno.EACCES, "Permission denied")

    def refuse(_: Path) -> bool:
        raise closed

    monkeypatch.setattr(Path, "is_dir", refuse)
    monkeypatch.setattr(Path, "exists", refuse)
    error = OutputFailed.of(tmp_path / "x.csv", closed)
    assert error.found == "permission denied"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "it was not made"),
        (b"", "it is empty"),
        (b"x", "it is as it was"),
    ],
)
def test_an_output_that_failed_is_as_it_was_only_where_there_was_one(
    tmp_path: Path, content: bytes | None, said: str
) -> None:
    path = tmp_path / "calibration.yaml"
    if content is not None:
        path.write_bytes(content)
    error = OutputFailed.of(path, OSError(errno.ENOSPC, "No space left on device"))
    assert error.remedy.startswith(f"{said}; ")
