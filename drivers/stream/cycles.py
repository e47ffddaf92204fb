"""Cycles of a stream: one SYNC each, and the frames until the next.

Each pacing has its own in sync.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence

import can

from drivers.canopen.bus import base_frame, is_plain
from drivers.canopen.link import SYNC_COB_ID, Link
from drivers.canopen.sdo import Clock
from drivers.canopen.socketcan import CapturedMessage
from drivers.errors import BusError, DriverError
from drivers.messages import CellEvent, EventKind, EventSink

#: Largest delay of the reader behind the bus; older data cannot protect moving axes
LARGEST_LAG_NS = 1_000_000_000
#: Frames that are read in a row without the clock: to read it is a system call
FRAMES_PER_CLOCK_CHECK = 64


def nothing_to_send(_: int) -> Sequence[can.Message]:
    """Return no frames: see `CycleBus.low_priority`."""
    return ()


def is_sync(message: can.Message) -> bool:
    """Return whether a frame is a SYNC."""
    return message.arbitration_id == SYNC_COB_ID and is_plain(message)


def arrived_ns(message: can.Message, now_ns: int) -> int:
    """Return the monotonic time at which a frame arrived [ns].

    It is the kernel's stamp, or `now_ns` for a frame without one.
    """
    if isinstance(message, CapturedMessage):
        return message.monotonic_ns
    return now_ns


class CycleBus:
    """The bus as the cycles of a stream use it:
    frames that arrive, frames to send, and the count of the cycles.

    Args:
        link: its bus is open once the stream begins.
        clock: monotonic [ns].
        start_ns: time of the first SYNC in the samples [ns since 1970].
        emit: receives events.
        process_between: processes a frame that is read after a cycle has ended and before the
            next SYNC.
    """

    def __init__(
        self,
        link: Link,
        clock: Clock,
        start_ns: int,
        emit: EventSink,
        process_between: Callable[[can.Message], None],
    ) -> None:
        self.link = link
        self.clock = clock
        #: Errors that must stop a recording and were not raised yet, the oldest first
        self.faults: deque[DriverError] = deque()
        self.emit = emit
        self.process_between = process_between
        #: SYNCs sent, or followed
        self.cycles = 0
        #: Periods without a SYNC
        self.skipped = 0
        #: Time of the last SYNC in the samples [ns since 1970]; the start before the first one
        self.time_ns = start_ns
        #: Time of the last answer by the clock [ns]; before the first one, that of the first SYNC
        self.answered_ns = 0
        #: Whether no axis answered the last SYNC
        self.silent = False
        #: Frames that are sent before the next SYNC, which triggers synchronous RPDOs.
        self.outgoing: list[can.Message] = []
        #: Returns frames that are sent only where `outgoing` is empty; takes the last SYNC's time
        #: [ns since 1970].
        self.low_priority: Callable[[int], Sequence[can.Message]] = nothing_to_send
        self._start_ns = start_ns
        self._first_sync_ns = 0
        self._sync = base_frame(SYNC_COB_ID)
        self._take_received: Callable[[], can.Message | None] | None = None
        self._frames_since_clock = 0
        self._reported_late = False

    def begin(self) -> None:
        """Use `BurstBus.take` of the open bus, where it has that."""
        self._take_received = getattr(self.link.bus, "take", None)

    def report(self, axis: int | None, kind: EventKind, code: int, text: str) -> None:
        """Emit an event of an axis, or of the whole cell, at the time of the last SYNC."""
        self.emit(CellEvent(self.time_ns, axis, kind, code, text))

    def stamp(self, at_ns: int) -> None:
        """Take over the time of a SYNC by the clock [ns] as that of its cycle."""
        if self.cycles == 0:
            self._first_sync_ns = at_ns
        self.time_ns = self._start_ns + at_ns - self._first_sync_ns

    def arrived_frames(self) -> Iterator[can.Message]:
        """Yield the frames that have arrived already.

        To read them for longer than `LARGEST_LAG_NS` is a fault.
        """
        recv = self.link.bus.recv
        begun_ns = self.clock()
        while (message := recv(0.0)) is not None:
            yield message
            reading_ns = self.clock() - begun_ns
            if self.check_lag(reading_ns):
                return

    def read_waiting(self) -> None:
        """Process the frames that have arrived already: the next SYNC comes after them."""
        for message in self.arrived_frames():
            self.process_between(message)

    def next_of_burst(self) -> can.Message | None:
        """Return a frame that the bus has received already.

        None where there is none, and for every `FRAMES_PER_CLOCK_CHECK`-th call: the caller then
        reads the clock, and sends SYNC and heartbeat if they are due.
        """
        self._frames_since_clock = (self._frames_since_clock + 1) % FRAMES_PER_CLOCK_CHECK
        if self._take_received is None or self._frames_since_clock == 0:
            return None
        return self._take_received()

    def check_lag(self, behind_ns: int) -> bool:
        """Return whether the reader is more than `LARGEST_LAG_NS` behind the bus.

        The first time adds a fault. It does not say that frames were lost: those are counted.
        """
        is_late = behind_ns > LARGEST_LAG_NS
        if is_late and not self._reported_late:
            self._reported_late = True
            remedy = "moving axes cannot be watched; reduce the load of this computer"
            reason = f"read {behind_ns * 1e-9:.1f} s late: {remedy}"
            self.faults.append(BusError(str(self.link.address), reason))
        return is_late

    def take_outgoing(self) -> Sequence[can.Message]:
        """Return the frames to send now, and remove them from `outgoing`."""
        outgoing = self.outgoing
        self.outgoing = []
        if outgoing:
            return outgoing
        return self.low_priority(self.time_ns)

    def send_sync(self) -> None:
        """Send the frames that wait, and the SYNC right after them."""
        self.link.send((*self.take_outgoing(), self._sync))


class Cycles(ABC):
    """Cycles of one pacing: begins each with its SYNC, and reads its frames."""

    def __init__(self, bus: CycleBus) -> None:
        self.bus = bus
        #: SYNC of the next cycle, where it has been read: its arrival ended the last cycle
        self.early_sync: can.Message | None = None

    def begin(self) -> Cycles:
        """Discard the frames from before the first SYNC.

        Returns:
            the cycles to use: these, or others that fit the open bus better.
        """
        self.bus.read_waiting()
        return self

    @abstractmethod
    def open(self) -> Cycles | None:
        """Begin a cycle with its SYNC.

        Returns:
            None once the cycle is begun; where no SYNC comes any more, other cycles, whose `open`
            must be called instead.
        """

    @abstractmethod
    def next_frame(self) -> can.Message | None:
        """Return the next frame of this cycle; None at its end."""

    def note_first_answer(self) -> None:  # noqa: B027 - most pacings do not wait for answers
        """Note that an axis has answered, the first one in this cycle."""

    def is_next_sync(self, message: can.Message) -> bool:
        """Return whether a frame is a SYNC of these cycles: our own, which came back."""
        return is_sync(message) and not message.is_rx

    def stop(self) -> None:  # noqa: B027 - most pacings send SYNC themselves
        """Stop the SYNC after the last cycle, where another device sends it."""
