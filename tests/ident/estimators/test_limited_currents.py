"""Drives that give less current than their reference asks for are found by the torque;
what is no such drive is not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ident.data.dataset import Dataset
from ident.data.run import Run
from ident.errors import Diagnosis, RankDeficient
from ident.estimators.diagnosis import diagnose
from ident.estimators.estimate import Identification
from ident.estimators.identify import identify
from ident.estimators.limited_currents import LimitedCurrent
from tests.ident.mistaken import AXES, SMALL, small_recordings
from tests.ident.recordings import MOUNTED, three_axes_truth

TRUTH = three_axes_truth()
AXIS = 1
GIVEN = 0.9
"""Share of the largest current of a run from which on the reference asks for more.

The motion is that of a recording without a limit, so the current that it needs beyond this share
differs by a tenth.
"""


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    """Two runs without load and two with it, in turn."""
    return small_recordings(TRUTH, 0, seconds=40.0)


def winding_up(run: Run, limit_a: float) -> Run:
    """The run with a reference of J2 that winds up wherever the motor needs what its drive gives at
    most.
    """
    current = run.current_a.copy()
    own = current[:, AXIS]
    times = 2.5 + np.sin(11.0 * run.time_s)
    current[:, AXIS] = np.where(np.abs(own) > GIVEN * limit_a, times * own, own)
    return replace(run, current_a=current)


def largest_a(runs: list[Run]) -> float:
    return max(float(np.abs(run.current_a[:, AXIS]).max()) for run in runs)


def fitted(runs: list[Run], *, keep_rows: bool = True) -> Identification:
    return identify(TRUTH.model, runs, SMALL, axes=AXES, keep_rows=keep_rows)


def limits_named(found: Identification) -> list[Diagnosis]:
    return [one for one in diagnose(found, AXES) if one.name == "current-limited"]


@pytest.mark.slow
def test_a_drive_that_gives_less_is_named_and_its_samples_are_left_out(runs: list[Run]) -> None:
    limit_a = largest_a(runs)
    used = [winding_up(run, limit_a) for run in runs]
    found = fitted(used)
    named = limits_named(found)
    axes: set[str] = set()
    for diagnosis in named:
        axes.update(diagnosis.axes)
    assert axes == {AXES[AXIS]}
    torque_limits = found.channels[-1].torque_limits
    assert torque_limits[AXIS] == pytest.approx(limit_a, rel=0.12)
    with_all = fitted(used, keep_rows=False)
    error, before = (
        abs(one.estimate.gains[AXIS] / TRUTH.gains[AXIS] - 1.0) for one in (found, with_all)
    )
    assert before > 0.02
    assert error < 0.5 * before
    gain_difference = found.estimate.gains - TRUTH.gains
    z = gain_difference / found.estimate.gains_std
    assert np.abs(z).max() < 3.0


def test_recordings_without_a_limit_have_none(runs: list[Run]) -> None:
    found = fitted(runs)
    assert limits_named(found) == []
    torque_limits = found.channels[0].torque_limits
    assert np.isnan(torque_limits).all()


def test_a_blow_is_no_limit(runs: list[Run]) -> None:
    """What asks for more at any current, as a contact does, has no plateau."""
    rng = np.random.default_rng(0)
    struck = []
    for run in runs:
        current = run.current_a.copy()
        for start in rng.integers(500, len(current) - 500, 6).tolist():
            current[start : start + 60, AXIS] += (
                np.sign(current[start, AXIS]) * 0.8 * largest_a(runs)
            )
        struck.append(replace(run, current_a=current))
    assert limits_named(fitted(struck)) == []


def test_a_motor_that_weakens_is_no_limit(runs: list[Run]) -> None:
    """Saturation asks for more and more, but the torque goes on to grow."""
    half_a = 1.5 * largest_a(runs)
    weak = []
    for run in runs:
        current = run.current_a.copy()
        current[:, AXIS] *= 1.0 + (current[:, AXIS] / half_a) ** 2
        weak.append(replace(run, current_a=current))
    assert limits_named(fitted(weak)) == []


def test_a_held_out_run_decides_no_sample_of_the_fit(runs: list[Run]) -> None:
    """A limit that shows in the held-out run alone, at currents that the others reach."""
    limit_a = 0.95 * largest_a([runs[3]])
    held_out = replace(winding_up(runs[3], limit_a), name="held out")
    bare, loaded, other_bare, _ = runs
    used = [bare, loaded, other_bare]
    found = identify(TRUTH.model, used, SMALL, axes=AXES, holdout=[held_out], keep_rows=True)
    alone = identify(TRUTH.model, used, SMALL, axes=AXES, keep_rows=True)
    assert_allclose(found.estimate.gains, alone.estimate.gains, rtol=1e-12)
    assert np.isnan(found.channels[0].torque_limits).all()


def test_what_is_left_without_limited_samples_must_distinguish_payload_and_robot(
    runs: list[Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    def as_if_all_that_is_left_were_loaded(data: Dataset, limits: object) -> Dataset:
        return replace(data, payload=MOUNTED)

    limit = LimitedCurrent(AXIS, 1e6)
    identify_module = "ident.estimators.identify"
    monkeypatch.setattr(f"{identify_module}.limited_currents", lambda *_: (limit,))
    monkeypatch.setattr(f"{identify_module}.without_limited", as_if_all_that_is_left_were_loaded)
    with pytest.raises(RankDeficient, match="without load too"):
        fitted(runs)
