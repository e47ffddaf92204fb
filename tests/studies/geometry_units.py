"""Units of the geometry study: one mistake on one robot and seed, planted, fitted and searched.

geometry_study.py works them off and makes the tables.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from daq.config.cell import Cell, model_of
from daq.workflow.fit import declared_effects
from ident.data.run import Run
from ident.discovery.declared import with_declared
from ident.discovery.evidence import Evidence, gather
from ident.discovery.loop import find_effects
from ident.equations.instants import read_instants
from ident.errors import IdentificationError
from ident.estimators.identify import identify
from ident.estimators.method import Method
from ident.estimators.turned_geometry import find_turned_geometry
from tests.studies.geometry_runs import RunsOfRobot, load_runs, make_runs
from tests.studies.planted_mistakes import (
    Mistake,
    Planted,
    is_prismatic,
    judge_mistake,
    plant,
    predicted_offset_std,
)
from tests.studies.real_runs import RECORDINGS, data_folder

OFFSETS_DEG = (0.3, 1.0, 2.0)
OFFSETS_MM = (1.0, 3.0, 6.0)
TILTS_DEG = (0.5, 1.0, 3.0)
DELAYS_MS = (1.0, 3.0, 5.0)
SIGMAS = 3.0
"""σ within which a value must be; and a joint shows its zero where the smallest offset is as many
predicted σ.
"""
TURNED = "turned gravity"
TURNS_DEG = (90.0, 180.0)
WITHIN_RAD = math.radians(5.0)  #: Of the true direction, gravity that was turned counts as named
#: Recordings with turned gravity, by robot
REAL = {"TX-40 recording": "tx40", "KR300 recording": "kr300-A"}
OBSERVABLE = "observable"


@dataclass(frozen=True, slots=True)
class MistakeUnit:
    """One mistake on one robot and seed.

    Attributes:
        out: folder of the study.
        robot: of STUDIED or REAL.
        seed: of its runs.
        mistake: value of a Mistake, TURNED, or OBSERVABLE.
        axis: index; −1 without one.
        level: place of its size among the sizes of its kind.
    """

    out: Path
    robot: str
    seed: int
    mistake: str
    axis: int
    level: int

    @property
    def name(self) -> str:
        """Name of its file."""
        where = "" if self.axis < 0 else f"-{self.axis + 1}"
        return f"{self.robot.replace(' ', '-')}-{self.seed}-{self.mistake.replace(' ', '-')}{where}-{self.level}"  # noqa: E501

    @property
    def runs(self) -> RunsOfRobot:
        """Its runs."""
        return RunsOfRobot(self.out, self.robot, self.seed)


@dataclass(frozen=True, slots=True)
class OffsetRow:
    """Whether the runs of a robot and seed show the zero of each axis.

    Attributes:
        robot, seed: of the runs.
        prismatic: of each axis.
        std: σ that an offset would be found with, rad or m of each axis; infinite where it is not
            seen.
        observable: of each axis.
    """

    robot: str
    seed: int
    prismatic: tuple[bool, ...]
    std: tuple[float, ...]
    observable: tuple[bool, ...]


@dataclass(frozen=True, slots=True)
class MistakeRow:
    """One mistake, and what came of it.

    Attributes:
        robot, seed, mistake: of the unit.
        axis: name; empty without one.
        size: that was planted [rad, m or s].
        planted: whether it was: a zero that the runs do not show is not.
        predicted_std: σ that a zero offset was predicted to be found with; NaN of others.
        named: whether the search named it on the right axis.
        value, std, z: as of NamedMistake.
        others: other effects that joined.
        set_aside: findings that passed the search, but did not join.
        error_before_percent, error_after_percent: relative error of the fit, before and after the
            search.
        gain_error_before_percent, gain_error_after_percent: of the worst gain; NaN of a real
            recording.
        gain_std_percent: σ of the worst gain after.
        refused: why there is no fit; else empty.
        processor_s: of fit and search.
    """

    robot: str
    seed: int
    mistake: str
    axis: str
    size: float
    planted: bool
    predicted_std: float
    named: bool
    value: float
    std: float
    z: float
    others: tuple[str, ...]
    set_aside: tuple[str, ...]
    error_before_percent: float
    error_after_percent: float
    gain_error_before_percent: float
    gain_error_after_percent: float
    gain_std_percent: float
    refused: str
    processor_s: float


NAN = float("nan")


def blank(
    unit: MistakeUnit, axis: str, size: float, *, planted: bool = True, predicted_std: float = NAN
) -> MistakeRow:
    """The row of a unit of which nothing is known yet."""
    return MistakeRow(
        robot=unit.robot,
        seed=unit.seed,
        mistake=unit.mistake,
        axis=axis,
        size=size,
        planted=planted,
        predicted_std=predicted_std,
        named=False,
        value=NAN,
        std=NAN,
        z=NAN,
        others=(),
        set_aside=(),
        error_before_percent=NAN,
        error_after_percent=NAN,
        gain_error_before_percent=NAN,
        gain_error_after_percent=NAN,
        gain_std_percent=NAN,
        refused="",
        processor_s=0.0,
    )


def size_of(mistake: Mistake, level: int, *, prismatic: bool) -> float:
    """Size of a mistake [rad, m or s]."""
    if mistake is Mistake.CLEAN:
        return 0.0
    if mistake in (Mistake.ENCODER, Mistake.CURRENT):
        return 1e-3 * DELAYS_MS[level]
    if mistake is Mistake.GRAVITY:
        return math.radians(TILTS_DEG[level])
    if prismatic:
        return 1e-3 * OFFSETS_MM[level]
    return math.radians(OFFSETS_DEG[level])


def fitted(cell: Cell, runs: Sequence[Run]) -> Evidence:
    """Fit runs by the declared model, with the effects that the cell declares.

    Raises:
        IdentificationError: the fit is refused.
    """
    declared = declared_effects(cell)
    found = identify(model_of(cell), runs, cell.conditioning, method=Method.ML, judge=not declared)
    start = gather(found, runs)
    if not declared:
        return start
    rng = np.random.default_rng(0)
    return with_declared(start, declared, rng)[-1].after


def observe_offsets(unit: MistakeUnit) -> tuple[OffsetRow, ...]:
    """Find the axes on which the clean runs of a robot would show a zero offset."""
    make_runs(unit.runs)
    runs = load_runs(unit.runs)
    evidence = fitted(unit.runs.cell, runs)
    std = predicted_offset_std(evidence)
    prismatic = is_prismatic(evidence)
    least = [size_of(Mistake.ZERO, 0, prismatic=linear) for linear in prismatic]
    observable = SIGMAS * std <= np.array(least)
    return (
        OffsetRow(
            unit.robot, unit.seed, prismatic, tuple(std.tolist()), tuple(observable.tolist())
        ),
    )


def search_unit(unit: MistakeUnit, offsets: OffsetRow) -> tuple[MistakeRow, ...]:
    """Plant the mistake of a unit, fit, and search; nothing where the runs would not show it."""
    mistake = Mistake(unit.mistake)
    cell = unit.runs.cell
    linear = unit.axis >= 0 and offsets.prismatic[unit.axis]
    size = size_of(mistake, unit.level, prismatic=linear)
    axis = cell.axis_names[unit.axis] if unit.axis >= 0 else ""
    row = blank(unit, axis, size)
    if mistake is Mistake.ZERO:
        predicted_std = offsets.std[unit.axis]
        row = replace(row, predicted_std=predicted_std, planted=offsets.observable[unit.axis])
        if not row.planted:
            return (row,)
    planted = Planted(mistake, unit.axis, size)
    runs, wrong = plant(load_runs(unit.runs), cell, planted, unit.seed)
    begun_s = time.process_time()
    try:
        start = fitted(wrong, runs)
        rng = np.random.default_rng(0)
        steps = find_effects(start, rng, axes=cell.place_names)
    except IdentificationError as error:
        refused = str(error).replace("\n", " ")
        processor_s = time.process_time() - begun_s
        return (
            replace(
                row,
                refused=refused,
                processor_s=processor_s,
            ),
        )
    spent_s = time.process_time() - begun_s
    end = steps[-1].after
    judged = judge_mistake(end, planted)
    true = unit.runs.true_gains
    before = 100.0 * np.abs(start.estimate.gains / true - 1.0)
    after = 100.0 * np.abs(end.estimate.gains / true - 1.0)
    worst = int(np.argmax(after))
    aside = []
    for step in steps:
        for one in step.set_aside:
            aside.append(one.finding)
    others = tuple(placed.name_among(cell.place_names) for placed in judged.others)
    set_aside = tuple(f"{one.effect.name} on {cell.place_names[one.axis]}" for one in aside)
    error_before_percent = start.estimate.relative_error(start.identification.system).total
    error_after_percent = end.estimate.relative_error(end.identification.system).total
    absolute_gain = abs(end.estimate.gains[worst])
    gain_std_percent = float(100.0 * end.estimate.gains_std[worst] / absolute_gain)
    gain_error_before_percent = float(before.max())
    gain_error_after_percent = float(after[worst])
    row = replace(
        row,
        named=judged.named,
        value=judged.value,
        std=judged.std,
        z=judged.z,
        others=others,
        set_aside=set_aside,
        error_before_percent=error_before_percent,
        error_after_percent=error_after_percent,
        gain_error_before_percent=gain_error_before_percent,
        gain_error_after_percent=gain_error_after_percent,
        gain_std_percent=gain_std_percent,
        processor_s=spent_s,
    )
    return (row,)


def turned_unit(unit: MistakeUnit) -> tuple[MistakeRow, ...]:
    """Fit a real recording with gravity turned about x of its base,
    and look for the true one as `fit` does.
    """
    recording = RECORDINGS[REAL[unit.robot]](data_folder())
    angle_deg = TURNS_DEG[unit.level]
    row = blank(unit, "", math.radians(angle_deg))
    true_m_s2 = np.array(recording.cell.gravity_m_s2)
    size = float(np.linalg.norm(true_m_s2))
    turned = {90.0: (0.0, size, 0.0), 180.0: (0.0, 0.0, size)}[angle_deg]
    cell = replace(recording.cell, gravity_m_s2=turned)
    model = model_of(cell)
    begun_s = time.process_time()
    instants = read_instants(model, recording.runs, cell.conditioning)
    found = find_turned_geometry(model, instants, recording.gains)
    if found is not None and found.gravity is not None:
        found_m_s2 = found.gravity.found_m_s2
        found_norm_m_s2 = float(np.linalg.norm(found_m_s2))
        along = float(found_m_s2 @ true_m_s2) / (found_norm_m_s2 * size)
        off_rad = math.acos(min(along, 1.0))
        std_rad = math.radians(found.gravity.std_deg)
        value = math.radians(found.gravity.turned_deg)
        row = replace(
            row, named=off_rad <= WITHIN_RAD, value=value, std=std_rad, z=off_rad / std_rad
        )
    try:
        fit = identify(
            model, recording.runs, cell.conditioning, method=Method.ML, fixed_gains=recording.gains
        )
    except IdentificationError as error:
        refused = str(error).replace("\n", " ")
        return (replace(row, refused=refused),)
    spent_s = time.process_time() - begun_s
    return (replace(row, error_before_percent=fit.training_error.total, processor_s=spent_s),)
