"""What differs from run to run as correlated errors of whitened rows:
friction moves with temperature and mounting.

The rows of one motor in one run share the deviation b of their friction from the common one, b ~
N(0, s²). In units of the noise and of s, with N the torque per unit of b, their errors have the
covariance

    V = 1 + N Nᵀ = 1 + U diag(λ) Uᵀ,      V^(−1/2) = 1 − U diag(1 − 1/√(1 + λ)) Uᵀ,

U the left singular vectors of N and λ its squared singular values. Rows multiplied by V^(−1/2) have
independent errors again (generalised least squares; Aitken, Proc. R. Soc. Edinburgh 55 (1936)): of
the deviations of whole runs little is left in them, and nothing that a candidate explains of it
counts. Errors of rows that were left out stay independent of the others, so folds of moves and of
runs need no change. Deviations of a joint that two motors feel are taken as two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # loads scipy.sparse when it is first used: a fit needs none of it

from ident.arrays import FloatArray, IntArray

#: Directions up to which zeros are kept: a product is three times as fast, and the memory is little
MOST_DENSE = 32


@dataclass(frozen=True, slots=True)
class RunScatter:
    """Covariance of the whitened rows of each motor,
    given by orthonormal directions of single runs.
    """

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
            seen = own[own.any(axis=1)]
            unit_rows = [scipy.sparse.csr_array((0, len(run)))]
            squares = [np.zeros(0)]
            for number in np.unique(run):
                rows = np.flatnonzero(run == number)
                _, size, along = np.linalg.svd(seen[:, rows], full_matrices=False)
                place = np.broadcast_to(rows, along.shape).ravel()
                starts = len(rows) * np.arange(len(along) + 1)
                unit_rows.append(
                    scipy.sparse.csr_array(
                        (along.ravel(), place, starts), shape=(len(along), len(run))
                    )
                )
                squares.append(size**2)
            stacked = scipy.sparse.vstack(unit_rows, format="csr")
            directions.append(stacked.toarray() if stacked.shape[0] <= MOST_DENSE else stacked)
            variances.append(np.concatenate(squares))
        return cls(tuple(directions), tuple(variances))

    def decorrelate(self, motor: int, columns: FloatArray) -> FloatArray:
        """V^(−1/2) times columns on the rows of a motor, columns first, shape (p, rows)."""
        return self._scaled(motor, columns, 1.0 / np.sqrt(1.0 + self.variances[motor]) - 1.0)

    def correlate(self, motor: int, columns: FloatArray) -> FloatArray:
        """V times columns on the rows of a motor, columns first, shape (p, rows)."""
        return self._scaled(motor, columns, self.variances[motor])

    def shared(self, motor: int, columns: FloatArray) -> FloatArray:
        """X (V − 1) Xᵀ of columns on the rows of a motor, columns first, shape (p, rows) → (p,
        p).
        """
        along = self.directions[motor] @ columns.T
        return np.asarray(along.T @ (self.variances[motor][:, None] * along))

    def sorted(self, orders: Sequence[IntArray]) -> RunScatter:
        """The same for rows of each motor in another order."""
        moved = tuple(own[:, order] for own, order in zip(self.directions, orders, strict=True))
        return RunScatter(moved, self.variances)

    def _scaled(self, motor: int, columns: FloatArray, factors: FloatArray) -> FloatArray:
        """X + U diag(f) Uᵀ X, transposed."""
        directions = self.directions[motor]
        along = factors[:, None] * (directions @ columns.T)
        return np.asarray(columns + (directions.T @ along).T)
