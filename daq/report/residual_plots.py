"""Pictures of one axis: the residual before and after an effect, over time and against its variable."""

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
    either direction of motion (what friction lacks cancels over both): a mean that still leaves zero is torque that the
    model still lacks.

    Args:
        path: of the PNG; None where its bytes alone are wanted.
        time_s: shape (k,) [s].
        before_nm, after_nm: residual torque without and with the effect, shape (k,) [force]; NaN where a row was left
            out.
        variable: what the effect depends on, shape (k,).
        variable_label: its name and unit.
        velocity_rad_s: of the axis, shape (k,) [rad/s or m/s].
        title: says which axis, which effect and which run it is.
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
    """Mean of y in stretches of x with equally many samples: no mean rests on a handful of them."""
    if len(x) < _BINS:
        return x[:0], y[:0]
    order = np.argsort(x, kind="stable")
    parts_x, parts_y = np.array_split(x[order], _BINS), np.array_split(y[order], _BINS)
    return np.array([part.mean() for part in parts_x]), np.array([part.mean() for part in parts_y])


# The candidates of one turn beside each other: what each would take off the error of moves left out.


_BAR_IN = 0.32
_PASSED, _RIVAL, _CLOSED = "passes every gate", "as good as the best", "fails a gate"
_LOOK = {_PASSED: (BLUE, ""), _RIVAL: (ORANGE, "//"), _CLOSED: (GREY, "")}
"""Colour and hatch; hatched, so that they differ in grey print too."""


@dataclass(frozen=True, slots=True)
class Bar:
    """One candidate.

    Attributes:
        name: effect and axis.
        fall: of the whole squared error on left-out moves, in units of the noise.
        passed: every gate.
        rival: indistinguishable from the one that was added (or, where none was, from the best).
    """

    name: str
    fall: float
    passed: bool
    rival: bool


def plot_ranking(path: Path | None, bars: Sequence[Bar], *, title: str) -> bytes:
    """Draw candidates from the best down; rivals of the best are marked.

    Args:
        path: of the PNG; None where its bytes alone are wanted.
        bars: the best first, at least one.
        title: says which turn it is.

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
    return _PASSED if bar.passed else _CLOSED
