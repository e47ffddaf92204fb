"""Messages of `drivegain record` before a recording and when it fails."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import NoReturn

import pytest

from daq.cli.app import main
from daq.config.cell_buses import load_warnings
from daq.config.cell_file import load_cell
from daq.errors import ExitCode
from daq.log.metadata import RunStatistics
from daq.workflow.record import Recorded
from drivers.errors import DriveFault, DriverError, SampleLost
from drivers.stream.answers import StreamStatistics
from tests.daq.command_line import run_verb


@pytest.fixture
def cells(tmp_path: Path, checkout: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Cell files by pacing; any plan will do."""
    monkeypatch.setattr("daq.workflow.plan.load_plan", lambda *_: None)
    monkeypatch.setattr("daq.workflow.plan.slowed", lambda *_: None)
    folder = tmp_path / "cells"
    folder.mkdir()
    text = (
        (checkout / "configs/cells/demo.yaml")
        .read_text()
        .replace("../robots", str(checkout / "configs/robots"))
    )
    for pacing in ("lockstep", "timed"):
        changed_text = text.replace("pacing: lockstep", f"pacing: {pacing}")
        (folder / f"{pacing}.yaml").write_text(changed_text)
    return {pacing: str(folder / f"{pacing}.yaml") for pacing in ("lockstep", "timed")}


def _failing(error: DriverError, part: Path | None) -> object:
    def record(*_: object, **__: object) -> NoReturn:
        if part is not None:
            part.touch()
        raise error

    return record


@pytest.mark.parametrize(
    ("valid", "code", "said"),
    [
        (True, ExitCode.OK, "complete"),
        (False, ExitCode.DATA_UNFIT, "INVALID: 2 missing answers; a fit will refuse it"),
    ],
)
def test_a_recording_with_losses_is_reported_and_is_no_success(
    cells: dict[str, str],
    valid: bool,
    code: ExitCode,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    missing = (0, 2, 0, 0, 0, 0)
    counted = RunStatistics(1000, 0, missing, valid, "" if valid else "2 missing answers")
    monkeypatch.setattr(
        "daq.workflow.record.record",
        lambda *_, **__: Recorded(tmp_path / "a.mcap", counted, StreamStatistics()),
    )
    command = [
        "record",
        cells["lockstep"],
        "plan.yaml",
        "--out",
        str(tmp_path / "a.mcap"),
        "--enable-motion",
    ]
    assert main(command) == code
    assert said in capsys.readouterr().out
    assert run_verb(*command, "--json") == code
    document = json.loads(capsys.readouterr().out)
    assert document["valid"] is valid


def test_a_bus_without_room_for_the_start_of_a_move_is_said_once_before_the_axes_move(
    cells: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    said_before: list[str] = []
    counted = RunStatistics(1000, 0, (0,) * 6, True, "")
    warnings = (*load_warnings(load_cell(Path(cells["timed"]))), "another warning")

    def recorded(*_: object, **__: object) -> Recorded:
        said_before.append(capsys.readouterr().err)
        return Recorded(tmp_path / "a.mcap", counted, StreamStatistics(), warnings)

    monkeypatch.setattr("daq.workflow.record.record", recorded)
    command = ["record", cells["timed"], "plan.yaml", "--out", str(tmp_path / "a.mcap")]
    assert main([*command, "--enable-motion", "--json"]) == ExitCode.OK
    after = capsys.readouterr().err
    (before,) = said_before
    assert "set-points and answers take 137 % of a period" in before
    assert "137 %" not in after
    assert "another warning" in after


@pytest.mark.parametrize("name", ["run.mcap", "my run.mcap"])
def test_a_failed_recording_says_what_it_left_and_the_next_one_what_is_in_its_way(
    cells: dict[str, str],
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / name
    part = tmp_path / f"{name}.part"
    command = ["record", cells["lockstep"], "plan.yaml", "--out", str(out), "--enable-motion"]
    error = DriveFault(3, "no heartbeat for 0.5 s")
    monkeypatch.setattr("daq.workflow.record.record", _failing(error, part))
    assert main(command) == ExitCode.DEVICE_FAULT
    error_output = capsys.readouterr().err
    first = " ".join(error_output.split())
    assert f"kept: the samples recorded until then are in {part}" in first
    # The second attempt does not even reach the bus.
    monkeypatch.setattr(
        "daq.workflow.record.record", lambda *_, **__: pytest.fail("the recording began")
    )
    assert main(command) == ExitCode.USAGE
    second = " ".join(capsys.readouterr().err.split())
    assert "the rest of a recording" in second
    for run in (first, second):
        expected = f"`rm {shlex.quote(str(part))}`"
        assert expected in run
        expected = f"`mv {shlex.quote(str(part))} "
        assert expected in run
        expected = f"`drivegain salvage {shlex.quote(str(part))} --out "
        assert expected in run
        assert "choose another --out" in run


def test_a_lost_sample_of_a_real_cell_does_not_name_lockstep(
    cells: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    real = Path(cells["timed"]).with_name("real.yaml")
    text = Path(cells["timed"]).read_text()
    real.write_text(text.replace("interface: virtual", "interface: socketcan"))
    error = SampleLost(7, (0,), ("J1 (node 1)",))
    monkeypatch.setattr("daq.workflow.record.record", _failing(error, None))
    code = run_verb("record", real, "plan.yaml", "--out", tmp_path / "run.mcap")
    assert code == ExitCode.DEVICE_FAULT
    error_output = capsys.readouterr().err
    output = " ".join(error_output.split())
    assert "hint: check the load of bus and computer" in output
    assert "lockstep" not in output


@pytest.mark.parametrize(
    ("pacing", "error", "hinted"),
    [
        ("timed", SampleLost(7, (0,), ("J1 (node 1)",)), True),
        ("lockstep", SampleLost(7, (0,), ("J1 (node 1)",)), False),
        ("timed", DriveFault(3, "no heartbeat for 0.5 s"), False),
    ],
)
def test_a_lost_sample_with_a_timed_pacing_names_lockstep(
    cells: dict[str, str],
    pacing: str,
    error: DriverError,
    hinted: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("daq.workflow.record.record", _failing(error, None))
    command = ["record", cells[pacing], "plan.yaml", "--out", str(tmp_path / "run.mcap")]
    assert main(command) == ExitCode.DEVICE_FAULT
    error_output = capsys.readouterr().err
    output = " ".join(error_output.split())
    assert ("hint:" in output) is hinted
    assert ("`sync.pacing: lockstep`" in output) is hinted
    assert "kept:" not in output


@pytest.mark.parametrize("name", ["A\nB", "A\udcff", "A\x1b[31m", "A\u202e"])
@pytest.mark.parametrize(
    ("verb", "option"),
    [
        (("record", "plan.yaml", "--out", "a.mcap", "--enable-motion"), "--operator"),
        (("calibrate",), "--by"),
    ],
    ids=["record", "calibrate"],
)
def test_an_operator_whose_name_cannot_be_shown_is_refused_before_anything_moves(
    checkout: Path,
    tmp_path: Path,
    verb: tuple[str, ...],
    option: str,
    name: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`apply` refused it; here it would have gone into the log."""
    monkeypatch.chdir(tmp_path)
    cell = checkout / "configs" / "cells" / "demo.yaml"
    first, *rest = verb
    assert run_verb(first, cell, *rest, option, name) == ExitCode.USAGE
    said = capsys.readouterr().err
    assert f"{option} {name!a}" in said
    assert "characters that cannot be shown" in said
    assert list(tmp_path.iterdir()) == []
