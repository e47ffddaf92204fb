"""Linear estimators of the paper: IDIM-LS, IDIM-WLS (eqs. 7-11, 15, 16) and IDIM-TLS (eqs.
17-23).
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from ident.arrays import FloatArray
from ident.equations.system import System, require_known_payload
from ident.equations.triangles import Triangles, singular_values, solve
from ident.estimators.estimate import Estimate
from ident.estimators.method import Method
from ident.model.base import independent_columns

MISJUDGED_RATIO = 1.5
"""Of `parameters_over_noise`: below it the smallest singular value is not the noise of a
current.
"""
NO_COLUMN = 1e-8
"""Norm of a column, relative to the largest of the same joint,
below which the joint does not have this column.
"""


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
    """Weighted least squares: rows of a joint are divided by the standard deviation of their error.

    Arguments and errors as for ``ls``.
    """
    return _solve(system, 1.0 / wls_row_std(system, fixed_gains), Method.WLS, fixed_gains)


def wls_row_std(system: System, fixed_gains: FloatArray | None = None) -> FloatArray:
    """Standard deviation by which ``wls`` divides the rows of each joint, shape (n,) [Nm].

    With fixed gains it is that of §2.2, `joint_error_std`. Where gains are free, or the robot is
    redundant, it is that of the global ``ls`` solution for all joints. §2.2 has none to offer
    there: where a known mass exerts no torque on a joint, as on every wrist, the right-hand side of
    this joint's own equations (eq. 15) is zero, and so are their solution and its error. A joint of
    a redundant robot has no equations of its own.

    Arguments and errors as for ``ls``.
    """
    if fixed_gains is not None and not system.model.is_redundant:
        return joint_error_std(system.joints, fixed_gains)
    return ls(system, fixed_gains).axis_noise


def joint_error_std(triangles: Triangles, gains: FloatArray) -> FloatArray:
    """Standard deviation of the error of each joint's own equations,
    solved by least squares (§2.2), shape (n,) [Nm].

    Args:
        triangles: of each joint's rows of W_tot.
        gains: known gains [Nm/A], shape (m,).
    """
    count = len(gains)
    deviations = []
    for factor, rows in zip(triangles.factors, triangles.rows.tolist(), strict=True):
        own = _own_columns(factor[:, count:-1])
        torque = factor[:, :count] @ gains + factor[:, -1]
        basis, _ = np.linalg.qr(own)
        error = float(np.linalg.norm(torque - basis @ (basis.T @ torque)))
        deviations.append(_deviation(error, factor, rows - own.shape[1]))
    return np.array(deviations)


def _own_columns(columns: FloatArray) -> FloatArray:
    """Columns that the equations of one joint distinguish, shape (r, c) → (r, ≤c)."""
    return columns[:, independent_columns(columns, smallest=NO_COLUMN)]


def _deviation(size: float, factor: FloatArray, freedom: int) -> float:
    """Standard deviation of an error of this size;
    without noise it is rounding error, without rows infinite.
    """
    if not factor.any():
        return np.inf
    rounding = np.finfo(np.float64).eps * float(np.linalg.norm(factor))
    return max(size, rounding) / float(np.sqrt(max(freedom, 1)))


def _solve(
    system: System, weight: FloatArray, method: Method, fixed: FloatArray | None
) -> Estimate:
    count = system.axis_count
    triangles = system.joints
    stacked = triangles.stacked(weight)
    if fixed is None:
        require_known_payload(system)
        matrix = stacked[:, :-1]
        right = -stacked[:, -1]
        first_estimated = 0
    else:
        matrix = -stacked[:, count:-1]
        right = stacked[:, :count] @ fixed + stacked[:, -1]
        first_estimated = count
    solution, inverse = solve(matrix, right)
    if fixed is None:
        full = np.concatenate((solution, [1.0]))
    else:
        full = np.concatenate((fixed, solution, [1.0]))
    rows = int(triangles.rows.sum())
    unknown_count = matrix.shape[1]
    # Eq. (9) on the weighted rows, then eq. (10).
    squares = float(np.sum((stacked @ full) ** 2))
    variance = squares / max(rows - unknown_count, 1)
    covariance = np.zeros((len(full) - 1, len(full) - 1))
    covariance[first_estimated:, first_estimated:] = variance * inverse
    weighted = system.weighted_singular_values(full, unknown_count, gains=fixed is None)
    return Estimate(
        method=method,
        gains=full[:count],
        gains_fixed=fixed is not None,
        unknowns=system.unknowns,
        parameters=full[count:-1],
        covariance=covariance,
        axis_noise=triangles.residual_std(full, unknown_count),
        singular_values=singular_values(matrix),
        condition=float(weighted[0] / weighted[-1]),
        rows=rows,
    )


class Scaling(Enum):
    """Scaling before TLS, which is not invariant to it."""

    NONE = "none"
    ROWS = "rows of joint j divided by σ_W^j of eq. (22)"  # the paper, §3.3
    RESIDUALS = "rows of joint j divided by the deviation of its residual"
    COLUMNS = "unit-norm columns"
    BOTH = "rows divided by the deviation of their residual, unit-norm columns"

    @property
    def has_unit_columns(self) -> bool:
        """Whether the columns are divided by their norms."""
        return self in (Scaling.COLUMNS, Scaling.BOTH)


def tls(system: System, scaling: Scaling = Scaling.ROWS) -> Estimate:
    """Total least squares: the right singular vector of W_tot's smallest singular value,
    last entry one (eq. 18).

    Args:
        system: of at least one loaded and one unloaded run.
        scaling: of rows and columns before the decomposition; the paper divides rows by
            `joint_data_std`. A joint of a redundant robot has no equations of its own: ROWS is
            RESIDUALS there.

    Raises:
        DataUnfit: no run carries a known payload.
    """
    require_known_payload(system)
    triangles = system.joints
    row_std = tls_row_std(system, scaling)
    vector, covariance, singular = _smallest(triangles, 1.0 / row_std, scaling.has_unit_columns)
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


def joint_data_std(triangles: Triangles) -> FloatArray:
    """Standard deviation σ_W^j of the data in the equations of each joint (eq.
    22 and §3.3), shape (n,).

    It is the smallest singular value of these equations over √(r − c). In eq. (22) c is the number
    of columns, which must be independent. In the equations of one joint they are not: most
    parameters are absent from its torque, and some of those that are present cannot be
    distinguished in it. Columns below NO_COLUMN of the largest norm, and columns that depend on
    those before them, are left out; c is the number of the others. A joint without any column has
    an infinite deviation, so no weight.

    Args:
        triangles: of each joint's rows of W_tot.
    """
    deviations = []
    for factor, rows in zip(triangles.factors, triangles.rows.tolist(), strict=True):
        own = _own_columns(factor)
        smallest = float(singular_values(own).min(initial=np.inf))
        deviations.append(_deviation(smallest, factor, rows - own.shape[1]))
    return np.array(deviations)


def misjudged_joints(system: System) -> tuple[int, ...]:
    """Joints whose σ_W^j is not the noise of a current, by their index; none of a redundant robot.

    Eq. (22) takes the smallest singular value of the joint's equations for noise. Where the moves
    hardly show one of the joint's parameters, a combination of columns of W, which have no noise,
    has one as small. σ_W^j is then too small, the rows of this joint count for too much, and
    ``tls`` bends the gains.

    Args:
        system: of the fit.
    """
    if system.model.is_redundant:
        return ()
    ratios = parameters_over_noise(system)
    return tuple(np.flatnonzero(ratios < MISJUDGED_RATIO).tolist())


def parameters_over_noise(system: System) -> FloatArray:
    """Smallest singular value of each joint's equations without its currents,
    relative to that with them, shape (n,).

    Where noise of the currents determines σ_W^j, everything that the moves show of the parameters
    is well above it.
    """
    ratios = []
    for factor in system.joints.factors:
        own = independent_columns(factor, smallest=NO_COLUMN)
        parameters = [column for column in own if column >= system.axis_count]
        smallest_of_all = singular_values(factor[:, own]).min(initial=np.inf)
        smallest_of_parameters = singular_values(factor[:, parameters]).min(initial=np.inf)
        ratio = np.inf
        if np.isfinite(smallest_of_all):
            ratio = smallest_of_parameters / smallest_of_all
        ratios.append(ratio)
    return np.array(ratios)


def tls_row_std(system: System, scaling: Scaling = Scaling.ROWS) -> FloatArray:
    """Standard deviation by which ``tls`` divides the rows of each joint, shape (n,);
    arguments as for ``tls``.
    """
    triangles = system.joints
    even = np.ones(len(triangles.factors))
    if scaling in (Scaling.NONE, Scaling.COLUMNS):
        return even
    if scaling is Scaling.ROWS and not system.model.is_redundant:
        return joint_data_std(triangles)
    first, _, _ = _smallest(triangles, even, scaling.has_unit_columns)
    return triangles.residual_std(first, len(first) - 1)


def _smallest(
    triangles: Triangles, weight: FloatArray, unit_columns: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solution with last entry one, its covariance (eq.
    23), and the singular values of the scaled W_tot.
    """
    stacked = triangles.stacked(weight)
    norms = np.ones(stacked.shape[1])
    if unit_columns:
        norms = np.linalg.norm(stacked, axis=0)
    scaled = stacked / norms
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    vector = vt[-1] / vt[-1, -1]
    rows = int(triangles.rows.sum())
    unknowns = len(vector)
    data_std = s[-1] / np.sqrt(max(rows - unknowns, 1))  # eq. (22)
    compatible = scaled - s[-1] * np.outer(u[:, -1], vt[-1])  # eq. (20)
    first = compatible[:, :-1]
    size = 1.0 + float(np.sum(vector[:-1] ** 2))
    _, inverse = solve(first, scaled[:, -1])
    scaled_covariance = data_std**2 * size * inverse  # eq. (23)
    back = norms[-1] / norms[:-1]
    return vector * norms[-1] / norms, scaled_covariance * np.outer(back, back), s
