"""The whitened equations of the motors' currents,
against their definition and against finite differences.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ident.arrays import FloatArray
from ident.equations.currents import (
    ROWS_FOR_TRIANGLE,
    Currents,
    PreloadedCurrents,
    whitening_transform,
)
from ident.equations.triangles import Triangles

GAINS = np.array([12.0, -5.0, 3.0])
NOISE = np.array([0.1, 0.2, 0.05])
PARAMETERS = np.array([1.5, -0.5])
ROWS = 60


class Recording:
    """Currents of three motors, each with an equation of its own:
    g_i v_i = (W χ + k)_i + g_i e_i.
    """

    def __init__(self, rows: int = ROWS, noise: FloatArray = NOISE) -> None:
        rng = np.random.default_rng(4)
        self.linear = rng.normal(size=(3, rows, 2))
        self.known = rng.normal(size=(3, rows))
        # W χ + k of motor i and row r
        self.torque = np.einsum("irp,p->ir", self.linear, PARAMETERS) + self.known
        errors = noise[:, None] * rng.normal(size=(3, rows))
        self.current = self.torque / GAINS[:, None] + errors

    def motor_rows(self, motor: int) -> FloatArray:
        """[v_i | W_i | k_i] of one motor, shape (r, p + 2)."""
        return np.column_stack((self.current[motor], self.linear[motor], self.known[motor]))

    def currents(self) -> Currents:
        """All rows, not reduced."""
        rows = tuple(self.motor_rows(motor) for motor in range(3))
        triangles = Triangles(rows, np.array([len(one) for one in rows]))
        return Currents.of_motors(triangles)


@pytest.fixture
def recording() -> Recording:
    return Recording()


def test_the_residual_is_the_torque_of_the_currents_less_that_of_the_model(
    recording: Recording,
) -> None:
    residual = recording.currents().residual(GAINS, PARAMETERS)
    expected = GAINS[:, None] * recording.current - recording.torque
    assert_allclose(residual, expected.ravel(), atol=1e-12)


@pytest.mark.parametrize("rows", [ROWS_FOR_TRIANGLE // 3 - 1, 5 * ROWS_FOR_TRIANGLE])
def test_parameters_are_those_of_least_squares_for_few_and_for_many_rows(rows: int) -> None:
    currents = Recording(rows).currents()
    right = currents.drive @ GAINS - currents.known
    expected = np.linalg.lstsq(currents.linear, right, rcond=None)[0]
    assert_allclose(currents.parameters(GAINS), expected, rtol=1e-10)


def test_whitened_rows_have_the_noise_of_one(recording: Recording) -> None:
    many = Recording(4000).currents()
    residual = many.whitened(GAINS, NOISE).residual(GAINS, PARAMETERS).reshape(3, -1)
    # Four standard errors of a deviation, 1/√(2·4000).
    residual_std = residual.std(axis=1)
    assert_allclose(residual_std, 1.0, atol=0.045)


def test_the_noise_of_each_current_is_found_with_its_degrees_of_freedom(
    recording: Recording,
) -> None:
    currents = recording.currents()
    errors = recording.current - recording.torque / GAINS[:, None]
    rows_root = np.sqrt(ROWS - 5 / 3)
    expected = np.linalg.norm(errors, axis=1) / rows_root
    assert_allclose(currents.noise(GAINS, PARAMETERS, free=5), expected, rtol=1e-10)


def test_the_unit_of_the_currents_changes_no_parameter(recording: Recording) -> None:
    unit = 1e-7
    currents = recording.currents()
    in_other_unit = replace(currents, drive=unit * currents.drive)
    parameters, noise = currents.settled(GAINS, free=5)
    found, found_noise = in_other_unit.settled(GAINS / unit, free=5)
    assert_allclose(found, parameters, rtol=1e-8)
    assert_allclose(found_noise, unit * noise, rtol=1e-8)


def test_a_motor_without_rows_has_a_noise_of_one(recording: Recording) -> None:
    rows = (recording.motor_rows(0), np.empty((0, 4)), recording.motor_rows(2))
    triangles = Triangles(rows, np.array([ROWS, 0, ROWS]))
    currents = Currents.of_motors(triangles)
    noise = currents.noise(GAINS, PARAMETERS)
    assert noise[1] == 1.0
    expected = NOISE[[0, 2]]
    assert_allclose(noise[[0, 2]], expected, rtol=0.4)


def test_the_cost_is_that_of_the_likelihood(recording: Recording) -> None:
    errors = recording.current - recording.torque / GAINS[:, None]
    expected = np.sum(ROWS * np.log(np.linalg.norm(errors, axis=1)))
    cost = recording.currents().cost(GAINS, PARAMETERS, NOISE)
    assert cost == pytest.approx(expected, rel=1e-10)


def test_settled_parameters_and_noise_belong_to_each_other(recording: Recording) -> None:
    currents = recording.currents()
    parameters, noise = currents.settled(GAINS, free=2)
    again = currents.whitened(GAINS, noise).parameters(GAINS)
    assert_allclose(parameters, again, rtol=1e-8)
    expected = currents.noise(GAINS, parameters, free=2)
    assert_allclose(noise, expected, rtol=1e-8)
    assert_allclose(noise, NOISE, rtol=0.4)
    assert_allclose(parameters, PARAMETERS, atol=0.1)


def _slope(currents: Currents, motor: int) -> FloatArray:
    """Finite difference of the whitened residual to one gain, the noise held."""
    step = np.zeros(3)
    absolute_gain = abs(GAINS[motor])
    step[motor] = 1e-6 * absolute_gain
    more = currents.whitened(GAINS + step, NOISE).residual(GAINS + step, PARAMETERS)
    less = currents.whitened(GAINS - step, NOISE).residual(GAINS - step, PARAMETERS)
    return np.asarray((more - less) / (2.0 * step[motor]))


@pytest.mark.parametrize("motor", range(3))
def test_corrected_currents_are_the_slope_of_the_residual(recording: Recording, motor: int) -> None:
    currents = recording.currents()
    whitened = currents.whitened(GAINS, NOISE)
    residual = whitened.residual(GAINS, PARAMETERS)
    corrected = currents.corrected(GAINS, NOISE, whitened, residual)
    expected = _slope(currents, motor)
    largest_absolute_expected = np.abs(expected).max()
    assert_allclose(corrected[:, motor], expected, atol=1e-7 * largest_absolute_expected)


# Motors that work against each other


@pytest.fixture
def preload() -> FloatArray:
    """One direction of torques that moves nothing, another one in each row, shape (r, 3, 1)."""
    rng = np.random.default_rng(8)
    directions = rng.normal(size=(ROWS, 3, 1))
    direction_norm = np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(directions / direction_norm)


@pytest.fixture
def preloaded(recording: Recording, preload: FloatArray) -> PreloadedCurrents:
    rows = []
    for motor in range(3):
        drive = np.zeros((ROWS, 3))
        drive[:, motor] = recording.current[motor]
        stacked_drive = np.column_stack((drive, recording.linear[motor], recording.known[motor]))
        rows.append(stacked_drive)
    return PreloadedCurrents.of_rows(rows, preload)


def test_the_transform_leaves_what_the_likeliest_preload_does_not_explain(
    recording: Recording, preload: FloatArray, preloaded: PreloadedCurrents
) -> None:
    residual = preloaded.whitened(GAINS, NOISE).residual(GAINS, PARAMETERS).reshape(3, -1)
    left = GAINS[:, None] * recording.current - recording.torque
    unit = GAINS * NOISE
    for row in range(ROWS):
        amount = np.linalg.lstsq(preload[row] / unit[:, None], left[:, row] / unit, rcond=None)[0]
        expected = (left[:, row] - preload[row] @ amount) / unit
        assert_allclose(residual[:, row], expected, atol=1e-9)


def test_preload_of_any_size_leaves_no_trace(
    recording: Recording, preload: FloatArray, preloaded: PreloadedCurrents
) -> None:
    transform = whitening_transform(preload, GAINS, NOISE)
    # (T_D)_rij N_rj of each row
    left = np.einsum("rij,rjk->rik", transform, preload)
    assert_allclose(left, 0.0, atol=1e-10)
    # D T_D is a projection, because T_D = P D⁻¹ and P P = P.
    projection = transform * (GAINS * NOISE)
    assert_allclose(projection @ projection, projection, atol=1e-10)
    assert_allclose(np.trace(projection, axis1=1, axis2=2), 2.0)


def test_corrected_currents_give_the_slope_of_the_cost_with_preload(
    preloaded: PreloadedCurrents,
) -> None:
    whitened = preloaded.whitened(GAINS, NOISE)
    residual = whitened.residual(GAINS, PARAMETERS)
    gradient = preloaded.corrected(GAINS, NOISE, whitened, residual).T @ residual
    for motor in range(3):
        step = np.zeros(3)
        absolute_gain = abs(GAINS[motor])
        step[motor] = 1e-6 * absolute_gain
        more = preloaded.cost(GAINS + step, PARAMETERS, NOISE)
        less = preloaded.cost(GAINS - step, PARAMETERS, NOISE)
        expected = (more - less) / (2.0 * step[motor])
        largest_absolute_gradient = np.abs(gradient).max()
        assert gradient[motor] == pytest.approx(
            expected, rel=1e-5, abs=1e-4 * largest_absolute_gradient
        )


def test_the_cost_with_preload_is_half_the_squares(preloaded: PreloadedCurrents) -> None:
    residual = preloaded.whitened(GAINS, NOISE).residual(GAINS, PARAMETERS)
    assert preloaded.cost(GAINS, PARAMETERS, NOISE) == pytest.approx(0.5 * np.sum(residual**2))


def test_the_noise_beside_a_preload_is_found_from_what_is_visible_of_it() -> None:
    rows = 6000
    many = Recording(rows)
    rng = np.random.default_rng(9)
    directions = rng.normal(size=(rows, 3, 1))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    of_motors = []
    for motor in range(3):
        drive = np.zeros((rows, 3))
        drive[:, motor] = many.current[motor]
        stacked_drive = np.column_stack((drive, many.linear[motor], many.known[motor]))
        of_motors.append(stacked_drive)
    currents = PreloadedCurrents.of_rows(of_motors, directions)
    noise = currents.noise(GAINS, PARAMETERS)
    # A third of the noise is hidden by the preload; of 6000 rows some 4000 are seen: four standard
    # errors.
    assert_allclose(noise, NOISE, rtol=0.07)
