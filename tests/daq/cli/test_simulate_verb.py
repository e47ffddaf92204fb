"""`drivegain simulate`: its buses, and the settings that it prints for a cell file."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import can
import pytest
import yaml

import daq.simulation.simulation_file
from daq.cli.app import main
from daq.cli.simulate import MountedFile, how_to_reach, nodes_on_buses, port_of_hub
from daq.config.cell_file import load_cell
from daq.errors import ExitCode, UsageError
from daq.workflow.bus_lock import bus_lock, require_untaken
from drivers.canopen.bus import BusAddress
from drivers.canopen.split_bus import BusPart
from drivers.simulation.spec import CellSpec
from tests.daq.command_line import run_verb
from tests.drivers.raw_client import raw_client_at
from tests.drivers.simulation.cells import clean_cell
from tests.pipeline.simulated_bus import served_cell

FLOOD = b"< send 123 8 01 02 03 04 05 06 07 08 >" * 1000
FLOOD_BYTES = 20_000_000
RECOVERY_S = 60.0  #: The simulated drives work off what has come


def test_each_bus_has_its_nodes() -> None:
    node_ids = (1, 2, 3, 4, 5)
    there = nodes_on_buses(("can0=1,2,3", "can1=4,5"), node_ids)
    expected = {"can0": frozenset((1, 2, 3)), "can1": frozenset((4, 5))}
    assert there == expected


@pytest.mark.parametrize(
    ("said", "message"),
    [
        (("can0=1,2", "can1=3"), "node 1, 2, 3; expected: each node of the cell once: 1, 2, 3, 4"),
        (("can0=1,2", "can1=2,3,4"), "node 1, 2, 2, 3, 4"),
        (("can0=1,2", "can1=3,4,9"), "node 1, 2, 3, 4, 9"),
        (("can0=1,2", "can0=3,4"), "--bus can0=3,4"),
        (("can0=1,2", "can1"), "--bus can1"),
        (("can0=1,2", "=3,4"), "--bus =3,4"),
        (("can0=1,2", "can1=3,x"), "--bus can1=3,x"),
        (("can0=1,2", "can1=3,,4"), "--bus can1=3,,4"),
        (("can0=1,2", "can1=3-4"), "--bus can1=3-4"),
    ],
)
def test_what_is_said_wrongly_of_a_bus_is_refused(said: tuple[str, ...], message: str) -> None:
    node_ids = (1, 2, 3, 4)
    with pytest.raises(UsageError) as caught:
        nodes_on_buses(said, node_ids)
    assert message in (
        f"{caught.value.subject} {caught.value.found}; expected: {caught.value.expected}"
    )


def test_a_port_is_of_a_hub_alone() -> None:
    assert port_of_hub("socketcand", None) == 29536
    assert port_of_hub("socketcand", 0) == 0
    assert port_of_hub("socketcan", None) is None
    with pytest.raises(UsageError, match="the interface socketcan, which has no hub"):
        port_of_hub("socketcan", 29537)


def test_the_part_of_a_cell_file_can_be_pasted() -> None:
    nodes = frozenset((1, 2)), frozenset((3,))
    hub = tuple(
        BusPart(name, BusAddress("socketcand", name, port=4000), some)
        for name, some in zip(("can0", "can1"), nodes, strict=True)
    )
    _, pasted, axes, _ = how_to_reach(hub, 2000).split("\n\n")
    keys = {
        "interface": "socketcand",
        "host": "127.0.0.1",
        "port": 4000,
        "bitrate_bit_s": 1_000_000,
    }
    assert yaml.safe_load(pasted) == {
        "bus": [{"name": name, "channel": name, **keys} for name in ("can0", "can1")],
        "sync": {"period_us": 2000, "pacing": "lockstep"},
    }
    assert axes.splitlines() == [
        "axes with node_id 1, 2: add bus: can0",
        "axes with node_id 3: add bus: can1",
    ]
    address = BusAddress("socketcan", "can0")
    one = BusPart("can0", address, frozenset())
    _, pasted, _ = how_to_reach((one,), 1000).split("\n\n")
    assert yaml.safe_load(pasted) == {
        "bus": {"interface": "socketcan", "channel": "can0", "bitrate_bit_s": 1_000_000},
        "sync": {"period_us": 1000, "pacing": "timed"},
    }


@pytest.mark.slow
def test_a_mechanism_that_does_not_close_is_refused_with_its_file(
    checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = checkout / "configs/simulation"
    content = (folder / "five-bar-plant.urdf").read_bytes()
    (tmp_path / "five-bar-plant.urdf").write_bytes(content)
    text = (
        (folder / "five-bar.yaml")
        .read_text(encoding="utf-8")
        .replace("directions: [x, y]", "directions: [x, y, rz]")
    )
    (tmp_path / "five-bar.yaml").write_text(text, encoding="utf-8")
    assert main(["simulate", str(tmp_path / "five-bar.yaml"), "--interface", "virtual"]) == 6
    said = capsys.readouterr().err
    assert "five-bar.yaml" in said
    assert "tip stays open" in said


def test_a_bus_that_fails_is_an_error_with_a_remedy(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Cell:
        def __init__(self, *_: object, **__: object) -> None:
            pass

        def serve_forever(self) -> None:
            raise can.CanOperationError("the server closed the connection")

    monkeypatch.setattr("drivers.simulation.cell.SimulatedCell", Cell)
    assert (
        main(["simulate", "clean", "--interface", "virtual", "--channel", "failing"])
        == ExitCode.DEVICE_FAULT
    )
    said = capsys.readouterr().err
    assert "virtual:failing" in said
    assert "the server closed the connection" in said


@pytest.mark.slow
def test_a_flood_of_one_client_ends_neither_the_simulated_cell_nor_its_answers(
    checkout: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """20 MB from one client ended `simulate` with exit code 5; `served_cell` expects 0."""
    with served_cell(tmp_path, checkout) as cell:
        port = load_cell(cell).buses[0].port
        with raw_client_at(port) as hostile:
            for _ in range(FLOOD_BYTES // len(FLOOD)):
                hostile.sendall(FLOOD)
        # `served_cell` has read what the simulated cell prints before
        assert capfd.readouterr().err.count("\n") <= 1
        end_s = time.monotonic() + RECOVERY_S
        verdicts: set[str] = set()
        while verdicts != {"ok"} and time.monotonic() < end_s:
            code = run_verb("scan", cell, "--json")
            said = capfd.readouterr()
            assert "two devices" not in said.out
            if code == ExitCode.OK:
                nodes = json.loads(said.out)["nodes"]
                verdicts = {node["verdict"] for node in nodes}
        assert verdicts == {"ok"}
    assert capfd.readouterr().err == ""


def test_a_pipe_names_no_body(tmp_path: Path) -> None:
    """Reading it would hold up the simulated cell until something is written to it."""
    os.mkfifo(tmp_path / "body")
    named: list[str | None] = []

    def load(name: str | None) -> CellSpec:
        named.append(name)
        return clean_cell()

    path = tmp_path / "body"
    mounted_file = MountedFile(path, load, lambda error: pytest.fail(str(error)))
    mounted_file.at_power_on()
    assert named == [None]


@pytest.mark.parametrize("verb", [["simulate", "demo"], ["demo", "--out", "made"]])
@pytest.mark.parametrize("package", ["numba", "pinocchio"])
def test_without_its_packages_the_extra_is_named(
    verb: list[str],
    package: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        daq.simulation.simulation_file,
        "find_spec",
        lambda name: None if name == package else object(),
    )
    assert main(verb) == 6
    said = capsys.readouterr().err
    assert f"no package {package}" in said
    assert "pip install 'drivegain[simulation]'" in said
    assert not (tmp_path / "made").exists()


@pytest.mark.slow
def test_every_verb_can_be_imported_without_the_simulated_cell() -> None:
    """Their help and what they do to a real cell need no package of the extra."""
    code = (
        "import sys\n"
        "sys.modules.update(dict.fromkeys(('numba', 'pinocchio', 'llvmlite'), None))\n"
        "import ident.planning.clearance, ident.planning.excitation, ident.physical.physical\n"
        "from daq.cli.app import VERBS\n"
        "print(len([verb.function() for verb in VERBS]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 20


def test_no_amplifiers_join_a_bus_on_which_a_recorder_moves_others(
    checkout: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("daq.workflow.bus_lock.SHARED_FOLDERS", (tmp_path,))
    tmp_path.chmod(0o1777)
    monkeypatch.setattr(
        "drivers.canopen.bus.open_bus", lambda *_, **__: pytest.fail("the bus was opened")
    )
    cell = load_cell(checkout / "configs/cells/demo.yaml")
    changed_buses = replace(cell.buses[0], interface="socketcan", channel="vcan9")
    buses = (changed_buses,)
    there = replace(cell, buses=buses)
    with bus_lock(there):
        command = ["simulate", "clean", "--interface", "socketcan", "--channel", "vcan9"]
        assert main(command) == ExitCode.BUS_TAKEN
    said = capsys.readouterr().err
    assert "bus socketcan:vcan9" in said
    assert "they would answer in the middle of its motion" in said
    require_untaken(there.buses, tmp_path)
