"""Geometry from redundant encoders: one wrong number is named,
and nothing else is corrected for it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy
from numpy.typing import NDArray

from ident.data.run import Run
from ident.errors import ModelError
from ident.estimators.geometry_estimate import GeometryFinding, estimate_geometry, thinned
from ident.model.geometry import (
    GeometryChange,
    GeometryKind,
    GeometryParameter,
    base_places,
    encoder_delays,
    geometry_parameters,
    model_with_geometry,
)
from tests.ident.closed_recordings import RATE_HZ, axis_positions
from tests.ident.mechanisms import FIVE_BAR, PLANAR

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
#: of a count of 2⁻¹⁶ turns of a motor behind a gear of 5, as of the shipped redundant robot
NOISE_RAD = 5e-6
PARAMETERS = geometry_parameters(PLANAR.robot)
X_OF_FIRST = GeometryParameter(GeometryKind.PLACE, "motor-0", "x")
Y_OF_SECOND = GeometryParameter(GeometryKind.PLACE, "motor-1", "y")
SECONDS = 8.0
DRAWS = 12
COUNT_RAD = 2.0 * np.pi / (65536 * 5)


@cache
def _exact(seed: int) -> FloatArray:
    """Positions of the motors that the closures allow."""
    rng = np.random.default_rng(seed)
    return axis_positions(PLANAR, rng, SECONDS)


def _run(position_rad: FloatArray) -> Run:
    time_s = np.arange(len(position_rad)) / RATE_HZ
    current_a = np.zeros_like(position_rad)
    return Run("run", time_s, position_rad, current_a)


def _noise(seed: int, shape: tuple[int, ...], correlation_s: float = 0.0) -> FloatArray:
    """Draw noise of σ = 1: white, or that decays over a time."""
    rng = np.random.default_rng(100 + seed)
    white = rng.standard_normal(shape)
    if correlation_s == 0.0:
        return white
    kept = np.exp(-1.0 / (RATE_HZ * correlation_s))
    white[1:] *= np.sqrt(1.0 - kept**2)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -kept], white, axis=0))


def _found(
    *wrong: tuple[GeometryParameter, float], position_rad: FloatArray | None = None, seed: int = 1
) -> GeometryFinding:
    """Finding with a description in which numbers are off;
    what has to be added is the negative of it.
    """
    changes = [GeometryChange(parameter, change) for parameter, change in wrong]
    if position_rad is None:
        exact = _exact(seed)
        position_rad = exact + NOISE_RAD * _noise(seed, exact.shape)
    runs = (thinned(_run(position_rad)),)
    model = model_with_geometry(PLANAR.model, changes)
    found = estimate_geometry(model, runs)
    assert found is not None
    return found


def _is_named(found: GeometryFinding, parameter: GeometryParameter, change: float) -> bool:
    """Whether one number alone explains a misfit down to the noise, with its value within 3 σ."""
    assert found.is_significant
    assert found.misfit_left == pytest.approx(found.noise, rel=0.15)
    (cause,) = found.causes
    return cause.parameter == parameter and abs(cause.change - change) < 3.0 * cause.std


@pytest.mark.parametrize("degrees", [0.05, -0.1, 0.5])
def test_a_wrong_zero_is_named(degrees: float) -> None:
    found = _found((PARAMETERS[1], np.radians(degrees)))
    assert _is_named(found, PARAMETERS[1], -np.radians(degrees))
    assert found.corrections == found.causes
    std = found.corrections[0].std
    assert std < np.radians(1e-3)
    assert found.alternatives == ()
    assert found.noise == pytest.approx(NOISE_RAD, rel=0.2)


@pytest.mark.parametrize(("number", "share"), [(4, 0.001), (5, -0.003), (9, 0.01), (10, 0.003)])
def test_a_wrong_length_is_named(number: int, share: float) -> None:
    found = _found((PARAMETERS[number], 0.28 * share))
    assert _is_named(found, PARAMETERS[number], -0.28 * share)


def test_two_wrong_numbers_are_named_together() -> None:
    found = _found((PARAMETERS[0], 2e-3), (PARAMETERS[10], -4e-4))
    expected = {PARAMETERS[0], PARAMETERS[10]}
    parameters = {one.parameter for one in found.corrections}
    assert parameters == expected
    assert found.changes[0].change == found.corrections[0].change
    assert found.covariance.shape == (2, 2)
    for one in found.corrections:
        wrong = {PARAMETERS[0]: 2e-3, PARAMETERS[10]: -4e-4}[one.parameter]
        absolute_change = abs(one.change + wrong)
        assert absolute_change < 4.0 * one.std


@pytest.mark.parametrize("parameter", [X_OF_FIRST, Y_OF_SECOND])
def test_a_motor_that_sits_elsewhere_on_the_base_is_no_zero_and_no_rod(
    parameter: GeometryParameter,
) -> None:
    found = _found((parameter, 3e-4))
    assert _is_named(found, parameter, -3e-4)
    assert found.corrections == found.causes


@pytest.mark.parametrize("delay_s", [0.001, 0.003, 0.010])
def test_a_late_encoder_is_named_and_nothing_is_corrected_for_it(delay_s: float) -> None:
    position_rad = _exact(1).copy()
    time_s = np.arange(len(position_rad)) / RATE_HZ
    on_time = scipy.interpolate.CubicSpline(time_s, position_rad[:, 1])
    position_rad[:, 1] = on_time(time_s - delay_s)
    found = _found(position_rad=position_rad + NOISE_RAD * _noise(1, position_rad.shape))
    parameter = encoder_delays(PLANAR.robot)[1]
    assert _is_named(found, parameter, delay_s)
    assert found.corrections == ()
    assert found.changes == ()


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(
    "axes", [(1.0, 0.0, -1.0, 0.5), (1.0, 0.0, 0.0, 0.0), (0.7, -0.4, 1.0, 0.2)]
)
def test_arms_that_bend_are_no_wrong_numbers(seed: int, axes: tuple[float, ...]) -> None:
    """A misfit that turns with the pose is explained by some numbers to a part,
    but not down to the noise.
    """
    exact = _exact(seed)
    bend_rad = 2e-4 * np.sin(3.0 * exact[:, [0]]) * np.array(axes)
    position_rad = exact + bend_rad + NOISE_RAD * _noise(seed, exact.shape)
    found = _found(position_rad=position_rad, seed=seed)
    assert found.is_significant
    assert found.causes == ()
    assert found.corrections == ()
    assert found.misfit > 5.0 * found.noise
    assert found.misfit_left < found.misfit


def test_more_wrong_numbers_than_three_are_not_corrected() -> None:
    rng = np.random.default_rng(5)
    wrong = [(parameter, 1e-3 * float(rng.standard_normal())) for parameter in PARAMETERS]
    found = _found(*wrong)
    assert found.is_significant
    assert found.corrections == ()
    assert found.misfit_left == pytest.approx(NOISE_RAD, rel=0.2)


def test_a_right_description_says_nothing() -> None:
    for seed in range(1, 6):
        found = _found(seed=seed)
        assert not found.is_significant
        assert found.causes == ()
        assert found.misfit == found.misfit_left


@pytest.mark.parametrize("correlation_s", [0.02, 0.1, 0.5])
def test_the_deviation_of_a_wrong_zero_contains_slow_noise(correlation_s: float) -> None:
    """Twelve draws know the root mean square to 20 %; without what slow noise does it would be
    twice as large and more.
    """
    wrong_rad = np.radians(0.1)
    scaled: list[float] = []
    for draw in range(DRAWS):
        seed = 1 + draw % 3
        exact = _exact(seed)
        noise = NOISE_RAD * _noise(draw, exact.shape, correlation_s)
        found = _found((PARAMETERS[1], wrong_rad), position_rad=exact + noise)
        (cause,) = found.causes
        assert cause.parameter == PARAMETERS[1]
        scaled.append((cause.change + wrong_rad) / cause.std)
    mean_squared_scaled = np.mean(np.square(scaled))
    assert 0.5 < np.sqrt(mean_squared_scaled) < 1.5


@pytest.mark.parametrize("correlation_s", [0.02, 0.1, 0.5])
def test_slow_noise_hides_no_wrong_zero(correlation_s: float) -> None:
    exact = _exact(1)
    noisy = exact + NOISE_RAD * _noise(1, exact.shape, correlation_s)
    found = _found((PARAMETERS[1], 1e-3), position_rad=noisy)
    (correction,) = found.corrections
    assert correction.parameter == PARAMETERS[1]
    absolute_change = abs(correction.change + 1e-3)
    assert absolute_change < 3.0 * correction.std
    assert found.noise < 0.5 * NOISE_RAD  # what neighbouring samples show of it


@pytest.mark.parametrize("share", [1.0, 0.002])
def test_rounding_to_counts_is_noise(share: float) -> None:
    """Also of axes so slow that neighbouring samples have the same count."""
    rng = np.random.default_rng(1)
    exact = axis_positions(PLANAR, rng, SECONDS, share)
    position_rad = COUNT_RAD * np.round(exact / COUNT_RAD)
    found = _found(position_rad=position_rad)
    assert not found.is_significant
    assert found.noise == pytest.approx(COUNT_RAD / np.sqrt(12.0), rel=0.15)


def test_a_count_below_what_bends_a_gain_says_nothing() -> None:
    exact = _exact(1)
    position_rad = exact + 1e-8 * _noise(1, exact.shape)
    found = _found((PARAMETERS[1], 1e-5), position_rad=position_rad)
    assert not found.is_significant


def test_encoders_that_no_pose_fits_are_refused() -> None:
    with pytest.raises(ModelError, match="motors do not fit each other"):
        _found((PARAMETERS[1], 0.2))


def test_without_redundant_encoders_or_positions_nothing_is_said() -> None:
    position_rad = np.zeros((1000, 2))
    run = _run(position_rad)
    assert estimate_geometry(FIVE_BAR.model, (thinned(run),)) is None
    runs = (thinned(_run(_exact(1)[:200])),)
    assert estimate_geometry(PLANAR.model, runs) is None
    assert estimate_geometry(PLANAR.model, (thinned(_run(_exact(1)[:4])),)) is None


def test_positions_are_thinned_where_every_axis_is_valid() -> None:
    q = np.arange(1000.0)[:, None] * np.ones(4)
    valid = np.ones(q.shape, dtype=np.bool_)
    valid[40, 2] = False
    time_s = np.arange(1000) / 500.0
    current_a = np.zeros_like(q)
    run = Run("run", time_s, q, current_a, valid=valid)
    found = thinned(run)
    # Ten samples on either side belong to a position.
    position_rad = list(found.position_rad[:4, 0])
    assert position_rad == [10.0, 20.0, 60.0, 70.0]
    before_rad = list(found.before_rad[:2, 0])
    assert before_rad == [9.0, 19.0]
    after_rad = list(found.after_rad[:2, 0])
    assert after_rad == [11.0, 21.0]
    assert np.allclose(found.motion[:, :, 0], 500.0)
    assert np.allclose(found.motion[:, :, 1:] * 0.02 ** np.arange(2, 5), 0.0, atol=1e-6)
    assert np.allclose(found.count_rad, 1.0)
    changed_run = replace(run, valid=None)
    assert len(thinned(changed_run).position_rad) == 98


def test_a_place_on_the_base_is_one_of_its_coordinates() -> None:
    assert X_OF_FIRST in base_places(PLANAR.robot)
    moved = model_with_geometry(PLANAR.model, [GeometryChange(Y_OF_SECOND, 0.002)]).robot
    before = {joint.name: joint.translation_m for joint in PLANAR.robot.joints}
    for joint in moved.joints:
        if joint.name == "motor-1":
            shift = [0.0, 0.002, 0.0]
        else:
            shift = [0.0, 0.0, 0.0]
        translation_difference_m = joint.translation_m - before[joint.name]
        assert np.allclose(translation_difference_m, shift, atol=1e-15)
