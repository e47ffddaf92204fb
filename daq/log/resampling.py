"""Sample times: judge the stamps of a recording, and resample it to a uniform clock.

Everything after a log assumes evenly spaced samples, as central differences do. A stamp is the time
of its sample: positions at the ticks of a uniform clock come from a cubic spline through the
samples, currents from straight lines between them. If the stamps already show a uniform clock, the
samples are used as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

# Loads scipy.interpolate when it is first used: half of the time of an import without a spline
import scipy

from daq.config.import_description import RATES_HZ, TimeColumn
from daq.errors import TableUnfit, counted
from daq.log.metadata import Timing
from daq.log.table import Table
from ident.arrays import BoolArray, FloatArray, IntArray

#: Largest distance of a stamp from a uniform clock at which the samples are not resampled [periods]
UNIFORM_TOLERANCE = 1e-3
#: Largest range of the differences between the rounded stamps of a uniform clock and the clock
#: [units of their last digit]: 1 by rounding, and what the fitted period adds
ROUNDED_RANGE = 1.5
#: Largest distance of a step from an integer number of usual steps at which samples are missing; if
#: it is larger, they are late [usual steps]
INTEGER_TOLERANCE = 0.25
#: Shortest step between two samples; a spline through closer ones amplifies their noise [usual
#: steps]
SHORTEST_STEP = 0.1
#: Largest relative change of the rate within a recording. A controller samples at one rate: stamps
#: of two rates come from a clock that drifts, and they scale velocities and inertias.
LARGEST_RATE_CHANGE = 0.1
#: Change of the rate that jitter may cause in addition [σ of the mean of a window]
RATE_NOISE_SIGMAS = 6.0
RATE_WINDOWS = 20  #: Number of windows of a recording in which its rate is compared
SHORTEST_WINDOW = 50  #: Fewest steps of such a window
#: Limits of a stated rate over the rate of the stamps. Far below the rate of the stamps, noise
#: aliases into the band of the motion.
SMALLEST_RATE_RATIO = 0.5
LARGEST_RATE_RATIO = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Clock:
    """Sample times of the rows of a recording that are used,
    and the ticks that they are resampled to.
    """

    row: IntArray  #: rows of the file that are used, shape (k,)
    time_s: FloatArray  #: their stamps since the first one [s], increasing, shape (k,)
    tick_s: FloatArray  #: ticks of the uniform clock [s], shape (m,)
    timing: Timing  #: rate, jitter and gaps of the stamps

    def positions(self, values: FloatArray) -> FloatArray:
        """Interpolate positions by a cubic spline.

        Args:
            values: positions of the rows, shape (k, n).

        Returns:
            positions at the ticks, shape (m, n).
        """
        if not self.timing.resampled:
            return values
        spline = scipy.interpolate.CubicSpline(self.time_s, values)
        return spline(self.tick_s)

    def currents(self, values: FloatArray) -> FloatArray:
        """Interpolate currents by straight lines.

        Args:
            values: currents of the rows, shape (k, n).

        Returns:
            currents at the ticks, shape (m, n).
        """
        if not self.timing.resampled:
            return values
        columns = []
        for column in values.T:
            resampled = np.interp(self.tick_s, self.time_s, column)
            columns.append(resampled)
        return np.column_stack(columns)


def on_clock(values: FloatArray, clock: Clock | None) -> FloatArray:
    """Move columns of the file, shape (rows, n), to the samples of the log, shape (k, n)."""
    if clock is None:
        return values
    return clock.currents(values[clock.row])


def clock_of(table: Table, wanted: TimeColumn, numbers: FloatArray) -> Clock:
    """Return the clock of a recording.

    Two kinds of rows are left out: those that repeat the row before with its stamp, and those
    that are nearer to the row before than SHORTEST_STEP.

    Args:
        table: the file with the stamps.
        wanted: description of the time column; if it states a rate, the ticks have this rate.
        numbers: everything that is imported, shape (k, c).

    Raises:
        TableUnfit: a stamp is earlier than the one before, or repeats it with other numbers; a step
            is longer than `largest_gap_periods`; the rate is outside RATES_HZ, or changes by more
            than LARGEST_RATE_CHANGE; or the stated rate is far from that of the stamps.
    """
    assert table.stamps is not None  # the description names a time column, so the reader has it
    is_new = _is_new_row(table, wanted, numbers)
    row = np.flatnonzero(is_new)
    duplicates = len(numbers) - len(row)
    time_s = table.stamps.time_s[row]
    # The first row has no row before it, and an infinite step.
    step_s = np.diff(time_s, prepend=-np.inf)
    shortest_s = SHORTEST_STEP * np.median(step_s)
    is_far = step_s >= shortest_s
    close = int(np.count_nonzero(~is_far))
    row = row[is_far]
    time_s = time_s[is_far]
    if len(row) < 3:
        stamps = counted(len(row), "different time stamp")
        rows = counted(len(numbers), "row")
        raise TableUnfit(
            str(table.path),
            found=f"{stamps} in {rows}",
            expected="one for each sample",
            remedy="correct `column` and `unit` of `time` in the import description, or give "
            "rate_hz instead",
        )
    timing = check_stamps(time_s)
    timing = replace(timing, rows=len(numbers), duplicates=duplicates, close=close)
    _check_range_of_rate(table, wanted, timing)
    _check_gaps(table, wanted, row, time_s, timing)
    _check_constant_rate(table, wanted, time_s)
    if wanted.rate_hz is not None:
        timing = _at_rate(table, wanted, wanted.rate_hz, time_s, timing)
    last_s = time_s[-1]
    last_tick = int(last_s * timing.rate_hz + UNIFORM_TOLERANCE)
    tick_s = np.arange(last_tick + 1) / timing.rate_hz
    tick_s = np.minimum(tick_s, last_s)  # a spline does not extrapolate
    return Clock(row, time_s, tick_s, timing)


def _check_range_of_rate(table: Table, wanted: TimeColumn, timing: Timing) -> None:
    """Refuse a rate that no controller samples at: the unit of the stamps is another one."""
    lowest_hz, highest_hz = RATES_HZ
    # The rate comes from stamps, so its limits have the tolerance of stamps.
    smallest_hz = lowest_hz * (1.0 - UNIFORM_TOLERANCE)
    largest_hz = highest_hz * (1.0 + UNIFORM_TOLERANCE)
    if not smallest_hz <= timing.rate_hz <= largest_hz:
        raise TableUnfit(
            f"{table.path}, column {wanted.column}",
            found=f"stamps at {timing.rate_hz:.4g} Hz with `unit: {wanted.unit.value}`",
            expected=f"{lowest_hz:g} to {highest_hz:g} Hz",
            remedy="correct `unit` of `time` in the import description: is it s, ms, us or ns?",
        )


def check_stamps(time_s: FloatArray) -> Timing:
    """Judge time stamps.

    Args:
        time_s: stamps since the first one [s], increasing, shape (k,) with k > 1.

    Returns:
        the timing. Its rate is the number of periods over the duration. A step counts as several
            periods if every step is nearly an integer number of usual steps; else each is one.
    """
    step_s = np.diff(time_s)
    periods, usual_s = _periods(step_s)
    period_count = float(periods.sum())
    rate_hz = float(period_count / time_s[-1])
    missing = round(period_count) - len(step_s)
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
    """Return the number of periods in each step, and the usual step.

    Args:
        step_s: steps between the stamps [s], shape (k,).

    Returns:
        integer numbers of periods, shape (k,), all 1 where one step is no such number; and the
            usual step [s].
    """
    usual_s = float(np.median(step_s))
    steps = step_s / usual_s
    periods = np.rint(steps)
    is_near = np.abs(steps - periods) < INTEGER_TOLERANCE
    if not np.all((periods >= 1.0) & is_near):
        periods = np.ones_like(step_s)
    return periods, usual_s


def _check_constant_rate(table: Table, wanted: TimeColumn, time_s: FloatArray) -> None:
    """Refuse stamps if their rate drifts or jumps.

    The rate is compared between windows: jitter and missing samples do not change its mean over a
    window.
    """
    step_s = np.diff(time_s)
    periods, _ = _periods(step_s)
    period_s = step_s / periods
    window_steps = max(SHORTEST_WINDOW, len(period_s) // RATE_WINDOWS)
    window_count = len(period_s) // window_steps
    if window_count < 2:
        return
    used_s = period_s[: window_count * window_steps]
    windows_s = used_s.reshape(window_count, window_steps)
    mean_s = windows_s.mean(axis=1)
    std_s = windows_s.std(axis=1)
    jitter_s = float(np.median(std_s))
    usual_s = float(mean_s.mean())
    noise = RATE_NOISE_SIGMAS * jitter_s / (np.sqrt(window_steps) * usual_s)
    change = mean_s.max() / mean_s.min() - 1.0
    if change > LARGEST_RATE_CHANGE + noise:
        slowest_hz = 1.0 / mean_s.max()
        quickest_hz = 1.0 / mean_s.min()
        raise TableUnfit(
            f"{table.path}, column {wanted.column}",
            found=f"stamps at {slowest_hz:.4g} to {quickest_hz:.4g} Hz in parts of the recording",
            expected=f"one rate, to {100.0 * LARGEST_RATE_CHANGE:g} %",
            remedy="if these are times of arrival, give rate_hz instead of time; else import the "
            "parts of one rate as recordings of their own",
        )


def _is_uniform(time_s: FloatArray) -> bool:
    """Return whether stamps show a uniform clock: exactly, or rounded to a decimal digit.

    Rounding makes steps of two lengths that differ by one unit of the digit, and moves every stamp
    by less than one unit.
    """
    middle = 0.5 * (len(time_s) - 1)
    index = np.arange(len(time_s)) - middle
    # Slope of the straight line through the stamps, by least squares.
    period_s = float(index @ time_s / (index @ index))
    range_s = float(np.ptp(time_s - period_s * index))
    if range_s <= 2.0 * UNIFORM_TOLERANCE * period_s:
        return True
    for unit_s in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        units = time_s / unit_s
        rounded = np.rint(units)
        distance = np.abs(units - rounded)
        if np.all(distance < 1e-3):
            has_two_steps = np.ptp(np.diff(rounded)) <= 1.0
            is_near = range_s <= ROUNDED_RANGE * unit_s
            return bool(has_two_steps and is_near)
    return False


def _at_rate(
    table: Table, wanted: TimeColumn, rate_hz: float, time_s: FloatArray, timing: Timing
) -> Timing:
    """Return the timing with a stated rate.

    The samples are resampled if the stated rate and that of the stamps differ by half a period or
    more at the end of the file.
    """
    ratio = rate_hz / timing.rate_hz
    if not SMALLEST_RATE_RATIO <= ratio <= LARGEST_RATE_RATIO:
        raise TableUnfit(
            f"{table.path}, column {wanted.column}",
            found=f"stamps at {timing.rate_hz:.6g} Hz",
            expected=f"a rate near the stated {rate_hz:g} Hz: at least half and at most "
            "twice as large",
            remedy="correct `rate_hz` or `unit` of `time` in the import description",
        )
    last_s = float(time_s[-1])
    difference_periods = last_s * abs(rate_hz - timing.rate_hz)
    drift_s = max(timing.drift_s, difference_periods / rate_hz)
    resampled = timing.resampled or difference_periods >= 0.5
    return replace(timing, rate_hz=rate_hz, drift_s=drift_s, resampled=resampled)


def _is_new_row(table: Table, wanted: TimeColumn, numbers: FloatArray) -> BoolArray:
    """Return for each row whether it differs from the row before, shape (k,).

    Raises:
        TableUnfit: a stamp is earlier than the one before, or repeats it with other numbers.
    """
    assert table.stamps is not None
    step_s = np.diff(table.stamps.time_s)
    has_equal_numbers = np.all(numbers[1:] == numbers[:-1], axis=1)
    is_repeated = (step_s == 0.0) & has_equal_numbers
    is_wrong = (step_s <= 0.0) & ~is_repeated
    if is_wrong.any():
        first_wrong = int(np.argmax(is_wrong))
        row = first_wrong + 1  # step i leads to row i + 1
        backwards_s = -float(step_s[first_wrong])
        if backwards_s:
            found = f"a stamp {backwards_s:.6g} s before that of the row above"
            remedy = "were two recordings joined? import each by `keep` of the import description"
        else:
            found = "the stamp of the row above, with other numbers"
            remedy = (
                "delete the row that is wrong; if the stamps are coarse, give rate_hz instead of "
                "time; in a bag, do two nodes publish the same joints on the topic?"
            )
        place = table.place(row, wanted.column)
        raise TableUnfit(place, found=found, expected="stamps that increase", remedy=remedy)
    return np.concatenate(([True], ~is_repeated))


def _check_gaps(
    table: Table, wanted: TimeColumn, row: IntArray, time_s: FloatArray, timing: Timing
) -> None:
    """Refuse gaps: nothing is known of the motion in them."""
    step_s = np.diff(time_s)
    longest_s = wanted.largest_gap_periods * timing.usual_step_s
    longest_s *= 1.0 + UNIFORM_TOLERANCE
    gaps = np.flatnonzero(step_s > longest_s)
    if gaps.size:
        first = int(gaps[0])
        found = f"{step_s[first]:.6g} s after the sample before"
        if len(gaps) > 1:
            found += f", and {len(gaps) - 1} more gaps"
        row_after = int(row[first + 1])
        raise TableUnfit(
            table.place(row_after, wanted.column),
            found=found,
            expected=f"at most {wanted.largest_gap_periods:g} times the usual "
            f"{timing.usual_step_s:.6g} s",
            remedy="samples are missing: import the parts before and after it as two recordings, "
            "by `keep`, or allow the gap with `largest_gap_periods` of `time`; if these are times "
            "of arrival, give rate_hz instead of time",
        )
