"""The CiA 402 state machine: the state in a statusword, and the controlword that leads to a goal.

Source: CiA 402-2 (IEC 61800-7-201), finite state automaton of the power drive system, objects 6040h
and 6041h.
"""

from __future__ import annotations

from enum import Enum, IntEnum

STATUS_FAULT = 1 << 3
STATUS_TARGET_REACHED = 1 << 10
STATUS_SETPOINT_ACKNOWLEDGE = 1 << 12  # profile position mode
STATUS_FOLLOWING_ERROR = 1 << 13  # profile position mode

CONTROL_NEW_SETPOINT = 1 << 4  # profile position mode; acts on its rising edge
CONTROL_CHANGE_IMMEDIATELY = 1 << 5


class State(Enum):
    """State of one drive; the value is (mask, pattern) of the statusword."""

    NOT_READY_TO_SWITCH_ON = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)
    UNKNOWN = (0x00, 0xFF)  #: A pattern outside the standard; no statusword matches this mask

    def __str__(self) -> str:
        return self.name.replace("_", " ")


POWERLESS = (State.SWITCH_ON_DISABLED, State.NOT_READY_TO_SWITCH_ON, State.FAULT)
"""States in which a drive gives its motor no power;
in FAULT REACTION ACTIVE it still does, in UNKNOWN it may.
"""

ENABLED = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE)
"""States in which the drive function is enabled and the motor has torque."""
FAULTY = (State.FAULT, State.FAULT_REACTION_ACTIVE)

STATE_BITS = 0x6F  #: Bits of the statusword that encode the state


def _state(bits: int) -> State:
    for state in State:
        mask, pattern = state.value
        if bits & mask == pattern:
            return state
    return State.UNKNOWN


_STATES = tuple(map(_state, range(STATE_BITS + 1)))  # six decodes a SYNC: a table, not a search


def decode(statusword: int) -> State:
    """Return the state of a statusword (6041h)."""
    return _STATES[statusword & STATE_BITS]


class ControlCommand(IntEnum):
    """Bits 0–3 and 7 of the controlword (6040h)."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    DISABLE_OPERATION = 0x07  # the same word; its effect depends on the state (transitions 3 and 5)
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


class Goal(Enum):
    """State to which a drive is led."""

    OPERATION_ENABLED = "operation enabled"
    SWITCH_ON_DISABLED = "switch on disabled"
    QUICK_STOP = "quick stop"


_PATHS = {
    Goal.OPERATION_ENABLED: {
        State.SWITCH_ON_DISABLED: ControlCommand.SHUTDOWN,
        State.READY_TO_SWITCH_ON: ControlCommand.SWITCH_ON,
        State.SWITCHED_ON: ControlCommand.ENABLE_OPERATION,
        State.OPERATION_ENABLED: ControlCommand.ENABLE_OPERATION,
    },
    # One step at a time: voltage is removed only after the drive has stopped and its brake could
    # close.
    Goal.SWITCH_ON_DISABLED: {
        State.OPERATION_ENABLED: ControlCommand.DISABLE_OPERATION,
        State.SWITCHED_ON: ControlCommand.SHUTDOWN,
    },
    Goal.QUICK_STOP: {
        State.OPERATION_ENABLED: ControlCommand.QUICK_STOP,
        State.QUICK_STOP_ACTIVE: ControlCommand.QUICK_STOP,
    },
}


def next_command(state: State, goal: Goal) -> ControlCommand:
    """Return the next command on the path from a state to a goal.

    From FAULT, and from every state without a path, it is DISABLE VOLTAGE. A fault is left by
    ``FAULT_RESET_SEQUENCE`` alone, so nothing re-enables an axis by itself. DISABLE VOLTAGE is also
    a harmless first controlword for drives that show statusword 0000h until they receive one.
    """
    return _PATHS[goal].get(state, ControlCommand.DISABLE_VOLTAGE)


FAULT_RESET_SEQUENCE = (
    ControlCommand.DISABLE_VOLTAGE,
    ControlCommand.FAULT_RESET,
    ControlCommand.DISABLE_VOLTAGE,
)
"""Bit 7 acts on its rising edge; the sequence ends in SWITCH ON DISABLED,
never in OPERATION ENABLED.
"""
