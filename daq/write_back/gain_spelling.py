"""How a gain is written into a controller file."""

from __future__ import annotations

import math


def spell(value: float, std: float) -> str:
    """A gain as text: two digits beyond the first digit of σ, at least five significant, no more than a float has.

    The text has a point always, so that no reader takes it for an integer.
    """
    magnitude = math.floor(math.log10(abs(value)))
    decimals = 4 - magnitude
    if std > 0:
        decimals = max(decimals, 2 - math.floor(math.log10(std)))
    decimals = min(decimals, 16 - magnitude)
    if magnitude < -5 or magnitude > 12:
        return f"{value:.{decimals + magnitude}e}"
    return f"{value:.{max(decimals, 1)}f}"
