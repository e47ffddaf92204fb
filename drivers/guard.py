"""Amplifiers that stop by themselves when the recorder falls silent: killed, hung, or cut off.

The recorder sends a heartbeat while axes have power. Each amplifier watches it (CiA 301, consumer heartbeat time 1016h,
which begins with the first heartbeat) and, when none comes, does what its abort connection option code says (CiA 402-2,
6007h): quick stop.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from drivers.errors import ObjectAccessError
from drivers.profile import ObjectEntry
from drivers.sdo import ObjectAccess

CONSUMERS = ObjectEntry(0x1016, 0, 8, signed=False)
ABORT_CONNECTION = ObjectEntry(0x6007, 0, 16, signed=True)
QUICK_STOP_ON_LOSS = 3


@dataclass(frozen=True, slots=True)
class Guard:
    """How an amplifier can watch the recorder, and what its objects held before.

    Attributes:
        consumer: entry of 1016h that is used, None when there is none.
        consumer_before: its value.
        option_before: value of 6007h, None when the amplifier has no such object.
        lack: what it cannot do, for a person; empty when it does all.
    """

    consumer: ObjectEntry | None
    consumer_before: int
    option_before: int | None
    lack: str = ""


def find_guard(access: ObjectAccess, recorder_id: int) -> Guard:
    """Look for a free entry of 1016h; one that still watches a recorder that was killed is taken again.

    Raises:
        ObjectAccessError: the node does not answer; an object that it lacks is told in `Guard.lack`.
    """
    try:
        entries = access.read(CONSUMERS)
        for sub in range(1, entries + 1):
            entry = ObjectEntry(0x1016, sub, 32, signed=False)
            value = access.read(entry)
            leftover = value >> 16 & 0x7F == recorder_id
            if leftover or value & 0xFFFF == 0:
                return Guard(entry, 0 if leftover else value, *_option(access))
    except ObjectAccessError as error:
        if error.abort_code is None:
            raise
        return Guard(None, 0, None, "no 1016h: it does NOT stop by itself when the recorder is killed")
    return Guard(None, 0, None, "no free 1016h: it does NOT stop by itself when the recorder is killed")


def _option(access: ObjectAccess) -> tuple[int | None, str]:
    try:
        return access.read(ABORT_CONNECTION), ""
    except ObjectAccessError as error:
        if error.abort_code is None:
            raise
        return None, "no 6007h: when the recorder is killed it stops in the way that its maker decided"


def arm(access: ObjectAccess, guard: Guard, recorder_id: int, silence_ms: int) -> Guard:
    """Let the amplifier quick stop after so much silence of the recorder; counted from its first heartbeat.

    Returns:
        the guard as it is in force: an amplifier that refuses one of the writes lacks that, and is no reason not to
        record.

    Raises:
        ObjectAccessError: it does not answer.
    """
    consumer = guard.consumer
    if consumer is None:
        return guard
    if guard.option_before is not None:
        refused = _refused(access, ABORT_CONNECTION, QUICK_STOP_ON_LOSS)
        if refused:
            lack = f"6007h = {guard.option_before} rules how it stops when the recorder is killed: 3 is {refused}"
            guard = replace(guard, option_before=None, lack=lack)
    refused = _refused(access, consumer, recorder_id << 16 | silence_ms)
    if refused:
        if guard.option_before is not None:
            access.write(ABORT_CONNECTION, guard.option_before)
        lack = f"it does NOT stop by itself when the recorder is killed: 1016h is {refused}"
        guard = replace(guard, consumer=None, option_before=None, lack=lack)
    return guard


def _refused(access: ObjectAccess, entry: ObjectEntry, value: int) -> str:
    try:
        access.write(entry, value)
    except ObjectAccessError as error:
        if error.abort_code is None:
            raise
        return error.reason
    return ""


def disarm(access: ObjectAccess, guard: Guard) -> None:
    """Give back what was there.

    Raises:
        ObjectAccessError: a write was refused or not answered.
    """
    if guard.consumer is None:
        return
    access.write(guard.consumer, guard.consumer_before)
    if guard.option_before is not None:
        access.write(ABORT_CONNECTION, guard.option_before)
