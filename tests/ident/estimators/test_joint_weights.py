"""Weights of the rows of each joint: eq. (22) and §3.3 for `tls`, §2.3 for `wls`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.run import Run
from ident.discovery.evidence import Evidence
from ident.equations.reduction import reduce_runs, regrouped
from ident.equations.system import System
from ident.equations.triangles import Triangles, triangle
from ident.estimators.estimate import Identification
from ident.estimators.least_squares import (
    Scaling,
    joint_data_std,
    joint_error_std,
    ls,
    misjudged_joints,
    tls,
    wls,
)
from ident.estimators.maximum_likelihood import ml
from tests.ident.recordings import CONDITIONING, GAINS, MOUNTED, Truth, record

FloatArray = NDArray[np.float64]

ROWS = 500
NOISE_A = 0.3


def _rows_of_joint(evidence: Evidence, joint: int) -> FloatArray:
    """Rows of W_tot of one joint, written out (eq. 17), shape (r, c)."""
    rows = evidence.training
    used = rows.use[joint]
    direction = rows.drive_train.direction[:, joint]
    current = direction[:, None] * rows.current[:, used]
    columns = rows.of_joint(joint, used)
    known = rows.known()[joint, used]
    transposed = np.concatenate((current, -columns, -known[None]))
    return transposed.T


def _solution(matrix: FloatArray, right_side: FloatArray) -> FloatArray:
    """Least squares of a dense system."""
    solution = np.linalg.lstsq(matrix, right_side, rcond=None)
    return np.asarray(solution[0])


def _residual(matrix: FloatArray, right_side: FloatArray) -> FloatArray:
    """What the columns do not explain."""
    predicted = matrix @ _solution(matrix, right_side)
    return right_side - predicted


def _smallest_singular_value(rows: FloatArray) -> float:
    values = np.linalg.svd(rows, compute_uv=False)
    return float(values[-1])


def _root_of_freedom(rows: FloatArray) -> float:
    """Root of the number of rows that the columns leave over."""
    row_count, column_count = rows.shape
    return float(np.sqrt(row_count - column_count))


@dataclass(frozen=True)
class _Parts:
    """Columns of W_tot of six axes (eq. 17), by what they belong to."""

    gains: FloatArray
    parameters: FloatArray
    known: FloatArray

    @classmethod
    def of(cls, rows: FloatArray) -> _Parts:
        return cls(rows[:, :6], rows[:, 6:-1], rows[:, -1])

    def torque(self) -> FloatArray:
        """Torque of the known gains."""
        return np.asarray(self.gains @ GAINS + self.known)


def _in_turn_independent(rows: FloatArray) -> list[int]:
    """Columns that the columns chosen before them do not explain, by least squares."""
    norms = np.linalg.norm(rows, axis=0)
    chosen: list[int] = []
    threshold = 1e-8 * norms.max()
    for column in np.flatnonzero(norms > threshold):
        unit = rows[:, column] / norms[column]
        before = rows[:, chosen] / norms[chosen]
        left = _residual(before, unit)
        if np.linalg.norm(left) > 1e-8:
            chosen.append(int(column))
    return chosen


def _small_system(truth: Truth, seed: int, noise_a: float) -> System:
    """Two runs without load and two with the disc, with this noise in the currents."""
    rng = np.random.default_rng(seed)
    runs = []
    for number in range(4):
        payload = MOUNTED if number % 2 else None
        name = f"run{number}"
        run = record(truth, name, rng, payload, noise_a=noise_a, seconds=22.0)
        runs.append(run)
    standstill_rad_s = (0.03,) * 3
    conditioning = replace(CONDITIONING, standstill_rad_s=standstill_rad_s)
    standard = reduce_runs(truth.model, runs, conditioning)
    return regrouped(standard)


def _mean_error(gains: FloatArray, truth: Truth) -> float:
    errors = gains / truth.gains - 1.0
    return float(np.mean(np.abs(errors)))


def test_joint_data_std_is_equation_22_on_the_rows_of_the_joint(noisy: Evidence) -> None:
    triangles = noisy.training.system().joints
    found = joint_data_std(triangles)
    for joint in range(6):
        rows = _rows_of_joint(noisy, joint)
        own = rows[:, _in_turn_independent(rows)]
        expected = _smallest_singular_value(own) / _root_of_freedom(own)
        assert found[joint] == pytest.approx(expected, rel=1e-6)


def test_joint_data_std_with_absent_and_dependent_columns_is_that_of_the_others() -> None:
    rng = np.random.default_rng(5)
    exact = rng.normal(size=(ROWS, 4))
    coefficients = [1.0, -2.0, 0.5]
    exact[:, 3] = exact[:, :3] @ coefficients
    noise = 0.1 * rng.normal(size=exact.shape)
    full = exact + noise
    absent = np.zeros((ROWS, 1))
    negligible = 1e-10 * rng.normal(size=(ROWS, 1))
    first = full[:, :1]
    second = full[:, 1:2]
    dependent = first - 3.0 * second
    more = np.concatenate((full, absent, negligible, dependent), axis=1)
    rows = np.array([ROWS])
    columns = more.shape[1]
    factors = (triangle((more,), columns),)
    found = joint_data_std(Triangles(factors, rows))
    expected = _smallest_singular_value(full) / _root_of_freedom(full)
    assert found == pytest.approx([expected], rel=1e-9)
    assert expected == pytest.approx(0.1, rel=0.1)


def test_joint_data_std_without_rows_is_infinite_so_that_the_joint_has_no_weight() -> None:
    resting = np.zeros((3, 3))
    moving = np.eye(3)
    moving[:, 2] = (1.0, 1.0, 0.1)
    rows = np.array([0, 9])
    triangles = Triangles((resting, moving), rows)
    found = joint_data_std(triangles)
    assert found[0] == np.inf
    assert np.isfinite(found[1])


@pytest.mark.slow
@pytest.mark.parametrize("axis", range(3))
def test_joint_data_std_follows_the_noise_of_the_current_and_not_the_gain(
    small_truth: Truth, axis: int
) -> None:
    triangles = _small_system(small_truth, 1, NOISE_A).joints
    quiet = joint_data_std(triangles)
    # The same noise on three axes whose gains are different
    assert quiet == pytest.approx(quiet.mean(), rel=0.1)
    other_gains = small_truth.gains.copy()
    other_gains[axis] *= 2.0
    stronger = replace(small_truth, gains=other_gains)
    joints = _small_system(stronger, 1, NOISE_A).joints
    found = joint_data_std(joints)
    expected = pytest.approx(quiet[axis], rel=0.05)
    assert found[axis] == expected


@pytest.mark.slow
def test_tls_with_noise_in_the_currents_is_as_good_as_ml(small_truth: Truth) -> None:
    of_ml = []
    of_tls = []
    of_residuals = []
    for seed in range(1, 5):
        system = _small_system(small_truth, seed, NOISE_A)
        by_ml = ml(system)
        by_tls = tls(system)
        by_residuals = tls(system, Scaling.RESIDUALS)
        of_ml.append(_mean_error(by_ml.gains, small_truth))
        of_tls.append(_mean_error(by_tls.gains, small_truth))
        of_residuals.append(_mean_error(by_residuals.gains, small_truth))
    error_of_tls = np.mean(of_tls)
    assert error_of_tls < 1.5 * np.mean(of_ml)
    assert np.mean(of_residuals) > 2.0 * error_of_tls


def test_joint_error_std_is_that_of_the_joint_alone(noisy: Evidence) -> None:
    system = noisy.training.system()
    found = joint_error_std(system.joints, GAINS)
    for joint in range(6):
        parts = _Parts.of(_rows_of_joint(noisy, joint))
        columns = parts.parameters
        own = columns[:, _in_turn_independent(columns)]
        error = np.linalg.norm(_residual(own, parts.torque()))
        expected = error / _root_of_freedom(own)
        assert found[joint] == pytest.approx(expected, rel=1e-6)


def test_wls_of_fixed_gains_weights_by_the_error_of_the_joint_alone(
    noisy_found: Identification,
) -> None:
    system = noisy_found.system
    weight = 1.0 / joint_error_std(system.joints, GAINS)
    parts = _Parts.of(system.joints.stacked(weight))
    expected = _solution(-parts.parameters, parts.torque())
    parameters = wls(system, GAINS).parameters
    assert parameters == pytest.approx(expected, rel=1e-6, abs=1e-8)


def test_a_wrist_has_no_torque_of_the_known_mass_so_free_gains_take_the_global_error(
    noisy_found: Identification,
) -> None:
    system = noisy_found.system
    wrist = system.joints.factors[3:]
    assert len(wrist) == 3
    for factor in wrist:
        known = factor[:, -1]
        assert np.linalg.norm(known) == 0.0
    weight = 1.0 / ls(system).axis_noise
    matrix = system.joints.stacked(weight)
    unknown = matrix[:, :-1]
    expected = _solution(unknown, -matrix[:, -1])
    gains = wls(system).gains
    assert gains == pytest.approx(expected[:6], rel=1e-6)


@pytest.mark.slow
def test_tls_of_runs_in_another_order_is_the_same(
    truth: Truth, noisy_runs: tuple[Run, ...]
) -> None:
    def gains(runs: tuple[Run, ...]) -> FloatArray:
        standard = reduce_runs(truth.model, runs, CONDITIONING)
        return tls(regrouped(standard)).gains

    in_order = gains(noisy_runs)
    reversed_order = gains(noisy_runs[::-1])
    assert reversed_order == pytest.approx(in_order, rel=1e-9)


def _with_twin_column(system: System, difference: float) -> System:
    """J1 has one column twice, but for a share of its norm;
    the parameter of the second one is zero.
    """
    count = system.axis_count
    factors = []
    for joint, factor in enumerate(system.joints.factors):
        row_count, column_count = factor.shape
        twin = np.zeros((row_count, 1))
        own_row = np.zeros((1, column_count + 1))
        if joint == 0:
            norms = np.linalg.norm(factor, axis=0)
            worst_joint = np.argmax(norms[count:-1])
            largest = count + int(worst_joint)
            twin = factor[:, [largest]]
            own_row[:, -2] = difference * norms[largest]
        columns = factor[:, :-1]
        known = factor[:, -1:]
        wider = np.concatenate((columns, twin, known), axis=1)
        factors.append(np.concatenate((wider, own_row)))
    joints = replace(system.joints, factors=tuple(factors))
    return replace(system, joints=joints)


@pytest.mark.parametrize(("difference", "expected"), [(1e-2, ()), (1e-4, (0,))])
def test_misjudged_joints_with_a_parameter_that_hardly_shows_names_its_joint(
    small_truth: Truth, difference: float, expected: tuple[int, ...]
) -> None:
    small_system = _small_system(small_truth, 1, NOISE_A)
    system = _with_twin_column(small_system, difference)
    assert misjudged_joints(system) == expected


def test_misjudged_joints_of_usual_recordings_is_empty(
    small_truth: Truth, noisy_found: Identification
) -> None:
    system = _small_system(small_truth, 1, NOISE_A)
    assert misjudged_joints(system) == ()
    assert misjudged_joints(noisy_found.system) == ()


def test_misjudged_joints_with_currents_in_milliampere_names_a_joint_whose_gain_is_bent(
    small_truth: Truth,
) -> None:
    """Eq.

    (21) takes the noise for one of every column, and parameters are then larger numbers than gains.
    """
    system = _small_system(small_truth, 1, NOISE_A)
    first_factor = system.joints.factors[0]
    scale = np.ones(first_factor.shape[1])
    scale[: system.axis_count] = 1000.0
    factors = tuple(factor * scale for factor in system.joints.factors)
    joints = replace(system.joints, factors=factors)
    in_milliampere = replace(system, joints=joints)
    assert 0 in misjudged_joints(in_milliampere)
    gains = 1000.0 * tls(in_milliampere).gains
    error_in_milliampere = _mean_error(gains, small_truth)
    error = _mean_error(tls(system).gains, small_truth)
    assert error_in_milliampere > 3.0 * error
