"""One simulated amplifier as CiA 402 sees it: power state, set-points, statusword, faults."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from drivers.simulated.amplifier import AmplifierSet
from drivers.simulated.power_state import PowerState, next_state
from drivers.simulated.profile_position import plan
from drivers.simulated.readings import Readings


class ErrorCode(IntEnum):
    """Error codes of CiA 402-2 and CiA 301 (603Fh, EMCY)."""

    NONE = 0x0000
    COMMUNICATION_LOST = 0x8100
    PDO_TOO_SHORT = 0x8210
    HEARTBEAT_LOST = 0x8130
    FOLLOWING_ERROR = 0x8611


class QuickStop(IntEnum):
    """Option code 605Ah."""

    DISABLE = 0
    SLOW_DOWN_AND_DISABLE = 1
    QUICK_STOP_AND_DISABLE = 2
    SLOW_DOWN_AND_STAY = 5
    QUICK_STOP_AND_STAY = 6


@dataclass(frozen=True, slots=True)
class Settings:
    """Objects that tell a drive how to move; counts, counts/s and counts/s²."""

    mode: int
    target: int
    speed: int
    acceleration: int
    deceleration: int
    quick_stop_deceleration: int
    quick_stop: int


class Drive:
    """Power state and profile position mode of one axis; the loops themselves are in the AmplifierSet.

    Attributes:
        state: of CiA 402.
        controlword: as written last.
        error: code of the active fault.
        limited: a limit acts that the loops know nothing of.
    """

    def __init__(self, index: int, amplifiers: AmplifierSet) -> None:
        self._index = index
        self._amplifiers = amplifiers
        self.state = PowerState.SWITCH_ON_DISABLED
        self.controlword = 0
        self.error: int = ErrorCode.NONE
        self.limited = False
        self._acknowledged = False
        self._waiting: tuple[int, Settings] | None = None

    def reset(self) -> None:
        """Power-on state; the brake closes."""
        self._enter(PowerState.SWITCH_ON_DISABLED)
        self.controlword, self.error = 0, ErrorCode.NONE

    def command(self, controlword: int, settings: Settings, readings: Readings) -> None:
        """Obey a controlword."""
        previous, self.controlword = self.controlword, controlword
        stays = settings.quick_stop >= QuickStop.SLOW_DOWN_AND_STAY
        state = next_state(self.state, controlword, previous, stays)
        if state is not self.state:
            if self.state is PowerState.FAULT:
                self.error = ErrorCode.NONE
            self._change(state, settings)
        if self.state is not PowerState.OPERATION_ENABLED or settings.mode != 1:
            return
        if controlword & 0x100 and not previous & 0x100:  # halt
            self._waiting = None
            self._amplifiers.stop(self._index, settings.deceleration)
        if not controlword & 0x10:
            # The handshake ends when the master takes the request away, unless a set-point still waits.
            self._acknowledged = self._waiting is not None
        elif not previous & 0x10 and not controlword & 0x100:
            self._request(controlword, settings, readings)

    def monitor(self, readings: Readings, settings: Settings) -> ErrorCode:
        """After each SYNC period: faults, end of a quick stop, the waiting set-point.

        Returns:
            the code of a new fault, or NONE.
        """
        if self.state is PowerState.QUICK_STOP_ACTIVE:
            if settings.quick_stop < QuickStop.SLOW_DOWN_AND_STAY and not self._amplifiers.moving(self._index):
                self._enter(PowerState.SWITCH_ON_DISABLED)  # transition 12
        elif self._waiting is not None and not self._amplifiers.moving(self._index):
            target, waiting = self._waiting
            self._waiting = None
            self._acknowledged = bool(self.controlword & 0x10)
            self._start(target, waiting)
        if readings.following_error[self._index] and self.powered:
            self.fail(ErrorCode.FOLLOWING_ERROR)
            return ErrorCode.FOLLOWING_ERROR
        return ErrorCode.NONE

    def fail(self, code: int) -> None:
        """Fault reaction: the power stage goes off and the brake closes at once."""
        self._enter(PowerState.FAULT)
        self.error = code

    @property
    def powered(self) -> bool:
        """Whether the loops hold the axis."""
        return self.state in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE)

    def quick_stop(self, settings: Settings) -> None:
        """As if the master had asked for it."""
        if self.state is PowerState.OPERATION_ENABLED:
            self._change(PowerState.QUICK_STOP_ACTIVE, settings)

    def statusword(self, readings: Readings) -> int:
        """Object 6041h."""
        word = self.state.value | 0x0210  # voltage present, remote
        if self.powered:
            word |= readings.reached[self._index] << 10 | (readings.limited[self._index] | self.limited) << 11
        if self._acknowledged:
            word |= 0x1000
        if self.error is ErrorCode.FOLLOWING_ERROR:
            word |= 0x2000
        return word

    def _change(self, state: PowerState, settings: Settings) -> None:
        if state is PowerState.QUICK_STOP_ACTIVE:
            if settings.quick_stop == QuickStop.DISABLE:
                self._enter(PowerState.SWITCH_ON_DISABLED)
                return
            slow = settings.quick_stop in (QuickStop.SLOW_DOWN_AND_DISABLE, QuickStop.SLOW_DOWN_AND_STAY)
            self._waiting, self._acknowledged = None, False
            self._amplifiers.stop(self._index, settings.deceleration if slow else settings.quick_stop_deceleration)
            self.state = state
            return
        if state is PowerState.OPERATION_ENABLED and self.state is PowerState.QUICK_STOP_ACTIVE:
            self.state = state  # transition 16: the loops never stopped
            return
        self._enter(state)

    def _enter(self, state: PowerState) -> None:
        self._amplifiers.enable(self._index, state is PowerState.OPERATION_ENABLED)
        self._waiting, self._acknowledged = None, False
        self.state = state

    def _request(self, controlword: int, settings: Settings, readings: Readings) -> None:
        moving = self._amplifiers.moving(self._index)
        if moving and not controlword & 0x20 and self._waiting is not None:
            return  # no room: the request stays unacknowledged
        target = settings.target
        if controlword & 0x40:
            target += int(self._amplifiers.loops[self._index]["target"])
        self._acknowledged = True
        if moving and not controlword & 0x20:
            self._waiting = (target, settings)
            return
        self._waiting = None
        self._start(target, settings)
        # Told at once, so that no one takes the end of the last move for the end of this one.
        readings.reached[self._index] = 0

    def _start(self, target: int, settings: Settings) -> None:
        axis = self._amplifiers.loops[self._index]
        self._amplifiers.move(
            self._index,
            plan(
                float(axis["demand"]),
                float(axis["demand_velocity"]),
                float(target),
                float(settings.speed),
                float(settings.acceleration),
                float(settings.deceleration),
            ),
        )
