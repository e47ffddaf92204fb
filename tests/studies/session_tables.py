"""Tables of the session study: a row for each unit,
and one for each robot (docs/evidence/session.md).

They are apart from the study, so that a change here makes no unit again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daq.files import replace_file
from tests.studies.any_robot import ROBOTS
from tests.studies.study_rows import to_csv

CHANGE_S = 180.0  #: For each change of the payload


def session_s(way: dict[str, Any]) -> float:
    """Motion of a guided session with its changes [s]; infinite where it failed."""
    if "failed" in way:
        return float("inf")
    return float(way["motion_s"] + CHANGE_S * way["changes"])


def steps_s(way: dict[str, Any]) -> float:
    """Motion of the three runs with their one change [s]; infinite where no duration was enough."""
    duration_s = way.get("duration_s")
    if duration_s is None:
        return float("inf")
    return 3.0 * float(duration_s) + CHANGE_S


def ratio_of(row: dict[str, Any]) -> float:
    """Time of a guided session over that step by step;
    infinite where it failed, 0 where only the other way did.
    """
    guided_s = session_s(row["guided"])
    if np.isinf(guided_s):
        return float("inf")
    return guided_s / steps_s(row["step_by_step"])


def is_missed(way: dict[str, Any]) -> bool:
    """Whether a guided session ended without its target."""
    return "failed" in way or bool(way["missing"])


@dataclass(frozen=True, slots=True)
class SessionRow:
    """A unit of the study, as in docs/evidence/data/session.csv."""

    robot: str
    seed: int
    motion_s: float
    changes: int
    step_by_step_s: float  #: the shortest duration that was enough [s]
    ratio: float  #: of the times, with three minutes a change
    worst_error_percent: float
    rms_z: float  #: errors over σ
    target_missed: bool
    reason: str  #: of a way that failed, or of a missed target


def row_of(unit: dict[str, Any]) -> SessionRow:
    """The unit as a row of the table."""
    way = unit["guided"]
    steps = unit["step_by_step"]
    z = _z([unit])
    errors = [abs(error) for error in way.get("error_percent", {}).values()]
    motion_s = way.get("motion_s", float("inf"))
    return SessionRow(
        robot=unit["robot"],
        seed=unit["seed"],
        motion_s=motion_s,
        changes=way.get("changes", 0),
        step_by_step_s=steps.get("duration_s") or float("inf"),
        ratio=ratio_of(unit),
        worst_error_percent=max(errors, default=float("inf")),
        rms_z=_rms(z),
        target_missed=is_missed(way),
        reason=way.get("failed", "") or way.get("missing", "") or steps.get("failed", ""),
    )


@dataclass(frozen=True, slots=True)
class RobotRow:
    """All seeds of a robot, as in docs/evidence/data/session-robots.csv."""

    robot: str
    seeds: int
    motion_s: float  #: median
    changes: str  #: least to most, of those that ended without an error
    step_by_step_s: float  #: median
    ratio: float  #: median
    worst_ratio: float
    targets_missed: int
    rms_z: float
    worst_error_percent: float


def robot_row(name: str, own: Sequence[dict[str, Any]]) -> RobotRow:
    """The units of a robot, or of all."""
    rows = [row_of(unit) for unit in own]
    ended = [row for row in rows if np.isfinite(row.motion_s)]
    changed = [row.changes for row in ended] or [0]
    ratios = [row.ratio for row in rows]
    median_motion_s = np.median([row.motion_s for row in rows])
    motion_s = float(median_motion_s)
    median_step_by_step_s = np.median([row.step_by_step_s for row in rows])
    step_by_step_s = float(median_step_by_step_s)
    targets_missed = sum(row.target_missed for row in rows)
    ratio = float(np.median(ratios))
    rms_z = _rms(_z(own))
    worst_error_percent = max((row.worst_error_percent for row in ended), default=float("nan"))
    return RobotRow(
        robot=name,
        seeds=len(rows),
        motion_s=motion_s,
        changes=f"{min(changed)} to {max(changed)}",
        step_by_step_s=step_by_step_s,
        ratio=ratio,
        worst_ratio=max(ratios),
        targets_missed=targets_missed,
        rms_z=rms_z,
        worst_error_percent=worst_error_percent,
    )


def robot_rows(units: Sequence[dict[str, Any]]) -> list[RobotRow]:
    """A row for each robot in the order of ROBOTS, and one for all."""
    rows = []
    for robot in ROBOTS:
        own = [unit for unit in units if unit["robot"] == robot.name]
        if own:
            rows.append(robot_row(robot.name, own))
    if units:
        rows.append(robot_row("all", units))
    return rows


def summary(units: Sequence[dict[str, Any]]) -> str:
    """A line for each robot, and the reasons of what failed."""
    lines = [
        "| robot | seeds | guided: motion s | changes | step by step: duration s | ratio of times, "
        "median | worst | target missed | error / σ, rms | worst error % |",
        "|" + "---|" * 10,
    ]
    for row in robot_rows(units):
        times = (
            f"{row.motion_s:.0f} | {row.changes} | {row.step_by_step_s:.0f} | {row.ratio:.2f} | "
            f"{row.worst_ratio:.2f}"
        )
        errors = f"{row.targets_missed} | {row.rms_z:.2f} | {row.worst_error_percent:.2f}"
        lines.append(f"| {row.robot} | {row.seeds} | {times} | {errors} |")
    reasons = [f"{row.robot}-{row.seed}: {row.reason}" for row in map(row_of, units) if row.reason]
    return "\n".join([*lines, "", *reasons])


def _z(units: Sequence[dict[str, Any]]) -> list[float]:
    """Errors of all gains over their σ."""
    found = []
    for unit in units:
        guided = unit["guided"]
        for axis, error in guided.get("error_percent", {}).items():
            found.append(error / guided["std_percent"][axis])
    return found


def _rms(values: Sequence[float]) -> float:
    if values:
        return float(np.sqrt(np.mean(np.square(values))))
    return float("nan")


def write_tables(folder: Path, units: Sequence[dict[str, Any]]) -> None:
    """Write the tables of the documentation."""
    names = [robot.name for robot in ROBOTS]
    in_order = sorted(units, key=lambda unit: (names.index(unit["robot"]), unit["seed"]))
    rows = map(row_of, in_order)
    content = to_csv(SessionRow, rows).encode()
    replace_file(folder / "session.csv", content)
    path = folder / "session-robots.csv"
    replace_file(path, to_csv(RobotRow, robot_rows(in_order)).encode())
