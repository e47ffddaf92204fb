"""What a make of amplifier calls position and current, in which unit it says them, and who says so."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum


class Amplitude(Enum):
    """Convention of a current value; peak against RMS alone is a 41 % gain error.

    QUADRATURE is the torque-making component of a field-oriented loop, in the length that the drive's transformation
    gives it. UNSTATED is a convention that was chosen when the drive was set up and that it does not tell.
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


class Basis(Enum):
    """What a fact of a profile rests on, the strongest first.

    EDS: the manufacturer's electronic data sheet. MANUAL: the manufacturer's text, read. STANDARD: what CiA 301 or 402
    asks for; that the drive does so was not checked. NOTES: this project's notes on amplifiers, not traced to a text of
    the manufacturer. ASSUMED: nobody has checked it.
    """

    EDS = "eds"
    MANUAL = "manual"
    STANDARD = "standard"
    NOTES = "notes"
    ASSUMED = "assumed"

    @property
    def verified(self) -> bool:
        """Whether it was read in a text of the manufacturer."""
        return self in (Basis.EDS, Basis.MANUAL)


class Mapping(Enum):
    """What becomes of PDO mappings when a drive saves its parameters."""

    STORED = "stored"
    SEPARATE = "separate"
    UNKNOWN = "unknown"


class ScaleForm(Enum):
    """The known ways from a raw number to ampere; `CurrentScale` is what each amounts to.

    PRODUCT: factor × objects. PER_MILLE: of a rated current that the drive holds in mA. FIXED_STEP: so many ampere.
    DIGITS_OF_PEAK: so many digits are the drive's peak current, which a person enters. DIGITS_OF_REPORTED_PEAK: the
    same, and the drive tells it in mA. SWITCHED_PER_MILLE: of the rated current, or of it over √2, as an object says.
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
    signed: bool

    def __str__(self) -> str:
        return f"{self.index:04X}h:{self.subindex:02X}"


@dataclass(frozen=True, slots=True)
class CurrentScale:
    """Ampere per raw unit = factor × product of the objects' values × weight of the switch's value.

    CiA 402 generic: factor 1e-6 (per mille of mA) × 6075h.

    Attributes:
        factor, objects: of the product; the objects are read by SDO at connect.
        form: how a profile file says it.
        switch: object whose value chooses a weight, None where there is no choice.
        weights: of the switch's values 0, 1, and so on.
    """

    factor: float
    objects: tuple[ObjectEntry, ...]
    form: ScaleForm = ScaleForm.PRODUCT
    switch: ObjectEntry | None = None
    weights: tuple[float, ...] = (1.0,)

    def ampere_per_unit(self, values: Sequence[int], choice: int = 0) -> float:
        """The scale.

        Args:
            values: of the objects, in their order.
            choice: value of the switch.

        Raises:
            IndexError: the switch has no such value.
        """
        if not 0 <= choice < len(self.weights):
            raise IndexError(choice)
        return self.factor * math.prod(values) * self.weights[choice]


@dataclass(frozen=True, slots=True)
class RatedMotor:
    """Where a drive keeps the motor's name plate; what ampere values are checked against.

    Attributes:
        current: rated current.
        ampere_per_unit: of it (6075h: 1e-3).
        torque: rated torque, None where the drive has none.
        newton_metre_per_unit: of it (6076h: 1e-3).
    """

    current: ObjectEntry
    ampere_per_unit: float = 1e-3
    torque: ObjectEntry | None = None
    newton_metre_per_unit: float = 1e-3


@dataclass(frozen=True, slots=True)
class Save:
    """How a drive is told to keep its parameters.

    Attributes:
        command: object that takes the signature.
        signature: what to write to it ("save" of CiA 301).
        mapping: whether mappings made for a recording would be kept too; then they must be restored before.
    """

    command: ObjectEntry
    signature: int
    mapping: Mapping


@dataclass(frozen=True, slots=True)
class Fact:
    """Why one line of a profile is believed.

    Attributes:
        about: key of the profile.
        basis: kind of evidence.
        where: document and section, EDS object, or what is missing.
    """

    about: str
    basis: Basis
    where: str


@dataclass(frozen=True, slots=True)
class DriveProfile:
    """Objects, types, scales and conventions of one make of amplifier, each fact with its source.

    Attributes:
        position: encoder position [counts], motor side.
        current: the signal whose gain is identified.
        current_scale: from raw unit to ampere in the stated amplitude convention.
        saturation_bit: bit of statusword 6041h that tells that a limit acts, None when the drive has none.
        toggle_bit: bit of statusword 6041h that the drive inverts whenever it fills its PDO anew; None when it has
            none: then frozen data show as values that do not change in a move (drivers/motion/watch.py).
        update_period_us: how often the drive refreshes the mapped objects.
        save_semantics: what saving stores, in words; it decides what must be restored before a save.
        source: where these facts stand, in short.
        facts: the same, one a line of the profile.
        rated: the motor's name plate in the drive, None where it has none.
        save: how it is told to save, None where it cannot or where nobody knows.
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
    facts: tuple[Fact, ...] = ()
    rated: RatedMotor | None = None
    save: Save | None = None
    toggle_bit: int | None = None

    @property
    def signal(self) -> str:
        """What the log's current is, for people: "current reference 6074h:00"."""
        words = {
            TapPoint.REFERENCE: "current reference",
            TapPoint.LIMITED_REFERENCE: "limited current reference",
            TapPoint.ACTUAL: "ACTUAL current",
        }
        return f"{words[self.tap]} {self.current}"

    @property
    def unverified(self) -> tuple[Fact, ...]:
        """What was not read in a text of the manufacturer."""
        return tuple(fact for fact in self.facts if not fact.basis.verified)


# A number in a drive's object dictionary that is not always an integer.


class ParameterKind(Enum):
    """Data type of an object (CiA 301: INTEGER16, UNSIGNED16, INTEGER32, UNSIGNED32, REAL32)."""

    I16 = "i16"
    U16 = "u16"
    I32 = "i32"
    U32 = "u32"
    F32 = "f32"

    @property
    def bits(self) -> int:
        """Width."""
        return int(self.value[1:])


_CODES = {
    ParameterKind.I16: "<h",
    ParameterKind.U16: "<H",
    ParameterKind.I32: "<i",
    ParameterKind.U32: "<I",
    ParameterKind.F32: "<f",
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number in a drive."""

    index: int
    subindex: int
    kind: ParameterKind

    def __str__(self) -> str:
        return str(self.entry)

    @property
    def entry(self) -> ObjectEntry:
        """The object as it goes over the bus: its bits as an unsigned word."""
        return ObjectEntry(self.index, self.subindex, self.kind.bits, signed=False)

    @property
    def whole(self) -> bool:
        """Whether it holds integers alone."""
        return self.kind is not ParameterKind.F32

    def word(self, value: float) -> int:
        """The bits of the number that it can hold nearest to a value.

        Raises:
            ValueError: it holds no such number: out of range, or not finite.
        """
        if not math.isfinite(value):
            raise ValueError(f"{value} is no number for {self}")
        try:
            data = struct.pack(_CODES[self.kind], round(value) if self.whole else value)
        except (struct.error, OverflowError) as error:
            raise ValueError(f"{value:g} does not fit {self.kind.value} {self}") from error
        return int.from_bytes(data, "little")

    def value(self, word: int) -> float:
        """The number that some bits stand for; REAL32 knows NaN and infinity."""
        (number,) = struct.unpack(_CODES[self.kind], word.to_bytes(self.kind.bits // 8, "little"))
        return float(number)


# One configured axis of a cell, as the bus sees it.


@dataclass(frozen=True, slots=True)
class Identity:
    """Object 1018h (CiA 301); a serial of None is not compared."""

    vendor_id: int
    product_code: int
    serial: int | None = None


@dataclass(frozen=True, slots=True)
class Axis:
    """One amplifier of the cell.

    Attributes:
        name: what a person calls it.
        node_id: CANopen node id, 1 to 127.
        profile: which objects it keeps position and current in.
        identity: what 1018h must say, or None when the configuration does not know it.
    """

    name: str
    node_id: int
    profile: DriveProfile
    identity: Identity | None = None
