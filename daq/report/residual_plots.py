"""Pictures of the residual: one axis before and after an effect, and the candidates of a turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.report.picture import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    QUANTITY,
    FloatArray,
    grid,
    legend_below,
    save_png,
    thinned,
    unformatted,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_POINTS = 2000
_BINS = 40


def plot_residual(
    path: Path | None,
    time_s: FloatArray,
    before_nm: FloatArray,
    after_nm: FloatArray,
    *,
    variable: FloatArray,
    variable_label: str,
    velocity_rad_s: FloatArray,
    title: str,
    force: str = "Nm",
) -> bytes:
    """Draw the residual of one axis before and after an effect joined the model.

    Left over time, right against the variable that the effect depends on, with the mean of each stretch of it for
    either direction of motion (missing friction cancels over both): a mean away from zero is torque that the model
    still lacks.

    Args:
        path: of the PNG; None for its bytes alone.
        time_s: shape (k,) [s].
        before_nm, after_nm: residual torque without and with the effect, shape (k,) [force]; NaN where a row was left
            out.
        variable: variable that the effect depends on, shape (k,).
        variable_label: its name and unit.
        velocity_rad_s: of the axis, shape (k,) [rad/s or m/s].
        title: names axis, effect and run.
        force: "Nm", or "N" along a prismatic joint.

    Returns:
        the PNG.

    Raises:
        OSError: from the file system.
    """
    title = f"{unformatted(title)}\ngaps: samples left out, most of them at standstill"
    figure, ((before_time, before_scatter), (after_time, after_scatter)) = grid(2, (1.7, 1.0), title, height_in=2.5)
    rows = (
        ("without the effect", before_nm, ORANGE, before_time, before_scatter),
        ("with the effect", after_nm, BLUE, after_time, after_scatter),
    )
    for name, residual_nm, colour, over_time, scatter in rows:
        over_time.plot(*thinned(time_s, residual_nm), color=colour, linewidth=0.8)
        shown = np.isfinite(residual_nm)
        rms_nm = float(np.sqrt(np.mean(residual_nm[shown] ** 2))) if shown.any() else float("nan")
        over_time.set_title(f"{name}: RMS {rms_nm:.3g} {force}", fontsize=9, loc="left")
        over_time.set_ylabel(f"residual {QUANTITY[force]} [{force}]", fontsize=8)
        _draw_scatter(scatter, variable, residual_nm, velocity_rad_s)
    after_time.set_xlabel("time [s]", fontsize=8)
    after_scatter.set_xlabel(variable_label, fontsize=8)
    before_scatter.set_title("the same against the variable of the effect", fontsize=9, loc="left")
    legend_below(figure, before_scatter)
    return save_png(figure, path)


def _draw_scatter(place: Axes, variable: FloatArray, residual_nm: FloatArray, velocity_rad_s: FloatArray) -> None:
    place.axhline(0.0, color=GREY, linewidth=0.8)
    known = np.isfinite(variable) & np.isfinite(residual_nm)
    directions = (("forwards", velocity_rad_s > 0, GREEN, "-"), ("backwards", velocity_rad_s < 0, PURPLE, "--"))
    for name, moving, colour, line in directions:
        x, y = variable[known & moving], residual_nm[known & moving]
        step = max(len(x) // _POINTS, 1)
        place.plot(x[::step], y[::step], ".", color=colour, markersize=2, alpha=0.35, label=f"sample, {name}")
        centres, means = _binned_mean(x, y)
        # A white rim keeps the mean visible in a cloud of its own colour.
        place.plot(centres, means, color="white", linewidth=3.6)
        place.plot(centres, means, color=colour, linewidth=1.8, linestyle=line, label=f"mean, {name}")


def _binned_mean(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean of y in stretches of x with equally many samples, so that no mean is of a handful of them."""
    if len(x) < _BINS:
        return x[:0], y[:0]
    order = np.argsort(x, kind="stable")
    parts_x, parts_y = np.array_split(x[order], _BINS), np.array_split(y[order], _BINS)
    return np.array([part.mean() for part in parts_x]), np.array([part.mean() for part in parts_y])


_BAR_IN = 0.32
_PASSED, _RIVAL, _FAILED = "passes every gate", "indistinguishable from the best", "fails a gate"
_LOOK = {_PASSED: (BLUE, ""), _RIVAL: (ORANGE, "//"), _FAILED: (GREY, "")}
"""Colour and hatch; the hatch distinguishes them in grey print."""


@dataclass(frozen=True, slots=True)
class Bar:
    """One candidate.

    Attributes:
        name: effect and axis.
        fall: fall of the squared error on left-out moves, in noise variances.
        passed: whether it passes every gate.
        rival: not distinguishable from the added one (or, where none was added, from the best).
    """

    name: str
    fall: float
    passed: bool
    rival: bool


def plot_ranking(path: Path | None, bars: Sequence[Bar], *, title: str) -> bytes:
    """Draw candidates from the best down; rivals of the best are marked.

    Args:
        path: of the PNG; None for its bytes alone.
        bars: the best first, at least one.
        title: names the turn.

    Returns:
        the PNG.

    Raises:
        OSError: from the file system.
    """
    figure, ((place,),) = grid(1, (1.0,), unformatted(title), height_in=_BAR_IN * len(bars))
    for label, (colour, hatch) in _LOOK.items():
        rows = [row for row, bar in enumerate(bars) if _kind(bar) == label]
        if rows:
            place.barh(
                rows, [bars[row].fall for row in rows], color=colour, hatch=hatch, edgecolor="white", label=label
            )
    place.set_yticks(range(len(bars)), [unformatted(bar.name) for bar in bars])
    place.invert_yaxis()
    place.set_xlabel("fall of the squared error on moves left out [noise variances]", fontsize=8)
    legend_below(figure, place)
    return save_png(figure, path)


def _kind(bar: Bar) -> str:
    if bar.rival:
        return _RIVAL
    return _PASSED if bar.passed else _FAILED
