"""Watch a cell without changing it: reports of its axes, their rate, and the load of the bus.

While another master is on the bus, nothing is sent: its SYNC and the answers in our mapping are
overheard, each cycle a `Sample`. On a quiet bus the axes are read by SDO uploads, one open request
a node; then a sample has the last values of all axes, every READING_S, and an axis that refuses an
object is marked missing. Nothing is ever written.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import can

from drivers.canopen.bus import bus_errors, is_plain
from drivers.canopen.link import NMT_COB_ID, SYNC_COB_ID, Link
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
#: A request without an answer for so long is lost, and the objects are read from the first again
ABANDONED_S = 1.0
#: Time between two sets of SDO requests to an axis; six axes then load a bus of 1 Mbit/s by 5 %
READING_S = 0.1


class ReadingSource(Enum):
    """Origin of the readings."""

    OVERHEARD = "overheard"  #: answers to the SYNC of another master
    ASKED = "asked"  #: SDO uploads of our own, where no other master is on the bus


@dataclass(frozen=True, slots=True)
class ObjectRefusal:
    """Answer without the value of an object."""

    entry: ObjectEntry  #: the object
    abort_code: int | None  #: of the SDO abort; None for an answer that is no value of this size


@dataclass(frozen=True, slots=True)
class AxisReading:
    """Reading of one axis."""

    position_counts: int | None  #: last value, None before the first and after a refusal
    current_raw: int | None  #: likewise
    statusword: int | None  #: likewise
    nmt: int | None  #: state in its last heartbeat, None before the first
    rate_hz: float  #: of complete sets of these values since the last reading
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
    """Last values of one axis, and the answers that it still owes.

    A set has one value of each of `entries`. A column is an index of `entries`.
    """

    def __init__(self, axis: Axis) -> None:
        self.node_id = axis.node_id
        self.entries = feedback_entries(axis)
        self.slots = slots_of((axis,))  # by COB-ID
        # None before the first answer, and where the last one had no value
        self.values: list[int | None] = [None] * len(self.entries)
        self.last_values = [0] * len(self.entries)  # also after a refusal; 0 before the first
        self.answered: set[int] = set()  # COB-IDs of the answers to the last SYNC
        self.has_answered = False  # whether an earlier SYNC was answered completely
        self.in_set: set[int] = set()  # COB-IDs of the overheard set that is not complete
        self.sets = 0  # complete ones since the last `take`
        self.lost = 0  # SYNCs or requests without an answer
        self.complete_ns: int | None = None  # when the last complete set by SDO came
        self.requested = -1  # column of the last request, -1 before the first of a set
        self.request_ns: int | None = None  # when the open request was sent
        self.next_set_ns = 0  # when the next set is due
        self.heard_ns: int | None = None  # when it last sent anything
        self.longest_delay_ns: int | None = None  # of an answer since the last `take`
        self.refused: dict[int, ObjectRefusal] = {}  # by column

    @property
    def is_complete(self) -> bool:
        """Whether the last SYNC has all its answers."""
        return self.answered == self.slots.keys()

    def take(self, nmt: int | None, since_ns: int, now_ns: int) -> AxisReading:
        """Return a reading and begin the next.

        Args:
            nmt: state in its last heartbeat, None before the first.
            since_ns: time of the last reading by the clock [ns].
            now_ns: time by the clock [ns].
        """
        position, current, statusword = self.values
        lasted_s = max((now_ns - since_ns) * 1e-9, 1e-9)
        # An axis is silent that sent nothing since the last reading, and for at least ABANDONED_S.
        silent_since_ns = min(since_ns, now_ns - round(ABANDONED_S * 1e9))
        refused = [self.refused[column] for column in sorted(self.refused)]
        delay_s = None
        if self.longest_delay_ns is not None:
            delay_s = self.longest_delay_ns * 1e-9
        reading = AxisReading(
            position_counts=position,
            current_raw=current,
            statusword=statusword,
            nmt=nmt,
            rate_hz=self.sets / lasted_s,
            lost=self.lost,
            heard=self.heard_ns is not None and self.heard_ns >= silent_since_ns,
            delay_s=delay_s,
            refused=tuple(refused),
        )
        self.sets = 0
        self.longest_delay_ns = None
        return reading

    def hear_pdo(self, cob_id: int, data: bytes) -> None:
        """Take an overheard TPDO."""
        slot = self.slots[cob_id]
        if len(data) != slot.length:
            # Another master's mapping: not ours to interpret.
            return
        for column, value in zip(slot.columns, slot.layout.unpack(data), strict=True):
            self._note_value(column, value)
        self.answered.add(cob_id)
        self.in_set.add(cob_id)
        if self.in_set == self.slots.keys():
            self.sets += 1
            self.in_set.clear()

    def hear_sync(self) -> None:
        """End the time for answers to the SYNC before.

        Missing answers count as lost from the first complete answer of the axis on.
        """
        if self.is_complete:
            self.has_answered = True
        elif self.has_answered:
            self.lost += 1
        self.answered.clear()
        self.in_set.clear()

    def hear_answer(self, data: bytes, now_ns: int) -> None:
        """Take an SDO answer to the open request, however late it comes."""
        if self.request_ns is None:
            # An answer to another program
            return
        column = self.requested
        entry = self.entries[column]
        answer = upload_answer(data, entry)
        if answer is None:
            # An answer to another program
            return
        delay_ns = now_ns - self.request_ns
        self.longest_delay_ns = max(self.longest_delay_ns or 0, delay_ns)
        self.request_ns = None
        if answer.value is None:
            self.values[column] = None
            self.refused[column] = ObjectRefusal(entry, answer.abort_code)
        else:
            self._note_value(column, answer.value)
        # An axis that refuses an object has no complete set.
        is_last = column == len(self.entries) - 1
        if is_last and not self.refused:
            self.sets += 1
            self.complete_ns = now_ns

    def _note_value(self, column: int, value: int) -> None:
        """Note the value of an object, which is refused no more."""
        self.values[column] = value
        self.last_values[column] = value
        self.refused.pop(column, None)

    def next_request(self, now_ns: int) -> ObjectEntry | None:
        """Return the object to request now; None while an answer is awaited, or no set is due."""
        if self.request_ns is not None:
            if now_ns < self.request_ns + round(ABANDONED_S * 1e9):
                return None
            self.lost += 1
            # From the first object again: the values of a set belong together.
            self.abandon_request()
        column = (self.requested + 1) % len(self.entries)
        if column == 0:
            if now_ns < self.next_set_ns:
                return None
            self.next_set_ns = now_ns + round(READING_S * 1e9)
        self.requested = column
        self.request_ns = now_ns
        return self.entries[column]

    def abandon_request(self) -> None:
        """Wait for no answer any more, and begin with the first object again."""
        self.request_ns = None
        self.requested = -1


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
        #: Period of SYNC, with which SYNCs that this program missed leave a gap in the samples'
        #: cycles; None to count only those that were heard.
        self.period_ns: int | None = None
        self._link = link
        self._on_sample = on_sample
        self._wall_minus_monotonic_ns = wall_minus_monotonic_ns
        self._taken = taken
        self._axes = tuple(_AxisWatch(axis) for axis in axes)
        self._by_cob_id: dict[int, _AxisWatch] = {}
        for axis_watch in self._axes:
            self._by_cob_id |= dict.fromkeys(axis_watch.slots, axis_watch)
        self._by_node = {axis.node_id: axis for axis in self._axes}
        self._split: SplitAddress | None = None
        self._buses: tuple[str, ...] = ("",)
        if isinstance(link.address, SplitAddress):
            self._split = link.address
            self._buses = tuple(map(str, self._split.parts))
        self._frames: Counter[tuple[int, int]] = Counter()  # by bus and length
        self._syncs = 0
        self._cycle = 0
        # Clock [ns] and stamp [s] of the last SYNC, until its sample is complete
        self._last_sync: tuple[int, float] | None = None
        self._next_sample_ns = 0
        self._began_ns = link.clock()
        self._master_ns: int | None = None  # when another master was last heard
        self._since_ns = self._began_ns  # the last reading

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
                    self._send_requests()
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
        wall_ns = now_ns + self._wall_minus_monotonic_ns
        events = self._link.take_events(wall_ns, tuple(self._by_node))
        return CellReading(self.source, lasted_s, tuple(axes), sync_hz, tuple(frames), events)

    def pause(self) -> None:
        """Drop open requests: other code reads the bus for a moment."""
        for axis in self._axes:
            axis.abandon_request()

    def _send_requests(self) -> None:
        """Send the requests that are due, one an axis, unless a recorder has taken the bus."""
        now_ns = self._link.clock()
        requests = []
        for axis in self._axes:
            entry = axis.next_request(now_ns)
            if entry is not None:
                requests.append(upload_request(axis.node_id, entry))
        if requests and self._taken():
            self._note_master()
            return
        for request in requests:
            self._link.send((request,))
            buses: Sequence[int] = (0,)
            if self._split is not None:
                buses = self._split.route(request)
            for bus in buses:
                self._frames[bus, len(request.data)] += 1

    def _hear(self, message: can.Message) -> None:
        """Process a frame: count it, and give it to the axis that it is about."""
        bus = 0
        if self._split is not None:
            bus = self._buses.index(str(message.channel))
        self._frames[bus, len(message.data)] += 1
        if not is_plain(message):
            self._link.dispatch(message)
            return
        identifier = message.arbitration_id
        data = bytes(message.data)
        sender = self._by_node.get(identifier & 0x7F)
        if sender is not None and identifier & ~0x7F in FROM_NODES:
            sender.heard_ns = self._link.clock()
        answering = self._by_node.get(identifier - SDO_ANSWER)
        is_sdo_request = SDO_REQUEST <= identifier < SDO_REQUEST + 0x80
        if identifier == SYNC_COB_ID:
            self._syncs += 1
            self._note_master()
            self._sample_overheard(message.timestamp)
            for axis in self._axes:
                axis.hear_sync()
        elif identifier == NMT_COB_ID or is_sdo_request:
            self._note_master()
        elif identifier in self._by_cob_id:
            self._by_cob_id[identifier].hear_pdo(identifier, data)
        elif answering is not None and len(data) == 8:
            answering.hear_answer(data, self._link.clock())
        else:
            self._link.dispatch(message)

    def _note_master(self) -> None:
        """Note that another master uses the bus, or is about to."""
        if self.source is ReadingSource.ASKED:
            # The axes answer to its SYNC from now on; missing answers count as lost once the first
            # has come.
            self.pause()
            for axis in self._axes:
                axis.has_answered = False
                axis.answered.clear()
        self._master_ns = self._link.clock()

    def _sample_overheard(self, stamp_s: float) -> None:
        """Complete the sample of the SYNC before this one, which has the given time stamp."""
        last_sync = self._last_sync
        self._last_sync = (self._link.clock(), stamp_s)
        if last_sync is None:
            return
        last_ns, last_stamp_s = last_sync
        missing = [not axis.is_complete for axis in self._axes]
        self._emit(last_ns, missing)
        if self.period_ns is not None:
            # Frames without time stamps all have 0: then no period counts as missed.
            periods = round((stamp_s - last_stamp_s) * 1e9 / self.period_ns)
            missed = max(0, periods - 1)
            self._cycle += missed

    def _sample_asked(self, now_ns: int) -> None:
        """Make a sample of the last values, if it is due."""
        # The last SYNC of a master that is gone gets no sample.
        self._last_sync = None
        if now_ns < self._next_sample_ns:
            return
        self._next_sample_ns = now_ns + round(READING_S * 1e9)
        # A set begins every READING_S, and its answers may take ANSWER_S; the rest is a margin.
        oldest_ns = now_ns - round((2 * READING_S + ANSWER_S) * 1e9)
        missing = []
        for axis in self._axes:
            is_old = axis.complete_ns is None or axis.complete_ns < oldest_ns
            refuses = bool(axis.refused)
            missing.append(is_old or refuses)
        self._emit(now_ns, missing)

    def _emit(self, time_ns: int, missing: list[bool]) -> None:
        """Pass on a sample of the last values; `missing` says which axes did not answer."""
        by_axis = []
        missing_bits = 0
        for number, axis in enumerate(self._axes):
            by_axis.append(axis.last_values)
            if missing[number]:
                missing_bits |= 1 << number
        position, current, statusword = zip(*by_axis, strict=True)
        sample = Sample(
            cycle=self._cycle,
            time_ns=time_ns + self._wall_minus_monotonic_ns,
            position_counts=position,
            current_raw=current,
            statusword=statusword,
            missing=missing_bits,
        )
        self._on_sample(sample)
        self._cycle += 1
