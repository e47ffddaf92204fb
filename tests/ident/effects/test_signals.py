"""Signals: clocks, inertia and torques, against the truth and the mechanics library."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.discovery.evidence import Evidence
from ident.effects.signals import Signals, declared_signals, fitted_signals, session_began_s
from ident.model.robot import Motion
from tests.ident.recordings import PAYLOAD_TRUTH, Truth

FloatArray = NDArray[np.float64]


@pytest.fixture(scope="module")
def data(small: Evidence) -> Dataset:
    """The first second of a loaded run."""
    whole = small.datasets[1]
    part = slice(0, 1000)
    return replace(
        whole,
        time_s=whole.time_s[part],
        position_rad=whole.position_rad[part],
        velocity_rad_s=whole.velocity_rad_s[part],
        acceleration_rad_s2=whole.acceleration_rad_s2[part],
    )


def _loaded(truth: Truth) -> FloatArray:
    parameters = truth.parameters.copy()
    parameters[truth.model.flange] += list(PAYLOAD_TRUTH.values())
    return parameters


def _without(truth: Truth, *prefixes: str) -> FloatArray:
    kept = [not column.name.startswith(prefixes) for column in truth.model.columns]
    return np.asarray(_loaded(truth) * kept)


def _made(truth: Truth, data: Dataset, began_s: float | None = None) -> Signals:
    return declared_signals(truth.model, data, _loaded(truth), truth.gains, began_s)


def test_torques_are_of_the_load_through_the_gear_and_of_the_motor(
    small_truth: Truth, data: Dataset
) -> None:
    made = _made(small_truth, data)
    columns = small_truth.model.regressor(data.motion())
    load, geared, whole = (
        np.einsum("jck,c->jk", columns, parameters)
        for parameters in (
            _without(small_truth, "Ia", "fv", "fs", "off"),
            _without(small_truth, "Ia", "off"),
            _loaded(small_truth),
        )
    )
    assert made.load_torque_nm == pytest.approx(load)
    assert made.geared_torque_nm == pytest.approx(geared)
    to_motor = small_truth.model.drive_train.to_motor
    assert made.motor_torque_nm == pytest.approx(to_motor @ whole)
    assert made.current_a * small_truth.gains[:, None] == pytest.approx(made.motor_torque_nm)
    assert made.motor_position_rad == pytest.approx(
        np.diag([40.0, 50.0, -45.0]) @ data.position_rad.T
    )


def _inertia(signals: Signals) -> FloatArray:
    return np.stack(
        [signals.inertia(slice(None), axis) for axis in range(len(signals.position_rad))], axis=1
    )


def test_inertia_is_torque_per_acceleration_at_every_sample(
    small_truth: Truth, data: Dataset
) -> None:
    """Mass matrix of links and payload;
    interpolated between postures, so it follows to a hundredth.
    """
    parameters = _without(small_truth, "Ia", "fv", "fs", "off")
    still = np.zeros_like(data.position_rad)
    rng = np.random.default_rng(1)
    acceleration = rng.normal(size=data.position_rad.shape)
    moved, held = (
        np.einsum(
            "jck,c->jk",
            small_truth.model.regressor(Motion(data.position_rad, still, a)),
            parameters,
        )
        for a in (acceleration, still)
    )
    inertia = _inertia(_made(small_truth, data))
    found = np.einsum("ijk,kj->ik", inertia, acceleration)
    absolute_moved = np.abs(found - (moved - held))
    largest_absolute_moved = np.max(absolute_moved)
    moved_difference = np.abs(moved - held)
    assert largest_absolute_moved < 0.01 * np.max(moved_difference)
    assert inertia == pytest.approx(np.swapaxes(inertia, 0, 1), abs=1e-9)
    for sample in range(0, 1000, 100):
        inertia_eigenvalues = np.linalg.eigvalsh(inertia[:, :, sample])
        assert np.all(inertia_eigenvalues > 0)


def test_of_an_estimate_the_rotor_of_a_regrouped_axis_counts_as_link(
    small: Evidence, small_truth: Truth, data: Dataset
) -> None:
    """Ia of joints 1 and 2 cannot be distinguished from their links;
    that of joint 3 is a parameter of its own.
    """
    signals = fitted_signals(small.model, data, small.training, small.estimate)
    found = _inertia(signals)
    true = _inertia(_made(small_truth, data))
    rotors = np.array([0.03, 0.03, 0.0])
    expected = true + np.diag(rotors)[:, :, None]
    largest_difference = np.max(np.abs(found - expected))
    largest_absolute_true = np.max(np.abs(true))
    assert largest_difference < 0.05 * largest_absolute_true
    mean_true = true[1, 1].mean()
    difference = found[1, 1].mean() - mean_true
    assert difference == pytest.approx(0.03, abs=0.02)


def test_the_session_clock_counts_from_the_first_run(small_truth: Truth, data: Dataset) -> None:
    runs = [replace(data, started_s=started_s) for started_s in (1000.0, 1060.0, 1130.0)]
    began_s = session_began_s(runs)
    assert began_s == 1000.0
    made = [_made(small_truth, run, began_s) for run in runs]
    for later, run in zip((0.0, 60.0, 130.0), made, strict=True):
        assert run.time_s[0] == 0.0
        assert run.session_s == pytest.approx(run.time_s + later)
        session_steps_s = np.diff(run.session_s)
        assert np.all(session_steps_s > 0)


@pytest.mark.parametrize(
    ("starts_s", "began_s"),
    [
        ((512.3, 0.0, 60.0), 0.0),
        ((0.0, 0.0), None),
        ((0.0, 500.0, 500.5), None),
        ((0.0, 1.7e9), None),
        ((1.7e9 + 0.5, 1.7e9), 1.7e9),
        ((0.0,), 0.0),
    ],
)
def test_runs_that_overlap_have_no_common_clock(
    data: Dataset, starts_s: tuple[float, ...], began_s: float | None
) -> None:
    """Stamps from each file's own start say nothing of the session;
    by the time of day a simulated cell may overlap.
    """
    time_difference_s = data.time_s[-1] - data.time_s[0]
    assert time_difference_s > 0.9
    datasets = [replace(data, started_s=started_s) for started_s in starts_s]
    assert session_began_s(datasets) == began_s


def test_without_a_clock_the_session_is_the_run(small_truth: Truth, data: Dataset) -> None:
    runs = [replace(data, started_s=1000.0), replace(data, started_s=None)]
    assert session_began_s(runs) is None
    assert session_began_s([]) is None
    made = _made(small_truth, runs[1], session_began_s(runs))
    assert np.array_equal(made.session_s, made.time_s)


def test_one_run_without_a_clock_leaves_all_without(small_truth: Truth, data: Dataset) -> None:
    """Else runs with a clock would be a clock's reading, not a session, away from those without."""
    runs = [replace(data, started_s=1.7e9), replace(data, started_s=None)]
    made = _made(small_truth, runs[0], session_began_s(runs))
    assert np.array_equal(made.session_s, made.time_s)
