"""`plan.yaml`: moves that a person can read, change and approve before anything moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from daq.config.cell import DEGREE, Cell, JointUnit, model_of
from daq.config.yaml_file import StrictModel, parse_yaml, read_model, read_yaml_bytes
from daq.errors import ConfigurationInconsistent
from daq.files import replace_file
from daq.workflow.experiment import PlannedMove, experiment_duration_s, paths_of, scene_of
from daq.workflow.plan import Plan
from drivers.errors import MotionRefused
from ident.arrays import FloatArray
from ident.planning.clearance import CLOSURES, Checker, Obstruction

LONGEST_S = 3600.0
Velocity = Annotated[float, Field(ge=0.01, le=1)]  #: Slower than a hundredth of its limits a move would hardly end
Acceleration = Annotated[float, Field(ge=0.0001, le=1)]
"""A hundredth of the speed on the same ways is a ten-thousandth of the acceleration."""


class _Move(StrictModel):
    target_deg: tuple[float, ...] | None = None
    target: tuple[float, ...] | None = None
    velocity: Velocity
    acceleration: Acceleration
    dwell_s: Annotated[float, Field(ge=0, le=60)] = 0.0

    @model_validator(mode="after")
    def _one_target(self) -> _Move:
        if (self.target_deg is None) == (self.target is None):
            raise ValueError("target_deg, or target where some axes are in mm")
        return self


class _Plan(StrictModel):
    format: Literal["drivegain-plan"]
    cell: str
    seed: int
    condition: Annotated[float, Field(gt=0)]
    # Plans of earlier versions have none.
    predicted_std_percent: tuple[Annotated[float, Field(gt=0)], ...] = ()
    moves: Annotated[tuple[_Move, ...], Field(min_length=1, max_length=10_000)]


def save_plan(plan: Plan, path: Path) -> None:
    """Write a plan; a file of that name is replaced whole.

    Raises:
        OSError: from the file system.
    """
    key = _key(plan.units)
    predicted = ", ".join(f"{value:.3f}" for value in plan.predicted_std_percent)
    lines = [
        "# Synchronised point-to-point moves; velocity and acceleration are shares of the joint limits.",
        f"# Targets: {', '.join(unit.name for unit in plan.units)}.",
        "format: drivegain-plan",
        f"cell: {plan.cell}",
        f"seed: {plan.seed}",
        f"condition: {plan.condition:.1f}    # of the weighted observation matrix",
        f"predicted_std_percent: [{predicted}]    # of each gain, moves made without load and with the payload",
        "moves:",
    ]
    for move in plan.moves:
        target = ", ".join(f"{at / unit.si:.3f}" for at, unit in zip(move.target_rad, plan.units, strict=True))
        lines.append(
            f"  - {{{key}: [{target}], velocity: {move.velocity:.3f}, acceleration: {move.acceleration:.4f}, "
            f"dwell_s: {move.dwell_s:.3f}}}"
        )
    replace_file(path, ("\n".join(lines) + "\n").encode())


def load_plan(path: Path, cell: Cell) -> Plan:
    """Read a plan for a cell; one that was changed by hand is checked as strictly as one that was made.

    Raises:
        ConfigurationError: the file is missing, is not what its schema says, a target lies outside the joint limits,
            the plan takes longer than an hour, or a way leaves the declared workspace or clearance.
    """
    model = read_model(parse_yaml(read_yaml_bytes(path), str(path)), _Plan)
    if model.cell != cell.name:
        remedy = "make a plan for this cell: `drivegain plan CELL`"
        raise _refused(str(path), f"a plan for cell {model.cell!r}", f"one for {cell.name!r}", remedy)
    if len(model.predicted_std_percent) not in (0, len(cell.axes)):
        found = f"{len(model.predicted_std_percent)} numbers"
        remedy = "make the plan anew: `drivegain plan CELL`"
        raise _refused(f"{path}: predicted_std_percent", found, f"{len(cell.axes)}, one a gain", remedy)
    moves = tuple(_move(path, cell, number, move) for number, move in enumerate(model.moves))
    duration_s = experiment_duration_s(cell, moves)
    if duration_s > LONGEST_S:
        found = f"{duration_s:.0f} s of moves and dwells"
        remedy = "leave moves out, or raise velocity and acceleration"
        raise _refused(f"{path}: moves", found, f"at most {LONGEST_S:.0f} s", remedy)
    _check_room(path, cell, moves)
    return Plan(
        cell=model.cell,
        seed=model.seed,
        condition=model.condition,
        predicted_std_percent=model.predicted_std_percent,
        duration_s=duration_s,
        moves=moves,
        units=tuple(axis.unit for axis in cell.axes),
    )


def _key(units: tuple[JointUnit, ...]) -> str:
    return "target_deg" if all(unit == DEGREE for unit in units) else "target"


def _refused(where: str, found: str, expected: str, remedy: str = "correct the move") -> ConfigurationInconsistent:
    return ConfigurationInconsistent(where, found=found, expected=expected, remedy=remedy)


def _move(path: Path, cell: Cell, number: int, move: _Move) -> PlannedMove:
    key = "target_deg" if move.target is None else "target"
    values = move.target_deg or move.target or ()
    where = f"{path}: moves[{number}].{key}"
    expected_key = _key(tuple(axis.unit for axis in cell.axes))
    if key != expected_key:
        units = ", ".join(f"{axis.name} {axis.unit.name}" for axis in cell.axes)
        raise _refused(where, key, f"{expected_key} ({units})")
    if len(values) != len(cell.axes):
        raise _refused(where, f"{len(values)} positions", f"{len(cell.axes)}, one a joint")
    target = tuple(value * axis.unit.si for value, axis in zip(values, cell.axes, strict=True))
    for axis, position in zip(cell.axes, target, strict=True):
        lower, upper = axis.limits.position
        if not lower <= position <= upper:
            expected = f"{axis.unit.spell(lower)} to {axis.unit.spell(upper)}, the joint's limits"
            remedy = "correct the move, or the limits if they are wrong"
            raise _refused(f"{where}, {axis.name}", axis.unit.spell(position), expected, remedy)
    return PlannedMove(target, move.velocity, move.acceleration, move.dwell_s)


def check_approach(cell: Cell, plan: Plan, start_rad: FloatArray) -> None:
    """Refuse a way to the first target that leaves what the cell file declares.

    Args:
        cell: with `workspace`, `clearance` or closures; without any, nothing is known of the room.
        plan: for this cell.
        start_rad: where the robot stands [rad; m of a prismatic joint], shape (n,).

    Raises:
        MotionRefused: with the place and the bodies that come too close.
    """
    first = np.array(plan.moves[0].target_rad)
    check_way(cell, start_rad, first, "the way from here to the first target of the plan")


def check_way(cell: Cell, start_rad: FloatArray, end_rad: FloatArray, way: str) -> None:
    """Refuse a way, named for the message, that leaves what the cell file declares.

    Raises:
        MotionRefused: with the place and the bodies that come too close.
    """
    if not _is_bounded(cell):
        return
    found = _checker(cell).obstruction(start_rad, end_rad)
    if found is not None:
        raise MotionRefused(
            f"{way}: found {_spell(cell, found)}; bring the robot near the first target by hand, or correct "
            f"{_keys(found)} in the cell file"
        )


def _is_bounded(cell: Cell) -> bool:
    """Whether the cell file says where the robot must not go."""
    return cell.clearance is not None or cell.chain is not None


def _spell(cell: Cell, found: Obstruction) -> str:
    where = ", ".join(axis.unit.spell(p) for axis, p in zip(cell.axes, found.position, strict=True))
    if found.first == CLOSURES:
        return f"that the loops do not close, or are close to a singularity, at ({where})"
    return f"{1000 * found.distance_m:.0f} mm between {found.first} and {found.second} at ({where})"


def _keys(found: Obstruction) -> str:
    return "`closures`, `motors` and `limits`" if found.first == CLOSURES else "`workspace` and `clearance`"


def _checker(cell: Cell) -> Checker:
    """Distances to what the cell file declares; that a guessed arm touches itself refuses nothing."""
    robot = model_of(cell).robot
    lightest = min((payload.mass_kg for payload in cell.payloads), default=1.0)
    scene = scene_of(cell, robot, lightest)
    return Checker(robot, replace(scene.checker.scene, pairs=())) if scene.guessed else scene.checker


def _check_room(path: Path, cell: Cell, moves: tuple[PlannedMove, ...]) -> None:
    """Refuse ways that leave what the cell file declares."""
    if not _is_bounded(cell):
        return
    checker = _checker(cell)
    minimum_m = checker.scene.minimum_m
    for number, way in enumerate(paths_of(cell, moves), start=1):
        found = checker.obstruction(np.asarray(way.start), np.asarray(way.end))
        if found is not None:
            raise _refused(
                f"{path}: moves[{number}], on the way there",
                _spell(cell, found),
                "poses inside the workspace" if found.first == CLOSURES else f"at least {1000 * minimum_m:.0f} mm",
                f"correct the move, or {_keys(found)} in the cell file",
            )
