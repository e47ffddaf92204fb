"""No verb waits for a pipe, a device or a socket:
each file that it reads is refused unless it is a regular one.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from daq.cli.app import VERBS, main
from daq.cli.verb import Verb
from daq.documents.calibration_file import save_calibration
from daq.errors import ExitCode
from tests.daq.calibrations import demo_calibration
from tests.daq.command_line import run_verb
from tests.daq.logs import demo_content, samples, write

VALID = {
    "cell": "configs/cells/demo.yaml",
    "log": "a.mcap",
    "logs": "a.mcap",
    "calibration": "calibration.yaml",
    "description": "configs/imports/tx40.yaml",
    "simulation": "clean",
    "data": ".",
    "key": "ada.key",
}
"""Values of the other arguments, by name; any other is a name of no file."""
WRITTEN = {"out", "pictures", "plot", "csv", "report", "preview", "folder", "to", "cases"}
"""Places to write to, which `test_hostile_links` judges."""
OTHERS = {"data", "payload_from"}  #: A folder, and a file that a verb reads again and again
LONGEST_S = 20.0


def _command_lines() -> Iterator[tuple[str, list[str]]]:
    """Yield a name and the words of each command line, with PIPE for one file that it reads."""
    for verb in VERBS:
        for kind in verb.kinds or (verb,):
            if verb.kinds:
                words = [verb.name, kind.name]
            else:
                words = [verb.name]
            params = kind.command().params
            for one in params:
                annotation_text = str(one.type_descriptor.annotation)
                if "Path" in annotation_text and one.name not in WRITTEN | OTHERS:
                    yield f"{' '.join(words)} {one.name}", [*words, *arguments(kind, params, one)]


def arguments(kind: Verb, params: list[Any], one: Any) -> Iterator[str]:
    """Yield the words for one argument, PIPE, and for those that the verb requires beside it."""
    for param in params:
        if param is one or param.required:
            if param is one:
                value = "PIPE"
            else:
                value = VALID.get(param.name, "absent")
            yield from (
                (value,)
                if param.param_type_name == "argument"
                else (max(param.opts, key=len), value)
            )
    if kind.name == "log":
        yield "--csv"  # one of two kinds of table


LINES = dict(_command_lines())


@contextmanager
def _in_time() -> Iterator[None]:
    """Interrupt what waits, with an error that no verb handles."""

    def late(_number: int, _frame: FrameType | None) -> None:
        raise AssertionError("it waits for the pipe")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def folder(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a cell, a log and a calibration."""
    made = tmp_path_factory.mktemp("here")
    shutil.copytree(checkout / "configs", made / "configs")
    path = made / "a.mcap"
    write(path, demo_content(checkout), samples([[0] * 6] * 50))
    save_calibration(demo_calibration(), made / "calibration.yaml")
    os.mkfifo(made / "pipe")
    return made


@pytest.mark.parametrize("line", LINES)
def test_no_verb_waits_for_a_pipe(
    line: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    with _in_time():
        code = main([word.replace("PIPE", "pipe") for word in LINES[line]])
    assert code != ExitCode.OK
    assert "Traceback" not in "".join(capsys.readouterr())


LONG_NAME = "x" * 300
OF_LONG_NAMES = {
    "an output that exists": ["fit", "a.mcap", LONG_NAME, "--out", "calibration.yaml"],
    "data of an import": [
        *("import", "configs/imports/tx40.yaml", "--data", LONG_NAME, "--out", "made.mcap"),
    ],
    "logs of a fleet": ["fleet", LONG_NAME, "--out", "made"],
    "a controller": ["apply", VALID["cell"], "calibration.yaml", "--to", LONG_NAME],
    "a rollback": ["rollback", VALID["cell"], "--to", LONG_NAME],
}
for _line, _words in LINES.items():
    OF_LONG_NAMES[_line] = [word.replace("PIPE", LONG_NAME) for word in _words]


@pytest.mark.parametrize("line", OF_LONG_NAMES)
def test_a_name_that_no_file_system_takes_is_not_called_a_full_disk(
    line: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    code = main(OF_LONG_NAMES[line])
    said = "".join(capsys.readouterr())
    assert code not in (ExitCode.OK, ExitCode.UNEXPECTED)
    assert "free space" not in said
    assert "Traceback" not in said


def test_an_output_whose_temporary_name_is_too_long_asks_for_a_shorter_one(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    name = "x" * 250 + ".html"
    code = run_verb("certificate", "calibration.yaml", "--cell", VALID["cell"], "--out", name)
    assert code == ExitCode.UNEXPECTED
    assert "choose a shorter name" in capsys.readouterr().err


@pytest.mark.parametrize(
    "verb", [["info"], ["fit"], ["export", "bag"], ["export", "log", "--csv"], ["salvage"]]
)
def test_devices_and_sockets_are_refused_like_pipes(
    verb: list[str], folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "made")]
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(tmp_path / "socket"))
        for place in (Path("/dev/zero"), tmp_path / "socket", folder / "pipe"):
            code = run_verb(*verb, place, *(out if verb != ["info"] else ()))
            assert code == ExitCode.DATA_UNFIT
            assert "no regular file" in capsys.readouterr().err
