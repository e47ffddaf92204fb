"""CiA 402 part of one simulated amplifier: power state, set-points, statusword, faults."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, IntEnum

from drivers.simulation.amplifier import SEGMENTS, AmplifierSet, plan, ramp_down


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


def next_state(
    state: PowerState, controlword: int, previous: int, stays_in_quick_stop: bool
) -> PowerState:
    """Return the state after a controlword (finite state automaton of CiA 402-2).

    Args:
        state: present state.
        controlword: object 6040h as written.
        previous: controlword before; fault reset acts on the rising edge of bit 7 alone.
        stays_in_quick_stop: quick stop option 605Ah is 5 or 6, the only case in which transition 16
            exists.
    """
    after: PowerState
    if state is PowerState.FAULT:
        reset = controlword & 0x80 and not previous & 0x80
        after = state
        if reset:
            after = PowerState.SWITCH_ON_DISABLED
    elif state in (PowerState.NOT_READY_TO_SWITCH_ON, PowerState.FAULT_REACTION_ACTIVE):
        after = state
    elif not controlword & 0x02:  # disable voltage: transitions 7, 9, 10, 12
        after = PowerState.SWITCH_ON_DISABLED
    elif state is PowerState.QUICK_STOP_ACTIVE:
        again = controlword & 0x0F == 0x0F and stays_in_quick_stop  # 16
        after = state
        if again:
            after = PowerState.OPERATION_ENABLED
    elif not controlword & 0x04:  # quick stop: 7, 10, 11
        running = state is PowerState.OPERATION_ENABLED
        after = PowerState.SWITCH_ON_DISABLED
        if running:
            after = PowerState.QUICK_STOP_ACTIVE
    elif not controlword & 0x01:  # shutdown: 2, 6, 8
        after = PowerState.READY_TO_SWITCH_ON
    elif state is PowerState.SWITCH_ON_DISABLED:
        after = state  # switch on needs READY TO SWITCH ON first
    else:  # switch on (3, 5); enable operation (4, and from READY TO SWITCH ON through SWITCHED ON, which is allowed)  # noqa: E501
        after = PowerState.SWITCHED_ON
        if controlword & 0x08:
            after = PowerState.OPERATION_ENABLED
    return after


class ErrorCode(IntEnum):
    """Error codes of CiA 402-2 and CiA 301 (603Fh, EMCY)."""

    NONE = 0x0000
    COMMUNICATION_LOST = 0x8100
    PDO_TOO_SHORT = 0x8210
    HEARTBEAT_LOST = 0x8130
    FOLLOWING_ERROR = 0x8611


Setpoint = tuple[float, float, float, float]
"""Target, speed, acceleration and deceleration [counts, s]:
objects 607Ah, 6081h, 6083h and 6084h when it was set.
"""


class Drive:
    """Power state and profile position mode of one axis;
    the loops themselves are in the AmplifierSet.
    """

    def __init__(self, index: int, amplifiers: AmplifierSet, number: Callable[[int], int]) -> None:
        self._index = index
        self._amplifiers = amplifiers
        self._axis = amplifiers.loops[index]  # a view
        self._number = number  # present value of an object
        self.state = PowerState.SWITCH_ON_DISABLED  #: CiA 402 power state
        self.controlword = 0  #: last value written
        self.error: int = ErrorCode.NONE  #: code of the active fault
        self.limited = False  #: an injected limit is active, in addition to those of the loops
        self._acknowledged = False
        self._waiting: Setpoint | None = None

    def reset(self) -> None:
        """Return to the power-on state; the brake closes."""
        self._enter(PowerState.SWITCH_ON_DISABLED)
        self.controlword = 0
        self.error = ErrorCode.NONE

    def command(self, controlword: int) -> None:
        """Obey a controlword."""
        previous = self.controlword
        self.controlword = controlword
        state = next_state(self.state, controlword, previous, self._stays_in_quick_stop)
        if state is not self.state:
            if self.state is PowerState.FAULT:
                self.error = ErrorCode.NONE
            self._change(state)
        if self.state is not PowerState.OPERATION_ENABLED or self._number(0x6060) != 1:
            return
        if controlword & 0x100 and not previous & 0x100:  # halt
            self._waiting = None
            self._stop(self._number(0x6084))
        if not controlword & 0x10:
            # The handshake ends when the master clears the request, unless a set-point still waits.
            self._acknowledged = self._waiting is not None
        elif not previous & 0x10 and not controlword & 0x100:
            self._request(controlword)

    def monitor(self) -> ErrorCode:
        """Update faults, quick stop and waiting set-point after a SYNC period;
        return the code of a new fault.
        """
        if self.state is PowerState.QUICK_STOP_ACTIVE:
            if not self._stays_in_quick_stop and not self.moving:
                self._enter(PowerState.SWITCH_ON_DISABLED)  # transition 12
        elif self._waiting is not None and not self.moving:
            waiting = self._waiting
            self._waiting = None
            self._acknowledged = bool(self.controlword & 0x10)
            self._start(waiting)
        if self._amplifiers.readings.following_error[self._index] and self.powered:
            self.fail(ErrorCode.FOLLOWING_ERROR)
            return ErrorCode.FOLLOWING_ERROR
        return ErrorCode.NONE

    def fail(self, code: int) -> None:
        """Enter FAULT: the power stage goes off and the brake closes at once."""
        self._enter(PowerState.FAULT)
        self.error = code

    @property
    def powered(self) -> bool:
        """Whether the loops control the axis."""
        return self.state in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE)

    @property
    def _stays_in_quick_stop(self) -> bool:
        return self._number(0x605A) >= 5  # options 5 and 6: as 1 and 2, without leaving the state

    def quick_stop(self) -> None:
        """Obey the quick stop command without a controlword: transitions 7, 10 and 11."""
        if self.state is PowerState.OPERATION_ENABLED:
            self._change(PowerState.QUICK_STOP_ACTIVE)
        elif self.state in (PowerState.READY_TO_SWITCH_ON, PowerState.SWITCHED_ON):
            self._enter(PowerState.SWITCH_ON_DISABLED)

    def statusword(self) -> int:
        """Return object 6041h."""
        readings = self._amplifiers.readings
        word = self.state.value | 0x0210  # voltage present, remote
        if self.powered:
            limited = readings.limited[self._index] | self.limited
            word |= readings.reached[self._index] << 10 | limited << 11
        if self._acknowledged:
            word |= 0x1000
        if self.error is ErrorCode.FOLLOWING_ERROR:
            word |= 0x2000
        return word

    def _change(self, state: PowerState) -> None:
        if state is PowerState.QUICK_STOP_ACTIVE:
            option = self._number(0x605A)
            if option == 0:  # disable at once
                self._enter(PowerState.SWITCH_ON_DISABLED)
                return
            self._waiting = None
            self._acknowledged = False
            # Slow down, or quick stop
            self._stop(self._number(0x6084 if option in (1, 5) else 0x6085))
            self.state = state
            return
        if state is PowerState.OPERATION_ENABLED and self.state is PowerState.QUICK_STOP_ACTIVE:
            self.state = state  # transition 16: the loops never stopped
            return
        self._enter(state)

    def _enter(self, state: PowerState) -> None:
        """Enter a state with the power stage on or off;
        the set-point then holds the present position.
        """
        axis = self._axis
        axis["enabled"] = int(state is PowerState.OPERATION_ENABLED)
        axis["reached"] = axis["following_error"] = 0
        axis["current_a"] = axis["integral_a"] = axis["inside_for_s"] = 0.0
        axis["demand"] = axis["target"] = axis["counts"]
        axis["demand_velocity"] = axis["demand_acceleration"] = 0.0
        axis["piece"] = SEGMENTS
        self._waiting = None
        self._acknowledged = False
        self.state = state

    def _request(self, controlword: int) -> None:
        moving = self.moving
        if moving and not controlword & 0x20 and self._waiting is not None:
            return  # no room: the request stays unacknowledged
        target = self._number(0x607A)
        if controlword & 0x40:
            target += int(self._axis["target"])
        self._acknowledged = True
        speed = float(self._number(0x6081))
        acceleration = float(self._number(0x6083))
        deceleration = float(self._number(0x6084))
        setpoint = (float(target), speed, acceleration, deceleration)
        if moving and not controlword & 0x20:
            self._waiting = setpoint
            return
        self._waiting = None
        self._start(setpoint)
        # Reported at once, so that a master does not take the end of the last move for the end of
        # this one.
        self._amplifiers.readings.reached[self._index] = 0

    @property
    def moving(self) -> bool:
        """Whether the set-point moves."""
        return bool(self._axis["piece"] < SEGMENTS)

    def _start(self, setpoint: Setpoint) -> None:
        self._amplifiers.move(self._index, plan(*self._demand, *setpoint))

    def _stop(self, deceleration: float) -> None:
        self._amplifiers.move(self._index, ramp_down(*self._demand, deceleration))

    @property
    def _demand(self) -> tuple[float, float]:
        """Position and velocity of the set-point."""
        return float(self._axis["demand"]), float(self._axis["demand_velocity"])
