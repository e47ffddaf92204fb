"""How a log came to be: evidence for whoever must say whether a calibration made of it may reach a controller."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Recording:
    """What a log tells of its making; axes in their order.

    Attributes:
        recorded_s: Unix time of its first sample [s]; None where it was imported and does not tell.
        entered_kg: mass of the payload as it was entered at the recording, from the scale; None where nobody did.
        serials: serial number of each amplifier, None for one that told none.
        saturated_percent: share of each axis's samples in which a limit acted [%].
        lost_cycles: SYNC cycles that are not in it.
        missing: samples in which each axis did not answer.
        controller_sha256: digest of the controller's file when it was recorded; None where the cell named none.
    """

    recorded_s: float | None
    entered_kg: float | None
    serials: tuple[int | None, ...]
    saturated_percent: tuple[float, ...]
    lost_cycles: int
    missing: tuple[int, ...]
    controller_sha256: str | None
