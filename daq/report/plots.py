"""The pictures of a fit and of a residual as drawings: torques, effects, and the ranking of candidates.

Each function returns the drawings of a page, one a panel; `daq.report.svg.sheet` makes a file of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from daq.config.cell import Cell
from daq.files import replace_file
from daq.report.effect_names import effect_text, other_axis, variable_label
from daq.report.fit import start_of
from daq.report.gains import plot_gains
from daq.report.picture import QUANTITY
from daq.report.svg import Line, chart, ranking, sheet
from daq.workflow.fit import Fit
from ident.arrays import FloatArray
from ident.calibration import Calibration
from ident.discovery.evidence import Evidence
from ident.discovery.search import Finding
from ident.effects.effect import PlacedEffect
from ident.effects.signals import fitted_signals, session_began_s
from ident.equations.observation import Observation
from ident.equations.rows import decimate_rows
from ident.estimators.estimate import relative_error


def draw_fit(fitted: Fit, calibration: Calibration, truth: dict[str, float] | None, out: Path) -> None:
    """Draw the torques of a held-out run (paper Fig. 2), the residual before and after each effect, and the gains.

    `truth` is the true gain by axis, for a simulated cell only.

    Raises:
        OSError: from the file system.
    """
    before = start_of(fitted)
    final = fitted.steps[-1].after if fitted.steps else before
    title = f"Joint torques, {'first run of the fit' if final.holdout is None else 'a held-out run'}"
    replace_file(out / "torques.svg", sheet(draw_torques(final, fitted.cell), title))
    replace_file(out / "gains.png", plot_gains(calibration.gains, truth, title="Joint drive gains"))
    for step in fitted.steps:
        for placed in (placed for placed in step.after.effects if placed not in before.effects):
            axis = fitted.cell.place_names[placed.axis]
            title = f"{axis}: {effect_text(placed.effect, fitted.cell.place_names)}"
            drawn = sheet(draw_effect(before, step.after, placed, fitted.cell), title)
            replace_file(out / f"residual-{axis}-{placed.effect.name}.svg", drawn)
        before = step.after


def _shown_rows(evidence: Evidence) -> Observation:
    """Held-out rows, or those of the fit where there are none."""
    return evidence.training if evidence.holdout is None else evidence.holdout


def draw_torques(final: Evidence, cell: Cell) -> tuple[str, ...]:
    """Draw measured and predicted torque of the first held-out run, or of the fit."""
    rows = _shown_rows(final)
    rows = rows.only(rows.run == rows.run[0])
    return plot_torques(
        rows.time_s,
        np.where(rows.use, rows.torque(final.estimate.gains), np.nan).T,
        np.where(rows.use, final.estimate.predicted_torque(rows), np.nan).T,
        cell.axis_names,
        forces=tuple(axis.unit.force for axis in cell.axes),
    )


SHOWN_S = 10.0  #: Length of the stretch that is drawn, from the beginning [s]; in a longer one the lines merge


def plot_torques(
    time_s: FloatArray,
    measured_nm: FloatArray,
    predicted_nm: FloatArray,
    axes: tuple[str, ...],
    *,
    forces: tuple[str, ...],
) -> tuple[str, ...]:
    """Draw τ = V g with the identified gains (wide) and the model's τ (dashed), one panel an axis (paper Fig. 2).

    The relative error over each panel is that of the whole run, not only of the stretch that is drawn.

    Args:
        time_s: shape (k,) [s].
        measured_nm: torque from current and identified gain, shape (k, n) [forces]; NaN where a row was left out.
        predicted_nm: torque from the model, same shape [forces].
        axes: names of the n axes.
        forces: "Nm" or, along a prismatic joint, "N", for each axis.
    """
    shown = time_s <= time_s[0] + SHOWN_S
    drawn = []
    use = np.isfinite(measured_nm) & np.isfinite(predicted_nm)
    errors = relative_error(measured_nm.T, predicted_nm.T, use.T)
    for index, (name, unit) in enumerate(zip(axes, forces, strict=True)):
        lines = (
            Line(time_s[shown], measured_nm[shown, index], "wide", "current × gain"),
            Line(time_s[shown], predicted_nm[shown, index], "dashed", "model"),
        )
        label = f"{name}: {QUANTITY[unit]} [{unit}], error {errors.axes[index]:.1f} %"
        drawn.append(chart(lines, f"Measured and predicted {QUANTITY[unit]} of {name}", ("time [s]", label)))
    return tuple(drawn)


def drawn_axis(before: Evidence, after: Evidence, placed: PlacedEffect) -> int:
    """Return the axis of an effect; of one on a joint without a motor, the axis whose residual falls most with it."""
    if placed.axis < after.model.robot.axis_count:
        return placed.axis
    without, with_it = (
        np.sum(one.estimate.residual_torque(one.training) ** 2, axis=1, where=one.training.use)
        for one in (before, after)
    )
    moved = without > 0.0
    return int(np.argmax(np.where(moved, without - with_it, 0.0) / np.where(moved, without, 1.0)))


def draw_effect(before: Evidence, after: Evidence, placed: PlacedEffect, cell: Cell) -> tuple[str, ...]:
    """Draw the residual of an axis before and after an effect was added, on the first held-out run, or of the fit.

    It is that of `drawn_axis`, against the variable and the velocity of the joint that the effect acts on.
    """
    index = len(after.fit_runs) if after.held_out else 0
    rows_after = _shown_rows(after)
    chosen = rows_after.run == index
    data = after.datasets[index]
    seen = fitted_signals(after.model, data, after.training, after.estimate, session_began_s(after.fit_runs))
    along = seen.variable(placed.effect.abscissa, placed.axis, other_axis(placed.effect))
    variable, velocity = (
        decimate_rows(data, rows_after.conditioning, column[None])[0]
        for column in (along, seen.velocity_rad_s[placed.axis])
    )
    drawn = drawn_axis(before, after, placed)
    use = rows_after.use[drawn, chosen]
    residuals = (
        np.where(use, model.estimate.residual_torque(_shown_rows(model))[drawn, chosen], np.nan)
        for model in (before, after)
    )
    return plot_residual(
        rows_after.time_s[chosen],
        *residuals,
        variable=variable,
        variable_label=variable_label(placed.effect, cell.place_names, cell.place_units[placed.axis].force),
        velocity_rad_s=velocity,
        force=cell.axes[drawn].unit.force,
    )


_BINS = 40


def plot_residual(
    time_s: FloatArray,
    before_nm: FloatArray,
    after_nm: FloatArray,
    *,
    variable: FloatArray,
    variable_label: str,
    velocity_rad_s: FloatArray,
    force: str = "Nm",
) -> tuple[str, ...]:
    """Draw the residual of one axis before and after an effect joined the model, in four panels of one scale.

    First over time, then against the variable that the effect depends on, with the mean of each stretch of it for
    either direction of motion (missing friction cancels over both): a mean away from zero is torque that the model
    still lacks.

    Args:
        time_s: shape (k,) [s].
        before_nm, after_nm: residual torque without and with the effect, shape (k,) [force]; NaN where a row was left
            out.
        variable: variable that the effect depends on, shape (k,).
        variable_label: its name and unit.
        velocity_rad_s: of the axis, shape (k,) [rad/s or m/s].
        force: "Nm", or "N" along a prismatic joint.
    """
    drawn = []
    reach = float(np.nanmax(np.abs(np.concatenate([before_nm, after_nm, [0.0]]))))
    for words, residual_nm in (("without", before_nm), ("with", after_nm)):
        shown = residual_nm[np.isfinite(residual_nm)]
        rms_nm = float(np.sqrt(np.mean(shown**2))) if len(shown) else float("nan")
        label = f"residual {words} the effect [{force}], RMS {rms_nm:.3g}"
        title = f"Residual {QUANTITY[force]} {words} the effect"
        over_time = chart((Line(time_s, residual_nm, "thin"),), title, ("time [s]", label), reach=reach)
        lines = _against(variable, residual_nm, velocity_rad_s)
        drawn += [over_time, chart(lines, title, (variable_label, f"{words} the effect [{force}]"), reach=reach)]
    return tuple(drawn)


def _against(variable: FloatArray, residual_nm: FloatArray, velocity_rad_s: FloatArray) -> tuple[Line, ...]:
    """Samples and means over the variable, for either direction of motion."""
    known = np.isfinite(variable) & np.isfinite(residual_nm)
    clouds, means = [], []
    directions = (("forwards", velocity_rad_s > 0, "cloud", "line"), ("backwards", velocity_rad_s < 0, "rest", "other"))
    for name, moving, cloud, line in directions:
        x, y = variable[known & moving], residual_nm[known & moving]
        # Stretches of the variable with equally many samples, so that no mean is of a handful of them.
        bins = np.array_split(np.argsort(x, kind="stable"), _BINS) if len(x) >= _BINS else []
        clouds.append(Line(x, y, cloud))
        centres, middle = (np.array([column[part].mean() for part in bins]) for column in (x, y))
        means.append(Line(centres, middle, line, f"mean {name}"))
    return (*clouds, *means)


def plot_ranking(findings: Sequence[Finding], rivals: Sequence[PlacedEffect], axes: tuple[str, ...]) -> str:
    """Draw candidates by the fall of the squared error on left-out moves, the best first.

    Rivals are those not distinguishable from the added one; they are pale. Those that fail a gate are hollow.
    """
    alike = {(rival.effect.name, rival.axis) for rival in rivals}
    rows = []
    for one in findings:
        kind = "full" if one.passed else "empty"
        if (one.effect.name, one.axis) in alike:
            kind = "alike"
        rows.append((f"{axes[one.axis]}: {effect_text(one.effect, axes)}", one.held_out_fall, kind))
    return ranking(rows, "Candidates", "squared error that it removes")
