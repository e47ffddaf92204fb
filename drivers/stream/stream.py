"""The SYNC-grouped stream: one SYNC, sent or followed, the answers of all axes back, one Sample.

The stream is the only reader of the bus while it runs. A TPDO carries no cycle number, so an answer that comes after
the next SYNC can be told from that SYNC's own answer only by waiting for both: after a missing frame the stream does
that, for one cycle, before it believes that the frame was lost.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from struct import Struct

import can

from drivers.canopen.bus import bus_errors
from drivers.canopen.link import SYNC_COB_ID
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.pdo import Direction, feedback_entries, layout, pack, records
from drivers.errors import BusError, CellSilent, NodeMisplaced, PdoLengthWrong, SampleLost
from drivers.motion.watch import Watch
from drivers.stream.sample import CellEvent, EventKind, EventSink, Sample, ignore_event
from drivers.stream.socketcan import CapturedMessage, Losses, losses_of, remarks_of
from drivers.stream.sync import FollowedSync, LockstepSync, Pacing, SyncRate, TimedSync

SHORTENED, STRAGGLING = 16, 4
"""Parts of a lockstep cycle's bound: for a cell that was silent before, and for axes when others have answered."""

LARGEST_LAG_NS = 1_000_000_000
"""Of the reader behind the bus; what it sees of the axes is then older than what a person would bear."""
FRAMES_PER_S = 50_000
"""More than two buses of 1 Mbit/s carry: among so many frames a producer that is alive has been heard."""


@dataclass(frozen=True, slots=True)
class StreamStatistics:
    """What has become of the frames so far; a run is sound when all from `missing` to `backlog_dropped` are zero.

    Attributes:
        cycles: SYNCs sent, or followed.
        frames: answers used.
        missing: answers that did not come in their cycle.
        late: answers that came in a later cycle, where that could be known.
        duplicate: second answers of an axis to one SYNC.
        surplus: PDOs of an axis of the cell that it was not told to send.
        wrong_length: answers that are not as long as the mapping says; they count as missing too.
        skipped_periods: periods without a SYNC because the schedule slipped, or a followed SYNC did not come.
        kernel_dropped: frames of any kind that the kernel dropped because its receive buffer was full.
        interface_dropped: the same, before they came to the buffer.
        backlog_dropped: frames that the capture process dropped because nobody took them from it.
        foreign: PDOs that are explained: of nodes that are no axes of the cell, or from before the first SYNC.
    """

    cycles: int = 0
    frames: int = 0
    missing: int = 0
    late: int = 0
    duplicate: int = 0
    surplus: int = 0
    wrong_length: int = 0
    skipped_periods: int = 0
    kernel_dropped: int = 0
    interface_dropped: int = 0
    backlog_dropped: int = 0
    foreign: int = 0


@dataclass(frozen=True, slots=True)
class _Slot:
    """Where the values of one TPDO go."""

    axis: int
    bit: int
    length: int
    layout: Struct
    columns: tuple[int, ...]


def _slots(network: CanopenNetwork) -> dict[int, _Slot]:
    """The slot of each COB-ID; column = field × axes + axis, with fields position, current, statusword."""
    slots: dict[int, _Slot] = {}
    axes = len(network.axes)
    for number, axis in enumerate(network.axes):
        entries = feedback_entries(axis)
        pdos = pack(entries)
        for pdo, record in zip(pdos, records(Direction.TPDO, axis.node_id, pdos), strict=True):
            form = layout(pdo)
            columns = tuple(entries.index(entry) * axes + number for entry in pdo)
            slots[record.cob_id] = _Slot(number, 1 << len(slots), form.size, form, columns)
    return slots


def _is_sync(message: can.Message) -> bool:
    plain = not (message.is_error_frame or message.is_extended_id or message.is_remote_frame)
    return plain and message.arbitration_id == SYNC_COB_ID


class SyncStream:
    """An iterator of Samples that never ends by itself; ``next`` raises what must stop a recording.

    Args:
        network: a prepared network; nobody else may read its bus while the stream is used.
        pacing: when a SYNC goes out.
        on_event: gets EMCY, NMT and CiA 402 changes and losses, before the sample of their cycle is returned.
        max_missing_cycles: so many incomplete cycles in a row are tolerated, counted and marked in their samples.

    Raises (by ``next``):
        SampleLost: more incomplete cycles in a row than tolerated.
        DriveFault: an EMCY, a new fault or following error, or a node that left OPERATIONAL.
        CellSilent: the same, and no axis answered.
        PdoLengthWrong: an axis answers twice in a row with a PDO that is not as long as its mapping.
        LimitActive: a limit of a drive acts for too long.
        BusBusy: another master sends SYNC, NMT commands or set-points of an axis.
        HeartbeatLost: a node is silent for more than two of its periods.
        BusError: the bus, one of its parts or the capture process has gone, the followed SYNC does not come any more,
            or the bus is read more than a second late.
        NodeMisplaced: a node is heard on another of the cell's buses than its own.
    """

    def __init__(
        self,
        network: CanopenNetwork,
        pacing: Pacing,
        on_event: EventSink = ignore_event,
        max_missing_cycles: int = 3,
    ) -> None:
        self.network = network
        self.pacing: Pacing = pacing
        self.max_missing_cycles = max_missing_cycles
        self._link = network.link
        self._on_event = on_event
        self._slots = _slots(network)
        self._axes = len(network.axes)
        self._nodes = frozenset(network.node_ids)
        self._all = (1 << len(self._slots)) - 1
        self._sync = can.Message(arbitration_id=SYNC_COB_ID, is_extended_id=False)
        self._outgoing: list[can.Message] = []
        self._values = [0] * (3 * self._axes)
        self._seen = 0
        self._debt = 0
        self._last_data: dict[int, bytearray] = {}
        self._incomplete_cycles = 0
        self._short: dict[int, int] = {}
        self._silent = False
        self._answered_ns = 0
        self._next_sync_ns = 0
        self._first_sync_ns = 0
        self._last_sync_ns = 0
        self._opened: can.Message | None = None
        self._rate = SyncRate(pacing.period_ns)
        self._behind = False
        self._overdue = 0
        self._waited = self._over = False
        self._base = self._losses = Losses()
        self._time_ns = pacing.start_ns
        self._watch = Watch(network, on_event)
        self._cycles = self._frames = self._missing = self._late = 0
        self._duplicate = self._surplus = self._wrong_length = self._skipped = self._foreign = 0

    @property
    def statistics(self) -> StreamStatistics:
        """Counts up to now."""
        return StreamStatistics(
            self._cycles,
            self._frames,
            self._missing,
            self._late,
            self._duplicate,
            self._surplus,
            self._wrong_length,
            self._skipped,
            self._losses.kernel,
            self._losses.interface,
            self._losses.backlog,
            self._foreign,
        )

    @property
    def silent(self) -> bool:
        """Whether no axis answered the last SYNC."""
        return self._silent

    @property
    def time_ns(self) -> int:
        """Time of the last SYNC [ns since 1970]; the pacing's start before the first one."""
        return self._time_ns

    def emit(self, event: CellEvent) -> None:
        """Put an event of the caller's into the order of the stream's."""
        self._on_event(event)

    def send(self, messages: Sequence[can.Message]) -> None:
        """Send frames right before the next SYNC, on which synchronous RPDOs act."""
        self._outgoing.extend(messages)

    def drop_outgoing(self) -> None:
        """Forget the frames that wait for the next SYNC: what they ask for is no longer wanted."""
        self._outgoing.clear()

    def __iter__(self) -> Iterator[Sample]:
        return self

    def __next__(self) -> Sample:
        self.check()
        return self.advance()

    def check(self) -> None:
        """Raise the oldest fault that was seen and not raised yet."""
        if self._watch.faults:
            raise self._watch.faults.popleft()

    def advance(self) -> Sample:
        """One cycle whatever the drives' condition is, as stopping them needs; faults wait for the next ``next``.

        Raises:
            BusError: the bus has gone.
            NodeMisplaced: as `next`.
        """
        self._over = False
        try:
            with bus_errors(self._link.address):
                if self._cycles == 0:
                    self._begin()
                pacing = self.pacing
                self._collect(self._follow_sync(pacing) if isinstance(pacing, FollowedSync) else self._send_sync())
        except (BusError, NodeMisplaced) as error:
            self._on_event(CellEvent(self._time_ns, None, EventKind.BUS_LOST, 0, str(error)))
            raise
        return self._finish_cycle()

    def _begin(self) -> None:
        """What came before the first SYNC is nobody's, and what was lost before it is not missed."""
        bus, begun_ns = self._link.bus, self.pacing.clock()
        for message in self._waiting():
            fresh = isinstance(message, CapturedMessage) and message.monotonic_ns > begun_ns
            if fresh and isinstance(self.pacing, FollowedSync) and _is_sync(message):
                self._opened = message  # a reader that is no faster than the bus would look for an end for ever
                break
            self._between_cycles(message)
        self._base = losses_of(bus)
        for remark in remarks_of(bus):
            self._on_event(CellEvent(self._time_ns, None, EventKind.CAPTURE, 0, remark))

    def _waiting(self) -> Iterator[can.Message]:
        """The frames that have come already; who is at them for too long sees no axis any more."""
        clock, recv = self.pacing.clock, self._link.bus.recv
        begun_ns = clock()
        while (message := recv(0.0)) is not None:
            yield message
            if (behind_ns := clock() - begun_ns) > LARGEST_LAG_NS:
                self._fall_behind(behind_ns)
                return

    def _fall_behind(self, behind_ns: int) -> None:
        """A fault, once: whether anything is lost the counters say."""
        if not self._behind:
            self._behind = True
            reason = f"read {behind_ns * 1e-9:.1f} s late: nobody watches axes that move so"
            self._watch.faults.append(BusError(str(self._link.address), reason))

    def _until_sync(self, pacing: FollowedSync, end_ns: int) -> can.Message | None:
        """The next frame until a time by the clock, or that had come by then: a late reader is no dead producer."""
        self._link.beat()
        while (left_ns := end_ns - pacing.clock()) > 0:
            message = self._link.bus.recv(left_ns * 1e-9)
            if message is not None:
                return message
        self._overdue += 1
        return self._link.bus.recv(0.0) if self._overdue <= FRAMES_PER_S * pacing.timeout_s else None

    def _follow_sync(self, pacing: FollowedSync) -> int:
        """Send what waits, and find the next SYNC among the frames; returns until when the one after it must come."""
        self._link.beat()
        if self._outgoing:
            # As early in the period as can be: all of it should be there before the next SYNC.
            outgoing, self._outgoing = self._outgoing, []
            self._link.send(outgoing)
        sync, self._opened = self._opened, None
        # Where answers of the last cycle were missing, the wait for them was a wait for this SYNC already.
        end_ns = pacing.clock() + round(pacing.timeout_s * 1e9) // (2 if self._waited else 1)
        while sync is None:
            message = self._until_sync(pacing, end_ns)
            if message is None:
                return self._lose_sync(pacing)
            if _is_sync(message):
                sync = message
            else:
                self._between_cycles(message)
        at_ns = sync.monotonic_ns if isinstance(sync, CapturedMessage) else pacing.clock()
        periods = 0
        if self._cycles == 0:
            self._first_sync_ns = self._answered_ns = at_ns
        else:
            # One period after the SYNC before it, or more where others between them did not come.
            since_ns = at_ns - self._last_sync_ns
            periods = max(1, (since_ns + pacing.period_ns // 2) // pacing.period_ns)
            self._skipped += periods - 1
            if self._rate.too_fast(since_ns):
                self._link.note_foreign(SYNC_COB_ID)
        if pacing.in_kernel and isinstance(sync, CapturedMessage) and not sync.local:
            self._link.note_foreign(SYNC_COB_ID)
        now_ns = pacing.clock()
        if now_ns - at_ns > LARGEST_LAG_NS:
            self._fall_behind(now_ns - at_ns)
        pacing.seen(at_ns, periods)
        self._last_sync_ns = at_ns
        self._time_ns = pacing.start_ns + at_ns - self._first_sync_ns
        self._cycles += 1
        self._overdue, self._waited = 0, False
        return now_ns + round(pacing.timeout_s * 1e9)

    def _lose_sync(self, pacing: FollowedSync) -> int:
        """The producer is dead: tell it once, and send SYNC from now on, because the axes must be stopped."""
        reason = f"no SYNC from {pacing.producer} for {pacing.timeout_s:g} s"
        self._on_event(CellEvent(self._time_ns, None, EventKind.SYNC_LOST, self._cycles, reason))
        self._watch.faults.append(BusError(str(self._link.address), reason))
        self.pacing = TimedSync(pacing.period_ns, pacing.start_ns, pacing.clock)
        now = pacing.clock()
        if self._cycles == 0:
            self._first_sync_ns = self._answered_ns = now
        self._next_sync_ns = now
        return self._send_sync()

    def _send_sync(self) -> int:
        """Send what waits and the SYNC; returns until when its answers may come, by the clock."""
        pacing, bus = self.pacing, self._link.bus
        self._link.beat()
        for before in self._waiting():
            self._between_cycles(before)
        now = pacing.clock()
        if self._cycles == 0:
            self._first_sync_ns = self._next_sync_ns = self._answered_ns = now
        if isinstance(pacing, LockstepSync):
            self._time_ns = pacing.start_ns + self._cycles * pacing.period_ns
            # A cell that was silent for the whole bound gets no second one: the stop must not take minutes.
            bound_s = pacing.timeout_s / SHORTENED if self._silent else pacing.timeout_s
            deadline_ns = now + round(bound_s * 1e9)
        else:
            while (left_ns := self._next_sync_ns - now) > 0:
                message = bus.recv(left_ns * 1e-9)
                if message is not None:
                    self._between_cycles(message)
                now = pacing.clock()
            slipped = (now - self._next_sync_ns) // pacing.period_ns
            self._skipped += slipped
            if slipped * pacing.period_ns > LARGEST_LAG_NS:
                self._fall_behind(slipped * pacing.period_ns)
            self._time_ns = pacing.start_ns + now - self._first_sync_ns
            deadline_ns = self._next_sync_ns = self._next_sync_ns + (slipped + 1) * pacing.period_ns
        outgoing, self._outgoing = self._outgoing, []
        self._link.send((*outgoing, self._sync))
        self._cycles += 1
        return deadline_ns

    def _next_frame(self, deadline_ns: int) -> can.Message | None:
        """The next frame of this cycle; None when it is over: at its deadline, or with the next followed SYNC."""
        recv, clock = self._link.bus.recv, self.pacing.clock
        if isinstance(self.pacing, FollowedSync):
            # By the order on the bus alone: whatever the clock says, what has come already is read first.
            message = self._until_sync(self.pacing, deadline_ns)
            self._waited = message is None
            if message is not None and _is_sync(message):
                self._opened = message
                return None
            return message
        while (left_ns := deadline_ns - clock()) > 0:
            message = recv(left_ns * 1e-9)
            if message is None:
                continue
            if message.is_rx or not isinstance(message, CapturedMessage):
                return message
            self._note_own_sync(message)
        return None

    def _note_own_sync(self, message: CapturedMessage) -> None:
        """The SYNC of this cycle as the kernel saw it; what is made up keeps its time."""
        if isinstance(self.pacing, TimedSync):
            if (behind_ns := self.pacing.clock() - message.monotonic_ns) > LARGEST_LAG_NS:
                self._fall_behind(behind_ns)
            if self._cycles == 1:
                self._first_sync_ns = message.monotonic_ns
            self._time_ns = self.pacing.start_ns + message.monotonic_ns - self._first_sync_ns

    def _collect(self, deadline_ns: int) -> None:
        """Receive until all answers are there, or the cycle is over."""
        clock, slots, values = self.pacing.clock, self._slots, self._values
        last_data = self._last_data
        debt, seen, everything = self._debt, 0, self._all
        while seen != everything or debt:
            message = self._next_frame(deadline_ns)
            if message is None:
                break
            identifier = message.arbitration_id
            slot = slots.get(identifier)
            if slot is None or message.is_error_frame or message.is_extended_id or message.is_remote_frame:
                self._other(message)
                continue
            data = message.data
            if len(data) != slot.length:
                self._note_length(slot, identifier, len(data))
                continue
            deadline_ns = deadline_ns if seen else self._stragglers_until(deadline_ns)
            if seen & slot.bit:
                if debt & slot.bit:
                    # The first one was the late answer to an earlier SYNC, this one is ours.
                    debt &= ~slot.bit
                    self._late += 1
                else:
                    self._duplicate += 1
                    if last_data.get(identifier) == data:
                        continue
                    # The second answer differs: the first may have been a repetition of the cycle before.
            seen |= slot.bit
            last_data[identifier] = data
            for column, value in zip(slot.columns, slot.layout.unpack(data), strict=True):
                values[column] = value
        self._seen = seen
        self._silent = not seen
        if seen:
            self._answered_ns = clock()
        # One answer and a debt at the end: the owed frame was lost for good, and the answer is this cycle's.
        self._debt = everything & ~seen

    def _stragglers_until(self, deadline_ns: int) -> int:
        """Cells in lockstep answer in one go: where one axis has answered, the others get less patience."""
        if not isinstance(self.pacing, LockstepSync):
            return deadline_ns
        return min(deadline_ns, self.pacing.clock() + round(self.pacing.timeout_s * 1e9) // STRAGGLING)

    def _note_length(self, slot: _Slot, identifier: int, found: int) -> None:
        """One frame may have been cut by another's; a second one with the next SYNC is a wrong mapping."""
        self._wrong_length += 1
        node_id = self.network.node_ids[slot.axis]
        if identifier not in self._short or self._short[identifier] < self._cycles - 1:
            text = f"node {node_id}: PDO {identifier:03X}h has {found} bytes, its mapping says {slot.length}"
            self._on_event(CellEvent(self._time_ns, slot.axis, EventKind.PDO_LENGTH, identifier, text))
        elif self._short[identifier] == self._cycles - 1:
            self._watch.faults.append(PdoLengthWrong(node_id, identifier, slot.length, found))
        self._short[identifier] = self._cycles

    def read_on(self, seconds: float) -> None:
        """After the last cycle: count what it left on the bus, and what this machine tells late of its losses.

        Sends nothing. Answers after the first such call, or after the next SYNC of a producer that is followed, are
        nobody's: others may have sent SYNC by then, to stop axes by SDO.

        Raises:
            BusError: the bus has gone, and so has what it would have told.
            NodeMisplaced: as `next`.
        """
        clock, followed = self.pacing.clock, isinstance(self.pacing, FollowedSync)
        over = self._over or self._opened is not None
        end_ns = clock() + round(seconds * 1e9)
        with bus_errors(self._link.address):
            while (left_ns := end_ns - clock()) > 0:
                if (late := self._link.bus.recv(left_ns * 1e-9)) is None:
                    continue
                over = over or (followed and _is_sync(late))
                if not (over and late.arbitration_id in self._slots):
                    self._between_cycles(late)
        self._over = True
        self._note_losses()
        self._watch.note_events(self._time_ns)

    def _between_cycles(self, message: can.Message) -> None:
        """A frame that is read before the next SYNC, and so answers none that is still open."""
        slot = self._slots.get(message.arbitration_id)
        if slot is None or message.is_error_frame or message.is_extended_id or message.is_remote_frame:
            self._other(message)
        elif self._cycles == 0:
            self._foreign += 1
        elif self._debt & slot.bit:
            self._debt &= ~slot.bit
            self._late += 1
        else:
            self._duplicate += 1

    def _other(self, message: can.Message) -> None:
        if self._link.dispatch(message) or not 0x180 <= message.arbitration_id < 0x580:
            return
        ours = not message.is_extended_id and message.arbitration_id & 0x7F in self._nodes
        if ours and self._cycles:
            self._surplus += 1
        else:
            self._foreign += 1

    def _finish_cycle(self) -> Sample:
        axes, values = self._axes, self._values
        # A period that was left out has a number too, so that nobody takes its neighbours for neighbours.
        cycle = self._cycles - 1 + self._skipped
        missing = 0
        if self._seen != self._all:
            for slot in self._slots.values():
                if not self._seen & slot.bit:
                    missing |= 1 << slot.axis
                    self._missing += 1
            self._note_missing(cycle, missing)
        else:
            self._incomplete_cycles = 0
        self._frames += self._seen.bit_count()
        self._note_losses()
        statuswords = tuple(values[2 * axes :])
        self._watch.cycle(self._time_ns, self.pacing.clock(), statuswords, missing)
        return Sample(cycle, self._time_ns, tuple(values[:axes]), tuple(values[axes : 2 * axes]), statuswords, missing)

    def _note_losses(self) -> None:
        """Frames that this machine lost; which they were nobody knows."""
        losses = losses_of(self._link.bus).since(self._base)
        if losses == self._losses:
            return
        new, self._losses = losses.since(self._losses), losses
        for count, where in (
            (new.kernel, "in the kernel's receive buffer, which was full"),
            (new.interface, "by the interface, before the receive buffer"),
            (new.backlog, "by the capture process, whose backlog was full"),
        ):
            if count:
                text = f"{count} frames dropped {where}"
                self._on_event(CellEvent(self._time_ns, None, EventKind.FRAMES_DROPPED, count, text))

    def _note_missing(self, cycle: int, missing: int) -> None:
        silent = tuple(axis for axis in range(self._axes) if missing >> axis & 1)
        self._incomplete_cycles += 1
        for axis in silent:
            text = f"no complete answer of {self.network.axes[axis].name} to cycle {cycle}"
            self._on_event(CellEvent(self._time_ns, axis, EventKind.SAMPLE_LOST, cycle, text))
        if self._incomplete_cycles <= self.max_missing_cycles:
            return
        if len(silent) == self._axes:
            waited_s = (self.pacing.clock() - self._answered_ns) * 1e-9
            self._watch.faults.append(CellSilent(cycle, waited_s))
        else:
            self._watch.faults.append(SampleLost(cycle, silent))
