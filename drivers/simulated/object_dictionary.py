"""The objects of a simulated CiA 402 amplifier: types, access, defaults (CiA 301 §7.5, CiA 402-2)."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import Enum

from drivers.simulated.errors import SdoAbort
from drivers.simulated.spec import AxisSpec

WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
NO_SUBINDEX = 0x06090011
INVALID_VALUE = 0x06090030


class Kind(Enum):
    """Data types by their struct code."""

    I8 = "b"
    U8 = "B"
    I16 = "h"
    U16 = "H"
    I32 = "i"
    U32 = "I"
    TEXT = "s"

    @property
    def bits(self) -> int:
        """Width; 0 for text, which has none."""
        return 0 if self is Kind.TEXT else 8 * struct.calcsize("<" + self.value)


class Mappable(Enum):
    """Into which process data object an entry may be mapped."""

    NO = ""
    TRANSMIT = "t"
    RECEIVE = "r"


Value = int | str


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry of the dictionary.

    Attributes:
        kind: data type.
        default: at power-on, if the node does not compute it.
        writable: by SDO.
        mappable: into PDOs.
        lowest, highest: range of values that are accepted, inclusive, None for the whole type.
    """

    kind: Kind
    default: Value = 0
    writable: bool = False
    mappable: Mappable = Mappable.NO
    lowest: int | None = None
    highest: int | None = None

    def encode(self, value: Value) -> bytes:
        """As it goes over the bus."""
        if isinstance(value, str):
            return value.encode("ascii")
        return struct.pack("<" + self.kind.value, value)

    def decode(self, data: bytes) -> Value:
        """From the bus.

        Raises:
            SdoAbort: wrong length, or outside the range of values.
        """
        if self.kind is Kind.TEXT:
            return data.decode("ascii", errors="replace")
        size = self.kind.bits // 8
        if len(data) != size:
            raise SdoAbort(TOO_LONG if len(data) > size else TOO_SHORT)
        (value,) = struct.unpack("<" + self.kind.value, data)
        if (self.lowest is not None and value < self.lowest) or (self.highest is not None and value > self.highest):
            raise SdoAbort(INVALID_VALUE)
        return int(value)


Dictionary = dict[tuple[int, int], Entry]

_REAL32, _REAL32_BITS = struct.Struct("<f"), struct.Struct("<I")

SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")


def amplifier_dictionary(axis: AxisSpec) -> Dictionary:
    """All entries of an amplifier, PDO parameters (1400h-1BFFh) excepted: pdo.py answers for those."""
    counts = axis.counts_per_revolution
    peak_per_mille = round(1000 * axis.peak_current_a / axis.rated_current_a)
    transmit, receive = Mappable.TRANSMIT, Mappable.RECEIVE
    return {
        (0x1000, 0): Entry(Kind.U32, 0x00020192),  # servo drive (2) of profile 402
        (0x1001, 0): Entry(Kind.U8, mappable=transmit),
        (0x1003, 0): Entry(Kind.U8, writable=True, highest=0),  # writing zero clears the history
        (0x1003, 1): Entry(Kind.U32),
        (0x1005, 0): Entry(Kind.U32, 0x80),
        (0x1008, 0): Entry(Kind.TEXT, "drivegain simulated CiA 402 amplifier"),
        (0x1009, 0): Entry(Kind.TEXT, "1.0"),
        (0x100A, 0): Entry(Kind.TEXT, "1.0"),
        (0x1010, 0): Entry(Kind.U8, 1),
        (0x1010, 1): Entry(Kind.U32, 1, writable=True),
        (0x1011, 0): Entry(Kind.U8, 1),
        (0x1011, 1): Entry(Kind.U32, 1, writable=True),
        (0x1014, 0): Entry(Kind.U32, 0x80 + axis.node_id),
        (0x1016, 0): Entry(Kind.U8, 1),
        (0x1016, 1): Entry(Kind.U32, writable=True),  # whom to watch: node id << 16 | ms
        (0x1017, 0): Entry(Kind.U16, 100, writable=True),
        (0x1018, 0): Entry(Kind.U8, 4),
        (0x1018, 1): Entry(Kind.U32, axis.vendor_id),
        (0x1018, 2): Entry(Kind.U32, axis.product_code),
        (0x1018, 3): Entry(Kind.U32, axis.revision),
        (0x1018, 4): Entry(Kind.U32, axis.serial),
        (0x1019, 0): Entry(Kind.U8),
        # The maker's own: the joint drive gain that somebody entered. Nobody reads it but a master.
        (0x2003, 0): Entry(Kind.U8, 2),
        (0x2003, 1): Entry(Kind.I32, round(1000 * axis.entered_gain_nm_per_a), writable=True),
        (0x2003, 2): Entry(Kind.U32, _REAL32_BITS.unpack(_REAL32.pack(axis.entered_gain_nm_per_a))[0], writable=True),
        (0x6007, 0): Entry(Kind.I16, 1, writable=True, lowest=0, highest=3),
        (0x603F, 0): Entry(Kind.U16, mappable=transmit),
        (0x6040, 0): Entry(Kind.U16, writable=True, mappable=receive),
        (0x6041, 0): Entry(Kind.U16, mappable=transmit),
        (0x605A, 0): Entry(Kind.I16, 2, writable=True, lowest=0, highest=6),
        (0x6060, 0): Entry(Kind.I8, 0, writable=True, mappable=receive, lowest=0, highest=1),
        (0x6061, 0): Entry(Kind.I8, mappable=transmit),
        (0x6062, 0): Entry(Kind.I32, mappable=transmit),
        (0x6063, 0): Entry(Kind.I32, mappable=transmit),
        (0x6064, 0): Entry(Kind.I32, mappable=transmit),
        (0x6065, 0): Entry(Kind.U32, counts // 2, writable=True),
        (0x6066, 0): Entry(Kind.U16, 10, writable=True),
        (0x6067, 0): Entry(Kind.U32, counts // 100, writable=True),
        (0x6068, 0): Entry(Kind.U16, 10, writable=True),
        (0x606C, 0): Entry(Kind.I32, mappable=transmit),
        (0x6073, 0): Entry(Kind.U16, peak_per_mille, writable=True, mappable=receive, highest=peak_per_mille),
        (0x6074, 0): Entry(Kind.I16, mappable=transmit),
        (0x6075, 0): Entry(Kind.U32, round(1000 * axis.rated_current_a)),
        # Zero until someone enters the motor's name plate: the cell must not tell its true torque constant.
        (0x6076, 0): Entry(Kind.U32, 0, writable=True),
        (0x6077, 0): Entry(Kind.I16, mappable=transmit),
        (0x6078, 0): Entry(Kind.I16, mappable=transmit),
        (0x607A, 0): Entry(Kind.I32, writable=True, mappable=receive),
        (0x6081, 0): Entry(Kind.U32, 10 * counts, writable=True, mappable=receive, lowest=1),
        (0x6083, 0): Entry(Kind.U32, 50 * counts, writable=True, mappable=receive, lowest=1),
        (0x6084, 0): Entry(Kind.U32, 50 * counts, writable=True, mappable=receive, lowest=1),
        (0x6085, 0): Entry(Kind.U32, 100 * counts, writable=True, mappable=receive, lowest=1),
        (0x608F, 0): Entry(Kind.U8, 2),
        (0x608F, 1): Entry(Kind.U32, counts),
        (0x608F, 2): Entry(Kind.U32, 1),
        (0x60F4, 0): Entry(Kind.I32, mappable=transmit),
        (0x6502, 0): Entry(Kind.U32, 1),  # profile position alone
    }


def find(dictionary: Dictionary, index: int, subindex: int) -> Entry:
    """The entry.

    Raises:
        SdoAbort: it does not exist.
    """
    entry = dictionary.get((index, subindex))
    if entry is not None:
        return entry
    raise SdoAbort(NO_SUBINDEX if any(known == index for known, _ in dictionary) else NO_OBJECT)
