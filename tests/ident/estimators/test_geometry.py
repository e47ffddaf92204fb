"""Zeros and lengths from redundant encoders: one wrong number is named, and a right description says nothing."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.run import Run
from ident.errors import ModelError
from ident.estimators.geometry_estimate import GeometryFinding, Positions, estimate_geometry, thinned
from ident.model.geometry import GeometryChange, geometry_parameters
from ident.model.geometry_derivatives import model_with_geometry
from tests.ident.closed_recordings import axis_positions
from tests.ident.mechanisms import FIVE_BAR, PLANAR

FloatArray = NDArray[np.float64]
NOISE_RAD = 5e-6  #: of a count of 2⁻¹⁶ turns of a motor behind a gear of 5, as of the shipped redundant robot
PARAMETERS = geometry_parameters(PLANAR.robot)
SAMPLES = 120


@cache
def _exact(seed: int) -> FloatArray:
    """Positions of the motors that the closures allow, 0.1 s apart."""
    rng = np.random.default_rng(seed)
    return axis_positions(PLANAR, rng, 20.0)[::25][:SAMPLES]


def _recorded(seed: int, noise_rad: float = NOISE_RAD, bend_rad: FloatArray | float = 0.0) -> tuple[Positions, ...]:
    exact = _exact(seed)
    noise = noise_rad * np.random.default_rng(100 + seed).standard_normal(exact.shape)
    return (Positions("run", exact + noise + bend_rad, np.arange(len(exact)) // 20),)


def _described(*wrong: tuple[int, float], seed: int = 1, noise_rad: float = NOISE_RAD) -> GeometryFinding:
    """Finding with a description in which numbers are off; what has to be added is the negative of it."""
    changes = [GeometryChange(PARAMETERS[number], change) for number, change in wrong]
    found = estimate_geometry(model_with_geometry(PLANAR.model, changes), _recorded(seed, noise_rad))
    assert found is not None
    return found


@pytest.mark.parametrize("degrees", [0.05, -0.1, 0.5])
def test_a_wrong_zero_is_named(degrees: float) -> None:
    found = _described((1, np.radians(degrees)))
    (correction,) = found.corrections
    assert found.is_significant
    assert correction.parameter == PARAMETERS[1]
    assert abs(correction.change + np.radians(degrees)) < 4.0 * correction.std
    assert correction.std < np.radians(1e-3)
    assert found.alternatives == ()
    assert found.misfit > 50.0 * found.misfit_left
    assert found.misfit_left == pytest.approx(NOISE_RAD, rel=0.2)


@pytest.mark.parametrize(("number", "share"), [(4, 0.001), (5, -0.003), (9, 0.01), (10, 0.003)])
def test_a_wrong_length_is_named(number: int, share: float) -> None:
    found = _described((number, 0.28 * share))
    (correction,) = found.corrections
    assert correction.parameter == PARAMETERS[number]
    assert abs(correction.change + 0.28 * share) < 4.0 * correction.std


def test_two_wrong_numbers_are_named_together() -> None:
    found = _described((0, 2e-3), (10, -4e-4))
    assert {one.parameter for one in found.corrections} == {PARAMETERS[0], PARAMETERS[10]}
    assert found.changes[0].change == found.corrections[0].change
    assert found.covariance.shape == (2, 2)
    for one in found.corrections:
        wrong = {PARAMETERS[0]: 2e-3, PARAMETERS[10]: -4e-4}[one.parameter]
        assert abs(one.change + wrong) < 4.0 * one.std


def test_many_wrong_numbers_are_estimated_together() -> None:
    rng = np.random.default_rng(5)
    wrong = [(number, 1e-3 * float(rng.standard_normal())) for number in range(len(PARAMETERS))]
    found = _described(*wrong)
    assert len(found.corrections) == len(PARAMETERS)
    scaled = [(one.change + change) / one.std for one, (_, change) in zip(found.corrections, wrong, strict=True)]
    assert np.sqrt(np.mean(np.square(scaled))) < 2.0


def test_a_right_description_says_nothing() -> None:
    for seed in range(1, 11):
        found = _described(seed=seed)
        assert not found.is_significant
        assert found.corrections == ()
        assert found.misfit == found.misfit_left


def test_deviations_are_those_of_the_noise() -> None:
    """All numbers together: what weakly seen directions scatter is in σ."""
    scaled = []
    for seed in range(1, 5):
        scaled += [one.change / one.std for one in _described(seed=seed).every]
    assert 0.7 < np.sqrt(np.mean(np.square(scaled))) < 1.4


def test_a_count_below_what_bends_a_gain_says_nothing() -> None:
    assert not _described((1, 1e-5), noise_rad=1e-8).is_significant


def test_arms_that_bend_are_no_wrong_zero() -> None:
    """A misfit that turns with the pose is larger than noise, and is not blamed on one number."""
    bend = 2e-4 * np.sin(3.0 * _exact(2)[:, [0]]) * np.array([1.0, 0.0, -1.0, 0.5])
    found = estimate_geometry(PLANAR.model, _recorded(2, bend_rad=bend))
    assert found is not None
    assert len(found.corrections) != 1


def test_encoders_that_no_pose_fits_are_refused() -> None:
    with pytest.raises(ModelError, match="motors do not fit each other"):
        _described((1, 0.2))


def test_without_redundant_encoders_or_positions_nothing_is_said() -> None:
    positions = Positions("run", np.zeros((100, 2)), np.arange(100) // 20)
    assert estimate_geometry(FIVE_BAR.model, (positions,)) is None
    few = replace(_recorded(1)[0], position_rad=_exact(1)[:20], stretch=np.arange(20))
    assert estimate_geometry(PLANAR.model, (few,)) is None


def test_positions_are_thinned_where_every_axis_is_valid() -> None:
    q = np.arange(1000.0)[:, None] * np.ones(4)
    valid = np.ones(q.shape, dtype=np.bool_)
    valid[10, 2] = False
    run = Run("run", np.arange(1000) / 500.0, q, np.zeros_like(q), valid=valid)
    found = thinned(run)
    assert list(found.position_rad[:3, 0]) == [0.0, 20.0, 30.0]
    assert len(thinned(replace(run, valid=None)).position_rad) == 100
    assert found.stretch.max() == 0
