"""Gains and parameters of closed chains: exact recordings, noise, internal preload."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ident.arrays import FloatArray
from ident.data.dataset import Dataset, differentiate
from ident.equations.currents import PreloadedCurrents, whitening_transform
from ident.equations.linearisation import linearise
from ident.equations.observation import Observation, observe
from ident.equations.rows import decimate_rows
from ident.errors import DataUnfit
from ident.estimators.estimate import Identification
from ident.estimators.identify import identify
from ident.estimators.least_squares import Scaling, tls
from ident.estimators.maximum_likelihood import iv
from ident.estimators.method import Method
from ident.model.model import Column
from tests.ident.closed_recordings import Made, recorded
from tests.ident.mechanisms import FIVE_BAR, MECHANISMS, PLANAR, Mechanism

pytestmark = pytest.mark.slow

SEEDS = range(10, 15)
NOISE_A = 0.03


def _made(name: str) -> Made:
    mechanism = next(one for one in MECHANISMS if one.name == name)
    return recorded(mechanism)


@cache
def _fitted(name: str) -> Identification:
    made = _made(name)
    return identify(made.model, made.runs, made.conditioning, keep_rows=True)


def _gathered(found: Identification) -> tuple[tuple[Dataset, ...], Observation]:
    """Datasets and rows of a fit."""
    assert found.gathered is not None
    return found.gathered


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
@pytest.mark.parametrize("method", [Method.ML, Method.WLS, Method.LS])
def test_exact_recordings_give_the_gains_back(mechanism: Mechanism, method: Method) -> None:
    made = _made(mechanism.name)
    found = identify(made.model, made.runs, made.conditioning, method=method)
    assert found.estimate.gains == pytest.approx(mechanism.gains, rel=1e-6)
    assert found.training_error.total < 1e-6


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_parameters_are_those_of_the_base_grouping(mechanism: Mechanism) -> None:
    found = _fitted(mechanism.name)
    standard = _made(mechanism.name).standard
    expected = found.system.base.grouping @ standard
    own = found.estimate.parameters[: len(expected)]
    assert own == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_five_bar_has_the_base_parameters_of_the_paper_and_pencil() -> None:
    """A plane needs 3 of each link (Izz, mx, my); one of a closed loop's mx is regrouped;
    3 of each drive.
    """
    names = _fitted(FIVE_BAR.name).system.base.names
    of_links = [name for name in names if name.startswith(("Izz", "mx", "my"))]
    assert len(of_links) == 4 * 3 - 1
    assert len(names) == 4 * 3 - 1 + 2 * 3


def test_noise_does_not_bend_the_gains_of_a_preloaded_drive() -> None:
    """Least squares loses a share of every gain to the noise of its own columns;
    corrected currents do not.
    """
    errors = []
    deviations = []
    noises = []
    for seed in SEEDS:
        made = recorded(PLANAR, seed, seconds=12.0, noise_a=NOISE_A)
        found = identify(made.model, made.runs, made.conditioning).estimate
        errors.append(found.gains / PLANAR.gains - 1.0)
        deviations.append(found.gains_std / np.abs(PLANAR.gains))
        noises.append(found.axis_noise)
    mean_error = np.mean(errors, axis=0)
    std_of_mean = np.mean(deviations, axis=0) / np.sqrt(len(SEEDS))
    assert np.all(np.abs(mean_error) < 3.5 * std_of_mean)
    measured = np.sqrt(np.mean(np.square(errors)))
    claimed = np.sqrt(np.mean(np.square(deviations)))
    assert 0.5 < measured / claimed < 1.5
    # White noise behind the decimation: each motor shows the same share of it.
    noise_of_motors = np.mean(noises, axis=0)
    assert noise_of_motors == pytest.approx(np.full(4, np.mean(noises)), rel=0.06)


def test_tls_of_a_redundant_robot_has_residual_weights() -> None:
    system = _fitted(PLANAR.name).system
    assert system.model.is_redundant
    by_residuals = tls(system, Scaling.RESIDUALS)
    assert tls(system).gains == pytest.approx(by_residuals.gains, rel=1e-12)


def test_what_the_preload_hides_is_taken_out_exactly() -> None:
    rng = np.random.default_rng(1)
    preload, _ = np.linalg.qr(rng.normal(size=(30, 4, 1)))
    gains = np.array([2.0, -1.5, 1.8, 2.2])
    noise = np.array([0.02, 0.05, 0.01, 0.03])
    transform = whitening_transform(preload, gains, noise)
    assert np.max(np.abs(transform @ preload)) < 1e-10
    # ‖T y‖² is yᵀA (AᵀD²A)⁻¹ Aᵀy, with A the complement of N and D of gains times noise.
    basis, _ = np.linalg.qr(preload, mode="complete")
    complement = basis[:, :, 1:]
    scaled = complement * (gains * noise)[None, :, None]
    y = rng.normal(size=(30, 4, 1))
    seen = _transposed(complement) @ y
    weighted = np.linalg.solve(_transposed(scaled) @ scaled, seen)
    expected = _transposed(seen) @ weighted
    squares = np.sum((transform @ y) ** 2, axis=(1, 2))
    assert squares == pytest.approx(expected[:, 0, 0], rel=1e-9)


def _transposed(matrices: FloatArray) -> FloatArray:
    """Transposes of a stack of matrices."""
    return np.swapaxes(matrices, 1, 2)


def test_the_gain_columns_are_derivatives() -> None:
    """The least e(g)ᵀe(g) over all preloads, at given σ, falls as they say."""
    made = recorded(PLANAR, noise_a=NOISE_A)
    system = identify(made.model, made.runs, made.conditioning).system
    currents = system.currents
    assert isinstance(currents, PreloadedCurrents)
    noise = np.array([0.01, 0.02, 0.012, 0.015])
    gains = PLANAR.gains * np.array([1.01, 0.98, 1.0, 1.02])
    whitened = currents.whitened(gains, noise)
    parameters = whitened.parameters(gains)
    residual = whitened.residual(gains, parameters)
    slope = 2.0 * currents.corrected(gains, noise, whitened, residual).T @ residual
    step = 1e-6
    for motor in range(4):
        change = step * np.eye(4)[motor]
        ahead = 2.0 * currents.cost(gains + change, parameters, noise)
        behind = 2.0 * currents.cost(gains - change, parameters, noise)
        difference = (ahead - behind) / (2.0 * step)
        assert slope[motor] == pytest.approx(difference, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_rows_and_triangles_are_the_same_equations(mechanism: Mechanism) -> None:
    found = _fitted(mechanism.name)
    made = _made(mechanism.name)
    datasets, rows = _gathered(found)
    assert len(datasets) == 2
    runs = [differentiate(run, made.model.drive_train, made.conditioning) for run in made.runs]
    again = observe(made.model, runs, made.conditioning, found.system)
    assert again.regressor == pytest.approx(rows.regressor)

    system = rows.system()
    estimate = found.estimate
    assert estimate.relative_error(system).total < 1e-6
    noise = np.ones(mechanism.model.robot.axis_count)
    wrong_gains = estimate.gains * 1.1
    cost = system.currents.cost(wrong_gains, estimate.parameters, noise)
    expected = found.system.currents.cost(wrong_gains, estimate.parameters, noise)
    assert cost == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_torques_are_whitened_as_the_columns_of_the_jacobian(mechanism: Mechanism) -> None:
    found = _fitted(mechanism.name)
    to_motor = _made(mechanism.name).model.drive_train.to_motor
    _, rows = _gathered(found)
    estimate = found.estimate
    noise = np.ones(mechanism.model.robot.axis_count)
    problem = linearise(rows, estimate.gains, estimate.parameters, noise, gains_fixed=False)
    jacobian = problem.jacobian
    columns = np.zeros((jacobian.width, len(problem.residual)))
    for motor, (part, used) in enumerate(zip(jacobian.parts, jacobian.seen, strict=True)):
        columns[used, problem.rows_of(motor)] = part
    gain_count = found.system.axis_count
    first_two = slice(gain_count, gain_count + 2)  # parameters
    expected = columns[first_two] / problem.scale[first_two, None]
    whitened = problem.whitened(rows.regressor[:, :2], to_motor)
    assert whitened == pytest.approx(expected.T, abs=1e-9)


def test_what_preload_hides_of_an_effect_is_in_no_row() -> None:
    """A torque of one motor alone is seen at all of them:
    the part that works against the others is not.
    """
    found = _fitted(PLANAR.name)
    made = _made(PLANAR.name)
    datasets, rows_without = _gathered(found)
    motor = 1
    torques_nm = [np.abs(data.velocity_rad_s[:, motor]) for data in datasets]
    runs = []
    for run, torque_nm in zip(made.runs, torques_nm, strict=True):
        current_a = run.current_a.copy()
        current_a[:, motor] += _padded(torque_nm) / PLANAR.gains[motor]
        runs.append(replace(run, current_a=current_a))
    with_effect = [differentiate(run, made.model.drive_train, made.conditioning) for run in runs]
    rows = observe(made.model, with_effect, made.conditioning, found.system)

    decimated = [
        decimate_rows(data, made.conditioning, torque_nm)
        for data, torque_nm in zip(datasets, torques_nm, strict=True)
    ]
    torque_rows = np.concatenate(decimated)
    alone = np.zeros((4, 1, len(torque_rows)))
    alone[motor, 0] = torque_rows
    seen = rows.extended((Column("effect", "Nm"),), alone).effects
    added = rows.torque(PLANAR.gains) - rows_without.torque(PLANAR.gains)
    used = rows.use[0]
    size = np.linalg.norm(added[:, used])
    # A turns within a row's window, so that the filter leaves a little.
    unexplained = (added - seen[:, 0])[:, used]
    assert np.linalg.norm(unexplained) < 0.02 * size
    unexplained_alone = (added - alone[:, 0])[:, used]
    assert np.linalg.norm(unexplained_alone) > 0.3 * size


def _padded(inner: FloatArray) -> FloatArray:
    """A signal at all samples of a run: differences leave out the first and the last."""
    return np.pad(inner, (1, 1))


def test_instruments_need_an_equation_a_motor() -> None:
    with pytest.raises(DataUnfit, match="more motors than degrees of freedom"):
        iv(_fitted(PLANAR.name).system)
