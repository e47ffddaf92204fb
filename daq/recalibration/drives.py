"""A look at the drives before a job moves anything: who they are, no fault, and nobody else's power on them."""

from __future__ import annotations

from daq.configuration.cell import Cell
from daq.record import network_of
from drivers.errors import DriveFault, StateRefused
from drivers.network import Undisturbed
from drivers.state import POWERLESS, State, decode

FAULTS = (State.FAULT, State.FAULT_REACTION_ACTIVE)
IDLE = (*POWERLESS, State.READY_TO_SWITCH_ON)
"""Without power in the motor, and with nobody's wish for it."""

LEFT_BEHIND = (
    " (so a recorder that was killed leaves a drive to which no SYNC comes any more: `drivegain record` takes it over, "
    "or switch it off and on)"
)


def check_drives(cell: Cell, undisturbed: Undisturbed) -> None:
    """Read identity and state of every drive; nothing is changed and nothing moves.

    Args:
        cell: its file.
        undisturbed: keeps signals from the closing of the network.

    Raises:
        DriveFault: one has a fault; to reset it is a person's decision.
        StateRefused: one has power already: another controller drives this robot.
        DriverError: a drive does not answer, is another one than declared, or the bus has gone.
    """
    with network_of(cell, undisturbed) as network:
        network.check_identities()
        for axis, statusword in zip(network.axes, network.statuswords(), strict=True):
            state = decode(statusword)
            if state in FAULTS:
                reason = f"{state} before the job began; find its cause, then reset it"
                raise DriveFault(axis.node_id, reason, statusword)
            if state not in IDLE:
                left = LEFT_BEHIND if state is State.QUICK_STOP_ACTIVE else ""
                raise StateRefused(axis.node_id, "no power before a job begins", f"{state}{left}", statusword)
