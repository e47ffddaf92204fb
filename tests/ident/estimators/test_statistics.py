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
    return System(
        model=TWO_AXES,
        base=BaseParameters((0, 1, 2), np.eye(3), ("a", "b", "c")),
        columns=tuple(Column(name, "1") for name in "abc"),
        payloads=(Payload("disc", "x", {"m": 1.0}),),
        payload_columns=((0,),),
        runs=("run",),
        joints=Triangles(tuple(triangle((half,), 7) for half in halves), np.array([ROWS // 2] * 2)),
        motors=Triangles((), np.zeros(0, dtype=np.int64)),
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
    values = np.stack([np.concatenate((e.gains, e.parameters)) for e in found])
    return values.mean(axis=0), np.cov(values.T), np.mean([e.covariance for e in found], axis=0)


def _agree(measured: FloatArray, claimed: FloatArray) -> None:
    assert np.diag(claimed) == pytest.approx(np.diag(measured), rel=0.3)
    scale = np.sqrt(np.outer(np.diag(measured), np.diag(measured)))
    assert np.max(np.abs(claimed - measured) / scale) < 0.3


def test_least_squares_scatters_as_equation_10_says() -> None:
    """Noise in Y_L alone, one size for all rows: what eq. (8) assumes."""

    def disturb(exact: FloatArray, rng: np.random.Generator) -> FloatArray:
        noisy = exact.copy()
        noisy[:, -1] += 0.3 * rng.normal(size=ROWS)
        return noisy

    mean, measured, claimed = _scatter(ls, disturb)
    assert mean == pytest.approx(SOLUTION[:-1], abs=5e-3)
    _agree(measured, claimed)


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


@pytest.mark.parametrize("scaling", [Scaling.NONE, Scaling.ROWS])
def test_total_least_squares_scatters_as_equation_23_says(scaling: Scaling) -> None:
    """Equal, independent errors in every entry of W_tot: what eq.

    (21) assumes. LS is biased there.
    """

    def disturb(exact: FloatArray, rng: np.random.Generator) -> FloatArray:
        return exact + 0.05 * rng.normal(size=exact.shape)

    mean, measured, claimed = _scatter(lambda system: tls(system, scaling), disturb)
    _agree(measured, claimed)
    bias = np.abs(mean - SOLUTION[:-1])
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
    covariance = variance * np.linalg.inv(regressor.T @ regressor)
    found = ls(rows.system())
    assert np.concatenate((found.gains, found.parameters)) == pytest.approx(
        solution, rel=1e-6, abs=1e-8
    )
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(
        np.sqrt(np.diag(covariance)), rel=1e-5
    )
    _, s, vt = np.linalg.svd(matrix, full_matrices=False)
    vector = vt[-1] / vt[-1, -1]
    compatible = (matrix - np.outer(matrix @ vt[-1], vt[-1]))[:, :-1]
    noise = s[-1] ** 2 / (count - matrix.shape[1])
    size = 1.0 + np.sum(vector[:-1] ** 2)
    total = tls(rows.system(), Scaling.NONE)
    assert np.concatenate((total.gains, total.parameters)) == pytest.approx(
        vector[:-1], rel=1e-5, abs=1e-7
    )
    claimed = np.sqrt(np.diag(noise * size * np.linalg.inv(compatible.T @ compatible)))
    assert np.sqrt(np.diag(total.covariance)) == pytest.approx(claimed, rel=1e-4)
