"""The SYNC-grouped stream: one SYNC, sent or followed, the answers of all axes, one Sample.

The stream is the only reader of the bus while it runs. Where frames have the kernel's stamps, our own SYNC comes back
among them, and a cycle lasts from one SYNC to the next in the order of the frames, however late they are read: SYNC is
sent on schedule while the stream waits for frames. Where they have none, a cycle ends by the clock, after everything
that has arrived was read. Which answer belongs to which SYNC is decided in answers.py, the pacing is described in
sync.py.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence

import can

from drivers.canopen.bus import bus_errors
from drivers.canopen.link import SYNC_COB_ID
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.socketcan import CapturedMessage, Losses, lags_behind, losses_of, read_until_ns, remarks_of
from drivers.errors import BusError, DriveFault, NodeMisplaced, SampleLost, node_label
from drivers.messages import CellEvent, EventKind, EventSink, Sample
from drivers.stream.answers import Answers, Slot, StreamStatistics
from drivers.stream.sync import FollowedSync, LockstepSync, Pacing, SyncRate, TimedSync
from drivers.stream.watch import Watch

SHORTENED, STRAGGLING = 16, 4
"""Divisors of a lockstep time-out: if no axis answered the last SYNC, and once another axis has answered this one."""

MAX_MISSING_CYCLES = 3  #: Tolerated incomplete cycles in a row; they are counted, and marked in the samples
LARGEST_LAG_NS = 1_000_000_000  #: Largest delay of the reader behind the bus; older data cannot protect moving axes
LOOK_EVERY = 64  #: Frames between two looks at the clock while frames are waiting: each is a system call
PATIENCE_S = 0.02  #: Time between two looks whether the capture process has received what came before a deadline
FRAMES_PER_S = 50_000
"""Frames per second of time-out to read past the deadline before a producer is dead; two full buses carry fewer."""


def nothing_to_send(_: int) -> Sequence[can.Message]:
    """Return no frames: see `SyncStream.spare`."""
    return ()


def _is_plain(message: can.Message) -> bool:
    return not (message.is_error_frame or message.is_extended_id or message.is_remote_frame)


def _is_sync(message: can.Message) -> bool:
    return message.arbitration_id == SYNC_COB_ID and _is_plain(message)


class SyncStream:
    """An iterator of Samples that never ends by itself; ``next`` raises what must stop a recording.

    Args:
        network: a prepared network; only the stream may read its bus meanwhile.
        pacing: schedule of SYNC.
        on_event: receives EMCY, NMT and CiA 402 changes and losses before the sample of their cycle is returned.

    Raises:
        SampleLost: by ``next``, as all of these: more incomplete cycles in a row than `MAX_MISSING_CYCLES`.
        DriveFault: an EMCY, a new fault or following error, a node that left OPERATIONAL or sends no heartbeat for two
            of its periods, an active limit, stale data, or a PDO of wrong length twice in a row.
        BusBusy: another master sends SYNC, NMT commands or set-points of an axis.
        BusError: the bus, one of its parts or the capture process is lost, the followed SYNC stopped, or the bus is
            read more than a second late.
        NodeMisplaced: a node is heard on another of the cell's buses than its own.
    """

    def __init__(
        self,
        network: CanopenNetwork,
        pacing: Pacing,
        on_event: EventSink = lambda _event: None,
    ) -> None:
        self.network = network
        self.pacing: Pacing = pacing
        #: Takes the events; a caller inserts its own here.
        self.emit = on_event
        self.silent = False  #: Whether no axis answered the last SYNC
        #: Time of the last SYNC [ns since 1970]; the pacing's start before the first one.
        self.time_ns = pacing.start_ns
        #: Frames to send right before the next SYNC, which triggers synchronous RPDOs.
        self.outgoing: list[can.Message] = []
        #: Returns frames that may wait, for a cycle that has no others to send; receives the last SYNC's time [ns].
        self.spare: Callable[[int], Sequence[can.Message]] = nothing_to_send
        self._link = network.link
        self._answers = Answers(network.axes, network.pdos, certain=isinstance(pacing, LockstepSync))
        self._sync = can.Message(arbitration_id=SYNC_COB_ID, is_extended_id=False)
        self._last_wrong_length: dict[int, int] = {}  # cycle, by COB-ID
        self._answered_ns = self._next_sync_ns = self._first_sync_ns = self._last_sync_ns = 0
        self._early_sync: can.Message | None = None
        # Each SYNC that was sent and has not come back: its time by the clock [ns], and the periods left out before it.
        # None where SYNC does not come back.
        self._sent: deque[tuple[int, int]] | None = None
        self._rate = SyncRate(pacing.period_ns)
        self._take_batched: Callable[[], can.Message | None] | None = None
        self._unlooked = 0
        self._behind = self._waited = self._cycle_over = False
        self._base = self._counted = self._losses = Losses()
        self._watch = Watch(network, on_event, real_time=not isinstance(pacing, LockstepSync))
        self._cycles = self._skipped = self._reads_past_deadline = self._incomplete_cycles = self._silent_cycles = 0
        self._counts = self._answers.counts

    @property
    def statistics(self) -> StreamStatistics:
        """Counts up to now."""
        return StreamStatistics(
            cycles=self._cycles,
            skipped_periods=self._skipped,
            kernel_dropped=self._losses.kernel,
            interface_dropped=self._losses.interface,
            backlog_dropped=self._losses.backlog,
            **self._counts,
        )

    def __iter__(self) -> Iterator[Sample]:
        return self

    def __next__(self) -> Sample:
        self.check()
        return self.advance()

    def check(self) -> None:
        """Raise the oldest fault that was not raised yet."""
        if self._watch.faults:
            raise self._watch.faults.popleft()

    def advance(self) -> Sample:
        """Run one cycle even with faults, as stopping the axes needs; `__next__` raises them later.

        Raises:
            BusError: the bus is lost.
            NodeMisplaced: as `next`.
        """
        self._cycle_over = False
        try:
            with bus_errors(self._link.address):
                if self._cycles == 0:
                    self._begin()
                pacing = self.pacing
                if isinstance(pacing, FollowedSync):
                    deadline_ns = self._follow_sync(pacing)
                elif self._sent is not None:
                    deadline_ns = self._open_own_cycle()
                else:
                    deadline_ns = self._send_sync()
                self._collect(deadline_ns)
        except (BusError, NodeMisplaced) as error:
            self.emit(CellEvent(self.time_ns, None, EventKind.BUS_LOST, 0, str(error)))
            raise
        return self._finish_cycle()

    def _begin(self) -> None:
        """Discard the frames from before the first SYNC; losses before it do not count."""
        bus, begun_ns = self._link.bus, self.pacing.clock()
        self._take_batched = getattr(bus, "take", None)
        if isinstance(self.pacing, TimedSync) and read_until_ns(bus) is not None:
            self._sent = deque()
        for message in self._waiting():
            fresh = isinstance(message, CapturedMessage) and message.monotonic_ns > begun_ns
            if fresh and isinstance(self.pacing, FollowedSync) and _is_sync(message):
                self._early_sync = message  # if frames arrive as fast as they are read, the loop would not end
                break
            self._between_cycles(message)
        self._base = self._counted = losses_of(bus)
        for remark in remarks_of(bus):
            self.emit(CellEvent(self.time_ns, None, EventKind.CAPTURE, 0, remark))

    def _waiting(self) -> Iterator[can.Message]:
        """Yield the frames that have arrived already; a reader that needs too long is a fault."""
        clock, recv = self.pacing.clock, self._link.bus.recv
        begun_ns = clock()
        while (message := recv(0.0)) is not None:
            yield message
            if self._too_late(clock() - begun_ns):
                return

    def _too_late(self, behind_ns: int) -> bool:
        """Whether the reader is too late; reported once, because the counters show whether frames were lost."""
        late = behind_ns > LARGEST_LAG_NS
        if late and not self._behind:
            self._behind = True
            remedy = "moving axes cannot be watched; reduce the load of this computer"
            reason = f"read {behind_ns * 1e-9:.1f} s late: {remedy}"
            self._watch.faults.append(BusError(str(self._link.address), reason))
        return late

    def _next_arrived(self, pacing: FollowedSync, end_ns: int) -> can.Message | None:
        """Return the next frame that arrived before a deadline, even if it is read late; None without any."""
        if (taken := self._batched()) is not None:
            return taken
        bus = self._link.bus
        self._link.beat()
        while (left_ns := end_ns - (now_ns := pacing.clock())) > 0:
            if (message := bus.recv(left_ns * 1e-9)) is not None:
                return message
        self._reads_past_deadline += 1
        if self._reads_past_deadline > FRAMES_PER_S * pacing.timeout_s:
            return None
        message = bus.recv(0.0)
        # A capture process that was stopped has not received all of it yet.
        while message is None and now_ns < end_ns + LARGEST_LAG_NS and lags_behind(bus, end_ns):
            self._link.beat()
            message = bus.recv(PATIENCE_S)
            now_ns = pacing.clock()
        return message

    def _batched(self) -> can.Message | None:
        """Return a frame that was received with the one before, without a look at the clock; now and then None."""
        self._unlooked = (self._unlooked + 1) % LOOK_EVERY
        return None if self._take_batched is None or self._unlooked == 0 else self._take_batched()

    def _follow_sync(self, pacing: FollowedSync) -> int:
        """Send waiting frames, and read until the next SYNC; returns the deadline of the SYNC after it."""
        self._link.beat()
        if outgoing := self._take_outgoing():
            # As early in the period as possible: all of it should arrive before the next SYNC.
            self._link.send(outgoing)
        sync, self._early_sync = self._early_sync, None
        # A cycle that waited in vain for answers waited for this SYNC too: half of the time-out is enough.
        end_ns = pacing.clock() + round(pacing.timeout_s * 1e9) // (2 if self._waited else 1)
        while sync is None:
            message = self._next_arrived(pacing, end_ns)
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
            # One period after the SYNC before it, or more where SYNCs between them did not come.
            since_ns = at_ns - self._last_sync_ns
            periods = max(1, (since_ns + pacing.period_ns // 2) // pacing.period_ns)
            self._skipped += periods - 1
            if self._rate.too_fast(since_ns):
                self._link.note_foreign(SYNC_COB_ID)
        if pacing.in_kernel and isinstance(sync, CapturedMessage) and not sync.local:
            self._link.note_foreign(SYNC_COB_ID)
        now_ns = pacing.clock()
        self._too_late(now_ns - at_ns)
        if pacing.seen is not None:
            pacing.seen(at_ns, periods)
        self._last_sync_ns = at_ns
        self.time_ns = pacing.start_ns + at_ns - self._first_sync_ns
        self._cycles += 1
        self._reads_past_deadline, self._waited = 0, False
        return now_ns + round(pacing.timeout_s * 1e9)

    def _lose_sync(self, pacing: FollowedSync) -> int:
        """Report the dead producer once, and send SYNC from now on, because the axes must be stopped."""
        reason = f"no SYNC from {pacing.producer} for {pacing.timeout_s:g} s"
        self.emit(CellEvent(self.time_ns, None, EventKind.SYNC_LOST, self._cycles, reason))
        self._watch.faults.append(BusError(str(self._link.address), reason))
        self.pacing = TimedSync(pacing.period_ns, pacing.start_ns, pacing.clock)
        self._next_sync_ns = pacing.clock()
        if self._cycles:
            # The wait leaves a gap in the cycles, as it does in their times.
            since_ns = self._next_sync_ns - self._last_sync_ns
            self._skipped += max(0, (since_ns - pacing.period_ns // 2) // pacing.period_ns)
        return self._send_sync()

    def _open_own_cycle(self) -> int:
        """Read until our next SYNC comes back, which is sent when it is due; returns the time of the one after it."""
        if self._cycles == 0:
            self._next_sync_ns = self._answered_ns = self.pacing.clock()
        sync, self._early_sync = self._early_sync, None
        while sync is None:
            message = self._read_and_send()
            if message is None:
                return self._send_sync()
            if _is_sync(message) and not message.is_rx:
                sync = message
            else:
                self._between_cycles(message)
        now_ns = self.pacing.clock()
        at_ns = sync.monotonic_ns if isinstance(sync, CapturedMessage) else now_ns
        self._too_late(now_ns - at_ns)
        self._skipped += self._sent.popleft()[1] if self._sent else 0
        if self._cycles == 0:
            self._first_sync_ns = at_ns
        self.time_ns = self.pacing.start_ns + at_ns - self._first_sync_ns
        self._cycles += 1
        return self._next_sync_ns

    def _read_and_send(self) -> can.Message | None:
        """Return the next frame, and send SYNC when it is due; None once SYNC does not come back."""
        sent = self._sent
        if sent is not None and (taken := self._batched()) is not None:
            return taken
        while sent is not None:
            self._link.beat()
            now_ns = self.pacing.clock()
            if now_ns >= self._next_sync_ns:
                late = (now_ns - self._next_sync_ns) // self.pacing.period_ns
                self._too_late(late * self.pacing.period_ns)
                self._next_sync_ns += (late + 1) * self.pacing.period_ns
                self._link.send((*self._take_outgoing(), self._sync))
                sent.append((now_ns, late))
            if sent and self._too_late(now_ns - sent[0][0]):
                self._skipped += sum(late for _, late in sent) + len(sent)
                self._sent = sent = None  # from now on, cycles end by the clock
            elif (message := self._link.bus.recv((self._next_sync_ns - now_ns) * 1e-9)) is not None:
                return message
        return None

    def _send_sync(self) -> int:
        """Send waiting frames and the SYNC; returns the deadline of its answers by the clock."""
        pacing, bus = self.pacing, self._link.bus
        self._link.beat()
        for before in self._waiting():
            self._between_cycles(before)
        now = pacing.clock()
        if self._cycles == 0:
            self._first_sync_ns = self._next_sync_ns = self._answered_ns = now
        if isinstance(pacing, LockstepSync):
            self.time_ns = pacing.start_ns + self._cycles * pacing.period_ns
            # A cell that was silent for the whole time gets less the next time: the stop must not take minutes.
            bound_s = pacing.timeout_s / SHORTENED if self.silent else pacing.timeout_s
            deadline_ns = now + round(bound_s * 1e9)
        else:
            while (left_ns := self._next_sync_ns - now) > 0:
                message = bus.recv(left_ns * 1e-9)
                if message is not None:
                    self._between_cycles(message)
                now = pacing.clock()
            slipped = (now - self._next_sync_ns) // pacing.period_ns
            self._skipped += slipped
            self._too_late(slipped * pacing.period_ns)
            self.time_ns = pacing.start_ns + now - self._first_sync_ns
            deadline_ns = self._next_sync_ns = self._next_sync_ns + (slipped + 1) * pacing.period_ns
        self._link.send((*self._take_outgoing(), self._sync))
        self._cycles += 1
        return deadline_ns

    def _take_outgoing(self) -> Sequence[can.Message]:
        outgoing, self.outgoing = self.outgoing, []
        return outgoing or self.spare(self.time_ns)

    def _next_frame(self, deadline_ns: int) -> can.Message | None:
        """Return the next frame of this cycle; None at its deadline, or at the next followed SYNC."""
        recv, clock = self._link.bus.recv, self.pacing.clock
        if isinstance(self.pacing, FollowedSync):
            # Only the order on the bus counts: frames that have arrived are read first, whatever the clock shows.
            message = self._next_arrived(self.pacing, deadline_ns)
            self._waited = message is None
            if message is not None and _is_sync(message):
                self._early_sync = message
                return None
            return message
        if self._sent is not None:
            message = self._read_and_send()
            if message is not None and _is_sync(message) and not message.is_rx:
                self._early_sync = message
                return None
            return message
        while (left_ns := deadline_ns - clock()) > 0:
            message = recv(left_ns * 1e-9)
            if message is not None and message.is_rx:
                return message
        # What has arrived belongs to this cycle: the next SYNC is not sent yet.
        return None if -left_ns > LARGEST_LAG_NS else recv(0.0)

    def _collect(self, deadline_ns: int) -> None:
        """Receive until all answers are there, or the cycle is over."""
        answers, pacing = self._answers, self.pacing
        answers.begin()
        while not answers.complete:
            message = self._next_frame(deadline_ns)
            if message is None:
                break
            slot = self._answers.slots.get(message.arbitration_id) if _is_plain(message) else None
            if slot is None:
                self._process_other(message)
            elif len(message.data) != slot.length:
                self._note_length(slot, message.arbitration_id, len(message.data))
            else:
                if isinstance(pacing, LockstepSync) and not answers.any:  # such a cell answers all at once
                    deadline_ns = min(deadline_ns, pacing.clock() + round(pacing.timeout_s * 1e9) // STRAGGLING)
                answers.take(message.arbitration_id, slot, message.data)
        self.silent = not answers.any
        self._silent_cycles = self._silent_cycles + 1 if self.silent else 0
        if not self.silent:
            self._answered_ns = pacing.clock()

    def _note_length(self, slot: Slot, identifier: int, found: int) -> None:
        """Report a PDO of wrong length: the first may have been corrupted, one with the next SYNC too is a fault."""
        self._counts["wrong_length"] += 1
        axis = self.network.axes[slot.axis]
        reason = f"PDO {identifier:03X}h has {found} bytes, its mapping has {slot.length}"
        if identifier not in self._last_wrong_length or self._last_wrong_length[identifier] < self._cycles - 1:
            text = f"{node_label(axis)}: {reason}"
            self.emit(CellEvent(self.time_ns, slot.axis, EventKind.PDO_LENGTH, identifier, text))
        elif self._last_wrong_length[identifier] == self._cycles - 1:
            remedy = "did another program change the mapping, or does another device use this COB-ID?"
            self._watch.faults.append(DriveFault(axis, reason, remedy=remedy))
        self._last_wrong_length[identifier] = self._cycles

    def read_on(self, seconds: float, lag_s: float = 0.0) -> None:
        """Count the frames left after the last cycle, and losses that are reported late. Sends no SYNC.

        The first call stops the SYNC that is followed. An answer more than SYNCs shows that earlier ones were late
        (answers.py). Answers after the first call do not count: another SYNC may have been sent by then, to stop axes
        by SDO.

        Args:
            seconds: to read on; counted from the last SYNC, if more SYNCs come.
            lag_s: longest further time to wait for these SYNCs, and for a capture process that has not received what
                came in time.

        Raises:
            BusError: the bus is lost, and with it the last reports.
            NodeMisplaced: as `next`.
        """
        clock, bus, answers, pacing = self.pacing.clock, self._link.bus, self._answers, self.pacing
        counted, self._cycle_over = not self._cycle_over, True
        begun = self._early_sync is not None  # a cycle without a sample
        if begun:
            answers.begin()
        last_ns = (end_ns := clock() + round(seconds * 1e9)) + round(lag_s * 1e9)
        with bus_errors(self._link.address):
            if counted and isinstance(pacing, FollowedSync) and pacing.stop is not None:
                pacing.stop()
            while (now_ns := clock()) < end_ns or (now_ns < last_ns and lags_behind(bus, end_ns)):
                self._link.beat()
                late = bus.recv((end_ns - now_ns) * 1e-9 if now_ns < end_ns else PATIENCE_S)
                if late is None:
                    continue
                if _is_sync(late) and (isinstance(pacing, FollowedSync) or not late.is_rx):
                    if begun:
                        answers.leave()
                    answers.begin()
                    begun = True
                    end_ns = min(last_ns, max(end_ns, clock() + round(seconds * 1e9)))
                slot = answers.slots.get(late.arbitration_id) if _is_plain(late) else None
                if slot is None or (counted and not begun):
                    self._between_cycles(late)
                elif counted and len(late.data) == slot.length:
                    answers.take(late.arbitration_id, slot, late.data)
        self._note_losses()
        self._watch.note_events(self.time_ns)

    def _between_cycles(self, message: can.Message) -> None:
        """Process a frame that is read before the next SYNC, and so answers none that is open."""
        slot = self._answers.slots.get(message.arbitration_id) if _is_plain(message) else None
        if slot is None:
            self._process_other(message)
        elif self._cycles == 0:
            self._counts["foreign"] += 1
        else:
            self._answers.take_between(slot)

    def _process_other(self, message: can.Message) -> None:
        if self._link.dispatch(message) or not 0x180 <= message.arbitration_id < 0x580:
            return
        ours = not message.is_extended_id and message.arbitration_id & 0x7F in self.network.node_ids
        self._counts["surplus" if ours and self._cycles else "foreign"] += 1

    def _finish_cycle(self) -> Sample:
        values, axes = self._answers.values, len(self.network.axes)
        # A skipped period has a number too, so that a gap is visible in the samples.
        cycle = self._cycles - 1 + self._skipped
        missing = self._answers.end()
        self._incomplete_cycles = self._incomplete_cycles + 1 if missing else 0
        if missing:
            silent = tuple(axis for axis in range(axes) if missing >> axis & 1)
            names = [node_label(self.network.axes[axis]) for axis in silent]
            for axis, name in zip(silent, names, strict=True):
                text = f"no complete answer from {name} to cycle {cycle}"
                self.emit(CellEvent(self.time_ns, axis, EventKind.SAMPLE_LOST, cycle, text))
            if self._incomplete_cycles > MAX_MISSING_CYCLES:
                # A reader that is late takes many cycles at once; those waited for no answer by the clock.
                silent_ns = max(self.pacing.clock() - self._answered_ns, self._silent_cycles * self.pacing.period_ns)
                silent_s = silent_ns * 1e-9 if self.silent else None  # doubtful answers are answers
                self._watch.faults.append(SampleLost(cycle, silent, names, silent_s))
        self._note_losses()
        statuswords = tuple(values[2 * axes :])
        self._watch.cycle(self.time_ns, self.pacing.clock(), statuswords, missing)
        return Sample(cycle, self.time_ns, tuple(values[:axes]), tuple(values[axes : 2 * axes]), statuswords, missing)

    def _note_losses(self) -> None:
        """Report frames that this machine lost; their content is unknown."""
        counted = losses_of(self._link.bus)
        if counted == self._counted:
            return
        new, self._counted, self._losses = counted.since(self._counted), counted, counted.since(self._base)
        for count, where in (
            (new.kernel, "in the kernel's receive buffer, which was full"),
            (new.interface, "by the interface, before the receive buffer"),
            (new.backlog, "by the capture process, whose backlog was full"),
        ):
            if count:
                text = f"{count} frames dropped {where}"
                self.emit(CellEvent(self.time_ns, None, EventKind.FRAMES_DROPPED, count, text))
