"""Linear estimators of the paper: IDIM-LS, IDIM-WLS (eqs. 7-11, 15, 16), IDIM-TLS (eqs. 17-23)."""

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
"""Of `parameters_over_noise`: below it the smallest singular value is no noise of a current."""
NO_COLUMN = 1e-8
"""Norm below which a joint does not have a column, relative to its largest one."""


def ls(system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Ordinary least squares.

    Args:
        system: of at least one loaded and one unloaded run where the gains are unknown.
        fixed_gains: known gains [Nm/A], shape (m,); then it is the classical IDIM-LS (eq. 7).

    Raises:
        PayloadMissing: free gains without a known payload: every gain could be scaled at will.
    """
    weight = np.ones(system.axis_count)
    return _solve(system, weight, Method.LS, fixed_gains)


def wls(system: System, fixed_gains: FloatArray | None = None) -> Estimate:
    """Weighted least squares: rows of a joint are divided by the standard deviation of their error.

    Arguments and errors as for ``ls``.
    """
    weight = 1.0 / wls_row_std(system, fixed_gains)
    return _solve(system, weight, Method.WLS, fixed_gains)


def wls_row_std(system: System, fixed_gains: FloatArray | None = None) -> FloatArray:
    """Standard deviation by which ``wls`` divides the rows of each joint, shape (n,) [Nm].

    With fixed gains it is that of §2.3, `joint_error_std`. Where gains are free, or the robot is
    redundant, it is that of the global ``ls`` solution for all joints. §2.3 has none to offer
    there: where a known mass exerts no torque on a joint, as on every wrist, the right-hand side of
    this joint's own equations (eq. 15) is zero, and so are their solution and its error. A joint of
    a redundant robot has no equations of its own.

    Arguments and errors as for ``ls``.
    """
    if fixed_gains is not None and not system.model.is_redundant:
        return joint_error_std(system.joints, fixed_gains)
    return ls(system, fixed_gains).axis_noise


def joint_error_std(triangles: Triangles, gains: FloatArray) -> FloatArray:
    """Standard deviation of the error of each joint's own equations (§2.3), shape (n,) [Nm].

    They are solved by least squares.

    Args:
        triangles: of each joint's rows of W_tot.
        gains: known gains [Nm/A], shape (m,).
    """
    count = len(gains)
    deviations: list[float] = []
    for factor, rows in zip(triangles.factors, triangles.rows.tolist(), strict=True):
        currents = factor[:, :count]
        known = factor[:, -1]
        own = _own_columns(factor[:, count:-1])
        torque = currents @ gains + known
        # Y − Q Qᵀ Y: what the columns of W do not explain
        basis, _ = np.linalg.qr(own)
        explained = basis @ (basis.T @ torque)
        error_size = float(np.linalg.norm(torque - explained))
        freedom = rows - own.shape[1]
        deviations.append(_deviation(error_size, factor, freedom))
    return np.array(deviations)


def _own_columns(columns: FloatArray) -> FloatArray:
    """Columns that the equations of one joint distinguish, shape (r, c) → (r, ≤c)."""
    independent = independent_columns(columns, smallest=NO_COLUMN)
    return columns[:, independent]


def _deviation(size: float, factor: FloatArray, freedom: int) -> float:
    """Standard deviation of an error of this size: at least rounding; without rows infinite."""
    if not factor.any():
        return np.inf
    epsilon = np.finfo(np.float64).eps
    rounding = epsilon * float(np.linalg.norm(factor))
    root = float(np.sqrt(max(freedom, 1)))
    return max(size, rounding) / root


def _solve(
    system: System, weight: FloatArray, method: Method, fixed: FloatArray | None
) -> Estimate:
    count = system.axis_count
    triangles = system.joints
    has_fixed_gains = fixed is not None
    # W_tot = [V | −W | −W_uL | −W_kL χ_kL]
    stacked = triangles.stacked(weight)
    known = stacked[:, -1]
    if fixed is None:
        require_known_payload(system)
        matrix = stacked[:, :-1]
        right = -known
        first_estimated = 0
    else:
        currents = stacked[:, :count]
        matrix = -stacked[:, count:-1]
        right = currents @ fixed + known
        first_estimated = count
    solution, inverse = solve(matrix, right)
    if fixed is None:
        full = np.concatenate((solution, [1.0]))
    else:
        full = np.concatenate((fixed, solution, [1.0]))
    rows = int(triangles.rows.sum())
    unknown_count = matrix.shape[1]
    freedom = max(rows - unknown_count, 1)
    # Eq. (9) on the weighted rows, then eq. (10).
    residual = stacked @ full
    variance = float(np.sum(residual**2)) / freedom
    width = len(full) - 1
    covariance = np.zeros((width, width))
    covariance[first_estimated:, first_estimated:] = variance * inverse
    return _estimate(
        system,
        method,
        full,
        covariance,
        singular_values(matrix),
        unknown_count,
        gains_fixed=has_fixed_gains,
    )


def _estimate(
    system: System,
    method: Method,
    solution: FloatArray,
    covariance: FloatArray,
    singular: FloatArray,
    unknown_count: int,
    *,
    gains_fixed: bool,
) -> Estimate:
    """The estimate of a solution (g, χ, χ_uL, 1) of eq. (17), with so many of them estimated."""
    count = system.axis_count
    triangles = system.joints
    weighted = system.weighted_singular_values(solution, unknown_count, gains=not gains_fixed)
    return Estimate(
        method=method,
        gains=solution[:count],
        gains_fixed=gains_fixed,
        unknowns=system.unknowns,
        parameters=solution[count:-1],
        covariance=covariance,
        axis_noise=triangles.residual_std(solution, unknown_count),
        singular_values=singular,
        condition=float(weighted[0] / weighted[-1]),
        rows=int(triangles.rows.sum()),
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
    """Total least squares (eq. 18).

    The solution is the right singular vector of W_tot's smallest singular value, last entry one.

    Args:
        system: of at least one loaded and one unloaded run.
        scaling: of rows and columns before the decomposition; the paper divides rows by
            `joint_data_std`. A joint of a redundant robot has no equations of its own: ROWS is
            RESIDUALS there.

    Raises:
        PayloadMissing: no run carries a known payload.
    """
    require_known_payload(system)
    weight = 1.0 / tls_row_std(system, scaling)
    vector, covariance, singular = _smallest(system.joints, weight, scaling.has_unit_columns)
    unknown_count = len(vector) - 1
    return _estimate(
        system, Method.TLS, vector, covariance, singular, unknown_count, gains_fixed=False
    )


def joint_data_std(triangles: Triangles) -> FloatArray:
    """Standard deviation σ_W^j of the data in each joint's equations (§3.3), shape (n,).

    It is the smallest singular value of these equations over √(r − c). In eq. (22) c is the number
    of columns, which must be independent. In the equations of one joint they are not: most
    parameters are absent from its torque, and some of those that are present cannot be
    distinguished in it. Columns below NO_COLUMN of the largest norm, and columns that depend on
    those before them, are left out; c is the number of the others. A joint without any column has
    an infinite deviation, so no weight.

    Args:
        triangles: of each joint's rows of W_tot.
    """
    deviations: list[float] = []
    for factor, rows in zip(triangles.factors, triangles.rows.tolist(), strict=True):
        own = _own_columns(factor)
        smallest = float(singular_values(own).min(initial=np.inf))
        freedom = rows - own.shape[1]
        deviations.append(_deviation(smallest, factor, freedom))
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
    misjudged = np.flatnonzero(ratios < MISJUDGED_RATIO)
    return tuple(misjudged.tolist())


def parameters_over_noise(system: System) -> FloatArray:
    """Ratio of each joint's smallest singular values, without and with its currents, shape (n,).

    Where noise of the currents determines σ_W^j, everything that the moves show of the parameters
    is well above it.
    """
    ratios: list[float] = []
    for factor in system.joints.factors:
        own = independent_columns(factor, smallest=NO_COLUMN)
        parameters = [column for column in own if column >= system.axis_count]
        of_all = singular_values(factor[:, own])
        of_parameters = singular_values(factor[:, parameters])
        smallest_of_all = of_all.min(initial=np.inf)
        smallest_of_parameters = of_parameters.min(initial=np.inf)
        ratio = np.inf
        if np.isfinite(smallest_of_all):
            ratio = smallest_of_parameters / smallest_of_all
        ratios.append(ratio)
    return np.array(ratios)


def tls_row_std(system: System, scaling: Scaling = Scaling.ROWS) -> FloatArray:
    """Standard deviation by which ``tls`` divides the rows of each joint, shape (n,).

    Arguments as for ``tls``.
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
    """Solution with last entry one, its covariance (eq. 23), and singular values of W_tot."""
    stacked = triangles.stacked(weight)
    norms = np.ones(stacked.shape[1])
    if unit_columns:
        norms = np.linalg.norm(stacked, axis=0)
    scaled = stacked / norms
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    left_singular = u[:, -1]
    smallest = s[-1]
    right_singular = vt[-1]
    scaled_solution = right_singular / right_singular[-1]
    rows = int(triangles.rows.sum())
    freedom = max(rows - len(scaled_solution), 1)
    data_std = smallest / np.sqrt(freedom)  # eq. (22)
    compatible = scaled - smallest * np.outer(left_singular, right_singular)  # eq. (20)
    _, inverse = solve(compatible[:, :-1], scaled[:, -1])
    squared_size = 1.0 + float(np.sum(scaled_solution[:-1] ** 2))
    scaled_covariance = data_std**2 * squared_size * inverse  # eq. (23)
    # Back to the columns before they were scaled
    column_scale = norms[-1] / norms[:-1]
    solution = scaled_solution * norms[-1] / norms
    covariance = scaled_covariance * np.outer(column_scale, column_scale)
    return solution, covariance, s
