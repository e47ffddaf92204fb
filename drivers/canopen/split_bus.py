"""Several CAN buses that one cell is wired to, read and written as one.

A frame that carries a node id goes to the bus of that node: SDO, PDO and EMCY by the lower seven
bits of their COB-ID (CiA 301, predefined connection set), NMT by its second byte. Frames without a
node go to all buses: SYNC, NMT to all, and the heartbeat of the recorder.

Received frames that wait on several buses come in the order of their time stamps, which all
interfaces take from clocks of this computer: monotonic where all have such stamps, else wall time.
Where all have monotonic stamps, our own SYNC is returned once every bus has given it back. So every
frame that came before the SYNC on its bus is returned before the SYNC.

A bus that fails is reported once, as a BusError with its name; buses that fail while one burst is
sent, as one BusError with all their names. The others go on, so that their axes can be stopped and
restored; the nodes of the failed bus are silent from then on.
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
#: Time after a time-out in which frames are still read that are left out, such as those of a node
#: on a wrong bus; a flood of them must not keep the reader
LONGEST_LEFT_OUT_S = 0.1
#: Most frames of one bus in a row while another has one too. Where the clock of a bus lags, all its
#: frames are older than those of the others, which would not be read.
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
    part_of_node: dict[int, BusPart] = {}  # by node id
    for part in address.parts:
        for node_id in part.node_ids:
            other = part_of_node.setdefault(node_id, part)
            if other is not part:
                label = node_label(node_id, part.axis_names)
                shared = f"{label} is on {other.name} and on {part.name}"
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
        self._homes: dict[int, int] = {}  # index of the bus of each node, by its id
        self._axis_names: dict[int, str] = {}
        for index, part in enumerate(address.parts):
            self._homes |= dict.fromkeys(part.node_ids, index)
            self._axis_names |= part.axis_names
        self._clock = clock
        # The next frame of each bus, taken from its end and not returned yet
        self._waiting: list[can.Message | None] = [None] * len(self._ends)
        self._failed: set[int] = set()  # indices of the buses
        self._misplaced: set[tuple[int, int]] = set()  # node and bus, those raised already
        self._last_bus = 0  # of the last frame
        self._frames_in_a_row = 0  # of that bus
        # Number of waits at a single bus, where one of them has no file descriptor: the buses take
        # turns
        self._waits = 0
        self._handles = tuple(_fileno(end) for end in self._ends)  # file descriptors
        # Whether all have monotonic stamps
        self._stamped = all(read_until_ns(end) is not None for end in self._ends)
        super().__init__(channel=str(address))

    @property
    def alive(self) -> bool:
        """Whether at least one of the buses still works."""
        return len(self._failed) < len(self._ends)

    @property
    def losses(self) -> Losses:
        """Losses of all buses together."""
        kernel = 0
        interface = 0
        backlog = 0
        for end in self._ends:
            losses = losses_of(end)
            kernel += losses.kernel
            interface += losses.interface
            backlog += losses.backlog
        return Losses(kernel, interface, backlog)

    @property
    def read_until_ns(self) -> int | None:
        """Monotonic time up to which every frame of every bus has been received;
        None where one has no stamps.
        """
        times_ns: list[int] = []
        for index, end in enumerate(self._ends):
            if index in self._failed:
                continue
            time_ns = read_until_ns(end)
            if time_ns is None:
                return None
            times_ns.append(time_ns)
        return min(times_ns, default=None)

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks for the operator on how each bus was opened."""
        found = []
        for name, end in zip(self._names, self._ends, strict=True):
            for remark in remarks_of(end):
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
        sent: this keeps the SYNCs close together. Buses that fail raise one BusError with all their
        names, after the others got their frames.
        """
        failures: list[BusError] = []
        for route, group in groupby(messages, self.address.route):
            frames = tuple(group)
            if len(route) == 1:
                failures += self._send_to(route, frames)
            else:
                for frame in frames:
                    failures += self._send_to(route, (frame,))
        if failures:
            raise _joined(failures)
        self._require_one()

    def _send_to(self, route: Sequence[int], frames: Sequence[can.Message]) -> list[BusError]:
        """Send frames to the buses of these indices that still work; return the new failures."""
        failures = []
        for index in route:
            if index in self._failed:
                continue
            try:
                send_burst(self._ends[index], frames)
            except _FAILURES as error:
                failures.append(self._fail(index, error))
        return failures

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the oldest frame that waits on any of the buses; None if none comes in time.

        Raises:
            BusError: one of the buses has just failed, or went off; or all have failed.
            NodeMisplaced: a node is heard on another bus than its own; raised once, its frames
                there are left out.
        """
        end_s = None if timeout is None else self._clock() + timeout
        while True:
            for index in self._buses_without_frame():
                self._waiting[index] = self._take(index, 0.0)
            oldest = self._oldest()
            if oldest is not None:
                message = self._waiting[oldest]
                self._waiting[oldest] = None
                if message is not None and self._belongs(message, oldest):
                    return message
                if end_s is not None and self._clock() > end_s + LONGEST_LEFT_OUT_S:
                    return None
                # The end may hold another frame, which its file descriptor does not show.
                continue
            left_s = None if end_s is None else end_s - self._clock()
            if left_s is not None and left_s <= 0:
                return None
            self._require_one()
            self._wait(left_s)

    def _buses_without_frame(self) -> list[int]:
        """Return the indices of the buses that still work and have no frame in `_waiting`."""
        found = []
        for index, waiting in enumerate(self._waiting):
            if waiting is None and index not in self._failed:
                found.append(index)
        return found

    def _take(self, index: int, timeout_s: float) -> can.Message | None:
        """Return the next frame of one bus; its ``channel`` names that bus."""
        try:
            message = self._ends[index].recv(timeout_s)
        except _FAILURES as error:
            raise self._fail(index, error) from error
        if message is None:
            return None
        if message.is_error_frame and message.arbitration_id & BUS_OFF:
            raise self._fail(index, BusError(self._names[index], BUS_OFF_REASON))
        message.channel = self._names[index]
        return message

    def _oldest(self) -> int | None:
        """Return the bus of the oldest waiting frame; None where no frame may be returned yet.

        With stamps, our own SYNC waits until it has come back from every bus that works. Then it is
        returned once, and those of the other buses are discarded.
        """
        waiting: list[tuple[can.Message, int]] = []
        for index, message in enumerate(self._waiting):
            if message is not None:
                waiting.append((message, index))
        if self._stamped:
            received = [(message, index) for message, index in waiting if message.is_rx]
            working = len(self._ends) - len(self._failed)
            if waiting and not received and len(waiting) == working:
                # Every bus has given our SYNC back.
                _, first = waiting[0]
                for _, index in waiting[1:]:
                    self._waiting[index] = None
                return first
            waiting = received
        if not waiting:
            return None
        times = _arrival_times(waiting)
        if len(times) > 1 and self._frames_in_a_row >= LARGEST_RUN:
            times = [(stamp, index) for stamp, index in times if index != self._last_bus]
        _, oldest = min(times)
        if oldest == self._last_bus:
            self._frames_in_a_row += 1
        else:
            self._frames_in_a_row = 1
        self._last_bus = oldest
        return oldest

    def _belongs(self, message: can.Message, index: int) -> bool:
        """Whether a frame comes from the bus of its node;
        our own SYNC, received for its time, from the first bus.
        """
        if not message.is_rx:
            working = set(range(len(self._ends))) - self._failed
            return index == min(working, default=index)
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
            axis_name = self._axis_names.get(node_id, "")
            raise NodeMisplaced(node_id, self._names[home], self._names[index], axis_name)
        return home == index

    def _wait(self, left_s: float | None) -> None:
        """Wait until a frame comes on one of the buses, or the time is over."""
        buses = self._buses_without_frame()
        handles: list[int] = []
        for index in buses:
            handle = self._handles[index]
            if handle is not None:
                handles.append(handle)
        if len(handles) == len(buses):
            select.select(handles, (), (), left_s)
            return
        # The buses in turn, each for a moment; a single one for the time that is left.
        self._waits += 1
        index = buses[self._waits % len(buses)]
        if left_s is None:
            timeout_s = ALTERNATION_S
        elif len(buses) > 1:
            timeout_s = min(left_s, ALTERNATION_S)
        else:
            timeout_s = left_s
        self._waiting[index] = self._take(index, timeout_s)

    def _fail(self, index: int, error: Exception) -> BusError:
        """Leave a bus out from now on, and return its failure with its name.

        Our SYNC that it gave back is dropped: those of the other buses do not wait for it.
        """
        self._failed.add(index)
        waiting = self._waiting[index]
        if waiting is not None and not waiting.is_rx:
            self._waiting[index] = None
        if isinstance(error, BusError):
            reason = error.reason
        else:
            reason = str(error) or type(error).__name__
        failure = BusError(self._names[index], reason)
        failure.__cause__ = error
        return failure

    def _require_one(self) -> None:
        """Raise BusError where all buses have failed."""
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
                failures.append(self._fail(index, error))
        if failures:
            raise _joined(failures)


def _joined(failures: Sequence[BusError]) -> BusError:
    """Return one error with the names and reasons of all buses that failed."""
    first, *others = failures
    if not others:
        return first
    reason = "; ".join([first.reason, *map(str, others)])
    joined = BusError(first.address, reason)
    joined.__cause__ = first.__cause__
    return joined


def _arrival_times(waiting: Sequence[tuple[can.Message, int]]) -> list[tuple[float, int]]:
    """Return the time of each frame, with the index of its bus.

    It is monotonic [ns] where all frames have such stamps: the wall clock can be set between two
    frames, and a float of its seconds has steps of 200 ns. Else it is wall time [s].
    """
    stamps: list[tuple[float, int]] = []
    for message, index in waiting:
        if isinstance(message, CapturedMessage):
            stamps.append((message.monotonic_ns, index))
    if len(stamps) == len(waiting):
        return stamps
    return [(message.timestamp, index) for message, index in waiting]


def _fileno(end: can.BusABC) -> int | None:
    """Return the file descriptor to wait at; None where a bus has none."""
    try:
        handle = end.fileno()
    except (NotImplementedError, OSError):
        return None
    return handle if handle >= 0 else None
