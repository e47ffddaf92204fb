"""The error for closed gates."""

from __future__ import annotations

from collections.abc import Sequence

from daq.errors import CalibrationRefused
from daq.write_back.gates import Refusal


def closed(target: str, refusals: Sequence[Refusal]) -> CalibrationRefused:
    """What to raise for at least one closed gate; several are listed one a line.

    Args:
        target: what was not written.
        refusals: the closed gates.
    """
    if len(refusals) == 1:
        only = refusals[0]
        return CalibrationRefused(only.subject, found=only.found, expected=only.expected, remedy=only.remedy)
    listed = "".join(f"\n  {refusal}" for refusal in refusals)
    return CalibrationRefused(
        target,
        found=f"{len(refusals)} closed gates{listed}\n ",
        expected="none",
        remedy="nothing was written",
    )
