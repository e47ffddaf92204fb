"""Object dictionary of a simulated CiA 402 amplifier, and its SDO server.

Source: CiA 301 §7.2 and §7.5, CiA 402-2.

Amplifiers of a vendor differ only in the objects that a recording reads (current, rated values);
states, moves and limits are those of CiA 402. Their units are written here from the vendors'
manuals, not taken from the drive profiles, so that tests detect a wrong scale.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from drivers.simulation.amplifier import AmplifierSet
from drivers.simulation.spec import AxisSpec, Dialect, SdoAbort

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
        """Width in bits; 0 for text."""
        if self is Kind.TEXT:
            return 0
        return 8 * struct.calcsize("<" + self.value)

    def encode(self, value: int) -> bytes:
        """Return the bytes for the bus."""
        return struct.pack("<" + self.value, value)

    def decode(self, data: bytes) -> int:
        """Return the value of bytes from the bus; SdoAbort for a wrong length."""
        size = self.bits // 8
        if len(data) != size:
            raise SdoAbort(TOO_LONG if len(data) > size else TOO_SHORT)
        (value,) = struct.unpack("<" + self.value, data)
        return int(value)


class Access(Enum):
    """Access to an entry by SDO, and the kind of PDO that it may be mapped into."""

    RO = "read"
    RW = "read and write"
    TPDO = "read, or a transmit PDO"
    RPDO = "read and write, or a receive PDO"


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry of the dictionary."""

    index: int
    subindex: int
    kind: Kind  #: data type
    access: Access = Access.RO
    default: int = 0  #: at power-on, if the node does not compute it
    lowest: int | None = None  #: lowest accepted value, None for the type's own
    highest: int | None = None  #: highest accepted value, None for the type's own
    text: str = ""  #: value of an entry of kind TEXT

    @property
    def writable(self) -> bool:
        """Whether it can be written by SDO."""
        return self.access in (Access.RW, Access.RPDO)

    def accepts(self, value: int) -> bool:
        """Return whether a value is in its range."""
        if self.lowest is not None and value < self.lowest:
            return False
        return self.highest is None or value <= self.highest

    def decode(self, data: bytes) -> int:
        """Return the value of bytes from the bus.

        Raises:
            SdoAbort: wrong length, or outside the range of values.
        """
        value = self.kind.decode(data)
        if not self.accepts(value):
            raise SdoAbort(INVALID_VALUE)
        return value


Dictionary = dict[tuple[int, int], Entry]

SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")


def _cia402(axis: AxisSpec) -> tuple[Entry, ...]:
    """Objects of CiA 301 and CiA 402, and two of the manufacturer."""
    counts = axis.counts_per_revolution
    peak_per_mille = round(1000 * axis.peak_current_a / axis.rated_current_a)
    gain_as_float = struct.pack("<f", axis.entered_gain_nm_per_a)
    i8, u8, i16, u16, i32, u32, text = Kind
    ro, rw, tpdo, rpdo = Access
    return (
        Entry(0x1000, 0, u32, ro, 0x00020192),  # servo drive (2) of profile 402
        Entry(0x1001, 0, u8, tpdo),
        Entry(0x1003, 0, u8, rw, highest=0),  # writing zero clears the history
        Entry(0x1003, 1, u32),
        Entry(0x1005, 0, u32, ro, 0x80),
        Entry(0x1008, 0, text, text="drivegain simulated CiA 402 amplifier"),
        Entry(0x1009, 0, text, text="1.0"),
        Entry(0x100A, 0, text, text="1.0"),
        Entry(0x1010, 0, u8, ro, 1),
        Entry(0x1010, 1, u32, rw, 1),
        Entry(0x1011, 0, u8, ro, 1),
        Entry(0x1011, 1, u32, rw, 1),
        Entry(0x1014, 0, u32, ro, 0x80 + axis.node_id),
        Entry(0x1016, 0, u8, ro, 1),
        Entry(0x1016, 1, u32, rw),  # monitored node id << 16 | ms
        Entry(0x1017, 0, u16, rw, 100),
        Entry(0x1018, 0, u8, ro, 4),
        Entry(0x1018, 1, u32, ro, axis.vendor_id),
        Entry(0x1018, 2, u32, ro, axis.product_code),
        Entry(0x1018, 3, u32, ro, axis.revision),
        Entry(0x1018, 4, u32, ro, axis.serial),
        Entry(0x1019, 0, u8),
        # Manufacturer specific: the entered joint drive gain, for masters only.
        Entry(0x2003, 0, u8, ro, 2),
        Entry(0x2003, 1, i32, rw, round(1000 * axis.entered_gain_nm_per_a)),
        Entry(0x2003, 2, u32, rw, int.from_bytes(gain_as_float, "little")),
        Entry(0x2005, 0, i16),  # manufacturer specific: temperature of the motor [0.1 °C]
        Entry(0x6007, 0, i16, rw, 1, lowest=0, highest=3),
        Entry(0x603F, 0, u16, tpdo),
        Entry(0x6040, 0, u16, rpdo),
        Entry(0x6041, 0, u16, tpdo),
        Entry(0x605A, 0, i16, rw, 2, lowest=0, highest=6),
        Entry(0x6060, 0, i8, rpdo, lowest=0, highest=1),
        Entry(0x6061, 0, i8, tpdo),
        Entry(0x6062, 0, i32, tpdo),
        Entry(0x6063, 0, i32, tpdo),
        Entry(0x6064, 0, i32, tpdo),
        Entry(0x6065, 0, u32, rw, counts // 2),
        Entry(0x6066, 0, u16, rw, 10),
        Entry(0x6067, 0, u32, rw, counts // 100),
        Entry(0x6068, 0, u16, rw, 10),
        Entry(0x606C, 0, i32, tpdo),
        Entry(0x6073, 0, u16, rpdo, peak_per_mille, highest=peak_per_mille),
        Entry(0x6074, 0, i16, tpdo),
        Entry(0x6075, 0, u32, ro, round(1000 * axis.rated_current_a)),
        # Zero unless the motor's rated torque was entered: the cell must not reveal its true torque
        # constant.
        Entry(0x6076, 0, u32, rw, round(1000 * axis.entered_torque_nm)),
        Entry(0x6077, 0, i16, tpdo),
        Entry(0x6078, 0, i16, tpdo),
        Entry(0x607A, 0, i32, rpdo),
        Entry(0x6081, 0, u32, rpdo, 10 * counts, lowest=1),
        Entry(0x6083, 0, u32, rpdo, 50 * counts, lowest=1),
        Entry(0x6084, 0, u32, rpdo, 50 * counts, lowest=1),
        Entry(0x6085, 0, u32, rpdo, 100 * counts, lowest=1),
        Entry(0x608F, 0, u8, ro, 2),
        Entry(0x608F, 1, u32, ro, counts),
        Entry(0x608F, 2, u32, ro, 1),
        Entry(0x60F4, 0, i32, tpdo),
        Entry(0x6502, 0, u32, ro, 1),  # profile position alone
    )


def find(dictionary: Dictionary, index: int, subindex: int) -> Entry:
    """Return an entry.

    Raises:
        SdoAbort: it does not exist.
    """
    entry = dictionary.get((index, subindex))
    if entry is not None:
        return entry
    if any(known == index for known, _ in dictionary):
        raise SdoAbort(NO_SUBINDEX)
    raise SdoAbort(NO_OBJECT)


_HEAD = struct.Struct("<BHB")

TOGGLE_NOT_ALTERNATED = 0x05030000
UNKNOWN_COMMAND = 0x05040001


class SdoServer:
    """SDO server of one node: expedited and segmented transfers (CiA 301 §7.2.4.3)."""

    def __init__(
        self, read: Callable[[int, int], bytes], write: Callable[[int, int, bytes], None]
    ) -> None:
        self._read = read
        self._write = write
        self._entry = (0, 0)
        self._upload: bytes | None = None
        self._download: bytearray | None = None
        self._toggle = 0

    def answer(self, request: bytes) -> bytes | None:
        """Return the response to a request of 8 bytes; None to an abort of the client."""
        if len(request) < 8:
            return None
        command = request[0] >> 5
        if command in (1, 2):
            _, index, subindex = _HEAD.unpack_from(request)
            self._entry = (index, subindex)
        if command in (1, 2, 4):  # a new transfer or an abort of the client ends the present one
            self._upload = self._download = None
        if command == 4:
            return None
        serve = {
            0: self._continue_download,
            1: self._start_download,
            2: self._start_upload,
            3: self._continue_upload,
        }
        try:
            return serve.get(command, self._refuse)(request)
        except SdoAbort as abort:
            self._upload = self._download = None
            return self._response(0x80, abort.code.to_bytes(4, "little"))

    def _response(self, command: int, data: bytes) -> bytes:
        """Command byte, index and subindex of the transfer, and four bytes of data."""
        return _HEAD.pack(command, *self._entry) + data.ljust(4, b"\0")

    def _start_upload(self, _: bytes) -> bytes:
        data = self._read(*self._entry)
        size = len(data)
        if size <= 4:
            unused = 4 - size
            return self._response(0x43 | unused << 2, data)
        self._upload = data
        self._toggle = 0
        return self._response(0x41, size.to_bytes(4, "little"))

    def _continue_upload(self, request: bytes) -> bytes:
        if self._upload is None:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._check_toggle(request)
        part = self._upload[:7]
        rest = self._upload[7:]
        unused = 7 - len(part)
        is_last = not rest
        head = self._toggle | unused << 1 | is_last
        answer = bytes([head]) + part.ljust(7, b"\0")
        self._toggle ^= 0x10
        self._upload = rest or None
        return answer

    def _start_download(self, request: bytes) -> bytes:
        if request[0] & 0x02:
            size = 4
            if request[0] & 0x01:
                size = 4 - (request[0] >> 2 & 3)
            self._write(*self._entry, request[4 : 4 + size])
        else:
            self._download = bytearray()
            self._toggle = 0
        return self._response(0x60, b"")

    def _continue_download(self, request: bytes) -> bytes:
        if self._download is None:
            raise SdoAbort(UNKNOWN_COMMAND)
        self._check_toggle(request)
        unused = request[0] >> 1 & 7
        self._download += request[1 : 8 - unused]
        answer = bytes([0x20 | self._toggle]) + bytes(7)
        self._toggle ^= 0x10
        if request[0] & 0x01:
            data = bytes(self._download)
            self._download = None
            self._write(*self._entry, data)
        return answer

    def _refuse(self, _: bytes) -> bytes:
        raise SdoAbort(UNKNOWN_COMMAND)

    def _check_toggle(self, request: bytes) -> None:
        if request[0] & 0x10 != self._toggle:
            raise SdoAbort(TOGGLE_NOT_ALTERNATED)


class CurrentObject(NamedTuple):
    """Object that reports a current in units of `step_a`, rounded and limited to its data type."""

    key: tuple[int, int]
    kind: Kind
    step_a: float
    is_reference: bool  #: the current reference with its noise, not the current of the motor

    def source(self, amplifiers: AmplifierSet, index: int) -> Callable[[], int]:
        """Return a function that reads the value of one amplifier."""
        highest = 2 ** (self.kind.bits - 1) - 1
        signal_a = amplifiers.actual_a
        if self.is_reference:
            signal_a = amplifiers.reported_a
        lowest = -highest - 1

        def read() -> int:
            value = round(float(signal_a[index]) / self.step_a)
            limited: int = max(lowest, min(highest, value))
            return limited

        return read


class Vendor(NamedTuple):
    """Differences of a vendor's amplifiers from the CiA 402 dictionary."""

    absent: frozenset[int] = frozenset()  #: objects that they lack
    #: in addition to, or in place of, 6074h, 6077h and 6078h
    currents: tuple[CurrentObject, ...] = ()
    others: tuple[Entry, ...] = ()  #: further objects


def vendor(axis: AxisSpec) -> Vendor:
    """Return the differences of an axis' amplifier."""
    by_dialect = {
        Dialect.CIA402: Vendor(),
        Dialect.EPOS4: Vendor(
            frozenset({0x6073, 0x6074, 0x6075, 0x6078}),
            (
                CurrentObject((0x30D0, 0), Kind.I32, 1e-3, is_reference=True),  # mA
                CurrentObject((0x30D1, 1), Kind.I32, 1e-3, is_reference=False),
                CurrentObject((0x30D1, 2), Kind.I32, 1e-3, is_reference=False),
            ),
            (Entry(0x3001, 1, Kind.U32, Access.RW, round(1000 * axis.rated_current_a)),),
        ),
        Dialect.COPLEY: Vendor(
            frozenset({0x6073, 0x6074, 0x6075, 0x6076, 0x6077, 0x6078}),
            (
                CurrentObject((0x221D, 0), Kind.I16, 0.01, is_reference=True),  # 10 mA
                CurrentObject((0x221C, 0), Kind.I16, 0.01, is_reference=False),
            ),
            (Entry(0x2240, 0, Kind.I32, Access.TPDO),),  # the motor's encoder
        ),
        Dialect.IPOS: Vendor(
            frozenset({0x6073, 0x6074, 0x6075, 0x6076, 0x6078}),
            # 65520 internal units are twice the peak current.
            (
                CurrentObject(
                    (0x6077, 0), Kind.I16, 2.0 * axis.peak_current_a / 65520.0, is_reference=False
                ),
            ),
        ),
        Dialect.AX2000: Vendor(
            frozenset({0x6073, 0x6075, 0x6076, 0x6078}),
            # 3280 digits are the peak current.
            (
                CurrentObject(
                    (0x6074, 0), Kind.I16, axis.peak_current_a / 3280.0, is_reference=True
                ),
            ),
            (Entry(0x3529, 1, Kind.I32, default=round(1000 * axis.peak_current_a)),),
        ),
    }
    return by_dialect[axis.dialect]


def amplifier_dictionary(axis: AxisSpec) -> Dictionary:
    """Return all entries of an amplifier but the PDO parameters (1400h-1BFFh) of pdo.py."""
    make = vendor(axis)
    entries = [entry for entry in _cia402(axis) if entry.index not in make.absent]
    for current in make.currents:
        entries.append(Entry(*current.key, current.kind, Access.TPDO))
    entries += make.others
    return {(entry.index, entry.subindex): entry for entry in entries}
