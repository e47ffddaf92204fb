"""The R of a QR factorisation whose rows come piece by piece (TSQR): what is left of millions of rows in one triangle.

R of the stack [R_before; new rows] is R of all rows so far, so that the observation matrix is never held whole. Each
step is Householder's (LAPACK ``tpqrt``, which knows that the upper part is a triangle), so R carries a backward error
of some ε ‖column‖ in every column, whatever the condition number. The Gram matrix is twice as fast and squares the
condition number: singular values below √ε ‖W‖ are lost in it (docs/bench.md has both, measured).

R is unique up to the sign of its rows; ‖R x‖ = ‖W x‖ for every x.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

FloatArray = NDArray[np.float64]

BLOCK_ROWS = 1024
"""Rows folded in at once: 80 columns of them stay in a core's own cache."""

REFLECTORS = 8
"""Householder vectors applied together; wider blocks cost more inside themselves than they save on the rest."""


def qr_update(triangle: FloatArray | None, columns: FloatArray) -> FloatArray:
    """R of the rows behind ``triangle`` and the rows in ``columns``.

    Args:
        triangle: what an earlier call returned, None at the start; left as it is.
        columns: further rows, column by column with time last, shape (c, k); any k, none too; left as they are.

    Returns:
        upper triangular, shape (c, c); with fewer than c independent rows it is singular, but never smaller.

    Raises:
        ValueError: the number of columns is not that of the triangle.
    """
    count, rows = columns.shape
    if triangle is not None and triangle.shape != (count, count):
        raise ValueError(f"expected {triangle.shape[0]} columns, as in the rows before, found {count}")
    if not count or not rows:
        return np.zeros((count, count)) if triangle is None else triangle
    out = np.zeros((count, count), order="F") if triangle is None else np.array(triangle, order="F")
    for first in range(0, rows, BLOCK_ROWS):
        # Time last in C order is (rows, columns) in Fortran order: LAPACK gets it without a transposition.
        block = np.array(columns[:, first : first + BLOCK_ROWS], order="C")
        out = lapack.dtpqrt(0, min(REFLECTORS, count), out, block.T, overwrite_a=1, overwrite_b=1)[0]
    return np.triu(out)


def qr_merge(parts: Iterable[tuple[FloatArray, Sequence[int]]], width: int) -> FloatArray:
    """R of several sets of rows, each known by its own triangle over a subset of the columns.

    A joint's torque depends on the links behind it and on its own drive alone: its triangle is that narrow, and only
    here the joints meet.

    Args:
        parts: triangle of shape (c_i, c_i), and which of the ``width`` columns these c_i are.
        width: number of columns.

    Returns:
        upper triangular, shape (width, width).
    """
    out: FloatArray | None = None
    for triangle, places in parts:
        rows = np.zeros((width, triangle.shape[0]))
        rows[list(places)] = triangle.T
        out = qr_update(out, rows)
    return np.zeros((width, width)) if out is None else out
