"""What the amplifiers themselves said when a recording started; without it raw numbers have no unit."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

NAME = "readback.json"


@dataclass(frozen=True, slots=True)
class AxisReadback:
    """Of one axis.

    Attributes:
        name: of the axis.
        current_per_unit: unit of the reference (A) for each raw unit, from the profile's formula and objects.
        position_rad_per_count: motor angle of a count [rad]; None for 2π over the cell's counts a revolution.
        drive: all that the amplifier said about itself: identity, serial number, rated current, PDO mapping.
    """

    name: str
    current_per_unit: float
    position_rad_per_count: float | None = None
    drive: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Readback:
    """Of all axes, in their order."""

    axes: tuple[AxisReadback, ...]


def readback_of_drives(names: Sequence[str], ampere_per_unit: Sequence[float], answers: Mapping[str, Any]) -> Readback:
    """The readback of a network that has been prepared.

    Args:
        names: of the axes, in their order.
        ampere_per_unit: as drivers.network.CanopenNetwork.ampere_per_unit() gives it.
        answers: as its readback() gives it, by axis name.
    """
    return Readback(
        tuple(
            AxisReadback(name, scale, drive=dict(answers[name]))
            for name, scale in zip(names, ampere_per_unit, strict=True)
        )
    )


def readback_bytes(readback: Readback) -> bytes:
    """The attachment."""
    return json.dumps(asdict(readback), indent=1).encode()


def readback_from_bytes(data: bytes) -> Readback:
    """What `readback_bytes` wrote.

    Raises:
        ValueError: it is something else.
    """
    try:
        tree = json.loads(data)
    except RecursionError as error:
        raise ValueError("nested too deep") from error
    axes = tree.get("axes") if isinstance(tree, dict) else None
    if not isinstance(axes, list) or not axes:
        raise ValueError("no list of axes")
    return Readback(tuple(_axis(axis) for axis in axes))


def _axis(tree: Any) -> AxisReadback:
    tree = tree if isinstance(tree, dict) else {}
    name, drive, angle = tree.get("name"), tree.get("drive", {}), tree.get("position_rad_per_count")
    if not (isinstance(name, str) and isinstance(drive, dict)):
        raise ValueError(f"axis {name!r}: name or drive")  # noqa: TRY004 - one kind of error for a foreign attachment
    return AxisReadback(
        name=name,
        current_per_unit=_quantum(name, "current_per_unit", tree.get("current_per_unit")),
        position_rad_per_count=None if angle is None else _quantum(name, "position_rad_per_count", angle),
        drive=drive,
    )


def _quantum(name: str, key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value <= sys.float_info.max:
        raise ValueError(f"axis {name!r}: {key} is {value!r:.40}, expected a positive number")
    return float(value)
