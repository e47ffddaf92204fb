"""Find the nodes of a bus without changing anything there."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from drivers.canopen.bus import BusAddress
from drivers.canopen.link import Link
from drivers.canopen.pdo import STATUSWORD
from drivers.canopen.sdo import ObjectAccess, SdoPolicy, upload_request
from drivers.canopen.split_bus import CellAddress
from drivers.errors import ObjectAccessError
from drivers.profiles.cia402 import State, decode
from drivers.profiles.profile import Identity, ObjectEntry

VENDOR_ID = ObjectEntry(0x1018, 1, 32, signed=False)
PRODUCT_CODE = ObjectEntry(0x1018, 2, 32, signed=False)
REVISION = ObjectEntry(0x1018, 3, 32, signed=False)
SERIAL = ObjectEntry(0x1018, 4, 32, signed=False)
_DEVICE_TYPE = ObjectEntry(0x1000, 0, 32, signed=False)


@dataclass(frozen=True, slots=True)
class FoundNode:
    """One node of a bus, as far as it reports."""

    node_id: int  #: CANopen node id
    identity: Identity | None  #: object 1018h, or None when it answers no SDO (it may be stopped)
    revision: int | None  #: 1018h:03, or None
    device_name: str | None  #: 1008h, or None
    nmt: int | None  #: NMT state of its last heartbeat, or None when it sends none
    statusword: int | None  #: 6041h, or None when it is no CiA 402 drive

    @property
    def state(self) -> State | None:
        """CiA 402 state, or None when it is no drive."""
        return None if self.statusword is None else decode(self.statusword)


def scan(
    address: CellAddress | str, node_ids: Sequence[int] = range(1, 128), wait_s: float = 0.5
) -> tuple[FoundNode, ...]:
    """Open a bus and find its nodes; changes nothing.

    Args:
        address: of the bus, such as ``"socketcan:can0"``.
        node_ids: to search.
        wait_s: for answers and heartbeats.

    Raises:
        BusError: the bus cannot be opened, or is lost.
    """
    place = BusAddress.parse(address) if isinstance(address, str) else address
    link = Link(place, SdoPolicy(), time.monotonic_ns)
    link.open()
    try:
        return scan_link(link, node_ids, wait_s)
    finally:
        link.close()


def scan_link(link: Link, node_ids: Sequence[int], wait_s: float) -> tuple[FoundNode, ...]:
    """Find all nodes that answer an SDO request or send a heartbeat within a time."""
    answered = answering(link, node_ids, wait_s)
    alive = sorted(set(answered) | (set(link.nmt) & set(node_ids)))
    found = []
    for node_id in alive:
        nmt = link.nmt.get(node_id)
        if node_id not in answered:
            found.append(FoundNode(node_id, None, None, None, nmt, None))
            continue
        access = link.objects(node_id)
        identity = name = None
        with suppress(ObjectAccessError):
            identity = read_identity(access)
        with suppress(ObjectAccessError):
            name = access.read_bytes(0x1008, 0).rstrip(b"\0 ").decode("utf-8", "replace")
        revision, statusword = (access.read_optional(entry, any_abort=True) for entry in (REVISION, STATUSWORD))
        found.append(FoundNode(node_id, identity, revision, name, nmt, statusword))
    return tuple(found)


def read_identity(access: ObjectAccess) -> Identity:
    """Read object 1018h; the serial is None where a node has none."""
    return Identity(access.read(VENDOR_ID), access.read(PRODUCT_CODE), access.read_optional(SERIAL, any_abort=True))


def answering(link: Link, node_ids: Sequence[int], wait_s: float) -> tuple[int, ...]:
    """Return the nodes that answer an SDO request; all are asked at once, and share the time."""
    asked = set(node_ids)
    link.answered.clear()
    _ask(link, node_ids)
    link.wait(wait_s, lambda: asked <= link.answered)
    return tuple(sorted(asked & link.answered))


def free_ids(link: Link, node_ids: Sequence[int], wait_s: float) -> tuple[int, ...]:
    """Return the node ids of which no frame came since the bus was opened, nor an SDO answer within a time."""
    _ask(link, node_ids)
    link.wait(wait_s)  # all of it: a device without SDO server is known by its heartbeat alone
    return tuple(node_id for node_id in node_ids if node_id not in link.heard)


def _ask(link: Link, node_ids: Sequence[int]) -> None:
    link.send([upload_request(node_id, _DEVICE_TYPE) for node_id in node_ids])
