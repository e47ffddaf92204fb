"""What a recording that was killed has left in a drive: its power takes it away, a save would keep it."""

from __future__ import annotations

from drivers.axis import Axis
from drivers.errors import ObjectAccessError
from drivers.guard import CONSUMERS
from drivers.mapping import PDOS, SETPOINT_PDOS, Direction, PdoRecord, feedback_entries, pack, read_record, records
from drivers.network import CanopenNetwork
from drivers.profile import ObjectEntry
from drivers.sdo import ABORT_DOES_NOT_EXIST, ABORT_NO_SUBINDEX


def left_over(network: CanopenNetwork, axis: Axis) -> str:
    """What a drive still has of a recording that was killed, for a person; empty where it has nothing.

    Raises:
        ObjectAccessError: it does not let it be read.
    """
    watched = _watches_recorder(network, axis)
    if watched:
        return watched
    access = network.link.objects(axis.node_id)
    for ours in _recorded(axis):
        found = read_record(access, ours.direction, ours.number)
        if found is not None and (found.entries, found.transmission) == (ours.entries, ours.transmission):
            return str(found)
    return ""


def _watches_recorder(network: CanopenNetwork, axis: Axis) -> str:
    """Whether the drive waits for a recorder's heartbeat: a recording sets that first, and gives it back last."""
    access = network.link.objects(axis.node_id)
    try:
        for sub in range(1, access.read(CONSUMERS) + 1):
            value = access.read(ObjectEntry(CONSUMERS.index, sub, 32, signed=False))
            if network.was_ours(value):
                return f"{CONSUMERS.index:04X}h:{sub:02X} = {value:08X}h watches the recorder"
    except ObjectAccessError as error:
        # Only one that it does not have is none: whatever else it refuses may hide what was left.
        if error.abort_code not in (ABORT_DOES_NOT_EXIST, ABORT_NO_SUBINDEX):
            raise
    return ""


def _recorded(axis: Axis) -> tuple[PdoRecord, ...]:
    """The PDOs that a recording sets up."""
    try:
        feedback = pack(feedback_entries(axis))[:PDOS]
    except ValueError:
        return ()  # of this drive nothing can be recorded
    node_id = axis.node_id
    return records(Direction.TPDO, node_id, feedback) + records(Direction.RPDO, node_id, SETPOINT_PDOS)
