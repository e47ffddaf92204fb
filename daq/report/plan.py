"""A plan and what it promises: the predicted σ of each gain and the verdict on it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from daq.config.cell import Cell, joint_unit
from daq.report.document import Figure, Report
from daq.workflow.experiment import Experiment
from daq.workflow.plan import Plan, longer_run_s
from ident.planning.gain_verdict import GOOD_PERCENT, GainVerdict, Identifiability, Visibility
from ident.plausible import format_at_limit


class PlannedGain(Report):
    """Prediction for one gain."""

    axis: str
    predicted_std_percent: Figure
    known_preload_std_percent: Figure
    """σ if internal preload of redundant motors were known [%]"""
    verdict: str
    hidden_by: Literal["preload", "motion"] | None
    """why the gain is unseen, or weak by preload"""
    seen_by: list[str]
    alone_percent: dict[str, Figure]
    """σ that each source of information gives alone [%]"""
    words: str


class PlanReport(Report):
    """`plan`."""

    plan: str
    cell: str
    seed: int
    payload: str
    moves: int
    duration_s: float
    condition: float
    assumed: list[str]
    rank: int
    """independent directions of the gains that the moves determine to 10 %"""
    known_preload_rank: int | None
    """the same if internal preload were known"""
    hidden: list[str]
    """sentences on gains that the moves do not show, with what to do"""
    gains: list[PlannedGain]


def plan_report(
    out: Path, cell: Cell, experiment: Experiment, made: Plan, judged: Identifiability
) -> PlanReport:
    """Return a plan, with the verdict on the gain of each axis."""
    gains = [
        _planned_gain(axis.name, gain) for axis, gain in zip(cell.axes, judged.gains, strict=True)
    ]
    return PlanReport.of(
        made,
        judged,
        plan=out,
        payload=experiment.payload.name,
        moves=len(made.moves),
        duration_s=round(made.duration_s, 3),
        condition=round(made.condition, 1),
        assumed=experiment.remarks,
        hidden=judged.sentences(cell.axis_names),
        gains=gains,
    )


def _planned_gain(axis: str, gain: GainVerdict) -> PlannedGain:
    known_percent = gain.known_preload_percent
    if known_percent is not None:
        known_percent = round(known_percent, 3)
    alone_percent = {source: round(alone, 3) for source, alone in gain.alone_percent.items()}
    return PlannedGain.of(
        gain,
        axis=axis,
        predicted_std_percent=round(gain.std_percent, 3),
        known_preload_std_percent=known_percent,
        seen_by=gain.sources,
        alone_percent=alone_percent,
        words=gain.words(axis),
    )


def _on_all_gains(
    cell: Cell, made: Plan, judged: Identifiability, requested_s: float
) -> Iterator[str]:
    """Say which gains are hidden, and what makes weak ones good;
    σ falls with the square root of the time.
    """
    hidden = judged.sentences(cell.axis_names)
    yield from hidden
    if not hidden and judged.known_preload_rank is not None:
        directions = f"{judged.rank} of {len(judged.gains)} independent directions of the gains"
        yield f"Internal preload obscures no gain: these moves determine {directions}."
    weak = [gain for gain in judged.gains if gain.verdict is not Visibility.GOOD]
    if not weak:
        return
    ways = [
        "a heavier payload",
        "wider limits of position, speed and acceleration in the cell file",
    ]
    worst_percent = max(gain.std_percent for gain in weak)
    longer_s = None
    if math.isfinite(worst_percent):
        longer_s = longer_run_s(made.duration_s, requested_s, worst_percent / GOOD_PERCENT)
    if longer_s is not None:
        ways.insert(0, f"a longer run (some --duration {longer_s:.0f})")
    names = ", ".join(cell.axes[gain.axis].name for gain in weak)
    yield f"For good gains ({GOOD_PERCENT:g} %) of {names}: {'; or '.join(ways)}."


def _assembly(cell: Cell, experiment: Experiment) -> Iterator[str]:
    """Positions of the joints without a motor that close the loops,
    to compare with the real robot.
    """
    if cell.chain is None:
        return
    robot = experiment.scene.checker.robot
    position = experiment.design.expectation.model.assembly.position_rad

    def listed(joints: tuple[int, ...]) -> str:
        parts = []
        for number in joints:
            joint = robot.joints[number]
            unit = joint_unit(joint.kind)
            # Adding zero removes the sign of a rounded -0.
            value = np.round(position[number] / unit.si, 1) + 0.0
            parts.append(f"{joint.name} {value:g} {unit.name}")
        return ", ".join(parts)

    yield (
        f"Assembly pose, to compare with the robot: {listed(robot.passive_joints)} while the "
        f"motors' joints are at {listed(robot.axis_joints)}."
    )


def plan_text(
    out: Path,
    preview: Path | None,
    cell: Cell,
    experiment: Experiment,
    made: Plan,
    judged: Identifiability,
    requested_s: float,
) -> str:
    """Describe a plan in lines for the operator, who looks at its preview, if there is one.

    `requested_s` is the duration that the plan was allowed to have [s]; a longer one is proposed
    for weak gains.
    """
    look = f": {preview} shows the moves"
    if preview is None:
        look = ", or look at it (--preview PAGE)"
    way = "`record` checks the way to its first target from where the robot stands."
    if cell.clearance is None:
        way = (
            "The way to its first target is not checked: the cell file declares no `workspace` "
            "and no `clearance`."
        )
    width = max(map(len, (*cell.axis_names, "axis")))
    lines = [
        f"{out}: {len(made.moves)} moves in {made.duration_s:.0f} s, condition "
        f"{made.condition:.0f}",
        f"  {'axis':{width}}  predicted σ  verdict",
    ]
    sentences = []
    for axis, gain in zip(cell.axes, judged.gains, strict=True):
        std_percent = format_at_limit(gain.std_percent, GOOD_PERCENT, 2)
        lines.append(f"  {axis.name:{width}}  {std_percent:>9} %  {gain.verdict.value}")
        sentences.append(f"  {gain.words(axis.name)}")
    lines += sentences
    lines += _on_all_gains(cell, made, judged, requested_s)
    lines += _assembly(cell, experiment)
    lines.append("Assumed:")
    lines += [f"  {remark}" for remark in experiment.remarks]
    lines.append(f"Read the plan before the robot executes it{look}. {way}")
    return "\n".join(lines)
