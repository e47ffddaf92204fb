"""A number in a drive's object dictionary that is not always an integer."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import Enum

from drivers.profile import ObjectEntry


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
