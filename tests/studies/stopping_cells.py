"""Simulated cells that are recorded in blocks, with the gains after each move and each block.

Blocks are without load, loaded, loaded, without load, and so on, of random moves
(tests/ident/pieces.py). A fit that grows gives the quick estimate after each move, and that of `ml`
after each block.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ident.data.conditioning import Conditioning
from ident.estimators.growing import GrowingFit
from ident.estimators.maximum_likelihood import ml
from tests.ident.pieces import first_samples, noisy_pieces
from tests.ident.recordings import MOUNTED, FloatArray, Truth, three_axes_truth, tx40_truth
from tests.ident.weighed import RATE_HZ

BLOCK_S = 8.0  #: Of one block
MOVE_S = 1.1  #: From one look to the next, about a move
FIRST_SEED = 4001


@dataclass(frozen=True, slots=True)
class Arm:
    """Kind of the cells."""

    truth: Callable[[], Truth]
    blocks: int  #: recorded of each cell
    cells: int


ARMS = {"three": Arm(three_axes_truth, 20, 100), "tx40": Arm(tx40_truth, 12, 50)}


@dataclass(frozen=True, slots=True)
class Look:
    """Gains at one moment of one cell."""

    seed: int
    estimator: str  #: QUICK or ML
    block: int  #: from 1
    is_end: bool  #: of the block
    recorded_s: float  #: so far
    error_percent: tuple[float, ...]  #: of each gain, against the truth
    std_percent: tuple[float, ...]  #: σ of each gain

    @property
    def z(self) -> tuple[float, ...]:
        """Error of each gain in its σ."""
        return tuple(
            error / std for error, std in zip(self.error_percent, self.std_percent, strict=True)
        )


QUICK = "quick"
ML = "ml"


@dataclass(frozen=True, slots=True)
class CellUnit:
    """One cell: noise and moves of its own."""

    arm: str
    number: int

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.arm}-{self.number:03d}"

    @property
    def seed(self) -> int:
        """Seed of its noise and moves."""
        return FIRST_SEED + self.number


def looks_of(unit: CellUnit) -> list[Look]:
    """Record a cell, and return the gains at every look at which they are known."""
    arm = ARMS[unit.arm]
    truth = arm.truth()
    standstill_rad_s = (0.03,) * len(truth.gains)
    conditioning = Conditioning(standstill_rad_s=standstill_rad_s)
    fit = GrowingFit(truth.model, conditioning, (MOUNTED,))
    looks = []

    def look(
        estimator: str, gains: FloatArray, std: FloatArray, block: int, block_s: float
    ) -> None:
        error_percent = 100.0 * (gains / truth.gains - 1.0)
        std_percent = 100.0 * std / np.abs(gains)
        recorded_s = (block - 1) * BLOCK_S + block_s
        looks.append(
            Look(
                seed=unit.seed,
                estimator=estimator,
                block=block,
                is_end=block_s == BLOCK_S,
                recorded_s=recorded_s,
                error_percent=tuple(error_percent.tolist()),
                std_percent=tuple(std_percent.tolist()),
            )
        )

    moments_s = [*np.arange(MOVE_S, BLOCK_S, MOVE_S).tolist(), BLOCK_S]
    for block, run in enumerate(noisy_pieces(truth, unit.seed, arm.blocks, BLOCK_S), start=1):
        for moment_s in moments_s:
            if moment_s < BLOCK_S:
                fit = fit.with_run_so_far(first_samples(run, round(moment_s * RATE_HZ)))
            else:
                fit = fit.with_run(run)
            found = fit.gains()
            if found.gains is not None and found.gains_std is not None:
                look(QUICK, found.gains, found.gains_std, block, moment_s)
        if found.gains is not None:
            estimate = ml(fit.system())
            look(ML, estimate.gains, estimate.gains_std, block, BLOCK_S)
    return looks
