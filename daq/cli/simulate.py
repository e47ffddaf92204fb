"""`drivegain simulate`: a simulated cell on a bus of its own, for the other verbs in another terminal."""

from __future__ import annotations

import signal
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.interrupt import interruptible
from daq.cli.verb import Verb
from daq.configuration.simulation import load_simulation, shipped_simulation
from drivers.bus import BusAddress, open_bus
from drivers.hub import Hub
from drivers.simulated.cell import SimulatedCell

SHIPPED = ("demo", "clean", "seven-axis", "gantry")


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
    """Run a simulated cell until Ctrl-C or SIGTERM: amplifiers that answer NMT, SDO, PDO, SYNC, heartbeat and EMCY.

    It prints the bus to write into the cell file of the other verbs, which then run in a second terminal.
    """
    shipped = simulation.name in SHIPPED and not simulation.exists()
    spec = load_simulation(shipped_simulation(simulation.name) if shipped else simulation, payload)
    # A terminal that has gone is no reason to end: that is what nohup is for.
    with suppress(KeyboardInterrupt), interruptible(signals=(signal.SIGINT, signal.SIGTERM)), ExitStack() as stack:
        address = BusAddress(interface, channel)
        if interface == "socketcand":
            address = stack.enter_context(Hub((channel,), port)).address()
        bus = open_bus(address)
        stack.callback(bus.shutdown)
        cell = SimulatedCell(spec, bus)
        typer.echo(f"{len(spec.axes)} amplifiers on {address}, payload {payload or 'none'}; Ctrl-C ends it")
        typer.echo(how_to_reach(address, spec.sync_period_us))
        cell.serve_forever()


def how_to_reach(address: BusAddress, period_us: int) -> str:
    """What the cell file of the other verbs must say, ready to paste, and a first command."""
    hub = f"  host: {address.host}\n  port: {address.port}\n" if address.interface == "socketcand" else ""
    # A kernel's bus carries frames in their own time; over a hub the simulated cell sets the pace.
    pacing = "timed" if address.interface == "socketcan" else "lockstep"
    return (
        "To reach it, let the cell file say this instead of its own `bus` and `sync`:\n\n"
        f"bus:\n  interface: {address.interface}\n  channel: {address.channel}\n{hub}"
        f"  bitrate_bit_s: {address.bitrate_bit_s}\nsync:\n  period_us: {period_us}\n  pacing: {pacing}\n\n"
        "and try it in a second terminal: drivegain scan CELL"
    )


SIMULATE = Verb("simulate", simulate, "drivegain simulate demo --payload disc")
