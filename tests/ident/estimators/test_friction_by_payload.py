"""Friction that is another one with a payload:
it does not become gain, and a calibration predicts with both.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.calibration import Calibration, Parameter, calibration_of
from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.estimators.estimate import Identification
from ident.estimators.identify import identify
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import Model
from ident.model.robot import Motion
from ident.prediction import fitted_model, predict_torque, standard_parameters
from ident.weighing import weigh
from tests.ident.recordings import (
    MOUNTED,
    PAYLOAD_TRUTH,
    Truth,
    record,
    three_axes_truth,
    tx40_truth,
)

FloatArray = NDArray[np.float64]

WARMER = 0.8  #: Friction of the warm arm in the loaded runs over that of the cold one
NOISE_A = 0.02
CONDITIONING = Conditioning()


def _warmer(truth: Truth) -> Truth:
    """The same arm with less friction."""
    parameters = truth.parameters.copy()
    parameters[truth.model.friction_columns] *= WARMER
    return replace(truth, parameters=parameters)


@pytest.fixture(scope="module")
def truth() -> Truth:
    return three_axes_truth()


@pytest.fixture(scope="module")
def runs(truth: Truth) -> tuple[Run, ...]:
    """Two runs without load, then two with it, when the arm is warm."""
    rng = np.random.default_rng(7)
    bare = [
        record(truth, f"bare{number}", rng, noise_a=NOISE_A, rate_hz=500.0, averaged=2)
        for number in range(2)
    ]
    warm = _warmer(truth)
    loaded = [
        record(warm, f"loaded{number}", rng, MOUNTED, noise_a=NOISE_A, rate_hz=500.0, averaged=2)
        for number in range(2)
    ]
    return (*bare, *loaded)


@pytest.fixture(scope="module")
def found(truth: Truth, runs: tuple[Run, ...]) -> Identification:
    model = replace(truth.model, friction_by_payload=True)
    return identify(model, runs, CONDITIONING)


@pytest.fixture(scope="module")
def calibration(truth: Truth, found: Identification) -> Calibration:
    axes = ("J1", "J2", "J3")
    return calibration_of(found, axes, truth.gains)


def _sigmas_off(found: Identification, truth: Truth) -> FloatArray:
    gain_difference = found.estimate.gains - truth.gains
    return np.abs(gain_difference) / found.estimate.gains_std


def test_friction_that_falls_before_the_payload_is_mounted_does_not_become_gain(
    truth: Truth, runs: tuple[Run, ...], found: Identification
) -> None:
    assert np.all(_sigmas_off(found, truth) < 3.0)
    shared = identify(truth.model, runs, CONDITIONING, judge=False)
    worst = np.max(np.abs(shared.estimate.gains / truth.gains - 1.0))
    assert worst > 5.0 * np.max(np.abs(found.estimate.gains / truth.gains - 1.0))


def test_what_the_payload_adds_to_friction_is_that_of_the_truth(
    truth: Truth, found: Identification
) -> None:
    names = [column.name for column in found.estimate.unknowns]
    for place in truth.model.friction_columns:
        name = f"{truth.model.columns[place].name}_loaded"
        index = names.index(name)
        added = (WARMER - 1.0) * truth.parameters[place]
        parameter_difference = abs(found.estimate.parameters[index] - added)
        assert parameter_difference < 4.0 * found.estimate.parameters_std[index]


@pytest.mark.slow
def test_it_costs_little_where_friction_stays(truth: Truth) -> None:
    rng = np.random.default_rng(8)
    runs = [
        record(truth, f"run{number}", rng, payload, noise_a=NOISE_A, rate_hz=500.0, averaged=2)
        for number, payload in enumerate((None, MOUNTED, None, MOUNTED))
    ]
    shared = identify(truth.model, runs, CONDITIONING)
    model = replace(truth.model, friction_by_payload=True)
    by_payload = identify(model, runs, CONDITIONING)
    assert np.all(_sigmas_off(by_payload, truth) < 3.5)
    assert np.all(by_payload.estimate.gains_std < 1.3 * shared.estimate.gains_std)


@pytest.mark.parametrize("payload", [None, MOUNTED])
def test_a_calibration_predicts_with_the_friction_of_what_is_mounted(
    truth: Truth, calibration: Calibration, payload: object
) -> None:
    mounted = MOUNTED if payload is not None else None
    arm = truth if mounted is None else _warmer(truth)
    rng = np.random.default_rng(9)
    run = record(arm, "new", rng, mounted, seconds=6.0, rate_hz=500.0, averaged=2)
    data = differentiate(run, truth.model.drive_train, CONDITIONING)
    if mounted is None:
        body = None
    else:
        body = np.array(list(PAYLOAD_TRUTH.values()))
    # The model of a cell: that the calibration has friction by payload is read from its parameters.
    predicted = predict_torque(calibration, truth.model, data)
    expected = arm.model.torques(data.motion(), arm.model.with_payload(arm.parameters, body))[2].T
    moving = np.abs(data.velocity_rad_s) > 0.1
    left = np.sqrt(np.mean((predicted - expected)[moving] ** 2) / np.mean(expected[moving] ** 2))
    assert left < 0.01
    other = _warmer(truth) if mounted is None else truth
    wrong = other.model.torques(data.motion(), other.model.with_payload(other.parameters, body))[
        2
    ].T
    assert (
        np.sqrt(np.mean((predicted - wrong)[moving] ** 2) / np.mean(expected[moving] ** 2)) > 0.02
    )


def test_a_model_without_it_takes_the_friction_without_load(
    truth: Truth, calibration: Calibration
) -> None:
    model = fitted_model(calibration, truth.model)
    assert model.friction_by_payload
    whole = standard_parameters(calibration, model)
    declared = standard_parameters(calibration, truth.model)
    np.testing.assert_array_equal(declared, whole[: len(declared)])
    assert np.all(whole[len(declared) :] != 0.0)


@pytest.mark.parametrize("make", [three_axes_truth, tx40_truth])
def test_the_columns_of_friction_are_there_once_more_while_a_payload_is_mounted(
    make: object,
) -> None:
    assert callable(make)
    declared: Model = make().model
    model = replace(declared, friction_by_payload=True)
    rng = np.random.default_rng(3)
    axes = model.robot.axis_count
    motion = Motion(*rng.normal(size=(3, 50, axes)))
    count = len(declared.columns)
    bare = model.regressor(motion)
    loaded = model.regressor(motion, loaded=True)
    np.testing.assert_array_equal(bare[:, :count], declared.regressor(motion))
    np.testing.assert_array_equal(loaded[:, :count], bare[:, :count])
    assert not bare[:, count:].any()
    np.testing.assert_array_equal(
        loaded[:, model.loaded_friction_columns], loaded[:, model.friction_columns]
    )
    assert not loaded[~model.support].any()
    parameters = rng.normal(size=len(model.columns))
    body = rng.normal(size=10)
    for regressor, mounted in ((bare, None), (loaded, body)):
        by_columns = np.einsum("mck,c->mk", regressor, parameters)
        if mounted is not None:
            by_columns += np.einsum("mck,c->mk", regressor[:, model.flange], body)
        standard = model.with_payload(parameters, mounted)
        np.testing.assert_allclose(
            model.torques(motion, standard)[2],
            by_columns,
            rtol=1e-9,
            atol=1e-9,
        )


def test_where_every_run_is_loaded_there_is_one_friction(truth: Truth) -> None:
    rng = np.random.default_rng(10)
    disc = Payload("disc", "a", dict(PAYLOAD_TRUTH))
    known = {name: 0.5 * value for name, value in PAYLOAD_TRUTH.items()}
    plate = Payload("plate", "b", known)
    runs = [
        record(truth, f"run{number}", rng, payload, noise_a=NOISE_A, rate_hz=500.0, averaged=2)
        for number, payload in enumerate((disc, plate))
    ]
    by_payload = replace(truth.model, friction_by_payload=True)
    gains = truth.gains
    shared = identify(truth.model, runs, CONDITIONING, fixed_gains=gains, judge=False)
    found = identify(by_payload, runs, CONDITIONING, fixed_gains=gains, judge=False)
    assert found.estimate.unknowns == shared.estimate.unknowns
    np.testing.assert_allclose(
        found.estimate.parameters, shared.estimate.parameters, rtol=1e-9, atol=1e-9
    )


def test_a_mounting_of_any_name_is_no_friction() -> None:
    assert Parameter("fs1_loaded", 0.1, 0.1, "Nm").is_payload_friction
    assert not Parameter("mx:grip_loaded", 0.1, 0.1, "kg m").is_payload_friction
    assert not Parameter("fs1", 0.1, 0.1, "Nm").is_payload_friction


def test_a_body_is_weighed_beside_bare_runs_of_another_friction(
    truth: Truth, calibration: Calibration
) -> None:
    rng = np.random.default_rng(13)
    model = replace(truth.model, friction_by_payload=True)
    bare = record(truth, "bare", rng, noise_a=NOISE_A, rate_hz=500.0, averaged=2)
    loaded = record(
        _warmer(truth), "loaded", rng, MOUNTED, noise_a=NOISE_A, rate_hz=500.0, averaged=2
    )
    mass = list(LINK_PARAMETERS).index("m")
    weighed = weigh(calibration, model, (loaded,), CONDITIONING, bare=(bare,))
    one_friction = weigh(calibration, truth.model, (loaded,), CONDITIONING, bare=(bare,))
    mass_error_kg = weighed.values[mass] - PAYLOAD_TRUTH["m"]
    error_kg = abs(mass_error_kg)
    assert error_kg < 3.0 * weighed.std[mass]
    assert weighed.std[mass] < 0.3 * one_friction.std[mass]
