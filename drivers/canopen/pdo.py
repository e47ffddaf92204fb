"""PDO mapping: pack objects into frames, write the mapping in the order that drives accept, and restore it.

Source: CiA 301, objects 1400h–1BFFh: communication parameters (COB-ID with bit 31 = not valid, transmission type) and
mapping parameters (count, then index << 16 | subindex << 8 | bits).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from drivers.errors import ObjectAccessError, SetupRefused
from drivers.profiles.profile import Axis, ObjectEntry

if TYPE_CHECKING:  # the load of a bus is computed without opening one
    from drivers.canopen.sdo import ObjectAccess

HEARTBEAT_MS = 100  #: Period of the heartbeats of every node, and of the recorder
PDO_BYTES = 8
PDOS = 4  #: PDOs of the predefined connection set, in each direction
NOT_VALID = 1 << 31
_COB_ID_BITS = NOT_VALID | 0x1FFF_FFFF  # bit 30 (RTR) is set by some drives on their own
SYNCHRONOUS = 1  #: Transmission type: sent, or acted upon, at every SYNC

STATUSWORD = ObjectEntry(0x6041, 0, 16, signed=False)
CONTROLWORD = ObjectEntry(0x6040, 0, 16, signed=False)
TARGET_POSITION = ObjectEntry(0x607A, 0, 32, signed=True)
PROFILE_VELOCITY = ObjectEntry(0x6081, 0, 32, signed=False)
PROFILE_ACCELERATION = ObjectEntry(0x6083, 0, 32, signed=False)
PROFILE_DECELERATION = ObjectEntry(0x6084, 0, 32, signed=False)

_CODES = {(8, True): "b", (8, False): "B", (16, True): "h", (16, False): "H", (32, True): "i", (32, False): "I"}


class Direction(Enum):
    """Direction seen from the drive; the value is (communication index, mapping index, first COB-ID)."""

    TPDO = (0x1800, 0x1A00, 0x180)
    RPDO = (0x1400, 0x1600, 0x200)


@dataclass(frozen=True, slots=True)
class PdoRecord:
    """Communication and mapping parameters of one PDO in a drive."""

    direction: Direction  #: receive or transmit
    number: int  #: number of the PDO, from 0
    cob_id: int  #: sub 1 with its flag bits
    transmission: int  #: type, sub 2
    entries: tuple[int, ...]  #: mapped objects, each as the 32-bit word of the mapping parameter

    def __str__(self) -> str:
        mapped = " ".join(f"{entry:08X}" for entry in self.entries) or "nothing"
        return f"{self.name}: COB-ID {self.cob_id:08X}h, type {self.transmission}, {mapped}"

    @property
    def name(self) -> str:
        """Name as in the drives' manuals: TPDO1."""
        return f"{self.direction.name}{self.number + 1}"


def word(entry: ObjectEntry) -> int:
    """Return the mapping parameter of an object."""
    return entry.index << 16 | entry.subindex << 8 | entry.bits


def pack(entries: Sequence[ObjectEntry]) -> tuple[tuple[ObjectEntry, ...], ...]:
    """Distribute objects over PDOs of at most eight bytes, each into the first that has room.

    Raises:
        ValueError: an object is no integer of 8, 16 or 32 bits, or more than four PDOs are needed.
    """
    pdos: list[list[ObjectEntry]] = []
    for entry in entries:
        if (entry.bits, entry.signed) not in _CODES:
            raise ValueError(f"object {entry} has {entry.bits} bits; only 8, 16 and 32 can be decoded")
        for pdo in pdos:
            if sum(other.bits for other in pdo) + entry.bits <= 8 * PDO_BYTES:
                pdo.append(entry)
                break
        else:
            pdos.append([entry])
    if len(pdos) > PDOS:
        raise ValueError(f"{len(entries)} objects need {len(pdos)} PDOs, a drive has {PDOS}")
    return tuple(tuple(pdo) for pdo in pdos)


def layout(entries: Sequence[ObjectEntry]) -> struct.Struct:
    """Return the payload of a PDO: little endian, at constant offsets."""
    return struct.Struct("<" + "".join(_CODES[entry.bits, entry.signed] for entry in entries))


def records(direction: Direction, node_id: int, pdos: Sequence[Sequence[ObjectEntry]]) -> tuple[PdoRecord, ...]:
    """Return synchronous PDOs with the predefined COB-IDs of a node."""
    return tuple(
        PdoRecord(direction, number, direction.value[2] + 0x100 * number + node_id, SYNCHRONOUS, tuple(map(word, pdo)))
        for number, pdo in enumerate(pdos)
    )


def feedback_entries(axis: Axis) -> tuple[ObjectEntry, ...]:
    """Return the objects of a Sample: position, current, statusword, in this order."""
    return (axis.profile.position, axis.profile.current, STATUSWORD)


SETPOINT_PDOS = (
    (CONTROLWORD, TARGET_POSITION),
    (PROFILE_VELOCITY, PROFILE_ACCELERATION),
    (PROFILE_DECELERATION,),
)
"""Set-points of an axis. Only the first PDO is sent in the cycle in which all axes start."""


def _parameters(direction: Direction, number: int) -> tuple[ObjectEntry, ObjectEntry, ObjectEntry]:
    communication, mapping, _ = direction.value
    return (
        ObjectEntry(communication + number, 1, 32, signed=False),
        ObjectEntry(communication + number, 2, 8, signed=False),
        ObjectEntry(mapping + number, 0, 8, signed=False),
    )


def _entry(count: ObjectEntry, subindex: int) -> ObjectEntry:
    return ObjectEntry(count.index, subindex, 32, signed=False)


def read_record(access: ObjectAccess, direction: Direction, number: int) -> PdoRecord | None:
    """Read one PDO of a drive; None when the drive has no such PDO."""
    cob_id, transmission, count = _parameters(direction, number)
    identifier = access.read_optional(cob_id)
    if identifier is None:
        return None
    mapped = access.read(count)
    entries = tuple(access.read(_entry(count, sub)) for sub in range(1, mapped + 1))
    return PdoRecord(direction, number, identifier, access.read(transmission), entries)


def write_record(access: ObjectAccess, record: PdoRecord) -> None:
    """Write what differs of one PDO, read it back and compare.

    Drives accept only this order: COB-ID not valid, count 0, entries, transmission type, count, COB-ID valid.

    Raises:
        SetupRefused: a step was aborted, or the PDO reads back differently.
    """
    cob_id, transmission, count = _parameters(record.direction, record.number)
    before = read_record(access, record.direction, record.number)
    if before == record:
        return
    off = (record.cob_id if before is None else before.cob_id) | NOT_VALID
    steps = [(cob_id, off)]
    if before is None or (before.entries, before.transmission) != (record.entries, record.transmission):
        steps += [(count, 0), *((_entry(count, sub), word) for sub, word in enumerate(record.entries, start=1))]
        steps += [(transmission, record.transmission), (count, len(record.entries))]
    if record.cob_id != off:
        steps.append((cob_id, record.cob_id))
    for entry, value in steps:
        try:
            access.write(entry, value)
        except ObjectAccessError as error:
            raise SetupRefused(access, f"{record.name}: writing {value:#x} to {entry}: {error.reason}") from error
    found = read_record(access, record.direction, record.number)
    if (
        found is None
        or (found.entries, found.transmission) != (record.entries, record.transmission)
        or (found.cob_id ^ record.cob_id) & _COB_ID_BITS
    ):
        raise SetupRefused(access, f"{record.name}: reads back as '{found}', written was '{record}'")
