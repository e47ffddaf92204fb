"""The pacings of a stream: the schedule of SYNC, and how the frames between two SYNCs are read.

Samples and events of all pacings have one epoch: wall time [ns since 1970] at the stream's first
SYNC, plus monotonic time since, so that setting the wall clock has no effect. On SocketCAN the time
of a SYNC is the kernel's, converted to the monotonic clock (drivers/canopen/capture.py); `clock`
must then be that clock.

A pacing is frozen data; `cycles` returns what a stream runs on. Cycles end by the clock
(`LockstepCycles`, `TimedCycles`) or by the next SYNC in the order of the frames (`EchoedCycles`,
`FollowedCycles`).
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import ClassVar

import can

from drivers.canopen.link import SYNC_COB_ID
from drivers.canopen.sdo import Clock
from drivers.canopen.socketcan import CapturedMessage, lags_behind, read_until_ns
from drivers.errors import BusError
from drivers.messages import EventKind
from drivers.stream.cycles import LARGEST_LAG_NS, CycleBus, Cycles, arrived_ns, is_sync

SHORTENED = 16
STRAGGLING = 4
"""Divisors of a lockstep time-out: if no axis answered the last SYNC,
and once another axis has answered this one.
"""
#: Time between two looks whether the capture process has received what came before a deadline
PATIENCE_S = 0.02
FRAMES_PER_S = 50_000
"""Frames per second of time-out to read past the deadline before a producer is dead;
two full buses carry fewer.
"""
STAMP_ERROR_NS = 1_000_000
"""More than any error of a stamp: the kernel's are converted to another clock, to some tens of
microseconds.
"""
#: SYNCs ahead of the schedule that are too many; a late producer catches up with one or two
SURPLUS = 3.0
DECAY = 0.99
"""Decay of the lead per SYNC: the permanent difference of two clocks, some tens of ppm,
then adds up to nothing.
"""


@dataclass(frozen=True, slots=True)
class LockstepSync:
    """Send the next SYNC when the last one is answered:
    for a simulated cell, whose time is the SYNC itself.

    The time of the samples is made up, one period a cycle.
    """

    period_ns: int  #: time of one cycle [ns]
    timeout_s: float = 1.0  #: time in which one cycle must be answered [s of the clock]
    start_ns: int = 0  #: wall time of cycle 0 [ns since 1970]
    clock: Clock = time.monotonic_ns  #: for the time-out and the heartbeats [ns]
    #: Whether SYNC waits for the answers to the one before: none is late, and the samples' time is
    #: not the clock's.
    waits_for_answers: ClassVar[bool] = True

    def cycles(self, bus: CycleBus) -> Cycles:
        """Return the cycles of a stream with this pacing."""
        return LockstepCycles(bus, self)


@dataclass(frozen=True, slots=True)
class TimedSync:
    """Send a SYNC every period by the clock, on an absolute schedule that starts with the first
    one.

    Whole periods that were missed are counted and left out; there is never a burst to catch up.
    """

    period_ns: int  #: of the schedule [ns]
    start_ns: int = 0  #: wall time of the first SYNC [ns since 1970]
    #: monotonic [ns]; the time since the first SYNC is added to start_ns
    clock: Clock = time.monotonic_ns
    waits_for_answers: ClassVar[bool] = False  #: see `LockstepSync`

    def cycles(self, bus: CycleBus) -> Cycles:
        """Return the cycles of a stream with this pacing."""
        return TimedCycles(bus, self.period_ns)


class Producer:
    """A SYNC producer that keeps its period by itself, also after the last cycle."""

    #: Whether it is this machine's kernel; a SYNC from the wire is then another device's
    in_kernel = False

    def __init__(self, name: str, period_us: int) -> None:
        self.name = name  #: For messages
        self.period_us = period_us

    def pacing(self, timeout_s: float, start_ns: int, clock: Clock) -> FollowedSync:
        """Return the pacing of a stream that follows this producer; see `FollowedSync`."""
        return FollowedSync(1000 * self.period_us, self, timeout_s, start_ns, clock)

    def seen(self, monotonic_ns: int, periods: int) -> None:
        """Process a SYNC by its time [ns], and its periods since the one before,
        0 for the first.
        """

    def rest(self) -> None:
        """Stop sending until the next start, if that begins a new phase of SYNC."""

    def pause(self) -> None:
        """Stop sending, without waiting for an answer."""


@dataclass(frozen=True, slots=True)
class FollowedSync:
    """Follow the SYNC of a producer that we started: each SYNC that is seen begins a cycle.

    The order of the frames on the bus decides which cycle they belong to: a late reader loses
    nothing. On a bus without stamps, its delay counts as periods that were left out.
    """

    period_ns: int  #: of the producer [ns]
    producer: Producer  #: is paused after the last cycle
    #: Time without a SYNC after which the producer counts as dead; the stream then sends SYNC
    #: itself, because the axes are stopped by frames that act on SYNC.
    timeout_s: float = 0.1
    start_ns: int = 0  #: wall time of the first SYNC [ns since 1970]
    #: monotonic [ns]; the time since the first SYNC is added to start_ns
    clock: Clock = time.monotonic_ns
    waits_for_answers: ClassVar[bool] = False  #: see `LockstepSync`

    def cycles(self, bus: CycleBus) -> Cycles:
        """Return the cycles of a stream with this pacing."""
        return FollowedCycles(bus, self)


Pacing = LockstepSync | TimedSync | FollowedSync


class _CyclesByClock(Cycles):
    """Cycles that end at a deadline, after everything that has arrived was read."""

    def __init__(self, bus: CycleBus) -> None:
        super().__init__(bus)
        self._deadline_ns = 0

    def _read_the_rest(self) -> int:
        """Process what has arrived since the last cycle; returns the time by the clock [ns]."""
        bus = self.bus
        bus.link.beat()
        bus.read_waiting()
        now_ns = bus.clock()
        if bus.cycles == 0:
            bus.answered_ns = now_ns
        return now_ns

    def next_frame(self) -> can.Message | None:
        bus = self.bus
        recv = bus.link.bus.recv
        while (left_ns := self._deadline_ns - bus.clock()) > 0:
            message = recv(left_ns * 1e-9)
            if message is not None and message.is_rx:
                return message
        # What has arrived belongs to this cycle: the next SYNC is not sent yet.
        return None if -left_ns > LARGEST_LAG_NS else recv(0.0)


class LockstepCycles(_CyclesByClock):
    """A cycle ends when all axes have answered, or after its time-out."""

    def __init__(self, bus: CycleBus, pacing: LockstepSync) -> None:
        super().__init__(bus)
        self._pacing = pacing
        self._timeout_ns = round(pacing.timeout_s * 1e9)

    def open(self) -> None:
        bus = self.bus
        pacing = self._pacing
        now_ns = self._read_the_rest()
        bus.time_ns = pacing.start_ns + bus.cycles * pacing.period_ns
        # A cell that was silent for the whole time gets less the next time: the stop must not take
        # minutes.
        if bus.silent:
            bound_s = pacing.timeout_s / SHORTENED
        else:
            bound_s = pacing.timeout_s
        self._deadline_ns = now_ns + round(bound_s * 1e9)
        bus.send_sync()
        bus.cycles += 1

    def note_first_answer(self) -> None:
        # A simulated cell answers all at once.
        straggling_ns = self.bus.clock() + self._timeout_ns // STRAGGLING
        self._deadline_ns = min(self._deadline_ns, straggling_ns)


class TimedCycles(_CyclesByClock):
    """A cycle lasts from one SYNC to the time of the next one;
    for a bus whose frames have no stamps.

    Args:
        bus: of the stream.
        period_ns: of the schedule [ns].
        due_ns: time of the next SYNC by the clock [ns]; the first SYNC of a stream is sent at once.
    """

    def __init__(self, bus: CycleBus, period_ns: int, due_ns: int = 0) -> None:
        super().__init__(bus)
        self._period_ns = period_ns
        self._due_ns = due_ns

    def begin(self) -> Cycles:
        if read_until_ns(self.bus.link.bus) is None:
            return super().begin()
        return EchoedCycles(self.bus, self._period_ns).begin()

    def open(self) -> None:
        bus = self.bus
        now_ns = self._read_the_rest()
        if bus.cycles == 0:
            self._due_ns = now_ns
        while (left_ns := self._due_ns - now_ns) > 0:
            message = bus.link.bus.recv(left_ns * 1e-9)
            if message is not None:
                bus.process_between(message)
            now_ns = bus.clock()
        slipped = (now_ns - self._due_ns) // self._period_ns
        bus.skipped += slipped
        bus.check_lag(slipped * self._period_ns)
        bus.stamp(now_ns)
        self._due_ns += (slipped + 1) * self._period_ns
        self._deadline_ns = self._due_ns
        bus.send_sync()
        bus.cycles += 1


class _CyclesByOrder(Cycles):
    """Cycles that end with the next SYNC, in the order of the frames on the bus."""

    def __init__(self, bus: CycleBus) -> None:
        super().__init__(bus)
        self._begun_ns = 0  # by the clock; an earlier SYNC begins no cycle

    def _is_from_before(self, message: can.Message) -> bool:
        """Return whether a frame is older than the stream.

        A capture process that had to wait for a processor still hands over such frames after
        `begin` has read all that were there.
        """
        if self.bus.cycles or not isinstance(message, CapturedMessage):
            return False
        return message.monotonic_ns < self._begun_ns

    @abstractmethod
    def _read(self) -> can.Message | None:
        """Return the next frame; None if none comes in time."""

    def _next_sync(self) -> can.Message | None:
        """Process the frames before the next SYNC, and return it; None if it does not come."""
        sync = self.early_sync
        self.early_sync = None
        while sync is None:
            message = self._read()
            if message is None:
                return None
            if self.is_next_sync(message) and not self._is_from_before(message):
                sync = message
            else:
                self.bus.process_between(message)
        return sync

    def next_frame(self) -> can.Message | None:
        message = self._read()
        if message is None or not self.is_next_sync(message):
            return message
        self.early_sync = message
        return None


class EchoedCycles(_CyclesByOrder):
    """A cycle lasts from our SYNC to our next one:
    both come back among the frames of a bus with stamps.

    SYNC is sent on schedule while frames are waited for.

    Args:
        bus: of the stream.
        period_ns: of the schedule [ns].
    """

    def __init__(self, bus: CycleBus, period_ns: int) -> None:
        super().__init__(bus)
        self._period_ns = period_ns
        self._due_ns = 0
        # Each SYNC that was sent and has not come back: its time by the clock [ns], and the periods
        # left out before it.
        self._sent: deque[tuple[int, int]] = deque()
        self._comes_back = True

    def begin(self) -> Cycles:
        # Our first SYNC follows at once, and must not seem older because of its stamp's error.
        self._begun_ns = self.bus.clock() - STAMP_ERROR_NS
        return super().begin()

    def open(self) -> Cycles | None:
        bus = self.bus
        if bus.cycles == 0:
            self._due_ns = bus.clock()
            bus.answered_ns = self._due_ns
        sync = self._next_sync()
        if sync is None:
            return TimedCycles(bus, self._period_ns, self._due_ns)
        now_ns = bus.clock()
        at_ns = arrived_ns(sync, now_ns)
        bus.check_lag(now_ns - at_ns)
        if self._sent:
            _, left_out = self._sent.popleft()
            bus.skipped += left_out
        bus.stamp(at_ns)
        bus.cycles += 1
        return None

    def _read(self) -> can.Message | None:
        """Return the next frame, and send SYNC when it is due;
        None once SYNC does not come back.
        """
        bus = self.bus
        if self._comes_back and (taken := bus.next_of_burst()) is not None:
            return taken
        while self._comes_back:
            bus.link.beat()
            now_ns = bus.clock()
            if now_ns >= self._due_ns:
                left_out = (now_ns - self._due_ns) // self._period_ns
                bus.check_lag(left_out * self._period_ns)
                self._due_ns += (left_out + 1) * self._period_ns
                bus.send_sync()
                self._sent.append((now_ns, left_out))
            if self._sent and bus.check_lag(now_ns - self._sent[0][0]):
                # From now on, cycles end by the clock.
                self._comes_back = False
                bus.skipped += sum(left_out for _, left_out in self._sent) + len(self._sent)
            elif (message := bus.link.bus.recv((self._due_ns - now_ns) * 1e-9)) is not None:
                return message
        return None


class FollowedCycles(_CyclesByOrder):
    """A cycle lasts from one SYNC of a producer to the next, in the order of the frames."""

    def __init__(self, bus: CycleBus, pacing: FollowedSync) -> None:
        super().__init__(bus)
        self._pacing = pacing
        self._timeout_ns = round(pacing.timeout_s * 1e9)
        self._rate = SyncRate(pacing.period_ns)
        self._last_sync_ns = 0
        self._deadline_ns = 0
        self._waited = False  # whether the last cycle waited for an answer in vain
        self._reads_past_deadline = 0

    def begin(self) -> Cycles:
        bus = self.bus
        self._begun_ns = bus.clock()
        for message in bus.arrived_frames():
            if (
                is_sync(message)
                and isinstance(message, CapturedMessage)
                and message.monotonic_ns > self._begun_ns
            ):
                # If frames arrive as fast as they are read, the loop would not end
                self.early_sync = message
                break
            bus.process_between(message)
        return self

    def open(self) -> Cycles | None:
        bus = self.bus
        bus.link.beat()
        if outgoing := bus.take_outgoing():
            # As early in the period as possible: all of it should arrive before the next SYNC.
            bus.link.send(outgoing)
        # A cycle that waited in vain for answers waited for this SYNC too: half of the time-out is
        # enough.
        if self._waited:
            bound_ns = self._timeout_ns // 2
        else:
            bound_ns = self._timeout_ns
        self._deadline_ns = bus.clock() + bound_ns
        sync = self._next_sync()
        if sync is None:
            return self._lose_sync()
        self._take_sync(sync)
        return None

    def _take_sync(self, sync: can.Message) -> None:
        """Begin the cycle of a SYNC that was read."""
        bus = self.bus
        pacing = self._pacing
        at_ns = arrived_ns(sync, bus.clock())
        periods = 0
        if bus.cycles == 0:
            bus.answered_ns = at_ns
        else:
            # One period after the SYNC before it, or more where SYNCs between them did not come.
            since_ns = at_ns - self._last_sync_ns
            periods = max(1, self._periods_in(since_ns))
            bus.skipped += periods - 1
            # Without a stamp, the reader may be late instead of the SYNC
            if isinstance(sync, CapturedMessage):
                latest_ns = pacing.period_ns
            else:
                latest_ns = LARGEST_LAG_NS
            if self._rate.too_fast(since_ns, latest_ns):
                bus.link.note_foreign(SYNC_COB_ID)
        if pacing.producer.in_kernel and isinstance(sync, CapturedMessage) and not sync.local:
            bus.link.note_foreign(SYNC_COB_ID)
        now_ns = bus.clock()
        bus.check_lag(now_ns - at_ns)
        pacing.producer.seen(at_ns, periods)
        self._last_sync_ns = at_ns
        bus.stamp(at_ns)
        bus.cycles += 1
        self._reads_past_deadline = 0
        self._waited = False
        self._deadline_ns = now_ns + self._timeout_ns

    def _periods_in(self, time_ns: int) -> int:
        """Return the number of periods in a time, rounded."""
        return (time_ns + self._pacing.period_ns // 2) // self._pacing.period_ns

    def _lose_sync(self) -> Cycles:
        """Report the dead producer, and send SYNC from now on, because the axes must be stopped."""
        bus = self.bus
        pacing = self._pacing
        reason = f"no SYNC from {pacing.producer.name} for {pacing.timeout_s:g} s"
        bus.report(None, EventKind.SYNC_LOST, bus.cycles, reason)
        bus.faults.append(BusError(str(bus.link.address), reason))
        due_ns = bus.clock()
        if bus.cycles:
            # The wait leaves a gap in the cycles, as it does in their times.
            bus.skipped += max(0, self._periods_in(due_ns - self._last_sync_ns) - 1)
        return TimedCycles(bus, pacing.period_ns, due_ns)

    def next_frame(self) -> can.Message | None:
        message = super().next_frame()
        self._waited = message is None and self.early_sync is None
        return message

    def _read(self) -> can.Message | None:
        """Return the next frame that arrived before the deadline, even if it is read late;
        None without any.

        Only the order on the bus counts: frames that have arrived are read first, whatever the
        clock shows.
        """
        bus = self.bus
        end_ns = self._deadline_ns
        if (taken := bus.next_of_burst()) is not None:
            return taken
        recv = bus.link.bus.recv
        bus.link.beat()
        while (left_ns := end_ns - (now_ns := bus.clock())) > 0:
            if (message := recv(left_ns * 1e-9)) is not None:
                return message
        self._reads_past_deadline += 1
        if self._reads_past_deadline > FRAMES_PER_S * self._pacing.timeout_s:
            return None
        message = recv(0.0)
        # A capture process that was stopped has not received all of it yet.
        while (
            message is None
            and now_ns < end_ns + LARGEST_LAG_NS
            and lags_behind(bus.link.bus, end_ns)
        ):
            bus.link.beat()
            message = recv(PATIENCE_S)
            now_ns = bus.clock()
        return message

    def is_next_sync(self, message: can.Message) -> bool:
        """Return whether a frame is a SYNC, which the producer has sent."""
        return is_sync(message)

    def stop(self) -> None:
        self._pacing.producer.pause()


class SyncRate:
    """Detects a second SYNC producer: its SYNCs look like the expected producer's,
    but then too many arrive.

    Jitter cancels out: a late SYNC is followed by an early one.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ahead = 0.0

    def too_fast(self, since_last_ns: int, latest_ns: int) -> bool:
        """Whether a SYNC this long after the one before is one too many.

        `latest_ns` is how late the one before may have been: as many may follow it at once.
        """
        lead = self._ahead
        if lead >= -1.0:  # below, as many SYNCs are still to come as the reader was late
            lead *= DECAY
        lead += 1.0 - since_last_ns / self._period_ns
        self._ahead = max(-latest_ns / self._period_ns, lead)
        return self._ahead > SURPLUS
