"""Which gains have changed together: by one common factor, one alone, or several each by its own amount."""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

_UNLIKE = 0.01
"""Changes that noise makes so different in fewer cases than this are not one common factor."""
_COMMON_SIGMAS = 4.0


class Pattern(Enum):
    """What the changes of all gains look like."""

    NONE = "none"
    ONE = "one axis"
    COMMON = "all axes by the same factor"
    SEVERAL = "several axes"


def pattern(change_percent: ArrayLike, std_percent: ArrayLike, alarmed: ArrayLike) -> Pattern:
    """What the changes of all gains look like together.

    All by the same factor where at least two raise an alarm, the weighted mean c̄ of all changes is significant, and
    Σ ((c − c̄)/σ)² is no larger than χ² with n − 1 degrees of freedom makes plausible.

    Args:
        change_percent, std_percent: of each axis since its baseline, with σ > 0 [%], shape (n,).
        alarmed: which of them raise an alarm, shape (n,).
    """
    changes, stds = np.asarray(change_percent, float), np.asarray(std_percent, float)
    count = int(np.count_nonzero(alarmed))
    if count < 2:
        return Pattern.ONE if count else Pattern.NONE
    weights = 1.0 / stds**2
    common = float(weights @ changes / weights.sum())
    spread = float(weights @ (changes - common) ** 2)
    alike = chi2.sf(spread, len(changes) - 1) > _UNLIKE
    return Pattern.COMMON if alike and abs(common) * weights.sum() ** 0.5 > _COMMON_SIGMAS else Pattern.SEVERAL
