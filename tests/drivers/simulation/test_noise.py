"""Coloured noise, and the torque disturbance inside the control loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.simulation.amplifier import AmplifierSet
from drivers.simulation.noise import ColouredNoise, random_streams
from drivers.simulation.plant import Plant
from drivers.simulation.spec import CellSpec
from tests.drivers.simulation.cells import FloatArray, clean_cell

STEP_S = 0.25e-3
PERCENT = np.array([3.0, 8.0, 5.0, 10.0, 4.0, 6.0])


def disturbed(percent: FloatArray, correlation_s: float, seed: int = 1) -> CellSpec:
    """The clean cell without friction, which would hold a resting joint against the disturbance."""
    spec = clean_cell()
    axes = tuple(
        replace(
            axis,
            coulomb_nm=0.0,
            motor_coulomb_nm=0.0,
            torque_disturbance_percent=float(one),
            disturbance_correlation_s=correlation_s,
        )
        for axis, one in zip(spec.axes, percent, strict=True)
    )
    return replace(spec, axes=axes, seed=seed)


def hold(spec: CellSpec, steps: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Hold the start position; return disturbance [Nm], current [A] and motor angle [rad],
    shape (steps, 6) each.
    """
    plant = Plant(spec)
    amplifiers = AmplifierSet(spec, plant)
    closed = np.zeros(6, dtype=np.bool_)
    plant.set_brakes(closed)
    amplifiers.loops["enabled"] = 1
    disturbance_nm, current_a, motor_rad = (np.empty((steps, 6)) for _ in range(3))
    for k in range(steps):
        plant.step(amplifiers.loops["current_a"])
        amplifiers.control(plant.motor_rad)
        disturbance_nm[k], current_a[k] = plant.disturbance_nm, amplifiers.loops["current_a"]
        motor_rad[k] = plant.motor_rad
    return disturbance_nm, current_a, motor_rad


@given(
    sigma=st.floats(0.01, 30.0),
    correlation_s=st.sampled_from([0.0, 0.002, 0.01, 0.05]),
    seed=st.integers(0, 99),
)
@settings(max_examples=5)
def test_coloured_noise_has_its_deviation_and_its_correlation_from_the_first_value_on(
    sigma: float, correlation_s: float, seed: int
) -> None:
    n = 600
    streams = random_streams(seed, n, 7)
    noise = ColouredNoise(streams, np.full(n, sigma), np.full(n, correlation_s), STEP_S)
    values = [noise.value, *(noise.advance() for _ in range(8))]
    for lag in (0, 1, 8):
        if correlation_s:
            expected = np.exp(-lag * STEP_S / correlation_s)
        else:
            expected = float(lag == 0)
        found = np.mean(values[0] * values[lag]) / sigma**2
        assert found == pytest.approx(expected, abs=5.0 * np.sqrt(2.0 / n))


def test_the_disturbance_is_a_share_of_the_rated_torque_with_its_correlation_time() -> None:
    spec = disturbed(PERCENT, 0.002)
    plant = Plant(spec)
    if plant._disturbance:
        values = np.array([plant._disturbance.advance() for _ in range(40_000)])
    else:
        values = np.zeros((1, 6))
    rated_nm = np.array([abs(axis.gain_nm_per_a) * axis.rated_current_a for axis in spec.axes])
    # 10 s are 2 500 independent values of a correlation time of 2 ms.
    actual = values.std(axis=0) / rated_nm
    np.testing.assert_allclose(actual, 0.01 * PERCENT, rtol=0.06)
    centred = values - values.mean(axis=0)
    centred_variance = centred.var(axis=0)
    correlation = (centred[8:] * centred[:-8]).mean(axis=0) / centred_variance
    expected = np.exp(-1.0)
    np.testing.assert_allclose(correlation, expected, atol=0.06)
    difference = np.corrcoef(values.T) - np.eye(6)
    assert np.abs(difference).max() < 0.1  # each axis has its own


def test_below_the_bandwidth_the_current_carries_the_disturbance_and_above_it_the_arm_moves() -> (
    None
):
    percent = np.full(6, 5.0)
    spec = disturbed(percent, 0.05)
    disturbance_nm, current_a, motor_rad = (values[2_000:] for values in hold(spec, 10_000))
    gain_nm_per_a = [axis.gain_nm_per_a for axis in spec.axes]
    gain = np.array(gain_nm_per_a)
    window = np.hanning(len(current_a))[:, None]

    def spectrum(values: FloatArray) -> FloatArray:
        difference = values - values.mean(axis=0)
        return np.asarray(np.fft.rfft(window * difference, axis=0))

    frequency_hz = np.fft.rfftfreq(len(current_a), STEP_S)
    force = spectrum(disturbance_nm)
    answer = spectrum(gain * current_a)
    low = (frequency_hz > 0.4) & (frequency_hz < 2.0)
    high = (frequency_hz > 100.0) & (frequency_hz < 300.0)
    for band, expected, tolerance in ((low, -1.0, 0.03), (high, 0.0, 0.1)):
        absolute_force = np.abs(force[band])
        transfer = np.sum(answer[band] * np.conj(force[band]), axis=0) / np.sum(
            absolute_force**2, axis=0
        )
        np.testing.assert_allclose(transfer.real, expected, atol=tolerance)
    motor_rad_std = motor_rad.std(axis=0)
    counts = (
        motor_rad_std * np.array([axis.counts_per_revolution for axis in spec.axes]) / (2.0 * np.pi)
    )
    assert (counts > 5.0).all()  # and the encoders see it


def test_without_a_disturbance_nothing_changes_and_with_one_the_current_noise_stays_the_same() -> (
    None
):
    def noise(spec: CellSpec) -> FloatArray:
        amplifiers = AmplifierSet(spec, Plant(spec))
        return np.array([amplifiers._noise.advance() for _ in range(50)])

    without = clean_cell()
    percent = np.zeros(6)
    zero = disturbed(percent, 0.03)
    with_one = disturbed(PERCENT, 0.03)
    assert Plant(zero)._disturbance is None
    np.testing.assert_array_equal(noise(with_one), noise(without))
    moved = hold(with_one, 40)[2] - hold(zero, 40)[2]
    assert np.abs(moved).max() > 0.0
