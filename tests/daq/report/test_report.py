"""Pictures and tables: whole files, the same bytes for the same data,
and no peak lost on the way to the pixels.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
from xml.etree import ElementTree

import matplotlib.image
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from rich.console import Console

from daq.report.gains import gain_table, plot_gains, sum_text, torque_sentences, with_deviation
from daq.report.plots import plot_residual, plot_torques
from daq.report.svg import Line, before_after_drawing, chart, ranking, sheet, visible_points
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


def _drawings(kind: str) -> tuple[str, ...]:
    time_s, measured_nm, predicted_nm = _torques()
    if kind == "torque":
        forces = ("Nm",) * len(AXES)
        return plot_torques(time_s, measured_nm, predicted_nm, AXES, forces=forces)
    before_nm = measured_nm[:, 2] - 0.5 * predicted_nm[:, 2]
    after_nm = measured_nm[:, 2] - predicted_nm[:, 2]
    velocity_rad_s = np.cos(3 * time_s)
    return plot_residual(
        time_s,
        before_nm,
        after_nm,
        variable=predicted_nm[:, 2],
        variable_label="load torque [Nm]",
        velocity_rad_s=velocity_rad_s,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "panels"), [("torque", 6), ("residual", 4)])
def test_a_file_of_drawings_is_whole_and_the_same_twice(kind: str, panels: int) -> None:
    drawn = sheet(_drawings(kind), "J3 <&> run")
    expected = sheet(_drawings(kind), "J3 <&> run")
    assert drawn == expected
    assert len(drawn) < 400_000
    assert b"var(" not in drawn  # not every viewer of pictures knows variables
    root = ElementTree.fromstring(drawn)
    inner = [child for child in root if child.tag.endswith("svg")]
    assert len(inner) == panels
    places = {(float(one.attrib["x"]), float(one.attrib["y"])) for one in inner}
    assert len(places) == panels
    for one in inner:
        width = float(one.attrib["width"])
        assert float(one.attrib["x"]) + width < float(root.attrib["width"])
        height = float(one.attrib["height"])
        assert float(one.attrib["y"]) + height < float(root.attrib["height"])


def test_the_picture_of_the_gains_is_whole_and_the_same_twice() -> None:
    drawn = plot_gains(demo_calibration().gains, dict.fromkeys(AXES, 20.0))
    expected = plot_gains(demo_calibration().gains, dict.fromkeys(AXES, 20.0))
    assert drawn == expected
    assert matplotlib.image.imread(io.BytesIO(drawn)).shape[1] > 900


@pytest.mark.parametrize("axes", [1, 2, 5, 7])
def test_any_number_of_axes_has_its_panels(axes: int) -> None:
    time_s = np.arange(50) / 10.0
    torque_nm = np.ones((50, axes))
    forces = ("Nm",) * axes
    drawn = plot_torques(
        time_s, torque_nm, torque_nm, tuple(f"J{i}" for i in range(axes)), forces=forces
    )
    assert len(drawn) == axes
    ElementTree.fromstring(sheet(drawn, "t"))


def test_a_run_of_which_nothing_could_be_used_is_drawn_all_the_same() -> None:
    nothing = np.full((50, 2), np.nan)
    time_s = np.arange(50) / 10.0
    for one in plot_torques(time_s, nothing, nothing, ("J1", "J2"), forces=("Nm", "Nm")):
        assert "nan" not in one.partition("error nan")[2]


@pytest.mark.parametrize("samples", [400, 6001, 300_000])
@pytest.mark.parametrize("place", [0.0, 0.37, 1.0])
def test_no_peak_and_no_gap_is_lost_on_the_way_to_the_drawing(samples: int, place: float) -> None:
    x = np.linspace(0.0, 1.0, samples)
    column = np.zeros(samples)
    column[round(place * (samples - 1))] = 1.0
    column[round(0.6 * samples) : round(0.7 * samples)] = np.nan
    kept, values = visible_points(x, column)
    assert len(kept) <= 3000
    assert np.all(np.diff(kept) >= 0.0)
    assert np.nanmax(values) == 1.0
    expected = x[round(place * (samples - 1))]
    assert kept[np.nanargmax(values)] == expected
    gap = kept[~np.isfinite(values)]
    assert gap.min() == pytest.approx(0.6, abs=0.01)
    assert gap.max() == pytest.approx(0.7, abs=0.01)
    assert not np.any(np.isfinite(values) & (kept > 0.605) & (kept < 0.695))


def test_a_chart_draws_its_values_to_scale_and_breaks_at_gaps() -> None:
    """The scale of y is found from the grid lines of the drawing itself."""
    values = np.array([0.0, 10.0, np.nan, -10.0])
    lines = (Line(np.arange(4.0), values),)
    drawn = ElementTree.fromstring(chart(lines, "t", ("x", "y")))
    down = {float(t.text): float(t.attrib["y"]) - 4 for t in drawn.iter("text") if t.attrib.get("class") == "soft end"  # noqa: E501
            and t.text and t.text.lstrip("-").replace(".", "").isdigit()}  # fmt: skip
    (path,) = drawn.iter("path")
    pieces = re.findall(r"([ML])([\d.]+) ([\d.]+)", path.attrib["d"])
    assert [pen for pen, _, _ in pieces] == ["M", "L", "M"]
    assert [float(y) for _, _, y in pieces] == pytest.approx(
        [down[0.0], down[10.0], down[-10.0]], abs=0.1
    )
    x = [float(one) for _, one, _ in pieces]
    difference = x[1] - x[0]
    assert difference / (x[2] - x[0]) == pytest.approx(1 / 3, abs=0.01)


def test_a_name_of_any_length_leaves_the_scale_free() -> None:
    for name in ("J1", "shoulder_lift_joint", "a name that is longer than all the room there is"):
        rows = [(name, 3.0, 2.0)]
        drawn = ElementTree.fromstring(before_after_drawing(rows, "t", "%"))
        left = min(float(one.attrib["x1"]) for one in drawn.iter("line"))
        (shown,) = (one for one in drawn.iter("text") if one.text == name)
        assert float(shown.attrib.get("textLength", 8.5 * len(name))) < left


def test_no_word_of_a_ranking_is_cut_off() -> None:
    name = "J3: a torque that depends on the predicted current and that no named effect explains"
    rows = [(name, 5846.2, "full"), ("J2: a spring", 3.2, "empty")]
    drawn = ElementTree.fromstring(ranking(rows, "t", "%"))
    width, height = map(float, drawn.attrib["viewBox"].split()[2:])
    texts = [
        (one.text or "", float(one.attrib["x"]), float(one.attrib["y"]))
        for one in drawn.iter("text")
    ]
    assert " ".join(text for text, _, _ in texts if text in name) == name
    assert all(8.5 * len(text) + x <= width and y <= height for text, x, y in texts if text in name)
    assert {"5846", "3.2"} <= {text for text, _, _ in texts}


def test_no_grid_line_of_a_ranking_crosses_a_name() -> None:
    names = (
        "J3: a torque that depends on the load torque and that no named effect explains",
        "J2: a spring",
    )
    rows = [(name, 5846.2, "full") for name in names]
    drawn = ElementTree.fromstring(ranking(rows, "t", "%"))
    lines = [(float(one.attrib["y1"]), float(one.attrib["y2"])) for one in drawn.iter("line")]
    words = " ".join(names)
    baselines = [
        float(one.attrib["y"])
        for one in drawn.iter("text")
        if one.text is not None and one.text in words
    ]
    assert lines
    assert len(baselines) >= len(names) + 1
    for y in baselines:
        # Letters reach 11 above the baseline of a text of 14.
        assert all(bottom <= y - 11.0 or top >= y for top, bottom in lines)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("Izz1 + 1.0*Ia1 - 1.0*Iyy2 + 0.07*mz3", "Izz1 + Ia1 - Iyy2 + 0.07·mz3"),
        ("m6 - 1e-06*m7 + 21.0*m8", "m6 - 1e-06·m7 + 21.0·m8"),
        ("fv1", "fv1"),
        ("Ixx:disc", "Ixx:disc"),
        ("c of load-friction on J1*2", "c of load-friction on J1*2"),
    ],
)
def test_a_sum_of_parameters_is_written_for_readers(name: str, text: str) -> None:
    assert sum_text(name) == text


@given(st.lists(st.tuples(st.sampled_from("+-"), st.floats(1e-6, 1e3)), min_size=1, max_size=5))
def test_every_factor_of_a_sum_but_one_can_be_read_back(terms: list[tuple[str, float]]) -> None:
    rounded = [(sign, round(factor, 6)) for sign, factor in terms]
    name = "Izz1" + "".join(
        f" {sign} {factor}*m{number}" for number, (sign, factor) in enumerate(rounded)
    )
    shown = re.findall(r" ([+-]) (?:([0-9.e-]+)·)?m[0-9]", sum_text(name))
    assert [(sign, float(factor or 1.0)) for sign, factor in shown] == rounded


def test_the_table_says_error_and_truth_within_80_columns() -> None:
    gains = demo_calibration().gains
    out = io.StringIO()
    console = Console(file=out, width=80)
    truth = {gain.axis: gain.value / 1.01 for gain in gains}
    console.print(gain_table(gains, truth))
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
        (float("nan"), float("nan"), "-"),
    ],
)
def test_a_value_is_rounded_by_its_uncertainty(value: float, std: float, text: str) -> None:
    assert with_deviation(value, std) == text


def test_a_torque_of_the_drive_is_questioned_only_beyond_its_noise() -> None:
    """σ of the ratio is √2 %: 6 % are said, 4 % are not, whatever the sign of the gain."""
    gains = [
        Gain(name, sign * 10.0, 0.1, "Nm/A", sign * 10.0)
        for name, sign in (("J1", 1), ("J2", -1), ("J3", 1))
    ]
    torque_slope = TorqueSlope(-10.6, 0.1, 90)
    slopes = [TorqueSlope(10.4, 0.1, 90), torque_slope, None]
    (sentence,) = torque_sentences(slopes, gains)
    assert "by more than 3 σ on J2 (+6.0 %): a wrong torque constant" in sentence
    assert list(torque_sentences(slopes[:1], gains[:1])) == []


@pytest.mark.slow
def test_pictures_need_no_screen_and_no_global_state() -> None:
    modules = "daq.report.plots, daq.report.plots, daq.report.gains"
    code = f"import sys, {modules}; print('matplotlib.pyplot' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
