"""Not everything is searched while SYNC must go out in time; what is made meanwhile is."""

from __future__ import annotations

import gc
import weakref

import pytest

from daq.workflow.safeguards import defer_full_gc


class Ring:
    """Garbage that only a search finds."""

    def __init__(self) -> None:
        self.itself = self


def test_everything_is_searched_by_no_one_and_what_is_made_meanwhile_by_all() -> None:
    searched: list[int] = []

    def note(phase: str, reported: dict[str, int]) -> None:
        if phase == "start":
            searched.append(reported["generation"])

    gc.collect()
    gc.callbacks.append(note)
    try:
        with defer_full_gc():
            fresh = weakref.ref(Ring())
            kept = [[number] for number in range(4 * len(gc.get_objects()))]
        assert fresh() is None
        assert 2 not in searched
        assert {0, 1} <= set(searched)
        kept += [[number] for number in range(len(kept))]  # the same outside has everything searched
        assert 2 in searched
    finally:
        gc.callbacks.remove(note)


def test_a_run_that_fails_leaves_everything_as_it_was() -> None:
    before = gc.get_threshold()
    with pytest.raises(ValueError, match="bus"), defer_full_gc():
        assert gc.get_threshold() != before
        raise ValueError("bus")
    assert gc.get_threshold() == before
