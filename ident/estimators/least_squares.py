"""Ordinary and weighted least squares: IDIM-LS and IDIM-WLS (paper eqs. 7-11, 15, 16)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ident.estimate import Estimate, Method
from ident.system import System, require_known_payload
from ident.triangles import solve

FloatArray = NDArray[np.float64]


def ls(system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Ordinary least squares.

    Args:
        system: of at least one loaded and one unloaded run where the gains are unknown.
        fixed_gains: known gains [Nm/A], shape (n,); then it is the classical IDIM-LS (eq. 7).

    Raises:
        DataUnfit: free gains without a known payload: every gain could be scaled at will.
    """
    return _solve(system, np.ones(system.joint_count), Method.LS, fixed_gains)


def wls(system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Weighted least squares: rows of a joint are divided by the residual's standard deviation from ``ls`` (§2.3).

    Arguments and errors as for ``ls``.
    """
    first = _solve(system, np.ones(system.joint_count), Method.LS, fixed_gains)
    return _solve(system, 1.0 / first.axis_noise, Method.WLS, fixed_gains)


def _solve(system: System, weight: FloatArray, method: Method, fixed: FloatArray | None) -> Estimate:
    count, triangles = system.joint_count, system.joints
    stacked = triangles.stacked(weight)
    if fixed is None:
        require_known_payload(system)
        matrix, right = stacked[:, :-1], -stacked[:, -1]
    else:
        matrix, right = -stacked[:, count:-1], stacked[:, :count] @ fixed + stacked[:, -1]
    solution, inverse, singular = solve(matrix, right)
    full = np.concatenate((solution, [1.0])) if fixed is None else np.concatenate((fixed, solution, [1.0]))
    rows = int(triangles.rows.sum())
    # Eq. (9) on the weighted rows, then eq. (10).
    variance = float(np.sum((stacked @ full) ** 2)) / max(rows - matrix.shape[1], 1)
    covariance = np.zeros((len(full) - 1, len(full) - 1))
    first = 0 if fixed is None else count
    covariance[first:, first:] = variance * inverse
    weighted = triangles.weighted_system(full, matrix.shape[1], gains=fixed is None)
    return Estimate(
        method=method,
        gains=full[:count],
        gains_fixed=fixed is not None,
        unknowns=system.unknowns,
        parameters=full[count:-1],
        covariance=covariance,
        axis_noise=triangles.residual_std(full, matrix.shape[1]),
        singular_values=singular,
        condition=float(weighted[0] / weighted[-1]),
        rows=rows,
    )
