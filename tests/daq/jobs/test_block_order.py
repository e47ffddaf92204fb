"""Which block comes next: orders that cancel drift,
and orders that need few changes of the payload.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import replace
from itertools import count, pairwise
from math import ceil

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.jobs.block_order import (
    CHANGE_S,
    FIRST_BLOCKS,
    MOST_BARE_FIRST,
    NEXT_BLOCKS,
    ROUNDING,
    BlockRole,
    BlocksSoFar,
    bare_blocks_first,
    first_blocks,
    fixed_role,
    next_role,
    quickest_way,
)

BLOCK_S = 20.0
AFTER_THREE = BlocksSoFar(bare=1, loaded=1, is_mounted=True)


@given(st.integers(0, 50))
def test_after_each_whole_group_bare_and_loaded_blocks_lie_at_the_same_mean_time(
    groups: int,
) -> None:
    first = len(FIRST_BLOCKS)
    roles = {
        number: fixed_role(number) for number in range(first, first + groups * len(NEXT_BLOCKS))
    }
    bare = [number for number, role in roles.items() if role is BlockRole.BARE]
    loaded = [number for number, role in roles.items() if role is BlockRole.LOADED]
    assert len(bare) == len(loaded)
    assert sum(bare) == sum(loaded)


@given(st.integers(0, 200))
def test_the_payload_changes_at_most_every_second_block_after_the_first(number: int) -> None:
    """Mounting is the work of the person; the first three blocks need one change."""
    roles = [fixed_role(one) for one in range(number + 1)]
    loads = [role is not BlockRole.BARE for role in roles]
    changes = sum(one != other for one, other in pairwise(loads))
    limit = 1 + len(roles) // 2
    assert changes <= limit
    assert roles.count(BlockRole.HELD_OUT) == (number >= 2)


def _variance(blocks: BlocksSoFar) -> float:
    return 1.0 / blocks.bare + 1.0 / blocks.loaded


def _with_one_more(blocks: BlocksSoFar, role: BlockRole) -> BlocksSoFar:
    if role is BlockRole.BARE:
        bare = blocks.bare + 1
        return replace(blocks, bare=bare, is_mounted=False)
    loaded = blocks.loaded + 1
    return replace(blocks, loaded=loaded, is_mounted=True)


def _recorded(first_ratio: float) -> list[BlocksSoFar]:
    """Blocks of a session after the first three, until σ of the worst gain is at its target."""
    target = _variance(AFTER_THREE) / first_ratio
    steps = [AFTER_THREE]
    while _variance(steps[-1]) > target * (1.0 + ROUNDING):
        last_step = steps[-1]
        variance_ratio = _variance(last_step) / target
        way = quickest_way(steps[-1], variance_ratio, BLOCK_S)
        so_far = steps[-1]
        role = next_role(so_far, way)
        blocks = steps[-1]
        steps.append(_with_one_more(blocks, role))
    return steps


def _time_s(steps: list[BlocksSoFar]) -> float:
    changes = sum(one.is_mounted != other.is_mounted for one, other in pairwise(steps))
    return BLOCK_S * (len(steps) - 1) + CHANGE_S * changes


@given(st.floats(1.01, 40.0))
def test_a_session_needs_at_most_one_more_change(first_ratio: float) -> None:
    steps = _recorded(first_ratio)
    assert sum(one.is_mounted != other.is_mounted for one, other in pairwise(steps)) <= 1


def _fewest_loaded(bare: int, target: float) -> int | None:
    """The fewest loaded blocks that are enough beside so many bare ones; None where 1999 are not.

    Each further block makes the variance smaller, so they are found by halving.
    """
    numbers = range(1, 2000)
    at = bisect_left(
        numbers,
        True,
        key=lambda loaded: _variance(replace(AFTER_THREE, bare=bare, loaded=loaded)) <= target,
    )
    return numbers[at] if at < len(numbers) else None


@given(st.floats(1.01, 40.0))
def test_no_order_is_quicker(first_ratio: float) -> None:
    """Beside every number of bare and of loaded blocks that is enough."""
    target = _variance(AFTER_THREE) / first_ratio
    found_s = _time_s(_recorded(first_ratio))
    for bare in range(1, 90):
        loaded = _fewest_loaded(bare, target)
        if loaded is not None:
            others_s = BLOCK_S * (bare + loaded - 2) + (CHANGE_S if bare > 1 else 0.0)
            assert found_s <= others_s + 1e-9


@pytest.mark.parametrize("ratio", [2.5, 4.0, 9.0])
def test_it_is_quicker_than_the_order_that_cancels_drift(ratio: float) -> None:
    target = _variance(AFTER_THREE) / ratio
    steps = [AFTER_THREE]
    for number in count(len(FIRST_BLOCKS)):
        blocks = steps[-1]
        if _variance(blocks) <= target:
            break
        last_step = steps[-1]
        steps.append(_with_one_more(last_step, fixed_role(number)))
    limit = 0.8 * _time_s(steps)
    assert _time_s(_recorded(ratio)) < limit


def _until_limit(first_ratio: float, blocks: int, *, is_fixed: bool) -> tuple[float, int]:
    """σ² over that of the target after so many further blocks, or less,
    and the changes of the payload.
    """
    target = _variance(AFTER_THREE) / first_ratio
    steps = [AFTER_THREE]
    for number in range(blocks):
        last_step = steps[-1]
        ratio = _variance(last_step) / target
        if ratio <= 1.0 + ROUNDING:
            break
        block_number = len(FIRST_BLOCKS) + number
        role = fixed_role(block_number)
        if not is_fixed:
            so_far = steps[-1]
            way = quickest_way(steps[-1], ratio, BLOCK_S, blocks - number)
            role = next_role(so_far, way)
        steps.append(_with_one_more(steps[-1], role))
    changes = sum(one.is_mounted != other.is_mounted for one, other in pairwise(steps))
    return _variance(steps[-1]) / target, changes


@given(st.floats(1.01, 100.0), st.integers(1, 90))
def test_at_the_time_limit_sigma_is_no_larger_than_in_the_order_that_cancels_drift(
    first_ratio: float, blocks: int
) -> None:
    ratio, changes = _until_limit(first_ratio, blocks, is_fixed=False)
    fixed_ratio, _ = _until_limit(first_ratio, blocks, is_fixed=True)
    limit = max(fixed_ratio, 1.0) * (1.0 + 1e-6)
    assert ratio <= limit
    assert changes <= 1


@given(st.floats(1.01, 40.0))
def test_what_is_left_shrinks_by_each_block(first_ratio: float) -> None:
    steps = _recorded(first_ratio)
    target = _variance(AFTER_THREE) / first_ratio
    left = [quickest_way(one, _variance(one) / target, BLOCK_S).count for one in steps[:-1]]
    expected = list(range(len(steps) - 1, 0, -1))
    assert left == expected


NO_LIMIT = 1000  #: Blocks


@given(st.floats(0.01, float(MOST_BARE_FIRST)))
def test_where_the_prediction_is_right_the_payload_is_mounted_once(ratio: float) -> None:
    """σ² of n bare and n loaded blocks is that of one of each over n."""
    roles = first_blocks(bare_blocks_first(ratio, NO_LIMIT))
    bare = roles.count(BlockRole.BARE)
    expected = max(1, ceil(ratio - ROUNDING))
    assert bare == expected
    so_far = BlocksSoFar(bare=bare, loaded=1, is_mounted=True)
    target = 2.0 / ratio
    while _variance(so_far) > target * (1.0 + ROUNDING):
        variance_ratio = _variance(so_far) / target
        way = quickest_way(so_far, variance_ratio, BLOCK_S)
        role = next_role(so_far, way)
        assert role is BlockRole.LOADED
        so_far = _with_one_more(so_far, role)
    assert so_far.loaded <= bare


@pytest.mark.parametrize("ratio", [50.0, float("inf"), float("nan")])
def test_a_prediction_that_is_far_off_costs_a_few_blocks_at_most(ratio: float) -> None:
    assert bare_blocks_first(ratio, NO_LIMIT) == MOST_BARE_FIRST


@pytest.mark.parametrize(
    ("blocks_in_time", "bare"), [(1, 1), (3, 1), (5, 2), (6, 2), (9, 4), (13, 6), (40, 6)]
)
def test_a_session_too_short_for_its_target_keeps_half_of_its_time_for_the_payload(
    blocks_in_time: int, bare: int
) -> None:
    assert bare_blocks_first(100.0, blocks_in_time) == bare


def test_every_session_begins_with_what_gives_the_gains() -> None:
    assert first_blocks(1) == FIRST_BLOCKS
    expected = (BlockRole.BARE, BlockRole.BARE, *FIRST_BLOCKS)
    assert first_blocks(3) == expected
