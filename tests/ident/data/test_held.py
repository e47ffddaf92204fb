"""Held readings are filled in; what only repeats because it rests, or because it is coarse,
stays as it is.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from daq.config.cell import model_of
from ident.data.dataset import differentiate
from ident.data.held import fill_channel, fill_held, held_samples
from ident.data.run import Run
from ident.estimators.identify import identify
from tests.ident.mistaken import AXES, SMALL, diagnosed, small_recordings
from tests.ident.recordings import three_axes_truth
from tests.studies.real_runs import tx40

FloatArray = NDArray[np.float64]
TRUTH = three_axes_truth()
RATE_HZ = 1000.0
TIME_S = np.arange(6000) / RATE_HZ
COUNT_RAD = 2.0 * np.pi / 65536 / 32


def waves(seed: int) -> FloatArray:
    """A motion of three waves up to 3 Hz [rad]."""
    rng = np.random.default_rng(seed)
    waves = rng.uniform(0.2, 1.0, 3)[:, None] * np.sin(
        2.0 * np.pi * rng.uniform(0.1, 3.0, 3)[:, None] * TIME_S + rng.uniform(0.0, 6.0, 3)[:, None]
    )
    return np.asarray(waves.sum(axis=0))


def counted(values: FloatArray, count: float) -> FloatArray:
    """Values as an encoder of such counts gives them."""
    return np.asarray(np.round(values / count) * count)


def stale(values: FloatArray, samples: int) -> FloatArray:
    """Values of which every reading stays for so many samples."""
    return np.asarray(values[np.arange(len(values)) // samples * samples])


@given(
    seed=st.integers(0, 999), samples=st.integers(2, 20), count=st.sampled_from([0.0, COUNT_RAD])
)
@settings(max_examples=25, deadline=None)
def test_a_held_motion_is_filled_in(seed: int, samples: int, count: float) -> None:
    motion = waves(seed)
    read = counted(motion, count) if count else motion
    channel = fill_channel(stale(read, samples), RATE_HZ, by_spline=True)
    assert channel.held_share == pytest.approx(1.0 - 1.0 / samples, abs=0.03)
    assert channel.hold_s == pytest.approx(samples / RATE_HZ)
    inside = slice(50, -50)
    channel_difference = np.abs(channel.values - motion)
    worst = channel_difference[inside].max()
    # Where the motion turns, a reading changes by less than JUMP_COUNTS, and stays.
    difference = stale(read, samples) - motion
    largest_difference = np.abs(difference)[inside].max()
    assert worst < 3.0 * count + 0.1 * largest_difference


@given(seed=st.integers(0, 999), count=st.sampled_from([COUNT_RAD, 1e-3, 2.0 * np.pi / 4096]))
@settings(max_examples=25, deadline=None)
def test_a_coarse_encoder_holds_nothing(seed: int, count: float) -> None:
    read = counted(waves(seed), count)
    assert fill_channel(read, RATE_HZ, by_spline=True).values is read


@pytest.mark.parametrize("rest_s", [0.02, 0.2, 1.0])
def test_a_joint_that_rests_between_moves_holds_nothing(rest_s: float) -> None:
    ramp = np.clip((TIME_S % (0.5 + rest_s)) / 0.5, 0.0, 1.0)
    smooth = ramp**3 * (10.0 - 15.0 * ramp + 6.0 * ramp**2)
    steps = np.floor(TIME_S / (0.5 + rest_s))
    motion = counted(steps + smooth, COUNT_RAD)
    assert fill_channel(motion, RATE_HZ, by_spline=True).values is motion


@pytest.mark.parametrize("noise_counts", [0.3, 1.0, 3.0, 30.0])
def test_a_noisy_current_holds_nothing(noise_counts: float) -> None:
    rng = np.random.default_rng(1)
    for count in (0.01, 0.05):
        noise = noise_counts * count * rng.standard_normal(len(TIME_S))
        current = counted(waves(2) + noise, count)
        assert fill_channel(current, RATE_HZ, by_spline=False).values is current


def test_what_was_read_stays_what_it_was() -> None:
    read = stale(waves(3), 8)
    held = held_samples(read, RATE_HZ)
    filled = fill_channel(read, RATE_HZ, by_spline=True).values
    assert np.array_equal(filled[~held], read[~held])


def test_a_channel_that_is_not_held_stays_beside_one_that_is() -> None:
    position = np.stack((waves(1), stale(waves(2), 5)), axis=1)
    current = np.stack((stale(waves(3), 4), waves(4)), axis=1)
    filled_position, filled_current, held = fill_held(position, current, RATE_HZ)
    assert held is not None
    assert held.position_share == pytest.approx([0.0, 0.8], abs=0.02)
    assert held.current_share == pytest.approx([0.75, 0.0], abs=0.02)
    assert np.array_equal(filled_position[:, 0], position[:, 0])
    assert np.array_equal(filled_current[:, 1], current[:, 1])


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    """Two runs without load and two with it, in turn."""
    return small_recordings(TRUTH, 0)


def held(run: Run, samples: int) -> Run:
    """The run by a recorder that asks more often than the controller answers."""
    rows = np.arange(len(run.time_s)) // samples * samples
    return replace(run, position_rad=run.position_rad[rows], current_a=run.current_a[rows])


def test_recordings_without_held_readings_are_left_alone(runs: list[Run]) -> None:
    for run in runs:
        assert differentiate(run, TRUTH.model.drive_train, SMALL).held is None


def test_a_fit_of_held_readings_has_the_same_gains_and_says_so(runs: list[Run]) -> None:
    used = [held(run, 3) for run in runs]
    said = [one for one in diagnosed(TRUTH, used) if one.name == "readings-held"]
    expected = []
    for run in runs:
        for _ in ("positions", "currents"):
            expected.append((run.name,))
    assert [one.runs for one in said] == expected
    assert all(one.axes == tuple(AXES) for one in said)
    estimate = identify(TRUTH.model, used, SMALL, axes=AXES).estimate
    gains = estimate.gains
    assert gains == pytest.approx(TRUTH.gains, rel=0.03)


@pytest.mark.slow
def test_positions_of_a_real_arm_that_are_held_for_10_ms_cost_little(shared_data: Path) -> None:
    """The error of its six axes is 5.05 %, and was 5.63 % with these positions.

    Currents that are held, too, leave 8.9 %: above 300 Hz the current of J1 has noise of 0.16 A,
    and a hundred readings a second fold it into the band of the rows.
    """
    recording = tx40(shared_data)
    (run,) = recording.runs
    position_rad = held(run, 50).position_rad
    stale = replace(run, position_rad=position_rad)
    model = model_of(recording.cell)
    found = identify(model, (stale,), recording.cell.conditioning, fixed_gains=recording.gains)
    total = found.estimate.relative_error(found.system).total
    assert total < 5.2
