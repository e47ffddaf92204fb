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
#: Frames between two looks at the clock while frames are waiting: each is a system call
LOOK_EVERY = 64


def nothing_to_send(_: int) -> Sequence[can.Message]:
    """Return no frames: see `CycleBus.spare`."""
    return ()


def is_sync(message: can.Message) -> bool:
    """Return whether a frame is a SYNC."""
    return message.arbitration_id == SYNC_COB_ID and is_plain(message)


def arrived_ns(message: can.Message, now_ns: int) -> int:
    """Return the monotonic time at which a frame arrived [ns]:
    the kernel's, or the present one without its stamp.
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
        between: processes a frame that is read before the next SYNC, and so answers none that is
            open.
    """

    def __init__(
        self,
        link: Link,
        clock: Clock,
        start_ns: int,
        emit: EventSink,
        between: Callable[[can.Message], None],
    ) -> None:
        self.link = link
        self.clock = clock
        #: What must stop a recording and was not raised yet, the oldest first.
        self.faults: deque[DriverError] = deque()
        self.emit = emit
        self.between = between
        self.cycles = 0  #: SYNCs sent, or followed
        self.skipped = 0  #: Periods without a SYNC
        #: Time of the last SYNC in the samples [ns since 1970]; the start before the first one
        self.time_ns = start_ns
        self.answered_ns = 0  #: Time of the last answer by the clock [ns], or of the first SYNC
        self.silent = False  #: Whether no axis answered the last SYNC
        #: Frames to send right before the next SYNC, which triggers synchronous RPDOs.
        self.outgoing: list[can.Message] = []
        #: Returns frames that may wait, for a cycle that has no others to send; receives the last
        #: SYNC's time [ns].
        self.spare: Callable[[int], Sequence[can.Message]] = nothing_to_send
        self._start_ns = start_ns
        self._first_sync_ns = 0
        self._sync = base_frame(SYNC_COB_ID)
        self._take_batched: Callable[[], can.Message | None] | None = None
        self._unlooked = 0
        self._reported_late = False

    def begin(self) -> None:
        """Find how the open bus is read."""
        self._take_batched = getattr(self.link.bus, "take", None)

    def report(self, axis: int | None, kind: EventKind, code: int, text: str) -> None:
        """Emit an event of an axis, or of the whole cell, at the time of the last SYNC."""
        self.emit(CellEvent(self.time_ns, axis, kind, code, text))

    def stamp(self, at_ns: int) -> None:
        """Take over the time of a SYNC by the clock [ns] as that of its cycle."""
        if self.cycles == 0:
            self._first_sync_ns = at_ns
        self.time_ns = self._start_ns + at_ns - self._first_sync_ns

    def waiting(self) -> Iterator[can.Message]:
        """Yield the frames that have arrived already; a reader that needs too long is a fault."""
        recv = self.link.bus.recv
        begun_ns = self.clock()
        while (message := recv(0.0)) is not None:
            yield message
            if self.too_late(self.clock() - begun_ns):
                return

    def read_waiting(self) -> None:
        """Process the frames that have arrived already: the next SYNC comes after them."""
        for message in self.waiting():
            self.between(message)

    def batched(self) -> can.Message | None:
        """Return a frame that was received with the one before, without a look at the clock;
        now and then None.
        """
        self._unlooked = (self._unlooked + 1) % LOOK_EVERY
        if self._take_batched is None or self._unlooked == 0:
            return None
        return self._take_batched()

    def too_late(self, behind_ns: int) -> bool:
        """Return whether the reader is too late;
        reported once, because the counters show whether frames were lost.
        """
        late = behind_ns > LARGEST_LAG_NS
        if late and not self._reported_late:
            self._reported_late = True
            remedy = "moving axes cannot be watched; reduce the load of this computer"
            reason = f"read {behind_ns * 1e-9:.1f} s late: {remedy}"
            self.faults.append(BusError(str(self.link.address), reason))
        return late

    def take_outgoing(self) -> Sequence[can.Message]:
        """Return the frames to send now, and forget them."""
        outgoing = self.outgoing
        self.outgoing = []
        return outgoing or self.spare(self.time_ns)

    def send_sync(self) -> None:
        """Send the frames that wait, and the SYNC right after them."""
        self.link.send((*self.take_outgoing(), self._sync))


class Cycles(ABC):
    """Cycles of one pacing: begins each with its SYNC, and reads its frames."""

    def __init__(self, bus: CycleBus) -> None:
        self.bus = bus
        #: SYNC of the next cycle, if it ended the last one
        self.early_sync: can.Message | None = None

    def begin(self) -> Cycles:
        """Discard the frames from before the first SYNC;
        returns the cycles that fit the open bus.
        """
        self.bus.read_waiting()
        return self

    @abstractmethod
    def open(self) -> Cycles | None:
        """Begin a cycle with its SYNC; where that SYNC comes no more,
        return the cycles that begin it instead.
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
