"""Rows reduced to triangles, however many there were.

R of the stack [R_before; new rows] is R of all rows so far, so that the observation matrix is never
in memory at once. R is unique up to the sign of its rows, and ‖R x‖ = ‖W x‖ for every x. Each step
is Householder's (LAPACK ``tpqrt``, which knows that the upper part is a triangle), so R carries a
backward error of some ε ‖column‖ in every column, whatever the condition number. The Gram matrix is
twice as fast and squares the condition number: singular values below √ε ‖W‖ are lost in it
(docs/evidence has both, measured).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from ident.arrays import FloatArray, IntArray

BLOCK_ROWS = 1024  #: Rows folded in at once: 80 columns of them stay in a core's own cache

LEAST_RECIPROCAL_CONDITION = 1e-9  #: Of columns of norm one, in which all directions are well seen
REFLECTORS = 8
"""Householder vectors applied together; wider blocks cost more inside themselves than they save on
the rest.
"""


@dataclass(frozen=True, slots=True)
class Triangles:
    """R of the QR factorisation of each axis' equations; ‖R x‖ is their residual's norm at x."""

    factors: tuple[FloatArray, ...]  #: one for each axis, shape (≤c, c)
    rows: IntArray  #: number of equations of each axis, shape (m,)

    def stacked(self, weight: FloatArray) -> FloatArray:
        """All axes below each other, each scaled by its weight, (m,): shape (≤m c, c)."""
        pairs = zip(self.factors, weight, strict=True)
        return np.concatenate([factor * scale for factor, scale in pairs])

    def residual_std(self, vector: FloatArray, free: int) -> FloatArray:
        """σ of each axis' residual R x, shape (m,) (eq. 9).

        Args:
            vector: x, shape (c,).
            free: number of estimated parameters, which are shared by the axes.
        """
        square_sum = self.square_sum(vector)
        share = free / len(self.rows)
        freedom = np.maximum(self.rows - share, 1.0)
        return np.asarray(np.sqrt(square_sum / freedom))

    def square_sum(self, vector: FloatArray) -> FloatArray:
        """‖R x‖² of each axis, shape (m,)."""
        square_sums: list[float] = []
        for factor in self.factors:
            residual = factor @ vector
            square_sums.append(float(np.sum(residual**2)))
        return np.array(square_sums)


def triangle(parts: Iterable[FloatArray], columns: int) -> FloatArray:
    """R of rows that come in pieces below each other, shape (≤columns, columns).

    As few rows as columns, or fewer, stay as they are: ‖R x‖ = ‖W x‖ holds, but R is no triangle.
    Whoever needs one calls `qr_update`.

    It is made block by block (`qr_update`): LAPACK's factorisation of all rows at once goes through
    the memory for every few columns, and takes three to five times as long.

    Args:
        parts: pieces of rows, each of shape (r, columns).
        columns: c, for the case of no rows.
    """
    no_rows = np.empty((0, columns))
    rows = np.concatenate([no_rows, *parts])
    if len(rows) <= columns:
        return rows
    return qr_update(None, rows.T)


def triangle_of(columns: FloatArray) -> FloatArray:
    """R of rows that are given column by column, (c, k) → (≤c, c), without columns of zeros."""
    nonzero = np.flatnonzero(columns.any(axis=1))
    out = np.zeros((len(nonzero), len(columns)))
    out[:, nonzero] = qr_update(None, columns[nonzero])
    return out


def solve(matrix: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least squares with unit-norm columns inside.

    Args:
        matrix: M, shape (k, c).
        right: one right-hand side, shape (k,), or several, (k, s).

    Returns:
        the solution, shape (c,) or (c, s), and (MᵀM)⁻¹, shape (c, c).

    Scaling columns changes no least-squares solution, but spares digits where one is in kg and
    another in kg m².
    """
    norms = np.linalg.norm(matrix, axis=0)
    norms[norms == 0.0] = 1.0
    u, s, vt = np.linalg.svd(matrix / norms, full_matrices=False)
    is_seen = s > s[0] * 1e-13
    # M⁺ = H Uᵀ with H = V S⁻¹, in the units of the columns; (MᵀM)⁻¹ = H Hᵀ
    half = vt[is_seen].T / s[is_seen]
    half = half / norms[:, None]
    components = u[:, is_seen].T @ right
    return half @ components, half @ half.T


def least_squares(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """The solution of `solve` alone, shape (c,), by the triangle where all columns are well seen.

    Back substitution in R is as exact as the singular values are, which cost five times as much,
    unless a direction is hardly seen: then these decide which one is left out.

    Args:
        matrix: M, shape (k, c).
        right: shape (k,).
    """
    columns = matrix.shape[1]
    norms = np.linalg.norm(matrix, axis=0)
    if len(matrix) <= columns or not norms.all():
        solution, _ = solve(matrix, right)
        return solution
    rows = np.column_stack((matrix / norms, right))
    factor = qr_update(None, rows.T)
    upper = factor[:columns, :columns]
    reciprocal_condition, _ = lapack.dtrcon(upper)
    if reciprocal_condition < LEAST_RECIPROCAL_CONDITION:
        solution, _ = solve(matrix, right)
        return solution
    turned_right = factor[:columns, columns]
    in_units, _ = lapack.dtrtrs(upper, turned_right)
    return np.asarray(in_units / norms)


def singular_values(matrix: FloatArray) -> FloatArray:
    """Singular values of a matrix in decreasing order, shape (c,)."""
    values = np.linalg.svd(matrix, compute_uv=False)
    return np.asarray(values, dtype=np.float64)


def qr_update(triangle: FloatArray | None, columns: FloatArray) -> FloatArray:
    """R of the rows after ``triangle`` and the rows in ``columns``.

    Args:
        triangle: what an earlier call returned, None at the start; left as it is.
        columns: further rows, column by column with time last, shape (c, k); any k, none too; left
            as they are.

    Returns:
        upper triangular, shape (c, c); with fewer than c independent rows it is singular, but never
        smaller.

    Raises:
        ValueError: the number of columns is not that of the triangle.
    """
    count, rows = columns.shape
    if triangle is None:
        triangle = np.zeros((count, count))
    if triangle.shape != (count, count):
        raise ValueError(
            f"expected {triangle.shape[0]} columns, as in the rows before, found {count}"
        )
    if not count or not rows:
        return triangle
    reflectors = min(REFLECTORS, count)
    out = np.array(triangle, order="F")
    for first in range(0, rows, BLOCK_ROWS):
        # Time last in C order is (rows, columns) in Fortran order: LAPACK gets it without a
        # transposition.
        last = first + BLOCK_ROWS
        block = np.array(columns[:, first:last], order="C")
        out, *_ = lapack.dtpqrt(0, reflectors, out, block.T, overwrite_a=1, overwrite_b=1)
    return np.triu(out)
