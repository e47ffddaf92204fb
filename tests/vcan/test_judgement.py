"""The comparison of a log with a bus, on frames and logs that are made up;
this part needs no CAN.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import chain
from random import Random

import numpy as np
import pytest

from tests.vcan.judgement import FEEDBACK, SYNC, TPDO1, compare
from tests.vcan.listener import Frame
from tests.vcan.log_reader import Recorded

CYCLES = 40
AXES = 2
PERIOD_NS = 20_000_000
NODES = {0: 1, 1: 2}
START_NS = 1_700_000_000_000_000_000
LEAD_NS = 123_456_789  #: From the start of the run to its first SYNC
FIRST = 5  #: SYNCs on the bus before the log's first


def value(cycle: int, axis: int) -> tuple[int, int, int]:
    return 1000 * cycle + axis, -cycle, 0x0627


def made() -> tuple[Recorded, list[list[Frame]]]:
    """A sound log, and the frames of each cycle on the bus."""
    random = Random(7)
    times = [
        START_NS + LEAD_NS + number * PERIOD_NS + random.randrange(3_000_000)
        for number in range(-FIRST, CYCLES)
    ]
    bus = []
    for number, time_ns in enumerate(times):
        answers = [
            Frame(
                time_ns + 300_000 * (axis + 1),
                TPDO1 + NODES[axis],
                FEEDBACK.pack(*value(number - FIRST, axis)),
            )
            for axis in range(AXES)
        ]
        bus.append([Frame(time_ns, SYNC, b""), *answers])
    own = np.array(times[FIRST:], dtype=np.int64)
    values = []
    for cycle in range(CYCLES):
        of_axes = [value(cycle, axis) for axis in range(AXES)]
        values.append(of_axes)
    log = Recorded(
        np.arange(CYCLES),
        START_NS + own - own[0],
        np.array(values, dtype=np.int64),
        np.zeros(CYCLES, dtype=np.int64),
        START_NS,
        valid=True,
    )
    return log, bus


def violations(log: Recorded, bus: list[list[Frame]]) -> list[str]:
    frames = list(chain.from_iterable(bus))
    return compare(log, frames, NODES).violations


def test_a_sound_log_agrees_with_the_bus() -> None:
    log, bus = made()
    frames = list(chain.from_iterable(bus))
    found = compare(log, frames, NODES)
    assert found.violations == []
    assert (found.samples, found.values, found.flagged) == (CYCLES, CYCLES * AXES, 0)


@pytest.mark.parametrize("field", [0, 1, 2], ids=["position", "current", "statusword"])
def test_one_bit_that_was_not_on_the_bus_is_found(field: int) -> None:
    log, bus = made()
    log.values[17, 1, field] ^= 1
    assert [line.partition(":")[0] for line in violations(log, bus)] == ["cycle 17, axis 2"]


def test_a_value_of_the_cycle_before_is_found() -> None:
    log, bus = made()
    log.values[17] = log.values[16]
    assert len(violations(log, bus)) == AXES


def test_a_log_that_is_shifted_by_a_cycle_is_found() -> None:
    """The time stamps decide which SYNC is whose, not the values."""
    log, bus = made()
    log.values[1:] = log.values[:-1].copy()
    assert len(violations(log, bus)) == (CYCLES - 1) * AXES


def test_a_loss_that_is_not_counted_is_found() -> None:
    log, bus = made()
    del bus[FIRST + 9][2]
    assert violations(log, bus) == [
        "cycle 9, axis 2: no answer on the bus, and it is not marked missing"
    ]
    log.values[9, 1] = log.values[8, 1]
    log.missing[9] = 0b10
    assert violations(replace(log, valid=False), bus) == []
    assert violations(log, bus) == ["cycle 9, axis 2: missing in a valid log"]


def test_a_missing_answer_repeats_the_last_value() -> None:
    log, bus = made()
    del bus[FIRST + 9][2]
    log.missing[9] = 0b10
    assert "does not repeat" in violations(replace(log, valid=False), bus)[0]


def test_a_second_answer_makes_a_log_invalid() -> None:
    log, bus = made()
    bus[FIRST + 3].append(bus[FIRST + 3][1])
    assert violations(log, bus) == ["cycle 3, axis 1: 2 answers on the bus in a valid log"]
    assert violations(replace(log, valid=False), bus) == []


def test_a_short_answer_is_none() -> None:
    log, bus = made()
    cut = bus[FIRST + 3][1]
    bus[FIRST + 3][1] = cut._replace(data=cut.data[:-1])
    assert violations(log, bus) == [
        "cycle 3, axis 1: no answer on the bus, and it is not marked missing"
    ]


def without(log: Recorded, cycle: int) -> Recorded:
    kept = log.cycle != cycle
    return replace(
        log,
        cycle=log.cycle[kept],
        time_ns=log.time_ns[kept],
        values=log.values[kept],
        missing=log.missing[kept],
        valid=False,
    )


def renumbered(log: Recorded) -> Recorded:
    return replace(log, cycle=np.arange(len(log.cycle)))


@pytest.mark.parametrize(
    ("change", "expected"), [(lambda log: log, 0), (renumbered, 1)], ids=["gap", "no gap"]
)
def test_a_cycle_that_is_left_out_needs_a_gap_in_the_numbers(
    change: Callable[[Recorded], Recorded], expected: int
) -> None:
    log, bus = made()
    assert len(violations(change(without(log, 12)), bus)) == expected


def test_a_sample_without_a_sync_is_found() -> None:
    log, bus = made()
    log.time_ns[20] += 8_000_000
    assert violations(log, bus)[0].startswith("cycle 19: 1 SYNCs after it without a sample")


def test_a_log_of_another_time_has_no_bus() -> None:
    log, bus = made()
    assert violations(replace(log, started_ns=0), bus) == [
        "no SYNC on the bus near the start of the run"
    ]
