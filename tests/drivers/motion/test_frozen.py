"""Frozen data: the way that a set-point has gone, and when equal values prove that nothing is
measured any more.
"""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.messages import Sample
from drivers.move import Move
from drivers.stream.watch import FROZEN_S, FrozenData

PERIOD_NS = 1_000_000
MOVE = Move((50_000, 0), (100_000, 1), (1_000_000, 1))


def alarms(
    positions: list[int], currents: list[int], missing: list[int] | None = None
) -> list[int]:
    data = FrozenData(MOVE, (0, 0), (0,), PERIOD_NS)
    reported = []
    for cycle, (position, current) in enumerate(zip(positions, currents, strict=True)):
        lost = 0 if missing is None else missing[cycle]
        time_ns = cycle * PERIOD_NS
        sample = Sample(cycle, time_ns, (position, 0), (current, 0), (0x27, 0x27), lost)
        if data.frozen(sample):
            reported.append(cycle)
    return reported


def test_an_axis_that_shows_nothing_new_is_reported_in_its_bound() -> None:
    positions = [7] * 100
    currents = [3] * 100
    assert alarms(positions, currents)[0] == round(FROZEN_S * 1e9 / PERIOD_NS)


@settings(deadline=None)
@given(st.integers(0, 39), st.booleans())
def test_one_count_in_position_or_current_is_life(beat: int, of_current: bool) -> None:
    alive = [(cycle + beat) // 40 for cycle in range(500)]
    assert alarms([7] * 500 if of_current else alive, alive if of_current else [3] * 500) == []


def test_a_repeated_value_of_a_lost_sample_proves_nothing() -> None:
    missing = [int(cycle % 40 == 0) for cycle in range(500)]
    positions = [7] * 500
    currents = [3] * 500
    assert alarms(positions, currents, missing) == []
