"""Everything that can go wrong between a bus and a sample.

Each class has a caller that treats it differently.

DriverError
├── BusError                  the bus cannot be opened, or is lost
├── BusBusy                   another master, or another device with the recorder's node id, uses the bus
├── NodeMissing               configured nodes do not answer
├── NodeMisplaced             a node is heard on another bus than its own
├── NodeError                 one amplifier; carries `node_id` and `reason`
│   ├── ObjectAccessError     an SDO transfer was aborted or timed out
│   ├── SetupRefused          identity, PDO mapping, current scale or feedback is not as expected
│   ├── StateRefused          an NMT or CiA 402 state was not reached
│   ├── ParameterRefused      a parameter was not written, not saved, or reads back differently
│   └── DriveFault            EMCY, fault bit, lost heartbeat, limit, stale or malformed data while running
├── ParametersMixed           a write failed midway, and not every drive has its previous value again
├── SampleLost                a SYNC cycle had no complete answer
├── MotionRefused             motion without permission, or outside the limits
└── MotionTimeout             a move did not end in time

Where an error ends a motion, each part of the stop that could not be confirmed is attached to it as
a note.
"""  # noqa: E501

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Protocol

#: Prefix of the notes that report what a stop, or the closing of a network, could not confirm
WHILE = "while "
#: Prefix of the note that names the axes which had power and may still have
POWERED = "not confirmed without power: "


def error_chain(error: BaseException | None) -> tuple[BaseException, ...]:
    """Return an error and all errors behind it, nearest first:
    causes, and errors that were being handled.

    Each is there once, also where the errors form a cycle. They are compared by identity, because
    `==` between foreign errors may raise: that of canopen's SdoAbortedError does, with any error
    without an abort code.
    """
    chain: dict[int, BaseException] = {}  # by identity
    to_visit = [error]
    while to_visit:
        nearest = to_visit.pop(0)
        if nearest is not None and id(nearest) not in chain:
            chain[id(nearest)] = nearest
            to_visit += [nearest.__cause__, nearest.__context__]
    return tuple(chain.values())


def text_of(error: BaseException) -> str:
    """Return the text of an error; empty where it has none, or where its `__str__` raises."""
    with suppress(Exception):
        return str(error)
    return ""


def all_notes(error: BaseException | None) -> tuple[str, ...]:
    """Return the notes of an error, and of all errors behind it, each once.

    An error that comes later, such as that of a full disk, does not carry the notes of the one that
    it hides.
    """
    notes: dict[str, None] = {}  # keys alone: an ordered set
    for link in error_chain(error):
        for note in getattr(link, "__notes__", ()):
            notes[note] = None
    return tuple(notes)


def stop_notes(error: BaseException | None) -> tuple[str, ...]:
    """Return the notes of `all_notes` on what a stop or a closing network could not confirm."""
    return tuple(note for note in all_notes(error) if note.startswith((WHILE, POWERED)))


class NamedNode(Protocol):
    """Anything with a CANopen node id and the name of its axis, such as an Axis;
    the name may be empty.
    """

    @property
    def node_id(self) -> int: ...

    @property
    def name(self) -> str: ...


#: Node in a message: its node id, or its axis
Node = int | NamedNode


def node_label(node: Node, names: Mapping[int, str] | None = None) -> str:
    """Name a node in a message: "J3 (node 3)", or "node 3" where the axis is not known.

    Args:
        node: node id or axis.
        names: names of the axes by node id, for a node id.
    """
    node_id = _node_id_of(node)
    if not isinstance(node, int):
        name = node.name
    elif names is not None:
        name = names.get(node_id, "")
    else:
        name = ""
    if not name:
        return f"node {node_id}"
    return f"{name} (node {node_id})"


def _node_id_of(node: Node) -> int:
    if isinstance(node, int):
        return node
    return node.node_id


class DriverError(Exception):
    """Root of the tree; carries the evidence as attributes and in its message."""

    def __reduce__(self) -> tuple[object, ...]:
        # `args` holds the message, not the arguments of `__init__`: without this the error cannot
        # leave a process.
        return type(self).__new__, (type(self), *self.args), self.__dict__


class BusError(DriverError):
    """The bus cannot be opened, or is lost."""

    def __init__(self, address: str, reason: str) -> None:
        super().__init__(f"bus {address}: {reason}")
        self.address = address
        self.reason = reason


class BusBusy(DriverError):
    """Another device commands this bus, or sends the recorder's heartbeat:
    two masters would move one robot.
    """

    def __init__(self, address: str, found: str, expected: str, remedy: str) -> None:
        super().__init__(f"bus {address}: found {found}; expected {expected}; {remedy}")
        self.address = address
        self.found = found

    @classmethod
    def by_master(cls, address: object, seen: str) -> BusBusy:
        """Report frames that only this recorder should send."""
        return cls(
            str(address),
            f"{seen} that we did not send",
            "no other master, recorder or SYNC producer",
            "end the other program first",
        )

    @classmethod
    def by_own_id(cls, address: object, identifier: int) -> BusBusy:
        """Report a device with the recorder's node id.

        The drives would take its heartbeat for the recorder's, and go on if the recorder dies.
        """
        if identifier >= 0x700:
            frame = "heartbeat"
        else:
            frame = "frame"
        return cls(
            str(address),
            f"a {frame} {identifier:03X}h of another device, which has node id "
            f"{identifier & 0x7F} too",
            "an id that only the recorder uses",
            "the axes are stopped; give that device another node id, or record again: the recorder "
            "then takes another",
        )


class NodeMissing(DriverError):
    """Configured nodes do not answer."""

    def __init__(self, nodes: Sequence[Node], found: tuple[int, ...], waited_s: float) -> None:
        silent = ", ".join(map(node_label, nodes))
        answered = ", ".join(map(str, found)) or "none"
        super().__init__(
            f"{silent} did not answer within {waited_s:g} s (answered: {answered}); check power, "
            "wiring, bit rate and node id; a drive that was switched on just now answers once it "
            "has booted: try again then"
        )
        self.node_ids = tuple(map(_node_id_of, nodes))
        self.found = found


class NodeMisplaced(DriverError):
    """A node is heard on another bus than its own."""

    def __init__(self, node_id: int, expected: str, found: str, axis: str = "") -> None:
        node = node_label(node_id, {node_id: axis})
        super().__init__(
            f"{node} is heard on bus {found}, the cell "
            f"configuration has it on bus {expected}: it is wired to the other bus, two amplifiers "
            "have that node id, or both CAN interfaces are on one wire; `drivers.scan` shows the "
            "nodes of each bus"
        )
        self.node_id = node_id
        self.expected = expected
        self.found = found


class NodeError(DriverError):
    """One amplifier is not as expected; the reason has what was found,
    what was expected and what to do.
    """

    def __init__(self, node: Node, reason: str) -> None:
        super().__init__(f"{node_label(node)}: {reason}")
        self.node_id = _node_id_of(node)
        self.reason = reason


class ObjectAccessError(NodeError):
    """An SDO transfer was aborted or timed out; `abort_code` is None where no answer came."""

    def __init__(self, node: Node, entry: str, reason: str, abort_code: int | None = None) -> None:
        super().__init__(node, f"object {entry}: {reason}")
        self.entry = entry
        self.reason = reason
        self.abort_code = abort_code


def _with_remedy(found: str, expected: str, remedy: str) -> str:
    """Return "FOUND; expected EXPECTED; REMEDY", or "FOUND" alone where the remedy is empty."""
    if not remedy:
        return found
    return f"{found}; expected {expected}; {remedy}"


class SetupRefused(NodeError):
    """An amplifier is not the configured one, or cannot be set up for a recording.

    Where `expected` and `remedy` are empty, `found` is the complete text.
    """

    expected: str = ""
    remedy: str = ""

    def __init__(self, node: Node, found: str, *, expected: str = "", remedy: str = "") -> None:
        super().__init__(node, _with_remedy(found, expected, remedy))
        self.found = f"{node_label(node)}: {found}"
        self.expected = expected
        self.remedy = remedy


class StateRefused(NodeError):
    """An NMT state (no statusword) or a CiA 402 state was not reached in time.

    Args:
        node: that did not reach it.
        asked: the state.
        found: its state.
        statusword: that says so; None for an NMT state.
        remedy: in place of the usual one.
        reported: error that the node has reported (EMCY); empty without one.
    """

    def __init__(
        self,
        node: Node,
        asked: str,
        found: str,
        statusword: int | None = None,
        *,
        remedy: str | None = None,
        reported: str = "",
    ) -> None:
        if statusword is None:
            evidence = f"its heartbeat still says {found}"
            usual_remedy = "read its error register 1001h"
        else:
            evidence = f"statusword {statusword:#06x} says {found}"
            usual_remedy = "check the power stage, the safety chain (STO) and the fault memory"
        if reported:
            evidence = f"{evidence} after {reported}"
        super().__init__(node, f"asked for {asked}, {evidence}; {remedy or usual_remedy}")
        self.asked = asked
        self.found = found
        self.statusword = statusword
        self.reported = reported


class ParameterRefused(NodeError):
    """A parameter was not written, not saved, or reads back as another value."""


class ParametersMixed(DriverError):
    """A write failed midway, and not every drive has its previous value again."""

    def __init__(self, restored: tuple[str, ...], problems: tuple[str, ...]) -> None:
        drives = ", ".join(restored) or "no drive"
        listed = "; ".join(problems)
        super().__init__(
            "the write failed midway; the previous values are restored in "
            f"{drives}, and NOT confirmed where {listed}; "
            "do not enable an axis before every drive has its previous value again"
        )
        self.restored = restored
        self.problems = problems


class DriveFault(NodeError):
    """A drive reported a fault, fell silent or sent unusable data while running."""

    def __init__(
        self,
        node: Node,
        reason: str,
        statusword: int | None = None,
        emcy_code: int | None = None,
        remedy: str = "",
    ) -> None:
        text = f"{reason}; stopping all axes, none is enabled again"
        if remedy:
            text = f"{text}; {remedy}"
        super().__init__(node, text)
        self.reason = reason
        self.statusword = statusword
        self.emcy_code = emcy_code
        self.remedy = remedy


class SampleLost(DriverError):
    """A SYNC cycle had no complete answer.

    Args:
        cycle: number of the cycle.
        axes: indices of the axes without a complete answer.
        names: of these axes.
        silent_s: time since the last answer of any axis [s]; None where some axis still answers.
        reported: error that each of these axes has reported before (EMCY); empty without one.
    """

    def __init__(
        self,
        cycle: int,
        axes: tuple[int, ...],
        names: Sequence[str],
        silent_s: float | None = None,
        reported: Sequence[str] = (),
    ) -> None:
        if silent_s is None:
            text = f"no answer from {', '.join(names)}"
        else:
            text = (
                f"no axis answered within {silent_s:.3g} s; check the power of the cell and the bus"
            )
        for name, error in zip(names, reported, strict=False):
            if error and len(names) == 1:
                text = f"{text}; it had reported {error}"
            elif error:
                text = f"{text}; {name} had reported {error}"
        super().__init__(f"cycle {cycle}: {text}")
        self.cycle = cycle
        self.axes = axes
        self.reported = tuple(reported)


class MotionRefused(DriverError):
    """Motion was requested without permission, or outside the limits.

    Where `expected` and `remedy` are empty, `found` is the complete text.
    """

    def __init__(self, found: str, *, expected: str = "", remedy: str = "") -> None:
        text = found
        if remedy:
            text = f"found {found}"
        super().__init__(_with_remedy(text, expected, remedy))
        self.found = found
        self.expected = expected
        self.remedy = remedy


class MotionTimeout(DriverError):
    """A move did not end in time.

    Args:
        move: number of the move.
        axes: indices of the axes that did not end it.
        nodes: of these axes.
        waited_s: [s].
        acknowledge: value of statusword bit 12 (set-point acknowledge, CiA 402) that was awaited
            and did not come; None where the axes did not reach the target.
        other_master: evidence of another master on the bus; empty where there is none.
    """

    def __init__(
        self,
        move: int,
        axes: tuple[int, ...],
        nodes: Sequence[Node],
        waited_s: float,
        acknowledge: int | None = None,
        other_master: str = "",
    ) -> None:
        names = ", ".join(map(node_label, nodes))
        if acknowledge is None:
            found = "did not reach the target"
            remedy = "check brakes and limits, or use slower moves"
        elif acknowledge:
            found = "did not set statusword bit 12 (set-point acknowledge)"
            remedy = (
                "check that the drive is in profile position mode (6061h = 1) and accepts "
                "set-points by RPDO"
            )
        else:
            found = "did not clear statusword bit 12 (set-point acknowledge)"
            remedy = (
                "the drive still works on an earlier set-point: check that it is in profile "
                "position mode (6061h = 1) and that nothing else gives it set-points; switch it "
                "off and on"
            )
        if other_master:
            found = f"{found}, and {other_master},"
            remedy = f"end the other program first; else {remedy}"
        super().__init__(
            f"move {move}: {names} {found} within {waited_s:g} s; stopping all axes; {remedy}"
        )
        self.move = move
        self.axes = axes
