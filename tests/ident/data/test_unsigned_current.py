"""Currents without their sign are refused by axis;
a current that has one sign by its nature is not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.data.run import Run
from ident.data.unsigned_current import (
    bounces,
    missing_sign,
    require_signed_currents,
    unsigned_currents,
)
from ident.errors import CurrentUnsigned
from ident.estimators.identify import identify
from tests.ident.mistaken import AXES, SMALL, small_recordings
from tests.ident.recordings import FloatArray, Truth


@pytest.fixture(scope="module")
def runs(small_truth: Truth) -> list[Run]:
    return small_recordings(small_truth, 0, count=2)


def sized(run: Run, axes: list[int], sign: float = 1.0) -> Run:
    """The run with the sizes of these currents alone."""
    current = run.current_a.copy()
    absolute_current = np.abs(current[:, axes])
    current[:, axes] = sign * absolute_current
    return replace(run, current_a=current)


def shifted(current: FloatArray, least: float) -> FloatArray:
    """Currents shifted so far that the least of each is this share of its largest."""
    positive = current - current.min(axis=0)
    largest_positive = positive.max(axis=0)
    return np.asarray(positive + least * largest_positive)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["never negative", "never positive"])
@pytest.mark.parametrize("axes", [[0, 1, 2], [0], [1], [2]], ids=str)
def test_sizes_are_refused_and_the_axes_named(
    small_truth: Truth, runs: list[Run], axes: list[int], sign: float
) -> None:
    names = ", ".join(AXES[axis] for axis in axes)
    other = "negative" if sign > 0.0 else "positive"
    with pytest.raises(
        CurrentUnsigned, match=f"axis {names}: found currents that are never {other} .* both ways"
    ):
        identify(small_truth.model, [sized(run, axes, sign) for run in runs], SMALL, axes=AXES)


def test_the_missing_sign_is_that_of_each_axis(small_truth: Truth, runs: list[Run]) -> None:
    run = sized(sized(runs[0], [0, 2]), [1], -1.0)
    found = (
        rf"axis {', '.join(AXES)}: found currents that are never negative \({AXES[0]}, {AXES[2]}\) "
    )
    with pytest.raises(CurrentUnsigned, match=rf"{found}or never positive \({AXES[1]}\) while"):
        require_signed_currents(run, small_truth.model.drive_train.ratio, AXES)


def test_samples_that_are_no_use_have_no_sign(small_truth: Truth, runs: list[Run]) -> None:
    run = sized(runs[0], [1])
    valid = np.ones(run.current_a.shape, dtype=np.bool_)
    valid[100:110] = False
    current = run.current_a.copy()
    current[100:110] = -50.0
    found = replace(run, current_a=current, valid=valid)
    with pytest.raises(CurrentUnsigned, match="never negative"):
        require_signed_currents(found, small_truth.model.drive_train.ratio, AXES)


def test_sizes_in_a_held_out_run_are_refused(small_truth: Truth, runs: list[Run]) -> None:
    run = small_recordings(small_truth, 1, count=1)[0]
    unseen = replace(sized(run, [1]), name="unseen")
    with pytest.raises(CurrentUnsigned, match="run 'unseen': axis J2"):
        identify(
            small_truth.model,
            runs[:1],
            SMALL,
            holdout=[unseen],
            fixed_gains=small_truth.gains,
            axes=AXES,
        )


@pytest.mark.parametrize("seed", range(10))
def test_currents_with_a_sign_are_taken(small_truth: Truth, seed: int) -> None:
    noise_a = (0.0, 0.02, 0.15)[seed % 3]
    for run in small_recordings(small_truth, seed, count=2, noise_a=noise_a):
        ratio = small_truth.model.drive_train.ratio
        assert not unsigned_currents(run, ratio).any()


@settings(deadline=None)
@given(least=st.floats(0.0, 0.05), upwards=st.booleans(), steps=st.sampled_from([0, 10, 100]))
def test_a_current_that_has_one_sign_by_its_nature_is_taken(
    small_truth: Truth, runs: list[Run], least: float, upwards: bool, steps: int
) -> None:
    """A shoulder that always lifts, however near to zero its current comes,
    and however coarse its counts are.
    """
    current = shifted(runs[0].current_a if upwards else -runs[0].current_a, least)
    if steps:
        count = current.max(axis=0) / steps
        current = np.rint(current / count) * count
    lifting = replace(runs[0], current_a=current if upwards else -current)
    ratio = small_truth.model.drive_train.ratio
    assert not unsigned_currents(lifting, ratio).any()


def test_a_brake_that_takes_the_load_at_each_stop_is_no_size(
    small_truth: Truth, runs: list[Run]
) -> None:
    """The current of an axis that always lifts is zero while its brake is on."""
    current_a = runs[0].current_a
    current = shifted(current_a, 0.3)
    stops = np.arange(len(current)) % 220 < 40  # 0.2 s of 1.1
    current[stops] = 0.0
    braked = replace(runs[0], current_a=current)
    ratio = small_truth.model.drive_train.ratio
    assert not unsigned_currents(braked, ratio).any()


def test_an_axis_that_moves_one_way_alone_is_not_judged(
    small_truth: Truth, runs: list[Run]
) -> None:
    absolute_position_rad = np.abs(runs[0].position_rad)
    position_rad = np.cumsum(absolute_position_rad, axis=0)
    turning = replace(runs[0], position_rad=position_rad)
    run = sized(turning, [0, 1, 2])
    ratio = np.eye(3)
    assert not unsigned_currents(run, ratio).any()
    axes = [0, 1, 2]
    assert unsigned_currents(sized(runs[0], axes), small_truth.model.drive_train.ratio).all()


def test_sizes_that_are_reported_slowly_or_coarsely_are_found(
    small_truth: Truth, runs: list[Run]
) -> None:
    """A drive reports every third sample anew, in counts of 2 % of the largest current."""
    absolute_current_a = np.abs(runs[1].current_a[::3])
    repeated_current_a = np.repeat(absolute_current_a, 3, axis=0)
    time_s = runs[1].time_s
    slow = repeated_current_a[: len(time_s)]
    count = 0.02 * slow.max(axis=0)
    current_a = np.rint(slow / count) * count
    coarse = replace(runs[1], current_a=current_a)
    ratio = small_truth.model.drive_train.ratio
    assert unsigned_currents(coarse, ratio).all()


def test_samples_that_are_no_use_do_not_hide_a_size(small_truth: Truth, runs: list[Run]) -> None:
    """Where no frame came, the log has an old value or a zero."""
    axes = [0, 1, 2]
    size = sized(runs[0], axes)
    valid = np.ones(size.current_a.shape, dtype=np.bool_)
    valid[100:110] = False
    current = size.current_a.copy()
    current[100:110] = -5.0
    found = replace(size, current_a=current, valid=valid)
    ratio = small_truth.model.drive_train.ratio
    assert unsigned_currents(found, ratio).all()


def test_a_gap_after_the_first_sample_does_not_hide_a_size() -> None:
    time_s = np.linspace(0.0, 9.998, 5000)
    absolute_current = np.abs(3.0 * np.sin(2.0 * np.pi * 0.7 * time_s))
    is_used = np.ones(len(time_s), dtype=np.bool_)
    is_used[1:200] = False
    assert bounces(absolute_current, time_s)
    assert bounces(absolute_current[is_used], time_s[is_used])


@pytest.mark.parametrize("rounding_a", [0.0, 0.004])
def test_the_missing_sign_is_that_of_the_smaller_currents(rounding_a: float) -> None:
    sizes = np.array([3.0, 1.0, -rounding_a])
    assert missing_sign(sizes) == "negative"
    assert missing_sign(-sizes) == "positive"
