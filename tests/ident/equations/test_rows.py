"""Rows of the equations: what the filter's windows let through, and what they leave out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ident.arrays import BoolArray, FloatArray
from ident.data.conditioning import Decimator, decimator, torque_rows
from ident.data.dataset import Dataset, differentiate
from ident.data.run import Run
from ident.equations.rows import at_rows, chunks, motor_columns, row_filter, row_masks
from ident.errors import DataUnfit
from ident.model.model import DriveTrain
from tests.ident.recordings import CONDITIONING, Truth

SMALL = replace(CONDITIONING, standstill_rad_s=CONDITIONING.standstill_rad_s[:3])
"""For the arm of three axes."""


@pytest.fixture(scope="module")
def data(small_truth: Truth, small_runs: tuple[Run, ...]) -> Dataset:
    return differentiate(small_runs[0], small_truth.model.drive_train, SMALL)


def _windows(data: Dataset) -> tuple[FloatArray, list[slice]]:
    """Weight of each sample of a window, positive and summing to one,
    and the samples of each row.
    """
    filter_ = decimator(data.rate_hz, SMALL.decimation_cutoff_hz)
    size = np.abs(filter_.taps)
    starts = filter_.factor * np.arange(filter_.rows(len(data.time_s)))
    return size / size.sum(), [slice(start, start + len(size)) for start in starts.tolist()]


def _share(weights: FloatArray, windows: list[slice], flags: BoolArray) -> FloatArray:
    """Weighted share of the samples of each window of which a flag is set."""
    return np.array([float(weights @ flags[window]) for window in windows])


def test_a_row_counts_where_standstill_has_a_small_share_of_its_window(
    small_truth: Truth, data: Dataset
) -> None:
    use, _ = row_masks(small_truth.model, data, SMALL)
    weights, windows = _windows(data)
    for axis in range(3):
        share = _share(weights, windows, ~data.moving[:, axis])
        # No row is at the limit itself, where rounding decides.
        share_difference = np.abs(share - SMALL.standstill_share)
        assert share_difference.min() > 1e-12
        expected = share <= SMALL.standstill_share
        assert expected.any()
        assert not expected.all()
        assert np.array_equal(use[axis], expected)


def test_one_invalid_sample_takes_every_row_whose_window_has_it(
    small_truth: Truth, data: Dataset
) -> None:
    usable, _ = row_masks(small_truth.model, data, SMALL)
    weights, windows = _windows(data)
    sample = windows[int(np.flatnonzero(usable[1])[5])].start + len(weights) // 2
    valid = data.valid.copy()
    valid[sample, 1] = False
    use, motor_use = row_masks(small_truth.model, replace(data, valid=valid), SMALL)
    inside = np.array([window.start <= sample < window.stop for window in windows])
    seen = _share(weights, windows, ~valid[:, 1]) > 0.0
    assert seen.sum() >= inside.sum() - 2  # an outer tap may be zero
    assert not use[1][seen].any()
    assert np.array_equal(use[1][~seen], usable[1][~seen])
    assert np.array_equal(use[0], usable[0])
    assert not motor_use[1][seen].any()


def _masks_of_gears(
    truth: Truth, data: Dataset, ratio: FloatArray, axis: int
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Masks of an arm with these gears that always moves, where an axis has a stretch that is not
    valid, and the rows that see the stretch.
    """
    model = replace(truth.model, drive_train=DriveTrain(ratio))
    everywhere = np.ones_like(data.valid)
    moving = replace(data, valid=everywhere, moving=everywhere, motor_moving=everywhere)
    valid = everywhere.copy()
    valid[2000:2500, axis] = False
    weights, windows = _windows(data)
    seen = _share(weights, windows, ~valid[:, axis]) > 0.0
    use, motor_use = row_masks(model, replace(moving, valid=valid), SMALL)
    return use, motor_use, seen


def test_a_wrong_current_of_a_coupled_motor_takes_the_rows_of_all_joints_that_it_turns(
    small_truth: Truth, data: Dataset
) -> None:
    ratio = np.diag([40.0, 50.0, 45.0])
    ratio[2, 1] = 45.0  # motor 3 turns joints 2 and 3
    use, motor_use, seen = _masks_of_gears(small_truth, data, ratio, axis=2)
    assert seen.any()
    assert use[0].all()
    assert np.array_equal(use[1], ~seen)
    assert np.array_equal(use[2], ~seen)
    assert not motor_use[2][seen].any()
    assert motor_use[0].all()


def test_a_wrong_current_of_a_motor_that_drives_another_joint_takes_the_rows_of_that_joint(
    small_truth: Truth, data: Dataset
) -> None:
    ratio = np.diag([0.0, 0.0, 45.0])
    ratio[0, 1] = 50.0
    ratio[1, 0] = 40.0
    use, motor_use, seen = _masks_of_gears(small_truth, data, ratio, axis=0)
    assert seen.any()
    assert not motor_use[0][seen].any()
    assert not use[1][seen].any()
    assert use[2].all()
    assert motor_use[2].all()


def test_no_row_behind_a_filtered_current_has_torques_of_unknown_positions(
    small_truth: Truth, data: Dataset
) -> None:
    filtered = replace(SMALL, current_cutoff_hz=3.0)
    everywhere = np.ones_like(data.valid)
    moving = replace(data, valid=everywhere, moving=everywhere, motor_moving=everywhere)
    first = 3000
    last = first + round(0.3 * data.rate_hz)
    valid = everywhere.copy()
    valid[first:last] = False
    of_torque = torque_rows(data.rate_hz, filtered)
    changed = of_torque(np.where(valid[:, 0], 0.0, 1.0))
    use, motor_use = row_masks(small_truth.model, replace(moving, valid=valid), filtered)
    assert not use[:, np.abs(changed) > 0.0].any()
    assert not motor_use[:, np.abs(changed) > 0.0].any()
    assert use[:, np.abs(changed) == 0.0].any()
    # A current that is wrong by itself stays out of its own window alone.
    valid = everywhere.copy()
    valid[first:last, 1] = False
    use, _ = row_masks(small_truth.model, replace(moving, valid=valid), filtered)
    assert use[0].all()
    assert use[1, np.abs(changed) > 0.0].any()


def test_a_motor_at_rest_has_no_row_while_its_joint_moves(
    small_truth: Truth, data: Dataset
) -> None:
    motor_moving = data.motor_moving.copy()
    motor_moving[:, 2] = False
    use, motor_use = row_masks(small_truth.model, replace(data, motor_moving=motor_moving), SMALL)
    assert use[2].any()
    assert not motor_use[2].any()
    assert motor_use[0].any()


def test_the_motion_at_the_rows_is_that_at_the_centres_of_their_windows(data: Dataset) -> None:
    rows = at_rows(data, SMALL)
    centres = decimator(data.rate_hz, SMALL.decimation_cutoff_hz).centres(len(data.time_s))
    assert_allclose(rows.time_s, data.time_s[centres], atol=1e-9)
    median_time_s_step = np.median(np.diff(rows.time_s))
    assert rows.rate_hz == pytest.approx(1.0 / median_time_s_step)
    # A slow motion passes the filter.
    assert_allclose(rows.position_rad, data.position_rad[centres], atol=2e-3)
    assert rows.velocity_rad_s.shape == rows.position_rad.shape
    assert rows.temperature_c is None


def test_temperatures_are_at_the_rows_too(data: Dataset) -> None:
    temperature_c = np.full(data.position_rad.shape, 40.0)
    warm = replace(data, temperature_c=temperature_c)
    rows = at_rows(warm, SMALL)
    assert rows.temperature_c is not None
    assert_allclose(rows.temperature_c, 40.0, rtol=1e-9)


def test_a_run_of_fewer_than_ten_rows_is_refused(data: Dataset) -> None:
    filter_ = decimator(data.rate_hz, SMALL.decimation_cutoff_hz)
    enough = 2 * filter_.half + 9 * filter_.factor + 1
    assert filter_.rows(enough) == 10
    ten = replace(data, time_s=data.time_s[:enough])
    assert row_filter(ten, SMALL) == filter_
    with pytest.raises(DataUnfit, match="too short to decimate"):
        row_filter(replace(data, time_s=data.time_s[: enough - 1]), SMALL)


@pytest.mark.parametrize("chunk_rows", [1, 3, 7, 1000])
def test_pieces_have_every_window_once_and_whole(chunk_rows: int) -> None:
    taps = np.full(9, 1.0 / 9.0)
    filter_ = Decimator(taps, 4)
    samples = np.arange(103.0)
    pieces = [filter_(samples[part]) for part in chunks(filter_, len(samples), chunk_rows)]
    assert_allclose(np.concatenate(pieces), filter_(samples), rtol=1e-12)
    assert all(len(piece) <= chunk_rows for piece in pieces)


def test_the_columns_of_a_motor_are_a_row_of_the_drive_train_times_the_joints() -> None:
    rng = np.random.default_rng(1)
    joints = rng.normal(size=(4, 5, 20))
    to_motor = np.array([0.0, 2.0, 0.0, -0.5])
    # Σ_j T_ij W_jcr
    expected = np.einsum("j,jcr->cr", to_motor, joints)
    assert_allclose(motor_columns(to_motor, joints.__getitem__), expected, rtol=1e-12)
