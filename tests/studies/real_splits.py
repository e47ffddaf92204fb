"""Effects that a search on a part of a real recording writes, judged on the part that was left out.

The search runs on the rest alone, and only then the part is predicted, without and with the effects
that are written. Each written effect is judged on its own, too, against a model of the others that
is refitted without it: it must raise the error of no axis by more than noise (regions.py).
real_study.py makes the tables.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from daq.config.cell import model_of
from ident.arrays import FloatArray
from ident.data.run import Run
from ident.discovery.current_filter import find_current_filter
from ident.discovery.evidence import Evidence, gather, with_effects
from ident.discovery.loop import Step, find_effects
from ident.effects.effect import PlacedEffect
from ident.equations.observation import Observation
from ident.estimators.estimate import Estimate, RelativeError, of_squares
from ident.estimators.identify import identify
from ident.estimators.method import Method
from tests.studies.real_runs import RECORDINGS, Recording, data_folder, stretches
from tests.studies.regions import LEVEL, Rise, judge_rise, split_by_region, two_sides

REGION = "region"  #: A split by region of the workspace
TODAY = "today"  #: The one split that was made of each recording before
EVERYTHING = "everything"  #: In the place of an effect: all written effects of a split together


@dataclass(frozen=True, slots=True)
class SplitUnit:
    """One part of one split of a recording, left out."""

    recording: str  #: of RECORDINGS
    split: str  #: REGION or TODAY
    seed: int  #: of the regions; 0 of TODAY
    part: int  #: that is left out

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.recording}-{self.split}-{self.seed}-{self.part}"


@dataclass(frozen=True, slots=True)
class JudgedEffect:
    """A written effect, or all of a split, on the part that was left out; axes in their order.

    Attributes:
        recording, split, seed, part: of the unit.
        effect: `family on axis`, or EVERYTHING.
        written: effects of the split; of EVERYTHING alone.
        blocks: independent blocks of the axis with the largest rise.
        raised_axis: axis with the largest rise in units of its σ, beside the limit.
        raised_points: rise of its relative error [points].
        t, t_limit: that rise, and the limit above which it is more than noise.
        raises: whether it is.
        total_t, total_t_limit, total_raises: the same of all axes together.
        largest_rise_points: largest rise of the relative error of an axis [points], noise or not.
        total_rise_points: of the relative error of all axes [points].
        size_nm2, before_nm2, after_nm2: ‖Y_j‖² and ‖ρ_j‖² without and with it on the part that was
            left out.
        processor_s: of the search; of EVERYTHING alone.
    """

    recording: str
    split: str
    seed: int
    part: int
    effect: str
    written: tuple[str, ...]
    blocks: int
    raised_axis: str
    raised_points: float
    t: float
    t_limit: float
    raises: bool
    total_t: float
    total_t_limit: float
    total_raises: bool
    largest_rise_points: float
    total_rise_points: float
    size_nm2: tuple[float, ...]
    before_nm2: tuple[float, ...]
    after_nm2: tuple[float, ...]
    processor_s: float

    @property
    def error_before(self) -> RelativeError:
        """Relative error without it [%]."""
        size_nm2 = np.array(self.size_nm2)
        return of_squares(size_nm2, np.array(self.before_nm2))

    @property
    def error_after(self) -> RelativeError:
        """Relative error with it [%]."""
        size_nm2 = np.array(self.size_nm2)
        return of_squares(size_nm2, np.array(self.after_nm2))


def written_effects(steps: Sequence[Step], holdout: Sequence[Run] = ()) -> tuple[PlacedEffect, ...]:
    """Effects that a calibration would contain after a search: all of its last step.

    Args:
        steps: of the search.
        holdout: runs by which effects may be refused. The part of a recording that judges is never
            among them.
    """
    del holdout  # no effect is refused by itself so far
    return steps[-1].after.effects


@functools.cache
def recording_of(name: str) -> Recording:
    """Read a recording once."""
    return RECORDINGS[name](data_folder())


def sides_of(unit: SplitUnit) -> tuple[list[Run], list[Run]]:
    """The runs of a unit's recording without the part that is left out, and that part."""
    recording = recording_of(unit.recording)
    runs = list(recording.runs)
    if unit.split == TODAY:
        part_of = recording.part_of
    else:
        runs = [run for run in runs if run.name != recording.left_out_whole]
        part_of = split_by_region(runs, recording.stretch_s, unit.seed)
    # A split in two has its held-out part as number 0.
    masks = [part == unit.part for part in part_of]
    # A region leaves whole stretches out, and too few moves of the usual length would be left of a
    # short recording.
    if recording.stretches_are_moves or unit.split == REGION:
        runs = [replace(run, move=stretches(run, recording.stretch_s)) for run in runs]
    model = model_of(recording.cell)
    return two_sides(runs, masks, model, recording.cell.conditioning)


def judge_unit(unit: SplitUnit) -> tuple[JudgedEffect, ...]:
    """Search without a part of a recording, and judge what is written on that part."""
    recording = recording_of(unit.recording)
    cell = recording.cell
    rest, unseen = sides_of(unit)
    begun_s = time.process_time()
    found = identify(
        model_of(cell), rest, cell.conditioning, method=Method.ML, fixed_gains=recording.gains
    )
    current_filter = find_current_filter(gather(found, rest))
    if current_filter is not None:
        conditioning = current_filter.applied_to(cell.conditioning)
        found = identify(
            model_of(cell), rest, conditioning, method=Method.ML, fixed_gains=recording.gains
        )
    # The search is given no row of the part that judges it.
    rng = np.random.default_rng(0)
    steps = find_effects(gather(found, rest), rng)
    spent_s = time.process_time() - begun_s
    written = written_effects(steps)
    start = gather(found, rest, unseen)
    # Where nothing is written; a refit would differ by rounding, and that alike in all blocks
    end = start
    if written:
        after = steps[-1].after
        end = with_effects(_around(start, after), written)
    names = [placed.name_among(cell.axis_names) for placed in written]
    rows = [_judged(unit, cell.axis_names, EVERYTHING, start, end, tuple(names), spent_s)]
    for placed, name in zip(written, names, strict=True):
        others = tuple(other for other in written if other != placed)
        without = with_effects(end, others)
        rows.append(_judged(unit, cell.axis_names, name, without, end))
    return tuple(rows)


def _around(start: Evidence, found: Evidence) -> Evidence:
    """Evidence with held-out runs whose columns are predicted by the estimate of a search without
    them.
    """
    return replace(start, training=found.training, effects=found.effects, estimate=found.estimate)


def squares(rows: Observation, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """‖Y_j‖² and ‖ρ_j‖² of each joint [Nm²], shape (n,)."""
    torque = rows.torque(estimate.gains)
    residual = estimate.residual_torque(rows)
    return np.sum(torque**2, axis=1, where=rows.use), np.sum(residual**2, axis=1, where=rows.use)


def _judged(
    unit: SplitUnit,
    axes: Sequence[str],
    effect: str,
    before: Evidence,
    after: Evidence,
    written: tuple[str, ...] = (),
    processor_s: float = 0.0,
) -> JudgedEffect:
    """Compare two models on the part that was left out."""
    first = before.holdout
    second = after.holdout
    if first is None or second is None:
        raise ValueError(f"{unit.name}: nothing was left out")
    size, left_before = squares(first, before.estimate)
    _, left_after = squares(second, after.estimate)
    change = (
        after.estimate.residual_torque(second) ** 2 - before.estimate.residual_torque(first) ** 2
    )
    change = np.where(first.use, change, 0.0)
    rises = axis_rises(change, first)
    worst = max(range(len(rises)), key=lambda axis: rises[axis].t - rises[axis].limit)
    used = first.use.any(axis=0)
    total = judge_rise(change.sum(axis=0)[used], first.run[used])
    errors = of_squares(size, left_before), of_squares(size, left_after)
    points = np.subtract(errors[1].axes, errors[0].axes)
    total_rise_points = errors[1].total - errors[0].total
    raises = any(rise.is_shown for rise in rises)
    largest_rise_points = float(np.nanmax(points))
    raised_points = float(points[worst])
    size_nm2 = tuple(size.tolist())
    before_nm2 = tuple(left_before.tolist())
    after_nm2 = tuple(left_after.tolist())
    blocks = rises[worst].blocks
    return JudgedEffect(
        recording=unit.recording,
        split=unit.split,
        seed=unit.seed,
        part=unit.part,
        effect=effect,
        written=written,
        blocks=blocks,
        raised_axis=axes[worst],
        raised_points=raised_points,
        t=rises[worst].t,
        t_limit=rises[worst].limit,
        raises=raises,
        total_t=total.t,
        total_t_limit=total.limit,
        total_raises=total.is_shown,
        largest_rise_points=largest_rise_points,
        total_rise_points=total_rise_points,
        size_nm2=size_nm2,
        before_nm2=before_nm2,
        after_nm2=after_nm2,
        processor_s=processor_s,
    )


def axis_rises(change: FloatArray, rows: Observation) -> tuple[Rise, ...]:
    """Judge the rise of each axis's squared error, shape (n, r);
    the level is shared by the axes.
    """
    level = LEVEL / len(change)
    pairs = zip(change, rows.use, strict=True)
    return tuple(judge_rise(own[used], rows.run[used], level) for own, used in pairs)
