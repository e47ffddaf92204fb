"""A standstill speed that no one declared:
derived from the run, as good as a declared one, and better than none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.conditioning import Conditioning, Decimator
from ident.data.dataset import Dataset, differentiate
from ident.data.run import Run
from ident.equations.rows import row_filter, row_masks
from ident.errors import DataUnfit
from ident.estimators.identify import identify
from tests.ident.recordings import CONDITIONING, Truth

FloatArray = NDArray[np.float64]

ENCODER_NOISE_RAD = 2e-6
RESOLUTION_RAD = 3e-6
DERIVED = Conditioning()
NEVER = replace(CONDITIONING, standstill_rad_s=(0.0,) * 6)


def _at_rest(run: Run) -> NDArray[np.bool_]:
    """Samples whose exact positions do not change, shape (k, n)."""
    position_steps_rad = np.diff(run.position_rad, axis=0, prepend=run.position_rad[:1])
    step = np.abs(position_steps_rad)
    return np.asarray(step < 1e-9)


def _sticking(run: Run, truth: Truth, rng: np.random.Generator) -> Run:
    """The same run on a real arm: a resting joint holds any torque within its dry friction,
    and encoders are noisy.
    """
    at_rest = _at_rest(run)
    at_rest_steps = np.diff(at_rest, axis=0, prepend=False)
    dwell = np.cumsum(at_rest_steps, axis=0)
    names = [column.name for column in truth.model.columns]
    parameters = [
        truth.parameters[names.index(f"fs{joint + 1}")] for joint in range(at_rest.shape[1])
    ]
    dry = np.array(parameters)
    held = np.stack(
        [
            rng.uniform(-1.0, 1.0, dwell[-1, joint] + 1)[dwell[:, joint]]
            for joint in range(len(dry))
        ],
        axis=1,
    )
    torque = np.where(at_rest, dry * held, 0.0)
    noisy = run.position_rad + ENCODER_NOISE_RAD * rng.standard_normal(run.position_rad.shape)
    to_motor = truth.model.drive_train.to_motor
    current_a = run.current_a + torque @ to_motor.T / truth.gains
    position_rad = RESOLUTION_RAD * np.round(noisy / RESOLUTION_RAD)
    return replace(
        run,
        position_rad=position_rad,
        current_a=current_a,
    )


@pytest.fixture(scope="module")
def sticking(truth: Truth, noisy_runs: tuple[Run, ...]) -> tuple[Run, ...]:
    rng = np.random.default_rng(4)
    return tuple(_sticking(run, truth, rng) for run in noisy_runs)


def _gain_error(truth: Truth, runs: tuple[Run, ...], conditioning: Conditioning) -> float:
    gains = identify(truth.model, runs, conditioning).estimate.gains
    rms = np.sqrt(np.mean((gains / truth.gains - 1.0) ** 2))
    return float(rms)


def _derived(truth: Truth, run: Run) -> Dataset:
    return differentiate(run, truth.model.drive_train, DERIVED)


def test_it_distinguishes_rest_from_motion(
    truth: Truth, noisy_runs: tuple[Run, ...], sticking: tuple[Run, ...]
) -> None:
    for exact, run in zip(noisy_runs, sticking, strict=True):
        data = _derived(truth, run)
        # The low-pass smears the last of a move over some samples of the rest that follows.
        resting = np.apply_along_axis(
            lambda rest: np.convolve(rest, np.ones(61), "same") > 60.5, 0, _at_rest(exact)
        )
        assert resting.any(axis=0).all()
        assert not data.moving[resting[1:-1]].any()
        speed = np.abs(data.velocity_rad_s)
        speed_quantile = np.quantile(speed, 0.95, axis=0)
        assert data.moving[speed > 0.05 * speed_quantile].all()


@pytest.mark.slow
def test_gains_are_as_good_as_with_declared_speeds(truth: Truth, sticking: tuple[Run, ...]) -> None:
    # With noisy currents the two keep different rows, and their errors differ by chance.
    assert _gain_error(truth, sticking, DERIVED) < 1.3 * _gain_error(truth, sticking, CONDITIONING)


@pytest.mark.slow
def test_without_current_noise_only_standstill_biases_the_gains(
    truth: Truth, clean_runs: tuple[Run, ...]
) -> None:
    rng = np.random.default_rng(4)
    runs = tuple(_sticking(run, truth, rng) for run in clean_runs)
    derived, declared, never = (
        _gain_error(truth, runs, choice) for choice in (DERIVED, CONDITIONING, NEVER)
    )
    assert derived < 2e-4
    assert declared < 2e-4
    assert never > 1e-2


def test_no_row_that_counts_holds_more_rest_than_its_share(
    truth: Truth, clean_runs: tuple[Run, ...]
) -> None:
    # By the exact positions: the low-pass must not let a joint that rests pass for a moving one.
    strict = replace(DERIVED, standstill_share=0.05)
    for run in clean_runs:
        least = _largest_share_of_rest(truth, run, strict)
        most = _largest_share_of_rest(truth, run, DERIVED)
        assert least <= strict.standstill_share
        assert least < most <= DERIVED.standstill_share


def _largest_share_of_rest(truth: Truth, run: Run, conditioning: Conditioning) -> float:
    """Largest share of its dry friction that a row can have from a joint at rest,
    over all rows that count.
    """
    data = differentiate(run, truth.model.drive_train, conditioning)
    use, _ = row_masks(truth.model, data, conditioning)
    taps = row_filter(data, conditioning)
    absolute_tap = np.abs(taps.taps)
    weights = Decimator(absolute_tap, taps.factor)
    share = weights(_at_rest(run)[1:-1].T.astype(np.float64))
    return float(share[use].max())


@pytest.mark.parametrize("noise_rad", [0.0, ENCODER_NOISE_RAD, 1e-4])
def test_a_joint_that_is_held_never_moves(
    truth: Truth, noisy_runs: tuple[Run, ...], noise_rad: float
) -> None:
    position = noisy_runs[0].position_rad.copy()
    rng = np.random.default_rng(1)
    position[:, 3] = 0.7 + noise_rad * rng.standard_normal(len(position))
    changed_noisy_run = replace(noisy_runs[0], position_rad=position)
    held = [
        changed_noisy_run,
        replace(noisy_runs[1], position_rad=position),
    ]
    moving = _derived(truth, held[0]).moving
    assert not moving[:, 3].any()
    with pytest.raises(DataUnfit, match="J4 never moves"):
        identify(truth.model, held, DERIVED)


def test_a_zero_speed_is_declared_by_saying_so(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    moving = differentiate(noisy_runs[0], truth.model.drive_train, NEVER).moving
    assert moving.all()
