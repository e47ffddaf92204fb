"""Faults of single channels: they are named from the channel,
and not by what they leave in a fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ident.data.clipping import clipped_samples
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.data.run_channels import channels_of
from ident.errors import CurrentConstant, JointStill, RankDeficient
from ident.estimators.diagnosis import diagnose
from ident.estimators.identify import identify
from tests.ident.mistaken import AXES, SMALL, diagnosed, small_recordings
from tests.ident.recordings import Truth, three_axes_truth

TRUTH = three_axes_truth()


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    """Two runs without load and two with it, in turn."""
    return small_recordings(TRUTH, 0)


def with_still_joint(run: Run, axis: int = 2) -> Run:
    """The run with a position that does not change."""
    position = run.position_rad.copy()
    position[:, axis] = 0.3
    return replace(run, position_rad=position)


def with_limit(run: Run, limit: float, axis: int = 1) -> Run:
    """The run with a current that a limit clips."""
    current = run.current_a.copy()
    current[:, axis] = np.clip(current[:, axis], -limit, limit)
    return replace(run, current_a=current)


def with_constant_current(run: Run, size: float, axis: int = 1) -> Run:
    """The run with a current of one value."""
    current = run.current_a.copy()
    current[:, axis] = size
    return replace(run, current_a=current)


def fitted(truth: Truth, runs: list[Run]) -> np.ndarray:
    return identify(truth.model, runs, SMALL, axes=AXES).estimate.gains


# A joint that never moves


@pytest.mark.parametrize("number", [0, 1])
def test_a_joint_that_never_moves_in_the_only_run_of_a_mounting_is_named(
    runs: list[Run], number: int
) -> None:
    used = runs[:2]
    used[number] = with_still_joint(used[number])
    with pytest.raises(JointStill) as caught:
        identify(TRUTH.model, used, SMALL, axes=AXES)
    expected = f"run r{number}, axis J3"
    assert caught.value.subject == expected
    assert caught.value.found == "J3 never moves: the position is constant"
    assert isinstance(caught.value.__cause__, RankDeficient)


def test_a_joint_that_never_moves_in_any_run_is_named(runs: list[Run]) -> None:
    with pytest.raises(
        JointStill, match="axis J3: found J3 never moves above its standstill speed in any run"
    ):
        identify(TRUTH.model, [with_still_joint(run) for run in runs], SMALL, axes=AXES)


def test_an_encoder_that_stands_still_while_its_joint_moves_is_named_and_no_payload(
    runs: list[Run],
) -> None:
    used = [*runs[:3], with_still_joint(runs[3], axis=1)]
    first, *_ = diagnose(identify(TRUTH.model, used, SMALL, axes=AXES), AXES, TRUTH.gains)
    expected = ("joint-still", ("r3",), ("J2",))
    assert (first.name, first.runs, first.axes) == expected
    assert first.found == "J2 never moves: the position is constant"


def test_without_a_run_without_load_the_still_joint_is_not_the_cause(runs: list[Run]) -> None:
    with pytest.raises(RankDeficient, match="record the same robot without load too"):
        identify(TRUTH.model, [with_still_joint(runs[1]), runs[3]], SMALL, axes=AXES)


# A constant current


@pytest.mark.parametrize(("size", "words"), [(0.0, "zero throughout"), (1.5, "1.5 throughout")])
def test_a_constant_current_of_a_motor_that_moves_is_refused(
    runs: list[Run], size: float, words: str
) -> None:
    used = [*runs[:3], with_constant_current(runs[3], size)]
    with pytest.raises(CurrentConstant, match=rf"run 'r3': axis J2: found a current .*{words}"):
        identify(TRUTH.model, used, SMALL, axes=AXES)


def test_a_constant_current_of_a_held_out_run_is_refused(runs: list[Run]) -> None:
    holdout = [with_constant_current(runs[3], 1.0)]
    with pytest.raises(CurrentConstant, match="r3"):
        identify(TRUTH.model, runs[:3], SMALL, holdout=holdout, axes=AXES)


# A clipped current


def test_clipped_samples_are_named_and_left_out(runs: list[Run]) -> None:
    current_a = runs[3].current_a
    absolute_current_a = np.abs(current_a[:, 1])
    limit = float(np.percentile(absolute_current_a, 80.0))
    used = [*runs[:3], with_limit(runs[3], limit)]
    (found,) = [one for one in diagnosed(TRUTH, used) if one.name == "current-clipped"]
    expected = (("r3",), ("J2",))
    assert (found.runs, found.axes) == expected
    assert f"clipped at {limit:.4g}" in found.found
    assert fitted(TRUTH, used) == pytest.approx(TRUTH.gains, rel=0.05)


def test_whole_recordings_are_not_clipped(runs: list[Run]) -> None:
    for run in runs:
        channels = channels_of(TRUTH.model, differentiate(run, TRUTH.model.drive_train, SMALL))
        assert not channels.clipped_percent.any()


SAMPLES = np.arange(8000) * 0.002
COARSE = 0.05  #: One count of a coarse current [A]


@pytest.mark.parametrize(
    "current",
    [
        lambda t: COARSE * np.round(np.sin(2.0 * t) / COARSE),
        lambda t: np.repeat((np.sin(2.0 * t) + 0.3 * np.sin(3.1 * t))[::8], 8),
        lambda t: np.sign(np.sin(2.0 * t)) * 2.0 + 1.0,
        lambda t: np.where(np.sin(2.0 * t) > 0.0, 3.0, 0.5 + 0.1 * np.sin(50.0 * t)).clip(max=2.9),
    ],
    ids=["coarse sine", "held between slow readings", "levels of constant acceleration", "limit"],
)
def test_only_a_limit_is_a_limit(
    current: Callable[[np.ndarray], np.ndarray], request: pytest.FixtureRequest
) -> None:
    values = current(SAMPLES)[:, None]
    usable = np.ones_like(values, dtype=np.bool_)
    found = clipped_samples(values, usable)
    expected = request.node.callspec.id.endswith("limit")
    assert found.any() == expected
