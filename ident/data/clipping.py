"""Currents that a limit clips, where neither drive nor log reports the limit."""

from __future__ import annotations

import numpy as np

from ident.arrays import BoolArray, FloatArray

LEAST_SAMPLES = 20  #: Least number of clipped samples of a run
LEAST_CLIPPED = 0.002  #: Least share of the samples of a moving motor that a limit has clipped
LONG_STRETCH = 5
"""Least length of two stretches at a limit, in samples and in multiples of the longest stretch of
one value elsewhere. A smooth current of few counts, or one that is repeated between slow readings,
has stretches everywhere.
"""
LEAST_STRETCHES = 2
SAME_LIMIT = 0.05  #: Largest relative difference of the limits of both directions


def clipped_samples(current: FloatArray, usable: BoolArray) -> BoolArray:
    """Find samples at a limit: a current that stays at exactly its largest or smallest value,
    again and again.

    Args:
        current: of the motors, in any unit, shape (k, m).
        usable: samples of moving motors in which no limit was reported, shape (k, m).

    Returns:
        shape (k, m).
    """
    clipped = np.zeros(current.shape, dtype=np.bool_)
    for motor in range(current.shape[1]):
        own_use = usable[:, motor]
        if np.any(own_use):
            clipped[:, motor] = _clipped(current[:, motor], own_use)
    return clipped


def _clipped(current: FloatArray, usable: BoolArray) -> BoolArray:
    """Return the clipped samples of one current, shape (k,)."""
    changes = (np.diff(current) != 0.0) | (np.diff(usable) != 0)
    starts = np.concatenate(([0], np.flatnonzero(changes) + 1))
    lengths = np.diff(starts, append=len(current))
    values = current[starts]
    used = usable[starts]
    highest = float(np.max(values[used]))
    lowest = float(np.min(values[used]))
    # A limit of both directions is one; zero is what a channel without an answer has.
    is_one_limit = abs(highest + lowest) < SAME_LIMIT * abs(highest)
    least = max(LEAST_SAMPLES, LEAST_CLIPPED * np.count_nonzero(usable))
    clipped = np.zeros(len(current), dtype=np.bool_)
    for limit in (highest, lowest):
        has_its_sign = limit < 0.0
        if limit == highest:
            has_its_sign = limit > 0.0
        at_limit = used & (values == limit)
        elsewhere = used & ~at_limit & (values != 0.0)
        if is_one_limit:
            elsewhere &= (values != highest) & (values != lowest)
        longest_elsewhere = int(np.max(lengths[elsewhere], initial=1))
        is_long = at_limit & (lengths >= LONG_STRETCH * longest_elsewhere)
        is_often = np.count_nonzero(is_long) >= LEAST_STRETCHES
        if has_its_sign and is_often and lengths[at_limit].sum() >= least:
            clipped |= np.repeat(at_limit, lengths)
    return clipped
