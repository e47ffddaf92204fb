"""`drivegain scan`: the table of the nodes."""

from __future__ import annotations

import io
import json
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from daq.cli import main
from daq.cli.scan import no_answer
from daq.config.cell import Cell
from daq.config.cell_buses import bus_address, drive_axes
from daq.config.cell_file import bundle, cell_from_bundle
from daq.errors import ExitCode
from daq.log.reader import read_log
from daq.report.bus_views import (
    NO_ANSWER,
    NO_IDENTITY,
    OTHER_DRIVE,
    STOPPED,
    ScannedNode,
    scan_report,
    scan_table,
    scan_view,
    scanned_nodes,
)
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from daq.workflow.bus_lock import bus_lock
from drivers.canopen.bus import open_bus
from drivers.canopen.link import BEATS_KEPT, Link, NmtState
from drivers.canopen.node_scan import FoundNode
from drivers.canopen.sdo import SdoPolicy
from drivers.messages import EventKind
from drivers.profiles.profile import Identity
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.drive import ErrorCode, PowerState
from drivers.simulation.spec import CellSpec, SdoAbort
from ident.model.model import DriveTrain
from tests.daq.command_line import run_verb
from tests.faults.test_scenario import PLAN
from tests.two_buses import on_two_buses

STOP_NODE = 2  #: Command of NMT (CiA 301)


def _node(node_id: int, statusword: int | None, serial: int | None = None) -> FoundNode:
    if serial is None:
        serial = 1000 + node_id
    identity = Identity(0x29A, 0x40200, serial)
    return FoundNode(node_id, identity, 1, "drive", 0x7F, statusword)


def _nodes(node_ids: Iterable[int], statusword: int) -> tuple[FoundNode, ...]:
    return tuple(_node(node_id, statusword) for node_id in node_ids)


def _first_row(cell: Cell, node: FoundNode) -> ScannedNode:
    """The row of the first axis, where only this node answers."""
    rows = scanned_nodes(cell, (node,), "demo")
    return rows[0]


def _clean_simulation() -> CellSpec:
    return load_simulation(shipped_simulation("clean"))


@contextmanager
def _simulated(cell: Cell) -> Iterator[SimulatedCell]:
    """The cell on its bus, without a fault."""
    with open_bus(bus_address(cell)) as bus, SimulatedCell(_clean_simulation(), bus) as simulated:
        yield simulated


def _copied_cell_file(checkout: Path, folder: Path) -> Path:
    """The file of the demo cell, with all configurations in a folder of the test."""
    configs = folder / "configs"
    shutil.copytree(checkout / "configs", configs)
    return configs / "cells/demo.yaml"


def _shown(cell: Cell, nodes: tuple[FoundNode, ...], width: int) -> str:
    out = io.StringIO()
    console = Console(file=out, width=width, soft_wrap=True)
    rows = scanned_nodes(cell, nodes, "demo")
    console.print(scan_table(rows))
    return out.getvalue()


@pytest.mark.parametrize(
    ("statusword", "enabled"),
    [
        (0x0237, True),  # operation enabled
        (0x0217, True),  # quick stop active: the motor is braked under power
        (0x020F, True),  # fault reaction active
        (0x0233, False),  # switched on
        (0x0231, False),
        (0x0250, False),
        (0x0208, False),
        (None, None),
    ],
)
def test_an_enabled_axis_is_shouted(
    cell: Cell, statusword: int | None, enabled: bool | None
) -> None:
    nodes = (_node(1, 0x250), _node(2, statusword))
    rows = scanned_nodes(cell, nodes, "demo")
    expected = [False, enabled, None, None, None, None]
    assert [row.enabled for row in rows] == expected
    in_fault = statusword in {0x0208, 0x020F}
    in_faults = [row.in_fault for row in rows]
    assert in_faults == [False, in_fault, *[False] * 4]
    verdicts = [row.verdict for row in rows]
    verdict = "in fault" if in_fault else "ok"
    assert verdicts == ["ok", verdict, *["missing"] * 4]
    for width in (40, 80, 200):
        text = _shown(cell, nodes, width)
        assert ("ENABLED" in text) is bool(enabled)
        assert "…" not in text


def test_a_narrow_terminal_gets_every_column_and_whole_words(cell: Cell) -> None:
    nodes = _nodes(range(1, 7), 0x237)
    for width in (50, 80, 200):
        text = _shown(cell, nodes, width)
        line_widths = [cell_len(line.rstrip()) for line in text.splitlines()]
        assert max(line_widths) <= width
        assert text.count("ENABLED") == 6
        assert text.count("pre-operational") == 6
        for number in range(1, 7):
            assert str(1000 + number) in text


def test_a_virtual_bus_without_a_cell_names_the_simulation(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run_verb("scan", checkout / "configs/cells/five-bar.yaml", "--wait", "0.05")
    assert code == ExitCode.DEVICE_FAULT
    said = capsys.readouterr().err
    assert "start `drivegain simulate five-bar`" in said
    assert "wiring" not in said


def test_a_scan_without_answers_does_not_advise_a_scan(
    checkout: Path, cell: Cell, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = _copied_cell_file(checkout, tmp_path)
    changed_text = file.read_text().replace("node_id: 6", "node_id: 66")
    file.write_text(changed_text)
    with _simulated(cell):
        assert run_verb("scan", file, "--json") == ExitCode.DEVICE_FAULT
    failure = json.loads(capsys.readouterr().err)
    assert failure["kind"] == "NodeMissing"
    assert "wiring and termination" in failure["do"]
    assert "drivegain scan" not in failure["do"]


def test_a_real_bus_without_a_node_names_the_wiring(cell: Cell) -> None:
    changed_buses = replace(cell.buses[0], interface="socketcan")
    buses = (changed_buses,)
    real = replace(cell, buses=buses)
    axes = drive_axes(real)
    error = no_answer(real, axes, (), 0.5)
    assert "check power, wiring" in str(error)
    # One answered: a cell is there
    error = no_answer(cell, axes[1:], (1,), 0.5)
    assert "check power, wiring" in str(error)


def test_a_message_names_the_axis_first(cell: Cell) -> None:
    rows = scanned_nodes(cell, _nodes((3, 9), 0x237), "demo")
    report = scan_report(cell, rows, {}, (), ())
    said = [str(part) for part in scan_view(report)]
    assert said[1].startswith("J3 (node 3) IS ENABLED")
    assert said[2].startswith("node 9 IS ENABLED")


def test_identity_and_power_are_distinguished(cell: Cell) -> None:
    row = _first_row(cell, _node(1, 0x237, serial=9))
    assert row.verdict == "other serial number"
    assert row.enabled is True
    assert row.remarks == [
        "serial number 1018h:04 is 9, the cell configuration expects 1001",
        OTHER_DRIVE,
    ]


def test_table_and_remarks_write_the_numbers_of_an_identity_alike(cell: Cell) -> None:
    identity = Identity(0x2, 0x3, 4)
    other = FoundNode(1, identity, 1, "drive", 0x7F, 0x250)
    rows = scanned_nodes(cell, (other,), "demo")
    cells = _shown(cell, (other,), 200).split()
    expected_numbers = {"0x2": "0x29a", "0x3": "0x40200", "4": "1001"}
    for number, expected in expected_numbers.items():
        assert number in cells
        words = f"is {number}, the cell configuration expects {expected}"
        assert any(words in remark for remark in rows[0].remarks)


def test_a_drive_without_the_declared_serial_number_is_not_said_to_have_zero(cell: Cell) -> None:
    identity = Identity(0x29A, None, None)
    silent = FoundNode(1, identity, 1, "drive", 0x7F, 0x250)
    row = _first_row(cell, silent)
    assert row.verdict == "other product code"
    assert row.remarks[:2] == [
        "product code 1018h:02 is not reported, the cell configuration expects 0x40200",
        "serial number 1018h:04 is not reported, the cell configuration expects 1001",
    ]


@pytest.mark.parametrize(
    "identity", [None, Identity(0x29A), Identity(0x29A, None, 1001), Identity(0x29A, 0x40200)]
)
@pytest.mark.parametrize("reported", [Identity(0x29A, 0x40200, 1001), Identity(0x29A, None, 1001)])
def test_a_field_that_is_left_out_of_an_identity_is_not_compared(
    cell: Cell, identity: Identity | None, reported: Identity
) -> None:
    changed_axis = replace(cell.axes[0], identity=identity)
    axes = (changed_axis, *cell.axes[1:])
    node = FoundNode(1, reported, 1, "drive", 0x7F, 0x250)
    changed_cell = replace(cell, axes=axes)
    row = _first_row(changed_cell, node)
    product_declared = identity == Identity(0x29A, 0x40200)
    product_missing = product_declared and reported.product_code is None
    verdict = "other product code" if product_missing else "ok"
    assert row.verdict == verdict


def test_a_cell_without_serial_does_not_compare_it(cell: Cell) -> None:
    axes = []
    for axis in cell.axes:
        assert axis.identity is not None
        identity = replace(axis.identity, serial=None)
        axes.append(replace(axis, identity=identity))
    changed_cell = replace(cell, axes=tuple(axes))
    row = _first_row(changed_cell, _node(1, 0x250, serial=9))
    assert row.verdict == "ok"
    assert row.remarks == []


def test_a_node_that_answers_no_request_is_remarked(cell: Cell) -> None:
    """The table alone said `no identity`, and no word what to do."""
    beating = FoundNode(1, None, None, None, 0x7F, None)
    row = _first_row(cell, beating)
    assert row.verdict == "no identity"
    assert row.remarks == [NO_IDENTITY]
    overloaded = replace(beating, problems=("object 1018h:01: 64 answers to other requests",))
    row = _first_row(cell, overloaded)
    assert row.remarks == list(overloaded.problems)


def test_a_silent_axis_without_declared_identity_is_not_called_ok(cell: Cell) -> None:
    first, *others = cell.axes
    without_identity = replace(first, identity=None)
    cell = replace(cell, axes=(without_identity, *others))
    stopped = FoundNode(1, None, None, None, NmtState.STOPPED, None, answers=False)
    row = _first_row(cell, stopped)
    assert row.verdict == "no identity"
    assert row.remarks == [STOPPED]
    operational = replace(stopped, nmt=NmtState.OPERATIONAL)
    row = _first_row(cell, operational)
    assert row.verdict == "no identity"
    assert row.remarks == [NO_ANSWER]


@pytest.mark.parametrize("silent", [(3,), (1, 2, 3, 4, 5, 6)], ids=["one", "every"])
def test_axes_that_only_send_heartbeats_are_no_success(
    checkout: Path,
    cell: Cell,
    capsys: pytest.CaptureFixture[str],
    silent: tuple[int, ...],
) -> None:
    """It ended with 0: the table said `no identity`, and nothing else did."""
    heartbeat_ms = (20).to_bytes(2, "little")
    with _simulated(cell) as simulated:
        for node in simulated.nodes:
            if node.node_id in silent:
                node.write(0x1017, 0, heartbeat_ms)
                node.command_nmt(STOP_NODE, 0.0)
        code = run_verb("scan", checkout / "configs/cells/demo.yaml", "--json")
    assert code == ExitCode.DEVICE_FAULT
    printed = capsys.readouterr()
    failure = json.loads(printed.err)
    assert failure["kind"] == "NodeMissing"
    rows = json.loads(printed.out)["nodes"]
    remarks = {row["node_id"]: row["remarks"] for row in rows}
    unanswering = [node_id for node_id in remarks if remarks[node_id] == [STOPPED]]
    assert unanswering == list(silent)
    found = failure["found"]
    for node_id in silent:
        assert f"J{node_id} (node {node_id})" in found


def test_a_foreign_node_that_only_sends_heartbeats_is_no_failure(
    checkout: Path, cell: Cell, capsys: pytest.CaptureFixture[str]
) -> None:
    """A device that is no axis may be without an SDO server."""
    operational = bytes([NmtState.OPERATIONAL])
    beat = can.Message(arbitration_id=0x700 + 77, data=operational, is_extended_id=False)
    with _simulated(cell), open_bus(bus_address(cell)) as foreign:
        beats = foreign.send_periodic(beat, 0.05)
        code = run_verb("scan", checkout / "configs/cells/demo.yaml", "--json")
        beats.stop()
    assert code == ExitCode.OK
    rows = json.loads(capsys.readouterr().out)["nodes"]
    last = rows[-1]
    assert last["node_id"] == 77
    assert last["remarks"] == [NO_ANSWER]


def test_two_devices_and_a_profile_that_does_not_fit_are_said(cell: Cell) -> None:
    shared = replace(_node(1, 0x250), shared="two answers to one request")
    other = _node(2, 0x250)
    missing_objects = {"J2": "found no object 6074h:00"}
    rows = scanned_nodes(cell, (shared, other), "demo", missing_objects)
    verdicts = [row.verdict for row in rows[:2]]
    assert verdicts == ["two devices", "profile does not fit"]
    report = scan_report(cell, rows, {}, (), ())
    said = [str(part) for part in scan_view(report)]
    assert said[1].startswith(
        "J1 (node 1): found two answers to one request; two devices have this node id"
    )
    assert said[2] == "J2 (node 2): found no object 6074h:00"


def test_a_drive_without_an_object_of_its_profile_is_found_on_the_bus(
    checkout: Path, cell: Cell, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with _simulated(cell) as simulated:
        server = simulated.nodes[2]._sdo
        sound = server._read

        def read(index: int, subindex: int) -> bytes:
            if index == 0x6075:
                raise SdoAbort(0x06020000)
            return sound(index, subindex)

        monkeypatch.setattr(server, "_read", read)
        code = run_verb("scan", checkout / "configs/cells/demo.yaml", "--json")
    assert code == ExitCode.OK
    printed = capsys.readouterr().out
    rows = json.loads(printed)["nodes"]
    expected = ["ok", "ok", "profile does not fit", "ok", "ok", "ok"]
    verdicts = [row["verdict"] for row in rows]
    assert verdicts == expected
    (remark,) = rows[2]["remarks"]
    assert "no object 6075h:00 (scale of the current)" in remark


def test_a_drive_with_a_vendor_alone_passes_a_cell_without_its_product_and_serial(
    checkout: Path,
    cell: Cell,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = _copied_cell_file(checkout, tmp_path)
    declared = file.read_text()
    vendor_alone = declared.replace(", product_code: 0x00040200, serial: 1005", "")
    with _simulated(cell) as simulated:
        server = simulated.nodes[4]._sdo
        complete = server._read

        def read(index: int, subindex: int) -> bytes:
            if index == 0x1018 and subindex > 1:
                raise SdoAbort(0x06090011)
            return complete(index, subindex)

        monkeypatch.setattr(server, "_read", read)
        file.write_text(vendor_alone)
        assert run_verb("scan", file) == ExitCode.OK
        assert "Next: drivegain calibrate" in capsys.readouterr().err
        file.write_text(declared)
        # The scan has done its work: the exit code stays, and the text says that `record` will
        # refuse.
        assert run_verb("scan", file) == ExitCode.OK
        shown = capsys.readouterr()
    assert "J5 (node 5): serial number 1018h:04 is not reported" in shown.out
    assert f"J5 (node 5): {OTHER_DRIVE}" in shown.out
    assert "Next" not in shown.err


def test_a_fault_is_named_beside_what_else_is_wrong(cell: Cell) -> None:
    row = _first_row(cell, _node(1, 0x208, serial=9))
    assert row.verdict == "other serial number, in fault"


def test_a_fault_is_reset_when_a_person_says_so_and_nothing_gets_power(
    checkout: Path, cell: Cell, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(checkout / "configs/cells/demo.yaml")
    with _simulated(cell) as simulated:
        simulated.nodes[2].drive.fail(ErrorCode.FOLLOWING_ERROR)
        assert run_verb("scan", file) == ExitCode.OK
        shown = capsys.readouterr().out
        assert "in fault" in shown
        assert "--reset-faults" in shown
        drive = simulated.nodes[2].drive
        assert drive.state is PowerState.FAULT
        assert run_verb("scan", file, "--reset-faults", "--json") == ExitCode.OK
        document = json.loads(capsys.readouterr().out)
        assert document["reset"] == ["J3"]
        assert document["faults"]["J3"].startswith("8611h: ")
        verdicts = [node["verdict"] for node in document["nodes"]]
        assert verdicts == ["ok"] * 6
        states = [node.drive.state for node in simulated.nodes]
        expected = [PowerState.SWITCH_ON_DISABLED] * 6
        assert states == expected
        # Asked of a cell without a fault it does nothing.
        assert run_verb("scan", file, "--reset-faults") == ExitCode.OK
        assert "was reset" not in capsys.readouterr().out


def test_a_mistyped_nameplate_is_reported_with_its_line(
    checkout: Path, cell: Cell, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """25.65 of J3 is written as mNm: the motor's data in the drive and the current gain contradict
    it.

    The data of J1's motor are for amperes of the other amplitude, which is within the limit, and a
    warning.
    """
    file = _copied_cell_file(checkout, tmp_path)
    changed_text = file.read_text().replace("25.65", "25650")
    file.write_text(changed_text)
    before_number = changed_text.partition("25650")[0]
    line = 1 + before_number.count("\n")

    spec = _clean_simulation()
    reduction = np.abs(DriveTrain(cell.ratio).reduction)
    other_amplitude = np.sqrt(2.0) * cell.axes[0].nameplate_gain
    gain_of_axis = {0: other_amplitude, 2: 25.65}
    axes = list(spec.axes)
    for axis, gain in gain_of_axis.items():
        motor_constant = gain / reduction[axis]
        torque_nm = motor_constant * axes[axis].rated_current_a
        axes[axis] = replace(axes[axis], entered_torque_nm=torque_nm)
    spec = replace(spec, axes=tuple(axes))

    with open_bus(bus_address(cell)) as bus, SimulatedCell(spec, bus):
        assert run_verb("scan", file) == ExitCode.OK
        shown = capsys.readouterr()
        controller = tmp_path / "configs/controllers/demo.yaml"
        controller.unlink()
        assert run_verb("scan", file, "--json") == ExitCode.OK
        document = json.loads(capsys.readouterr().out)
    assert (
        f"demo.yaml:{line}: axes[2].nameplate_gain_nm_per_a: found 25650 Nm/A, while the current "
        "gain is 25.65 ("
    ) in shown.out
    assert "Next" not in shown.err
    (by_drive,) = document["mistyped"]
    assert "while N·Kt of the drive's motor is 25.65 (" in by_drive
    warnings = document["warnings"]
    (warning,) = [text for text in warnings if text.startswith("J1: ")]
    assert "near √2" in warning
    last_word = warning.split()[-1]
    assert last_word in shown.out


# -- a cell file that every other verb refuses
# -------------------------------------------------------------------------


def scan_edited(
    checkout: Path,
    cell: Cell,
    folder: Path,
    edit: Callable[[str], str],
    capsys: pytest.CaptureFixture[str],
) -> tuple[dict[str, Any], str]:
    """JSON and text of a scan of the demo cell with an edited file,
    all of whose drives are on the bus.
    """
    file = _copied_cell_file(checkout, folder)
    before = file.read_text(encoding="utf-8")
    edited = edit(before)
    assert edited != before
    file.write_text(edited, encoding="utf-8")
    with _simulated(cell):
        assert run_verb("scan", file, "--json") == ExitCode.OK
        document = json.loads(capsys.readouterr().out)
        assert run_verb("scan", file) == ExitCode.OK
        shown = capsys.readouterr()
    assert "Next" not in shown.err
    return document, shown.out


def test_a_profile_without_its_peak_current_costs_one_axis_its_check_and_no_drive_its_row(
    checkout: Path, cell: Cell, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def edit(text: str) -> str:
        return text.replace("drive: generic-cia402", "drive: technosoft-ipos", 1)

    document, shown = scan_edited(checkout, cell, tmp_path, edit, capsys)
    rows = document["nodes"]
    expected = [1001, 1002, 1003, 1004, 1005, 1006]
    serials = [row["serial"] for row in rows]
    assert serials == expected
    verdicts = [row["verdict"] for row in rows]
    assert verdicts == ["profile incomplete", *["ok"] * 5]
    (remark,) = rows[0]["remarks"]
    assert "current_scale.peak_current_a: found nothing; expected the peak current" in remark
    assert document["cell_fault"] == ""
    sorted_currents = sorted(document["current"])
    assert sorted_currents == ["J2", "J3", "J4", "J5", "J6"]
    assert "J1 (node 1): " in shown
    assert "copy the profile to drives/" in shown


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("velocity_deg_s: ", "velocity_deg_s: -", "limits.velocity_deg_s"),
        ("counts_per_revolution: ", "counts_per_revolution: 0 # ", "counts_per_revolution"),
        ("period_us: ", "period_us: 1 # ", "sync.period_us"),
        ("mass_kg: ", "mass_kg: -", "mass_kg"),
        ("urdf: ", "urdf: absent-", "absent-"),
    ],
)
def test_a_wrong_number_elsewhere_keeps_no_drive_from_being_found(
    checkout: Path,
    cell: Cell,
    tmp_path: Path,
    before: str,
    after: str,
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def edit(text: str) -> str:
        return text.replace(before, after, 1)

    document, shown = scan_edited(checkout, cell, tmp_path, edit, capsys)
    verdicts = [row["verdict"] for row in document["nodes"]]
    assert verdicts == ["ok"] * 6
    assert said in document["cell_fault"]
    assert "every other command refuses the cell file" in shown


@pytest.mark.parametrize(
    ("before", "after", "verdict"),
    [
        ("node_id: 6", "node_id: six", "not configured"),
        ("node_id: 6", "node_id: 5", "not configured"),
        ("node_id: 6", "node_id: 200", "not configured"),
        ("serial: 1006", "serial: SN1006", "ok"),
        ("drive: generic-cia402", "drive: 7", "profile incomplete"),
        ("drive: generic-cia402", "drive: unknown-make", "profile incomplete"),
    ],
)
def test_what_is_wrong_with_one_axis_costs_that_axis_alone(
    checkout: Path,
    cell: Cell,
    tmp_path: Path,
    before: str,
    after: str,
    verdict: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def edit(text: str) -> str:
        head, mark, tail = text.rpartition(before)
        return f"{head}{after}{tail}" if mark else text

    document, _ = scan_edited(checkout, cell, tmp_path, edit, capsys)
    expected = ["ok"] * 5 + [verdict]
    verdicts = [row["verdict"] for row in document["nodes"]]
    assert verdicts == expected
    remarks = document["nodes"][5]["remarks"]
    said = document["cell_fault"] + str(remarks)
    assert after.partition(": ")[2] in said


def test_a_file_without_any_node_id_is_refused_as_before(
    checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = _copied_cell_file(checkout, tmp_path)
    changed_text = file.read_text().replace("node_id: ", "node: ")
    file.write_text(changed_text)
    assert run_verb("scan", file, "--json") == ExitCode.CONFIGURATION
    failure = json.loads(capsys.readouterr().err)
    assert failure["kind"] == "SchemaMismatch"
    assert "did you mean that?" in failure["found"]


# -- while another program uses the bus
# --------------------------------------------------------------------------------


def sent_requests(witness: can.BusABC) -> list[int]:
    """Nodes to which a request was sent since the last look."""
    nodes = []
    while (frame := witness.recv(0.0)) is not None:
        if 0x600 < frame.arbitration_id < 0x680:
            nodes.append(frame.arbitration_id - 0x600)
    return nodes


@pytest.mark.parametrize("options", [[], ["--reset-faults"]])
def test_a_scan_while_a_recorder_has_the_bus_is_refused_like_a_second_recording(
    checkout: Path, cell: Cell, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(checkout / "configs/cells/demo.yaml")
    with _simulated(cell), open_bus(bus_address(cell)) as witness:
        with bus_lock(cell):
            code = run_verb("scan", file, "--json", *options)
        assert code == ExitCode.BUS_TAKEN
        failure = json.loads(capsys.readouterr().err)
        assert failure["kind"] == "BusTaken"
        assert failure["exit_code"] == ExitCode.BUS_TAKEN
        assert "such as a recording" in failure["found"]
        assert sent_requests(witness) == []
        assert run_verb("scan", file, *options) == ExitCode.OK


def test_a_scan_beside_a_master_whose_lock_is_not_seen_sends_nothing(
    checkout: Path, cell: Cell, capsys: pytest.CaptureFixture[str]
) -> None:
    """A recorder in a container, on another computer, or of another maker."""
    over = threading.Event()
    with _simulated(cell), open_bus(bus_address(cell)) as master:

        def lead() -> None:
            while not over.wait(0.01):
                message = can.Message(arbitration_id=0x80, is_extended_id=False)
                master.send(message)

        leading = threading.Thread(target=lead)
        leading.start()
        try:
            command = ["scan", str(checkout / "configs/cells/demo.yaml"), "--json"]
            assert main(command) == ExitCode.DEVICE_FAULT
        finally:
            over.set()
            leading.join()
        assert sent_requests(master) == []
    failure = json.loads(capsys.readouterr().err)
    assert failure["kind"] == "BusBusy"
    assert "a SYNC (080h) that we did not send" in failure["found"]


def hear_recorder(cell: Cell, until: Callable[[Link], bool]) -> Link:
    """Listen on the bus of a cell, without a frame of our own, until something was heard."""
    link = Link(bus_address(cell), SdoPolicy(), time.monotonic_ns)
    link.open()
    try:
        assert link.wait(60.0, lambda: until(link))
        return link
    finally:
        link.close()


@pytest.mark.slow
def test_a_scan_in_the_middle_of_a_motion_leaves_it_alone_and_accuses_no_drive(
    checkout: Path, cell: Cell, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The heartbeats of a cell in lockstep come as fast as its SYNC."""
    file = checkout / "configs/cells/demo.yaml"
    plan = tmp_path / "plan.yaml"
    log = tmp_path / "a.mcap"
    plan.write_text(PLAN, encoding="utf-8")
    files = [str(file), str(plan), "--out", str(log)]
    command = ["record", *files, "--enable-motion", "--speed", "0.05"]
    ended: list[int] = []

    def record() -> None:
        code = main(command)
        ended.append(code)

    recorder = threading.Thread(target=record)

    with _simulated(cell) as simulated:

        def in_motion(link: Link) -> bool:
            """Whether all axes have power, and all heartbeats that the link knows came since
            then.
            """
            states = {node.drive.state for node in simulated.nodes}
            if states != {PowerState.OPERATION_ENABLED}:
                for node in simulated.nodes:
                    link.count_beats(node.node_id)
                return False
            beats = [link._beats.get(node.node_id, ()) for node in simulated.nodes]
            known = [len(of_node) for of_node in beats]
            return min(known) == BEATS_KEPT

        recorder.start()
        link = hear_recorder(cell, in_motion)
        code = main(["scan", str(file)])
        recorder.join()
    assert code == ExitCode.BUS_TAKEN
    shared = [link.shared_id(node_id, 100) for node_id in range(1, 7)]
    assert shared == [""] * 6
    # All moves were made; on a busy machine an answer of the simulated cell may be late, which is
    # counted.
    assert ended[0] in (ExitCode.OK, ExitCode.DATA_UNFIT)
    events = read_log(log).events
    kinds = [event.kind for event in events]
    assert kinds.count(EventKind.MOVE_END) == 2
    assert EventKind.BUS_BUSY not in kinds
    capsys.readouterr()


@pytest.fixture(scope="module")
def two(checkout: Path) -> Cell:
    """The demo cell on two buses."""
    files = bundle(checkout / "configs/cells/demo.yaml")
    decoded_cell_yaml = files["cell.yaml"].decode()
    text = on_two_buses(decoded_cell_yaml, "virtual", "a", "b")
    return cell_from_bundle({**files, "cell.yaml": text.encode()})


def test_a_node_is_reported_where_it_is_and_where_it_belongs(two: Cell) -> None:
    left = scanned_nodes(two, _nodes((1, 2, 4, 9), 0x250), "left")
    buses = [row.bus for row in left]
    assert buses == ["left"] * 5
    of_nodes = [(row.node_id, row.axis, row.verdict) for row in left]
    assert of_nodes == [
        (1, "J1", "ok"),
        (2, "J2", "ok"),
        (3, "J3", "missing"),
        (4, "J4", "belongs on right"),
        (9, None, "not configured"),
    ]
    right = scanned_nodes(two, _nodes((4, 5, 6), 0x250), "right")
    verdicts = [row.verdict for row in right]
    assert verdicts == ["ok"] * 3
    out = io.StringIO()
    console = Console(file=out, width=200, soft_wrap=True)
    nodes = left + right
    console.print(scan_table(nodes))
    heading, _, *lines = out.getvalue().splitlines()
    first_headings = heading.split()[:2]
    assert first_headings == ["bus", "node"]
    first_words = [line.split()[0] for line in lines if line.strip()]
    assert first_words == ["left"] * 5 + ["right"] * 3
    assert "belongs on right" in out.getvalue()
