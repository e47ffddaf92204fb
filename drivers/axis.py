"""One configured axis of a cell, as the bus sees it."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.profile import DriveProfile


@dataclass(frozen=True, slots=True)
class Identity:
    """Object 1018h (CiA 301); a serial of None is not compared."""

    vendor_id: int
    product_code: int
    serial: int | None = None


@dataclass(frozen=True, slots=True)
class Axis:
    """One amplifier of the cell.

    Attributes:
        name: what a person calls it.
        node_id: CANopen node id, 1 to 127.
        profile: which objects it keeps position and current in.
        identity: what 1018h must say, or None when the configuration does not know it.
    """

    name: str
    node_id: int
    profile: DriveProfile
    identity: Identity | None = None
