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

USUAL_PERCENTILE = 99.0  #: Of the sizes of a current; what follows is a share of it
NEAR_ZERO = 0.02  #: Current of a visit to zero
BELOW_ZERO = 0.005  #: Largest current of the other sign: of rounding, or of an offset
VISITS = 6
"""Least visits of a run to zero.

The sizes of the currents of two real robots and a simulated one make 6 to 37 in 9 to 40 s; the same
currents with a sign, shifted until they have one sign alone, make 4 at most.
"""
COARSE = 0.05  #: Largest share that one count is of a current that needs VISITS
#: Least visits of a coarser current: rounding takes others to zero, up to 6 times
COARSE_VISITS = 12
APART_S = 0.1  #: Two visits are at least so far apart
REST_S = 0.05  #: A value that stays so long is a brake's, or of a drive without power, and no visit
BOUNCE = 3.0
"""Largest rise after a visit over the time 2 t, relative to that over t.

A size bounces with the ratio 2 and less; a smooth current that comes near zero by chance turns as a
parabola, with 4.
"""
RISE = 0.1  #: Rise over the time t
LONGEST_RISE_S = 0.3  #: Largest t
EACH_WAY = 0.1  #: Least share of the way of a motor in each direction


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
        names = tuple(axis for axis, found in zip(axes, unsigned, strict=True) if found)
        raise CurrentUnsigned(run.name, names, missing_sign(run.current_a[:, unsigned]))


def missing_sign(current: FloatArray) -> str:
    """Return the sign that currents of one sign do not have, in words.

    Args:
        current: of one axis or of several, shape (k,) or (k, c). A value of the other sign may be
            there, of rounding or of an offset (BELOW_ZERO): the larger size decides.
    """
    if current.max() > -current.min():
        return "negative"
    return "positive"


def unsigned_currents(run: Run, ratio: FloatArray) -> BoolArray:
    """Whether the current of each axis is a size without a sign, shape (n,);
    arguments of `require_signed_currents`.
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

    A size has, and so has the current of a shoulder that always carries its weight.
    """
    motor_rad = run.position_rad @ ratio.T
    found = np.zeros(run.current_a.shape[1], dtype=np.bool_)
    for axis in range(len(found)):
        used = _used_samples(run, axis)
        if has_one_sign(run.current_a[used, axis]):
            found[axis] = turns_both_ways(motor_rad[used, axis])
    return found


def has_one_sign(current: FloatArray) -> bool:
    """Whether a current, shape (k,), is never below zero, or never above it."""
    if not current.size:
        return False
    usual = float(np.percentile(np.abs(current), USUAL_PERCENTILE))
    limit = BELOW_ZERO * usual
    return bool(current.min() >= -limit or current.max() <= limit)


def turns_both_ways(motor_rad: FloatArray) -> bool:
    """Whether a motor, shape (k,), makes a good part of its way in each direction."""
    steps = np.diff(motor_rad)
    forwards = float(steps[steps > 0.0].sum())
    backwards = -float(steps[steps < 0.0].sum())
    return min(forwards, backwards) > EACH_WAY * (forwards + backwards)


def bounces(size: FloatArray, time_s: FloatArray) -> bool:
    """Whether the size of a current, shape (k,), comes down to zero and turns there,
    VISITS times and more.
    """
    usual = float(np.percentile(size, USUAL_PERCENTILE))
    # Of a value that stays, the first sample alone: a drive may report slower than the recording.
    start = np.flatnonzero(np.diff(size, prepend=np.nan) != 0.0)
    end = np.append(start[1:], len(size)) - 1
    is_rest = time_s[end] - time_s[start] > REST_S
    is_near = size[start] < NEAR_ZERO * usual
    near = start[is_near & ~is_rest]
    if len(near) < VISITS:
        return False
    count = float(np.diff(np.unique(size)).min())
    fewest_visits = COARSE_VISITS
    if count <= COARSE * usual:
        fewest_visits = VISITS
    visits = _visits(size, near, time_s)
    if len(visits) < fewest_visits:
        return False
    return rise_ratio(size, visits, time_s, RISE * usual) < BOUNCE


def _visits(size: FloatArray, near: IntArray, time_s: FloatArray) -> IntArray:
    """Sample nearest to zero of each visit, of the samples near zero in all of them."""
    pauses_s = np.diff(time_s[near], prepend=-np.inf)
    first_of_visit = np.flatnonzero(pauses_s > APART_S)
    visits: list[int] = []
    for samples in np.split(near, first_of_visit[1:]):
        nearest = int(np.argmin(size[samples]))
        visits.append(int(samples[nearest]))
    return np.array(visits)


def rise_ratio(size: FloatArray, visits: IntArray, time_s: FloatArray, rise: float) -> float:
    """Median rise of a current around its visits to zero over the time 2 t,
    relative to that over t.

    Args:
        size: of the current, shape (k,).
        visits: number of the sample nearest to zero in each visit.
        time_s: of each sample, shape (k,).
        rise: by which the current rises over t.

    Returns:
        the ratio for the shortest t; infinity where the current rises too slowly.
    """
    # Samples that may not be used leave gaps: the first step may be one.
    sampling_period_s = np.median(np.diff(time_s))
    longest = max(round(LONGEST_RISE_S / sampling_period_s), 1)
    lags = np.round(np.geomspace(1.0, longest, 40)).astype(int)
    for lag in np.unique(lags).tolist():
        is_inside = (visits >= 2 * lag) & (visits < len(size) - 2 * lag)
        inside = visits[is_inside]
        if not len(inside):
            break
        near = median_rise(size, inside, lag)
        if near >= rise:
            return median_rise(size, inside, 2 * lag) / near
    return float("inf")


def median_rise(size: FloatArray, visits: IntArray, lag: int) -> float:
    """Median over the visits of the mean size of the current, shape (k,), lag samples before and
    after, less that of the visit.
    """
    around = 0.5 * (size[visits - lag] + size[visits + lag])
    return float(np.median(around - size[visits]))
