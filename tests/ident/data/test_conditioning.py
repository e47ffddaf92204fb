"""The decimator against the sum it stands for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.data.conditioning import decimator


@settings(max_examples=40, deadline=None)
@given(
    rate_hz=st.sampled_from((250.0, 999.0, 1000.0, 5000.0)),
    cutoff_hz=st.floats(10.0, 90.0),
    extra=st.integers(0, 700),
    seed=st.integers(0, 2**31),
)
def test_each_row_is_its_whole_window_weighted(rate_hz: float, cutoff_hz: float, extra: int, seed: int) -> None:
    filter_ = decimator(rate_hz, cutoff_hz)
    samples = len(filter_.taps) + extra
    columns = np.random.default_rng(seed).normal(size=(2, samples))
    rows = filter_(columns)
    assert rows.shape == (2, filter_.rows(samples))
    for row, centre in enumerate(filter_.centres(samples)):
        window = columns[:, centre - filter_.half : centre + filter_.half + 1]
        assert rows[:, row] == pytest.approx(window @ filter_.taps, abs=1e-12)


def test_passes_what_is_slow_and_stops_what_is_fast() -> None:
    filter_ = decimator(1000.0, 20.0)
    time = np.arange(2000) / 1000.0
    slow, edge, fast = (np.sqrt(2) * np.std(filter_(np.sin(2 * np.pi * f * time)[None])) for f in (3.0, 20.0, 60.0))
    assert slow == pytest.approx(1.0, abs=0.02)
    assert edge == pytest.approx(0.5, abs=0.03)
    assert fast < 0.01


def test_nothing_comes_out_of_less_than_one_window() -> None:
    filter_ = decimator(1000.0, 20.0)
    assert filter_.rows(len(filter_.taps) - 1) == 0
    assert filter_.rows(len(filter_.taps)) == 1
