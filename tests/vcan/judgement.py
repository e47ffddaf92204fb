"""Compare a log with what a listener heard on the bus: no value that was not there, no loss that is not counted.

It reads logs with `daq.log.reader`, and knows of the stream only what a log promises: a sample belongs to one SYNC, its
values are those of the TPDOs between this SYNC and the next, and `missing` marks the axes without an answer.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from daq.log.container import UNFINISHED
from daq.log.reader import LogReader, SampleBlock
from tests.vcan.listener import Frame

SYNC, TPDO1 = 0x080, 0x180
FEEDBACK = Struct("<ihH")
"""Position, current and statusword of the shipped profiles' TPDO1."""
DEMO = {axis: axis + 1 for axis in range(6)}
"""Node id by axis of the demo cell."""
EARLIEST_S, LATEST_S = 0.1, 3.0
"""The log's first SYNC is at most so long before or after the start of the run that the log states."""
SAME_SYNC_NS = 1_000_000
"""The recorder converts the kernel's stamps to another clock, to some tens of microseconds."""
EQUALLY_GOOD_NS = 50_000


@dataclass(frozen=True, eq=False)
class Recorded:
    """Samples of a log as arrays, as in `daq.log.reader.SampleBlock`.

    Attributes:
        started_ns: wall time of the start of the run [ns since 1970].
        valid: the recorder's verdict; None where it did not come to one.
    """

    cycle: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    values: NDArray[np.int64]  #: position, current, statusword of each axis, shape (k, n, 3)
    missing: NDArray[np.int64]
    started_ns: int
    valid: bool | None


@dataclass
class Comparison:
    """Outcome of a comparison: `violations` is empty for a log that agrees with the bus."""

    samples: int = 0
    values: int = 0  #: that are bit for bit those of a frame
    flagged: int = 0  #: values that are marked as missing
    violations: list[str] = field(default_factory=list)


def read_recorded(path: Path) -> Recorded | None:
    """Return the samples of a finished or unfinished log; None for one without samples."""
    reader = LogReader(path)
    unfinished = path.name.endswith(UNFINISHED)
    blocks: list[SampleBlock] = list(reader.until_damage() if unfinished else reader)
    if not blocks:
        return None
    columns = ("position_counts", "current_raw", "statusword")
    return Recorded(
        np.concatenate([block.cycle for block in blocks]).astype(np.int64),
        np.concatenate([block.time_ns for block in blocks]),
        np.concatenate([np.stack([getattr(block, name).astype(np.int64) for name in columns], 2) for block in blocks]),
        np.concatenate([block.missing for block in blocks]).astype(np.int64),
        reader.head.run.started_wall_ns,
        reader.statistics.valid if reader.concluded else None,
    )


def compare(
    log: Recorded,
    frames: Sequence[Frame],
    nodes: Mapping[int, int] = DEMO,
    foreign_syncs: Collection[int] = (),
    same_sync_ns: int = SAME_SYNC_NS,
) -> Comparison:
    """Compare a log with the frames on a bus, for the axes whose nodes are on this bus.

    Args:
        log: what the recorder wrote.
        frames: what a listener heard, in the order of the bus.
        nodes: node id by axis.
        foreign_syncs: places in `frames` of SYNCs of another device, which need no sample.
        same_sync_ns: largest difference between the times of a sample and of its SYNC; on a second bus SYNC is later.
    """
    syncs = [place for place, frame in enumerate(frames) if frame.identifier == SYNC]
    best: Comparison | None = None
    times_ns = np.array([frames[place].time_ns for place in syncs], dtype=np.int64)
    for own in _alignments(log, times_ns, same_sync_ns):
        found = _compare(log, frames, nodes, syncs, own, set(foreign_syncs))
        if best is None or len(found.violations) < len(best.violations):
            best = found
    if best is None:
        best = Comparison(len(log.cycle), violations=["no SYNC on the bus near the start of the run"])
    return best


def _alignments(log: Recorded, sync_ns: NDArray[np.int64], same_sync_ns: int) -> list[list[int]]:
    """Return by sample the SYNC of its time (-1: none), for each first SYNC that fits the time stamps best.

    A log counts its time from its first SYNC, whose own time it does not have. No two SYNCs have equal jitter behind
    them: the steps between the samples show which SYNC was first, unless there are very few.
    """
    since_ns = log.time_ns - log.time_ns[0]
    begin = np.searchsorted(sync_ns, log.started_ns - round(EARLIEST_S * 1e9))
    end = np.searchsorted(sync_ns, log.started_ns + round(LATEST_S * 1e9))
    tried = []
    for first in range(int(begin), int(end)):
        wanted = sync_ns[first] + since_ns
        above = np.clip(np.searchsorted(sync_ns, wanted), 1, max(1, len(sync_ns) - 1))
        above = np.minimum(above, len(sync_ns) - 1)
        below = np.maximum(above - 1, 0)
        nearest = np.where(abs(sync_ns[above] - wanted) < abs(sync_ns[below] - wanted), above, below)
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
) -> Comparison:
    found = Comparison(len(log.cycle))
    say = found.violations.append
    for number, place in enumerate(own):
        name = f"cycle {log.cycle[number]}"
        if place < 0 or (number and place <= own[number - 1]):
            say(f"{name}: no SYNC of its own on the bus at its time")
            continue
        following = next((other for other in own[number + 1 :] if other >= 0), place + 1)
        between = [syncs[other] for other in range(place + 1, min(following, len(syncs)))]
        gap = number + 1 < len(own) and log.cycle[number + 1] - log.cycle[number] > 1
        if number + 1 < len(own) and not gap and (unexplained := [one for one in between if one not in foreign]):
            say(f"{name}: {len(unexplained)} SYNCs after it without a sample, and no gap in the cycles")
        if log.valid and gap:
            say(f"{name}: a gap after it in a valid log")
        end = syncs[following] if following < len(syncs) else len(frames)
        window = _answers(frames[syncs[place] + 1 : end], set(nodes.values()))
        for axis, node in nodes.items():
            _compare_axis(log, found, number, axis, window.get(node, []))
    return found


def _answers(frames: Sequence[Frame], nodes: set[int]) -> dict[int, list[bytes]]:
    """Return the data of the TPDO1s of each node."""
    window: dict[int, list[bytes]] = {}
    for frame in frames:
        if frame.identifier & ~0x7F == TPDO1 and frame.identifier & 0x7F in nodes:
            window.setdefault(frame.identifier & 0x7F, []).append(frame.data)
    return window


def _compare_axis(log: Recorded, found: Comparison, number: int, axis: int, window: Sequence[bytes]) -> None:
    name = f"cycle {log.cycle[number]}, axis {axis + 1}"
    values = tuple(int(value) for value in log.values[number, axis])
    answers = {FEEDBACK.unpack(data) for data in window if len(data) == FEEDBACK.size}
    if log.missing[number] >> axis & 1:
        found.flagged += 1
        if log.valid:
            found.violations.append(f"{name}: missing in a valid log")
        if number and values != tuple(int(value) for value in log.values[number - 1, axis]):
            found.violations.append(f"{name}: {values} is marked missing and does not repeat the value before")
        return
    if not answers:
        found.violations.append(f"{name}: no answer on the bus, and it is not marked missing")
    elif values not in answers:
        found.violations.append(f"{name}: {values} was not on the bus; there was {sorted(answers)}")
    elif log.valid and len(window) != 1:
        found.violations.append(f"{name}: {len(window)} answers on the bus in a valid log")
    else:
        found.values += 1
