"""The objects that a recording needs in a drive, compared with those that the drive has, before anything is written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.canopen.pdo import (
    CONTROLWORD,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    STATUSWORD,
    TARGET_POSITION,
)
from drivers.canopen.sdo import NO_SUCH_OBJECT, ObjectAccess
from drivers.errors import ObjectAccessError
from drivers.profiles.profile import DriveProfile, ObjectEntry

HEARTBEAT_TIME = ObjectEntry(0x1017, 0, 16)
MODE_OF_OPERATION = ObjectEntry(0x6060, 0, 8, signed=True)
MODE_DISPLAY = ObjectEntry(0x6061, 0, 8, signed=True)

Profiles = Callable[[], Sequence[DriveProfile]]
"""Returns the profiles from which one that fits a drive is suggested."""


@dataclass(frozen=True, slots=True)
class Need:
    """One object without which a drive cannot be recorded."""

    entry: ObjectEntry
    purpose: str  #: in a message


def needs_of(profile: DriveProfile) -> tuple[Need, ...]:
    """Return the objects that a recording with a profile needs; 1016h, 6007h and 6084h may be missing."""
    scale = profile.current_scale
    switch = () if scale.switch is None else (scale.switch,)
    return (
        Need(profile.position, "position"),
        Need(profile.current, "current"),
        Need(STATUSWORD, "statusword"),
        Need(CONTROLWORD, "controlword"),
        Need(TARGET_POSITION, "target position"),
        Need(PROFILE_VELOCITY, "profile velocity"),
        Need(PROFILE_ACCELERATION, "profile acceleration"),
        Need(MODE_OF_OPERATION, "mode of operation"),
        Need(MODE_DISPLAY, "mode display"),
        Need(HEARTBEAT_TIME, "heartbeat period"),
        *(Need(entry, "scale of the current") for entry in (*scale.objects, *switch)),
    )


def misfit(access: ObjectAccess, profile: DriveProfile, others: Profiles = tuple) -> str:
    """Describe the objects of a profile that a drive does not have, and name a profile that fits; empty if it has all.

    Raises:
        ObjectAccessError: the drive does not answer.
    """
    lacking = _lacking(access, profile)
    if not lacking:
        return ""
    fitting = [other for other in others() if other.name != profile.name and not _lacking(access, other)]
    if fitting:
        advice = " or ".join(f"`{other.name}` ({_difference(other, profile)})" for other in fitting)
        remedy = f"use a profile that fits this drive: {advice}"
    else:
        remedy = "no shipped profile fits this drive: write one with the objects of its manual"
    return f"found {', '.join(lacking)}; expected every object of profile {profile.name}; {remedy}"


def _lacking(access: ObjectAccess, profile: DriveProfile) -> tuple[str, ...]:
    found = []
    for need in needs_of(profile):
        try:
            bits = 8 * len(access.read_bytes(need.entry.index, need.entry.subindex))
        except ObjectAccessError as error:
            if error.abort_code is None:
                raise
            if error.abort_code in NO_SUCH_OBJECT:
                found.append(f"no object {need.entry} ({need.purpose})")
            continue  # an object that cannot be read now exists
        if bits < need.entry.bits:
            found.append(f"object {need.entry} ({need.purpose}) of {bits} bits instead of {need.entry.bits}")
    return tuple(found)


def _difference(other: DriveProfile, profile: DriveProfile) -> str:
    """Describe the objects by which another profile differs."""
    same = needs_of(profile)
    parts = [f"{need.purpose} from {need.entry}" for need in needs_of(other) if need not in same]
    if other.rated is not None and (profile.rated is None or other.rated.current != profile.rated.current):
        parts.append(f"rated current from {other.rated.current}")
    return ", ".join(parts) or "the same objects in other units"
