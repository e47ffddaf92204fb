"""Whether the answers to one SYNC fit between two of them on a CAN bus."""

from __future__ import annotations

from collections.abc import Iterable

from drivers.mapping import STATUSWORD, pack
from drivers.profile import DriveProfile

LARGEST_SHARE = 0.95
"""Of a period that SYNC and its answers may take at worst; what is left carries set-points and heartbeats."""


def frame_bits(data_bytes: int) -> int:
    """Longest data frame of an 11-bit identifier with so much data, stuff bits and the space after it counted.

    Source: ISO 11898-1; of 34 + 8·d bits that are stuffed, one in four (the first alone needs five) can be doubled.
    """
    stuffed = 34 + 8 * data_bytes
    return stuffed + 13 + (stuffed - 1) // 4


def answer_us(profiles: Iterable[DriveProfile], bitrate_bit_s: int) -> float:
    """How long SYNC and one answer of each axis occupy the bus at worst [µs].

    Args:
        profiles: of the axes, one each.
        bitrate_bit_s: of the bus.
    """
    bits = frame_bits(0) + sum(
        frame_bits(sum(entry.bits for entry in pdo) // 8)
        for profile in profiles
        for pdo in pack((profile.position, profile.current, STATUSWORD))
    )
    return 1e6 * bits / bitrate_bit_s
