"""The CiA 402 state machine of one simulated amplifier, pure (the finite state automaton of CiA 402-2)."""

from __future__ import annotations

from enum import Enum


class PowerState(Enum):
    """States by their bits in statusword 6041h (bits 0-3, 5, 6)."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


def next_state(state: PowerState, controlword: int, previous: int, stays_in_quick_stop: bool) -> PowerState:
    """The state after a controlword.

    Args:
        state: before it.
        controlword: object 6040h as written.
        previous: controlword before; fault reset acts on the rising edge of bit 7 alone.
        stays_in_quick_stop: quick stop option 605Ah is 5 or 6, the only case in which transition 16 exists.
    """
    after: PowerState
    if state is PowerState.FAULT:
        reset = controlword & 0x80 and not previous & 0x80
        after = PowerState.SWITCH_ON_DISABLED if reset else state
    elif state in (PowerState.NOT_READY_TO_SWITCH_ON, PowerState.FAULT_REACTION_ACTIVE):
        after = state
    elif not controlword & 0x02:  # disable voltage: transitions 7, 9, 10, 12
        after = PowerState.SWITCH_ON_DISABLED
    elif state is PowerState.QUICK_STOP_ACTIVE:
        again = controlword & 0x0F == 0x0F and stays_in_quick_stop  # 16
        after = PowerState.OPERATION_ENABLED if again else state
    elif not controlword & 0x04:  # quick stop: 7, 10, 11
        running = state is PowerState.OPERATION_ENABLED
        after = PowerState.QUICK_STOP_ACTIVE if running else PowerState.SWITCH_ON_DISABLED
    elif not controlword & 0x01:  # shutdown: 2, 6, 8
        after = PowerState.READY_TO_SWITCH_ON
    elif state is PowerState.SWITCH_ON_DISABLED:
        after = state  # switch on needs READY TO SWITCH ON first
    else:  # switch on (3, 5); enable operation (4, and from READY TO SWITCH ON through SWITCHED ON, which is allowed)
        after = PowerState.OPERATION_ENABLED if controlword & 0x08 else PowerState.SWITCHED_ON
    return after
