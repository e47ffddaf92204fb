"""What the model leaves: by axis, in-sample and on moves that were left out of the fit."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ident.errors import TooFewMoves
from ident.jackknife import FEWEST_MOVES
from ident.linearisation import Linearisation

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Folds:
    """A linearised problem cut into folds of whole moves, with everything that cross-validation reuses.

    A block holds the rows of one motor in one move; what is wanted of a fold, a move or a motor is a sum over blocks.

    Attributes:
        problem: the linearisation, its rows sorted by fold, move and motor.
        moves: whole moves that the folds were dealt, whatever pieces the problem's clusters are.
        blocks: rows of each block.
        fold, move, motor: of each block, shape (blocks,).
        whole: Cholesky factor of JᵀJ, with scipy's flag.
        factors: the same without each fold.
        scores: Jᵀe without each fold, shape (folds, f).
        move_hessian, move_score: JᵀJ and Jᵀe of each move, shape (moves, f, f) and (moves, f).
        part_hessian, part_score: JᵀJ and Jᵀr of each fold and motor, shape (folds, n, f, f) and (folds, n, f).
        motor_score: Jᵀe of each motor, shape (n, f).
        residual: r, the e of each row predicted by a fit that did not see its fold, shape (rows,).
    """

    problem: Linearisation
    moves: int
    blocks: tuple[slice, ...]
    fold: IntArray
    move: IntArray
    motor: IntArray
    whole: tuple[FloatArray, bool]
    factors: tuple[tuple[FloatArray, bool], ...]
    scores: FloatArray
    move_hessian: FloatArray
    move_score: FloatArray
    part_hessian: FloatArray
    part_score: FloatArray
    motor_score: FloatArray
    residual: FloatArray

    @property
    def count(self) -> int:
        """Number of folds."""
        return len(self.factors)

    def square_sum(self, residual: FloatArray) -> FloatArray:
        """‖e‖² of each fold and motor, shape (folds, n)."""
        total = np.zeros((self.count, len(self.problem.gamma)))
        for rows, fold, motor in zip(self.blocks, self.fold, self.motor, strict=True):
            total[fold, motor] += float(residual[rows] @ residual[rows])
        return total


def cut(problem: Linearisation, count: int = 8, whole: IntArray | None = None) -> Folds:
    """Deal the moves out to folds in turn, so that every fold sees every run; a move is never parted.

    Args:
        problem: around an estimate.
        count: of folds; fewer where there are fewer moves.
        whole: the move that each cluster is a piece of, shape (clusters,); the clusters themselves when None.

    Raises:
        TooFewMoves: to leave some out.
    """
    whole = np.arange(problem.moves) if whole is None else np.unique(whole, return_inverse=True)[1]
    moves = int(whole.max()) + 1
    if moves < FEWEST_MOVES:
        raise TooFewMoves(moves, FEWEST_MOVES)
    count = min(count, moves)
    fold_of = whole % count
    motors, width = len(problem.gamma), problem.jacobian.shape[1]
    problem = problem.ordered(np.lexsort((problem.motor, problem.cluster, fold_of[problem.cluster])))
    change = (np.diff(problem.cluster, prepend=-1) != 0) | (np.diff(problem.motor, prepend=-1) != 0)
    starts = np.flatnonzero(change)
    blocks = tuple(slice(int(a), int(b)) for a, b in pairwise((*starts, len(problem.motor))))
    move, motor = problem.cluster[starts], problem.motor[starts]
    fold = fold_of[move]
    move_hessian, move_score = np.zeros((problem.moves, width, width)), np.zeros((problem.moves, width))
    part_hessian = np.zeros((count, motors, width, width))
    motor_score = np.zeros((motors, width))
    for rows, k, m, i in zip(blocks, fold, move, motor, strict=True):
        inside = problem.jacobian[rows]
        gram, score = inside.T @ inside, inside.T @ problem.residual[rows]
        move_hessian[m] += gram
        move_score[m] += score
        part_hessian[k, i] += gram
        motor_score[i] += score
    by_fold = part_hessian.sum(axis=1)
    hessian, score = by_fold.sum(axis=0), motor_score.sum(axis=0)
    # Two effects may say nearly the same: the direction in which they differ is left as it is.
    hessian[np.diag_indices_from(hessian)] *= 1.0 + 1e-10
    factors, scores = [], []
    for k in range(count):
        rest = hessian - by_fold[k]
        # A direction that only this fold sees must not explode: it stays where the whole data put it.
        rest[np.diag_indices_from(rest)] += 1e-10 * np.diag(hessian)
        factors.append(linalg.cho_factor(rest, lower=True))
        scores.append(score - move_score[fold_of == k].sum(axis=0))
    steps = [linalg.cho_solve(factor, part) for factor, part in zip(factors, scores, strict=True)]
    residual = np.empty_like(problem.residual)
    part_score = np.zeros((count, motors, width))
    for rows, k, i in zip(blocks, fold, motor, strict=True):
        inside = problem.jacobian[rows]
        residual[rows] = problem.residual[rows] - inside @ steps[k]
        part_score[k, i] += inside.T @ residual[rows]
    return Folds(
        problem=problem,
        moves=moves,
        blocks=blocks,
        fold=fold,
        move=move,
        motor=motor,
        whole=linalg.cho_factor(hessian, lower=True),
        factors=tuple(factors),
        scores=np.stack(scores),
        move_hessian=move_hessian,
        move_score=move_score,
        part_hessian=part_hessian,
        part_score=part_score,
        motor_score=motor_score,
        residual=residual,
    )
