"""Noise floor: a known noise is recovered, whatever the axis does at rest; without data there is no floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.data.conditioning import decimator
from ident.data.dataset import Dataset, differentiate
from ident.discovery.noise_floor import NoiseFloor, noise_floors
from tests.ident.recordings import CONDITIONING, Truth, record

FloatArray = NDArray[np.float64]

NOISE_A = np.array([0.3, 0.1, 0.05, 0.2, 0.4, 0.02])
DEVIATIONS = 4.0
"""Limit in σ of the estimate itself, by its std_percent: one of six motors is outside by chance in 2600 runs."""


def _resting(truth: Truth, runs: int = 3) -> tuple[Dataset, ...]:
    """Noiseless runs whose current bends slowly while a motor rests, as that of an integrator does."""
    rng = np.random.default_rng(8)
    made = []
    for number in range(runs):
        data = differentiate(record(truth, f"run{number}", rng, seconds=22.0), truth.model.drive_train, CONDITIONING)
        current = data.current_a.copy()
        for motor, still in enumerate(~data.motor_moving.T):
            for part in _parts(still):
                t = np.linspace(-1.0, 1.0, part.stop - part.start)
                current[part, motor] = rng.normal() + rng.normal() * t + 0.3 * rng.normal() * t**2
        made.append(replace(data, current_a=current))
    return tuple(made)


def _parts(still: NDArray[np.bool_]) -> list[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate(([0], still.astype(np.int8), [0]))))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _noisy(runs: tuple[Dataset, ...], seed: int = 5) -> tuple[Dataset, ...]:
    rng = np.random.default_rng(seed)
    return tuple(
        replace(data, current_a=data.current_a + NOISE_A * rng.standard_normal(data.current_a.shape)) for data in runs
    )


@pytest.fixture(scope="module")
def resting(truth: Truth) -> tuple[Dataset, ...]:
    return _resting(truth)


def _all(floors: tuple[NoiseFloor | None, ...]) -> tuple[NoiseFloor, ...]:
    known = tuple(floor for floor in floors if floor is not None)
    assert len(known) == len(floors)
    return known


def _expected_a(data: Dataset) -> FloatArray:
    """σ of a filtered row of white noise."""
    taps = decimator(data.rate_hz, CONDITIONING.decimation_cutoff_hz).taps
    return np.asarray(NOISE_A * np.linalg.norm(taps))


def test_a_known_noise_comes_back(resting: tuple[Dataset, ...]) -> None:
    floors = _all(noise_floors(_noisy(resting), CONDITIONING))
    for floor, expected in zip(floors, _expected_a(resting[0]), strict=True):
        assert floor.noise_a == pytest.approx(expected, rel=DEVIATIONS * floor.std_percent / 100.0)
        assert floor.std_percent < 20.0


def test_the_estimates_scatter_as_they_say_and_are_not_biased(resting: tuple[Dataset, ...]) -> None:
    drawn = [_all(noise_floors(_noisy(resting, seed), CONDITIONING)) for seed in range(20)]
    relative = np.array([[floor.noise_a for floor in floors] for floors in drawn]) / _expected_a(resting[0])
    reported = np.mean([floor.std_percent for floor in drawn[0]]) / 100.0
    # 120 estimates: their mean is known to std_percent/√120, their scatter to 1/√240 of itself; three of those.
    assert relative.mean() == pytest.approx(1.0, abs=3.0 * reported / np.sqrt(relative.size) + 0.01)
    assert relative.std() == pytest.approx(reported, rel=0.25)


def test_slips_in_some_dwells_do_not_become_the_noise(resting: tuple[Dataset, ...]) -> None:
    """A quarter of the dwells spoilt moves the median to a higher quantile; a mean would follow the steps' size."""
    slipping = []
    for data in _noisy(resting):
        current = data.current_a.copy()
        for motor, still in enumerate(~data.motor_moving.T):
            for part in _parts(still)[::4]:
                current[(part.start + part.stop) // 2 : part.stop, motor] += 200.0 * NOISE_A[motor]
        slipping.append(replace(data, current_a=current))
    for floor, expected in zip(_all(noise_floors(slipping, CONDITIONING)), _expected_a(resting[0]), strict=True):
        assert floor.noise_a < 2.0 * expected


def test_what_moves_or_is_invalid_has_no_say(resting: tuple[Dataset, ...]) -> None:
    noisy = _noisy(resting)
    elsewhere = [
        replace(data, current_a=np.where(data.motor_moving, 99.0 * data.current_a, data.current_a)) for data in noisy
    ]
    assert noise_floors(elsewhere, CONDITIONING) == noise_floors(noisy, CONDITIONING)
    unseen = [replace(data, valid=np.zeros_like(data.valid)) for data in noisy]
    assert noise_floors(unseen, CONDITIONING) == (None,) * 6


def test_too_few_dwells_and_a_drive_that_reports_a_constant_report_nothing(resting: tuple[Dataset, ...]) -> None:
    (first, *_) = _noisy(resting)
    short = slice(0, 6000)
    cut = replace(
        first,
        time_s=first.time_s[short],
        current_a=first.current_a[short],
        motor_moving=first.motor_moving[short],
        valid=first.valid[short],
    )
    assert noise_floors((cut,), CONDITIONING) == (None,) * 6
    switched_off = [replace(data, current_a=np.zeros_like(data.current_a)) for data in resting]
    assert noise_floors(switched_off, CONDITIONING) == (None,) * 6
    always_moving = [replace(data, motor_moving=np.ones_like(data.motor_moving)) for data in resting]
    assert noise_floors(always_moving, CONDITIONING) == (None,) * 6


@settings(max_examples=20, deadline=None)
@given(factor=st.floats(0.01, 100.0), offset=st.floats(-10.0, 10.0))
def test_it_has_the_unit_of_the_current_and_no_offset(
    resting: tuple[Dataset, ...], factor: float, offset: float
) -> None:
    noisy = _noisy(resting[:2])
    floors = _all(noise_floors(noisy, CONDITIONING))
    scaled = [replace(data, current_a=factor * (data.current_a + offset)) for data in noisy]
    for one, other in zip(floors, _all(noise_floors(scaled, CONDITIONING)), strict=True):
        assert other.noise_a == pytest.approx(factor * one.noise_a, rel=1e-6)
        assert (other.dwells, other.freedom) == (one.dwells, one.freedom)
