"""PDOs of a simulated node: parameters, the rules for changing them, and transmission (CiA 301 §7.5.2)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

from drivers.simulation.objects import (
    INVALID_VALUE,
    NO_SUBINDEX,
    READ_ONLY,
    TOO_LONG,
    TOO_SHORT,
    Dictionary,
    Kind,
    Mappable,
)
from drivers.simulation.spec import SdoAbort

UNSUPPORTED_ACCESS = 0x06010000
NO_SUCH_OBJECT = 0x06020000
NOT_MAPPABLE = 0x06040041
PDO_TOO_LONG = 0x06040042

INVALID = 1 << 31  #: Bit of the COB-ID: the PDO does not exist

NO_RTR = 1 << 30

MAX_ENTRIES = 8

EVENT_DRIVEN = 254  #: First transmission type that is sent on a change, not on SYNC


class Direction(Enum):
    """Direction, seen from the node."""

    RECEIVE = Mappable.RECEIVE
    TRANSMIT = Mappable.TRANSMIT


@dataclass(frozen=True, slots=True)
class PdoParameters:
    """Communication and mapping parameters."""

    cob_id: int  #: with bit 31 (invalid) and bit 30 (no RTR)
    transmission: int  #: type; 1 to 240 on that many SYNCs, 0 on the SYNC after a change, 254 and 255 on a change
    inhibit_100us: int  #: least time between two event-driven frames
    event_timer_ms: int  #: longest time between two event-driven frames, 0 for none
    entries: tuple[int, ...]  #: mapping entries (index, subindex, bits), MAX_ENTRIES long
    count: int  #: how many of them are mapped


class Pdo:
    """One PDO; its parameters can be changed only in the order that CiA 301 allows.

    Attributes:
        parameters: last values written.
        layout: struct of the mapped values.
        mapped: (index, subindex) of each mapped value.
        locked: the mapping cannot be written.
    """

    def __init__(self, direction: Direction, parameters: PdoParameters, dictionary: Dictionary) -> None:
        self._direction = direction
        self._dictionary = dictionary
        self.parameters = parameters
        self.layout = struct.Struct("<")
        self.mapped: tuple[tuple[int, int], ...] = ()
        self.locked = False
        self.restore(parameters)

    @property
    def valid(self) -> bool:
        """Whether the PDO exists."""
        return not self.parameters.cob_id & INVALID

    @property
    def can_id(self) -> int:
        """CAN identifier."""
        return self.parameters.cob_id & 0x7FF

    def restore(self, parameters: PdoParameters) -> None:
        """Replace all parameters by defaults or saved ones."""
        self.parameters = parameters
        entries = parameters.entries[: parameters.count]
        self.mapped = tuple((entry >> 16, entry >> 8 & 0xFF) for entry in entries)
        self.layout = struct.Struct("<" + "".join(self._dictionary[key].kind.value for key in self.mapped))

    def read_communication(self, subindex: int) -> bytes:
        """Return an entry of 1400h or 1800h."""
        values: dict[int, tuple[str, int]] = {
            0: ("<B", 5 if self._direction is Direction.TRANSMIT else 2),
            1: ("<I", self.parameters.cob_id),
            2: ("<B", self.parameters.transmission),
        }
        if self._direction is Direction.TRANSMIT:
            values |= {3: ("<H", self.parameters.inhibit_100us), 5: ("<H", self.parameters.event_timer_ms)}
        if subindex not in values:
            raise SdoAbort(NO_SUBINDEX)
        return struct.pack(*values[subindex])

    def read_mapping(self, subindex: int) -> bytes:
        """Return an entry of 1600h or 1A00h."""
        if subindex == 0:
            return bytes([self.parameters.count])
        if subindex > MAX_ENTRIES:
            raise SdoAbort(NO_SUBINDEX)
        return struct.pack("<I", self.parameters.entries[subindex - 1])

    def write_communication(self, subindex: int, data: bytes) -> None:
        """Write an entry of 1400h or 1800h."""
        old = self.parameters
        if subindex == 0:
            raise SdoAbort(READ_ONLY)
        if subindex == 1:
            cob_id = _unsigned(data, Kind.U32)
            if cob_id & (1 << 29) or not 0x180 < (cob_id & 0x7FF) < 0x580 or cob_id >> 11 & 0x3FFFF:
                raise SdoAbort(INVALID_VALUE)  # base frames alone, and no identifier that CiA 301 restricts
            if self.valid and not cob_id & INVALID and (cob_id ^ old.cob_id) & 0x7FF:
                raise SdoAbort(INVALID_VALUE)  # the identifier shall not change while the PDO exists
            self.parameters = replace(old, cob_id=cob_id)
        elif subindex == 2:
            transmission = _unsigned(data, Kind.U8)
            if 241 <= transmission <= 253:
                raise SdoAbort(INVALID_VALUE)  # reserved, or on remote request, which these nodes do not serve
            self.parameters = replace(old, transmission=transmission)
        elif subindex == 3 and self._direction is Direction.TRANSMIT:
            if self.valid:
                raise SdoAbort(UNSUPPORTED_ACCESS)  # the inhibit time shall not change while the PDO exists
            self.parameters = replace(old, inhibit_100us=_unsigned(data, Kind.U16))
        elif subindex == 5 and self._direction is Direction.TRANSMIT:
            self.parameters = replace(old, event_timer_ms=_unsigned(data, Kind.U16))
        else:
            raise SdoAbort(NO_SUBINDEX)

    def write_mapping(self, subindex: int, data: bytes) -> None:
        """Write an entry of 1600h or 1A00h; the order is COB-ID invalid, count 0, entries, count, COB-ID valid."""
        if self.locked:
            raise SdoAbort(READ_ONLY)
        if self.valid:
            raise SdoAbort(UNSUPPORTED_ACCESS)
        if subindex == 0:
            count = _unsigned(data, Kind.U8)
            if count > MAX_ENTRIES:
                raise SdoAbort(INVALID_VALUE)
            used = self.parameters.entries[:count]
            for entry in used:
                self._check(entry)
            if sum(entry & 0xFF for entry in used) > 64:
                raise SdoAbort(PDO_TOO_LONG)
            self.restore(replace(self.parameters, count=count))
            return
        if subindex > MAX_ENTRIES:
            raise SdoAbort(NO_SUBINDEX)
        if self.parameters.count:
            raise SdoAbort(UNSUPPORTED_ACCESS)
        entry = _unsigned(data, Kind.U32)
        if entry:
            self._check(entry)
        entries = list(self.parameters.entries)
        entries[subindex - 1] = entry
        self.parameters = replace(self.parameters, entries=tuple(entries))

    def _check(self, mapping: int) -> None:
        entry = self._dictionary.get((mapping >> 16, mapping >> 8 & 0xFF))
        if entry is None:
            raise SdoAbort(NO_SUCH_OBJECT)
        if entry.mappable is not self._direction.value or entry.kind.bits != mapping & 0xFF:
            raise SdoAbort(NOT_MAPPABLE)


class TransmitTrigger:
    """Decides when a transmit PDO is sent."""

    def __init__(self, pdo: Pdo, sources: Callable[[tuple[int, int]], Callable[[], int]]) -> None:
        self.pdo = pdo
        self._sources = sources
        self._compiled: tuple[tuple[int, int], ...] = ()
        self._getters: tuple[Callable[[], int], ...] = ()
        self._syncs = 0
        self._last = b""
        self._last_us: int | None = None

    def reset(self) -> None:
        """Forget the last data sent (the node enters OPERATIONAL, or the PDO was changed)."""
        self._syncs, self._last, self._last_us = 0, b"", None

    def on_sync(self, now_us: int) -> bytes | None:
        """Return the data to send on this SYNC, or None."""
        kind = self.pdo.parameters.transmission
        if kind >= EVENT_DRIVEN:
            return self.on_event(now_us)
        data = self._data()
        if kind == 0:
            if data == self._last:
                return None
        else:
            self._syncs += 1
            if self._syncs < kind:
                return None
            self._syncs = 0
        self._last = data
        return data

    def on_event(self, now_us: int) -> bytes | None:
        """Return the data of an event-driven PDO to send after a possible change, or None."""
        parameters = self.pdo.parameters
        if parameters.transmission < EVENT_DRIVEN:
            return None
        data = self._data()
        since_us = None if self._last_us is None else now_us - self._last_us
        timer = parameters.event_timer_ms and since_us is not None and since_us >= 1000 * parameters.event_timer_ms
        if data == self._last and not timer:
            return None
        if since_us is not None and since_us < 100 * parameters.inhibit_100us:
            return None
        self._last, self._last_us = data, now_us
        return data

    def _data(self) -> bytes:
        if self.pdo.mapped is not self._compiled:
            self._compiled = self.pdo.mapped
            self._getters = tuple(self._sources(key) for key in self._compiled)
        return self.pdo.layout.pack(*[get() for get in self._getters])


def default_pdos(node_id: int, dictionary: Dictionary) -> tuple[tuple[Pdo, ...], tuple[Pdo, ...]]:
    """Return receive and transmit PDOs with the default mapping of CiA 402-2; only the first of each is valid."""
    receive = ((0x60400010,), (0x60400010, 0x60600008), (0x60400010, 0x607A0020), (0x60400010,))
    transmit = ((0x60410010,), (0x60410010, 0x60610008), (0x60410010, 0x60640020), (0x60410010, 0x606C0020))
    return (
        tuple(_default(Direction.RECEIVE, k, 0x200 + node_id, m, dictionary) for k, m in enumerate(receive)),
        tuple(_default(Direction.TRANSMIT, k, 0x180 + node_id, m, dictionary) for k, m in enumerate(transmit)),
    )


def _default(direction: Direction, number: int, first_id: int, mapping: tuple[int, ...], dictionary: Dictionary) -> Pdo:
    cob_id = first_id + 0x100 * number | (NO_RTR if direction is Direction.TRANSMIT else 0) | (INVALID if number else 0)
    entries = mapping + (0,) * (MAX_ENTRIES - len(mapping))
    return Pdo(direction, PdoParameters(cob_id, 255, 0, 0, entries, len(mapping)), dictionary)


def _unsigned(data: bytes, kind: Kind) -> int:
    size = kind.bits // 8
    if len(data) != size:
        raise SdoAbort(TOO_LONG if len(data) > size else TOO_SHORT)
    return int.from_bytes(data, "little")
