"""Readings that are none are found where they were planted and nowhere else, and are filled in,
left out or refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.data.channel_faults import ChannelFault, ChannelKind, FaultKind, find_faults, mended
from ident.data.dataset import Dataset, differentiate
from ident.data.run import Run
from ident.errors import ReadingsDamaged
from ident.estimators.diagnosis import diagnose
from ident.estimators.identify import identify
from ident.model.model import DriveTrain
from tests.ident.mistaken import AXES, SMALL, small_recordings
from tests.ident.recordings import three_axes_truth

FloatArray = NDArray[np.float64]
Change = Callable[[FloatArray], None]
"""What changes a channel in place, shape (k,)."""

RATE_HZ = 1000.0
SAMPLES = 6000
TIME_S = np.arange(SAMPLES) / RATE_HZ
COUNT_RAD = 2.0 * np.pi / 65536
NOISE_A = 0.05
COUPLED = np.array([[30.0, 0.0], [-20.0, 25.0]])
DIFFERENTIAL = np.array([[30.0, 20.0], [30.0, -20.0]])
TRUTH = three_axes_truth()


def motion(seed: int = 0) -> FloatArray:
    """Motor angles of two axes that start, move and rest [rad], in counts of an encoder, shape (k,
    2).
    """
    rng = np.random.default_rng(seed)
    pace = np.interp(TIME_S, [0.3, 0.8, 4.7, 5.2], [0.0, 1.0, 1.0, 0.0])
    passed_s = np.cumsum(pace)[:, None] / RATE_HZ
    angle_rad = np.zeros((SAMPLES, 2))
    for frequency_hz in rng.uniform(0.3, 1.5, (3, 2)):
        amplitude_rad = 20.0 / (1.0 + frequency_hz)
        angle_rad += amplitude_rad * np.sin(2.0 * np.pi * frequency_hz * passed_s)
    return rounded(angle_rad, COUNT_RAD)


def rounded(values: FloatArray, step: float) -> FloatArray:
    return np.asarray(np.round(values / step) * step)


def currents(position: FloatArray, seed: int = 0) -> FloatArray:
    """Currents with friction, inertia and noise, shape (k, 2)."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(scale=NOISE_A, size=position.shape)
    velocity = np.gradient(position, 1.0 / RATE_HZ, axis=0)
    friction = 0.8 * np.tanh(velocity) + 0.004 * velocity
    gravity = 0.6 * np.cos(position / 30.0)
    return np.asarray(friction + gravity + noise)


def sound(seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Positions and currents without a fault."""
    position = motion(seed)
    return position, currents(position, seed)


def damaged_position(change: Change, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Positions and currents, the position of the second axis changed."""
    position, current = sound(seed)
    change(position[:, 1])
    return position, current


def damaged_current(change: Change, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Positions and currents, the current of the second axis changed."""
    position, current = sound(seed)
    change(current[:, 1])
    return position, current


def frozen(first: int, end: int | None = None) -> Change:
    """The change that holds a sample up to another one, or to the last one."""

    def change(channel: FloatArray) -> None:
        channel[first:end] = channel[first]

    return change


def zeroed(first: int, end: int) -> Change:
    def change(channel: FloatArray) -> None:
        channel[first:end] = 0.0

    return change


def held(channel: FloatArray) -> FloatArray:
    """The channel with each tenth reading held for 10 ms."""
    return channel[np.arange(SAMPLES) // 10 * 10]


def place_of(fault: ChannelFault) -> tuple[FaultKind, ChannelKind, int]:
    return fault.kind, fault.quantity, fault.axis


# Sound recordings


@given(seed=st.integers(0, 999))
@settings(max_examples=20, deadline=None)
def test_a_sound_recording_has_no_fault(seed: int) -> None:
    position, current = sound(seed)
    assert find_faults(position, current, RATE_HZ) == ()


def flickering() -> FloatArray:
    flickers = np.arange(SAMPLES) % 977 == 0
    return np.where(flickers, 0.3 + COUNT_RAD, 0.3)


def moving_at_the_end() -> FloatArray:
    moving_s = np.maximum(TIME_S - 5.7, 0.0)
    return 1.0 - np.cos(10.0 * moving_s)


def constant_acceleration() -> FloatArray:
    acceleration = np.sign(np.sin(4.0 * TIME_S))
    velocity = np.cumsum(acceleration)
    return np.cumsum(velocity) * 1e-6


def noise() -> FloatArray:
    rng = np.random.default_rng(1)
    return np.sin(TIME_S) + rng.normal(scale=0.01, size=SAMPLES)


def sudden_stops() -> FloatArray:
    times_s = [0.0, 2.0, 2.02, 3.0, 3.02, 6.0]
    positions = [0.0, 2.0, 2.01, 2.01, 2.02, 5.0]
    return np.interp(TIME_S, times_s, positions)


SOUND: dict[str, Callable[[], FloatArray]] = {
    "at rest": lambda: np.full(SAMPLES, 0.3),
    "at rest with an encoder that flickers": flickering,
    "at rest for most of the run": moving_at_the_end,
    "really slow": lambda: rounded(0.001 * TIME_S, COUNT_RAD),
    "coarse encoder": lambda: rounded(np.sin(TIME_S), 0.02),
    "sharp corners": lambda: np.abs(np.mod(TIME_S, 2.0) - 1.0),
    "constant acceleration": constant_acceleration,
    "noise": noise,
    "readings held for 10 ms": lambda: held(np.sin(2.0 * TIME_S)),
    "stops within 20 ms": sudden_stops,
}
"""Positions of the second axis that look odd."""


@pytest.mark.parametrize("kind", SOUND)
def test_what_only_looks_odd_is_no_fault(kind: str) -> None:
    position = motion()
    position[:, 1] = SOUND[kind]()
    faults = find_faults(position, currents(position), RATE_HZ)
    assert faults == ()


# Glitches


@pytest.mark.slow
@given(
    start=st.integers(0, 5990),
    samples=st.integers(1, 3),
    size=st.floats(1.0, 1e6),
    is_down=st.booleans(),
    seed=st.integers(0, 99),
)
@settings(max_examples=40, deadline=None)
def test_a_glitch_is_found_where_it_is_and_filled_in(
    start: int, samples: int, size: float, is_down: bool, seed: int
) -> None:
    step = -size if is_down else size

    def change(channel: FloatArray) -> None:
        channel[start : start + samples] += step

    position, current = damaged_position(change, seed)
    (found,) = find_faults(position, current, RATE_HZ)
    assert place_of(found) == (FaultKind.GLITCH, ChannelKind.POSITION, 1)
    assert found.stretches.tolist() == [[start, start + samples]]
    assert found.size == pytest.approx(size, rel=0.3, abs=0.05)
    assert not found.is_refused
    error_rad = np.abs(mended(position, (found,), RATE_HZ) - motion(seed))
    is_at_an_end = not 10 < start < 5980
    limit_rad = 0.05 if is_at_an_end else 3.0 * COUNT_RAD
    assert error_rad.max() < limit_rad


DROPOUT_LENGTHS = (1, 3, 20, 50)  #: samples


@pytest.mark.parametrize("samples", DROPOUT_LENGTHS)
def test_a_dropout_of_a_position_to_zero_is_a_glitch(samples: int) -> None:
    first = 2000
    end = first + samples
    position, current = damaged_position(zeroed(first, end), seed=1)
    (found,) = find_faults(position, current, RATE_HZ)
    assert found.kind is FaultKind.GLITCH
    assert found.stretches.tolist() == [[first, end]]


@pytest.mark.parametrize("samples", DROPOUT_LENGTHS)
def test_a_dropout_of_a_current_to_zero_is_filled_in(samples: int) -> None:
    first = 2000
    end = first + samples
    position, sound_current = sound(seed=1)
    sound_current += 4.0  # far from zero
    current = sound_current.copy()
    current[first:end, 1] = 0.0
    (found,) = find_faults(position, current, RATE_HZ)
    assert found.kind is FaultKind.GLITCH
    assert found.stretches.tolist() == [[first, end]]
    filled = mended(current, (found,), RATE_HZ, quantity=ChannelKind.CURRENT)
    error_a = np.abs(filled - sound_current)
    assert error_a[first:end].max() < 8.0 * NOISE_A


def test_a_current_where_a_joint_breaks_loose_is_no_glitch() -> None:
    """As on a real robot at 250 Hz: for a sample the controller asks for three times the current,
    which rings on.
    """
    position, current = sound()
    current[2000:2005, 1] += [-1.4, -0.2, 0.5, 0.5, 0.4]
    assert find_faults(position, current, RATE_HZ) == ()


@pytest.mark.parametrize("sample", [1, 5998])
def test_a_current_that_steps_beside_an_end_of_the_recording_is_no_glitch(sample: int) -> None:
    """Friction turned there: nothing says that the current would return."""
    position, current = sound()
    if sample == 1:
        current[:sample, 1] -= 5.0
    else:
        current[sample:, 1] += 5.0
    assert find_faults(position, current, RATE_HZ) == ()


def test_glitches_in_too_many_samples_are_refused() -> None:
    def change(channel: FloatArray) -> None:
        channel[100:5000:40] += 3.0

    position, current = damaged_position(change)
    (found,) = find_faults(position, current, RATE_HZ)
    assert found.kind is FaultKind.GLITCH
    assert len(found.stretches) == 123
    assert found.is_refused


def test_a_glitch_of_held_readings_is_a_reading() -> None:
    """Each reading stays for 10 ms, the glitch too."""

    def change(channel: FloatArray) -> None:
        channel[:] = held(channel)
        channel[1500:1510] += 30.0

    position, current = damaged_position(change)
    (found,) = find_faults(position, current, RATE_HZ)
    assert found.kind is FaultKind.GLITCH
    assert found.stretches.tolist() == [[1500, 1510]]


def slowly_reported(channel: FloatArray) -> FloatArray:
    """The channel with each fourth reading held for 4 ms."""
    return channel[np.arange(SAMPLES) // 4 * 4]


@pytest.mark.parametrize("size_a", [2.0, -2.0])
def test_a_small_peak_of_a_slowly_reported_current_is_no_fault(size_a: float) -> None:
    """A controller may ask for it where a joint breaks loose."""

    def change(channel: FloatArray) -> None:
        channel[:] = slowly_reported(channel)
        channel[1500:1504] += size_a

    position, current = damaged_current(change)
    assert find_faults(position, current, RATE_HZ) == ()


def test_a_dropout_of_a_slowly_reported_current_is_found() -> None:
    def change(channel: FloatArray) -> None:
        channel[:] = slowly_reported(channel)
        channel[1500:1520] = channel[1500] + 2.0

    position, current = damaged_current(change)
    (found,) = find_faults(position, current, RATE_HZ)
    assert place_of(found) == (FaultKind.GLITCH, ChannelKind.CURRENT, 1)
    assert found.stretches.tolist() == [[1500, 1520]]


def joints_of_coupled_motors(motor_rad: FloatArray) -> FloatArray:
    return np.asarray(motor_rad @ np.linalg.inv(COUPLED).T)


def test_a_glitch_of_a_coupled_motor_is_that_of_its_own_axis() -> None:
    motor_rad, current = sound()
    sound_joint_rad = joints_of_coupled_motors(motor_rad)
    motor_rad[1500, 0] += 1.0
    joint_rad = joints_of_coupled_motors(motor_rad)
    (found,) = find_faults(joint_rad, current, RATE_HZ, COUPLED)
    assert (found.kind, found.axis) == (FaultKind.GLITCH, 0)
    filled = mended(joint_rad, (found,), RATE_HZ, COUPLED)
    assert filled == pytest.approx(sound_joint_rad, abs=1e-5)


def test_a_frozen_encoder_of_a_coupled_joint_is_found() -> None:
    motor_rad, current = sound()
    joint_rad = joints_of_coupled_motors(motor_rad)
    joint_rad[1500:1800, 1] = joint_rad[1500, 1]
    (found,) = find_faults(joint_rad, current, RATE_HZ, COUPLED)
    assert (found.kind, found.axis) == (FaultKind.FROZEN, 1)


def test_frozen_encoders_of_two_joints_of_a_differential_are_both_found() -> None:
    motor_rad, current = sound()
    joint_rad = np.linalg.solve(DIFFERENTIAL, motor_rad.T).T
    joint_rad[1500:1800, 0] = joint_rad[1500, 0]
    joint_rad[3000:3300, 1] = joint_rad[3000, 1]
    faults = find_faults(joint_rad, current, RATE_HZ, DIFFERENTIAL)
    assert [(one.kind, one.axis) for one in faults] == [
        (FaultKind.FROZEN, 0),
        (FaultKind.FROZEN, 1),
    ]


@pytest.mark.parametrize("joint", [0, 1])
def test_a_frozen_encoder_of_a_joint_of_a_differential_costs_no_reading_of_the_other(
    joint: int,
) -> None:
    motor_rad, current = sound()
    joint_rad = np.linalg.solve(DIFFERENTIAL, motor_rad.T).T
    joint_rad[1500:1800, joint] = joint_rad[1500, joint]
    faults = find_faults(joint_rad, current, RATE_HZ, DIFFERENTIAL)
    filled = mended(joint_rad, faults, RATE_HZ, DIFFERENTIAL)
    is_filled = np.any(filled != joint_rad, axis=0)
    assert np.flatnonzero(is_filled).tolist() == [joint]


def test_what_is_known_to_be_missing_is_no_finding() -> None:
    position, current = damaged_position(zeroed(1500, 1540))
    usable = np.ones(position.shape, dtype=np.bool_)
    usable[1500:1540, 1] = False
    faults = find_faults(position, current, RATE_HZ, usable=usable)
    assert faults == ()


def test_a_first_sample_that_is_known_to_be_missing_is_no_finding() -> None:
    position, current = sound()
    position[0, 1] += 1.0
    (found,) = find_faults(position, current, RATE_HZ)
    assert found.stretches.tolist() == [[0, 1]]
    usable = np.ones(position.shape, dtype=np.bool_)
    usable[0, 1] = False
    faults = find_faults(position, current, RATE_HZ, usable=usable)
    assert faults == ()


# Counters, signs and places


@pytest.mark.parametrize("bits", [12, 14, 16])
@pytest.mark.parametrize("signed", [True, False])
def test_a_counter_that_wraps_is_refused_with_its_bits(bits: int, signed: bool) -> None:
    range_rad = 2.0**bits * COUNT_RAD
    least_rad = -0.5 * range_rad if signed else 0.0

    def change(channel: FloatArray) -> None:
        channel[:] = np.mod(channel - least_rad, range_rad) + least_rad

    position, current = damaged_position(change)
    (found,) = find_faults(position, current, RATE_HZ)
    assert (found.kind, found.axis) == (FaultKind.WRAPPING, 1)
    assert found.size == pytest.approx(range_rad, rel=0.01)
    assert found.is_refused


def test_negative_currents_without_their_sign_are_refused() -> None:
    digit_a = 0.001
    range_a = 2.0**16 * digit_a

    def change(channel: FloatArray) -> None:
        channel[:] = np.mod(rounded(channel, digit_a), range_a)

    position, current = damaged_current(change)
    (found,) = find_faults(position, current, RATE_HZ)
    assert place_of(found) == (FaultKind.UNSIGNED, ChannelKind.CURRENT, 1)


def test_a_current_that_friction_turns_between_two_values_has_its_sign() -> None:
    position, current = sound()
    current[:, 1] = np.where(np.sin(3.0 * TIME_S) > 0.0, 5.0, -5.0)
    assert find_faults(position, current, RATE_HZ) == ()


def test_an_encoder_that_lost_its_place_is_refused() -> None:
    def change(channel: FloatArray) -> None:
        channel[1500:] += 2.0

    position, current = damaged_position(change)
    (found,) = find_faults(position, current, RATE_HZ)
    assert place_of(found) == (FaultKind.DISPLACED, ChannelKind.POSITION, 1)


# Frozen and clipped

FILTER_REACH = 101
"""Samples beside a gap that the filters may spoil."""


def differentiated(position: FloatArray, current: FloatArray) -> Dataset:
    run = Run("r", TIME_S, position, current)
    conditioning = replace(SMALL, standstill_rad_s=(0.1, 0.1))
    return differentiate(run, DriveTrain(np.eye(2)), conditioning)


@pytest.mark.parametrize("seconds", [0.1, 0.3])
def test_a_frozen_position_is_left_out_on_every_axis(seconds: float) -> None:
    end = 1500 + round(seconds * RATE_HZ)
    position, current = damaged_position(frozen(1500, end))
    (found,) = find_faults(position, current, RATE_HZ)
    assert place_of(found) == (FaultKind.FROZEN, ChannelKind.POSITION, 1)
    assert found.stretches.tolist() == [[1500, end]]
    data = differentiated(position, current)
    assert not data.valid[1499:end].any()
    assert data.valid[: 1499 - FILTER_REACH].all()
    assert data.valid[end + FILTER_REACH :].all()


@pytest.mark.parametrize("begin_s", [2.0, 3.1, 4.0])
def test_a_position_that_freezes_to_the_end_is_found(begin_s: float) -> None:
    begin = round(begin_s * RATE_HZ)
    position, current = damaged_position(frozen(begin))
    (found,) = find_faults(position, current, RATE_HZ)
    assert place_of(found) == (FaultKind.FROZEN, ChannelKind.POSITION, 1)
    assert found.stretches.tolist() == [[begin, len(position)]]


def test_a_robot_that_is_stopped_at_once_is_not_frozen() -> None:
    position, _ = sound()
    position[3300:] = position[3300]
    faults = find_faults(position, currents(position), RATE_HZ)
    assert faults == ()


def test_an_axis_without_acceleration_that_is_done_before_the_others_is_not_frozen() -> None:
    position, _ = sound()
    times_s = [0.0, 1.0, 1.6, 2.0, 2.4, 3.0]
    position[:, 1] = np.interp(TIME_S, times_s, [0.0, 5.0, 2.0, 9.0, 1.0, 6.0])
    faults = find_faults(position, currents(position), RATE_HZ)
    assert faults == ()


def test_a_frozen_current_is_left_out_on_its_axis() -> None:
    position, current = damaged_current(frozen(1500, 1800))
    (found,) = find_faults(position, current, RATE_HZ)
    assert place_of(found) == (FaultKind.FROZEN, ChannelKind.CURRENT, 1)
    data = differentiated(position, current)
    assert not data.valid[1499:1799, 1].any()
    assert data.valid[:, 0].all()


@pytest.mark.parametrize("percentile", [96.0, 80.0])
def test_a_position_at_the_end_of_its_range_is_left_out(percentile: float) -> None:
    def change(channel: FloatArray) -> None:
        end_of_range = np.percentile(channel, percentile)
        channel[:] = np.minimum(channel, end_of_range)

    position, current = damaged_position(change, seed=1)
    (found,) = find_faults(position, current, RATE_HZ)
    assert (found.kind, found.axis) == (FaultKind.CLIPPED, 1)
    assert found.is_left_out
    assert not found.is_refused
    assert found.share == pytest.approx(1.0 - percentile / 100.0, abs=0.05)


def test_an_axis_that_stops_and_goes_on_without_acceleration_is_not_frozen() -> None:
    """As of a simple device, or of a robot that ran into something;
    it goes on from where it stood.
    """
    position, _ = sound()
    times_s = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    position[:, 1] = np.interp(TIME_S, times_s, [0.0, 5.0, 5.0, 2.0, 2.0, 9.0, 12.0])
    faults = find_faults(position, currents(position), RATE_HZ)
    assert faults == ()


# In a fit


def with_last_position(runs: Sequence[Run], change: Change) -> list[Run]:
    """The runs, the last one with another position of J2."""
    *others, last = runs
    position = last.position_rad.copy()
    change(position[:, 1])
    return [*others, replace(last, position_rad=position)]


def test_a_fit_names_a_glitch_and_has_the_gains_of_the_sound_run() -> None:
    runs = small_recordings(TRUTH, 0)
    expected = identify(TRUTH.model, runs, SMALL, axes=AXES)

    def change(channel: FloatArray) -> None:
        channel[3000] += 1.0

    damaged = with_last_position(runs, change)
    found = identify(TRUTH.model, damaged, SMALL, axes=AXES)
    assert found.estimate.gains == pytest.approx(expected.estimate.gains, rel=1e-4)
    diagnoses = diagnose(found, AXES, TRUTH.gains)
    (diagnosis,) = (one for one in diagnoses if one.name == "readings-damaged")
    glitch_s = 3000 / runs[3].rate_hz
    assert diagnosis.runs == ("r3",)
    assert diagnosis.axes == ("J2",)
    assert f"at {glitch_s:g} s" in diagnosis.found
    assert diagnosis.found.endswith("these samples were filled in")


def test_a_fit_refuses_an_encoder_that_lost_its_place() -> None:
    runs = small_recordings(TRUTH, 0)

    def change(channel: FloatArray) -> None:
        channel[3000:] += 1.0

    damaged = with_last_position(runs, change)
    message = "run 'r3': axis J2: found a position that steps by 50 rad of the motor"
    with pytest.raises(ReadingsDamaged, match=message):
        identify(TRUTH.model, damaged, SMALL, axes=AXES)
