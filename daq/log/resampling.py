"""Sample times: judge the stamps of a recording, and resample it to a uniform clock.

Everything after a log assumes evenly spaced samples, as central differences do. A stamp is the time
of its sample: positions at the ticks of a uniform clock come from a cubic spline through the
samples, currents from straight lines between them. Where the stamps show a uniform clock, the
samples stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

# Loads scipy.interpolate when it is first used: half of the time of an import without a spline
import scipy

from daq.config.import_description import RATES_HZ, TimeColumn
from daq.errors import TableUnfit
from daq.log.metadata import Timing
from daq.log.table import Table
from ident.arrays import BoolArray, FloatArray, IntArray

#: Largest distance of a stamp from a uniform clock that leaves the samples as they are [periods]
EVEN = 1e-3
#: Spread of the rounded stamps of a uniform clock [units of their last digit]: 1, and what the fit
#: adds
COARSE = 1.5
#: Steps this near to whole numbers of the usual one mean that samples are missing, not late [usual
#: steps]
NEAR = 0.25
#: Shortest step between two samples [usual steps]; a spline through closer ones amplifies their
#: noise
CLOSEST = 0.1
RATE_CHANGE = 0.1
RATE_NOISE = 6.0
"""Largest change of the rate within a recording, beyond so many deviations of what jitter does to
the mean of a window. A controller samples at one rate: stamps of another are of a clock that
drifts, and scale velocities and inertias.
"""
RATE_WINDOWS, SHORTEST_WINDOW = 20, 50  #: Windows of a recording, and the fewest steps of one
SLOWEST = 0.5
QUICKEST = 2.0
"""Rates that may be stated, in multiples of the data's:
far below, noise folds into the band of the motion.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Clock:
    """Sample times of the rows of a recording that are used,
    and the ticks that they are resampled to.
    """

    row: IntArray  #: rows of the file that are used, shape (k,)
    time_s: FloatArray  #: their stamps since the first one [s], increasing, shape (k,)
    tick_s: FloatArray  #: ticks of the uniform clock [s], shape (m,)
    timing: Timing  #: what the stamps showed

    def positions(self, values: FloatArray) -> FloatArray:
        """Return positions at the ticks, shape (m, n), by a cubic spline through those of the rows,
        shape (k, n).
        """
        if not self.timing.resampled:
            return values
        return scipy.interpolate.CubicSpline(self.time_s, values)(self.tick_s)

    def currents(self, values: FloatArray) -> FloatArray:
        """Return currents at the ticks, shape (m, n), by straight lines between those of the rows,
        shape (k, n).
        """
        if not self.timing.resampled:
            return values
        resampled = [np.interp(self.tick_s, self.time_s, column) for column in values.T]
        return np.column_stack(resampled)


def on_clock(values: FloatArray, clock: Clock | None) -> FloatArray:
    """Move columns of the file, shape (rows, n), to the samples of the log, shape (k, n)."""
    if clock is None:
        return values
    return clock.currents(values[clock.row])


def clock_of(table: Table, wanted: TimeColumn, numbers: FloatArray) -> Clock:
    """Return the clock of a recording.

    Rows that repeat the one before, stamp and all, are left out; so are samples CLOSEST to the one
    before.

    Args:
        table: the file with the stamps.
        wanted: the time column; its rate is that of the ticks, if it has one.
        numbers: everything that is imported, shape (k, c).

    Raises:
        TableUnfit: a stamp is earlier than the one before, or repeats it with other numbers; a step
            is longer than `largest_gap_periods`; the rate is outside RATES_HZ, or changes by more
            than RATE_CHANGE; or the stated rate is far from that of the stamps.
    """
    assert table.stamps is not None  # its reader was asked for them
    row = np.flatnonzero(_distinct(table, wanted, numbers))
    time_s = table.stamps.time_s[row]
    duplicates = len(numbers) - len(row)
    step_s = np.diff(time_s, prepend=-np.inf)
    far = step_s >= CLOSEST * np.median(step_s)
    row = row[far]
    time_s = time_s[far]
    if len(row) < 3:
        raise TableUnfit(
            str(table.path),
            found=f"{len(row)} different time stamps in {len(numbers)} rows",
            expected="one for each sample",
            remedy="correct `column` and `unit` of `time` in the import description, or give "
            "rate_hz instead",
        )
    close = int(np.count_nonzero(~far))
    timing = check_stamps(time_s)
    timing = replace(timing, rows=len(numbers), duplicates=duplicates, close=close)
    lowest_hz = RATES_HZ[0] * (1.0 - EVEN)
    highest_hz = RATES_HZ[1] * (1.0 + EVEN)
    if not lowest_hz <= timing.rate_hz <= highest_hz:
        raise TableUnfit(
            f"{table.path}, column {wanted.column}",
            found=f"stamps at {timing.rate_hz:.4g} Hz with `unit: {wanted.unit.value}`",
            expected=f"{RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz",
            remedy="correct `unit` of `time` in the import description: is it s, ms, us or ns?",
        )
    _check_gaps(table, wanted, row, time_s, timing)
    _check_rate(table, wanted, time_s)
    if wanted.rate_hz is not None:
        timing = _at_rate(table, wanted, wanted.rate_hz, time_s, timing)
    last_tick = int(time_s[-1] * timing.rate_hz + EVEN)
    tick_s = np.arange(last_tick + 1) / timing.rate_hz
    tick_s = np.minimum(tick_s, time_s[-1])
    return Clock(row, time_s, tick_s, timing)


def check_stamps(time_s: FloatArray) -> Timing:
    """Judge time stamps.

    Args:
        time_s: stamps since the first one [s], increasing, shape (k,) with k > 1.

    Returns:
        the timing. Its rate is that of the usual step where every step is nearly a whole number of
        them, else the mean rate.
    """
    step_s = np.diff(time_s)
    periods, usual_s = _periods(step_s)
    rate_hz = float(periods.sum() / time_s[-1])
    missing = round(float(periods.sum())) - len(step_s)
    clock_periods = np.concatenate(([0.0], np.cumsum(periods)))
    clock_s = clock_periods / rate_hz
    jitter_s = np.std(step_s - periods / rate_hz)
    drift_s = np.abs(time_s - clock_s).max()
    is_uniform = missing <= 0 and _is_uniform(time_s)
    return Timing(
        rows=len(time_s),
        rate_hz=rate_hz,
        usual_step_s=usual_s,
        longest_step_s=float(step_s.max()),
        jitter_s=float(jitter_s),
        drift_s=float(drift_s),
        missing=missing,
        resampled=not is_uniform,
    )


def _periods(step_s: FloatArray) -> tuple[FloatArray, float]:
    """Return each step in usual steps, shape (k,), all ones where they are not nearly whole;
    and the usual step [s].
    """
    usual_s = float(np.median(step_s))
    periods = np.rint(step_s / usual_s)
    distance = np.abs(step_s / usual_s - periods)
    if not np.all((periods >= 1.0) & (distance < NEAR)):
        periods = np.ones_like(step_s)
    return periods, usual_s


def _check_rate(table: Table, wanted: TimeColumn, time_s: FloatArray) -> None:
    """Refuse stamps whose rate drifts or jumps;
    jitter and missing samples leave its mean over a window alone.
    """
    step_s = np.diff(time_s)
    periods, _ = _periods(step_s)
    period_s = step_s / periods
    width = max(SHORTEST_WINDOW, len(period_s) // RATE_WINDOWS)
    count = len(period_s) // width
    if count < 2:
        return
    windows = period_s[: count * width].reshape(count, width)
    mean_s = windows.mean(axis=1)
    jitter_s = float(np.median(windows.std(axis=1)))
    noise = RATE_NOISE * jitter_s / (np.sqrt(width) * float(mean_s.mean()))
    change = mean_s.max() / mean_s.min() - 1.0
    if change > RATE_CHANGE + noise:
        slowest_hz = 1.0 / mean_s.max()
        quickest_hz = 1.0 / mean_s.min()
        raise TableUnfit(
            f"{table.path}, column {wanted.column}",
            found=f"stamps at {slowest_hz:.4g} to {quickest_hz:.4g} Hz in parts of the recording",
            expected=f"one rate, to {100.0 * RATE_CHANGE:g} %",
            remedy="if these are times of arrival, give rate_hz instead of time; else import the "
            "parts of one rate as recordings of their own",
        )


def _is_uniform(time_s: FloatArray) -> bool:
    """Whether stamps show a uniform clock: exactly, or rounded to a decimal digit.

    Rounding makes steps of two kinds, one unit of the digit apart, and moves every stamp by less
    than one unit.
    """
    middle = 0.5 * (len(time_s) - 1)
    index = np.arange(len(time_s)) - middle
    period_s = float(index @ time_s / (index @ index))
    spread_s = float(np.ptp(time_s - period_s * index))
    if spread_s <= 2.0 * EVEN * period_s:
        return True
    for digit_s in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        digits = time_s / digit_s
        whole = np.rint(digits)
        if np.all(np.abs(digits - whole) < 1e-3):
            has_two_steps = np.ptp(np.diff(whole)) <= 1.0
            return bool(has_two_steps and spread_s <= COARSE * digit_s)
    return False


def _at_rate(
    table: Table, wanted: TimeColumn, rate_hz: float, time_s: FloatArray, timing: Timing
) -> Timing:
    """Return the timing with a stated rate; samples stay as they are if it agrees to half a period
    over the file.
    """
    if not SLOWEST <= rate_hz / timing.rate_hz <= QUICKEST:
        raise TableUnfit(
            f"{table.path}, column {wanted.column}",
            found=f"stamps at {timing.rate_hz:.6g} Hz",
            expected=f"a rate near the stated {rate_hz:g} Hz: at least half and at most "
            "twice as large",
            remedy="correct `rate_hz` or `unit` of `time` in the import description",
        )
    ahead = float(time_s[-1]) * abs(rate_hz - timing.rate_hz)  # periods at the last stamp
    drift_s = max(timing.drift_s, ahead / rate_hz)
    resampled = timing.resampled or ahead >= 0.5
    return replace(timing, rate_hz=rate_hz, drift_s=drift_s, resampled=resampled)


def _distinct(table: Table, wanted: TimeColumn, numbers: FloatArray) -> BoolArray:
    """Return which rows are not the row before once more, shape (k,)."""
    assert table.stamps is not None
    step_s = np.diff(table.stamps.time_s)
    has_equal_numbers = np.all(numbers[1:] == numbers[:-1], axis=1)
    repeated = (step_s == 0.0) & has_equal_numbers
    wrong = (step_s <= 0.0) & ~repeated
    if wrong.any():
        row = int(np.argmax(wrong)) + 1
        back_s = -float(step_s[row - 1])
        if back_s:
            found = f"a stamp {back_s:.6g} s before that of the row above"
            remedy = "were two recordings joined? import each by `keep` of the import description"
        else:
            found = "the stamp of the row above, with other numbers"
            remedy = (
                "delete the row that is wrong; if the stamps are coarse, give rate_hz instead of "
                "time; in a bag, do two nodes publish the same joints on the topic?"
            )
        place = table.place(row, wanted.column)
        raise TableUnfit(place, found=found, expected="stamps that increase", remedy=remedy)
    return np.concatenate(([True], ~repeated))


def _check_gaps(
    table: Table, wanted: TimeColumn, row: IntArray, time_s: FloatArray, timing: Timing
) -> None:
    """Refuse gaps: nothing is known of the motion in them."""
    step_s = np.diff(time_s)
    longest_s = wanted.largest_gap_periods * timing.usual_step_s * (1.0 + EVEN)
    gaps = np.flatnonzero(step_s > longest_s)
    if gaps.size:
        first = int(gaps[0])
        found = f"{step_s[first]:.6g} s after the sample before"
        if len(gaps) > 1:
            found += f", and {len(gaps) - 1} more gaps"
        raise TableUnfit(
            table.place(int(row[first + 1]), wanted.column),
            found=found,
            expected=f"at most {wanted.largest_gap_periods:g} times the usual "
            f"{timing.usual_step_s:.6g} s",
            remedy="samples are missing: import the parts before and after it as two recordings, "
            "by `keep`, or allow the gap with `largest_gap_periods` of `time`; if these are times "
            "of arrival, give rate_hz instead of time",
        )
