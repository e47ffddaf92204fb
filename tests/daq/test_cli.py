"""The command line itself: help, exit codes, JSON, and the verbs init and info."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from daq.cli import main
from daq.cli.app import VERBS
from daq.configuration.cell_file import load_cell
from daq.configuration.importing import load_import
from drivers.event import CellEvent, EventKind
from tests.daq.logs import DISC, START_NS, demo_content, samples, write


@pytest.mark.parametrize("verb", VERBS, ids=[verb.name for verb in VERBS])
def test_every_help_ends_with_an_example(verb: object, capsys: pytest.CaptureFixture[str]) -> None:
    name, example = getattr(verb, "name", ""), getattr(verb, "example", "")
    assert main([name, "--help"]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert example.startswith(f"drivegain {name}")
    assert output.endswith(f"Example: {example}")


@pytest.mark.parametrize("arguments", [["no-such-verb"], ["info"], ["info", "--no-such-option", "x"], ["import", "x"]])
def test_wrong_usage_is_exit_code_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert "Usage" in output.err


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("drivegain ")


@pytest.fixture
def log(checkout: Path, tmp_path: Path) -> Path:
    """A loaded run of the demo cell."""
    events = (
        CellEvent(START_NS, None, EventKind.MOVE_START, 1, ""),
        CellEvent(START_NS, 2, EventKind.EMCY, 0x2310, "\x1b[2Jcurrent"),
    )
    return write(tmp_path / "a.mcap", demo_content(checkout, DISC), samples([[k] * 6 for k in range(500)]), events)


def test_info_json_is_one_object_and_nothing_else(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(log), "--json"]) == 0
    output = capsys.readouterr()
    assert output.err == ""
    found = json.loads(output.out)
    assert (found["role"], found["payload"]["known"]) == ("loaded", {"m": 4.59})
    assert (found["samples"], found["duration_s"], found["rate_hz"]) == (500, 0.5, 1000.0)
    assert (found["moves"], found["lost_cycles"], found["valid"]) == (1, 0, True)
    assert found["axes"] == ["J1", "J2", "J3", "J4", "J5", "J6"]
    assert [event["code"] for event in found["events"]] == [0x2310]
    assert len(found["sha256"]) == len(found["cell_sha256"]) == 64


def test_info_as_text_cannot_command_the_terminal(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(log)]) == 0
    text = capsys.readouterr().out
    assert "loaded" in text
    assert "\x1b" not in text
    assert "\\x1b[2Jcurrent" in text


def test_info_of_a_damaged_log_is_exit_code_4(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 1
    log.write_bytes(data)
    assert main(["info", str(log), "--json"]) == 4
    output = capsys.readouterr()
    assert output.out == ""
    assert "checksum" in output.err


def test_init_makes_a_cell_that_can_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "new" / "press-4"
    assert main(["init", str(folder)]) == 0
    written = {Path(line) for line in capsys.readouterr().out.splitlines()}
    assert written == {path for path in folder.rglob("*") if path.is_file()}
    cell = load_cell(folder / "cells/press-4.yaml")
    assert cell.name == "press-4"
    assert cell.bus is not None
    assert (cell.bus.interface, cell.bus.channel) == ("socketcan", "can0")
    assert cell.controller_path == folder / "controllers/press-4.yaml"
    assert cell.controller_path.is_file()
    assert load_import(folder / "imports/press-4.yaml").cell.resolve() == folder / "cells/press-4.yaml"
    assert "#" in (folder / "cells/press-4.yaml").read_text(encoding="utf-8")
    assert [path.name for path in folder.parent.iterdir()] == ["press-4"]


def test_init_overwrites_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "press-4").mkdir()
    (tmp_path / "press-4/notes.txt").write_text("mine", encoding="utf-8")
    assert main(["init", str(tmp_path / "press-4")]) == 2
    assert "something in it" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "press-4").iterdir()] == ["notes.txt"]


def test_init_into_an_empty_folder(tmp_path: Path) -> None:
    (tmp_path / "press-4").mkdir()
    assert main(["init", str(tmp_path / "press-4")]) == 0
    assert main(["init", str(tmp_path / "press-4")]) == 2
    assert main(["init", str(tmp_path / "press 4;")]) == 2
