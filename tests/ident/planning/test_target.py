"""Time left to a target σ, and the reason why the worst gain takes longest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident.errors import ModelError
from ident.planning.gain_verdict import GainSource, GainVerdict, Visibility
from ident.planning.target import SlowCause, slow_cause, time_to_target

PERCENT = st.floats(0.01, 50.0)

GOOD_VERDICT = GainVerdict(
    axis=1,
    std_percent=0.8,
    known_preload_percent=None,
    alone_percent={GainSource.GRAVITY: 0.9, GainSource.INERTIA: 1.5, GainSource.COUPLING: 4.0},
    gravity_acts=True,
    verdict=Visibility.GOOD,
    advice=None,
)


@given(
    std=st.lists(PERCENT, min_size=1, max_size=7), target=PERCENT, recorded_s=st.floats(1.0, 1e4)
)
def test_after_the_time_left_every_gain_is_at_its_target(
    std: list[float], target: float, recorded_s: float
) -> None:
    target_percent = np.full(len(std), target)
    std_percent = np.array(std)
    found = time_to_target(std_percent, target_percent, recorded_s)
    # σ falls with the root of the time.
    then = np.array(std) * np.sqrt(recorded_s / (recorded_s + found.left_s))
    expected = np.minimum(std, target)
    assert then == pytest.approx(expected)
    largest_std_index = int(np.argmax(std))
    assert found.worst == largest_std_index
    assert (found.longest_s == 0.0) == (max(std) <= target)


def test_the_worst_gain_is_the_one_farthest_from_its_own_target() -> None:
    target_percent = np.array([0.5, 2.0, np.inf])
    std_percent = np.array([1.0, 2.0, 0.2])
    found = time_to_target(std_percent, target_percent, 60.0)
    assert found.worst == 0
    assert found.ratio == pytest.approx([2.0, 1.0, 0.0])
    assert found.left_s == pytest.approx([180.0, 0.0, 0.0])
    assert found.longest_s > 0.0


def test_a_gain_that_is_not_known_takes_for_ever() -> None:
    for recorded_s in (0.0, 60.0):
        std_percent = np.array([0.1, np.inf])
        found = time_to_target(std_percent, np.array([0.5, 0.5]), recorded_s)
        assert found.worst == 1
        assert found.left_s.tolist() == [0.0, np.inf]
        assert found.longest_s == np.inf
    # A gain that does not matter is not waited for.
    target_percent = np.array([0.5, np.inf])
    assert time_to_target(np.array([0.1, np.inf]), target_percent, 60.0).longest_s == 0.0


@pytest.mark.parametrize(
    ("std", "target", "message"),
    [
        ([1.0, 1.0], [1.0], "one per gain"),
        ([1.0], [0.0], "above 0 %"),
        ([np.nan], [1.0], "expected σ of every gain"),
        ([-1.0], [1.0], "expected σ of every gain"),
    ],
)
def test_wrong_arguments_are_refused(std: list[float], target: list[float], message: str) -> None:
    std_percent = np.array(std)
    target_percent = np.array(target)
    with pytest.raises(ModelError, match=message):
        time_to_target(std_percent, target_percent, 60.0)


ALONE = {GainSource.GRAVITY: np.inf, GainSource.INERTIA: 20.0, GainSource.COUPLING: 1.0}


@pytest.mark.parametrize(
    ("verdict", "noise_ratio", "cause"),
    [
        (GOOD_VERDICT, 1.0, SlowCause.TIME),
        (GOOD_VERDICT, 3.0, SlowCause.NOISE),
        (replace(GOOD_VERDICT, gravity_acts=False), 1.0, SlowCause.INERTIA),
        (replace(GOOD_VERDICT, alone_percent=ALONE), 1.0, SlowCause.COUPLING),
        (replace(GOOD_VERDICT, std_percent=30.0, verdict=Visibility.UNSEEN), 1.0, SlowCause.MOTION),
        (
            replace(GOOD_VERDICT, std_percent=np.inf, verdict=Visibility.UNSEEN),
            3.0,
            SlowCause.MOTION,
        ),
        (
            replace(
                GOOD_VERDICT, std_percent=5.0, verdict=Visibility.WEAK, known_preload_percent=1.0
            ),
            3.0,
            SlowCause.PRELOAD,
        ),
    ],
)
def test_the_reason_is_that_of_the_verdict(
    verdict: GainVerdict, noise_ratio: float, cause: SlowCause
) -> None:
    assert slow_cause(verdict, has_payload=True, noise_ratio=noise_ratio) is cause
    assert slow_cause(verdict, has_payload=False, noise_ratio=noise_ratio) is SlowCause.NO_PAYLOAD
