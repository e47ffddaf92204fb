"""`drivegain monitor`: the state of the axes; nothing is changed, and nothing is sent while another master is there."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.cli.verb import CellArgument, JsonOption, Verb, print_json

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from drivers.canopen.network import CanopenNetwork

_SHOWN_EVENTS = 5


def monitor_verb(
    cell: CellArgument,
    once: Annotated[bool, typer.Option("--once", help="Show one reading and end.")] = False,
    interval: Annotated[float, typer.Option(help="Time between two readings [s].", min=0.1, max=60.0)] = 0.5,
    json: JsonOption = False,
) -> None:
    """Show position, current, state, rate and losses of every axis, and the load of the bus, until Ctrl-C.

    The first two seconds only listen. While another master is on the bus, nothing is sent, and the axes' answers to
    that master are shown; otherwise the axes are queried. Nothing is written, enabled or moved. --json implies --once.
    """
    from contextlib import suppress

    from rich.console import Console
    from rich.live import Live

    from daq.cli.terminal import interruptible
    from daq.config.bus import cell_address, drive_axes
    from daq.config.cell_file import load_cell
    from daq.report.bus import monitor_view
    from drivers.canopen.network import CanopenNetwork
    from drivers.canopen.sdo import SdoPolicy
    from drivers.errors import NodeMissing
    from drivers.stream.monitor import QUIET_S

    declared = load_cell(cell)
    console = Console(highlight=False)
    policy = SdoPolicy(timeout_s=0.3, attempts=2)
    with (
        suppress(KeyboardInterrupt),
        interruptible(),
        CanopenNetwork(cell_address(declared), drive_axes(declared), policy=policy) as network,
    ):
        readings = _readings(declared, network, interval)
        if once or json or not console.is_terminal:
            document = next(readings)
            if json:
                print_json(document)
            else:
                console.print(monitor_view(document))
            silent = [axis for axis, shown in zip(network.axes, document["axes"], strict=True) if shown["silent"]]
            heard = tuple(axis["node_id"] for axis in document["axes"] if not axis["silent"])
            if silent:
                raise NodeMissing(silent, heard, QUIET_S + interval)
            return
        with Live(console=console, auto_refresh=False, screen=False) as live:
            for document in readings:
                live.update(monitor_view(document), refresh=True)


def _readings(cell: Cell, network: CanopenNetwork, interval_s: float) -> Iterator[dict[str, Any]]:
    """Yield documents without end, the first after the time in which another master would have been heard."""
    from collections import deque
    from contextlib import suppress

    from daq.report.bus import monitor_document
    from drivers.errors import DriverError
    from drivers.profiles.scale import read_scale
    from drivers.stream.monitor import QUIET_S, CellMonitor, Source
    from drivers.stream.sample import EventKind

    monitor = CellMonitor(network.link, network.axes)
    ampere: list[float | None] = [None] * len(network.axes)
    unknown = set(range(len(network.axes)))
    event_lines: deque[str] = deque(maxlen=_SHOWN_EVENTS)
    # At the start a node's presence is no news; an error is.
    event_lines.extend(event.text for event in monitor.watch(QUIET_S).events if event.kind is not EventKind.NMT)
    while True:
        reading = monitor.watch(interval_s)
        answering = [axis for axis in unknown if reading.axes[axis].current_raw is not None]
        if reading.source is Source.ASKED and answering:
            monitor.pause()
            for axis in answering:
                unknown.remove(axis)
                with suppress(DriverError):  # its current stays a raw number, and is shown as one
                    access = network.link.objects(network.node_ids[axis])
                    ampere[axis] = read_scale(access, network.axes[axis].profile).ampere_per_unit
        event_lines.extend(event.text for event in reading.events)
        yield monitor_document(cell, reading, ampere, list(event_lines))


MONITOR = Verb("monitor", monitor_verb, "drivegain monitor cells/demo.yaml")
