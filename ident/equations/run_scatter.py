"""What differs from run to run, such as friction, as correlated errors of whitened rows.

The rows of one motor in one run share the deviation b of their friction from the common one, b ~
N(0, s²). In units of the noise and of s, with N the torque per unit of b, their errors have the
covariance

    V = 1 + N Nᵀ = 1 + U diag(λ) Uᵀ,      V^(−1/2) = 1 − U diag(1 − 1/√(1 + λ)) Uᵀ,

U the left singular vectors of N and λ its squared singular values. Rows multiplied by V^(−1/2) have
independent errors again (generalised least squares; Aitken, Proc. R. Soc. Edinburgh 55 (1936)): of
the deviations of whole runs little is left in them, and nothing that a candidate explains of it
counts. Errors of rows that were left out stay independent of the others, so folds of moves and of
runs need no change. Deviations of a joint that two motors turn are taken as two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # loads scipy.sparse when it is first used: a fit needs none of it

from ident.arrays import FloatArray, IntArray

#: Directions up to which zeros are stored: a product is three times as fast, and the memory is
#: little
MOST_DENSE = 32


@dataclass(frozen=True, slots=True)
class RunScatter:
    """Covariance of each motor's whitened rows, by orthonormal directions of single runs."""

    directions: tuple[Any, ...]  #: Uᵀ of each motor, an array or a sparse one, shapes (k_i, rows_i)
    variances: tuple[FloatArray, ...]  #: λ of each direction, shapes (k_i,)

    @classmethod
    def of(cls, columns: Sequence[FloatArray], runs: Sequence[IntArray]) -> RunScatter:
        """Build it from the torque of one standard deviation.

        Args:
            columns: N of each motor, whitened, columns first, shapes (k, rows_i).
            runs: run of each row of each motor, shapes (rows_i,).
        """
        directions: list[Any] = []
        variances: list[FloatArray] = []
        for own, run in zip(columns, runs, strict=True):
            of_motor, own_variances = _directions_of_runs(own, run)
            directions.append(of_motor)
            variances.append(own_variances)
        return cls(tuple(directions), tuple(variances))

    def decorrelate(self, motor: int, columns: FloatArray) -> FloatArray:
        """V^(−1/2) times columns on the rows of a motor, columns first, shape (p, rows)."""
        std = np.sqrt(1.0 + self.variances[motor])
        factors = 1.0 / std - 1.0
        return self._scaled(motor, columns, factors)

    def correlate(self, motor: int, columns: FloatArray) -> FloatArray:
        """V times columns on the rows of a motor, columns first, shape (p, rows)."""
        return self._scaled(motor, columns, self.variances[motor])

    def shared(self, motor: int, columns: FloatArray) -> FloatArray:
        """X (V − 1) Xᵀ of columns on a motor's rows, columns first, (p, rows) → (p, p)."""
        components = self.directions[motor] @ columns.T  # Uᵀ Xᵀ
        variances = self.variances[motor][:, None]
        return np.asarray(components.T @ (variances * components))

    def sorted(self, orders: Sequence[IntArray]) -> RunScatter:
        """The same for rows of each motor in another order."""
        pairs = zip(self.directions, orders, strict=True)
        directions = [own[:, order] for own, order in pairs]
        return RunScatter(tuple(directions), self.variances)

    def _scaled(self, motor: int, columns: FloatArray, factors: FloatArray) -> FloatArray:
        """X + U diag(f) Uᵀ X, transposed."""
        directions = self.directions[motor]
        components = columns @ directions.T  # rows stay along memory
        scaled = components * factors
        return np.asarray(columns + scaled @ directions)


def _directions_of_runs(columns: FloatArray, run: IntArray) -> tuple[Any, FloatArray]:
    """Uᵀ and λ of one motor, shapes (k, rows) and (k,).

    Args:
        columns: N, whitened, columns first, shape (k, rows).
        run: of each row, shape (rows,).
    """
    row_count = len(run)
    nonzero = columns.any(axis=1)
    seen = columns[nonzero]
    directions = [scipy.sparse.csr_array((0, row_count))]
    squares = [np.zeros(0)]
    for number in np.unique(run):
        rows = np.flatnonzero(run == number)
        of_run = seen[:, rows]
        _, sizes, own = np.linalg.svd(of_run, full_matrices=False)
        count = len(own)
        column_indices = np.broadcast_to(rows, own.shape).ravel()
        starts = len(rows) * np.arange(count + 1)
        entries = (own.ravel(), column_indices, starts)
        directions.append(scipy.sparse.csr_array(entries, shape=(count, row_count)))
        squares.append(sizes**2)
    stacked: Any = scipy.sparse.vstack(directions, format="csr")
    if stacked.shape[0] <= MOST_DENSE:
        stacked = stacked.toarray()
    return stacked, np.concatenate(squares)
