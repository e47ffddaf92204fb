"""A drive profile file: which objects of an amplifier carry position and current, and in which unit."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from daq.configuration.yaml_file import StrictModel, parse_yaml, read_model
from drivers.profile import Amplitude, CurrentScale, DriveProfile, ObjectEntry, TapPoint


class EntryModel(StrictModel):
    """One object dictionary entry."""

    index: Annotated[int, Field(ge=0x1000, le=0xFFFF)]
    subindex: Annotated[int, Field(ge=0, le=0xFF)] = 0
    type: Literal["i8", "i16", "i32", "i64", "u8", "u16", "u32", "u64"]

    def entry(self) -> ObjectEntry:
        """As drivers takes it."""
        return ObjectEntry(self.index, self.subindex, int(self.type[1:]), signed=self.type[0] == "i")


class SignalModel(StrictModel):
    """A signal that is mapped into the TPDO: at most 32 bits, because logs hold int32."""

    index: Annotated[int, Field(ge=0x1000, le=0xFFFF)]
    subindex: Annotated[int, Field(ge=0, le=0xFF)] = 0
    type: Literal["i8", "i16", "i32", "u8", "u16"]

    def entry(self) -> ObjectEntry:
        """As drivers takes it."""
        return ObjectEntry(self.index, self.subindex, int(self.type[1:]), signed=self.type[0] == "i")


class ScaleModel(StrictModel):
    """Ampere per raw unit: factor × product of objects."""

    factor: Annotated[float, Field(gt=0)]
    objects: tuple[EntryModel, ...] = ()


class DriveModel(StrictModel):
    """A whole drive profile file."""

    name: Annotated[str, Field(min_length=1)]
    position: SignalModel
    current: SignalModel
    current_scale: ScaleModel
    amplitude: Amplitude
    tap: TapPoint
    saturation_bit: Annotated[int, Field(ge=0, le=15)] | None = None
    update_period_us: Annotated[int, Field(gt=0)]
    save_semantics: str
    source: Annotated[str, Field(min_length=1)]


def drive_from_text(text: bytes, name: str) -> DriveProfile:
    """The profile in the text of a drive file.

    Args:
        text: of the file.
        name: what to call it in messages.

    Raises:
        ConfigurationError: the text is not a drive profile.
    """
    model = read_model(parse_yaml(text, name), DriveModel)
    return DriveProfile(
        name=model.name,
        position=model.position.entry(),
        current=model.current.entry(),
        current_scale=CurrentScale(model.current_scale.factor, tuple(o.entry() for o in model.current_scale.objects)),
        amplitude=model.amplitude,
        tap=model.tap,
        saturation_bit=model.saturation_bit,
        update_period_us=model.update_period_us,
        save_semantics=model.save_semantics,
        source=model.source,
    )
