"""One plant on several buses: however the SYNCs come, time moves once for each."""

from __future__ import annotations

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from drivers.simulation.cell import PATIENCE, SyncGate

BOTH = frozenset((0, 1))
LEFT = frozenset((0,))


def test_one_bus_needs_no_node_ids() -> None:
    gate = SyncGate(1)
    expected = [(LEFT,)] * 3
    assert [gate.arrive(0) for _ in range(3)] == expected
    assert not gate.open


def test_a_cycle_begins_with_the_last_sync_whatever_their_order() -> None:
    gate = SyncGate(2)
    for first, second in ((0, 1), (1, 0), (0, 1)):
        assert gate.arrive(first) == ()
        assert gate.open
        assert gate.arrive(second) == (BOTH,)


def test_a_bus_without_sync_is_not_waited_for_for_ever() -> None:
    gate = SyncGate(2)
    expected = [()] * PATIENCE
    assert [gate.arrive(0) for _ in range(PATIENCE)] == expected
    assert gate.arrive(0) == (LEFT,) * (PATIENCE + 1)
    assert gate.arrive(0) == (LEFT,)


def test_a_late_sync_moves_no_time_and_brings_its_bus_back() -> None:
    gate = SyncGate(2)
    gate.arrive(0)
    assert gate.close() == (LEFT,)
    assert gate.late(1)
    assert not gate.late(1)
    assert gate.arrive(0) == ()
    assert gate.arrive(1) == (BOTH,)


@given(st.integers(1, 4), st.lists(st.permutations(range(4)), max_size=30))
def test_every_round_of_syncs_is_one_cycle(buses: int, rounds: list[list[int]]) -> None:
    gate = SyncGate(buses)
    for order in rounds:
        ran: list[frozenset[int]] = []
        for bus in order:
            if bus < buses:
                ran.extend(gate.arrive(bus))
        expected = [frozenset(range(buses))]
        assert ran == expected


@given(st.lists(st.integers(0, 1), max_size=200))
def test_a_bus_that_is_handed_on_in_bursts_loses_no_cycle(order: list[int]) -> None:
    """As long as no bus is further ahead than the patience,
    the n-th SYNCs of the buses belong together.
    """
    gate = SyncGate(2)
    come = Counter[int]()
    cycles = 0
    for bus in order:
        come_difference = come[bus] - come[1 - bus]
        if come_difference >= PATIENCE:
            continue
        come[bus] += 1
        assert not gate.late(bus)
        ran = gate.arrive(bus)
        assert set(ran) <= {BOTH}
        cycles += len(ran)
        expected = min(come[0], come[1])
        assert cycles == expected
