"""No full collection runs while SYNC must go out in time; young objects are still collected."""

from __future__ import annotations

import gc
import weakref

import pytest

from daq.workflow.on_time import defer_full_gc


class Ring:
    """A reference cycle, which only a collection frees."""

    def __init__(self) -> None:
        self.itself = self


@pytest.mark.slow
def test_full_collections_are_deferred_and_young_ones_are_not() -> None:
    collected: list[int] = []

    def note(phase: str, reported: dict[str, int]) -> None:
        if phase == "start":
            collected.append(reported["generation"])

    limits = gc.get_threshold()
    gc.set_threshold(700, 10, 10)  # Python's own
    gc.collect()
    # A full collection looks at a quarter more than the last one has left; what the test runner has
    # frozen is no part.
    enough = 200_000 + 4 * len(gc.get_objects())
    gc.callbacks.append(note)
    try:
        with defer_full_gc():
            collected.clear()
            fresh = weakref.ref(Ring())
            kept = [[number] for number in range(enough)]
        assert fresh() is None
        assert 2 not in collected
        assert {0, 1} <= set(collected)
        # Outside the block the same causes a full collection
        kept += [[number] for number in range(len(kept))]
        assert 2 in collected
    finally:
        gc.callbacks.remove(note)
        gc.set_threshold(*limits)


def test_what_was_made_before_is_not_searched_again_in_the_block() -> None:
    searched: list[int] = []

    def note(phase: str, reported: dict[str, int]) -> None:
        if phase == "start" and reported["generation"] == 1:
            young = len(gc.get_objects(generation=0)) + len(gc.get_objects(generation=1))
            searched.append(young)

    limits = gc.get_threshold()
    gc.set_threshold(20_000, 50, 100)  # those of the command line
    before = [[number] for number in range(100_000)]
    gc.callbacks.append(note)
    try:
        with defer_full_gc():
            searched.clear()
            kept = [[number] for number in range(30_000)]
        assert searched
        assert max(searched) < 10_000
    finally:
        gc.callbacks.remove(note)
        gc.set_threshold(*limits)
    assert len(before) + len(kept) == 130_000


def test_a_run_that_fails_leaves_everything_as_it_was() -> None:
    before = gc.get_threshold()
    with pytest.raises(ValueError, match="bus"), defer_full_gc():
        assert gc.get_threshold() != before
        raise ValueError("bus")
    assert gc.get_threshold() == before
