"""The problem around an estimate as a linear one, and everything that leaves moves out of it.

The residual of motor i is e_i = (v_i − γ_i (T τ)_i)/σ_i with the unknowns (g_1 … g_n, χ, χ_uL); see
estimators/maximum_likelihood.py. Its derivative to a gain is built from the *predicted* torque, not from the measured
current, so that the noise does not enter it. `motor_jacobian` is that derivative. Error bars leave out one move at a
time (`left_out_shifts`); the search for effects leaves out folds of moves (`cut_into_folds`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import linalg

from ident.arrays import FloatArray, IntArray
from ident.equations.rows import Observation
from ident.equations.system import System
from ident.errors import TooFewMoves

MIN_MOVES_TO_LEAVE_OUT = 8  #: With fewer, leaving one out shows little of the scatter, and each fold holds one


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Rows of all motors below each other, motor 1 first."""

    jacobian: FloatArray  #: ∂(γ (T τ)/σ) per unit of each free unknown in its own scale, shape (rows, f)
    residual: FloatArray  #: whitened, shape (rows,)
    current: FloatArray  #: measured, whitened: what the residual is relative to, shape (rows,)
    motor: IntArray  #: of each row, shape (rows,)
    cluster: IntArray  #: number of each row's cluster, 0 … without gaps, shape (rows,)
    source: IntArray  #: index of each row among the observation's decimated rows, shape (rows,)
    gamma: FloatArray  #: 1/g, shape (n,)
    noise: FloatArray  #: σ_i [A], shape (n,)
    free: IntArray  #: which of (gains, parameters) are free, shape (f,)
    #: Unit of each free unknown: a step of one in the scaled unknown is this much of the real one, shape (f,).
    scale: FloatArray

    @property
    def cluster_count(self) -> int:
        """Number of clusters."""
        return int(self.cluster.max()) + 1

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
    """Linearise around given gains [Nm/A], parameters and current noise [A] of each motor."""
    count = len(gains)
    parts, motors, clusters, sources = [], [], [], []
    for motor, columns in enumerate(observation.motor_columns()):
        used = np.flatnonzero(observation.motor_use[motor])
        parts.append((*motor_jacobian(columns[:, used].T, motor, gains, parameters, noise), columns[0, used]))
        motors.append(np.full(len(used), motor))
        clusters.append(observation.move[used])
        sources.append(used)
    jacobian, residual, current = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    motor_of = np.concatenate(motors)
    free = np.arange(count if gains_fixed else 0, jacobian.shape[1])
    norms = np.linalg.norm(jacobian, axis=0)
    unit = np.concatenate((gains, np.divide(1.0, norms[count:], where=norms[count:] > 0, out=np.ones(len(parameters)))))
    return Linearisation(
        jacobian=jacobian[:, free] * unit[free],
        residual=residual,
        current=current / noise[motor_of],
        motor=motor_of,
        cluster=np.unique(np.concatenate(clusters), return_inverse=True)[1].astype(np.int64),
        source=np.concatenate(sources),
        gamma=1.0 / gains,
        noise=noise,
        free=free,
        scale=unit[free],
    )


def motor_jacobian(
    rows: FloatArray, motor: int, gains: FloatArray, parameters: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """J = ∂(γ_i (T τ)_i/σ_i)/∂(g, χ, χ_uL) and e of one motor's equations, shapes (m, n + p) and (m,).

    Args:
        rows: [v_i | (T [W | W_uL])_i | (T W_kL χ_kL)_i], or the triangle of these, which has the same JᵀJ and Jᵀe.
        motor: i.
        gains, parameters: where to linearise.
        noise: σ of each motor's current [A].
    """
    count = len(gains)
    torque = rows[:, 1:-1] @ parameters + rows[:, -1]
    scale = 1.0 / (gains[motor] * noise[motor])
    jacobian = np.zeros((len(rows), count + len(parameters)))
    jacobian[:, motor] = -scale / gains[motor] * torque  # ∂(γ τ)/∂g = −γ² τ
    jacobian[:, count:] = scale * rows[:, 1:-1]
    return jacobian, rows[:, 0] / noise[motor] - scale * torque


def left_out_shifts(grams: FloatArray, scores: FloatArray) -> FloatArray:
    """Shift of the unknowns when each cluster is left out, d_c = −(H − G_c)⁻¹ s_c with H = Σ G_c, shape (m, f).

    Args:
        grams: G_c = J_cᵀJ_c of each cluster, shape (m, f, f).
        scores: s_c = J_cᵀe_c around the estimate, where they sum to zero, shape (m, f).
    """
    hessian = grams.sum(axis=0)
    # In units in which every unknown is seen equally well: kilograms are beside kg m².
    unit = 1.0 / np.sqrt(np.where(np.diag(hessian) > 0.0, np.diag(hessian), 1.0))
    rest = (hessian - grams) * np.outer(unit, unit)
    return -np.stack([_solved(matrix, score * unit) * unit for matrix, score in zip(rest, scores, strict=True)])


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    try:
        return np.asarray(linalg.cho_solve(linalg.cho_factor(matrix, lower=True), right))
    except linalg.LinAlgError:  # a direction that only the cluster left out has seen
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0])


def jackknife_covariance(
    system: System, gains: FloatArray, parameters: FloatArray, noise: FloatArray, *, gains_fixed: bool
) -> FloatArray:
    """Covariance of (gains, parameters) from leaving out one move at a time, zero for fixed gains.

    The residual of a geared robot is correlated over a move (lag one about 0.67): rows are not independent, moves
    nearly are (MacKinnon & White 1985; for clusters Bell & McCaffrey 2002, CR3; docs/explanation/uncertainty.md).

    Args:
        system: of the fit.
        gains, parameters: the estimate, gains in Nm/A, shapes (n,) and (p,).
        noise: σ_i of each motor's current [A], shape (n,).
        gains_fixed: the gains were given.

    Returns:
        shape (n + p, n + p).

    Raises:
        TooFewMoves: fewer than MIN_MOVES_TO_LEAVE_OUT.
    """
    clusters, count, size = len(system.clusters), len(gains), len(gains) + len(parameters)
    if clusters < MIN_MOVES_TO_LEAVE_OUT:
        raise TooFewMoves(clusters, MIN_MOVES_TO_LEAVE_OUT)
    free = slice(count if gains_fixed else 0, size)
    grams, scores = np.zeros((clusters, size, size)), np.zeros((clusters, size))
    for index, cluster in enumerate(system.clusters):
        for motor, rows in enumerate(cluster):
            jacobian, residual = motor_jacobian(rows, motor, gains, parameters, noise)
            grams[index] += jacobian.T @ jacobian
            scores[index] += jacobian.T @ residual
    shifts = left_out_shifts(grams[:, free, free], scores[:, free])
    centred = shifts - shifts.mean(axis=0)
    covariance = np.zeros((size, size))
    covariance[free, free] = (clusters - 1) / clusters * (centred.T @ centred)
    return covariance


@dataclass(frozen=True, slots=True)
class Folds:
    """A linearised problem cut into folds of whole moves, with everything that cross-validation reuses.

    A block holds the rows of one motor in one cluster; folds, clusters and motors are sums over blocks.
    """

    problem: Linearisation  #: the linearisation, its rows sorted by fold, cluster and motor
    moves: int  #: number of whole moves distributed over the folds; a cluster may be only a piece of one
    blocks: tuple[tuple[slice, int, int, int], ...]  #: rows, fold, cluster and motor of each block
    full_factor: tuple[FloatArray, bool]  #: Cholesky factor of JᵀJ, with scipy's flag
    factors: tuple[tuple[FloatArray, bool], ...]  #: the same without each fold
    scores: FloatArray  #: Jᵀe without each fold, shape (folds, f)
    cluster_hessian: FloatArray  #: JᵀJ of each cluster, shape (clusters, f, f)
    cluster_score: FloatArray  #: Jᵀe of each cluster, shape (clusters, f)
    part_hessian: FloatArray  #: JᵀJ of each fold and motor, shape (folds, n, f, f)
    part_score: FloatArray  #: Jᵀr of each fold and motor, shape (folds, n, f)
    motor_score: FloatArray  #: Jᵀe of each motor, shape (n, f)
    residual: FloatArray  #: r, the e of each row predicted by a fit that did not see its fold, shape (rows,)

    @property
    def count(self) -> int:
        """Number of folds."""
        return len(self.factors)

    def square_sum(self, residual: FloatArray) -> FloatArray:
        """‖e‖² of each fold and motor, shape (folds, n)."""
        rows, fold, _, motor = zip(*self.blocks, strict=True)
        total = np.zeros((self.count, len(self.problem.gamma)))
        np.add.at(total, (fold, motor), np.add.reduceat(residual**2, [part.start for part in rows]))
        return total


def cut_into_folds(problem: Linearisation, count: int = 8, move_of: IntArray | None = None) -> Folds:
    """Deal the moves out to folds in turn, so that every fold sees every run; a move is never parted.

    Args:
        problem: around an estimate.
        count: of folds; fewer where there are fewer moves.
        move_of: the move that each cluster is a piece of, shape (clusters,); the clusters themselves when None.

    Raises:
        TooFewMoves: to leave some out.
    """
    move_of = np.arange(problem.cluster_count) if move_of is None else np.unique(move_of, return_inverse=True)[1]
    moves = int(move_of.max()) + 1
    if moves < MIN_MOVES_TO_LEAVE_OUT:
        raise TooFewMoves(moves, MIN_MOVES_TO_LEAVE_OUT)
    count = min(count, moves)
    fold_of = move_of % count
    motors, width = len(problem.gamma), problem.jacobian.shape[1]
    order = np.lexsort((problem.motor, problem.cluster, fold_of[problem.cluster]))
    of_rows = ("jacobian", "residual", "current", "motor", "cluster", "source")
    problem = replace(problem, **{name: getattr(problem, name)[order] for name in of_rows})
    change = (np.diff(problem.cluster, prepend=-1) != 0) | (np.diff(problem.motor, prepend=-1) != 0)
    starts = np.flatnonzero(change)
    rows_of = (slice(int(a), int(b)) for a, b in pairwise((*starts, len(problem.motor))))
    cluster, motor = problem.cluster[starts], problem.motor[starts]
    blocks = tuple(zip(rows_of, fold_of[cluster].tolist(), cluster.tolist(), motor.tolist(), strict=True))
    cluster_hessian = np.zeros((problem.cluster_count, width, width))
    cluster_score = np.zeros((problem.cluster_count, width))
    part_hessian, motor_score = np.zeros((count, motors, width, width)), np.zeros((motors, width))
    for rows, k, m, i in blocks:
        inside = problem.jacobian[rows]
        gram, score = inside.T @ inside, inside.T @ problem.residual[rows]
        cluster_hessian[m] += gram
        cluster_score[m] += score
        part_hessian[k, i] += gram
        motor_score[i] += score
    by_fold = part_hessian.sum(axis=1)
    hessian, score = by_fold.sum(axis=0), motor_score.sum(axis=0)
    # Two effects may be nearly equal: regularise the direction in which they differ.
    hessian[np.diag_indices_from(hessian)] *= 1.0 + 1e-10
    factors, scores = [], []
    for k in range(count):
        rest = hessian - by_fold[k]
        # A direction that only this fold sees must not explode: it stays where the whole data put it.
        rest[np.diag_indices_from(rest)] += 1e-10 * np.diag(hessian)
        factors.append(linalg.cho_factor(rest, lower=True))
        scores.append(score - cluster_score[fold_of == k].sum(axis=0))
    steps = [linalg.cho_solve(factor, part) for factor, part in zip(factors, scores, strict=True)]
    residual = np.empty_like(problem.residual)
    part_score = np.zeros((count, motors, width))
    for rows, k, _, i in blocks:
        inside = problem.jacobian[rows]
        residual[rows] = problem.residual[rows] - inside @ steps[k]
        part_score[k, i] += inside.T @ residual[rows]
    return Folds(
        problem=problem,
        moves=moves,
        blocks=blocks,
        full_factor=linalg.cho_factor(hessian, lower=True),
        factors=tuple(factors),
        scores=np.stack(scores),
        cluster_hessian=cluster_hessian,
        cluster_score=cluster_score,
        part_hessian=part_hessian,
        part_score=part_score,
        motor_score=motor_score,
        residual=residual,
    )
