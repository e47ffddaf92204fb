"""The slope of a controller's own torque over the current:
its value, its σ, and where there is none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.data.torque_channel import TorqueChannel, torque_slope

SLOPE = -9.3
RATE_HZ = 20.0


def channel(
    rng: np.random.Generator,
    seconds: float = 30.0,
    offset_nm: float = 0.4,
    noise_nm: float = 0.5,
    noise_a: float = 0.2,
) -> TorqueChannel:
    """Noise of the torque that is correlated, as behind a filter, and noise of the current,
    6 % of its square.
    """
    count = round(seconds * RATE_HZ)
    time_s = np.arange(count) / RATE_HZ
    true_a = np.sin(2.0 * np.pi * time_s / 3.0 + rng.uniform(0.0, 6.0)) + 0.3 * rng.standard_normal(
        count
    )
    current_a, nearby_a = true_a + noise_a * rng.standard_normal((2, count))
    noise = np.convolve(rng.standard_normal(count + 1), (noise_nm, noise_nm), "valid")
    torque_nm = SLOPE * true_a + offset_nm + noise
    return TorqueChannel(time_s, current_a, nearby_a, torque_nm)


def test_the_slope_is_within_its_sigma_and_offsets_of_runs_do_not_matter() -> None:
    rng = np.random.default_rng(0)
    found = [torque_slope([channel(rng), channel(rng, offset_nm=-20.0)]) for _ in range(200)]
    slopes = [slope for slope in found if slope is not None]
    expected = [1200] * 200
    assert [slope.readings for slope in slopes] == expected
    largest_std = max(slope.std for slope in slopes)
    assert largest_std < 0.15
    # 200 draws know a deviation to 5 %, and a mean to 7 % of one; least squares is 6 % too small,
    # many σ.
    misses = [(slope.value - SLOPE) / slope.std for slope in slopes]
    assert 0.85 < np.std(misses) < 1.15
    assert abs(np.mean(misses)) < 0.2


@pytest.mark.parametrize("seconds", [0.05, 0.1, 3.9])
def test_a_few_readings_have_no_slope(seconds: float) -> None:
    rng = np.random.default_rng(1)
    channels = [channel(rng, seconds)]
    assert torque_slope(channels) is None


def test_a_constant_current_has_no_slope() -> None:
    rng = np.random.default_rng(2)
    made = channel(rng)
    current_a = 3.0 + 0.01 * made.current_a
    held = replace(made, current_a=current_a)
    assert torque_slope([held]) is None


def test_a_constant_torque_has_no_slope() -> None:
    rng = np.random.default_rng(2)
    made = channel(rng)
    torque_nm = np.full_like(made.torque_nm, 3.0)
    channels = [replace(made, torque_nm=torque_nm)]
    assert torque_slope(channels) is None
