"""Ordinary and weighted least squares: IDIM-LS and IDIM-WLS (paper eqs. 7-11, 15, 16)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ident.errors import DataUnfit
from ident.estimate import Estimate, Method
from ident.estimators.triangles import Triangles, joint_triangles, solve
from ident.observation import Observation

FloatArray = NDArray[np.float64]


def ls(observation: Observation, fixed_gains: FloatArray | None = None) -> Estimate:
    """Ordinary least squares.

    Args:
        observation: rows of at least one loaded and one unloaded run where the gains are unknown.
        fixed_gains: known gains [Nm/A], shape (n,); then it is the classical IDIM-LS (eq. 7).

    Raises:
        DataUnfit: free gains without a known payload: every gain could be scaled at will.
    """
    triangles = joint_triangles(observation)
    return _solve(observation, triangles, np.ones(observation.joint_count), Method.LS, fixed_gains)


def wls(observation: Observation, fixed_gains: FloatArray | None = None) -> Estimate:
    """Weighted least squares: rows of a joint are divided by the residual's standard deviation from ``ls`` (§2.3).

    Arguments and errors as for ``ls``.
    """
    triangles = joint_triangles(observation)
    first = _solve(observation, triangles, np.ones(observation.joint_count), Method.LS, fixed_gains)
    return _solve(observation, triangles, 1.0 / first.axis_noise, Method.WLS, fixed_gains)


def require_known_payload(observation: Observation) -> None:
    """Without a known payload the system (17) is homogeneous and gains have no scale."""
    if not observation.known().any():
        raise DataUnfit(
            ", ".join(observation.runs),
            "no run carries a payload of known mass, so all gains could be scaled at will; "
            "record a run with a weighed payload, or hold the gains fixed",
        )


def _solve(
    observation: Observation, triangles: Triangles, weight: FloatArray, method: Method, fixed: FloatArray | None
) -> Estimate:
    count = observation.joint_count
    system = triangles.stacked(weight)
    if fixed is None:
        require_known_payload(observation)
        matrix, right = system[:, :-1], -system[:, -1]
    else:
        matrix, right = -system[:, count:-1], system[:, :count] @ fixed + system[:, -1]
    solution, inverse, singular = solve(matrix, right)
    full = np.concatenate((solution, [1.0])) if fixed is None else np.concatenate((fixed, solution, [1.0]))
    rows = int(triangles.rows.sum())
    # Eq. (9) on the weighted rows, then eq. (10).
    variance = float(np.sum((system @ full) ** 2)) / max(rows - matrix.shape[1], 1)
    covariance = np.zeros((len(full) - 1, len(full) - 1))
    first = 0 if fixed is None else count
    covariance[first:, first:] = variance * inverse
    return Estimate(
        method=method,
        gains=full[:count],
        gains_fixed=fixed is not None,
        unknowns=observation.unknowns,
        parameters=full[count:-1],
        covariance=covariance,
        axis_noise=triangles.residual_std(full, matrix.shape[1]),
        singular_values=singular,
        condition=float(singular[0] / singular[-1]),
        rows=rows,
    )
