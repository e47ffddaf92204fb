"""The toggle bit of an amplifier: what a constant bit proves, and how soon."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.config.drive import drive_from_text
from daq.errors import SchemaMismatch
from drivers.profiles.profile import Axis
from drivers.stream.watch import ToggleBits
from tests.drivers.scripted import PROFILE
from tests.faults.cells import CONFIGS

PERIOD_NS = 1_000_000
BIT = 14


def alarm_cycles(
    values: Sequence[int], update_period_us: int = 1000, missing: Sequence[int] = ()
) -> list[int]:
    """Cycles in which the first of two axes is reported; the second has no such bit."""
    profile = replace(PROFILE, toggle_bit=BIT, update_period_us=update_period_us)
    axes = (Axis("J1", 1, profile, None), Axis("J2", 2, PROFILE, None))
    bits = ToggleBits(axes)
    found = []
    for cycle, value in enumerate(values):
        lost = int(cycle in missing)
        for axis, bit, error in bits.stale(cycle * PERIOD_NS, (value << BIT | 0x27, 0x27), lost):
            assert axis == 0
            assert error.node_id == 1
            assert bit == BIT
            found.append(cycle)
    return found


def test_a_bit_that_is_stuck_is_reported_once_after_two_periods() -> None:
    found = alarm_cycles([0, 1, 0, 1, 1, 1, 1, 1, 0, 1, 1, 1])
    assert found == [5, 11]


@settings(deadline=None)
@given(st.integers(1, 5), st.integers(0, 4), st.integers(5, 60))
def test_an_amplifier_that_is_slower_than_sync_is_reported_after_two_of_its_periods(
    cycles_a_refresh: int, phase: int, hangs: int
) -> None:
    values = []
    for cycle in range(hangs + 40):
        values.append((min(cycle, hangs) + phase) // cycles_a_refresh % 2)
    found = alarm_cycles(values, update_period_us=1000 * cycles_a_refresh)
    assert len(found) == 1
    assert hangs < found[0] <= hangs + 2 * cycles_a_refresh


@settings(deadline=None)
@given(st.sets(st.integers(0, 199)))
def test_a_lost_frame_proves_nothing(lost: set[int]) -> None:
    """The values repeat the last ones then, and how often the bit has changed meanwhile is not
    known.
    """
    values: list[int] = []
    for cycle in range(200):
        values.append(values[-1] if cycle in lost and values else cycle % 2)
    assert alarm_cycles(values, missing=tuple(lost)) == []


def test_only_a_bit_that_is_the_makers_own_can_be_a_toggle_bit_and_it_needs_a_source() -> None:
    text = (CONFIGS / "drives" / "generic-cia402.yaml").read_text(encoding="utf-8")
    sourced = text + "  toggle_bit:\n    basis: manual\n    where: of some maker\n"
    for spoiled in (
        text.replace("tap:", "toggle_bit: 14\ntap:", 1),
        sourced,
        sourced.replace("tap:", "toggle_bit: 10\ntap:", 1),
    ):
        with pytest.raises(SchemaMismatch, match="toggle_bit"):
            drive_from_text(spoiled.encode(), "spoiled.yaml")
    profile = drive_from_text(
        sourced.replace("tap:", "toggle_bit: 14\ntap:", 1).encode(), "good.yaml"
    )
    assert profile.toggle_bit == 14
    abouts = {fact.about for fact in profile.facts}
    assert abouts >= {"toggle_bit", "save"}


def test_the_second_axis_is_watched_while_the_first_is_missing_or_toggles() -> None:
    profile = replace(PROFILE, toggle_bit=BIT, update_period_us=1000)
    for missing in (0, 1):
        axes = (Axis("J1", 1, profile), Axis("J2", 2, profile))
        bits = ToggleBits(axes)
        found = []
        for cycle in range(4):
            words = (cycle % 2 << BIT, 1 << BIT)
            found.append(list(bits.stale(cycle * PERIOD_NS, words, missing)))
        (stale,) = found[2]
        assert stale[0] == 1
        assert stale[1] == BIT
        assert "J2 (node 2): statusword bit 14 has not toggled for 2 cycles, 2 ms" in str(stale[2])
        assert found[0] + found[1] + found[3] == []
