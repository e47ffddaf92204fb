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
        sample = Sample(cycle, cycle * PERIOD_NS, (position, 0), (current, 0), (0x27, 0x27), lost)
        if data.frozen(sample):
            reported.append(cycle)
    return reported


def test_an_axis_that_shows_nothing_new_is_reported_in_its_bound() -> None:
    expected = round(FROZEN_S * 1e9 / PERIOD_NS)
    assert alarms([7] * 100, [3] * 100)[0] == expected


@settings(deadline=None)
@given(st.integers(0, 39), st.booleans())
def test_one_count_in_position_or_current_is_life(beat: int, of_current: bool) -> None:
    alive = [(cycle + beat) // 40 for cycle in range(500)]
    positions = [7] * 500 if of_current else alive
    currents = alive if of_current else [3] * 500
    assert alarms(positions, currents) == []


def test_a_repeated_value_of_a_lost_sample_proves_nothing() -> None:
    missing = [int(cycle % 40 == 0) for cycle in range(500)]
    found = alarms([7] * 500, [3] * 500, missing)
    assert found == []


def _sample(cycle: int, positions: tuple[int, int], missing: int = 0) -> Sample:
    return Sample(cycle, cycle * PERIOD_NS, positions, (3, 3), (0x27, 0x27), missing)


def test_the_second_of_two_moving_axes_is_found_although_the_first_lives() -> None:
    move = Move((50_000, 50_000), (100_000, 100_000), (1_000_000, 1_000_000))
    data = FrozenData(move, (0, 0), (0, 1), PERIOD_NS)
    found = [data.frozen(_sample(cycle, (cycle, 7))) for cycle in range(60)]
    assert {axes for axes in found if axes} == {(1,)}
    # 50 ms: cycle 0 has the values first.
    assert found.index((1,)) == 50


def test_a_set_point_that_creeps_proves_nothing_until_it_has_gone_far_enough() -> None:
    # 640 counts/s: 64 counts, the least way, in 100 ms and the ramp's half of 0.64 ms.
    move = Move((1000,), (640,), (1_000_000,))
    data = FrozenData(move, (0,), (0,), PERIOD_NS)
    found = []
    for cycle in range(150):
        sample = Sample(cycle, cycle * PERIOD_NS, (7,), (3,), (0x27,))
        if data.frozen(sample):
            found.append(cycle)
    assert found[0] == 101


def test_the_way_begins_with_the_first_sample_and_not_with_the_first_cycle() -> None:
    data = FrozenData(MOVE, (0, 0), (0,), PERIOD_NS)
    found = []
    for cycle in range(60):
        found.append(bool(data.frozen(_sample(1000 + cycle, (7, 7)))))
    assert found.index(True) == 50
