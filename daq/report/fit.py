"""The pictures of a fit: torques as the paper's Fig. 2, the gains, and the residual before and after each effect."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from daq.configuration.cell import Cell
from daq.configuration.joint_unit import MILLIMETRE, JointUnit
from daq.effect_words import in_words, other_axis, variable_words
from daq.fit import Fit
from daq.report.gains import plot_gains
from daq.report.residual import plot_residual
from daq.report.torque import plot_torques
from ident.before_after import declared
from ident.calibration import Calibration
from ident.effects.abscissa import Abscissa, values
from ident.effects.placed import PlacedEffect
from ident.loop import Evidence
from ident.rows import decimate_rows
from ident.signals import session_began_s, signals


def draw(fitted: Fit, calibration: Calibration, truth: dict[str, float] | None, out: Path) -> None:
    """Torques of the unused run (paper Fig. 2), residual before and after each effect, and the gains.

    Raises:
        OSError: from the file system.
    """
    before = start_of(fitted)
    final = fitted.steps[-1].after if fitted.steps else before
    draw_torques(out / "torques.png", final, fitted.cell)
    plot_gains(out / "gains.png", calibration.gains, truth, title="Joint drive gains")
    for step in fitted.steps:
        for placed in (placed for placed in step.after.effects if placed not in before.effects):
            name = fitted.cell.axis_names[placed.axis]
            draw_effect(out / f"residual-{name}-{placed.effect.name}.png", before, step.after, placed, fitted.cell)
        before = step.after


def start_of(fitted: Fit) -> Evidence:
    """The rows under the declared model; the logs are read again only where nobody has kept them.

    Raises:
        DataError: a log cannot be read any more.
    """
    if not fitted.steps:
        return fitted.evidence()
    return declared(fitted.steps[0].after, fitted.identification.estimate)


def draw_torques(path: Path | None, final: Evidence, cell: Cell) -> bytes:
    """Measured against predicted torque of the first run held out, or of the fit.

    Raises:
        OSError: from the file system.
    """
    rows = final.training if final.holdout is None else final.holdout
    rows = rows.only(rows.run == rows.run[0])
    measured = np.where(rows.use, rows.torque(final.estimate.gains), np.nan).T
    predicted = np.where(rows.use, final.estimate.predicted_torque(rows), np.nan).T
    which = "a run not used in the fit" if final.holdout is not None else "the first run of the fit"
    forces = tuple(axis.unit.force for axis in cell.axes)
    title = f"Joint torques of {which}"
    return plot_torques(path, rows.time_s, measured, predicted, cell.axis_names, title=title, forces=forces)


def draw_effect(path: Path | None, before: Evidence, after: Evidence, placed: PlacedEffect, cell: Cell) -> bytes:
    """The residual of an effect's axis before and after it joined the model, on the first run held out, or of the fit.

    Raises:
        OSError: from the file system.
    """
    index = len(after.trained) if after.held_out else 0
    rows_before = before.holdout if before.holdout is not None else before.training
    rows_after = after.holdout if after.holdout is not None else after.training
    chosen, data = rows_after.run == index, after.datasets[index]
    seen = signals(after.model, data, after.training, after.estimate, session_began_s(after.trained))
    along = values(placed.effect.abscissa, seen, placed.axis, other_axis(placed.effect))
    variable, velocity = (
        decimate_rows(data, rows_after.conditioning, column[None])[0]
        for column in (along, data.velocity_rad_s[placed.axis])
    )
    use = rows_after.use[placed.axis, chosen]
    residuals = (
        np.where(use, model.estimate.residual_torque(rows)[placed.axis, chosen], np.nan)
        for model, rows in ((before, rows_before), (after, rows_after))
    )
    name, unit = cell.axes[placed.axis].name, cell.axes[placed.axis].unit
    return plot_residual(
        path,
        rows_after.time_s[chosen],
        *residuals,
        variable=variable,
        variable_label=_label(placed, cell.axis_names, unit),
        velocity_rad_s=velocity,
        title=f"{name}: {in_words(placed.effect, cell.axis_names)}, run {data.name}",
        force=unit.force,
    )


def _label(placed: PlacedEffect, axes: tuple[str, ...], unit: JointUnit) -> str:
    """The variable with its unit at this joint: what acts on a prismatic one is a force, and its position is in m."""
    abscissa = placed.effect.abscissa
    words, _, measure = abscissa.value.partition(" [")
    label = f"{variable_words(placed.effect, axes) if other_axis(placed.effect) is not None else words} [{measure}"
    if unit is not MILLIMETRE or abscissa in {Abscissa.MOTOR_ANGLE, Abscissa.CURRENT, Abscissa.OTHER_VELOCITY}:
        return label
    return label.replace("rad", "m").replace("Nm", "N").replace("torque", "force")
