"""The verbs against `drivegain simulate` in a process of its own, over the hub on 127.0.0.1."""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.cli.terminal import SIGNALS
from daq.errors import ExitCode
from tests.pipeline.simulated_bus import served_cell

pytestmark = pytest.mark.processes


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory, checkout: Path) -> Iterator[Path]:
    """A cell file whose bus is the simulated cell's hub."""
    with served_cell(tmp_path_factory.mktemp("cell"), checkout) as cell_file:
        yield cell_file


@pytest.fixture(scope="module")
def long_plan(cell: Path) -> Path:
    """A plan for that cell."""
    plan = cell.with_name("plan.yaml")
    assert (
        main(["plan", str(cell), "--out", str(plan), "--duration", "20", "--exchanges", "0"])
        == ExitCode.OK
    )
    return plan


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_simulated_cell_in_the_background_of_a_script_can_be_ended(
    checkout: Path, number: signal.Signals
) -> None:
    """A program that a script starts with & ignores SIGINT from its birth on."""
    command = f"trap '' INT; exec {shlex.quote(sys.executable)} -m daq simulate clean --port 0"
    with subprocess.Popen(
        ["sh", "-c", command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=checkout,
    ) as process:
        assert process.stdout is not None
        assert "6 amplifiers" in process.stdout.readline()
        process.send_signal(number)
        _, err = process.communicate(timeout=20)
    assert (process.returncode, err) == (ExitCode.OK, "")


def test_scan_finds_six_amplifiers(cell: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scan", str(cell), "--json"]) == ExitCode.OK
    nodes = json.loads(capsys.readouterr().out)["nodes"]
    assert [
        (node["node_id"], node["axis"], node["verdict"], node["enabled"]) for node in nodes
    ] == [(number, f"J{number}", "ok", False) for number in range(1, 7)]


def test_plan_record_info_and_the_same_plan_again(
    cell: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.yaml"
    log = tmp_path / "bare.mcap"
    assert (
        main(["plan", str(cell), "--out", str(plan), "--duration", "8", "--exchanges", "10"])
        == ExitCode.OK
    )
    first = plan.read_bytes()
    assert (
        main(["plan", str(cell), "--out", str(plan), "--duration", "8", "--exchanges", "10"])
        == ExitCode.OK
    )
    assert plan.read_bytes() == first
    capsys.readouterr()
    assert (
        main(["record", str(cell), str(plan), "--out", str(log), "--enable-motion", "--json"])
        == ExitCode.OK
    )
    recorded = json.loads(capsys.readouterr().out)
    assert recorded["valid"]
    assert recorded["lost_cycles"] == 0
    assert recorded["missing"] == [0] * 6
    assert not list(tmp_path.glob("*.part"))
    assert main(["info", str(log), "--json"]) == ExitCode.OK
    assert (
        main(["record", str(cell), str(plan), "--out", str(log), "--enable-motion"])
        == ExitCode.USAGE
    )
    assert "file of that name" in capsys.readouterr().err


@pytest.mark.parametrize("number", SIGNALS)
def test_an_interrupted_recording_stops_the_axes_and_says_so(
    cell: Path,
    long_plan: Path,
    tmp_path: Path,
    checkout: Path,
    capsys: pytest.CaptureFixture[str],
    number: signal.Signals,
) -> None:
    log = tmp_path / "bare.mcap"
    part = tmp_path / "bare.mcap.part"
    command = [
        sys.executable,
        "-m",
        "daq",
        "record",
        str(cell),
        str(long_plan),
        "--out",
        str(log),
        "--enable-motion",
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=checkout
    ) as process:
        for _ in range(1200):
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=0.05)
            begun = part.stat().st_size if part.exists() else 0
            if begun > 60_000 or process.returncode is not None:
                break
        process.send_signal(number)
        process.send_signal(signal.SIGTERM)  # a second one does not cut the stop short
        out, err = process.communicate(timeout=60)
    assert process.returncode == ExitCode.INTERRUPTED, err
    assert out == ""
    assert "Traceback" not in err
    output = (
        f"interrupted: axes stopped; the samples recorded so far are in {part}, which `fit` "
        "does not read"
    )
    assert [line for line in err.splitlines() if line.startswith(output)]
    assert (
        main(["record", str(cell), str(long_plan), "--out", str(log), "--enable-motion"])
        == ExitCode.USAGE
    )
    output = " ".join(capsys.readouterr().err.split())
    assert "the rest of a recording" in output
    assert f"`rm {part}`" in output
    assert "another --out" in output
    assert list(tmp_path.iterdir()) == [part]
    capsys.readouterr()
    assert main(["scan", str(cell), "--json"]) == ExitCode.OK
    assert {node["state"] for node in json.loads(capsys.readouterr().out)["nodes"]} == {
        "SWITCH ON DISABLED"
    }
    assert main(["fit", str(part)]) == ExitCode.DATA_UNFIT


def test_nothing_moves_and_nothing_is_written_without_permission(
    cell: Path, long_plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["record", str(cell), str(long_plan), "--out", str(tmp_path / "bare.mcap")])
        == ExitCode.USAGE
    )
    assert "--enable-motion" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_missing_node_is_named_and_leaves_no_log(
    cell: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = cell.with_name("other.yaml")
    other.write_text(cell.read_text().replace("node_id: 6", "node_id: 66"))
    plan = tmp_path / "plan.yaml"
    log = tmp_path / "bare.mcap"
    assert (
        main(["plan", str(other), "--out", str(plan), "--duration", "8", "--exchanges", "0"])
        == ExitCode.OK
    )
    code = main(["record", str(other), str(plan), "--out", str(log), "--enable-motion"])
    assert code == ExitCode.DEVICE_FAULT
    assert "node 66" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [plan]
    assert main(["scan", str(other)]) == ExitCode.DEVICE_FAULT


def test_another_amplifier_than_configured_is_refused(
    cell: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = cell.with_name("exchanged.yaml")
    other.write_text(cell.read_text().replace("serial: 1003", "serial: 9999"))
    plan = tmp_path / "plan.yaml"
    log = tmp_path / "bare.mcap"
    assert (
        main(["plan", str(other), "--out", str(plan), "--duration", "8", "--exchanges", "0"])
        == ExitCode.OK
    )
    code = main(["record", str(other), str(plan), "--out", str(log), "--enable-motion"])
    assert code == ExitCode.DEVICE_FAULT
    said = capsys.readouterr().err
    # Both numbers as the cell file and `scan` write them.
    assert "9999" in said
    assert "1003" in said
    assert list(tmp_path.iterdir()) == [plan]
