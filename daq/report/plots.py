"""The pictures of a fit and of a residual, each a PNG: torques, effects, and the ranking of candidates."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.config.cell import MILLIMETRE, Cell, JointUnit
from daq.files import replace_file
from daq.report.effect_names import effect_text, other_axis, variable_text
from daq.report.fit import start_of
from daq.report.gains import plot_gains
from daq.report.picture import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    QUANTITY,
    SKY,
    grid,
    legend_below,
    panels,
    render,
    unformatted,
)
from daq.workflow.fit import Fit
from ident.arrays import FloatArray
from ident.calibration import Calibration
from ident.discovery.evidence import Evidence
from ident.discovery.search import Finding
from ident.effects.effect import PlacedEffect
from ident.effects.signals import Abscissa, fitted_signals, session_began_s
from ident.equations.rows import decimate_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_fit(fitted: Fit, calibration: Calibration, truth: dict[str, float] | None, out: Path) -> None:
    """Draw the torques of a held-out run (paper Fig. 2), the residual before and after each effect, and the gains.

    `truth` is the true gain by axis, for a simulated cell only.

    Raises:
        OSError: from the file system.
    """
    before = start_of(fitted)
    final = fitted.steps[-1].after if fitted.steps else before
    replace_file(out / "torques.png", draw_torques(final, fitted.cell))
    replace_file(out / "gains.png", plot_gains(calibration.gains, truth, title="Joint drive gains"))
    for step in fitted.steps:
        for placed in (placed for placed in step.after.effects if placed not in before.effects):
            name = f"residual-{fitted.cell.axis_names[placed.axis]}-{placed.effect.name}.png"
            replace_file(out / name, draw_effect(before, step.after, placed, fitted.cell))
        before = step.after


def draw_torques(final: Evidence, cell: Cell) -> bytes:
    """Draw measured and predicted torque of the first held-out run, or of the fit."""
    rows = final.training if final.holdout is None else final.holdout
    rows = rows.only(rows.run == rows.run[0])
    return plot_torques(
        rows.time_s,
        np.where(rows.use, rows.torque(final.estimate.gains), np.nan).T,
        np.where(rows.use, final.estimate.predicted_torque(rows), np.nan).T,
        cell.axis_names,
        title=f"Joint torques of {'the first run of the fit' if final.holdout is None else 'a held-out run'}",
        forces=tuple(axis.unit.force for axis in cell.axes),
    )


def plot_torques(
    time_s: FloatArray,
    measured_nm: FloatArray,
    predicted_nm: FloatArray,
    axes: tuple[str, ...],
    *,
    title: str,
    forces: tuple[str, ...] = (),
    shown_s: float = 10.0,
) -> bytes:
    """Draw τ = V g with the identified gains (full) and the model's τ (dotted), one panel an axis (paper Fig. 2).

    The relative error over each panel is that of the whole run, not only of the stretch that is drawn.

    Args:
        time_s: shape (k,) [s].
        measured_nm: torque from current and identified gain, shape (k, n) [forces]; NaN where a row was left out.
        predicted_nm: torque from the model, same shape [forces].
        axes: names of the n axes.
        title: names the run.
        forces: "Nm" or, along a prismatic joint, "N", for each axis; all are "Nm" when left out.
        shown_s: length of the stretch that is drawn, from the beginning [s]; in a longer one the lines merge.
    """
    shown = time_s <= time_s[0] + shown_s
    whole_s = float(time_s[-1] - time_s[0])
    extent = f", first {shown_s:g} s of {whole_s:.0f} s" if whole_s > shown_s else ""
    figure, places = panels(
        len(axes), 2, f"{unformatted(title)}{extent}\ngaps: samples left out, most of them at standstill"
    )
    units = forces or ("Nm",) * len(axes)
    for index, (name, unit, place) in enumerate(zip(axes, units, places, strict=True)):
        measured, predicted = measured_nm[:, index], predicted_nm[:, index]
        place.plot(time_s[shown], measured[shown], color=SKY, linewidth=2.4, label="current × identified gain")
        place.plot(time_s[shown], predicted[shown], color=BLACK, linewidth=1.5, linestyle=":", label="model")
        both = np.isfinite(measured) & np.isfinite(predicted)
        norm = float(np.linalg.norm(measured[both]))
        # ‖ρ‖/‖Y‖ (paper, Table 6); unknown without samples.
        error = 100.0 * float(np.linalg.norm((measured - predicted)[both])) / norm if norm else float("nan")
        place.set_title(f"{unformatted(name)}   relative error {error:.1f} %", fontsize=9, loc="left")
        place.set_ylabel(f"{QUANTITY[unit]} [{unit}]", fontsize=8)
        if index >= len(axes) - 2:
            place.set_xlabel("time [s]", fontsize=8)
    legend_below(figure, places[0])
    return render(figure)


def draw_effect(before: Evidence, after: Evidence, placed: PlacedEffect, cell: Cell) -> bytes:
    """Draw the residual of an axis before and after an effect was added, on the first held-out run, or of the fit."""
    index = len(after.trained) if after.held_out else 0
    rows_before = before.holdout if before.holdout is not None else before.training
    rows_after = after.holdout if after.holdout is not None else after.training
    chosen, data = rows_after.run == index, after.datasets[index]
    seen = fitted_signals(after.model, data, after.training, after.estimate, session_began_s(after.trained))
    along = seen.variable(placed.effect.abscissa, placed.axis, other_axis(placed.effect))
    variable, velocity = (
        decimate_rows(data, rows_after.conditioning, column[None])[0]
        for column in (along, data.velocity_rad_s[:, placed.axis])
    )
    use = rows_after.use[placed.axis, chosen]
    residuals = (
        np.where(use, model.estimate.residual_torque(rows)[placed.axis, chosen], np.nan)
        for model, rows in ((before, rows_before), (after, rows_after))
    )
    axis = cell.axes[placed.axis]
    return plot_residual(
        rows_after.time_s[chosen],
        *residuals,
        variable=variable,
        variable_label=_label(placed, cell.axis_names, axis.unit),
        velocity_rad_s=velocity,
        title=f"{axis.name}: {effect_text(placed.effect, cell.axis_names)}, run {data.name}",
        force=axis.unit.force,
    )


def _label(placed: PlacedEffect, axes: tuple[str, ...], unit: JointUnit) -> str:
    """Label the variable with its unit at this joint: force and metres along a prismatic one."""
    abscissa = placed.effect.abscissa
    words, _, measure = abscissa.value.partition(" [")
    label = f"{variable_text(placed.effect, axes) if other_axis(placed.effect) is not None else words} [{measure}"
    if unit is not MILLIMETRE or abscissa in {Abscissa.MOTOR_ANGLE, Abscissa.CURRENT, Abscissa.OTHER_VELOCITY}:
        return label
    return label.replace("rad", "m").replace("Nm", "N").replace("torque", "force")


_POINTS = 2000
_BINS = 40


def plot_residual(
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
        time_s: shape (k,) [s].
        before_nm, after_nm: residual torque without and with the effect, shape (k,) [force]; NaN where a row was left
            out.
        variable: variable that the effect depends on, shape (k,).
        variable_label: its name and unit.
        velocity_rad_s: of the axis, shape (k,) [rad/s or m/s].
        title: names axis, effect and run.
        force: "Nm", or "N" along a prismatic joint.
    """
    title = f"{unformatted(title)}\ngaps: samples left out, most of them at standstill"
    figure, places = grid(2, (1.7, 1.0), title, height_in=2.5)
    rows = (("without the effect", before_nm, ORANGE), ("with the effect", after_nm, BLUE))
    for (over_time, scatter), (name, residual_nm, colour) in zip(places, rows, strict=True):
        over_time.plot(time_s, residual_nm, color=colour, linewidth=0.8)
        shown = np.isfinite(residual_nm)
        rms_nm = float(np.sqrt(np.mean(residual_nm[shown] ** 2))) if shown.any() else float("nan")
        over_time.set_title(f"{name}: RMS {rms_nm:.3g} {force}", fontsize=9, loc="left")
        over_time.set_ylabel(f"residual {QUANTITY[force]} [{force}]", fontsize=8)
        _draw_scatter(scatter, variable, residual_nm, velocity_rad_s)
    places[1][0].set_xlabel("time [s]", fontsize=8)
    places[1][1].set_xlabel(variable_label, fontsize=8)
    places[0][1].set_title("the same against the variable of the effect", fontsize=9, loc="left")
    legend_below(figure, places[0][1])
    return render(figure)


def _draw_scatter(place: Axes, variable: FloatArray, residual_nm: FloatArray, velocity_rad_s: FloatArray) -> None:
    place.axhline(0.0, color=GREY, linewidth=0.8)
    known = np.isfinite(variable) & np.isfinite(residual_nm)
    directions = (("forwards", velocity_rad_s > 0, GREEN, "-"), ("backwards", velocity_rad_s < 0, PURPLE, "--"))
    for name, moving, colour, line in directions:
        x, y = variable[known & moving], residual_nm[known & moving]
        step = max(len(x) // _POINTS, 1)
        place.plot(x[::step], y[::step], ".", color=colour, markersize=2, alpha=0.35, label=f"sample, {name}")
        # Stretches of the variable with equally many samples, so that no mean is of a handful of them.
        order = np.argsort(x, kind="stable") if len(x) >= _BINS else np.array([], dtype=np.intp)
        bins = np.array_split(order, _BINS) if len(order) else []
        centres, means = [x[part].mean() for part in bins], [y[part].mean() for part in bins]
        # A white rim keeps the mean visible in a cloud of its own colour.
        place.plot(centres, means, color="white", linewidth=3.6)
        place.plot(centres, means, color=colour, linewidth=1.8, linestyle=line, label=f"mean, {name}")


_BAR_IN = 0.32
_LOOK = {"passes every gate": (BLUE, ""), "indistinguishable from the best": (ORANGE, "//"), "fails a gate": (GREY, "")}
"""Colour and hatch of a bar by its label; the hatch distinguishes them in grey print."""


def plot_ranking(
    findings: Sequence[Finding], rivals: Sequence[PlacedEffect], axes: tuple[str, ...], *, title: str
) -> bytes:
    """Draw candidates by the fall of the squared error on left-out moves, the best first.

    Rivals are those not distinguishable from the added one or, where none was added, from the best; they are hatched.
    """
    figure, ((place,),) = grid(1, (1.0,), unformatted(title), height_in=_BAR_IN * len(findings))
    hatched = {(rival.effect.name, rival.axis) for rival in rivals}
    passed, rival, failed = _LOOK
    labels = [
        rival if (finding.effect.name, finding.axis) in hatched else passed if finding.passed else failed
        for finding in findings
    ]
    for label, (colour, hatch) in _LOOK.items():
        rows = [row for row, one in enumerate(labels) if one == label]
        falls = [findings[row].held_out_fall for row in rows]
        if rows:
            place.barh(rows, falls, color=colour, hatch=hatch, edgecolor="white", label=label)
    names = [PlacedEffect(finding.effect, finding.axis).name_among(axes) for finding in findings]
    place.set_yticks(range(len(names)), [unformatted(name) for name in names])
    place.invert_yaxis()
    place.set_xlabel("fall of the squared error on moves left out [noise variances]", fontsize=8)
    legend_below(figure, place)
    return render(figure)
