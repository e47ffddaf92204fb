"""The words for a zero that is off: the same by torque, by encoders, and on the certificate.

The number is what has to be added: to the positions of the axis, and so to its `zero_offset_…` in
the cell file. A zero that was declared 2° too large is off by -2°.
"""

from __future__ import annotations

import math

DEGREES = "°"
MILLIMETRES = "mm"
MOST_DECIMALS = 4  #: Of degrees or millimetres: what a cell file can hold
FEWEST_DECIMALS = 2


def zero_off_text(name: str, value: float, std: float, unit: str) -> str:
    """Say how far a zero is off: `the zero of J3 off by -2.00 ± 0.04°`.

    Args:
        name: of the axis.
        value: to be added to its position [unit].
        std: its σ [unit].
        unit: `°` or `mm`.
    """
    decimals = zero_decimals(std)
    shown_std = max(std, 0.5 * 10.0**-MOST_DECIMALS)
    space = "" if unit == DEGREES else " "
    size_text = f"{value:+.{decimals}f}"
    std_text = f"{shown_std:.{decimals}f}"
    size = f"{size_text} ± {std_text}{space}{unit}"
    return f"the zero of {name} off by {size} (to be added to its position)"


def zero_remedy(name: str, value: float, std: float, unit: str, described: float) -> str:
    """Say which number of the cell file corrects a zero.

    Args:
        name: of the axis.
        value: to be added to its position [unit].
        std: its σ [unit].
        unit: `°` or `mm`.
        described: the number that the cell file has now [unit].
    """
    key = "zero_offset_deg" if unit == DEGREES else "zero_offset_mm"
    decimals = zero_decimals(std)
    change = f"{value:+.{decimals}f}"
    corrected = f"{described + value:.{decimals}f}"
    return (
        f"add {change} to `{key}` of {name} in the cell file, which makes it {corrected}, or "
        "correct the zero in the controller"
    )


def zero_decimals(std: float) -> int:
    """Decimals of a zero that its σ leaves."""
    if not std > 0.0:
        return MOST_DECIMALS
    decimals = -math.floor(math.log10(std))
    return min(MOST_DECIMALS, max(FEWEST_DECIMALS, decimals))
