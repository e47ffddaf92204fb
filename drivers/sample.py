"""One SYNC cycle of a cell, as the amplifiers sent it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Sample:
    """What all axes reported for one SYNC.

    Raw counts, converted late: the gain is what is being identified, so no assumed gain is baked into data.

    Attributes:
        cycle: number of the sampling period since the stream began; a period that had no SYNC leaves a gap.
        time_ns: time of the SYNC, not of the frames that answered it: wall time at the stream's first SYNC plus the
            monotonic time since [ns since 1970].
        position_counts: motor-side position of each axis [encoder counts].
        current_raw: signal of the current loop of each axis [unit of the drive profile's current object].
        statusword: CiA 402 object 6041h of each axis.
        missing: bit i is set when axis i did not answer this SYNC; its values then repeat the last known ones.
    """

    cycle: int
    time_ns: int
    position_counts: tuple[int, ...]
    current_raw: tuple[int, ...]
    statusword: tuple[int, ...]
    missing: int = 0
