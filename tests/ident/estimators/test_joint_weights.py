"""Weights of the rows of each joint: eq. (22) and §3.3 for `tls`, §2.2 for `wls`."""

from __future__ import annotations

from dataclasses import replace

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
    current = rows.drive_train.direction[:, joint, None] * rows.current[:, used]
    known = rows.known()[joint, used][None]
    return np.concatenate((current, -rows.of_joint(joint, used), -known)).T


def _in_turn_independent(rows: FloatArray) -> list[int]:
    """Columns that the columns chosen before them do not explain, by least squares."""
    norms = np.linalg.norm(rows, axis=0)
    chosen: list[int] = []
    for column in np.flatnonzero(norms > 1e-8 * norms.max()):
        unit = rows[:, column] / norms[column]
        before = rows[:, chosen] / norms[chosen]
        left = unit - before @ np.linalg.lstsq(before, unit, rcond=None)[0]
        if np.linalg.norm(left) > 1e-8:
            chosen.append(int(column))
    return chosen


def _small_system(truth: Truth, seed: int, noise_a: float) -> System:
    """Two runs without load and two with the disc, with this noise in the currents."""
    rng = np.random.default_rng(seed)
    runs = [
        record(
            truth,
            f"run{number}",
            rng,
            MOUNTED if number % 2 else None,
            noise_a=noise_a,
            seconds=22.0,
        )
        for number in range(4)
    ]
    standstill_rad_s = (0.03,) * 3
    conditioning = replace(CONDITIONING, standstill_rad_s=standstill_rad_s)
    standard = reduce_runs(truth.model, runs, conditioning)
    return regrouped(standard)


def _mean_error(gains: FloatArray, truth: Truth) -> float:
    return float(np.mean(np.abs(gains / truth.gains - 1.0)))


def test_joint_data_std_is_equation_22_on_the_rows_of_the_joint(noisy: Evidence) -> None:
    triangles = noisy.training.system().joints
    found = joint_data_std(triangles)
    for joint in range(6):
        rows = _rows_of_joint(noisy, joint)
        own = rows[:, _in_turn_independent(rows)]
        smallest = np.linalg.svd(own, compute_uv=False)[-1]
        row_count_root = np.sqrt(len(rows) - own.shape[1])
        assert found[joint] == pytest.approx(smallest / row_count_root, rel=1e-6)


def test_joint_data_std_with_absent_and_dependent_columns_is_that_of_the_others() -> None:
    rng = np.random.default_rng(5)
    exact = rng.normal(size=(ROWS, 4))
    exact[:, 3] = exact[:, :3] @ [1.0, -2.0, 0.5]
    full = exact + 0.1 * rng.normal(size=exact.shape)
    absent = np.zeros((ROWS, 1))
    negligible = 1e-10 * rng.normal(size=(ROWS, 1))
    dependent = full[:, :1] - 3.0 * full[:, 1:2]
    more = np.concatenate((full, absent, negligible, dependent), axis=1)
    rows = np.array([ROWS])
    columns = more.shape[1]
    factors = (triangle((more,), columns),)
    found = joint_data_std(Triangles(factors, rows))
    rows_root = np.sqrt(ROWS - 4)
    expected = np.linalg.svd(full, compute_uv=False)[-1] / rows_root
    assert found == pytest.approx([expected], rel=1e-9)
    assert expected == pytest.approx(0.1, rel=0.1)


def test_joint_data_std_without_rows_is_infinite_so_that_the_joint_has_no_weight() -> None:
    resting = np.zeros((3, 3))
    moving = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.1]])
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
    assert found[axis] == pytest.approx(quiet[axis], rel=0.05)


@pytest.mark.slow
def test_tls_with_noise_in_the_currents_is_as_good_as_ml(small_truth: Truth) -> None:
    errors: dict[str, list[float]] = {"ml": [], "tls": [], "residuals": []}
    for seed in range(1, 5):
        system = _small_system(small_truth, seed, NOISE_A)
        gains = ml(system).gains
        errors["ml"].append(_mean_error(gains, small_truth))
        errors["tls"].append(_mean_error(tls(system).gains, small_truth))
        errors["residuals"].append(_mean_error(tls(system, Scaling.RESIDUALS).gains, small_truth))
    means = {name: float(np.mean(values)) for name, values in errors.items()}
    assert means["tls"] < 1.5 * means["ml"]
    assert means["residuals"] > 2.0 * means["tls"]


def test_joint_error_std_is_that_of_the_joint_alone(noisy: Evidence) -> None:
    system = noisy.training.system()
    found = joint_error_std(system.joints, GAINS)
    for joint in range(6):
        rows = _rows_of_joint(noisy, joint)
        torque = rows[:, :6] @ GAINS + rows[:, -1]
        columns = rows[:, 6:-1]
        own = columns[:, _in_turn_independent(columns)]
        error = np.linalg.norm(torque - own @ np.linalg.lstsq(own, torque, rcond=None)[0])
        row_count_root = np.sqrt(len(rows) - own.shape[1])
        assert found[joint] == pytest.approx(error / row_count_root, rel=1e-6)


def test_wls_of_fixed_gains_weights_by_the_error_of_the_joint_alone(
    noisy_found: Identification,
) -> None:
    system = noisy_found.system
    weight = 1.0 / joint_error_std(system.joints, GAINS)
    matrix = system.joints.stacked(weight)
    torque = matrix[:, :6] @ GAINS + matrix[:, -1]
    expected = np.linalg.lstsq(-matrix[:, 6:-1], torque, rcond=None)[0]
    parameters = wls(system, GAINS).parameters
    assert parameters == pytest.approx(expected, rel=1e-6, abs=1e-8)


def test_a_wrist_has_no_torque_of_the_known_mass_so_free_gains_take_the_global_error(
    noisy_found: Identification,
) -> None:
    system = noisy_found.system
    known = [float(np.linalg.norm(factor[:, -1])) for factor in system.joints.factors]
    assert known[3:] == [0.0, 0.0, 0.0]
    weight = 1.0 / ls(system).axis_noise
    matrix = system.joints.stacked(weight)
    expected = np.linalg.lstsq(matrix[:, :-1], -matrix[:, -1], rcond=None)[0]
    gains = wls(system).gains
    assert gains == pytest.approx(expected[:6], rel=1e-6)


@pytest.mark.slow
def test_tls_of_runs_in_another_order_is_the_same(
    truth: Truth, noisy_runs: tuple[Run, ...]
) -> None:
    def gains(runs: tuple[Run, ...]) -> FloatArray:
        standard = reduce_runs(truth.model, runs, CONDITIONING)
        return tls(regrouped(standard)).gains

    assert gains(noisy_runs[::-1]) == pytest.approx(gains(noisy_runs), rel=1e-9)


def _with_twin_column(system: System, difference: float) -> System:
    """J1 has one column twice, but for a share of its norm;
    the parameter of the second one is zero.
    """
    count = system.axis_count
    factors = []
    for joint, factor in enumerate(system.joints.factors):
        twin = np.zeros((len(factor), 1))
        own_row = np.zeros((1, factor.shape[1] + 1))
        if joint == 0:
            norms = np.linalg.norm(factor, axis=0)
            worst_joint = np.argmax(norms[count:-1])
            largest = count + int(worst_joint)
            twin = factor[:, [largest]]
            own_row[0, -2] = difference * norms[largest]
        wider = np.concatenate((factor[:, :-1], twin, factor[:, -1:]), axis=1)
        factors.append(np.concatenate((wider, own_row)))
    joints = replace(system.joints, factors=tuple(factors))
    return replace(system, joints=joints)


@pytest.mark.parametrize(("difference", "expected"), [(1e-2, ()), (1e-4, (0,))])
def test_misjudged_joints_with_a_parameter_that_hardly_shows_names_its_joint(
    small_truth: Truth, difference: float, expected: tuple[int, ...]
) -> None:
    system = _with_twin_column(_small_system(small_truth, 1, NOISE_A), difference)
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
    assert _mean_error(gains, small_truth) > 3.0 * _mean_error(tls(system).gains, small_truth)
