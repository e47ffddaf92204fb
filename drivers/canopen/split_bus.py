"""Several CAN buses that one cell is wired to, read and written as one.

A frame that carries a node id goes to the bus of that node: SDO, PDO and EMCY by the lower seven
bits of their COB-ID (CiA 301, predefined connection set), NMT by its second byte. Frames without a
node go to all buses: SYNC, NMT to all, and the heartbeat of the recorder. Received frames come in
the order of their time stamps, which all interfaces take from clocks of this computer: monotonic
where all have such stamps, else wall time. Where all have such stamps, our own SYNC comes when it
has been received from every bus: all frames that arrived on their bus before it have come by then.

A bus that fails is reported once, as a BusError with its name. The others go on, so that their axes
can be stopped and restored; the nodes of the failed bus are silent from then on.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby

import can

from drivers.canopen.bus import BusAddress, open_bus, send_burst
from drivers.canopen.socketcan import (
    CapturedMessage,
    Losses,
    losses_of,
    read_until_ns,
    receive_only,
    remarks_of,
)
from drivers.errors import BusError, NodeMisplaced, node_label

#: Time to wait at one bus while another may receive, where one of them has no file descriptor
ALTERNATION_S = 0.0005
#: Time after a time-out in which frames that are left out may still be read: a flood of them
LONGEST_LEFT_OUT_S = 0.1
#: Frames of one bus in a row while another has one too: a lagging clock must not silence the others
LARGEST_RUN = 64
BUS_OFF = 0x40  # linux/can/error.h, class CAN_ERR_BUSOFF of an error frame
BUS_OFF_REASON = "bus-off: the CAN controller disconnected itself; check the wiring"
_FAILURES = (can.CanError, OSError, BusError)
FROM_NODES = frozenset((0x080, 0x180, 0x280, 0x380, 0x480, 0x580, 0x700))
"""Services that nodes send: EMCY, TPDO1 to 4, SDO answer, heartbeat."""


@dataclass(frozen=True, slots=True)
class BusPart:
    """One of the buses of a cell."""

    name: str  #: for messages
    address: BusAddress  #: of the bus
    node_ids: frozenset[int]  #: of the amplifiers on it
    #: by node id, for messages
    axis_names: Mapping[int, str] = field(default_factory=dict, compare=False)

    def __str__(self) -> str:
        return f"{self.name} ({self.address})"


@dataclass(frozen=True, slots=True)
class SplitAddress:
    """Addresses of the buses of a cell; each node id is on one of them at most."""

    parts: tuple[BusPart, ...]

    def __str__(self) -> str:
        return " + ".join(map(str, self.parts))

    def route(self, message: can.Message) -> tuple[int, ...]:
        """Return the indices of the parts that a frame concerns: its node's, or all."""
        node_id = 0
        if not (message.is_extended_id or message.is_error_frame):
            node_id = message.arbitration_id & 0x7F
            if message.arbitration_id == 0 and len(message.data) > 1:
                node_id = message.data[1]
        for index, part in enumerate(self.parts):
            if node_id in part.node_ids:
                return (index,)
        return tuple(range(len(self.parts)))


CellAddress = BusAddress | SplitAddress  #: Address of one bus, or of several


def open_cell_bus(address: CellAddress, *, answering: bool = False) -> can.BusABC:
    """Open one end of the bus of a cell, or of every bus as one.

    Args:
        address: of the cell.
        answering: for devices that answer each frame, see `open_bus`.

    Raises:
        BusError: one cannot be opened (those before it are closed again), or two have a node id in
            common.
    """
    if isinstance(address, BusAddress):
        return open_bus(address, answering=answering)
    homes: dict[int, BusPart] = {}
    for part in address.parts:
        for node_id in part.node_ids:
            if (other := homes.setdefault(node_id, part)) is not part:
                shared = (
                    f"{node_label(node_id, part.axis_names)} is on {other.name} and on {part.name}"
                )
                raise BusError(str(address), f"{shared}; give one of the two another node id")
    ends: list[can.BusABC] = []
    for part in address.parts:
        try:
            ends.append(open_bus(part.address, answering=answering))
        except BusError as error:
            for end in ends:
                end.shutdown()
            raise BusError(str(part), error.reason) from error
    return SplitBus(address, ends)


class SplitBus(can.BusABC):
    """Ends of several buses as one, which closes them;
    ``channel`` of a received frame names its bus.

    The ends are in the order of the address; the clock, for time-outs, is monotonic [s].
    """

    def __init__(
        self,
        address: SplitAddress,
        ends: Sequence[can.BusABC],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.address = address
        self.channel_info = str(address)
        self._ends = tuple(ends)
        self._names = tuple(map(str, address.parts))
        self._homes: dict[int, int] = {}
        self._axis_names: dict[int, str] = {}
        for index, part in enumerate(address.parts):
            self._homes |= dict.fromkeys(part.node_ids, index)
            self._axis_names |= part.axis_names
        self._clock = clock
        self._waiting: list[can.Message | None] = [None] * len(self._ends)
        self._failed: set[int] = set()
        self._misplaced: set[tuple[int, int]] = set()
        self._last = self._run = self._turn = 0
        self._handles = tuple(_fileno(end) for end in self._ends)
        self._stamped = all(read_until_ns(end) is not None for end in self._ends)
        super().__init__(channel=str(address))

    @property
    def alive(self) -> bool:
        """Whether one of the buses has not failed."""
        return len(self._failed) < len(self._ends)

    @property
    def losses(self) -> Losses:
        """Losses of all buses together."""
        return Losses(*map(sum, zip(*map(losses_of, self._ends), strict=True)))

    @property
    def read_until_ns(self) -> int | None:
        """Monotonic time up to which every frame of every bus has been received;
        None where one has no stamps.
        """
        times = [
            read_until_ns(end) for index, end in enumerate(self._ends) if index not in self._failed
        ]
        known = [time_ns for time_ns in times if time_ns is not None]
        if known and len(known) == len(times):
            return min(known)
        return None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks for the operator on how each bus was opened."""
        named = zip(self._names, map(remarks_of, self._ends), strict=True)
        found = []
        for name, remarks in named:
            for remark in remarks:
                found.append(f"{name}: {remark}")
        return tuple(found)

    def receive_only(self, wanted: Sequence[tuple[int, int]]) -> None:
        """Let the kernel discard other frames of every bus."""
        for end in self._ends:
            receive_only(end, wanted)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """As `send_burst`, with one frame."""
        self.send_burst((msg,))

    def send_burst(self, messages: Sequence[can.Message]) -> None:
        """Send several frames in their order; consecutive frames of one bus go there in one call.

        A frame for all buses goes to one right after the other, when everything before it has been
        sent: this keeps the SYNCs close together. A bus that fails raises BusError after the others
        got their frames.
        """
        failures: list[BusError] = []
        for route, run in groupby(messages, self.address.route):
            together = tuple(run)
            for burst in (together,) if len(route) == 1 else ((message,) for message in together):
                for index in route:
                    if index in self._failed:
                        continue
                    try:
                        send_burst(self._ends[index], burst)
                    except _FAILURES as error:
                        failures.append(self._failure(index, error))
        if failures:
            raise failures[0]
        self._require_one()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the oldest frame that waits on any of the buses.

        Raises:
            BusError: one of the buses has just failed, or went off; or all have failed.
            NodeMisplaced: a node is heard on another bus than its own; raised once, its frames
                there are left out.
        """
        end_s = None if timeout is None else self._clock() + timeout
        while True:
            for index, head in enumerate(self._waiting):
                if head is None and index not in self._failed:
                    self._waiting[index] = self._take(index, 0.0)
            oldest = self._oldest()
            if oldest is not None:
                message = self._waiting[oldest]
                self._waiting[oldest] = None
                if message is not None and self._belongs(message, oldest):
                    return message
                if end_s is not None and self._clock() > end_s + LONGEST_LEFT_OUT_S:
                    return None
                continue  # an end may hold more frames without a ready file descriptor
            left_s = None if end_s is None else end_s - self._clock()
            if left_s is not None and left_s <= 0:
                return None
            self._require_one()
            self._wait(left_s)

    def _take(self, index: int, timeout_s: float) -> can.Message | None:
        try:
            message = self._ends[index].recv(timeout_s)
        except _FAILURES as error:
            raise self._failure(index, error) from error
        if message is None:
            return None
        if message.is_error_frame and message.arbitration_id & BUS_OFF:
            raise self._failure(index, BusError(self._names[index], BUS_OFF_REASON))
        message.channel = self._names[index]
        return message

    def _oldest(self) -> int | None:
        """Return the bus of the oldest waiting frame;
        None where there is none, or only our SYNC of some buses.
        """
        waiting = [
            (message, index) for index, message in enumerate(self._waiting) if message is not None
        ]
        if self._stamped:
            received = [(message, index) for message, index in waiting if message.is_rx]
            if waiting and not received and len(waiting) == len(self._ends) - len(self._failed):
                first = waiting[0][1]
                self._waiting = [
                    head if index == first else None for index, head in enumerate(self._waiting)
                ]
                return first
            waiting = received
        # The wall clock can be set between two frames, and a float of its seconds has steps of 200
        # ns.
        heads: list[tuple[float, int]] = [
            (m.monotonic_ns, index) for m, index in waiting if isinstance(m, CapturedMessage)
        ]
        if len(heads) < len(waiting):
            heads = [(message.timestamp, index) for message, index in waiting]
        if not heads:
            return None
        if len(heads) > 1 and self._run >= LARGEST_RUN:
            heads = [head for head in heads if head[1] != self._last]
        _, index = min(heads)
        self._run = self._run + 1 if index == self._last else 1
        self._last = index
        return index

    def _belongs(self, message: can.Message, index: int) -> bool:
        """Whether a frame comes from the bus of its node;
        our own SYNC, received for its time, from the first bus.
        """
        if not message.is_rx:
            return index == min(set(range(len(self._ends))) - self._failed, default=index)
        if (
            message.is_extended_id
            or message.is_error_frame
            or message.arbitration_id & 0x780 not in FROM_NODES
        ):
            return True
        node_id = message.arbitration_id & 0x7F
        home = self._homes.get(node_id, index)
        if home != index and (node_id, index) not in self._misplaced:
            self._misplaced.add((node_id, index))
            raise NodeMisplaced(
                node_id, self._names[home], self._names[index], self._axis_names.get(node_id, "")
            )
        return home == index

    def _wait(self, left_s: float | None) -> None:
        """Wait until a frame comes on one of the buses, or the time is over."""
        live = [n for n, head in enumerate(self._waiting) if head is None and n not in self._failed]
        handles = [handle for index in live if (handle := self._handles[index]) is not None]
        if len(handles) == len(live):
            select.select(handles, (), (), left_s)
            return
        self._turn += 1
        index = live[self._turn % len(live)]
        if left_s is None or len(live) > 1:
            timeout_s = ALTERNATION_S
        else:
            timeout_s = left_s
        self._waiting[index] = self._take(
            index, timeout_s if left_s is None else min(left_s, timeout_s)
        )

    def _failure(self, index: int, error: Exception) -> BusError:
        """Leave this bus out from now on."""
        self._failed.add(index)
        if (head := self._waiting[index]) is not None and not head.is_rx:
            self._waiting[index] = None
        if isinstance(error, BusError):
            reason = error.reason
        else:
            reason = str(error) or type(error).__name__
        failure = BusError(self._names[index], reason)
        failure.__cause__ = error
        return failure

    def _require_one(self) -> None:
        if not self.alive:
            raise BusError(self.channel_info, "all of them have failed")

    def shutdown(self) -> None:
        """Close all ends, also after a failure."""
        if self._is_shutdown:
            return
        super().shutdown()
        failures = []
        for index, end in enumerate(self._ends):
            try:
                end.shutdown()
            except _FAILURES as error:
                failures.append(self._failure(index, error))
        if failures:
            raise failures[0]


def _fileno(end: can.BusABC) -> int | None:
    try:
        handle = end.fileno()
    except (NotImplementedError, OSError):
        return None
    return handle if handle >= 0 else None
