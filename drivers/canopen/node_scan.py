"""Find the nodes of a bus without changing anything there."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

from drivers.canopen.bus import BusAddress
from drivers.canopen.link import LISTEN_S, Link
from drivers.canopen.pdo import STATUSWORD
from drivers.canopen.sdo import SDO_REQUEST, ObjectAccess, SdoPolicy, upload_request
from drivers.canopen.setup import HEARTBEAT_TIME
from drivers.canopen.split_bus import CellAddress
from drivers.errors import ObjectAccessError
from drivers.profiles.cia402 import State, decode
from drivers.profiles.profile import Identity, ObjectEntry

T = TypeVar("T")
# Objects of the communication profile area (CiA 301). 1018h is the identity object.
_DEVICE_TYPE = ObjectEntry(0x1000, 0, 32)
_DEVICE_NAME_INDEX = 0x1008
VENDOR_ID = ObjectEntry(0x1018, 1, 32)
PRODUCT_CODE = ObjectEntry(0x1018, 2, 32)
REVISION = ObjectEntry(0x1018, 3, 32)
SERIAL = ObjectEntry(0x1018, 4, 32)
#: A node whose transfer never ends must not keep the others from being found.
SCAN_POLICY = SdoPolicy(attempts=2, transfer_s=1.0, most_bytes=256)
NODE_S = 3.0  #: Longest time to send requests to one node
SCAN_S = 30.0  #: Longest time to send requests to all nodes together


@dataclass(frozen=True, slots=True)
class FoundNode:
    """One node of a bus, as far as it reports."""

    node_id: int  #: CANopen node id
    identity: Identity | None  #: object 1018h, or None when it does not answer or refuses it
    revision: int | None  #: 1018h:03, or None
    device_name: str | None  #: 1008h, or None
    nmt: int | None  #: NMT state of its last heartbeat, or None when it sends none
    statusword: int | None  #: 6041h, or None when it is no CiA 402 drive
    shared: str = ""  #: evidence that two devices have this node id
    problems: tuple[str, ...] = ()  #: objects that it reports badly, with the reason
    answers: bool = True  #: to SDO requests; False for one of which heartbeats alone are heard

    @property
    def state(self) -> State | None:
        """CiA 402 state, or None when it is no drive."""
        if self.statusword is None:
            return None
        return decode(self.statusword)


def scan(
    address: CellAddress | str, node_ids: Sequence[int] = range(1, 128), wait_s: float = 0.5
) -> tuple[FoundNode, ...]:
    """Open a bus and find its nodes; changes nothing.

    Nothing is sent while another master commands the bus: it may be moving the axes.

    Args:
        address: of the bus, such as ``"socketcan:can0"``.
        node_ids: to search.
        wait_s: for answers and heartbeats.

    Raises:
        BusBusy: another master commands this bus.
        BusError: the bus cannot be opened, or is lost.
    """
    if isinstance(address, str):
        address = BusAddress.parse(address)
    link = Link(address, SdoPolicy(), time.monotonic_ns)
    link.open()
    try:
        link.require_quiet(LISTEN_S)
        return scan_link(link, node_ids, wait_s)
    finally:
        link.close()


def scan_link(link: Link, node_ids: Sequence[int], wait_s: float) -> tuple[FoundNode, ...]:
    """Find all nodes that answer an SDO request or send a heartbeat within a time."""
    scan_end_ns = link.clock() + round((wait_s + SCAN_S) * 1e9)
    answered = answering(link, node_ids, wait_s)
    # Counted now: the requests that follow are answered too.
    answered_twice = _answering_twice(link, answered, wait_s)
    with_heartbeat = set(link.nmt) & set(node_ids)
    found = []
    periods_ms = {}
    for node_id in sorted(with_heartbeat.union(answered)):
        if node_id in answered:
            node, period_ms = _describe(link, node_id, scan_end_ns)
        else:
            node = _unanswering_node(node_id)
            period_ms = 0
        found.append(node)
        periods_ms[node_id] = period_ms
    # Once for all nodes: their heartbeats arrive at the same time.
    slowest_ms = max(periods_ms.values(), default=0)
    link.hear_beats(slowest_ms)
    nodes = []
    for node in found:
        shared = link.shared_id(node.node_id, periods_ms[node.node_id])
        if node.node_id in answered_twice and not shared:
            shared = "two answers to one request for 1000h:00"
        nodes.append(replace(node, nmt=link.nmt.get(node.node_id), shared=shared))
    return tuple(nodes)


def _unanswering_node(node_id: int) -> FoundNode:
    """Return a node that sends a heartbeat and answers no SDO request."""
    return FoundNode(
        node_id,
        identity=None,
        revision=None,
        device_name=None,
        nmt=None,
        statusword=None,
        answers=False,
    )


def _describe(link: Link, node_id: int, scan_end_ns: int) -> tuple[FoundNode, int]:
    """Read the objects that describe a node, as far as there is time.

    A bad answer to one of them is noted as a problem, and the others are still read.

    Returns:
        the node, and the period of its heartbeat (1017h) [ms], 0 for none.
    """
    access = link.objects(node_id, SCAN_POLICY)
    problems: list[str] = []
    begun_ns = link.clock()
    node_end_ns = begun_ns + round(NODE_S * 1e9)
    end_ns = min(node_end_ns, scan_end_ns)
    if begun_ns < scan_end_ns:
        out_of_time = f"the rest was not asked: its answers took longer than {NODE_S:g} s"
    else:
        out_of_time = (
            f"nothing was asked of it: the scan was over after {SCAN_S:g} s; is the bus flooded?"
        )

    def read_or_note(read: Callable[[], T]) -> T | None:
        if link.clock() >= end_ns:
            if out_of_time not in problems:
                problems.append(out_of_time)
            return None
        try:
            return read()
        except ObjectAccessError as error:
            # An abort is no problem: most of these objects are optional.
            if error.abort_code is None:
                problems.append(f"object {error.entry}: {error.reason}")
        return None

    identity = read_or_note(partial(read_identity, access))
    name_bytes = read_or_note(partial(access.read_bytes, _DEVICE_NAME_INDEX, 0))
    device_name = None
    if name_bytes is not None:
        device_name = name_bytes.rstrip(b"\0 ").decode("utf-8", "replace")
    revision = read_or_note(partial(access.read, REVISION))
    statusword = read_or_note(partial(access.read, STATUSWORD))
    period_ms = read_or_note(partial(access.read, HEARTBEAT_TIME))
    node = FoundNode(
        node_id,
        identity,
        revision,
        device_name,
        nmt=None,
        statusword=statusword,
        problems=tuple(problems),
    )
    return node, period_ms or 0


def read_identity(access: ObjectAccess) -> Identity:
    """Read object 1018h; CiA 301 requires the vendor id alone, the rest may be None."""
    vendor_id = access.read(VENDOR_ID)
    product_code = access.read_optional(PRODUCT_CODE, any_abort=True)
    serial = access.read_optional(SERIAL, any_abort=True)
    return Identity(vendor_id, product_code, serial)


def answering(link: Link, node_ids: Sequence[int], wait_s: float) -> tuple[int, ...]:
    """Return the nodes that answer an SDO request; all are asked at once, and share the time.

    A node that sends its boot-up message meanwhile is asked once more: it was still booting when
    the first request came.
    """
    asked = set(node_ids)
    asked_again: set[int] = set()
    link.answered.clear()
    begun_ns = link.clock()

    def to_ask_again() -> list[int]:
        unanswered = asked - link.answered.keys()
        candidates = sorted(unanswered - asked_again)
        return [node_id for node_id in candidates if link.booted_since(node_id, begun_ns)]

    def can_go_on() -> bool:
        return asked <= link.answered.keys() or bool(to_ask_again())

    _request_device_type(link, node_ids)
    end_ns = begun_ns + round(wait_s * 1e9)
    while link.wait((end_ns - link.clock()) * 1e-9, can_go_on):
        booted = to_ask_again()
        if not booted:
            break
        asked_again.update(booted)
        _request_device_type(link, booted)
    return tuple(sorted(asked & link.answered.keys()))


def _answering_twice(link: Link, node_ids: Sequence[int], wait_s: float) -> tuple[int, ...]:
    """Return the nodes that answer one request twice, each time they are asked.

    A slow node, or one behind a slow gateway, may still answer what another program has asked: then
    two answers come once, not again.

    Args:
        link: whose count of answers is that of one request to each node.
        node_ids: that have answered.
        wait_s: for the answers to a second request.
    """
    suspects = _several_answers(link, node_ids)
    if suspects:
        link.answered.clear()
        _request_device_type(link, suspects)
        link.wait(wait_s)
        suspects = _several_answers(link, suspects)
    return suspects


def _several_answers(link: Link, node_ids: Sequence[int]) -> tuple[int, ...]:
    """Return the nodes of which several answers have come and that no other program has asked."""
    found: list[int] = []
    for node_id in node_ids:
        asked_by_others = SDO_REQUEST + node_id in link.foreign
        if link.answered[node_id] > 1 and not asked_by_others:
            found.append(node_id)
    return tuple(found)


def free_ids(link: Link, node_ids: Sequence[int], wait_s: float) -> tuple[int, ...]:
    """Return the node ids of which no frame came since the bus was opened,
    nor an SDO answer within a time.
    """
    _request_device_type(link, node_ids)
    # The full time: a device without SDO server is known by its heartbeat alone.
    link.wait(wait_s)
    return tuple(node_id for node_id in node_ids if node_id not in link.heard)


def _request_device_type(link: Link, node_ids: Sequence[int]) -> None:
    """Send each node a request for 1000h, which every CANopen device has."""
    link.send([upload_request(node_id, _DEVICE_TYPE) for node_id in node_ids])
