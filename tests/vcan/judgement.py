"""Compare a log with what a listener heard on the bus:
no value that was not there, no loss that is not counted.

It shares no code with the product (log_reader.py), and knows of the stream only what a log
promises: a sample belongs to one SYNC, its values are those of the TPDOs between this SYNC and the
next, and `missing` marks the axes without an answer.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from tests.vcan.listener import Frame
from tests.vcan.log_reader import Recorded

SYNC = 0x080
TPDO1 = 0x180
FEEDBACK = Struct("<ihH")
"""Position, current and statusword of the shipped profiles' TPDO1."""
DEMO = {axis: axis + 1 for axis in range(6)}
"""Node id by axis of the demo cell."""
EARLIEST_S = 0.1
LATEST_S = 3.0
"""The log's first SYNC is at most so long before or after the start of the run that the log
states.
"""
SAME_SYNC_NS = 1_000_000
"""The recorder converts the kernel's stamps to another clock, to some tens of microseconds."""
EQUALLY_GOOD_NS = 50_000
TWICE = "answers twice"
"""In the reason of a log that no fit accepts, because more answers came than SYNCs were sent.

A recorder whose own SYNC does not come back to it cannot see an answer that the bus carried before
that SYNC, and that came in after it. If all answers of some cycles were late, their values are one
cycle off, and the surplus answer at the end shows it (`drivers.stream.answers`). A log without a
verdict has not come to that end.
"""


@dataclass
class Comparison:
    """Outcome of a comparison: `violations` is empty for a log that agrees with the bus."""

    samples: int = 0
    values: int = 0  #: that are bit for bit those of a frame
    flagged: int = 0  #: values that are marked as missing
    neighbours: int = 0  #: values of the cycle before or after, in a log that is refused for that
    #: by sample, the place of its SYNC among the frames; -1 without one
    syncs: list[int] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)

    @property
    def badness(self) -> tuple[int, int]:
        """The smaller it is, the better does an alignment explain the log."""
        return len(self.violations), self.neighbours


def compare(
    log: Recorded,
    frames: Sequence[Frame],
    nodes: Mapping[int, int] = DEMO,
    foreign_syncs: Collection[int] = (),
    same_sync_ns: int = SAME_SYNC_NS,
    in_order: bool = False,
    clock_steps_ns: Collection[int] = (0,),
) -> Comparison:
    """Compare a log with the frames on a bus, for the axes whose nodes are on this bus.

    Args:
        log: what the recorder wrote.
        frames: what a listener heard, in the order of the bus.
        nodes: node id by axis.
        foreign_syncs: places in `frames` of SYNCs of another device, which need no sample.
        same_sync_ns: largest difference between the times of a sample and of its SYNC; on a second
            bus SYNC is later.
        in_order: the stamps of the bus are not punctual, but no SYNC is lost: samples and SYNCs are
            paired by their order, and by their times only if they do not agree so.
        clock_steps_ns: by how much the recorder's wall clock may have been off at its start.
    """
    syncs = [place for place, frame in enumerate(frames) if frame.identifier == SYNC]
    best: Comparison | None = None
    times_ns = np.array([frames[place].time_ns for place in syncs], dtype=np.int64)
    foreign = set(foreign_syncs)
    for own in _all_alignments(
        log, frames, nodes, syncs, times_ns, foreign, same_sync_ns, in_order, clock_steps_ns
    ):
        found = _compare(log, frames, nodes, syncs, own, foreign, in_order, best)
        if best is None or found.badness < best.badness:
            best = found
        if best.badness == (0, 0):
            return best
    if best is None:
        best = Comparison(
            len(log.cycle), violations=["no SYNC on the bus near the start of the run"]
        )
    return best


def _all_alignments(
    log: Recorded,
    frames: Sequence[Frame],
    nodes: Mapping[int, int],
    syncs: Sequence[int],
    times_ns: NDArray[np.int64],
    foreign: set[int],
    same_sync_ns: int,
    in_order: bool,
    clock_steps_ns: Collection[int],
) -> Iterator[list[int]]:
    for step_ns in clock_steps_ns:
        started_ns = log.started_ns - step_ns
        if in_order:
            yield from _in_order(
                log, frames, nodes, syncs, _first_syncs(times_ns, started_ns), foreign
            )
        yield from _alignments(log, times_ns, started_ns, same_sync_ns)


def _first_syncs(sync_ns: NDArray[np.int64], started_ns: int) -> range:
    """Return the SYNCs near the start of a run, one of which is the log's first."""
    begin = np.searchsorted(sync_ns, started_ns - round(EARLIEST_S * 1e9))
    end = np.searchsorted(sync_ns, started_ns + round(LATEST_S * 1e9))
    return range(int(begin), int(end))


def _in_order(
    log: Recorded,
    frames: Sequence[Frame],
    nodes: Mapping[int, int],
    syncs: Sequence[int],
    firsts: Sequence[int],
    foreign: set[int],
) -> Iterator[list[int]]:
    """Yield by sample the SYNC behind which its values are:
    the next one, or one after SYNCs of another device.
    """
    ends = [*syncs[1:], len(frames)]
    windows = [
        _answers(frames[begin + 1 : end], set(nodes.values()))
        for begin, end in zip(syncs, ends, strict=True)
    ]
    for first in firsts:
        if not _agrees(log, 0, nodes, windows[first]):
            continue
        own = [first]
        for number in range(1, len(log.cycle)):
            place = own[-1] + 1
            while (
                place < len(syncs)
                and syncs[place] in foreign
                and not _agrees(log, number, nodes, windows[place])
            ):
                place += 1
            if place >= len(syncs):
                break
            own.append(place)
        yield own + [-1] * (len(log.cycle) - len(own))


def _agrees(
    log: Recorded, number: int, nodes: Mapping[int, int], window: Mapping[int, Sequence[bytes]]
) -> bool:
    """Return whether the values of a sample are among the answers to a SYNC."""
    for axis, node in nodes.items():
        values = tuple(int(value) for value in log.values[number, axis])
        if not log.missing[number] >> axis & 1 and FEEDBACK.pack(*values) not in window.get(
            node, ()
        ):
            return False
    return True


def _alignments(
    log: Recorded, sync_ns: NDArray[np.int64], started_ns: int, same_sync_ns: int
) -> list[list[int]]:
    """Return by sample the SYNC of its time (-1:
    none), for each first SYNC that fits the time stamps best.

    A log counts its time from its first SYNC, whose own time it does not have. No two SYNCs have
    equal jitter behind them: the steps between the samples show which SYNC was first, unless there
    are very few.
    """
    since_ns = log.time_ns - log.time_ns[0]
    tried = []
    for first in _first_syncs(sync_ns, started_ns):
        wanted = sync_ns[first] + since_ns
        above = np.clip(np.searchsorted(sync_ns, wanted), 1, max(1, len(sync_ns) - 1))
        above = np.minimum(above, len(sync_ns) - 1)
        below = np.maximum(above - 1, 0)
        nearest = np.where(
            abs(sync_ns[above] - wanted) < abs(sync_ns[below] - wanted), above, below
        )
        off_ns = abs(sync_ns[nearest] - wanted)
        own = np.where(off_ns <= same_sync_ns, nearest, -1)
        tried.append((float(np.percentile(off_ns, 90)), [int(place) for place in own]))
    least = min((off for off, _ in tried), default=0.0)
    return [own for off, own in tried if off <= least + EQUALLY_GOOD_NS]


def _compare(
    log: Recorded,
    frames: Sequence[Frame],
    nodes: Mapping[int, int],
    syncs: Sequence[int],
    own: Sequence[int],
    foreign: set[int],
    in_order: bool,
    best: Comparison | None,
) -> Comparison:
    """Compare a log with the frames where its samples have these SYNCs;
    only so far until it is no better than the best one.
    """
    found = Comparison(len(log.cycle), syncs=[_place_of(place, syncs) for place in own])
    say = found.violations.append
    doubtful = in_order and (log.valid is None or TWICE in log.reason)
    for number, place in enumerate(own):
        if best is not None and found.badness >= best.badness:
            return found
        name = f"cycle {log.cycle[number]}"
        if place < 0 or (number and place <= own[number - 1]):
            say(f"{name}: no SYNC of its own on the bus at its time")
            continue
        following = next((other for other in own[number + 1 :] if other >= 0), place + 1)
        between = [syncs[other] for other in range(place + 1, min(following, len(syncs)))]
        gap = number + 1 < len(own) and log.cycle[number + 1] - log.cycle[number] > 1
        if (
            number + 1 < len(own)
            and not gap
            and (unexplained := [one for one in between if one not in foreign])
        ):
            say(
                f"{name}: {len(unexplained)} SYNCs after it without a sample, and no gap in "
                "the cycles"
            )
        if log.valid and gap:
            say(f"{name}: a gap after it in a valid log")
        if following < len(syncs):
            end = syncs[following]
        else:
            end = len(frames)
        window = _answers(frames[syncs[place] + 1 : end], set(nodes.values()))
        near: dict[int, list[bytes]] = {}
        if doubtful:
            begin = syncs[max(0, place - 1)]
            if following + 1 < len(syncs):
                after = syncs[following + 1]
            else:
                after = len(frames)
            near = _answers(frames[begin:after], set(nodes.values()))
        for axis, node in nodes.items():
            _compare_axis(log, found, number, axis, window.get(node, []), near.get(node, []))
    return found


def _place_of(number: int, syncs: Sequence[int]) -> int:
    """Return the place of a SYNC among the frames, by its number; -1 stays."""
    if number < 0:
        return number
    return syncs[number]


def _answers(frames: Sequence[Frame], nodes: set[int]) -> dict[int, list[bytes]]:
    """Return the data of the TPDO1s of each node."""
    window: dict[int, list[bytes]] = {}
    for frame in frames:
        if frame.identifier & ~0x7F == TPDO1 and frame.identifier & 0x7F in nodes:
            window.setdefault(frame.identifier & 0x7F, []).append(frame.data)
    return window


def _compare_axis(
    log: Recorded,
    found: Comparison,
    number: int,
    axis: int,
    window: Sequence[bytes],
    near: Sequence[bytes],
) -> None:
    name = f"cycle {log.cycle[number]}, axis {axis + 1}"
    values = tuple(int(value) for value in log.values[number, axis])
    answers = {FEEDBACK.unpack(data) for data in window if len(data) == FEEDBACK.size}
    if log.missing[number] >> axis & 1:
        found.flagged += 1
        if log.valid:
            found.violations.append(f"{name}: missing in a valid log")
        if number and values != tuple(int(value) for value in log.values[number - 1, axis]):
            found.violations.append(
                f"{name}: {values} is marked missing and does not repeat the value before"
            )
        return
    if values not in answers and FEEDBACK.pack(*values) in near:
        found.neighbours += 1
    elif not answers:
        found.violations.append(f"{name}: no answer on the bus, and it is not marked missing")
    elif values not in answers:
        found.violations.append(f"{name}: {values} was not on the bus; there was {sorted(answers)}")
    elif log.valid and len(window) != 1:
        found.violations.append(f"{name}: {len(window)} answers on the bus in a valid log")
    else:
        found.values += 1
