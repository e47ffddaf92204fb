"""The SYNC-grouped stream: one SYNC, sent or followed, the answers of all axes, one Sample.

The stream is the only reader of the bus while it runs. Where frames have the kernel's stamps, our
own SYNC comes back among them, and a cycle lasts from one SYNC to the next in the order of the
frames, however late they are read: SYNC is sent on schedule while the stream waits for frames.
Where they have none, a cycle ends by the clock, after everything that has arrived was read. Which
answer belongs to which SYNC is decided in answers.py, the pacings are in sync.py.
"""

from __future__ import annotations

from collections.abc import Iterator

import can

from drivers.canopen.bus import bus_errors, is_plain
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.socketcan import Losses, lags_behind, losses_of, remarks_of
from drivers.errors import BusError, DriveFault, NodeMisplaced, SampleLost, node_label
from drivers.messages import EventKind, EventSink, Sample
from drivers.stream.answers import Answers, Slot, StreamStatistics
from drivers.stream.cycles import CycleBus, Cycles
from drivers.stream.sync import PATIENCE_S, Pacing
from drivers.stream.watch import Watch

#: Tolerated incomplete cycles in a row; they are counted, and marked in the samples
MAX_MISSING_CYCLES = 3


class SyncStream:
    """An iterator of Samples that never ends by itself; ``next`` raises what must stop a recording.

    Args:
        network: a prepared network; only the stream may read its bus meanwhile.
        pacing: schedule of SYNC.
        on_event: receives EMCY, NMT and CiA 402 changes and losses before the sample of their cycle
            is returned.

    Raises:
        SampleLost: more incomplete cycles in a row than `MAX_MISSING_CYCLES`.
        DriveFault: an EMCY, a new fault or following error, a node that left OPERATIONAL or sends
            no heartbeat for two of its periods, an active limit, stale data, or a PDO of wrong
            length twice in a row.
        BusBusy: another master sends SYNC, NMT commands or set-points of an axis.
        BusError: the bus, one of its parts or the capture process is lost, the followed SYNC
            stopped, or the bus is read more than a second late.
        NodeMisplaced: a node is heard on another of the cell's buses than its own.
    """

    def __init__(
        self,
        network: CanopenNetwork,
        pacing: Pacing,
        on_event: EventSink = lambda _event: None,
    ) -> None:
        self.network = network
        self.pacing = pacing
        self._link = network.link
        self._answers = Answers(network.axes, network.pdos, certain=pacing.waits_for_answers)
        self._counts = self._answers.counts
        #: The bus as the cycles use it. `drivers.motion.execute` adds frames to send with the next
        #: SYNC, and reads whether an axis answered the last one.
        self.bus = CycleBus(
            network.link,
            pacing.clock,
            pacing.start_ns,
            emit=on_event,
            process_between=self._process_between_cycles,
        )
        self._watch = Watch(network, self.bus, real_time=not pacing.waits_for_answers)
        self._cycles: Cycles = pacing.cycles(self.bus)
        # Cycle of the last PDO of wrong length, by COB-ID
        self._last_wrong_length: dict[int, int] = {}
        # Whether `read_on` was called since the last cycle
        self._has_read_on = False
        # Counted by the bus since it was opened: up to the first SYNC, and up to the last report
        self._losses_at_begin = Losses()
        self._losses = Losses()
        self._incomplete_cycles = 0  # the last ones in a row
        self._silent_cycles = 0  # the last ones in a row

    @property
    def time_ns(self) -> int:
        """Time of the last SYNC [ns since 1970]; the pacing's start before the first one."""
        return self.bus.time_ns

    @property
    def statistics(self) -> StreamStatistics:
        """Counts up to now."""
        losses = self._losses.since(self._losses_at_begin)
        return StreamStatistics(
            cycles=self.bus.cycles,
            skipped_periods=self.bus.skipped,
            kernel_dropped=losses.kernel,
            interface_dropped=losses.interface,
            backlog_dropped=losses.backlog,
            **self._counts,
        )

    def __iter__(self) -> Iterator[Sample]:
        return self

    def __next__(self) -> Sample:
        self.check()
        return self.advance()

    def check(self) -> None:
        """Raise the oldest fault that was not raised yet."""
        if self.bus.faults:
            raise self.bus.faults.popleft()

    def advance(self) -> Sample:
        """Run one cycle even with faults, as stopping the axes needs; `__next__` raises them later.

        Raises:
            BusError: the bus is lost.
            NodeMisplaced: as `next`.
        """
        self._has_read_on = False
        try:
            with bus_errors(self._link.address):
                if self.bus.cycles == 0:
                    self._begin()
                self._open_cycle()
                self._collect()
        except (BusError, NodeMisplaced) as error:
            if self.bus.cycles > 0:
                # There may be no later cycle that would report them.
                self._note_losses()
            self.bus.report(None, EventKind.BUS_LOST, 0, str(error))
            raise
        return self._finish_cycle()

    def _begin(self) -> None:
        """Discard the frames from before the first SYNC; losses before it do not count."""
        self.bus.begin()
        self._cycles = self._cycles.begin()
        self._losses_at_begin = losses_of(self._link.bus)
        self._losses = self._losses_at_begin
        for remark in remarks_of(self._link.bus):
            self.bus.report(None, EventKind.CAPTURE, 0, remark)

    def _open_cycle(self) -> None:
        """Begin a cycle with its SYNC; where SYNC comes no more, other cycles take over."""
        successor = self._cycles.open()
        while successor is not None:
            self._cycles = successor
            successor = self._cycles.open()

    def _slot_of(self, message: can.Message) -> Slot | None:
        """Return the slot of a TPDO of an axis; None for every other frame."""
        if is_plain(message):
            return self._answers.slots.get(message.arbitration_id)
        return None

    def _collect(self) -> None:
        """Receive until all answers are there, or the cycle is over."""
        answers = self._answers
        cycles = self._cycles
        answers.begin()
        while not answers.complete:
            message = cycles.next_frame()
            if message is None:
                break
            slot = self._slot_of(message)
            if slot is None:
                self._process_other(message)
            elif len(message.data) != slot.length:
                self._note_length(slot, message.arbitration_id, len(message.data))
            else:
                if not answers.any:
                    cycles.note_first_answer()
                answers.take(message.arbitration_id, slot, message.data)
        self.bus.silent = not answers.any
        if self.bus.silent:
            self._silent_cycles += 1
        else:
            self._silent_cycles = 0
            self.bus.answered_ns = self.bus.clock()

    def _note_length(self, slot: Slot, identifier: int, found: int) -> None:
        """Report a PDO of wrong length.

        The first may have been corrupted on the bus. Another one in the next cycle is a fault; one
        more in the same cycle is only counted.
        """
        self._counts["wrong_length"] += 1
        axis = self.network.axes[slot.axis]
        reason = f"PDO {identifier:03X}h has {found} bytes, its mapping has {slot.length}"
        cycle = self.bus.cycles
        last_cycle = self._last_wrong_length.get(identifier)
        if last_cycle is None or last_cycle < cycle - 1:
            text = f"{node_label(axis)}: {reason}"
            self.bus.report(slot.axis, EventKind.PDO_LENGTH, identifier, text)
        elif last_cycle == cycle - 1:
            remedy = (
                "did another program change the mapping, or does another device use this COB-ID?"
            )
            self.bus.faults.append(DriveFault(axis, reason, remedy=remedy))
        self._last_wrong_length[identifier] = cycle

    def read_on(self, seconds: float, lag_s: float = 0.0) -> None:
        """Count the frames left after the last cycle, and losses that are reported late.

        Sends no SYNC. The first call after a cycle pauses the followed producer, and counts the
        answers that still come: one answer too many shows that earlier ones were late (answers.py).
        Further calls count no answers: another SYNC may have been sent by then, to stop axes by
        SDO.

        Args:
            seconds: to read on; counted from the last SYNC, if more SYNCs come.
            lag_s: longest further time to wait for these SYNCs, and for a capture process that has
                not received what came in time.

        Raises:
            BusError: the bus is lost, and with it the last reports.
            NodeMisplaced: as `next`.
        """
        is_first_call = not self._has_read_on
        self._has_read_on = True
        try:
            with bus_errors(self._link.address):
                self._read_late(seconds, lag_s, count_answers=is_first_call)
        except (BusError, NodeMisplaced):
            self._note_losses()
            raise
        self._note_losses()
        self._watch.note_events()

    def _read_late(self, seconds: float, lag_s: float, *, count_answers: bool) -> None:
        """Read the frames after the last cycle; see `read_on`.

        A SYNC among them begins another cycle, of which no sample is made.
        """
        clock = self.bus.clock
        bus = self._link.bus
        answers = self._answers
        cycles = self._cycles
        duration_ns = round(seconds * 1e9)
        in_cycle = cycles.early_sync is not None
        if in_cycle:
            answers.begin()
        end_ns = clock() + duration_ns
        latest_end_ns = end_ns + round(lag_s * 1e9)
        if count_answers:
            cycles.stop()
        while True:
            now_ns = clock()
            if now_ns < end_ns:
                wait_s = (end_ns - now_ns) * 1e-9
            elif now_ns < latest_end_ns and lags_behind(bus, end_ns):
                wait_s = PATIENCE_S
            else:
                break
            self._link.beat()
            message = bus.recv(wait_s)
            if message is None:
                continue
            if cycles.is_next_sync(message):
                if in_cycle:
                    answers.leave()
                answers.begin()
                in_cycle = True
                end_ns = max(end_ns, clock() + duration_ns)
                end_ns = min(end_ns, latest_end_ns)
            slot = self._slot_of(message)
            if slot is None:
                self._process_other(message)
            elif count_answers:
                self._count_late_answer(slot, message, in_cycle=in_cycle)

    def _count_late_answer(self, slot: Slot, message: can.Message, *, in_cycle: bool) -> None:
        """Count an answer after the last cycle; `in_cycle` after another SYNC."""
        if not in_cycle:
            self._process_between_cycles(message)
        elif len(message.data) != slot.length:
            self._note_length(slot, message.arbitration_id, len(message.data))
        else:
            self._answers.take(message.arbitration_id, slot, message.data)

    def _process_between_cycles(self, message: can.Message) -> None:
        """Process a frame that is read after a cycle has ended and before the next SYNC."""
        slot = self._slot_of(message)
        if slot is None:
            self._process_other(message)
        elif self.bus.cycles == 0:
            # From before the first SYNC: it does no harm.
            self._counts["foreign"] += 1
        elif len(message.data) != slot.length:
            self._note_length(slot, message.arbitration_id, len(message.data))
        else:
            self._answers.take_between(slot)

    def _process_other(self, message: can.Message) -> None:
        """Process a frame that is no mapped TPDO of an axis; count it if it is another PDO."""
        if self._link.dispatch(message):
            return
        identifier = message.arbitration_id
        is_pdo = 0x180 <= identifier < 0x580
        if not is_pdo:
            return
        node_id = identifier & 0x7F
        of_our_axis = node_id in self.network.node_ids and not message.is_extended_id
        if of_our_axis and self.bus.cycles:
            self._counts["surplus"] += 1
        else:
            self._counts["foreign"] += 1

    def _finish_cycle(self) -> Sample:
        """Return the sample of the cycle, after its faults and losses are noted."""
        # The first cycle has number 0. A skipped period has a number too, so that a gap is visible
        # in the samples.
        cycle = self.bus.cycles - 1 + self.bus.skipped
        missing = self._answers.end()
        if missing:
            self._incomplete_cycles += 1
            self._report_missing(cycle, missing)
        else:
            self._incomplete_cycles = 0
        self._note_losses()
        axes = len(self.network.axes)
        values = self._answers.values
        position = tuple(values[:axes])
        current = tuple(values[axes : 2 * axes])
        statuswords = tuple(values[2 * axes :])
        self._watch.cycle(statuswords, missing)
        return Sample(cycle, self.time_ns, position, current, statuswords, missing)

    def _report_missing(self, cycle: int, missing: int) -> None:
        """Report the axes without a complete answer, bit i for axis i;
        too many such cycles in a row are a fault.
        """
        absent = tuple(axis for axis in range(len(self.network.axes)) if missing >> axis & 1)
        names = [node_label(self.network.axes[axis]) for axis in absent]
        for axis, name in zip(absent, names, strict=True):
            text = f"no complete answer from {name} to cycle {cycle}"
            self.bus.report(axis, EventKind.SAMPLE_LOST, cycle, text)
        if self._incomplete_cycles <= MAX_MISSING_CYCLES:
            return
        # Doubtful answers (answers.py) mark an axis as missing too, but it is not silent.
        silent_s = None
        if self.bus.silent:
            # A late reader takes many cycles at once, in almost no time by the clock.
            by_clock_ns = self.bus.clock() - self.bus.answered_ns
            by_cycles_ns = self._silent_cycles * self.pacing.period_ns
            silent_s = max(by_clock_ns, by_cycles_ns) * 1e-9
        reported: list[str] = []
        for axis in absent:
            node_id = self.network.axes[axis].node_id
            reported.append(self._link.reported.get(node_id, ""))
        self.bus.faults.append(SampleLost(cycle, absent, names, silent_s, reported))

    def _note_losses(self) -> None:
        """Report frames that this machine lost; their content is unknown."""
        losses = losses_of(self._link.bus)
        if losses == self._losses:
            return
        new = losses.since(self._losses)
        self._losses = losses
        for count, where in (
            (new.kernel, "in the kernel's receive buffer, which was full"),
            (new.interface, "by the interface, before the receive buffer"),
            (new.backlog, "by the capture process, whose backlog was full"),
        ):
            if count:
                text = f"{count} frames dropped {where}"
                self.bus.report(None, EventKind.FRAMES_DROPPED, count, text)
