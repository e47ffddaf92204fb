"""`drivegain monitor`: what the axes do now; it changes nothing, and asks nothing while another master is there."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from daq.cli.scan import ENABLED
from daq.cli.terminal import interruptible
from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.config.bus import cell_address, drive_axes, frame_bits
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from drivers.canopen.link import nmt_name
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.sdo import SdoPolicy
from drivers.errors import DriverError, NodeMissing
from drivers.profiles.cia402 import decode
from drivers.profiles.profile import Axis
from drivers.profiles.scale import read_scale
from drivers.stream.monitor import QUIET_S, CellMonitor, CellReading, Source
from drivers.stream.sample import EventKind

POLICY = SdoPolicy(timeout_s=0.3, attempts=2)
SHOWN_EVENTS = 5
_SAID = {
    Source.OVERHEARD: "another master leads this bus: overheard, nothing is sent",
    Source.ASKED: "no other master: the axes are asked, nothing is written",
}


def monitor_verb(
    cell: Annotated[Path, typer.Argument(help="Cell file.")],
    once: Annotated[bool, typer.Option("--once", help="Show one reading and end.")] = False,
    interval: Annotated[float, typer.Option(help="Between two readings [s].", min=0.1, max=60.0)] = 0.5,
    json: JsonOption = False,
) -> None:
    """Show position, current, state, rate and losses of every axis, and the load of the bus, until Ctrl-C.

    It listens for two seconds first. While another master is on the bus it sends nothing and reads what the axes answer
    to that one's SYNC; otherwise it asks them. It never writes, enables or moves. --json implies --once.
    """
    declared = load_cell(cell)
    console = Console(highlight=False)
    with (
        suppress(KeyboardInterrupt),
        interruptible(),
        CanopenNetwork(cell_address(declared), drive_axes(declared), policy=POLICY) as network,
    ):
        readings = _readings(declared, network, interval)
        if once or json or not console.is_terminal:
            document = next(readings)
            if json:
                print_json(document)
            else:
                console.print(view(document))
            _require(network.axes, document, QUIET_S + interval)
            return
        with Live(console=console, auto_refresh=False, screen=False) as live:
            for document in readings:
                live.update(view(document), refresh=True)


def _readings(cell: Cell, network: CanopenNetwork, interval_s: float) -> Iterator[dict[str, Any]]:
    """Documents without end; the first after the time in which another master would have been heard."""
    monitor = CellMonitor(network.link, network.axes)
    ampere: list[float | None] = [None] * len(network.axes)
    unknown = set(range(len(network.axes)))
    event_lines: deque[str] = deque(maxlen=SHOWN_EVENTS)
    # That a node is there is no news at the beginning; an error is.
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
        yield describe(cell, reading, ampere, list(event_lines))


def describe(cell: Cell, reading: CellReading, ampere: list[float | None], events: list[str]) -> dict[str, Any]:
    """A reading as a JSON object.

    Args:
        cell: whose reading it is.
        reading: of the bus.
        ampere: of a raw unit of each axis' current [A], None where it is not known.
        events: to tell with it, the oldest first.
    """
    axes = []
    for declared, axis, position, ampere_per_unit in zip(
        cell.axes, reading.axes, joint_positions(cell, reading), ampere, strict=True
    ):
        raw, word = axis.current_raw, axis.statusword
        state = None if word is None else decode(word)
        axes.append(
            {
                "axis": declared.name,
                "node_id": declared.node_id,
                "position": None if position is None else position / declared.unit.si,
                "unit": declared.unit.name,
                "position_counts": axis.position_counts,
                "current_a": None if raw is None or ampere_per_unit is None else raw * ampere_per_unit,
                "current_raw": raw,
                "state": None if state is None else str(state),
                "enabled": None if state is None else state in ENABLED,
                "statusword": word,
                "nmt": None if axis.nmt is None else nmt_name(axis.nmt),
                "rate_hz": axis.rate_hz,
                "lost": axis.lost,
                "silent": axis.rate_hz == 0.0,
            }
        )
    loads = bus_loads_percent(cell, reading)
    return {
        "cell": cell.name,
        "source": reading.source.value,
        "seconds": reading.seconds,
        "sync_hz": reading.sync_hz,
        "frames_per_s": sum(map(sum, reading.frames)) / reading.seconds,
        "bus_load_percent": max(loads),
        "buses": [{"bus": bus.name, "load_percent": load} for bus, load in zip(cell.buses, loads, strict=True)],
        "axes": axes,
        "events": events,
    }


def joint_positions(cell: Cell, reading: CellReading) -> list[float | None]:
    """Position of each joint [rad, or m], q = R⁻¹ q_motor + offset (paper eq. 24); None where a motor is unknown."""
    to_joint = np.linalg.inv(cell.ratio)
    turns = [
        None
        if axis.position_counts is None or not declared.counts_per_revolution
        else axis.position_counts / declared.counts_per_revolution
        for declared, axis in zip(cell.axes, reading.axes, strict=True)
    ]
    motor_rad = np.array([0.0 if turn is None else 2.0 * np.pi * turn for turn in turns])
    unknown = np.array([turn is None for turn in turns])
    offset = np.array([axis.zero_offset_rad for axis in cell.axes])
    joint = to_joint @ motor_rad + offset
    # A joint needs the motors that move it, and no others.
    blind = (np.abs(to_joint) > 1e-12 * np.abs(to_joint).max()) @ unknown
    return [None if hidden else float(value) for hidden, value in zip(blind, joint, strict=True)]


def bus_loads_percent(cell: Cell, reading: CellReading) -> tuple[float, ...]:
    """Of the bits that each wire could carry, with every frame as long as stuffing can make it [%]."""
    return tuple(
        100.0
        * sum(count * frame_bits(length) for length, count in enumerate(frames))
        / (bus.bitrate_bit_s * reading.seconds)
        for bus, frames in zip(cell.buses, reading.frames, strict=True)
    )


def view(document: dict[str, Any]) -> Group:
    """The same for a person."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for heading in ("axis", "position", "current", "state", "rate Hz", "lost"):
        table.add_column(heading, no_wrap=True, justify="left" if heading in ("axis", "state") else "right")
    for axis in document["axes"]:
        table.add_row(*map(Text, _cells(axis)), style=_style(axis))
    head = Text(printable(f"{document['cell']}: {_SAID[Source(document['source'])]}"))
    loads = ", ".join(f"{printable(bus['bus'])} {bus['load_percent']:.1f} % at worst" for bus in document["buses"])
    load = Text(f"{loads}, {document['frames_per_s']:.0f} frames/s, SYNC {document['sync_hz']:.1f} Hz")
    return Group(head, table, load, *(Text(printable(event), "yellow") for event in document["events"]))


def _cells(axis: dict[str, Any]) -> tuple[str, ...]:
    position = "?" if axis["position"] is None else f"{axis['position']:.3f} {axis['unit']}"
    if axis["current_a"] is not None:
        current = f"{axis['current_a']:+.3f} A"
    else:
        current = "?" if axis["current_raw"] is None else f"{axis['current_raw']:+d} raw"
    state = (axis["state"] or "?").lower()
    if axis["silent"]:
        state += " (SILENT)"
    elif axis["enabled"]:
        state += " (ENABLED)"
    return printable(axis["axis"]), position, current, state, f"{axis['rate_hz']:.1f}", str(axis["lost"])


def _style(axis: dict[str, Any]) -> str | None:
    if axis["silent"]:
        return "red"
    return "bold" if axis["enabled"] else None


def _require(axes: Sequence[Axis], document: dict[str, Any], waited_s: float) -> None:
    """Make sure that no axis is silent, where one reading is all there is.

    Raises:
        NodeMissing: some axes were silent.
    """
    silent = [axis for axis, shown in zip(axes, document["axes"], strict=True) if shown["silent"]]
    heard = tuple(axis["node_id"] for axis in document["axes"] if not axis["silent"])
    if silent:
        raise NodeMissing(silent, heard, waited_s)


MONITOR = Verb("monitor", monitor_verb, "drivegain monitor cells/demo.yaml")
