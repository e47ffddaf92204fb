"""Readings that are held: a recorder that samples faster than the controller answers stores the
same number again.

A held position is a staircase, and its derivatives are blows that no filter takes out again. Held
samples are treated as missing: the position between two new readings is that of a cubic spline
through them, the current that of a straight line. A reading is as old as its first sample says.

Repeated numbers alone show nothing: a joint at rest repeats its position, and a coarse encoder
repeats each count until the next one comes. But where a reading stays for a while and then jumps by
several counts, the counts between were not read.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray

LEAST_HELD = 0.2
"""Least share of the readings of a channel in motion that are held before it is treated.

A noisy current repeats up to a twentieth of its readings by chance. A controller whose cycles are
not even repeats a tenth of its positions, and a joint that two motors turn repeats what either of
them does: 15 % on a real arm, which loses nothing by it.
"""
JUMP_COUNTS = 3.0  #: Smallest jump after a held reading, in counts of the channel
ROUNDING = 1e-9  #: Of a channel's range: smaller changes are rounding, no counts
#: Readings on either side by which a damaged one is filled in; as many as it has samples, if these
#: are more
READINGS_EACH_SIDE = 4
LONGEST_HOLD_S = 0.05  #: A reading that stays longer may be a joint at rest


@dataclass(frozen=True, slots=True, eq=False)
class HeldChannels:
    """Share of the readings in motion that were held, and how long a reading stays;
    0 for channels left as they are.
    """

    position_share: FloatArray  #: of each joint, shape (n,)
    position_hold_s: FloatArray  #: median, shape (n,)
    current_share: FloatArray  #: of each motor, shape (n,)
    current_hold_s: FloatArray  #: median, shape (n,)


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One channel of a run without its held samples."""

    values: FloatArray  #: with what was held filled in, shape (k,)
    #: of the readings in motion that were held; 0 where the channel was left as it is
    share: float = 0.0
    hold_s: float = 0.0  #: how long a reading stays, median; 0 where the channel was left as it is


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
        position and current, the same arrays where nothing was filled in, and what was held, or
        None.
    """
    if damaged_position is None:
        damaged_position = np.zeros(position.shape, dtype=np.bool_)
    if damaged_current is None:
        damaged_current = np.zeros(position.shape, dtype=np.bool_)
    positions = _without_held_of_each(position, damaged_position, rate_hz, smooth=True)
    currents = _without_held_of_each(current, damaged_current, rate_hz, smooth=False)
    is_held = any(channel.share for channel in (*positions, *currents))
    is_damaged = np.any(damaged_position) or np.any(damaged_current)
    if not is_held and not is_damaged:
        return position, current, None
    held = None
    if is_held:
        held = HeldChannels(
            position_share=np.array([channel.share for channel in positions]),
            position_hold_s=np.array([channel.hold_s for channel in positions]),
            current_share=np.array([channel.share for channel in currents]),
            current_hold_s=np.array([channel.hold_s for channel in currents]),
        )
    filled_position = np.stack([channel.values for channel in positions], axis=1)
    filled_current = np.stack([channel.values for channel in currents], axis=1)
    return filled_position, filled_current, held


def _without_held_of_each(
    columns: FloatArray, damaged: BoolArray, rate_hz: float, *, smooth: bool
) -> list[Channel]:
    """`without_held` of each channel, shape (k, n)."""
    channels: list[Channel] = []
    for values, own_damaged in zip(columns.T, damaged.T, strict=True):
        channels.append(without_held(values, rate_hz, smooth=smooth, damaged=own_damaged))
    return channels


def held_channel(values: FloatArray, rate_hz: float) -> BoolArray | None:
    """Return which samples of a channel are held, shape (k,); None where fewer than LEAST_HELD are.

    Args:
        values: of the channel, shape (k,).
        rate_hz: sampling rate.
    """
    held = held_samples(values, rate_hz)
    if _share_held(values, held) < LEAST_HELD:
        return None
    return held


def without_held(
    values: FloatArray, rate_hz: float, *, smooth: bool, damaged: BoolArray | None = None
) -> Channel:
    """Fill in the held samples of a channel, unless fewer than LEAST_HELD are held,
    and the damaged ones.

    Args:
        values: of the channel, shape (k,).
        rate_hz: sampling rate.
        smooth: by a cubic spline, else by straight lines.
        damaged: samples that are no readings, shape (k,); None for none.
    """
    if damaged is None:
        damaged = np.zeros(len(values), dtype=np.bool_)
    held = held_channel(values, rate_hz)
    if held is None:
        longest = 0
        if smooth:
            longest = longest_smooth(rate_hz)
        return Channel(fill_damaged(values, damaged, longest))
    is_read = ~held & ~damaged
    read = np.flatnonzero(is_read)
    missing = np.flatnonzero(~is_read)
    if smooth:
        from scipy.interpolate import CubicSpline  # noqa: PLC0415 - verbs that only judge a log need no scipy

        spline = CubicSpline(read, values[read])
        filled = spline(missing)
    else:
        filled = np.interp(missing, read, values[read])
    out = values.copy()
    out[missing] = filled
    lengths = np.diff(read)
    hold = float(np.median(lengths[lengths > 1]))
    return Channel(out, _share_held(values, held), hold / rate_hz)


def longest_smooth(rate_hz: float) -> int:
    """Most samples that a curve is laid through: beyond LONGEST_HOLD_S it would be made up."""
    return max(READINGS_EACH_SIDE, round(LONGEST_HOLD_S * rate_hz))


def fill_damaged(
    values: FloatArray, damaged: BoolArray, longest: int, time: FloatArray | None = None
) -> FloatArray:
    """Fill in samples that are no readings, by those around them; the same array without any.

    Args:
        values: of a channel, shape (k,).
        damaged: shape (k,).
        longest: so many samples and fewer are filled in by the cubic that fits
            READINGS_EACH_SIDE readings on either side best, others by a straight line.
        time: of each sample, in any unit, shape (k,); None for a constant rate.
    """
    if not np.any(damaged) or np.all(damaged):
        return values
    if time is None:
        time = np.arange(len(values), dtype=np.float64)
    out = values.copy()
    right = np.flatnonzero(~damaged)
    wrong = np.flatnonzero(damaged)
    out[wrong] = np.interp(time[wrong], time[right], values[right])
    gaps = np.flatnonzero(np.diff(wrong) > 1) + 1
    for block in np.split(wrong, gaps):
        if len(block) > longest:
            continue
        count = max(READINGS_EACH_SIDE, len(block))
        after = int(np.searchsorted(right, block[0]))
        first = max(after - count, 0)
        near = right[first : after + count]
        is_between = near[0] < block[0] and near[-1] > block[-1]
        # Beyond the first and the last reading a cubic goes astray.
        degree = 1
        if is_between and len(near) > READINGS_EACH_SIDE:
            degree = 3
        middle = float(np.mean(time[near]))
        coefficients = np.polyfit(time[near] - middle, values[near], degree)
        out[block] = np.polyval(coefficients, time[block] - middle)
    return out


def held_samples(values: FloatArray, rate_hz: float) -> BoolArray:
    """Return which samples repeat a reading that then jumps, shape (k,);
    its first sample is not one of them.

    Args:
        values: of a channel, shape (k,).
        rate_hz: sampling rate.
    """
    held = np.zeros(len(values), dtype=np.bool_)
    first = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)  # of each reading
    lengths = np.diff(first)
    if not len(lengths) or lengths.max() == 1:
        return held
    jumps = np.abs(np.diff(values[first]))
    is_repeated = (lengths > 1) & (lengths <= LONGEST_HOLD_S * rate_hz)
    then_jumps = jumps > JUMP_COUNTS * _count(values, jumps)
    held[: first[-1]] = np.repeat(is_repeated & then_jumps, lengths)
    held[first] = False
    return held


def _count(values: FloatArray, jumps: FloatArray) -> float:
    """Size of a count of a channel: its smallest change; 0 for a channel without counts."""
    rounding = ROUNDING * float(np.ptp(values))
    changes = jumps[jumps > rounding]
    if not len(changes):
        return 0.0
    return float(changes.min())


def _share_held(values: FloatArray, held: BoolArray) -> float:
    """Share of the samples in which a channel changes, or should, that are held."""
    changes = int(np.count_nonzero(np.diff(values)))
    count = int(np.count_nonzero(held))
    return count / max(count + changes, 1)
