"""A bus and its axes: the nodes that `drivegain scan` finds, the state that `drivegain monitor` shows, the currents."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from daq.config.cell import PacingMode
from daq.config.cell_buses import bus_loads, bus_loads_percent
from daq.report.text import picked, plain_table, printable, terminal_text
from daq.workflow.events import event_document
from drivers.profiles.cia402 import ENABLED, FAULTY, State, decode

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.workflow.monitor import WatchedCell
    from drivers.canopen.node_scan import FoundNode
    from drivers.profiles.profile import Identity
    from drivers.stream.monitor import AxisReading


def scan_view(
    rows: list[dict[str, Any]], reset: Mapping[str, str], mistyped: Sequence[str] = (), warnings: Sequence[str] = ()
) -> Iterator[RenderableType]:
    """Table of the nodes on all buses, and what needs attention.

    `reset` has the fault of each axis that was reset, `mistyped` the nameplates that `plan` and `record` would refuse,
    `warnings` what `record` would warn of.
    """
    yield scan_table(rows)
    for row in rows:
        name = f"{printable(row['axis'])} (node {row['node_id']})" if row["axis"] else f"node {row['node_id']}"
        if row["enabled"]:
            yield Text(f"{name} IS ENABLED: its motor has torque and may move at any time.", "bold red")
        yield from (Text(f"{name}: {printable(remark)}", "yellow") for remark in row["remarks"])
    for name, fault in reset.items():
        yield Text(f"The fault of {printable(name)} was reset; it has no power. It was {printable(fault)}.")
    if any(row["in_fault"] for row in rows):
        yield Text(
            "An axis is in fault. Its display, the drive's own tool or an EMCY in the log of the last run (`drivegain "
            "explain-emcy`) shows the cause. Remove it, then reset the fault with --reset-faults; nothing moves.",
            "yellow",
        )
    yield from (Text(printable(text), "yellow") for text in (*mistyped, *warnings))


_IDENTITY = ("vendor_id", "product_code", "serial")


def scan_rows(
    cell: Cell, found: tuple[FoundNode, ...], bus: str, misfits: Mapping[str, str] | None = None
) -> list[dict[str, Any]]:
    """Rows of the nodes of one bus, configured or found; `misfits` describes objects that a drive lacks, by axis."""
    from drivers.canopen.link import nmt_name  # noqa: PLC0415 - `info` shows currents without the CAN library

    homes = {axis.node_id: axis for axis in cell.axes if axis.node_id is not None}
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
            verdict = f"belongs on {homes[node_id].bus}" if node_id in homes else "not configured"
        elif node.shared:
            verdict = "two devices"
        else:
            verdict = _identity_verdict(expected, identity)
        misfit = "" if axis is None else (misfits or {}).get(axis.name, "")
        if misfit and verdict == "ok":
            verdict = "profile does not fit"
        in_fault = node is not None and node.state in FAULTY
        if in_fault:
            verdict = "in fault" if verdict == "ok" else f"{verdict}, in fault"
        rows.append(
            {
                "bus": bus,
                "node_id": node_id,
                "axis": homes[node_id].name if node_id in homes else None,
                **(dict.fromkeys(_IDENTITY) if identity is None else picked(identity, *_IDENTITY)),
                "device_name": None if node is None else node.device_name,
                "nmt": None if node is None or node.nmt is None else nmt_name(node.nmt),
                "state": None if node is None or node.state is None else str(node.state),
                "enabled": None if node is None or node.state is None else node.state in ENABLED,
                "in_fault": in_fault,
                "verdict": verdict,
                "remarks": [*_remarks(node, expected), *([misfit] if misfit else [])],
            }
        )
    return rows


def _identity_verdict(expected: Identity | None, found: Identity | None) -> str:
    if expected is None:
        return "ok"
    if found is None:
        return "no identity"
    differing = expected.differences(found)
    return f"other {differing[0].partition(' 1018h')[0]}" if differing else "ok"


def _remarks(node: FoundNode | None, expected: Identity | None) -> Iterator[str]:
    """Describe what is wrong with a node."""
    if node is None:
        return
    if node.shared:
        yield f"found {node.shared}; two devices have this node id, give one of them another"
    if expected is not None and node.identity is not None:
        yield from expected.differences(node.identity)
    yield from node.problems


_POWER = {True: "ENABLED", False: "off", None: "?"}


def scan_table(rows: list[dict[str, Any]]) -> Table:
    """Table of the nodes; first what decides whether a recording can start, then the identity."""
    several = len({row["bus"] for row in rows}) > 1
    headings = ("node", "axis", "power", "verdict", "state", "vendor", "product", "serial", "NMT", "name")
    columns = (*(("bus",) if several else ()), *headings)
    table = plain_table(columns, left=range(len(columns)), keys=2 + several)
    for row in rows:
        cells = (
            *((row["bus"],) if several else ()),
            str(row["node_id"]),
            row["axis"] or "",
            _POWER[row["enabled"]],
            row["verdict"],
            (row["state"] or "").lower(),
            "" if row["vendor_id"] is None else f"{row['vendor_id']:#x}",
            "" if row["product_code"] is None else f"{row['product_code']:#x}",
            "" if row["serial"] is None else str(row["serial"]),
            (row["nmt"] or "").lower(),
            row["device_name"] or "",
        )
        style = "bold red" if row["enabled"] or row["verdict"] != "ok" else None
        table.add_row(*map(terminal_text, cells), style=style)
    return table


def monitor_document(cell: Cell, watched: WatchedCell) -> dict[str, Any]:
    """JSON document of one reading of the bus."""
    from drivers.canopen.link import nmt_name  # noqa: PLC0415 - as above

    reading, faults, prediction = watched.reading, watched.faults, watched.prediction
    # While another master prepares, it sends no SYNC, and no axis has to answer.
    addressed = reading.source.value == "asked" or reading.sync_hz > 0.0
    axes: list[dict[str, Any]] = []
    for declared, axis, position, ampere_per_unit in zip(
        cell.axes, reading.axes, watched.position, watched.ampere, strict=True
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
                "in_fault": state in FAULTY,
                "statusword": word,
                "nmt": None if axis.nmt is None else nmt_name(axis.nmt),
                **picked(axis, "rate_hz", "lost"),
                "silent": addressed and not axis.heard,
                "delay_s": axis.delay_s,
                "refused": [{"object": str(one.entry), "abort_code": one.abort_code} for one in axis.refused],
                "remark": "; ".join(_answer_remarks(axis)),
                "fault": asdict(faults[declared.name]) if state in FAULTY and declared.name in faults else None,
                "prediction": prediction["axes"][len(axes)] if prediction is not None and prediction["axes"] else None,
            }
        )
    loads = bus_loads_percent(cell, reading)
    return {
        "cell": cell.name,
        "source": reading.source.value,
        "recorder": watched.recorder,
        **picked(reading, "seconds", "sync_hz"),
        "frames_per_s": sum(map(sum, reading.frames)) / reading.seconds,
        "bus_load_percent": max(loads),
        "buses": [{"bus": bus.name, "load_percent": load} for bus, load in zip(cell.buses, loads, strict=True)],
        "axes": axes,
        "prediction": None if prediction is None else {key: prediction[key] for key in ("payload", "remark")},
        "events": [event.text for event in watched.events],
        "notices": [
            event_document(
                event.kind, event.code, None if event.axis is None else cell.axis_names[event.axis], event.text
            )
            for event in watched.events
        ],
    }


def _answer_remarks(axis: AxisReading) -> Iterator[str]:
    """Describe the answers of an axis that are late or without a value."""
    for one in axis.refused:
        if one.abort_code is None:
            yield f"answers without a value of {one.entry.bits} bits for {one.entry}"
        else:
            yield f"answers with abort 0x{one.abort_code:08X} for {one.entry}"
    if axis.delay_s is not None and axis.is_late:
        yield f"answers after {1e3 * axis.delay_s:.0f} ms"


_ALARMING = {str(state) for state in (*FAULTY, State.QUICK_STOP_ACTIVE)}
_SOURCE_TEXT = {
    "overheard": "another master leads this bus; its traffic is read and nothing is sent",
    "recorder": "drivegain's recorder, or another of its verbs, uses this bus; its traffic is read and nothing is sent",
    "asked": "no other master: the axes are queried, nothing is written",
}
_FAULT_UNKNOWN = "the drive names no error code; find the cause, then `drivegain scan CELL --reset-faults`"


def monitor_view(document: dict[str, Any]) -> Group:
    """Tables of the axes, with the load of the buses and recent events, from `monitor_document`."""
    table = plain_table(("axis", "position", "current", "state", "rate Hz", "lost"), left=(0, 3))
    faults = []
    for axis in document["axes"]:
        position = "?" if axis["position"] is None else f"{axis['position']:.3f} {axis['unit']}"
        current = "?" if axis["current_raw"] is None else f"{axis['current_raw']:+d} raw"
        if axis["current_a"] is not None:
            current = f"{axis['current_a']:+.3f} A"
        if axis["enabled"] is False:
            current = "no power"  # the number is an old reference, or the offset of a sensor
        note, style = (" (ENABLED)", "bold green") if axis["enabled"] else ("", None)
        if axis["state"] in _ALARMING:
            style = "bold red"
        if axis["silent"]:
            note, style = " (SILENT)", "bold red"
        state = (axis["state"] or "?").lower() + note
        cells = (printable(axis["axis"]), position, current, state, f"{axis['rate_hz']:.1f}", str(axis["lost"]))
        table.add_row(*map(Text, cells), style=style)
        if axis["remark"]:
            faults.append(Text(f"{printable(axis['axis'])} {axis['remark']}", "yellow"))
        if axis["in_fault"]:
            fault = axis["fault"]
            text = _FAULT_UNKNOWN if fault is None else f"{fault['hex']} {fault['text']}; {fault['remedy']}"
            faults.append(Text(f"{printable(axis['axis'])} is in fault: {text}", "bold red"))
    source = "recorder" if document["source"] == "overheard" and document["recorder"] else document["source"]
    head = Text(printable(f"{document['cell']}: {_SOURCE_TEXT[source]}"))
    loads = ", ".join(f"{printable(bus['bus'])} {bus['load_percent']:.1f} % at worst" for bus in document["buses"])
    load = Text(f"{loads}, {document['frames_per_s']:.0f} frames/s, SYNC {document['sync_hz']:.1f} Hz")
    return Group(head, table, load, *prediction_view(document), *faults, *map(_notice, document["notices"]))


def prediction_view(document: dict[str, Any]) -> Iterator[RenderableType]:
    """Measured beside predicted current, or why there is none; nothing without a calibration."""
    if document["prediction"] is None:
        return
    remark, payload = document["prediction"]["remark"], document["prediction"]["payload"]
    if remark:
        yield Text(printable(remark))
    if not any(axis["prediction"] for axis in document["axes"]):
        return
    table = plain_table(("axis", "measured", "predicted", "± band", "residual rms", "outside"))
    for axis in document["axes"]:
        found = axis["prediction"]
        values = [
            "at rest" if value is None and name == "predicted" else "-" if value is None else f"{value:+.3f}"
            for name, value in ((name, found[name]) for name in ("measured", "predicted"))
        ]
        if axis["enabled"] is False:
            values[0] = "no power"
        band, rms = ("-" if found[name] is None else f"{found[name]:.3f}" for name in ("band", "residual_rms"))
        cells = (printable(axis["axis"]), *values, band, rms, f"{100 * found['outside_share']:.0f} %")
        table.add_row(*map(Text, cells), style="bold yellow" if found["conspicuous"] else None)
    carried = "without payload" if payload is None else f"with payload {printable(payload)}"
    yield Text(
        "Currents of half a second ago, in the unit of the gains' current, filtered as in the fit, "
        f"{carried}; residual of the last 10 s in which the axis moved:"
    )
    yield table


def _notice(notice: dict[str, Any]) -> Text:
    """One event, with its remedy where it is alarming."""
    where = "" if notice["axis"] is None else f"{notice['axis']}: "
    remedy = f"; {notice['remedy']}" if notice["remedy"] else ""
    return Text(printable(f"{where}{notice['text']}{remedy}"), "yellow" if notice["alarm"] else "")


def current_signals(cell: Cell) -> dict[str, str]:
    """Recorded current of each axis with an amplifier, such as "current reference 6074h:00, rms"."""
    return {
        axis.name: f"{axis.profile.signal}, amplitude {axis.profile.amplitude.value}"
        for axis in cell.axes
        if axis.profile is not None
    }


def load_lines(cell: Cell) -> tuple[str, ...]:
    """Describe the load that a recording puts on each bus."""
    lockstep = cell.sync is not None and cell.sync.pacing is PacingMode.LOCKSTEP
    says = "in lockstep; a real bus would be loaded by" if lockstep else "loaded by"
    return tuple(f"{bus.name} ({bus.interface}:{bus.channel}): {says} {load}" for bus, load in bus_loads(cell))
