"""`drivegain scan`: who is on the bus; nothing is changed and nothing moves."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.config.bus import bus_parts, cell_address, drive_axes
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.errors import UsageError
from daq.report.fit import actual_current_note, current_signals
from drivers.canopen.emcy import CODES, describe
from drivers.canopen.link import nmt_name
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.scan import FoundNode
from drivers.errors import NodeMissing
from drivers.profiles.cia402 import State

ENABLED = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
"""States in which the drive function is enabled and the motor has torque (CiA 402-2, finite state automaton)."""


FAULTY = (State.FAULT, State.FAULT_REACTION_ACTIVE)
IN_FAULT = (
    "An axis is in fault: its own display or tool says why, or an EMCY in the log of the last run (`drivegain "
    "explain-emcy`). When the cause is gone, --reset-faults resets it; nothing moves."
)


def scan_verb(
    cell: Annotated[Path, typer.Argument(help="Cell file.")],
    wait: Annotated[float, typer.Option(help="How long to wait for answers [s].", min=0.05, max=60.0)] = 0.5,
    reset_faults: Annotated[
        bool,
        typer.Option(
            "--reset-faults",
            help="Reset the fault of every axis that is in FAULT, by 6040h; it stays without power, and nothing moves.",
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """List the nodes on the cell's buses with identity, name and state, beside what the cell configuration expects.

    Each bus is searched by itself for every node id, so that an amplifier on the wrong one is found there. Nothing is
    changed but by --reset-faults: find out first why the axis is in fault.
    """
    declared = load_cell(cell)
    found, reset = {}, []
    for part in bus_parts(declared):
        axes = tuple(axis for axis in drive_axes(declared) if axis.node_id in part.node_ids)
        with CanopenNetwork(part.address, axes) as network:
            found[part.name] = network.scan(wait_s=wait)
        faulty = tuple(axis for axis in axes if axis.node_id in _in_fault(found[part.name]))
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
        console = Console(soft_wrap=True)
        console.print(scan_table(rows, console.width, several=len(found) > 1))
        for row in rows:
            if row["enabled"]:
                name = f"node {row['node_id']}" + (f" ({printable(row['axis'])})" if row["axis"] else "")
                console.print(Text(f"{name} IS ENABLED: its motor has torque and may move at any time.", "bold red"))
        for name in reset:
            console.print(Text(f"The fault of {printable(name)} was reset; it has no power."))
        if any(row["in_fault"] for row in rows):
            console.print(Text(IN_FAULT, "yellow"))
        note = actual_current_note(declared)
        if note is not None:
            console.print(Text(note, "yellow"))
    absent = {row["node_id"] for row in rows if row["verdict"] == "missing"}
    missing = [axis for axis in drive_axes(declared) if axis.node_id in absent]
    if missing:
        raise NodeMissing(missing, tuple(node.node_id for nodes in found.values() for node in nodes), wait)


def scan_rows(cell: Cell, found: tuple[FoundNode, ...], bus: str) -> list[dict[str, Any]]:
    """One row for each node that is configured or found on a bus.

    Args:
        cell: what is expected.
        found: on the bus.
        bus: its name.
    """
    homes = {axis.node_id: axis.bus for axis in cell.axes if axis.node_id is not None}
    axes = {axis.node_id: axis for axis in cell.axes if axis.node_id is not None and axis.bus == bus}
    nodes = {node.node_id: node for node in found}
    rows = []
    for node_id in sorted(axes.keys() | nodes.keys()):
        axis, node = axes.get(node_id), nodes.get(node_id)
        identity = None if node is None else node.identity
        expected = None if axis is None else axis.identity
        if node is None:
            verdict = "missing"
        elif axis is None:
            verdict = f"belongs on {homes[node_id]}" if node_id in homes else "not configured"
        else:
            verdict = "ok" if expected is None or expected == identity else "other identity"
        in_fault = node is not None and node.state in FAULTY
        if in_fault:
            verdict = "in fault" if verdict == "ok" else f"{verdict}, in fault"
        rows.append(
            {
                "bus": bus,
                "node_id": node_id,
                "axis": None if axis is None else axis.name,
                "vendor_id": None if identity is None else identity.vendor_id,
                "product_code": None if identity is None else identity.product_code,
                "serial": None if identity is None else identity.serial,
                "device_name": None if node is None else node.device_name,
                "nmt": None if node is None or node.nmt is None else nmt_name(node.nmt),
                "state": None if node is None or node.state is None else str(node.state),
                "enabled": None if node is None or node.state is None else node.state in ENABLED,
                "in_fault": in_fault,
                "verdict": verdict,
            }
        )
    return rows


def _in_fault(found: Iterable[FoundNode]) -> frozenset[int]:
    return frozenset(node.node_id for node in found if node.state is State.FAULT)


_GAP = 3
_DISPENSABLE = ("nmt", "vendor", "product", "serial", "state")
"""Left out one after the other where a terminal is too narrow; `--json` has them all."""
_POWER = {True: "ENABLED", False: "off", None: "?"}


def scan_table(rows: list[dict[str, Any]], width: int = 80, several: bool = False) -> Table:
    """The rows for a person, in at most so many columns; bus (of several), node, axis, power and verdict are whole."""
    columns = {
        **({"bus": [printable(row["bus"]) for row in rows]} if several else {}),
        "node": [str(row["node_id"]) for row in rows],
        "axis": [printable(row["axis"] or "") for row in rows],
        "vendor": ["" if row["vendor_id"] is None else f"{row['vendor_id']:#x}" for row in rows],
        "product": ["" if row["product_code"] is None else f"{row['product_code']:#x}" for row in rows],
        "serial": ["" if row["serial"] is None else str(row["serial"]) for row in rows],
        "nmt": [(row["nmt"] or "").lower() for row in rows],
        "state": [(row["state"] or "").lower() for row in rows],
        "power": [_POWER[row["enabled"]] for row in rows],
        "verdict": [row["verdict"] for row in rows],
    }
    wide = {heading: max(map(cell_len, (heading, *texts))) for heading, texts in columns.items()}
    for heading in _DISPENSABLE:
        if sum(wide.values()) + _GAP * (len(wide) - 1) <= width:
            break
        del wide[heading], columns[heading]
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for heading, least in wide.items():
        table.add_column(heading.upper() if heading == "nmt" else heading, no_wrap=True, min_width=least)
    for row, texts in zip(rows, zip(*columns.values(), strict=True), strict=True):
        style = "bold red" if row["enabled"] or row["verdict"] != "ok" else None
        table.add_row(*map(Text, texts), style=style)
    return table


SCAN = Verb("scan", scan_verb, "drivegain scan cells/demo.yaml")


# `drivegain explain-emcy`: what an error code of an amplifier means.


_HEX = re.compile(r"(?:0[xX])?([0-9a-fA-F]{1,4})[hH]?")


def explain_emcy_verb(
    code: Annotated[str, typer.Argument(help="As manuals write it, in hexadecimal: 8611, 8611h or 0x8611.")],
    json: JsonOption = False,
) -> None:
    """Say what an emergency error code (EMCY, object 603Fh) means by CiA 301 and CiA 402.

    Codes that these leave to the manufacturer are told by their class; the drive's manual knows more.
    """
    number = read_code(code)
    standard = number in CODES
    text = describe(number)
    if json:
        print_json({"code": number, "hex": f"{number:04X}h", "text": text, "standard": standard})
        return
    typer.echo(f"{number:04X}h: {text}")


def read_code(text: str) -> int:
    """The number in a code as people write it.

    Raises:
        UsageError: it is no hexadecimal number of at most four digits.
    """
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
