"""Linear estimators of the paper: IDIM-LS, IDIM-WLS (eqs. 7-11, 15, 16) and IDIM-TLS (eqs. 17-23)."""

from __future__ import annotations

from enum import Enum

import numpy as np

from ident.arrays import FloatArray
from ident.equations.system import System, require_known_payload
from ident.equations.triangles import Triangles, singular_values, solve
from ident.estimators.estimate import Estimate
from ident.estimators.method import Method


def ls(system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Ordinary least squares.

    Args:
        system: of at least one loaded and one unloaded run where the gains are unknown.
        fixed_gains: known gains [Nm/A], shape (m,); then it is the classical IDIM-LS (eq. 7).

    Raises:
        DataUnfit: free gains without a known payload: every gain could be scaled at will.
    """
    return _solve(system, np.ones(system.axis_count), Method.LS, fixed_gains)


def wls(system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Weighted least squares: rows of a joint are divided by the residual's standard deviation from ``ls`` (§2.3).

    Arguments and errors as for ``ls``.
    """
    first = _solve(system, np.ones(system.axis_count), Method.LS, fixed_gains)
    return _solve(system, 1.0 / first.axis_noise, Method.WLS, fixed_gains)


def _solve(system: System, weight: FloatArray, method: Method, fixed: FloatArray | None) -> Estimate:
    count, triangles = system.axis_count, system.joints
    stacked = triangles.stacked(weight)
    if fixed is None:
        require_known_payload(system)
        matrix, right = stacked[:, :-1], -stacked[:, -1]
    else:
        matrix, right = -stacked[:, count:-1], stacked[:, :count] @ fixed + stacked[:, -1]
    solution, inverse = solve(matrix, right)
    full = np.concatenate((solution, [1.0])) if fixed is None else np.concatenate((fixed, solution, [1.0]))
    rows = int(triangles.rows.sum())
    # Eq. (9) on the weighted rows, then eq. (10).
    variance = float(np.sum((stacked @ full) ** 2)) / max(rows - matrix.shape[1], 1)
    covariance = np.zeros((len(full) - 1, len(full) - 1))
    first = 0 if fixed is None else count
    covariance[first:, first:] = variance * inverse
    weighted = system.weighted_singular_values(full, matrix.shape[1], gains=fixed is None)
    return Estimate(
        method=method,
        gains=full[:count],
        gains_fixed=fixed is not None,
        unknowns=system.unknowns,
        parameters=full[count:-1],
        covariance=covariance,
        axis_noise=triangles.residual_std(full, matrix.shape[1]),
        singular_values=singular_values(matrix),
        condition=float(weighted[0] / weighted[-1]),
        rows=rows,
    )


class Scaling(Enum):
    """Scaling before TLS, which is not invariant to it."""

    NONE = "none"
    ROWS = "rows weighted per joint"  # the paper, §3.3
    COLUMNS = "unit-norm columns"
    BOTH = "rows weighted per joint, unit-norm columns"


def tls(system: System, scaling: Scaling = Scaling.ROWS) -> Estimate:
    """Total least squares: the right singular vector of W_tot's smallest singular value, last entry one (eq. 18).

    Args:
        system: of at least one loaded and one unloaded run.
        scaling: of rows and columns before the decomposition; the paper weights rows per joint.

    Raises:
        DataUnfit: no run carries a known payload.
    """
    require_known_payload(system)
    triangles = system.joints
    weight = np.ones(system.axis_count)
    columns = scaling in (Scaling.COLUMNS, Scaling.BOTH)
    if scaling in (Scaling.ROWS, Scaling.BOTH):
        first, _, _ = _smallest(triangles, weight, columns)
        # σ_W^j, the standard deviation of joint j's equations (§3.3, last paragraph).
        weight = 1.0 / triangles.residual_std(first, len(first) - 1)
    vector, covariance, singular = _smallest(triangles, weight, columns)
    count = system.axis_count
    weighted = system.weighted_singular_values(vector, len(vector) - 1, gains=True)
    return Estimate(
        method=Method.TLS,
        gains=vector[:count],
        gains_fixed=False,
        unknowns=system.unknowns,
        parameters=vector[count:-1],
        covariance=covariance,
        axis_noise=triangles.residual_std(vector, len(vector) - 1),
        singular_values=singular,
        condition=float(weighted[0] / weighted[-1]),
        rows=int(triangles.rows.sum()),
    )


def _smallest(
    triangles: Triangles, weight: FloatArray, unit_columns: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    stacked = triangles.stacked(weight)
    norms = np.linalg.norm(stacked, axis=0) if unit_columns else np.ones(stacked.shape[1])
    scaled = stacked / norms
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    vector = vt[-1] / vt[-1, -1]
    rows, unknowns = int(triangles.rows.sum()), len(vector)
    noise = s[-1] / np.sqrt(max(rows - unknowns, 1))  # eq. (22)
    compatible = scaled - s[-1] * np.outer(u[:, -1], vt[-1])  # eq. (20)
    first = compatible[:, :-1]
    size = 1.0 + float(np.sum(vector[:-1] ** 2))
    scaled_covariance = noise**2 * size * solve(first, scaled[:, -1])[1]  # eq. (23)
    back = norms[-1] / norms[:-1]
    return vector * norms[-1] / norms, scaled_covariance * np.outer(back, back), s
