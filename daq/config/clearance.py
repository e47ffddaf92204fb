"""What a cell file says of the room around the arm: its workspace, its shape and what stands in its way."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from daq.config.yaml_file import Fault, StrictModel
from ident.planning.clearance import BASE, Box, Capsule

BASE_LINK = "base"
DEFAULT_MINIMUM_M = 0.01

Point = tuple[float, float, float]
Label = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[\w][\w .()/+-]*$")]
Metres = Annotated[float, Field(gt=0, le=10)]


class WorkspaceModel(StrictModel):
    """A box in the base frame in which everything on the last link must stay."""

    lower_m: Point
    upper_m: Point


class CapsuleModel(StrictModel):
    """All points within a radius of a segment, in the frame of the joint that moves it (or of the base)."""

    name: Label
    link: Label
    from_m: Point
    to_m: Point
    radius_m: Metres


class ObstacleModel(StrictModel):
    """A box in the base frame."""

    name: Label
    lower_m: Point
    upper_m: Point


class ClearanceModel(StrictModel):
    """What must keep apart; without capsules the arm's shape is guessed from its joint chain."""

    minimum_m: Annotated[float, Field(ge=0, le=1)] = DEFAULT_MINIMUM_M
    capsules: Annotated[tuple[CapsuleModel, ...], Field(max_length=64)] = ()
    obstacles: Annotated[tuple[ObstacleModel, ...], Field(max_length=64)] = ()


@dataclass(frozen=True, slots=True)
class Clearance:
    """The same in the terms of ident/planning/clearance.py.

    Attributes:
        workspace: in which everything on the last link must stay, None where it is not declared.
        minimum_m: distance to keep.
        capsules: none where the arm's shape is not declared.
        obstacles: boxes in the base frame.
    """

    workspace: Box | None
    minimum_m: float
    capsules: tuple[Capsule, ...]
    obstacles: tuple[Box, ...]


def clearance_of(
    workspace: WorkspaceModel | None, clearance: ClearanceModel | None, axis_names: Sequence[str]
) -> Clearance | None:
    """From the cell file's sections; None where it has neither."""
    if workspace is None and clearance is None:
        return None
    declared = clearance or ClearanceModel()
    links = {BASE_LINK: BASE, **{name: index for index, name in enumerate(axis_names)}}
    return Clearance(
        workspace=None if workspace is None else Box("workspace", workspace.lower_m, workspace.upper_m),
        minimum_m=declared.minimum_m,
        capsules=tuple(Capsule(c.name, links[c.link], c.from_m, c.to_m, c.radius_m) for c in declared.capsules),
        obstacles=tuple(Box(box.name, box.lower_m, box.upper_m) for box in declared.obstacles),
    )


def clearance_faults(
    workspace: WorkspaceModel | None, clearance: ClearanceModel | None, axis_names: Sequence[str]
) -> Iterator[Fault]:
    """Boxes turned inside out, and capsules on links that the cell does not have."""
    if workspace is not None:
        yield from _box_faults(("workspace",), workspace)
    if clearance is None:
        return
    for index, obstacle in enumerate(clearance.obstacles):
        yield from _box_faults(("clearance", "obstacles", index), obstacle)
    for index, capsule in enumerate(clearance.capsules):
        if capsule.link not in (BASE_LINK, *axis_names):
            expected = f"{BASE_LINK}, or the axis that moves it: {', '.join(axis_names)}"
            yield Fault(("clearance", "capsules", index, "link"), capsule.link, expected)


def _box_faults(path: tuple[str | int, ...], box: WorkspaceModel | ObstacleModel) -> Iterator[Fault]:
    for axis, lower, upper in zip("xyz", box.lower_m, box.upper_m, strict=True):
        if not lower < upper:
            found = f"{axis} from {lower:g} to {upper:g} m"
            yield Fault((*path, "lower_m"), found, "the lower corner below the upper one")
