"""Candidate columns put to the test on a problem in folds: what they explain, in-sample and on moves left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ident.residual import Folds

FloatArray = NDArray[np.float64]

SAID_ALREADY = 1e-6
"""Share of a column that must be left when all declared directions are taken out of it."""
UNSEEN = 1e-9
"""Share of a direction, squared, below which the folds that a fit may use do not show it."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One candidate's columns put to the test on a problem.

    Attributes:
        coefficients: in-sample, in the unit of the columns, shape (p,).
        fallen: in-sample fall of ‖e‖² of each motor, shape (n,).
        training_fall: fall of ‖e‖² on the other folds, which may choose among settings, shape (folds,).
        held_out: ‖e‖² of each fold and motor with the candidate fitted on the others, shape (folds, n).
        score: Φ⊥ᵀe, shape (p,).
        scatter: Φ⊥ᵀe of each move with the candidate fitted, which is its noise alone, shape (moves, p).
        gram: Φ⊥ᵀΦ⊥ of each move, shape (moves, p, p).
    """

    coefficients: FloatArray
    fallen: FloatArray
    training_fall: FloatArray
    held_out: FloatArray
    score: FloatArray
    scatter: FloatArray
    gram: FloatArray


@dataclass(frozen=True, slots=True)
class Products:
    """Of candidate columns Φ (many candidates side by side) with the problem, shape (…, q) for q columns.

    Attributes:
        move_jacobian, move_gram, move_score: JᵀΦ, ΦᵀΦ and Φᵀe of each move.
        part_jacobian, part_gram, part_score, part_held: JᵀΦ, ΦᵀΦ, Φᵀe and Φᵀr of each fold and motor.
    """

    move_jacobian: FloatArray
    move_gram: FloatArray
    move_score: FloatArray
    part_jacobian: FloatArray
    part_gram: FloatArray
    part_score: FloatArray
    part_held: FloatArray


def put_to_test(folds: Folds, columns: FloatArray, candidates: Sequence[slice]) -> tuple[Trial | None, ...]:
    """Project columns off all declared directions, gains included, and see what they explain.

    Everything is computed from products that are summed block by block, so that a candidate costs no pass over the
    rows of its own.

    Args:
        folds: the problem in folds.
        columns: whitened candidate columns, shape (rows, q).
        candidates: which columns belong together.

    Returns:
        for each candidate; None where the declared model says the same already.
    """
    made = _products(folds, columns)
    f = len(folds.motor_score[0])
    # Φ⊥ = Φ − J H⁻¹ JᵀΦ, of each move and of each motor.
    along = linalg.cho_solve(folds.whole, made.move_jacobian.sum(axis=0))
    move_score = made.move_score - folds.move_score @ along
    motor_score = made.part_score.sum(axis=0) - folds.motor_score @ along
    moved = [
        linalg.cho_solve(factor, made.part_jacobian.sum(axis=(0, 1)) - made.part_jacobian[k].sum(axis=0))
        for k, factor in enumerate(folds.factors)
    ]
    before = folds.square_sum(folds.residual)
    squares = np.einsum("mqq->q", made.move_gram)
    trials: list[Trial | None] = []
    for chosen in candidates:
        w = along[:, chosen].reshape(f, -1)
        move_gram = _projected_gram(
            made.move_gram[:, chosen, chosen], made.move_jacobian[:, :, chosen], w, folds.move_hessian
        )
        gram = move_gram.sum(axis=0)
        if np.any(np.diag(gram) <= SAID_ALREADY * squares[chosen]) or np.linalg.cond(gram / _size(gram)) > 1e10:
            trials.append(None)
            continue
        score = move_score[:, chosen].sum(axis=0)
        coefficients = np.linalg.solve(gram, score)
        motor_gram = _projected_gram(
            made.part_gram[:, :, chosen, chosen].sum(axis=0),
            made.part_jacobian[:, :, :, chosen].sum(axis=0),
            w,
            folds.part_hessian.sum(axis=0),
        )
        fallen = 2.0 * motor_score[:, chosen] @ coefficients - np.einsum(
            "p,npq,q->n", coefficients, motor_gram, coefficients
        )
        training_fall, held_out = _left_out(folds, made, chosen, [step[:, chosen] for step in moved], before)
        trials.append(
            Trial(
                coefficients=coefficients,
                fallen=fallen,
                training_fall=training_fall,
                held_out=held_out,
                score=score,
                scatter=move_score[:, chosen] - move_gram @ coefficients,
                gram=move_gram,
            )
        )
    return tuple(trials)


def _size(gram: FloatArray) -> FloatArray:
    root = np.sqrt(np.diag(gram))
    return np.asarray(np.outer(root, root))


def _projected_gram(gram: FloatArray, jacobian: FloatArray, along: FloatArray, hessian: FloatArray) -> FloatArray:
    """(Φ − J w)ᵀ(Φ − J w) of each part, shape (parts, p, p)."""
    crossed = np.swapaxes(jacobian, 1, 2) @ along
    return np.asarray(gram - crossed - np.swapaxes(crossed, 1, 2) + along.T @ (hessian @ along))


def _left_out(
    folds: Folds, made: Products, chosen: slice, moved: Sequence[FloatArray], before: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fall on the other folds, and ‖e‖² on each fold with coefficients from the others."""
    training_fall, held_out = np.empty(folds.count), np.empty_like(before)
    gram, score = made.part_gram[:, :, chosen, chosen], made.part_score[:, :, chosen]
    jacobian = made.part_jacobian[:, :, :, chosen]
    whole_gram, whole_score, whole = gram.sum(axis=(0, 1)), score.sum(axis=(0, 1)), jacobian.sum(axis=(0, 1))
    for k in range(folds.count):
        step = moved[k]
        coupling = whole - jacobian[k].sum(axis=0)
        schur = whole_gram - gram[k].sum(axis=0) - coupling.T @ step
        drive = whole_score - score[k].sum(axis=0) - step.T @ folds.scores[k]
        # What the other folds do not show at all is left as it is: in its own unit, the shortest of all solutions.
        unit = np.sqrt(np.diag(whole_gram))
        fitted = np.linalg.lstsq(schur / np.outer(unit, unit), drive / unit, rcond=UNSEEN)[0] / unit
        training_fall[k] = float(drive @ fitted)
        # r − (Φ − J step) fitted, squared motor by motor.
        inside = _projected_gram(gram[k], jacobian[k], step, folds.part_hessian[k])
        shown = made.part_held[k][:, chosen] - folds.part_score[k] @ step
        held_out[k] = before[k] - 2.0 * shown @ fitted + np.einsum("p,npq,q->n", fitted, inside, fitted)
    return training_fall, held_out


def _products(folds: Folds, columns: FloatArray) -> Products:
    problem, n = folds.problem, len(folds.problem.gamma)
    f, q = problem.jacobian.shape[1], columns.shape[1]
    moves, count = problem.moves, folds.count
    made = Products(
        np.zeros((moves, f, q)),
        np.zeros((moves, q, q)),
        np.zeros((moves, q)),
        np.zeros((count, n, f, q)),
        np.zeros((count, n, q, q)),
        np.zeros((count, n, q)),
        np.zeros((count, n, q)),
    )
    felt = [bool(np.any(columns[problem.motor == motor])) for motor in range(n)]
    for rows, k, m, i in zip(folds.blocks, folds.fold, folds.move, folds.motor, strict=True):
        if not felt[i]:
            continue
        inside = columns[rows]
        jacobian, gram, score = problem.jacobian[rows].T @ inside, inside.T @ inside, problem.residual[rows] @ inside
        made.move_jacobian[m] += jacobian
        made.move_gram[m] += gram
        made.move_score[m] += score
        made.part_jacobian[k, i] += jacobian
        made.part_gram[k, i] += gram
        made.part_score[k, i] += score
        made.part_held[k, i] += folds.residual[rows] @ inside
    return made
