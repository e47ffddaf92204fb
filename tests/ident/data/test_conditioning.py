"""The filters against their definitions and against scipy.signal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from ident.data.conditioning import (
    LONG_SERIES,
    Conditioning,
    current_rows,
    decimator,
    low_pass,
    rows_lost,
    torque_rows,
)


@settings(max_examples=40, deadline=None)
@given(
    rate_hz=st.sampled_from((250.0, 999.0, 1000.0, 5000.0)),
    cutoff_hz=st.floats(10.0, 90.0),
    extra=st.integers(0, 700),
    seed=st.integers(0, 2**31),
)
def test_each_row_is_its_whole_window_weighted(
    rate_hz: float, cutoff_hz: float, extra: int, seed: int
) -> None:
    filter_ = decimator(rate_hz, cutoff_hz)
    samples = len(filter_.taps) + extra
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(2, samples))
    rows = filter_(columns)
    expected = (2, filter_.rows(samples))
    assert rows.shape == expected
    for row, centre in enumerate(filter_.centres(samples)):
        centre_difference = centre - filter_.half
        window = columns[:, centre_difference : centre + filter_.half + 1]
        assert rows[:, row] == pytest.approx(window @ filter_.taps, abs=1e-12)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(
    rate_hz=st.sampled_from((250.0, 999.0, 1000.0, 5000.0)),
    cutoff_hz=st.floats(10.0, 90.0),
    extra=st.integers(0, 700),
    seed=st.integers(0, 2**31),
)
def test_a_long_series_is_decimated_as_its_windows_say(
    rate_hz: float, cutoff_hz: float, extra: int, seed: int
) -> None:
    filter_ = decimator(rate_hz, cutoff_hz)
    samples = LONG_SERIES + extra
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(2, 1, samples))
    rows = filter_(columns)
    assert rows.shape == (2, 1, filter_.rows(samples))
    windows = np.lib.stride_tricks.sliding_window_view(columns, len(filter_.taps), axis=-1)
    expected = windows[..., :: filter_.factor, :] @ filter_.taps
    assert rows == pytest.approx(expected, abs=1e-12)
    # The beginning of a shorter series is decimated together with the other one.
    shorter = columns[..., : LONG_SERIES - 1]
    count = filter_.rows(LONG_SERIES - 1)
    assert filter_(shorter) == pytest.approx(rows[..., :count], abs=1e-12)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 7, 10])
@pytest.mark.parametrize("cutoff_hz", [10.0, 40.0, 400.0])
def test_the_low_pass_is_scipys(order: int, cutoff_hz: float) -> None:
    rng = np.random.default_rng(order)
    cumulative = np.cumsum(rng.normal(size=(2, 3000)), axis=1)
    values = cumulative + 40.0
    sections = signal.butter(order, cutoff_hz, fs=1000.0, output="sos")
    expected = signal.sosfiltfilt(sections, values, axis=1)
    largest_absolute_expected = np.abs(expected).max()
    assert low_pass(values, 1000.0, cutoff_hz, order) == pytest.approx(
        expected, abs=1e-12 * largest_absolute_expected
    )


@pytest.mark.parametrize(("rate_hz", "cutoff_hz"), [(1000.0, 20.0), (250.0, 7.5), (999.0, 90.0)])
def test_the_taps_are_scipys(rate_hz: float, cutoff_hz: float) -> None:
    taps = decimator(rate_hz, cutoff_hz).taps
    assert taps == pytest.approx(
        signal.firwin(len(taps), cutoff_hz, fs=rate_hz, window="hamming"), abs=1e-15
    )


def test_passes_what_is_slow_and_stops_what_is_fast() -> None:
    filter_ = decimator(1000.0, 20.0)
    time = np.arange(2000) / 1000.0
    slow, edge, fast = (
        np.sqrt(2) * np.std(filter_(np.sin(2 * np.pi * f * time)[None])) for f in (3.0, 20.0, 60.0)
    )
    assert slow == pytest.approx(1.0, abs=0.02)
    assert edge == pytest.approx(0.5, abs=0.03)
    assert fast < 0.01


def test_nothing_comes_out_of_less_than_one_window() -> None:
    filter_ = decimator(1000.0, 20.0)
    assert filter_.rows(len(filter_.taps) - 1) == 0
    assert filter_.rows(len(filter_.taps)) == 1


@pytest.mark.parametrize("order", [0, 2, 3])
def test_torque_rows_are_currents_rows_behind_the_low_pass_of_the_currents(order: int) -> None:
    rate_hz = 125.0
    series = np.cumsum(np.random.default_rng(0).standard_normal((2, 2000)), axis=1)
    filtered = Conditioning(decimation_cutoff_hz=7.0, current_cutoff_hz=2.0, current_order=order)
    if order:
        sections = signal.butter(order, 2.0, fs=rate_hz, output="sos")
        expected = signal.sosfiltfilt(sections, series, axis=1)
    else:
        pole = 2.0 * np.pi * 2.0
        times = np.arange(2000) / rate_hz
        expected = np.array([signal.lsim(([pole], [1.0, pole]), own, times)[1] for own in series])
    torque = torque_rows(rate_hz, filtered)(series)
    current = current_rows(rate_hz, filtered)(expected)
    scale = np.abs(series).max()
    # Beyond its window the response has a hundredth left, in slow waves.
    assert np.abs(torque - current)[:, 10:-10].max() < 0.01 * scale
    assert torque.shape == current.shape


def test_rows_with_a_filter_of_the_currents_are_those_without_but_for_the_ends() -> None:
    plain = Conditioning(decimation_cutoff_hz=7.0)
    filtered = Conditioning(decimation_cutoff_hz=7.0, current_cutoff_hz=2.0, current_order=3)
    lost = rows_lost(125.0, filtered)
    centres = current_rows(125.0, plain).centres(2000)
    own = current_rows(125.0, filtered).centres(2000)
    np.testing.assert_array_equal(own, centres[lost : len(centres) - lost])
    series = np.random.default_rng(1).standard_normal((1, 2000))
    rows = current_rows(125.0, plain)(series)
    np.testing.assert_allclose(current_rows(125.0, filtered)(series), rows[:, lost:-lost])


def test_without_a_filter_of_the_currents_torques_and_currents_have_one_decimator() -> None:
    plain = Conditioning()
    assert torque_rows(250.0, plain) is decimator(250.0, plain.decimation_cutoff_hz)
    assert current_rows(250.0, plain) is decimator(250.0, plain.decimation_cutoff_hz)
    assert "current_cutoff_hz" not in plain.document()
    assert Conditioning.of_document(plain.document()) == plain


def test_a_document_holds_the_filter_of_the_currents() -> None:
    filtered = Conditioning(current_cutoff_hz=1.74, current_order=3)
    assert Conditioning.of_document(filtered.document()) == filtered
