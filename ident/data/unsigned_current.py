"""Currents without their sign: drives that report the size of the current only.

The current of an axis that moves both ways passes through zero. Its size comes down to zero there
and turns back, as a ball that bounces. A current with a sign does not: either it is never near
zero, as in the shoulder of an arm that always carries its weight, or noise, friction and
acceleration take it below zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.data.run import Run
from ident.errors import CurrentUnsigned

USUAL_PERCENTILE = 99.0  #: Percentile of the sizes of a current that is its usual largest size
VISIT_SHARE = 0.02  #: Largest size in a visit to zero, as a share of the usual largest one
#: Largest size of the other sign, by rounding or an offset, as a share of the usual largest one
OTHER_SIGN_SHARE = 0.005
LEAST_VISITS = 6
"""Least visits of a run to zero.

The sizes of the currents of two real robots and a simulated one make 6 to 37 in 9 to 40 s; the same
currents with a sign, shifted until they have one sign alone, make 4 at most.
"""
#: Smallest count of a coarse current, as a share of its usual largest size
COARSE_COUNT_SHARE = 0.05
LEAST_COARSE_VISITS = 12
"""Least visits of a coarse current: twice those of one that has its sign.

Rounding takes such a current to zero, up to 6 times.
"""
LEAST_PAUSE_S = 0.1  #: Least time between two visits
LONGEST_VISIT_S = 0.05
"""Longest time for which the current keeps one value in a visit.

A longer one is no visit: the brake is on, or the drive has no power.
"""
LARGEST_RISE_RATIO = 3.0
"""Largest rise after a visit over the time 2 t, relative to that over t.

A size bounces with the ratio 2 and less; a smooth current that comes near zero by chance turns as a
parabola, with 4.
"""
#: Least rise over the time t, as a share of the usual largest size
RISE_SHARE = 0.1
LONGEST_RISE_S = 0.3  #: Largest t
LAGS = 40  #: Number of values of t that are tried, in a geometric series
#: Least way in each direction of a motor that turns both ways, as a share of its whole way
LEAST_WAY_SHARE = 0.1


def require_signed_currents(run: Run, ratio: FloatArray, axes: Sequence[str]) -> None:
    """Refuse a recording in which drives report the size of the current only.

    Args:
        run: a recording of n axes.
        ratio: R of the drive train: motor angles are R q (paper eq. 24), shape (n, n).
        axes: name of each axis.

    Raises:
        CurrentUnsigned: a current is never of the other sign, and comes down to zero again and
            again, while its motor turns both ways.
    """
    refuse_unsigned(run, unsigned_currents(run, ratio), axes)


def refuse_unsigned(run: Run, unsigned: BoolArray, axes: Sequence[str]) -> None:
    """Refuse a recording if some of its currents, shape (n,), are sizes.

    Raises:
        CurrentUnsigned: for these currents.
    """
    if unsigned.any():
        found = np.flatnonzero(unsigned).tolist()
        names = tuple(axes[axis] for axis in found)
        raise CurrentUnsigned(run.name, names, missing_signs(run, found))


def missing_signs(run: Run, axes: Sequence[int]) -> tuple[str, ...]:
    """Return the sign that the current of each of these axes does not have, in words."""
    signs: list[str] = []
    for axis in axes:
        used = _used_samples(run, axis)
        signs.append(missing_sign(run.current_a[used, axis]))
    return tuple(signs)


def missing_sign(current: FloatArray) -> str:
    """Return the sign that a current of one sign does not have, in words.

    Args:
        current: shape (k,). A value of the other sign may be there, of rounding or of an offset
            (OTHER_SIGN_SHARE): the larger size decides.
    """
    if current.max() > -current.min():
        return "negative"
    return "positive"


def unsigned_currents(run: Run, ratio: FloatArray) -> BoolArray:
    """Whether the current of each axis is a size without a sign, shape (n,).

    Args:
        run, ratio: as of `require_signed_currents`.
    """
    found = one_sided_currents(run, ratio)
    for axis in np.flatnonzero(found).tolist():
        used = _used_samples(run, axis)
        size = np.abs(run.current_a[used, axis])
        found[axis] = bounces(size, run.time_s[used])
    return found


def _used_samples(run: Run, axis: int) -> BoolArray | slice:
    """Samples of an axis that may be used."""
    if run.valid is None:
        return slice(None)
    return run.valid[:, axis]


def one_sided_currents(run: Run, ratio: FloatArray) -> BoolArray:
    """Whether the current of each axis has one sign while its motor turns both ways, shape (n,).

    That is so for a size, and also for a shoulder that always carries its weight.
    """
    motor_rad = run.position_rad @ ratio.T
    found = np.zeros(run.current_a.shape[1], dtype=np.bool_)
    for axis in range(len(found)):
        used = _used_samples(run, axis)
        if has_one_sign(run.current_a[used, axis]):
            found[axis] = turns_both_ways(motor_rad[used, axis])
    return found


def has_one_sign(current: FloatArray) -> bool:
    """Whether a current, shape (k,), is never below zero, or never above it, but for
    OTHER_SIGN_SHARE.
    """
    if not current.size:
        return False
    usual = float(np.percentile(np.abs(current), USUAL_PERCENTILE))
    limit = OTHER_SIGN_SHARE * usual
    return bool(current.min() >= -limit or current.max() <= limit)


def turns_both_ways(motor_rad: FloatArray) -> bool:
    """Whether a motor makes a good part of its way in each direction.

    Args:
        motor_rad: its positions, shape (k,).
    """
    steps = np.diff(motor_rad)
    forwards = float(steps[steps > 0.0].sum())
    backwards = -float(steps[steps < 0.0].sum())
    return min(forwards, backwards) > LEAST_WAY_SHARE * (forwards + backwards)


def bounces(size: FloatArray, time_s: FloatArray) -> bool:
    """Whether the size of a current comes down to zero and turns there, again and again.

    Args:
        size: of the current, shape (k,).
        time_s: of each sample, shape (k,).
    """
    usual = float(np.percentile(size, USUAL_PERCENTILE))
    # A drive may report more slowly than the recorder samples: each value counts once, at its
    # first sample. NaN differs from the first value.
    start = np.flatnonzero(np.diff(size, prepend=np.nan) != 0.0)
    end = np.append(start[1:], len(size)) - 1
    stays_too_long = time_s[end] - time_s[start] > LONGEST_VISIT_S
    is_near_zero = size[start] < VISIT_SHARE * usual
    near_zero = start[is_near_zero & ~stays_too_long]
    if len(near_zero) < LEAST_VISITS:
        return False
    values = np.unique(size)
    smallest_step = float(np.diff(values).min())
    fewest_visits = LEAST_COARSE_VISITS
    if smallest_step <= COARSE_COUNT_SHARE * usual:
        fewest_visits = LEAST_VISITS
    visits = _visits(size, near_zero, time_s)
    if len(visits) < fewest_visits:
        return False
    return rise_ratio(size, visits, time_s, RISE_SHARE * usual) < LARGEST_RISE_RATIO


def _visits(size: FloatArray, near_zero: IntArray, time_s: FloatArray) -> IntArray:
    """Divide samples near zero into visits, and return the smallest of each.

    Args:
        size: of the current, shape (k,).
        near_zero: numbers of the samples near zero, ascending.
        time_s: of each sample, shape (k,).

    Returns:
        number of the sample nearest to zero in each visit.
    """
    pauses_s = np.diff(time_s[near_zero], prepend=-np.inf)
    first_of_visit = np.flatnonzero(pauses_s > LEAST_PAUSE_S)
    visits: list[int] = []
    # The pause before the first visit is endless, so the first of these numbers is 0.
    for samples in np.split(near_zero, first_of_visit[1:]):
        nearest = int(np.argmin(size[samples]))
        visits.append(int(samples[nearest]))
    return np.array(visits)


def rise_ratio(size: FloatArray, visits: IntArray, time_s: FloatArray, least_rise: float) -> float:
    """Median rise of a current around its visits to zero over the time 2 t,
    relative to that over t.

    Args:
        size: of the current, shape (k,).
        visits: number of the sample nearest to zero in each visit.
        time_s: of each sample, shape (k,).
        least_rise: the least rise over t.

    Returns:
        the ratio for the shortest t with this rise; infinity where the current rises too slowly.
    """
    # Samples that may not be used leave gaps: the first step may be one.
    sampling_period_s = np.median(np.diff(time_s))
    longest = max(round(LONGEST_RISE_S / sampling_period_s), 1)
    # t is lag samples.
    lags = np.round(np.geomspace(1.0, longest, LAGS)).astype(int)
    for lag in np.unique(lags).tolist():
        is_inside = (visits >= 2 * lag) & (visits < len(size) - 2 * lag)
        inside = visits[is_inside]
        if not len(inside):
            break
        rise_over_t = median_rise(size, inside, lag)
        if rise_over_t >= least_rise:
            rise_over_2t = median_rise(size, inside, 2 * lag)
            return rise_over_2t / rise_over_t
    return float("inf")


def median_rise(size: FloatArray, visits: IntArray, lag: int) -> float:
    """Median rise of a current from its visits to zero to the samples at a distance.

    The rise of one visit is the mean of the sizes before and after it, less the size in it.

    Args:
        size: of the current, shape (k,).
        visits: number of the sample nearest to zero in each visit.
        lag: distance on either side, in samples.
    """
    around = 0.5 * (size[visits - lag] + size[visits + lag])
    return float(np.median(around - size[visits]))
