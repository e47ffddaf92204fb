"""PDO mapping: pack objects into frames, write the mapping in the order that drives accept,
and restore it.

Source: CiA 301, objects 1400h–1BFFh: communication parameters (COB-ID with bit 31 = not valid,
transmission type) and mapping parameters (count, then index << 16 | subindex << 8 | bits).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import chain
from typing import TYPE_CHECKING

from drivers.errors import ObjectAccessError, SetupRefused
from drivers.profiles.profile import Axis, ObjectEntry

if TYPE_CHECKING:  # the load of a bus is computed without opening one
    from drivers.canopen.sdo import ObjectAccess

HEARTBEAT_MS = 100  #: Period of the heartbeats of every node, and of the recorder
PDO_BYTES = 8
MAPPABLE = "a PDO that can be mapped for the recording"
NOT_MAPPABLE = (
    "is it fixed by the maker, or does another tool set the drive up now? end that tool, or switch "
    "the drive off and on"
)
PDOS = 4  #: PDOs of the predefined connection set, in each direction
MOST_ENTRIES = 64  #: Objects that one PDO can carry, a bit each (CiA 301)
NOT_VALID = 1 << 31
READ_ONLY = 0x0601_0002  #: Abort of a write to an object that a drive keeps fixed (CiA 301)
_EXTENDED = 1 << 29  #: COB-ID of 29 bits
_COB_ID_BITS = NOT_VALID | 0x1FFF_FFFF  # bit 30 (RTR) is set by some drives on their own
SYNCHRONOUS = 1  #: Transmission type: sent, or acted upon, at every SYNC

STATUSWORD = ObjectEntry(0x6041, 0, 16)
CONTROLWORD = ObjectEntry(0x6040, 0, 16)
TARGET_POSITION = ObjectEntry(0x607A, 0, 32, signed=True)
PROFILE_VELOCITY = ObjectEntry(0x6081, 0, 32)
PROFILE_ACCELERATION = ObjectEntry(0x6083, 0, 32)
PROFILE_DECELERATION = ObjectEntry(0x6084, 0, 32)

_CODES = {
    (8, True): "b",
    (8, False): "B",
    (16, True): "h",
    (16, False): "H",
    (32, True): "i",
    (32, False): "I",
}


class Direction(Enum):
    """Direction seen from the drive: communication index, mapping index and first COB-ID."""

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


def pack(
    entries: Sequence[ObjectEntry], most_bytes: int = PDO_BYTES
) -> tuple[tuple[ObjectEntry, ...], ...]:
    """Distribute objects over PDOs of at most so many bytes, each into the first that has room.

    Raises:
        ValueError: an object is no integer of 8, 16 or 32 bits, or more than four PDOs are needed.
    """
    pdos: list[list[ObjectEntry]] = []
    for entry in entries:
        if (entry.bits, entry.signed) not in _CODES:
            raise ValueError(
                f"object {entry} has {entry.bits} bits; only 8, 16 and 32 can be decoded"
            )
        for pdo in pdos:
            used_bits = sum(other.bits for other in pdo)
            if used_bits + entry.bits <= 8 * most_bytes:
                pdo.append(entry)
                break
        else:
            pdos.append([entry])
    if len(pdos) > PDOS:
        raise ValueError(f"{len(entries)} objects need {len(pdos)} PDOs, a drive has {PDOS}")
    return tuple(tuple(pdo) for pdo in pdos)


def records(
    direction: Direction,
    node_id: int,
    pdos: Sequence[Sequence[ObjectEntry]],
    numbers: Sequence[int] = range(PDOS),
) -> tuple[PdoRecord, ...]:
    """Return synchronous PDOs with the predefined COB-IDs of a node;
    `numbers` are those of the PDOs that it has.

    Raises:
        ValueError: it has too few.
    """
    if len(pdos) > len(numbers):
        raise ValueError(
            f"found {len(numbers)} {direction.name}s in the drive; expected {len(pdos)}"
        )
    _, _, first_cob_id = direction.value
    found = []
    for number, pdo in zip(numbers, pdos, strict=False):
        cob_id = first_cob_id + 0x100 * number + node_id
        entries = tuple(map(word, pdo))
        found.append(PdoRecord(direction, number, cob_id, SYNCHRONOUS, entries))
    return tuple(found)


def feedback_entries(axis: Axis) -> tuple[ObjectEntry, ...]:
    """Return the objects of a Sample: position, current, statusword, in this order."""
    return (axis.profile.position, axis.profile.current, STATUSWORD)


COMMAND = (TARGET_POSITION, CONTROLWORD)
"""Set-point that starts a move.

The target comes first: a drive may act as soon as it has read the controlword.
"""
MOTION_PROFILE = (PROFILE_VELOCITY, PROFILE_ACCELERATION, PROFILE_DECELERATION)
SETPOINT_PDOS = (*pack(COMMAND), *pack(MOTION_PROFILE))
"""Set-points of an axis.

Only those of the command are sent in the cycle in which all axes start.
"""


@dataclass(frozen=True, slots=True)
class AxisPdos:
    """PDOs of one axis in a recording."""

    feedback: tuple[PdoRecord, ...]  #: TPDOs with the objects of a Sample
    setpoints: tuple[PdoRecord, ...]  #: RPDOs with those of a set-point

    def payloads(self, values: Mapping[ObjectEntry, int]) -> Iterator[tuple[int, bytes]]:
        """Yield COB-ID and payload of each RPDO all of whose objects have a value,
        in the order of their numbers.
        """
        for record in self.setpoints:
            layout, entries = record_payload(record, tuple(values))
            if len(entries) == len(record.entries):
                yield record.cob_id & 0x7FF, layout.pack(*(values[entry] for entry in entries))


def wanted_pdos(
    axis: Axis,
    numbers: Mapping[Direction, Sequence[int]] | None = None,
    absent: Sequence[ObjectEntry] = (),
    most_bytes: int = PDO_BYTES,
) -> AxisPdos:
    """Return the PDOs of an axis as a recording maps them.

    Args:
        axis: with its profile.
        numbers: of the PDOs that the drive has, from 0; None for the four of the predefined
            connection set.
        absent: objects of `MOTION_PROFILE` that the drive does not have.
        most_bytes: in one PDO.

    Raises:
        ValueError: the drive has too few PDOs, or an object is no integer.
    """
    have = dict.fromkeys(Direction, range(PDOS)) if numbers is None else numbers
    profile = [entry for entry in MOTION_PROFILE if entry not in absent]
    setpoints = pack(COMMAND, most_bytes) + pack(profile, most_bytes)
    feedback = pack(feedback_entries(axis), most_bytes)
    return AxisPdos(
        feedback=records(Direction.TPDO, axis.node_id, feedback, have[Direction.TPDO]),
        setpoints=records(Direction.RPDO, axis.node_id, setpoints, have[Direction.RPDO]),
    )


def fixed_feedback(axis: Axis, found: Sequence[PdoRecord]) -> tuple[PdoRecord, ...]:
    """Return those of a drive's own TPDOs that carry every object of a Sample, synchronous;
    empty where they do not.
    """
    return _carrying(set(map(word, feedback_entries(axis))), found)


def fixed_setpoints(
    found: Sequence[PdoRecord], absent: Sequence[ObjectEntry] = ()
) -> tuple[PdoRecord, ...]:
    """Return those of a drive's own RPDOs that carry every object of a set-point and no other,
    synchronous.

    Empty where they do not, or where a controlword comes before its target.
    """
    command = set(map(word, COMMAND))
    profile = {word(entry) for entry in MOTION_PROFILE if entry not in absent}
    used = _carrying(command | profile, found)
    for record in used:
        entries = set(record.entries)
        if not entries <= command and not entries <= profile:
            return ()
    order = [mapped for mapped in _all_mapped(used) if mapped in command]
    if order != list(map(word, COMMAND)):
        return ()
    return used


def _all_mapped(pdos: Sequence[PdoRecord]) -> tuple[int, ...]:
    return tuple(chain.from_iterable(record.entries for record in pdos))


def _carrying(needed: set[int], found: Sequence[PdoRecord]) -> tuple[PdoRecord, ...]:
    used = []
    for record in found:
        is_usable = not record.cob_id & (NOT_VALID | _EXTENDED)
        if is_usable and needed & set(record.entries):
            used.append(record)
    every = _all_mapped(used)
    has_whole_bytes = all((mapped & 0xFF) % 8 == 0 for mapped in every)
    carried = [mapped for mapped in every if mapped in needed]
    if sorted(carried) != sorted(needed) or not has_whole_bytes:
        return ()
    return tuple(replace(record, transmission=SYNCHRONOUS) for record in used)


def record_payload(
    record: PdoRecord, entries: Sequence[ObjectEntry]
) -> tuple[struct.Struct, tuple[ObjectEntry, ...]]:
    """Return the layout of a TPDO, and those of the given objects that it carries, in its order;
    it skips others.
    """
    known = {word(entry): entry for entry in entries}
    codes = "<"
    carried = []
    for mapped in record.entries:
        entry = known.get(mapped)
        if entry is None:
            skipped_bytes = (mapped & 0xFF) // 8
            codes += f"{skipped_bytes}x"
        else:
            codes += _CODES[entry.bits, entry.signed]
            carried.append(entry)
    return struct.Struct(codes), tuple(carried)


def _parameters(direction: Direction, number: int) -> tuple[ObjectEntry, ObjectEntry, ObjectEntry]:
    communication, mapping, _ = direction.value
    return (
        ObjectEntry(communication + number, 1, 32),
        ObjectEntry(communication + number, 2, 8),
        ObjectEntry(mapping + number, 0, 8),
    )


def _entry(count: ObjectEntry, subindex: int) -> ObjectEntry:
    return ObjectEntry(count.index, subindex, 32)


def read_pdo_record(access: ObjectAccess, direction: Direction, number: int) -> PdoRecord | None:
    """Read one PDO of a drive; None when the drive has no such PDO."""
    cob_id, transmission, count = _parameters(direction, number)
    identifier = access.read_optional(cob_id)
    if identifier is None:
        mapped = None
    else:
        mapped = access.read_optional(count)
    if identifier is None or mapped is None:
        return None
    # 254 and 255 mean a multiplexed PDO, which has no entries (CiA 301).
    subs = range(1, mapped + 1) if mapped <= MOST_ENTRIES else ()
    entries = tuple(access.read(_entry(count, sub)) for sub in subs)
    return PdoRecord(direction, number, identifier, access.read(transmission), entries)


def write_pdo_record(access: ObjectAccess, record: PdoRecord) -> None:
    """Write what differs of one PDO, read it back and compare.

    Drives accept only this order: COB-ID not valid, count 0, entries, transmission type, count,
    COB-ID valid. A drive with a fixed COB-ID gets the rest.

    Raises:
        SetupRefused: a step was aborted, or the PDO reads back differently.
    """
    cob_id, transmission, count = _parameters(record.direction, record.number)
    before = read_pdo_record(access, record.direction, record.number)
    if before == record:
        return
    off = (record.cob_id if before is None else before.cob_id) | NOT_VALID
    as_before = before is not None and not (before.cob_id ^ record.cob_id) & _COB_ID_BITS
    mapped = before is not None and before.entries == record.entries
    fixed = False
    steps = [(cob_id, off)]
    if not mapped:
        steps.append((count, 0))
        for sub, mapped_object in enumerate(record.entries, start=1):
            steps.append((_entry(count, sub), mapped_object))
    if before is None or before.transmission != record.transmission:
        steps.append((transmission, record.transmission))
    if not mapped:
        steps.append((count, len(record.entries)))
    if record.cob_id != off:
        steps.append((cob_id, record.cob_id))
    for entry, value in steps:
        if fixed and entry == cob_id:
            continue
        try:
            access.write(entry, value)
        except ObjectAccessError as error:
            fixed = entry == cob_id and error.abort_code == READ_ONLY and as_before
            if not fixed:
                reason = f"{record.name}: writing {value:#x} to {entry}: {error.reason}"
                if error.abort_code is None:
                    raise SetupRefused(access, reason) from error
                raise SetupRefused(
                    access, reason, expected=MAPPABLE, remedy=NOT_MAPPABLE
                ) from error
    found = read_pdo_record(access, record.direction, record.number)
    if found is None or not _is_as_written(found, record):
        raise SetupRefused(
            access, f"{record.name}: reads back as '{found}', written was '{record}'"
        )


def _is_as_written(found: PdoRecord, record: PdoRecord) -> bool:
    """Whether a PDO that was read back is the one that was written."""
    if found.entries != record.entries or found.transmission != record.transmission:
        return False
    return not (found.cob_id ^ record.cob_id) & _COB_ID_BITS


def turn_off(access: ObjectAccess, record: PdoRecord) -> None:
    """Set a PDO of a drive, as it was read, to not valid;
    where its COB-ID is fixed, leave it without objects.

    Raises:
        SetupRefused: the drive refuses both.
    """
    try:
        write_pdo_record(access, replace(record, cob_id=record.cob_id | NOT_VALID))
    except SetupRefused as refused:
        try:
            write_pdo_record(access, replace(record, entries=()))
        except SetupRefused:
            raise refused from refused.__cause__
