"""`workspace` and `clearance` of a cell file:
the room around the arm, its shape, and the obstacles.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from daq.config.yaml_file import Fault, Name
from ident.planning.clearance import BASE, Box, Capsule

BASE_LINK = "base"
DEFAULT_MINIMUM_M = 0.01

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Clearance:
    """The room around the arm, in the types of `ident.planning.clearance`."""

    #: box for everything on the link with the payload, None if it is not declared
    workspace: Box | None
    minimum_m: float  #: smallest distance [m]
    capsules: tuple[Capsule, ...]  #: shape of the arm; empty if it is not declared
    obstacles: tuple[Box, ...]  #: boxes in the base frame


@dataclass(frozen=True, slots=True)
class WorkspaceSection:
    """A box in the base frame in which everything on the link with the payload must stay."""

    lower_m: Point  #: lower corner in the base frame
    upper_m: Point  #: upper corner in the base frame


@dataclass(frozen=True, slots=True)
class CapsuleSection:
    """All points within a radius of a segment, in the frame of the named axis (or of the base)."""

    name: Name  #: for messages
    link: Name  #: axis whose frame the points are in, or base
    from_m: Point  #: one end of the segment
    to_m: Point  #: other end of the segment
    radius_m: Annotated[float, Field(gt=0, le=10)]  #: around the segment [m]


@dataclass(frozen=True, slots=True)
class Obstacle(Box):
    """A box in the base frame."""

    name: Name


@dataclass(frozen=True, slots=True)
class ClearanceSection:
    """Bodies to keep apart; without capsules the arm's shape is derived from its joint chain."""

    #: least distance that moves keep [m]
    minimum_m: Annotated[float, Field(ge=0, le=1)] = DEFAULT_MINIMUM_M
    capsules: Annotated[tuple[CapsuleSection, ...], Field(max_length=64)] = ()  #: shapes of the arm
    obstacles: Annotated[tuple[Obstacle, ...], Field(max_length=64)] = ()  #: bodies in the room


def clearance_of(
    workspace: WorkspaceSection | None,
    clearance: ClearanceSection | None,
    joints: Mapping[str, int],
) -> Clearance | None:
    """Convert the sections of the cell file; None if it has neither.

    Args:
        workspace, clearance: of the cell file.
        joints: index of the joint that each axis drives by the name of the axis, and of each joint
            without a motor.
    """
    if workspace is None and clearance is None:
        return None
    declared = clearance or ClearanceSection()
    links = {BASE_LINK: BASE, **joints}
    box = None
    if workspace is not None:
        box = Box("workspace", workspace.lower_m, workspace.upper_m)
    capsules = []
    for capsule in declared.capsules:
        link = links[capsule.link]
        placed = Capsule(capsule.name, link, capsule.from_m, capsule.to_m, capsule.radius_m)
        capsules.append(placed)
    return Clearance(
        workspace=box,
        minimum_m=declared.minimum_m,
        capsules=tuple(capsules),
        obstacles=declared.obstacles,
    )


def clearance_faults(
    workspace: WorkspaceSection | None, clearance: ClearanceSection | None, names: Sequence[str]
) -> Iterator[Fault]:
    """Find boxes with exchanged corners, and capsules on links that the cell does not have."""
    if workspace is not None:
        yield from _box_faults(("workspace",), workspace)
    if clearance is None:
        return
    for index, obstacle in enumerate(clearance.obstacles):
        yield from _box_faults(("clearance", "obstacles", index), obstacle)
    for index, capsule in enumerate(clearance.capsules):
        if capsule.link not in (BASE_LINK, *names):
            axes = ", ".join(names)
            expected = f"{BASE_LINK}, or the axis that moves it: {axes}"
            yield Fault(("clearance", "capsules", index, "link"), capsule.link, expected)


def _box_faults(path: tuple[str | int, ...], box: WorkspaceSection | Box) -> Iterator[Fault]:
    for axis, lower, upper in zip("xyz", box.lower_m, box.upper_m, strict=True):
        if not lower < upper:
            found = f"{axis} from {lower:g} to {upper:g} m"
            yield Fault((*path, "lower_m"), found, "the lower corner below the upper one")
