"""The problem around an estimate as a linear one: whitened residuals and their Jacobian, motor by motor.

e_i = (v_i − γ_i (T τ)_i)/σ_i with the unknowns (g_1 … g_n, χ, χ_uL); see estimators/maximum_likelihood.py. The gain
direction is built from the *predicted* torque, not the measured current, so that the noise does not enter it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ident.equations.observation import Observation
from ident.errors import TooFewMoves
from ident.estimators.estimate import MIN_MOVES

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Rows of all motors below each other, motor 1 first.

    Attributes:
        jacobian: ∂(γ (T τ)/σ) per unit of each free unknown in its own scale, shape (rows, f).
        residual: whitened, shape (rows,).
        current: measured, whitened: what the residual is relative to, shape (rows,).
        motor: of each row, shape (rows,).
        cluster: move of each row, numbered 0 … without gaps, shape (rows,).
        source: index of each row among the observation's decimated rows, shape (rows,).
        gamma: 1/g, shape (n,).
        noise: σ_i [A], shape (n,).
        free: which of (gains, parameters) are free, shape (f,).
        scale: unit of each free unknown: a step of one in the scaled unknown is this much of the real one, shape (f,).
    """

    jacobian: FloatArray
    residual: FloatArray
    current: FloatArray
    motor: IntArray
    cluster: IntArray
    source: IntArray
    gamma: FloatArray
    noise: FloatArray
    free: IntArray
    scale: FloatArray

    @property
    def moves(self) -> int:
        """Number of clusters."""
        return int(self.cluster.max()) + 1

    def ordered(self, order: IntArray) -> Linearisation:
        """The same rows in another order."""
        return replace(
            self,
            jacobian=self.jacobian[order],
            residual=self.residual[order],
            current=self.current[order],
            motor=self.motor[order],
            cluster=self.cluster[order],
            source=self.source[order],
        )

    def whitened(self, torque_nm: FloatArray, to_motor: FloatArray) -> FloatArray:
        """Joint torque columns, shape (n, extra, r), as columns beside the Jacobian, shape (rows, extra).

        Args:
            torque_nm: per unit of each column.
            to_motor: T (DriveTrain.to_motor).
        """
        columns = np.zeros((len(self.motor), torque_nm.shape[1]))
        felt = [bool(np.any(torque)) for torque in torque_nm]
        for motor, row in enumerate(to_motor):
            rows = np.flatnonzero(self.motor == motor)
            for joint in np.flatnonzero(row):
                if felt[joint]:
                    weight = row[joint] * self.gamma[motor] / self.noise[motor]
                    columns[rows] += weight * torque_nm[joint][:, self.source[rows]].T
        return columns


def linearise(
    observation: Observation, gains: FloatArray, parameters: FloatArray, noise: FloatArray, *, gains_fixed: bool
) -> Linearisation:
    """Around given gains [Nm/A], parameters and current noise [A] of each motor."""
    linear, known = observation.motor_torque()
    count = len(gains)
    gamma = 1.0 / gains
    jacobian, residual, currents, motors, clusters, sources = [], [], [], [], [], []
    for motor in range(count):
        used = np.flatnonzero(observation.motor_use[motor])
        columns = linear[motor][:, used]
        torque = parameters @ columns + known[motor, used]
        rows = np.zeros((len(used), count + len(parameters)))
        # ∂(γ τ)/∂g = −γ² τ; in units of the gain itself, −γ τ.
        rows[:, motor] = -gamma[motor] * torque / noise[motor]
        rows[:, count:] = columns.T * (gamma[motor] / noise[motor])
        jacobian.append(rows)
        residual.append((observation.current[motor, used] - gamma[motor] * torque) / noise[motor])
        currents.append(observation.current[motor, used] / noise[motor])
        motors.append(np.full(len(used), motor))
        clusters.append(observation.move[used])
        sources.append(used)
    matrix = np.concatenate(jacobian)
    free = np.arange(count if gains_fixed else 0, matrix.shape[1])
    norms = np.linalg.norm(matrix, axis=0)
    unit = np.concatenate((gains, np.divide(1.0, norms[count:], where=norms[count:] > 0, out=np.ones(len(parameters)))))
    matrix[:, count:] *= unit[count:]
    return Linearisation(
        jacobian=matrix[:, free],
        residual=np.concatenate(residual),
        current=np.concatenate(currents),
        motor=np.concatenate(motors),
        cluster=np.unique(np.concatenate(clusters), return_inverse=True)[1].astype(np.int64),
        source=np.concatenate(sources),
        gamma=gamma,
        noise=noise,
        free=free,
        scale=unit[free],
    )


# What the model leaves: by axis, in-sample and on moves that were left out of the fit.


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
    if moves < MIN_MOVES:
        raise TooFewMoves(moves, MIN_MOVES)
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
