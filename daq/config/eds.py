"""An electronic data sheet (CiA 306, EDS or DCF): what the maker of an amplifier says of its objects."""

from __future__ import annotations

import configparser
import re
from collections.abc import Iterator
from dataclasses import dataclass

from daq.errors import ConfigurationInconsistent
from drivers.profiles.profile import DriveProfile, ObjectEntry

MAX_BYTES = 4 * 2**20
"""No data sheet of an amplifier is larger; a file that is must be something else."""
_SECTION = re.compile(r"([0-9A-Fa-f]{4})(?:sub([0-9A-Fa-f]{1,2}))?\Z")
_TYPES = {2: (8, True), 3: (16, True), 4: (32, True), 5: (8, False), 6: (16, False), 7: (32, False)}
"""Bits and sign of the integer types of CiA 301, by their number in a data sheet."""
_LARGEST_TYPE = 0x0FFF


@dataclass(frozen=True, slots=True)
class EdsObject:
    """One object of a data sheet.

    Attributes:
        name: parameter name.
        bits, signed: of an integer; bits 0 for everything else.
        readable, mappable: by SDO, into a PDO.
    """

    name: str
    bits: int
    signed: bool
    readable: bool
    mappable: bool


@dataclass(frozen=True, slots=True)
class Eds:
    """A data sheet.

    Attributes:
        name: what to call it in messages.
        description: of the device, as its maker words it.
        objects: by (index, subindex).
    """

    name: str
    description: str
    objects: dict[tuple[int, int], EdsObject]


def eds_from_text(text: bytes, name: str) -> Eds:
    """Read a data sheet.

    Empty fields, which real data sheets have, count as not given.

    Args:
        text: of the file.
        name: what to call it in messages.

    Raises:
        ConfigurationInconsistent: it is none.
    """
    if len(text) > MAX_BYTES:
        raise _no_eds(name, f"{len(text)} bytes")
    parser = configparser.RawConfigParser(strict=False, allow_no_value=True, comment_prefixes=(";",))
    try:
        parser.read_string(text.decode("latin-1"), name)
    except configparser.Error as error:
        raise _no_eds(name, str(error).splitlines()[0][:200]) from error
    objects = {}
    for section in parser.sections():
        match = _SECTION.match(section)
        keys = {key: (value or "").strip() for key, value in parser.items(section)}
        # The head of an array or record has no value of its own: its subindices have.
        if match is None or not keys.get("datatype"):
            continue
        objects[int(match[1], 16), int(match[2] or "0", 16)] = _object(name, section, keys)
    if not objects:
        raise _no_eds(name, "no objects")
    info = dict(parser.items("FileInfo")) if parser.has_section("FileInfo") else {}
    return Eds(name, (info.get("description") or "").strip(), objects)


def disagreements(profile: DriveProfile, eds: Eds) -> tuple[str, ...]:
    """What a profile says of a drive that the drive's own data sheet denies; empty where the two agree."""
    return tuple(_disagreements(profile, eds))


def _disagreements(profile: DriveProfile, eds: Eds) -> Iterator[str]:
    scale, rated = profile.current_scale, profile.rated
    read = [*scale.objects, *(() if scale.switch is None else (scale.switch,))]
    if rated is not None:
        read += [rated.current, *(() if rated.torque is None else (rated.torque,))]
    if profile.save is not None:
        read.append(profile.save.command)
    for entry in dict.fromkeys((profile.position, profile.current, *read)):
        yield from _entry_faults(entry, eds, mapped=entry in (profile.position, profile.current))


def _entry_faults(entry: ObjectEntry, eds: Eds, *, mapped: bool) -> Iterator[str]:
    found = eds.objects.get((entry.index, entry.subindex))
    if found is None:
        yield f"{entry}: no such object in {eds.name}"
        return
    if (found.bits, found.signed) != (entry.bits, entry.signed):
        found_type = f"{'i' if found.signed else 'u'}{found.bits}" if found.bits else "no integer"
        wanted = f"{'i' if entry.signed else 'u'}{entry.bits}"
        yield f"{entry} ({found.name}): {found_type} in {eds.name}, {wanted} in the profile"
    if not found.readable:
        yield f"{entry} ({found.name}): cannot be read by {eds.name}"
    if mapped and not found.mappable:
        yield f"{entry} ({found.name}): cannot be mapped by {eds.name}"


def _object(name: str, section: str, keys: dict[str, str]) -> EdsObject:
    try:
        kind, mappable = int(keys["datatype"], 0), int(keys.get("pdomapping") or "0", 0)
    except ValueError as error:
        raise _no_eds(name, f"[{section}] with DataType {keys['datatype'][:40]!r}") from error
    if not 0 < kind <= _LARGEST_TYPE:
        raise _no_eds(name, f"[{section}] with DataType {kind:#x}")
    bits, signed = _TYPES.get(kind, (0, False))
    access = keys.get("accesstype", "").lower()
    return EdsObject(
        keys.get("parametername", ""), bits, signed, access in {"ro", "rw", "rwr", "rww", "const"}, mappable == 1
    )


def _no_eds(name: str, found: str) -> ConfigurationInconsistent:
    return ConfigurationInconsistent(
        name, found=found, expected="an electronic data sheet (EDS or DCF, CiA 306)", remedy="is this the right file?"
    )
