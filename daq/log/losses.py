"""Losses that a log tells of, and whether somebody wants to use it all the same."""

from __future__ import annotations

import re
from enum import Enum

MASKED = (
    "missing answers",
    "late answers",
    "answers of wrong length",
    "frames dropped by the kernel",
    "frames dropped by the interface",
    "frames dropped by the capture process",
)
"""What the recorder counts and every reader masks: the samples that it concerns carry the axis in `missing`."""


class LossyLogs(Enum):
    """What happens with a log that its recorder marked invalid because of MASKED losses."""

    REFUSED = "refused"
    ACCEPTED = "accepted"


def tells_losses_alone(reason: str) -> bool:
    """Whether the reason of an invalid run speaks of MASKED losses and of nothing else.

    Doubles, frames that nobody asked for and periods without SYNC are not among them: they say that the recorder did
    not understand what it saw.
    """
    kinds = "|".join(map(re.escape, MASKED))
    return all(re.fullmatch(rf"\d+ (?:{kinds})", part) for part in reason.split(", "))
