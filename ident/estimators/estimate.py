"""What an estimator found, and its certificate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ident.equations.observation import Observation
from ident.equations.system import System
from ident.errors import TooFewMoves
from ident.estimators.method import Method
from ident.model.model import Column

# How much of the torque a model does not tell, in per cent.


@dataclass(frozen=True, slots=True)
class RelativeError:
    """‖ρ‖/‖Y‖ of each axis and of all together [%]; it means nothing without the filter beside it."""

    axes: tuple[float, ...]
    total: float


def relative_error(measured_nm: FloatArray, predicted_nm: FloatArray, use: BoolArray) -> RelativeError:
    """‖ρ_j‖/‖Y_j‖ of each joint and of all together [%] (paper Table 6); NaN for a joint without a row that counts.

    Args:
        measured_nm, predicted_nm: joint torque, shape (n, r).
        use: rows of each joint that count, shape (n, r).
    """
    size = np.sum(measured_nm**2, axis=1, where=use)
    return of_squares(size, np.sum((measured_nm - predicted_nm) ** 2, axis=1, where=use))


def of_squares(size: FloatArray, left: FloatArray) -> RelativeError:
    """The same from ‖Y_j‖² and ‖ρ_j‖² of each joint, both of shape (n,)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        axes = 100.0 * np.sqrt(left / size)
        total = 100.0 * np.sqrt(left.sum() / size.sum())
    return RelativeError(tuple(float(value) for value in axes), float(total))


FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Estimate:
    """Gains and parameters of one observation.

    Attributes:
        method: which estimator.
        gains: g of each motor [Nm at the joint per A], shape (n,).
        gains_fixed: the gains were given, not estimated.
        unknowns: name and unit of each parameter: χ, then χ_uL.
        parameters: their values, shape (p,).
        covariance: of (gains, parameters), shape (n + p, n + p); gains' rows are zero where they were fixed.
        axis_noise: standard deviation of the residual [Nm for joint equations, A for ml's motor equations], shape (n,).
        singular_values: of the weighted observation matrix W_r (``tls``: of W_tot).
        condition: of W_r, rows of a joint divided by the deviation of this estimate's residual, as in Table 5.
        rows: equations used.
        iterations: of an iterative estimator.
    """

    method: Method
    gains: FloatArray
    gains_fixed: bool
    unknowns: tuple[Column, ...]
    parameters: FloatArray
    covariance: FloatArray
    axis_noise: FloatArray
    singular_values: FloatArray
    condition: float
    rows: int
    iterations: int = 0

    @property
    def gains_std(self) -> FloatArray:
        """σ of each gain, shape (n,)."""
        return np.sqrt(np.diag(self.covariance)[: len(self.gains)])

    @property
    def parameters_std(self) -> FloatArray:
        """σ of each parameter, shape (p,)."""
        return np.sqrt(np.diag(self.covariance)[len(self.gains) :])

    def predicted_torque(self, observation: Observation) -> FloatArray:
        """W χ + W_uL χ_uL + W_kL χ_kL [Nm], shape (n, r): what the model says the joints need."""
        return np.asarray(np.einsum("jpr,p->jr", observation.linear(), self.parameters) + observation.known())

    def residual_torque(self, observation: Observation) -> FloatArray:
        """ρ = V g − W χ − … (eq. 13) [Nm], shape (n, r)."""
        return observation.torque(self.gains) - self.predicted_torque(observation)

    def relative_error(self, system: System) -> RelativeError:
        """‖ρ_j‖/‖Y_j‖ of each joint over its used rows, and of all together [%] (paper Table 6)."""
        rest = np.zeros(len(self.parameters))
        left = system.joints.square_sum(np.concatenate((self.gains, self.parameters, [1.0])))
        return of_squares(system.joints.square_sum(np.concatenate((self.gains, rest, [0.0]))), left)


# Error bars of an autocorrelated residual: leave out one move at a time (measured in docs/evidence/estimators.md).
#
# The residual of a geared robot is correlated over a move (lag one about 0.67), so rows are not independent, moves
# nearly
# are. With G_c = J_cᵀJ_c and s_c = J_cᵀe_c of move c, leaving it out shifts the estimate by −(H − G_c)⁻¹ s_c
# (MacKinnon &
# White 1985; for clusters Bell & McCaffrey 2002, CR3).


MIN_MOVES = 8
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
    if moves < MIN_MOVES:
        raise TooFewMoves(moves, MIN_MOVES)
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
