"""`plan.yaml`: moves that a person can read, change and approve before anything moves."""

from __future__ import annotations

from math import degrees, radians
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from daq.atomic_file import replace_file
from daq.configuration.cell import Cell
from daq.configuration.yaml_file import StrictModel, parse_yaml, read_bytes, read_model
from daq.errors import ConfigurationInconsistent
from daq.plan import Plan, PlannedMove, duration_of

Share = Annotated[float, Field(ge=0.01, le=1)]
"""Slower than a hundredth of its limits a move would hardly end."""


class _Move(StrictModel):
    target_deg: tuple[float, ...]
    velocity: Share
    acceleration: Share
    dwell_s: Annotated[float, Field(ge=0, le=60)] = 0.0


class _Plan(StrictModel):
    format: Literal["drivegain-plan"]
    cell: str
    seed: int
    condition: Annotated[float, Field(gt=0)]
    moves: Annotated[tuple[_Move, ...], Field(min_length=1)]


def save_plan(plan: Plan, path: Path) -> None:
    """Write a plan; a file of that name is replaced whole.

    Raises:
        OSError: from the file system.
    """
    lines = [
        "# Synchronised point-to-point moves; velocity and acceleration are shares of the joint limits.",
        "format: drivegain-plan",
        f"cell: {plan.cell}",
        f"seed: {plan.seed}",
        f"condition: {plan.condition:.1f}    # of the weighted observation matrix",
        "moves:",
    ]
    for move in plan.moves:
        target = ", ".join(f"{degrees(angle):.3f}" for angle in move.target_rad)
        lines.append(
            f"  - {{target_deg: [{target}], velocity: {move.velocity:.3f}, acceleration: {move.acceleration:.3f}, "
            f"dwell_s: {move.dwell_s:.3f}}}"
        )
    replace_file(path, ("\n".join(lines) + "\n").encode())


def load_plan(path: Path, cell: Cell) -> Plan:
    """Read a plan for a cell.

    Raises:
        ConfigurationError: the file is missing, is not what its schema says, or a target lies outside the joint limits.
    """
    model = read_model(parse_yaml(read_bytes(path), str(path)), _Plan)
    count = len(cell.axes)
    if model.cell != cell.name:
        raise ConfigurationInconsistent(
            str(path),
            found=f"a plan for cell {model.cell!r}",
            expected=f"one for {cell.name!r}",
            remedy="make a plan for this cell: `drivegain plan CELL`",
        )
    moves = []
    for number, move in enumerate(model.moves):
        if len(move.target_deg) != count:
            raise ConfigurationInconsistent(
                f"{path}: moves[{number}].target_deg",
                found=f"{len(move.target_deg)} angles",
                expected=f"{count}, one a joint",
                remedy="correct the move",
            )
        target = tuple(radians(angle) for angle in move.target_deg)
        for axis, angle in zip(cell.axes, target, strict=True):
            lower, upper = axis.limits.position
            if not lower <= angle <= upper:
                raise ConfigurationInconsistent(
                    f"{path}: moves[{number}].target_deg, {axis.name}",
                    found=f"{degrees(angle):.3f} deg",
                    expected=f"{degrees(lower):.3f} to {degrees(upper):.3f} deg, the joint's limits",
                    remedy="correct the move, or the limits if they are wrong",
                )
        moves.append(PlannedMove(target, move.velocity, move.acceleration, move.dwell_s))
    return Plan(model.cell, model.seed, model.condition, duration_of(cell, moves), tuple(moves))
