"""Splits of recordings by region of the workspace, and whether an error on what was left out rises
by more than noise.

A split cuts runs into stretches and deals them to four parts by where the arm was: the stretches
are halved at the median along the direction in which their joint positions differ most, and each
half again. Each seed weighs the joints differently, so it halves along other directions. Parts are
of one size, and each is apart from the others.

A rise is judged on blocks of rows that are independent of each other: rows are joined in pairs
until neighbours no longer show a correlation (batch means: Fishman 1978), as
`ident.equations.linearisation.independent_blocks` joins moves. With d_b the rise of the squared
error in block b of B,

    Σ d_b > t_(1 − p, B − 1) · √(B/(B − 1) Σ (d_b − mean)²)

is a rise by more than noise at the level p.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import stdtrit

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.equations.rows import row_masks
from ident.model.model import Model
from tests.studies.real_runs import stretches

PARTS = 4
LEVEL = 0.01  #: Share of splits in which noise alone makes a rise, over all axes together
#: Rows in half a window of the row filter: what is farther apart shares little of it
FIRST_BLOCK = 4
LEAST_BLOCKS = 8
OWN_RUN_S = 10.0  #: A side in one stretch of this length is as if it had been recorded alone
#: Standard errors of the correlation of neighbouring blocks, above which they are joined
CORRELATED = 2.0


@dataclass(frozen=True, slots=True)
class Rise:
    """Rise of a squared error over independent blocks.

    Attributes:
        rise: sum over the blocks.
        std: its σ by their scatter.
        blocks: their number.
        limit: t above which it is more than noise.
    """

    rise: float
    std: float
    blocks: int
    limit: float

    @property
    def t(self) -> float:
        """The rise in units of its σ; 0 where nothing changes."""
        return self.rise / self.std if self.std > 0.0 else 0.0

    @property
    def is_shown(self) -> bool:
        """Whether it is more than noise."""
        return self.t > self.limit


def region_of(position: FloatArray, seed: int, parts: int = PARTS) -> IntArray:
    """Part of each stretch, shape (s,), by the mean joint positions of all stretches, shape (s, n).

    Args:
        position: in any units; each joint is scaled by its spread.
        seed: of the weights of the joints.
        parts: a power of two.
    """
    spread = position.std(axis=0)
    scale = np.where(spread > 0.0, spread, 1.0)
    weights = np.random.default_rng(seed).exponential(size=position.shape[1])
    scaled = (position - position.mean(axis=0)) / scale * weights
    part = np.zeros(len(position), dtype=np.int64)
    while parts > 1:
        halves = np.zeros_like(part)
        for old in np.unique(part):
            own = np.flatnonzero(part == old)
            halves[own] = _upper_half(scaled[own])
        part = 2 * part + halves
        parts //= 2
    return part


def _upper_half(points: FloatArray) -> IntArray:
    """1 for the half of the points, shape (s, n), that lies farther along their widest direction;
    else 0.
    """
    centred = points - points.mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    # The sign of a singular vector is a matter of rounding.
    along = centred @ (direction * np.sign(direction[np.argmax(np.abs(direction))]))
    upper = np.zeros(len(points), dtype=np.int64)
    upper[np.argsort(along, kind="stable")[len(points) // 2 :]] = 1
    return upper


def split_by_region(runs: Sequence[Run], stretch_s: float, seed: int) -> tuple[IntArray, ...]:
    """Part of each sample of each run, shape (k,) each."""
    numbers = [stretches(run, stretch_s) for run in runs]
    means: list[FloatArray] = []
    for run, number in zip(runs, numbers, strict=True):
        means += [run.position_rad[number == one].mean(axis=0) for one in np.unique(number)]
    part_of_stretch = region_of(np.array(means), seed)
    first = 0
    parts = []
    for number in numbers:
        parts.append(part_of_stretch[first + number])
        first += int(number[-1]) + 1
    return tuple(parts)


def two_sides(
    runs: Sequence[Run], left_out: Sequence[BoolArray], model: Model, conditioning: Conditioning
) -> tuple[list[Run], list[Run]]:
    """The rest of some runs and what is left out of them;
    a row whose window touches both sides belongs to neither.

    A run of which a side has no row that counts is none of that side.

    Args:
        runs: to split.
        left_out: of each run, shape (k,) each.
        model: as declared.
        conditioning: the filters.
    """
    rest = []
    unseen = []
    for run, mask in zip(runs, left_out, strict=True):
        if run.valid is None:
            valid = np.ones(run.position_rad.shape, dtype=np.bool_)
        else:
            valid = run.valid
        rest.append(
            _side(replace(run, name=f"{run.name}, the rest", valid=valid & ~mask[:, None]), ~mask)
        )
        unseen.append(
            _side(replace(run, name=f"{run.name}, left out", valid=valid & mask[:, None]), mask)
        )
    with_rows = partial(_has_rows, model=model, conditioning=conditioning)
    return list(filter(with_rows, rest)), list(filter(with_rows, unseen))


def _has_rows(run: Run, model: Model, conditioning: Conditioning) -> bool:
    """Whether a row of a run counts: outside standstill, and with its whole window on one side."""
    data = differentiate(run, model.drive_train, conditioning)
    use, _ = row_masks(model, data, conditioning)
    return bool(use.any())


def _side(run: Run, own: BoolArray) -> Run:
    """A run with the samples of one side, shape (k,);
    a side that is one long stretch is a run of its own.
    """
    first = int(np.argmax(own))
    last = len(own) - int(np.argmax(own[::-1]))
    part = slice(first, last)
    if not own.any() or not own[part].all() or last - first < OWN_RUN_S * run.rate_hz:
        return run
    return replace(
        run,
        time_s=run.time_s[part],
        position_rad=run.position_rad[part],
        current_a=run.current_a[part],
        valid=None if run.valid is None else run.valid[part],
        move=None if run.move is None else run.move[part],
    )


def independent_sums(change: FloatArray, run: IntArray) -> FloatArray:
    """Sums of a change over blocks of rows that are independent of each other, shape (blocks,).

    Args:
        change: of each row, in the order of time, shape (r,).
        run: of each row, shape (r,): no block has rows of two runs.
    """
    starts = _firsts(run, FIRST_BLOCK)
    sums = np.add.reduceat(change, starts) if len(change) else change
    run = run[starts]
    while True:
        deviation = sums - sums.mean() if len(sums) else sums
        products = (deviation[1:] * deviation[:-1])[run[1:] == run[:-1]]
        first = _firsts(run, 2)
        is_independent = products.sum() <= CORRELATED * np.linalg.norm(products)
        if is_independent or len(first) < LEAST_BLOCKS:
            return np.asarray(sums)
        sums = np.add.reduceat(sums, first)
        run = run[first]


def _firsts(run: IntArray, size: int) -> IntArray:
    """First of every so many entries of each run, ascending."""
    firsts = [np.flatnonzero(run == one)[::size] for one in np.unique(run)]
    if firsts:
        return np.sort(np.concatenate(firsts))
    return np.zeros(0, dtype=np.int64)


def judge_rise(change: FloatArray, run: IntArray, level: float = LEVEL) -> Rise:
    """Judge the rise of a squared error by its change in each row, shape (r,), of runs,
    shape (r,).
    """
    sums = independent_sums(change, run)
    blocks = len(sums)
    if blocks < 2:
        return Rise(float(sums.sum()), 0.0, blocks, float("inf"))
    std = float(np.sqrt(blocks * np.var(sums, ddof=1)))
    return Rise(float(sums.sum()), std, blocks, float(stdtrit(blocks - 1, 1.0 - level)))
