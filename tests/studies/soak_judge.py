"""Whose a lost value is: the host's, or ours.

A recording is compared with what an independent listener heard on its bus, and with what the
machine took from the programs at that time (tests/vcan/host_watch.py). Nothing of the product is
imported. A value is lost where the log has no sample of a period, or marks the value as missing.
It is the host's loss

- if the machine took half a period or more from the programs around that period: they waited for a
  processor, or the processors were slow or gone; or if the kernel dropped packets because a queue
  was full;
- or if the listener lacks the value as well, although SYNC came on schedule: by the stamps, the
  answer came after the next SYNC was due, or not at all.

Every other loss is ours: the listener has the value and the log has not, or SYNC was late without
anybody taking the processor from its sender. A value that is marked only because the answer before
it was late (`drivers.stream.answers` explains the doubt) has the cause of that one. Samples left
out without a gap in the cycles, and values that were not on the bus, are ours always.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from tests.vcan.host_watch import STEAL_NS, Tick
from tests.vcan.judgement import DEMO, SAME_SYNC_NS, SYNC, TPDO1, compare
from tests.vcan.listener import Frame
from tests.vcan.log_reader import Recorded

STARVED_PERIODS = 0.5
"""Time taken from the programs around a period, in periods, from which on its losses are the
host's.
"""
PUNCTUAL_PERIODS = 0.5
"""A SYNC that is followed by the next one sooner left the axes too little time."""
USUAL_PERCENT = 50
SLOW = 1.5
"""The usual time of the watch's piece of work is its median; up to so many times that, it is not
slow.
"""
DUE_PERIODS = 50
"""The schedule of a SYNC that the recorder sends by the clock is that of the most punctual one of
so many periods before it: the clocks of recorder and bus may drift.
"""
END_CYCLES = 8
"""A recording that supervision ended is judged by its last cycles."""
END_S = 1.5
END_TAKEN_S = 0.3
"""Of the last seconds, and time taken in them from which on the end is the host's: heartbeats and
the reader of the bus count as lost after some tenths of a second (docs/reference/faults.md).
"""


class Cause(Enum):
    """Whose loss it is."""

    OURS = "ours"
    HOST = "host"


class LossKind(Enum):
    """How a value is lost."""

    NO_SYNC = "no SYNC in its period"
    LATE = "no answer on the bus before the next SYNC was due"
    UNREAD = "the answer was on the bus in time"
    DOUBTFUL = "marked because the answer before it was late"
    UNCOUNTED = "a SYNC without a sample and without a gap in the cycles"


@dataclass(frozen=True)
class Loss:
    """Lost values of one period."""

    cycle: int  #: number in the log
    kind: LossKind
    cause: Cause
    values: int = 1  #: number of values, one an axis


@dataclass
class Verdict:
    """Outcome for one recording."""

    frames: int = 0  #: heard by the listener from its first to its last sample
    values: int = 0  #: of all axes in all periods from the first to the last sample
    wrong: int = 0  #: violations of what a log promises, of whatever kind (`compare`)
    neighbours: int = 0  #: values of the cycle before or after, in a log that is refused for that
    starved_share: float = 0.0  #: share of the periods around which the host took too much
    losses: list[Loss] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  #: the first violations in words

    def lost(self, cause: Cause) -> int:
        """Number of values lost by a cause."""
        return sum(loss.values for loss in self.losses if loss.cause is cause)

    def by_kind(self) -> Counter[LossKind]:
        """Number of values lost by kind."""
        found: Counter[LossKind] = Counter()
        for loss in self.losses:
            found[loss.kind] += loss.values
        return found


class Host:
    """What the machine took from the watched programs.

    Args:
        ticks: of the watch, by processor and time.
    """

    def __init__(self, ticks: Sequence[Tick]) -> None:
        table = np.array(ticks, dtype=np.int64).reshape(-1, len(Tick._fields))
        columns = dict(zip(Tick._fields, table.T, strict=True))
        self._processors = []
        for cpu in np.unique(columns["cpu"]):
            own = columns["cpu"] == cpu
            self._processors.append(_Processor({name: kept[own] for name, kept in columns.items()}))

    def taken_ns(self, begin_ns: int, end_ns: int) -> int:
        """Return the time that was taken from the programs between two times [ns since 1970]:
        their waiting, and what the slowest processor lost.
        """
        waited_ns = [one.waited_ns(begin_ns, end_ns) for one in self._processors]
        lost_ns = [one.lost_ns(begin_ns, end_ns) for one in self._processors]
        return sum(waited_ns) + max(lost_ns, default=0)

    def dropped(self, begin_ns: int, end_ns: int) -> int:
        """Return the number of packets that the kernel dropped between two times."""
        return sum(one.dropped(begin_ns, end_ns) for one in self._processors)

    def describe(self, begin_ns: int, end_ns: int) -> str:
        """Say what the recorder did between two times, by the sum of the ticks in them."""
        of = {
            name: sum(one.total(name, begin_ns, end_ns) for one in self._processors)
            for name in ("ran_ns", "waited_ns", "major_faults", "disk_waits")
        }
        milliseconds = 1e-6 * (end_ns - begin_ns)
        return (
            f"in {milliseconds:.1f} ms the recorder's busiest thread ran {1e-6 * of['ran_ns']:.1f} "
            f"ms, its programs waited {1e-6 * of['waited_ns']:.1f} ms for a processor, it read "
            f"{of['major_faults']} pages from a disk and waited for it at {of['disk_waits']} ticks"
        )

    def starves(self, begin_ns: int, end_ns: int, period_ns: int) -> bool:
        """Return whether the host explains a loss between two times."""
        if self.dropped(begin_ns, end_ns):
            return True
        return self.taken_ns(begin_ns, end_ns) >= STARVED_PERIODS * period_ns


class _Processor:
    """The ticks of one processor, by column."""

    def __init__(self, columns: Mapping[str, NDArray[np.int64]]) -> None:
        self._columns = columns
        self._end_ns = columns["time_ns"]
        self._begin_ns = self._end_ns - columns["since_ns"]
        # Work that takes twice its usual time means that half of the time was taken.
        usual_ns = np.percentile(columns["work_ns"], USUAL_PERCENT)
        taken_share = np.maximum(0.0, 1.0 - SLOW * usual_ns / columns["work_ns"])
        slow_ns = (taken_share * columns["since_ns"]).astype(np.int64)
        self._slow_ns = np.maximum(slow_ns, columns["late_ns"])
        # A wait is counted when it ends, stolen time in ticks of the kernel: both began before.
        self._waited_from_ns = self._begin_ns - columns["waited_ns"]
        self._stolen_from_ns = self._begin_ns - STEAL_NS
        earliest_ns = np.minimum(self._waited_from_ns, self._stolen_from_ns)
        self._reach_ns = int((self._end_ns - earliest_ns).max(initial=0))

    def _chosen(self, begin_ns: int, end_ns: int) -> slice:
        """Return the ticks that may have something of the time between two times."""
        first = int(np.searchsorted(self._end_ns, begin_ns))
        last = int(np.searchsorted(self._end_ns, end_ns + self._reach_ns, side="right"))
        return slice(first, last)

    def _within(
        self,
        taken_ns: NDArray[np.int64],
        from_ns: NDArray[np.int64],
        begin_ns: int,
        end_ns: int,
    ) -> NDArray[np.int64]:
        """Return how much of each tick's taken time may lie between two times [ns]."""
        chosen = self._chosen(begin_ns, end_ns)
        until_ns = np.minimum(self._end_ns[chosen], end_ns)
        shared_ns = until_ns - np.maximum(from_ns[chosen], begin_ns)
        within_ns: NDArray[np.int64] = np.minimum(taken_ns[chosen], np.maximum(shared_ns, 0))
        return within_ns

    def waited_ns(self, begin_ns: int, end_ns: int) -> int:
        """Return the waiting time of the programs between two times [ns]."""
        waited_ns = self._columns["waited_ns"]
        return int(self._within(waited_ns, self._waited_from_ns, begin_ns, end_ns).sum())

    def lost_ns(self, begin_ns: int, end_ns: int) -> int:
        """Return the time that the processor itself lost between two times [ns]."""
        slow_ns = self._within(self._slow_ns, self._begin_ns, begin_ns, end_ns)
        stolen_ns = self._within(self._columns["stolen_ns"], self._stolen_from_ns, begin_ns, end_ns)
        return int(np.maximum(slow_ns, stolen_ns).sum())

    def dropped(self, begin_ns: int, end_ns: int) -> int:
        """Return the number of packets dropped between two times."""
        return self.total("dropped", begin_ns, end_ns)

    def total(self, name: str, begin_ns: int, end_ns: int) -> int:
        """Return the sum of a count over the ticks that touch the time between two times."""
        first = int(np.searchsorted(self._end_ns, begin_ns))
        last = int(np.searchsorted(self._end_ns, end_ns, side="right"))
        return int(self._columns[name][first : last + 1].sum())


def judge_losses(
    log: Recorded,
    frames: Sequence[Frame],
    ticks: Sequence[Tick],
    period_ns: int,
    nodes: Mapping[int, int] = DEMO,
    same_sync_ns: int = SAME_SYNC_NS,
    in_order: bool = False,
) -> Verdict:
    """Return the losses of a recording and whose they are.

    Args:
        log: what the recorder wrote.
        frames: what the listener heard, in the order of the bus.
        ticks: of the watch of the machine.
        period_ns: of SYNC [ns].
        nodes: node id by axis.
        same_sync_ns: see `tests.vcan.judgement.compare`.
        in_order: see there.
    """
    found = compare(log, frames, nodes, same_sync_ns=same_sync_ns, in_order=in_order)
    verdict = Verdict(wrong=len(found.violations), neighbours=found.neighbours)
    verdict.notes = found.violations[:5]
    if found.syncs:
        _Losses(log, frames, Host(ticks), period_ns, nodes, found.syncs, in_order).judge(verdict)
    return verdict


class _Losses:
    """The losses of one recording, whose samples have their SYNCs at these places."""

    def __init__(
        self,
        log: Recorded,
        frames: Sequence[Frame],
        host: Host,
        period_ns: int,
        nodes: Mapping[int, int],
        places: Sequence[int],
        by_clock: bool,
    ) -> None:
        self._log = log
        self._frames = frames
        self._host = host
        self._period_ns = period_ns
        self._nodes = nodes
        self._samples = [number for number, place in enumerate(places) if place >= 0]
        self._places = places
        self._by_clock = by_clock  # cycles end when the next SYNC is due
        self._before: dict[int, Cause] = {}  # of the axes that the sample before has not

    def judge(self, verdict: Verdict) -> None:
        """Add all losses."""
        if not self._samples:
            return
        first = self._samples[0]
        last = self._samples[-1]
        periods = int(self._log.cycle[last] - self._log.cycle[first]) + 1
        verdict.values = periods * len(self._nodes)
        verdict.frames = self._end_of(last) - self._places[first]
        starved = 0
        for at, number in enumerate(self._samples):
            starved += self._starves_around(at)
            losses = self._marked(at)
            if number != last:
                losses += self._left_out(number, self._samples[at + 1])
            verdict.losses += losses
            if any(loss.cause is Cause.OURS for loss in losses):
                begin_ns, end_ns = self._window_ns(at)
                around = self._host.describe(begin_ns, end_ns)
                verdict.notes.append(f"cycle {self._log.cycle[number]}: {around}")
        verdict.starved_share = starved / len(self._samples)

    def _end_of(self, number: int) -> int:
        """Return the place of the first SYNC behind that of a sample, or the end of the frames."""
        place = self._places[number] + 1
        while place < len(self._frames) and self._frames[place].identifier != SYNC:
            place += 1
        return place

    def _time_ns(self, number: int) -> int:
        return self._frames[self._places[number]].time_ns

    def _window_ns(self, at: int) -> tuple[int, int]:
        """Return the times of the SYNC before that of a sample, and of the one behind it."""
        number = self._samples[at]
        begin_ns = self._time_ns(number) - self._period_ns
        if at > 0:
            begin_ns = min(begin_ns, self._time_ns(self._samples[at - 1]))
        end = self._end_of(number)
        end_ns = self._time_ns(number) + self._period_ns
        if end < len(self._frames):
            end_ns = max(end_ns, self._frames[end].time_ns)
        return begin_ns, end_ns

    def _starves_around(self, at: int) -> bool:
        return self._host.starves(*self._window_ns(at), self._period_ns)

    def _marked(self, at: int) -> list[Loss]:
        """Return the losses of a sample: its values that are marked as missing."""
        number = self._samples[at]
        mask = int(self._log.missing[number])
        before = self._before
        self._before = {}
        if mask == 0:
            return []
        losses = []
        cycle = int(self._log.cycle[number])
        end = self._end_of(number)
        due_ns = self._due_ns(at)
        heard = {
            frame.identifier & 0x7F
            for frame in self._frames[self._places[number] : end]
            if frame.identifier & ~0x7F == TPDO1 and frame.time_ns < due_ns
        }
        starves = self._starves_around(at)
        for axis, node in self._nodes.items():
            if not mask >> axis & 1:
                continue
            kind = LossKind.LATE
            cause = Cause.OURS
            if node in heard:
                kind = LossKind.UNREAD
            lost_by_listener = kind is LossKind.LATE and self._is_punctual(number, end, due_ns)
            if starves or lost_by_listener:
                cause = Cause.HOST
            if kind is LossKind.UNREAD and axis in before:
                kind = LossKind.DOUBTFUL
                cause = before[axis]
            self._before[axis] = cause
            losses.append(Loss(cycle, kind, cause))
        return losses

    def _due_ns(self, at: int) -> int:
        """Return the time until which answers to the SYNC of a sample are waited for."""
        number = self._samples[at]
        end = self._end_of(number)
        end_ns = self._time_ns(number) + self._period_ns
        if end < len(self._frames):
            end_ns = self._frames[end].time_ns
        if not self._by_clock:
            return end_ns
        near = self._samples[max(0, at - DUE_PERIODS) : at + 1]
        cycle = int(self._log.cycle[number])
        schedule_ns = [
            self._time_ns(one) + (cycle - int(self._log.cycle[one])) * self._period_ns
            for one in near
        ]
        return min(end_ns, min(schedule_ns) + self._period_ns)

    def _is_punctual(self, number: int, end: int, due_ns: int) -> bool:
        """Return whether a SYNC left the axes their time until the next one."""
        if end >= len(self._frames):
            return True
        left_ns = due_ns - self._time_ns(number)
        return left_ns >= PUNCTUAL_PERIODS * self._period_ns

    def _left_out(self, number: int, following: int) -> list[Loss]:
        """Return the losses between two samples that follow each other."""
        axes = len(self._nodes)
        cycle = int(self._log.cycle[number])
        gap = int(self._log.cycle[following]) - cycle - 1
        between = self._frames[self._places[number] + 1 : self._places[following]]
        syncs = sum(frame.identifier == SYNC for frame in between)
        losses = []
        end_ns = self._time_ns(following)
        # A SYNC that is sent late has a time behind that at which the next ones were due: what held
        # it up is between its own due time and its frame.
        due_ns = end_ns - (gap + 1) * self._period_ns
        begin_ns = min(self._time_ns(number), due_ns)
        cause = Cause.OURS
        if self._host.starves(begin_ns, end_ns, self._period_ns):
            cause = Cause.HOST
        for lost in range(gap):
            kind = LossKind.NO_SYNC
            if lost < syncs:
                kind = LossKind.UNREAD
            losses.append(Loss(cycle + 1 + lost, kind, cause, axes))
        for _ in range(syncs - gap):
            losses.append(Loss(cycle, LossKind.UNCOUNTED, Cause.OURS, axes))
        return losses


def cause_of_end(
    verdict: Verdict, log: Recorded | None, ticks: Sequence[Tick], ended_ns: int
) -> Cause:
    """Return who ended a recording that supervision ended.

    Args:
        verdict: on the recording.
        log: what the recorder wrote; None without samples.
        ticks: of the watch of the machine.
        ended_ns: time of the end [ns since 1970].
    """
    host = Host(ticks)
    if host.taken_ns(ended_ns - round(END_S * 1e9), ended_ns) >= END_TAKEN_S * 1e9:
        return Cause.HOST
    if log is None:
        return Cause.OURS
    last = int(log.cycle[-1])
    near = [loss for loss in verdict.losses if loss.cycle > last - END_CYCLES]
    if near and all(loss.cause is Cause.HOST for loss in near):
        return Cause.HOST
    return Cause.OURS
