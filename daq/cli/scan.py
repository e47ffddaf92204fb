"""`drivegain scan` and `explain-emcy`: the nodes on the bus and their error codes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.next_step import say_next
from daq.cli.terminal import print_view, say
from daq.cli.verb import CellArgument, JsonOption, print_json
from daq.errors import ConfigurationInconsistent, UsageError, VirtualBusEmpty
from drivers.errors import DriverError, NodeMissing

if TYPE_CHECKING:
    from daq.config.cell import Wired
    from daq.config.wiring import AxisWiring
    from drivers.canopen.bus import BusAddress
    from drivers.canopen.network import CanopenNetwork
    from drivers.canopen.node_scan import FoundNode
    from drivers.canopen.scale import ScaleReading
    from drivers.profiles.profile import Axis


def scan_verb(
    cell: CellArgument,
    wait: Annotated[
        float, typer.Option(help="How long to wait for answers [s].", min=0.05, max=60.0)
    ] = 0.5,
    reset_faults: Annotated[
        bool,
        typer.Option(
            "--reset-faults",
            help="Reset every axis in FAULT (6040h); it stays unpowered, nothing moves.",
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """List the nodes on the cell's buses with identity, name and state,
    and compare them with the cell file.

    Every node id is tried on every bus, so that an amplifier on the wrong bus is found. Nameplate
    gains are compared with the motors' data in the drives and with the current gains. Nothing is
    changed without --reset-faults; find out why an axis is in fault before you reset it. While a
    recording or another master uses the bus, nothing is sent: exit code 12 or 5. Of a cell file
    that other verbs refuse, the buses and node ids are enough; what is missing is said. Exit code 5
    also where an axis does not answer, as one of which heartbeats alone are heard; what else is
    wrong is in the table, as another serial number is, and `record` refuses it.
    """
    from daq.config.cell_buses import bus_parts
    from daq.config.wiring import read_wiring
    from daq.report.bus_views import scan_report, scan_view, scanned_nodes
    from daq.workflow.bus_lock import bus_lock
    from daq.workflow.nameplates import check_nameplates, nameplate_warnings

    wiring, declared = read_wiring(cell)
    found: dict[str, tuple[FoundNode, ...]] = {}
    misfits = {axis.name: axis.profile_fault for axis in wiring.axes if axis.profile_fault}
    scales: dict[str, ScaleReading | None] = {}
    causes: dict[str, str] = {}
    with bus_lock(wiring):
        for part in bus_parts(wiring):
            axes = tuple(axis for axis in wiring.axes if axis.bus == part.name)
            scanned = _scan_bus(part.address, axes, wait, reset_faults)
            found[part.name] = scanned.nodes
            scales |= scanned.scales
            misfits |= scanned.misfits
            causes |= scanned.causes
    mistyped: list[str] = []
    warnings: tuple[str, ...] = ()
    if declared is not None:
        readings = [scales.get(name) for name in declared.axis_names]
        warnings = nameplate_warnings(declared, readings)
        try:
            check_nameplates(cell, declared, readings)
        except ConfigurationInconsistent as error:
            mistyped.append(str(error))
    listed = []
    for name, nodes in found.items():
        listed += scanned_nodes(wiring, nodes, name, misfits)
    report = scan_report(wiring, listed, causes, mistyped, warnings, wiring.fault)
    if json:
        print_json(report)
    else:
        print_view(scan_view(report))
    heard = tuple(chain.from_iterable(found.values()))
    absent = {node.node_id for node in listed if node.verdict == "missing"}
    for name, nodes in found.items():
        absent |= _unanswering(wiring, name, nodes)
    missing = [_amplifier(axis) for axis in wiring.axes if axis.node_id in absent]
    if missing:
        answered = tuple(node.node_id for node in heard if node.answers)
        if heard:  # a bus with heartbeats alone is not empty
            raise NodeMissing(missing, answered, wait)
        raise no_answer(wiring, missing, answered, wait)
    if (
        not json
        and declared is not None
        and not mistyped
        and all(node.verdict == "ok" for node in listed)
    ):
        say_next("drivegain", "calibrate", cell, "--check")


@dataclass(frozen=True, slots=True)
class ScannedBus:
    """What was found on one bus."""

    nodes: tuple[FoundNode, ...]  #: by node id
    scales: dict[str, ScaleReading | None]  #: of the current, by axis; None where it cannot be read
    misfits: dict[str, str]  #: objects of its profile that a drive lacks, by axis
    causes: dict[str, str]  #: error code of each axis that was in fault and was reset


def _scan_bus(
    address: BusAddress,
    wired: tuple[AxisWiring, ...],
    wait_s: float,
    reset_faults: bool,
) -> ScannedBus:
    """Find the nodes of a bus whose lock is taken, and reset the axes in fault if that is wanted.

    Raises:
        BusBusy: another master commands the bus; nothing was sent.
        DriverError: the bus is lost, or an axis stays in fault.
    """
    from drivers.canopen.network import CanopenNetwork
    from drivers.profiles.cia402 import State

    axes = tuple(_amplifier(axis) for axis in wired)
    with_profile = {axis.node_id for axis in wired if axis.profile is not None}
    with CanopenNetwork(address, axes) as network:
        nodes = network.scan(wait_s=wait_s)
        sound = {node.node_id for node in nodes if node.identity and not node.problems}
        here = [axis for axis in axes if axis.node_id in sound & with_profile]
        scales = {axis.name: _scale_of(network, axis) for axis in here}
        misfits = {axis.name: text for axis in here if (text := _misfit_of(network, axis))}
    in_fault = {node.node_id for node in nodes if node.state is State.FAULT}
    faulty = tuple(axis for axis in axes if axis.node_id in in_fault)
    if not reset_faults or not faulty:
        return ScannedBus(nodes, scales, misfits, {})
    with CanopenNetwork(address, faulty) as network:
        network.require_quiet()
        causes = {axis.name: _fault_of(network, axis) for axis in faulty}
        network.reset_faults()
    with CanopenNetwork(address, axes) as network:
        nodes = network.scan(wait_s=wait_s)
    return ScannedBus(nodes, scales, misfits, causes)


def _unanswering(wiring: Wired, bus: str, nodes: Sequence[FoundNode]) -> set[int]:
    """Node ids of the axes of a bus of which heartbeats alone are heard, as of a stopped node.

    A device that is no axis of the cell may be without an SDO server.
    """
    own = {axis.node_id for axis in wiring.axes if axis.bus == bus}
    return {node.node_id for node in nodes if not node.answers and node.node_id in own}


def no_answer(
    cell: Wired, missing: Sequence[Axis], answered: tuple[int, ...], wait_s: float
) -> Exception:
    """Error for axes that did not answer: amplifiers without power,
    or a simulated cell that was not started.
    """
    from daq.cli.simulate import SHIPPED

    if answered or not all(bus.kind.is_of_process for bus in cell.buses):
        return NodeMissing(missing, answered, wait_s)
    name = cell.name if cell.name in SHIPPED else "FILE"
    return VirtualBusEmpty(
        f"cell {cell.name!r}",
        found="no node on its bus, which is virtual: no amplifier and no other program is "
        "ever on it",
        expected="the bus of a simulated cell in a second terminal, or of a robot",
        remedy=f"start `drivegain simulate {name}`, and put the `bus` and `sync` that it prints "
        "into a copy of the cell file",
    )


def _amplifier(axis: AxisWiring) -> Axis:
    """Axis for the bus; without a profile it is that of the standard,
    whose current and position are not read.
    """
    from drivers.profiles.profile import CIA402, Axis

    return Axis(axis.name, axis.node_id, axis.profile or CIA402, axis.identity)


def _scale_of(network: CanopenNetwork, axis: Axis) -> ScaleReading | None:
    """Read the scale of a drive's current; None where it cannot be read, which `record` reports."""
    from drivers.canopen.scale import read_scale

    try:
        return read_scale(network.link.objects(axis.node_id), axis.profile)
    except DriverError:
        return None


def _misfit_of(network: CanopenNetwork, axis: Axis) -> str:
    """Describe the objects of its profile that a drive lacks;
    empty where it has them, or does not answer.
    """
    from daq.config.drive import shipped_profiles
    from drivers.canopen.setup import misfit

    try:
        lacking = misfit(network.link.objects(axis.node_id), axis.profile, shipped_profiles)
    except DriverError:
        return ""
    return "" if lacking is None else str(lacking)


def _fault_of(network: CanopenNetwork, axis: Axis) -> str:
    """Describe the error code (603Fh) of an axis in fault, which its reset clears."""
    from drivers.canopen.emcy import explain, read_error_code

    code = read_error_code(network.link.objects(axis.node_id))
    if code == 0:
        return "the drive names no error code (603Fh)"
    return f"{explain(code).hex}: {explain(code).text}"


_HEX = re.compile(r"(?:0[xX])?([0-9a-fA-F]{1,4})[hH]?")


def explain_emcy_verb(
    code: Annotated[str, typer.Argument(help="Hexadecimal, as in manuals: 8611, 8611h or 0x8611.")],
    json: JsonOption = False,
) -> None:
    """Explain an emergency error code (EMCY, object 603Fh) by CiA 301 and CiA 402.

    For a manufacturer's own code only its class is known; the drive's manual has the rest.
    """
    from daq.report.bus_views import error_code_report
    from daq.workflow.events import explain_error_code

    found = explain_error_code(read_code(code))
    if json:
        print_json(error_code_report(found))
    else:
        say(f"{found.hex}: {found.text}\nWhat to do: {found.remedy}.")


def read_code(text: str) -> int:
    """Read an error code as manuals write it."""
    found = _HEX.fullmatch(text.strip())
    if found is None:
        raise UsageError(
            f"code {text!r}",
            found="no error code",
            expected="a hexadecimal number of at most four digits, as 8611, 8611h or 0x8611",
            remedy="take it from the event's text (`drivegain info LOG`) or from object 603Fh",
        )
    return int(found.group(1), 16)
