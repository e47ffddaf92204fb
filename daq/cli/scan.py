"""`drivegain scan`: who is on the bus; nothing is changed and nothing moves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from daq.cli.verb import JsonOption, Verb, print_json
from daq.configuration.cell import Cell
from daq.configuration.cell_file import load_cell
from daq.record import network_of
from drivers.errors import NodeMissing
from drivers.link import nmt_name
from drivers.scan import FoundNode


def scan_verb(
    cell: Annotated[Path, typer.Argument(help="Cell file.")],
    wait: Annotated[float, typer.Option(help="How long to wait for answers [s].", min=0.05, max=60.0)] = 0.5,
    json: JsonOption = False,
) -> None:
    """List the nodes on the cell's bus with identity, name and state, beside what the cell configuration expects."""
    declared = load_cell(cell)
    with network_of(declared) as network:
        found = network.scan(wait_s=wait)
    rows = scan_rows(declared, found)
    if json:
        print_json({"bus": str(network.link.address), "nodes": rows})
    else:
        Console(soft_wrap=True).print(scan_table(rows))
    missing = tuple(row["node_id"] for row in rows if row["verdict"] == "missing")
    if missing:
        raise NodeMissing(missing, tuple(node.node_id for node in found), wait)


def scan_rows(cell: Cell, found: tuple[FoundNode, ...]) -> list[dict[str, Any]]:
    """One row a node, configured or found."""
    axes = {axis.node_id: axis for axis in cell.axes if axis.node_id is not None}
    nodes = {node.node_id: node for node in found}
    rows = []
    for node_id in sorted(axes.keys() | nodes.keys()):
        axis, node = axes.get(node_id), nodes.get(node_id)
        identity = None if node is None else node.identity
        expected = None if axis is None else axis.identity
        if node is None:
            verdict = "missing"
        elif axis is None:
            verdict = "not configured"
        else:
            verdict = "ok" if expected is None or expected == identity else "other identity"
        rows.append(
            {
                "node_id": node_id,
                "axis": None if axis is None else axis.name,
                "vendor_id": None if identity is None else identity.vendor_id,
                "product_code": None if identity is None else identity.product_code,
                "serial": None if identity is None else identity.serial,
                "device_name": None if node is None else node.device_name,
                "nmt": None if node is None or node.nmt is None else nmt_name(node.nmt),
                "state": None if node is None or node.state is None else str(node.state),
                "verdict": verdict,
            }
        )
    return rows


def scan_table(rows: list[dict[str, Any]]) -> Table:
    """The rows for a person."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for heading in ("node", "axis", "vendor", "product", "serial", "NMT", "state", ""):
        table.add_column(heading, no_wrap=True)
    for row in rows:
        numbers = ("" if row[key] is None else f"{row[key]:#x}" for key in ("vendor_id", "product_code"))
        serial = "" if row["serial"] is None else str(row["serial"])
        words = ((row[key] or "").lower() for key in ("nmt", "state"))
        style = None if row["verdict"] == "ok" else "bold red"
        table.add_row(str(row["node_id"]), row["axis"] or "", *numbers, serial, *words, row["verdict"], style=style)
    return table


SCAN = Verb("scan", scan_verb, "drivegain scan cells/demo.yaml")
