"""Time stamps: uniform ones leave the samples alone, uneven ones are taken for what they are,
gaps are refused.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from daq.config.import_description import TimeColumn, TimeUnit
from daq.errors import TableUnfit
from daq.log.resampling import Clock, check_stamps, clock_of
from daq.log.table import Stamps, Table
from ident.arrays import FloatArray

AnyFloats = np.ndarray[tuple[Any, ...], np.dtype[np.floating[Any]]]

WANTED = TimeColumn(file="run.csv", column="t", unit=TimeUnit.SECOND)


def _clock(
    time_s: AnyFloats, wanted: TimeColumn = WANTED, numbers: FloatArray | None = None
) -> Clock:
    """The clock of these stamps; every row has numbers of its own unless they are given."""
    if numbers is None:
        time_count = float(len(time_s))
        numbers = np.arange(time_count)[:, None]
    stamps = Stamps(np.asarray(time_s, dtype=np.float64), 0)
    lines = range(2, 2 + len(time_s))
    table = Table(Path("run.csv"), (), numbers, "", stamps, lines)
    return clock_of(table, wanted, numbers)


def _steps(
    rng: np.random.Generator, count: int, steps_ms: tuple[int, ...] = (10, 12)
) -> FloatArray:
    """Stamps with random steps [s]."""
    cumulative = np.cumsum(rng.choice(steps_ms, count))
    return np.concatenate(([0.0], cumulative)) * 1e-3


@example(0.029366597839968218, 4, True, 0.0)
@given(st.floats(0.2e-3, 0.1), st.integers(2, 7), st.booleans(), st.floats(0.0, 1.0))
def test_a_uniform_clock_is_one_with_rounded_stamps_too(
    period_s: float, digits: int, down: bool, phase: float
) -> None:
    """Stamps of 2.5 ms in whole ms are 0, 2, 5, 7, 10: rounded, not uneven."""
    digit_s = 10.0**-digits
    if digit_s > 0.5 * period_s:
        return
    exact = (np.arange(500) + phase) * period_s / digit_s + 1e-6  # what is whole stays so
    time_s = (np.floor(exact) if down else np.rint(exact)) * digit_s
    time_difference_s = time_s - time_s[0]
    timing = check_stamps(time_difference_s)
    assert not timing.resampled
    assert timing.missing == 0
    assert timing.rate_hz * period_s == pytest.approx(1.0, abs=2.0 * digit_s / (499 * period_s))


def test_stamps_that_are_uniform_leave_the_samples_alone() -> None:
    time_s = np.arange(100) * 0.004
    clock = _clock(time_s)
    rng = np.random.default_rng(0)
    values = rng.normal(size=(100, 2))
    assert clock.positions(values) is values
    assert clock.currents(values) is values
    expected = 99 / time_s[-1]
    assert clock.timing.rate_hz == expected
    assert clock.timing.drift_s < 1e-12
    assert clock.row.tolist() == list(range(100))


def test_steps_of_10_and_12_ms() -> None:
    rng = np.random.default_rng(1)
    time_s = _steps(rng, 4000)
    clock = _clock(time_s)
    timing = clock.timing
    assert timing.resampled
    expected = 4000 / time_s[-1]
    assert timing.rate_hz == pytest.approx(expected)
    assert timing.longest_step_s == pytest.approx(0.012)
    assert timing.jitter_s == pytest.approx(1e-3, rel=0.02)
    assert timing.drift_s > 10e-3
    assert timing.missing == 0
    assert timing.duplicates == 0
    assert timing.close == 0
    assert len(clock.tick_s) == 4001
    tick_steps_s = np.diff(clock.tick_s)
    assert tick_steps_s == pytest.approx(1.0 / timing.rate_hz)

    def motion(at_s: FloatArray) -> FloatArray:
        return np.column_stack([np.sin(4.0 * at_s), np.cos(7.0 * at_s)])

    difference = clock.positions(motion(time_s)) - motion(clock.tick_s)
    error = np.abs(difference).max()
    assert error < 2e-6  # (ω h)⁴ / 384 of the quicker one, and a little at the ends
    largest_difference = np.abs(motion(time_s) - motion(clock.tick_s)).max()
    assert largest_difference > 100 * error
    largest_error = np.abs(clock.currents(motion(time_s)) - motion(clock.tick_s)).max()
    limit = (7.0 * 0.012) ** 2 / 8
    assert largest_error <= limit


def test_missing_samples_are_interpolated_and_the_others_stay() -> None:
    index = np.delete(np.arange(300), [57, 120, 121])
    clock = _clock(index * 1e-3)
    assert clock.timing.missing == 3
    assert clock.timing.rate_hz == pytest.approx(1000.0)
    values = np.sin(index / 30.0)[:, None]
    for resampled in (clock.positions(values), clock.currents(values)):
        assert len(resampled) == 300
        assert resampled[index] == pytest.approx(values, abs=1e-12)
        phase_rad = np.arange(300) / 30.0
        expected = np.sin(phase_rad)
        assert resampled[:, 0] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("row", [1, 40, 99])
def test_a_row_that_is_there_twice_counts_once(row: int) -> None:
    rows = np.insert(np.arange(99), row, row - 1)
    time_s = rows * 0.01
    clock = _clock(time_s, numbers=np.sin(rows)[:, None])
    assert clock.timing.duplicates == 1
    assert not clock.timing.resampled
    rows_sine = np.sin(rows)[clock.row].tolist()
    expected = np.sin(np.arange(99)).tolist()
    assert rows_sine == expected


def test_a_stamp_that_is_there_twice_with_other_numbers_is_refused() -> None:
    time_s = np.insert(np.arange(99), 40, 39) * 0.01
    with pytest.raises(
        TableUnfit,
        match=r"run.csv:42, column t: found the stamp of the row above, "
        r"with other numbers",
    ):
        _clock(time_s)


def test_stamps_that_go_back_are_refused() -> None:
    time_s = np.concatenate((np.arange(50), np.arange(50))) * 0.01
    with pytest.raises(
        TableUnfit,
        match=r"run.csv:52, column t: found a stamp "
        r"0.49 s before",
    ) as caught:
        _clock(time_s)
    assert "two recordings" in caught.value.remedy


def test_samples_that_come_at_once_are_not_used_for_a_speed() -> None:
    time_s = np.sort(np.append(np.arange(200) * 0.01, 0.5001))
    clock = _clock(time_s)
    assert clock.timing.close == 1
    assert 51 not in clock.row
    assert not clock.timing.resampled


@pytest.mark.parametrize(("periods", "allowed"), [(3, 3.0), (4, 3.0), (20, 3.0), (20, 25.0)])
def test_gaps(periods: int, allowed: float) -> None:
    time_s = np.concatenate((np.arange(100), 99 + periods + np.arange(100))) * 0.01
    wanted = replace(WANTED, largest_gap_periods=allowed)
    if periods <= allowed:
        missing = _clock(time_s, wanted).timing.missing
        assert missing == periods - 1
        return
    pattern = (
        r"run.csv:102, column t: found "
        rf"{periods * 0.01:g} s after"
    )
    with pytest.raises(
        TableUnfit,
        match=pattern,
    ) as caught:
        _clock(time_s, wanted)
    assert caught.value.expected == "at most 3 times the usual 0.01 s"
    assert "`largest_gap_periods`" in caught.value.remedy


@pytest.mark.parametrize(
    ("rate_hz", "resampled"), [(100.0, False), (100.001, False), (100.5, True), (125.0, True)]
)
def test_a_stated_rate(rate_hz: float, resampled: bool) -> None:
    time_s = np.arange(1001) * 0.01
    clock = _clock(time_s, replace(WANTED, rate_hz=rate_hz))
    assert clock.timing.rate_hz == rate_hz
    assert clock.timing.resampled is resampled
    if resampled:
        tick_steps_s = np.diff(clock.tick_s)
        assert tick_steps_s == pytest.approx(1.0 / rate_hz)
        assert 10.0 - 1.0 / rate_hz < clock.tick_s[-1] <= 10.0


@pytest.mark.parametrize("rate_hz", [49.0, 201.0, 1000.0])
def test_a_stated_rate_far_from_that_of_the_stamps_is_refused(rate_hz: float) -> None:
    time_s = np.arange(1001) * 0.01
    with pytest.raises(TableUnfit, match="found stamps at 100 Hz"):
        _clock(time_s, replace(WANTED, rate_hz=rate_hz))


def test_a_column_that_is_no_time_is_refused() -> None:
    numbers = np.zeros((50, 1))
    time_s = np.zeros(50)
    with pytest.raises(TableUnfit, match="1 different time stamp in 50 rows"):
        _clock(time_s, numbers=numbers)
