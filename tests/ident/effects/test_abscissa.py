"""Bases and ways: what must hold whatever the data are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from ident.effects.friction import Presliding
from ident.effects.signals import STICKING_RAD_S, curvature, distance_since_reversal
from ident.effects.unnamed import INTERVALS, cubic_basis
from tests.ident.effects.test_effects import random_signals

FloatArray = NDArray[np.float64]

_numbers = st.floats(-100.0, 100.0, allow_subnormal=False)
_speeds = arrays(
    np.float64, st.integers(2, 60), elements=st.floats(-3.0, 3.0, allow_subnormal=False)
)


@given(
    x=arrays(np.float64, st.integers(1, 50), elements=_numbers),
    lower=_numbers,
    width=st.floats(1e-3, 200.0),
)
@settings(deadline=None)
def test_splines_sum_to_one_and_are_never_negative(
    x: FloatArray, lower: float, width: float
) -> None:
    upper = lower + width
    basis = cubic_basis(x, lower, upper)
    expected = (INTERVALS + 3, len(x))
    assert basis.shape == expected
    assert basis.sum(axis=0) == pytest.approx(np.ones(len(x)))
    assert np.all(basis >= -1e-15)
    lower_upper = lower + width
    outside = cubic_basis(
        np.array([lower - 1.0, lower, lower + width, lower + width + 1.0]), lower, lower_upper
    )
    assert outside[:, 0] == pytest.approx(outside[:, 1])
    assert outside[:, 2] == pytest.approx(outside[:, 3])


@given(coefficients=arrays(np.float64, 4, elements=st.floats(-3.0, 3.0)))
@settings(deadline=None)
def test_splines_hold_every_cubic(coefficients: FloatArray) -> None:
    """And so are smooth at their knots, as cubics are."""
    x = np.linspace(-1.0, 2.0, 200)
    cubic = np.polynomial.Polynomial(coefficients)(x)
    basis = cubic_basis(x, -1.0, 2.0)
    fitted = np.linalg.lstsq(basis.T, cubic, rcond=None)[0]
    assert fitted @ basis == pytest.approx(cubic, abs=1e-9)


@given(velocity=_speeds)
@settings(deadline=None)
def test_the_way_grows_until_the_motion_turns(velocity: FloatArray) -> None:
    direction, way = distance_since_reversal(velocity, 100.0)
    turned = np.diff(direction) != 0
    assert np.all(way >= 0.0)
    assert np.all(np.diff(way)[~turned] >= -1e-12)
    assert way[1:][turned] == pytest.approx(0.0, abs=1e-12)
    unique_directions = set(np.unique(direction))
    assert unique_directions <= {-1.0, 0.0, 1.0}
    moving = np.abs(velocity) > STICKING_RAD_S
    velocity_sign = np.sign(velocity[moving])
    assert np.array_equal(direction[moving], velocity_sign)
    # Who has moved once has a direction, and keeps it at rest.
    assert np.all(direction[np.argmax(moving) :] != 0.0) or not moving.any()


@pytest.mark.slow
@given(velocity=_speeds)
@settings(deadline=None)
def test_the_way_is_the_same_in_the_other_direction(velocity: FloatArray) -> None:
    direction, way = distance_since_reversal(velocity, 100.0)
    turned_direction, turned_way = distance_since_reversal(-velocity, 100.0)
    assert turned_way == pytest.approx(way)
    assert np.array_equal(turned_direction, -direction)


@given(velocity=_speeds, distance_rad=st.floats(1e-3, 1.0))
@settings(deadline=None)
def test_a_bristle_lags_at_most_from_one_side_to_the_other(
    velocity: FloatArray, distance_rad: float
) -> None:
    """z stays within ±1, so z − sign is against the motion, and at most two."""
    assume(bool(np.any(np.abs(velocity) > STICKING_RAD_S)))
    signals = replace(random_signals(0), velocity_rad_s=velocity[None])
    (lag,) = Presliding(distance_rad).columns(signals, 0)
    direction, way = distance_since_reversal(velocity, signals.rate_hz)
    assert np.all(lag * direction <= 1e-12)
    assert np.all(np.abs(lag) <= 2.0 * np.exp(-way / distance_rad) + 1e-12)


def test_curvature_of_a_parabola_is_its_own() -> None:
    time_s = np.arange(100) / 50.0
    assert curvature(3.0 * time_s**2, 50.0)[3:-3] == pytest.approx(6.0)
