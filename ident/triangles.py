"""Triangular factors: everything that a linear estimator needs of millions of rows (TSQR)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
        size = self.square_sum(vector)
        return np.asarray(np.sqrt(size / np.maximum(self.rows - free / len(self.rows), 1.0)))

    def square_sum(self, vector: FloatArray) -> FloatArray:
        """‖R x‖² of each axis, shape (n,)."""
        return np.array([float(np.sum((factor @ vector) ** 2)) for factor in self.factors])

    def weighted_system(self, solution: FloatArray, free: int, *, gains: bool) -> FloatArray:
        """Singular values of W_r with rows of a joint divided by its residual's deviation (paper Table 5).

        Args:
            solution: (g, χ, χ_uL, 1) of eq. (17).
            free: number of estimated parameters.
            gains: whether the columns V belong to the unknowns.
        """
        first = 0 if gains else len(self.factors)
        return singular_values(self.stacked(1.0 / self.residual_std(solution, free))[:, first:-1])


def triangle(parts: Iterable[FloatArray], columns: int) -> FloatArray:
    """R of rows that come in pieces below each other, shape (≤columns, columns).

    Args:
        parts: pieces of rows, each of shape (m, columns).
        columns: c, for the case of no rows.
    """
    rows = np.concatenate([np.empty((0, columns)), *parts])
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64) if len(rows) > columns else rows


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
