"""`drivegain simulate` and `drivegain demo`: run a simulated cell, alone or for the whole job."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.terminal import (
    at_most_one,
    interruptible,
    output_console,
    print_view,
    replace_output,
    say,
    show_steps,
    until_interrupted,
)
from daq.cli.verb import JsonOption, output_option, print_json
from daq.errors import ConfigurationInconsistent, UsageError, counted
from daq.files import read_regular, replace_file
from daq.report.text import Sentence
from drivers.canopen.interfaces import SOCKETCAND, interface_of

if TYPE_CHECKING:
    from rich.console import RenderableType

    from daq.simulation.demo import DemoOutcome
    from drivers.canopen.split_bus import BusPart
    from drivers.simulation.spec import CellSpec

SHIPPED = (
    "demo",
    "clean",
    "rx90",
    "kr270",
    "seven-axis",
    "gantry",
    "five-bar",
    "orthoglide",
    "dualv",
)
_SHIPPED_FAULTS = "faults-example"
HUB_PORT = 29536  #: Of a hub, if none is given: that of cell files without a port
LARGEST_NAME_FILE_BYTES = 4096  #: Size of a file that names a body


def simulate(
    simulation: Annotated[
        Path,
        typer.Argument(
            help=f"Simulation file, the truth of a cell, or a shipped one: {', '.join(SHIPPED)}."
        ),
    ],
    payload: Annotated[
        str | None, typer.Option(help="Name of the mounted body in the simulation file.")
    ] = None,
    faults: Annotated[
        Path | None, typer.Option(help="Scenario file, or the shipped faults-example.")
    ] = None,
    interface: Annotated[
        str, typer.Option(help="socketcand, a hub on 127.0.0.1, or socketcan.")
    ] = SOCKETCAND.name,
    channel: Annotated[str, typer.Option(help="Channel of the bus.")] = "can0",
    bus: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CHANNEL=NODE,NODE,...",
            help="One of several buses, instead of --channel; repeatable.",
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(
            help=f"Port of the hub, {HUB_PORT} by default; 0 takes a free one.", min=0, max=65535
        ),
    ] = None,
    payload_from: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Names the mounted body, or none; read again while no axis has power.",
        ),
    ] = None,
) -> None:
    """Run a simulated cell until Ctrl-C or SIGTERM:
    amplifiers that answer NMT, SDO, PDO, SYNC, heartbeat and EMCY.

    It prints the bus settings for the cell file; the other verbs then run in a second terminal.
    Each shipped one but clean, which is the demo without its hidden effect, has a cell file of its
    name.
    """

    from daq.simulation.simulation_file import (
        load_scenario,
        load_simulation,
        require_simulator,
        shipped_simulation,
    )
    from daq.workflow.bus_lock import require_untaken
    from drivers.canopen.bus import BusAddress, bus_errors
    from drivers.canopen.split_bus import BusPart, CellAddress, SplitAddress, open_cell_bus
    from drivers.simulation.hub import Hub

    require_simulator()
    from drivers.simulation.cell import SimulatedCell
    from drivers.simulation.spec import SpecInvalid

    at_most_one(payload_from=payload_from, payload=payload)
    hub_port = port_of_hub(interface, port)
    # A folder of that name, as `init` makes it, is no simulation file.
    shipped = simulation.name in SHIPPED and not simulation.is_file()
    truth = shipped_simulation(simulation.name) if shipped else simulation
    mounted = None
    if payload_from is not None:
        mounted = MountedFile(
            payload_from,
            partial(load_simulation, truth),
            lambda error: say(f"{error}; the mounted body stays", err=True),
        )
    spec = load_simulation(truth, payload) if mounted is None else mounted.at_power_on()
    if faults is not None:
        shipped = faults.name == _SHIPPED_FAULTS and not faults.is_file()
        scenario = shipped_simulation(faults.name) if shipped else faults
        spec = replace(
            spec, faults=spec.faults + load_scenario(scenario, len(spec.axes), spec.sync_period_us)
        )
    # SIGHUP is left alone, so that nohup works.
    with (
        until_interrupted(),
        interruptible(signals=(signal.SIGINT, signal.SIGTERM)),
        ExitStack() as stack,
    ):
        nodes_by_bus: dict[str, frozenset[int]] = {channel: frozenset()}
        if bus:
            nodes_by_bus = nodes_on_buses(bus, [axis.node_id for axis in spec.axes])
        addresses = {name: BusAddress(interface, name) for name in nodes_by_bus}
        if hub_port is not None:
            hub = stack.enter_context(Hub(tuple(nodes_by_bus), hub_port))
            addresses = {name: hub.address(name) for name in nodes_by_bus}
        else:  # a hub is a bus of this program, which no other program uses yet
            require_untaken(addresses.values())
        parts = tuple(BusPart(name, addresses[name], nodes) for name, nodes in nodes_by_bus.items())
        address: CellAddress = parts[0].address
        if bus:
            address = SplitAddress(parts)
        end = open_cell_bus(address, answering=True)
        stack.callback(end.shutdown)
        try:
            cell = SimulatedCell(spec, end, mounted=mounted)
        except SpecInvalid as error:
            expected = "a cell that can be built"
            remedy = "correct it, or the URDF that it names"
            raise ConfigurationInconsistent(
                str(truth), found=str(error), expected=expected, remedy=remedy
            ) from error
        what = payload or "none" if payload_from is None else f"as {payload_from} says"
        faulty = len(spec.faults) or "no"
        say(
            f"{counted(len(spec.axes), 'amplifier')} on {address}, payload {what}, {faulty} "
            "faults; Ctrl-C ends it"
        )
        typer.echo(how_to_reach(parts, spec.sync_period_us))
        with bus_errors(address):
            cell.serve_forever()


class MountedFile:
    """Body mounted on the simulated cell, named in a file that is read again at every call.

    Args:
        path: its first line is the name of a body, or none; without the file nothing is mounted.
        load: builds the description of the cell with a body.
        complain: receives the error of an unknown name; the mounted body stays.
    """

    def __init__(
        self,
        path: Path,
        load: Callable[[str | None], CellSpec],
        complain: Callable[[UsageError], None],
    ) -> None:
        self._path = path
        self._load = load
        self._complain = complain
        self._name: str | None = None
        self._spec: CellSpec | None = None

    def at_power_on(self) -> CellSpec:
        """Load the cell with the body that the file names now, an unknown one being an error."""
        self._name = self._read()
        self._spec = self._load(self._name)
        return self._spec

    def __call__(self) -> CellSpec | None:
        """Return the cell with the body that the file names;
        the same object while the name is the same.
        """
        name = self._read()
        if name != self._name:
            self._name = name
            try:
                self._spec = self._load(name)
            except UsageError as error:
                self._complain(error)
        return self._spec

    def _read(self) -> str | None:
        with suppress(OSError):
            head = read_regular(self._path, LARGEST_NAME_FILE_BYTES)
            name = head.decode("utf-8", "replace").partition("\n")[0].strip()
            return None if name == "none" else name or self._name  # empty while it is being written
        return None


def port_of_hub(interface: str, port: int | None) -> int | None:
    """Return the port of the hub; None on an interface that has no hub.

    Args:
        interface: as it is typed.
        port: as it is typed; None for the usual one.

    Raises:
        UsageError: a port is typed for an interface without a hub.
    """
    if interface_of(interface) is SOCKETCAND:
        return HUB_PORT if port is None else port
    if port is not None:
        raise UsageError(
            f"--port {port}",
            found=f"the interface {interface}, which has no hub",
            expected=f"a port for {SOCKETCAND.name} alone",
            remedy=f"leave --port out, or take --interface {SOCKETCAND.name}",
        )
    return None


def nodes_on_buses(options: Sequence[str], node_ids: Sequence[int]) -> dict[str, frozenset[int]]:
    """Read the nodes of each channel from CHANNEL=NODE,NODE,...;
    each node of the cell must be on exactly one bus.
    """
    there: dict[str, frozenset[int]] = {}
    for one in options:
        channel, _, nodes = one.partition("=")
        texts = nodes.split(",")
        numbers = [int(node) for node in texts if node.isascii() and node.isdigit()]
        is_new = bool(channel) and channel not in there
        if not is_new or len(numbers) != len(texts):
            raise UsageError(
                f"--bus {one}",
                found="no CHANNEL=NODE,NODE,..., or a repeated channel",
                expected="a channel and the nodes on it",
                remedy="for example --bus can0=1,2,3 --bus can1=4,5,6",
            )
        there[channel] = frozenset(numbers)
    everywhere = sorted(chain.from_iterable(there.values()))
    wanted = sorted(node_ids)
    if everywhere != wanted:
        given = " --bus ".join(options)
        listed = ", ".join(map(str, everywhere))
        all_nodes = ", ".join(map(str, wanted))
        raise UsageError(
            f"--bus {given}",
            found=f"node {listed}",
            expected=f"each node of the cell once: {all_nodes}",
            remedy="list every node on its bus",
        )
    return there


def how_to_reach(parts: Sequence[BusPart], period_us: int) -> str:
    """Return the settings for the cell file, ready to paste, and a first command to try."""
    # A kernel's bus carries frames in their own time; over a hub the simulated cell sets the pace.
    pacing = "timed"
    if parts[0].address.kind.is_simulated:
        pacing = "lockstep"
    has_several_buses = len(parts) > 1
    buses = ""
    nodes = ""
    for part in parts:
        address = part.address
        keys = {"interface": address.interface, "channel": address.channel}
        if address.kind.has_server:
            keys["host"] = address.host
            keys["port"] = str(address.port)
        keys["bitrate_bit_s"] = str(address.bitrate_bit_s)
        indent = "  "
        if has_several_buses:
            indent = "    "
            buses += f"  - name: {part.name}\n"
            node_ids = ", ".join(map(str, sorted(part.node_ids)))
            nodes += f"axes with node_id {node_ids}: add bus: {part.name}\n"
        for key, value in keys.items():
            buses += f"{indent}{key}: {value}\n"
    if nodes:
        nodes = f"{nodes}\n"
    return (
        "A cell of `drivegain init --simulated` reaches it as it is. In another cell file, replace "
        "`bus` and `sync` with:\n\n"
        f"bus:\n{buses}sync:\n  period_us: {period_us}\n  pacing: {pacing}\n\n"
        f"{nodes}and try it in a second terminal: drivegain scan CELL"
    )


def demo(
    out: Annotated[Path, output_option("--out", "Folder to fill.")] = Path("out/demo"),
    simulation: Annotated[
        Path | None, typer.Option(help="Another simulation file than the shipped one.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of plans and noise.", min=0)] = 1,
    duration: Annotated[
        float, typer.Option(help="Duration of each of the five runs [s].", min=10.0, max=600.0)
    ] = 40.0,
    json: JsonOption = False,
) -> None:
    """Calibrate a simulated six-axis cell: scan, plan, record, identify, add effects,
    write a copy of its file.
    """

    from daq.report.document import json_text
    from daq.report.proposal import show_proposal
    from daq.simulation.demo import ProgressReporter, Settings, demo_report, demonstrate
    from daq.simulation.simulation_file import shipped_simulation

    began = time.monotonic()
    settings = Settings(out, simulation or shipped_simulation(), seed, duration)
    with replace_output(out):
        with show_steps() as stepper:
            outcome = demonstrate(
                settings,
                lambda: datetime.now(UTC),
                ProgressReporter(stepper.step, stepper.progress),
            )
        report = demo_report(outcome, seconds=round(time.monotonic() - began, 1))
        replace_file(out / "summary.json", json_text(report).encode())
    if json:
        print_json(report)
        return
    print_view(demo_view(outcome))
    show_proposal(outcome.proposal, output_console())
    if outcome.written is not None:
        say(f"Written to the copy {outcome.written.edit.subject}.")
    say(f"\nLogs, calibration.yaml, pictures, summary.json and report/report.html are in {out}.")


def demo_view(outcome: DemoOutcome) -> Iterator[RenderableType]:
    """Nodes on the bus, turns of the loop, errors before and after, the summary,
    and the gains compared with the truth.
    """
    from daq.report.bus_views import scan_table, scanned_nodes
    from daq.report.gains import gain_table
    from daq.report.residual import before_after_table, summary, turns_view

    fitted = outcome.fitted
    truth = outcome.truth
    yield scan_table(scanned_nodes(outcome.cell, outcome.nodes, outcome.cell.buses[0].name))
    yield ""
    yield from turns_view(fitted)
    yield before_after_table(outcome.changed, fitted.cell.axis_names)
    yield ""
    yield from map(Sentence, summary(fitted, outcome.changed, outcome.calibration.effects))
    yield ""
    title = "Drive gains and the truth of the simulated cell; change % is from the nameplate"
    yield gain_table(outcome.calibration.gains, truth, title=title)
    if fitted.paper is not None:
        errors = (
            100.0 * (gain / truth[axis] - 1.0)
            for axis, gain in zip(truth, fitted.paper.gains, strict=True)
        )
        yield ("Errors of the paper's total least squares on the same rows: ") + ", ".join(
            f"{e:+.2f} %" for e in errors
        )
    yield ""
