"""`drivegain simulate`: a simulated cell on a bus of its own, for the other verbs in another terminal."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.verb import Verb
from daq.configuration.simulation import load_simulation, shipped_simulation
from drivers.bus import BusAddress, open_bus
from drivers.hub import Hub
from drivers.simulated.cell import SimulatedCell

SHIPPED = ("demo", "clean")


def simulate(
    simulation: Annotated[
        Path, typer.Argument(help="Simulation file, the truth of a cell; or demo or clean, which come with drivegain.")
    ],
    payload: Annotated[str | None, typer.Option(help="Mounted body, by its name in the simulation file.")] = None,
    interface: Annotated[
        str, typer.Option(help="socketcand starts a hub on 127.0.0.1; socketcan uses a real or virtual CAN.")
    ] = "socketcand",
    channel: Annotated[str, typer.Option(help="Of the bus.")] = "can0",
    port: Annotated[int, typer.Option(help="Of the hub; 0 takes a free one.", min=0, max=65535)] = 29536,
) -> None:
    """Run a simulated cell until Ctrl-C: amplifiers that answer NMT, SDO, PDO, SYNC, heartbeat and EMCY."""
    shipped = simulation.name in SHIPPED and not simulation.exists()
    spec = load_simulation(shipped_simulation(simulation.name) if shipped else simulation, payload)
    with ExitStack() as stack:
        address = BusAddress(interface, channel)
        if interface == "socketcand":
            address = stack.enter_context(Hub((channel,), port)).address()
        bus = open_bus(address)
        stack.callback(bus.shutdown)
        cell = SimulatedCell(spec, bus)
        typer.echo(f"{len(spec.axes)} amplifiers on {address}, payload {payload or 'none'}; Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            cell.serve_forever()


SIMULATE = Verb("simulate", simulate, "drivegain simulate demo --payload disc")
