"""A drive profile file: the objects of an amplifier with position and current, their units,
and the evidence for each.

The classes here differ from those of `drivers.profiles`: an object's type is one word (`i32`), and
the keys of a scale depend on its form.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from daq.config.yaml_file import (
    DocumentKind,
    Fault,
    Positive,
    StrictModel,
    fault_texts,
    parse_yaml,
    read_model,
)
from daq.environment import shipped_configurations
from daq.errors import ConfigurationInconsistent
from drivers.profiles.profile import (
    Amplitude,
    CurrentScale,
    DriveProfile,
    Fact,
    FactBasis,
    Mapping,
    ObjectEntry,
    RatedMotor,
    Save,
    ScaleForm,
    TapPoint,
    Thermometer,
)

Index = Annotated[int, Field(ge=0x1000, le=0xFFFF)]
Subindex = Annotated[int, Field(ge=0, le=0xFF)]
Text = Annotated[str, Field(min_length=1, max_length=400)]


class SectionModel(StrictModel, ABC):
    """A section that `drivers` has as a class of its own."""

    @abstractmethod
    def built(self) -> Any:
        """Convert to the class of `drivers`."""


def _parts(model: StrictModel) -> dict[str, Any]:
    """Return the values of a section by their keys,
    with every section in it as the class of `drivers`.
    """
    parts: dict[str, Any] = {}
    for key, value in model:
        if isinstance(value, SectionModel):
            parts[key] = value.built()
        else:
            parts[key] = value
    return parts


class EntryModel(SectionModel):
    """One object dictionary entry."""

    index: Index
    subindex: Subindex = 0
    type: Literal["i8", "i16", "i32", "i64", "u8", "u16", "u32", "u64"]

    def built(self) -> Any:
        """Convert to `ObjectEntry`; a temperature is a `Thermometer`."""
        return ObjectEntry(
            self.index, self.subindex, int(self.type[1:]), signed=self.type[0] == "i"
        )


class SignalModel(EntryModel):
    """A signal of at most 32 bits: logs hold int32 of what a TPDO carries,
    and slow readings come in one SDO frame.
    """

    type: Literal["i8", "i16", "i32", "u8", "u16"]


SCALE_KEYS: dict[ScaleForm, frozenset[str]] = {
    ScaleForm.PRODUCT: frozenset({"factor", "objects"}),
    ScaleForm.PER_MILLE: frozenset({"rated_current"}),
    ScaleForm.FIXED_STEP: frozenset({"ampere_per_unit"}),
    ScaleForm.DIGITS_OF_PEAK: frozenset({"digits", "peak_current_a"}),
    ScaleForm.DIGITS_OF_REPORTED_PEAK: frozenset({"digits", "peak_current"}),
    ScaleForm.SWITCHED_PER_MILLE: frozenset({"rated_current", "switch"}),
}
"""Keys of each form, all of them required (but `objects` of a product)."""


class ScaleModel(SectionModel):
    """Ampere per raw unit, in one of the known forms (drivers.profile.ScaleForm).

    A file without `form` is a product: logs of the first version carry such profiles.
    """

    form: ScaleForm = ScaleForm.PRODUCT
    factor: Positive | None = None
    objects: tuple[EntryModel, ...] = ()
    rated_current: EntryModel | None = None
    ampere_per_unit: Positive | None = None
    digits: Annotated[int, Field(gt=0)] | None = None
    peak_current_a: Positive | None = None
    peak_current: EntryModel | None = None
    switch: EntryModel | None = None

    @model_validator(mode="after")
    def _form_and_keys(self) -> ScaleModel:
        given = self.model_fields_set - {"form"}
        wanted = SCALE_KEYS[self.form]
        may_be_empty = {"peak_current_a"}
        empty = {key for key in given - may_be_empty if getattr(self, key) is None}
        unknown = given - wanted
        missing = wanted - given - {"objects"}
        if empty or unknown or missing:
            keys = " and ".join(sorted(wanted))
            raise ValueError(f"{keys} of a scale of form {self.form.value}, and nothing else")
        return self

    def built(self) -> CurrentScale | None:
        """Convert to the class of `drivers`; None until the peak current is entered."""
        factor = self.factor
        objects = self.objects
        if self.rated_current is not None:
            factor = 1e-6  # a thousandth of so many mA
            objects = (self.rated_current,)
        elif self.digits is not None and self.peak_current is not None:
            factor = 1e-3 / self.digits  # [mA]
            objects = (self.peak_current,)
        elif self.digits is not None and self.peak_current_a is not None:
            factor = self.peak_current_a / self.digits
        elif self.ampere_per_unit is not None:
            factor = self.ampere_per_unit
        if factor is None:
            return None
        entries = tuple(entry.built() for entry in objects)
        if self.switch is None:
            return CurrentScale(factor, entries, self.form)
        switch = self.switch.built()
        return CurrentScale(factor, entries, self.form, switch, (math.sqrt(0.5), 1.0))


class RatedModel(SectionModel):
    """Objects with the motor's rated values."""

    current: EntryModel
    ampere_per_unit: Positive = 1e-3
    torque: EntryModel | None = None
    newton_metre_per_unit: Positive = 1e-3

    def built(self) -> RatedMotor:
        """Convert to the class of `drivers`."""
        return RatedMotor(**_parts(self))


class TemperatureModel(SignalModel):
    """Object with the temperature of the motor or the drive."""

    kelvin_per_unit: Positive

    def built(self) -> Thermometer:
        """Convert to the class of `drivers`."""
        return Thermometer(super().built(), self.kelvin_per_unit)


class SaveModel(SectionModel):
    """Command with which the drive stores its parameters."""

    index: Index = 0x1010
    subindex: Subindex
    signature: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    mapping: Mapping

    def built(self) -> Save:
        """Convert to the class of `drivers`."""
        return Save(
            ObjectEntry(self.index, self.subindex, 32, signed=False), self.signature, self.mapping
        )


class FactModel(StrictModel):
    """Evidence for a fact."""

    basis: FactBasis
    where: Text


class FactsModel(SectionModel):
    """Evidence for each line of a profile."""

    position: FactModel
    current: FactModel
    current_scale: FactModel
    amplitude: FactModel
    tap: FactModel
    saturation_bit: FactModel
    update_period_us: FactModel
    rated: FactModel
    save: FactModel
    toggle_bit: FactModel | None = None
    torque: FactModel | None = None
    temperature: FactModel | None = None

    def built(self) -> tuple[Fact, ...]:
        """Convert to the class of `drivers`."""
        return tuple(Fact(name, fact.basis, fact.where) for name, fact in self if fact is not None)


class DriveModel(StrictModel):
    """A whole drive profile file."""

    reference: ClassVar[str] = "schemas.md"
    document_kind: ClassVar[DocumentKind | None] = DocumentKind.DRIVE_PROFILE

    name: Annotated[str, Field(min_length=1)]
    position: SignalModel
    current: SignalModel
    current_scale: ScaleModel
    amplitude: Amplitude
    tap: TapPoint
    saturation_bit: Annotated[int, Field(ge=0, le=15)] | None = None
    toggle_bit: Literal[8, 14, 15] | None = None
    """CiA 402 leaves these bits to the maker;
    the others have a meaning in profile position mode.
    """
    update_period_us: Annotated[int, Field(gt=0)]
    rated: RatedModel | None = None
    torque: SignalModel | None = None
    """Torque actual value, in thousandths of the rated torque,
    which the drive must report (`rated.torque`).
    """
    temperature: TemperatureModel | None = None
    save: SaveModel | None = None
    save_semantics: str
    source: Annotated[str, Field(min_length=1)]
    eds: Annotated[str, Field(pattern=r"^[^/\\\x00]+$", max_length=200)] | None = None
    """File next to the profile, the maker's data sheet; a log carries it."""
    facts: FactsModel | None = None

    @model_validator(mode="after")
    def _options_and_sources(self) -> DriveModel:
        for key in ("toggle_bit", "torque", "temperature"):
            if self.facts is None:
                continue
            is_given = getattr(self, key) is not None
            has_source = getattr(self.facts, key) is not None
            if is_given != has_source:
                raise ValueError(f"{key} and facts.{key}, both or neither")
        if self.torque is not None and (self.rated is None or self.rated.torque is None):
            raise ValueError("torque with rated.torque, of which it is given in thousandths")
        return self


def shipped_profiles() -> tuple[DriveProfile, ...]:
    """Return the shipped profiles, without those that need an entry of the operator."""
    profiles = []
    for path in sorted((shipped_configurations() / "drives").glob("*.yaml")):
        with suppress(ConfigurationInconsistent):
            profiles.append(drive_from_text(path.read_bytes(), path.name))
    return tuple(profiles)


def drive_from_text(text: bytes, name: str) -> DriveProfile:
    """Read a drive file.

    Args:
        text: content of the file.
        name: name of the file in messages.

    Raises:
        ConfigurationError: it is not a drive profile, or the peak current of the drive is missing.
    """
    document = parse_yaml(text, name)
    parts = _parts(read_model(document, DriveModel))
    if parts["current_scale"] is None:
        place = ("current_scale", "peak_current_a")
        expected = "the peak current of this size of drive [A]; no object of the drive reports it"
        raise ConfigurationInconsistent(
            **fault_texts(document, [Fault(place, "nothing", expected)]),
            remedy="copy the profile to drives/ next to your cell file and enter it from the "
            "drive's data sheet",
        )
    del parts["eds"]  # a log carries it for people; no reader of a profile needs it
    parts["facts"] = parts["facts"] or ()
    return DriveProfile(**parts)
