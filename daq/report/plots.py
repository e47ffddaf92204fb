"""The pictures of a fit and of a residual as drawings:
torques, effects, and the ranking of candidates.

Each function returns the drawings of a page, one a panel; `daq.report.svg.sheet` makes a file of
them.
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


def draw_fit(
    fitted: Fit, calibration: Calibration, truth: dict[str, float] | None, out: Path
) -> None:
    """Draw the torques of a held-out run, the residual by effect, and the gains (paper Fig. 2).

    `truth` is the true gain by axis, for a simulated cell only.

    Raises:
        OSError: from the file system.
    """
    before = start_of(fitted)
    final = before
    if fitted.steps:
        final = fitted.steps[-1].after
    run = "a held-out run"
    if final.holdout is None:
        run = "first run of the fit"
    torques = sheet(draw_torques(final, fitted.cell), f"Joint torques, {run}")
    replace_file(out / "torques.svg", torques)
    gains = plot_gains(calibration.gains, truth)
    replace_file(out / "gains.png", gains)
    for step in fitted.steps:
        for placed in step.after.effects:
            if placed in before.effects:
                continue
            axis = fitted.cell.place_names[placed.axis]
            title = f"{axis}: {effect_text(placed.effect, fitted.cell.place_names)}"
            residual = draw_effect(before, step.after, placed, fitted.cell)
            replace_file(out / f"residual-{axis}-{placed.effect.name}.svg", sheet(residual, title))
        before = step.after


def _shown_rows(evidence: Evidence) -> Observation:
    """Held-out rows, or those of the fit where there are none."""
    if evidence.holdout is None:
        return evidence.training
    return evidence.holdout


def draw_torques(final: Evidence, cell: Cell) -> tuple[str, ...]:
    """Draw measured and predicted torque of the first held-out run, or of the fit."""
    rows = _shown_rows(final)
    rows = rows.only(rows.run == rows.run[0])
    measured_nm = np.where(rows.use, rows.torque(final.estimate.gains), np.nan)
    predicted_nm = np.where(rows.use, final.estimate.predicted_torque(rows), np.nan)
    forces = tuple(axis.unit.force for axis in cell.axes)
    return plot_torques(rows.time_s, measured_nm.T, predicted_nm.T, cell.axis_names, forces=forces)


#: Length of the stretch that is drawn, from the beginning [s]; in a longer one the lines merge
SHOWN_S = 10.0


def plot_torques(
    time_s: FloatArray,
    measured_nm: FloatArray,
    predicted_nm: FloatArray,
    axes: tuple[str, ...],
    *,
    forces: tuple[str, ...],
) -> tuple[str, ...]:
    """Draw τ = V g with the identified gains (wide) and the model's τ (dashed),
    one panel an axis (paper Fig. 2).

    The relative error over each panel is that of all of the run, not only of the stretch that is
    drawn.

    Args:
        time_s: shape (k,) [s].
        measured_nm: torque from current and identified gain, shape (k, n) [forces]; NaN where a row
            was left out.
        predicted_nm: torque from the model, same shape [forces].
        axes: names of the n axes.
        forces: "Nm" or, along a prismatic joint, "N", for each axis.
    """
    shown = time_s <= time_s[0] + SHOWN_S
    drawn = []
    use = np.isfinite(measured_nm) & np.isfinite(predicted_nm)
    errors = relative_error(measured_nm.T, predicted_nm.T, use.T)
    for index, (name, unit) in enumerate(zip(axes, forces, strict=True)):
        measured = Line(time_s[shown], measured_nm[shown, index], "wide", "current × gain")
        predicted = Line(time_s[shown], predicted_nm[shown, index], "dashed", "model")
        quantity = QUANTITY[unit]
        label = f"{name}: {quantity} [{unit}], error {errors.axes[index]:.1f} %"
        title = f"Measured and predicted {quantity} of {name}"
        drawn.append(chart((measured, predicted), title, ("time [s]", label)))
    return tuple(drawn)


def drawn_axis(before: Evidence, after: Evidence, placed: PlacedEffect) -> int:
    """Return the axis of an effect; of one on a joint without a motor,
    the axis whose residual falls most with it.
    """
    if placed.axis < after.model.robot.axis_count:
        return placed.axis
    without = _squared_residual(before)
    with_it = _squared_residual(after)
    moved = without > 0.0
    fall = np.where(moved, without - with_it, 0.0)
    share = fall / np.where(moved, without, 1.0)
    return int(np.argmax(share))


def _squared_residual(evidence: Evidence) -> FloatArray:
    """Sum of the squared residual torque of each axis over the rows of the fit, shape (n,)."""
    rows = evidence.training
    residual_nm = evidence.estimate.residual_torque(rows)
    squared: FloatArray = np.sum(residual_nm**2, axis=1, where=rows.use)
    return squared


def draw_effect(
    before: Evidence, after: Evidence, placed: PlacedEffect, cell: Cell
) -> tuple[str, ...]:
    """Draw the residual of an axis before and after an effect was added, on the first held-out run,
    or of the fit.

    It is that of `drawn_axis`, against the variable and the velocity of the joint that the effect
    acts on.
    """
    index = 0
    if after.held_out:
        index = len(after.fit_runs)
    rows_after = _shown_rows(after)
    chosen = rows_after.run == index
    data = after.datasets[index]
    began_s = session_began_s(after.fit_runs)
    signals = fitted_signals(after.model, data, after.training, after.estimate, began_s)
    effect = placed.effect
    along = signals.variable(effect.abscissa, placed.axis, other_axis(effect))
    velocity_rad_s = signals.velocity_rad_s[placed.axis]
    columns = np.stack([along, velocity_rad_s])
    variable, shown_velocity_rad_s = decimate_rows(data, rows_after.conditioning, columns)
    axis = drawn_axis(before, after, placed)
    use = rows_after.use[axis, chosen]
    before_nm = before.estimate.residual_torque(_shown_rows(before))[axis, chosen]
    after_nm = after.estimate.residual_torque(rows_after)[axis, chosen]
    unit = cell.place_units[placed.axis]
    return plot_residual(
        rows_after.time_s[chosen],
        np.where(use, before_nm, np.nan),
        np.where(use, after_nm, np.nan),
        variable=variable,
        variable_label=variable_label(effect, cell.place_names, unit.force),
        velocity_rad_s=shown_velocity_rad_s,
        force=cell.axes[axis].unit.force,
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
    """Draw the residual of one axis before and after an effect joined the model,
    in four panels of one scale.

    First over time, then against the variable that the effect depends on, with the mean of each
    stretch of it for either direction of motion (missing friction cancels over both): a mean away
    from zero is torque that the model still lacks.

    Args:
        time_s: shape (k,) [s].
        before_nm, after_nm: residual torque without and with the effect, shape (k,) [force]; NaN
            where a row was left out.
        variable: variable that the effect depends on, shape (k,).
        variable_label: its name and unit.
        velocity_rad_s: of the axis, shape (k,) [rad/s or m/s].
        force: "Nm", or "N" along a prismatic joint.
    """
    drawn = []
    every_nm = np.concatenate([before_nm, after_nm, [0.0]])
    reach = float(np.nanmax(np.abs(every_nm)))
    for words, residual_nm in (("without", before_nm), ("with", after_nm)):
        shown = residual_nm[np.isfinite(residual_nm)]
        rms_nm = float("nan")
        if len(shown):
            rms_nm = float(np.sqrt(np.mean(shown**2)))
        label = f"residual {words} the effect [{force}], RMS {rms_nm:.3g}"
        title = f"Residual {QUANTITY[force]} {words} the effect"
        curve = Line(time_s, residual_nm, "thin")
        drawn.append(chart((curve,), title, ("time [s]", label), reach=reach))
        lines = _against(variable, residual_nm, velocity_rad_s)
        labels = (variable_label, f"{words} the effect [{force}]")
        drawn.append(chart(lines, title, labels, reach=reach))
    return tuple(drawn)


def _against(
    variable: FloatArray, residual_nm: FloatArray, velocity_rad_s: FloatArray
) -> tuple[Line, ...]:
    """Samples and means over the variable, for either direction of motion."""
    known = np.isfinite(variable) & np.isfinite(residual_nm)
    forwards = known & (velocity_rad_s > 0)
    backwards = known & (velocity_rad_s < 0)
    return (
        Line(variable[forwards], residual_nm[forwards], "cloud"),
        Line(variable[backwards], residual_nm[backwards], "rest"),
        _mean_line(variable[forwards], residual_nm[forwards], "line", "mean forwards"),
        _mean_line(variable[backwards], residual_nm[backwards], "other", "mean backwards"),
    )


def _mean_line(variable: FloatArray, residual_nm: FloatArray, kind: str, name: str) -> Line:
    """Mean of each stretch of the variable; empty where there are too few samples."""
    # Stretches with equally many samples, so that no mean is of a handful of them.
    stretches = []
    if len(variable) >= _BINS:
        order = np.argsort(variable, kind="stable")
        stretches = np.array_split(order, _BINS)
    centres = [variable[rows].mean() for rows in stretches]
    means = [residual_nm[rows].mean() for rows in stretches]
    return Line(np.array(centres), np.array(means), kind, name)


def plot_ranking(
    findings: Sequence[Finding], rivals: Sequence[PlacedEffect], axes: tuple[str, ...]
) -> str:
    """Draw candidates by the fall of the squared error on left-out moves, the best first.

    Rivals are those not distinguishable from the added one; they are pale. Those that fail a gate
    are hollow.
    """
    alike = {(rival.effect.name, rival.axis) for rival in rivals}
    rows = []
    for one in findings:
        kind = "empty"
        if one.passed:
            kind = "full"
        if (one.effect.name, one.axis) in alike:
            kind = "alike"
        name = f"{axes[one.axis]}: {effect_text(one.effect, axes)}"
        rows.append((name, one.left_out_fall, kind))
    return ranking(rows, "Candidates", "squared error that it removes")
