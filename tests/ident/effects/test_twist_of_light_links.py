"""A link with little or no inertia behind a gear that is not rigid."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from ident.arrays import FloatArray
from ident.effects.twist import LEAST_SHARE, DrivenLink, Gears, twists

RATE_HZ = 500.0
SAMPLES = 600
GEARS = Gears(np.zeros(1), np.array([1e-4]), 0.3)


def _link(inertia_kg_m2: FloatArray) -> DrivenLink:
    time_s = np.arange(SAMPLES) / RATE_HZ
    speed = 0.5 + 0.2 * np.sin(2.0 * np.pi * 0.5 * time_s)
    torque = 5.0 + np.sin(2.0 * np.pi * 0.5 * time_s)
    dry_nm = np.zeros(SAMPLES)
    return DrivenLink(RATE_HZ, inertia_kg_m2, torque, speed, dry_nm)


def test_a_link_without_inertia_does_not_lag() -> None:
    link = _link(np.zeros(SAMPLES))
    found = twists(link, GEARS)
    assert not found.twist_rad.any()
    assert_allclose(found.passed_nm[0], link.pushed_nm)


def test_the_gear_of_a_link_in_motion_is_a_spring_under_its_torque() -> None:
    inertia_kg_m2 = np.full(SAMPLES, 0.2)
    found = twists(_link(inertia_kg_m2), GEARS)
    inside = slice(100, -100)
    # δ = c τ, since the torque changes slowly beside the resonance.
    pushed_nm = _link(np.full(SAMPLES, 0.2)).pushed_nm
    expected = 1e-4 * pushed_nm
    assert_allclose(found.twist_rad[0, inside], expected[inside], rtol=0.02)


def test_an_inertia_that_is_none_counts_as_a_small_one_and_a_real_one_as_it_is() -> None:
    inertia = np.full(SAMPLES, 0.2)
    negative = inertia.copy()
    negative[300] = -0.1
    smallest = inertia.copy()
    mean_negative = float(np.mean(negative))
    smallest[300] = LEAST_SHARE * mean_negative
    assert_allclose(
        twists(_link(negative), GEARS).passed_nm,
        twists(_link(smallest), GEARS).passed_nm,
        rtol=1e-6,
    )
    link = _link(2.0 * inertia)
    heavier = twists(link, GEARS).twist_rad
    assert np.isfinite(heavier).all()
    twist_rad = twists(_link(inertia), GEARS).twist_rad
    heavier_difference = heavier - twist_rad
    assert np.abs(heavier_difference).max() > 0.0


def test_gears_that_are_followed_together_lag_as_each_of_them_alone() -> None:
    """One of them writes over what was known around its windows, and over nothing else."""
    time_s = np.arange(SAMPLES) / RATE_HZ
    speed = np.sin(2.0 * np.pi * time_s)
    torque = 4.0 * np.sin(2.0 * np.pi * time_s + 0.4)
    inertia_kg_m2 = np.full(SAMPLES, 0.2)
    dry_nm = np.zeros(SAMPLES)
    link = DrivenLink(RATE_HZ, inertia_kg_m2, torque, speed, dry_nm)
    before = link.pushed_nm.copy()
    gaps_rad = np.array([0.0, 5e-4, 2e-3])
    compliance_rad_nm = np.full(3, 1e-4)
    together = twists(link, Gears(gaps_rad, compliance_rad_nm, 0.2))
    assert np.array_equal(link.pushed_nm, before)
    for index in range(1, len(gaps_rad)):  # a gear without a gap has windows of its own
        half_gap_rad = gaps_rad[[index]]
        gears = Gears(half_gap_rad, np.array([1e-4]), 0.2)
        alone = twists(link, gears)
        assert_allclose(together.twist_rad[index], alone.twist_rad[0], rtol=1e-9, atol=1e-12)
        assert_allclose(together.passed_nm[index], alone.passed_nm[0], rtol=1e-9, atol=1e-9)
        assert_allclose(
            together.acceleration_rad_s2[index], alone.acceleration_rad_s2[0], rtol=1e-9, atol=1e-9
        )
    # A link behind a gap is further from its motor than its spring alone allows.
    absolute_twist_rad = np.abs(together.twist_rad[2])
    largest_absolute_twist_rad = absolute_twist_rad.max()
    assert np.all(largest_absolute_twist_rad > np.abs(together.twist_rad[0]).max())
