"""`drivegain simulate`: a simulated cell on a bus of its own, for the other verbs in another terminal."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.terminal import interruptible
from daq.cli.verb import Verb
from daq.errors import UsageError
from daq.simulation.simulation_file import load_scenario, load_simulation, require_simulator, shipped_simulation
from drivers.canopen.bus import BusAddress, open_answering_bus
from drivers.canopen.hub import Hub
from drivers.simulation.spec import CellSpec
from drivers.stream.split_bus import BusPart, SplitAddress, open_split_bus

SHIPPED = ("demo", "clean", "seven-axis", "gantry")
SHIPPED_FAULTS = "faults-example"


def simulate(
    simulation: Annotated[
        Path, typer.Argument(help="Simulation file, the truth of a cell; or demo or clean, which come with drivegain.")
    ],
    payload: Annotated[str | None, typer.Option(help="Mounted body, by its name in the simulation file.")] = None,
    faults: Annotated[
        Path | None,
        typer.Option(help="Scenario file of what goes wrong, and when; or faults-example, which lists all kinds."),
    ] = None,
    interface: Annotated[
        str, typer.Option(help="socketcand starts a hub on 127.0.0.1; socketcan uses a real or virtual CAN.")
    ] = "socketcand",
    channel: Annotated[str, typer.Option(help="Of the bus.")] = "can0",
    bus: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CHANNEL=NODE,NODE,...",
            help="One of several buses with the nodes on it, instead of --channel; say it once for each bus.",
        ),
    ] = None,
    port: Annotated[int, typer.Option(help="Of the hub; 0 takes a free one.", min=0, max=65535)] = 29536,
    payload_from: Annotated[
        Path | None,
        typer.Option(
            "--payload-from",
            metavar="FILE",
            help="File with the name of the mounted body, or none; read anew whenever all axes are without power.",
        ),
    ] = None,
) -> None:
    """Run a simulated cell until Ctrl-C or SIGTERM: amplifiers that answer NMT, SDO, PDO, SYNC, heartbeat and EMCY.

    It prints the bus to write into the cell file of the other verbs, which then run in a second terminal.
    """
    require_simulator()
    from drivers.simulation.cell import MountingCell, SimulatedCell  # noqa: PLC0415 - needs an optional extra

    if payload is not None and payload_from is not None:
        raise UsageError(
            "--payload-from", found="--payload beside it", expected="one of the two", remedy="leave out one of them"
        )
    shipped = simulation.name in SHIPPED and not simulation.exists()
    truth = shipped_simulation(simulation.name) if shipped else simulation
    mounted = None if payload_from is None else MountedFile(payload_from, partial(load_simulation, truth), _complain)
    spec = load_simulation(truth, payload) if mounted is None else mounted.at_power_on()
    if faults is not None:
        shipped = faults.name == SHIPPED_FAULTS and not faults.exists()
        scenario = shipped_simulation(faults.name) if shipped else faults
        spec = replace(spec, faults=spec.faults + load_scenario(scenario, len(spec.axes), spec.sync_period_us))
    # A terminal that has gone is no reason to end: that is what nohup is for.
    with suppress(KeyboardInterrupt), interruptible(signals=(signal.SIGINT, signal.SIGTERM)), ExitStack() as stack:
        there = nodes_on_buses(bus, [axis.node_id for axis in spec.axes]) if bus else {channel: frozenset()}
        hub = stack.enter_context(Hub(tuple(there), port)) if interface == "socketcand" else None
        parts = tuple(
            BusPart(name, BusAddress(interface, name) if hub is None else hub.address(name), nodes)
            for name, nodes in there.items()
        )
        address = SplitAddress(parts) if bus else parts[0].address
        end = open_split_bus(address) if isinstance(address, SplitAddress) else open_answering_bus(address)
        stack.callback(end.shutdown)
        cell = SimulatedCell(spec, end) if mounted is None else MountingCell(spec, end, mounted)
        what = payload or "none" if payload_from is None else f"as {payload_from} says"
        faulty = len(spec.faults) or "no"
        typer.echo(f"{len(spec.axes)} amplifiers on {address}, payload {what}, {faulty} faults; Ctrl-C ends it")
        typer.echo(how_to_reach(parts, spec.sync_period_us))
        cell.serve_forever()


class MountedFile:
    """What a file says is mounted; called, it reads the file again.

    Args:
        path: its first line is the name of a body, or none; nothing is mounted while there is no such file.
        load: makes the description of the cell with a body.
        complain: is told of a name that the simulation does not know; what was mounted stays.
    """

    def __init__(
        self, path: Path, load: Callable[[str | None], CellSpec], complain: Callable[[UsageError], None]
    ) -> None:
        self._path = path
        self._load = load
        self._complain = complain
        self._said: str | None = None
        self._spec: CellSpec | None = None

    def at_power_on(self) -> CellSpec:
        """The cell as the file has it now.

        Raises:
            UsageError: the simulation does not know the body.
        """
        self._said = self._read()
        self._spec = self._load(self._said)
        return self._spec

    def __call__(self) -> CellSpec | None:
        """The same object as before where nothing has changed."""
        said = self._read()
        if said != self._said:
            self._said = said
            try:
                self._spec = self._load(said)
            except UsageError as error:
                self._complain(error)
        return self._spec

    def _read(self) -> str | None:
        with suppress(OSError):
            name = self._path.read_text(encoding="utf-8", errors="replace").partition("\n")[0].strip()
            return None if name == "none" else name or self._said  # empty while it is being written
        return None


def _complain(error: UsageError) -> None:
    typer.echo(f"{error}; what was mounted stays", err=True)


def nodes_on_buses(said: Sequence[str], node_ids: Sequence[int]) -> dict[str, frozenset[int]]:
    """Nodes by the channel of their bus.

    Args:
        said: CHANNEL=NODE,NODE,... of each bus.
        node_ids: of the cell; each must be on one of the buses.

    Raises:
        UsageError: something else was said.
    """
    there: dict[str, frozenset[int]] = {}
    for one in said:
        channel, _, nodes = one.partition("=")
        numbers = [int(node) for node in nodes.split(",") if node.isascii() and node.isdigit()]
        if not channel or channel in there or not numbers or len(numbers) != nodes.count(",") + 1:
            raise UsageError(
                f"--bus {one}",
                found="no CHANNEL=NODE,NODE,..., or a channel for the second time",
                expected="a channel and the nodes on it",
                remedy="for example --bus can0=1,2,3 --bus can1=4,5,6",
            )
        there[channel] = frozenset(numbers)
    everywhere = sorted(node for nodes in there.values() for node in nodes)
    if everywhere != sorted(node_ids):
        raise UsageError(
            f"--bus {' --bus '.join(said)}",
            found=f"node {', '.join(map(str, everywhere))}",
            expected=f"each node of the cell once: {', '.join(map(str, sorted(node_ids)))}",
            remedy="say on which bus each of them is",
        )
    return there


def how_to_reach(parts: Sequence[BusPart], period_us: int) -> str:
    """What the cell file of the other verbs must say, ready to paste, and a first command."""
    # A kernel's bus carries frames in their own time; over a hub the simulated cell sets the pace.
    pacing = "timed" if parts[0].address.interface == "socketcan" else "lockstep"
    several = len(parts) > 1
    buses = "".join(("  - name: " + part.name + "\n" if several else "") + _keys(part, several) for part in parts)
    nodes = "".join(
        f"axes with node_id {', '.join(map(str, sorted(part.node_ids)))}: add bus: {part.name}\n" for part in parts
    )
    return (
        "To reach it, let the cell file say this instead of its own `bus` and `sync`:\n\n"
        f"bus:\n{buses}sync:\n  period_us: {period_us}\n  pacing: {pacing}\n\n"
        + (f"{nodes}\n" if several else "")
        + "and try it in a second terminal: drivegain scan CELL"
    )


def _keys(part: BusPart, several: bool) -> str:
    address, indent = part.address, "    " if several else "  "
    keys = {"interface": address.interface, "channel": address.channel}
    if address.interface == "socketcand":
        keys |= {"host": address.host, "port": str(address.port)}
    keys["bitrate_bit_s"] = str(address.bitrate_bit_s)
    return "".join(f"{indent}{key}: {value}\n" for key, value in keys.items())


SIMULATE = Verb("simulate", simulate, "drivegain simulate demo --payload disc --faults faults-example")
