"""A scenario in the simulation file, through the command line:
exit code, log, and what is left on the axes.
"""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path

import can
import pytest

from daq.cli.app import main
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.errors import ConfigurationInconsistent, ConfigurationMissing, ExitCode, SchemaMismatch
from daq.log.feed import LARGEST_PACKET, Feed, ProgramEnd, connected, read_packet
from daq.log.reader import read_log
from daq.simulation.simulation_file import load_scenario, load_simulation, shipped_simulation
from drivers.canopen.bus import open_bus
from drivers.messages import EventKind
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.drive import PowerState
from drivers.simulation.faults import FaultKind, FaultSpec
from drivers.simulation.hub import Hub
from drivers.simulation.spec import CellSpec, SdoAbort, SpecInvalid
from tests.daq.console.feeds import arrivals
from tests.faults.cells import CONFIGS

# The wrist's motors are coupled: with opposite angles of J5 and J6, motor 6 would stand still, and
# a fault of its data in motion could not be seen.
PLAN = """format: drivegain-plan
cell: demo
seed: 1
condition: 100.0
moves:
  - {target_deg: [20, -20, 70, 20, -20, -20], velocity: 0.5, acceleration: 0.5, dwell_s: 0.01}
  - {target_deg: [0, 0, 90, 0, 0, 0], velocity: 0.5, acceleration: 0.5, dwell_s: 0.01}
"""


CELL_FILE = CONFIGS / "cells" / "demo.yaml"


def scenario(folder: Path, faults: str) -> Path:
    """A simulation file of the demo cell with these faults."""
    clean = CONFIGS / "simulation" / "clean.yaml"
    text = clean.read_text(encoding="utf-8")
    text = text.replace("urdf: ", f"urdf: {CONFIGS}/simulation/")
    path = folder / "scenario.yaml"
    path.write_text(f"{text}faults:\n{faults}", encoding="utf-8")
    return path


def faulty_cell(folder: Path, faults: str) -> CellSpec:
    """The demo cell with these faults."""
    path = scenario(folder, faults)
    return load_simulation(path)


@contextmanager
def simulated(spec: CellSpec) -> Iterator[SimulatedCell]:
    """Run a cell on the bus of the demo cell."""
    address = bus_address(load_cell(CELL_FILE))
    with open_bus(address) as bus, SimulatedCell(spec, bus) as cell:
        yield cell


def record_command(folder: Path) -> list[str]:
    """Write a plan; return the arguments that record it to `a.mcap`, without leave to move."""
    plan = folder / "plan.yaml"
    plan.write_text(PLAN, encoding="utf-8")
    out = folder / "a.mcap"
    return [
        "record",
        str(CELL_FILE),
        str(plan),
        "--out",
        str(out),
    ]


@pytest.mark.slow
def test_a_fault_of_a_scenario_ends_a_recording_with_exit_code_5_and_is_in_its_log(
    tmp_path: Path,
) -> None:
    fault = "  - {fault: emergency, axis: J3, at_s: 0.2, emcy_code: 0x2310}\n"
    spec = faulty_cell(tmp_path, fault)
    command = record_command(tmp_path)

    with simulated(spec) as cell:
        code = main([*command, "--enable-motion", "--operator", "test"])
        drives = [node.drive for node in cell.nodes]
        in_fault = [drive for drive in drives if drive.state == PowerState.FAULT]
        powered = [drive for drive in drives if drive.powered]

    assert code == ExitCode.DEVICE_FAULT
    assert len(in_fault) <= 1
    assert powered == []
    out = tmp_path / "a.mcap"
    assert not out.exists()
    part = tmp_path / "a.mcap.part"
    saved = tmp_path / "saved.mcap"
    salvage = ["salvage", str(part), "--out", str(saved)]
    assert main(salvage) == ExitCode.OK
    events = read_log(saved).events
    emcy_and_stop = [one for one in events if one.kind in (EventKind.EMCY, EventKind.STOP)]
    first = emcy_and_stop[0]
    assert first.kind == EventKind.EMCY
    assert first.axis == 2
    assert first.code == 0x2310
    kinds = {event.kind for event in emcy_and_stop}
    assert EventKind.STOP in kinds


class WatchedFeed(Feed):
    """A feed with a console from its first moment on."""

    console: socket.socket

    def __enter__(self) -> WatchedFeed:
        came = arrivals(self)
        super().__enter__()
        console = connected(self._names.feed, socket.SOCK_SEQPACKET, 10.0)
        assert console is not None
        assert came.wait(10)
        WatchedFeed.console = console
        return self


def end_at_the_console() -> ProgramEnd:
    """The end that the console of the last `WatchedFeed` received."""
    with WatchedFeed.console as console:
        while True:
            message = read_packet(console.recv(LARGEST_PACKET), None).message
            if message is not None and message.end is not None:
                return message.end


def setup_failure(capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    """The error that a refused set-up printed last, as a JSON document."""
    lines = capsys.readouterr().err.splitlines()
    failure: dict[str, str] = json.loads(lines[-1])
    assert failure["kind"] == "SetupRefused"
    return failure


def check_console_and_folder(failure: dict[str, str], folder: Path) -> None:
    """Check that a console received the error, and that the recording left no file."""
    text = f"{failure['found']}; expected {failure['expected']}; {failure['do']}"
    assert end_at_the_console() == ProgramEnd(ok=False, axes_stopped=True, text=text)
    logs = list(folder.glob("*.mcap*"))
    assert logs == []


def test_a_drive_that_refuses_its_mapping_ends_a_recording_with_its_error_and_consoles_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An SDO abort of the library is behind that error,
    and cannot be compared with other errors.
    """
    monkeypatch.setattr("daq.log.feed.Feed", WatchedFeed)
    spec = faulty_cell(tmp_path, "  - {fault: refuses-mapping, axis: J2}\n")
    command = record_command(tmp_path)

    with simulated(spec) as cell:
        code = main([*command, "--enable-motion", "--json"])
        states = {node.drive.state for node in cell.nodes}

    assert code == ExitCode.DEVICE_FAULT
    assert states == {PowerState.SWITCH_ON_DISABLED}
    failure = setup_failure(capsys)
    assert failure["found"].startswith(
        "J2 (node 2): TPDO1: writing 0x0 to 1A00h:00: aborted, Code 0x06010002"
    )
    assert failure["expected"] == "a PDO that can be mapped for the recording"
    assert "switch the drive off and on" in failure["do"]
    check_console_and_folder(failure, tmp_path)


def refuse(
    monkeypatch: pytest.MonkeyPatch, cell: SimulatedCell, action: str, index: int, sub: int
) -> None:
    """Let J2 abort each reading or writing of an object."""
    server = cell.nodes[1]._sdo
    sound = getattr(server, action)

    def aborting(read_index: int, read_sub: int, *value: bytes) -> object:
        if (read_index, read_sub) == (index, sub):
            raise SdoAbort(0x08000022)
        return sound(read_index, read_sub, *value)

    monkeypatch.setattr(server, action, aborting)


REFUSED_OBJECTS = [
    ("_read", 0x1018, 1, "identity"),
    ("_read", 0x1017, 0, "heartbeats of 100 ms"),
    ("_write", 0x1017, 0, "heartbeats of 100 ms"),
    ("_read", 0x1800, 1, "parameters of TPDO1"),
    ("_read", 0x1A00, 0, "mapping of TPDO1"),
    ("_read", 0x1400, 2, "parameters of RPDO1"),
    ("_write", 0x1800, 1, "a PDO that can be mapped"),
    ("_write", 0x1A00, 1, "a PDO that can be mapped"),
    ("_write", 0x1400, 1, "a PDO that can be mapped"),
    ("_write", 0x1600, 0, "a PDO that can be mapped"),
    ("_read", 0x6041, 0, "statusword"),
    ("_read", 0x6060, 0, "profile position mode (1)"),
    ("_write", 0x6060, 0, "profile position mode (1)"),
    ("_read", 0x6061, 0, "profile position mode (1)"),
    ("_read", 0x6075, 0, "scale of the current"),
]
"""Objects of each step of the set-up, and what the message says of them;
tests/drivers has every object.
"""


@pytest.mark.parametrize(
    ("action", "index", "sub", "said"),
    REFUSED_OBJECTS,
    ids=lambda part: f"{part:04X}" if isinstance(part, int) else part,
)
def test_an_abort_at_each_step_of_the_setup_is_exit_5_with_its_reason_and_consoles_get_it(
    action: str,
    index: int,
    sub: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("daq.log.feed.Feed", WatchedFeed)
    command = record_command(tmp_path)
    spec = load_simulation(shipped_simulation("clean"))

    with simulated(spec) as cell:
        refuse(monkeypatch, cell, action, index, sub)
        code = main([*command, "--enable-motion", "--json"])
        states = {node.drive.state for node in cell.nodes}

    assert code == ExitCode.DEVICE_FAULT
    assert states == {PowerState.SWITCH_ON_DISABLED}
    failure = setup_failure(capsys)
    assert failure["found"].startswith("J2 (node 2): ")
    assert f"{index:04X}h:{sub:02X}" in failure["found"]
    assert said in failure["found"] + failure["expected"]
    assert failure["do"]
    check_console_and_folder(failure, tmp_path)


def test_without_leave_nothing_is_sent_to_the_cell(tmp_path: Path) -> None:
    command = record_command(tmp_path)
    assert main(command) == ExitCode.USAGE


def test_times_of_a_scenario_become_syncs(tmp_path: Path) -> None:
    faults = (
        "  - {fault: silent}\n"
        "  - {fault: lost, axis: 2, at_s: 1.5, for_s: 0.002}\n"
        "  - {fault: emergency, axis: J3, at_cycle: 7, emcy_code: 0x2310}\n"
    )
    spec = faulty_cell(tmp_path, faults)
    silent, lost, emergency = spec.faults
    assert silent == FaultSpec(FaultKind.SILENT)
    assert lost == FaultSpec(
        FaultKind.LOST,
        axis=1,
        at_cycle=1500,
        cycles=2,
    )
    assert emergency == FaultSpec(
        FaultKind.EMERGENCY,
        axis=2,
        at_cycle=7,
        cycles=None,
        value=0x2310,
    )


@pytest.mark.parametrize(
    "fault",
    [
        "{fault: explodes}",
        "{fault: lost, at_s: 1, at_cycle: 1}",
        "{fault: lost, for_s: 1, cycles: 1}",
        "{fault: emergency, axis: J3}",
        "{fault: lost, emcy_code: 0x2310}",
    ],
)
def test_a_scenario_that_means_nothing_is_refused(tmp_path: Path, fault: str) -> None:
    path = scenario(tmp_path, f"  - {fault}\n")
    with pytest.raises(SchemaMismatch):
        load_simulation(path)


def test_a_scenario_for_an_axis_that_the_cell_lacks_is_refused(tmp_path: Path) -> None:
    path = scenario(tmp_path, "  - {fault: lost, axis: J7}\n")
    with pytest.raises(ConfigurationInconsistent, match="J7"):
        load_simulation(path)


# -- a scenario file of faults alone
# -----------------------------------------------------------------------------------


def test_the_faults_of_a_scenario_file_come_on_top_of_those_of_the_simulation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    built: list[CellSpec] = []

    class Cell:
        def __init__(self, spec: CellSpec, _bus: can.BusABC, **_: object) -> None:
            built.append(spec)

        def serve_forever(self) -> None:
            raise KeyboardInterrupt

    monkeypatch.setattr("drivers.simulation.cell.SimulatedCell", Cell)
    faults = tmp_path / "faults.yaml"
    faults.write_text(
        "faults:\n  - {fault: limit, axis: J2, at_s: 1.5}\n  - {fault: silent}\n", encoding="utf-8"
    )
    simulation = scenario(tmp_path, "  - {fault: lost, axis: 2, at_cycle: 7}\n")
    arguments = [
        "simulate",
        str(simulation),
        "--interface",
        "virtual",
        "--channel",
        "scenario",
        "--faults",
    ]
    assert main([*arguments, str(faults)]) == ExitCode.OK
    own = FaultSpec(
        FaultKind.LOST,
        axis=1,
        at_cycle=7,
    )
    limit = FaultSpec(
        FaultKind.LIMIT,
        axis=1,
        at_cycle=1500,
    )
    silent = FaultSpec(FaultKind.SILENT)
    assert built[0].faults == (own, limit, silent)
    assert "3 faults" in capsys.readouterr().out

    assert main([*arguments, "faults-example"]) == ExitCode.OK
    example = load_scenario(shipped_simulation("faults-example"), 6, 1000)
    assert built[1].faults == (own, *example)


def test_the_example_names_every_kind_of_fault() -> None:
    path = shipped_simulation("faults-example")
    text = path.read_text(encoding="utf-8")
    pairs = re.findall(r"^#   ?([a-z-]+)  |  ([a-z-]+)  ", text, re.MULTILINE)
    words = set(chain.from_iterable(pairs))
    kinds = {kind.value for kind in FaultKind}
    assert kinds <= words
    lost, emergency = load_scenario(path, 6, 1000)
    assert lost == FaultSpec(
        FaultKind.LOST,
        axis=1,
        at_cycle=1500,
        cycles=1,
    )
    assert emergency == FaultSpec(
        FaultKind.EMERGENCY,
        axis=2,
        at_cycle=4000,
        cycles=None,
        value=0x7305,
    )


@pytest.mark.parametrize(
    ("text", "error", "found"),
    [
        (
            "faults:\n  - {fault: lost, axis: J7}\n",
            ConfigurationInconsistent,
            r"faults.yaml:2: faults\[0\].axis.*J1 to J6",
        ),
        ("faults:\n  - {fault: explodes}\n", SchemaMismatch, r"faults.yaml:2: faults\[0\].fault"),
        ("faults:\n  - {fault: lost, axsi: J2}\n", SchemaMismatch, "axsi"),
        ("faults: []\n", SchemaMismatch, "faults"),
        ("- {fault: lost}\n", SchemaMismatch, "faults.yaml"),
        ("seed: 1\nfaults:\n  - {fault: lost}\n", SchemaMismatch, "seed"),
        (None, ConfigurationMissing, "faults.yaml"),
    ],
)
def test_a_wrong_scenario_file_is_refused_with_its_line(
    tmp_path: Path, text: str | None, error: type[Exception], found: str
) -> None:
    path = tmp_path / "faults.yaml"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(error, match=found):
        load_scenario(path, 6, 1000)


def test_the_help_of_simulate_shows_how_to_give_a_scenario(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["simulate", "--help"]) == ExitCode.OK
    printed = capsys.readouterr().out
    assert "drivegain simulate demo --payload disc --faults faults-example" in printed


@pytest.mark.parametrize(
    "times",
    [
        "at_s: 1e308",
        "at_s: 1, for_s: 1e300",
        "at_cycle: 18446744073709551615",
        "at_s: 0, cycles: 1000000000001",
    ],
)
def test_a_time_that_no_cell_lives_to_see_is_reported(times: str, tmp_path: Path) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text(f"faults:\n  - {{fault: silent, axis: J1, {times}}}\n", encoding="utf-8")
    with pytest.raises(SchemaMismatch, match="less than or equal to"):
        load_scenario(path, 6, 1000)


@pytest.mark.parametrize("kind", [FaultKind.BUS_OFF, FaultKind.ERROR_PASSIVE])
def test_a_fault_that_the_hub_cannot_carry_is_reported_before_anything_moves(
    kind: FaultKind,
) -> None:
    clean = load_simulation(shipped_simulation("clean"))
    fault = FaultSpec(kind, at_cycle=5)
    spec = replace(clean, faults=(fault,))
    with (
        Hub(("can0",)) as hub,
        open_bus(hub.address()) as bus,
        pytest.raises(SpecInvalid, match=kind.value),
    ):
        SimulatedCell(spec, bus)
