"""What the amplifiers of a cell tell of themselves, in the units of CiA 402; renewed once a SYNC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.simulated.amplifier import AmplifierSet, FloatArray
from drivers.simulated.compiled import compiled


@dataclass(frozen=True, slots=True)
class Readings:
    """Integers as they go over the bus, one an axis.

    Attributes:
        position: 6064h [counts].
        demand: 6062h [counts].
        velocity: 606Ch [counts/s].
        current_demand: 6074h [per mille of rated current].
        current: 6077h and 6078h [per mille of rated current].
        reached, limited, following_error: bits 10, 11 and 13 of 6041h as the loops see them.
    """

    position: list[int]
    demand: list[int]
    velocity: list[int]
    current_demand: list[int]
    current: list[int]
    reached: list[int]
    limited: list[int]
    following_error: list[int]


def take(amplifiers: AmplifierSet, rated_current_a: FloatArray) -> Readings:
    """Round and wrap what the loops hold.

    Args:
        amplifiers: after a SYNC period.
        rated_current_a: shape (n,).
    """
    told = np.empty((8, len(rated_current_a)), dtype=np.int64)
    _tell(amplifiers.loops, amplifiers.reported_a, rated_current_a, told)
    return Readings(*told.tolist())


@compiled
def _tell(
    loops: NDArray[np.void], reported_a: FloatArray, rated_current_a: FloatArray, told: NDArray[np.int64]
) -> None:
    """Fill one row for each field of Readings, in their order, shape (8, n)."""
    for i in range(len(loops)):
        axis = loops[i]
        # int32 as the bus carries it: an endless axis wraps around.
        told[0, i] = (axis["counts"] + 2**31) % 2**32 - 2**31
        told[1, i] = (np.int64(np.rint(axis["demand"])) + 2**31) % 2**32 - 2**31
        told[2, i] = np.int64(min(max(np.rint(axis["velocity"]), -(2.0**31)), 2.0**31 - 1.0))
        per_mille = 1000.0 / rated_current_a[i]
        told[3, i] = np.int64(min(max(np.rint(reported_a[i] * per_mille), -32768.0), 32767.0))
        told[4, i] = np.int64(min(max(np.rint(axis["current_a"] * per_mille), -32768.0), 32767.0))
        told[5, i] = axis["reached"]
        told[6, i] = axis["limited"]
        told[7, i] = axis["following_error"]
