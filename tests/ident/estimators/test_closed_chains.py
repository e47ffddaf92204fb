"""Gains and parameters of closed chains: exact recordings, noise, internal preload."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ident.arrays import FloatArray
from ident.data.dataset import differentiate
from ident.equations.currents import PreloadedCurrents, whitening_transform
from ident.equations.linearisation import linearise
from ident.equations.observation import observe
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
    expected = 4 * 3 - 1 + 2 * 3
    assert len(names) == expected
    assert sum(name.startswith(("Izz", "mx", "my")) for name in names) == 11


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
        absolute_gain = np.abs(PLANAR.gains)
        deviations.append(found.gains_std / absolute_gain)
        noises.append(found.axis_noise)
    mean = np.mean(errors, axis=0)
    expected = np.mean(deviations, axis=0)
    seed_count_root = np.sqrt(len(SEEDS))
    assert np.all(np.abs(mean) < 3.5 * expected / seed_count_root)
    mean_squared_deviation = np.mean(np.square(deviations))
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) / np.sqrt(mean_squared_deviation) < 1.5
    # White noise behind the decimation: each motor shows the same share of it.
    mean_noise = np.mean(noises, axis=0)
    assert mean_noise == pytest.approx(np.full(4, np.mean(noises)), rel=0.06)


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
    # ‖T y‖² is yᵀA (AᵀD²A)⁻¹ Aᵀy, with A the complement of N.
    complement = np.linalg.qr(preload, mode="complete")[0][:, :, 1:]
    scaled = complement * (gains * noise)[None, :, None]
    y = rng.normal(size=(30, 4, 1))
    seen = np.swapaxes(complement, 1, 2) @ y
    expected = np.swapaxes(seen, 1, 2) @ np.linalg.solve(np.swapaxes(scaled, 1, 2) @ scaled, seen)
    assert np.sum((transform @ y) ** 2, axis=(1, 2)) == pytest.approx(expected[:, 0, 0], rel=1e-9)


def test_the_gain_columns_are_derivatives() -> None:
    """The least e(g)ᵀe(g) over all preloads, at given σ, falls as they say."""
    made = recorded(PLANAR, noise_a=NOISE_A)
    system = identify(made.model, made.runs, made.conditioning).system
    currents = system.currents
    assert isinstance(currents, PreloadedCurrents)
    noise = np.array([0.01, 0.02, 0.012, 0.015])
    gains = PLANAR.gains * np.array([1.01, 0.98, 1.0, 1.02])
    parameters = currents.whitened(gains, noise).parameters(gains)
    whitened = currents.whitened(gains, noise)
    residual = whitened.residual(gains, parameters)
    slope = 2.0 * currents.corrected(gains, noise, whitened, residual).T @ residual
    for motor in range(4):
        step = 1e-6 * np.eye(4)[motor]
        ahead, behind = (
            2.0 * currents.cost(gains + sign * step, parameters, noise) for sign in (1, -1)
        )
        assert slope[motor] == pytest.approx((ahead - behind) / 2e-6, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda one: one.name)
def test_rows_and_triangles_are_the_same_equations(mechanism: Mechanism) -> None:
    found = _fitted(mechanism.name)
    made = _made(mechanism.name)
    assert found.gathered is not None
    datasets, rows = found.gathered
    runs = [differentiate(run, made.model.drive_train, made.conditioning) for run in made.runs]
    again = observe(made.model, runs,
                    made.conditioning, found.system)  # fmt: skip
    assert again.regressor == pytest.approx(rows.regressor)
    system = rows.system()
    estimate = found.estimate
    assert estimate.relative_error(system).total < 1e-6
    ones = np.ones(mechanism.model.robot.axis_count)
    assert system.currents.cost(estimate.gains * 1.1, estimate.parameters, ones) == pytest.approx(
        found.system.currents.cost(estimate.gains * 1.1, estimate.parameters, ones), rel=1e-6
    )
    problem = linearise(rows, estimate.gains, estimate.parameters, ones, gains_fixed=False)
    torque = rows.regressor[:, :2]
    seen = problem.whitened(torque, made.model.drive_train.to_motor)
    first = found.system.axis_count
    direct = np.zeros((problem.jacobian.width, len(problem.residual)))
    for motor, (part, held) in enumerate(
        zip(problem.jacobian.parts, problem.jacobian.seen, strict=True)
    ):
        direct[held, problem.rows_of(motor)] = part
    assert seen == pytest.approx(
        (direct[first : first + 2] / problem.scale[first : first + 2, None]).T, abs=1e-9
    )
    assert len(datasets) == 2


def test_what_preload_hides_of_an_effect_is_in_no_row() -> None:
    """A torque of one motor alone is seen at all of them:
    the part that works against the others is not.
    """
    found = _fitted(PLANAR.name)
    made = _made(PLANAR.name)
    assert found.gathered is not None
    data, _ = found.gathered
    per_unit = [
        decimate_rows(one, made.conditioning, np.abs(one.velocity_rad_s[:, 1])) for one in data
    ]
    alone = np.zeros((4, 1, sum(map(len, per_unit))))
    alone[1, 0] = np.concatenate(per_unit)
    with_effect = [
        replace(
            run,
            current_a=run.current_a
            + _padded(np.abs(one.velocity_rad_s) * [0, 1, 0, 0] / PLANAR.gains),
        )
        for run, one in zip(made.runs, data, strict=True)
    ]
    again = [differentiate(run, made.model.drive_train, made.conditioning) for run in with_effect]
    rows = observe(made.model, again, made.conditioning, found.system)
    columns = (Column("effect", "Nm"),)
    seen = rows.extended(columns, alone).effects
    added = rows.torque(PLANAR.gains) - found.gathered[1].torque(PLANAR.gains)
    used = rows.use[0]
    # A turns within a row's window, so that the filter leaves a little.
    added_norm = np.linalg.norm((added - seen[:, 0])[:, used])
    assert added_norm < 0.02 * np.linalg.norm(added[:, used])
    added_difference = added - alone[:, 0]
    added_difference_norm = np.linalg.norm(added_difference[:, used])
    assert added_difference_norm > 0.3 * np.linalg.norm(added[:, used])


def _padded(inner: FloatArray) -> FloatArray:
    """At all samples of a run: differences leave out the first and the last."""
    return np.pad(inner, ((1, 1), (0, 0)))


def test_instruments_need_an_equation_a_motor() -> None:
    with pytest.raises(DataUnfit, match="more motors than degrees of freedom"):
        iv(_fitted(PLANAR.name).system)
