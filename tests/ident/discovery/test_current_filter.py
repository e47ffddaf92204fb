"""A low-pass that the currents of a recording went through: found with its cut-off and kind, and
never in the place of another mistake.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy import signal

from daq.config.cell import model_of
from ident.data.dataset import Dataset
from ident.data.run import Run
from ident.discovery.current_filter import CurrentFilter, find_current_filter
from ident.discovery.evidence import gather
from ident.estimators.identify import identify
from ident.estimators.method import Method
from tests.ident.mistaken import SMALL, small_recordings
from tests.ident.recordings import Truth, acting_on, bent, gathered, three_axes_truth
from tests.studies.real_runs import RECORDINGS

FloatArray = NDArray[np.float64]
TRUTH = three_axes_truth()
NOISE_A = 0.03


def _recorded(change: Callable[[Run], Run], seed: int = 3, truth: Truth = TRUTH) -> tuple[Run, ...]:
    return tuple(change(run) for run in small_recordings(truth, seed, noise_a=NOISE_A))


def _found(change: Callable[[Run], Run], seed: int = 3) -> CurrentFilter | None:
    return find_current_filter(gathered(TRUTH, _recorded(change, seed)))


def without_phase(run: Run, cutoff_hz: float, order: int) -> Run:
    """The run with currents that were made smooth afterwards."""
    sections = signal.butter(order, cutoff_hz, fs=run.rate_hz, output="sos")
    return replace(run, current_a=signal.sosfiltfilt(sections, run.current_a, axis=0))


def lagging(run: Run, cutoff_hz: float) -> Run:
    """The run with currents behind a filter of first order."""
    sections = signal.butter(1, cutoff_hz, fs=run.rate_hz, output="sos")
    start = signal.sosfilt_zi(sections)[:, :, None] * run.current_a[0]
    filtered, _ = signal.sosfilt(sections, run.current_a, axis=0, zi=start)
    return replace(run, current_a=filtered)


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, 4])
def test_a_filter_without_phase_is_found_with_its_cut_off_and_order(order: int) -> None:
    found = _found(lambda run: without_phase(run, 2.0, order))
    assert found is not None
    assert found.order == order
    assert abs(found.cutoff_hz - 2.0) < 3.0 * found.cutoff_std_hz
    assert found.cutoff_std_hz < 0.05
    assert found.fallen_share > 0.5


@pytest.mark.slow
def test_a_causal_filter_of_first_order_is_found_as_one() -> None:
    found = _found(lambda run: lagging(run, 2.0))
    assert found is not None
    assert found.order == 0
    assert abs(found.cutoff_hz - 2.0) < max(3.0 * found.cutoff_std_hz, 0.02)


@pytest.mark.slow
def test_gains_behind_a_filter_are_right_once_it_is_in_the_model() -> None:
    runs = _recorded(lambda run: without_phase(run, 2.0, 3))
    evidence = gathered(TRUTH, runs)
    found = find_current_filter(evidence)
    assert found is not None
    filtered = identify(TRUTH.model, runs, found.applied_to(evidence.conditioning)).estimate
    error = np.abs(filtered.gains / TRUTH.gains - 1.0)
    assert error.max() < 0.01
    assert np.all(np.abs(filtered.gains - TRUTH.gains) < 4.0 * filtered.gains_std)
    bare = np.abs(evidence.estimate.gains / TRUTH.gains - 1.0)
    assert error.max() < bare.max()


@pytest.mark.slow
def test_a_filter_is_judged_in_the_noise_of_the_currents_by_any_estimator() -> None:
    runs = _recorded(lambda run: without_phase(run, 2.0, 2))
    found: list[CurrentFilter] = []
    for method in (Method.ML, Method.WLS):
        fitted = identify(
            TRUTH.model,
            runs,
            SMALL,
            method=method,
            fixed_gains=TRUTH.gains,
            keep_rows=True,
            judge=False,
        )
        current_filter = find_current_filter(gather(fitted))
        assert current_filter is not None
        found.append(current_filter)
    by_ml, by_wls = found
    assert_allclose(by_wls.change.before, by_ml.change.before, rtol=1e-6)


@pytest.mark.parametrize("seed", [3, 4])
def test_currents_as_they_flowed_have_no_filter(seed: int) -> None:
    assert _found(lambda run: run, seed) is None


@pytest.mark.parametrize("delay_ms", [5.0, 30.0])
def test_late_currents_are_no_filter(delay_ms: float) -> None:
    def late(run: Run) -> Run:
        late_s = run.time_s - 1e-3 * delay_ms
        columns = [np.interp(late_s, run.time_s, own) for own in run.current_a.T]
        return replace(run, current_a=np.stack(columns, axis=1))

    assert _found(late) is None


def test_a_late_encoder_is_no_filter() -> None:
    def late(run: Run) -> Run:
        position_rad = run.position_rad.copy()
        position_rad[:, 1] = np.interp(run.time_s - 0.02, run.time_s, position_rad[:, 1])
        return replace(run, position_rad=position_rad)

    assert _found(late) is None


def test_one_filtered_current_is_no_filter_of_the_recording() -> None:
    def of_one(run: Run) -> Run:
        current_a = run.current_a.copy()
        current_a[:, 0] = without_phase(run, 2.0, 3).current_a[:, 0]
        return replace(run, current_a=current_a)

    assert _found(of_one) is None


def test_friction_that_the_model_lacks_is_no_filter() -> None:
    clean = gathered(TRUTH, _recorded(lambda run: run))

    def torque_nm(data: Dataset) -> FloatArray:
        velocity = data.velocity_rad_s[:, 1]
        return acting_on(1, 3, 8.0 * np.tanh(velocity / 0.01))

    assert find_current_filter(bent(clean, TRUTH, torque_nm)) is None


@pytest.mark.slow
@pytest.mark.parametrize(("name", "expected_hz"), [("ur10", 1.74), ("tx40", 0.0), ("kr300-A", 0.0)])
def test_of_real_recordings_the_ur10_alone_has_filtered_currents(
    shared_data: Path, name: str, expected_hz: float
) -> None:
    recording = RECORDINGS[name](shared_data)
    model = model_of(recording.cell)
    conditioning = recording.cell.conditioning
    found = identify(
        model, recording.runs, conditioning, method=Method.ML, fixed_gains=recording.gains
    )
    current_filter = find_current_filter(gather(found, recording.runs))
    if not expected_hz:
        assert current_filter is None
        return
    assert current_filter is not None
    assert current_filter.cutoff_hz == pytest.approx(expected_hz, abs=0.05)
    assert current_filter.order == 3
    filtered = identify(
        model,
        recording.runs,
        current_filter.applied_to(conditioning),
        method=Method.ML,
        fixed_gains=recording.gains,
    )
    assert found.training_error.total > 4.0
    assert filtered.training_error.total < 2.7
