"""Gravity as a person types it into a description: without the digits that are noise.

A component that is noise brings base parameters that the robot does not have, and a condition
number that is tenfold: gravity along an axis of the base is exactly along it, or it is not.
"""

from __future__ import annotations

import math

import numpy as np

from ident.arrays import FloatArray

ZERO_SIGMAS = 2.0  #: A component within so many σ of zero is zero
MOST_DECIMALS = 4  #: Of m/s²
FEWEST_DECIMALS = 2


def suggested_gravity(found_m_s2: FloatArray, std_m_s2: FloatArray) -> FloatArray:
    """Return gravity of the same size, rounded to what its σ supports,
    and along an axis where that is within 2 σ.

    Args:
        found_m_s2: as it was estimated, shape (3,).
        std_m_s2: σ of each component, shape (3,).

    Returns:
        gravity [m/s²], shape (3,).
    """
    size = float(np.linalg.norm(found_m_s2))
    magnitude = np.abs(found_m_s2)
    is_nonzero = magnitude > ZERO_SIGMAS * std_m_s2
    is_nonzero[np.argmax(magnitude)] = True
    gravity_m_s2 = np.where(is_nonzero, found_m_s2, 0.0)
    gravity_m_s2 *= size / np.linalg.norm(gravity_m_s2)
    decimals = MOST_DECIMALS
    largest_std_m_s2 = float(np.max(std_m_s2[is_nonzero]))
    if np.count_nonzero(is_nonzero) > 1 and largest_std_m_s2 > 0.0:
        of_std = -math.floor(math.log10(largest_std_m_s2))
        decimals = min(MOST_DECIMALS, max(FEWEST_DECIMALS, of_std))
    rounded = np.round(gravity_m_s2, decimals)
    return np.asarray(rounded + 0.0)  # no minus before a zero
