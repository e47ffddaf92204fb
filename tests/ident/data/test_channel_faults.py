"""Readings that are none are found where they were planted and nowhere else, and are filled in,
left out or refused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.data.channel_faults import ChannelKind, FaultKind, find_faults, mended
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.errors import ReadingsDamaged
from ident.estimators.diagnosis import diagnose
from ident.estimators.identify import identify
from ident.model.model import DriveTrain
from tests.ident.mistaken import AXES, SMALL, small_recordings
from tests.ident.recordings import three_axes_truth

FloatArray = NDArray[np.float64]
RATE_HZ = 1000.0
TIME_S = np.arange(6000) / RATE_HZ
COUNT_RAD = 2.0 * np.pi / 65536
NOISE_A = 0.05
COUPLED = np.array([[30.0, 0.0], [-20.0, 25.0]])
TRUTH = three_axes_truth()


def motion(seed: int = 0) -> FloatArray:
    """Motor angles of two axes that start, move and rest [rad], in counts of an encoder, shape (k,
    2).
    """
    rng = np.random.default_rng(seed)
    interpolated_time_s = np.interp(TIME_S, [0.3, 0.8, 4.7, 5.2], [0.0, 1.0, 1.0, 0.0])
    pace = np.clip(interpolated_time_s, 0.0, 1.0)
    passed_s = np.cumsum(pace) / RATE_HZ
    angle = np.zeros((len(TIME_S), 2))
    for speed in rng.uniform(0.3, 1.5, (3, 2)):
        angle += 20.0 * np.sin(2.0 * np.pi * speed * passed_s[:, None]) / (1.0 + speed)
    return np.asarray(np.round(angle / COUNT_RAD) * COUNT_RAD)


def currents(position: FloatArray, seed: int = 0) -> FloatArray:
    """Currents with friction, inertia and noise, shape (k, 2)."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(scale=NOISE_A, size=position.shape)
    velocity = np.gradient(position, 1.0 / RATE_HZ, axis=0)
    return np.asarray(
        0.8 * np.tanh(velocity) + 0.004 * velocity + 0.6 * np.cos(position / 30.0) + noise
    )


def planted(
    change: Callable[[FloatArray], None], *, in_current: bool = False, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Positions and currents of which one column was changed in place."""
    position = motion(seed)
    current = currents(position, seed)
    change(current[:, 1] if in_current else position[:, 1])
    return position, current


def kinds(position: FloatArray, current: FloatArray) -> list[tuple[FaultKind, ChannelKind, int]]:
    """What is found, without where."""
    faults = find_faults(position, current, RATE_HZ)
    return [(one.kind, one.quantity, one.axis) for one in faults]


# Sound recordings


@given(seed=st.integers(0, 999))
@settings(max_examples=20, deadline=None)
def test_a_sound_recording_has_no_fault(seed: int) -> None:
    position, current = planted(lambda _: None, seed=seed)
    assert find_faults(position, current, RATE_HZ) == ()


SOUND: dict[str, Callable[[], FloatArray]] = {
    "at rest": lambda: np.full(6000, 0.3),
    "at rest with an encoder that flickers": lambda: 0.3 + COUNT_RAD * (np.arange(6000) % 977 == 0),
    "at rest for most of the run": lambda: np.where(
        TIME_S < 5.7, 0.0, 1.0 - np.cos(10.0 * (TIME_S - 5.7))
    ),
    "really slow": lambda: np.round(0.001 * TIME_S / COUNT_RAD) * COUNT_RAD,
    "coarse encoder": lambda: np.round(np.sin(TIME_S) / 0.02) * 0.02,
    "sharp corners": lambda: np.abs(np.mod(TIME_S, 2.0) - 1.0),
    "constant acceleration": lambda: np.cumsum(np.cumsum(np.sign(np.sin(4.0 * TIME_S)))) * 1e-6,
    "noise": lambda: np.sin(TIME_S) + np.random.default_rng(1).normal(scale=0.01, size=6000),
    "readings held for 10 ms": lambda: np.sin(2.0 * TIME_S)[np.arange(6000) // 10 * 10],
    "stops within 20 ms": lambda: np.interp(
        TIME_S, [0.0, 2.0, 2.02, 3.0, 3.02, 6.0], [0.0, 2.0, 2.01, 2.01, 2.02, 5.0]
    ),
}


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
    def change(channel: FloatArray) -> None:
        channel[start : start + samples] += -size if is_down else size

    position, current = planted(change, seed=seed)
    (found,) = find_faults(position, current, RATE_HZ)
    expected = (FaultKind.GLITCH, ChannelKind.POSITION, 1)
    assert (found.kind, found.quantity, found.axis) == expected
    assert found.stretches.tolist() == [[start, start + samples]]
    assert found.size == pytest.approx(size, rel=0.3, abs=0.05)
    assert not found.is_refused
    sound = motion(seed)
    inside = 10 < start < 5980
    difference = np.abs(mended(position, (found,), RATE_HZ) - sound)
    assert difference.max() < (3.0 * COUNT_RAD if inside else 0.05)


@pytest.mark.parametrize("samples", [1, 3, 20, 50])
def test_a_dropout_to_zero_is_filled_in(samples: int) -> None:
    zeros = slice(2000, 2000 + samples)
    for in_current in (False, True):
        position, current = planted(
            lambda channel: np.copyto(channel[zeros], 0.0), in_current=in_current, seed=1
        )
        if in_current:
            current += 4.0
            current[zeros, 1] = 0.0
        (found,) = find_faults(position, current, RATE_HZ)
        assert found.kind is FaultKind.GLITCH
        expected = [[2000, 2000 + samples]]
        assert found.stretches.tolist() == expected
    sound = currents(motion(1), 1) + 4.0
    filled = mended(current, (found,), RATE_HZ, quantity=ChannelKind.CURRENT)
    filled_difference = np.abs(filled - sound)
    largest_filled_difference = filled_difference[zeros].max()
    assert largest_filled_difference < 8.0 * NOISE_A


def test_a_current_where_a_joint_breaks_loose_is_no_glitch() -> None:
    """As on a real robot at 250 Hz: for a sample the controller asks for three times the current,
    which rings on.
    """
    position, current = planted(lambda _: None)
    current[2000:2005, 1] += [-1.4, -0.2, 0.5, 0.5, 0.4]
    assert find_faults(position, current, RATE_HZ) == ()


@pytest.mark.parametrize("sample", [1, 5998])
def test_a_current_that_steps_beside_an_end_of_the_recording_is_no_glitch(sample: int) -> None:
    """Friction turned there: nothing says that the current would return."""
    position, current = planted(lambda _: None)
    if sample == 1:
        current[:sample, 1] -= 5.0
    else:
        current[sample:, 1] += 5.0
    assert find_faults(position, current, RATE_HZ) == ()


def test_glitches_in_too_many_samples_are_refused() -> None:
    def change(channel: FloatArray) -> None:
        channel[100:5000:40] += 3.0

    position, current = planted(change)
    (found,) = find_faults(position, current, RATE_HZ)
    assert (found.kind, len(found.stretches)) == (FaultKind.GLITCH, 123)
    assert found.is_refused


def test_a_glitch_of_held_readings_is_a_reading() -> None:
    """Each reading stays for 10 ms, the glitch too."""

    def change(channel: FloatArray) -> None:
        channel[:] = channel[np.arange(6000) // 10 * 10]
        channel[1500:1510] += 30.0

    position, current = planted(change)
    (found,) = find_faults(position, current, RATE_HZ)
    expected = (FaultKind.GLITCH, [[1500, 1510]])
    assert (found.kind, found.stretches.tolist()) == expected


def test_a_glitch_of_a_coupled_motor_is_that_of_its_own_axis() -> None:
    motor_rad = motion()
    motor_rad[1500, 0] += 1.0
    coupled_inverse = np.linalg.inv(COUPLED)
    joint_rad = motor_rad @ coupled_inverse.T
    current = currents(motion())
    (found,) = find_faults(joint_rad, current, RATE_HZ, COUPLED)
    assert (found.kind, found.axis) == (FaultKind.GLITCH, 0)
    sound = motion() @ np.linalg.inv(COUPLED).T
    assert mended(joint_rad, (found,), RATE_HZ, COUPLED) == pytest.approx(sound, abs=1e-5)


def test_a_frozen_encoder_of_a_coupled_joint_is_found() -> None:
    joint_rad = motion() @ np.linalg.inv(COUPLED).T
    joint_rad[1500:1800, 1] = joint_rad[1500, 1]
    current = currents(motion())
    found = find_faults(joint_rad, current, RATE_HZ, COUPLED)
    expected = [(FaultKind.FROZEN, 1)]
    assert [(one.kind, one.axis) for one in found] == expected


def test_what_is_known_to_be_missing_is_no_finding() -> None:
    position, current = planted(lambda channel: np.copyto(channel[1500:1540], 0.0))
    usable = np.ones(position.shape, dtype=np.bool_)
    usable[1500:1540, 1] = False
    faults = find_faults(position, current, RATE_HZ, usable=usable)
    assert faults == ()


# Counters, signs and places


@pytest.mark.parametrize("bits", [12, 14, 16])
@pytest.mark.parametrize("signed", [True, False])
def test_a_counter_that_wraps_is_refused_with_its_bits(bits: int, signed: bool) -> None:
    whole = 2.0**bits * COUNT_RAD
    least = -0.5 * whole if signed else 0.0

    def change(channel: FloatArray) -> None:
        channel[:] = np.mod(channel - least, whole) + least

    position, current = planted(change)
    (found,) = find_faults(position, current, RATE_HZ)
    assert (found.kind, found.axis) == (FaultKind.WRAPPING, 1)
    assert found.size == pytest.approx(whole, rel=0.01)
    assert found.is_refused


def test_negative_currents_without_their_sign_are_refused() -> None:
    whole = 2.0**16 * 0.001

    def change(channel: FloatArray) -> None:
        channel[:] = np.mod(np.round(channel / 0.001) * 0.001, whole)

    assert kinds(*planted(change, in_current=True)) == [
        (FaultKind.UNSIGNED, ChannelKind.CURRENT, 1)
    ]


def test_a_current_that_friction_turns_between_two_values_has_its_sign() -> None:
    position, current = planted(lambda _: None)
    current[:, 1] = np.where(np.sin(3.0 * TIME_S) > 0.0, 5.0, -5.0)
    assert find_faults(position, current, RATE_HZ) == ()


def test_an_encoder_that_lost_its_place_is_refused() -> None:
    def change(channel: FloatArray) -> None:
        channel[1500:] += 2.0

    assert kinds(*planted(change)) == [(FaultKind.DISPLACED, ChannelKind.POSITION, 1)]


# Frozen and clipped


@pytest.mark.parametrize("seconds", [0.1, 0.3])
def test_a_frozen_position_is_left_out_on_every_axis(seconds: float) -> None:
    end = 1500 + round(seconds * RATE_HZ)
    position, current = planted(lambda channel: np.copyto(channel[1500:end], channel[1500]))
    (found,) = find_faults(position, current, RATE_HZ)
    expected = (FaultKind.FROZEN, ChannelKind.POSITION, 1)
    assert (found.kind, found.quantity, found.axis) == expected
    assert found.stretches.tolist() == [[1500, end]]
    run = Run("r", TIME_S, position, current)
    drive_train = DriveTrain(np.eye(2))
    data = differentiate(run, drive_train, SMALL_TWO)
    assert not data.valid[1499:end].any()
    assert data.valid[: 1499 - 101].all()
    assert data.valid[end + 101 :].all()


@pytest.mark.parametrize("begin_s", [2.0, 3.1, 4.0])
def test_a_position_that_freezes_to_the_end_is_found(begin_s: float) -> None:
    begin = round(begin_s * RATE_HZ)
    position, current = planted(lambda channel: np.copyto(channel[begin:], channel[begin]))
    (found,) = find_faults(position, current, RATE_HZ)
    expected = (FaultKind.FROZEN, ChannelKind.POSITION, 1)
    assert (found.kind, found.quantity, found.axis) == expected
    assert found.stretches.tolist() == [[begin, len(position)]]


def test_a_robot_that_is_stopped_at_once_is_not_frozen() -> None:
    position, _ = planted(lambda _: None)
    position[3300:] = position[3300]
    faults = find_faults(position, currents(position), RATE_HZ)
    assert faults == ()


def test_an_axis_without_acceleration_that_is_done_before_the_others_is_not_frozen() -> None:
    position, _ = planted(lambda _: None)
    position[:, 1] = np.interp(
        TIME_S, [0.0, 1.0, 1.6, 2.0, 2.4, 3.0], [0.0, 5.0, 2.0, 9.0, 1.0, 6.0]
    )
    faults = find_faults(position, currents(position), RATE_HZ)
    assert faults == ()


def test_a_frozen_current_is_left_out_on_its_axis() -> None:
    position, current = planted(
        lambda channel: np.copyto(channel[1500:1800], channel[1500]), in_current=True
    )
    (found,) = find_faults(position, current, RATE_HZ)
    expected = (FaultKind.FROZEN, ChannelKind.CURRENT, 1)
    assert (found.kind, found.quantity, found.axis) == expected
    run = Run("r", TIME_S, position, current)
    drive_train = DriveTrain(np.eye(2))
    data = differentiate(run, drive_train, SMALL_TWO)
    assert not data.valid[1499:1799, 1].any()
    assert data.valid[:, 0].all()


@pytest.mark.parametrize("percentile", [96.0, 80.0])
def test_a_position_at_the_end_of_its_range_is_left_out(percentile: float) -> None:
    def change(channel: FloatArray) -> None:
        channel_percentile = np.percentile(channel, percentile)
        np.minimum(channel, channel_percentile, out=channel)

    position, current = planted(change, seed=1)
    (found,) = find_faults(position, current, RATE_HZ)
    assert (found.kind, found.axis) == (FaultKind.CLIPPED, 1)
    assert found.is_left_out
    assert not found.is_refused
    assert found.share == pytest.approx(1.0 - percentile / 100.0, abs=0.05)


def test_an_axis_that_stops_and_goes_on_without_acceleration_is_not_frozen() -> None:
    """As of a simple device, or of a robot that ran into something;
    it goes on from where it stood.
    """
    position, _ = planted(lambda _: None)
    position[:, 1] = np.interp(
        TIME_S, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [0.0, 5.0, 5.0, 2.0, 2.0, 9.0, 12.0]
    )
    faults = find_faults(position, currents(position), RATE_HZ)
    assert faults == ()


SMALL_TWO = replace(SMALL, standstill_rad_s=(0.1, 0.1))


# In a fit


def with_position(run: Run, change: Callable[[FloatArray], None]) -> Run:
    """The run with another position of J2."""
    position = run.position_rad.copy()
    change(position[:, 1])
    return replace(run, position_rad=position)


def test_a_fit_names_a_glitch_and_has_the_gains_of_the_sound_run() -> None:
    runs = small_recordings(TRUTH, 0)
    sound = identify(TRUTH.model, runs, SMALL, axes=AXES)

    def change(channel: FloatArray) -> None:
        channel[3000] += 1.0

    damaged = [*runs[:3], with_position(runs[3], change)]
    found = identify(TRUTH.model, damaged, SMALL, axes=AXES)
    assert found.estimate.gains == pytest.approx(sound.estimate.gains, rel=1e-4)
    (said,) = [one for one in diagnose(found, AXES, TRUTH.gains) if one.name == "readings-damaged"]
    at_s = 3000 / runs[3].rate_hz
    expected = (("r3",), ("J2",))
    assert (said.runs, said.axes) == expected
    assert f"at {at_s:g} s" in said.found
    assert said.found.endswith("these samples were filled in")


def test_a_fit_refuses_an_encoder_that_lost_its_place() -> None:
    runs = small_recordings(TRUTH, 0)

    def change(channel: FloatArray) -> None:
        channel[3000:] += 1.0

    damaged = [*runs[:3], with_position(runs[3], change)]
    with pytest.raises(
        ReadingsDamaged,
        match=r"run 'r3': axis J2: found a position that steps by "
        r"50 rad of the motor",
    ):
        identify(TRUTH.model, damaged, SMALL, axes=AXES)
