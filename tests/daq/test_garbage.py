"""What lives is not searched while SYNC must go out in time, and is searched again afterwards."""

from __future__ import annotations

import gc
import weakref

import pytest

from daq.garbage import settled


class Ring:
    """Garbage that only a search finds."""

    def __init__(self) -> None:
        self.itself = self


def test_what_was_there_before_waits_and_what_is_made_meanwhile_does_not() -> None:
    before = Ring()
    with settled():
        kept = weakref.ref(before)
        del before
        gc.collect()
        assert kept() is not None
        fresh = weakref.ref(Ring())
        gc.collect()
        assert fresh() is None
    gc.collect()
    assert kept() is None


def test_a_run_that_fails_leaves_nothing_unsearched() -> None:
    with pytest.raises(ValueError, match="bus"), settled():
        assert gc.get_freeze_count() > 0
        raise ValueError("bus")
    assert gc.get_freeze_count() == 0
