"""Pictures and tables: whole files, the same bytes for the same data,
and no peak lost on the way to the pixels.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import matplotlib.image
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from rich.console import Console, RenderableType

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
    speeds_rad_s = np.arange(1, 7)
    amplitudes_nm = np.array([40, 60, 30, 8, 6, 3])
    predicted_nm = amplitudes_nm * np.sin(np.outer(time_s, speeds_rad_s))
    measured_nm = predicted_nm + rng.normal(size=predicted_nm.shape)
    measured_nm[400:500] = np.nan
    return time_s, measured_nm, predicted_nm


def _drawings(kind: str) -> tuple[str, ...]:
    time_s, measured_nm, predicted_nm = _torques()
    if kind == "torque":
        forces = ("Nm",) * len(AXES)
        return plot_torques(time_s, measured_nm, predicted_nm, AXES, forces=forces)
    measured_j3_nm = measured_nm[:, 2]
    predicted_j3_nm = predicted_nm[:, 2]
    return plot_residual(
        time_s,
        measured_j3_nm - 0.5 * predicted_j3_nm,
        measured_j3_nm - predicted_j3_nm,
        variable=predicted_j3_nm,
        variable_label="load torque [Nm]",
        velocity_rad_s=np.cos(3 * time_s),
    )


def _number(element: Element, attribute: str) -> float:
    return float(element.attrib[attribute])


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "panels"), [("torque", 6), ("residual", 4)])
def test_a_file_of_drawings_is_whole_and_the_same_twice(kind: str, panels: int) -> None:
    drawn = sheet(_drawings(kind), "J3 <&> run")
    again = sheet(_drawings(kind), "J3 <&> run")
    assert drawn == again
    assert len(drawn) < 400_000
    assert b"var(" not in drawn  # not every viewer of pictures knows variables
    root = ElementTree.fromstring(drawn)
    inner = [child for child in root if child.tag.endswith("svg")]
    assert len(inner) == panels
    places = {(_number(panel, "x"), _number(panel, "y")) for panel in inner}
    assert len(places) == panels
    for panel in inner:
        right = _number(panel, "x") + _number(panel, "width")
        assert right < _number(root, "width")
        bottom = _number(panel, "y") + _number(panel, "height")
        assert bottom < _number(root, "height")


def test_the_picture_of_the_gains_is_whole_and_the_same_twice() -> None:
    truth = dict.fromkeys(AXES, 20.0)
    drawn = plot_gains(demo_calibration().gains, truth)
    again = plot_gains(demo_calibration().gains, truth)
    assert drawn == again
    _, width, *_ = matplotlib.image.imread(io.BytesIO(drawn)).shape
    assert width > 900


@pytest.mark.parametrize("axes", [1, 2, 5, 7])
def test_any_number_of_axes_has_its_panels(axes: int) -> None:
    time_s = np.arange(50) / 10.0
    torque_nm = np.ones((50, axes))
    names = tuple(f"J{i}" for i in range(axes))
    drawn = plot_torques(time_s, torque_nm, torque_nm, names, forces=("Nm",) * axes)
    assert len(drawn) == axes
    ElementTree.fromstring(sheet(drawn, "t"))


def test_a_run_of_which_nothing_could_be_used_is_drawn_all_the_same() -> None:
    nothing = np.full((50, 2), np.nan)
    time_s = np.arange(50) / 10.0
    for drawing in plot_torques(time_s, nothing, nothing, ("J1", "J2"), forces=("Nm", "Nm")):
        _, _, after_heading = drawing.partition("error nan")
        assert "nan" not in after_heading


@pytest.mark.parametrize("samples", [400, 6001, 300_000])
@pytest.mark.parametrize("place", [0.0, 0.37, 1.0])
def test_no_peak_and_no_gap_is_lost_on_the_way_to_the_drawing(samples: int, place: float) -> None:
    x = np.linspace(0.0, 1.0, samples)
    peak = round(place * (samples - 1))
    column = np.zeros(samples)
    column[peak] = 1.0
    column[round(0.6 * samples) : round(0.7 * samples)] = np.nan
    visible_x, values = visible_points(x, column)
    assert len(visible_x) <= 3000
    assert np.all(np.diff(visible_x) >= 0.0)
    assert np.nanmax(values) == 1.0
    assert visible_x[np.nanargmax(values)] == x[peak]
    gap = visible_x[~np.isfinite(values)]
    assert gap.min() == pytest.approx(0.6, abs=0.01)
    assert gap.max() == pytest.approx(0.7, abs=0.01)
    is_inside_gap = (visible_x > 0.605) & (visible_x < 0.695)
    assert not np.any(np.isfinite(values[is_inside_gap]))


def _heights_of_grid_values(drawn: Element) -> dict[float, float]:
    """Height in the drawing of each value that the axis of y names."""
    heights = {}
    for text in drawn.iter("text"):
        content = text.text or ""
        is_number = content.lstrip("-").replace(".", "").isdigit()
        if is_number and text.attrib.get("class") == "soft end":
            heights[float(content)] = _number(text, "y") - 4  # letters stand below their line
    return heights


def test_a_chart_draws_its_values_to_scale_and_breaks_at_gaps() -> None:
    """The scale of y is found from the grid lines of the drawing itself."""
    values = np.array([0.0, 10.0, np.nan, -10.0])
    lines = (Line(np.arange(4.0), values),)
    drawn = ElementTree.fromstring(chart(lines, "t", ("x", "y")))
    heights = _heights_of_grid_values(drawn)
    (path,) = drawn.iter("path")
    points = re.findall(r"([ML])([\d.]+) ([\d.]+)", path.attrib["d"])
    pens = [pen for pen, _, _ in points]
    x = [float(x) for _, x, _ in points]
    y = [float(y) for _, _, y in points]
    assert pens == ["M", "L", "M"]
    assert y == pytest.approx([heights[0.0], heights[10.0], heights[-10.0]], abs=0.1)
    assert (x[1] - x[0]) / (x[2] - x[0]) == pytest.approx(1 / 3, abs=0.01)


LETTER_WIDTH = 8.5  #: of a wide letter in a text of 14
LETTER_HEIGHT = 11.0  #: of a letter above the baseline of a text of 14


def test_a_name_of_any_length_leaves_the_scale_free() -> None:
    for name in ("J1", "shoulder_lift_joint", "a name that is longer than all the room there is"):
        rows = [(name, 3.0, 2.0)]
        drawn = ElementTree.fromstring(before_after_drawing(rows, "t", "%"))
        left = min(_number(line, "x1") for line in drawn.iter("line"))
        (label,) = (text for text in drawn.iter("text") if text.text == name)
        length = float(label.attrib.get("textLength", LETTER_WIDTH * len(name)))
        assert length < left


def test_no_word_of_a_ranking_is_cut_off() -> None:
    name = "J3: a torque that depends on the predicted current and that no named effect explains"
    rows = [(name, 5846.2, "full"), ("J2: a spring", 3.2, "empty")]
    drawn = ElementTree.fromstring(ranking(rows, "t", "%"))
    _, _, width, height = map(float, drawn.attrib["viewBox"].split())
    texts = list(drawn.iter("text"))
    contents = [text.text or "" for text in texts]
    assert " ".join(content for content in contents if content in name) == name
    for text, content in zip(texts, contents, strict=True):
        if content in name:
            assert LETTER_WIDTH * len(content) + _number(text, "x") <= width
            assert _number(text, "y") <= height
    assert {"5846", "3.2"} <= set(contents)


def test_no_grid_line_of_a_ranking_crosses_a_name() -> None:
    names = (
        "J3: a torque that depends on the load torque and that no named effect explains",
        "J2: a spring",
    )
    rows = [(name, 5846.2, "full") for name in names]
    drawn = ElementTree.fromstring(ranking(rows, "t", "%"))
    lines = list(drawn.iter("line"))
    words = " ".join(names)
    baselines = [
        _number(text, "y")
        for text in drawn.iter("text")
        if text.text is not None and text.text in words
    ]
    assert lines
    assert len(baselines) >= len(names) + 1
    for baseline in baselines:
        for line in lines:
            is_above = _number(line, "y2") <= baseline - LETTER_HEIGHT
            is_below = _number(line, "y1") >= baseline
            assert is_above or is_below


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
    name = "Izz1"
    for number, (sign, factor) in enumerate(rounded):
        name += f" {sign} {factor}*m{number}"
    written = re.findall(r" ([+-]) (?:([0-9.e-]+)·)?m[0-9]", sum_text(name))
    read_back = [(sign, float(factor or 1.0)) for sign, factor in written]  # 1 is not written
    assert read_back == rounded


def _printed(table: RenderableType) -> str:
    out = io.StringIO()
    Console(file=out, width=80).print(table)
    return out.getvalue()


def test_the_table_says_error_and_truth_within_80_columns() -> None:
    gains = demo_calibration().gains
    truth = {gain.axis: gain.value / 1.01 for gain in gains}
    text = _printed(gain_table(gains, truth))
    assert "…" not in text
    assert text.count("+1.00") == 6
    assert "-9.210 ± 0.037" in text
    assert "-20.1" in text
    without_truth = _printed(gain_table(gains))
    assert "truth" not in without_truth


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
    j1 = Gain("J1", 10.0, 0.1, "Nm/A", 10.0)
    j2 = Gain("J2", -10.0, 0.1, "Nm/A", -10.0)
    j3 = Gain("J3", 10.0, 0.1, "Nm/A", 10.0)
    within_noise = TorqueSlope(10.4, 0.1, 90)
    beyond_noise = TorqueSlope(-10.6, 0.1, 90)
    (sentence,) = torque_sentences([within_noise, beyond_noise, None], [j1, j2, j3])
    assert "by more than 3 σ on J2 (+6.0 %): a wrong torque constant" in sentence
    assert list(torque_sentences([within_noise], [j1])) == []


@pytest.mark.slow
def test_pictures_need_no_screen_and_no_global_state() -> None:
    modules = "daq.report.plots, daq.report.gains"
    code = f"import sys, {modules}; print('matplotlib.pyplot' in sys.modules)"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
