"""`drivegain scan` and `drivegain explain-emcy`: the nodes on the bus, and the meaning of their error codes."""

from __future__ import annotations

import re
from typing import Annotated

import typer

from daq.cli.verb import CellArgument, JsonOption, Verb, print_json
from daq.errors import UsageError


def scan_verb(
    cell: CellArgument,
    wait: Annotated[float, typer.Option(help="How long to wait for answers [s].", min=0.05, max=60.0)] = 0.5,
    reset_faults: Annotated[
        bool,
        typer.Option(
            "--reset-faults",
            help="Reset every axis that is in FAULT, by 6040h; it stays without power, and nothing moves.",
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """List the nodes on the cell's buses with identity, name and state, and compare them with the cell file.

    Every node id is tried on every bus, so that an amplifier on the wrong bus is found. Nothing is changed without
    --reset-faults; find out why an axis is in fault before you reset it.
    """
    from rich.console import Console

    from daq.cli.terminal import print_view
    from daq.config.bus import bus_parts, cell_address, drive_axes
    from daq.config.cell_file import load_cell
    from daq.report.bus import current_signals, scan_rows, scan_view
    from drivers.canopen.network import CanopenNetwork
    from drivers.errors import NodeMissing
    from drivers.profiles.cia402 import State

    declared = load_cell(cell)
    found, reset = {}, []
    for part in bus_parts(declared):
        axes = tuple(axis for axis in drive_axes(declared) if axis.node_id in part.node_ids)
        with CanopenNetwork(part.address, axes) as network:
            found[part.name] = network.scan(wait_s=wait)
        in_fault = {node.node_id for node in found[part.name] if node.state is State.FAULT}
        faulty = tuple(axis for axis in axes if axis.node_id in in_fault)
        if reset_faults and faulty:
            with CanopenNetwork(part.address, faulty) as network:
                network.reset_faults()
            with CanopenNetwork(part.address, axes) as network:
                found[part.name] = network.scan(wait_s=wait)
            reset += [axis.name for axis in faulty]
    rows = [row for name, nodes in found.items() for row in scan_rows(declared, nodes, name)]
    if json:
        address = str(cell_address(declared))
        print_json({"bus": address, "nodes": rows, "reset": reset, "current": current_signals(declared)})
    else:
        print_view(scan_view(declared, rows, reset, Console().width))
    absent = {row["node_id"] for row in rows if row["verdict"] == "missing"}
    missing = [axis for axis in drive_axes(declared) if axis.node_id in absent]
    if missing:
        raise NodeMissing(missing, tuple(node.node_id for nodes in found.values() for node in nodes), wait)


SCAN = Verb("scan", scan_verb, "drivegain scan cells/demo.yaml")

_HEX = re.compile(r"(?:0[xX])?([0-9a-fA-F]{1,4})[hH]?")


def explain_emcy_verb(
    code: Annotated[str, typer.Argument(help="Hexadecimal, as in manuals: 8611, 8611h or 0x8611.")],
    json: JsonOption = False,
) -> None:
    """Explain an emergency error code (EMCY, object 603Fh) by CiA 301 and CiA 402.

    For a manufacturer's own code only its class is known; the drive's manual has the rest.
    """
    from drivers.canopen.emcy import CODES, describe

    number = read_code(code)
    text = describe(number)
    if json:
        print_json({"code": number, "hex": f"{number:04X}h", "text": text, "standard": number in CODES})
    else:
        typer.echo(f"{number:04X}h: {text}")


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


EXPLAIN_EMCY = Verb("explain-emcy", explain_emcy_verb, "drivegain explain-emcy 8611h")
