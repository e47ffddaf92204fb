"""Held readings: a recorder that samples faster than the controller answers stores a reading again.

A channel of held readings is a staircase, and no filter removes the peaks from its derivatives. So
held samples are treated as missing. They are filled in from the new readings on either side:
positions by a cubic spline, currents by straight lines. The first sample of a reading has its time.

Repeated numbers alone are no evidence: a joint at rest repeats its position, and a coarse encoder
repeats each count until the next one. The evidence is a reading that repeats and then jumps by
several counts: a channel that is read at every sample shows the counts between.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray

LEAST_HELD = 0.2
"""Least share of the readings of a channel in motion that are held before they are filled in.

A noisy current repeats up to a twentieth of its readings by chance. A controller with uneven cycles
repeats a tenth of its positions. A joint that two motors turn repeats its position when either of
them does: 15 % on a real arm, and its gains are no worse for it.
"""
#: Smallest jump after a held reading, in counts of the channel's resolution
JUMP_COUNTS = 3.0
#: Largest change of a channel that is rounding error, as a share of its range
ROUNDING = 1e-9
#: Readings on either side of damaged samples to which a polynomial is fitted; where there are more
#: damaged samples than that, as many readings as damaged samples
READINGS_EACH_SIDE = 4
#: A reading that stays longer may be a joint at rest
LONGEST_HOLD_S = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class HeldChannels:
    """Held readings of a run.

    Share of the readings in motion that were held, and how long a reading stays; both are 0 for a
    channel whose held readings were not filled in.
    """

    position_share: FloatArray  #: of each joint, shape (n,)
    position_hold_s: FloatArray  #: median, shape (n,)
    current_share: FloatArray  #: of each motor, shape (n,)
    current_hold_s: FloatArray  #: median, shape (n,)


@dataclass(frozen=True, slots=True, eq=False)
class FilledChannel:
    """One channel of a run with its held and damaged samples filled in."""

    values: FloatArray  #: shape (k,)
    #: share of its readings in motion that were held; 0 where these were not filled in
    held_share: float = 0.0
    #: median time that a reading stays; 0 where held readings were not filled in
    hold_s: float = 0.0


def fill_held(
    position: FloatArray,
    current: FloatArray,
    rate_hz: float,
    damaged_position: BoolArray | None = None,
    damaged_current: BoolArray | None = None,
) -> tuple[FloatArray, FloatArray, HeldChannels | None]:
    """Fill in the held samples of a run's channels, and the damaged ones.

    Args:
        position: of the joints, shape (k, n).
        current: of the motors, shape (k, n).
        rate_hz: sampling rate.
        damaged_position, damaged_current: samples that are no readings, shape (k, n) each; None for
            none.

    Returns:
        position and current, the same arrays where nothing was filled in; and the held channels,
        None where there are none.
    """
    if damaged_position is None:
        damaged_position = np.zeros(position.shape, dtype=np.bool_)
    if damaged_current is None:
        damaged_current = np.zeros(position.shape, dtype=np.bool_)
    positions = _fill_channels(position, damaged_position, rate_hz, by_spline=True)
    currents = _fill_channels(current, damaged_current, rate_hz, by_spline=False)
    any_held = any(channel.held_share > 0.0 for channel in (*positions, *currents))
    any_damaged = np.any(damaged_position) or np.any(damaged_current)
    if not any_held and not any_damaged:
        return position, current, None
    held = None
    if any_held:
        held = HeldChannels(
            position_share=np.array([channel.held_share for channel in positions]),
            position_hold_s=np.array([channel.hold_s for channel in positions]),
            current_share=np.array([channel.held_share for channel in currents]),
            current_hold_s=np.array([channel.hold_s for channel in currents]),
        )
    filled_position = np.stack([channel.values for channel in positions], axis=1)
    filled_current = np.stack([channel.values for channel in currents], axis=1)
    return filled_position, filled_current, held


def _fill_channels(
    channels: FloatArray, damaged: BoolArray, rate_hz: float, *, by_spline: bool
) -> list[FilledChannel]:
    """`fill_channel` of each column of an array of shape (k, n)."""
    filled: list[FilledChannel] = []
    for values, is_damaged in zip(channels.T, damaged.T, strict=True):
        channel = fill_channel(values, rate_hz, by_spline=by_spline, damaged=is_damaged)
        filled.append(channel)
    return filled


def fill_channel(
    values: FloatArray, rate_hz: float, *, by_spline: bool, damaged: BoolArray | None = None
) -> FilledChannel:
    """Fill in the held samples of a channel, and the damaged ones.

    Where fewer than LEAST_HELD are held, only the damaged samples are filled in (`fill_damaged`).

    Args:
        values: of the channel, shape (k,).
        rate_hz: sampling rate.
        by_spline: whether held samples are filled in by a cubic spline, else by straight lines.
        damaged: samples that are no readings, shape (k,); None for none.
    """
    if damaged is None:
        damaged = np.zeros(len(values), dtype=np.bool_)
    held = samples_to_fill(values, rate_hz)
    if held is None:
        longest_cubic = 0
        if by_spline:
            longest_cubic = longest_cubic_fill(rate_hz)
        return FilledChannel(fill_damaged(values, damaged, longest_cubic))
    is_read = ~held & ~damaged
    read = np.flatnonzero(is_read)
    missing = np.flatnonzero(~is_read)
    if by_spline:
        from scipy.interpolate import CubicSpline  # noqa: PLC0415 - verbs that only judge a log need no scipy

        spline = CubicSpline(read, values[read])
        estimated = spline(missing)
    else:
        estimated = np.interp(missing, read, values[read])
    filled = values.copy()
    filled[missing] = estimated
    stays = np.diff(read)  # samples from each reading to the next
    median_hold = float(np.median(stays[stays > 1]))
    return FilledChannel(filled, _held_share(values, held), median_hold / rate_hz)


def longest_cubic_fill(rate_hz: float) -> int:
    """Largest number of damaged samples in a row that a cubic fills in.

    Over more than LONGEST_HOLD_S the readings on either side no longer determine the curve between.
    """
    return max(READINGS_EACH_SIDE, round(LONGEST_HOLD_S * rate_hz))


def fill_damaged(
    values: FloatArray, damaged: BoolArray, longest_cubic: int, time: FloatArray | None = None
) -> FloatArray:
    """Fill in samples that are no readings by those around them; the same array without any.

    Up to ``longest_cubic`` samples in a row are filled in by the cubic that fits the readings on
    either side best (READINGS_EACH_SIDE), more by a straight line from the reading before them to
    the one after. Where there are too few readings, or all are on one side, the cubic is a line
    fitted to them.

    Args:
        values: of a channel, shape (k,).
        damaged: shape (k,).
        longest_cubic: largest number of samples in a row that a cubic fills in.
        time: of each sample, in any unit, shape (k,); None for a constant rate.
    """
    if not np.any(damaged) or np.all(damaged):
        return values
    if time is None:
        time = np.arange(len(values), dtype=np.float64)
    filled = values.copy()
    good = np.flatnonzero(~damaged)
    bad = np.flatnonzero(damaged)
    filled[bad] = np.interp(time[bad], time[good], values[good])
    for block in _blocks(bad):
        if len(block) > longest_cubic:
            continue
        # Places among the good samples: the first one after the block, and those around it
        after = int(np.searchsorted(good, block[0]))
        each_side = max(READINGS_EACH_SIDE, len(block))
        first = max(after - each_side, 0)
        around = good[first : after + each_side]
        is_enclosed = around[0] < block[0] and around[-1] > block[-1]
        # A cubic diverges beyond the first and the last reading.
        degree = 1
        if is_enclosed and len(around) > READINGS_EACH_SIDE:
            degree = 3
        middle = float(np.mean(time[around]))
        coefficients = np.polyfit(time[around] - middle, values[around], degree)
        filled[block] = np.polyval(coefficients, time[block] - middle)
    return filled


def _blocks(samples: IntArray) -> list[IntArray]:
    """Divide ascending sample numbers into blocks of consecutive ones."""
    starts = np.flatnonzero(np.diff(samples) > 1) + 1
    return np.split(samples, starts)


def samples_to_fill(values: FloatArray, rate_hz: float) -> BoolArray | None:
    """Return the held samples of a channel, shape (k,); None where fewer than LEAST_HELD are.

    Args:
        values: of the channel, shape (k,).
        rate_hz: sampling rate.
    """
    held = held_samples(values, rate_hz)
    if _held_share(values, held) < LEAST_HELD:
        return None
    return held


def held_samples(values: FloatArray, rate_hz: float) -> BoolArray:
    """Return which samples repeat a reading that is followed by a jump, shape (k,).

    The first sample of a reading is not held.

    Args:
        values: of a channel, shape (k,).
        rate_hz: sampling rate.
    """
    held = np.zeros(len(values), dtype=np.bool_)
    # First sample of each reading; NaN differs from the first value of the channel.
    first = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    stays = np.diff(first)
    if not len(stays) or stays.max() == 1:
        return held
    jumps = np.abs(np.diff(values[first]))
    is_repeated = (stays > 1) & (stays <= LONGEST_HOLD_S * rate_hz)
    then_jumps = jumps > JUMP_COUNTS * _count_size(values, jumps)
    # Every sample of a reading that qualifies, and then all but its first
    held[: first[-1]] = np.repeat(is_repeated & then_jumps, stays)
    held[first] = False
    return held


def _count_size(values: FloatArray, jumps: FloatArray) -> float:
    """Size of one count of a channel: its smallest change; 0 for a channel that never changes.

    Args:
        values: of the channel, shape (k,).
        jumps: sizes of its changes, shape (j,).
    """
    rounding = ROUNDING * float(np.ptp(values))
    changes = jumps[jumps > rounding]
    if not len(changes):
        return 0.0
    return float(changes.min())


def _held_share(values: FloatArray, held: BoolArray) -> float:
    """Share of held samples among those in motion: the held ones, and each change of the channel.

    Args:
        values: of the channel, shape (k,).
        held: its held samples, shape (k,).
    """
    changes = int(np.count_nonzero(np.diff(values)))
    held_count = int(np.count_nonzero(held))
    return held_count / max(held_count + changes, 1)
