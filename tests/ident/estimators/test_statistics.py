"""Eqs.

(7)-(11) and (17)-(23): against the formulas written out on all rows, and against the scatter they
predict.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.discovery.evidence import Evidence
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
TWO_AXES = Model(
    Robot(
        (Joint("J", JointKind.REVOLUTE, -1, np.eye(3), np.zeros(3), np.array([0.0, 0.0, 1.0])),)
        * 2,
        np.zeros(3),
    ),
    DriveTrain(np.eye(2)),
)


def _system(matrix: FloatArray) -> System:
    """W_tot of two joints, the first half of the rows the first one's."""
    halves = np.split(matrix, 2)
    factors = tuple(triangle((half,), 7) for half in halves)
    rows = np.array([ROWS // 2] * 2)
    joints = Triangles(factors, rows)
    independent = (0, 1, 2)
    grouping = np.eye(3)
    names = ("a", "b", "c")
    base = BaseParameters(independent, grouping, names)
    columns = tuple(Column(name, "1") for name in "abc")
    motors = Triangles((), np.zeros(0, dtype=np.int64))
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
    matrix = rng.normal(size=(ROWS, 7)) * np.array([1.0, 2.0, 5.0, 1.0, 0.5, 3.0, 1.0])
    matrix[:, -1] = -matrix[:, :-1] @ SOLUTION[:-1]
    return np.asarray(matrix)


def _scatter(
    estimate: Callable[[System], Estimate],
    disturb: Callable[[FloatArray, np.random.Generator], FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean and covariance of 400 estimates, and the mean of the covariances that they claim."""
    rng = np.random.default_rng(4)
    exact = _exact(rng)
    found = [estimate(_system(disturb(exact, rng))) for _ in range(400)]
    stacked_gains = [np.concatenate((e.gains, e.parameters)) for e in found]
    values = np.stack(stacked_gains)
    return values.mean(axis=0), np.cov(values.T), np.mean([e.covariance for e in found], axis=0)


def _agree(measured: FloatArray, claimed: FloatArray) -> None:
    assert np.diag(claimed) == pytest.approx(np.diag(measured), rel=0.3)
    measured_diagonal_outer = np.outer(np.diag(measured), np.diag(measured))
    scale = np.sqrt(measured_diagonal_outer)
    claimed_difference = np.abs(claimed - measured)
    assert np.max(claimed_difference / scale) < 0.3


def test_least_squares_scatters_as_equation_10_says() -> None:
    """Noise in Y_L alone, one size for all rows: what eq. (8) assumes."""

    def disturb(exact: FloatArray, rng: np.random.Generator) -> FloatArray:
        noisy = exact.copy()
        noisy[:, -1] += 0.3 * rng.normal(size=ROWS)
        return noisy

    mean, measured, claimed = _scatter(ls, disturb)
    assert mean == pytest.approx(SOLUTION[:-1], abs=5e-3)
    _agree(measured, claimed)


@pytest.mark.slow
def test_weighting_rows_by_joint_gains_what_it_says() -> None:
    """The second joint four times as noisy:
    WLS knows, LS claims one σ for both and scatters more.
    """

    def disturb(exact: FloatArray, rng: np.random.Generator) -> FloatArray:
        noisy = exact.copy()
        noisy[:, -1] += np.repeat([0.25, 1.0], ROWS // 2) * rng.normal(size=ROWS)
        return noisy

    _, measured, claimed = _scatter(wls, disturb)
    _agree(measured, claimed)
    _, of_ls, _ = _scatter(ls, disturb)
    assert np.all(np.diag(measured) < 0.35 * np.diag(of_ls))


@pytest.mark.slow
@pytest.mark.parametrize("scaling", [Scaling.NONE, Scaling.ROWS])
def test_total_least_squares_scatters_as_equation_23_says(scaling: Scaling) -> None:
    """Equal, independent errors in every entry of W_tot: what eq.

    (21) assumes. LS is biased there.
    """

    def disturb(exact: FloatArray, rng: np.random.Generator) -> FloatArray:
        return exact + 0.05 * rng.normal(size=exact.shape)

    mean, measured, claimed = _scatter(lambda system: tls(system, scaling), disturb)
    _agree(measured, claimed)
    mean_difference = mean - SOLUTION[:-1]
    bias = np.abs(mean_difference)
    assert np.all(bias < 4.0 * np.sqrt(np.diag(measured) / 400) + 1e-3)

    def much(exact: FloatArray, rng: np.random.Generator) -> FloatArray:
        return exact + 0.2 * rng.normal(size=exact.shape)

    of_tls, of_ls = (
        np.abs(_scatter(e, much)[0] / SOLUTION[:-1] - 1.0) for e in (lambda s: tls(s, scaling), ls)
    )
    assert np.max(of_tls) < 0.1 * np.max(of_ls)


def test_the_triangles_give_the_formulas_of_all_rows(noisy: Evidence) -> None:
    """Eqs. (16), (9), (10), (19), (22) and (23) written out on the whole W_tot."""
    rows = noisy.training.only(noisy.training.run < 2)
    matrix = np.concatenate(
        [
            np.concatenate(
                (
                    rows.drive_train.direction[:, joint, None] * rows.current[:, used],
                    -rows.of_joint(joint, used),
                    -rows.known()[joint, used][None],
                )
            ).T
            for joint, used in enumerate(rows.use)
        ]
    )
    regressor = matrix[:, :-1]
    right = -matrix[:, -1]
    count, unknowns = regressor.shape
    solution = np.linalg.lstsq(regressor, right, rcond=None)[0]
    variance = np.sum((right - regressor @ solution) ** 2) / (count - unknowns)
    inverse = np.linalg.inv(regressor.T @ regressor)
    covariance = variance * inverse
    found = ls(rows.system())
    stacked_gains = np.concatenate((found.gains, found.parameters))
    assert stacked_gains == pytest.approx(solution, rel=1e-6, abs=1e-8)
    covariance_diagonal_root = np.sqrt(np.diag(found.covariance))
    assert covariance_diagonal_root == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-5)
    _, s, vt = np.linalg.svd(matrix, full_matrices=False)
    vector = vt[-1] / vt[-1, -1]
    matrix_difference = matrix - np.outer(matrix @ vt[-1], vt[-1])
    compatible = matrix_difference[:, :-1]
    degrees_of_freedom = count - matrix.shape[1]
    noise = s[-1] ** 2 / degrees_of_freedom
    size = 1.0 + np.sum(vector[:-1] ** 2)
    total = tls(rows.system(), Scaling.NONE)
    assert np.concatenate((total.gains, total.parameters)) == pytest.approx(
        vector[:-1], rel=1e-5, abs=1e-7
    )
    diagonal = np.diag(noise * size * np.linalg.inv(compatible.T @ compatible))
    claimed = np.sqrt(diagonal)
    covariance_diagonal = np.diag(total.covariance)
    assert np.sqrt(covariance_diagonal) == pytest.approx(claimed, rel=1e-4)
