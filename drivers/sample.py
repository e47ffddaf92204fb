"""One SYNC cycle of a cell, as the amplifiers sent it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Sample:
    """What all axes reported for one SYNC.

    Raw counts, converted late: the gain is what is being identified, so no assumed gain is baked into data.

    Attributes:
        cycle: number of the SYNC since the stream began.
        time_ns: time of the SYNC [ns], not of the frames that answered it.
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
