"""Equations (7)-(11) and (17)-(23): against the formulas written out on all rows, and against the
scatter they predict.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.discovery.evidence import Evidence
from ident.equations.observation import Observation
from ident.equations.system import System
from ident.equations.triangles import Triangles, triangle
from ident.estimators.estimate import Estimate
from ident.estimators.least_squares import Scaling, ls, tls, wls
from ident.model.base import BaseParameters
from ident.model.bodies import Payload
from ident.model.model import Column, DriveTrain, Model
from ident.model.robot import Joint, JointKind, Robot

FloatArray = NDArray[np.float64]

SOLUTION = np.array([3.0, -2.0, 0.7, 0.2, -0.5, 1.1, 1.0])
"""Two gains, three parameters of the robot, one of the payload, and eq. (17)'s one."""
ROWS = 400
TRIALS = 400
UNKNOWNS = SOLUTION[:-1]
JOINT = Joint("J", JointKind.REVOLUTE, -1, np.eye(3), np.zeros(3), np.array([0.0, 0.0, 1.0]))
TWO_JOINTS = Robot((JOINT, JOINT), np.zeros(3))
TWO_AXES = Model(TWO_JOINTS, DriveTrain(np.eye(2)))


def _system(matrix: FloatArray) -> System:
    """W_tot of two joints, the first half of the rows the first one's."""
    halves = np.split(matrix, 2)
    factors = tuple(triangle((half,), matrix.shape[1]) for half in halves)
    joints = Triangles(factors, np.array([ROWS // 2, ROWS // 2]))
    motors = Triangles((), np.zeros(0, dtype=np.int64))
    names = ("a", "b", "c")
    base = BaseParameters((0, 1, 2), np.eye(3), names)
    columns = tuple(Column(name, "1") for name in names)
    payloads = (Payload("disc", "x", {"m": 1.0}),)
    return System(
        model=TWO_AXES,
        base=base,
        columns=columns,
        payloads=payloads,
        payload_columns=((0,),),
        runs=("run",),
        joints=joints,
        motors=motors,
        clusters=(),
    )


def _exact(rng: np.random.Generator) -> FloatArray:
    """Rows with W_tot χ_tot = 0."""
    size_of_columns = np.array([1.0, 2.0, 5.0, 1.0, 0.5, 3.0, 1.0])
    matrix = rng.normal(size=(ROWS, 7)) * size_of_columns
    matrix[:, -1] = -matrix[:, :-1] @ UNKNOWNS
    return np.asarray(matrix)


Estimator = Callable[[System], Estimate]
Disturbance = Callable[[FloatArray, np.random.Generator], FloatArray]


def _solution(estimate: Estimate) -> FloatArray:
    """Gains, then parameters."""
    return np.concatenate((estimate.gains, estimate.parameters))


def _scatter(
    estimator: Estimator, disturb: Disturbance
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean and covariance of 400 estimates, and the mean of the covariances that they claim."""
    rng = np.random.default_rng(4)
    exact = _exact(rng)
    solutions = []
    covariances = []
    for _ in range(TRIALS):
        disturbed = disturb(exact, rng)
        estimate = estimator(_system(disturbed))
        solutions.append(_solution(estimate))
        covariances.append(estimate.covariance)
    mean = np.mean(solutions, axis=0)
    measured = np.cov(np.transpose(solutions))
    claimed = np.mean(covariances, axis=0)
    return mean, measured, claimed


def _agree(measured: FloatArray, claimed: FloatArray) -> None:
    """Check two covariances: the variances within 30 %, the rest within 0.3 as correlations."""
    variances = np.diag(measured)
    assert np.diag(claimed) == pytest.approx(variances, rel=0.3)
    scale = np.sqrt(np.outer(variances, variances))
    correlation_error = np.abs(claimed - measured) / scale
    assert np.max(correlation_error) < 0.3


def test_least_squares_scatters_as_equation_10_says() -> None:
    """Noise in Y_L alone, one size for all rows: what eq. (8) assumes."""

    def disturb(exact: FloatArray, rng: np.random.Generator) -> FloatArray:
        noisy = exact.copy()
        noisy[:, -1] += 0.3 * rng.normal(size=ROWS)
        return noisy

    mean, measured, claimed = _scatter(ls, disturb)
    assert mean == pytest.approx(UNKNOWNS, abs=5e-3)
    _agree(measured, claimed)


@pytest.mark.slow
def test_weighting_rows_by_joint_gains_what_it_says() -> None:
    """The second joint four times as noisy:
    WLS knows, LS claims one σ for both and scatters more.
    """

    def disturb(exact: FloatArray, rng: np.random.Generator) -> FloatArray:
        noisy = exact.copy()
        std_of_rows = np.repeat([0.25, 1.0], ROWS // 2)
        noisy[:, -1] += std_of_rows * rng.normal(size=ROWS)
        return noisy

    _, measured, claimed = _scatter(wls, disturb)
    _agree(measured, claimed)
    _, of_ls, _ = _scatter(ls, disturb)
    assert np.all(np.diag(measured) < 0.35 * np.diag(of_ls))


@pytest.mark.slow
@pytest.mark.parametrize("scaling", [Scaling.NONE, Scaling.ROWS])
def test_total_least_squares_scatters_as_equation_23_says(scaling: Scaling) -> None:
    """Equal, independent errors in every entry of W_tot: what equation (21) assumes.

    LS is biased there.
    """

    def scaled_tls(system: System) -> Estimate:
        return tls(system, scaling)

    def disturb_little(exact: FloatArray, rng: np.random.Generator) -> FloatArray:
        return exact + 0.05 * rng.normal(size=exact.shape)

    def disturb_much(exact: FloatArray, rng: np.random.Generator) -> FloatArray:
        return exact + 0.2 * rng.normal(size=exact.shape)

    mean, measured, claimed = _scatter(scaled_tls, disturb_little)
    _agree(measured, claimed)
    bias = np.abs(mean - UNKNOWNS)
    std_of_mean = np.sqrt(np.diag(measured) / TRIALS)
    assert np.all(bias < 4.0 * std_of_mean + 1e-3)

    mean_of_tls, _, _ = _scatter(scaled_tls, disturb_much)
    mean_of_ls, _, _ = _scatter(ls, disturb_much)
    bias_of_tls = np.abs(mean_of_tls / UNKNOWNS - 1.0)
    bias_of_ls = np.abs(mean_of_ls / UNKNOWNS - 1.0)
    assert np.max(bias_of_tls) < 0.1 * np.max(bias_of_ls)


def _total_matrix(rows: Observation) -> FloatArray:
    """W_tot of equation (16), the rows of one joint below those of another."""
    of_joints = []
    for joint, used in enumerate(rows.use):
        direction = rows.drive_train.direction[:, joint, None]
        currents = direction * rows.current[:, used]
        parameters = rows.of_joint(joint, used)
        known = rows.known()[joint, used]
        columns = np.concatenate((currents, -parameters, -known[None]))
        of_joints.append(columns.T)
    return np.concatenate(of_joints)


def _ls_by_formulas(matrix: FloatArray) -> tuple[NDArray[np.floating], FloatArray]:
    """Solution and covariance of least squares: equations (9) and (10)."""
    regressor = matrix[:, :-1]
    right = -matrix[:, -1]
    rows, unknowns = regressor.shape
    solution, *_ = np.linalg.lstsq(regressor, right, rcond=None)
    residual = right - regressor @ solution
    variance = np.sum(residual**2) / (rows - unknowns)
    covariance = variance * np.linalg.inv(regressor.T @ regressor)
    return solution, covariance


def _tls_by_formulas(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solution and covariance of total least squares: equations (19), (22) and (23)."""
    rows, columns = matrix.shape
    _, singular_values, vt = np.linalg.svd(matrix, full_matrices=False)
    null_vector = vt[-1]
    solution = null_vector[:-1] / null_vector[-1]
    # The nearest matrix of smaller rank is compatible: a vector solves it exactly.
    compatible = matrix - np.outer(matrix @ null_vector, null_vector)
    regressor = compatible[:, :-1]
    variance = singular_values[-1] ** 2 / (rows - columns)
    size = 1.0 + np.sum(solution**2)
    covariance = variance * size * np.linalg.inv(regressor.T @ regressor)
    return solution, covariance


def test_the_triangles_give_the_formulas_of_all_rows(noisy: Evidence) -> None:
    rows = noisy.training.only(noisy.training.run < 2)
    matrix = _total_matrix(rows)

    found = ls(rows.system())
    solution, covariance = _ls_by_formulas(matrix)
    assert _solution(found) == pytest.approx(solution, rel=1e-6, abs=1e-8)
    std = np.sqrt(np.diag(covariance))
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(std, rel=1e-5)

    found = tls(rows.system(), Scaling.NONE)
    solution, covariance = _tls_by_formulas(matrix)
    assert _solution(found) == pytest.approx(solution, rel=1e-5, abs=1e-7)
    std = np.sqrt(np.diag(covariance))
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(std, rel=1e-4)
