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
    """Say how far a zero is off: `the zero of J3 off by -2.00 ± 0.04° (to be added to its
    position)`.

    Args:
        name: of the axis.
        value: to be added to its position [unit].
        std: its σ [unit].
        unit: `°` or `mm`.
    """
    decimals = zero_decimals(std)
    shown_std = max(std, 0.5 * 10.0**-MOST_DECIMALS)
    space = "" if unit == DEGREES else " "
    size = f"{value:+.{decimals}f} ± {shown_std:.{decimals}f}{space}{unit}"
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
    return (
        f"add {value:+.{decimals}f} to `{key}` of {name} in the cell file, which makes it "
        f"{described + value:.{decimals}f}, or correct the zero in the controller"
    )


def zero_decimals(std: float) -> int:
    """Decimals of a zero that its σ leaves."""
    if not std > 0.0:
        return MOST_DECIMALS
    return min(MOST_DECIMALS, max(FEWEST_DECIMALS, -math.floor(math.log10(std))))
