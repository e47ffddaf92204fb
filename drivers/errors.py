"""Everything that can go wrong between a bus and a sample.

DriverError
├── BusError                  the bus cannot be opened, or has gone
├── BusBusy                   another master commands this bus
├── RecorderIdTaken           the recorder's heartbeat has no node id of its own
├── NodeMissing               a configured node does not answer
├── NodeMisplaced             a node is heard on another bus than its own
├── IdentityMismatch          1018h is not what the cell configuration expects
├── NmtRefused                a node did not confirm an NMT state by heartbeat
├── ObjectAccessError         an SDO transfer was aborted or timed out
├── ScaleImplausible          a drive's ampere value cannot be true (drivers/profiles/scale.py)
├── MappingRefused            a PDO mapping could not be written, or reads back differently
├── StateRefused              a CiA 402 transition did not happen in its bound
├── PowerNotOff               a parameter was to be written while the axis has power, or may have
├── SaveRefused               nobody knows what a drive's save would keep, or it would keep a recording's settings
├── ReadbackDiffers           a parameter reads back as another value than was written
├── ParametersMixed           a write failed midway, and not every drive has its old value again
├── FeedbackDiffers           a PDO carries another value than the object that it maps
├── SampleLost                a SYNC cycle had no complete answer
├── CellSilent                no axis answers any more
├── PdoLengthWrong            an answer is not as long as the mapping says, twice
├── DataFrozen                position and current do not change while the axis is told to move
├── DataStale                 an amplifier's toggle bit says that it sends old values
├── LimitActive               a limit acts for too long
├── DriveFault                EMCY, fault bit or following error while running
├── HeartbeatLost             a node fell silent
├── MotionRefused             motion was asked for without permission, or outside the limits
└── MotionTimeout             a move did not end in its bound
"""

from __future__ import annotations

WHILE = "while "
"""How every note begins that says of an error what the stop, or the giving back, behind it could not confirm."""


class DriverError(Exception):
    """Root of the tree; carries the evidence as attributes and says it in its message."""

    def __reduce__(self) -> tuple[object, ...]:
        # The arguments of `__init__` are not the message that `args` holds: without this, no process can hand one of
        # these to another.
        return type(self).__new__, (type(self), *self.args), self.__dict__


class BusError(DriverError):
    """The bus cannot be opened, or has gone."""

    def __init__(self, address: str, reason: str) -> None:
        super().__init__(f"bus {address}: {reason}")
        self.address = address
        self.reason = reason


class BusBusy(DriverError):
    """Another master commands this bus: two of them would move one robot."""

    def __init__(self, address: str, seen: str) -> None:
        super().__init__(
            f"bus {address}: {seen} that we did not send: another master, recorder or SYNC producer uses this bus; "
            "end it first"
        )
        self.address = address
        self.seen = seen


class RecorderIdTaken(DriverError):
    """The recorder's heartbeat has no node id of its own; a stop that could not be confirmed is noted on the error."""

    def __init__(self, found: str, remedy: str) -> None:
        super().__init__(
            f"node id of the recorder's heartbeat: found {found}; expected an id that no device uses, because another "
            f"device's heartbeat with it keeps the axes running when the recorder is killed; {remedy}"
        )
        self.found = found
        self.remedy = remedy

    @classmethod
    def by_another(cls, node_id: int) -> RecorderIdTaken:
        """A device was heard that sends it too."""
        return cls(
            f"a heartbeat {0x700 + node_id:03X}h of another device, which has node id {node_id} too",
            "the axes are stopped; give that device another node id, or record again: the recorder then takes another",
        )


class NodeMissing(DriverError):
    """A configured node does not answer."""

    def __init__(self, node_ids: tuple[int, ...], found: tuple[int, ...], waited_s: float) -> None:
        super().__init__(
            f"node {', '.join(map(str, node_ids))} did not answer within {waited_s:g} s "
            f"(answered: {', '.join(map(str, found)) or 'none'}); check power, wiring, bit rate and node id"
        )
        self.node_ids = node_ids
        self.found = found
        self.waited_s = waited_s


class NodeMisplaced(DriverError):
    """A node is heard on another bus than its own."""

    def __init__(self, node_id: int, expected: str, found: str) -> None:
        super().__init__(
            f"node {node_id} is heard on bus {found}, the cell configuration has it on bus {expected}: it is wired to "
            "the other bus, two amplifiers have that node id, or both CAN interfaces are on one wire; "
            "`drivegain scan` shows the nodes of each bus"
        )
        self.node_id = node_id
        self.expected = expected
        self.found = found


class IdentityMismatch(DriverError):
    """Object 1018h is not what the cell configuration expects."""

    def __init__(self, node_id: int, field: str, expected: int, found: int) -> None:
        super().__init__(
            f"node {node_id}: {field} is {found:#x}, the cell configuration expects {expected:#x}; "
            "was an amplifier exchanged? correct the configuration only after checking the hardware"
        )
        self.node_id = node_id
        self.field = field
        self.expected = expected
        self.found = found


class NmtRefused(DriverError):
    """A node did not confirm an NMT state by heartbeat."""

    def __init__(self, node_id: int, asked: str, found: str, waited_s: float) -> None:
        super().__init__(
            f"node {node_id}: asked for NMT {asked}, its heartbeat still says {found} after {waited_s:g} s; "
            "read its error register 1001h"
        )
        self.node_id = node_id
        self.asked = asked
        self.found = found


class ObjectAccessError(DriverError):
    """An SDO transfer was aborted or timed out."""

    def __init__(self, node_id: int, entry: str, reason: str, abort_code: int | None = None) -> None:
        super().__init__(f"node {node_id}: object {entry}: {reason}")
        self.node_id = node_id
        self.entry = entry
        self.reason = reason
        self.abort_code = abort_code


class MappingRefused(DriverError):
    """A PDO mapping could not be written, or reads back differently."""

    def __init__(self, node_id: int, pdo: str, reason: str) -> None:
        super().__init__(f"node {node_id}: {pdo}: {reason}")
        self.node_id = node_id
        self.pdo = pdo
        self.reason = reason


class StateRefused(DriverError):
    """A CiA 402 transition did not happen in its bound."""

    def __init__(self, node_id: int, asked: str, found: str, statusword: int) -> None:
        super().__init__(
            f"node {node_id}: asked for {asked}, statusword {statusword:#06x} says {found}; "
            "check the power stage, the safety chain (STO) and the fault memory"
        )
        self.node_id = node_id
        self.asked = asked
        self.found = found
        self.statusword = statusword


class PowerNotOff(DriverError):
    """A parameter was to be written while the axis has power, or may have."""

    def __init__(self, node_id: int, state: str, statusword: int) -> None:
        super().__init__(
            f"node {node_id}: {state} (statusword {statusword:#06x}): its power stage is not off, and no parameter is "
            "written while it is on; disable the axes with the controller that enabled them, then try again"
        )
        self.node_id = node_id
        self.state = state
        self.statusword = statusword


class SaveRefused(DriverError):
    """Nobody knows what a drive's save would keep, or it would keep a recording's settings."""

    def __init__(self, node_id: int, reason: str, remedy: str) -> None:
        super().__init__(f"node {node_id}: nothing was written, because saving it {reason}; {remedy}")
        self.node_id = node_id
        self.reason = reason


class ReadbackDiffers(DriverError):
    """A parameter reads back as another value than was written."""

    def __init__(self, node_id: int, entry: str, written: str, found: str) -> None:
        super().__init__(
            f"node {node_id}: object {entry} reads back as {found}, written was {written}; does the drive limit or "
            "round it, or is it another object?"
        )
        self.node_id = node_id
        self.entry = entry


class ParametersMixed(DriverError):
    """A write failed midway, and not every drive has its old value again."""

    def __init__(self, restored: tuple[str, ...], problems: tuple[str, ...]) -> None:
        super().__init__(
            f"the write failed midway; the old values stand again in {', '.join(restored) or 'no drive'}, and are NOT "
            f"known to stand where {'; '.join(problems)}; do not enable the axes before `drivegain rollback --drives`"
        )
        self.restored = restored
        self.problems = problems


class FeedbackDiffers(DriverError):
    """A PDO carries another value than the object that it maps, at standstill."""

    def __init__(self, node_id: int, entry: str, by_sdo: int, by_pdo: int, allowed: int) -> None:
        super().__init__(
            f"node {node_id}: object {entry} is {by_sdo} by SDO and {by_pdo} in its PDO at standstill, expected at "
            f"most {allowed} apart; another device sends with this COB-ID, or the mapping is not what it reads back as"
        )
        self.node_id = node_id
        self.entry = entry
        self.by_sdo = by_sdo
        self.by_pdo = by_pdo


class CellSilent(DriverError):
    """No axis answers any more; a stop that could not be confirmed is noted on the error."""

    def __init__(self, cycle: int, waited_s: float) -> None:
        super().__init__(
            f"cycle {cycle}: no axis answered within {waited_s:.3g} s; check the power of the cell and the bus"
        )
        self.cycle = cycle
        self.waited_s = waited_s


class PdoLengthWrong(DriverError):
    """An answer is not as long as the mapping says, twice; a stop that could not be confirmed is noted on the error."""

    def __init__(self, node_id: int, cob_id: int, expected: int, found: int) -> None:
        super().__init__(
            f"node {node_id}: PDO {cob_id:03X}h has {found} bytes, its mapping says {expected}; stopping all axes; "
            "did somebody change the mapping, or does another device use this COB-ID?"
        )
        self.node_id = node_id
        self.cob_id = cob_id
        self.expected = expected
        self.found = found


class DataFrozen(DriverError):
    """Position and current do not change while the axis is told to move."""

    def __init__(self, move: int, node_id: int, position_counts: int, current_raw: int) -> None:
        super().__init__(
            f"node {node_id}: move {move}: position {position_counts} and current {current_raw} do not change while "
            "the axis is told to move; stopping all axes; is its data frozen, its encoder or its motor cable off?"
        )
        self.move = move
        self.node_id = node_id
        self.position_counts = position_counts
        self.current_raw = current_raw


class DataStale(DriverError):
    """An amplifier's toggle bit stands; a stop that could not be confirmed is noted on the error."""

    def __init__(self, node_id: int, bit: int, unchanged_s: float, cycles: int) -> None:
        super().__init__(
            f"node {node_id}: statusword bit {bit} has not toggled for {cycles} cycles, {1e3 * unchanged_s:g} ms: it "
            "sends old values; stopping all axes; restart the drive, and check toggle_bit and update_period_us of its "
            "profile"
        )
        self.node_id = node_id
        self.bit = bit
        self.unchanged_s = unchanged_s
        self.cycles = cycles


class LimitActive(DriverError):
    """A limit of the drive acts for too long; a stop that could not be confirmed is noted on the error."""

    def __init__(self, node_id: int, acted_s: float, statusword: int) -> None:
        super().__init__(
            f"node {node_id}: a limit acts for {acted_s:g} s, statusword {statusword:#06x}; stopping all axes; "
            "check limit switches, position, speed and current limits, or use slower moves"
        )
        self.node_id = node_id
        self.acted_s = acted_s
        self.statusword = statusword


class SampleLost(DriverError):
    """A SYNC cycle had no complete answer."""

    def __init__(self, cycle: int, axes: tuple[int, ...]) -> None:
        super().__init__(f"cycle {cycle}: no answer from axis {', '.join(str(a + 1) for a in axes)}")
        self.cycle = cycle
        self.axes = axes


class DriveFault(DriverError):
    """EMCY, fault bit or following error while running; a stop that could not be confirmed is noted on the error."""

    def __init__(self, node_id: int, reason: str, statusword: int | None = None, emcy_code: int | None = None) -> None:
        super().__init__(f"node {node_id}: {reason}; stopping all axes, none is enabled again")
        self.node_id = node_id
        self.reason = reason
        self.statusword = statusword
        self.emcy_code = emcy_code


class HeartbeatLost(DriverError):
    """A node fell silent; a stop that could not be confirmed is noted on the error."""

    def __init__(self, node_id: int, silent_s: float) -> None:
        super().__init__(f"node {node_id}: no heartbeat for {silent_s:g} s; stopping all axes, none is enabled again")
        self.node_id = node_id
        self.silent_s = silent_s


class MotionRefused(DriverError):
    """Motion was asked for without permission, or outside the limits."""


class MotionTimeout(DriverError):
    """A move did not end in its bound; a stop that could not be confirmed is noted on the error."""

    def __init__(self, move: int, axes: tuple[int, ...], waited_s: float) -> None:
        super().__init__(
            f"move {move}: axis {', '.join(str(a + 1) for a in axes)} did not reach its target "
            f"within {waited_s:g} s; stopping all axes"
        )
        self.move = move
        self.axes = axes
        self.waited_s = waited_s
