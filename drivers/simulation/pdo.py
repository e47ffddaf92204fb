"""PDOs of a simulated node: parameters, the rules for changing them,
and transmission (CiA 301 §7.5.2).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from drivers.simulation.objects import (
    INVALID_VALUE,
    NO_OBJECT,
    NO_SUBINDEX,
    READ_ONLY,
    Access,
    Dictionary,
    Kind,
)
from drivers.simulation.spec import SdoAbort

UNSUPPORTED_ACCESS = 0x06010000
NOT_MAPPABLE = 0x06040041
PDO_TOO_LONG = 0x06040042

INVALID = 1 << 31  #: Bit of the COB-ID: the PDO does not exist

NO_RTR = 1 << 30

MAX_ENTRIES = 8

EVENT_DRIVEN = 254  #: First transmission type that is sent on a change, not on SYNC


Finder = Callable[[tuple[int, int]], Callable[[], int]]  #: Finds the reader of a mapped value


@dataclass(frozen=True, slots=True)
class PdoParameters:
    """Communication and mapping parameters."""

    cob_id: int  #: with bit 31 (invalid) and bit 30 (no RTR)
    #: type; 1 to 240 on that many SYNCs, 0 on the SYNC after a change, 254 and 255 on a change
    transmission: int
    inhibit_100us: int  #: least time between two event-driven frames
    event_timer_ms: int  #: longest time between two event-driven frames, 0 for none
    entries: tuple[int, ...]  #: mapping entries (index, subindex, bits), MAX_ENTRIES long
    count: int  #: how many of them are mapped


class Pdo:
    """One PDO; its parameters can be changed only in the order that CiA 301 allows,
    and decide when it is sent.

    Attributes:
        valid: the PDO exists.
        can_id: CAN identifier.
        layout: struct of the mapped values.
        mapped: (index, subindex) of each mapped value.
        locked: the mapping cannot be written.
    """

    def __init__(
        self, direction: Access, parameters: PdoParameters, dictionary: Dictionary, source: Finder
    ) -> None:
        self._direction = direction
        self._dictionary = dictionary
        self._source = source
        self.parameters = parameters
        self.layout = struct.Struct("<")
        self.mapped: tuple[tuple[int, int], ...] = ()
        self.locked = False
        self._getters: tuple[Callable[[], int], ...] = ()
        self.restore(parameters)

    @property
    def parameters(self) -> PdoParameters:
        """Last values written."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: PdoParameters) -> None:
        self._parameters = parameters
        self.valid = not parameters.cob_id & INVALID
        self.can_id = parameters.cob_id & 0x7FF

    def restore(self, parameters: PdoParameters) -> None:
        """Replace all parameters by defaults or saved ones."""
        self.reset()
        self._map(parameters)

    def reset(self) -> None:
        """Forget the last data sent (the node enters OPERATIONAL, or the PDO was changed)."""
        self._syncs = 0
        self._last = b""
        self._last_us: int | None = None

    def _map(self, parameters: PdoParameters) -> None:
        self.parameters = parameters
        entries = parameters.entries[: parameters.count]
        self.mapped = tuple((entry >> 16, entry >> 8 & 0xFF) for entry in entries)
        kinds = [self._dictionary[key].kind.value for key in self.mapped]
        self.layout = struct.Struct("<" + "".join(kinds))
        self._getters = tuple(self._source(key) for key in self.mapped)

    def on_sync(self, now_us: int) -> bytes | None:
        """Return the data to send on this SYNC, or None."""
        kind = self._parameters.transmission
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
        parameters = self._parameters
        if parameters.transmission < EVENT_DRIVEN:
            return None
        data = self._data()
        since_us = None
        if self._last_us is not None:
            since_us = now_us - self._last_us
        timer = (
            parameters.event_timer_ms
            and since_us is not None
            and since_us >= 1000 * parameters.event_timer_ms
        )
        if data == self._last and not timer:
            return None
        if since_us is not None and since_us < 100 * parameters.inhibit_100us:
            return None
        self._last = data
        self._last_us = now_us
        return data

    def _data(self) -> bytes:
        return self.layout.pack(*[get() for get in self._getters])

    @property
    def _fields(self) -> dict[int, tuple[Kind, str]]:
        """Entries of 1400h or 1800h: data type and parameter."""
        fields = {1: (Kind.U32, "cob_id"), 2: (Kind.U8, "transmission")}
        if self._direction is Access.TPDO:
            fields |= {3: (Kind.U16, "inhibit_100us"), 5: (Kind.U16, "event_timer_ms")}
        return fields

    def _field(self, subindex: int) -> tuple[Kind, str]:
        if subindex not in self._fields:
            raise SdoAbort(NO_SUBINDEX)
        return self._fields[subindex]

    def read_communication(self, subindex: int) -> bytes:
        """Return an entry of 1400h or 1800h."""
        if subindex == 0:
            return bytes([max(self._fields)])
        kind, name = self._field(subindex)
        return kind.encode(getattr(self.parameters, name))

    def read_mapping(self, subindex: int) -> bytes:
        """Return an entry of 1600h or 1A00h."""
        if subindex == 0:
            return bytes([self.parameters.count])
        if subindex > MAX_ENTRIES:
            raise SdoAbort(NO_SUBINDEX)
        return Kind.U32.encode(self.parameters.entries[subindex - 1])

    def write_communication(self, subindex: int, data: bytes) -> None:
        """Write an entry of 1400h or 1800h."""
        if subindex == 0:
            raise SdoAbort(READ_ONLY)
        kind, name = self._field(subindex)
        if name == "inhibit_100us" and self.valid:
            # The inhibit time shall not change while the PDO exists
            raise SdoAbort(UNSUPPORTED_ACCESS)
        value = kind.decode(data)
        if name == "cob_id":
            if value & (1 << 29) or not 0x180 < (value & 0x7FF) < 0x580 or value >> 11 & 0x3FFFF:
                # Base frames alone, and no identifier that CiA 301 restricts
                raise SdoAbort(INVALID_VALUE)
            if self.valid and not value & INVALID and (value ^ self.parameters.cob_id) & 0x7FF:
                # The identifier shall not change while the PDO exists
                raise SdoAbort(INVALID_VALUE)
        elif name == "transmission" and 241 <= value <= 253:
            # Reserved, or on remote request, which these nodes do not serve
            raise SdoAbort(INVALID_VALUE)
        change: dict[str, Any] = {name: value}
        self.parameters = replace(self.parameters, **change)
        self.reset()

    def write_mapping(self, subindex: int, data: bytes) -> None:
        """Write an entry of 1600h or 1A00h; the order is COB-ID invalid, count 0, entries, count,
        COB-ID valid.
        """
        if self.locked:
            raise SdoAbort(READ_ONLY)
        if self.valid:
            raise SdoAbort(UNSUPPORTED_ACCESS)
        if subindex == 0:
            count = Kind.U8.decode(data)
            if count > MAX_ENTRIES:
                raise SdoAbort(INVALID_VALUE)
            used = self.parameters.entries[:count]
            for entry in used:
                self._check(entry)
            if sum(entry & 0xFF for entry in used) > 64:
                raise SdoAbort(PDO_TOO_LONG)
            self._map(replace(self.parameters, count=count))
            return
        if subindex > MAX_ENTRIES:
            raise SdoAbort(NO_SUBINDEX)
        if self.parameters.count:
            raise SdoAbort(UNSUPPORTED_ACCESS)
        entry = Kind.U32.decode(data)
        if entry:
            self._check(entry)
        entries = list(self.parameters.entries)
        entries[subindex - 1] = entry
        self.parameters = replace(self.parameters, entries=tuple(entries))

    def _check(self, mapping: int) -> None:
        entry = self._dictionary.get((mapping >> 16, mapping >> 8 & 0xFF))
        if entry is None:
            raise SdoAbort(NO_OBJECT)
        if entry.access is not self._direction or entry.kind.bits != mapping & 0xFF:
            raise SdoAbort(NOT_MAPPABLE)


def default_pdos(
    node_id: int, dictionary: Dictionary, source: Finder
) -> tuple[tuple[Pdo, ...], tuple[Pdo, ...]]:
    """Return receive and transmit PDOs with the default mapping of CiA 402-2;
    only the first of each is valid.
    """

    def made(
        direction: Access, first_cob_id: int, mappings: tuple[tuple[int, ...], ...]
    ) -> tuple[Pdo, ...]:
        pdos = []
        for number, mapping in enumerate(mappings):
            cob_id = first_cob_id + 0x100 * number + node_id
            if number:
                cob_id |= INVALID
            entries = mapping + (0,) * (MAX_ENTRIES - len(mapping))
            parameters = PdoParameters(cob_id, 255, 0, 0, entries, len(mapping))
            pdos.append(Pdo(direction, parameters, dictionary, source))
        return tuple(pdos)

    receive = ((0x60400010,), (0x60400010, 0x60600008), (0x60400010, 0x607A0020), (0x60400010,))
    transmit = (
        (0x60410010,),
        (0x60410010, 0x60610008),
        (0x60410010, 0x60640020),
        (0x60410010, 0x606C0020),
    )
    return made(Access.RPDO, 0x200, receive), made(Access.TPDO, 0x180 | NO_RTR, transmit)
