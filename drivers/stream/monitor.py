"""Watch a cell without changing it: reports of its axes, their rate, and the load of the bus.

While another master is on the bus, nothing is sent: its SYNC and the answers in our mapping are
overheard, each cycle a `Sample`. On a quiet bus the axes are read by SDO uploads, one open request
a node; then a sample has the last values of all axes, every READING_S. Nothing is ever written.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import can

from drivers.canopen.bus import bus_errors, is_plain
from drivers.canopen.link import SYNC_COB_ID, Link
from drivers.canopen.pdo import feedback_entries
from drivers.canopen.sdo import SDO_ANSWER, SDO_REQUEST, upload_answer, upload_request
from drivers.canopen.split_bus import FROM_NODES, SplitAddress
from drivers.messages import CellEvent, Sample
from drivers.profiles.cia402 import FAULTY, decode
from drivers.profiles.profile import Axis, ObjectEntry
from drivers.stream.answers import slots_of

QUIET_S = 2.0  #: Silence of other masters after which the axes are read by SDO
#: Time allowed for an answer; CiA 301 sets no limit, and drives answer within milliseconds
ANSWER_S = 0.3
ABANDONED_S = 1.0  #: A request without an answer for so long is lost, and the axis is asked anew
#: Time between two SDO readings of an axis: six axes then load a bus of 1 Mbit/s by some 5 %
READING_S = 0.1


class ReadingSource(Enum):
    """Origin of the readings."""

    OVERHEARD = "overheard"
    ASKED = "asked"


@dataclass(frozen=True, slots=True)
class ObjectRefusal:
    """Answer without the value of an object."""

    entry: ObjectEntry  #: the object
    abort_code: int | None  #: of the SDO abort; None for an answer that is no value of this size


@dataclass(frozen=True, slots=True)
class AxisReading:
    """Reading of one axis."""

    position_counts: int | None  #: last value, None before the first
    current_raw: int | None  #: last value, None before the first
    statusword: int | None  #: last value, None before the first
    nmt: int | None  #: state in its last heartbeat, None before the first
    rate_hz: float  #: of complete readings since the last reading
    lost: int  #: SYNCs or requests without an answer since the monitor began
    #: whether the axis sent anything since the last reading, or in the last ABANDONED_S
    heard: bool = True
    #: longest time until an answer to a request since the last reading, None without one
    delay_s: float | None = None
    refused: tuple[ObjectRefusal, ...] = ()  #: objects that its last answers did not give

    @property
    def is_late(self) -> bool:
        """Whether an answer took longer than `ANSWER_S`."""
        return self.delay_s is not None and self.delay_s > ANSWER_S

    @property
    def in_fault(self) -> bool:
        """Whether its last statusword reports a fault."""
        return self.statusword is not None and decode(self.statusword) in FAULTY


@dataclass(frozen=True, slots=True)
class CellReading:
    """Reading of a cell."""

    source: ReadingSource  #: of the values
    seconds: float  #: since the last reading
    axes: tuple[AxisReading, ...]  #: in their order
    sync_hz: float  #: SYNCs a second
    #: Number of frames in that time by bus and length, ours included, shape (buses, 9).
    frames: tuple[tuple[int, ...], ...]
    events: tuple[CellEvent, ...]  #: EMCY and changes of NMT states in that time


class _AxisWatch:
    """Last values of one axis, and its pending answers."""

    def __init__(self, axis: Axis) -> None:
        self.node_id = axis.node_id
        self.entries = feedback_entries(axis)
        self.slots = slots_of((axis,))  # of one axis alone: columns are indices of its entries
        self.values: list[int | None] = [None] * len(self.entries)
        self.seen: set[int] = set()
        self.followed = False
        self.readings = 0
        self.lost = 0
        self.complete_ns: int | None = None  # when the last complete reading by SDO came
        self.asked = -1
        self.asked_ns: int | None = None  # when the request that waits for its answer was sent
        self.due_ns = 0
        self.heard_ns: int | None = None
        self.delay_ns: int | None = None
        self.refused: dict[int, ObjectRefusal] = {}  # by column

    def take(self, nmt: int | None, since_ns: int, now_ns: int) -> AxisReading:
        """Return a reading and begin the next."""
        position, current, statusword = self.values
        lasted_s = max((now_ns - since_ns) * 1e-9, 1e-9)
        abandoned_ns = min(since_ns, now_ns - round(ABANDONED_S * 1e9))
        refused = [self.refused[column] for column in sorted(self.refused)]
        reading = AxisReading(
            position_counts=position,
            current_raw=current,
            statusword=statusword,
            nmt=nmt,
            rate_hz=self.readings / lasted_s,
            lost=self.lost,
            heard=self.heard_ns is not None and self.heard_ns >= abandoned_ns,
            delay_s=None if self.delay_ns is None else self.delay_ns * 1e-9,
            refused=tuple(refused),
        )
        self.readings = 0
        self.delay_ns = None
        return reading

    def hear(self, cob_id: int, data: bytes) -> None:
        slot = self.slots[cob_id]
        if len(data) != slot.length:
            return  # another master's mapping: not ours to interpret
        for column, value in zip(slot.columns, slot.layout.unpack(data), strict=True):
            self.values[column] = value
            self.refused.pop(column, None)
        self.seen.add(cob_id)
        self.readings += self.seen == self.slots.keys()

    def sync(self) -> None:
        """End the time for answers to the SYNC before;
        losses count from an axis's first complete answer on.
        """
        self.lost += self.followed and self.seen != self.slots.keys()
        self.followed = self.followed or self.seen == self.slots.keys()
        self.seen.clear()

    def answer(self, data: bytes, now_ns: int) -> None:
        """Take an answer to the open request, however late it comes."""
        answer = upload_answer(data, self.entries[self.asked])
        if self.asked_ns is None or answer is None:
            return  # an answer to another program
        self.delay_ns = max(self.delay_ns or 0, now_ns - self.asked_ns)
        self.asked_ns = None
        self.values[self.asked] = answer.value
        if answer.value is None:
            self.refused[self.asked] = ObjectRefusal(self.entries[self.asked], answer.abort_code)
        else:
            self.refused.pop(self.asked, None)
        if self.asked == len(self.entries) - 1 and not self.refused:
            self.readings += 1
            self.complete_ns = now_ns

    def next_request(self, now_ns: int) -> ObjectEntry | None:
        if self.asked_ns is not None:
            if now_ns < self.asked_ns + round(ABANDONED_S * 1e9):
                return None
            self.lost += 1
            self.drop()  # start again: the values of a reading belong together
        following = (self.asked + 1) % len(self.entries)
        if following == 0:
            if now_ns < self.due_ns:
                return None
            self.due_ns = now_ns + round(READING_S * 1e9)
        self.asked = following
        self.asked_ns = now_ns
        return self.entries[self.asked]

    def drop(self) -> None:
        """Wait for no answer any more."""
        self.asked_ns = None
        self.asked = -1


class CellMonitor:
    """Reads a bus and, where no other master is on it, its axes by SDO;
    nothing else may read the link meanwhile.
    """

    def __init__(
        self,
        link: Link,
        axes: tuple[Axis, ...],
        on_sample: Callable[[Sample], None] = lambda _sample: None,
        wall_minus_monotonic_ns: int = 0,
        taken: Callable[[], bool] = lambda: False,
    ) -> None:
        """Store the arguments.

        Args:
            link: open bus.
            axes: of the cell.
            on_sample: receives every sample while the bus is watched. An axis that did not answer
                is marked missing.
            wall_minus_monotonic_ns: offset of the stamps of samples and events from the link's
                clock [ns].
            taken: whether a recorder has taken the bus and listens before it sends; from then on
                nothing is sent, because the recorder refuses a bus on which it hears requests.
        """
        self.period_ns: int | None = None
        """Period of SYNC; SYNCs that this program missed then leave a gap in the samples' cycles.

        None counts SYNCs.
        """
        self._link = link
        self._on_sample = on_sample
        self._offset_ns = wall_minus_monotonic_ns
        self._taken = taken
        self._axes = tuple(_AxisWatch(axis) for axis in axes)
        self._by_cob_id: dict[int, _AxisWatch] = {}
        for axis_watch in self._axes:
            self._by_cob_id |= dict.fromkeys(axis_watch.slots, axis_watch)
        self._by_node = {axis.node_id: axis for axis in self._axes}
        self._split = link.address if isinstance(link.address, SplitAddress) else None
        self._buses = ("",) if self._split is None else tuple(map(str, self._split.parts))
        self._frames: Counter[tuple[int, int]] = Counter()
        self._syncs = 0
        self._cycle = 0
        # Clock and stamp of the last SYNC, until its sample is complete
        self._sync: tuple[int, float] | None = None
        self._sample_due_ns = 0
        self._master_ns: int | None = None
        self._began_ns = self._since_ns = link.clock()

    @property
    def source(self) -> ReadingSource:
        """Origin of the values now; overheard until the absence of another master is certain."""
        if self._master_ns is None:
            last_ns = self._began_ns
        else:
            last_ns = self._master_ns
        if self._link.clock() - last_ns < QUIET_S * 1e9:
            return ReadingSource.OVERHEARD
        return ReadingSource.ASKED

    def watch(self, seconds: float) -> CellReading:
        """Read the bus for a time and return a reading."""
        clock = self._link.clock
        deadline_ns = clock() + round(seconds * 1e9)
        with bus_errors(self._link.address):
            while (left_ns := deadline_ns - clock()) > 0:
                if self.source is ReadingSource.ASKED:
                    self._ask()
                    self._sample_asked(clock())
                message = self._link.bus.recv(min(left_ns * 1e-9, READING_S / 10))
                if message is not None:
                    self._hear(message)
        now_ns = clock()
        lasted_s = max((now_ns - self._since_ns) * 1e-9, 1e-9)
        axes = []
        for axis in self._axes:
            nmt = self._link.nmt.get(axis.node_id)
            axes.append(axis.take(nmt, self._since_ns, now_ns))
        self._since_ns = now_ns
        frames = []
        for bus in range(len(self._buses)):
            by_length = [self._frames[bus, length] for length in range(9)]
            frames.append(tuple(by_length))
        sync_hz = self._syncs / lasted_s
        self._syncs = 0
        self._frames.clear()
        events = self._link.take_events(now_ns + self._offset_ns, tuple(self._by_node))
        return CellReading(self.source, lasted_s, tuple(axes), sync_hz, tuple(frames), events)

    def pause(self) -> None:
        """Drop open requests: other code reads the bus for a moment."""
        for axis in self._axes:
            axis.drop()

    def _ask(self) -> None:
        now_ns = self._link.clock()
        due = [
            (axis, entry) for axis in self._axes if (entry := axis.next_request(now_ns)) is not None
        ]
        if due and self._taken():
            self._lead()
            return
        for axis, entry in due:
            request = upload_request(axis.node_id, entry)
            self._link.send((request,))
            for bus in (0,) if self._split is None else self._split.route(request):
                self._frames[bus, len(request.data)] += 1

    def _hear(self, message: can.Message) -> None:
        bus = 0 if self._split is None else self._buses.index(str(message.channel))
        self._frames[bus, len(message.data)] += 1
        if not is_plain(message):
            self._link.dispatch(message)
            return
        identifier = message.arbitration_id
        axis = self._by_node.get(identifier & 0x7F)
        if axis is not None and identifier & ~0x7F in FROM_NODES:
            axis.heard_ns = self._link.clock()
        if identifier == SYNC_COB_ID:
            self._syncs += 1
            self._lead()
            self._sample_overheard(message.timestamp)
            for axis in self._axes:
                axis.sync()
        elif identifier == 0 or SDO_REQUEST <= identifier < SDO_REQUEST + 0x80:
            self._lead()
        elif identifier in self._by_cob_id:
            self._by_cob_id[identifier].hear(identifier, bytes(message.data))
        elif identifier - SDO_ANSWER in self._by_node and len(message.data) == 8:
            self._by_node[identifier - SDO_ANSWER].answer(bytes(message.data), self._link.clock())
        else:
            self._link.dispatch(message)

    def _lead(self) -> None:
        """Note that there is another master."""
        if self.source is ReadingSource.ASKED:
            self.pause()
            for axis in self._axes:
                axis.followed = False
                axis.seen.clear()
        self._master_ns = self._link.clock()

    def _sample_overheard(self, stamp_s: float) -> None:
        """Complete the sample of the SYNC before this one, which has the given time stamp."""
        before = self._sync
        self._sync = (self._link.clock(), stamp_s)
        if before is None:
            return
        self._emit(before[0], [axis.seen != axis.slots.keys() for axis in self._axes])
        if self.period_ns is not None:
            # Frames without time stamps all have 0: their cycles are counted.
            self._cycle += max(0, round((stamp_s - before[1]) * 1e9 / self.period_ns) - 1)

    def _sample_asked(self, now_ns: int) -> None:
        """Make a sample of the last values, if it is due."""
        self._sync = None
        if now_ns < self._sample_due_ns:
            return
        self._sample_due_ns = now_ns + round(READING_S * 1e9)
        oldest_ns = now_ns - round((2 * READING_S + ANSWER_S) * 1e9)
        missing = []
        for axis in self._axes:
            missing.append(axis.complete_ns is None or axis.complete_ns < oldest_ns)
        self._emit(now_ns, missing)

    def _emit(self, time_ns: int, missing: list[bool]) -> None:
        by_axis = []
        for axis in self._axes:
            by_axis.append([value or 0 for value in axis.values])
        position, current, statusword = zip(*by_axis, strict=True)
        sample = Sample(
            cycle=self._cycle,
            time_ns=time_ns + self._offset_ns,
            position_counts=position,
            current_raw=current,
            statusword=statusword,
            missing=sum(1 << number for number, absent in enumerate(missing) if absent),
        )
        self._on_sample(sample)
        self._cycle += 1
