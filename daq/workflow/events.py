"""Events of a cell in words, with what to do:
the console's page and `drivegain monitor` show the same.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from daq.advice import for_command_line
from drivers.canopen.emcy import ErrorCode, explain
from drivers.messages import EventKind

REMEDIES = {
    EventKind.HEARTBEAT_LOST: "check the drive's power and its cable; `drivegain scan` shows which "
    "nodes answer",
    EventKind.FOLLOWING_ERROR: "check brake, load and collision; use slower moves (`record "
    "--speed 0.5`)",
    EventKind.LIMIT: "check limit switches and current limits, or use slower moves",
    EventKind.SAMPLE_LOST: "check the load of bus and computer; the run is marked invalid, "
    "record it again",
    EventKind.BUS_BUSY: "end the other program on this bus",
    EventKind.BUS_LOST: "check the CAN interface and its cable",
    EventKind.BUS_PASSIVE: "check the bus's cable and its two terminating resistors",
    EventKind.FRAMES_DROPPED: "reduce the load of this computer; the run is marked invalid, "
    "record it again",
    EventKind.SYNC_LOST: "check the device that produces SYNC",
    EventKind.PDO_LENGTH: "did another program change the mapping, or does another device use this "
    "identifier?",
    EventKind.FROZEN: "check the encoder and the motor cable; restart the drive",
    EventKind.STOP_UNCONFIRMED: "look at this axis; use the emergency stop if it moves",
}
ALARMING = frozenset(REMEDIES) | {EventKind.EMCY}


@dataclass(frozen=True, slots=True)
class EventNotice:
    """An event as people are shown it."""

    axis: str | None  #: its name; None for the whole cell
    kind: str  #: name of the event's kind
    code: int  #: as in `CellEvent`
    text: str  #: what happened, without the axis, which is shown next to it
    remedy: str  #: what to do; empty where nothing is to be done
    alarm: bool  #: whether a person has to look


def notice_of(kind: EventKind, code: int, axis: str | None, text: str) -> EventNotice:
    """Return an event with the axis by name, and the remedy.

    Args:
        kind, code, text: as in `CellEvent`.
        axis: its name, None for the whole cell.
    """
    remedy = REMEDIES.get(kind, "")
    if kind is EventKind.EMCY:
        remedy = explain_error_code(code).remedy
    if axis is not None:
        text = re.sub(rf"^{re.escape(axis)}( \(node \d+\))?: ", "", text)
    return EventNotice(
        axis=axis,
        kind=kind.value,
        code=code,
        text=text,
        remedy=remedy,
        alarm=kind in ALARMING,
    )


def explain_error_code(code: int) -> ErrorCode:
    """Meaning and first remedy of an error code of 16 bits, with the verb that resets the fault."""
    found = explain(code)
    return replace(found, remedy=for_command_line(found.remedy))
