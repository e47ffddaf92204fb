"""Compare a drive profile, and the PDOs of a recording with it,
with the maker's data sheet (EDS or DCF, CiA 306).

No verb needs data sheets. They serve the author of a profile, through the tests of the shipped
profiles.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from configparser import RawConfigParser
from copy import copy
from io import StringIO

from canopen.objectdictionary import ObjectDictionary, ODArray, ODVariable
from canopen.objectdictionary.datatypes import INTEGER_TYPES, SIGNED_TYPES
from canopen.objectdictionary.eds import import_eds

from drivers.canopen.pdo import (
    COMMAND,
    MOTION_PROFILE,
    PROFILE_DECELERATION,
    STATUSWORD,
    Direction,
    wanted_pdos,
)
from drivers.canopen.setup import needs_of
from drivers.profiles.profile import Axis, DriveProfile, ObjectEntry

LARGEST_BYTES = 4 * 2**20
_READABLE = {"ro", "rw", "rwr", "rww", "const"}
_EMPTY_FIELD = re.compile(
    r"^(?:PDOMapping|ObjectType|SubNumber)=[ \t\r]*$", re.MULTILINE | re.IGNORECASE
)
"""Fields of an object that real data sheets leave empty and canopen cannot read."""


_OCTAL = re.compile(
    r"^([A-Za-z]+[ \t]*=[ \t]*(?:\$NODEID[ \t]*\+[ \t]*)?)0([0-7]+)(?=[ "
    r"\t]*(?:\+|\r?$))",
    re.MULTILINE | re.IGNORECASE,
)
"""Octal numbers as CiA 306 has them, with a leading 0; canopen reads those of Python, with 0o."""


def data_sheet(text: bytes, name: str, node_id: int | None = None) -> ObjectDictionary:
    """Read a data sheet.

    Args:
        text: content of the file.
        name: name of the file in messages.
        node_id: for defaults that depend on it; without it they are absent.

    Raises:
        ValueError: it is not a data sheet.
    """
    if len(text) > LARGEST_BYTES:
        raise ValueError(_message(name, f"{len(text)} bytes"))
    complete = _EMPTY_FIELD.sub("", text.decode("latin-1"))
    readable = _OCTAL.sub(r"\g<1>0o\g<2>", complete)
    try:
        sheet: ObjectDictionary = import_eds(StringIO(readable), node_id)
        _complete_compact_arrays(sheet, readable)
    # canopen raises errors of many kinds for a file that is not a data sheet.
    except Exception as error:
        raise ValueError(
            _message(name, f"{type(error).__name__}: {str(error).partition(chr(10))[0][:200]}")
        ) from error
    if not any(index >= 0x1000 for index in sheet):
        raise ValueError(_message(name, "no objects"))
    return sheet


def _complete_compact_arrays(sheet: ObjectDictionary, text: str) -> None:
    """Add the elements behind the first of arrays by CompactSubObj;
    those that canopen makes lack PDOMapping.
    """
    parser = RawConfigParser(inline_comment_prefixes=(";",), strict=False)
    parser.read_string(text)
    for section in parser.sections():
        count = parser.get(section, "CompactSubObj", fallback="")
        if not count or re.fullmatch("[0-9A-Fa-f]{4}", section) is None:
            continue
        array = sheet[int(section, 16)]
        if not isinstance(array, ODArray):
            continue
        for subindex in range(2, int(count, 0) + 1):
            if subindex not in array.subindices:
                element = copy(array.subindices[1])
                element.subindex = subindex
                element.name = f"{array.subindices[1].name}_{subindex:x}"
                array.add_member(element)


def disagreements(profile: DriveProfile, sheet: ObjectDictionary) -> tuple[str, ...]:
    """List the statements of a profile that the drive's data sheet contradicts;
    empty if the two agree.
    """
    rated = profile.rated
    read = list(needs_of(profile))
    if rated is not None:
        read += [rated.current, *(() if rated.torque is None else (rated.torque,))]
    if profile.torque is not None:
        read.append(profile.torque)
    if profile.save is not None:
        read.append(profile.save.command)
    mapped = {profile.position, profile.current, STATUSWORD, *COMMAND, *MOTION_PROFILE} - {
        PROFILE_DECELERATION
    }
    variable = sheet.get_variable(PROFILE_DECELERATION.index, 0)
    lacks_deceleration = variable is None
    if not lacks_deceleration:
        mapped.add(PROFILE_DECELERATION)
        read.append(PROFILE_DECELERATION)
    faults: list[str] = []
    for entry in dict.fromkeys(read):
        faults.extend(_faults(entry, sheet, mapped=entry in mapped))
    numbers = {}
    for way in Direction:
        numbers[way] = [n for n in range(4) if way.value[0] + n in sheet]
    try:
        wanted_pdos(
            Axis("any", 1, profile), numbers, MOTION_PROFILE[2:] if lacks_deceleration else ()
        )
    except ValueError as error:
        faults.append(str(error))
    return tuple(faults)


def _faults(entry: ObjectEntry, sheet: ObjectDictionary, *, mapped: bool) -> Iterator[str]:
    found = sheet.get_variable(entry.index, entry.subindex)
    if found is None:
        yield f"{entry}: no such object"
        return
    wanted = _type_name(entry.bits, entry.signed)
    if (declared := _declared(found)) != wanted:
        yield f"{entry} ({found.name}): {declared} in the data sheet, {wanted} in the profile"
    if found.access_type.lower() not in _READABLE:
        yield f"{entry} ({found.name}): not readable according to the data sheet"
    if mapped and not found.pdo_mappable:
        yield f"{entry} ({found.name}): not mappable according to the data sheet"


def _declared(variable: ODVariable) -> str:
    if variable.data_type not in INTEGER_TYPES:
        return "no integer"
    return _type_name(len(variable), variable.data_type in SIGNED_TYPES)


def _type_name(bits: int, signed: bool) -> str:
    return f"{'i' if signed else 'u'}{bits}"


def _message(name: str, found: str) -> str:
    return (
        f"{name}: found {found}; expected an electronic data sheet (EDS or DCF, CiA 306); is "
        "this the right file?"
    )
