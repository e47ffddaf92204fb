"""Errors as a person and as a program see them: found, expected and a remedy in every one."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from daq.cli.failure import ADVICE, ADVICE_WITHIN, ErrorParts, show_failure
from daq.errors import DataError, ExitCode, OutputFailed, UsageError
from daq.report.document import ErrorReport, json_tree
from drivers.canopen.bus import bus_errors
from drivers.canopen.emcy import remedy_of
from drivers.errors import BusError, DriveFault, DriverError, SampleLost
from ident.errors import IdentificationError
from tests.daq.command_line import run_verb


def _all(root: type[Exception]) -> Iterator[type[Exception]]:
    yield root
    for child in root.__subclasses__():
        yield from _all(child)


def _made(kind: type[Exception], message: str, *, has_parts: bool = True) -> Exception:
    """An error of any class: each has a constructor of its own."""
    error = kind.__new__(kind)
    error.args = (message,)
    for name in ("subject", "found", "expected", "remedy", "address"):
        part = name if has_parts else ""
        object.__setattr__(error, name, part)
    evidence: dict[str, object] = {"emcy_code": None, "statusword": None, "reported": ()}
    for name, value in evidence.items():
        object.__setattr__(error, name, value)
    return error


@pytest.mark.parametrize(
    "kind", [*_all(DriverError), *_all(IdentificationError)], ids=lambda kind: kind.__name__
)
def test_every_error_of_drivers_and_of_the_science_has_a_remedy(kind: type[Exception]) -> None:
    error = _made(kind, "J3 (node 3): evidence")
    failure = ErrorParts.of(error)
    assert all((failure.error, failure.found, failure.expected, failure.do))
    for label in ("error", "expected", "do"):
        lines = dict(line[:2] for line in failure.lines())
        assert label in lines


@pytest.mark.parametrize(
    "kind", [*_all(DriverError), *_all(IdentificationError)], ids=lambda kind: kind.__name__
)
def test_an_error_of_the_demonstration_names_no_verb_that_needs_a_cell_file(
    kind: type[Exception],
) -> None:
    error = _made(kind, f"J3 (node 3): fault; {remedy_of(0x8611)}")
    failure = ErrorParts.of(error, "demo")
    assert failure.do
    assert "CELL" not in f"{failure.error} {failure.found} {failure.do}"


@pytest.mark.parametrize("verb", ["scan", "monitor"])
@pytest.mark.parametrize("kind", [*_all(DriverError)], ids=lambda kind: kind.__name__)
def test_no_verb_that_asks_the_drives_advises_to_run_itself(
    kind: type[Exception], verb: str
) -> None:
    error = _made(kind, "J3 (node 3): evidence", has_parts=False)
    failure = ErrorParts.of(error, verb)
    assert failure.do
    pattern = rf"`drivegain {verb} CELL([^`]*)`"
    own = re.findall(pattern, failure.do)
    # An option that was not given would be another command.
    for options in own:
        assert "--" in options, failure.do


def test_advice_names_verbs_that_exist(capsys: pytest.CaptureFixture[str]) -> None:
    advice = list(ADVICE.values())
    for within in ADVICE_WITHIN.values():
        advice.extend(within.values())
    for expected, remedy in advice:
        matches = re.findall(r"`drivegain ([a-z-]+)([^`]*)`", f"{expected} {remedy}")
        for verb, rest in matches:
            assert run_verb(verb, "--help") == 0
            text = capsys.readouterr().out
            for option in re.findall(r"--[a-z-]+", rest):
                assert option in text


@pytest.mark.parametrize(
    ("number", "found", "remedy"),
    [
        (errno.ECONNREFUSED, "connection refused", "drivegain simulate demo"),
        (errno.EAFNOSUPPORT, "no CAN in this kernel", "modprobe vcan"),
        (errno.EPROTONOSUPPORT, "no CAN in this kernel", "ip link add dev vcan0 type vcan"),
        (errno.ENODEV, "no such CAN interface", "bus.channel"),
        (errno.ENETDOWN, "down", "ip link set can0 up"),
        (errno.EPERM, "no permission", "NET_RAW"),
        (errno.EACCES, "no permission", "NET_RAW"),
    ],
)
def test_an_error_of_the_operating_system_is_explained(
    number: int, found: str, remedy: str
) -> None:
    with pytest.raises(BusError) as caught, bus_errors("socketcan:can0"):
        raise OSError(number, os.strerror(number))
    failure = ErrorParts.of(caught.value)
    assert failure.error == "bus socketcan:can0"
    assert found in failure.found
    assert remedy in failure.do
    assert failure.exit_code == ExitCode.DEVICE_FAULT


def test_a_refused_connection_names_the_command_that_starts_a_cell(
    checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    assert run_verb("init", tmp_path / "lathe", "--simulated") == 0
    cell = tmp_path / "lathe/cells/lathe.yaml"
    text = cell.read_text(encoding="utf-8")
    changed_text = text.replace("29536", str(port))
    cell.write_text(changed_text, encoding="utf-8")
    capsys.readouterr()
    assert run_verb("scan", cell) == ExitCode.DEVICE_FAULT
    said = capsys.readouterr().err
    assert re.search(
        r"^found: .*connection refused.*\nexpected: .*\ndo: .*drivegain "
        r"simulate demo",
        said,
        re.MULTILINE,
    )
    assert "Errno" not in said


def test_texts_of_an_error_stand_under_one_another_also_in_further_lines(
    capsys: pytest.CaptureFixture[str],
) -> None:
    error = DataError("a.mcap", found="x\ny", expected="z", remedy="w")
    show_failure(ErrorParts.of(error), json_wanted=False)
    lines = capsys.readouterr().err.splitlines()
    assert "found:    x" in lines
    assert "          y" in lines
    assert "expected: z" in lines
    assert "do:       w" in lines


def test_a_program_gets_one_object_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    error = DataError("a\nb\udcff", found="x", expected="y", remedy="z")
    error.add_note("kept: c.mcap")
    failure = ErrorParts.of(error)
    show_failure(failure, json_wanted=True)
    (line,) = capsys.readouterr().err.splitlines()
    expected = {
        **{"error": "a\nb\udcff", "found": "x", "expected": "y", "do": "z"},
        **{"exit_code": 4, "kind": "DataError", "kept": "c.mcap"},
    }
    assert json.loads(line) == expected
    stop = DriveFault(3, "fault")
    stop.add_note("while stopping: J3 (node 3) does not answer")
    report = ErrorParts.of(stop).document()
    assert "axes" not in json_tree(report)
    stop.add_note("not confirmed without power: J3 (node 3)")
    document = ErrorParts.of(stop).document()
    assert document.axes == ("J3 (node 3) NOT CONFIRMED WITHOUT POWER: use the emergency stop")


def test_what_a_stop_could_not_confirm_is_shown_though_a_later_error_hides_its_cause() -> None:
    """The disk is full while the log of a stopped motion is closed."""
    later = OutputFailed("a.mcap", found="no space left", expected="room", remedy="free some")
    later.__context__ = stop = DriveFault(3, "fault")
    stop.add_note("while stopping: J3 (node 3) does not answer")
    stop.add_note("not confirmed without power: J3 (node 3)")
    document = ErrorParts.of(later).document()
    assert document.axes == "J3 (node 3) NOT CONFIRMED WITHOUT POWER: use the emergency stop"
    assert document.unconfirmed == ["while stopping: J3 (node 3) does not answer"]
    ErrorReport.model_validate(json_tree(document))  # an error is shown unchecked


def test_an_error_that_is_its_own_cause_is_explained() -> None:
    error = BusError("socketcan:can0", "gone")
    error.__cause__ = error
    assert ErrorParts.of(error).exit_code == ExitCode.DEVICE_FAULT


@pytest.mark.parametrize("json_option", [[], ["--json"]])
def test_an_error_that_cannot_be_printed_keeps_its_exit_code(
    json_option: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Path("/dev/full").open("w", buffering=1, encoding="utf-8") as full:
        monkeypatch.setattr(sys, "stderr", full)
        assert run_verb("scan", "missing.yaml", *json_option) == ExitCode.CONFIGURATION
        monkeypatch.undo()
        with suppress(OSError):  # what could not be written is tried again
            full.close()


def test_an_error_of_a_verb_is_an_object_under_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (
        ["scan", "none.yaml"],
        ["info", str(tmp_path / "none.mcap")],
        ["explain-emcy", "x"],
    ):
        code = run_verb(*arguments, "--json")
        output = capsys.readouterr()
        document: dict[str, Any] = json.loads(output.err)
        assert output.out == ""
        assert {"error", "found", "expected", "do", "exit_code", "kind"} <= document.keys()
        assert document["exit_code"] == code != 0


def test_an_interrupt_says_what_was_kept_and_leaves_no_empty_folder(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    # A job in the background inherits SIGINT ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    monkeypatch.setattr("daq.workflow.fit.fit", lambda *_, **__: signal.raise_signal(signal.SIGINT))
    (tmp_path / "kept").mkdir()
    report_folder = tmp_path / "new" / "report"
    for folder, stays in ((report_folder, False), (tmp_path / "kept", True)):
        assert run_verb("residual", "x.mcap", "--report", folder) == ExitCode.INTERRUPTED
        assert capsys.readouterr().err.endswith("interrupted: no file was written\n")
        assert folder.exists() is stays
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("statusword", "remedy"),
    [(None, "safety chain"), (0x0240, "safety chain"), (0x0218, "--reset-faults")],
)
def test_remedy_of_a_fault_without_a_code_explains_none(
    statusword: int | None, remedy: str
) -> None:
    fault = DriveFault(3, "left OPERATIONAL, is BOOT-UP", statusword)
    failure = ErrorParts.of(fault, "record")
    assert remedy in failure.do
    assert "explain-emcy" not in failure.do


def test_remedy_of_a_fault_with_a_code_explains_it() -> None:
    failure = ErrorParts.of(DriveFault(3, "EMCY 8611h", emcy_code=0x8611), "record")
    assert "explain-emcy" in failure.do


def test_remedy_of_a_fault_that_has_its_own_is_that_one() -> None:
    failure = ErrorParts.of(DriveFault(3, "a limit", 0x0237, remedy="use slower moves"), "record")
    assert failure.do == "use slower moves"
    assert "use slower moves" not in failure.error


def test_remedy_of_a_lost_sample_after_an_error_is_about_that_error() -> None:
    reported = ("EMCY 8130h heartbeat error",)
    lost = SampleLost(0, (2,), ("J3",), reported=reported)
    assert "explain-emcy" in ErrorParts.of(lost, "record").do
    silent = SampleLost(0, (2,), ("J3",), reported=("",))
    assert "load of bus" in ErrorParts.of(silent, "record").do


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE])
def test_too_many_open_files_names_the_limit(number: int) -> None:
    error = UsageError("cell.yaml", found="x", expected="y", remedy="check the name")
    error.__cause__ = OSError(number, os.strerror(number), "cell.yaml")
    failure = ErrorParts.of(error)
    assert failure.found == "too many open files"
    assert "ulimit -n" in failure.do


@pytest.mark.parametrize(
    "words", [("fit", "a.mcap", "--out", "c.yaml"), ("init", "press-4", "--simulated")]
)
def test_a_removed_current_folder_is_named(
    words: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    try:
        assert run_verb(*words) != ExitCode.OK
    finally:
        os.chdir(tmp_path)
    said = capsys.readouterr().err
    assert "no current folder" in said
    assert "change to another folder" in said
