"""Error bars of an autocorrelated residual: leave out one move at a time (how true they are: docs/estimators.md).

The residual of a geared robot is correlated over a move (lag one about 0.67), so rows are not independent, moves nearly
are. With G_c = J_cᵀJ_c and s_c = J_cᵀe_c of move c, leaving it out shifts the estimate by −(H − G_c)⁻¹ s_c (MacKinnon &
White 1985; for clusters Bell & McCaffrey 2002, CR3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ident.errors import TooFewMoves
from ident.system import System

FloatArray = NDArray[np.float64]

FEWEST_MOVES = 8
"""With fewer, leaving one out in turn tells little of the scatter, and folds of moves hold one each."""


def jackknife_covariance(
    system: System, gains: FloatArray, parameters: FloatArray, noise: FloatArray, *, gains_fixed: bool
) -> FloatArray:
    """Covariance of (gains, parameters) around an estimate, shape (n + p, n + p); zero for fixed gains.

    e_i = (v_i − γ_i (T τ)_i)/σ_i as in estimators/maximum_likelihood.py. A move's triangle serves as well as its rows:
    both have the same Gram matrices. The gain direction is built from the *predicted* torque, not the measured
    current, so that the noise does not enter it.

    Args:
        system: of the fit.
        gains, parameters: the estimate [Nm/A], shapes (n,) and (p,).
        noise: σ_i of each motor's current [A], shape (n,).
        gains_fixed: the gains were given.

    Raises:
        TooFewMoves: their scatter says nothing of the uncertainty.
    """
    moves, count = len(system.moves), len(gains)
    if moves < FEWEST_MOVES:
        raise TooFewMoves(moves, FEWEST_MOVES)
    free = slice(count if gains_fixed else 0, count + len(parameters))
    grams, scores = [], []
    for move in system.moves:
        jacobian, residual = _around(move, gains, parameters, noise)
        grams.append(jacobian[:, free].T @ jacobian[:, free])
        scores.append(jacobian[:, free].T @ residual)
    hessian = np.sum(grams, axis=0)
    # In units in which every unknown is seen equally well: kilograms stand beside kg m².
    unit = 1.0 / np.sqrt(np.where(np.diag(hessian) > 0.0, np.diag(hessian), 1.0))
    scaled = hessian * np.outer(unit, unit)
    shifts = np.stack(
        [_solved(scaled - g * np.outer(unit, unit), s * unit) for g, s in zip(grams, scores, strict=True)]
    )
    centred = (shifts - shifts.mean(axis=0)) * unit
    covariance = np.zeros((count + len(parameters),) * 2)
    covariance[free, free] = (moves - 1) / moves * (centred.T @ centred)
    return covariance


def _around(
    move: tuple[FloatArray, ...], gains: FloatArray, parameters: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """J and e of a move, all motors below each other."""
    count = len(gains)
    jacobian = np.zeros((sum(map(len, move)), count + len(parameters)))
    residual = np.empty(len(jacobian))
    first = 0
    for motor, rows in enumerate(move):
        part = slice(first, first + len(rows))
        torque = rows[:, 1:-1] @ parameters + rows[:, -1]
        scale = 1.0 / (gains[motor] * noise[motor])
        # ∂(γ τ)/∂g = −γ² τ.
        jacobian[part, motor] = -scale / gains[motor] * torque
        jacobian[part, count:] = scale * rows[:, 1:-1]
        residual[part] = rows[:, 0] / noise[motor] - scale * torque
        first = part.stop
    return jacobian, residual


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    try:
        return np.asarray(linalg.cho_solve(linalg.cho_factor(matrix, lower=True), right))
    except linalg.LinAlgError:  # a direction that only the move left out has seen
        return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0])
