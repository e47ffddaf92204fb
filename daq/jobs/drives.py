"""Check the drives before a job, and take over those that a killed recorder has left with power.

A killed recorder cannot remove the power. Its drives watch its heartbeat (1016h) and quick stop when it stays away, so
a job waits for that. Most drives then remove the power themselves. Those that stay in QUICK STOP ACTIVE (605Ah = 5 to
8) or SWITCHED ON lose it here, at standstill, with the interlock closed. A drive that watches no killed recorder
belongs to another controller: it is left alone.
"""

from __future__ import annotations

from collections.abc import Sequence

from daq.config.cell import Cell
from daq.workflow.record import network_of
from drivers.canopen.network import CanopenNetwork, SignalBlocker
from drivers.canopen.setup import read_consumers
from drivers.errors import DriveFault, StateRefused
from drivers.motion.execute import DEFAULT_BOUNDS
from drivers.profiles.cia402 import POWERLESS, Goal, State, decode
from drivers.profiles.profile import Axis

FAULTS = (State.FAULT, State.FAULT_REACTION_ACTIVE)
LEFT = (State.QUICK_STOP_ACTIVE, State.SWITCHED_ON)  #: States of power without a motion that a killed recorder leaves
IDLE = (*POWERLESS, State.READY_TO_SWITCH_ON)  #: Without power in the motor, and without a request for it
STOP_S = 15.0  #: For the quick stop after a guard has expired; a simulated cell on a busy machine may be that slow
ASK_S = 0.1  #: Between two questions for the states
STANDSTILL_S = 0.2  #: Between two readings of a position that must agree
OTHERS = (
    "nothing was changed: end the other controller; if a recorder was killed there, `drivegain record` takes the drive "
    "over, or switch it off and on"
)

Powered = tuple[tuple[Axis, int], ...]  #: Axes with power, and their statuswords


def check_drives(cell: Cell, block_signals: SignalBlocker, take_over: bool) -> None:
    """Check identity and state of every drive; nothing moves.

    Args:
        cell: whose drives these are.
        block_signals: as in `network_of`.
        take_over: remove the power of drives that a killed recorder left with it; else nothing is changed.

    Raises:
        DriveFault: one has a fault; to reset it is a person's decision.
        StateRefused: one has power already: another controller drives this robot, or it moves.
        BusBusy: another master commands the bus; nothing was sent.
        DriverError: a drive does not answer, is another one than declared, or the bus has gone.
    """
    with network_of(cell, block_signals) as network:
        network.require_quiet()  # a recorder on another computer is not excluded by the lock of the bus
        network.check_identities()
        left = _with_power(network)
        if not left:
            return
        _require_ours(network, left)
        left = _wait(network, left)
        _require_stopped(network, left)
        if take_over:
            for axis, _ in left:
                network.disable(axis, Goal.SWITCH_ON_DISABLED)


def _with_power(network: CanopenNetwork) -> Powered:
    """Return the axes with power.

    Raises:
        DriveFault: an axis has a fault.
    """
    found = tuple(zip(network.axes, network.statuswords(), strict=True))
    for axis, statusword in found:
        if (state := decode(statusword)) in FAULTS:
            raise DriveFault(axis, f"{state} before the job began; find its cause, then reset it", statusword)
    return tuple((axis, statusword) for axis, statusword in found if decode(statusword) not in IDLE)


def _require_ours(network: CanopenNetwork, left: Powered) -> None:
    """Refuse axes that do not watch a recorder which is gone."""
    network.require_quiet()  # also hears the heartbeat of a recorder that is still there
    for axis, statusword in left:
        entries = read_consumers(network.link.objects(axis.node_id)) or ()
        if not any(network.was_ours(value) for _, value in entries):
            raise _refused(axis, statusword, OTHERS)


def _wait(network: CanopenNetwork, left: Powered) -> Powered:
    """Let the guards expire and the axes stop by themselves; return those that have power all the same."""
    clock = network.link.clock
    end_ns = clock() + network.guard_ms * 10**6 + round(STOP_S * 1e9)
    while left and clock() < end_ns:
        network.link.wait(ASK_S)
        left = _with_power(network)
    return left


def _require_stopped(network: CanopenNetwork, left: Powered) -> None:
    """Refuse axes that are in another state than a killed recorder leaves, or move."""
    axes = [axis for axis, _ in left]
    before = _positions(network, axes)
    network.link.wait(STANDSTILL_S if left else 0.0)
    for (axis, statusword), here, there in zip(left, before, _positions(network, axes), strict=True):
        if decode(statusword) not in LEFT:
            raise _refused(axis, statusword, OTHERS)
        if abs(there - here) > DEFAULT_BOUNDS.standstill_counts:
            moves = f"it moves by {abs(there - here)} counts in {STANDSTILL_S:g} s: press the emergency stop"
            raise _refused(axis, statusword, moves)


def _positions(network: CanopenNetwork, axes: Sequence[Axis]) -> tuple[int, ...]:
    return tuple(network.link.objects(axis.node_id).read(axis.profile.position) for axis in axes)


def _refused(axis: Axis, statusword: int, remedy: str) -> StateRefused:
    return StateRefused(axis, "no power before a job begins", str(decode(statusword)), statusword, remedy=remedy)
