"""Pictures and tables: whole files, the same bytes for the same data, and no peak lost on the way to the pixels."""

from __future__ import annotations

import io
import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from daq.report.gains import gain_table, plot_gains, torque_sentences, with_deviation
from daq.report.picture import ORANGE, grid, render
from daq.report.plots import plot_residual, plot_torques
from ident.calibration import Gain
from ident.data.torque_channel import TorqueSlope
from tests.daq.calibrations import AXES, demo_calibration

FloatArray = NDArray[np.float64]


def _torques(samples: int = 3000) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(3)
    time_s = np.arange(samples) / 200.0
    predicted_nm = np.sin(time_s[:, None] * np.arange(1, 7)) * np.array([40, 60, 30, 8, 6, 3])
    measured_nm = predicted_nm + rng.normal(size=predicted_nm.shape)
    measured_nm[400:500] = np.nan
    return time_s, measured_nm, predicted_nm


def _draw(kind: str) -> bytes:
    time_s, measured_nm, predicted_nm = _torques()
    if kind == "torque":
        return plot_torques(time_s, measured_nm, predicted_nm, AXES, title="demo, run loaded-1")
    if kind == "residual":
        return plot_residual(
            time_s,
            measured_nm[:, 2] - 0.5 * predicted_nm[:, 2],
            measured_nm[:, 2] - predicted_nm[:, 2],
            variable=predicted_nm[:, 2],
            variable_label="load torque [Nm]",
            velocity_rad_s=np.cos(3 * time_s),
            title="J3: load-friction",
        )
    return plot_gains(demo_calibration().gains, dict.fromkeys(AXES, 20.0), title="demo")


@pytest.mark.parametrize("kind", ["torque", "residual", "gains"])
def test_a_picture_is_whole_and_the_same_twice(kind: str) -> None:
    drawn = _draw(kind)
    assert drawn == _draw(kind)
    pixels = matplotlib.image.imread(io.BytesIO(drawn))
    assert pixels.shape[0] > 400
    assert pixels.shape[1] > 900
    # Something is drawn: a blank sheet has one colour.
    assert len(np.unique(np.round(255 * pixels).astype(np.uint8).view(np.uint32))) > 20


@pytest.mark.parametrize("axes", [1, 2, 5, 7])
def test_any_number_of_axes_has_its_panels(axes: int) -> None:
    time_s = np.arange(50) / 10.0
    torque_nm = np.ones((50, axes))
    drawn = plot_torques(time_s, torque_nm, torque_nm, tuple(f"J{i}" for i in range(axes)), title="t")
    assert matplotlib.image.imread(io.BytesIO(drawn)).size > 0


def test_a_run_of_which_nothing_could_be_used_is_drawn_all_the_same() -> None:
    nothing = np.full((50, 2), np.nan)
    drawn = plot_torques(np.arange(50) / 10.0, nothing, nothing, ("J1", "J2"), title="t")
    assert matplotlib.image.imread(io.BytesIO(drawn)).size > 0


@pytest.mark.parametrize("samples", [400, 6001, 300_000])
@pytest.mark.parametrize("place", [0.0, 0.37, 1.0])
def test_no_peak_and_no_gap_is_lost_on_the_way_to_the_pixels(samples: int, place: float) -> None:
    time_s, column = np.linspace(0.0, 1.0, samples), np.zeros(samples)
    column[round(place * (samples - 1))] = 1.0
    column[round(0.6 * samples) : round(0.7 * samples)] = np.nan
    figure, ((axes,),) = grid(1, (1.0,), "peak", height_in=3.0)
    axes.plot(time_s, column, color=ORANGE, linewidth=0.8)
    axes.set_ylim(-0.5, 1.5)
    axes.set_xlim(-0.1, 1.1)
    pixels = matplotlib.image.imread(io.BytesIO(render(figure)))
    drawn = (pixels[..., 0] > 0.8) & (pixels[..., 2] < 0.5)
    rows, columns = np.nonzero(drawn.any(axis=1))[0], np.nonzero(drawn.any(axis=0))[0]
    assert np.ptp(rows) > 0.4 * np.ptp(axes.get_window_extent().get_points()[:, 1])  # up to the peak, half of the panel
    gaps = np.diff(columns)
    assert gaps.max() > 0.07 * np.ptp(columns)  # a tenth is left out
    assert np.count_nonzero(gaps > 2) == 1


def test_the_table_says_error_and_truth_within_80_columns() -> None:
    gains = demo_calibration().gains
    out = io.StringIO()
    Console(file=out, width=80).print(gain_table(gains, {gain.axis: gain.value / 1.01 for gain in gains}))
    text = out.getvalue()
    assert "…" not in text
    assert text.count("+1.00") == 6
    assert "-9.210 ± 0.037" in text
    assert "-20.1" in text
    without = io.StringIO()
    Console(file=without, width=80).print(gain_table(gains))
    assert "truth" not in without.getvalue()


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (33.9, 0.1356, "33.90 ± 0.14"),
        (-9.2134, 0.0304, "-9.213 ± 0.030"),
        (1234.5, 56.7, "1234 ± 57"),
        (32.96, 0.0, "32.96 (fixed)"),
        (1.0, float("nan"), "1 ± nan"),
    ],
)
def test_a_value_is_rounded_by_its_uncertainty(value: float, std: float, text: str) -> None:
    assert with_deviation(value, std) == text


def test_a_torque_of_the_drive_is_questioned_only_beyond_its_noise() -> None:
    """σ of the ratio is √2 %: 6 % are said, 4 % are not, whatever the sign of the gain."""
    gains = [Gain(name, sign * 10.0, 0.1, "Nm/A", sign * 10.0) for name, sign in (("J1", 1), ("J2", -1), ("J3", 1))]
    slopes = [TorqueSlope(10.4, 0.1, 90), TorqueSlope(-10.6, 0.1, 90), None]
    (sentence,) = torque_sentences(slopes, gains)
    assert "by more than 3 σ on J2 (+6.0 %): a wrong torque constant" in sentence
    assert list(torque_sentences(slopes[:1], gains[:1])) == []


def test_pictures_need_no_screen_and_no_global_state() -> None:
    modules = "daq.report.plots, daq.report.plots, daq.report.gains"
    code = f"import sys, {modules}; print('matplotlib.pyplot' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
