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

VENDOR_ID = ObjectEntry(0x1018, 1, 32)
PRODUCT_CODE = ObjectEntry(0x1018, 2, 32)
REVISION = ObjectEntry(0x1018, 3, 32)
SERIAL = ObjectEntry(0x1018, 4, 32)
T = TypeVar("T")
SCAN_POLICY = SdoPolicy(attempts=2, transfer_s=1.0, most_bytes=256)
"""One node that never ends must not keep the others from being found."""
NODE_S = 3.0  #: After this time, nothing more is asked of a node
SCAN_S = 30.0  #: After this time, nothing more is asked of any node
_DEVICE_TYPE = ObjectEntry(0x1000, 0, 32)


@dataclass(frozen=True, slots=True)
class FoundNode:
    """One node of a bus, as far as it reports."""

    node_id: int  #: CANopen node id
    identity: Identity | None  #: object 1018h, or None when it answers no SDO (it may be stopped)
    revision: int | None  #: 1018h:03, or None
    device_name: str | None  #: 1008h, or None
    nmt: int | None  #: NMT state of its last heartbeat, or None when it sends none
    statusword: int | None  #: 6041h, or None when it is no CiA 402 drive
    shared: str = ""  #: evidence that two devices have this node id
    problems: tuple[str, ...] = ()  #: objects that it reports badly, with the reason

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
    place = BusAddress.parse(address) if isinstance(address, str) else address
    link = Link(place, SdoPolicy(), time.monotonic_ns)
    link.open()
    try:
        link.require_quiet(LISTEN_S)
        return scan_link(link, node_ids, wait_s)
    finally:
        link.close()


def scan_link(link: Link, node_ids: Sequence[int], wait_s: float) -> tuple[FoundNode, ...]:
    """Find all nodes that answer an SDO request or send a heartbeat within a time."""
    end_ns = link.clock() + round((wait_s + SCAN_S) * 1e9)
    answered = answering(link, node_ids, wait_s)
    several = _answering_twice(link, answered, wait_s)
    alive = sorted(set(answered) | (set(link.nmt) & set(node_ids)))
    nothing = (None, None, None, None, None)
    found = [
        _describe(link, n, end_ns) if n in answered else (FoundNode(n, *nothing), 0) for n in alive
    ]
    link.hear_beats(max((period_ms for _, period_ms in found), default=0))  # of all nodes at once
    nodes = []
    for node, period_ms in found:
        shared = link.shared_id(node.node_id, period_ms)
        if node.node_id in several and not shared:
            shared = "two answers to one request for 1000h:00"
        nodes.append(replace(node, nmt=link.nmt.get(node.node_id), shared=shared))
    return tuple(nodes)


def _describe(link: Link, node_id: int, scan_end_ns: int) -> tuple[FoundNode, int]:
    """Read what a node reports of itself until the scan ends, and the period of its heartbeat [ms];
    0 for none.

    An object that it reports badly does not keep the others from it.
    """
    access = link.objects(node_id, SCAN_POLICY)
    problems = list[str]()
    end_ns = min(link.clock() + round(NODE_S * 1e9), scan_end_ns)
    unasked = f"the rest was not asked: its answers took longer than {NODE_S:g} s"
    if link.clock() >= scan_end_ns:
        unasked = (
            f"nothing was asked of it: the scan was over after {SCAN_S:g} s; is the bus flooded?"
        )

    def reported(read: Callable[[], T]) -> T | None:
        if link.clock() >= end_ns:
            if unasked not in problems:
                problems.append(unasked)
            return None
        try:
            return read()
        except ObjectAccessError as error:
            if error.abort_code is None:
                problems.append(f"object {error.entry}: {error.reason}")
        return None

    identity = reported(partial(read_identity, access))
    data = reported(partial(access.read_bytes, 0x1008, 0))
    if data is None:
        name = None
    else:
        name = data.rstrip(b"\0 ").decode("utf-8", "replace")
    revision, statusword, period_ms = (
        reported(partial(access.read, entry)) for entry in (REVISION, STATUSWORD, HEARTBEAT_TIME)
    )
    return FoundNode(
        node_id, identity, revision, name, None, statusword, problems=tuple(problems)
    ), period_ms or 0


def read_identity(access: ObjectAccess) -> Identity:
    """Read object 1018h, of which CiA 301 requires the vendor only: the rest may be None."""
    vendor_id = access.read(VENDOR_ID)
    product_code = access.read_optional(PRODUCT_CODE, any_abort=True)
    serial = access.read_optional(SERIAL, any_abort=True)
    return Identity(vendor_id, product_code, serial)


def answering(link: Link, node_ids: Sequence[int], wait_s: float) -> tuple[int, ...]:
    """Return the nodes that answer an SDO request; all are asked at once, and share the time.

    One that sends its boot-up message meanwhile is asked again: it was still booting when it was
    asked.
    """
    asked = set(node_ids)
    link.answered.clear()
    began_ns = link.clock()
    again: set[int] = set()

    def booted() -> list[int]:
        return [
            n
            for n in sorted(asked - again - link.answered.keys())
            if link.booted_since(n, began_ns)
        ]

    _ask(link, node_ids)
    end_ns = began_ns + round(wait_s * 1e9)
    while link.wait(
        (end_ns - link.clock()) * 1e-9, lambda: asked <= link.answered.keys() or bool(booted())
    ):
        up = booted()
        if not up:
            break
        again.update(up)
        _ask(link, up)
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
        _ask(link, suspects)
        link.wait(wait_s)
        suspects = _several_answers(link, suspects)
    return suspects


def _several_answers(link: Link, node_ids: Sequence[int]) -> tuple[int, ...]:
    """Return the nodes of which several answers have come and that no other program has asked."""
    return tuple(
        n for n in node_ids if link.answered[n] > 1 and SDO_REQUEST + n not in link.foreign
    )


def free_ids(link: Link, node_ids: Sequence[int], wait_s: float) -> tuple[int, ...]:
    """Return the node ids of which no frame came since the bus was opened,
    nor an SDO answer within a time.
    """
    _ask(link, node_ids)
    link.wait(wait_s)  # all of it: a device without SDO server is known by its heartbeat alone
    return tuple(node_id for node_id in node_ids if node_id not in link.heard)


def _ask(link: Link, node_ids: Sequence[int]) -> None:
    link.send([upload_request(node_id, _DEVICE_TYPE) for node_id in node_ids])
