"""What a make of amplifier calls position and current, and in which unit it says them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Amplitude(Enum):
    """Convention of a current value; peak against RMS alone is a 41 % gain error."""

    PEAK = "peak"
    RMS = "rms"
    DC = "dc"


class TapPoint(Enum):
    """Where in the current loop the logged signal is taken."""

    REFERENCE = "reference"
    LIMITED_REFERENCE = "limited reference"
    ACTUAL = "actual"


@dataclass(frozen=True, slots=True)
class ObjectEntry:
    """One entry of a CANopen object dictionary (CiA 301)."""

    index: int
    subindex: int
    bits: int
    signed: bool

    def __str__(self) -> str:
        return f"{self.index:04X}h:{self.subindex:02X}"


@dataclass(frozen=True, slots=True)
class CurrentScale:
    """Ampere per raw unit = factor × product of the objects' values, read by SDO at connect.

    CiA 402 generic: factor 1e-6 (per mille of mA) × 6075h.
    """

    factor: float
    objects: tuple[ObjectEntry, ...]


@dataclass(frozen=True, slots=True)
class DriveProfile:
    """Objects, types, scales and conventions of one make of amplifier, each fact with its source.

    Attributes:
        position: encoder position [counts], motor side.
        current: the signal whose gain is identified.
        current_scale: from raw unit to ampere in the stated amplitude convention.
        saturation_bit: bit of statusword 6041h that tells that a limit acts, None when the drive has none.
        update_period_us: how often the drive refreshes the mapped objects.
        save_semantics: what 1010h stores, in words; it decides what must be restored before a save.
        source: where these facts stand.
    """

    name: str
    position: ObjectEntry
    current: ObjectEntry
    current_scale: CurrentScale
    amplitude: Amplitude
    tap: TapPoint
    saturation_bit: int | None
    update_period_us: int
    save_semantics: str
    source: str
