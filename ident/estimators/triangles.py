"""Triangular factors: everything that a linear estimator needs of millions of rows (TSQR)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.errors import DataUnfit
from ident.observation import Observation

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Triangles:
    """R of the QR factorisation of each axis' equations; ‖R x‖ is the norm of their residual for any x.

    Attributes:
        factors: one for each axis, shape (≤c, c).
        rows: number of equations of each axis, shape (n,).
    """

    factors: tuple[FloatArray, ...]
    rows: NDArray[np.int64]

    def stacked(self, weight: FloatArray) -> FloatArray:
        """All axes below each other, each scaled by its weight."""
        return np.concatenate([factor * scale for factor, scale in zip(self.factors, weight, strict=True)])

    def residual_std(self, vector: FloatArray, free: int) -> FloatArray:
        """Standard deviation of each axis' residual R x; ``free`` parameters are shared among the axes (eq. 9)."""
        size = np.array([float(np.sum((factor @ vector) ** 2)) for factor in self.factors])
        return np.asarray(np.sqrt(size / np.maximum(self.rows - free / len(self.rows), 1.0)))

    def weighted_system(self, solution: FloatArray, free: int, *, gains: bool) -> FloatArray:
        """Singular values of W_r with rows of a joint divided by its residual's deviation (paper Table 5).

        Args:
            solution: (g, χ, χ_uL, 1) of eq. (17).
            free: number of estimated parameters.
            gains: whether the columns V belong to the unknowns.
        """
        first = 0 if gains else len(self.factors)
        return singular_values(self.stacked(1.0 / self.residual_std(solution, free))[:, first:-1])


def joint_triangles(observation: Observation) -> Triangles:
    """Rows of the paper's eq. (17), W_tot = [V | −W | −W_uL | −W_kL χ_kL], joint by joint: c = n + p + 1 columns."""
    linear, known = observation.linear(), observation.known()
    direction = observation.drive_train.direction
    factors: list[FloatArray] = []
    for joint, used in enumerate(observation.use):
        rows = np.concatenate(
            (
                direction[:, joint, None] * observation.current[:, used],
                -linear[joint][:, used],
                -known[joint, used][None],
            )
        )
        factors.append(np.asarray(np.linalg.qr(rows.T, mode="r"), dtype=np.float64))
    return Triangles(tuple(factors), observation.use.sum(axis=1))


def motor_triangles(observation: Observation) -> Triangles:
    """Rows [v_i | (T W)_i | (T W_kL χ_kL)_i] of g_i v_i = (T W χ + T W_kL χ_kL)_i: each holds one current alone."""
    linear, known = observation.motor_torque()
    factors: list[FloatArray] = []
    for motor, used in enumerate(observation.motor_use):
        if used.sum() <= linear.shape[1]:
            raise DataUnfit(
                ", ".join(observation.runs),
                f"motor {motor + 1} has {int(used.sum())} usable rows for {linear.shape[1]} unknowns; "
                "record longer, or move it more",
            )
        rows = np.concatenate(
            (observation.current[motor, used][None], linear[motor][:, used], known[motor, used][None])
        )
        factors.append(np.asarray(np.linalg.qr(rows.T, mode="r"), dtype=np.float64))
    return Triangles(tuple(factors), observation.motor_use.sum(axis=1))


def solve(matrix: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Least squares with unit-norm columns inside: solution, (MᵀM)⁻¹ and singular values of M as given.

    Scaling columns changes no least-squares solution, but spares digits where kilograms stand beside kg m².
    """
    norms = np.linalg.norm(matrix, axis=0)
    norms[norms == 0.0] = 1.0
    u, s, vt = np.linalg.svd(matrix / norms, full_matrices=False)
    keep = s > s[0] * 1e-13
    half = vt[keep].T / s[keep] / norms[:, None]
    return half @ (u[:, keep].T @ right), half @ half.T, singular_values(matrix)


def singular_values(matrix: FloatArray) -> FloatArray:
    """In decreasing order."""
    return np.asarray(np.linalg.svd(matrix, compute_uv=False), dtype=np.float64)
