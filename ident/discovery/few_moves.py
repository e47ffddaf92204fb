"""Candidates that rest on few moves: tested without those of most leverage, or not at all.

The moves' random signs tell noise from an effect by the scatter of moves. A candidate whose columns
are large in one or two moves, as a saturation that only the largest currents reach, has no scatter
to compare with: its statistic is large in half of the draws, true or not. So the moves of most
leverage are left out, everything is projected and fitted again on the others, and these are tested
where there are enough of them. What rests on few moves sets no limit for others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from ident.arrays import FloatArray
from ident.effects.effect import Effect
from ident.effects.signals import Abscissa
from ident.equations.linearisation import RIDGE, Folds, lower_factor

FEWEST_MOVES = 3.0  #: Effective number of moves below which their random signs test nothing
#: The same below which a candidate sets no limit for others, and is tested without those of most
#: leverage
FEW_MOVES = 8.0
SHARE = 0.01
"""Share of Φ⊥ᵀΦ⊥ that the other moves must hold: with less they know the coefficients ten times
worse, and a test by them says nothing.
"""
LEVERAGE = 3  #: Moves left out then

RECORD = {
    Abscissa.VELOCITY: "moves at such speeds",
    Abscissa.POSITION: "moves to that end of the axis' range",
    Abscissa.LOAD: "moves with a large load torque on this axis",
    Abscissa.TIME: "and longer runs",
    Abscissa.SESSION: "runs, over a longer session",
    Abscissa.MOTOR_ANGLE: "slow moves over the whole range of this axis",
    Abscissa.CURRENT: "moves with a large current of this axis (fast starts and stops, or "
    "more payload)",
    Abscissa.TORQUE_RATE: "moves with fast starts and stops of this axis",
    Abscissa.LOAD_CURVATURE: "moves with fast starts and stops of this axis",
    Abscissa.DISTANCE: "moves with reversals of this axis",
    Abscissa.OTHER_VELOCITY: "moves of both joints at once",
    Abscissa.OTHER_ACCELERATION: "moves with fast starts and stops of the other joint",
    Abscissa.TEMPERATURE: "runs at other temperatures",
}
"""What to record for an effect that shows itself against a variable."""
NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight")


@dataclass(frozen=True, slots=True)
class MoveScores:
    """Projected products of a candidate by cluster; zero for clusters that were left out."""

    score: FloatArray  #: Φ⊥ᵀe, shape (p,)
    #: Φ⊥ᵀe of each cluster with the candidate fitted: its noise alone, shape (clusters, p)
    scatter: FloatArray
    gram: FloatArray  #: Φ⊥ᵀΦ⊥ of each cluster, shape (clusters, p, p)


def moves_behind(gram: FloatArray) -> float:
    """Effective number of moves that a candidate's columns rest on, (Σ G_m)²/Σ G_m².

    It is the least of its coefficients.

    Args:
        gram: Φ⊥ᵀΦ⊥ of each cluster, shape (clusters, p, p).
    """
    own = np.diagonal(gram, axis1=1, axis2=2)
    squares = np.sum(own**2, axis=0)
    squares = np.maximum(squares, np.finfo(np.float64).tiny)
    squared_sums = own.sum(axis=0) ** 2
    return float(np.min(squared_sums / squares))


def without_most_leverage(
    folds: Folds,
    crossed: FloatArray,
    squares: FloatArray,
    scores: FloatArray,
    projected: FloatArray,
) -> MoveScores | None:
    """Fit everything again without the clusters of most leverage.

    None where the other clusters do not show the candidate.

    Args:
        folds: the problem.
        crossed: ΦᵀJ of each cluster, shape (clusters, p, f).
        squares: ΦᵀΦ of each cluster, shape (clusters, p, p).
        scores: Φᵀe of each cluster, shape (clusters, p).
        projected: Φ⊥ᵀΦ⊥ of each cluster on all rows, shape (clusters, p, p).
    """
    projected_sum = projected.sum(axis=0)
    # Leverage of each cluster, tr(G_m G⁻¹).
    leverage = np.einsum("mpq,qp->m", projected, np.linalg.pinv(projected_sum))
    order = np.argsort(leverage)
    left_out = order[-LEVERAGE:]
    left = np.sort(order[:-LEVERAGE])
    clusters, unknowns, _ = folds.cluster_hessian.shape
    full_hessian = folds.motor_hessian.sum(axis=0)
    hessian = full_hessian - folds.cluster_hessian[left_out].sum(axis=0)
    ridge = RIDGE * np.diag(np.diag(full_hessian))
    factor = lower_factor(hessian + ridge)
    # w = H⁻¹ JᵀΦ and x = H⁻¹ Jᵀe of the clusters that are left.
    crossed_left = crossed[left]
    along = linalg.cho_solve(factor, crossed_left.sum(axis=0).T)
    step = linalg.cho_solve(factor, folds.cluster_score[left].sum(axis=0))
    # H_m w and H_m x of every cluster by one product, which is far faster than a product for each.
    flat_hessians = folds.cluster_hessian.reshape(-1, unknowns)
    all_pushed = flat_hessians @ np.column_stack((along, step))
    of_cluster = all_pushed.reshape(clusters, unknowns, -1)[left]
    pushed = of_cluster[:, :, :-1]
    pushed_step = of_cluster[:, :, -1]
    # (Φ − J w)ᵀ(Φ − J w) and (Φ − J w)ᵀ(e − J x) of each cluster.
    beside = crossed_left @ along
    gram = squares[left] - beside - np.swapaxes(beside, 1, 2) + along.T @ pushed
    own_score = scores[left] - crossed_left @ step
    declared_score = folds.cluster_score[left] - pushed_step
    score = own_score - declared_score @ along
    gram_sum = gram.sum(axis=0)
    least_seen = SHARE * np.diag(projected_sum)
    if np.any(np.diag(gram_sum) < least_seen):
        return None
    coefficients = np.linalg.pinv(gram_sum) @ score.sum(axis=0)
    scatter_of_all = np.zeros_like(scores)
    scatter_of_all[left] = score - gram @ coefficients
    gram_of_all = np.zeros_like(squares)
    gram_of_all[left] = gram
    return MoveScores(score.sum(axis=0), scatter_of_all, gram_of_all)


def is_tested_on_others(without_leverage: MoveScores | None) -> bool:
    """Whether a candidate that rests on few moves rests on enough others to be tested by these."""
    if without_leverage is None:
        return False
    return moves_behind(without_leverage.gram) >= FEW_MOVES


def what_to_record(effect: Effect, gram: FloatArray, without_leverage: MoveScores | None) -> str:
    """Say that a candidate rests on too few moves to be believed, and what to record.

    Args:
        effect: of the candidate.
        gram: Φ⊥ᵀΦ⊥ of each cluster, shape (clusters, p, p).
        without_leverage: the candidate without the moves of most leverage.
    """
    count = max(round(moves_behind(gram)), 1)
    if count == 1:
        moves = "one move"
    else:
        moves = f"{NUMBERS[count]} moves"
    if is_tested_on_others(without_leverage):
        why = "and the others do not show it"
    else:
        why = "too few to test it"
    wanted = RECORD[effect.abscissa]
    return f"it rests on {moves}, {why}: record more {wanted}"
