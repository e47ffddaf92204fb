"""Describe a make of amplifier: its objects for position and current, their units,
and the source of each fact.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated

from annotated_types import Interval


class Amplitude(Enum):
    """Convention of a current value; peak against RMS alone is a 41 % gain error.

    QUADRATURE is the q-axis current of a field-oriented loop; its scale depends on the drive's
    Clarke transformation (amplitude or power invariant). UNSTATED is a convention that was chosen
    at commissioning and that the drive does not report.
    """

    PEAK = "peak"
    RMS = "rms"
    DC = "dc"
    QUADRATURE = "quadrature"
    UNSTATED = "unstated"


class TapPoint(Enum):
    """Where in the current loop the logged signal is taken."""

    REFERENCE = "reference"
    LIMITED_REFERENCE = "limited reference"
    ACTUAL = "actual"


class FactBasis(Enum):
    """Evidence for a fact of a profile, the strongest first.

    EDS: the manufacturer's electronic data sheet. MANUAL: the manufacturer's text, read. STANDARD:
    required by CiA 301 or 402, not checked for this drive. NOTES: this project's notes on
    amplifiers, not traced to a text of the manufacturer. ASSUMED: not checked at all.
    """

    EDS = "eds"
    MANUAL = "manual"
    STANDARD = "standard"
    NOTES = "notes"
    ASSUMED = "assumed"


class Mapping(Enum):
    """Whether a drive's save includes its PDO mappings."""

    STORED = "stored"
    SEPARATE = "separate"
    UNKNOWN = "unknown"


class ScaleForm(Enum):
    """Known conversions from a raw number to ampere; each becomes a `CurrentScale`.

    PRODUCT: factor × objects.
    PER_MILLE: per mille of the rated current, which an object of the drive has [mA].
    FIXED_STEP: ampere per digit.
    DIGITS_OF_PEAK: so many digits are the drive's peak current, which the operator enters.
    DIGITS_OF_REPORTED_PEAK: the same, where an object of the drive has the peak current [mA].
    SWITCHED_PER_MILLE: per mille of the rated current, or of the rated current over √2; the value
    of another object decides.
    """

    PRODUCT = "product"
    PER_MILLE = "per-mille-of-rated-current"
    FIXED_STEP = "fixed-step"
    DIGITS_OF_PEAK = "digits-of-peak-current"
    DIGITS_OF_REPORTED_PEAK = "digits-of-told-peak-current"
    SWITCHED_PER_MILLE = "per-mille-of-rated-current-or-its-rms"


@dataclass(frozen=True, slots=True)
class ObjectEntry:
    """One entry of a CANopen object dictionary (CiA 301)."""

    index: int
    subindex: int
    bits: int
    signed: bool = False

    def __str__(self) -> str:
        return f"{self.index:04X}h:{self.subindex:02X}"


@dataclass(frozen=True, slots=True)
class CurrentScale:
    """Conversion of a raw current to ampere.

    Ampere per raw unit = factor × product of the values of `objects` × weight of the value of
    `switch`. With the objects of CiA 402 alone, the factor is 1e-6 (per mille of mA), and the
    object is the motor rated current 6075h.
    """

    factor: float
    objects: tuple[ObjectEntry, ...]  #: they are read by SDO at connect
    form: ScaleForm = ScaleForm.PRODUCT  #: how a profile file writes it
    #: object whose value is the index of the weight; None where there is one weight
    switch: ObjectEntry | None = None
    weights: tuple[float, ...] = (1.0,)

    def ampere_per_unit(self, values: Sequence[int], choice: int = 0) -> float:
        """Return the scale [A per raw unit].

        Args:
            values: of `objects`, in their order.
            choice: value of `switch`.

        Raises:
            IndexError: there is no weight for this choice.
        """
        if not 0 <= choice < len(self.weights):
            raise IndexError(choice)
        return self.factor * math.prod(values) * self.weights[choice]


@dataclass(frozen=True, slots=True)
class RatedMotor:
    """Objects of the motor's rated values in a drive, against which ampere values are checked."""

    current: ObjectEntry  #: rated current
    ampere_per_unit: float = 1e-3  #: its unit (6075h: 1e-3)
    torque: ObjectEntry | None = None  #: rated torque; None where the drive has none
    newton_metre_per_unit: float = 1e-3  #: its unit (6076h: 1e-3)


@dataclass(frozen=True, slots=True)
class Thermometer:
    """Object with the temperature of the motor or the drive."""

    entry: ObjectEntry
    kelvin_per_unit: float  #: its unit; a raw value of 0 is 0 °C


@dataclass(frozen=True, slots=True)
class Save:
    """Command that saves a drive's parameters."""

    command: ObjectEntry  #: object to write
    signature: int  #: its value ("save" of CiA 301)
    #: whether it saves PDO mappings too; the drive's own mappings must then be restored before a
    #: save, so that it does not store those of a recording
    mapping: Mapping


@dataclass(frozen=True, slots=True)
class Fact:
    """Evidence for one key of a profile."""

    about: str  #: key of the profile
    basis: FactBasis  #: kind of evidence
    where: str  #: document and section, EDS object, or the missing evidence


@dataclass(frozen=True, slots=True)
class DriveProfile:
    """Objects, types, scales and conventions of one make of amplifier,
    each fact with its source.
    """

    name: str
    position: ObjectEntry  #: encoder position [counts], motor side
    current: ObjectEntry  #: the signal whose gain is identified
    current_scale: CurrentScale  #: from raw unit to ampere in the stated amplitude convention
    amplitude: Amplitude
    tap: TapPoint
    #: bit of statusword 6041h that shows an active limit, None when the drive has none
    saturation_bit: int | None
    update_period_us: int  #: period in which the drive refreshes the mapped objects
    #: content of a save, in words; it decides what must be restored before a save
    save_semantics: str
    source: str  #: documents, in short
    facts: tuple[Fact, ...] = ()  #: the same for each key of the profile
    #: the motor's rated values in the drive, None where it has none
    rated: RatedMotor | None = None
    save: Save | None = None  #: command that saves, None where there is none or it is unknown
    #: Bit of statusword 6041h that the drive inverts whenever it refreshes its PDO. None where it
    #: has no such bit: frozen data are then detected by values that do not change during a move
    #: (drivers/stream/watch.py).
    toggle_bit: int | None = None
    #: Torque actual value [per mille of the rated torque], None where the drive has none. It is
    #: compared with the identified gain, and no fit uses it.
    torque: ObjectEntry | None = None
    #: of the motor or the drive, None where the drive reports none
    temperature: Thermometer | None = None

    @property
    def signal(self) -> str:
        """Description of the recorded current: "current reference 6074h:00"."""
        tap_names = {
            TapPoint.REFERENCE: "current reference",
            TapPoint.LIMITED_REFERENCE: "limited current reference",
            TapPoint.ACTUAL: "ACTUAL current",
        }
        return f"{tap_names[self.tap]} {self.current}"


CIA402 = DriveProfile(
    name="cia402",
    position=ObjectEntry(0x6064, 0, 32, signed=True),
    current=ObjectEntry(0x6074, 0, 16, signed=True),
    current_scale=CurrentScale(1e-6, (ObjectEntry(0x6075, 0, 32),), ScaleForm.PER_MILLE),
    amplitude=Amplitude.RMS,
    tap=TapPoint.REFERENCE,
    saturation_bit=11,
    update_period_us=1000,
    save_semantics="unknown",
    source="CiA 402-2 (objects 6041h, 6064h, 6074h, 6075h, 6076h)",
    rated=RatedMotor(ObjectEntry(0x6075, 0, 32), torque=ObjectEntry(0x6076, 0, 32)),
)
"""An amplifier that follows the standard: position in 6064h,
torque demand in 6074h as per mille of rated current.
"""


U32 = Annotated[int, Interval(ge=0, le=0xFFFFFFFF)]  #: Checked where a cell file is read


@dataclass(frozen=True, slots=True)
class Identity:
    """Object 1018h (CiA 301).

    The vendor alone is mandatory. None stands for a field that a drive does not have, or that a
    configuration leaves open: it is not compared.
    """

    vendor_id: U32  #: 1018:01 of the drive
    product_code: U32 | None = None  #: 1018:02
    serial: U32 | None = None  #: 1018:04; by it, two exchanged drives are noticed

    def differences(self, found: Identity) -> tuple[str, ...]:
        """Describe each field in which a drive differs from this configuration;
        a serial number is decimal.
        """
        fields = (
            ("vendor id 1018h:01", "#x", self.vendor_id, found.vendor_id),
            ("product code 1018h:02", "#x", self.product_code, found.product_code),
            ("serial number 1018h:04", "d", self.serial, found.serial),
        )
        described = []
        for name, notation, expected, reported in fields:
            if expected is None or expected == reported:
                continue
            if reported is None:
                number = "not reported"
            else:
                number = format(reported, notation)
            described.append(
                f"{name} is {number}, the cell configuration expects {expected:{notation}}"
            )
        return tuple(described)


@dataclass(frozen=True, slots=True)
class Axis:
    """One amplifier of the cell."""

    name: str  #: for messages and logs
    node_id: int  #: CANopen node id, 1 to 127
    profile: DriveProfile = CIA402  #: objects of position and current
    identity: Identity | None = None  #: expected 1018h, or None when it is not configured


class ParameterKind(Enum):
    """Data type of an object (CiA 301: INTEGER16, UNSIGNED16, INTEGER32, UNSIGNED32, REAL32)."""

    I16 = "i16"
    U16 = "u16"
    I32 = "i32"
    U32 = "u32"
    F32 = "f32"

    @property
    def bits(self) -> int:
        """Width in bits."""
        return int(self.value[1:])


_STRUCT_CODES = {
    ParameterKind.I16: "<h",
    ParameterKind.U16: "<H",
    ParameterKind.I32: "<i",
    ParameterKind.U32: "<I",
    ParameterKind.F32: "<f",
}


@dataclass(frozen=True, slots=True)
class DriveParameter:
    """One number in a drive's object dictionary, integer or floating point."""

    index: int
    subindex: int
    kind: ParameterKind

    def __str__(self) -> str:
        return str(self.entry)

    @property
    def entry(self) -> ObjectEntry:
        """The object as SDO transfers it: its bit pattern as an unsigned number."""
        return ObjectEntry(self.index, self.subindex, self.kind.bits)

    def word(self, value: float) -> int:
        """Return the bit pattern of the nearest number that the object can hold.

        Raises:
            ValueError: the value is out of range, or not finite.
        """
        if not math.isfinite(value):
            raise ValueError(f"{value} is no number for {self}")
        number = value
        if self.kind is not ParameterKind.F32:
            number = round(value)
        try:
            data = struct.pack(_STRUCT_CODES[self.kind], number)
        except (struct.error, OverflowError) as error:
            raise ValueError(f"{value:g} does not fit {self.kind.value} {self}") from error
        return int.from_bytes(data, "little")

    def value(self, word: int) -> float:
        """Return the number of a bit pattern; REAL32 has NaN and infinity."""
        data = word.to_bytes(self.kind.bits // 8, "little")
        (number,) = struct.unpack(_STRUCT_CODES[self.kind], data)
        return float(number)
