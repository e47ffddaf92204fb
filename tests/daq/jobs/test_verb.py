"""`drivegain recalibrate` as a timer calls it: exit codes, standard output, standard error."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.cli.simulate import MountedFile
from daq.errors import ExitCode, UsageError
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.spec import CellSpec
from tests.daq.command_line import run_verb
from tests.daq.jobs.rig import make_rig, serving
from tests.drivers.scripted import FakeClock, ScriptedBus


def test_a_dry_run_says_what_a_job_would_do(
    tmp_path: Path, short_plan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, short_plan)
    command = ["recalibrate", "--cell", str(rig.cell_file), "--dry-run"]
    with serving(rig):
        assert run_verb(*command, "--json") == ExitCode.OK
        captured = capsys.readouterr()
        steps = json.loads(captured.out)["steps"]
        assert steps[0] == "mount none, record bare-1"
        lines = captured.err.splitlines()
        levels = [json.loads(line)["level"] for line in lines]
        assert levels == ["info", "info"]
        assert main(command) == ExitCode.OK
    assert "a new session" in capsys.readouterr().out
    assert not (rig.cells / "recalibration").exists()


def test_a_job_that_is_held_says_so_in_its_exit_code_and_in_json_alone(
    tmp_path: Path, short_plan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, short_plan)
    rig.closed.unlink()
    assert run_verb("recalibrate", "--cell", rig.cell_file) == ExitCode.NOT_RELEASED
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    events = [json.loads(line) for line in lines]
    last_event = events[-1]
    assert last_event["error"] == "NotReleased"
    level = events[-1]["level"]
    assert level == "error"
    assert captured.out == ""
    assert run_verb("recalibrate", "--cell", rig.cell_file, "--json") == ExitCode.NOT_RELEASED
    assert rig.session.state.attempt == 2


def test_a_person_at_a_terminal_reads_what_to_do(
    tmp_path: Path,
    short_plan: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, short_plan)
    rig.closed.unlink()
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert run_verb("recalibrate", "--cell", rig.cell_file) == ExitCode.NOT_RELEASED
    output = capsys.readouterr().err
    assert "session ended: outcome stopped" in output
    assert " ".join(output.split()).count("close the cell") == 1
    assert "exit_code" not in output


def test_a_cell_without_the_section_names_what_it_lacks(
    tmp_path: Path, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells_folder = checkout / "configs" / "cells"
    cell = cells_folder / "demo.yaml"
    for verb in ("recalibrate", "schedule", "install-units"):
        assert run_verb(verb, "--cell", cell) == ExitCode.CONFIGURATION
        assert "recalibration" in capsys.readouterr().err


def masses(cell: SimulatedCell) -> float:
    inertias = cell.plant._model.inertias
    return float(sum(inertia.mass for inertia in inertias))


def test_the_simulated_payload_changes_with_the_file_but_never_under_power(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    file = tmp_path / "mounted"
    complaints: list[UsageError] = []

    def load(name: str | None) -> CellSpec:
        return load_simulation(shipped_simulation("demo"), name)

    mounted = MountedFile(file, load, complaints.append)
    bus = ScriptedBus((), FakeClock())
    request.addfinalizer(bus.shutdown)
    cell = SimulatedCell(mounted.at_power_on(), bus, mounted=mounted)
    bare = masses(cell)

    def frame() -> float:
        cell._next_frame()
        return masses(cell)

    assert frame() == bare
    file.write_text("disc\n")
    assert frame() == pytest.approx(bare + 4.59)
    state = cell.nodes[2].drive.state
    cell.nodes[2].drive.state = state.OPERATION_ENABLED
    file.write_text("none\n")
    assert frame() == pytest.approx(bare + 4.59)
    cell.nodes[2].drive.reset()
    assert frame() == bare
    # While it is being written, and with an unknown name: it stays as it was.
    file.write_text("plate\n")
    frame()
    for text in ("", "anvil\n"):
        file.write_text(text)
        assert frame() == pytest.approx(bare + 1.686)
    assert [error.found for error in complaints] == ["no such body in the simulation"]
    file.unlink()
    assert frame() == bare
