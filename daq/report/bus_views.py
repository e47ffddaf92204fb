"""A bus and its axes: the nodes that `drivegain scan` finds,
the state that `drivegain monitor` shows, the currents.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from daq.config.cell import PacingMode
from daq.config.cell_buses import bus_loads, bus_loads_percent, cell_address
from daq.report.document import Figure, Report
from daq.report.text import known_text, plain_table, printable, terminal_text
from daq.workflow.events import notice_of
from drivers.canopen.emcy import CODES
from drivers.profiles.cia402 import ENABLED, FAULTY, State, decode

if TYPE_CHECKING:
    from daq.config.cell import Cell, CellAxis, Wired, WiredAxis
    from daq.workflow.live_prediction import RecentCurrent
    from daq.workflow.monitor import WatchedCell
    from drivers.canopen.emcy import ErrorCode
    from drivers.canopen.node_scan import FoundNode
    from drivers.messages import CellEvent
    from drivers.profiles.profile import Identity
    from drivers.stream.monitor import AxisReading


class ErrorCodeEntry(Report):
    """An error code of EMCY or 603Fh in words."""

    code: int
    hex: str
    text: str
    remedy: str


class ErrorCodeReport(ErrorCodeEntry):
    """`explain-emcy`."""

    standard: bool
    """whether CiA 301 or CiA 402 names it; else its class is described"""


class PredictedCurrent(Report):
    """Current of one axis by a calibration, half a second ago,
    filtered as in the fit [unit of the gain's current].
    """

    measured: Figure
    """null at standstill, or where the scale of the current is unknown"""
    predicted: Figure
    """null at standstill"""
    band: Figure
    """null for a calibration that does not say what it left of the currents"""
    residual_rms: Figure
    """over the last 10 s in which the axis moved; null before any"""
    outside_share: float
    """share of that time in which the residual is outside the band"""
    conspicuous: bool
    """it is outside for more than half of at least 2 s of motion"""


class RefusedObject(Report):
    """Object that an axis does not give."""

    object: str
    """index and sub-index, as 6041h:00"""
    abort_code: int | None
    """of the SDO abort; null for an answer that is no value of this size"""


class MonitoredAxis(Report):
    """One axis."""

    axis: str
    node_id: int
    position: Figure
    unit: str
    """of the position"""
    position_counts: int | None
    current_a: Figure
    current_raw: int | None
    state: str | None
    """state of CiA 402"""
    enabled: bool | None
    """whether the motor has torque"""
    in_fault: bool
    statusword: int | None
    nmt: str | None
    """NMT state of CiA 301"""
    rate_hz: float
    """of complete answers"""
    lost: int
    """SYNCs or requests without an answer"""
    silent: bool
    """it should answer, and sent nothing at all, not even a heartbeat"""
    delay_s: Figure
    """longest time until an answer; null where nothing was asked or answered"""
    refused: list[RefusedObject]
    remark: str
    """answers that are late or without a value; empty if there are none"""
    fault: ErrorCodeEntry | None
    """of an axis in fault, where its code is known"""
    prediction: PredictedCurrent | None


class MonitoredBus(Report):
    """Load of one bus."""

    bus: str
    load_percent: float
    """with every frame as long as bit stuffing can make it"""


class PredictionState(Report):
    """Premise of the predicted currents."""

    payload: str | None
    remark: str
    """why there are none; empty if there are"""


class Notice(Report):
    """A recent event."""

    axis: str | None
    kind: str
    code: int
    text: str
    remedy: str
    alarm: bool


class MonitorReport(Report):
    """`monitor`."""

    cell: str
    source: str
    """asked, or overheard while another master leads the bus"""
    recorder: bool
    """whether a recording or job of drivegain has the bus"""
    seconds: float
    sync_hz: float
    frames_per_s: float
    bus_load_percent: float
    """of the most loaded bus"""
    buses: list[MonitoredBus]
    axes: list[MonitoredAxis]
    prediction: PredictionState | None
    """null without --calibration"""
    events: list[str]
    """texts of recent events"""
    notices: list[Notice]
    """the same events with what to do"""


class ScannedNode(Report):
    """A node that is in the cell file or on the bus."""

    bus: str
    node_id: int
    axis: str | None
    vendor_id: int | None
    product_code: int | None
    serial: int | None
    device_name: str | None
    nmt: str | None
    """NMT state of CiA 301"""
    state: str | None
    """state of CiA 402"""
    enabled: bool | None
    """whether the motor has torque"""
    in_fault: bool
    verdict: str
    remarks: list[str]
    """what is wrong with it"""


class ScanReport(Report):
    """`scan`."""

    bus: str
    """address of all buses"""
    nodes: list[ScannedNode]
    reset: list[str]
    """axes whose fault was reset"""
    faults: dict[str, str]
    """the fault of each of them"""
    current: dict[str, str]
    """recorded current of each axis"""
    mistyped: list[str]
    """nameplate gains that plan or record would refuse"""
    warnings: list[str]
    """what record would warn of, such as a gain that is near √2 times the drive's"""
    cell_fault: str
    """why every other verb refuses the cell file, apart from the profiles in `remarks`;
    empty where none does
    """


def error_code_report(found: ErrorCode) -> ErrorCodeReport:
    """Return an error code in words, and whether a standard names it."""
    return ErrorCodeReport.of(found, standard=found.code in CODES)


def scan_report(
    cell: Wired,
    nodes: Sequence[ScannedNode],
    faults: Mapping[str, str],
    mistyped: Sequence[str],
    warnings: Sequence[str],
    cell_fault: str = "",
) -> ScanReport:
    """Return what a scan of all buses found.

    Args:
        cell: content of its file.
        nodes: of all buses, as `scanned_nodes` gives them.
        faults: of each axis that was reset.
        mistyped: nameplates that `plan` and `record` would refuse.
        warnings: what `record` would warn of.
        cell_fault: why every other verb refuses the cell file; empty where none does.
    """
    return ScanReport.of(
        bus=str(cell_address(cell)),
        nodes=nodes,
        reset=list(faults),
        faults=faults,
        current=current_signals(cell),
        mistyped=mistyped,
        warnings=warnings,
        cell_fault=cell_fault,
    )


def scan_view(report: ScanReport) -> Iterator[RenderableType]:
    """Table of the nodes on all buses, and what needs attention."""
    yield scan_table(report.nodes)
    for node in report.nodes:
        name = f"node {node.node_id}"
        if node.axis:
            name = f"{printable(node.axis)} (node {node.node_id})"
        if node.enabled:
            yield Text(
                f"{name} IS ENABLED: its motor has torque and may move at any time.", "bold red"
            )
        yield from (Text(f"{name}: {printable(remark)}", "yellow") for remark in node.remarks)
    for axis, fault in report.faults.items():
        yield Text(
            f"The fault of {printable(axis)} was reset; it has no power. It was {printable(fault)}."
        )
    if any(node.in_fault for node in report.nodes):
        yield Text(
            "An axis is in fault. Its display, the drive's own tool or an EMCY in the log of the "
            "last run (`drivegain explain-emcy`) shows the cause. Remove it, then reset the fault "
            "with --reset-faults; nothing moves.",
            "yellow",
        )
    yield from (Text(printable(text), "yellow") for text in (*report.mistyped, *report.warnings))
    if report.cell_fault:
        yield Text(
            "The drives were found by the wiring alone; every other command refuses the cell file: "
            f"{printable(report.cell_fault)}",
            "yellow",
        )


def scanned_nodes(
    cell: Wired, found: Sequence[FoundNode], bus: str, misfits: Mapping[str, str] | None = None
) -> list[ScannedNode]:
    """Return the nodes of one bus, configured or found;
    `misfits` describes objects that a drive lacks, by axis.
    """
    axes = {axis.node_id: axis for axis in cell.axes if axis.node_id is not None}
    configured = {node_id for node_id, axis in axes.items() if axis.bus == bus}
    nodes = {node.node_id: node for node in found}
    return [
        _scanned_node(bus, node_id, axes.get(node_id), nodes.get(node_id), misfits or {})
        for node_id in sorted(configured | nodes.keys())
    ]


def _scanned_node(
    bus: str,
    node_id: int,
    home: WiredAxis | None,
    node: FoundNode | None,
    misfits: Mapping[str, str],
) -> ScannedNode:
    """Return one node; `home` is the axis that has its number, on this bus or on another."""
    from drivers.canopen.link import nmt_name  # noqa: PLC0415 - `info` shows currents without the CAN library

    axis = None
    if home is not None and home.bus == bus:
        axis = home
    identity = None
    if node is not None:
        identity = node.identity
    misfit = ""
    if axis is not None:
        misfit = misfits.get(axis.name, "")
    remarks = []
    if node is not None:
        remarks = list(_remarks(node, None if axis is None else axis.identity))
    if misfit:
        remarks.append(misfit)
    in_fault = node is not None and node.state in FAULTY
    verdict = _verdict(home, axis, node, misfit)
    if in_fault:
        if verdict == "ok":
            verdict = "in fault"
        else:
            verdict = f"{verdict}, in fault"
    return ScannedNode.of(
        node,
        identity,
        bus=bus,
        node_id=node_id,
        axis=None if home is None else home.name,
        nmt=None if node is None or node.nmt is None else nmt_name(node.nmt),
        **_state(None if node is None else node.statusword),
        in_fault=in_fault,
        verdict=verdict,
        remarks=remarks,
    )


def _state(statusword: int | None) -> dict[str, str | bool | None]:
    """Return name and power of a state of CiA 402; null where it is not known."""
    if statusword is None:
        return {"state": None, "enabled": None}
    state = decode(statusword)
    return {"state": str(state), "enabled": state in ENABLED}


def _verdict(
    home: WiredAxis | None, axis: WiredAxis | None, node: FoundNode | None, misfit: str
) -> str:
    """Return what is to be said first of a node, its fault apart."""
    if node is None:
        return "missing"
    if axis is None:
        return _foreign_verdict(home)
    if node.shared:
        return "two devices"
    expected = axis.identity
    is_unknown = expected is not None or not node.answers
    if is_unknown and node.identity is None:
        return "no identity"
    if expected is not None and node.identity is not None:
        differing = expected.differences(node.identity)
        if differing:
            number, _, _ = differing[0].partition(" 1018h")
            return f"other {number}"
    verdict = "ok"
    if misfit and axis.profile is None:
        verdict = "profile incomplete"
    elif misfit:
        verdict = "profile does not fit"
    return verdict


def _foreign_verdict(home: WiredAxis | None) -> str:
    """Return what is to be said of a node that no axis on its bus has."""
    if home is None:
        return "not configured"
    return f"belongs on {home.bus}"


OTHER_DRIVE = (
    "this is another drive than the cell file describes, and `record` refuses it: check the "
    "wiring; if the drive was exchanged, enter its `identity` in the cell file and calibrate again"
)

NO_IDENTITY = (
    "found a node that does not tell its identity (1018h); expected that of the cell file; scan "
    "again with a longer `--wait`; if it stays so, switch the drive off and on"
)

NO_ANSWER = (
    "found heartbeats of the node, and no answer to a request (SDO); expected an answer; scan "
    "again with `--wait 2`; if it stays so, switch the drive off and on"
)
STOPPED = (
    "found the node in NMT state STOPPED, in which it answers no request (SDO); expected "
    "PRE-OPERATIONAL; end the program that has stopped it, or switch the drive off and on"
)


def _remarks(node: FoundNode, expected: Identity | None) -> Iterator[str]:
    """Describe what is wrong with a node."""
    if node.shared:
        yield f"found {node.shared}; two devices have this node id, give one of them another"
    if expected is not None and node.identity is not None:
        differing = expected.differences(node.identity)
        yield from differing
        if differing:
            yield OTHER_DRIVE
    if not node.answers:
        yield _unanswering(node)
    elif expected is not None and node.identity is None and not node.problems:
        yield NO_IDENTITY
    yield from node.problems


def _unanswering(node: FoundNode) -> str:
    """Say what to do about a node of which heartbeats alone are heard."""
    from drivers.canopen.link import NmtState  # noqa: PLC0415 - `info` shows currents without the CAN library

    return STOPPED if node.nmt == NmtState.STOPPED else NO_ANSWER


_POWER = {True: "ENABLED", False: "off", None: "?"}


def scan_table(nodes: Sequence[ScannedNode]) -> Table:
    """Table of the nodes; first what decides whether a recording can start, then the identity."""
    headings = (
        "bus",
        "node",
        "axis",
        "power",
        "verdict",
        "state",
        "vendor",
        "product",
        "serial",
        "NMT",
        "name",
    )
    # A single bus needs no column.
    first = 1
    if len({node.bus for node in nodes}) > 1:
        first = 0
    table = plain_table(headings[first:], left=range(len(headings)), keys=3 - first)
    for node in nodes:
        cells = (
            node.bus,
            str(node.node_id),
            node.axis or "",
            _POWER[node.enabled],
            node.verdict,
            (node.state or "").lower(),
            known_text(node.vendor_id, "#x", ""),
            known_text(node.product_code, "#x", ""),
            known_text(node.serial, "d", ""),
            (node.nmt or "").lower(),
            node.device_name or "",
        )
        style = None
        if node.enabled or node.verdict != "ok":
            style = "bold red"
        table.add_row(*map(terminal_text, cells[first:]), style=style)
    return table


def monitor_report(cell: Cell, watched: WatchedCell) -> MonitorReport:
    """Return one reading of the bus."""
    reading = watched.reading
    loads = bus_loads_percent(cell, reading)
    return MonitorReport.of(
        watched,
        reading,
        cell=cell.name,
        frames_per_s=sum(map(sum, reading.frames)) / reading.seconds,
        bus_load_percent=max(loads),
        buses=[
            MonitoredBus(bus=bus.name, load_percent=load)
            for bus, load in zip(cell.buses, loads, strict=True)
        ],
        axes=[_monitored_axis(axis, watched, number) for number, axis in enumerate(cell.axes)],
        events=[event.text for event in watched.events],
        notices=[_notice(cell, event) for event in watched.events],
    )


def _monitored_axis(declared: CellAxis, watched: WatchedCell, number: int) -> MonitoredAxis:
    from drivers.canopen.link import nmt_name  # noqa: PLC0415 - as above

    assert declared.node_id is not None  # a cell without nodes has no bus to read
    axis = watched.reading.axes[number]
    position = watched.position[number]
    ampere_per_unit = watched.ampere[number]
    raw = axis.current_raw
    # While another master prepares, it sends no SYNC, and no axis has to answer.
    addressed = watched.reading.source.value == "asked" or watched.reading.sync_hz > 0.0
    predicted: Sequence[RecentCurrent] = ()
    if watched.prediction is not None:
        predicted = watched.prediction.axes
    return MonitoredAxis.of(
        axis,
        axis=declared.name,
        node_id=declared.node_id,
        position=None if position is None else position / declared.unit.si,
        unit=declared.unit.name,
        current_a=None if raw is None or ampere_per_unit is None else raw * ampere_per_unit,
        **_state(axis.statusword),
        nmt=None if axis.nmt is None else nmt_name(axis.nmt),
        silent=addressed and not axis.heard,
        refused=[RefusedObject.of(one, object=str(one.entry)) for one in axis.refused],
        remark="; ".join(_answer_remarks(axis)),
        fault=watched.faults.get(declared.name) if axis.in_fault else None,
        prediction=predicted[number] if predicted else None,
    )


def _notice(cell: Cell, event: CellEvent) -> Notice:
    axis = None
    if event.axis is not None:
        axis = cell.axis_names[event.axis]
    return Notice.of(notice_of(event.kind, event.code, axis, event.text))


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
    "recorder": "drivegain's recorder, or another of its verbs, uses this bus; its traffic is read "
    "and nothing is sent",
    "asked": "no other master: the axes are queried, nothing is written",
}
_FAULT_UNKNOWN = (
    "the drive names no error code; find the cause, then `drivegain scan CELL --reset-faults`"
)


def monitor_view(report: MonitorReport) -> Group:
    """Tables of the axes, with the load of the buses and recent events."""
    table = plain_table(("axis", "position", "current", "state", "rate Hz", "lost"), left=(0, 3))
    faults = []
    for axis in report.axes:
        note = ""
        style = None
        if axis.enabled:
            note = " (ENABLED)"
            style = "bold green"
        if axis.silent:
            note = " (SILENT)"
        if axis.silent or axis.state in _ALARMING:
            style = "bold red"
        cells = (
            printable(axis.axis),
            "?" if axis.position is None else f"{axis.position:.3f} {axis.unit}",
            _current_text(axis),
            (axis.state or "?").lower() + note,
            f"{axis.rate_hz:.1f}",
            str(axis.lost),
        )
        table.add_row(*map(Text, cells), style=style)
        if axis.remark:
            faults.append(Text(f"{printable(axis.axis)} {axis.remark}", "yellow"))
        if axis.in_fault:
            fault = axis.fault
            text = _FAULT_UNKNOWN
            if fault is not None:
                text = f"{fault.hex} {fault.text}; {fault.remedy}"
            faults.append(Text(f"{printable(axis.axis)} is in fault: {text}", "bold red"))
    source = report.source
    if source == "overheard" and report.recorder:
        source = "recorder"
    head = Text(printable(f"{report.cell}: {_SOURCE_TEXT[source]}"))
    texts = [f"{printable(bus.bus)} {bus.load_percent:.1f} % at worst" for bus in report.buses]
    loads = ", ".join(texts)
    load = Text(f"{loads}, {report.frames_per_s:.0f} frames/s, SYNC {report.sync_hz:.1f} Hz")
    return Group(
        head, table, load, *prediction_view(report), *faults, *map(_notice_text, report.notices)
    )


def _current_text(axis: MonitoredAxis) -> str:
    if axis.enabled is False:
        return "no power"  # the number is an old reference, or the offset of a sensor
    if axis.current_a is not None:
        return f"{axis.current_a:+.3f} A"
    if axis.current_raw is None:
        return "?"
    return f"{axis.current_raw:+d} raw"


def prediction_view(report: MonitorReport) -> Iterator[RenderableType]:
    """Measured and predicted current, or why there is none; nothing without a calibration."""
    if report.prediction is None:
        return
    if report.prediction.remark:
        yield Text(printable(report.prediction.remark))
    table = plain_table(("axis", "measured", "predicted", "± band", "residual rms", "outside"))
    for axis in report.axes:
        found = axis.prediction
        if found is None:
            continue
        cells = (
            printable(axis.axis),
            "no power" if axis.enabled is False else known_text(found.measured, "+.3f"),
            known_text(found.predicted, "+.3f", "at rest"),
            known_text(found.band, ".3f"),
            known_text(found.residual_rms, ".3f"),
            f"{100 * found.outside_share:.0f} %",
        )
        table.add_row(*map(Text, cells), style="bold yellow" if found.conspicuous else None)
    if not table.row_count:
        return
    payload = report.prediction.payload
    carried = "without payload"
    if payload is not None:
        carried = f"with payload {printable(payload)}"
    yield Text(
        "Currents of half a second ago, in the unit of the gains' current, filtered as in the fit, "
        f"{carried}; residual of the last 10 s in which the axis moved:"
    )
    yield table


def _notice_text(notice: Notice) -> Text:
    """One event, with its remedy where it is alarming."""
    where = ""
    if notice.axis is not None:
        where = f"{notice.axis}: "
    remedy = ""
    if notice.remedy:
        remedy = f"; {notice.remedy}"
    return Text(printable(f"{where}{notice.text}{remedy}"), "yellow" if notice.alarm else "")


def current_signals(cell: Wired) -> dict[str, str]:
    """Recorded current of each axis with an amplifier, such as "current reference 6074h:00,
    rms".
    """
    return {
        axis.name: f"{axis.profile.signal}, amplitude {axis.profile.amplitude.value}"
        for axis in cell.axes
        if axis.profile is not None
    }


def load_lines(cell: Cell) -> tuple[str, ...]:
    """Describe the load that a recording puts on each bus."""
    lockstep = cell.sync is not None and cell.sync.pacing is PacingMode.LOCKSTEP
    says = "loaded by"
    if lockstep:
        says = "in lockstep; a real bus would be loaded by"
    return tuple(
        f"{bus.name} ({bus.interface}:{bus.channel}): {says} {load}"
        for bus, load in bus_loads(cell)
    )
