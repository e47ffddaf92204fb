"""Linearised rows at random, of which trials and fits of candidates are computed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ident.equations.linearisation import Jacobian, Linearisation

FloatArray = NDArray[np.float64]

MOTORS = 3
MOVES = 16
WIDTH = 5  #: Unknowns


def random_problem(rng: np.random.Generator) -> Linearisation:
    """Rows of three motors in sixteen moves of uneven length; the residual is what a fit leaves.

    The last motor's equation lacks the first two unknowns, as those near the flange do.
    """
    row_counts = rng.integers(8, 20, size=(MOTORS, MOVES))
    motor = np.repeat(np.arange(MOTORS), row_counts.sum(axis=1))
    moves = np.tile(np.arange(MOVES), MOTORS)
    cluster = np.repeat(moves, row_counts.ravel())
    jacobian = rng.normal(size=(len(motor), WIDTH)) * (1.0 + motor[:, None])
    jacobian[motor == MOTORS - 1, :2] = 0.0
    parts: list[FloatArray] = []
    seen: list[NDArray[np.int64]] = []
    for one in range(MOTORS):
        own = jacobian[motor == one].T
        is_seen = own.any(axis=1)
        parts.append(own[is_seen])
        seen.append(np.flatnonzero(is_seen))
    raw = rng.normal(size=len(motor)) + 0.3 * np.sin(np.arange(len(motor)))
    residual = raw - jacobian @ fitted_to(jacobian, raw)
    current = 5.0 * rng.normal(size=len(motor))
    source = np.arange(len(motor))
    gamma = np.ones(MOTORS)
    free = np.arange(WIDTH)
    return Linearisation(
        jacobian=Jacobian(tuple(parts), tuple(seen), WIDTH),
        residual=residual,
        current=current,
        motor=motor,
        cluster=cluster,
        source=source,
        gamma=gamma,
        noise=np.ones(MOTORS),
        free=free,
        scale=np.ones(WIDTH),
    )


def fitted_to(columns: FloatArray, target: FloatArray) -> FloatArray:
    """Coefficients of columns that fit a target best."""
    coefficients, *_ = np.linalg.lstsq(columns, target, rcond=None)
    return np.asarray(coefficients)
