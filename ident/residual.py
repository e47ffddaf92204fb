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

    Attributes:
        problem: the linearisation, its rows sorted by fold so that a fold is a slice and never a copy.
        slices: rows of each fold.
        factors: Cholesky factor of JᵀJ without each fold, with scipy's flag.
        scores: Jᵀe without each fold, shape (folds, f).
        residual: e of each row, predicted by a fit that did not see its fold, shape (rows,).
    """

    problem: Linearisation
    slices: tuple[slice, ...]
    factors: tuple[tuple[FloatArray, bool], ...]
    scores: FloatArray
    residual: FloatArray

    @property
    def count(self) -> int:
        """Number of folds."""
        return len(self.factors)

    def square_sum(self, residual: FloatArray) -> FloatArray:
        """‖e‖² of each fold and motor, shape (folds, n)."""
        n, squares = len(self.problem.gamma), residual**2
        sums = [np.bincount(self.problem.motor[rows], squares[rows], n) for rows in self.slices]
        return np.asarray(np.stack(sums), dtype=np.float64)


def cut(problem: Linearisation, count: int = 8) -> Folds:
    """Deal the moves out to folds in turn, so that every fold sees every run; a move is never parted.

    Args:
        problem: around an estimate.
        count: of folds; fewer where there are fewer moves.

    Raises:
        TooFewMoves: to leave some out.
    """
    if problem.moves < FEWEST_MOVES:
        raise TooFewMoves(problem.moves, FEWEST_MOVES)
    count = min(count, problem.moves)
    fold = problem.cluster % count
    order = np.argsort(fold, kind="stable")
    problem = problem.ordered(order)
    bounds = np.searchsorted(fold[order], np.arange(count + 1))
    slices = tuple(slice(int(first), int(last)) for first, last in pairwise(bounds))
    hessian, score = problem.jacobian.T @ problem.jacobian, problem.jacobian.T @ problem.residual
    factors, scores = [], []
    residual = np.empty_like(problem.residual)
    for rows in slices:
        inside = problem.jacobian[rows]
        rest = hessian - inside.T @ inside
        # A direction that only this fold sees must not explode: it stays where the whole data put it.
        rest[np.diag_indices_from(rest)] += 1e-10 * np.diag(hessian)
        factors.append(linalg.cho_factor(rest, lower=True))
        scores.append(score - inside.T @ problem.residual[rows])
        residual[rows] = problem.residual[rows] - inside @ linalg.cho_solve(factors[-1], scores[-1])
    return Folds(problem, slices, tuple(factors), np.stack(scores), residual)


@dataclass(frozen=True, slots=True)
class Trial:
    """One candidate's columns put to the test on a problem.

    Attributes:
        coefficients: in-sample, in the unit of the columns, shape (p,).
        fallen: in-sample fall of ‖e‖² of each motor, shape (n,).
        training_fall: fall of ‖e‖² on the other folds, which may choose among settings, shape (folds,).
        held_out: ‖e‖² of each fold and motor with the candidate fitted on the others, shape (folds, n).
        score: Φ⊥ᵀe, shape (p,).
        scatter: Φ⊥ᵀe of each move with the candidate fitted, which is its noise alone, shape (clusters, p).
    """

    coefficients: FloatArray
    fallen: FloatArray
    training_fall: FloatArray
    held_out: FloatArray
    score: FloatArray
    scatter: FloatArray


def put_to_test(folds: Folds, hessian: tuple[FloatArray, bool], columns: FloatArray) -> Trial | None:
    """Project the columns off all declared directions, gains included, and see what they explain.

    Args:
        folds: the problem in folds.
        hessian: Cholesky factor of the whole JᵀJ.
        columns: whitened candidate columns, shape (rows, p).

    Returns:
        None where the declared model says the same already (less than 1e-6 of a column is left).
    """
    problem = folds.problem
    whole = problem.jacobian.T @ columns
    projected = columns - problem.jacobian @ linalg.cho_solve(hessian, whole)
    gram = projected.T @ projected
    if np.any(np.diag(gram) < 1e-6 * np.sum(columns**2, axis=0)):
        return None
    score = np.asarray(projected.T @ problem.residual)
    coefficients = np.asarray(np.linalg.solve(gram, score), dtype=np.float64)
    after = problem.residual - projected @ coefficients
    by_move = [np.bincount(problem.cluster, part, problem.moves) for part in (projected * after[:, None]).T]
    scatter = np.asarray(np.stack(by_move, axis=1), dtype=np.float64)
    difference = problem.residual**2 - after**2
    fallen = np.asarray(np.bincount(problem.motor, difference, len(problem.gamma)), dtype=np.float64)
    left = np.empty_like(problem.residual)
    training_fall = np.empty(folds.count)
    size = columns.T @ columns
    against = columns.T @ problem.residual
    folded = zip(folds.slices, folds.factors, folds.scores, strict=True)
    for index, (rows, factor, nuisance) in enumerate(folded):
        inside, j = columns[rows], problem.jacobian[rows]
        coupling = whole - j.T @ inside
        moved = linalg.cho_solve(factor, coupling)
        schur = size - inside.T @ inside - coupling.T @ moved
        drive = against - inside.T @ problem.residual[rows] - moved.T @ nuisance
        fitted = np.linalg.solve(schur, drive)
        training_fall[index] = float(drive @ fitted)
        left[rows] = folds.residual[rows] - (inside - j @ moved) @ fitted
    return Trial(coefficients, fallen, training_fall, folds.square_sum(left), score, scatter)
