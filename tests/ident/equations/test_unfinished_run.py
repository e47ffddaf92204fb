"""Rows of a recording that goes on: each once, and as those of the finished recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ident.data.conditioning import decimator
from ident.data.run import Run
from ident.equations.unfinished_run import (
    SETTLED_PERIODS,
    NewRows,
    RunProgress,
    _samples_from,
    new_rows,
)
from ident.errors import DataUnfit
from tests.ident.pieces import first_samples, noisy_pieces
from tests.ident.recordings import CONDITIONING, Truth
from tests.ident.weighed import RATE_HZ

SMALL = replace(CONDITIONING, standstill_rad_s=CONDITIONING.standstill_rad_s[:3])
SECONDS = 6.0


@pytest.fixture(scope="module")
def run(small_truth: Truth) -> Run:
    made = noisy_pieces(small_truth, 4, count=1, seconds=SECONDS)[0]
    count = len(made.time_s)
    valid = np.ones((count, 3), dtype=np.bool_)
    move = np.arange(count) // 500
    temperature_c = np.linspace(20.0, 30.0, 3 * count).reshape(count, 3)
    return replace(made, move=move, valid=valid, temperature_c=temperature_c)


def so_far(run: Run, count: int) -> Run:
    assert run.move is not None
    assert run.valid is not None
    assert run.temperature_c is not None
    return replace(
        first_samples(run, count),
        move=run.move[:count],
        valid=run.valid[:count],
        temperature_c=run.temperature_c[:count],
    )


def look(truth: Truth, run: Run, before: RunProgress | None, *, complete: bool = False) -> NewRows:
    return new_rows(truth.model, run, SMALL, before, is_complete=complete)


def rows_used(found: NewRows) -> int:
    """Number of rows of the first axis that count."""
    if found.built is None:
        return 0
    return sum(int(rows.use[0].sum()) for rows in found.built[1])


def test_samples_before_a_row_are_left_out_of_every_signal(run: Run) -> None:
    part = _samples_from(run, 100)
    assert_allclose(part.time_s, run.time_s[100:])
    assert_allclose(part.position_rad, run.position_rad[100:])
    assert_allclose(part.current_a, run.current_a[100:])
    assert part.move is not None
    assert run.move is not None
    assert part.move.tolist() == run.move[100:].tolist()
    assert part.valid is not None
    assert len(part.valid) == len(run.time_s) - 100
    assert part.temperature_c is not None
    assert run.temperature_c is not None
    assert_allclose(part.temperature_c, run.temperature_c[100:])


def test_signals_that_a_run_does_not_have_stay_away(run: Run) -> None:
    bare = replace(run, move=None, valid=None, temperature_c=None)
    part = _samples_from(bare, 100)
    assert (part.move, part.valid, part.temperature_c) == (None, None, None)


def test_two_samples_have_no_rate(small_truth: Truth, run: Run) -> None:
    with pytest.raises(DataUnfit, match="2 samples; expected at least 3, for a sampling rate"):
        look(small_truth, so_far(run, 2), None)


def test_a_run_shorter_than_the_filters_waits(small_truth: Truth, run: Run) -> None:
    found = look(small_truth, so_far(run, 500), None)
    assert found.built is None
    assert found.progress.rows == 0
    assert not found.progress.is_complete
    assert found.progress.rate_hz == pytest.approx(RATE_HZ)


def test_the_newest_rows_wait_until_the_filter_has_settled(small_truth: Truth, run: Run) -> None:
    samples = len(run.time_s)
    filter_ = decimator(run.rate_hz, SMALL.decimation_cutoff_hz)
    settled = np.ceil(SETTLED_PERIODS * run.rate_hz / SMALL.position_cutoff_hz)
    unfinished = look(small_truth, run, None)
    finished = look(small_truth, run, None, complete=True)
    assert unfinished.progress.rows == filter_.rows(samples - 2 - int(settled))
    assert finished.progress.rows == filter_.rows(samples - 2)
    assert not unfinished.progress.is_complete
    assert finished.progress.is_complete


def test_rows_of_all_looks_are_those_of_the_finished_run(small_truth: Truth, run: Run) -> None:
    whole = look(small_truth, run, None, complete=True)
    before = None
    counted = 0
    products = np.zeros((3, 3))
    samples = len(run.time_s)
    for count in (samples // 2, samples // 2 + 1, 3 * samples // 4, samples):
        found = look(small_truth, so_far(run, count), before, complete=count == samples)
        before = found.progress
        counted += rows_used(found)
        products += current_products(found)
    assert before is not None
    assert (before.rows, before.is_complete) == (whole.progress.rows, True)
    assert counted == rows_used(whole)
    assert_allclose(products, current_products(whole), rtol=1e-9)


def current_products(found: NewRows) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Σ v vᵀ of the rows in which all motors count."""
    total = np.zeros((3, 3))
    if found.built is not None:
        for rows in found.built[1]:
            own = rows.current[:, rows.motor_use.all(axis=0)]
            total += own @ own.T
    return total


def test_a_look_without_a_new_row_gives_none(small_truth: Truth, run: Run) -> None:
    half = so_far(run, len(run.time_s) // 2)
    first = look(small_truth, half, None)
    again = look(small_truth, half, first.progress)
    assert again.built is None
    assert again.progress == first.progress
    ended = look(small_truth, half, replace(first.progress, rows=10_000), complete=True)
    assert ended.progress.is_complete


@pytest.mark.parametrize(("number", "continues"), [(7, True), (0, False)])
def test_rows_within_a_move_continue_it(
    small_truth: Truth, run: Run, number: int, continues: bool
) -> None:
    assert run.move is not None
    half = len(run.time_s) // 2
    first = look(small_truth, replace(so_far(run, half), move=np.full(half, 7)), None)
    assert not first.continues_move
    move = np.full(len(run.time_s), 7)
    filter_ = decimator(run.rate_hz, SMALL.decimation_cutoff_hz)
    # Samples of the rows that are new belong to the same move, or to another.
    move[first.progress.rows * filter_.factor :] = number
    second = look(small_truth, replace(run, move=move), first.progress)
    assert second.continues_move is continues
