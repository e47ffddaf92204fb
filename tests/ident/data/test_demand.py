"""The demanded motion, rebuilt from recorded moves."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset, differentiate
from ident.data.demand import DemandCache, as_demanded, demanded_positions, with_demand
from ident.data.run import Run
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import LatePosition, corrected_dataset
from ident.model.model import DriveTrain

FloatArray = NDArray[np.float64]
RATE_HZ = 250.0
CONDITIONING = Conditioning(standstill_rad_s=(0.03, 0.03))
STRAIGHT = DriveTrain(np.diag([40.0, 30.0]))
COUPLED = DriveTrain(np.array([[40.0, 0.0], [30.0, 30.0]]))


def trapezoid(
    stops: FloatArray, rng: np.random.Generator, speed: float, acceleration: float
) -> FloatArray:
    """Positions of one motor that goes from stop to stop at trapezoidal speed,
    with rests of 0.2 s or more.
    """
    repeated_stop = np.repeat(stops[0], round(0.3 * RATE_HZ))
    parts = [repeated_stop]
    for start, end in pairwise(stops):
        way = abs(end - start)
        ramp = min(speed / acceleration, np.sqrt(way / acceleration))
        duration = way / (acceleration * ramp) + ramp
        time = np.arange(round(duration * RATE_HZ) + 1) / RATE_HZ
        velocity = acceleration * np.minimum(np.minimum(time, duration - time).clip(0.0), ramp)
        done = np.cumsum(velocity)
        parts.append(start + (end - start) * done / done[-1])
        parts.append(np.repeat(end, round(rng.uniform(0.2, 0.6) * RATE_HZ)))
    return np.concatenate(parts)


def dataset(position: FloatArray, train: DriveTrain = STRAIGHT) -> Dataset:
    time_s = np.arange(len(position)) / RATE_HZ
    current_a = np.zeros_like(position)
    run = Run("run", time_s, position, current_a)
    return differentiate(run, train, CONDITIONING)


def two_motors(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    motors = [trapezoid(rng.uniform(-2.0, 2.0, 7), rng, speed, 6.0) for speed in (2.0, 1.4)]
    longest = max(map(len, motors))
    return np.stack(
        [np.pad(motor, (0, longest - len(motor)), mode="edge") for motor in motors], axis=1
    )


@pytest.mark.parametrize("seed", range(6))
def test_moves_are_found_beneath_a_disturbance(seed: int) -> None:
    asked = two_motors(seed)
    rng = np.random.default_rng(seed + 1)
    wave = (
        0.002
        * np.sin(2.0 * np.pi * rng.uniform(5.0, 15.0) * np.arange(len(asked)) / RATE_HZ)[:, None]
    )
    position = np.asarray(asked + wave, dtype=np.float64)
    found = demanded_positions(dataset(position), STRAIGHT)
    assert found is not None
    speed = np.diff(asked[1:-1], axis=0)
    difference = np.diff(found, axis=0) - speed
    assert np.all(np.sum(difference**2, axis=0) < 0.01 * np.sum(speed**2, axis=0))
    # Three numbers a move follow next to nothing of what the disturbance adds to the acceleration.
    added = np.diff(wave[1:-1], n=2, axis=0)
    left = np.diff(found - asked[1:-1], n=2, axis=0)
    assert np.all(np.abs(np.sum(added * left, axis=0)) < 0.06 * np.sum(added**2))


def test_coupled_motors_make_the_trapezoids() -> None:
    """Joint 2 is the difference of two motors that start and stop at different times:
    no trapezoid of its own.
    """
    motors = two_motors(3)
    joints = np.asarray(np.linalg.solve(COUPLED.direction, motors.T).T, dtype=np.float64)
    found = demanded_positions(dataset(joints, COUPLED), COUPLED)
    assert found is not None
    difference = found - joints[1:-1]
    largest_absolute_difference = np.max(np.abs(difference))
    assert largest_absolute_difference < 0.01


def test_continuous_motion_has_no_moves() -> None:
    time = np.arange(2000)[:, None] / RATE_HZ
    motion = (
        np.sin(2.0 * time + np.array([0.0, 1.0]))
        + 0.5 * np.cos(3.3 * time)
        + 0.3 * np.sin(5.1 * time)
    )
    data = dataset(motion)
    assert demanded_positions(data, STRAIGHT) is None
    assert with_demand(data, STRAIGHT, CONDITIONING) is data
    assert as_demanded(data) is data


def test_an_axis_that_rests_is_demanded_to_rest() -> None:
    motion = two_motors(1)
    motion[:, 1] = 0.7
    found = demanded_positions(dataset(motion), STRAIGHT)
    assert found is not None
    assert found[:, 1] == pytest.approx(0.7)


def test_a_motion_of_one_sample_at_the_end_is_a_move() -> None:
    # Only the largest speed of a rest finds the rests below this disturbance. At 20 Hz, the last
    # rest has two samples, and the motor moves off in the last sample.
    disturbance = 0.012 * np.sin(2.0 * np.pi * np.arange(20) / 5.0)
    move = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
    end = [0.0, 0.0, 0.0, 0.03]
    motor = np.concatenate((disturbance, move, 1.0 + disturbance[:10], move[::-1], end))
    position = np.column_stack((motor, motor))
    longer = np.concatenate((position[:1], position, position[-1:]))
    run = Run("run", np.arange(len(longer)) / 20.0, longer, np.zeros_like(longer))
    slow = replace(CONDITIONING, position_cutoff_hz=5.0, decimation_cutoff_hz=2.0)
    data = replace(differentiate(run, STRAIGHT, slow), position_rad=position)
    found = demanded_positions(data, STRAIGHT)
    assert found is not None
    assert np.max(np.abs(found - position)) < 0.05


def test_derivatives_are_those_of_the_demanded_positions() -> None:
    asked = as_demanded(with_demand(dataset(two_motors(2)), STRAIGHT, CONDITIONING))
    speed = np.gradient(asked.position_rad, 1.0 / RATE_HZ, axis=0)
    speed_difference = np.abs(speed - asked.velocity_rad_s)
    assert np.max(speed_difference) < 1e-9
    absolute_velocity_rad_s = np.abs(asked.velocity_rad_s)
    assert np.max(absolute_velocity_rad_s) == pytest.approx(2.0, rel=0.05)


def test_what_corrects_a_run_corrects_its_demand() -> None:
    given = dataset(two_motors(4))
    effect = LatePosition(applied_s=0.004)
    placed = (PlacedEffect(effect, 1),)
    demanded_of_corrected = as_demanded(
        with_demand(corrected_dataset(given, placed), STRAIGHT, CONDITIONING)
    )
    corrected_demand = corrected_dataset(
        as_demanded(with_demand(given, STRAIGHT, CONDITIONING)), placed
    )
    position_difference_rad = np.abs(
        corrected_demand.position_rad - demanded_of_corrected.position_rad
    )
    assert np.max(position_difference_rad) < 1e-4
    velocity_difference_rad_s = np.abs(
        corrected_demand.velocity_rad_s - demanded_of_corrected.velocity_rad_s
    )
    assert np.max(velocity_difference_rad_s) < 0.02
    assert np.max(np.abs(given.position_rad - demanded_of_corrected.position_rad)) > 0.005


def test_the_demand_of_a_run_is_rebuilt_once() -> None:
    cache = DemandCache()
    one = dataset(two_motors(5))
    other = dataset(two_motors(6))
    first = cache.positions(one, STRAIGHT)
    assert cache.positions(one, STRAIGHT) is first
    assert first is not None
    again = demanded_positions(one, STRAIGHT)
    assert again is not None
    assert np.array_equal(first, again)
    assert cache.positions(other, STRAIGHT) is not first
